//! Pieces cut out of a picture: its pixels in a form the segmentation takes, and what came of it in words.

use image::{DynamicImage, GrayImage, RgbImage};
use isthmus::mask::{self, Aoi, Segmentation, Segmenter};

/// 16-bit levels as 8-bit ones over the range they use: cameras of 10 to 14 bits fill but a part of the 16.
pub(super) fn stretched(levels: &[u16]) -> Vec<u8> {
    let (low, high) = levels.iter().fold((u16::MAX, 0), |(low, high), &v| (low.min(v), high.max(v)));
    let range = u32::from(high.saturating_sub(low)).max(1);
    levels.iter().map(|&v| (u32::from(v - low) * 255 / range) as u8).collect()
}

/// The pixels of a picture in a form the segmentation takes: grey, or red, green and blue.
#[derive(Debug)]
pub enum Pixels {
    /// One byte a pixel.
    Grey(GrayImage),
    /// Three bytes a pixel.
    Rgb(RgbImage),
}

impl From<DynamicImage> for Pixels {
    /// What is transparent is ground, whatever colour it has: of a picture that is transparent in parts only the transparency counts.
    fn from(image: DynamicImage) -> Self {
        let [width, height] = [image.width(), image.height()];
        if let Some(opacity) = opacity(&image) {
            return Self::Grey(opacity);
        }
        match image {
            DynamicImage::ImageLuma8(grey) => Self::Grey(grey),
            DynamicImage::ImageLumaA8(_) => Self::Grey(image.into_luma8()),
            DynamicImage::ImageLuma16(_) | DynamicImage::ImageLumaA16(_) => {
                let mut grey = GrayImage::new(width, height);
                grey.copy_from_slice(&stretched(&image.into_luma16()));
                Self::Grey(grey)
            }
            DynamicImage::ImageRgb16(_) | DynamicImage::ImageRgba16(_) => {
                let mut colour = RgbImage::new(width, height);
                colour.copy_from_slice(&stretched(&image.into_rgb16()));
                Self::Rgb(colour)
            }
            colour => Self::Rgb(colour.into_rgb8()),
        }
    }
}

/// Least part of a picture that is transparent where that means ground: the rounded corners of a window take less.
const MIN_TRANSPARENT: f64 = 0.02;
/// Alpha from which on a pixel counts as opaque: half.
const OPAQUE: u8 = 128;

/// The alpha channel of a picture that has opaque and transparent parts.
fn opacity(image: &DynamicImage) -> Option<GrayImage> {
    let alpha: Vec<u8> = match image {
        DynamicImage::ImageLumaA8(picture) => picture.pixels().map(|p| p.0[1]).collect(),
        DynamicImage::ImageRgba8(picture) => picture.pixels().map(|p| p.0[3]).collect(),
        _ if image.color().has_alpha() => image.to_rgba8().pixels().map(|p| p.0[3]).collect(),
        _ => return None,
    };
    let transparent = alpha.iter().filter(|a| **a < OPAQUE).count();
    let is_cut_out = transparent < alpha.len() && transparent as f64 >= MIN_TRANSPARENT * alpha.len() as f64;
    is_cut_out.then(|| GrayImage::from_raw(image.width(), image.height(), alpha)).flatten()
}

impl Pixels {
    /// Cuts the pieces out.
    ///
    /// # Errors
    /// Why there are none, in words.
    pub fn cut(&self, segmenter: &mut Segmenter) -> Result<Segmentation, String> {
        let frame = self.frame().map_err(|e| e.to_string())?;
        let segmentation = segmenter.segment(&frame, &mask::Parameters::default());
        if segmentation.cutouts.is_empty() { Err(why_empty(&segmentation)) } else { Ok(segmentation) }
    }

    /// The frame to cut out of.
    ///
    /// # Errors
    /// A size the segmentation can't address.
    pub fn frame(&self) -> Result<mask::Frame<'_>, mask::MaskError> {
        match self {
            Self::Grey(image) => mask::Frame::grey(image.width(), image.height(), image.as_raw()),
            Self::Rgb(image) => mask::Frame::rgb(image.width(), image.height(), image.as_raw()),
        }
    }
}

/// Why a segmentation has no cutout, in words.
fn why_empty(segmentation: &Segmentation) -> String {
    match segmentation.rejected.first() {
        None => "nothing stands out from the ground".to_owned(),
        Some(first) => format!(
            "{} thing(s) stand out from the ground, but none is taken for a piece; the first, at ({}, {}): {:?}",
            segmentation.rejected.len(),
            first.aoi.x,
            first.aoi.y,
            first.reason
        ),
    }
}

/// What is wrong with a segmentation, in words: pieces left out, pieces that had to be cut apart, pieces beside shadows, and borders that are not told all the way.
pub fn left_out(segmentation: &Segmentation) -> Vec<String> {
    let shape = |aoi: &Aoi| format!("the shape of {} x {} px at ({}, {})", aoi.width, aoi.height, aoi.x, aoi.y);
    let rejected = segmentation.rejected.iter().filter_map(|rejected| {
        // Specks, hairs and glare are no pieces: nothing is lost without them.
        let why = match rejected.reason {
            mask::Reason::CutByFrame => "is cut by the edge of the frame",
            mask::Reason::Touching => "is two pieces that touch",
            mask::Reason::Convex => "has neither tab nor blank, as the others have",
            _ => return None,
        };
        Some(format!("{} {why}; left out", shape(&rejected.aoi)))
    });
    let separated = segmentation.separated.iter().map(|aoi| {
        format!("{} is pieces that touch; cut apart, their borders are straight where they touched", shape(aoi))
    });
    let shaded = segmentation.shaded.len();
    let shaded = (shaded > 0).then(|| {
        format!("{shaded} shape(s) cast a shadow; where it lies beside them their borders are told less exactly")
    });
    let untold = segmentation.untold.first().map(|first| {
        format!(
            "{} shape(s) have a border that can't be told all the way (the first: {}): print of the ground's level, gloss, dirt or a shadow \
             lies there",
            segmentation.untold.len(),
            shape(first)
        )
    });
    rejected.chain(separated).chain(shaded).chain(untold).collect()
}

#[cfg(test)]
mod tests {
    use image::RgbaImage;

    use super::*;

    #[test]
    fn sixteen_bits_of_a_file_are_stretched_as_those_of_a_camera() {
        let grey = image::ImageBuffer::from_raw(2, 2, vec![0_u16, 1000, 2000, 4000]).map(DynamicImage::ImageLuma16);
        let Pixels::Grey(grey) = Pixels::from(grey.unwrap()) else { panic!("grey") };
        assert_eq!(grey.as_raw(), &[0, 63, 127, 255]);
        let colour = image::ImageBuffer::from_raw(2, 1, vec![0_u16, 1000, 2000, 4000, 0, 1000]);
        let Pixels::Rgb(colour) = Pixels::from(colour.map(DynamicImage::ImageRgb16).unwrap()) else { panic!("rgb") };
        assert_eq!(colour.as_raw(), &[0, 63, 127, 255, 0, 63]);
    }

    #[test]
    fn borders_that_are_not_told_are_named() {
        let aoi = Aoi { x: 5, y: 7, width: 120, height: 130 };
        let words = left_out(&Segmentation { untold: vec![aoi, aoi], ..Segmentation::default() });
        assert_eq!(words.len(), 1);
        assert!(
            words[0].starts_with("2 shape(s) have a border") && words[0].contains("120 x 130 px at (5, 7)"),
            "{words:?}"
        );
        assert!(left_out(&Segmentation::default()).is_empty());
    }

    #[test]
    fn transparency_is_ground_whatever_colour_it_hides() {
        /// A square of this opacity on a transparent ground, all of one colour.
        fn square(alpha: u8) -> DynamicImage {
            let is_within = |v: u32| (8..24).contains(&v);
            DynamicImage::ImageRgba8(RgbaImage::from_fn(32, 32, |x, y| {
                image::Rgba([90, 60, 30, if is_within(x) && is_within(y) { alpha } else { 0 }])
            }))
        }
        let shapes = |picture: DynamicImage| {
            let pixels = Pixels::from(picture);
            let segmentation = mask::segment(&pixels.frame().unwrap(), &mask::Parameters::default());
            segmentation.cutouts.iter().map(|c| (c.aoi.x, c.aoi.y, c.aoi.width, c.aoi.height)).collect::<Vec<_>>()
        };
        let expected = [(8, 8, 16, 16)];
        assert_eq!(shapes(square(255)), expected);
        let sixteen_bits = DynamicImage::ImageRgba16(square(255).into_rgba16());
        assert_eq!(shapes(sixteen_bits), expected);
        assert_eq!(shapes(DynamicImage::ImageLumaA8(square(255).into_luma_alpha8())), expected);
    }

    #[test]
    fn transparency_that_tells_no_parts_apart_is_passed_over() {
        let picture = |alpha: fn(u32) -> u8| {
            let pixel = |x: u32, y: u32| image::Rgba([x as u8, 2, 3, alpha(x + 100 * y)]);
            Pixels::from(DynamicImage::ImageRgba8(RgbaImage::from_fn(100, 100, pixel)))
        };
        let alphas: [fn(u32) -> u8; 3] = [|_| 255, |_| 0, |at| if at < 100 { 0 } else { 255 }];
        for alpha in alphas {
            let Pixels::Rgb(colour) = picture(alpha) else { panic!("rgb") };
            assert_eq!(colour.get_pixel(7, 50).0, [7, 2, 3]);
        }
    }
}
