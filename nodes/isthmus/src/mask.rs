//! Segmentation of a frame into shapes.
//!
//! # Method
//! 1. *Ground*: the frame is averaged over small blocks; the class of blocks (N. Otsu, 1979) that prevails along the rim is
//!    ground, and a quadratic surface through it follows uneven light. Shapes may be darker, brighter or of another colour. Where
//!    the rim does not tell (a tight crop round a shape), both classes are tried, and the one that gives
//!    whole shapes is right.
//! 2. *Blocks that stand out* from the ground by more than its scatter are joined to connected components. The threshold is
//!    near the ground, so that dark print on dark ground still belongs to its shape.
//! 3. *Pixels*: about each component the frame is cut out, in a form in which half-way between two fixed levels is half-way
//!    between the shape's own level near the border and the ground's: as it is, where both are uniform, else
//!    divided by the local contrast. Pixels beyond half-way are joined to components once more: neighbours whose shadows
//!    or glow met come apart.
//! 4. *Rejection*, each with its [`Reason`]: cut by the frame's edge, too small beside the others, thread-like (hairs,
//!    scanner edges), faint (glare), two shapes that touch (of about twice the usual area, with an isthmus between the halves). Where that
//!    isthmus is too narrow to be the neck of one of them they are cut apart instead ([`Segmentation::separated`]).
//!
//! # Cost
//! Linear in the number of pixels; memory linear as well, since thread-like components are never cut out.
//!
//! # Failure
//! [`MaskError`] for a frame that is inconsistent. A frame without shapes gives an empty list.
//!
//! ```
//! use isthmus::mask::{Frame, segment};
//! let mut pixels = vec![200u8; 64 * 64];
//! for y in 20..44 {
//!     pixels[y * 64 + 16..y * 64 + 48].fill(30);
//! }
//! let segmentation = segment(&Frame::grey(64, 64, &pixels)?, &Default::default());
//! let [cutout] = &segmentation.cutouts[..] else { panic!("one shape") };
//! assert_eq!((cutout.aoi.x, cutout.aoi.y, cutout.aoi.width, cutout.aoi.height), (16, 20, 32, 24));
//! # Ok::<(), isthmus::mask::MaskError>(())
//! ```

mod ground;
mod runs;

use ground::{Blocks, Ground, median, quantile};
pub(crate) use runs::changes;
use runs::{Component, Components};

use crate::Point;
use crate::contour::Border;
use crate::isthmus::{self, Polarity};
use crate::skeleton::Triangulation;

/// A rectangle of whole pixels of the source frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Aoi {
    /// Left column.
    pub x: i32,
    /// Top row.
    pub y: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// One shape cut out of a frame: an 8-bit picture in which nothing but this shape differs from the ground.
#[derive(Debug, Clone, PartialEq)]
pub struct Cutout {
    /// Bounding box of the shape in the source frame.
    pub aoi: Aoi,
    /// Where the picture lies in the source frame: the AOI and a margin (it may reach beyond the frame).
    pub window: Aoi,
    /// Grey levels, row by row, `window.width * window.height` of them.
    pub pixels: Vec<u8>,
    /// Grey level of the shape.
    pub shape_level: f32,
    /// Grey level of the ground.
    pub ground_level: f32,
    /// Standard deviation of the grey levels.
    pub noise_level: f32,
}

/// How the pixels of a frame are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelFormat {
    /// One byte a pixel.
    Grey,
    /// Three bytes a pixel; their order does not matter here.
    Rgb,
}

/// A picture in memory, rows from top to bottom.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    format: PixelFormat,
    width: usize,
    height: usize,
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

    fn row(&self, y: usize) -> &'a [u8] {
        &self.pixels[y * self.stride..][..self.width * self.format.channels()]
    }
}

/// What a shape must be like to be accepted.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Parameters {
    /// Least area in pixels. Default 256: the smallest real pieces with a measurable outline (16 px across).
    pub min_area: usize,
    /// Least area as a part of the frame's typical shape (the one that half of all shape area is in shapes at least as
    /// large as). Default 0.2: pieces of one puzzle differ by less; printed labels and crumbs are smaller.
    pub min_relative_area: f64,
    /// Least contrast as a part of the frame's typical shape. Default 0.2: glare and shadows have less.
    pub min_relative_contrast: f64,
    /// Least part of its bounding box that a shape fills. Default 0.08: hairs and scanner edges fill less.
    pub min_fill: f64,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { min_area: 256, min_relative_area: 0.2, min_relative_contrast: 0.2, min_fill: 0.08 }
    }
}

/// Why something that differs from the ground is not taken for a shape.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Reason {
    /// The frame's edge cuts it.
    CutByFrame,
    /// It is too small, by itself or beside the other shapes.
    Small,
    /// It is a thread: a hair, the edge of the scanner's glass.
    Thread,
    /// It differs far less from the ground than the other shapes: glare, a shadow.
    Faint,
    /// Two shapes touch.
    Touching,
}

/// Something that differs from the ground and is not taken for a shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rejected {
    /// Its bounding box.
    pub aoi: Aoi,
    /// Its area in pixels.
    pub area: usize,
    /// Why.
    pub reason: Reason,
}

/// What a frame shows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Segmentation {
    /// The shapes, in reading order of the top left corners of their bounding boxes.
    pub cutouts: Vec<Cutout>,
    /// What was left out, specks of less than [`MIN_REPORTED_AREA`] pixels aside, in the same order.
    pub rejected: Vec<Rejected>,
    /// Bounding boxes of shapes that touched and were cut apart, in the same order; their border is a straight line where they
    /// touched.
    pub separated: Vec<Aoi>,
}

/// Specks smaller than this, in pixels, are not reported: noise and dust make any number of them.
pub const MIN_REPORTED_AREA: usize = 64;

/// Pixels of ground round a shape in its cutout: room for the blur that the contour may need.
const MARGIN: usize = 8;
/// Greatest contrast of a cutout that had to be divided by the local contrast, in grey levels: shape and ground keep some room.
const MAX_DIVIDED_CONTRAST: f32 = 180.0;
/// Standard deviations of noise for which there is room beyond the levels of such a cutout: clipping is a bias.
const DIVIDED_ROOM: f32 = 4.0;
/// Most spread of the shape's level (between its quartiles, noise aside), as a part of the contrast, at which the pixels are cut out
/// as they are: the contour half-way moves by a thirtieth of the edge's blur at most.
const UNIFORM: f32 = 0.06;
/// Most difference of the ground's level round a shape, as a part of the contrast, at which the pixels are cut out as they are.
const UNIFORM_GROUND: f32 = 0.06;
/// Depth of the blocks all of whose neighbours belong to the shape.
const INNER_DEPTH: u8 = 2;
/// Greatest depth that is told apart, in blocks: beyond the blur of any edge worth measuring.
const MAX_DEPTH: u8 = 7;
/// The blur of the edge is left behind where the median level of blocks is this part of that of the blocks next deeper.
const SETTLED: f32 = 0.985;
/// Most noise of the map of local contrasts, as a part of the contrast: it moves the contour by a hundredth of the edge's blur.
const MAP_NOISE: f32 = 0.004;
/// A shape alone in the frame may touch the edges if it spans this part of the frame in both directions: then the frame
/// was cropped to the shape.
const TIGHT_SPAN: f64 = 0.9;
/// ... and if it covers at most this part of the frame's rim.
const TIGHT_CONTACT: f64 = 0.6;
/// ... and has this part of all the area that stands out.
const TIGHT_SHARE: f64 = 0.9;
/// How many blocks beyond its border a shape's levels matter: the blur of its edge, and the interpolation.
const BORDER_BLOCKS: usize = 3;
/// Neighbours of a shape smaller than this, in pixels, stay in its cutout: noise makes them of the outer half of a blurred edge, and
/// without them, as without the holes in its inner half, the edge would lie elsewhere.
const MIN_ERASED: usize = 16;
/// Most differences of neighbouring pixels looked at to measure the noise: beyond, the figure gets no better.
const NOISE_SAMPLES: usize = 2_000;
/// Blocks of a shape looked at to measure its levels, roughly: beyond, medians get no better.
const LEVEL_SAMPLES: usize = 1_000;

/// Least number of shapes in a frame whose median area says what one shape has.
const TOUCHING_SHAPES: usize = 3;
/// Least area of two shapes that touch, in median areas: the two smallest pieces of a puzzle are larger together.
const TOUCHING_AREA: f64 = 1.5;
/// Least area of each of the two, in median areas.
const TOUCHING_LOBE: f64 = 0.5;
/// Greatest width of the place where two shapes touch, as a part of the square root of the median area: the neck of a tab
/// that reaches into the other's blank is not wider.
const TOUCHING_WIDTH: f64 = 0.35;
/// Greatest width of such a place at which the two are cut apart, as a part of the same: the necks of tabs are wider, and cut there the one
/// would keep the other's tab.
const SEPARABLE_WIDTH: f64 = 0.1;
/// Half the width of the cut between two shapes, in pixels: pixels on either side of it are no neighbours.
const CUT: f64 = 1.0;

/// Finds the shapes of a frame.
#[must_use]
pub fn segment(frame: &Frame<'_>, parameters: &Parameters) -> Segmentation {
    Segmenter::default().segment(frame, parameters)
}

/// Finds shapes, keeping its buffers from one frame to the next.
#[derive(Debug, Clone, Default)]
pub struct Segmenter {
    blocks: Blocks,
    coarse: Components,
    fine: Components,
    /// For each block the coarse component that owns it, or [`NOBODY`]: its blocks and those next to them.
    owner: Vec<u32>,
    residual: Vec<f32>,
    crop: Crop,
}

const NOBODY: u32 = u32::MAX;

/// The surroundings of a coarse component.
#[derive(Debug, Clone, Default)]
struct Crop {
    x: i32,
    y: i32,
    width: usize,
    height: usize,
    pixels: Vec<u8>,
    shape_level: f32,
    ground_level: f32,
    noise_level: f32,
    /// Contrast in the grey levels of the frame.
    contrast: f32,
}

impl Segmenter {
    /// Finds the shapes of a frame.
    #[must_use]
    pub fn segment(&mut self, frame: &Frame<'_>, parameters: &Parameters) -> Segmentation {
        self.blocks.fill(frame);
        let mut best: Option<(usize, Segmentation)> = None;
        for candidate in ground::candidates(&self.blocks) {
            let ground = ground::fit(&self.blocks, candidate, std::mem::take(&mut self.residual));
            let segmentation = self.shapes(frame, &ground, parameters);
            self.residual = ground.residual;
            let area = segmentation.cutouts.iter().map(|c| c.aoi.width as usize * c.aoi.height as usize).sum();
            if best.as_ref().is_none_or(|(most, _)| area > *most) {
                best = Some((area, segmentation));
            }
        }
        best.map(|(_, segmentation)| segmentation).unwrap_or_default()
    }

    /// Finds the shapes that stand out from a ground.
    fn shapes(&mut self, frame: &Frame<'_>, ground: &Ground, parameters: &Parameters) -> Segmentation {
        let columns = self.blocks.columns;
        self.coarse.clear();
        for (row, residual) in ground.residual.chunks_exact(columns).enumerate() {
            self.coarse.begin_row(row);
            self.coarse.add_row(residual, |r| r > ground.threshold);
        }
        self.coarse.close();
        self.claim_blocks();

        let mut found: Vec<Found> = Vec::new();
        let mut rejected = Vec::new();
        let block = self.blocks.size;
        for k in 0..self.coarse.list.len() {
            let c = self.coarse.list[k];
            let area = c.area * block * block;
            let aoi = Aoi {
                x: (c.left * block) as i32,
                y: (c.top * block) as i32,
                width: ((c.right - c.left) * block).min(frame.width - c.left * block) as u32,
                height: ((c.bottom - c.top) * block).min(frame.height - c.top * block) as u32,
            };
            let box_area = aoi.width as usize * aoi.height as usize;
            let thread = (area as f64) < parameters.min_fill * box_area as f64;
            if area < parameters.min_area || thread {
                if area >= MIN_REPORTED_AREA {
                    rejected.push(Rejected { aoi, area, reason: if thread { Reason::Thread } else { Reason::Small } });
                }
                continue;
            }
            self.cut_out(frame, ground, k);
            self.crop.label(&mut self.fine);
            self.collect(frame, parameters, &mut found, &mut rejected);
        }
        sift(frame, parameters, found, rejected)
    }

    /// Makes every coarse component own its blocks and the free ones next to them.
    fn claim_blocks(&mut self) {
        let (columns, rows) = (self.blocks.columns, self.blocks.rows);
        self.owner.clear();
        self.owner.resize(columns * rows, NOBODY);
        for run in &self.coarse.runs {
            let label = run.label as u32;
            self.owner[run.row * columns + run.start..run.row * columns + run.end].fill(label);
        }
        for run in &self.coarse.runs {
            let label = run.label as u32;
            for row in run.row.saturating_sub(1)..rows.min(run.row + 2) {
                let (start, end) = (run.start.saturating_sub(1), columns.min(run.end + 1));
                for owner in &mut self.owner[row * columns + start..row * columns + end] {
                    *owner = if *owner == NOBODY { label } else { *owner };
                }
            }
        }
    }

    /// Cuts a coarse component's surroundings out of the frame into `self.crop`.
    fn cut_out(&mut self, frame: &Frame<'_>, ground: &Ground, k: usize) {
        let c = self.coarse.list[k];
        let (block, columns) = (self.blocks.size, self.blocks.columns);
        let levels = self.levels(ground, k);
        let crop = &mut self.crop;
        let margin = MARGIN + block;
        let rows = RowSource { frame, ground, block };
        (crop.x, crop.y) = ((c.left * block) as i32 - margin as i32, (c.top * block) as i32 - margin as i32);
        crop.width = (c.right - c.left) * block + 2 * margin;
        crop.height = (c.bottom - c.top) * block + 2 * margin;
        crop.contrast = levels.contrast;
        let plain = levels.uniform && frame.format == PixelFormat::Grey;
        if plain {
            crop.ground_level = levels.ground;
            // A sum of rounded numbers; a level is one of the 8-bit scale.
            crop.shape_level = (levels.ground + levels.sense * levels.contrast).clamp(0.0, 255.0);
        } else if levels.uniform {
            (crop.shape_level, crop.ground_level) = (levels.contrast, 0.0);
        } else {
            // Half the contrast and the room above it fill half the scale.
            let noise = ground.scatter * block as f32 / levels.contrast.max(f32::MIN_POSITIVE);
            let contrast = (127.5 / (0.5 + DIVIDED_ROOM * noise)).min(MAX_DIVIDED_CONTRAST);
            (crop.shape_level, crop.ground_level) = (127.5 + contrast / 2.0, 127.5 - contrast / 2.0);
        }
        let ground_pixel = crop.ground_level.round().clamp(0.0, 255.0) as u8;
        crop.pixels.clear();
        crop.pixels.resize(crop.width * crop.height, ground_pixel);
        let label = k as u32;
        for (row, out) in crop.pixels.chunks_exact_mut(crop.width).enumerate() {
            let y = crop.y + row as i32;
            if y < 0 || y >= frame.height as i32 {
                continue;
            }
            let y = y as usize;
            let from = crop.x.max(0) as usize;
            let to = frame.width.min((crop.x + crop.width as i32) as usize);
            let out = &mut out[(from as i32 - crop.x) as usize..][..to - from];
            let source = frame.row(y);
            let owners = &self.owner[y / block * columns..][..columns];
            if plain {
                out.copy_from_slice(&source[from..to]);
            } else {
                levels.fill_row(&rows, (y, from), out, [crop.shape_level, crop.ground_level]);
            }
            // What belongs to other components is made ground.
            let within = from / block..to.div_ceil(block);
            let is_foreign = |owner: u32| owner != label && owner != NOBODY;
            if owners[within.clone()].iter().fold(0, |count, owner| count + u32::from(is_foreign(*owner))) == 0 {
                continue;
            }
            for (column, owner) in within.clone().zip(&owners[within]) {
                if is_foreign(*owner) {
                    let (start, end) = ((column * block).max(from), ((column + 1) * block).min(to));
                    out[start - from..end - from].fill(ground_pixel);
                }
            }
        }
        self.crop.noise_level = self.noise(ground, k);
    }

    /// Levels of a coarse component and of the ground round it.
    fn levels(&self, ground: &Ground, k: usize) -> Levels {
        let c = self.coarse.list[k];
        let columns = self.blocks.columns;
        let surface = |column: usize, row: usize| -> f32 {
            ground.surfaces.first().map_or(0.0, |s| s.at(column as f64, row as f64))
        };
        let middle_block = ((c.left + c.right) / 2, (c.top + c.bottom) / 2);
        let corners = [(c.left, c.top), (c.right, c.top), (c.left, c.bottom), (c.right, c.bottom), middle_block]
            .map(|(column, row)| surface(column, row));
        let (low, high) = corners.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        let grey = self.blocks.planes.len() == 1;
        let step = (((c.area / LEVEL_SAMPLES) as f64).sqrt() as usize).max(1);
        let mut levels = Levels {
            left: c.left,
            top: c.top,
            width: c.right - c.left,
            height: c.bottom - c.top,
            ground: corners.iter().sum::<f32>() / corners.len() as f32,
            ..Levels::default()
        };
        // A block all of whose neighbours belong to the component, those beyond the frame included.
        let inside = |column: usize, row: usize| -> bool {
            self.is_of(ground, k, column, row)
                && (row.saturating_sub(1)..self.blocks.rows.min(row + 2))
                    .all(|r| (column.saturating_sub(1)..columns.min(column + 2)).all(|c| self.is_of(ground, k, c, r)))
        };
        let mut list = Vec::new();
        let mut signed = Vec::new();
        let blocks_in = |step: usize| {
            (c.top..c.bottom).step_by(step).flat_map(move |r| (c.left..c.right).step_by(step).map(move |c| (c, r)))
        };
        for (column, row) in blocks_in(step).filter(|(column, row)| inside(*column, *row)) {
            let block = row * columns + column;
            list.push(ground.residual[block]);
            if grey {
                signed.push(self.blocks.planes[0][block] - surface(column, row));
            }
        }
        levels.take_sense(&signed, grey);
        levels.take_contrast(&mut list, ground.scatter);
        levels.uniform &= high - low <= UNIFORM_GROUND * levels.contrast && (levels.one_sided || !grey);
        if !list.is_empty() && levels.uniform {
            return levels;
        }
        // The edge's blur reaches some blocks deep: the shape's own level is found beyond it.
        let depths = self.depths(ground, k);
        let settled = settled_depth(&depths, |i| {
            ground.residual[(c.top + i / levels.width) * columns + c.left + i % levels.width]
        });
        list.clear();
        let residual = blocks_in(1).map(|(column, row)| ground.residual[row * columns + column]);
        levels.map.extend(residual.zip(&depths).map(|(r, depth)| if *depth >= settled { r } else { 0.0 }));
        list.extend(levels.map.iter().filter(|r| **r > 0.0));
        let is_thin = settled < INNER_DEPTH;
        if is_thin {
            // Thinner than three blocks: the strongest blocks are the best there is.
            let top = quantile(&mut list, 0.9);
            list = vec![top];
        }
        levels.take_contrast(&mut list, ground.scatter);
        levels.uniform &= high - low <= UNIFORM_GROUND * levels.contrast && (levels.one_sided || !grey);
        if levels.uniform || is_thin {
            levels.map.fill(levels.contrast);
        } else {
            let noise = ground.scatter / levels.contrast.max(f32::MIN_POSITIVE);
            levels.spread_out(2.0 * ground.threshold, usize::from(settled) + BORDER_BLOCKS, noise);
        }
        levels
    }

    /// Whether a block belongs to a coarse component itself, rather than to its surroundings.
    fn is_of(&self, ground: &Ground, k: usize, column: usize, row: usize) -> bool {
        let block = row * self.blocks.columns + column;
        self.owner[block] == k as u32 && ground.residual[block] > ground.threshold
    }

    /// How many blocks deep within a coarse component each block of its box lies (1 along its border, 0 outside of it), up to
    /// [`MAX_DEPTH`]; what lies beyond the frame counts as within.
    fn depths(&self, ground: &Ground, k: usize) -> Vec<u8> {
        let c = self.coarse.list[k];
        let (width, height) = (c.right - c.left, c.bottom - c.top);
        let mut depths = vec![0; width * height];
        for run in self.coarse.runs.iter().filter(|run| run.label == k) {
            for column in run.start..run.end {
                if self.is_of(ground, k, column, run.row) {
                    depths[(run.row - c.top) * width + column - c.left] = MAX_DEPTH;
                }
            }
        }
        let (left, top) = (c.left > 0, c.top > 0);
        let (right, bottom) = (c.right < self.blocks.columns, c.bottom < self.blocks.rows);
        // Distance along rows, columns and diagonals: one pass forward over the neighbours that come before, one back.
        let relax = |depths: &mut [u8], x: usize, y: usize, sense: isize| {
            let at = y * width + x;
            if depths[at] == 0 {
                return;
            }
            for (dx, dy) in [(-1, 0), (-1, -1), (0, -1), (1, -1)] {
                let (u, v) = (x as isize + sense * dx, y as isize + sense * dy);
                let open = (u < 0 && left)
                    || (u >= width as isize && right)
                    || (v < 0 && top)
                    || (v >= height as isize && bottom);
                let before = if open {
                    0
                } else if u < 0 || v < 0 || u >= width as isize || v >= height as isize {
                    MAX_DEPTH
                } else {
                    depths[v as usize * width + u as usize]
                };
                depths[at] = depths[at].min(before + 1);
            }
        };
        for y in 0..height {
            for x in 0..width {
                relax(&mut depths, x, y, 1);
            }
        }
        for y in (0..height).rev() {
            for x in (0..width).rev() {
                relax(&mut depths, x, y, -1);
            }
        }
        depths
    }

    /// Standard deviation of the grey levels of `self.crop`, from differences of neighbouring pixels, in shape and ground; the larger.
    fn noise(&self, ground: &Ground, k: usize) -> f32 {
        /// Lower quartile and median of the absolute difference of two normal numbers, in standard deviations.
        const QUARTILE: f32 = 0.450_6;
        const MEDIAN: f32 = 0.953_9;
        let crop = &self.crop;
        let (block, columns) = (self.blocks.size, self.blocks.columns);
        let (mut shape, mut clear) = (Vec::new(), Vec::new());
        let step = (crop.width * crop.height / NOISE_SAMPLES).max(1);
        for at in (0..crop.pixels.len() - 1).step_by(step) {
            let (x, y) = (crop.x + (at % crop.width) as i32, crop.y + (at / crop.width) as i32);
            let (column, row) = (x.max(0) as usize / block, y.max(0) as usize / block);
            if x < 0 || y < 0 || column >= columns || row >= self.blocks.rows || (at + 1) % crop.width == 0 {
                continue;
            }
            let here = row * columns + column;
            let (before, after) = (column.saturating_sub(1), (column + 1).min(columns - 1));
            let neighbours = [row * columns + before, row * columns + after, row.saturating_sub(1) * columns + column];
            let stands_out = |b: &usize| ground.residual[*b] > ground.threshold;
            let difference = f32::from(crop.pixels[at].abs_diff(crop.pixels[at + 1]));
            if stands_out(&here) && self.owner[here] == k as u32 && neighbours.iter().all(stands_out) {
                shape.push(difference);
            } else if self.owner[here] == NOBODY {
                clear.push(difference);
            }
        }
        // Print and texture are not noise: half of a shape is free of them.
        (quantile(&mut shape, 0.25) / QUARTILE).max(median(clear) / MEDIAN)
    }

    /// Takes the components of `self.crop` over, each as a cutout, or among the rejected.
    fn collect(
        &self,
        frame: &Frame<'_>,
        parameters: &Parameters,
        found: &mut Vec<Found>,
        rejected: &mut Vec<Rejected>,
    ) {
        let crop = &self.crop;
        for (index, c) in self.fine.list.iter().enumerate() {
            let aoi = crop.aoi(c);
            let box_area = aoi.width as usize * aoi.height as usize;
            let reason = if (c.area as f64) < parameters.min_fill * box_area as f64 {
                Some(Reason::Thread)
            } else if c.area < parameters.min_area {
                Some(Reason::Small)
            } else {
                None
            };
            if let Some(reason) = reason {
                if c.area >= MIN_REPORTED_AREA {
                    rejected.push(Rejected { aoi, area: c.area, reason });
                }
                continue;
            }
            let contact = self.rim_contact(frame, index);
            let cutout = crop.cutout(&self.fine, index);
            found.push(Found { cutout, area: c.area, contact, contrast: crop.contrast });
        }
    }

    /// Number of pixels of a fine component on the frame's rim.
    fn rim_contact(&self, frame: &Frame<'_>, index: usize) -> usize {
        let crop = &self.crop;
        let runs = self.fine.runs.iter().filter(|r| r.label == index);
        runs.map(|r| {
            let y = crop.y + r.row as i32;
            if y == 0 || y == frame.height as i32 - 1 {
                r.end - r.start
            } else {
                usize::from(crop.x + r.start as i32 == 0) + usize::from(crop.x + r.end as i32 == frame.width as i32)
            }
        })
        .sum()
    }
}

impl Crop {
    /// Connects the pixels that are beyond half-way from ground to shape.
    fn label(&self, components: &mut Components) {
        let level = (self.shape_level + self.ground_level) / 2.0;
        components.clear();
        for (y, row) in self.pixels.chunks_exact(self.width).enumerate() {
            components.begin_row(y);
            if self.shape_level > self.ground_level {
                let least = level.floor() as u8;
                components.add_row(row, |p| p > least);
            } else {
                let most = level.ceil() as u8;
                components.add_row(row, |p| p < most);
            }
        }
        components.close();
    }

    /// Bounding box of a component in the source frame.
    fn aoi(&self, c: &Component) -> Aoi {
        Aoi {
            x: self.x + c.left as i32,
            y: self.y + c.top as i32,
            width: (c.right - c.left) as u32,
            height: (c.bottom - c.top) as u32,
        }
    }

    /// Grey level of ground.
    fn ground_pixel(&self) -> u8 {
        self.ground_level.round().clamp(0.0, 255.0) as u8
    }

    /// The part round a component, all others made ground.
    fn cutout(&self, components: &Components, index: usize) -> Cutout {
        let c = &components.list[index];
        let (left, top) = (c.left.saturating_sub(MARGIN), c.top.saturating_sub(MARGIN));
        let (right, bottom) =
            (self.width.min(c.right + MARGIN), (self.pixels.len() / self.width).min(c.bottom + MARGIN));
        let width = right - left;
        let mut pixels = Vec::with_capacity(width * (bottom - top));
        for y in top..bottom {
            pixels.extend_from_slice(&self.pixels[y * self.width + left..y * self.width + right]);
        }
        let ground = self.ground_pixel();
        let is_erased = |label: usize| label != index && components.list[label].area >= MIN_ERASED;
        for run in components.runs.iter().filter(|r| is_erased(r.label) && (top..bottom).contains(&r.row)) {
            let (start, end) = (run.start.clamp(left, right), run.end.clamp(left, right));
            pixels[(run.row - top) * width + start - left..(run.row - top) * width + end - left].fill(ground);
        }
        Cutout {
            aoi: self.aoi(c),
            window: Aoi {
                x: self.x + left as i32,
                y: self.y + top as i32,
                width: width as u32,
                height: (bottom - top) as u32,
            },
            pixels,
            shape_level: self.shape_level,
            ground_level: self.ground_level,
            noise_level: self.noise_level,
        }
    }

    /// Makes ground of the pixels along a line, so that what lies on either side comes apart.
    fn cut(&mut self, [from, to]: [Point; 2]) {
        let local = |p: Point| Point::new(p.x - f64::from(self.x), p.y - f64::from(self.y));
        let (from, to) = (local(from), local(to));
        let ground = self.ground_pixel();
        let (low, high) = (from.inf(&to), from.sup(&to));
        let rows = self.pixels.len() / self.width;
        let range = |low: f64, high: f64, count: usize| {
            let first = (low - CUT).floor().clamp(0.0, count as f64) as usize;
            first..((high + CUT).ceil() + 1.0).clamp(0.0, count as f64) as usize
        };
        let along = to - from;
        for y in range(low.y, high.y, rows) {
            for x in range(low.x, high.x, self.width) {
                let to = Point::new(x as f64, y as f64) - from;
                let t = (to.dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
                if (to - along * t).norm() <= CUT {
                    self.pixels[y * self.width + x] = ground;
                }
            }
        }
    }
}

/// A shape that may still be rejected beside the others.
struct Found {
    cutout: Cutout,
    area: usize,
    contact: usize,
    contrast: f32,
}

/// Rejects what is cut by the frame, or small or faint beside the other shapes.
fn sift(frame: &Frame<'_>, parameters: &Parameters, found: Vec<Found>, mut rejected: Vec<Rejected>) -> Segmentation {
    let total: usize = found.iter().map(|f| f.area).sum();
    let mut by_area: Vec<(usize, f32)> = found.iter().map(|f| (f.area, f.contrast)).collect();
    by_area.sort_unstable_by_key(|f| f.0);
    let mut above = total;
    let typical_area = by_area
        .iter()
        .find(|f| {
            above -= f.0;
            above * 2 <= total
        })
        .map_or(0, |f| f.0);
    let typical_contrast = median(by_area.iter().filter(|f| 2 * f.0 >= typical_area).map(|f| f.1).collect());
    // The lower median, small fry aside: of three shapes two of which touch, a single one.
    let usual: Vec<usize> = by_area
        .iter()
        .map(|f| f.0)
        .filter(|a| *a as f64 >= parameters.min_relative_area * typical_area as f64)
        .collect();
    let median_area = if usual.len() < TOUCHING_SHAPES { usize::MAX } else { usual[(usual.len() - 1) / 2] };
    let rim = 2 * (frame.width + frame.height);
    let mut cutouts = Vec::new();
    let mut separated = Vec::new();
    let mut open = found;
    while let Some(f) = open.pop() {
        let aoi = f.cutout.aoi;
        let tight = f64::from(aoi.width) >= TIGHT_SPAN * frame.width as f64
            && f64::from(aoi.height) >= TIGHT_SPAN * frame.height as f64
            && f.contact as f64 <= TIGHT_CONTACT * rim as f64
            && f.area as f64 >= TIGHT_SHARE * total as f64;
        let reason = if (f.area as f64) < parameters.min_relative_area * typical_area as f64 {
            Some(Reason::Small)
        } else if f64::from(f.contrast) < parameters.min_relative_contrast * f64::from(typical_contrast) {
            Some(Reason::Faint)
        } else if f.contact > 0 && !tight {
            Some(Reason::CutByFrame)
        } else if f.area as f64 >= TOUCHING_AREA * median_area as f64
            && let Some(contact) = contact(&f.cutout, median_area as f64)
        {
            let parts = part(&f, contact, median_area as f64);
            if parts.is_empty() {
                Some(Reason::Touching)
            } else {
                separated.push(aoi);
                open.extend(parts);
                continue;
            }
        } else {
            None
        };
        match reason {
            Some(reason) => rejected.push(Rejected { aoi, area: f.area, reason }),
            None => cutouts.push(f.cutout),
        }
    }
    separated.sort_by_key(|aoi| (aoi.y, aoi.x));
    cutouts.sort_by_key(|c| (c.aoi.y, c.aoi.x));
    rejected.sort_by_key(|r| (r.aoi.y, r.aoi.x));
    Segmentation { cutouts, rejected, separated }
}

/// The narrowest place at which two shapes of about a given area each touch: an isthmus with most of a shape on either side.
fn contact(cutout: &Cutout, area: f64) -> Option<[Point; 2]> {
    let (border, noise) = Border::from_cutout(cutout).ok()?;
    let triangulation = Triangulation::new(&border).ok()?;
    let whole = border.area();
    let joins_two = |i: &isthmus::Isthmus| {
        let count = (i.path_length / border.spacing).ceil() as usize + 1;
        let lobe = Border { points: border.sample(i.arc, 0.0, count), spacing: border.spacing }.area();
        i.polarity == Polarity::Positive
            && i.width <= TOUCHING_WIDTH * area.sqrt()
            && lobe.min(whole - lobe) >= TOUCHING_LOBE * area
    };
    let contacts = isthmus::find(&border, &triangulation, noise).into_iter().filter(joins_two);
    contacts.min_by(|a, b| a.width.total_cmp(&b.width)).map(|i| i.critical_points)
}

/// Cuts a shape apart at a contact, if that is so narrow that it is no neck; the parts, none if they do not come apart.
fn part(found: &Found, contact: [Point; 2], area: f64) -> Vec<Found> {
    if (contact[1] - contact[0]).norm() > SEPARABLE_WIDTH * area.sqrt() {
        return Vec::new();
    }
    let cutout = &found.cutout;
    let mut crop = Crop {
        x: cutout.window.x,
        y: cutout.window.y,
        width: cutout.window.width as usize,
        pixels: cutout.pixels.clone(),
        shape_level: cutout.shape_level,
        ground_level: cutout.ground_level,
        noise_level: cutout.noise_level,
        ..Crop::default()
    };
    crop.cut(contact);
    let mut components = Components::default();
    crop.label(&mut components);
    let large = |index: &usize| components.list[*index].area as f64 >= TOUCHING_LOBE * area;
    let parts: Vec<usize> = (0..components.list.len()).filter(large).collect();
    if parts.len() < 2 {
        return Vec::new();
    }
    let part = |index: usize| Found {
        cutout: crop.cutout(&components, index),
        area: components.list[index].area,
        contact: 0,
        contrast: found.contrast,
    };
    parts.into_iter().map(part).collect()
}

/// The depth from which on blocks of a shape have its own level, the blur of its edge being left behind: the first whose median
/// residual is nearly that of the next.
fn settled_depth(depths: &[u8], residual: impl Fn(usize) -> f32) -> u8 {
    let mut by_depth: [Vec<f32>; MAX_DEPTH as usize + 1] = Default::default();
    for (i, depth) in depths.iter().enumerate().filter(|(_, depth)| **depth > 0) {
        by_depth[usize::from(*depth)].push(residual(i));
    }
    let counts = by_depth.each_ref().map(Vec::len);
    let most = counts.iter().max().copied().unwrap_or(0);
    let medians = by_depth.map(median);
    // Few blocks are no measure, and too few to learn local levels from.
    let enough = |depth: u8| counts[usize::from(depth)] * 4 >= most;
    let deepest = (1..=MAX_DEPTH).rev().find(|d| enough(*d)).unwrap_or(1);
    let settled = |d: &u8| medians[usize::from(*d)] >= SETTLED * medians[usize::from(*d) + 1];
    (INNER_DEPTH.min(deepest)..deepest).find(settled).unwrap_or(deepest)
}

/// Contrast of a coarse component against the ground.
#[derive(Debug, Default)]
struct Levels {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    /// Median contrast.
    contrast: f32,
    /// Contrast of each block of the component's bounding box, unless one pair of levels will do.
    map: Vec<f32>,
    /// Whether one pair of levels will do.
    uniform: bool,
    /// 1 for a shape brighter than the ground, -1 for a darker one (grey frames only).
    sense: f32,
    /// Whether the sense is the same everywhere.
    one_sided: bool,
    /// Ground level (grey frames only).
    ground: f32,
}

impl Levels {
    /// Takes the median of blocks' residuals for the contrast, and their spread, less what noise accounts for, for the
    /// uniformity.
    fn take_contrast(&mut self, list: &mut [f32], scatter: f32) {
        /// Distance between the quartiles of a normal distribution, in standard deviations.
        const QUARTILES: f32 = 1.349;
        self.contrast = quantile(list, 0.5);
        let spread = quantile(list, 0.75) - quantile(list, 0.25);
        let excess = (spread.powi(2) - (QUARTILES * scatter).powi(2)).max(0.0).sqrt();
        self.uniform = excess <= UNIFORM * self.contrast;
    }

    /// Whether the shape is brighter or darker than the ground, from blocks' signed residuals.
    fn take_sense(&mut self, signed: &[f32], grey: bool) {
        let brighter = signed.iter().filter(|s| **s > 0.0).count();
        self.sense = if 2 * brighter >= signed.len() { 1.0 } else { -1.0 };
        // A twentieth of the blocks may be specks or print.
        self.one_sided = grey && !signed.is_empty() && brighter.min(signed.len() - brighter) * 20 <= signed.len();
    }

    /// Spreads the levels of the inner blocks out over the box, each block taking the mean of its neighbours that have a level;
    /// none stays below `least`. `noise` is the standard deviation of a block's level as a part of the contrast.
    fn spread_out(&mut self, least: f32, reach: usize, noise: f32) {
        let (width, height) = (self.width, self.height);
        let neighbours = move |k: usize| {
            let (x, y) = (k % width, k / width);
            (y.saturating_sub(1)..height.min(y + 2))
                .flat_map(move |v| (x.saturating_sub(1)..width.min(x + 2)).map(move |u| v * width + u))
        };
        let mean = move |map: &[f32], k: usize| {
            let known = neighbours(k).map(|k| map[k]).filter(|level| *level > 0.0);
            let (sum, count) = known.fold((0.0, 0.0), |(sum, count), level| (sum + level, count + 1.0));
            (count > 0.0).then(|| sum / count)
        };
        // Each round takes the mean of nine, and leaves a third of the deviation at most.
        let mut left = noise;
        while left > MAP_NOISE {
            let map = std::mem::take(&mut self.map);
            let smoothed = |k: usize| if map[k] > 0.0 { mean(&map, k).unwrap_or(map[k]) } else { 0.0 };
            self.map = (0..map.len()).map(smoothed).collect();
            left /= 3.0;
        }
        let mut open: Vec<usize> = (0..self.map.len()).filter(|&k| self.map[k] == 0.0).collect();
        for _ in 0..reach {
            let filled: Vec<(usize, f32)> =
                open.iter().filter_map(|&k| mean(&self.map, k).map(|level| (k, level))).collect();
            for (k, level) in filled {
                self.map[k] = level;
            }
            open.retain(|&k| self.map[k] == 0.0);
        }
        for level in &mut self.map {
            *level = if *level == 0.0 { self.contrast } else { level.max(least) };
        }
    }

    /// Fills `line` with the reciprocal contrast of the pixels of row `y` from column `from` on, between the blocks' centres.
    fn fill_reciprocals(&self, block: usize, (y, from): (usize, usize), line: &mut [f32]) {
        if self.uniform {
            line.fill(1.0 / self.contrast.max(f32::MIN_POSITIVE));
            return;
        }
        // Block k has its centre at pixel k * block + (block - 1) / 2.
        let in_blocks = |pixel: usize| (pixel as f32 - (block - 1) as f32 / 2.0) / block as f32;
        let row = (in_blocks(y) - self.top as f32).clamp(0.0, (self.height - 1) as f32);
        let (j, t) = (row as usize, row.fract());
        let upper = &self.map[j * self.width..][..self.width];
        let lower = &self.map[(j + 1).min(self.height - 1) * self.width..][..self.width];
        let reciprocal = |i: usize| 1.0 / (upper[i] + (lower[i] - upper[i]) * t);
        // The column of a pixel is a whole number of blocks and one of few fractions.
        let mut i = usize::MAX;
        let (mut left, mut right) = (0.0, 0.0);
        for (x, value) in line.iter_mut().enumerate() {
            let column = (in_blocks(from + x) - self.left as f32).clamp(0.0, (self.width - 1) as f32);
            let at = column as usize;
            if at != i {
                (left, right) = (reciprocal(at), reciprocal((at + 1).min(self.width - 1)));
                i = at;
            }
            *value = left + (right - left) * (column - at as f32);
        }
    }

    /// Fills a row of pixels with their difference from the ground, divided by the local contrast unless that is uniform.
    fn fill_row(&self, rows: &RowSource<'_>, (y, from): (usize, usize), out: &mut [u8], levels: [f32; 2]) {
        let RowSource { frame, ground, block } = *rows;
        let in_blocks = |pixel: usize| (pixel as f64 - (block - 1) as f64 / 2.0) / block as f64;
        let channels = frame.format.channels();
        let source = &frame.row(y)[from * channels..];
        let mut difference = vec![0.0f32; out.len()];
        let mut line = vec![0.0f32; out.len()];
        for (c, surface) in ground.surfaces.iter().enumerate() {
            surface.fill_line(in_blocks(y), in_blocks(from), 1.0 / block as f64, &mut line);
            for ((d, g), p) in difference.iter_mut().zip(&line).zip(source.iter().skip(c).step_by(channels)) {
                let signed = f32::from(*p) - g;
                *d = if self.one_sided { self.sense * signed } else { d.max(signed.abs()) };
            }
        }
        let [shape_level, ground_level] = levels;
        self.fill_reciprocals(block, (y, from), &mut line);
        for ((out, d), reciprocal) in out.iter_mut().zip(&difference).zip(&line) {
            // Half a level up and cut off is rounded; beyond 0 and 255 the conversion saturates.
            *out = (ground_level + 0.5 + (shape_level - ground_level) * d * reciprocal) as u8;
        }
    }
}

/// Where the pixels of a row come from.
#[derive(Clone, Copy)]
struct RowSource<'a> {
    frame: &'a Frame<'a>,
    ground: &'a Ground,
    block: usize,
}
