//! Segmentation of a frame into shapes.
//!
//! # Method
//! 1. *Ground*: the frame is averaged over small blocks; the class of blocks (N. Otsu, 1979) that prevails along the rim is
//!    ground, and a quadratic surface through it follows uneven light. Shapes may be darker, brighter or of another colour; the ground may be grained. Where
//!    the rim does not tell (a tight crop round a shape), or what stands out is a convex sheet that fills the frame (the ground within the walls of a tray), both classes are tried, and the one that gives
//!    whole shapes is right.
//! 2. *Blocks that stand out* from the ground by more than its scatter are joined to connected components. The threshold is
//!    near the ground, so that dark print on dark ground still belongs to its shape.
//! 3. *Levels*: the contrast of a component is measured deep within it, beyond the blur of its edge. It is one number, or a surface as
//!    light falls off, or (print) a map of blocks. Means of noise that black or white clips are put right.
//! 4. *Pixels*: about each component the frame is cut out, in a form in which half-way between two fixed levels is half-way
//!    between the shape's own level near the border and the ground's: as it is, where both are uniform, else
//!    divided by the local contrast. Pixels beyond half-way are joined to components once more: neighbours whose shadows
//!    or glow met come apart. Where a part of the border is soft, it is sought within the shadow that makes it so ([`Segmentation::shaded`]). Print that comes
//!    near the ground's level belongs to the shape where its edge to the ground is crisp. Threads that hang on a shape (hairs) are taken off.
//!    A border beside which, or across which, levels are not as elsewhere is named ([`Segmentation::untold`]).
//! 5. *Rejection*, each with its [`Reason`]: cut by the frame's edge, too small beside the others, thread-like (hairs,
//!    scanner edges), soft beside sharp ones or faint without a crisp edge (glare), convex beside such with bays (coins, labels, rulers), two shapes that touch (of about twice the usual area, with an isthmus between the halves; it is a waist where most large shapes have none). Where that
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

mod across;
mod blocks;
mod clipping;
mod convex;
mod crop;
mod frame;
mod ground;
mod levels;
mod metric;
mod print;
mod runs;
mod segmentation;
mod shadows;
mod sift;
mod standing;
mod statistics;
mod surface;
mod threads;

pub use crate::cutout::{Aoi, Cutout};
pub use frame::{Frame, MAX_SIDE, MaskError, PixelFormat};
pub use segmentation::{MIN_REPORTED_AREA, Parameters, Reason, Rejected, Segmentation};

use crate::contour::Tracer;
use blocks::Blocks;
use crop::Crop;
use ground::Ground;
use print::Print;
use runs::Components;
use shadows::{Beside, Shadows};
use sift::{Found, sift};
use standing::Standing;
use threads::Threads;

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
    /// For each block the coarse component that owns it, or [`standing::NOBODY`]: its blocks and those next to them.
    owner: Vec<u32>,
    residual: Vec<f32>,
    crop: Crop,
    threads: Threads,
    shadows: Shadows,
    print: Print,
    tracer: Tracer,
}

impl Segmenter {
    /// Finds the shapes of a frame.
    #[must_use]
    pub fn segment(&mut self, frame: &Frame<'_>, parameters: &Parameters) -> Segmentation {
        self.blocks.fill(frame);
        // `self` is filled while the candidates are looked at.
        let blocks = std::mem::take(&mut self.blocks);
        let mut found: Vec<(bool, Segmentation)> = Vec::new();
        for (candidate, is_told) in ground::candidates(&blocks) {
            let ground = ground::find(&blocks, candidate, std::mem::take(&mut self.residual));
            let (segmentation, has_bays) = self.shapes(frame, &blocks, &ground, parameters);
            self.residual = ground.residual;
            // A convex sheet that fills the frame is ground; what was taken for ground lies along the rim: the walls of a tray.
            let fills = |aoi: &Aoi| 2 * aoi.width as usize > frame.width && 2 * aoi.height as usize > frame.height;
            let is_sheet = |r: &Rejected| fills(&r.aoi) && (!has_bays || r.reason == Reason::Convex);
            let is_ground = |c: &Cutout| fills(&c.aoi) && !has_bays;
            let has_sheet = segmentation.rejected.iter().any(is_sheet) || segmentation.cutouts.iter().any(is_ground);
            found.push((has_sheet, segmentation));
            if is_told && !has_sheet {
                break;
            }
        }
        self.blocks = blocks;
        // Unless there is nothing on it but its joints: then it is a solved puzzle.
        let is_shown = found.iter().any(|(has_sheet, _)| *has_sheet);
        let is_sound = |(has_sheet, s): &(bool, Segmentation)| !(*has_sheet || is_shown && are_lines(&s.cutouts));
        let mut best: Option<((bool, usize), Segmentation)> = None;
        for candidate in found {
            let worth = (is_sound(&candidate), candidate.1.cutouts.iter().map(box_area).sum());
            if best.as_ref().is_none_or(|(best, _)| worth > *best) {
                best = Some((worth, candidate.1));
            }
        }
        best.map(|(_, segmentation)| segmentation).unwrap_or_default()
    }

    /// Finds the shapes that stand out from a ground; whether there are such with bays.
    fn shapes(
        &mut self,
        frame: &Frame<'_>,
        blocks: &Blocks,
        ground: &Ground,
        parameters: &Parameters,
    ) -> (Segmentation, bool) {
        let columns = blocks.columns;
        self.coarse.clear();
        for (row, residual) in ground.residual.chunks_exact(columns).enumerate() {
            self.coarse.begin_row(row);
            self.coarse.add_row(residual, |r| r > ground.threshold);
        }
        self.coarse.close();
        standing::claim(blocks, &self.coarse, &mut self.owner);
        let standing = Standing { blocks, ground, components: &self.coarse, owner: &self.owner };

        let mut found: Vec<Found> = Vec::new();
        let mut rejected = Vec::new();
        let block = blocks.size;
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
            self.crop.take(frame, &standing, k);
            self.crop.label(&mut self.fine);
            let mut beside = self.crop.lift_shadows(&self.fine, &mut self.shadows, parameters);
            let recovered = self.crop.may_be_more && self.crop.recover_print(frame, &standing, k, &mut self.print);
            beside.is_doubtful |= recovered;
            if beside.is_shaded || recovered {
                self.crop.label(&mut self.fine);
            }
            if self.crop.erase_threads(&self.fine, &mut self.threads, parameters) {
                self.crop.label(&mut self.fine);
            }
            self.collect(frame, parameters, beside, &mut found, &mut rejected);
        }
        standing::release(blocks, &self.coarse, &mut self.owner);
        sift(frame, parameters, found, rejected, &mut self.tracer)
    }

    /// Takes the components of `self.crop` over, each as a cutout, or among the rejected.
    fn collect(
        &self,
        frame: &Frame<'_>,
        parameters: &Parameters,
        beside: Beside,
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
            let is_convex = convex::may_be_convex(c, self.fine.runs_of(index)) && convex::is_convex(&cutout);
            found.push(Found { cutout, area: c.area, contact, contrast: crop.contrast, beside, is_convex });
        }
    }

    /// Number of pixels of a fine component on the frame's rim.
    fn rim_contact(&self, frame: &Frame<'_>, index: usize) -> usize {
        let crop = &self.crop;
        let runs = self.fine.runs_of(index);
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

fn box_area(cutout: &Cutout) -> usize {
    cutout.aoi.width as usize * cutout.aoi.height as usize
}

/// Whether shapes are lines, which fill little of their boxes: the joints of a solved puzzle.
fn are_lines(cutouts: &[Cutout]) -> bool {
    /// A piece fills half of its box and more, an arc a tenth.
    const LEAST_FILL: f64 = 0.3;
    let area = |c: &Cutout| {
        let half = 0.5 * (c.shape_level + c.ground_level);
        c.pixels.iter().filter(|p| (f32::from(**p) > half) == (c.shape_level > c.ground_level)).count()
    };
    let [filled, boxes] = [cutouts.iter().map(area).sum::<usize>(), cutouts.iter().map(box_area).sum()];
    (filled as f64) < LEAST_FILL * boxes as f64
}
