//! What the shape analysis sees: border, area of interest, skeletons, isthmuses, isthmus distance functions.

use image::{GrayImage, RgbImage};
use isthmus::Features;
use isthmus::Point;
use isthmus::isthmus::{Isthmus, Polarity};
use isthmus::mask::{Aoi, Cutout};
use isthmus::profile::distance_function;
use isthmus::skeleton::SkeletonPoint;
use nalgebra::Vector2;

use super::canvas::{BLACK, BLUE, Canvas, GREY, INK, ORANGE, PALE, Pen, Rgb, SKY, Size, VERMILLION, WHITE};

/// How [`inspection`] draws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InspectionStyle {
    /// Longest side of the piece in the picture, in pixels.
    pub piece_side: f64,
    /// Whether the isthmus distance functions are plotted beside the piece.
    pub plots: bool,
}

impl Default for InspectionStyle {
    fn default() -> Self {
        Self { piece_side: 900.0, plots: true }
    }
}

/// Longest side of [`frame_overview`] where there is no reason for another, in pixels.
pub const OVERVIEW_SIDE: f64 = 2400.0;
/// Most magnified: beyond it a small shape shows pixels rather than shape.
const MAX_SCALE: f64 = 6.0;
const MARGIN: f64 = 24.0;
/// Size of one plot with its axes, in pixels.
const PLOT: (f64, f64) = (330.0, 214.0);
const PLOT_COLUMNS: usize = 2;
/// Salient isthmuses plotted at most; a piece has about four.
const MAX_PLOTS: usize = 12;
/// Samples of a plotted isthmus distance function.
const IDF_SAMPLES: usize = 160;

/// The name of an isthmus in pictures: polarity and index, as `features.json` and the messages number them.
fn name(index: usize, isthmus: &Isthmus) -> String {
    match isthmus.polarity {
        Polarity::Positive => format!("P{index}"),
        Polarity::Negative => format!("N{index}"),
    }
}

fn colour(isthmus: &Isthmus) -> Rgb {
    match isthmus.polarity {
        Polarity::Positive => VERMILLION,
        Polarity::Negative => BLUE,
    }
}

/// One piece with everything the shape analysis found, and its isthmus distance functions beside it.
pub fn inspection(id: &str, source: &str, cutout: &Cutout, features: &Features, style: InspectionStyle) -> RgbImage {
    let window = cutout.window;
    let (columns, rows) = (f64::from(window.width.max(1)), f64::from(window.height.max(1)));
    let scale = (style.piece_side / columns.max(rows)).min(MAX_SCALE);
    let plotted: Vec<usize> = (0..features.isthmuses.len()).filter(|&k| features.isthmuses[k].salient).collect();
    let plots = if style.plots { plotted.len().min(MAX_PLOTS) } else { 0 };
    let plot_rows = plots.div_ceil(PLOT_COLUMNS) as f64;
    let plot_columns = plots.min(PLOT_COLUMNS) as f64;

    let header = 4.0 * Size::Normal.height() + 32.0;
    let legend = 4.0 * (Size::Normal.height() + 6.0);
    let panel = (columns * scale, (rows * scale).max(plot_rows * PLOT.1));
    let width = (panel.0 + plot_columns * (PLOT.0 + MARGIN)).max(860.0) + 2.0 * MARGIN;
    let Some(mut canvas) = Canvas::new(width, header + panel.1 + legend + 3.0 * MARGIN, WHITE) else {
        return RgbImage::new(0, 0);
    };

    canvas.text(Point::new(MARGIN, MARGIN - 6.0), id, Size::Large, true, INK);
    let aoi = cutout.aoi;
    let salient = |polarity| features.isthmuses.iter().filter(|i| i.salient && i.polarity == polarity).count();
    let waists = features.isthmuses.iter().filter(|i| !i.salient).count();
    let facts = format!(
        "{source}: {} x {} px at ({}, {}), border {:.0} px, noise {:.3} px",
        aoi.width,
        aoi.height,
        aoi.x,
        aoi.y,
        features.border.points.len() as f64 * features.border.spacing,
        features.noise,
    );
    let count = |n: usize, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let counts = format!(
        "{} (positive), {} (negative), {} (not salient)",
        count(salient(Polarity::Positive), "neck"),
        count(salient(Polarity::Negative), "mouth"),
        count(waists, "shallow waist")
    );
    canvas.text(Point::new(MARGIN, MARGIN + 30.0), &facts, Size::Normal, false, INK);
    let decided = format!(
        "grey levels: piece {:.0}, ground {:.0}, border {:.0}, noise {:.1}; border sampled every {:.2} px",
        cutout.shape_level,
        cutout.ground_level,
        0.5 * (cutout.shape_level + cutout.ground_level),
        cutout.noise_level,
        features.border.spacing,
    );
    canvas.text(Point::new(MARGIN, MARGIN + 54.0), &decided, Size::Normal, false, INK);
    canvas.text(Point::new(MARGIN, MARGIN + 78.0), &counts, Size::Normal, false, INK);

    let top_left = Point::new(MARGIN, header + MARGIN);
    let picture_from_frame = View { origin: corner(window), scale, top_left };
    let sample = |p: Point| level(&cutout.pixels, window.width, window.height, p - corner(window).coords);
    picture_from_frame.draw_ground(&mut canvas, Vector2::new(columns, rows), sample);
    picture_from_frame.draw_shape(&mut canvas, features, cutout, true);

    let right = MARGIN + panel.0 + MARGIN;
    let longest = plotted.iter().map(|&k| features.isthmuses[k].path_length).fold(1.0, f64::max);
    let idfs: Vec<(usize, Vec<f64>)> = plotted
        .iter()
        .take(plots)
        .map(|&k| (k, distance_function(&features.border, &features.isthmuses[k], IDF_SAMPLES)))
        .collect();
    let highest = idfs.iter().flat_map(|(_, idf)| idf).copied().filter(|v| v.is_finite()).fold(1.0, f64::max);
    for (slot, (k, idf)) in idfs.iter().enumerate() {
        let (column, row) = ((slot % PLOT_COLUMNS) as f64, (slot / PLOT_COLUMNS) as f64);
        let at = Point::new(right + column * (PLOT.0 + MARGIN), header + MARGIN + row * PLOT.1);
        plot(&mut canvas, at, &features.isthmuses[*k], *k, idf, longest, highest);
    }
    draw_legend(&mut canvas, Point::new(MARGIN, header + panel.1 + 2.0 * MARGIN), plotted.len() - plots, style.plots);
    canvas.finish()
}

/// A whole frame with all its pieces, for frames that hold more than one.
pub fn frame_overview(frame: &GrayImage, pieces: &[(&str, &Cutout, &Features)], max_side: f64) -> RgbImage {
    let (columns, rows) = (f64::from(frame.width().max(1)), f64::from(frame.height().max(1)));
    let scale = (max_side / columns.max(rows)).min(1.0);
    let Some(mut canvas) = Canvas::new(columns * scale, rows * scale, WHITE) else { return RgbImage::new(0, 0) };
    let view = View { origin: Point::new(-0.5, -0.5), scale, top_left: Point::origin() };
    let sample = |p: Point| level(frame.as_raw(), frame.width(), frame.height(), p + Vector2::repeat(0.5));
    view.draw_ground(&mut canvas, Vector2::new(columns, rows), sample);
    for (_, cutout, features) in pieces {
        view.draw_shape(&mut canvas, features, cutout, false);
    }
    for (id, cutout, features) in pieces {
        let aoi = cutout.aoi;
        let size = Size::Small;
        let room = f64::from(aoi.width) * scale;
        if size.width(id, true) < room {
            canvas.label(view.place(features.border.centroid()), id, size, BLACK);
        }
    }
    canvas.finish()
}

/// Upper left corner of a rectangle of pixels: half a pixel before the first centre.
fn corner(area: Aoi) -> Point {
    Point::new(f64::from(area.x) - 0.5, f64::from(area.y) - 0.5)
}

fn contains(area: Aoi, p: Point) -> bool {
    let inside = p - corner(area);
    (0.0..=f64::from(area.width)).contains(&inside.x) && (0.0..=f64::from(area.height)).contains(&inside.y)
}

/// Grey level between pixels; `p` counts from the upper left corner of the first pixel.
fn level(pixels: &[u8], width: u32, height: u32, p: Point) -> f64 {
    let at = |x: f64, y: f64| {
        let x = x.clamp(0.0, f64::from(width.max(1)) - 1.0) as usize;
        let y = y.clamp(0.0, f64::from(height.max(1)) - 1.0) as usize;
        pixels.get(y * width as usize + x).copied().map_or(0.0, f64::from)
    };
    let (x, y) = (p.x - 0.5, p.y - 0.5);
    let (x0, y0) = (x.floor(), y.floor());
    let (u, v) = (x - x0, y - y0);
    let upper = at(x0, y0) * (1.0 - u) + at(x0 + 1.0, y0) * u;
    let lower = at(x0, y0 + 1.0) * (1.0 - u) + at(x0 + 1.0, y0 + 1.0) * u;
    upper * (1.0 - v) + lower * v
}

/// From the source frame to the picture.
struct View {
    /// Upper left corner of what is shown, in the source frame.
    origin: Point,
    scale: f64,
    top_left: Point,
}

impl View {
    fn place(&self, p: Point) -> Point {
        self.top_left + (p - self.origin) * self.scale
    }

    /// The camera's picture, so pale that lines show on it.
    fn draw_ground(&self, canvas: &mut Canvas, size: Vector2<f64>, sample: impl Fn(Point) -> f64) {
        canvas.paint_pixels(self.top_left, self.top_left + size * self.scale, |x, y| {
            let p = self.origin + (Point::new(x + 0.5, y + 0.5) - self.top_left) / self.scale;
            [(255.0 - (255.0 - sample(p)) * 0.30).round() as u8; 3]
        });
    }

    fn draw_shape(&self, canvas: &mut Canvas, features: &Features, cutout: &Cutout, detailed: bool) {
        let (aoi, window) = (cutout.aoi, cutout.window);
        // Line widths grow with the picture, so that a small picture isn't drowned in lines.
        let unit = (self.scale / 2.0).clamp(0.6, 1.0);
        let place = |p: Point| self.place(p);
        let low = corner(aoi);
        let high = low + Vector2::new(f64::from(aoi.width), f64::from(aoi.height));
        canvas.frame(place(low), place(high), Pen::new(GREY, 1.2 * unit).dashed(true));

        for (skeleton, colour) in [(&features.exoskeleton, SKY), (&features.endoskeleton, ORANGE)] {
            for branch in &skeleton.branches {
                // The exoskeleton goes on outside of what is shown.
                let shown = |p: &SkeletonPoint| contains(window, p.point);
                for part in branch.split(|p| !shown(p)) {
                    canvas.line(part.iter().map(|p| place(p.point)), false, Pen::new(colour, 1.6 * unit));
                }
            }
        }
        for isthmus in features.isthmuses.iter().filter(|i| i.salient) {
            let length = features.border.points.len() as f64 * features.border.spacing;
            let count = (isthmus.path_length.min(length) / features.border.spacing).ceil().max(2.0) as usize;
            let segment = features.border.sample(isthmus.arc, 0.0, count);
            canvas.line(segment.into_iter().map(place), false, Pen::new(colour(isthmus), 7.0 * unit).opacity(0.35));
        }
        canvas.line(features.border.points.iter().copied().map(place), true, Pen::new(BLACK, 1.6 * unit));
        // The salient ones last, on top.
        for (k, isthmus) in features.isthmuses.iter().enumerate().rev() {
            let (colour, ends) = (colour(isthmus), isthmus.critical_points.map(place));
            let width = if isthmus.salient { 3.0 } else { 1.4 };
            canvas.line(ends, false, Pen::new(colour, width * unit).dashed(!isthmus.salient));
            for end in ends {
                match (isthmus.salient, isthmus.polarity) {
                    (true, Polarity::Positive) => canvas.disc(end, 4.5 * unit, colour),
                    (true, Polarity::Negative) => canvas.square(end, 4.0 * unit, colour),
                    (false, _) => canvas.ring(end, 3.0 * unit, colour),
                }
            }
            if isthmus.salient && detailed {
                canvas.disc(place(isthmus.point), 2.5 * unit, colour);
                canvas.label(self.label_place(isthmus), &name(k, isthmus), Size::Normal, colour);
            }
        }
    }

    /// Beside the isthmus line, on the side away from its match segment.
    fn label_place(&self, isthmus: &Isthmus) -> Point {
        let [a, b] = isthmus.critical_points;
        let across = b - a;
        let size = across.norm();
        if size <= f64::MIN_POSITIVE {
            return self.place(isthmus.point);
        }
        // The border runs clockwise: a tab's segment lies to the left of the line from its first to its second end,
        // a blank's to the right.
        let side = match isthmus.polarity {
            Polarity::Positive => 1.0,
            Polarity::Negative => -1.0,
        };
        let away = Vector2::new(-across.y, across.x) * (side / size);
        self.place(isthmus.point) + away * 22.0
    }
}

/// One isthmus distance function. All plots of a picture share their axes, so that they compare at a glance.
fn plot(canvas: &mut Canvas, at: Point, isthmus: &Isthmus, index: usize, idf: &[f64], longest: f64, highest: f64) {
    let kind = match isthmus.polarity {
        Polarity::Positive => "neck",
        Polarity::Negative => "mouth",
    };
    let title = format!("{} {kind} {:.1} px", name(index, isthmus), isthmus.width);
    canvas.text(at, &title, Size::Normal, true, colour(isthmus));
    let low = at + Vector2::new(34.0, 26.0);
    let high = at + Vector2::new(PLOT.0 - 8.0, PLOT.1 - 44.0);
    let x = |v: f64| low.x + v / longest * (high.x - low.x);
    let y = |v: f64| high.y - v / highest * (high.y - low.y);
    for tick in ticks(highest, 4) {
        canvas.line([Point::new(low.x, y(tick)), Point::new(high.x, y(tick))], false, Pen::new(PALE, 1.0));
        let text = format!("{tick:.0}");
        let width = Size::Small.width(&text, false);
        canvas.text(Point::new(low.x - width - 5.0, y(tick) - 8.0), &text, Size::Small, false, GREY);
    }
    for tick in ticks(longest, 5) {
        canvas.line([Point::new(x(tick), low.y), Point::new(x(tick), high.y)], false, Pen::new(PALE, 1.0));
        let text = format!("{tick:.0}");
        let width = Size::Small.width(&text, false);
        canvas.text(Point::new(x(tick) - 0.5 * width, high.y + 2.0), &text, Size::Small, false, GREY);
    }
    canvas.line([low, Point::new(low.x, high.y), high], false, Pen::new(GREY, 1.2));
    let step = isthmus.path_length / (idf.len().max(2) - 1) as f64;
    let curve = idf.iter().enumerate().map(|(k, v)| Point::new(x(k as f64 * step), y(*v)));
    canvas.line(curve, false, Pen::new(colour(isthmus), 2.2));
}

/// Round numbers from 0 up to `high`, about `count` of them.
fn ticks(high: f64, count: usize) -> impl Iterator<Item = f64> {
    let rough = (high / count as f64).max(1.0);
    let power = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough).unwrap_or(10.0 * power);
    (0..).map(move |k| f64::from(k) * step).take_while(move |v| *v <= high)
}

fn draw_legend(canvas: &mut Canvas, at: Point, not_plotted: usize, plots: bool) {
    let line_height = Size::Normal.height() + 6.0;
    let mut entry = |column: f64, row: f64, draw: &dyn Fn(&mut Canvas, Point), text: &str| {
        let at = at + Vector2::new(column, row * line_height);
        draw(canvas, at + Vector2::new(16.0, 0.5 * Size::Normal.height()));
        canvas.text(at + Vector2::new(42.0, 0.0), text, Size::Normal, false, INK);
    };
    let across = |pen: Pen| {
        move |canvas: &mut Canvas, p: Point| {
            canvas.line([p - Vector2::new(16.0, 0.0), p + Vector2::new(16.0, 0.0)], false, pen);
        }
    };
    let isthmus = |colour: Rgb, square: bool| {
        move |canvas: &mut Canvas, p: Point| {
            let reach = Vector2::new(12.0, 0.0);
            canvas.line([p - reach, p + reach], false, Pen::new(colour, 3.0));
            for end in [p - reach, p + reach] {
                if square { canvas.square(end, 4.0, colour) } else { canvas.disc(end, 4.5, colour) }
            }
        }
    };
    entry(0.0, 0.0, &isthmus(VERMILLION, false), "P: positive isthmus, its ICPs");
    entry(0.0, 1.0, &isthmus(BLUE, true), "N: negative isthmus, its ICPs");
    let shallow = |canvas: &mut Canvas, p: Point| {
        let reach = Vector2::new(12.0, 0.0);
        canvas.line([p - reach, p + reach], false, Pen::new(VERMILLION, 1.4).dashed(true));
        [p - reach, p + reach].into_iter().for_each(|end| canvas.ring(end, 3.0, VERMILLION));
    };
    entry(0.0, 2.0, &shallow, "not salient: a waist of the body");
    entry(0.0, 3.0, &across(Pen::new(GREY, 1.2).dashed(true)), "area of interest");
    entry(430.0, 0.0, &across(Pen::new(ORANGE, 1.6)), "endoskeleton (inside)");
    entry(430.0, 1.0, &across(Pen::new(SKY, 1.6)), "exoskeleton (outside)");
    entry(430.0, 2.0, &across(Pen::new(VERMILLION, 7.0).opacity(0.35)), "match segment");
    if plots {
        let at = at + Vector2::new(740.0, 0.0);
        let mut note = String::from("Plots: distance from the isthmus point [px]");
        canvas.text(at, &note, Size::Normal, false, GREY);
        note = "over path length along the match segment [px]".into();
        canvas.text(at + Vector2::new(0.0, line_height), &note, Size::Normal, false, GREY);
        if not_plotted > 0 {
            note = format!("{not_plotted} more not plotted");
            canvas.text(at + Vector2::new(0.0, 2.0 * line_height), &note, Size::Normal, false, GREY);
        }
    }
}
