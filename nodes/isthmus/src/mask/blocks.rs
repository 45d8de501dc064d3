//! A frame in blocks of pixels: what segmentation looks at before it looks at pixels.

use super::frame::Frame;
use crate::wide::widely;

/// Blocks that are looked at to find the ground: a shape of a thousandth of the frame still has several among them.
const SAMPLES: usize = 5_000;

/// Every so many of them tell the noise: a median of a thousand is known to a thirtieth.
pub(super) const NOISE_STEP: usize = 4;

/// A block that is looked at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) block: usize,
    // Of four bytes, so that they become floating point numbers in one step.
    pub(super) column: u32,
    pub(super) row: u32,
}

/// Means over square blocks of pixels.
#[derive(Debug, Clone, Default)]
pub(super) struct Blocks {
    /// Pixels along the side of a block.
    pub(super) size: usize,
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// One plane for a grey frame, three for a colour one.
    pub(super) planes: Vec<Vec<f32>>,
    /// The blocks that are looked at to find the ground, all over the frame.
    pub(super) samples: Vec<Sample>,
    /// Distance of these in a row, in blocks.
    pub(super) sample_step: usize,
    /// Their means, plane by plane.
    pub(super) sampled: Vec<Vec<f32>>,
    /// By how much the first pixel of every [`NOISE_STEP`]th of them differs from the next one.
    pub(super) steps: Vec<u8>,
    sums: Vec<u16>,
    words: Vec<u32>,
}

impl Blocks {
    /// Chooses the blocks that are looked at to find the ground.
    fn choose_samples(&mut self) {
        let (columns, rows) = (self.columns, self.rows);
        let step = ((columns * rows) as f64 / SAMPLES as f64).sqrt().round().max(1.0) as usize;
        // Frames of a few rows are looked at all along.
        let (across, down) = if rows < step {
            (step, 1)
        } else if columns < step {
            (1, step)
        } else {
            (step, step)
        };
        self.sample_step = across;
        self.samples.clear();
        for row in (0..rows).step_by(down) {
            // Each row begins elsewhere, so that narrow upright shapes are hit as well.
            let from = if columns > across { row / down % across } else { 0 };
            for column in (from..columns).step_by(across) {
                self.samples.push(Sample { block: row * columns + column, column: column as u32, row: row as u32 });
            }
        }
    }

    pub(super) fn fill(&mut self, frame: &Frame<'_>) {
        let channels = frame.format.channels();
        let (width, height) = (frame.width, frame.height);
        self.size = block_size(width.min(height));
        self.columns = width.div_ceil(self.size);
        self.rows = height.div_ceil(self.size);
        self.choose_samples();
        self.planes.resize_with(channels, Vec::new);
        for plane in &mut self.planes {
            plane.clear();
            plane.reserve(self.columns * self.rows);
        }
        self.steps.clear();
        for block_row in 0..self.rows {
            // Here, since the row is at hand.
            let row = frame.row(block_row * self.size);
            let samples = self.samples.iter().skip(self.steps.len() * NOISE_STEP).step_by(NOISE_STEP);
            let samples = samples.take_while(|s| s.row as usize == block_row);
            self.steps.extend(samples.map(|s| {
                let at = s.column as usize * self.size * channels;
                row[at].abs_diff(*row.get(at + channels).unwrap_or(&row[at]))
            }));
            let rows = block_row * self.size..height.min((block_row + 1) * self.size);
            // The usual blocks are summed several at a time; what is left of the row goes the common way.
            let done = match (&mut self.planes[..], self.size, rows.len()) {
                ([plane], 4, 4) => {
                    widely!(sum_blocks([0, 1, 2, 3].map(|k| frame.row(rows.start + k)), &mut self.words, plane))
                }
                _ => 0,
            };
            if done == width {
                continue;
            }
            let count = rows.len();
            self.sums.clear();
            self.sums.resize((width - done) * channels, 0);
            for y in rows {
                for (sum, p) in self.sums.iter_mut().zip(&frame.row(y)[done * channels..]) {
                    *sum += u16::from(*p);
                }
            }
            for (c, plane) in self.planes.iter_mut().enumerate() {
                plane.extend(self.sums.chunks(self.size * channels).map(|block| {
                    let sum: u32 = block.iter().skip(c).step_by(channels).map(|s| u32::from(*s)).sum();
                    sum as f32 / (block.len() / channels * count) as f32
                }));
            }
        }
        self.sampled.resize_with(channels, Vec::new);
        for (sampled, plane) in self.sampled.iter_mut().zip(&self.planes) {
            sampled.clear();
            sampled.extend(self.samples.iter().map(|s| plane[s.block]));
        }
    }
}

/// Appends the means of the blocks of 4 x 4 pixels of four rows; gives the number of columns done. Rows are read one after the other, as they lie in
/// memory.
#[inline(always)]
fn sum_blocks(rows: [&[u8]; 4], sums: &mut Vec<u32>, means: &mut Vec<f32>) -> usize {
    /// Every other byte of a word.
    const BYTES: u32 = 0x00ff_00ff;
    // Sums side by side in one word, of the even and the odd pixels. None outgrows its sixteen bits.
    let pairs = |word: [u8; 4]| {
        let word = u32::from_le_bytes(word);
        (word & BYTES) + (word >> 8 & BYTES)
    };
    let [first, middle @ .., last] = rows.map(|row| row.as_chunks::<4>().0);
    sums.clear();
    sums.resize(first.len(), 0);
    for (sum, word) in sums.iter_mut().zip(first) {
        *sum = pairs(*word);
    }
    for row in middle {
        for (sum, word) in sums.iter_mut().zip(row) {
            *sum += pairs(*word);
        }
    }
    let from = means.len();
    means.resize(from + last.len(), 0.0);
    for ((mean, sum), word) in means[from..].iter_mut().zip(&*sums).zip(last) {
        let sum = sum + pairs(*word);
        *mean = ((sum & 0xffff) + (sum >> 16)) as i32 as f32 / 16.0;
    }
    last.len() * 4
}

/// Side of a block in pixels: small pictures have small shapes.
fn block_size(frame_side: usize) -> usize {
    match frame_side {
        0..128 => 1,
        128..700 => 2,
        _ => 4,
    }
}
