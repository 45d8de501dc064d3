//! Messages of the isthmus jigsaw cell as Rust types, made from the `.msg`, `.srv` and `.action` files beside this crate.
//!
//! The same files build with the standard rosidl generators for C++ and Python, so there is one source. Each structure
//! (de)serialises with serde in the order of its fields, which is what a CDR encoder needs; comments become documentation,
//! constants associated constants, field defaults the [`Default`].
//!
//! - [`msg`] and [`action`] are those of the package `jigsaw_msgs` itself; the standard packages that it needs have modules
//!   named after them, such as [`sensor_msgs`].
//! - [`Message::TYPE`] tells a type's names, full definition (as bags store it) and hash; [`MESSAGE_TYPES`],
//!   [`MessageType::find`] and [`visit`] do so by name, for those who meet a type at run time only.
//!
//! The crate knows no middleware. One that wants its own marker trait on a message wraps it.
//!
//! # Example
//!
//! ```
//! use jigsaw_msgs::{Message, MessageType, msg::Assembly, std_msgs::msg::Header};
//!
//! let header = Header { frame_id: "puzzle".to_owned(), ..Header::default() };
//! let assembly = Assembly { header, state: Assembly::PARTIAL, ..Assembly::default() };
//! assert_eq!(assembly.header.frame_id, "puzzle");
//!
//! let image = MessageType::find("sensor_msgs/msg/Image").ok_or("unknown type")?;
//! assert_eq!(image.dds_name, "sensor_msgs::msg::dds_::Image_");
//! assert!(image.definition.contains("MSG: std_msgs/Header"));
//! assert_ne!(image.type_hash, Assembly::TYPE.type_hash);
//! # Ok::<(), &str>(())
//! ```

use std::fmt::Debug;

use serde::de::{DeserializeOwned, Error as _};
use serde::ser::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

include!(concat!(env!("OUT_DIR"), "/messages.rs"));

/// The names, definition and hash of a message type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct MessageType {
    /// The package, such as `sensor_msgs`.
    pub package: &'static str,
    /// The name in its package, such as `Image` or `Trigger_Request`.
    pub name: &'static str,
    /// The full name, such as `sensor_msgs/msg/Image`.
    pub full_name: &'static str,
    /// The name on DDS, such as `sensor_msgs::msg::dds_::Image_`.
    pub dds_name: &'static str,
    /// The definition, followed by that of every type it contains, in the form of an MCAP schema of encoding `ros2msg`.
    pub definition: &'static str,
    /// The hash of the fields' names and types, `RIHS01_…` (REP 2016).
    pub type_hash: &'static str,
}

impl MessageType {
    /// The type of a full name, such as `sensor_msgs/msg/Image`.
    pub fn find(full_name: &str) -> Option<&'static Self> {
        let index = MESSAGE_TYPES.binary_search_by_key(&full_name, |known| known.full_name).ok()?;
        MESSAGE_TYPES.get(index)
    }
}

/// A message, or one of the structures of a service or an action.
pub trait Message: Serialize + DeserializeOwned + Debug + Clone + PartialEq + Default + Send + Sync + 'static {
    /// Its names, definition and hash.
    const TYPE: MessageType;
}

/// A service.
pub trait Service {
    /// What the client sends.
    type Request: Message;
    /// What the server answers.
    type Response: Message;
    /// The package, such as `std_srvs`.
    const PACKAGE: &'static str;
    /// The name in its package, such as `Trigger`.
    const NAME: &'static str;
}

/// An action.
pub trait Action {
    /// What the client wants.
    type Goal: Message;
    /// What came of it.
    type Result: Message;
    /// How far it is.
    type Feedback: Message;
    /// The package, such as `jigsaw_msgs`.
    const PACKAGE: &'static str;
    /// The name in its package, such as `Assemble`.
    const NAME: &'static str;
}

/// What to do with a type that is known by name only; see [`visit`].
pub trait Visitor {
    /// What comes of it.
    type Output;
    /// Does it with the Rust type `M`.
    fn visit<M: Message>(self) -> Self::Output;
}

/// Refuses a bounded sequence or string that is longer than `N`, in both directions.
struct AtMost<const N: usize>;

impl<const N: usize> AtMost<N> {
    fn serialize<T: Bounded + Serialize, S: Serializer>(value: &T, serializer: S) -> Result<S::Ok, S::Error> {
        match value.length() {
            length if length > N => Err(S::Error::custom(too_long(length, N))),
            _ => value.serialize(serializer),
        }
    }

    fn deserialize<'de, T: Bounded + Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<T, D::Error> {
        let value = T::deserialize(deserializer)?;
        match value.length() {
            length if length > N => Err(D::Error::custom(too_long(length, N))),
            _ => Ok(value),
        }
    }
}

fn too_long(length: usize, bound: usize) -> String {
    format!("length {length} is over the bound of {bound}")
}

/// What a bound in a definition counts: elements of a sequence, bytes of a string.
trait Bounded {
    fn length(&self) -> usize;
}

impl<T> Bounded for Vec<T> {
    fn length(&self) -> usize {
        self.len()
    }
}

impl Bounded for String {
    fn length(&self) -> usize {
        self.len()
    }
}
