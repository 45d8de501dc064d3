//! The fuzz targets of `fuzz/`, without the engine: every seed, every input that once broke something (`fuzz/finds/`), and
//! damaged copies of the seeds, always the same ones. Memory is limited, so that a length that is believed ends the test.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use nix::sys::resource::{Resource, getrlimit, setrlimit};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[allow(dead_code, clippy::expect_used, missing_docs, unreachable_pub, reason = "it is the library of another crate")]
#[path = "../fuzz/src/lib.rs"]
mod targets;

use targets::{TARGETS, Target};

/// Address space for a target: what a node is given.
const MEMORY: u64 = 4 << 30;

/// What a target takes more: mcap 0.26 reserves (and never touches) as much as a string claims, up to 4 GiB, which no record
/// in a chunk can be checked for beforehand. Bags are not read by the nodes.
const MORE: [(&str, u64); 2] = [("bag_mcap", 8 << 30), ("bag_sqlite", 8 << 30)];

/// The limit is that of the process: one target at a time.
static TURN: Mutex<()> = Mutex::new(());

/// Damaged copies of each seed.
const COPIES: usize = 60;

/// How long one input may take; the slowest takes some tenths of a second when nothing else runs.
const PATIENCE: Duration = Duration::from_secs(30);

/// Numbers at which arithmetic goes wrong: extremes, signs, and the floats that are none.
const STRANGE: [u32; 10] = [
    0,
    1,
    u32::MAX,
    0x7fff_ffff,
    0x8000_0000,
    0x0000_ffff,
    0x7fc0_0000, // not a number
    0x7f80_0000, // infinite
    0xff80_0000,
    0x0000_0001, // the least float
];

fn damaged(seed: &[u8], random: &mut impl Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..random.random_range(1..=6) {
        let place = random.random_range(0..bytes.len().max(1));
        match random.random_range(0..6) {
            0 => bytes.truncate(place),
            1 => bytes.insert(place.min(bytes.len()), random.random()),
            2 => drop(bytes.drain(place.min(bytes.len())..(place + 8).min(bytes.len()))),
            // Near the front are the headers.
            3 => overwrite(&mut bytes, random.random_range(0..64), random),
            _ => overwrite(&mut bytes, place, random),
        }
    }
    bytes
}

fn overwrite(bytes: &mut [u8], place: usize, random: &mut impl Rng) {
    let place = place / 4 * 4;
    let strange = STRANGE[random.random_range(0..STRANGE.len())].to_le_bytes();
    if let Some(word) = bytes.get_mut(place..place + 4) {
        match random.random_range(0..3) {
            0 => word[random.random_range(0..4)] ^= 1 << random.random_range(0..8),
            _ => word.copy_from_slice(&strange),
        }
    }
}

fn run(target: &Target, input: &[u8], what: &str) {
    let start = Instant::now();
    (target.run)(input);
    assert!(start.elapsed() < PATIENCE, "{}: {what} took {:?}", target.name, start.elapsed());
}

/// Limits the memory to that of a target.
fn limit(target: &Target) {
    let (_, hard) = getrlimit(Resource::RLIMIT_AS).unwrap();
    let more: u64 = MORE.iter().filter(|(name, _)| *name == target.name).map(|(_, more)| more).sum();
    setrlimit(Resource::RLIMIT_AS, (MEMORY + more).min(hard), hard).unwrap();
}

/// For the engine, which begins with them.
fn write_seeds(folder: &Path, seeds: &[Vec<u8>]) {
    std::fs::create_dir_all(folder).unwrap();
    for (number, seed) in seeds.iter().enumerate() {
        std::fs::write(folder.join(format!("seed_{number}")), seed).unwrap();
    }
}

#[test]
fn damaged_input_gives_errors_and_neither_panics_nor_hangs() {
    for target in TARGETS {
        let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        limit(target);
        let seeds = (target.seeds)();
        assert!(!seeds.is_empty() && seeds.iter().all(|seed| !seed.is_empty()), "{} has no seeds", target.name);
        if let Some(corpus) = std::env::var_os("JIGSAW_FUZZ_CORPUS") {
            write_seeds(&Path::new(&corpus).join(target.name), &seeds);
        }
        let mut random = ChaCha8Rng::seed_from_u64(1990);
        for (k, seed) in seeds.iter().enumerate() {
            run(target, seed, &format!("seed {k}"));
            for copy in 0..COPIES {
                run(target, &damaged(seed, &mut random), &format!("copy {copy} of seed {k}"));
            }
        }
    }
}

#[test]
fn what_once_broke_something_does_so_no_more() {
    for target in TARGETS {
        let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        limit(target);
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/finds").join(target.name);
        for file in std::fs::read_dir(folder).into_iter().flatten() {
            let path = file.unwrap().path();
            run(target, &std::fs::read(&path).unwrap(), &path.display().to_string());
        }
    }
}
