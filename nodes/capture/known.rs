//! Which piece is which: names of pieces, and pieces that were seen before.
//!
//! A name must be the same whenever the same frame is seen again, after a restart as well, and must differ for different
//! pieces. So it is made from what identifies the frame: the file's name, or the stamp of the message.
//! A camera that looks at an unmoved table sends every piece again with every frame; one that covers the place of a
//! known piece of the same camera is that piece. A camera's frames may come on two topics, raw and compressed.

use std::collections::{HashMap, VecDeque};
use std::ops::Range;

use isthmus::mask::{Aoi, Cutout};

use crate::fields::camera;

/// What identifies a frame.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum FrameName {
    /// A file's name without its folder.
    File(String),
    /// A topic, and the stamp's seconds and nanoseconds.
    Stamp(String, i32, u32),
}

impl FrameName {
    /// File or topic, as `source` of the messages.
    pub fn source(&self) -> &str {
        match self {
            Self::File(name) | Self::Stamp(name, ..) => name,
        }
    }

    /// Name of the frame's only piece; several get a number more.
    pub fn base(&self) -> String {
        match self {
            Self::File(name) => plain(stem(name)),
            Self::Stamp(_, sec, nanosec) => plain(&format!("{sec}_{nanosec:09}")),
        }
    }

    /// What frames have in common whose pieces would have the same names: two topics may have frames of one stamp.
    fn key(&self) -> String {
        match self {
            Self::File(name) => name.clone(),
            Self::Stamp(..) => self.base(),
        }
    }
}

/// The names of the pieces of a frame: its own of a single one, with a number of several.
fn piece_ids(base: &str, count: usize) -> impl Iterator<Item = String> {
    (0..count).map(move |k| if count == 1 { base.to_owned() } else { format!("{base}_{k}") })
}

fn stem(file: &str) -> &str {
    file.rsplit_once('.').map_or(file, |(stem, _)| stem)
}

/// Names become names of coordinate frames, in which a slash would divide and a space confuse.
fn plain(name: &str) -> String {
    name.chars().map(|c| if c.is_alphanumeric() || "_-.".contains(c) { c } else { '_' }).collect()
}

/// Frames that are remembered, so that one seen again gives the same names: some minutes of a camera, and far more
/// than the frames of any recorded puzzle.
const FRAMES_KEPT: usize = 8192;

/// Pieces whose places are remembered; four times the largest common puzzle.
const PIECES_KEPT: usize = 4096;

/// Bits of a word, as a number of columns.
const WORD: i32 = u64::BITS as i32;

/// The name of a cutout, and whether it is to be published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Admission {
    /// Name of the piece.
    pub id: String,
    /// False where a known piece was seen again in the same place.
    pub publish: bool,
}

/// The frames and pieces seen so far.
#[derive(Debug, Default)]
pub struct Known {
    /// By their keys: hash of the content, names of the pieces.
    frames: HashMap<String, Vec<(u64, Vec<String>)>>,
    frame_order: VecDeque<String>,
    /// Which file a piece is of, by the piece's name.
    files: HashMap<String, String>,
    places: VecDeque<Place>,
}

/// Where a piece was seen: a bit a pixel, in words that begin at multiples of 64 columns of the frame, so that those of two
/// pieces lie over each other.
#[derive(Debug)]
struct Place {
    id: String,
    camera: String,
    /// The words across, and the rows.
    words: Range<i32>,
    rows: Range<i32>,
    bits: Vec<u64>,
    area: u32,
}

impl Known {
    /// Names the cutouts of a frame. `content` is a hash of the frame's content; `overlap` the share of area from which
    /// a piece counts as seen before.
    pub fn admit(&mut self, frame: &FrameName, content: u64, cutouts: &[Cutout], overlap: f64) -> Vec<Admission> {
        let seen = self.frames.get(&frame.key());
        if let Some((_, ids)) =
            seen.and_then(|all| all.iter().find(|(hash, ids)| (*hash, ids.len()) == (content, cutouts.len())))
        {
            // The same frame again (a replay, or a wish to see it again): the same pieces.
            return ids.iter().map(|id| Admission { id: id.clone(), publish: true }).collect();
        }
        let mut base = frame.base();
        if seen.is_some_and(|all| !all.is_empty()) {
            // Another frame with the stamp of a known one (some cameras leave it zero, or send frames in two ways).
            base = format!("{base}_{content:016x}");
        }
        if let FrameName::File(name) = frame {
            let is_other = |id: String| self.files.get(&id).is_some_and(|other| other != name);
            if piece_ids(&base, cutouts.len()).any(is_other) {
                base = plain(name);
            }
            self.files.extend(piece_ids(&base, cutouts.len()).map(|id| (id, name.clone())));
        }
        let admissions: Vec<Admission> = piece_ids(&base, cutouts.len())
            .zip(cutouts)
            .map(|(id, cutout)| match frame {
                FrameName::File(_) => Admission { id, publish: true },
                FrameName::Stamp(source, ..) => self.admit_place(source, id, cutout, overlap),
            })
            .collect();
        self.remember(frame, content, &admissions);
        admissions
    }

    fn admit_place(&mut self, source: &str, id: String, cutout: &Cutout, overlap: f64) -> Admission {
        let place = Place::new(id, source, cutout);
        if let Some(known) = self.places.iter().find(|known| known.overlaps(&place, overlap)) {
            return Admission { id: known.id.clone(), publish: false };
        }
        let id = place.id.clone();
        if self.places.len() >= PIECES_KEPT {
            self.places.pop_front();
        }
        self.places.push_back(place);
        Admission { id, publish: true }
    }

    fn remember(&mut self, frame: &FrameName, content: u64, admissions: &[Admission]) {
        let ids = admissions.iter().map(|a| a.id.clone()).collect();
        self.frames.entry(frame.key()).or_default().push((content, ids));
        self.frame_order.push_back(frame.key());
        if self.frame_order.len() > FRAMES_KEPT
            && let Some(oldest) = self.frame_order.pop_front()
            && let Some(contents) = self.frames.get_mut(&oldest)
        {
            contents.remove(0);
            if contents.is_empty() {
                self.frames.remove(&oldest);
            }
        }
    }
}

impl Place {
    fn new(id: String, source: &str, cutout: &Cutout) -> Self {
        let Aoi { x, y, width, height } = cutout.aoi;
        let right = x + width as i32;
        let words = x.div_euclid(WORD)..right.div_euclid(WORD) + 1;
        let mut place = Self {
            id,
            camera: camera(source).to_owned(),
            bits: vec![0; words.len() * height as usize],
            words,
            rows: y..y + height as i32,
            area: 0,
        };
        let threshold = (cutout.shape_level + cutout.ground_level) / 2.0;
        let bright = cutout.shape_level > cutout.ground_level;
        let left = (x - cutout.window.x).max(0) as usize;
        let top = (y - cutout.window.y).max(0) as usize;
        let before = x.rem_euclid(WORD) as usize;
        let lines = place.bits.chunks_exact_mut(place.words.len());
        for (row, line) in lines.enumerate() {
            let start = (top + row) * cutout.window.width as usize + left;
            let Some(pixels) = cutout.pixels.get(start..start + width as usize) else { break };
            for (column, &pixel) in pixels.iter().enumerate() {
                if (f32::from(pixel) > threshold) == bright {
                    let bit = before + column;
                    line[bit / WORD as usize] |= 1 << (bit % WORD as usize);
                    place.area += 1;
                }
            }
        }
        place
    }

    /// Whether the area that both cover is at least this share of what either covers, for the same camera.
    fn overlaps(&self, other: &Self, share: f64) -> bool {
        let (smaller, larger) = (self.area.min(other.area), self.area.max(other.area));
        // The share can't exceed the ratio of the areas, by which most pieces differ.
        if self.camera != other.camera || smaller == 0 || f64::from(smaller) < share * f64::from(larger) {
            return false;
        }
        let common = |a: &Range<i32>, b: &Range<i32>| a.start.max(b.start)..a.end.min(b.end);
        let words = common(&self.words, &other.words);
        if words.is_empty() {
            return false;
        }
        let in_row = |y| self.line(y, &words).iter().zip(other.line(y, &words)).map(|(a, b)| (a & b).count_ones());
        let both: u32 = common(&self.rows, &other.rows).flat_map(in_row).sum();
        f64::from(both) >= share * f64::from(self.area + other.area - both)
    }

    /// Some of the words of a row.
    fn line(&self, y: i32, words: &Range<i32>) -> &[u64] {
        let start = (y - self.rows.start) as usize * self.words.len() + (words.start - self.words.start) as usize;
        &self.bits[start..start + words.len()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OVERLAP: f64 = 0.97;

    /// A disc of this radius.
    fn disc(x: i32, y: i32, radius: i32) -> Cutout {
        let size = (2 * radius + 1) as u32;
        let aoi = Aoi { x: x - radius, y: y - radius, width: size, height: size };
        let pixels = (-radius..=radius)
            .flat_map(|v| (-radius..=radius).map(move |u| if u * u + v * v <= radius * radius { 20 } else { 230 }))
            .collect();
        Cutout { aoi, window: aoi, pixels, shape_level: 20.0, ground_level: 230.0, noise_level: 1.0 }
    }

    fn stamp(sec: i32) -> FrameName {
        FrameName::Stamp("/image".to_owned(), sec, 5)
    }

    fn ids(admissions: &[Admission]) -> Vec<(&str, bool)> {
        admissions.iter().map(|a| (a.id.as_str(), a.publish)).collect()
    }

    #[test]
    fn names_come_from_stamp_or_file() {
        let mut known = Known::default();
        let one = [disc(100, 100, 40)];
        let two = [disc(100, 300, 40), disc(300, 300, 50)];
        assert_eq!(ids(&known.admit(&stamp(1), 1, &one, OVERLAP)), [("1_000000005", true)]);
        assert_eq!(ids(&known.admit(&stamp(2), 2, &two, OVERLAP)), [("2_000000005_0", true), ("2_000000005_1", true)]);
        let file = FrameName::File("my piece/1.png".to_owned());
        assert_eq!(ids(&known.admit(&file, 3, &one, OVERLAP)), [("my_piece_1", true)]);
    }

    #[test]
    fn a_frame_seen_again_gives_the_same_names() {
        let (mut first, mut restarted) = (Known::default(), Known::default());
        let frame = [disc(100, 100, 40), disc(300, 300, 50)];
        let before = first.admit(&stamp(1), 7, &frame, OVERLAP);
        assert_eq!(first.admit(&stamp(1), 7, &frame, OVERLAP), before);
        assert_eq!(restarted.admit(&stamp(1), 7, &frame, OVERLAP), before);
    }

    #[test]
    fn a_piece_that_stays_is_published_once() {
        let mut known = Known::default();
        let first = known.admit(&stamp(1), 1, &[disc(100, 100, 60)], OVERLAP);
        let again = known.admit(&stamp(2), 2, &[disc(100, 101, 60), disc(300, 100, 60)], OVERLAP);
        assert_eq!(ids(&again), [(first[0].id.as_str(), false), ("2_000000005_1", true)]);
        let other_size = known.admit(&stamp(3), 3, &[disc(100, 100, 50)], OVERLAP);
        assert_eq!(ids(&other_size), [("3_000000005", true)]);
        let compressed = FrameName::Stamp("/image/compressed".to_owned(), 3, 5);
        let other_way = known.admit(&compressed, 4, &[disc(101, 100, 50), disc(500, 100, 60)], OVERLAP);
        assert_eq!(ids(&other_way)[0], ("3_000000005", false));
        let other_camera = FrameName::Stamp("/other/compressed".to_owned(), 3, 5);
        let other = known.admit(&other_camera, 5, &[disc(100, 100, 60)], OVERLAP);
        let all = [&other_size[0].id, &other_way[1].id, &other[0].id];
        assert!(other[0].publish && all[0] != all[1] && all[0] != all[2] && all[1] != all[2], "{all:?}");
    }

    #[test]
    fn areas_are_compared_pixel_by_pixel() {
        const RADIUS: i32 = 40;
        let is_within = |x: i32, y: i32| x * x + y * y <= RADIUS * RADIUS;
        // Wherever the words of a row begin.
        for (x, shift) in (60..130).flat_map(|x| (0..4).map(move |shift| (x, shift))) {
            let [here, there] = [x, x + shift].map(|x| Place::new("p".into(), "/image", &disc(x, 100, RADIUS)));
            let pixels = (-RADIUS..=RADIUS).flat_map(|v| (-RADIUS..=RADIUS + shift).map(move |u| (u, v)));
            let [mut both, mut either] = [0_u32; 2];
            for (u, v) in pixels {
                both += u32::from(is_within(u, v) && is_within(u - shift, v));
                either += u32::from(is_within(u, v) || is_within(u - shift, v));
            }
            let share = f64::from(both) / f64::from(either);
            assert!(here.overlaps(&there, share - 1e-9) && !here.overlaps(&there, share + 1e-9), "{x} {shift}");
        }
    }

    #[test]
    fn equal_stamps_with_other_content_are_told_apart() {
        let mut known = Known::default();
        let first = known.admit(&stamp(0), 1, &[disc(100, 100, 40)], OVERLAP);
        let second = known.admit(&stamp(0), 2, &[disc(300, 100, 40)], OVERLAP);
        assert_ne!(first[0].id, second[0].id);
        assert!(second[0].publish);
        assert_eq!(known.admit(&stamp(0), 2, &[disc(300, 100, 40)], OVERLAP), second);
    }

    #[test]
    fn files_of_one_stem_are_told_apart() {
        let mut known = Known::default();
        let name = |file: &str| FrameName::File(file.to_owned());
        let first = known.admit(&name("a.png"), 1, &[disc(100, 100, 40)], OVERLAP);
        let second = known.admit(&name("a.jpg"), 2, &[disc(100, 100, 40)], OVERLAP);
        assert_eq!((first[0].id.as_str(), second[0].id.as_str()), ("a", "a.jpg"));
        // The second piece of one file would have the name of the only one of another.
        known.admit(&name("scan.png"), 3, &[disc(100, 100, 40), disc(300, 100, 40)], OVERLAP);
        let only = known.admit(&name("scan_1.png"), 4, &[disc(100, 100, 40)], OVERLAP);
        assert_eq!(ids(&only), [("scan_1.png", true)]);
    }

    #[test]
    fn memory_is_bounded() {
        let mut known = Known::default();
        for sec in 0..(FRAMES_KEPT as i32 + 100) {
            known.admit(&stamp(sec), 1, &[], OVERLAP);
        }
        assert_eq!((known.frames.len(), known.frame_order.len()), (FRAMES_KEPT, FRAMES_KEPT));
    }
}
