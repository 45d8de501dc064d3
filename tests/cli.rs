//! The command line `jigsaw` as a user runs it: the real binary, real files, exit codes.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use nalgebra::{Isometry2, Point2, Vector2};
use serde_json::Value;
use tempfile::TempDir;

/// Distance of a piece's centroid from where it belongs, in pixels, when the first piece is laid on its true place:
/// the first piece's own error swings the others by its rotation.
const PLACE_TOLERANCE: f64 = 2.0;
/// Error of a clearance, in pixels, with the noise and blur used here.
const CLEARANCE_TOLERANCE: f64 = 0.2;
/// A critical point against the truth, in pixels.
const CRITICAL_POINT_TOLERANCE: f64 = 1.8;

fn jigsaw(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_jigsaw")).args(arguments).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Asserts an exit code and shows what the program said if it is another.
fn assert_exit(output: &Output, code: i32) {
    assert_eq!(output.status.code(), Some(code), "{output:?}");
}

fn stderr_lines(output: &Output) -> Vec<String> {
    String::from_utf8(output.stderr.clone()).unwrap().lines().map(str::to_owned).collect()
}

#[test]
fn streams_that_nobody_reads_are_no_fault() {
    let full = || fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let (node, jigsaw) = (env!("CARGO_BIN_EXE_capture_node"), env!("CARGO_BIN_EXE_jigsaw"));
    for (program, arguments, code) in [
        (node, &["--help"][..], 0),
        (node, &["--version"], 0),
        (node, &["--no-such-option"], 2),
        (jigsaw, &["--help"], 0),
        (jigsaw, &["bag", "info", "/no/such/bag"], 2),
        (jigsaw, &["watch", "--out", "x", "--timeout", "nan"], 2),
    ] {
        let status = Command::new(program).args(arguments).stdout(full()).stderr(full()).status().unwrap();
        assert_eq!(status.code(), Some(code), "{program} {arguments:?}");
    }
}

/// Makes a puzzle with the given options in `folder`.
fn generate(folder: &Path, options: &[&str]) -> Value {
    let output = jigsaw(&[&["generate", "--out", text(folder)], options].concat());
    assert_exit(&output, 0);
    read_json(&folder.join("truth.json"))
}

fn pose(value: &Value) -> Isometry2<f64> {
    let number = |name: &str| value[name].as_f64().unwrap();
    Isometry2::new(Vector2::new(number("x"), number("y")), number("theta"))
}

fn point(value: &Value) -> Point2<f64> {
    Point2::new(value[0].as_f64().unwrap(), value[1].as_f64().unwrap())
}

/// Asserts that every placed piece lies right relative to the first, and that every mating is a true joint.
fn assert_true(assembly: &Value, truth: &Value) {
    let truth_of = |id: &Value| truth["pieces"].as_array().unwrap().iter().find(|p| p["id"] == *id).unwrap();
    let pieces = assembly["pieces"].as_array().unwrap();
    let first = &pieces[0];
    let truth_from_assembly =
        pose(&truth_of(&first["id"])["puzzle_from_image"]) * pose(&first["puzzle_from_image"]).inverse();
    for piece in pieces {
        let true_piece = truth_of(&piece["id"]);
        assert_eq!(piece["source"], true_piece["source"]);
        let centroid = point(&true_piece["centroid"]);
        let found = truth_from_assembly * pose(&piece["puzzle_from_image"]) * centroid;
        let wanted = pose(&true_piece["puzzle_from_image"]) * centroid;
        assert!((found - wanted).norm() < PLACE_TOLERANCE, "{} is off by {}", piece["id"], (found - wanted).norm());
    }
    let joints = truth["joints"].as_array().unwrap();
    for mating in assembly["matings"].as_array().unwrap() {
        let joint = joints.iter().find(|joint| {
            joint["positive"] == mating["positive"]["piece"] && joint["negative"] == mating["negative"]["piece"]
        });
        let joint = joint.unwrap_or_else(|| panic!("not a true mating: {mating}"));
        let error = mating["clearance_px"].as_f64().unwrap() - joint["clearance_px"].as_f64().unwrap();
        assert!(error.abs() < CLEARANCE_TOLERANCE, "clearance off by {error}");
    }
}

#[test]
fn a_generated_puzzle_is_assembled_as_it_was_cut() {
    let folder = TempDir::new().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    let options =
        ["--rows", "4", "--cols", "6", "--seed", "11", "--noise", "5", "--blur", "1", "--clearance", "0.5..2"];
    let truth = generate(&images, &options);
    assert_eq!(truth["pieces"].as_array().unwrap().len(), 24);

    let output = jigsaw(&["assemble", text(&images), "--out", text(&out)]);
    assert_exit(&output, 0);
    assert!(String::from_utf8_lossy(&output.stdout).contains("24/24"), "{output:?}");
    let assembly = read_json(&out.join("assembly.json"));
    assert_eq!(assembly["pieces"].as_array().unwrap().len(), 24);
    assert!(assembly["pieces"].as_array().unwrap().iter().all(|p| p["component"] == 0));
    assert_eq!(assembly["matings"].as_array().unwrap().len(), 38);
    assert_eq!(assembly["unplaced"], Value::Array(vec![]));
    assert_true(&assembly, &truth);
    for stage in ["segment", "features", "match", "assemble"] {
        assert!(assembly["seconds"][stage].as_f64().unwrap() >= 0.0);
    }
    assert!(assembly["table"]["pairs"].as_u64().unwrap() >= 38);

    let picture = image::open(out.join("assembly.png")).unwrap();
    assert!(picture.width() > 1000 && picture.height() > 700);
    let mut table = csv::Reader::from_path(out.join("matches.csv")).unwrap();
    assert_eq!(table.headers().unwrap().iter().next_back(), Some("fate"));
    let fates: Vec<String> = table.records().map(|row| row.unwrap().iter().next_back().unwrap().to_owned()).collect();
    assert_eq!(fates.iter().filter(|fate| *fate == "mated").count(), 38);
    // Nothing half written stays behind.
    let hidden =
        fs::read_dir(&out).unwrap().filter(|f| f.as_ref().unwrap().file_name().to_string_lossy().starts_with('.'));
    assert_eq!(hidden.count(), 0);
}

#[test]
fn frames_with_many_pieces_get_the_ids_of_the_truth() {
    let folder = TempDir::new().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    let options = ["--rows", "3", "--cols", "4", "--pieces-per-frame", "7", "--light", "front", "--noise", "3"];
    let truth = generate(&images, &options);
    let output = jigsaw(&["assemble", text(&images), "--out", text(&out)]);
    assert_exit(&output, 0);
    let assembly = read_json(&out.join("assembly.json"));
    assert_eq!(assembly["pieces"].as_array().unwrap().len(), 12);
    assert_true(&assembly, &truth);
}

#[test]
fn a_piece_face_down_is_left_over() {
    let folder = TempDir::new().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    let truth = generate(&images, &["--rows", "3", "--cols", "3", "--seed", "5", "--flipped", "1"]);
    let output = jigsaw(&["assemble", text(&images), "--out", text(&out)]);
    assert_exit(&output, 1);
    let assembly = read_json(&out.join("assembly.json"));
    assert_true(&assembly, &truth);
    let flipped = truth["pieces"].as_array().unwrap().iter().find(|p| p["flipped"] == true).unwrap();
    assert_eq!(assembly["unplaced"], Value::Array(vec![flipped["id"].clone()]));
    assert!(out.join("assembly.png").is_file() && out.join("matches.csv").is_file());
}

#[test]
fn inspect_finds_the_true_necks() {
    let folder = TempDir::new().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    let truth = generate(&images, &["--rows", "2", "--cols", "2"]);
    let output = jigsaw(&["inspect", text(&images), "--out", text(&out)]);
    assert_exit(&output, 0);
    let features = read_json(&out.join("features.json"));
    let features = features.as_array().unwrap();
    assert_eq!(features.len(), 4);
    for record in features {
        let id = record["id"].as_str().unwrap();
        let piece = truth["pieces"].as_array().unwrap().iter().find(|p| p["id"] == id).unwrap();
        assert!(record["border_length_px"].as_f64().unwrap() > 1000.0);
        assert!(record["noise_px"].as_f64().unwrap() < 0.2);
        let aoi = |name: &str| record["aoi"][name].as_f64().unwrap();
        let centroid = point(&piece["centroid"]);
        assert!(centroid.x > aoi("x") && centroid.x < aoi("x") + aoi("width"));
        assert!(centroid.y > aoi("y") && centroid.y < aoi("y") + aoi("height"));
        for side in piece["sides"].as_array().unwrap().iter().filter(|s| s["critical_points"].is_array()) {
            let polarity = if side["kind"] == "tab" { "positive" } else { "negative" };
            let wanted = [point(&side["critical_points"][0]), point(&side["critical_points"][1])];
            let found = record["isthmuses"].as_array().unwrap().iter().find(|isthmus| {
                let ends = [point(&isthmus["critical_points"][0]), point(&isthmus["critical_points"][1])];
                isthmus["polarity"] == polarity
                    && ends.iter().zip(&wanted).all(|(a, b)| (a - b).norm() < CRITICAL_POINT_TOLERANCE)
            });
            let found = found.unwrap_or_else(|| panic!("{id}: no {polarity} isthmus at {wanted:?}"));
            assert!(found["idf"].as_array().unwrap().len() > 10);
            assert!(found["path_length_px"].as_f64().unwrap() > found["width_px"].as_f64().unwrap());
        }
        let picture = image::open(out.join(format!("{id}_overlay.png"))).unwrap();
        assert!(picture.width() > 800);
    }
}

#[test]
fn bad_input_takes_one_line_and_exit_code_2() {
    let folder = TempDir::new().unwrap();
    let (empty, out) = (folder.path().join("empty"), folder.path().join("out"));
    fs::create_dir(&empty).unwrap();
    let wrong = folder.path().join("wrong.png");
    fs::write(&wrong, "this is a text").unwrap();
    let blank = folder.path().join("blank.png");
    image::GrayImage::from_pixel(64, 64, image::Luma([128])).save(&blank).unwrap();
    let (out, out_option) = (text(&out), "--out");
    let cases: &[(&[&str], &str)] = &[
        (&["assemble", "no/such/folder", out_option, out], "no/such/folder"),
        (&["assemble", text(&empty), out_option, out], "no image in this folder"),
        (&["assemble", text(&wrong), out_option, out], "wrong.png: not a picture"),
        (&["assemble", text(&blank), out_option, out], "blank.png"),
        (&["inspect", text(&wrong), out_option, out], "wrong.png: not a picture"),
        (&["assemble", text(&empty)], "--out"),
        (&["assemble", text(&empty), out_option, out, "--fast"], "--fast"),
        (&["assemble", text(&empty), out_option, out, "--minimum-confidence", "2"], "minimum_confidence=2"),
        (&["generate", "--rows", "0", out_option, out], "rows is 0"),
        (&["generate", "--clearance", "5..1", out_option, out], "clearance is 5 to 1"),
        (&["generate", "--piece-size", "900", out_option, out], "doesn't fit"),
        (&["generate", out_option, text(&wrong)], "wrong.png"),
        (&["solve"], "solve"),
    ];
    for (arguments, reason) in cases {
        let output = jigsaw(arguments);
        assert_exit(&output, 2);
        let lines = stderr_lines(&output);
        assert_eq!(lines.len(), 1, "{arguments:?}: {lines:?}");
        assert!(lines[0].contains(reason), "{arguments:?}: {lines:?}");
    }
}

#[test]
fn one_wrong_file_among_good_ones_costs_a_warning() {
    let folder = TempDir::new().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    let truth = generate(&images, &["--rows", "2", "--cols", "3"]);
    fs::write(images.join("notes.png"), "this is a text").unwrap();
    let output = jigsaw(&["assemble", text(&images), "--out", text(&out)]);
    assert_exit(&output, 0);
    let lines = stderr_lines(&output);
    assert_eq!(lines.len(), 1, "{lines:?}");
    assert!(lines[0].starts_with("warning: notes.png: "), "{lines:?}");
    assert_true(&read_json(&out.join("assembly.json")), &truth);
}

#[test]
fn results_in_the_folder_of_the_images_are_no_input() {
    let folder = TempDir::new().unwrap();
    let images = folder.path();
    generate(images, &["--rows", "2", "--cols", "2"]);
    for _ in 0..2 {
        assert_exit(&jigsaw(&["inspect", text(images), "--out", text(images)]), 0);
        assert_exit(&jigsaw(&["assemble", text(images), "--out", text(images)]), 0);
    }
    let assembly = read_json(&images.join("assembly.json"));
    assert_eq!(assembly["pieces"].as_array().unwrap().len(), 4);
}

#[test]
fn the_same_seed_writes_the_same_files() {
    let folder = TempDir::new().unwrap();
    let options = ["--rows", "2", "--cols", "2", "--seed", "3", "--noise", "10", "--frame", "256x256"];
    for copy in ["a", "b"] {
        generate(&folder.path().join(copy), &options);
    }
    for file in ["truth.json", "piece_0000.png", "piece_0003.png"] {
        let read = |copy: &str| fs::read(folder.path().join(copy).join(file)).unwrap();
        assert!(read("a") == read("b"), "{file} differs");
    }
}

#[test]
fn a_generated_bag_is_assembled() {
    let folder = TempDir::new().unwrap();
    for per_frame in ["1", "3"] {
        let (bag, out) = (folder.path().join(per_frame), folder.path().join(format!("out{per_frame}")));
        let options = ["--rows", "2", "--cols", "3", "--bag", "--pieces-per-frame", per_frame, "--rate", "30"];
        let truth = generate(&bag, &options);
        assert!(bag.join("metadata.yaml").is_file());
        let output = jigsaw(&["assemble", text(&bag), "--out", text(&out)]);
        assert_exit(&output, 0);
        let assembly = read_json(&out.join("assembly.json"));
        assert_eq!(assembly["pieces"].as_array().unwrap().len(), 6);
        assert_true(&assembly, &truth);
        // A bag is never overwritten.
        let again = jigsaw(&["generate", "--bag", "--out", text(&bag)]);
        assert_exit(&again, 2);
        assert_eq!(stderr_lines(&again).len(), 1);
    }
}

#[test]
fn help_is_for_people() {
    for arguments in [&["--help"][..], &["assemble", "--help"], &["inspect", "--help"], &["generate", "--help"]] {
        let output = jigsaw(arguments);
        assert_exit(&output, 0);
        assert!(String::from_utf8(output.stdout).unwrap().contains("Usage: jigsaw"));
    }
    let help = String::from_utf8(jigsaw(&["--help"]).stdout).unwrap();
    assert!(help.contains("Examples:") && help.contains("Exit codes:"), "{help}");
}
