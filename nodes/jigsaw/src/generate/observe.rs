//! Pieces of a generated puzzle as the solver takes them: from the true outlines, or as the extractor sees them in the
//! frames.

use super::Puzzle;
use crate::Piece;
use isthmus::mask;
use rayon::prelude::*;
use thiserror::Error;

/// Why a piece of a generated puzzle can't be had.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ObserveError {
    /// A frame that can't be segmented.
    #[error("frame {frame}: {source}")]
    Frame {
        /// The frame.
        frame: usize,
        /// What segmentation says.
        source: mask::MaskError,
    },
    /// Another number of shapes in a frame than pieces.
    #[error("frame {frame}: {found} shapes; must be {expected}, one for each piece")]
    Shapes {
        /// The frame.
        frame: usize,
        /// How many shapes were found.
        found: usize,
        /// How many pieces lie in the frame.
        expected: usize,
    },
    /// A piece whose shape can't be analysed.
    #[error("piece {id:?}: {source}")]
    Shape {
        /// The piece.
        id: String,
        /// What the shape analysis says.
        source: isthmus::Error,
    },
}

impl Puzzle {
    /// The pieces by their true outlines, sampled at 1 px: what a perfect camera would show.
    ///
    /// # Errors
    /// An outline that can't be analysed.
    pub fn exact(&self) -> Result<Vec<Piece>, ObserveError> {
        let piece = |k: usize| {
            let id = self.pieces()[k].id.clone();
            match isthmus::Features::from_border(self.border(k, 1.0), 0.0) {
                Ok(features) => Ok(Piece { id, seen: 0, features }),
                Err(source) => Err(ObserveError::Shape { id, source }),
            }
        };
        (0..self.pieces().len()).into_par_iter().map(piece).collect()
    }

    /// The pieces as the extractor sees them in the rendered frames, with default parameters.
    ///
    /// # Errors
    /// A frame in which not all pieces are found, a shape that can't be analysed.
    pub fn seen(&self) -> Result<Vec<Piece>, ObserveError> {
        let frames: Result<Vec<Vec<Piece>>, ObserveError> =
            (0..self.frame_count()).into_par_iter().map(|frame| self.seen_in(frame)).collect();
        Ok(frames?.into_iter().flatten().collect())
    }

    fn seen_in(&self, frame: usize) -> Result<Vec<Piece>, ObserveError> {
        let ids: Vec<&str> = self.pieces().iter().filter(|p| p.frame == frame).map(|p| p.id.as_str()).collect();
        let picture = self.render(frame);
        let picture = mask::Frame::grey(picture.width, picture.height, &picture.pixels)
            .map_err(|source| ObserveError::Frame { frame, source })?;
        let cutouts = mask::segment(&picture, &mask::Parameters::default()).cutouts;
        if cutouts.len() != ids.len() {
            return Err(ObserveError::Shapes { frame, found: cutouts.len(), expected: ids.len() });
        }
        let mut extractor = isthmus::Extractor::default();
        let extract = |(id, cutout): (&&str, &mask::Cutout)| match extractor.extract(cutout) {
            Ok(features) => Ok(Piece { id: (*id).to_owned(), seen: 0, features }),
            Err(source) => Err(ObserveError::Shape { id: (*id).to_owned(), source }),
        };
        ids.iter().zip(&cutouts).map(extract).collect()
    }
}
