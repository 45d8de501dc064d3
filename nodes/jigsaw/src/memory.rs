//! What is remembered from one solution to the next, so that one more piece costs little.
//!
//! Contacts and overlaps are evaluated where the pose, rounded to a grid, lies; a contact's right side is carried from
//! there to the pose itself by its own normal matrix, which at such distances is exact to the second order. So the figures
//! depend on the two pieces and the pose alone, whether they are computed or remembered, and a small change of the poses
//! (another piece far away) costs next to nothing. Eq. 1 of what is mated, and the fits that a second look tried, depend on
//! two isthmuses alone. What the last solution did not ask for is forgotten.
//!
//! Complexity O(1) to remember; a remembered figure takes some 300 bytes, and a solution asks for about ten of each pair of
//! neighbours.

use crate::contact::{ClearancePrior, Contact, Equations, follow, overlap_area};
use crate::matching::Match;
use crate::outline::Outline;
use isthmus::Point;
use nalgebra::{Isometry2, UnitComplex, Vector2, Vector3};
use rustc_hash::FxHashMap;
use std::sync::{Mutex, PoisonError};

/// An isthmus: the serial number of its piece, and its place among the tabs, or the mouths, of that.
pub(crate) type Isthmus = (u64, usize);

/// Meshes of the grid of poses along the sampling step of a contact: half a mesh off, the linearised distances err by
/// less than a thousandth of the step.
const MESHES: f64 = 10.0;
/// Mesh of the grid of poses for overlaps, in piece scales: along a side one scale long half a mesh makes a twentieth of the
/// overlap that is tolerated.
const OVERLAP_MESH: f64 = 0.002;
/// Parts of the memory that are locked apart, so that threads seldom wait for one another.
const SHARDS: usize = 16;

/// Two pieces, how finely they are looked at, and the pose on the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    pieces: [u64; 2],
    stride: usize,
    pose: [i64; 3],
}

/// A pose rounded to a grid: where the centroid lies, and the angle.
struct Rounded {
    place: [i64; 3],
    centre: Point,
    angle: f64,
    /// From there to the pose itself.
    shift: Vector2<f64>,
    turn: f64,
}

impl Rounded {
    /// `mesh` in piece scales, which as an angle moves what is a scale away by as much.
    fn new(a: &Outline, b_from_a: &Isometry2<f64>, mesh: f64) -> Self {
        let (centre, angle) = (b_from_a * a.centroid, b_from_a.rotation.angle());
        let length = mesh * a.scale;
        let place = [centre.x / length, centre.y / length, angle / mesh].map(|v| v.round() as i64);
        let [x, y, steps] = place.map(|v| v as f64);
        let rounded = Point::new(x * length, y * length);
        Self { place, centre: rounded, angle: steps * mesh, shift: centre - rounded, turn: angle - steps * mesh }
    }

    /// The rounded pose.
    fn pose(&self, a: &Outline) -> Isometry2<f64> {
        let rotation = UnitComplex::new(self.angle);
        Isometry2::from_parts((self.centre.coords - rotation * a.centroid.coords).into(), rotation)
    }

    /// Small motion at a point (of `b`'s image) from the rounded pose to the pose itself.
    fn motion_at(&self, at: &Point) -> Vector3<f64> {
        let arm = at - self.centre;
        let shift = self.shift + UnitComplex::new(self.turn) * arm - arm;
        Vector3::new(shift.x, shift.y, self.turn)
    }
}

#[derive(Debug, Default)]
struct Shard {
    /// Figures with the number of the solution that asked last.
    contacts: FxHashMap<Key, (u32, Option<Equations>)>,
    overlaps: FxHashMap<Key, (u32, f64)>,
    correlations: FxHashMap<[Isthmus; 2], (u32, f64)>,
    /// By mouth, then by tab.
    matches: FxHashMap<Isthmus, (u32, FxHashMap<Isthmus, Match>)>,
}

/// Figures that have been computed.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    shards: [Mutex<Shard>; SHARDS],
    solution: u32,
}

/// A copy remembers nothing, so that the serial numbers of its pieces are its own.
impl Clone for Memory {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl Memory {
    fn shard(&self, pieces: [u64; 2]) -> std::sync::MutexGuard<'_, Shard> {
        let sum = pieces[0].wrapping_mul(31).wrapping_add(pieces[1]) as usize;
        // What a panicking thread left behind are whole entries.
        self.shards[sum % SHARDS].lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Forgets what the last solution didn't ask for.
    pub(crate) fn next_solution(&mut self) {
        let last = self.solution;
        for shard in &mut self.shards {
            let shard = shard.get_mut().unwrap_or_else(PoisonError::into_inner);
            shard.contacts.retain(|_, v| v.0 == last);
            shard.overlaps.retain(|_, v| v.0 == last);
            shard.correlations.retain(|_, v| v.0 == last);
            shard.matches.retain(|_, v| v.0 == last);
        }
        self.solution = last.wrapping_add(1);
    }

    /// Area in which two pieces overlap, in square pixels: exact for shallow overlaps, large for deep ones.
    pub(crate) fn overlap(&self, a: &Outline, b: &Outline, b_from_a: &Isometry2<f64>) -> f64 {
        let centre = b_from_a * a.centroid;
        if (centre - b.centroid).norm() > a.radius + b.radius {
            return 0.0;
        }
        let rounded = Rounded::new(a, b_from_a, OVERLAP_MESH);
        let key = Key { pieces: [a.serial, b.serial], stride: 0, pose: rounded.place };
        if let Some(known) = self.shard(key.pieces).overlaps.get_mut(&key) {
            known.0 = self.solution;
            return known.1;
        }
        let area = overlap_area(a, b, &rounded.pose(a));
        self.shard(key.pieces).overlaps.insert(key, (self.solution, area));
        area
    }

    /// What was seen of the tabs that a mouth was compared with, once; to be kept again.
    pub(crate) fn matches(&self, mouth: Isthmus) -> FxHashMap<Isthmus, Match> {
        self.shard([mouth.0; 2]).matches.remove(&mouth).map_or_else(FxHashMap::default, |known| known.1)
    }

    /// Keeps what is seen of the tabs that a mouth is compared with.
    pub(crate) fn keep_matches(&self, mouth: Isthmus, matches: FxHashMap<Isthmus, Match>) {
        self.shard([mouth.0; 2]).matches.insert(mouth, (self.solution, matches));
    }

    /// Eq. 1 of a tab and a mouth.
    pub(crate) fn correlation(&self, tab: Isthmus, mouth: Isthmus, compute: impl FnOnce() -> f64) -> f64 {
        let pieces = [tab.0, mouth.0];
        if let Some(known) = self.shard(pieces).correlations.get_mut(&[tab, mouth]) {
            known.0 = self.solution;
            return known.1;
        }
        let value = compute();
        self.shard(pieces).correlations.insert([tab, mouth], (self.solution, value));
        value
    }

    /// What two pieces within `band` piece scales of each other say about their pose, from a point each `step` scales.
    pub(crate) fn contact(
        &self,
        a: &Outline,
        b: &Outline,
        b_from_a: &Isometry2<f64>,
        (band, step): (f64, f64),
        prior: &ClearancePrior,
    ) -> Option<Contact> {
        let stride = ((a.scale * step / a.spacing) as usize).max(1);
        let rounded = Rounded::new(a, b_from_a, step / MESHES);
        let key = Key { pieces: [a.serial, b.serial], stride, pose: rounded.place };
        let contact = |equations: &Equations| equations.contact(&rounded.motion_at(&equations.centre), prior);
        if let Some(known) = self.shard(key.pieces).contacts.get_mut(&key) {
            known.0 = self.solution;
            return known.1.as_ref().map(contact);
        }
        let computed = follow(a, b, &rounded.pose(a), 0.5 * band * (a.scale + b.scale), stride);
        self.shard(key.pieces).contacts.insert(key, (self.solution, computed));
        computed.as_ref().map(contact)
    }
}
