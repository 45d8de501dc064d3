//! Where frames come from: topics, or a folder of pictures.

use std::path::{Path, PathBuf};

use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};

/// File name endings of pictures, in lower case.
pub const PICTURE_ENDINGS: &[&str] = &["png", "jpg", "jpeg", "bmp", "tif", "tiff", "pbm", "pgm", "ppm", "pnm"];

/// A frame as it comes in.
#[derive(Debug, Clone)]
pub enum Frame {
    /// From the topic of this name.
    Raw(String, Image),
    /// From the topic of this name.
    Compressed(String, CompressedImage),
    /// From a folder.
    File(PathBuf),
}

/// Why a folder gives no pictures.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FolderError {
    /// It can't be read.
    #[error("folder '{}' can't be read: {reason}", folder.display())]
    Unreadable {
        /// The folder.
        folder: PathBuf,
        /// The system's words.
        reason: String,
    },
    /// There is no picture in it.
    #[error("folder '{}' holds no picture (a file that ends in {})", folder.display(), PICTURE_ENDINGS.join(", "))]
    Empty {
        /// The folder.
        folder: PathBuf,
    },
}

/// The pictures of a folder, by name.
///
/// # Errors
/// [`FolderError`] for a folder that can't be read or holds no picture.
pub fn pictures(folder: &Path) -> Result<Vec<PathBuf>, FolderError> {
    let unreadable = |e: std::io::Error| FolderError::Unreadable { folder: folder.to_owned(), reason: e.to_string() };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        if path.is_file() && PICTURE_ENDINGS.contains(&ending.as_str()) {
            files.push(path);
        }
    }
    files.sort();
    if files.is_empty() { Err(FolderError::Empty { folder: folder.to_owned() }) } else { Ok(files) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_are_listed_by_name() {
        let folder = std::env::temp_dir().join(format!("jigsaw-source-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let error = pictures(&folder).unwrap_err().to_string();
        assert!(error.contains("no picture"), "{error}");
        for name in ["b.PNG", "a.jpg", "c.pnm", "notes.txt", "c"] {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let names: Vec<_> = pictures(&folder).unwrap().iter().map(|p| p.file_name().unwrap().to_owned()).collect();
        assert_eq!(names, ["a.jpg", "b.PNG", "c.pnm"]);
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(matches!(pictures(&folder), Err(FolderError::Unreadable { .. })));
    }
}
