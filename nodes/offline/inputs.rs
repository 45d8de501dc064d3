//! What the paths of the command line name, image by image: files, folders of files, bags.

use std::fs;
use std::path::{Path, PathBuf};

use super::report::{OfflineError, Progress};
use crate::bag::{BagReader, RawMessage, Selection, Storage, TopicCount, cdr};
use crate::capture::convert::{self, Picture};
use crate::capture::source::{Frame, PICTURE_ENDINGS};
use crate::results::{ASSEMBLY_PICTURE, OVERLAY_ENDING};

/// Types of the messages that are pictures.
const RAW_IMAGE: &str = "sensor_msgs/msg/Image";
const COMPRESSED_IMAGE: &str = "sensor_msgs/msg/CompressedImage";

/// One image, not yet read.
pub(super) enum Input {
    File(PathBuf),
    /// A message of a bag.
    Message(RawMessage),
    /// A part of a bag that can't be read: why.
    Unreadable(String),
}

impl Input {
    pub(super) fn read(self) -> Result<Picture, String> {
        let frame = match self {
            Input::File(path) => Frame::File(path),
            Input::Message(message) => {
                let topic = message.topic.name.clone();
                let undecodable = |error| format!("{topic}: {error}");
                if message.topic.type_name == COMPRESSED_IMAGE {
                    Frame::Compressed(topic.clone(), cdr::decode(&message.cdr).map_err(undecodable)?)
                } else {
                    Frame::Raw(topic.clone(), cdr::decode(&message.cdr).map_err(undecodable)?)
                }
            }
            Input::Unreadable(reason) => return Err(reason),
        };
        convert::picture(frame).map_err(|error| one_line(&error.to_string()))
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// A path of the command line that can be read.
pub(super) enum Origin {
    File(PathBuf),
    Bag(BagReader),
}

impl Origin {
    /// How many images it holds.
    pub(super) fn count(&self) -> usize {
        match self {
            Origin::File(_) => 1,
            Origin::Bag(bag) => image_topics(bag).map(|topic| topic.messages as usize).sum(),
        }
    }

    pub(super) fn images(&self) -> Result<Box<dyn Iterator<Item = Input> + '_>, OfflineError> {
        match self {
            Origin::File(path) => Ok(Box::new(std::iter::once(Input::File(path.clone())))),
            Origin::Bag(bag) => {
                let selection = Selection::topics(image_topics(bag).map(|topic| topic.topic.name.clone()));
                Ok(Box::new(bag.messages(selection)?.map(|message| match message {
                    Ok(message) => Input::Message(message),
                    Err(error) => Input::Unreadable(one_line(&error.to_string())),
                })))
            }
        }
    }
}

fn image_topics(bag: &BagReader) -> impl Iterator<Item = &TopicCount> {
    bag.topics().iter().filter(|topic| [RAW_IMAGE, COMPRESSED_IMAGE].contains(&topic.topic.type_name.as_str()))
}

/// File name extension in lower case.
fn extension(path: &Path) -> String {
    path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default()
}

/// Whether a path is a bag: a file of one, or a folder with one.
fn is_bag(path: &Path) -> bool {
    if path.is_dir() {
        let holds_storage =
            |mut entries: fs::ReadDir| entries.any(|e| e.is_ok_and(|e| !e.path().is_dir() && is_bag(&e.path())));
        return path.join("metadata.yaml").is_file() || fs::read_dir(path).is_ok_and(holds_storage);
    }
    let storage = [Storage::Mcap, Storage::Sqlite3].map(Storage::extension);
    let name = if extension(path) == "zstd" { path.with_extension("") } else { path.to_path_buf() };
    storage.contains(&extension(&name).as_str())
}

/// What the paths name, the files of each folder in the order of their names. Pictures that a run wrote into `out` itself
/// are not taken for input.
pub(super) fn find_inputs(paths: &[PathBuf], out: &Path, progress: &dyn Progress) -> Result<Vec<Origin>, OfflineError> {
    let mut origins = vec![];
    for path in paths {
        let read = |error| OfflineError::Read { path: path.clone(), error };
        let is_folder = fs::metadata(path).map_err(read)?.is_dir();
        if is_bag(path) {
            let bag = BagReader::open(path)?;
            bag.warnings().iter().for_each(|warning| progress.warning(&one_line(&warning.to_string())));
            if image_topics(&bag).next().is_none() {
                return Err(OfflineError::NoTopic { path: path.clone() });
            }
            origins.push(Origin::Bag(bag));
            continue;
        }
        if !is_folder {
            origins.push(Origin::File(path.clone()));
            continue;
        }
        let own = matches!((path.canonicalize(), out.canonicalize()), (Ok(a), Ok(b)) if a == b);
        let mut files = vec![];
        for entry in fs::read_dir(path).map_err(read)? {
            let file = entry.map_err(read)?.path();
            let name = file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let written = own && (name == ASSEMBLY_PICTURE || name.ends_with(OVERLAY_ENDING));
            let wanted = PICTURE_ENDINGS.contains(&extension(&file).as_str());
            if wanted && !name.starts_with('.') && !written && file.is_file() {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Err(OfflineError::EmptyFolder { path: path.clone() });
        }
        files.sort();
        origins.extend(files.into_iter().map(Origin::File));
    }
    Ok(origins)
}
