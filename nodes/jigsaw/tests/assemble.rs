//! The whole solver on generated puzzles, whose truth is known.

use jigsaw::generate::{Options, Puzzle, Score};
use jigsaw::{Assembly, Params, Piece, Solver};

/// Worst piece of a 4 x 6 puzzle from exact outlines, in pixels: the border is sampled at 1 px.
const EXACT_OFFSET: f64 = 0.06;

fn exact_pieces(puzzle: &Puzzle) -> Vec<Piece> {
    (0..puzzle.pieces().len())
        .map(|k| Piece {
            id: puzzle.pieces()[k].id.clone(),
            features: isthmus::Features::from_border(puzzle.border(k, 1.0), 0.0).expect("features of a true outline"),
        })
        .collect()
}

fn solve(options: &Options, params: &Params) -> (Score, Assembly) {
    let puzzle = Puzzle::generate(options).expect("valid options");
    let pieces = exact_pieces(&puzzle);
    let assembly = jigsaw::assemble(&pieces, params).expect("valid pieces");
    (puzzle.score(&pieces, &assembly), assembly)
}

#[test]
fn a_clean_puzzle_is_assembled_exactly() {
    for seed in 11..13 {
        let (score, assembly) = solve(&Options { seed, ..Options::default() }, &Params::default());
        assert!(score.is_perfect(), "seed {seed}: {score:?}");
        assert_eq!(score.right_matings, score.joints, "seed {seed}");
        assert!(score.worst_offset < EXACT_OFFSET, "seed {seed}: {score:?}");
        assert!(assembly.unplaced.is_empty());
    }
}

#[test]
fn order_of_insertion_and_threads_do_not_matter() {
    let puzzle = Puzzle::generate(&Options { seed: 21, ..Options::default() }).expect("valid options");
    let pieces = exact_pieces(&puzzle);
    let run = |pieces: &[Piece], threads: usize| {
        let mut solver = Solver::new(Params { threads, ..Params::default() }).expect("valid parameters");
        for piece in pieces {
            solver.insert(piece.clone()).expect("unique ids");
        }
        let assembly = solver.solve();
        let mut poses: Vec<(String, String)> = assembly
            .placements
            .iter()
            .map(|p| (pieces[p.piece].id.clone(), format!("{:?} {}", p.puzzle_from_image, p.component)))
            .collect();
        poses.sort();
        poses
    };
    let first = run(&pieces, 1);
    assert_eq!(first.len(), pieces.len());
    let mut reversed = pieces.clone();
    reversed.reverse();
    assert_eq!(first, run(&reversed, 2));
}

#[test]
fn pieces_that_come_one_by_one_make_the_same_assembly() {
    let puzzle = Puzzle::generate(&Options { rows: 3, columns: 4, seed: 5, ..Options::default() }).expect("valid");
    let pieces = exact_pieces(&puzzle);
    let mut solver = Solver::new(Params::default()).expect("valid parameters");
    let mut last = Assembly::default();
    for piece in &pieces {
        solver.insert(piece.clone()).expect("unique ids");
        last = solver.solve();
    }
    let whole = jigsaw::assemble(&pieces, &Params::default()).expect("valid pieces");
    assert_eq!(last.placements, whole.placements);
    assert_eq!(last.matings, whole.matings);

    let taken = solver.remove(&pieces[3].id).expect("is there");
    solver.insert(taken).expect("was taken out");
    assert_eq!(solver.solve().placements.len(), pieces.len());
}

#[test]
fn nothing_is_made_of_nothing() {
    let assembly = jigsaw::assemble(&[], &Params::default()).expect("no pieces are no error");
    assert_eq!(assembly.placements.len() + assembly.unplaced.len(), 0);
}

#[test]
fn bad_input_is_refused_by_name() {
    let bad = Params { candidates: 0, ..Params::default() };
    let error = Solver::new(bad).expect_err("no candidates").to_string();
    assert!(error.contains("candidates=0"), "{error}");

    let puzzle = Puzzle::generate(&Options { rows: 2, columns: 2, ..Options::default() }).expect("valid");
    let pieces = exact_pieces(&puzzle);
    let mut solver = Solver::new(Params::default()).expect("valid parameters");
    solver.insert(pieces[0].clone()).expect("first");
    let error = solver.insert(pieces[0].clone()).expect_err("twice").to_string();
    assert!(error.contains(&pieces[0].id), "{error}");
    let mut broken = pieces[1].clone();
    broken.features.border.points[5].x = f64::NAN;
    let error = solver.insert(broken).expect_err("not a number").to_string();
    assert!(error.contains("finite"), "{error}");
}
