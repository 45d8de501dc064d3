//! Camera frames as a bag: grey pictures become `sensor_msgs/msg/CompressedImage` messages in PNG.
//!
//! ```
//! use jigsaw_nodes::bag::BagReader;
//! use jigsaw_nodes::bag::frames::{FrameBag, TOPIC};
//! let folder = tempfile::tempdir()?;
//! let mut bag = FrameBag::create(&folder.path().join("frames"), 0, 100_000_000)?;
//! bag.push(2, 2, &[0, 255, 255, 0])?;
//! bag.finish()?;
//! let bag = BagReader::open(&folder.path().join("frames"))?;
//! assert_eq!((bag.topics()[0].topic.name.as_str(), bag.message_count()), (TOPIC, 1));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::sensor_msgs::msg::CompressedImage;
use jigsaw_msgs::std_msgs::msg::Header;

use super::{BagError, BagWriter, Compression, QosProfile, Storage, Topic, TopicId, WriterOptions, cdr};

/// Topic of the frames.
pub const TOPIC: &str = "/image/compressed";

/// Frame of the camera, as the header names it.
const FRAME_ID: &str = "camera";

/// History depth of the publisher that a bag of frames stands for.
const DEPTH: u32 = 10;

const NANOSECONDS: i64 = 1_000_000_000;

/// Writes frames, evenly spaced in time.
pub struct FrameBag {
    folder: PathBuf,
    bag: BagWriter,
    topic: TopicId,
    stamp_ns: i64,
    period_ns: i64,
}

impl FrameBag {
    /// Starts a bag; the first frame is stamped `start_ns` \[ns since the epoch\], each further one `period_ns` later.
    ///
    /// # Errors
    /// As for [`BagWriter::create`].
    pub fn create(folder: &Path, start_ns: i64, period_ns: i64) -> Result<Self, BagError> {
        // PNG does not compress again.
        let options = WriterOptions { storage: Storage::Mcap, compression: Compression::None };
        let mut bag = BagWriter::create(folder, options)?;
        let topic =
            bag.add_topic(Topic::known(TOPIC, "sensor_msgs/msg/CompressedImage", vec![QosProfile::reliable(DEPTH)]))?;
        Ok(Self { folder: folder.to_owned(), bag, topic, stamp_ns: start_ns, period_ns })
    }

    /// Appends a grey frame of 8 bits a pixel, row by row from the top.
    ///
    /// # Errors
    /// [`BagError::Write`] where `pixels` are not `width` × `height`, or the storage refuses.
    pub fn push(&mut self, width: u32, height: u32, pixels: &[u8]) -> Result<(), BagError> {
        let fail = |reason: String| BagError::Write { path: self.folder.clone(), reason };
        if u64::from(width) * u64::from(height) != pixels.len() as u64 {
            return Err(fail(format!("a frame of {width} x {height} pixels has {} bytes", pixels.len())));
        }
        let mut data = Vec::new();
        PngEncoder::new_with_quality(&mut data, CompressionType::Best, FilterType::Adaptive)
            .write_image(pixels, width, height, ExtendedColorType::L8)
            .map_err(|e| fail(e.to_string()))?;
        let stamp = Time {
            sec: i32::try_from(self.stamp_ns.div_euclid(NANOSECONDS)).unwrap_or(i32::MAX),
            nanosec: u32::try_from(self.stamp_ns.rem_euclid(NANOSECONDS)).unwrap_or_default(),
        };
        let header = Header { stamp, frame_id: FRAME_ID.to_owned() };
        // As image_transport names it: pixel format, codec, format of what comes out.
        let message = CompressedImage { header, format: "mono8; png compressed mono8".to_owned(), data };
        let cdr = cdr::encode(&message).map_err(|e| fail(e.to_string()))?;
        self.bag.write(self.topic, self.stamp_ns, self.stamp_ns, &cdr)?;
        self.stamp_ns += self.period_ns;
        Ok(())
    }

    /// Completes the bag.
    ///
    /// # Errors
    /// As for [`BagWriter::finish`].
    pub fn finish(self) -> Result<(), BagError> {
        self.bag.finish()
    }
}
