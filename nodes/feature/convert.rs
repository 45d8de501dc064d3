//! Messages of pieces to cutouts, features to messages.

use isthmus::isthmus::{Isthmus, Polarity};
use isthmus::mask::{Aoi, Cutout};
use isthmus::skeleton::Skeleton;
use isthmus::{Features, Point, profile};
use jigsaw_msgs::geometry_msgs::msg::Point32;
use jigsaw_msgs::msg::{Isthmus as IsthmusMessage, PieceFeatures, PieceImage, SkeletonBranch};

use crate::fields::{
    MAX_AREA_PX, MAX_ID_LENGTH, MAX_SIDE_PX, SCALE_RULE, SCALES, header_fault, is_piece_id, text_fault,
};
use crate::ros::health::shown;

/// Samples of an isthmus distance function in the message: what the paper's plots show, and what 4-byte floats of a
/// match segment of common length (some 100 px) can tell apart.
const IDF_SAMPLES: usize = 64;

/// Why a `PieceImage` is refused: which field, and which rule it breaks.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PieceImageError {
    /// A name that can't name a coordinate frame.
    #[error("id '{0}': must be 1 to {MAX_ID_LENGTH} characters without '/' or blanks")]
    Id(String),
    /// A number out of range.
    #[error("piece '{id}': {field} is {value}: must be {rule}")]
    Range {
        /// Piece.
        id: String,
        /// Field.
        field: &'static str,
        /// Its value.
        value: String,
        /// What it must be.
        rule: &'static str,
    },
    /// No border or no skeleton in the picture.
    #[error("piece '{id}': no shape in the picture: {reason}")]
    Shape {
        /// Piece.
        id: String,
        /// The analysis' words.
        reason: String,
    },
}

impl PieceImageError {
    /// The kind, for counting and throttling.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Id(_) => "id",
            Self::Range { field, .. } => field,
            Self::Shape { .. } => "shape",
        }
    }
}

/// The cutout that a message carries.
///
/// # Errors
/// The first field that is out of range or does not fit the others.
pub fn cutout(message: &mut PieceImage) -> Result<Cutout, PieceImageError> {
    let id = message.id.clone();
    if !is_piece_id(&id) {
        return Err(PieceImageError::Id(shown(&id)));
    }
    if let Some((field, value, rule)) = header_fault(&message.header).or_else(|| text_fault("source", &message.source))
    {
        return Err(PieceImageError::Range { id, field, value, rule });
    }
    let image = &mut message.image;
    let (width, height) = (image.width, image.height);
    let check = |field: &'static str, holds: bool, value: &dyn ToString, rule: &'static str| {
        let value = value.to_string();
        if holds { Ok(()) } else { Err(PieceImageError::Range { id: id.clone(), field, value, rule }) }
    };
    check("image.encoding", image.encoding == "mono8", &shown(&image.encoding), "mono8")?;
    let sides = 1..=MAX_SIDE_PX;
    check("image.width", sides.contains(&width), &width, "1 to 32768")?;
    check("image.height", sides.contains(&height), &height, "1 to 32768")?;
    let area = u64::from(width) * u64::from(height);
    check("image area", area <= MAX_AREA_PX, &area, "at most 150 megapixels")?;
    check("image.step", image.step == width, &image.step, "the width: rows are packed")?;
    check("image.data length", image.data.len() as u64 == area, &image.data.len(), "width x height")?;
    let side = |v: i32| (-(MAX_SIDE_PX as i32)..=MAX_SIDE_PX as i32).contains(&v);
    check("image_x_px", side(message.image_x_px), &message.image_x_px, "-32768 to 32768")?;
    check("image_y_px", side(message.image_y_px), &message.image_y_px, "-32768 to 32768")?;
    check("aoi_x_px", side(message.aoi_x_px), &message.aoi_x_px, "-32768 to 32768")?;
    check("aoi_y_px", side(message.aoi_y_px), &message.aoi_y_px, "-32768 to 32768")?;
    check("aoi_width_px", (1..=width).contains(&message.aoi_width_px), &message.aoi_width_px, "1 to image.width")?;
    check("aoi_height_px", (1..=height).contains(&message.aoi_height_px), &message.aoi_height_px, "1 to image.height")?;
    let inside = |from: i32, length: u32, window: i32, side: u32| {
        from >= window && i64::from(from) + i64::from(length) <= i64::from(window) + i64::from(side)
    };
    let (x, y) = (message.aoi_x_px, message.aoi_y_px);
    let inside_x = inside(x, message.aoi_width_px, message.image_x_px, width);
    let inside_y = inside(y, message.aoi_height_px, message.image_y_px, height);
    check("aoi_x_px", inside_x, &x, "so that the AOI lies inside the picture, from image_x_px on")?;
    check("aoi_y_px", inside_y, &y, "so that the AOI lies inside the picture, from image_y_px on")?;
    check("frame_width_px", sides.contains(&message.frame_width_px), &message.frame_width_px, "1 to 32768")?;
    check("frame_height_px", sides.contains(&message.frame_height_px), &message.frame_height_px, "1 to 32768")?;
    let scale = message.metres_per_pixel;
    check("metres_per_pixel", SCALES.contains(&scale), &scale, SCALE_RULE)?;
    let grey = 0.0..=255.0;
    check("piece_level", grey.contains(&message.piece_level), &message.piece_level, "0 to 255")?;
    check("ground_level", grey.contains(&message.ground_level), &message.ground_level, "0 to 255")?;
    let contrast = (message.piece_level - message.ground_level).abs();
    check("contrast of piece_level and ground_level", contrast >= 1.0, &contrast, "at least 1")?;
    check("noise_level", grey.contains(&message.noise_level), &message.noise_level, "0 to 255")?;
    Ok(Cutout {
        aoi: Aoi {
            x: message.aoi_x_px,
            y: message.aoi_y_px,
            width: message.aoi_width_px,
            height: message.aoi_height_px,
        },
        window: Aoi { x: message.image_x_px, y: message.image_y_px, width, height },
        pixels: std::mem::take(&mut image.data),
        shape_level: message.piece_level,
        ground_level: message.ground_level,
        noise_level: message.noise_level,
    })
}

/// The message of a piece's features; header, name and place are those of the piece's picture.
pub fn features_message(piece: &PieceImage, features: &Features) -> PieceFeatures {
    let border = &features.border;
    PieceFeatures {
        header: piece.header.clone(),
        id: piece.id.clone(),
        source: piece.source.clone(),
        frame_width_px: piece.frame_width_px,
        frame_height_px: piece.frame_height_px,
        metres_per_pixel: piece.metres_per_pixel,
        aoi_x_px: piece.aoi_x_px,
        aoi_y_px: piece.aoi_y_px,
        aoi_width_px: piece.aoi_width_px,
        aoi_height_px: piece.aoi_height_px,
        border_x_px: border.points.iter().map(|p| p.x as f32).collect(),
        border_y_px: border.points.iter().map(|p| p.y as f32).collect(),
        border_length_px: (border.spacing * border.points.len() as f64) as f32,
        noise_px: features.noise as f32,
        isthmuses: features.isthmuses.iter().map(|isthmus| isthmus_message(features, isthmus)).collect(),
        endoskeleton: skeleton_message(&features.endoskeleton),
        exoskeleton: skeleton_message(&features.exoskeleton),
    }
}

fn isthmus_message(features: &Features, isthmus: &Isthmus) -> IsthmusMessage {
    let idf = profile::distance_function(&features.border, isthmus, IDF_SAMPLES);
    IsthmusMessage {
        polarity: match isthmus.polarity {
            Polarity::Positive => IsthmusMessage::POSITIVE,
            Polarity::Negative => IsthmusMessage::NEGATIVE,
        },
        salient: isthmus.salient,
        point_px: point_message(isthmus.point),
        critical_points_px: isthmus.critical_points.map(point_message),
        arc_px: isthmus.arc.map(|arc| arc as f32),
        width_px: isthmus.width as f32,
        path_length_px: isthmus.path_length as f32,
        persistence_px: isthmus.persistence as f32,
        idf_px: idf.into_iter().map(|d| d as f32).collect(),
    }
}

fn point_message(point: Point) -> Point32 {
    Point32 { x: point.x as f32, y: point.y as f32, z: 0.0 }
}

fn skeleton_message(skeleton: &Skeleton) -> Vec<SkeletonBranch> {
    let branch = |points: &Vec<isthmus::skeleton::SkeletonPoint>| SkeletonBranch {
        x_px: points.iter().map(|p| p.point.x as f32).collect(),
        y_px: points.iter().map(|p| p.point.y as f32).collect(),
        distance_px: points.iter().map(|p| p.distance as f32).collect(),
    };
    skeleton.branches.iter().map(branch).collect()
}
