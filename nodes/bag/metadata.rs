//! `metadata.yaml`, the table of contents of a bag folder: versions 1 to 9 are read, 9 is written.

use std::io::Read;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::qos::YamlProfile;
use super::{QosProfile, Storage, TopicCount};

/// File name inside the bag folder.
pub(super) const FILE_NAME: &str = "metadata.yaml";

/// Largest metadata file believed \[bytes\]; one topic takes about 1 kB.
const MAX_BYTES: u64 = 16 * 1024 * 1024;

/// Version of the format written.
const VERSION: u32 = 9;

/// What reading needs to know.
#[derive(Debug, Clone, Default)]
pub(super) struct Metadata {
    /// Storage file names without folder, in the order of the bag.
    pub(super) files: Vec<String>,
    /// Each message is compressed by itself.
    pub(super) messages_compressed: bool,
    /// What files or messages are compressed with, where that is not zstd.
    pub(super) foreign_compression: Option<String>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Debug, Serialize, Deserialize)]
struct Information {
    version: u32,
    #[serde(default)]
    storage_identifier: String,
    #[serde(default)]
    duration: Nanoseconds,
    #[serde(default)]
    starting_time: SinceEpoch,
    #[serde(default)]
    message_count: u64,
    #[serde(default)]
    topics_with_message_count: Vec<TopicWithCount>,
    #[serde(default)]
    compression_format: Option<String>,
    #[serde(default)]
    compression_mode: Option<String>,
    #[serde(default)]
    relative_file_paths: Vec<String>,
    #[serde(default)]
    files: Vec<FileInformation>,
    #[serde(default)]
    custom_data: Option<serde_yaml_ng::Value>,
    #[serde(default)]
    ros_distro: String,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct Nanoseconds {
    nanoseconds: i64,
}

#[derive(Debug, Default, Serialize, Deserialize)]
struct SinceEpoch {
    nanoseconds_since_epoch: i64,
}

#[derive(Debug, Serialize, Deserialize)]
struct TopicWithCount {
    topic_metadata: TopicMetadata,
    message_count: u64,
}

#[derive(Debug, Serialize, Deserialize)]
struct TopicMetadata {
    name: String,
    #[serde(rename = "type")]
    type_name: String,
    serialization_format: String,
    #[serde(default)]
    offered_qos_profiles: OfferedQos,
    #[serde(default)]
    type_description_hash: String,
}

/// A list from version 9 on, a string holding the YAML list before.
#[derive(Debug, Serialize, Deserialize)]
#[serde(untagged)]
enum OfferedQos {
    List(Vec<YamlProfile>),
    Text(String),
}

impl Default for OfferedQos {
    fn default() -> Self {
        Self::List(Vec::new())
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct FileInformation {
    path: String,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

impl Metadata {
    /// Reads the metadata file; the error is text for a warning, since the storage files suffice.
    pub(super) fn read(path: &Path) -> Result<Self, String> {
        let file = std::fs::File::open(path).map_err(|e| e.to_string())?;
        let mut text = String::new();
        file.take(MAX_BYTES).read_to_string(&mut text).map_err(|e| e.to_string())?;
        let document: Document = serde_yaml_ng::from_str(&text).map_err(|e| e.to_string())?;
        let information = document.rosbag2_bagfile_information;
        let mode = information.compression_mode.unwrap_or_default().to_ascii_lowercase();
        let compressed = ["file", "message"].contains(&mode.as_str());
        let foreign_compression = information
            .compression_format
            .filter(|format| compressed && !format.is_empty() && !format.eq_ignore_ascii_case("zstd"));
        // Old versions put the bag's own folder in front of the name; nothing may lead out of the folder.
        let files = information
            .relative_file_paths
            .iter()
            .filter_map(|path| Path::new(path).file_name())
            .map(|name| name.to_string_lossy().into_owned())
            .collect();
        Ok(Self { files, messages_compressed: mode == "message", foreign_compression })
    }
}

/// What a finished bag says about itself.
pub(super) struct Contents<'a> {
    pub(super) storage: Storage,
    pub(super) file_name: &'a str,
    pub(super) topics: &'a [TopicCount],
    /// Times of the first and the last message \[ns since the epoch\]; `None` without a message.
    pub(super) span_ns: Option<(i64, i64)>,
}

/// The text of `metadata.yaml` for a bag with one storage file.
pub(super) fn to_yaml(contents: &Contents<'_>) -> Result<String, serde_yaml_ng::Error> {
    let message_count = contents.topics.iter().map(|t| t.messages).sum();
    let (start, end) = contents.span_ns.unwrap_or((0, 0));
    let span =
        || (SinceEpoch { nanoseconds_since_epoch: start }, Nanoseconds { nanoseconds: end.saturating_sub(start) });
    let (starting_time, duration) = span();
    let (file_starting_time, file_duration) = span();
    let profiles = |list: &[QosProfile]| OfferedQos::List(list.iter().map(YamlProfile::from).collect());
    serde_yaml_ng::to_string(&Document {
        rosbag2_bagfile_information: Information {
            version: VERSION,
            storage_identifier: contents.storage.identifier().to_owned(),
            duration,
            starting_time,
            message_count,
            topics_with_message_count: contents
                .topics
                .iter()
                .map(|t| TopicWithCount {
                    topic_metadata: TopicMetadata {
                        name: t.topic.name.clone(),
                        type_name: t.topic.type_name.clone(),
                        serialization_format: t.topic.serialization.clone(),
                        offered_qos_profiles: profiles(&t.topic.offered_qos),
                        type_description_hash: t.topic.type_hash.clone(),
                    },
                    message_count: t.messages,
                })
                .collect(),
            compression_format: Some(String::new()),
            compression_mode: Some(String::new()),
            relative_file_paths: vec![contents.file_name.to_owned()],
            files: vec![FileInformation {
                path: contents.file_name.to_owned(),
                starting_time: file_starting_time,
                duration: file_duration,
                message_count,
            }],
            custom_data: None,
            ros_distro: String::new(),
        },
    })
}
