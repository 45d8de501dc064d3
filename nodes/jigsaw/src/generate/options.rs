//! What puzzle to generate, and which options are refused.

/// How the sheet is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Cut {
    /// Rows and columns whose corners meet four by four.
    #[default]
    Grid,
    /// Rows shifted against one another as in a brick wall: corners meet three by three, six neighbours a piece.
    Brick,
    /// As `Brick`, with the corners moved so that pieces are about hexagons.
    Honeycomb,
}

/// What the rim of the puzzle looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rim {
    /// A rectangle with straight sides.
    #[default]
    Straight,
    /// Wavy sides, and about a tenth of the cells left out along them.
    Ragged,
    /// Tabs and blanks without a neighbour: the inner part of a larger puzzle.
    Patch,
}

/// How the pieces are lit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lighting {
    /// Light table: dark pieces on bright ground.
    #[default]
    Back,
    /// Bright pieces on dark ground.
    Front,
}

/// What to generate. `Options::default()` is a clean 4 x 6 puzzle, one piece a frame of 1024 x 1024 pixels.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Options {
    /// Rows of pieces.
    pub rows: usize,
    /// Columns of pieces.
    pub columns: usize,
    /// Everything random follows from it. The cut, the heap and the noise draw from separate streams: more noise
    /// doesn't change a shape.
    pub seed: u64,
    /// How many puzzles lie in one heap, each cut on its own.
    pub puzzles: usize,
    /// How the sheet is divided.
    pub cut: Cut,
    /// What the rim looks like.
    pub rim: Rim,
    /// Pitch of the cut in pixels; `None`: 0.24 of the room a piece has in its frame, so that a piece with its tabs is
    /// 250 to 450 pixels wide in a frame of 1024.
    pub piece_size: Option<f64>,
    /// From 0 (every joint its own shape) to 1 (every joint the same shape on a regular cut).
    pub similarity: f64,
    /// Least and greatest clearance (kerf) between two joined borders, in pixels; each joint draws its own.
    pub clearance: [f64; 2],
    /// Fraction of the joints that are gentle waves without a neck. Each piece keeps at least one neck.
    pub wavy: f64,
    /// How many pieces are taken away.
    pub missing: usize,
    /// How many pieces lie there twice.
    pub duplicate: usize,
    /// How many pieces lie face down (mirrored).
    pub flipped: usize,
    /// Width and height of a frame, in pixels; `None`: 1024 x 1024, or, where a frame holds more than one piece, as
    /// much as they need at 512 x 512 each.
    pub frame: Option<[u32; 2]>,
    /// How many pieces lie in one frame.
    pub pieces_per_frame: usize,
    /// Light table or light from above.
    pub lighting: Lighting,
    /// Standard deviation of the sensor noise, in grey levels.
    pub noise: f64,
    /// Standard deviation of the Gaussian blur, in pixels.
    pub blur: f64,
    /// Fraction of the light lost in the corners of the frame (it falls with the square of the distance).
    pub vignette: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            rows: 4,
            columns: 6,
            seed: 1,
            puzzles: 1,
            cut: Cut::Grid,
            rim: Rim::Straight,
            piece_size: None,
            similarity: 0.0,
            clearance: [0.0, 0.0],
            wavy: 0.0,
            missing: 0,
            duplicate: 0,
            flipped: 0,
            frame: None,
            pieces_per_frame: 1,
            lighting: Lighting::Back,
            noise: 0.0,
            blur: 0.0,
            vignette: 0.0,
        }
    }
}

/// Why a puzzle can't be generated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GenerateError {
    /// An option is out of its range.
    #[error("{name} is {value}: must be {rule}")]
    OutOfRange {
        /// The option.
        name: &'static str,
        /// Its value.
        value: String,
        /// What it must be.
        rule: String,
    },
    /// A piece is larger than the room it has.
    #[error(
        "a piece of {width:.0} x {height:.0} px doesn't fit into {room_width:.0} x {room_height:.0} px of its frame: \
         use a larger frame or a smaller piece size"
    )]
    DoesNotFit {
        /// Extent of the piece, in pixels.
        width: f64,
        /// Extent of the piece, in pixels.
        height: f64,
        /// Room for one piece, in pixels.
        room_width: f64,
        /// Room for one piece, in pixels.
        room_height: f64,
    },
}

/// Most pieces of one heap: the paper's method is tried on up to 10 000; ten times that keeps memory under a few GiB.
const MAX_PIECES: usize = 100_000;
/// Longest side of a frame, in pixels.
const MAX_FRAME: u32 = 30_000;
/// Pitch over the room a piece has: with tabs and turned by 45 degrees a piece spans less than 2.3 pitches.
const PITCH_PER_ROOM: f64 = 0.24;
/// Room of one piece in a frame that holds many, in pixels, where no frame size is given.
const ROOM: u32 = 512;
/// The same for the pitch over the room: pieces of one tray lie closer together.
const PITCH_PER_TRAY_ROOM: f64 = 0.40;

impl Options {
    /// Size of a frame, in pixels.
    pub fn frame_size(&self) -> [u32; 2] {
        self.frame.unwrap_or_else(|| {
            if self.pieces_per_frame <= 1 {
                return [1024, 1024];
            }
            let [columns, rows] = tray(self.pieces_per_frame, 4.0 / 3.0);
            [columns as u32 * ROOM, rows as u32 * ROOM]
        })
    }

    /// Pitch of the cut, in pixels.
    pub fn pitch(&self) -> f64 {
        self.piece_size.unwrap_or_else(|| {
            let [width, height] = self.room();
            let share = if self.pieces_per_frame <= 1 { PITCH_PER_ROOM } else { PITCH_PER_TRAY_ROOM };
            share * width.min(height)
        })
    }

    /// Room of one piece in its frame, in pixels.
    pub(super) fn room(&self) -> [f64; 2] {
        let [width, height] = self.frame_size().map(f64::from);
        let [columns, rows] = tray(self.pieces_per_frame, width / height);
        [width / columns as f64, height / rows as f64]
    }

    /// Refuses options out of their range.
    pub(super) fn check(&self) -> Result<(), GenerateError> {
        fn rule(
            ok: bool,
            name: &'static str,
            value: impl ToString,
            rule: impl Into<String>,
        ) -> Result<(), GenerateError> {
            if ok {
                Ok(())
            } else {
                Err(GenerateError::OutOfRange { name, value: value.to_string(), rule: rule.into() })
            }
        }
        let within = |name, value: f64, low: f64, high: f64| {
            rule((low..=high).contains(&value), name, value, format!("{low} to {high}"))
        };
        rule(self.rows >= 1, "rows", self.rows, "at least 1")?;
        rule(self.columns >= 1, "columns", self.columns, "at least 1")?;
        rule(self.puzzles >= 1, "puzzles", self.puzzles, "at least 1")?;
        let whole = self.rows.saturating_mul(self.columns).saturating_mul(self.puzzles);
        rule(whole <= MAX_PIECES, "rows x columns x puzzles", whole, format!("at most {MAX_PIECES}"))?;
        rule(self.missing < whole, "missing", self.missing, format!("less than the {whole} pieces"))?;
        let left = whole - self.missing;
        rule(self.duplicate <= left, "duplicate", self.duplicate, format!("at most the {left} pieces"))?;
        rule(self.flipped <= left, "flipped", self.flipped, format!("at most the {left} pieces"))?;
        rule(
            (1..=MAX_PIECES).contains(&self.pieces_per_frame),
            "pieces per frame",
            self.pieces_per_frame,
            format!("1 to {MAX_PIECES}"),
        )?;
        for side in self.frame_size() {
            rule((16..=MAX_FRAME).contains(&side), "frame side", side, format!("16 to {MAX_FRAME} px"))?;
        }
        let pitch = self.pitch();
        rule(
            (16.0..=f64::from(MAX_FRAME)).contains(&pitch),
            "piece size",
            format!("{pitch:.1}"),
            format!("16 to {MAX_FRAME} px"),
        )?;
        within("similarity", self.similarity, 0.0, 1.0)?;
        within("wavy", self.wavy, 0.0, 1.0)?;
        within("noise", self.noise, 0.0, 127.0)?;
        within("blur", self.blur, 0.0, 20.0)?;
        within("vignette", self.vignette, 0.0, 0.95)?;
        let [low, high] = self.clearance;
        // The narrowest neck is 0.09 of the shortest joint; a wider kerf would eat it up.
        let most = 0.04 * pitch;
        rule(
            low >= 0.0 && low <= high && high <= most,
            "clearance",
            format!("{low} to {high} px"),
            format!("rising and within 0 to {most:.1} px (0.04 of the piece size)"),
        )
    }
}

/// Columns and rows of a tray for `count` pieces, about as wide as `aspect` says.
pub(super) fn tray(count: usize, aspect: f64) -> [usize; 2] {
    let columns = ((count as f64 * aspect).sqrt().round() as usize).clamp(1, count.max(1));
    [columns, count.max(1).div_ceil(columns)]
}
