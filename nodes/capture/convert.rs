//! Frames to pictures, cutouts to messages.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::time::UNIX_EPOCH;

use image::{DynamicImage, GrayImage, ImageReader, Limits, RgbImage, RgbaImage};
use isthmus::mask::{Aoi, Cutout};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::msg::PieceImage;
use jigsaw_msgs::sensor_msgs::msg::{CompressedImage, Image};
use jigsaw_msgs::std_msgs::msg::Header;

use super::cut::stretched;
use super::known::FrameName;
use super::source::Frame;
use crate::fields::{MAX_AREA_PX, MAX_SIDE_PX, header_fault};
use crate::ros::health::shown;

/// Most memory that decoding one file may take, in bytes.
const MAX_DECODER_MEMORY: u64 = 1 << 30;

/// Frame id of pictures from a folder, which have no header.
const FILE_FRAME_ID: &str = "camera";

/// Why a frame is refused: which field, and which rule it breaks.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// Width or height out of range.
    #[error(
        "{source_name}: size {width}x{height}: each side must be 1 to {MAX_SIDE_PX} and the area at most {MAX_AREA_PX} px"
    )]
    Size {
        /// Topic or file.
        source_name: String,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// A header that is none.
    #[error("{source_name}: {field} is {value}: must be {rule}")]
    Header {
        /// Topic.
        source_name: String,
        /// The field.
        field: &'static str,
        /// Its value.
        value: String,
        /// What it must be.
        rule: &'static str,
    },
    /// An encoding that is not read.
    #[error("{source_name}: encoding '{encoding}': must be one of {}", ENCODINGS.map(|(name, ..)| name).join(", "))]
    Encoding {
        /// Topic.
        source_name: String,
        /// The field.
        encoding: String,
    },
    /// Rows shorter than the pixels in them.
    #[error("{source_name}: step {step}: must be at least {least} (width {width} x {bytes} bytes)")]
    Step {
        /// Topic.
        source_name: String,
        /// The field.
        step: u32,
        /// Smallest step that fits.
        least: u64,
        /// Columns.
        width: u32,
        /// Bytes a pixel.
        bytes: u32,
    },
    /// Fewer data than step and height say.
    #[error("{source_name}: data of {length} bytes: must be at least {least} (step {step} x height {height})")]
    Data {
        /// Topic.
        source_name: String,
        /// Bytes there are.
        length: usize,
        /// Bytes there must be.
        least: u64,
        /// The field.
        step: u32,
        /// Rows.
        height: u32,
    },
    /// A file (in a folder or a message) that is no picture.
    #[error("{source_name}: not a picture that can be read: {reason}")]
    Undecodable {
        /// Topic or file.
        source_name: String,
        /// The decoder's words.
        reason: String,
    },
    /// Nothing but ground, or nothing but one grey.
    #[error("{source_name}: no piece in the picture: {reason}")]
    NoPiece {
        /// Topic or file.
        source_name: String,
        /// The segmentation's words.
        reason: String,
    },
}

impl FrameError {
    /// The kind, for counting and throttling.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Size { .. } => "size",
            Self::Header { field, .. } => field,
            Self::Encoding { .. } => "encoding",
            Self::Step { .. } => "step",
            Self::Data { .. } => "data",
            Self::Undecodable { .. } => "undecodable_picture",
            Self::NoPiece { .. } => "no_piece",
        }
    }
}

fn check_header(source_name: &str, header: &Header) -> Result<(), FrameError> {
    let fault = |(field, value, rule)| FrameError::Header { source_name: source_name.to_owned(), field, value, rule };
    header_fault(header).map_or(Ok(()), |found| Err(fault(found)))
}

/// How the bytes of a pixel are meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Layout {
    Grey,
    Grey16,
    Rgb,
    Bgr,
    Rgba,
    Bgra,
}

/// The encodings of `sensor_msgs/Image` that are read, with layout and bytes a pixel. Those that name but the type of
/// the channels come from `cv_bridge`, which passes OpenCV's matrices on: blue first.
const ENCODINGS: [(&str, Layout, u32); 10] = [
    ("mono8", Layout::Grey, 1),
    ("8UC1", Layout::Grey, 1),
    ("mono16", Layout::Grey16, 2),
    ("16UC1", Layout::Grey16, 2),
    ("rgb8", Layout::Rgb, 3),
    ("bgr8", Layout::Bgr, 3),
    ("8UC3", Layout::Bgr, 3),
    ("rgba8", Layout::Rgba, 4),
    ("bgra8", Layout::Bgra, 4),
    ("8UC4", Layout::Bgra, 4),
];

/// A frame as a picture, with its name and header.
#[derive(Debug, Clone)]
pub struct Picture {
    /// What identifies the frame.
    pub name: FrameName,
    /// Its header.
    pub header: Header,
    /// The pixels.
    pub pixels: DynamicImage,
    /// Hash of what came in.
    pub content: u64,
}

/// Reads a frame.
///
/// # Errors
/// [`FrameError`] names the field and the rule it breaks.
pub fn picture(frame: Frame) -> Result<Picture, FrameError> {
    match frame {
        Frame::Raw(topic, image) => {
            check_header(&topic, &image.header)?;
            let pixels = raw_pixels(&topic, &image)?;
            let name = FrameName::Stamp(topic, image.header.stamp.sec, image.header.stamp.nanosec);
            Ok(Picture { name, content: hash(&image.data), header: image.header, pixels })
        }
        Frame::Compressed(topic, image) => {
            check_header(&topic, &image.header)?;
            let pixels = decode(&topic, &image)?;
            let name = FrameName::Stamp(topic, image.header.stamp.sec, image.header.stamp.nanosec);
            Ok(Picture { name, content: hash(&image.data), header: image.header, pixels })
        }
        Frame::File(path) => read_file(&path),
    }
}

fn hash(data: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    data.hash(&mut hasher);
    hasher.finish()
}

fn check_size(source_name: &str, width: u32, height: u32) -> Result<(), FrameError> {
    let sides = 1..=MAX_SIDE_PX;
    if sides.contains(&width) && sides.contains(&height) && u64::from(width) * u64::from(height) <= MAX_AREA_PX {
        Ok(())
    } else {
        Err(FrameError::Size { source_name: source_name.to_owned(), width, height })
    }
}

fn raw_pixels(topic: &str, image: &Image) -> Result<DynamicImage, FrameError> {
    let (width, height, step) = (image.width, image.height, image.step);
    check_size(topic, width, height)?;
    let Some(&(_, layout, bytes)) = ENCODINGS.iter().find(|(name, ..)| *name == image.encoding) else {
        return Err(FrameError::Encoding { source_name: topic.to_owned(), encoding: shown(&image.encoding) });
    };
    let row_bytes = u64::from(width) * u64::from(bytes);
    if u64::from(step) < row_bytes {
        return Err(FrameError::Step { source_name: topic.to_owned(), step, least: row_bytes, width, bytes });
    }
    let least = u64::from(step) * u64::from(height);
    if (image.data.len() as u64) < least {
        return Err(FrameError::Data { source_name: topic.to_owned(), length: image.data.len(), least, step, height });
    }
    let rows = image.data.chunks_exact(step as usize).take(height as usize);
    let mut packed: Vec<u8> = Vec::with_capacity(row_bytes as usize * height as usize);
    rows.for_each(|row| packed.extend_from_slice(&row[..row_bytes as usize]));
    if matches!(layout, Layout::Bgr | Layout::Bgra) {
        packed.chunks_exact_mut(bytes as usize).for_each(|pixel| pixel.swap(0, 2));
    }
    let picture = match layout {
        Layout::Grey => GrayImage::from_raw(width, height, packed).map(DynamicImage::ImageLuma8),
        Layout::Grey16 => GrayImage::from_raw(width, height, stretched(&levels(&packed, image.is_bigendian != 0)))
            .map(DynamicImage::ImageLuma8),
        Layout::Rgb | Layout::Bgr => RgbImage::from_raw(width, height, packed).map(DynamicImage::ImageRgb8),
        Layout::Rgba | Layout::Bgra => RgbaImage::from_raw(width, height, packed).map(DynamicImage::ImageRgba8),
    };
    picture.ok_or_else(|| FrameError::Size { source_name: topic.to_owned(), width, height })
}

/// The numbers of 16 bits that bytes are.
fn levels(data: &[u8], big_endian: bool) -> Vec<u16> {
    let level = |pair: &[u8; 2]| if big_endian { u16::from_be_bytes(*pair) } else { u16::from_le_bytes(*pair) };
    data.as_chunks::<2>().0.iter().map(level).collect()
}

fn decode(topic: &str, image: &CompressedImage) -> Result<DynamicImage, FrameError> {
    let reader = ImageReader::new(std::io::Cursor::new(&image.data)).with_guessed_format();
    decoded(topic, reader.map_err(|e| undecodable(topic, e))?)
}

fn read_file(path: &Path) -> Result<Picture, FrameError> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let data = std::fs::read(path).map_err(|e| undecodable(&name, e))?;
    let reader = ImageReader::new(std::io::Cursor::new(&data)).with_guessed_format();
    let pixels = decoded(&name, reader.map_err(|e| undecodable(&name, e))?)?;
    // The file's own time, so that reading it again gives the same message.
    let age = std::fs::metadata(path).and_then(|m| m.modified()).ok().and_then(|t| t.duration_since(UNIX_EPOCH).ok());
    let stamp = age.map_or_else(Time::default, |age| Time {
        sec: i32::try_from(age.as_secs()).unwrap_or(i32::MAX),
        nanosec: age.subsec_nanos(),
    });
    let header = Header { stamp, frame_id: FILE_FRAME_ID.to_owned() };
    Ok(Picture { name: FrameName::File(name), header, content: hash(&data), pixels })
}

fn decoded<R: std::io::BufRead + std::io::Seek>(
    source_name: &str,
    mut reader: ImageReader<R>,
) -> Result<DynamicImage, FrameError> {
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(MAX_DECODER_MEMORY);
    reader.limits(limits);
    let picture = reader.decode().map_err(|e| undecodable(source_name, e))?;
    check_size(source_name, picture.width(), picture.height())?;
    Ok(picture)
}

fn undecodable(source_name: &str, reason: impl std::fmt::Display) -> FrameError {
    FrameError::Undecodable { source_name: source_name.to_owned(), reason: reason.to_string() }
}

/// The message of one piece.
pub fn piece_message(id: String, picture: &FrameHead, cutout: Cutout, metres_per_pixel: f64) -> PieceImage {
    let Aoi { x, y, width, height } = cutout.window;
    PieceImage {
        header: picture.header.clone(),
        id,
        source: picture.source.clone(),
        frame_width_px: picture.width,
        frame_height_px: picture.height,
        metres_per_pixel,
        aoi_x_px: cutout.aoi.x,
        aoi_y_px: cutout.aoi.y,
        aoi_width_px: cutout.aoi.width,
        aoi_height_px: cutout.aoi.height,
        image_x_px: x,
        image_y_px: y,
        piece_level: cutout.shape_level,
        ground_level: cutout.ground_level,
        noise_level: cutout.noise_level,
        image: Image {
            header: picture.header.clone(),
            height,
            width,
            encoding: "mono8".to_owned(),
            is_bigendian: 0,
            step: width,
            data: cutout.pixels,
        },
    }
}

/// What the messages of all pieces of a frame have in common.
#[derive(Debug, Clone)]
pub struct FrameHead {
    /// Header of the frame.
    pub header: Header,
    /// File name or topic.
    pub source: String,
    /// Columns of the frame.
    pub width: u32,
    /// Rows of the frame.
    pub height: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(encoding: &str, bytes: u32, pixels: &[u8]) -> Image {
        Image {
            height: 2,
            width: 2,
            encoding: encoding.to_owned(),
            step: 2 * bytes,
            data: pixels.to_vec(),
            ..Image::default()
        }
    }

    fn read(image: Image) -> Result<DynamicImage, FrameError> {
        picture(Frame::Raw("/image".to_owned(), image)).map(|p| p.pixels)
    }

    #[test]
    fn encodings_give_the_same_picture() {
        let rgb = [10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120];
        let swapped = [30, 20, 10, 60, 50, 40, 90, 80, 70, 120, 110, 100];
        let expected = read(image("rgb8", 3, &rgb)).unwrap().to_rgb8();
        assert_eq!(expected.as_raw(), &rgb);
        for encoding in ["bgr8", "8UC3"] {
            assert_eq!(read(image(encoding, 3, &swapped)).unwrap().to_rgb8(), expected, "{encoding}");
        }
        let with_alpha = |p: &[u8]| p.chunks(3).flat_map(|c| [c[0], c[1], c[2], 255]).collect::<Vec<_>>();
        assert_eq!(read(image("rgba8", 4, &with_alpha(&rgb))).unwrap().to_rgb8(), expected);
        for encoding in ["bgra8", "8UC4"] {
            assert_eq!(read(image(encoding, 4, &with_alpha(&swapped))).unwrap().to_rgb8(), expected, "{encoding}");
        }
    }

    #[test]
    fn sixteen_bits_are_stretched_in_either_byte_order() {
        let levels = [0_u16, 1000, 2000, 4000];
        let little: Vec<u8> = levels.iter().flat_map(|v| v.to_le_bytes()).collect();
        let big: Vec<u8> = levels.iter().flat_map(|v| v.to_be_bytes()).collect();
        let expected = [0, 63, 127, 255];
        for encoding in ["mono16", "16UC1"] {
            let big = Image { is_bigendian: 1, ..image(encoding, 2, &big) };
            assert_eq!(read(image(encoding, 2, &little)).unwrap().to_luma8().as_raw(), &expected, "{encoding}");
            assert_eq!(read(big).unwrap().to_luma8().as_raw(), &expected, "{encoding}");
        }
    }

    #[test]
    fn padding_at_the_end_of_rows_is_left_out() {
        let mut padded = image("mono8", 1, &[1, 2, 99, 3, 4, 99, 77]);
        padded.step = 3;
        assert_eq!(read(padded).unwrap().to_luma8().as_raw(), &[1, 2, 3, 4]);
    }

    #[test]
    fn nonsense_is_refused_by_field_and_rule() {
        let good = image("mono8", 1, &[1, 2, 3, 4]);
        let stamped = |sec, nanosec| Header { stamp: Time { sec, nanosec }, frame_id: String::new() };
        let named = |frame_id: String| Header { frame_id, ..Header::default() };
        let cases: [(Image, &str); 11] = [
            (Image { header: stamped(-1, 0), ..good.clone() }, "header.stamp.sec is -1: must be 0 or more"),
            (Image { header: stamped(1, u32::MAX), ..good.clone() }, "header.stamp.nanosec is 4294967295"),
            (Image { header: named("x".repeat(100_000)), ..good.clone() }, "header.frame_id is 'xxx"),
            (Image { header: named("a\nb".into()), ..good.clone() }, "without control characters"),
            (Image { width: 0, ..good.clone() }, "size 0x2"),
            (Image { height: u32::MAX, ..good.clone() }, "size 2x4294967295"),
            (Image { width: 30_000, height: 30_000, ..good.clone() }, "area at most"),
            (Image { encoding: "yuv422".into(), ..good.clone() }, "encoding 'yuv422': must be one of mono8"),
            (Image { step: 1, ..good.clone() }, "step 1: must be at least 2"),
            (Image { data: vec![1, 2, 3], ..good.clone() }, "data of 3 bytes: must be at least 4"),
            (Image { step: u32::MAX, ..good }, "data of 4 bytes"),
        ];
        for (bad, said) in cases {
            let message = read(bad).unwrap_err().to_string();
            assert!(message.contains(said) && message.starts_with("/image: "), "{message}");
            assert!(message.len() < 300 && !message.chars().any(char::is_control), "{message}");
        }
    }

    #[test]
    fn a_stamp_may_lie_years_back() {
        let old = Header { stamp: Time { sec: 0, nanosec: 1 }, frame_id: "camera".into() };
        assert!(read(Image { header: old, ..image("mono8", 1, &[1, 2, 3, 4]) }).is_ok());
    }

    #[test]
    fn files_that_are_no_pictures_are_refused() {
        let compressed = CompressedImage { format: "png".into(), data: b"text".to_vec(), ..CompressedImage::default() };
        let error = picture(Frame::Compressed("/image/compressed".into(), compressed)).unwrap_err();
        assert_eq!(error.kind(), "undecodable_picture");
        let missing = picture(Frame::File("/no/such.png".into())).unwrap_err().to_string();
        assert!(missing.starts_with("such.png: not a picture"), "{missing}");
    }

    #[test]
    fn png_and_jpeg_are_told_by_their_content() {
        let grey = DynamicImage::ImageLuma8(GrayImage::from_fn(16, 16, |x, _| image::Luma([(x * 16) as u8])));
        for format in [image::ImageFormat::Png, image::ImageFormat::Jpeg] {
            let mut data = std::io::Cursor::new(Vec::new());
            grey.write_to(&mut data, format).unwrap();
            let message =
                CompressedImage { format: "whatever".into(), data: data.into_inner(), ..CompressedImage::default() };
            let read = picture(Frame::Compressed("/image/compressed".into(), message)).unwrap();
            assert_eq!((read.pixels.width(), read.pixels.height()), (16, 16));
        }
    }
}
