//! Time of each stage on a 1024 x 1024 frame with one piece, on a 12-megapixel frame with 30 pieces, and of what one would use instead.
//!
//! `cargo bench -p isthmus-shapes`

#![allow(missing_docs, clippy::unwrap_used, reason = "bench program")]

#[path = "../tests/shapes/mod.rs"]
mod shapes;

use criterion::{Criterion, criterion_group, criterion_main};
use image::{GrayImage, Luma};
use isthmus::contour::{Border, Tracer};
use isthmus::isthmus::{Polarity, find};
use isthmus::mask::{Frame, Parameters, Segmenter};
use isthmus::skeleton::Triangulation;
use isthmus::{Extractor, profile};
use shapes::{Camera, Piece, pose};
use std::hint::black_box;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Samples of an isthmus distance function.
const IDF: usize = 64;

fn one_piece(c: &mut Criterion) {
    let outline = Piece::usual(300.0).outline(&pose(0.3, 1.0, 512.0, 512.0));
    let camera = Camera { width: 1024, height: 1024, noise: 3.0, ..Camera::default() };
    let pixels = camera.picture(std::slice::from_ref(&outline));
    let frame = Frame::grey(1024, 1024, &pixels).unwrap();
    let mut segmenter = Segmenter::default();
    let cutout = segmenter.segment(&frame, &Parameters::default()).cutouts.remove(0);
    let (border, noise) = Border::from_cutout(&cutout).unwrap();
    let triangulation = Triangulation::new(&border).unwrap();
    let isthmuses = find(&border, &triangulation, noise);
    let mut group = c.benchmark_group("one piece in 1024 x 1024");
    group.bench_function("threshold and cut out", |b| {
        b.iter(|| segmenter.segment(black_box(&frame), &Parameters::default()));
    });
    let mut tracer = Tracer::default();
    group.bench_function("border, resampled and smoothed", |b| b.iter(|| tracer.trace(black_box(&cutout))));
    let mut reused = Triangulation::default();
    group.bench_function("triangulate", |b| b.iter(|| reused.rebuild(black_box(&border))));
    group.bench_function("isthmuses", |b| b.iter(|| find(black_box(&border), &triangulation, noise)));
    group.bench_function("IDFs", |b| {
        b.iter(|| isthmuses.iter().map(|i| profile::distance_function(&border, i, IDF)[IDF / 2]).sum::<f64>());
    });
    group.bench_function("both skeletons", |b| {
        b.iter(|| {
            [Polarity::Positive, Polarity::Negative].map(|p| triangulation.skeleton(black_box(&border), p, noise))
        });
    });
    let mut extractor = Extractor::default();
    group.bench_function("all of it", |b| {
        b.iter(|| {
            let found = segmenter.segment(black_box(&frame), &Parameters::default());
            found.cutouts.iter().map(|c| extractor.extract(c).unwrap().isthmuses.len()).sum::<usize>()
        });
    });
    for (noise, blur, vignette) in [(3.0, 1.0, 0.5), (20.0, 4.0, 0.0), (20.0, 4.0, 0.5)] {
        let camera = Camera { noise, blur, vignette, ..camera };
        let pixels = camera.picture(std::slice::from_ref(&outline));
        let frame = Frame::grey(1024, 1024, &pixels).unwrap();
        group.bench_function(format!("all of it, noise {noise}, blur {blur}, vignette {vignette}"), |b| {
            b.iter(|| {
                let found = segmenter.segment(black_box(&frame), &Parameters::default());
                found.cutouts.iter().map(|c| extractor.extract(c).unwrap().isthmuses.len()).sum::<usize>()
            });
        });
    }
    group.sample_size(10);
    let binary =
        GrayImage::from_fn(1024, 1024, |x, y| Luma([if pixels[(y * 1024 + x) as usize] < 128 { 255 } else { 0 }]));
    group.bench_function("peer: imageproc Euclidean distance transform", |b| {
        b.iter(|| imageproc::distance_transform::euclidean_squared_distance_transform(black_box(&binary)));
    });
    group.bench_function("peer: imageproc border following", |b| {
        b.iter(|| imageproc::contours::find_contours::<i32>(black_box(&binary)));
    });
    group.finish();
}

fn many_pieces(c: &mut Criterion) {
    let mut outlines = Vec::new();
    for k in 0..30u64 {
        let (x, y) = (350.0 + 660.0 * (k % 6) as f64, 300.0 + 590.0 * (k / 6) as f64);
        outlines.push(Piece::random(300.0, k).outline(&pose(k as f64, 1.0, x, y)));
    }
    let camera = Camera { width: 4000, height: 3000, noise: 3.0, ..Camera::default() };
    let pixels = camera.picture(&outlines);
    let frame = Frame::grey(4000, 3000, &pixels).unwrap();
    let (mut segmenter, mut extractor) = (Segmenter::default(), Extractor::default());
    let mut group = c.benchmark_group("30 pieces in 12 megapixels");
    group.sample_size(10);
    group.bench_function("threshold and cut out", |b| {
        b.iter(|| segmenter.segment(black_box(&frame), &Parameters::default()).cutouts.len());
    });
    group.bench_function("all of it, one thread", |b| {
        b.iter(|| {
            let found = segmenter.segment(black_box(&frame), &Parameters::default());
            assert_eq!(found.cutouts.len(), 30);
            found.cutouts.iter().map(|c| extractor.extract(c).unwrap().isthmuses.len()).sum::<usize>()
        });
    });
    let mut extractors = [Extractor::default(), Extractor::default()];
    group.bench_function("all of it, pieces on two threads", |b| {
        b.iter(|| {
            let found = segmenter.segment(black_box(&frame), &Parameters::default());
            let next = AtomicUsize::new(0);
            let work = |extractor: &mut Extractor| {
                let mut isthmuses = 0;
                while let Some(cutout) = found.cutouts.get(next.fetch_add(1, Ordering::Relaxed)) {
                    isthmuses += extractor.extract(cutout).unwrap().isthmuses.len();
                }
                isthmuses
            };
            let [first, second] = &mut extractors;
            std::thread::scope(|scope| {
                let other = scope.spawn(|| work(first));
                work(second) + other.join().unwrap()
            })
        });
    });
    group.finish();
}

criterion_group!(benches, one_piece, many_pieces);
criterion_main!(benches);
