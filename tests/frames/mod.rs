//! Frames of generated puzzles as a camera sends them.

use jigsaw::generate::Puzzle;
use jigsaw_msgs::builtin_interfaces::msg::Time;
use jigsaw_msgs::sensor_msgs::msg::Image;
use jigsaw_msgs::std_msgs::msg::Header;

/// A frame of a puzzle as a message, with this stamp.
pub(crate) fn camera_image(puzzle: &Puzzle, frame: usize, stamp: Time) -> Image {
    let frame = puzzle.render(frame);
    Image {
        header: Header { stamp, frame_id: "camera".to_owned() },
        height: frame.height,
        width: frame.width,
        encoding: "mono8".to_owned(),
        is_bigendian: 0,
        step: frame.width,
        data: frame.pixels,
    }
}
