//! The loops of the three nodes over vectors, without any middleware: frames in, poses out, against the truth.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod frames;

use std::sync::Arc;

use frames::camera_image;
use futures::channel::{mpsc, oneshot};
use futures::{StreamExt, stream};
use image::ExtendedColorType;
use jigsaw::generate::{Options, Puzzle};
use jigsaw_msgs::action::{AssembleFeedback, AssembleGoal, AssembleResult};
use jigsaw_msgs::builtin_interfaces::msg::{Duration, Time};
use jigsaw_msgs::geometry_msgs::msg::Pose;
use jigsaw_msgs::msg::{Assembly, Mating, PieceFeatures, PieceImage};
use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};
use jigsaw_msgs::std_msgs::msg::Header;
use jigsaw_msgs::std_srvs::srv::{Trigger, TriggerRequest, TriggerResponse};
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_msgs::visualization_msgs::msg::{Marker, MarkerArray};
use jigsaw_nodes::capture::source::Frame;
use jigsaw_nodes::ros::actions::{Goal, GoalEnd};
use jigsaw_nodes::ros::activity::Activity;
use jigsaw_nodes::ros::health::Health;
use jigsaw_nodes::ros::params::{Parameters, Spec};
use jigsaw_nodes::ros::session::{Call, Settings};
use jigsaw_nodes::ros::transforms::PixelPlane;
use jigsaw_nodes::{capture, feature, solver};
use nalgebra::{Isometry2, Vector2};

/// Tolerance of a goal pose, in pixels and radians: a few times what the refinement reaches on such frames.
const TOLERANCE_PX: f64 = 0.5;
const TOLERANCE_RAD: f64 = 0.005;

const TOPIC: &str = "/camera/image";

fn parameters(table: &'static [Spec]) -> Arc<Parameters> {
    Arc::new(Parameters::declare("/test", &[table]))
}

fn health() -> Arc<Health> {
    Arc::new(Health::new("/test"))
}

fn puzzle() -> Puzzle {
    Puzzle::generate(&Options { rows: 2, columns: 3, seed: 11, noise: 2.0, blur: 1.0, ..Options::default() }).unwrap()
}

fn raw_frames(puzzle: &Puzzle) -> Vec<Frame> {
    let stamp = |k: usize| Time { sec: k as i32, nanosec: 0 };
    (0..puzzle.frame_count()).map(|k| Frame::Raw(TOPIC.to_owned(), camera_image(puzzle, k, stamp(k)))).collect()
}

fn settings(specs: &'static [Spec], health: &Arc<Health>) -> Settings {
    Settings { parameters: parameters(specs), health: Arc::clone(health), activity: Activity::always() }
}

fn run_capture(frames: Vec<Frame>, calls: Vec<Call<Trigger>>, health: &Arc<Health>) -> Vec<PieceImage> {
    let (sender, receiver) = mpsc::unbounded();
    let settings = settings(capture::params::PARAMETERS, health);
    let requests = capture::Requests { calls: stream::iter(calls), forgets: stream::empty(), resets: stream::empty() };
    smol::block_on(capture::run(stream::iter(frames), requests, sender, settings));
    smol::block_on(receiver.collect())
}

fn run_feature(pieces: Vec<PieceImage>, health: &Arc<Health>) -> Vec<PieceFeatures> {
    let (sender, receiver) = mpsc::unbounded();
    let settings = settings(feature::params::PARAMETERS, health);
    let (images, _) = mpsc::channel(0);
    let overlays = feature::Overlays { images, wanted: Box::new(|| false) };
    smol::block_on(feature::run(stream::iter(pieces), sender, overlays, settings));
    smol::block_on(receiver.collect())
}

struct Published {
    assemblies: Vec<Assembly>,
    transforms: Vec<TFMessage>,
    markers: Vec<MarkerArray>,
}

fn run_solver(features: Vec<PieceFeatures>, resets: Vec<Call<Trigger>>, health: &Arc<Health>) -> Published {
    run_solver_with_goals(features, resets, Vec::new(), health)
}

fn run_solver_with_goals(
    features: Vec<PieceFeatures>,
    resets: Vec<Call<Trigger>>,
    goals: Vec<solver::AssembleGoal>,
    health: &Arc<Health>,
) -> Published {
    // Room for everything the loop may publish, so that nobody need read while it runs.
    let room = 2 * features.len() + 16;
    let (assembly, assemblies) = mpsc::channel(room);
    let (transform, transforms) = mpsc::channel(room);
    let (marker, markers) = mpsc::channel(room);
    let (solutions, _) = mpsc::unbounded();
    let (told, _) = mpsc::channel(room);
    let outputs =
        solver::Outputs { assembly, transforms: transform, markers: marker, resets: told, solutions, journal: None };
    let settings = settings(solver::params::PARAMETERS, health);
    let requests = solver::Requests {
        resets: stream::iter(resets),
        solves: stream::empty(),
        goals: stream::iter(goals),
        forgets: stream::empty(),
    };
    smol::block_on(async {
        solver::run(stream::iter(features), requests, outputs, settings).await;
        Published {
            assemblies: assemblies.collect().await,
            transforms: transforms.collect().await,
            markers: markers.collect().await,
        }
    })
}

fn call() -> (Call<Trigger>, oneshot::Receiver<TriggerResponse>) {
    let (reply, answer) = oneshot::channel();
    (Call { request: TriggerRequest::default(), reply }, answer)
}

fn plane_pose(pose: &Pose) -> Isometry2<f64> {
    let angle = 2.0 * pose.orientation.z.atan2(pose.orientation.w);
    Isometry2::new(Vector2::new(pose.position.x, pose.position.y), angle)
}

#[test]
fn frames_become_poses_that_agree_with_the_truth() {
    let puzzle = puzzle();
    let health = health();
    let pieces = run_capture(raw_frames(&puzzle), Vec::new(), &health);
    assert_eq!(pieces.len(), 6);
    let features = run_feature(pieces, &health);
    let published = run_solver(features.clone(), Vec::new(), &health);
    assert_eq!(health.refusals(), 0);

    let last = published.assemblies.last().unwrap();
    assert_eq!((last.state, last.pieces.len(), last.unplaced.len()), (Assembly::COMPLETE, 6, 0));
    assert_eq!(last.header.stamp.sec, 5);
    let scale = features[0].metres_per_pixel;
    // The frame of the solution is its own; the first piece ties it to the frame of the truth.
    let mut solution_from_truth = None;
    for (k, truth) in puzzle.pieces().iter().enumerate() {
        let id = format!("{}_000000000", truth.frame);
        let placed = last.pieces.iter().find(|p| p.id == id).unwrap();
        let border = puzzle.border(k, 1.0);
        let [width, height] = puzzle.options().frame_size();
        let table = PixelPlane::table(width, height, scale);
        let observed = table.metres_from_pixels(border.centroid());
        let found = plane_pose(&placed.observed);
        assert!((found.translation.vector - observed.coords).norm() < TOLERANCE_PX * scale);
        assert_eq!(found.rotation.angle(), 0.0);
        let truth_plane = PixelPlane { metres_per_pixel: scale, origin_px: nalgebra::Point2::origin() };
        let goal = truth_plane.pose(&puzzle.puzzle_from_image(k).unwrap(), border.centroid());
        let found = plane_pose(&placed.goal);
        let tie = *solution_from_truth.get_or_insert(found * goal.inverse());
        let error = found.inverse() * tie * goal;
        assert!(error.translation.vector.norm() < TOLERANCE_PX * scale, "{id}: {error}");
        assert!(error.rotation.angle().abs() < TOLERANCE_RAD, "{id}: {error}");
    }

    let transforms = published.transforms.last().unwrap();
    assert_eq!(transforms.transforms.len(), 12);
    let markers = &published.markers.last().unwrap().markers;
    assert_eq!(markers[0].action, Marker::DELETEALL);
    assert_eq!(markers.len(), 13);
    let outlines = markers.iter().filter(|m| m.ns == "outline");
    let points: Vec<_> = outlines.flat_map(|m| &m.points).collect();
    let low = |value: fn(&jigsaw_msgs::geometry_msgs::msg::Point) -> f64| {
        points.iter().map(|p| value(p)).fold(f64::MAX, f64::min)
    };
    // The origin of the puzzle frame is its bottom left corner.
    assert!(low(|p| p.x).abs() < 1e-12 && low(|p| p.y).abs() < 1e-12);
}

/// A picture file as a camera would send it.
fn photograph(file: &std::path::Path, stamp: Time) -> Image {
    let picture = image::open(file).unwrap();
    let (width, height) = (picture.width(), picture.height());
    let (encoding, data) = if picture.color().has_color() {
        ("rgb8", picture.into_rgb8().into_raw())
    } else {
        ("mono8", picture.into_luma8().into_raw())
    };
    let header = Header { stamp, frame_id: "camera".to_owned() };
    Image { header, height, width, encoding: encoding.into(), is_bigendian: 0, step: data.len() as u32 / height, data }
}

/// Each message says of each real piece what the next node takes. Skipped where the scans are missing.
#[test]
fn real_pieces_are_refused_by_no_node() {
    let folder = std::env::var_os("JIGSAW_SCANS").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scans"),
        std::path::PathBuf::from,
    );
    if !folder.is_dir() {
        println!("skipped: no scans");
        return;
    }
    for (set, count) in [("eda12", 12), ("patch16", 16), ("toystory48", 48), ("white120", 120), ("horse208", 208)] {
        let folder = [folder.join(set).join("pieces"), folder.join(set)].into_iter().find(|f| f.is_dir()).unwrap();
        let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let is_scan = |file: &std::path::PathBuf| {
            let name = file.file_name().unwrap().to_string_lossy();
            [".png", ".jpg", ".jpeg", ".tiff"].iter().any(|end| name.ends_with(end)) && !name.contains("solved")
        };
        let mut files: Vec<_> = files.filter(is_scan).collect();
        files.sort();
        let stamp = |k: usize| Time { sec: k as i32, nanosec: 0 };
        let frames = files.iter().enumerate().map(|(k, f)| Frame::Raw(TOPIC.to_owned(), photograph(f, stamp(k))));
        let health = health();
        let features = run_feature(run_capture(frames.collect(), Vec::new(), &health), &health);
        assert_eq!((features.len(), health.refusals()), (count, 0), "{set}");
        for message in &features {
            solver::convert::piece(message).unwrap_or_else(|refusal| panic!("{set}: {refusal}"));
        }
    }
}

#[test]
fn the_same_run_twice_gives_the_same_messages() {
    let puzzle = puzzle();
    let run = || {
        let health = health();
        let features = run_feature(run_capture(raw_frames(&puzzle), Vec::new(), &health), &health);
        run_solver(features, Vec::new(), &health).assemblies.last().cloned().unwrap()
    };
    assert_eq!(run(), run());
}

#[test]
fn raw_and_compressed_frames_give_the_same_pieces() {
    let puzzle = puzzle();
    let compressed = (0..puzzle.frame_count())
        .map(|k| {
            let Image { header, width, height, data, .. } =
                camera_image(&puzzle, k, Time { sec: k as i32, nanosec: 0 });
            let mut png = std::io::Cursor::new(Vec::new());
            image::write_buffer_with_format(
                &mut png,
                &data,
                width,
                height,
                ExtendedColorType::L8,
                image::ImageFormat::Png,
            )
            .unwrap();
            let image = CompressedImage { header, format: "png".into(), data: png.into_inner() };
            Frame::Compressed(TOPIC.to_owned(), image)
        })
        .collect();
    let health = health();
    assert_eq!(run_capture(raw_frames(&puzzle), Vec::new(), &health), run_capture(compressed, Vec::new(), &health));
}

#[test]
fn bad_frames_are_refused_and_the_rest_goes_on() {
    let puzzle = puzzle();
    let mut frames = raw_frames(&puzzle);
    let ground =
        Image { encoding: "mono8".into(), width: 64, height: 64, step: 64, data: vec![200; 4096], ..Image::default() };
    let short = Image { data: vec![0; 10], ..ground.clone() };
    let unknown = Image { encoding: "bayer".into(), ..ground.clone() };
    for (at, bad) in [(0, ground), (2, short), (4, unknown)] {
        frames.insert(at, Frame::Raw(TOPIC.to_owned(), bad));
    }
    frames.push(Frame::Compressed(
        TOPIC.to_owned(),
        CompressedImage { data: b"text".to_vec(), ..CompressedImage::default() },
    ));
    let health = health();
    assert_eq!(run_capture(frames, Vec::new(), &health).len(), 6);
    assert_eq!(health.refusals(), 4);
}

#[test]
fn the_capture_service_publishes_the_latest_pieces_again() {
    let (early, too_early) = call();
    let health = health();
    assert!(run_capture(Vec::new(), vec![early], &health).is_empty());
    assert!(!smol::block_on(too_early).unwrap().success);
}

#[test]
fn bad_features_are_refused_and_change_nothing() {
    let puzzle = puzzle();
    let health = health();
    let good = run_feature(run_capture(raw_frames(&puzzle), Vec::new(), &health), &health);
    let clean = run_solver(good.clone(), Vec::new(), &health).assemblies.last().cloned().unwrap();
    let first = &good[0];
    let other = |change: &dyn Fn(&mut PieceFeatures)| {
        let mut bad = first.clone();
        bad.id = "stranger".to_owned();
        change(&mut bad);
        bad
    };
    let bad = vec![
        other(&|f| f.id = "a/b".to_owned()),
        other(&|f| f.id = String::new()),
        other(&|f| f.border_x_px[3] = f32::NAN),
        other(&|f| f.border_y_px.truncate(4)),
        other(&|f| f.border_x_px.iter_mut().for_each(|x| *x = -*x)),
        other(&|f| f.border_length_px = f32::INFINITY),
        other(&|f| f.metres_per_pixel = 0.0),
        other(&|f| f.metres_per_pixel *= 2.0),
        other(&|f| f.frame_width_px = u32::MAX),
        other(&|f| f.noise_px = -1.0),
        other(&|f| f.isthmuses[0].arc_px[0] = 1e9),
        other(&|f| f.isthmuses[0].polarity = 7),
        other(&|f| f.isthmuses[0].width_px = f32::NAN),
        // A piece of another name's content under a known id.
        PieceFeatures { id: first.id.clone(), ..good[1].clone() },
    ];
    let refused = bad.len() as u64;
    let health = self::health();
    let mut mixed = good.clone();
    mixed.extend(bad);
    // The same message again is no offence.
    mixed.push(first.clone());
    let published = run_solver(mixed, Vec::new(), &health);
    assert_eq!(health.refusals(), refused);
    assert_eq!(published.assemblies.last().unwrap(), &clean);
}

#[test]
fn a_piece_that_still_lies_there_is_counted_once() {
    let puzzle = puzzle();
    let health = health();
    let mut features = run_feature(run_capture(raw_frames(&puzzle), Vec::new(), &health), &health);
    // As a capture node names them that was started again while the camera looks at the same table.
    let again: Vec<PieceFeatures> = features
        .iter()
        .map(|f| {
            let mut again = PieceFeatures { id: format!("again_{}", f.id), ..f.clone() };
            again.border_x_px.iter_mut().enumerate().for_each(|(i, x)| *x += 0.2 * (i as f32).sin());
            again
        })
        .collect();
    features.extend(again);
    let published = run_solver(features, Vec::new(), &health);
    let last = published.assemblies.last().unwrap();
    assert_eq!((last.state, last.pieces.len(), last.unplaced.len()), (Assembly::COMPLETE, 6, 0));
}

/// A piece that was turned half about the middle of the table is sought where it lies now, whatever comes first, and also when
/// what was seen before comes once more.
#[test]
fn a_piece_that_was_moved_is_sought_where_it_lies_now() {
    let puzzle = puzzle();
    let mut frames = raw_frames(&puzzle);
    let mut turned = camera_image(&puzzle, 2, Time { sec: 9, nanosec: 0 });
    turned.data.reverse();
    frames.push(Frame::Raw(TOPIC.to_owned(), turned));
    let health = health();
    let features = run_feature(run_capture(frames, Vec::new(), &health), &health);
    assert_eq!(features.len(), 7);
    let (before, now) = ("2_000000000", "9_000000000");
    let settled = run_solver(features[..6].to_vec(), Vec::new(), &health).assemblies.last().cloned().unwrap();
    let matings = |assembly: &Assembly| {
        let name = |id: &String| if id == now { before.to_owned() } else { id.clone() };
        let ends = |m: &Mating| [name(&m.positive_piece), name(&m.negative_piece)];
        let mut matings: Vec<_> = assembly.matings.iter().map(ends).collect();
        matings.sort();
        matings
    };
    let pick = |assembly: &Assembly, id: &str| {
        plane_pose(&assembly.pieces.iter().find(|p| p.id == id).unwrap().observed).translation.vector
    };
    let replayed = [&features[..], &features[2..3]].concat();
    let backwards: Vec<PieceFeatures> = features.iter().rev().cloned().collect();
    for features in [features, replayed, backwards] {
        let published = run_solver(features, Vec::new(), &health);
        let last = published.assemblies.last().unwrap();
        assert_eq!((last.state, last.pieces.len()), (Assembly::COMPLETE, 6));
        assert_eq!(last.unplaced, [before]);
        assert!(last.pieces.iter().all(|p| p.id != before));
        assert!((pick(last, now) + pick(&settled, before)).norm() < TOLERANCE_PX * 1e-4);
        assert_eq!(matings(last), matings(&settled));
        let frames = &published.transforms.last().unwrap().transforms;
        assert!(frames.len() == 12 && frames.iter().all(|t| !t.child_frame_id.contains(before)));
    }
    assert_eq!(health.refusals(), 0);
}

#[test]
fn the_order_of_the_pieces_does_not_matter() {
    let puzzle = puzzle();
    let health = health();
    let mut features = run_feature(run_capture(raw_frames(&puzzle), Vec::new(), &health), &health);
    let relative = |assembly: &Assembly| {
        let goal = |frame: usize| {
            let id = format!("{frame}_000000000");
            plane_pose(&assembly.pieces.iter().find(|p| p.id == id).unwrap().goal)
        };
        (1..6).map(|k| goal(0).inverse() * goal(k)).collect::<Vec<_>>()
    };
    let forward = run_solver(features.clone(), Vec::new(), &health);
    features.reverse();
    let backward = run_solver(features, Vec::new(), &health);
    let poses = |p: &Published| relative(p.assemblies.last().unwrap());
    for (a, b) in poses(&forward).iter().zip(poses(&backward)) {
        let error = a.inverse() * b;
        assert!(error.translation.vector.norm() < TOLERANCE_PX * 1e-4 && error.rotation.angle().abs() < TOLERANCE_RAD);
    }
}

#[test]
fn a_reset_forgets_all_pieces() {
    let (reset, answer) = call();
    let published = run_solver(Vec::new(), vec![reset], &health());
    assert!(smol::block_on(answer).unwrap().success);
    let last = published.assemblies.last().unwrap();
    assert_eq!((last.state, last.pieces.len()), (Assembly::COLLECTING, 0));
    assert_eq!(published.markers.last().unwrap().markers.len(), 1);
}

type End = (GoalEnd, AssembleResult);

fn goal(expected_pieces: u32) -> (solver::AssembleGoal, mpsc::Receiver<AssembleFeedback>, oneshot::Receiver<End>) {
    let (feedback, feedbacks) = mpsc::channel(100);
    let (finish, finished) = oneshot::channel();
    let (_, cancelled) = oneshot::channel();
    let goal = AssembleGoal { expected_pieces, ..Default::default() };
    (Goal { goal, feedback, finish, cancelled }, feedbacks, finished)
}

#[test]
fn a_goal_succeeds_when_every_expected_piece_is_placed() {
    let puzzle = puzzle();
    let health = health();
    let features = run_feature(run_capture(raw_frames(&puzzle), Vec::new(), &health), &health);
    let (wish, feedbacks, finished) = goal(6);
    run_solver_with_goals(features.clone(), Vec::new(), vec![wish], &health);
    let (end, result) = smol::block_on(finished).unwrap();
    assert_eq!((end, result.complete, result.assembly.pieces.len()), (GoalEnd::Succeeded, true, 6));
    let feedbacks: Vec<_> = smol::block_on(feedbacks.collect());
    assert_eq!(feedbacks.last().unwrap().pieces_seen, 6);

    // A goal that waits for a piece that never comes is not reached.
    let (wish, _, finished) = goal(7);
    run_solver_with_goals(features, Vec::new(), vec![wish], &health);
    assert!(smol::block_on(finished).is_err());
}

#[test]
fn what_is_left_over_spoils_no_puzzle_of_known_size() {
    let other = Puzzle::generate(&Options { rows: 2, columns: 3, seed: 12, ..Options::default() }).unwrap();
    // Shown first, for a goal ends as soon as the expected pieces are placed.
    let mut frames = vec![Frame::Raw(TOPIC.to_owned(), camera_image(&other, 0, Time { sec: 9, nanosec: 0 }))];
    frames.extend(raw_frames(&puzzle()));
    let health = health();
    let features = run_feature(run_capture(frames, Vec::new(), &health), &health);
    let state = run_solver(features.clone(), Vec::new(), &health).assemblies.last().unwrap().state;
    assert_eq!(state, Assembly::PARTIAL);
    let (wish, _, finished) = goal(6);
    run_solver_with_goals(features, Vec::new(), vec![wish], &health);
    let (end, result) = smol::block_on(finished).unwrap();
    assert_eq!((end, result.assembly.pieces.len(), result.assembly.unplaced.len()), (GoalEnd::Succeeded, 6, 1));
}

#[test]
fn a_goal_with_a_time_that_is_none_is_rejected() {
    let goal = |sec, nanosec| AssembleGoal { time_budget: Duration { sec, nanosec }, ..Default::default() };
    assert_eq!(solver::convert::budget(&goal(3, 5)), Ok(Some(std::time::Duration::new(3, 5))));
    assert_eq!(solver::convert::budget(&goal(0, 0)), Ok(None));
    for (sec, nanosec) in [(-1, 0), (0, 1_000_000_000), (i32::MIN, u32::MAX)] {
        let said = solver::convert::budget(&goal(sec, nanosec)).unwrap_err().to_string();
        assert!(said.contains("time_budget") && said.contains(&sec.to_string()), "{said}");
    }
}
