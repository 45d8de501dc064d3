//! What a stranger can reach, each as a function of bytes: it must give a value or an error, never a panic, a hang or
//! memory without bound. The fuzz engine calls these functions with whatever it finds; the test `tests/fuzz.rs` of the
//! cell calls them with damaged copies of the seeds.

#[path = "../../tests/frames/mod.rs"]
mod frames;

use frames::camera_image;
use image::{ExtendedColorType, ImageFormat};
use isthmus::contour::Border;
use isthmus::{Extractor, Features, Point, mask};
use jigsaw::generate::{Options, Puzzle};
use jigsaw::{Params, Piece, Solver};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::msg::{PieceFeatures, PieceImage};
use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};
use jigsaw_nodes::bag::{BagReader, BagWriter, QosProfile, Selection, Storage, Topic, WriterOptions, cdr};
use jigsaw_nodes::capture::convert::{FrameHead, picture, piece_message};
use jigsaw_nodes::capture::cut::Pixels;
use jigsaw_nodes::capture::source::Frame;
use jigsaw_nodes::ros::arguments::RosArgs;
use jigsaw_nodes::ros::node_params::COMMON_PARAMETERS;
use jigsaw_nodes::ros::params::Parameters;
use jigsaw_nodes::{capture, feature, solver};

/// Largest picture that is looked at after it was read, in pixels: enough for every branch, little enough to be quick.
const LARGEST_ANALYSED: u64 = 300 * 300;

/// Largest border that is matched, in points.
const LARGEST_MATCHED: usize = 2000;

/// A target, and inputs that are in order, to begin with.
pub struct Target {
    /// Its name, also that of its binary and of its folder in the corpus.
    pub name: &'static str,
    /// The function.
    pub run: fn(&[u8]),
    /// Inputs that are in order.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
pub const TARGETS: &[Target] = &[
    Target { name: "image", run: image, seeds: image_seeds },
    Target { name: "piece_image", run: piece_image, seeds: piece_image_seeds },
    Target { name: "piece_features", run: piece_features, seeds: piece_features_seeds },
    Target { name: "picture_file", run: picture_file, seeds: picture_file_seeds },
    Target { name: "bag_mcap", run: bag_mcap, seeds: || bag_seeds(Storage::Mcap) },
    Target { name: "bag_sqlite", run: bag_sqlite, seeds: || bag_seeds(Storage::Sqlite3) },
    Target { name: "arguments", run: arguments, seeds: arguments_seeds },
    Target { name: "parameter_file", run: parameter_file, seeds: parameter_file_seeds },
    Target { name: "frame", run: frame, seeds: frame_seeds },
    Target { name: "border", run: border, seeds: border_seeds },
];

/// A `sensor_msgs/Image` as CDR: decoded, converted, cut into pieces.
pub fn image(data: &[u8]) {
    if let Ok(message) = cdr::decode::<Image>(data) {
        look_at(Frame::Raw("/image".to_owned(), message));
    }
}

/// A file that claims to be a picture: PNG, JPEG, TIFF, BMP or PNM.
pub fn picture_file(data: &[u8]) {
    let message = CompressedImage { data: data.to_vec(), ..CompressedImage::default() };
    look_at(Frame::Compressed("/image/compressed".to_owned(), message));
}

fn look_at(frame: Frame) {
    let Ok(picture) = picture(frame) else { return };
    if u64::from(picture.pixels.width()) * u64::from(picture.pixels.height()) > LARGEST_ANALYSED {
        return;
    }
    let pixels = Pixels::from(picture.pixels);
    if let Ok(frame) = pixels.frame() {
        analyse(&frame);
    }
}

fn analyse(frame: &mask::Frame<'_>) {
    for cutout in mask::segment(frame, &mask::Parameters::default()).cutouts {
        let _ = Extractor::default().extract(&cutout);
    }
}

/// A `jigsaw_msgs/PieceImage` as CDR: decoded, converted, analysed, and its features as a message.
pub fn piece_image(data: &[u8]) {
    let Ok(mut message) = cdr::decode::<PieceImage>(data) else { return };
    let Ok(cutout) = feature::convert::cutout(&mut message) else { return };
    if cutout.pixels.len() as u64 > LARGEST_ANALYSED {
        return;
    }
    if let Ok(features) = Extractor::default().extract(&cutout) {
        // What this node sends the next one takes.
        let message = feature::convert::features_message(&message, &features);
        let _ = solver::convert::piece(&message);
    }
}

/// A `jigsaw_msgs/PieceFeatures` as CDR: decoded, converted, matched with itself, assembled.
pub fn piece_features(data: &[u8]) {
    let Ok(message) = cdr::decode::<PieceFeatures>(data) else { return };
    let Ok((piece, _)) = solver::convert::piece(&message) else { return };
    if piece.features.border.points.len() > LARGEST_MATCHED {
        return;
    }
    let other = Piece { id: format!("{}_", piece.id), ..piece.clone() };
    let Ok(mut solver) = Solver::new(Params { threads: 1, ..Params::default() }) else { return };
    if solver.insert(piece).is_ok() && solver.insert(other).is_ok() {
        solver.solve();
    }
}

/// A file that claims to be a bag in MCAP.
pub fn bag_mcap(data: &[u8]) {
    read_bag(data, "bag.mcap");
}

/// A file that claims to be a bag in sqlite3.
pub fn bag_sqlite(data: &[u8]) {
    read_bag(data, "bag.db3");
}

fn read_bag(data: &[u8], name: &str) {
    let Ok(folder) = tempfile::tempdir() else { return };
    let path = folder.path().join(name);
    if std::fs::write(&path, data).is_err() {
        return;
    }
    let Ok(bag) = BagReader::open(&path) else { return };
    let Ok(messages) = bag.messages(Selection::all()) else { return };
    for message in messages {
        let Ok(message) = message else { break };
        let _ = cdr::decode::<Image>(&message.cdr);
    }
}

/// Command line arguments, one a line, as all three nodes take them.
pub fn arguments(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    // Files of this machine are no input of a stranger's; see `parameter_file` for those.
    take(text.split('\n').filter(|argument| !argument.contains("params-file")));
}

/// A parameter file, as all three nodes take it.
pub fn parameter_file(data: &[u8]) {
    let Ok(file) = tempfile::NamedTempFile::new() else { return };
    if std::fs::write(file.path(), data).is_err() {
        return;
    }
    if let Some(path) = file.path().to_str() {
        take(["--ros-args", "--params-file", path]);
    }
}

fn take<'a>(arguments: impl IntoIterator<Item = &'a str>) {
    let Ok(args) = RosArgs::parse(arguments) else { return };
    for program in [capture::PROGRAM, feature::PROGRAM, solver::PROGRAM] {
        let Ok(names) = args.node("/", program.name) else { continue };
        for name in ["image", "~/get_state", "/clock"] {
            let _ = (names.topic(name), names.service(name));
        }
        let parameters = Parameters::declare(&names.full_name(), &[program.parameters, COMMON_PARAMETERS]);
        if parameters.start_with(&args.overrides(&names)).is_ok() && program.name == solver::PROGRAM.name {
            let _ = solver::params::solver_params(&parameters).validate();
        }
    }
}

/// A grey frame: the first byte and the length give its sides.
pub fn frame(data: &[u8]) {
    let Some((&width, pixels)) = data.split_first() else { return };
    let width = u32::from(width).max(1);
    let height = (pixels.len() as u32 / width).min(LARGEST_ANALYSED as u32 / width);
    let Some(pixels) = pixels.get(..(width * height) as usize) else { return };
    if let Ok(frame) = mask::Frame::grey(width, height, pixels) {
        analyse(&frame);
    }
}

/// A closed polygon, its corners as pairs of 16-bit numbers in 1/16 pixel: with all it may have of crossings, spikes and
/// repeated corners.
pub fn border(data: &[u8]) {
    let coordinate = |bytes: &[u8]| f64::from(i16::from_le_bytes([bytes[0], bytes[1]])) / 16.0;
    let points: Vec<Point> =
        data.chunks_exact(4).take(LARGEST_MATCHED).map(|c| Point::new(coordinate(c), coordinate(&c[2..]))).collect();
    let next = |i: usize| points[(i + 1) % points.len()];
    let length: f64 = (0..points.len()).map(|i| (next(i) - points[i]).norm()).sum();
    let spacing = length / points.len().max(1) as f64;
    let Ok(features) = Features::from_border(Border { points, spacing }, 0.05) else { return };
    let Ok(mut solver) = Solver::new(Params { threads: 1, ..Params::default() }) else { return };
    let pieces = ["a", "b"].map(|id| Piece { id: id.to_owned(), seen: 0, features: features.clone() });
    if pieces.into_iter().all(|piece| solver.insert(piece).is_ok()) {
        solver.solve();
    }
}

// Seeds: a small generated puzzle on its way through the cell.

const PLACE: &str = "/image";

/// Side of the frames in pixels: a piece fits in, [`LARGEST_ANALYSED`] is not reached, and the engine cuts no seed (at 1 MiB).
const SIDE: u32 = 160;

fn puzzle() -> Option<Puzzle> {
    let (piece_size, frame) = (Some(60.0), Some([SIDE, SIDE]));
    Puzzle::generate(&Options { rows: 1, columns: 2, seed: 5, piece_size, frame, ..Options::default() }).ok()
}

fn grey_frames() -> Vec<Image> {
    let render = |puzzle: &Puzzle| {
        (0..puzzle.frame_count()).map(|k| camera_image(puzzle, k, Time { sec: k as i32 + 1, nanosec: 5 })).collect()
    };
    puzzle().as_ref().map(render).unwrap_or_default()
}

fn piece_images() -> Vec<PieceImage> {
    let pieces = |image: Image| {
        let (width, height, header) = (image.width, image.height, image.header.clone());
        let frame = mask::Frame::grey(width, height, &image.data).ok()?;
        let cutout = mask::segment(&frame, &mask::Parameters::default()).cutouts.into_iter().next()?;
        let head = FrameHead { header, source: PLACE.to_owned(), width, height };
        Some(piece_message(format!("piece_{}", image.header.stamp.sec), &head, cutout, 1e-4))
    };
    grey_frames().into_iter().filter_map(pieces).collect()
}

fn piece_features_messages() -> Vec<PieceFeatures> {
    let features = |mut message: PieceImage| {
        let cutout = feature::convert::cutout(&mut message).ok()?;
        let features = Extractor::default().extract(&cutout).ok()?;
        Some(feature::convert::features_message(&message, &features))
    };
    piece_images().into_iter().filter_map(features).collect()
}

fn image_seeds() -> Vec<Vec<u8>> {
    let grey = grey_frames();
    let rgb = |image: &Image| Image {
        encoding: "bgra8".to_owned(),
        step: 4 * image.width,
        data: image.data.iter().flat_map(|&v| [v, v, v, 255]).collect(),
        ..image.clone()
    };
    let coloured: Vec<Image> = grey.iter().take(1).map(rgb).collect();
    grey.iter().chain(&coloured).filter_map(|message| cdr::encode(message).ok()).collect()
}

fn piece_image_seeds() -> Vec<Vec<u8>> {
    piece_images().iter().filter_map(|message| cdr::encode(message).ok()).collect()
}

fn piece_features_seeds() -> Vec<Vec<u8>> {
    piece_features_messages().iter().filter_map(|message| cdr::encode(message).ok()).collect()
}

fn picture_file_seeds() -> Vec<Vec<u8>> {
    let Some(image) = grey_frames().into_iter().next() else { return Vec::new() };
    let formats = [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Tiff, ImageFormat::Bmp, ImageFormat::Pnm];
    let encode = |format| {
        let mut file = std::io::Cursor::new(Vec::new());
        let (data, size) = (&image.data, (image.width, image.height));
        image::write_buffer_with_format(&mut file, data, size.0, size.1, ExtendedColorType::L8, format).ok()?;
        Some(file.into_inner())
    };
    formats.into_iter().filter_map(encode).collect()
}

fn bag_seeds(storage: Storage) -> Vec<Vec<u8>> {
    bag(storage).into_iter().collect()
}

/// A bag of the frames.
fn bag(storage: Storage) -> Option<Vec<u8>> {
    let folder = tempfile::tempdir().ok()?;
    let path = folder.path().join("bag");
    let mut bag = BagWriter::create(&path, WriterOptions { storage, ..WriterOptions::default() }).ok()?;
    let topic = Topic::known("/image", "sensor_msgs/msg/Image", vec![QosProfile::reliable(10)]);
    let topic = bag.add_topic(topic).ok()?;
    for (time, message) in (1..).zip(image_seeds()) {
        bag.write(topic, time, time, &message).ok()?;
    }
    bag.finish().ok()?;
    let mut files = std::fs::read_dir(&path).ok()?.flatten().map(|entry| entry.path());
    std::fs::read(files.find(|path| path.extension().is_some_and(|ending| ending != "yaml"))?).ok()
}

fn arguments_seeds() -> Vec<Vec<u8>> {
    [
        "--ros-args\n-r\n__ns:=/cell\n-r\nimage:=/camera/image\n-p\nmetres_per_pixel:=0.0002\n--log-level\nwarn",
        "--ros-args\n-p\nsolver_node:policy:=paper\n--remap\nsolver_node:assembly:=~/result\n--\nrest\n--ros-args\n-e\n/cell",
        "--ros-args\n-p\nnetwork_interfaces:=[127.0.0.1]\n--param\nthreads:=2\n-r\n__node:=other\n--disable-rosout-logs",
    ]
    .map(|text| text.as_bytes().to_vec())
    .to_vec()
}

fn parameter_file_seeds() -> Vec<Vec<u8>> {
    let written = [capture::PROGRAM, feature::PROGRAM, solver::PROGRAM]
        .map(|program| jigsaw_nodes::ros::params::yaml(program.name, &[program.parameters, COMMON_PARAMETERS]));
    let nested =
        "/**:\n  ros__parameters:\n    use_sim_time: true\nns:\n  solver_node:\n    ros__parameters: {candidates: 7}\n";
    written.into_iter().chain([nested.to_owned()]).map(String::into_bytes).collect()
}

fn frame_seeds() -> Vec<Vec<u8>> {
    grey_frames().into_iter().map(|image| [&[SIDE as u8][..], &image.data].concat()).collect()
}

fn border_seeds() -> Vec<Vec<u8>> {
    let corners = |message: PieceFeatures| {
        let points = message.border_x_px.iter().zip(&message.border_y_px).step_by(2);
        points.flat_map(|(x, y)| [*x, *y]).flat_map(|v| ((v * 16.0) as i16).to_le_bytes()).collect()
    };
    piece_features_messages().into_iter().map(corners).collect()
}
