//! Lines on a picture, for the examples.

use image::{Rgb, RgbImage};
use imageproc::drawing::draw_line_segment_mut;
use isthmus::Point;

/// Draws a straight line that is `2 * reach + 1` pixels wide; what lies beyond the picture is left out.
pub(crate) fn line(picture: &mut RgbImage, ends: [Point; 2], reach: i32, colour: Rgb<u8>) {
    for (dx, dy) in (-reach..=reach).flat_map(|dx| (-reach..=reach).map(move |dy| (dx, dy))) {
        let [from, to] = ends.map(|p| (p.x as f32 + dx as f32, p.y as f32 + dy as f32));
        draw_line_segment_mut(picture, from, to, colour);
    }
}
