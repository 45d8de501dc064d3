//! Messages of features to pieces, checked field by field.

use std::hash::{DefaultHasher, Hash, Hasher};

use isthmus::contour::Border;
use isthmus::isthmus::{Isthmus, Polarity};
use isthmus::{Features, Point};
use jigsaw::Piece;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::msg::{Isthmus as IsthmusMessage, PieceFeatures, SkeletonBranch};
use nalgebra::Point2;

use crate::fields::{
    MAX_ID_LENGTH, MAX_SIDE_PX, SCALE_RULE, SCALES, camera, header_fault, is_piece_id, seen, text_fault,
};
use crate::ros::health::shown;
use crate::ros::transforms::PixelPlane;

/// Most points of a border: a piece of some 8000 pixels, sampled at every pixel of its circumference.
const MAX_BORDER_POINTS: usize = MAX_SIDE_PX as usize;

/// Most border points of all pieces together, so that memory stays bounded: four times those of a thousand pieces of
/// 1000 pixels.
pub const MAX_POINTS_KEPT: usize = 16_000_000;

/// Most samples of an isthmus distance function, and most branches of a skeleton.
const MAX_SAMPLES: usize = 4096;

/// Most isthmuses of a piece. Real pieces have about ten.
const MAX_ISTHMUSES: usize = 1000;

/// Share by which the length of the border in the message may differ from that of its points.
const LENGTH_TOLERANCE: f64 = 0.05;

/// By how much of its width the end of an isthmus may lie off the place on the border that is told (or by the distance of
/// two border points, where that is more): far more than borders sampled in another way differ by, far less than it is to
/// any other isthmus.
const PLACE_TOLERANCE: f64 = 0.25;

/// Share by which the scales of two pieces may differ.
const SCALE_TOLERANCE: f64 = 1e-6;

/// Why a `PieceFeatures` is refused: which field, and which rule it breaks.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FeaturesError {
    /// A name that can't name a coordinate frame.
    #[error("id '{0}': must be 1 to {MAX_ID_LENGTH} characters without '/' or blanks")]
    Id(String),
    /// A name that another piece has.
    #[error("piece '{0}': another piece of this id, with another border, is here already; reset before it is reused")]
    DuplicateId(String),
    /// A field out of range, or one that does not fit another.
    #[error("piece '{id}': {field} is {value}: must be {rule}")]
    Field {
        /// Piece.
        id: String,
        /// Field.
        field: &'static str,
        /// Its value.
        value: String,
        /// What it must be.
        rule: String,
    },
    /// As many pieces as are allowed.
    #[error("piece '{id}': {most} pieces are here already, as many as parameter 'maximum_pieces' allows")]
    Full {
        /// Piece.
        id: String,
        /// The parameter.
        most: usize,
    },
    /// As much as memory is set aside for.
    #[error(
        "piece '{id}': {points} border points would be kept: must be at most {MAX_POINTS_KEPT} of all pieces together"
    )]
    Points {
        /// Piece.
        id: String,
        /// Those of all pieces with it.
        points: usize,
    },
    /// The solver does not take it.
    #[error("piece refused by the solver: {0}")]
    Solver(String),
}

impl FeaturesError {
    /// The kind, for counting and throttling.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Id(_) => "id",
            Self::DuplicateId(_) => "duplicate_id",
            Self::Field { field, .. } => field,
            Self::Full { .. } => "maximum_pieces",
            Self::Points { .. } => "border_points",
            Self::Solver(_) => "solver",
        }
    }
}

/// Where a piece was seen.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// File or topic.
    pub source: String,
    /// When.
    pub stamp: Time,
    /// The table under the frame it was seen in.
    pub table: PixelPlane,
    /// Its area centroid in the frame, the origin of the piece's own coordinate frame.
    pub centroid_in_image: Point,
    /// Its border in the frame.
    pub border_in_image: Vec<Point>,
}

/// Distance in pixels up to which two borders in the same frame are those of one piece that has not moved: more than the
/// noise of a border and the shake of a camera, far less than any two pieces differ that come to lie alike.
const SAME_PLACE_PX: f64 = 1.5;

/// Of how many border points one is compared.
const SAME_PLACE_STRIDE: usize = 16;

impl Sighting {
    /// Whether this is the same piece in the same place, seen by the same camera: a capture node that was started
    /// again gives what still lies there new names.
    pub fn is_same_place(&self, other: &Self) -> bool {
        let distance =
            |p: &Point| other.border_in_image.iter().map(|q| (q - p).norm_squared()).fold(f64::MAX, f64::min);
        camera(&self.source) == camera(&other.source)
            && self.table == other.table
            && (self.centroid_in_image - other.centroid_in_image).norm() <= SAME_PLACE_PX
            && self.border_in_image.iter().step_by(SAME_PLACE_STRIDE).all(|p| distance(p) <= SAME_PLACE_PX.powi(2))
    }
}

/// The piece and the sighting that a message carries.
///
/// # Errors
/// The first field that is out of range or does not fit the others.
pub fn piece(message: &PieceFeatures) -> Result<(Piece, Sighting), FeaturesError> {
    let id = &message.id;
    if !is_piece_id(id) {
        return Err(FeaturesError::Id(shown(id)));
    }
    if let Some((field, value, rule)) = header_fault(&message.header).or_else(|| text_fault("source", &message.source))
    {
        return Err(FeaturesError::Field { id: id.clone(), field, value, rule: rule.to_owned() });
    }
    let check = |field: &'static str, holds: bool, value: &dyn ToString, rule: &dyn ToString| {
        if holds {
            return Ok(());
        }
        Err(FeaturesError::Field { id: id.clone(), field, value: value.to_string(), rule: rule.to_string() })
    };
    let sides = 1..=MAX_SIDE_PX;
    check("frame_width_px", sides.contains(&message.frame_width_px), &message.frame_width_px, &"1 to 32768")?;
    check("frame_height_px", sides.contains(&message.frame_height_px), &message.frame_height_px, &"1 to 32768")?;
    let scale = message.metres_per_pixel;
    check("metres_per_pixel", SCALES.contains(&scale), &scale, &SCALE_RULE)?;
    let side = -(MAX_SIDE_PX as i32)..=MAX_SIDE_PX as i32;
    check("aoi_x_px", side.contains(&message.aoi_x_px), &message.aoi_x_px, &"-32768 to 32768")?;
    check("aoi_y_px", side.contains(&message.aoi_y_px), &message.aoi_y_px, &"-32768 to 32768")?;
    check("aoi_width_px", sides.contains(&message.aoi_width_px), &message.aoi_width_px, &"1 to 32768")?;
    check("aoi_height_px", sides.contains(&message.aoi_height_px), &message.aoi_height_px, &"1 to 32768")?;
    check("noise_px", (0.0..=1e3).contains(&message.noise_px), &message.noise_px, &"0 to 1000")?;
    let (xs, ys) = (&message.border_x_px, &message.border_y_px);
    check("border_y_px length", xs.len() == ys.len(), &ys.len(), &format!("that of border_x_px, {}", xs.len()))?;
    let enough = jigsaw::Solver::MIN_BORDER_POINTS..=MAX_BORDER_POINTS;
    let rule = format!("{} to {}", enough.start(), enough.end());
    check("border_x_px length", enough.contains(&xs.len()), &xs.len(), &rule)?;
    let near = |v: &f32| v.abs() <= 2.0 * MAX_SIDE_PX as f32;
    let bad = xs.iter().chain(ys).find(|v| !near(v)).copied().unwrap_or_default();
    check("border_x_px, border_y_px", near(&bad) && xs.iter().chain(ys).all(near), &bad, &"-65536 to 65536")?;

    let points: Vec<Point> = xs.iter().zip(ys).map(|(&x, &y)| Point2::new(x.into(), y.into())).collect();
    let next = |i: usize| points[(i + 1) % points.len()];
    let length: f64 = (0..points.len()).map(|i| (next(i) - points[i]).norm()).sum();
    let (twice_area, moment) = (0..points.len()).fold((0.0, Point::origin().coords), |(area, moment), i| {
        let (p, q) = (points[i], next(i));
        let cross = p.x * q.y - q.x * p.y;
        (area + cross, moment + (p.coords + q.coords) * cross)
    });
    check("area of the border", twice_area > 1.0, &(twice_area / 2.0), &"positive: clockwise as seen in the image")?;
    let told = f64::from(message.border_length_px);
    let agrees = (told - length).abs() <= LENGTH_TOLERANCE * length;
    check("border_length_px", agrees, &told, &format!("{length:.1}, the length of the border"))?;
    check("isthmuses length", message.isthmuses.len() <= MAX_ISTHMUSES, &message.isthmuses.len(), &MAX_ISTHMUSES)?;
    // Places on the border are told in the length that is told, which between two points may follow a curve.
    let border = Border { spacing: told / points.len() as f64, points };
    for isthmus in &message.isthmuses {
        check_isthmus(isthmus, told, &check)?;
        check_place(isthmus, &border, &check)?;
    }
    check_skeleton(["endoskeleton", "endoskeleton points"], &message.endoskeleton, &check)?;
    check_skeleton(["exoskeleton", "exoskeleton points"], &message.exoskeleton, &check)?;

    let centroid_in_image = Point::from(moment / (3.0 * twice_area));
    let features = Features {
        border: border.clone(),
        noise: message.noise_px.into(),
        isthmuses: message.isthmuses.iter().map(isthmus).collect(),
        // Matching needs no skeleton.
        endoskeleton: Default::default(),
        exoskeleton: Default::default(),
    };
    let sighting = Sighting {
        source: message.source.clone(),
        stamp: message.header.stamp.clone(),
        table: PixelPlane::table(message.frame_width_px, message.frame_height_px, scale),
        centroid_in_image,
        border_in_image: border.points,
    };
    let seen = seen(&message.source, &message.header.stamp);
    Ok((Piece { id: id.clone(), seen, features }, sighting))
}

type Check<'a> = dyn Fn(&'static str, bool, &dyn ToString, &dyn ToString) -> Result<(), FeaturesError> + 'a;

fn check_isthmus(isthmus: &IsthmusMessage, border_length: f64, check: &Check<'_>) -> Result<(), FeaturesError> {
    let known = [IsthmusMessage::POSITIVE, IsthmusMessage::NEGATIVE].contains(&isthmus.polarity);
    check("isthmuses.polarity", known, &isthmus.polarity, &"0 (positive) or 1 (negative)")?;
    let reach = 2.0 * MAX_SIDE_PX as f32;
    for point in isthmus.critical_points_px.iter().chain([&isthmus.point_px]) {
        let near = point.x.abs() <= reach && point.y.abs() <= reach;
        check(
            "isthmuses.critical_points_px, point_px",
            near,
            &format!("({}, {})", point.x, point.y),
            &"-65536 to 65536",
        )?;
    }
    for arc in isthmus.arc_px {
        let on_border = (0.0..=border_length * (1.0 + LENGTH_TOLERANCE)).contains(&f64::from(arc));
        check("isthmuses.arc_px", on_border, &arc, &format!("0 to the border's length, {border_length:.1}"))?;
    }
    check("isthmuses.width_px", isthmus.width_px > 0.0 && isthmus.width_px <= reach, &isthmus.width_px, &"positive")?;
    let path = f64::from(isthmus.path_length_px);
    let on_border = path > 0.0 && path <= border_length * (1.0 + LENGTH_TOLERANCE);
    check("isthmuses.path_length_px", on_border, &path, &format!("up to the border's length, {border_length:.1}"))?;
    let persistence = isthmus.persistence_px;
    // Infinite where no end of the branch is narrower.
    check("isthmuses.persistence_px", persistence >= 0.0, &persistence, &"0 or more")?;
    let idf = &isthmus.idf_px;
    check("isthmuses.idf_px length", idf.len() <= MAX_SAMPLES, &idf.len(), &MAX_SAMPLES)?;
    let bad = idf.iter().find(|d| !(0.0..=reach).contains(*d));
    check("isthmuses.idf_px", bad.is_none(), &bad.copied().unwrap_or_default(), &"0 to 65536")
}

/// Whether an isthmus lies where it says on the border: otherwise another part of the border would be matched.
fn check_place(isthmus: &IsthmusMessage, border: &Border, check: &Check<'_>) -> Result<(), FeaturesError> {
    let length = border.length();
    let [first, last] = isthmus.arc_px.map(f64::from);
    for (arc, point) in [first, last].into_iter().zip(&isthmus.critical_points_px) {
        let distance = (border.point_at(arc) - Point::new(point.x.into(), point.y.into())).norm();
        let near = distance <= border.spacing.max(PLACE_TOLERANCE * f64::from(isthmus.width_px));
        let rule = format!("where the critical point ({}, {}) lies on the border", point.x, point.y);
        check("isthmuses.arc_px", near, &arc, &rule)?;
    }
    let path = (last - first).rem_euclid(length);
    let agrees = (path - f64::from(isthmus.path_length_px)).abs() <= LENGTH_TOLERANCE * length;
    let rule = format!("{path:.1}, the length of the border from the first critical point to the second");
    check("isthmuses.path_length_px", agrees, &isthmus.path_length_px, &rule)
}

/// Matching needs no skeleton, but whoever records or draws the message relies on it.
fn check_skeleton(
    [field, points]: [&'static str; 2],
    branches: &[SkeletonBranch],
    check: &Check<'_>,
) -> Result<(), FeaturesError> {
    check(
        field,
        branches.len() <= MAX_SAMPLES,
        &format!("{} branches", branches.len()),
        &format!("at most {MAX_SAMPLES}"),
    )?;
    let reach = 2.0 * MAX_SIDE_PX as f32;
    for branch in branches {
        let lengths = [branch.x_px.len(), branch.y_px.len(), branch.distance_px.len()];
        let fits = lengths[0] <= MAX_BORDER_POINTS && lengths.iter().all(|length| *length == lengths[0]);
        check(
            points,
            fits,
            &format!("{lengths:?} long"),
            &format!("three times the same, at most {MAX_BORDER_POINTS}"),
        )?;
        let values = branch.x_px.iter().chain(&branch.y_px).chain(&branch.distance_px);
        let bad = values.copied().find(|v| !(-reach..=reach).contains(v));
        check(points, bad.is_none(), &bad.unwrap_or_default(), &"-65536 to 65536")?;
    }
    Ok(())
}

fn isthmus(message: &IsthmusMessage) -> Isthmus {
    let point = |p: &jigsaw_msgs::geometry_msgs::msg::Point32| Point2::new(p.x.into(), p.y.into());
    let [first, second] = &message.critical_points_px;
    Isthmus {
        polarity: if message.polarity == IsthmusMessage::POSITIVE { Polarity::Positive } else { Polarity::Negative },
        point: point(&message.point_px),
        critical_points: [point(first), point(second)],
        arc: message.arc_px.map(f64::from),
        width: message.width_px.into(),
        path_length: message.path_length_px.into(),
        persistence: message.persistence_px.into(),
        salient: message.salient,
    }
}

/// A hash of what makes a piece: the same message sent again has the same.
pub fn fingerprint(message: &PieceFeatures) -> u64 {
    let mut hasher = DefaultHasher::new();
    message.source.hash(&mut hasher);
    for v in message.border_x_px.iter().chain(&message.border_y_px) {
        v.to_bits().hash(&mut hasher);
    }
    hasher.finish()
}

/// Checks that a piece has the scale of the others: the solver compares pixels.
///
/// # Errors
/// A scale that differs.
pub fn check_scale(id: &str, scale: f64, others: Option<f64>) -> Result<(), FeaturesError> {
    match others {
        Some(known) if (scale / known - 1.0).abs() > SCALE_TOLERANCE => Err(FeaturesError::Field {
            id: id.to_owned(),
            field: "metres_per_pixel",
            value: scale.to_string(),
            rule: format!("{known}, as that of the other pieces"),
        }),
        _ => Ok(()),
    }
}
