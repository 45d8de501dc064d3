//! Frames as a camera would see them.

use ab_glyph_rasterizer::Rasterizer;
use isthmus::Point;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::{BLUR_REACH, Lighting, Options, Puzzle, rng, stream};

/// Grey levels of bright and dark, away from the ends of the scale so that noise is not clipped at once.
const BRIGHT: f32 = 225.0;
const DARK: f32 = 30.0;

/// A grey picture, row by row from the upper left corner.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Grey levels, `width * height` of them.
    pub pixels: Vec<u8>,
}

impl Puzzle {
    /// Renders a frame. Any order of the calls gives the same frames.
    ///
    /// A frame beyond the last is empty ground.
    pub fn render(&self, frame: usize) -> Frame {
        let options = self.options();
        let [width, height] = options.frame_size();
        let mut coverage = vec![0.0_f32; width as usize * height as usize];
        for (k, _) in self.pieces().iter().enumerate().filter(|(_, piece)| piece.frame == frame) {
            let window = Window::of(&self.outline(k), BLUR_REACH * options.blur).blurred(options.blur);
            window.add_to(&mut coverage, width as usize);
        }
        let mut rng = rng(options.seed, stream::FRAMES + frame as u64);
        Frame { width, height, pixels: expose(options, &coverage, width, height, &mut rng) }
    }
}

/// Coverage of a part of the frame, 0 to 1 for each pixel.
pub(super) struct Window {
    x: i64,
    y: i64,
    width: usize,
    height: usize,
    pub(super) coverage: Vec<f32>,
}

impl Window {
    /// Exact area of each pixel that lies within the outline, with `margin` pixels of ground all round.
    pub(super) fn of(outline: &[Point], margin: f64) -> Self {
        let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
        for p in outline {
            low = [low[0].min(p.x), low[1].min(p.y)];
            high = [high[0].max(p.x), high[1].max(p.y)];
        }
        let margin = margin.ceil() + 1.0;
        let [x, y] = low.map(|v| (v - margin).floor());
        let [width, height] = [(high[0] + margin).ceil() - x, (high[1] + margin).ceil() - y].map(|v| v as usize + 1);
        let mut rasterizer = Rasterizer::new(width, height);
        // Pixel centres lie at whole numbers; the rasterizer's pixel (0, 0) reaches from 0 to 1.
        let local = |p: Point| ab_glyph_rasterizer::point((p.x - x + 0.5) as f32, (p.y - y + 0.5) as f32);
        for (k, &p) in outline.iter().enumerate() {
            rasterizer.draw_line(local(p), local(outline[(k + 1) % outline.len()]));
        }
        let mut coverage = vec![0.0; width * height];
        rasterizer.for_each_pixel(|k, c| coverage[k] = c.abs().min(1.0));
        Self { x: x as i64, y: y as i64, width, height, coverage }
    }

    fn blurred(mut self, sigma: f64) -> Self {
        if sigma <= 0.0 {
            return self;
        }
        let reach = (BLUR_REACH * sigma).ceil() as usize;
        let mut kernel: Vec<f32> =
            (0..=2 * reach).map(|k| (-0.5 * ((k as f64 - reach as f64) / sigma).powi(2)).exp() as f32).collect();
        let sum: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|k| *k /= sum);
        // Two passes along rows, transposing each time: the second runs along what were columns.
        for _ in 0..2 {
            let mut out = vec![0.0; self.coverage.len()];
            let mut padded = vec![0.0; self.width + 2 * reach];
            for (y, row) in self.coverage.chunks_exact(self.width).enumerate() {
                padded[reach..reach + self.width].copy_from_slice(row);
                for (x, patch) in padded.windows(kernel.len()).enumerate() {
                    out[x * self.height + y] = patch.iter().zip(&kernel).map(|(a, b)| a * b).sum();
                }
            }
            self.coverage = out;
            (self.width, self.height) = (self.height, self.width);
        }
        self
    }

    fn add_to(&self, coverage: &mut [f32], frame_width: usize) {
        let frame_height = coverage.len() / frame_width;
        for (row, y) in self.coverage.chunks_exact(self.width).zip(self.y..) {
            if y < 0 || y as usize >= frame_height {
                continue;
            }
            for (&c, x) in row.iter().zip(self.x..) {
                if x >= 0 && (x as usize) < frame_width {
                    coverage[y as usize * frame_width + x as usize] += c;
                }
            }
        }
    }
}

/// From coverage to grey levels: light, vignette, noise.
fn expose(options: &Options, coverage: &[f32], width: u32, height: u32, rng: &mut ChaCha8Rng) -> Vec<u8> {
    let (ground, piece) = match options.lighting {
        Lighting::Back => (BRIGHT, DARK),
        Lighting::Front => (DARK, BRIGHT),
    };
    let (centre_x, centre_y) = ((f64::from(width) - 1.0) / 2.0, (f64::from(height) - 1.0) / 2.0);
    let corner = (centre_x * centre_x + centre_y * centre_y).max(1.0);
    // `check` has made sure that the deviation is finite and not negative, the only things `new` refuses.
    let noise = (options.noise > 0.0).then(|| Normal::new(0.0, options.noise as f32).ok()).flatten();
    let mut pixels = Vec::with_capacity(coverage.len());
    for (y, row) in coverage.chunks_exact(width as usize).enumerate() {
        let dy = (y as f64 - centre_y).powi(2);
        for (x, &c) in row.iter().enumerate() {
            let mut level = ground + (piece - ground) * c.min(1.0);
            if options.vignette > 0.0 {
                let dx = (x as f64 - centre_x).powi(2);
                level *= (1.0 - options.vignette * (dx + dy) / corner) as f32;
            }
            if let Some(noise) = noise {
                level += noise.sample(rng);
            }
            pixels.push(level.round().clamp(0.0, 255.0) as u8);
        }
    }
    pixels
}
