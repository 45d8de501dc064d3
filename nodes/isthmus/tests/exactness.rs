//! Necks that are known exactly are found, at the right place, on outlines and in pictures.

#![allow(clippy::unwrap_used, reason = "test program: its functions beside the tests fail by panic too")]

mod shapes;

use isthmus::isthmus::Isthmus;
use isthmus::{Extractor, Features, contour::Border};
use shapes::{Camera, Neck, Piece, pose};

/// A found isthmus belongs to the true one whose middle is this near, in pixels.
const SAME: f64 = 4.0;

/// Most superfluous isthmuses a piece that are taken for real ones: salient positive, and any negative.
const SUPERFLUOUS: [f64; 2] = [0.2, 0.1];
/// Most superfluous waists of the body a piece, not salient.
const WAISTS: f64 = 2.0;

/// How exact pictures of a kind must be, in pixels.
struct Limits {
    /// Median distance of isthmus points.
    median: f64,
    /// Greatest distance of an isthmus point.
    most: f64,
    /// Greatest distance of a critical point.
    ends: f64,
}

fn nearest<'a>(features: &'a Features, neck: &Neck) -> Option<&'a Isthmus> {
    features
        .isthmuses
        .iter()
        .filter(|i| i.polarity == neck.polarity)
        .min_by(|a, b| (a.point - neck.middle()).norm().total_cmp(&(b.point - neck.middle()).norm()))
        .filter(|i| (i.point - neck.middle()).norm() < SAME)
}

/// What is measured on many pieces.
#[derive(Debug, Default)]
struct Score {
    pieces: usize,
    true_necks: usize,
    missed: usize,
    not_salient: usize,
    superfluous: [usize; 2],
    superfluous_salient: [usize; 2],
    middle: Vec<f64>,
    ends: Vec<f64>,
}

impl Score {
    fn add(&mut self, features: &Features, necks: &[Neck]) {
        self.pieces += 1;
        self.true_necks += necks.len();
        let mut used = Vec::new();
        for neck in necks {
            let Some(found) = nearest(features, neck) else {
                self.missed += 1;
                continue;
            };
            self.not_salient += usize::from(!found.salient);
            used.push(found.point);
            self.middle.push((found.point - neck.middle()).norm());
            let end = |p: isthmus::Point| neck.ends.iter().map(|q| (p - q).norm()).fold(f64::MAX, f64::min);
            self.ends.extend(found.critical_points.map(end));
        }
        for i in features.isthmuses.iter().filter(|i| !used.contains(&i.point)) {
            self.superfluous[i.polarity as usize] += 1;
            self.superfluous_salient[i.polarity as usize] += usize::from(i.salient);
        }
    }

    /// Nothing missed, little superfluous, everything where it should be.
    fn check(&mut self, limits: &Limits, what: &str) {
        let summary = format!("{what}: {}", self.summary());
        println!("{summary}");
        assert_eq!((self.missed, self.not_salient), (0, 0), "{summary}");
        let a_piece = |count: usize| count as f64 / self.pieces as f64;
        assert!(a_piece(self.superfluous_salient[0]) <= SUPERFLUOUS[0], "{summary}");
        assert!(a_piece(self.superfluous[1]) <= SUPERFLUOUS[1], "{summary}");
        assert!(a_piece(self.superfluous[0]) <= WAISTS, "{summary}");
        // The summary has sorted them.
        let most = |v: &[f64]| v.last().copied().unwrap_or(f64::NAN);
        assert!(self.middle[self.middle.len() / 2] <= limits.median, "{summary}");
        assert!(most(&self.middle) <= limits.most, "{summary}");
        assert!(most(&self.ends) <= limits.ends, "{summary}");
    }

    fn summary(&mut self) -> String {
        let quantiles = |v: &mut Vec<f64>| {
            v.sort_by(f64::total_cmp);
            let at = |q: f64| v.get(((v.len() - 1) as f64 * q) as usize).copied().unwrap_or(f64::NAN);
            [at(0.5), at(0.95), at(1.0)]
        };
        let (middle, ends) = (quantiles(&mut self.middle), quantiles(&mut self.ends));
        format!(
            "{} pieces, {} necks, missed {}, not salient {}, superfluous {:?} (salient {:?}), middle {middle:.3?}, ends {ends:.3?}",
            self.pieces, self.true_necks, self.missed, self.not_salient, self.superfluous, self.superfluous_salient
        )
    }
}

#[test]
fn outlines() {
    let mut score = Score::default();
    for seed in 0..40 {
        let piece = Piece::random(300.0, seed);
        let pose = pose(seed as f64 * 0.7, 1.0, 256.3, 255.6);
        let features = Features::from_border(Border::from_points(&piece.outline(&pose)).unwrap(), 0.0).unwrap();
        score.add(&features, &piece.necks(&pose));
    }
    score.check(&Limits { median: 0.01, most: 0.02, ends: 0.03 }, "outlines");
}

#[test]
fn pictures() {
    // What noise and blur leave undecided grows with them: a quarter more than was measured.
    for (noise, blur, median, most, ends) in [
        (0.0, 0.8, 0.03, 0.15, 0.2),
        (10.0, 1.0, 0.12, 0.4, 0.5),
        (20.0, 1.0, 0.18, 0.5, 0.7),
        (20.0, 4.0, 0.3, 0.9, 1.6),
        (40.0, 1.0, 0.35, 1.0, 1.2),
        (40.0, 4.0, 0.5, 1.4, 2.1),
    ] {
        let mut score = Score::default();
        let mut extractor = Extractor::default();
        for seed in 0..20 {
            let piece = Piece::random(250.0, seed);
            let pose = pose(seed as f64 * 0.7, 1.0, 256.3, 255.6);
            let camera = Camera { noise, blur, seed, ..Camera::default() };
            let features = extractor.extract(&camera.cutout(&piece.outline(&pose))).unwrap();
            score.add(&features, &piece.necks(&pose));
        }
        score.check(&Limits { median, most, ends }, &format!("noise {noise} blur {blur}"));
    }
}

/// The pixel grid leaves no waves on edges that run nearly along it, in pictures sharper than the grid.
#[test]
fn edges_along_the_grid() {
    /// Root mean square of the points' distances from the edge, in pixels: five times that of quantised grey levels.
    const WAVES: f64 = 0.004;
    /// Half the side of a square, and how much of it next to a corner is left out.
    const HALF: f64 = 90.0;
    const CORNER: f64 = 30.0;
    for degrees in [1.0, 2.0, 3.0, 5.0, 8.0, 12.0] {
        let image_from_square = pose(f64::to_radians(degrees), 1.0, 256.3, 255.6);
        let corners = [[-HALF, -HALF], [HALF, -HALF], [HALF, HALF], [-HALF, HALF]];
        let outline = corners.map(|[x, y]| image_from_square * isthmus::Point::new(x, y));
        let camera = Camera { blur: 0.0, ..Camera::default() };
        let (border, _) = Border::from_cutout(&camera.cutout(&outline)).unwrap();
        let squares: Vec<f64> = border
            .points
            .iter()
            .map(|p| image_from_square.inverse() * p)
            .filter(|p| p.y.abs() < HALF - CORNER)
            .map(|p| (p.x.abs() - HALF).powi(2))
            .collect();
        let waves = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
        assert!(squares.len() > 200 && waves < WAVES, "{degrees}°: {waves} px at {} points", squares.len());
    }
}

/// Blur moves a neck towards the tighter side of a jump of curvature, and noise decides how much of that can be undone: limits as above, on
/// banks whose radius changes at the neck.
#[test]
fn jumps_of_curvature() {
    for (noise, blur, median, most, ends) in [
        (0.0, 0.0, 0.28, 0.33, 0.36),
        (8.0, 1.5, 0.57, 0.93, 0.96),
        (20.0, 1.5, 0.78, 1.2, 1.5),
        (20.0, 4.0, 1.0, 1.65, 2.5),
    ] {
        let mut score = Score::default();
        let mut extractor = Extractor::default();
        for seed in 0..20 {
            let ratio = if seed % 2 == 0 { 0.6 } else { 1.7 };
            let piece = Piece::random(250.0, seed).with_flare(ratio);
            let pose = pose(seed as f64 * 0.7, 1.0, 256.3, 255.6);
            let camera = Camera { noise, blur, seed, ..Camera::default() };
            let features = extractor.extract(&camera.cutout(&piece.outline(&pose))).unwrap();
            score.add(&features, &piece.necks(&pose));
        }
        score.check(&Limits { median, most, ends }, &format!("jumps, noise {noise} blur {blur}"));
    }
}
