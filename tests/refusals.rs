//! Messages of strangers: every field of every input is set to values out of range, one at a time, and the refusal has to
//! name the field. What is taken instead has to be a field whose every value makes sense.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod frames;

use frames::camera_image;
use isthmus::{Extractor, mask};
use jigsaw::generate::{Options, Puzzle};
use jigsaw_msgs::Message;
use jigsaw_msgs::action::AssembleGoal;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::msg::{PieceFeatures, PieceImage};
use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};
use jigsaw_nodes::capture::convert::{FrameHead, picture, piece_message};
use jigsaw_nodes::capture::source::Frame;
use jigsaw_nodes::{feature, solver};
use serde_json::{Value, json};

/// Longest refusal that is still one line to read.
const LONGEST_LINE: usize = 400;

fn image() -> Image {
    image_with_noise(0.0)
}

fn image_with_noise(noise: f64) -> Image {
    let options = Options { rows: 1, columns: 2, seed: 5, piece_size: Some(60.0), noise, ..Options::default() };
    camera_image(&Puzzle::generate(&options).unwrap(), 0, Time { sec: 7, nanosec: 5 })
}

fn piece_image() -> PieceImage {
    piece_of(image())
}

fn piece_of(image: Image) -> PieceImage {
    let frame = mask::Frame::grey(image.width, image.height, &image.data).unwrap();
    let cutout = mask::segment(&frame, &mask::Parameters::default()).cutouts.remove(0);
    let head = FrameHead { header: image.header, source: "/image".into(), width: image.width, height: image.height };
    piece_message("tab".to_owned(), &head, cutout, 1e-4)
}

fn piece_features() -> PieceFeatures {
    let mut message = piece_image();
    let cutout = feature::convert::cutout(&mut message).unwrap();
    feature::convert::features_message(&message, &Extractor::default().extract(&cutout).unwrap())
}

/// Values that no sender who is in order sends, for a field that holds this one.
fn strange(value: &Value) -> Vec<Value> {
    match value {
        Value::Number(_) => {
            let whole = [0, -1, i64::from(i32::MIN), i64::from(i32::MAX), i64::from(u32::MAX), 255, 40_000, -40_000];
            // Beyond single precision, so infinite there.
            whole.iter().map(|&v| json!(v)).chain([json!(1e39), json!(-1e39), json!(-1e-9), json!(1e9)]).collect()
        }
        Value::String(_) => {
            ["", "a/b", "a b", "a\nb", "\u{0}"].iter().map(|t| json!(t)).chain([json!("x".repeat(100_000))]).collect()
        }
        Value::Array(items) => {
            let longer = items.first().map(|item| Value::Array(vec![item.clone(); 200_000]));
            [json!([])].into_iter().chain(longer).collect()
        }
        Value::Bool(flag) => vec![json!(!flag)],
        Value::Null | Value::Object(_) => Vec::new(),
    }
}

/// The places of all fields, of the first element where there are several.
fn places(value: &Value, path: &str, found: &mut Vec<String>) {
    match value {
        Value::Object(fields) => {
            for (name, field) in fields {
                places(field, &format!("{path}/{name}"), found);
            }
        }
        Value::Array(items) => {
            found.push(path.to_owned());
            if let Some(first) = items.first() {
                places(first, &format!("{path}/0"), found);
            }
        }
        _ => found.push(path.to_owned()),
    }
}

/// Checks a conversion: `free` are the fields of which every value makes sense, `also` what a refusal may name beside the
/// field itself.
fn check<M: Message>(good: &M, convert: impl Fn(M) -> Result<(), String>, free: &[&str], also: &[(&str, &[&str])]) {
    convert(good.clone()).unwrap();
    let whole = serde_json::to_value(good).unwrap();
    let mut all = Vec::new();
    places(&whole, "", &mut all);
    let (mut refused, mut taken) = (0, Vec::new());
    for place in &all {
        let name = place.rsplit('/').find(|part| part.parse::<usize>().is_err()).unwrap();
        let mut refusals = 0;
        for value in strange(whole.pointer(place).unwrap()) {
            let mut changed = whole.clone();
            *changed.pointer_mut(place).unwrap() = value.clone();
            // Some values the type itself has no room for.
            let Ok(message) = serde_json::from_value::<M>(changed) else { continue };
            let Err(said) = convert(message) else { continue };
            let allowed = also.iter().filter(|(field, _)| *field == name).flat_map(|(_, names)| names.iter());
            assert!(allowed.chain([&name]).any(|n| said.contains(n)), "{place} = {}: {said}", shorten(&value));
            assert!(said.len() < LONGEST_LINE && !said.chars().any(char::is_control), "{place}: {said}");
            refusals += 1;
        }
        refused += refusals;
        if refusals == 0 {
            taken.push(place.as_str());
        }
    }
    assert!(refused > all.len() / 2, "{refused} refusals of {} fields", all.len());
    taken.retain(|place| !free.contains(place));
    assert!(taken.is_empty(), "no value of these is refused: {taken:?}");
}

fn shorten(value: &Value) -> String {
    value.to_string().chars().take(60).collect()
}

#[test]
fn images() {
    let convert = |image| picture(Frame::Raw("/image".to_owned(), image)).map(drop).map_err(|e| e.to_string());
    // Any level is one, and any byte says whether the order is big-endian.
    let free = ["/is_bigendian", "/data/0"];
    check(&image(), convert, &free, &[("width", &["size", "step"]), ("height", &["size"]), ("step", &["data"])]);
}

#[test]
fn compressed_images() {
    let image = image();
    let mut file = std::io::Cursor::new(Vec::new());
    let (width, height) = (image.width, image.height);
    let format = (image::ExtendedColorType::L8, image::ImageFormat::Png);
    image::write_buffer_with_format(&mut file, &image.data, width, height, format.0, format.1).unwrap();
    let message = CompressedImage { header: image.header, format: "png".to_owned(), data: file.into_inner() };
    let convert =
        |image| picture(Frame::Compressed("/image/compressed".to_owned(), image)).map(drop).map_err(|e| e.to_string());
    // What a file is, its content says.
    check(&message, convert, &["/format"], &[("data", &["not a picture"])]);
}

#[test]
fn piece_images() {
    let convert = |mut message| feature::convert::cutout(&mut message).map(drop).map_err(|e| e.to_string());
    // The header that counts is that of the piece; one byte a pixel has no order.
    let free = [
        "/image/header/stamp/sec",
        "/image/header/stamp/nanosec",
        "/image/header/frame_id",
        "/image/is_bigendian",
        "/image/data/0",
    ];
    let also: [(&str, &[&str]); 7] = [
        ("width", &["step", "area", "aoi_x_px"]),
        ("height", &["data", "area"]),
        ("image_x_px", &["aoi_x_px"]),
        ("image_y_px", &["aoi_y_px"]),
        ("aoi_width_px", &["aoi_x_px"]),
        ("aoi_height_px", &["aoi_y_px"]),
        ("metres_per_pixel", &[]),
    ];
    check(&piece_image(), convert, &free, &also);
}

#[test]
fn features() {
    let convert = |message: PieceFeatures| solver::convert::piece(&message).map(drop).map_err(|e| e.to_string());
    // Plane points; whether an isthmus is a neck or a mouth that stands out is for the sender to say; a piece may have
    // none; two arrays are of fixed length.
    let free = [
        "/isthmuses/0/point_px/z",
        "/isthmuses/0/critical_points_px/0/z",
        "/isthmuses/0/salient",
        "/isthmuses",
        "/isthmuses/0/arc_px",
        "/isthmuses/0/critical_points_px",
    ];
    let also: [(&str, &[&str]); 11] = [
        ("x", &["point_px", "arc_px"]),
        ("y", &["point_px", "arc_px"]),
        ("border_x_px", &["border"]),
        ("border_y_px", &["border"]),
        ("x_px", &["skeleton"]),
        ("y_px", &["skeleton"]),
        ("distance_px", &["skeleton"]),
        ("width_px", &["arc_px"]),
        ("arc_px", &["path_length_px"]),
        ("persistence_px", &[]),
        ("border_length_px", &["arc_px"]),
    ];
    check(&piece_features(), convert, &free, &also);
}

/// A field, and what spoils it.
type Case<'a, M> = (&'a str, &'a dyn Fn(&mut M));

#[test]
fn numbers_that_are_none_are_refused_in_every_float() {
    let convert = |message: &PieceFeatures| solver::convert::piece(message).map(drop);
    let none = f32::NAN;
    let cases: [Case<PieceFeatures>; 11] = [
        ("metres_per_pixel", &|m| m.metres_per_pixel = f64::NAN),
        ("noise_px", &|m| m.noise_px = none),
        ("border", &|m| m.border_x_px[3] = none),
        ("border", &|m| m.border_y_px[3] = none),
        ("border_length_px", &|m| m.border_length_px = none),
        ("point_px", &|m| m.isthmuses[0].point_px.x = none),
        ("arc_px", &|m| m.isthmuses[0].arc_px[1] = none),
        ("width_px", &|m| m.isthmuses[0].width_px = none),
        ("path_length_px", &|m| m.isthmuses[0].path_length_px = none),
        ("persistence_px", &|m| m.isthmuses[0].persistence_px = none),
        ("idf_px", &|m| m.isthmuses[0].idf_px[2] = none),
    ];
    for (field, change) in cases {
        let mut message = piece_features();
        change(&mut message);
        let said = convert(&message).unwrap_err().to_string();
        assert!(said.contains(field) && said.contains("NaN"), "{field}: {said}");
    }
    let cases: [Case<PieceImage>; 4] = [
        ("metres_per_pixel", &|m| m.metres_per_pixel = f64::NAN),
        ("piece_level", &|m| m.piece_level = none),
        ("ground_level", &|m| m.ground_level = none),
        ("noise_level", &|m| m.noise_level = none),
    ];
    for (field, change) in cases {
        let mut message = piece_image();
        change(&mut message);
        let said = feature::convert::cutout(&mut message).unwrap_err().to_string();
        assert!(said.contains(field) && said.contains("NaN"), "{field}: {said}");
    }
}

/// What one node says is what the next one reads, to the precision of the message.
#[test]
fn isthmuses_come_through_as_they_are() {
    /// In pixels: single precision leaves a ten-thousandth in frames of 1000.
    const PRECISION: f64 = 1e-3;
    for noise in [0.0, 5.0, 20.0] {
        let mut message = piece_of(image_with_noise(noise));
        let cutout = feature::convert::cutout(&mut message).unwrap();
        let features = Extractor::default().extract(&cutout).unwrap();
        let (piece, _) = solver::convert::piece(&feature::convert::features_message(&message, &features)).unwrap();
        assert!(!features.isthmuses.is_empty());
        for (said, read) in features.isthmuses.iter().zip(&piece.features.isthmuses) {
            for (arc, point) in read.arc.into_iter().zip(&said.critical_points) {
                let off = (piece.features.border.point_at(arc) - point).norm();
                assert!(off < PRECISION, "noise {noise}: a critical point is {off} px off its place on the border");
            }
        }
    }
}

#[test]
fn isthmuses_lie_where_they_say() {
    let cases: [Case<PieceFeatures>; 4] = [
        ("arc_px", &|m| m.isthmuses[0].arc_px = [0.0; 2]),
        // The border begins elsewhere than when the arcs were measured.
        ("arc_px", &|m| {
            let third = m.border_x_px.len() / 3;
            m.border_x_px.rotate_left(third);
            m.border_y_px.rotate_left(third);
        }),
        // From the second critical point to the first.
        ("path_length_px", &|m| {
            m.isthmuses[0].arc_px.reverse();
            m.isthmuses[0].critical_points_px.reverse();
        }),
        ("path_length_px", &|m| m.isthmuses[0].path_length_px *= 0.5),
    ];
    for (field, change) in cases {
        let mut message = piece_features();
        solver::convert::piece(&message).unwrap();
        change(&mut message);
        let said = solver::convert::piece(&message).unwrap_err().to_string();
        assert!(said.contains(field), "{field}: {said}");
    }
}

#[test]
fn goals() {
    let convert = |goal: AssembleGoal| solver::convert::budget(&goal).map(drop).map_err(|e| e.to_string());
    // Any number of pieces may be expected.
    check(
        &AssembleGoal::default(),
        convert,
        &["/expected_pieces"],
        &[("sec", &["time_budget"]), ("nanosec", &["time_budget"])],
    );
}
