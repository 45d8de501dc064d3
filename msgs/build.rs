//! Makes the Rust types from `msg`, `action` and `standard`.

use std::error::Error;
use std::path::PathBuf;
use std::{env, fs};

mod generator;

fn main() -> Result<(), Box<dyn Error>> {
    for input in ["build.rs", "generator", "msg", "action", "standard"] {
        println!("cargo::rerun-if-changed={input}");
    }
    let crate_folder = PathBuf::from(env::var("CARGO_MANIFEST_DIR")?);
    // A rule that a definition breaks is the user's error, so it is shown in words and not as a debug print.
    let definitions = match generator::read(&crate_folder) {
        Ok(definitions) => definitions,
        Err(error) => {
            println!("cargo::error={error}");
            return Ok(());
        }
    };
    let code = generator::rust::write(&definitions, generator::ROOT_PACKAGE);
    fs::write(PathBuf::from(env::var("OUT_DIR")?).join("messages.rs"), code)?;
    Ok(())
}
