//! `jigsaw watch`: wait at the end of the line until the puzzle is complete, print it, and write it to files.
//!
//! Listens to `assembly`, `pieces/features` and `assembly/image` only, as any arm would. `assembly.json` has the form of
//! that of `jigsaw assemble`: poses in metres are taken back to pixels, y down, with the top left corner of the assembly
//! at the origin. `assembly.png` is the last picture of the solver node.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::rc::Rc;
use std::time::Duration;

use clap::Args;
use futures::{FutureExt, StreamExt};
use jigsaw::TableCounts;
use jigsaw_msgs::geometry_msgs::msg::Pose;
use jigsaw_msgs::msg::{Assembly as AssemblyMessage, PieceFeatures};
use jigsaw_msgs::sensor_msgs::msg::Image;
use nalgebra::{Isometry2, Point2, Vector2};

use crate::console::{complain, say};
use crate::results::{
    ASSEMBLY_FILE, ASSEMBLY_PICTURE, AoiRecord, AssemblyFile, MatingRecord, PlacedRecord, PoseRecord, Seconds,
    SideRecord, WriteError, make_folder, write_file, write_json,
};
use crate::ros::exit::exit_code;
use crate::ros::process::Process;
use crate::ros::session::{Session, SessionError};
use crate::ros::topics;
use crate::ros::transforms::PixelPlane;
use crate::solver::convert;

/// Exit code where the puzzle was not complete in time.
const INCOMPLETE: u8 = 1;

/// Exit code for bad input.
const BAD_INPUT: u8 = 2;

/// Wait until the puzzle is assembled; print where its pieces go, and write assembly.json and assembly.png.
///
/// Exit code 0 only if the puzzle was complete, 1 if it was not by the time limit (what there is, is written), 2 for bad
/// input, 3 if the middleware failed and it is to be started again. The shapes of the pieces must be on DDS: `jigsaw cell`
/// keeps them to itself.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// Folder for the results; made if it isn't there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Pieces the puzzle has; without, the puzzle is complete when the solver node says so.
    #[arg(long, value_name = "N")]
    pieces: Option<usize>,
    /// Seconds to wait; 0 for no limit.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    timeout: f64,
    /// Arguments of ROS: -r FROM:=TO, -r __ns:=/NS …
    #[arg(long = "ros-args", num_args = 0.., allow_hyphen_values = true, value_terminator = "--", value_name = "ARGS")]
    ros_args: Vec<String>,
}

/// What was heard last.
#[derive(Debug, Default)]
struct Heard {
    assembly: Option<AssemblyMessage>,
    features: HashMap<String, PieceFeatures>,
    picture: Option<Image>,
}

impl Heard {
    /// Whether the puzzle is complete.
    fn is_assembled(&self, pieces: Option<usize>) -> bool {
        self.assembly.as_ref().is_some_and(|assembly| {
            assembly.state == AssemblyMessage::COMPLETE && pieces.is_none_or(|n| assembly.pieces.len() >= n)
        })
    }

    /// How many of the pieces are placed whose shape is not known.
    fn shapeless(&self) -> usize {
        let pieces = self.assembly.iter().flat_map(|assembly| &assembly.pieces);
        pieces.filter(|p| !self.features.contains_key(&p.id)).count()
    }

    /// Whether the puzzle is complete and the shape of every piece is known.
    fn is_complete(&self, pieces: Option<usize>) -> bool {
        self.is_assembled(pieces) && self.shapeless() == 0
    }

    /// How long to wait for what is missing still; `None` for the assembly itself.
    fn patience(&self, pieces: Option<usize>) -> Option<Duration> {
        let patience = if self.shapeless() == 0 { PICTURE_PATIENCE } else { SHAPE_PATIENCE };
        self.is_assembled(pieces).then_some(patience)
    }
}

/// How long to wait for the picture of a complete assembly, which comes after it.
const PICTURE_PATIENCE: Duration = Duration::from_secs(2);

/// How long to wait for the shapes of the pieces of a complete assembly. They come before it, or, latched, within 3 s.
const SHAPE_PATIENCE: Duration = Duration::from_secs(10);

/// Runs the command.
#[must_use]
pub fn run(args: WatchArgs) -> ExitCode {
    let Ok(timeout) = Duration::try_from_secs_f64(args.timeout) else {
        complain!("jigsaw watch: --timeout {}: must be 0 or a positive number of seconds", args.timeout);
        return ExitCode::from(BAD_INPUT);
    };
    let ros = std::iter::once("--ros-args".to_owned()).chain(args.ros_args);
    let heard = Rc::new(RefCell::new(Heard::default()));
    let (listening, pieces) = (Rc::clone(&heard), args.pieces);
    let ended = Rc::new(Cell::new(false));
    let in_time = Rc::clone(&ended);
    let result = Process::start("jigsaw", ros).and_then(|process| {
        process.run(move |process| {
            let mut session = process.node("assembly_watcher", &[])?;
            let listen = listen(&mut session, listening, pieces)?;
            Ok(Box::pin(async move {
                // The node lives as long as it listens.
                let _session = session;
                if timeout.is_zero() {
                    listen.await;
                } else {
                    futures::select! {
                        () = listen.fuse() => {}
                        _ = FutureExt::fuse(smol::Timer::after(timeout)) => in_time.set(true),
                    }
                }
                Ok(())
            }))
        })
    });
    if let Err(error) = result {
        return exit_code("jigsaw watch", Err(error));
    }
    if ended.get() {
        complain!("jigsaw watch: not complete after {} s", args.timeout);
    }
    let heard = heard.borrow();
    let Some(assembly) = &heard.assembly else {
        complain!("jigsaw watch: no assembly was published; do the nodes run, and in the same ROS_DOMAIN_ID?");
        return ExitCode::from(INCOMPLETE);
    };
    say!("{}", table(assembly, pieces).trim_end());
    if let Err(error) = write(&args.out, assembly, &heard) {
        complain!("jigsaw watch: {error}");
        return ExitCode::from(BAD_INPUT);
    }
    if heard.shapeless() > 0 {
        complain!(
            "jigsaw watch: assembly.json lacks {} pieces whose shapes were not published on pieces/features (jigsaw cell keeps them \
             to itself)",
            heard.shapeless()
        );
    }
    if heard.picture.is_none() {
        complain!("jigsaw watch: no picture was published on assembly/image");
    }
    ExitCode::from(if heard.is_complete(pieces) { 0 } else { INCOMPLETE })
}

/// Listens until the puzzle is complete.
fn listen(
    session: &mut Session,
    heard: Rc<RefCell<Heard>>,
    pieces: Option<usize>,
) -> Result<impl Future<Output = ()> + 'static, SessionError> {
    let mut assemblies = session.subscribe(&topics::ASSEMBLY)?;
    let mut features = session.subscribe(&topics::PIECE_FEATURES)?;
    let mut pictures = session.subscribe(&topics::ASSEMBLY_IMAGE)?;
    Ok(async move {
        let mut late = futures::future::Fuse::terminated();
        let mut patience = None;
        loop {
            futures::select! {
                assembly = assemblies.next() => match assembly {
                    Some(assembly) => heard.borrow_mut().assembly = Some(assembly),
                    None => return,
                },
                piece = features.next() => match piece {
                    Some(piece) => {
                        heard.borrow_mut().features.insert(piece.id.clone(), piece);
                    }
                    None => return,
                },
                picture = pictures.next() => match picture {
                    Some(picture) => {
                        heard.borrow_mut().picture = Some(picture);
                        if heard.borrow().is_complete(pieces) {
                            return;
                        }
                    }
                    None => return,
                },
                _ = late => return,
            }
            let wanted = heard.borrow().patience(pieces);
            if patience != wanted {
                patience = wanted;
                late = FutureExt::fuse(wanted.map_or_else(smol::Timer::never, smol::Timer::after));
            }
        }
    })
}

/// The angle about the axis out of the table.
fn yaw(pose: &Pose) -> f64 {
    let q = &pose.orientation;
    2.0 * q.z.atan2(q.w)
}

/// The motion of each piece, and how many are placed of how many.
fn table(assembly: &AssemblyMessage, pieces: Option<usize>) -> String {
    let mut text =
        String::from("piece                 observed x, y [mm]   turn [deg]   goal x, y [mm]       confidence\n");
    let mut placed: Vec<_> = assembly.pieces.iter().collect();
    placed.sort_by(|a, b| a.id.cmp(&b.id));
    for piece in &placed {
        let (from, to) = (&piece.observed.position, &piece.goal.position);
        let turn = (yaw(&piece.goal) - yaw(&piece.observed)).to_degrees();
        let turn = (turn + 180.0).rem_euclid(360.0) - 180.0;
        let _ = writeln!(
            text,
            "{:20}  {:8.2} {:8.2}   {turn:11.2}   {:8.2} {:8.2}   {:11.3}",
            piece.id,
            from.x * 1e3,
            from.y * 1e3,
            to.x * 1e3,
            to.y * 1e3,
            piece.confidence
        );
    }
    let all = pieces.unwrap_or(placed.len() + assembly.unplaced.len());
    let _ = writeln!(text, "{}/{all} pieces placed, {} matings", placed.len(), assembly.matings.len());
    text
}

/// Writes what was heard.
fn write(out: &Path, assembly: &AssemblyMessage, heard: &Heard) -> Result<(), WriteError> {
    make_folder(out)?;
    write_json(&out.join(ASSEMBLY_FILE), &in_pixels(assembly, &heard.features))?;
    if let Some(png) = heard.picture.as_ref().and_then(png) {
        write_file(&out.join(ASSEMBLY_PICTURE), |file| file.write_all(&png))?;
    }
    Ok(())
}

/// The picture as PNG; `None` where it is not a whole colour or grey picture.
fn png(picture: &Image) -> Option<Vec<u8>> {
    let (colour, bytes) = match picture.encoding.as_str() {
        "rgb8" => (image::ExtendedColorType::Rgb8, 3),
        "mono8" => (image::ExtendedColorType::L8, 1),
        _ => return None,
    };
    let row = picture.width as usize * bytes;
    let step = picture.step as usize;
    if row == 0 || step < row {
        return None;
    }
    let rows = picture.data.chunks(step).take(picture.height as usize);
    let pixels: Vec<u8> = rows.filter_map(|line| line.get(..row)).flatten().copied().collect();
    let mut png = Vec::new();
    image::ImageEncoder::write_image(
        image::codecs::png::PngEncoder::new(&mut png),
        pixels.get(..row * picture.height as usize)?,
        picture.width,
        picture.height,
        colour,
    )
    .ok()?;
    Some(png)
}

/// The content of `assembly.json`. Times are not known here, so they are zero.
fn in_pixels<'a>(message: &'a AssemblyMessage, features: &'a HashMap<String, PieceFeatures>) -> AssemblyFile<'a> {
    let mut placed = Vec::new();
    let mut scale = 1.0;
    let mut corner = Point2::new(f64::INFINITY, f64::INFINITY);
    for pose in &message.pieces {
        let Some((seen, Ok((_, sighting)))) = features.get(&pose.id).map(|f| (f, convert::piece(f))) else {
            continue;
        };
        scale = seen.metres_per_pixel;
        let plane = PixelPlane { metres_per_pixel: scale, origin_px: Point2::origin() };
        let goal = plane.pixels_from_metres(Point2::new(pose.goal.position.x, pose.goal.position.y));
        // Clockwise is positive with y down.
        let turn = Isometry2::rotation(-yaw(&pose.goal));
        let shift: Vector2<f64> = goal - turn * sighting.centroid_in_image;
        let puzzle_from_image = Isometry2::from_parts(shift.into(), turn.rotation);
        for p in &sighting.border_in_image {
            corner = corner.inf(&(puzzle_from_image * p));
        }
        placed.push((pose, seen, puzzle_from_image));
    }
    placed.sort_by(|(a, ..), (b, ..)| (a.component, &a.id).cmp(&(b.component, &b.id)));
    let pieces = placed.into_iter().map(|(pose, seen, puzzle_from_image)| {
        let place = puzzle_from_image.translation.vector - corner.coords;
        PlacedRecord {
            id: &pose.id,
            source: &pose.source,
            aoi: AoiRecord { x: seen.aoi_x_px, y: seen.aoi_y_px, width: seen.aoi_width_px, height: seen.aoi_height_px },
            puzzle_from_image: PoseRecord { x: place.x, y: place.y, theta: puzzle_from_image.rotation.angle() },
            component: pose.component as usize,
            confidence: pose.confidence.into(),
        }
    });
    let matings = message.matings.iter().map(|m| MatingRecord {
        positive: SideRecord { piece: &m.positive_piece, isthmus: m.positive_isthmus as usize },
        negative: SideRecord { piece: &m.negative_piece, isthmus: m.negative_isthmus as usize },
        correlation: m.correlation.into(),
        ave_gap_px: f64::from(m.ave_gap) / scale,
        clearance_px: f64::from(m.clearance) / scale,
        confidence: m.confidence.into(),
    });
    let counts = &message.table;
    AssemblyFile {
        pieces: pieces.collect(),
        matings: matings.collect(),
        unplaced: message.unplaced.iter().map(String::as_str).collect(),
        table: TableCounts {
            positive: counts.positive as usize,
            negative: counts.negative as usize,
            pairs: counts.pairs as usize,
            after_opening: counts.after_opening as usize,
            after_length: counts.after_length as usize,
            after_correlation: counts.after_correlation as usize,
            after_overlap: counts.after_overlap as usize,
            backtracks: counts.backtracks as usize,
        },
        seconds: Seconds::default(),
    }
}
