//! Anti-aliased drawing: lines, shapes and text on an RGB picture.

use image::RgbImage;
use isthmus::Point;
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Stroke, StrokeDash, Transform,
};

/// Red, green, blue.
pub(super) type Rgb = [u8; 3];

pub(super) const WHITE: Rgb = [255, 255, 255];
pub(super) const BLACK: Rgb = [0, 0, 0];
/// Text that is not quite black is easier on the eye.
pub(super) const INK: Rgb = [40, 40, 40];
pub(super) const GREY: Rgb = [130, 130, 130];
pub(super) const PALE: Rgb = [222, 222, 222];
// Okabe and Ito, Color Universal Design, 2008.
pub(super) const ORANGE: Rgb = [230, 159, 0];
pub(super) const SKY: Rgb = [86, 180, 233];
pub(super) const GREEN: Rgb = [0, 158, 115];
pub(super) const YELLOW: Rgb = [240, 228, 66];
pub(super) const BLUE: Rgb = [0, 114, 178];
pub(super) const VERMILLION: Rgb = [213, 94, 0];
pub(super) const PURPLE: Rgb = [204, 121, 167];

/// Greatest coordinate that is drawn, in pixels: far beyond any picture, and safe in the 32-bit numbers of the renderer.
const FAR: f64 = 1e6;

/// Longest side of a picture, in pixels: beyond it viewers and message buffers have trouble.
pub(super) const MAX_SIDE: u32 = 8192;

/// Sizes of text, by height of a line in pixels.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Size {
    Small,
    Normal,
    Large,
}

impl Size {
    fn raster(self) -> RasterHeight {
        match self {
            Size::Small => RasterHeight::Size16,
            Size::Normal => RasterHeight::Size20,
            Size::Large => RasterHeight::Size32,
        }
    }

    /// Height of a line, in pixels.
    pub(super) fn height(self) -> f64 {
        self.raster().val() as f64
    }

    /// Width of a text, in pixels.
    pub(super) fn width(self, text: &str, bold: bool) -> f64 {
        (text.chars().count() * get_raster_width(weight(bold), self.raster())) as f64
    }
}

fn weight(bold: bool) -> FontWeight {
    if bold { FontWeight::Bold } else { FontWeight::Regular }
}

/// How a line is drawn.
#[derive(Clone, Copy)]
pub(super) struct Pen {
    pub(super) colour: Rgb,
    pub(super) width: f64,
    pub(super) opacity: f32,
    pub(super) dashed: bool,
}

impl Pen {
    pub(super) fn new(colour: Rgb, width: f64) -> Self {
        Self { colour, width, opacity: 1.0, dashed: false }
    }

    pub(super) fn opacity(self, opacity: f32) -> Self {
        Self { opacity, ..self }
    }

    pub(super) fn dashed(self, dashed: bool) -> Self {
        Self { dashed, ..self }
    }
}

/// A picture in the making. Coordinates are those of the picture: pixels, x right, y down.
pub(super) struct Canvas {
    pixmap: Pixmap,
}

impl Canvas {
    /// An empty picture; sides are kept within 1 to [`MAX_SIDE`]. None where memory doesn't suffice.
    pub(super) fn new(width: f64, height: f64, colour: Rgb) -> Option<Self> {
        let side = |v: f64| if v.is_finite() { (v.ceil() as u32).clamp(1, MAX_SIDE) } else { 1 };
        let mut pixmap = Pixmap::new(side(width), side(height))?;
        pixmap.fill(solid(colour, 1.0));
        Some(Self { pixmap })
    }

    pub(super) fn finish(self) -> RgbImage {
        let (width, height) = (self.pixmap.width(), self.pixmap.height());
        let mut picture = RgbImage::new(width, height);
        for (to, from) in picture.pixels_mut().zip(self.pixmap.pixels()) {
            to.0 = [from.red(), from.green(), from.blue()];
        }
        picture
    }

    /// A line through points; `closed` joins the last to the first.
    pub(super) fn line(&mut self, points: impl IntoIterator<Item = Point>, closed: bool, pen: Pen) {
        // The renderer insists on a width.
        let drawable = pen.width > 0.0 && pen.width < FAR;
        let Some(path) = path(points, closed).filter(|_| drawable) else { return };
        let dash = if pen.dashed {
            let unit = (pen.width * 2.5) as f32;
            StrokeDash::new(vec![2.0 * unit, 1.6 * unit], 0.0)
        } else {
            None
        };
        let stroke = Stroke {
            width: pen.width as f32,
            line_cap: if pen.dashed { LineCap::Butt } else { LineCap::Round },
            line_join: LineJoin::Round,
            dash,
            ..Stroke::default()
        };
        self.pixmap.stroke_path(&path, &paint(pen.colour, pen.opacity), &stroke, Transform::identity(), None);
    }

    /// A filled polygon.
    pub(super) fn fill(&mut self, points: impl IntoIterator<Item = Point>, colour: Rgb, opacity: f32) {
        if let Some(path) = path(points, true) {
            let paint = paint(colour, opacity);
            self.pixmap.fill_path(&path, &paint, FillRule::EvenOdd, Transform::identity(), None);
        }
    }

    pub(super) fn rectangle(&mut self, low: Point, high: Point, colour: Rgb) {
        self.fill([low, Point::new(high.x, low.y), high, Point::new(low.x, high.y)], colour, 1.0);
    }

    pub(super) fn frame(&mut self, low: Point, high: Point, pen: Pen) {
        self.line([low, Point::new(high.x, low.y), high, Point::new(low.x, high.y)], true, pen);
    }

    /// A disc with a white ring, so that it shows on any ground.
    pub(super) fn disc(&mut self, centre: Point, radius: f64, colour: Rgb) {
        self.plain_disc(centre, radius + 1.5, WHITE);
        self.plain_disc(centre, radius, colour);
    }

    /// A disc with a coloured rim and a white middle.
    pub(super) fn ring(&mut self, centre: Point, radius: f64, colour: Rgb) {
        self.disc(centre, radius, colour);
        self.plain_disc(centre, 0.55 * radius, WHITE);
    }

    /// A square with a white edge.
    pub(super) fn square(&mut self, centre: Point, radius: f64, colour: Rgb) {
        for (radius, colour) in [(radius + 1.5, WHITE), (radius, colour)] {
            let reach = nalgebra::Vector2::repeat(radius);
            self.rectangle(centre - reach, centre + reach, colour);
        }
    }

    fn plain_disc(&mut self, centre: Point, radius: f64, colour: Rgb) {
        if !(centre.x.abs() < FAR && centre.y.abs() < FAR && radius < FAR) {
            return;
        }
        if let Some(path) = PathBuilder::from_circle(centre.x as f32, centre.y as f32, radius as f32) {
            self.pixmap.fill_path(&path, &paint(colour, 1.0), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// Copies a picture in: `sample` gives the colour at each pixel of the rectangle.
    pub(super) fn paint_pixels(&mut self, low: Point, high: Point, sample: impl Fn(f64, f64) -> Rgb) {
        let (width, height) = (self.pixmap.width(), self.pixmap.height());
        let clip = |v: f64, end: u32| v.round().clamp(0.0, f64::from(end)) as u32;
        for y in clip(low.y, height)..clip(high.y, height) {
            for x in clip(low.x, width)..clip(high.x, width) {
                let [r, g, b] = sample(f64::from(x), f64::from(y));
                self.blend(x as usize, y as usize, [r, g, b], 255);
            }
        }
    }

    /// Text with its upper left corner at `at`.
    pub(super) fn text(&mut self, at: Point, text: &str, size: Size, bold: bool, colour: Rgb) {
        let mut x = at.x.round() as i64;
        for letter in text.chars() {
            let glyph = get_raster(letter, weight(bold), size.raster())
                .or_else(|| get_raster('?', weight(bold), size.raster()));
            let Some(glyph) = glyph else { continue };
            for (dy, row) in glyph.rows().enumerate() {
                for (dx, &cover) in row.iter().enumerate() {
                    let (x, y) = (x + dx as i64, at.y.round() as i64 + dy as i64);
                    if x >= 0 && y >= 0 {
                        self.blend(x as usize, y as usize, colour, cover);
                    }
                }
            }
            x += glyph.width() as i64;
        }
    }

    /// Text in the middle of a point with a soft white ground.
    pub(super) fn label(&mut self, centre: Point, text: &str, size: Size, colour: Rgb) {
        let half = nalgebra::Vector2::new(0.5 * size.width(text, true), 0.5 * size.height());
        let pad = nalgebra::Vector2::new(2.0, -1.0);
        let (low, high) = (centre - half - pad, centre + half + pad);
        self.fill([low, Point::new(high.x, low.y), high, Point::new(low.x, high.y)], WHITE, 0.72);
        self.text(centre - half, text, size, true, colour);
    }

    fn blend(&mut self, x: usize, y: usize, [r, g, b]: Rgb, cover: u8) {
        let (width, height) = (self.pixmap.width() as usize, self.pixmap.height() as usize);
        if cover == 0 || x >= width || y >= height {
            return;
        }
        let pixel = &mut self.pixmap.pixels_mut()[y * width + x];
        let mix = |from: u8, to: u8| {
            let (from, to, cover) = (u32::from(from), u32::from(to), u32::from(cover));
            ((from * (255 - cover) + to * cover + 127) / 255) as u8
        };
        let mixed = [mix(pixel.red(), r), mix(pixel.green(), g), mix(pixel.blue(), b)];
        // The ground is opaque, so premultiplied and plain colours are the same.
        if let Some(mixed) = PremultipliedColorU8::from_rgba(mixed[0], mixed[1], mixed[2], 255) {
            *pixel = mixed;
        }
    }
}

/// A colour mixed with white: 0 gives white, 1 the colour.
pub(super) fn tint(colour: Rgb, strength: f64) -> Rgb {
    colour.map(|v| (255.0 + (f64::from(v) - 255.0) * strength).round() as u8)
}

fn solid([r, g, b]: Rgb, opacity: f32) -> Color {
    let mut colour = Color::from_rgba8(r, g, b, 255);
    colour.set_alpha(opacity.clamp(0.0, 1.0));
    colour
}

fn paint(colour: Rgb, opacity: f32) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color(solid(colour, opacity));
    paint
}

fn path(points: impl IntoIterator<Item = Point>, closed: bool) -> Option<tiny_skia::Path> {
    let mut builder = PathBuilder::new();
    for p in points.into_iter().filter(|p| p.x.abs() < FAR && p.y.abs() < FAR) {
        if builder.is_empty() {
            builder.move_to(p.x as f32, p.y as f32);
        } else {
            builder.line_to(p.x as f32, p.y as f32);
        }
    }
    if closed {
        builder.close();
    }
    builder.finish()
}
