//! rosbag2: read, write, play and record bags without a ROS installation and without knowing the message types.
//!
//! A bag is a folder with a `metadata.yaml` and one or more storage files, MCAP or sqlite3; a bare storage file is one
//! too. Messages are raw CDR with its 4-byte header all the way: [`BagReader`] yields them ordered by time,
//! [`BagWriter`] stores them, [`play`] publishes them over DDS and [`record`] subscribes them. Only [`cdr`] looks inside.
//!
//! ```text
//! BagReader ── Messages (raw, by time) ── play ── DDS
//! DDS ── record ── BagWriter ── name_0.mcap | name_0.db3, metadata.yaml
//! ```
//!
//! A bag that is cut off or damaged is read up to the damage: what is wrong is a [`BagWarning`] where the rest can be
//! used, a [`BagError`] where not. Memory stays bounded by the constants of [`storage`], whatever a file claims.

pub mod cdr;
pub mod cli;
pub mod frames;
pub mod play;
pub mod qos;
pub mod read;
pub mod record;
pub mod storage;
pub mod write;

mod mcap;
mod metadata;
mod pages;
mod queues;
mod sqlite;

use std::path::PathBuf;
use std::sync::Arc;

use thiserror::Error;

pub use qos::QosProfile;
pub use read::{BagReader, Messages};
pub use storage::{Compression, Selection};
pub use write::{BagWriter, TopicId, WriterOptions};

/// A topic as a bag describes it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Topic {
    /// Full name with its leading slash, as recorded.
    pub name: String,
    /// ROS type name, `package/msg/Type`. Empty where the bag does not say.
    pub type_name: String,
    /// Serialization format; `cdr` in every bag of today.
    pub serialization: String,
    /// QoS offered by the recorded publishers; empty where the bag does not say.
    pub offered_qos: Vec<QosProfile>,
    /// Type hash `RIHS01_…` of the type (REP 2016); empty where unknown.
    pub type_hash: String,
    /// Message definition, with those of the types it uses, in the format `ros2msg`; empty where unknown.
    pub definition: String,
}

impl Topic {
    /// A CDR topic whose definition and type hash are unknown.
    #[must_use]
    pub fn new(name: impl Into<String>, type_name: impl Into<String>, offered_qos: Vec<QosProfile>) -> Self {
        Self {
            name: name.into(),
            type_name: type_name.into(),
            serialization: "cdr".to_owned(),
            offered_qos,
            type_hash: String::new(),
            definition: String::new(),
        }
    }

    /// A CDR topic of a type that [`jigsaw_msgs`] knows, with its definition and hash; without them for any other type.
    #[must_use]
    pub fn known(name: impl Into<String>, type_name: impl Into<String>, offered_qos: Vec<QosProfile>) -> Self {
        let mut topic = Self::new(name, type_name, offered_qos);
        if let Some(known) = jigsaw_msgs::MessageType::find(&topic.type_name) {
            known.type_hash.clone_into(&mut topic.type_hash);
            known.definition.clone_into(&mut topic.definition);
        }
        topic
    }
}

/// A topic and how many messages of it a bag holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TopicCount {
    /// The topic.
    pub topic: Arc<Topic>,
    /// Number of its messages in the bag.
    pub messages: u64,
}

/// One recorded message, not decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawMessage {
    /// The topic it was recorded on.
    pub topic: Arc<Topic>,
    /// When it was received \[ns since the Unix epoch\].
    pub log_time_ns: i64,
    /// When it was sent \[ns since the Unix epoch\]; the log time where the storage keeps only that (sqlite3).
    pub publish_time_ns: i64,
    /// The message: encapsulation header and CDR.
    pub cdr: Vec<u8>,
}

/// Storage format of a bag.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Storage {
    /// MCAP, the default of ROS 2 since Iron.
    Mcap,
    /// An sqlite3 database, the default until Humble.
    Sqlite3,
}

impl Storage {
    /// The name rosbag2 gives the storage plugin.
    #[must_use]
    pub fn identifier(self) -> &'static str {
        match self {
            Self::Mcap => "mcap",
            Self::Sqlite3 => "sqlite3",
        }
    }

    /// File name extension.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Mcap => "mcap",
            Self::Sqlite3 => "db3",
        }
    }
}

/// Why a bag cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BagError {
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The folder holds no storage file.
    #[error("{}: no bag: the folder holds no .mcap or .db3 file", path.display())]
    NoStorage {
        /// The folder.
        path: PathBuf,
    },
    /// The file is neither MCAP nor an sqlite3 database.
    #[error("{}: no bag: the file starts neither as MCAP nor as sqlite3", path.display())]
    NotABag {
        /// The file.
        path: PathBuf,
    },
    /// The content of the file cannot be read, or not further.
    #[error("{}: damaged bag: {reason}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The bag uses a feature that is not supported.
    #[error("{}: {feature} is not supported", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The feature.
        feature: String,
    },
    /// The folder to write to exists.
    #[error("{} exists already; a bag is written to a new folder", path.display())]
    Exists {
        /// The folder.
        path: PathBuf,
    },
    /// A topic to be written has a name that no ROS topic has.
    #[error("topic name {name:?} must begin with a slash and have no empty part")]
    TopicName {
        /// The name.
        name: String,
    },
    /// The storage refused a write.
    #[error("{}: cannot write: {reason}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the storage says.
        reason: String,
    },
}

/// Something wrong with a bag that does not keep the rest of it from being read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum BagWarning {
    /// The file ends early or is damaged; what lies before is read.
    #[error("{}: {reason}; {messages} messages before that are read", path.display())]
    Incomplete {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
        /// How many messages can be read.
        messages: u64,
    },
    /// A file of the bag cannot be read at all; the others are.
    #[error("{reason}; the other files of the bag are read")]
    FileSkipped {
        /// What is wrong, with the name of the file.
        reason: String,
    },
    /// There is no usable `metadata.yaml`; the storage files say the rest.
    #[error("{}: {reason}; going by the storage files", path.display())]
    Metadata {
        /// The metadata file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

#[cfg(test)]
mod tests;
