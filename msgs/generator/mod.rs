//! Makes the Rust types from the definition files; `build.rs` runs it on every build, so the two cannot part.
//!
//! `definition` reads the files, `type_hash` computes their hashes, `rust` writes the code.

use std::path::Path;

pub(crate) mod definition;
pub(crate) mod rust;
pub(crate) mod type_hash;

use definition::{DefinitionError, Definitions, sorted_entries};

/// Name of the package whose definitions lie in `msg` and `action` of the crate's own folder.
pub(crate) const ROOT_PACKAGE: &str = "jigsaw_msgs";

/// Reads the definitions in the crate's folder: its own, and those of the packages in `standard`.
pub(crate) fn read(crate_folder: &Path) -> Result<Definitions, DefinitionError> {
    let mut packages = vec![(ROOT_PACKAGE.to_owned(), crate_folder.to_owned())];
    for folder in sorted_entries(&crate_folder.join("standard"))? {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        packages.push((name, folder));
    }
    Definitions::read(&packages)
}
