//! Pictures in memory.

/// How the pixels of a frame are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    /// One byte a pixel.
    Grey,
    /// Three bytes a pixel; their order does not matter here.
    Rgb,
}

impl PixelFormat {
    /// Bytes of a pixel.
    pub(super) fn channels(self) -> usize {
        match self {
            Self::Grey => 1,
            Self::Rgb => 3,
        }
    }
}

/// A picture in memory, rows from top to bottom.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    pub(super) format: PixelFormat,
    pub(super) width: usize,
    pub(super) height: usize,
    stride: usize,
    pixels: &'a [u8],
}

/// Why a frame cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MaskError {
    /// No pixels, or too many to address.
    #[error("frame of {width} x {height} pixels: both must be from 1 to {MAX_SIDE}")]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The distance between rows is less than a row.
    #[error("stride of {stride} bytes is less than the {row} bytes of a row")]
    Stride {
        /// Bytes from one row to the next.
        stride: usize,
        /// Bytes of a row.
        row: usize,
    },
    /// Bytes are missing.
    #[error("frame holds {bytes} bytes: its size and stride need {needed}")]
    Bytes {
        /// Bytes there are.
        bytes: usize,
        /// Bytes needed.
        needed: usize,
    },
}

/// Largest side of a frame in pixels: coordinates are 32-bit, and 2^17 is beyond any camera or scanner.
pub const MAX_SIDE: u32 = 1 << 17;

impl<'a> Frame<'a> {
    /// A frame whose rows are `stride` bytes apart (the last one may be shorter).
    ///
    /// # Errors
    /// [`MaskError`] where size, stride and number of bytes do not fit each other.
    pub fn new(
        format: PixelFormat,
        width: u32,
        height: u32,
        stride: usize,
        pixels: &'a [u8],
    ) -> Result<Self, MaskError> {
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(MaskError::Size { width, height });
        }
        let row = width as usize * format.channels();
        if stride < row {
            return Err(MaskError::Stride { stride, row });
        }
        let needed = stride.saturating_mul(height as usize - 1).saturating_add(row);
        if pixels.len() < needed {
            return Err(MaskError::Bytes { bytes: pixels.len(), needed });
        }
        Ok(Self { format, width: width as usize, height: height as usize, stride, pixels })
    }

    /// A grey frame without gaps between rows.
    ///
    /// # Errors
    /// [`MaskError`] where size and number of bytes do not fit each other.
    pub fn grey(width: u32, height: u32, pixels: &'a [u8]) -> Result<Self, MaskError> {
        Self::new(PixelFormat::Grey, width, height, width as usize, pixels)
    }

    /// A colour frame without gaps between rows.
    ///
    /// # Errors
    /// [`MaskError`] where size and number of bytes do not fit each other.
    pub fn rgb(width: u32, height: u32, pixels: &'a [u8]) -> Result<Self, MaskError> {
        Self::new(PixelFormat::Rgb, width, height, 3 * width as usize, pixels)
    }

    /// Bytes of a row.
    pub(super) fn row(&self, y: usize) -> &'a [u8] {
        &self.pixels[y * self.stride..][..self.width * self.format.channels()]
    }
}
