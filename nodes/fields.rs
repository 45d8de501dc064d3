//! What fields of messages keep to, whichever node reads them, and what several nodes write in the same way.

use image::RgbImage;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::Header;

use crate::ros::health::shown;

/// Largest side of a frame. Real cameras end at about 20 000; a claim beyond that is nonsense that would cost memory.
pub(crate) const MAX_SIDE_PX: u32 = 32_768;

/// Largest area of a frame: 150 megapixels.
pub(crate) const MAX_AREA_PX: u64 = 150_000_000;

/// Longest name of a frame or a source, in bytes; far more than anyone writes, and little enough to be kept.
const MAX_NAME_LENGTH: usize = 1024;

/// A field that breaks a rule: field, value, rule.
type Fault = (&'static str, String, &'static str);

/// Whether a text can be taken over into messages and logs.
pub(crate) fn text_fault(field: &'static str, text: &str) -> Option<Fault> {
    let fits = text.len() <= MAX_NAME_LENGTH && !text.chars().any(char::is_control);
    (!fits).then(|| (field, format!("'{}'", shown(text)), "at most 1024 bytes without control characters"))
}

/// What is wrong with a header, if anything. Its time may lie years back (as a bag's does) or before that of the message
/// before it.
pub(crate) fn header_fault(header: &Header) -> Option<Fault> {
    const NANOS: u32 = 1_000_000_000;
    let Time { sec, nanosec } = header.stamp;
    if sec < 0 {
        return Some(("header.stamp.sec", sec.to_string(), "0 or more"));
    }
    if nanosec >= NANOS {
        return Some(("header.stamp.nanosec", nanosec.to_string(), "less than 1000000000"));
    }
    text_fault("header.frame_id", &header.frame_id)
}

/// Longest name of a piece, in bytes; coordinate frames carry it.
pub(crate) const MAX_ID_LENGTH: usize = 200;

/// Scales that make sense, in metres a pixel: from an electron microscope to a picture of the Earth. Others would become
/// zero or infinite as the messages' single precision numbers.
pub(crate) const SCALES: std::ops::RangeInclusive<f64> = 1e-9..=1e3;

/// [`SCALES`] in words.
pub(crate) const SCALE_RULE: &str = "1e-9 to 1000";

/// Whether a piece may be called so: its name is a part of the name of a coordinate frame.
pub(crate) fn is_piece_id(id: &str) -> bool {
    (1..=MAX_ID_LENGTH).contains(&id.len()) && !id.chars().any(|c| c == '/' || c.is_whitespace() || c.is_control())
}

/// The camera that a topic is of: image transports send its frames once more, compressed, on a topic named after the raw
/// one.
pub(crate) fn camera(topic: &str) -> &str {
    topic.strip_suffix("/compressed").unwrap_or(topic)
}

/// When the pieces of a frame were seen, in nanoseconds. Of a file that is not known (0), for its time is that of the file; names
/// of topics begin with a slash, which those of files don't hold.
pub(crate) fn seen(source: &str, stamp: &Time) -> u64 {
    const SECOND: u64 = 1_000_000_000;
    let since_the_epoch = u64::try_from(stamp.sec).unwrap_or(0) * SECOND + u64::from(stamp.nanosec);
    if source.starts_with('/') { since_the_epoch } else { 0 }
}

/// A picture as a message, `rgb8`.
pub(crate) fn image_message(header: Header, picture: RgbImage) -> Image {
    Image {
        header,
        height: picture.height(),
        width: picture.width(),
        encoding: "rgb8".to_owned(),
        is_bigendian: 0,
        step: 3 * picture.width(),
        data: picture.into_raw(),
    }
}
