//! Pictures for people: the assembly ([`assembly`]) and the shape analysis of one piece ([`inspection`]).
//!
//! All pictures are plain RGB images, so that the command line writes them as PNG and the nodes publish them as
//! `sensor_msgs/Image` (`rgb8`). Colours are those of Okabe and Ito, which people with any common colour blindness can
//! tell apart; what a colour says a shape says as well.

mod assembly;
mod canvas;
mod inspection;

pub use assembly::{AssemblyStyle, assembly};
pub use inspection::{InspectionStyle, OVERVIEW_SIDE, frame_overview, inspection};

#[cfg(test)]
mod tests {
    use isthmus::Extractor;
    use isthmus::isthmus::Polarity;
    use isthmus::mask::{self, Cutout};
    use jigsaw::generate::{Options, Puzzle};
    use jigsaw::{Assembly, Mating, Piece, Placement};

    use super::*;

    /// A puzzle of four pieces as the camera sees it, and its true assembly.
    fn example() -> (Vec<Cutout>, Vec<Piece>, Assembly) {
        let puzzle = Puzzle::generate(&Options { rows: 2, columns: 2, ..Options::default() }).unwrap();
        let (mut cutouts, mut pieces, mut assembly) = (vec![], vec![], Assembly::default());
        for k in 0..4 {
            let frame = puzzle.render(k);
            let view = mask::Frame::grey(frame.width, frame.height, &frame.pixels).unwrap();
            let cutout = mask::segment(&view, &mask::Parameters::default()).cutouts.remove(0);
            let features = Extractor::default().extract(&cutout).unwrap();
            pieces.push(Piece { id: puzzle.pieces()[k].id.clone(), seen: 0, features });
            cutouts.push(cutout);
            let puzzle_from_image = puzzle.puzzle_from_image(k).unwrap();
            assembly.placements.push(Placement { piece: k, puzzle_from_image, component: 0, confidence: 1.0 });
        }
        (cutouts, pieces, assembly)
    }

    fn count(picture: &image::RgbImage, colour: [u8; 3]) -> usize {
        picture.pixels().filter(|p| p.0 == colour).count()
    }

    #[test]
    fn an_assembly_shows_every_piece_in_a_fill_of_its_own() {
        let (_, pieces, assembly) = example();
        let picture = super::assembly(&pieces, &assembly, AssemblyStyle::default());
        let area: f64 = pieces.iter().map(|p| p.features.border.area()).sum();
        let mut fills: std::collections::BTreeMap<[u8; 3], usize> = Default::default();
        picture.pixels().for_each(|p| *fills.entry(p.0).or_default() += 1);
        fills.remove(&canvas::WHITE);
        let large: Vec<usize> = fills.into_values().filter(|&n| n as f64 > 0.1 * area).collect();
        // Four touching pieces, four colours, which fill most of their area.
        assert_eq!(large.len(), 4);
        assert!(large.iter().sum::<usize>() as f64 > 0.85 * area);
    }

    #[test]
    fn pieces_left_over_and_doubtful_matings_are_marked() {
        let (_, pieces, mut assembly) = example();
        let whole = super::assembly(&pieces, &assembly, AssemblyStyle::default());
        assembly.placements.pop();
        assembly.unplaced.push(3);
        let tab = pieces[0].features.isthmuses.iter().position(|i| i.polarity == Polarity::Positive);
        let tab = tab.map(|k| (0, k)).unwrap_or((1, 0));
        assembly.matings.push(Mating {
            positive_piece: tab.0,
            positive_isthmus: tab.1,
            negative_piece: 2,
            negative_isthmus: 0,
            correlation: 0.9,
            ave_gap: 0.3,
            clearance: 0.0,
            confidence: 0.5,
        });
        let partial = super::assembly(&pieces, &assembly, AssemblyStyle::default());
        assert!(partial.height() > whole.height(), "the piece left over lies below");
        assert!(count(&partial, canvas::VERMILLION) > 20 && count(&whole, canvas::VERMILLION) == 0);
    }

    #[test]
    fn an_inspection_shows_both_kinds_of_isthmus_and_their_plots() {
        let (cutouts, pieces, _) = example();
        for (cutout, piece) in cutouts.iter().zip(&pieces) {
            let style = InspectionStyle::default();
            let picture = inspection(&piece.id, "x.png", cutout, &piece.features, style);
            let bare =
                inspection(&piece.id, "x.png", cutout, &piece.features, InspectionStyle { plots: false, ..style });
            assert!(picture.width() > bare.width());
            let salient = |polarity| piece.features.isthmuses.iter().any(|i| i.salient && i.polarity == polarity);
            // The legend holds some of each colour: compare with a piece without isthmuses.
            let mut plain = piece.features.clone();
            plain.isthmuses.clear();
            let plain = inspection(&piece.id, "x.png", cutout, &plain, style);
            for (polarity, colour) in [(Polarity::Positive, canvas::VERMILLION), (Polarity::Negative, canvas::BLUE)] {
                let more = count(&picture, colour) > count(&plain, colour) + 100;
                assert_eq!(more, salient(polarity), "{polarity:?} of {}", piece.id);
            }
        }
    }

    #[test]
    fn strange_input_gives_a_picture_all_the_same() {
        let (cutouts, pieces, _) = example();
        let nothing = super::assembly(&[], &Assembly::default(), AssemblyStyle::default());
        assert!(nothing.width() > 100 && nothing.height() > 50);
        let mut assembly = Assembly { unplaced: vec![0, 99], ..Assembly::default() };
        for (piece, x) in [(1, f64::NAN), (77, 0.0), (2, 1e12), (3, 0.0)] {
            let puzzle_from_image = nalgebra::Isometry2::translation(x, 0.0);
            assembly.placements.push(Placement { piece, puzzle_from_image, component: 0, confidence: 1.0 });
        }
        let strange = super::assembly(&pieces, &assembly, AssemblyStyle::default());
        assert!(strange.width() <= canvas::MAX_SIDE && strange.height() <= canvas::MAX_SIDE);
        let mut features = pieces[0].features.clone();
        features.isthmuses[0].path_length = f64::INFINITY;
        features.isthmuses[0].critical_points[0].x = f64::NAN;
        let cutout = Cutout { pixels: vec![], ..cutouts[0].clone() };
        let drawn = inspection("", "", &cutout, &features, InspectionStyle::default());
        assert!(drawn.width() > 100);
    }
}
