//! From pixels to metres.
//!
//! Pictures count pixels with x right and y **down**, pixel centres at whole numbers. The frames of the cell are
//! right-handed (REP 103): x right and y **up** as seen in the picture, z out of the table towards the camera, metres.
//! The origin of the table frame is the centre of the frame; that of the puzzle frame the bottom left corner of the
//! assembly. An angle that turns clockwise in the picture (positive with y down) is negative with y up.

use jigsaw_msgs::geometry_msgs::msg::{Point, Pose, Quaternion};
use nalgebra::{Isometry2, Point2, Vector2};

/// A plane pose in a y-up frame, in metres and radians.
pub type PlanePose = Isometry2<f64>;

/// A plane of pixels and its place in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPlane {
    /// Scale.
    pub metres_per_pixel: f64,
    /// Which pixel position is the origin of the metric frame.
    pub origin_px: Point2<f64>,
}

impl PixelPlane {
    /// The table under a frame of this size: origin at its centre.
    ///
    /// ```
    /// use jigsaw_nodes::ros::transforms::PixelPlane;
    /// use nalgebra::Point2;
    /// let table = PixelPlane::table(640, 480, 0.001);
    /// let corner_in_table = table.metres_from_pixels(Point2::new(-0.5, -0.5));
    /// assert!((corner_in_table - Point2::new(-0.32, 0.24)).norm() < 1e-12);
    /// ```
    pub fn table(width_px: u32, height_px: u32, metres_per_pixel: f64) -> Self {
        // Pixel centres are at whole numbers, so that the middle of n pixels is at (n - 1) / 2.
        let origin_px = Point2::new((f64::from(width_px) - 1.0) / 2.0, (f64::from(height_px) - 1.0) / 2.0);
        Self { metres_per_pixel, origin_px }
    }

    /// A point of the picture in metres.
    pub fn metres_from_pixels(&self, point_px: Point2<f64>) -> Point2<f64> {
        let offset = point_px - self.origin_px;
        Point2::new(offset.x * self.metres_per_pixel, -offset.y * self.metres_per_pixel)
    }

    /// A point in metres in the picture.
    pub fn pixels_from_metres(&self, point: Point2<f64>) -> Point2<f64> {
        self.origin_px + Vector2::new(point.x, -point.y) / self.metres_per_pixel
    }

    /// The pose of something whose origin lies at `origin_px` of its own picture, after `target_from_source` (pixels,
    /// y down) has brought that picture into this plane.
    pub fn pose(&self, target_from_source: &Isometry2<f64>, origin_px: Point2<f64>) -> PlanePose {
        let place = self.metres_from_pixels(target_from_source * origin_px);
        PlanePose::new(place.coords, -target_from_source.rotation.angle())
    }
}

/// A plane pose as the message of a pose in space.
pub fn pose_message(pose: &PlanePose) -> Pose {
    let half = pose.rotation.angle() / 2.0;
    Pose {
        position: Point { x: pose.translation.x, y: pose.translation.y, z: 0.0 },
        orientation: Quaternion { x: 0.0, y: 0.0, z: half.sin(), w: half.cos() },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rounding of a few operations on coordinates of up to some thousand pixels.
    const TOLERANCE: f64 = 1e-9;

    /// A few hundred reproducible poses and points.
    fn samples() -> impl Iterator<Item = (Isometry2<f64>, Point2<f64>, Point2<f64>, PixelPlane)> {
        (0..300).map(|i| {
            let x = |k: u32| (f64::from(i * 7 + k) * 12.9898).sin() * 1000.0;
            let plane =
                PixelPlane { metres_per_pixel: 1e-4 * (1.0 + f64::from(i)), origin_px: Point2::new(x(1), x(2)) };
            (Isometry2::new(Vector2::new(x(3), x(4)), x(5)), Point2::new(x(6), x(7)), Point2::new(x(8), x(9)), plane)
        })
    }

    #[test]
    fn metres_and_pixels_are_inverse() {
        for (_, point, _, plane) in samples() {
            let back = plane.pixels_from_metres(plane.metres_from_pixels(point));
            assert!((back - point).norm() < TOLERANCE);
        }
    }

    /// A point fixed to the piece must come out at the same place whether it is moved in pixels and then converted, or
    /// converted to the piece's metric frame and then moved by the pose.
    #[test]
    fn a_pose_moves_points_as_the_pixels_move() {
        for (target_from_source, origin, point, plane) in samples() {
            let direct = plane.metres_from_pixels(target_from_source * point);
            let point_in_piece = PixelPlane { origin_px: origin, ..plane }.metres_from_pixels(point);
            let posed = plane.pose(&target_from_source, origin) * point_in_piece;
            assert!((posed - direct).norm() < TOLERANCE * plane.metres_per_pixel.max(1.0));
        }
    }

    #[test]
    fn y_points_up_and_turns_change_sign() {
        let plane = PixelPlane { metres_per_pixel: 0.5, origin_px: Point2::origin() };
        let below = plane.metres_from_pixels(Point2::new(0.0, 10.0));
        assert!(below.y < 0.0);
        let clockwise_on_screen = Isometry2::rotation(0.3);
        let pose = plane.pose(&clockwise_on_screen, Point2::origin());
        assert!((pose.rotation.angle() + 0.3).abs() < TOLERANCE);
    }

    #[test]
    fn orientations_are_unit_quaternions_about_z() {
        for (pose, ..) in samples() {
            let q = pose_message(&pose).orientation;
            assert!((q.z.hypot(q.w) - 1.0).abs() < TOLERANCE && q.x == 0.0 && q.y == 0.0);
            let angle = 2.0 * q.z.atan2(q.w);
            assert!((Isometry2::rotation(angle).rotation.angle_to(&pose.rotation)).abs() < TOLERANCE);
        }
    }
}
