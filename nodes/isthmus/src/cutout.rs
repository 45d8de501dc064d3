//! What segmentation hands to border following.

/// A rectangle of whole pixels of the source frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Aoi {
    /// Left column.
    pub x: i32,
    /// Top row.
    pub y: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// One shape cut out of a frame: an 8-bit picture in which nothing but this shape differs from the ground.
#[derive(Debug, Clone, PartialEq)]
pub struct Cutout {
    /// Bounding box of the shape in the source frame.
    pub aoi: Aoi,
    /// Where the picture lies in the source frame: the AOI and a margin (it may reach beyond the frame).
    pub window: Aoi,
    /// Grey levels, row by row, `window.width * window.height` of them.
    pub pixels: Vec<u8>,
    /// Grey level of the shape.
    pub shape_level: f32,
    /// Grey level of the ground.
    pub ground_level: f32,
    /// Standard deviation of the grey levels.
    pub noise_level: f32,
}
