//! Solutions to messages: pixels to metres on the way.

use std::collections::HashSet;

use isthmus::isthmus::Polarity;
use jigsaw::{Assembly, Piece};
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::geometry_msgs::msg::{Point as PointMessage, Pose, Transform, TransformStamped, Vector3};
use jigsaw_msgs::msg::{Assembly as AssemblyMessage, CandidateCounts, Mating, PiecePose};
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::{ColorRGBA, Header};
use jigsaw_msgs::tf2_msgs::msg::TFMessage;
use jigsaw_msgs::visualization_msgs::msg::{Marker, MarkerArray};
use nalgebra::{Isometry2, Point2};

use super::features::Sighting;
use crate::fields::image_message;
use crate::picture::{self, AssemblyStyle};
use crate::ros::transforms::{PixelPlane, pose_message};

/// Names of the frames, and what counts as complete.
#[derive(Debug, Clone, PartialEq)]
pub struct Naming {
    /// Parent of the observed frames.
    pub table_frame: String,
    /// Parent of the goal frames.
    pub puzzle_frame: String,
    /// Pieces of the whole puzzle, 0 if not known.
    pub expected_pieces: usize,
}

/// What the solver has found, with all that is needed to say it in messages.
#[derive(Debug, Clone)]
pub struct Solution {
    /// The pieces, in the order of the assembly's indices.
    pub pieces: Vec<Piece>,
    /// Their sightings, in the same order.
    pub sightings: Vec<Sighting>,
    /// The assembly.
    pub assembly: Assembly,
    /// Names of the frames.
    pub naming: Naming,
}

impl Solution {
    /// The puzzle in metres: origin at the bottom left corner of the assembly.
    fn puzzle_plane(&self) -> PixelPlane {
        let corner = self
            .assembly
            .placements
            .iter()
            .filter_map(|placement| Some((placement, self.sightings.get(placement.piece)?)))
            .flat_map(|(placement, sighting)| sighting.border_in_image.iter().map(|p| placement.puzzle_from_image * p))
            .reduce(|corner, p| Point2::new(corner.x.min(p.x), corner.y.max(p.y)))
            .unwrap_or_else(Point2::origin);
        let metres_per_pixel = self.sightings.first().map_or(1.0, |s| s.table.metres_per_pixel);
        PixelPlane { metres_per_pixel, origin_px: corner }
    }

    /// How far the puzzle is.
    pub fn state(&self) -> u8 {
        let placed = self.assembly.placements.len();
        if placed == 0 || self.assembly.matings.is_empty() && self.present().count() != 1 {
            return AssemblyMessage::COLLECTING;
        }
        let one_assembly = self.assembly.placements.iter().all(|p| p.component == 0);
        let whole = match self.naming.expected_pieces {
            0 => placed > 1 && self.assembly.unplaced.is_empty() && !self.has_open_mouth(),
            expected => placed >= expected,
        };
        if one_assembly && whole { AssemblyMessage::COMPLETE } else { AssemblyMessage::PARTIAL }
    }

    /// The pieces that there are, with their sightings and places among all: not where one lay before it was seen elsewhere.
    fn present(&self) -> impl Iterator<Item = (usize, (&Piece, &Sighting))> {
        let all = self.pieces.iter().zip(&self.sightings).enumerate();
        all.filter(|(k, _)| !self.assembly.earlier.contains(k))
    }

    /// Whether a piece has a mouth that no tab is in: then another piece is still to come. (Necks don't tell: a body
    /// has waists that look like necks.)
    fn has_open_mouth(&self) -> bool {
        let mated: HashSet<(usize, usize)> =
            self.assembly.matings.iter().map(|m| (m.negative_piece, m.negative_isthmus)).collect();
        self.present().any(|(p, (piece, _))| {
            piece.features.isthmuses.iter().enumerate().any(|(i, isthmus)| {
                isthmus.polarity == Polarity::Negative && isthmus.salient && !mated.contains(&(p, i))
            })
        })
    }

    fn id(&self, piece: usize) -> String {
        self.pieces.get(piece).map(|p| p.id.clone()).unwrap_or_default()
    }

    fn stamp(&self) -> Time {
        let newest = self.sightings.iter().map(|s| (s.stamp.sec, s.stamp.nanosec)).max().unwrap_or_default();
        Time { sec: newest.0, nanosec: newest.1 }
    }

    fn header(&self) -> Header {
        Header { stamp: self.stamp(), frame_id: self.naming.puzzle_frame.clone() }
    }

    fn observed(sighting: &Sighting) -> Pose {
        pose_message(&sighting.table.pose(&Isometry2::identity(), sighting.centroid_in_image))
    }

    /// The message on `assembly`.
    pub fn assembly_message(&self) -> AssemblyMessage {
        let plane = self.puzzle_plane();
        let pieces = self
            .assembly
            .placements
            .iter()
            .filter_map(|placement| {
                let sighting = self.sightings.get(placement.piece)?;
                Some(PiecePose {
                    id: self.id(placement.piece),
                    source: sighting.source.clone(),
                    observed: Self::observed(sighting),
                    goal: pose_message(&plane.pose(&placement.puzzle_from_image, sighting.centroid_in_image)),
                    component: u32::try_from(placement.component).unwrap_or(u32::MAX),
                    confidence: placement.confidence as f32,
                })
            })
            .collect();
        let matings = self.assembly.matings.iter().map(|mating| Mating {
            positive_piece: self.id(mating.positive_piece),
            positive_isthmus: count(mating.positive_isthmus),
            negative_piece: self.id(mating.negative_piece),
            negative_isthmus: count(mating.negative_isthmus),
            correlation: mating.correlation as f32,
            ave_gap: (mating.ave_gap * plane.metres_per_pixel) as f32,
            clearance: (mating.clearance * plane.metres_per_pixel) as f32,
            confidence: mating.confidence as f32,
        });
        let table = &self.assembly.table;
        AssemblyMessage {
            header: self.header(),
            state: self.state(),
            table_frame: self.naming.table_frame.clone(),
            pieces,
            unplaced: self.assembly.without_place().map(|piece| self.id(piece)).collect(),
            matings: matings.collect(),
            table: CandidateCounts {
                positive: count(table.positive),
                negative: count(table.negative),
                pairs: count(table.pairs),
                after_opening: count(table.after_opening),
                after_length: count(table.after_length),
                after_correlation: count(table.after_correlation),
                after_overlap: count(table.after_overlap),
                backtracks: count(table.backtracks),
            },
        }
    }

    /// The message on `/tf_static`: every transform there is, because a late joiner gets the last message alone.
    pub fn transforms_message(&self) -> TFMessage {
        let transform = |parent: &str, child: String, stamp: &Time, pose: Pose| TransformStamped {
            header: Header { stamp: stamp.clone(), frame_id: parent.to_owned() },
            child_frame_id: child,
            transform: Transform {
                translation: Vector3 { x: pose.position.x, y: pose.position.y, z: pose.position.z },
                rotation: pose.orientation,
            },
        };
        let plane = self.puzzle_plane();
        let observed = self.present().map(|(_, (piece, sighting))| {
            let child = format!("piece_{}", piece.id);
            transform(&self.naming.table_frame, child, &sighting.stamp, Self::observed(sighting))
        });
        let goals = self.assembly.placements.iter().filter_map(|placement| {
            let sighting = self.sightings.get(placement.piece)?;
            let goal = pose_message(&plane.pose(&placement.puzzle_from_image, sighting.centroid_in_image));
            let child = format!("piece_{}_goal", self.id(placement.piece));
            Some(transform(&self.naming.puzzle_frame, child, &sighting.stamp, goal))
        });
        TFMessage { transforms: observed.chain(goals).collect() }
    }

    /// The message on `assembly/image`.
    pub fn image_message(&self) -> Image {
        image_message(self.header(), picture::assembly(&self.pieces, &self.assembly, AssemblyStyle::default()))
    }

    /// The message on `assembly/markers`: the outlines of the pieces in place and their names.
    pub fn markers_message(&self) -> MarkerArray {
        let plane = self.puzzle_plane();
        let base = |ns: &str, id: usize, kind: i32| Marker {
            header: self.header(),
            ns: ns.to_owned(),
            id: i32::try_from(id).unwrap_or(i32::MAX),
            r#type: kind,
            action: Marker::ADD,
            pose: identity_pose(),
            ..Marker::default()
        };
        // What was drawn for an earlier assembly goes first.
        let mut markers = vec![Marker { action: Marker::DELETEALL, ..base("", 0, Marker::LINE_STRIP) }];
        for placement in &self.assembly.placements {
            let Some(sighting) = self.sightings.get(placement.piece) else { continue };
            let outline: Vec<PointMessage> = sighting
                .border_in_image
                .iter()
                .chain(sighting.border_in_image.first())
                .map(|p| plane.metres_from_pixels(placement.puzzle_from_image * p))
                .map(|p| PointMessage { x: p.x, y: p.y, z: 0.0 })
                .collect();
            let size = extent(&outline);
            let color = component_color(placement.component);
            markers.push(Marker {
                points: outline,
                scale: Vector3 { x: size * LINE_WIDTH_SHARE, y: 0.0, z: 0.0 },
                color: color.clone(),
                ..base("outline", placement.piece, Marker::LINE_STRIP)
            });
            let place = plane.metres_from_pixels(placement.puzzle_from_image * sighting.centroid_in_image);
            let mut name = base("id", placement.piece, Marker::TEXT_VIEW_FACING);
            name.pose.position = PointMessage { x: place.x, y: place.y, z: 0.0 };
            name.scale.z = size * TEXT_HEIGHT_SHARE;
            name.color = color;
            name.text = self.id(placement.piece);
            markers.push(name);
        }
        MarkerArray { markers }
    }
}

/// Width of an outline, as a share of the piece's size.
const LINE_WIDTH_SHARE: f64 = 0.01;

/// Height of a name, as a share of the piece's size.
const TEXT_HEIGHT_SHARE: f64 = 0.12;

fn identity_pose() -> Pose {
    pose_message(&Isometry2::identity())
}

fn extent(points: &[PointMessage]) -> f64 {
    let range = |value: fn(&PointMessage) -> f64| {
        let (low, high) =
            points.iter().map(value).fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
        (high - low).max(0.0)
    };
    range(|p| p.x).max(range(|p| p.y))
}

/// The main assembly in green, the others in orange.
fn component_color(component: usize) -> ColorRGBA {
    if component == 0 {
        ColorRGBA { r: 0.0, g: 0.62, b: 0.45, a: 1.0 }
    } else {
        ColorRGBA { r: 0.9, g: 0.62, b: 0.0, a: 1.0 }
    }
}

fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}
