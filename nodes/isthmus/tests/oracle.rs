//! The skeletons against an independent one: the exact Euclidean distance transform of a raster picture.

mod shapes;

use isthmus::isthmus::Polarity;
use isthmus::skeleton::Skeleton;
use isthmus::{Features, Point, contour::Border};
use shapes::{Camera, Piece, pose};

/// Side of the pictures, in pixels.
const SIDE: usize = 400;
/// A raster distance is that of pixel centres: the border lies up to half a pixel's diagonal elsewhere, on either side.
const RASTER: f64 = 1.0;
/// How far a ridge of the raster may be from the skeleton: its own place is a matter of a pixel or two.
const RIDGE: f64 = 2.0;

/// How far an isthmus point may be from the skeleton, in pixels: where the disc touches at three points, the chord that meets the
/// border at right angles is not quite that of the disc.
const ISTHMUS: f64 = 1.0;

/// Distance of a point from the branches of a skeleton.
fn off(skeleton: &Skeleton, p: Point) -> f64 {
    let segments = skeleton.branches.iter().flat_map(|branch| branch.windows(2));
    let distance = segments.map(|pair| {
        let (along, to) = (pair[1].point - pair[0].point, p - pair[0].point);
        let t = (to.dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        (to - along * t).norm()
    });
    distance.fold(f64::MAX, f64::min)
}

/// Squared distance of each pixel to the nearest pixel where `set` holds (P. F. Felzenszwalb, D. P. Huttenlocher, *Distance
/// transforms of sampled functions*, 2012, by brute force along columns and lower envelopes along rows).
fn distance_transform(set: &[bool]) -> Vec<f64> {
    let far = (4 * SIDE * SIDE) as f64;
    let mut columns = vec![far; SIDE * SIDE];
    for x in 0..SIDE {
        let rows: Vec<usize> = (0..SIDE).filter(|y| set[y * SIDE + x]).collect();
        for y in 0..SIDE {
            let nearest = rows.iter().map(|r| r.abs_diff(y)).min();
            columns[y * SIDE + x] = nearest.map_or(far, |d| (d * d) as f64);
        }
    }
    let mut out = vec![0.0; SIDE * SIDE];
    for y in 0..SIDE {
        let row = &columns[y * SIDE..][..SIDE];
        for x in 0..SIDE {
            let at = |u: usize| row[u] + (u as f64 - x as f64).powi(2);
            out[y * SIDE + x] = (0..SIDE).map(at).fold(f64::MAX, f64::min);
        }
    }
    out
}

fn at(field: &[f64], p: Point) -> Option<f64> {
    let (x, y) = (p.x.round(), p.y.round());
    let inside = (0.0..SIDE as f64).contains(&x) && (0.0..SIDE as f64).contains(&y);
    inside.then(|| field[y as usize * SIDE + x as usize].sqrt())
}

fn check(skeleton: &Skeleton, distance: &[f64], what: &str) {
    for s in skeleton.branches.iter().flatten() {
        let Some(raster) = at(distance, s.point) else { continue };
        // The nearest pixel centre is up to 0.71 px away from the point, and so may its distance be.
        let tolerance = RASTER + 0.71;
        assert!((s.distance - raster).abs() < tolerance, "{what}: {s:?}, raster {raster}");
    }
}

#[test]
fn distances_and_ridges() {
    for seed in 0..4 {
        let piece = Piece::random(220.0, seed);
        let pose = pose(0.3 + seed as f64, 1.0, 200.2, 199.7);
        let outline = piece.outline(&pose);
        let features = Features::from_border(Border::from_points(&outline).unwrap(), 0.0).unwrap();
        let camera = Camera { width: SIDE, height: SIDE, blur: 0.0, ..Camera::default() };
        let inside: Vec<bool> = camera.picture(&[outline]).iter().map(|p| *p < 128).collect();
        let outside: Vec<bool> = inside.iter().map(|i| !i).collect();
        let (to_outside, to_inside) = (distance_transform(&outside), distance_transform(&inside));
        check(&features.endoskeleton, &to_outside, "endoskeleton");
        check(&features.exoskeleton, &to_inside, "exoskeleton");

        for i in &features.isthmuses {
            let field = if i.polarity == Polarity::Positive { &to_outside } else { &to_inside };
            let raster = at(field, i.point).unwrap();
            assert!((i.width / 2.0 - raster).abs() < RASTER + 0.71, "isthmus {i:?}, raster {raster}");
            let skeleton =
                if i.polarity == Polarity::Positive { &features.endoskeleton } else { &features.exoskeleton };
            let nearest = off(skeleton, i.point);
            assert!(nearest < ISTHMUS, "isthmus {i:?} is {nearest} px off the skeleton");
        }

        // Local maxima of the distance inside are on the skeleton.
        let mut maxima = 0;
        for y in 3..SIDE - 3 {
            for x in 3..SIDE - 3 {
                let here = to_outside[y * SIDE + x];
                let window = (y - 3..=y + 3).flat_map(|v| (x - 3..=x + 3).map(move |u| v * SIDE + u));
                if here > 25.0 && window.clone().all(|k| to_outside[k] <= here) {
                    maxima += 1;
                    let p = Point::new(x as f64, y as f64);
                    let nearest = off(&features.endoskeleton, p);
                    assert!(nearest < RIDGE, "maximum at ({x}, {y}) is {nearest} px off the endoskeleton");
                }
            }
        }
        assert!(maxima > 0);
    }
}
