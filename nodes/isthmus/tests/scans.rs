//! Real scans: every piece is found with the default parameters. Skipped where the scans are missing.

#![allow(clippy::unwrap_used, reason = "test program: its functions beside the tests fail by panic too")]

use isthmus::Extractor;
use isthmus::mask::{Frame, Parameters, segment};
use std::path::{Path, PathBuf};

/// The folder of the scans: `JIGSAW_SCANS`, or `../shared/scans` beside the checkout.
fn scans() -> Option<PathBuf> {
    let folder = std::env::var_os("JIGSAW_SCANS")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/scans"), PathBuf::from);
    folder.is_dir().then_some(folder)
}

fn pictures(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| ["jpg", "jpeg", "png", "tiff"].iter().any(|x| e == *x)))
        .filter(|p| !p.to_string_lossy().contains("solved"))
        .collect();
    files.sort();
    files
}

fn check(set: &str, pieces: usize) {
    let Some(folder) = scans() else {
        println!("skipped: no scans");
        return;
    };
    let folder = [folder.join(set).join("pieces"), folder.join(set)].into_iter().find(|f| f.is_dir()).unwrap();
    let mut extractor = Extractor::default();
    let (mut found, mut positive, mut negative) = (0, 0, 0);
    let mut report = String::new();
    for file in pictures(&folder) {
        let picture = image::open(&file).unwrap();
        let segmentation = if picture.color().has_color() {
            let rgb = picture.to_rgb8();
            segment(&Frame::rgb(rgb.width(), rgb.height(), rgb.as_raw()).unwrap(), &Parameters::default())
        } else {
            let grey = picture.to_luma8();
            segment(&Frame::grey(grey.width(), grey.height(), grey.as_raw()).unwrap(), &Parameters::default())
        };
        found += segmentation.cutouts.len();
        let name = file.file_name().unwrap().to_string_lossy();
        report += &format!("{name}: {} {:?}\n", segmentation.cutouts.len(), segmentation.rejected);
        for cutout in &segmentation.cutouts {
            let features = extractor.extract(cutout).unwrap();
            let count = |polarity| features.isthmuses.iter().filter(|i| i.salient && i.polarity == polarity).count();
            positive += count(isthmus::isthmus::Polarity::Positive);
            negative += count(isthmus::isthmus::Polarity::Negative);
        }
    }
    println!("{set}: {found} pieces, {positive} necks, {negative} mouths");
    assert_eq!(found, pieces, "{set}\n{report}");
}

#[test]
fn eda12() {
    check("eda12", 12);
}

#[test]
fn patch16() {
    check("patch16", 16);
}

#[test]
fn toystory48() {
    check("toystory48", 48);
}

#[test]
fn white120() {
    check("white120", 120);
}

#[test]
fn horse208() {
    check("horse208", 208);
}
