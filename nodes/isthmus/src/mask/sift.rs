//! Which of the shapes found are shapes of their own, beside the others.

use super::across::{has_crisp_edge, is_untold};
use super::crop::Crop;
use super::frame::Frame;
use super::runs::Components;
use super::segmentation::{Parameters, Reason, Rejected, Segmentation};
use super::shadows::Beside;
use super::statistics::{median, quantile};
use crate::Point;
use crate::contour::{Border, Tracer};
use crate::cutout::Cutout;
use crate::isthmus::{self, Polarity};
use crate::skeleton::Triangulation;

/// A shape alone in the frame may touch the edges if it spans this part of the frame in both directions: then the frame
/// was cropped to the shape.
const TIGHT_SPAN: f64 = 0.9;
/// ... and if it covers at most this part of the frame's rim.
const TIGHT_CONTACT: f64 = 0.6;
/// ... and has this part of all the area that stands out.
const TIGHT_SHARE: f64 = 0.9;
/// What touches the frame's edge and is longer than this part of its smaller side is a wall, a sheet, a strip: of a size of its own.
const WALL_SPAN: f64 = 0.5;
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

/// What touches the frame's edge, longer than this many times the square root of the typical area: no piece is so long.
const STRIP_LENGTH: f64 = 2.5;
/// ... and thinner on the mean than this part of the same: the edge of a sheet or of the scanner's glass, of which pieces show more.
const STRIP_WIDTH: f64 = 0.1;

/// Rows of a shape at whose ends its sharpness is looked at, about.
const ROWS: usize = 16;
/// How far on either side of its ends levels are compared there, in pixels: beyond the blur of pictures in focus, and within the margin of a cutout.
const REACH: usize = 3;
/// Shapes less sharp than this part of the sharpest are looked at once more: noise of an eighth of the contrast makes few such.
const SOFT: f32 = 0.7;

/// A shape that may still be rejected beside the others.
pub(super) struct Found {
    pub(super) cutout: Cutout,
    pub(super) area: usize,
    pub(super) contact: usize,
    pub(super) contrast: f32,
    pub(super) beside: Beside,
    /// Whether it has no bays.
    pub(super) is_convex: bool,
}

/// Rejects what is cut by the frame, or small, soft or faint beside the other shapes, and convex beside such with bays; whether there are such.
pub(super) fn sift(
    frame: &Frame<'_>,
    parameters: &Parameters,
    mut found: Vec<Found>,
    mut rejected: Vec<Rejected>,
    tracer: &mut Tracer,
) -> (Segmentation, bool) {
    let sharpness: Vec<f32> =
        if found.len() > 1 { found.iter().map(|f| sharpness(&f.cutout)).collect() } else { Vec::new() };
    let sharpest = sharpness.iter().copied().fold(0.0, f32::max);
    let mut sharpness = sharpness.into_iter();
    found.retain(|f| {
        let is_soft = sharpness.next().is_some_and(|s| s < SOFT * sharpest) && !has_crisp_edge(&f.cutout, tracer);
        if is_soft {
            rejected.push(Rejected { aoi: f.cutout.aoi, area: f.area, reason: Reason::Faint });
        }
        !is_soft
    });
    let total: usize = found.iter().map(|f| f.area).sum();
    let rim = 2 * (frame.width + frame.height);
    let is_tight = |f: &Found| {
        let aoi = f.cutout.aoi;
        f64::from(aoi.width) >= TIGHT_SPAN * frame.width as f64
            && f64::from(aoi.height) >= TIGHT_SPAN * frame.height as f64
            && f.contact as f64 <= TIGHT_CONTACT * rim as f64
            && f.area as f64 >= TIGHT_SHARE * total as f64
    };
    // Walls and sheets say nothing about the shapes beside them.
    let is_like_others = |f: &&Found| {
        let is_long =
            f64::from(f.cutout.aoi.width.max(f.cutout.aoi.height)) > WALL_SPAN * frame.width.min(frame.height) as f64;
        !f.is_convex && (f.contact == 0 || !is_long || is_tight(f))
    };
    let area_and_contrast = |f: &Found| (f.area, f.contrast);
    let mut by_area: Vec<(usize, f32)> = found.iter().filter(is_like_others).map(area_and_contrast).collect();
    if by_area.is_empty() {
        by_area.extend(found.iter().map(area_and_contrast));
    }
    by_area.sort_unstable_by_key(|f| f.0);
    let total: usize = by_area.iter().map(|f| f.0).sum();
    let mut above = total;
    let typical_area = by_area
        .iter()
        .find(|f| {
            above -= f.0;
            above * 2 <= total
        })
        .map_or(0, |f| f.0);
    let large = by_area.iter().filter(|f| 2 * f.0 >= typical_area);
    let typical_contrast = median(&large.map(|f| f.1).collect::<Vec<_>>());
    // The lower median, small fry aside: of three shapes two of which touch, a single one.
    let usual: Vec<usize> = by_area
        .iter()
        .map(|f| f.0)
        .filter(|a| *a as f64 >= parameters.min_relative_area * typical_area as f64)
        .collect();
    let median_area = if usual.len() < TOUCHING_SHAPES { usize::MAX } else { usual[(usual.len() - 1) / 2] };
    let typical_side = (typical_area as f64).sqrt();
    let is_strip = |f: &Found| {
        let length = f64::from(f.cutout.aoi.width.max(f.cutout.aoi.height));
        length > STRIP_LENGTH * typical_side && f.area as f64 <= STRIP_WIDTH * typical_side * length
    };
    let is_large = |f: &Found| f.area as f64 >= TOUCHING_AREA * median_area as f64;
    // Where large shapes are whole as a rule, shapes are of many sizes, and a waist is no contact.
    let large = found.iter().filter(|f| f.contact == 0 && !f.is_convex && is_large(f));
    let whole = large.map(|f| contact(&f.cutout, median_area as f64, tracer).is_none()).collect::<Vec<_>>();
    let are_alike = 2 * whole.iter().filter(|is_whole| **is_whole).count() <= whole.len();
    let mut taken: Vec<Found> = Vec::new();
    let mut convex = Vec::new();
    let mut separated = Vec::new();
    let mut open = found;
    while let Some(f) = open.pop() {
        let aoi = f.cutout.aoi;
        let reason = if (f.area as f64) < parameters.min_relative_area * typical_area as f64 {
            Some(Reason::Small)
        } else if f64::from(f.contrast) < parameters.min_relative_contrast * f64::from(typical_contrast)
            && !has_crisp_edge(&f.cutout, tracer)
        {
            Some(Reason::Faint)
        } else if f.contact > 0 && !is_tight(&f) {
            Some(if is_strip(&f) { Reason::Thread } else { Reason::CutByFrame })
        } else if is_large(&f)
            && let Some(contact) = contact(&f.cutout, median_area as f64, tracer)
        {
            let parts = part(&f, contact, median_area as f64);
            if parts.is_empty() {
                are_alike.then_some(Reason::Touching)
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
            None if f.is_convex => convex.push(f),
            None => taken.push(f),
        }
    }
    let has_bays = !taken.is_empty();
    for f in convex {
        if has_bays {
            rejected.push(Rejected { aoi: f.cutout.aoi, area: f.area, reason: Reason::Convex });
        } else {
            taken.push(f);
        }
    }
    separated.sort_by_key(|aoi| (aoi.y, aoi.x));
    rejected.sort_by_key(|r| (r.aoi.y, r.aoi.x));
    taken.sort_by_key(|f| (f.cutout.aoi.y, f.cutout.aoi.x));
    let shaded = taken.iter().filter(|f| f.beside.is_shaded).map(|f| f.cutout.aoi).collect();
    let doubtful = taken.iter().filter(|f| f.beside.is_doubtful);
    let untold = doubtful.filter(|f| is_untold(&f.cutout, tracer)).map(|f| f.cutout.aoi).collect();
    let cutouts = taken.into_iter().map(|f| f.cutout).collect();
    (Segmentation { cutouts, rejected, separated, shaded, untold }, has_bays)
}

/// The step of the level at the ends of some of a shape's rows, as a part of the contrast: the upper quartile.
fn sharpness(cutout: &Cutout) -> f32 {
    let (width, height) = (cutout.window.width as usize, cutout.window.height as usize);
    let contrast = cutout.shape_level - cutout.ground_level;
    let level = |x: usize, y: usize| f32::from(cutout.pixels[y.min(height - 1) * width + x.min(width - 1)]);
    let step = |x: usize, y: usize| {
        let across = level(x + REACH, y) - level(x.saturating_sub(REACH), y);
        let down = level(x, y + REACH) - level(x, y.saturating_sub(REACH));
        across.abs().max(down.abs()) / contrast.abs()
    };
    let half = cutout.ground_level + contrast / 2.0;
    let steps = (0..height).step_by((height / ROWS).max(1)).flat_map(|y| {
        let row = &cutout.pixels[y * width..][..width];
        let is_shape = |p: &u8| (f32::from(*p) > half) == (contrast > 0.0);
        let ends = [row.iter().position(is_shape), row.iter().rposition(is_shape)];
        ends.into_iter().flatten().map(move |x| (x, y))
    });
    quantile(&steps.map(|(x, y)| step(x, y)).collect::<Vec<_>>(), 0.75)
}

/// The narrowest place at which two shapes of about a given area each touch: an isthmus with most of a shape on either side.
fn contact(cutout: &Cutout, area: f64, tracer: &mut Tracer) -> Option<[Point; 2]> {
    let (border, noise) = tracer.trace(cutout).ok()?;
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
        beside: found.beside,
        is_convex: false,
    };
    parts.into_iter().map(part).collect()
}
