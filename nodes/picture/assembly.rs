//! The assembled puzzle: every piece where it belongs.

use std::collections::BTreeMap;

use image::RgbImage;
use isthmus::Point;
use jigsaw::{Assembly, Piece};
use nalgebra::{Isometry2, Vector2};

use super::canvas::{
    BLACK, BLUE, Canvas, GREEN, GREY, INK, ORANGE, PALE, PURPLE, Pen, Rgb, SKY, Size, VERMILLION, WHITE, YELLOW, tint,
};

/// How [`assembly`] draws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AssemblyStyle {
    /// Longest side of the puzzle in the picture, in pixels. Pieces are never drawn larger than they were seen.
    pub max_side: f64,
}

impl Default for AssemblyStyle {
    fn default() -> Self {
        Self { max_side: 2000.0 }
    }
}

/// Fills for neighbouring pieces: tints on which black text stays legible.
const FILLS: [(Rgb, f64); 8] = [
    (SKY, 0.32),
    (ORANGE, 0.55),
    (GREEN, 0.38),
    (YELLOW, 0.55),
    (PURPLE, 0.45),
    (BLUE, 0.48),
    (VERMILLION, 0.42),
    (GREY, 0.30),
];
/// Below this probability a mating is drawn as doubtful.
const SURE: f64 = 0.95;
const MARGIN: f64 = 32.0;
/// Space between pieces left over, in pixels of the picture.
const SPACING: f64 = 24.0;

/// A piece moved to where it is drawn.
struct Drawn {
    piece: usize,
    outline: Vec<Point>,
    /// Where its id is written, and the radius of the disc round that point in which nothing else of it lies.
    label: (Point, f64),
    low: Point,
    high: Point,
    picture_from_image: nalgebra::Similarity2<f64>,
}

impl Drawn {
    fn new(pieces: &[Piece], piece: usize, picture_from_image: nalgebra::Similarity2<f64>) -> Option<Self> {
        let border = &pieces.get(piece)?.features.border;
        let outline: Vec<Point> = border.points.iter().map(|p| picture_from_image * p).collect();
        let [low, high] = bounds(&outline)?;
        // The widest place of the piece, which its skeleton knows.
        let branches = &pieces[piece].features.endoskeleton.branches;
        let widest = branches.iter().flatten().max_by(|a, b| a.distance.total_cmp(&b.distance));
        let label = match widest {
            Some(widest) => (picture_from_image * widest.point, widest.distance * picture_from_image.scaling()),
            None => (picture_from_image * border.centroid(), 0.31 * (high - low).min()),
        };
        Some(Self { piece, outline, label, low, high, picture_from_image })
    }
}

/// None without points, or where one of them is no number.
fn bounds(points: &[Point]) -> Option<[Point; 2]> {
    let first = points.first()?;
    let finite = points.iter().all(|p| p.x.is_finite() && p.y.is_finite());
    finite.then(|| points.iter().fold([*first; 2], |[low, high], p| [low.inf(p), high.sup(p)]))
}

/// Draws the pieces in place, each with its id, its matings marked, the pieces left over below.
///
/// Indices of the assembly that point beyond `pieces` are ignored. An assembly without a piece gives a picture that
/// says so.
pub fn assembly(pieces: &[Piece], assembly: &Assembly, style: AssemblyStyle) -> RgbImage {
    // Extent of the puzzle, in pixels of the source images.
    let corners = assembly.placements.iter().filter_map(|placement| {
        let border = &pieces.get(placement.piece)?.features.border;
        let placed: Vec<Point> = border.points.iter().map(|p| placement.puzzle_from_image * p).collect();
        bounds(&placed)
    });
    let extent = corners.reduce(|[a, b], [c, d]| [a.inf(&c), b.sup(&d)]);
    let loose_width = assembly.unplaced.iter().filter_map(|&k| bounds(&pieces.get(k)?.features.border.points));
    let loose_width = loose_width.map(|[low, high]| (high - low).max()).fold(0.0, f64::max);
    let [low, high] = extent.unwrap_or([Point::origin(), Point::new(3.0 * loose_width.max(200.0), 0.0)]);
    let size = high - low;
    let scale = (style.max_side / size.max().max(loose_width).max(1.0)).min(1.0);

    let header = header(pieces, assembly);
    let least = header.iter().map(|(text, size, bold)| size.width(text, *bold)).fold(640.0, f64::max);
    let width = (size.x * scale).max(least) + 2.0 * MARGIN;
    let header_height: f64 = header.iter().map(|(_, size, _)| size.height() + 4.0).sum::<f64>() + 16.0;
    let shift = Vector2::new(0.5 * (width - size.x * scale), MARGIN + header_height) - low.coords * scale;
    let picture_from_puzzle = |pose: &Isometry2<f64>| {
        nalgebra::Similarity2::new(shift, 0.0, scale) * nalgebra::convert::<_, nalgebra::Similarity2<f64>>(*pose)
    };
    let placed: Vec<Drawn> = assembly
        .placements
        .iter()
        .filter_map(|p| Drawn::new(pieces, p.piece, picture_from_puzzle(&p.puzzle_from_image)))
        .collect();
    let below = MARGIN + header_height + size.y * scale + MARGIN;
    let (loose, legend_top) = lay_out_loose(pieces, &assembly.unplaced, scale, width, below);
    let Some(mut canvas) = Canvas::new(width, legend_top + Size::Normal.height() + MARGIN, WHITE) else {
        return RgbImage::new(0, 0);
    };

    let mut y = MARGIN;
    for (text, size, bold) in &header {
        canvas.text(Point::new(MARGIN, y), text, *size, *bold, INK);
        y += size.height() + 4.0;
    }
    let thickness = (0.006 * mean_size(&placed, &loose)).clamp(0.6, 2.0);
    for (drawn, fill) in placed.iter().zip(colours(&placed)) {
        canvas.fill(drawn.outline.iter().copied(), fill, 1.0);
    }
    for drawn in &placed {
        canvas.line(drawn.outline.iter().copied(), true, Pen::new(INK, thickness));
    }
    draw_matings(&mut canvas, pieces, assembly, &placed);
    if !loose.is_empty() {
        let at = Point::new(MARGIN, below);
        canvas.line([at, Point::new(width - MARGIN, below)], false, Pen::new(PALE, 2.0));
        canvas.text(at + Vector2::new(0.0, 8.0), "Left over", Size::Normal, true, GREY);
    }
    for drawn in &loose {
        canvas.fill(drawn.outline.iter().copied(), PALE, 1.0);
        canvas.line(drawn.outline.iter().copied(), true, Pen::new(GREY, thickness));
    }
    let prefix = common_prefix(pieces);
    for (drawn, colour) in placed.iter().map(|d| (d, BLACK)).chain(loose.iter().map(|d| (d, INK))) {
        draw_id(&mut canvas, pieces, drawn, prefix, colour);
    }
    draw_legend(&mut canvas, Point::new(MARGIN, legend_top), assembly);
    canvas.finish()
}

fn header(pieces: &[Piece], assembly: &Assembly) -> Vec<(String, Size, bool)> {
    let (placed, all) = (assembly.placements.len(), pieces.len());
    let components = assembly.placements.iter().map(|p| p.component + 1).max().unwrap_or(0);
    let plural = |count: usize, one: &str, many: &str| format!("{count} {}", if count == 1 { one } else { many });
    let mut second = format!(
        "{} in {}, {} left over",
        plural(assembly.matings.len(), "mating", "matings"),
        plural(components, "assembly", "assemblies"),
        assembly.unplaced.len(),
    );
    let table = &assembly.table;
    if table.pairs > 0 {
        second += &format!("; {} possible pairs, {} backtracks", table.pairs, table.backtracks);
    }
    vec![
        (format!("{placed} of {} placed", plural(all, "piece", "pieces")), Size::Large, true),
        (second, Size::Normal, false),
    ]
}

/// Rows of the pieces left over; also where the rows end.
fn lay_out_loose(pieces: &[Piece], unplaced: &[usize], scale: f64, width: f64, top: f64) -> (Vec<Drawn>, f64) {
    if unplaced.is_empty() {
        return (vec![], top);
    }
    let (mut x, mut y, mut row) = (MARGIN, top + Size::Normal.height() + SPACING, 0.0_f64);
    let mut loose = vec![];
    for &piece in unplaced {
        let Some([low, high]) = pieces.get(piece).and_then(|p| bounds(&p.features.border.points)) else { continue };
        let size = (high - low) * scale;
        if x > MARGIN && x + size.x > width - MARGIN {
            (x, y, row) = (MARGIN, y + row + SPACING, 0.0);
        }
        let shift = Vector2::new(x, y) - low.coords * scale;
        loose.extend(Drawn::new(pieces, piece, nalgebra::Similarity2::new(shift, 0.0, scale)));
        x += size.x + SPACING;
        row = row.max(size.y);
    }
    (loose, y + row + MARGIN)
}

/// A fill for each piece, different from those of the pieces it touches, and all about equally often.
fn colours(placed: &[Drawn]) -> Vec<Rgb> {
    let mut used = [0_usize; FILLS.len()];
    let mut chosen: Vec<usize> = Vec::with_capacity(placed.len());
    for (k, drawn) in placed.iter().enumerate() {
        let touches = |other: &Drawn| {
            drawn.low.x <= other.high.x
                && other.low.x <= drawn.high.x
                && drawn.low.y <= other.high.y
                && other.low.y <= drawn.high.y
        };
        let mut near = [false; FILLS.len()];
        (0..k).filter(|&other| touches(&placed[other])).for_each(|other| near[chosen[other]] = true);
        let fill = (0..FILLS.len()).min_by_key(|&c| (near[c], used[c])).unwrap_or(0);
        used[fill] += 1;
        chosen.push(fill);
    }
    chosen.into_iter().map(|c| tint(FILLS[c].0, FILLS[c].1)).collect()
}

fn mean_size(placed: &[Drawn], loose: &[Drawn]) -> f64 {
    let all = placed.iter().chain(loose);
    let sum: f64 = all.clone().map(|d| (d.high - d.low).max()).sum();
    sum / all.count().max(1) as f64
}

fn draw_matings(canvas: &mut Canvas, pieces: &[Piece], assembly: &Assembly, placed: &[Drawn]) {
    let by_piece: BTreeMap<usize, &Drawn> = placed.iter().map(|d| (d.piece, d)).collect();
    let radius = (0.014 * mean_size(placed, &[])).clamp(1.5, 6.0);
    for mating in &assembly.matings {
        let Some(drawn) = by_piece.get(&mating.positive_piece) else { continue };
        let isthmuses = &pieces[mating.positive_piece].features.isthmuses;
        let Some(isthmus) = isthmuses.get(mating.positive_isthmus) else { continue };
        let place = |p: Point| drawn.picture_from_image * p;
        let colour = if mating.confidence >= SURE { BLUE } else { VERMILLION };
        canvas.line(isthmus.critical_points.map(place), false, Pen::new(colour, 0.5 * radius));
        let middle = place(isthmus.point);
        if mating.confidence >= SURE {
            canvas.disc(middle, radius, colour);
        } else {
            canvas.ring(middle, 1.3 * radius, colour);
        }
    }
}

/// What all ids begin with, cut back to the last sign that isn't a digit.
fn common_prefix(pieces: &[Piece]) -> usize {
    let Some(first) = pieces.first() else { return 0 };
    let common = pieces.iter().fold(first.id.as_str(), |prefix, piece| {
        let length = prefix.char_indices().zip(piece.id.chars()).take_while(|((_, a), b)| a == b).count();
        prefix.char_indices().nth(length).map_or(prefix, |(end, _)| &prefix[..end])
    });
    common.trim_end_matches(|c: char| c.is_ascii_digit()).len()
}

/// The id in the middle of the piece, as long and as large as the piece allows.
fn draw_id(canvas: &mut Canvas, pieces: &[Piece], drawn: &Drawn, prefix: usize, colour: Rgb) {
    let id = &pieces[drawn.piece].id;
    let short = id.get(prefix..).filter(|rest| !rest.is_empty()).unwrap_or(id);
    let tiny = short.trim_start_matches('0');
    let (middle, radius) = drawn.label;
    let forms = [
        (id.as_str(), Size::Normal),
        (id, Size::Small),
        (short, Size::Normal),
        (short, Size::Small),
        (tiny, Size::Small),
    ];
    let half = |text: &str, size: Size| Vector2::new(0.5 * size.width(text, true), 0.5 * size.height());
    let fits = |(text, size): &(&str, Size)| !text.is_empty() && half(text, *size).norm() < radius;
    if let Some((text, size)) = forms.into_iter().find(fits) {
        canvas.text(middle - half(text, size), text, size, true, colour);
    }
}

fn draw_legend(canvas: &mut Canvas, at: Point, assembly: &Assembly) {
    if assembly.matings.is_empty() {
        return;
    }
    let middle = 0.5 * Size::Normal.height();
    canvas.disc(at + Vector2::new(6.0, middle), 5.0, BLUE);
    canvas.text(at + Vector2::new(20.0, 0.0), "mating at its neck", Size::Normal, false, INK);
    if assembly.matings.iter().any(|m| m.confidence < SURE) {
        let at = at + Vector2::new(230.0, 0.0);
        canvas.ring(at + Vector2::new(6.0, middle), 6.0, VERMILLION);
        canvas.text(at + Vector2::new(20.0, 0.0), "less than 95 % sure", Size::Normal, false, INK);
    }
}
