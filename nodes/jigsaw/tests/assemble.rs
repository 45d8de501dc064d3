//! The whole solver on generated puzzles, whose truth is known.

use jigsaw::generate::{Cut, Options, Puzzle, Rim, Score};
use jigsaw::{Assembly, Params, Piece, Policy, Solver};

/// Worst piece of a 4 x 6 puzzle from exact outlines, in pixels: the border is sampled at 1 px.
const EXACT_OFFSET: f64 = 0.06;

fn solve(options: &Options, params: &Params) -> (Score, Assembly) {
    let puzzle = Puzzle::generate(options).expect("valid options");
    let pieces = puzzle.exact().expect("features of true outlines");
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

/// Everything that a heap may hold beside one whole puzzle; pieces left over are fine where nothing holds them.
#[test]
fn incomplete_and_mixed_heaps_make_no_wrong_mating() {
    let cases = [
        ("missing", Options { missing: 4, ..Options::default() }),
        ("twice", Options { duplicate: 3, ..Options::default() }),
        ("flipped", Options { flipped: 2, ..Options::default() }),
        ("mixed", Options { puzzles: 2, rows: 3, ..Options::default() }),
        ("wavy", Options { wavy: 0.1, ..Options::default() }),
        ("patch", Options { rim: Rim::Patch, ..Options::default() }),
        ("ragged", Options { rim: Rim::Ragged, rows: 5, ..Options::default() }),
        ("brick", Options { cut: Cut::Brick, ..Options::default() }),
        ("honeycomb", Options { cut: Cut::Honeycomb, ..Options::default() }),
        ("alike", Options { similarity: 0.98, ..Options::default() }),
        ("clearance", Options { clearance: [0.0, 4.0], ..Options::default() }),
    ];
    for (name, options) in cases {
        let (score, _) = solve(&Options { seed: 31, ..options.clone() }, &Params::default());
        assert_eq!((score.misplaced, score.wrong_matings), (0, 0), "{name}: {score:?}");
        assert_eq!(score.right_matings, score.joints, "{name}: {score:?}");
        if options.missing == 0 {
            assert_eq!(score.placed, score.pieces, "{name}: {score:?}");
        }
    }
}

/// Of a heap from which most pieces are missing, the best candidate of most mouths is wrong, and the few that stand out
/// don't say how good wrong ones can be.
#[test]
fn what_is_missing_makes_nothing_else_fit() {
    let frame = Some([300, 300]);
    let options = Options {
        rows: 8,
        columns: 12,
        seed: 905,
        similarity: 0.7,
        noise: 8.0,
        blur: 1.5,
        clearance: [1.0, 1.0],
        frame,
        ..Options::default()
    };
    let puzzle = Puzzle::generate(&options).expect("valid options");
    let pieces = puzzle.seen().expect("a piece in each frame");
    // Every seventh piece, from one in the middle on, round the puzzle.
    let mut solver = Solver::new(Params::default()).expect("valid parameters");
    for k in 0..40 {
        solver.insert(pieces[(7 * k + 25) % pieces.len()].clone()).expect("unique ids");
    }
    let assembly = solver.solve();
    let score = puzzle.score(solver.pieces(), &assembly);
    assert_eq!(score.wrong_matings, 0, "{score:?}");
    assert!(score.right_matings > 0, "{score:?}");
}

/// What an arm is told while pieces still come in is as little wrong as what it is told in the end.
#[test]
fn nothing_is_wrong_on_the_way() {
    for seed in 11..16 {
        let options = Options {
            seed,
            noise: 8.0,
            blur: 1.5,
            clearance: [1.0, 1.0],
            frame: Some([512, 512]),
            ..Options::default()
        };
        let puzzle = Puzzle::generate(&options).expect("valid options");
        let mut pieces = puzzle.seen().expect("a piece in each frame");
        // Multiplied by a number that shares no factor with their count, the places are an order far from the rows.
        let count = pieces.len();
        pieces = (0..count).map(|k| pieces[(7 * k + seed as usize) % count].clone()).collect();
        let mut solver = Solver::new(Params::default()).expect("valid parameters");
        for piece in pieces {
            solver.insert(piece).expect("unique ids");
            let assembly = solver.solve();
            let score = puzzle.score(solver.pieces(), &assembly);
            assert_eq!((score.misplaced, score.wrong_matings), (0, 0), "seed {seed}: {score:?}");
        }
    }
}

/// Pieces that others hold in place mate with all their neighbours, whether the index thought so or not.
#[test]
fn a_contact_is_a_mating_even_if_it_was_no_candidate() {
    let options = Options { similarity: 0.98, seed: 5, ..Options::default() };
    let (score, assembly) = solve(&options, &Params { candidates: 1, ..Params::default() });
    assert!(score.is_perfect() && score.right_matings == score.joints, "{score:?}");
    // With one candidate a mouth, what is beyond one a mouth was found in contact.
    assert!(assembly.table.after_correlation > assembly.table.negative, "{:?}", assembly.table);
}

/// Two borders along one cut fit wherever on it their points lie: what is between them is a curve, not a chord.
#[test]
fn a_fit_does_not_depend_on_where_the_points_lie() {
    /// Mean residual of a true joint, in pixels; chords of points 1 px apart leave 0.008 in curves of 13 px.
    const RESIDUAL: f64 = 0.002;
    let (score, assembly) =
        solve(&Options { frame: Some([512, 512]), seed: 3, ..Options::default() }, &Params::default());
    let worst = assembly.matings.iter().map(|m| m.ave_gap).fold(0.0, f64::max);
    assert!(score.right_matings == score.joints && worst < RESIDUAL, "{worst} px, {score:?}");
}

#[test]
fn clearance_is_measured_joint_by_joint() {
    /// Greatest error of a joint's clearance on exact outlines, in pixels.
    const CLEARANCE: f64 = 0.1;
    let (score, _) = solve(&Options { clearance: [0.0, 4.0], seed: 41, ..Options::default() }, &Params::default());
    assert!(score.is_perfect() && score.worst_clearance < CLEARANCE, "{score:?}");
}

/// Cut by one kerf, the joints of a puzzle tell each other what it is: of noisy pictures each alone is off by up to 0.2 px.
#[test]
fn joints_of_one_kerf_know_it_together() {
    /// Greatest error of a joint's clearance on noisy, blurred pictures, in pixels.
    const CLEARANCE: f64 = 0.1;
    for (seed, kerf) in [(43, 0.0), (44, 1.5)] {
        let options = Options {
            rows: 3,
            columns: 4,
            clearance: [kerf, kerf],
            noise: 20.0,
            blur: 4.0,
            vignette: 0.5,
            seed,
            ..Options::default()
        };
        let puzzle = Puzzle::generate(&options).expect("valid options");
        let pieces = puzzle.seen().expect("a piece in each frame");
        let assembly = jigsaw::assemble(&pieces, &Params::default()).expect("valid pieces");
        let score = puzzle.score(&pieces, &assembly);
        assert!(score.is_perfect() && score.worst_clearance < CLEARANCE, "{score:?}");
    }
}

#[test]
fn the_literal_rules_thin_out_the_table_step_by_step() {
    let params = Params { policy: Policy::Paper, backtracks: 20, ..Params::default() };
    // The paper's rules need mouths wider than necks: a puzzle cut with clearance.
    let options = Options { rows: 2, columns: 3, clearance: [1.0, 1.0], seed: 4, ..Options::default() };
    let (_, assembly) = solve(&options, &params);
    let t = assembly.table;
    let steps = [t.pairs, t.after_opening, t.after_length, t.after_correlation, t.after_overlap];
    assert!(steps.windows(2).all(|w| w[0] >= w[1]), "{t:?}");
    assert!(t.pairs > t.after_overlap && t.after_overlap >= 7, "{t:?}");
}

/// The greedy descent of the paper takes wrong pairs, after which pieces can't be joined up or mouths stay open. Going back
/// mends that in some puzzles, and spoils none.
#[test]
fn backtracking_mends_what_the_greedy_descent_spoils() {
    let (mut spoilt, mut mended) = (0, 0);
    for seed in 1..9 {
        let options = Options { rows: 3, columns: 4, clearance: [0.5, 0.5], seed, ..Options::default() };
        let paper = |backtracks| Params { policy: Policy::Paper, backtracks, ..Params::default() };
        let (greedy, _) = solve(&options, &paper(0));
        let (backtracked, assembly) = solve(&options, &paper(300));
        assert!(backtracked.is_perfect() || !greedy.is_perfect(), "seed {seed}: {backtracked:?}");
        spoilt += usize::from(!greedy.is_perfect());
        if backtracked.is_perfect() && !greedy.is_perfect() {
            mended += 1;
            assert!(assembly.table.backtracks > 0, "seed {seed}: {:?}", assembly.table);
        }
    }
    assert!(spoilt > 0 && mended > 0, "{mended} of {spoilt} mended");
}

#[test]
fn order_of_insertion_and_threads_do_not_matter() {
    let puzzle = Puzzle::generate(&Options { seed: 21, ..Options::default() }).expect("valid options");
    let pieces = puzzle.exact().expect("features of true outlines");
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
    let pieces = puzzle.exact().expect("features of true outlines");
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

/// A piece that lies elsewhere now, as a camera that looks down on the table sees it.
fn moved(piece: &Piece, id: &str, seen: u64) -> Piece {
    let mut border = piece.features.border.clone();
    let motion = nalgebra::Isometry2::new(nalgebra::Vector2::new(300.5, -40.25), 1.0);
    border.points.iter_mut().for_each(|p| *p = motion * *p);
    let features = isthmus::Features::from_border(border, piece.features.noise).expect("a border");
    Piece { id: id.to_owned(), seen, features }
}

/// Ids of the pieces that are placed, left over, and known from where they lay before, however they come.
fn ids_of(pieces: &[Piece]) -> [Vec<String>; 3] {
    let run = |pieces: &[Piece], threads: usize| {
        let assembly = jigsaw::assemble(pieces, &Params { threads, ..Params::default() }).expect("valid pieces");
        assert!(assembly.placements.iter().all(|p| p.component == 0));
        let placed = assembly.placements.iter().map(|p| p.piece).collect();
        let earlier = assembly.earlier.clone();
        [placed, assembly.unplaced, earlier].map(|places| {
            let mut ids: Vec<String> = places.into_iter().map(|k| pieces[k].id.clone()).collect();
            ids.sort();
            ids
        })
    };
    let ids = run(pieces, 1);
    let backwards: Vec<Piece> = pieces.iter().rev().cloned().collect();
    assert_eq!(run(&backwards, 2), ids);
    ids
}

/// Where a piece was seen last it lies; what was seen at once are two pieces.
#[test]
fn of_copies_the_one_seen_last_is_placed() {
    let puzzle = Puzzle::generate(&Options { rows: 3, columns: 4, seed: 9, ..Options::default() }).expect("valid");
    let before = puzzle.exact().expect("features of true outlines");
    let names: Vec<String> = before.iter().map(|p| p.id.clone()).collect();
    let with = |copies: &[Piece]| ids_of(&[&before, copies].concat());
    let instead = |k: usize, id: &str| {
        let mut ids = names.clone();
        ids[k] = id.to_owned();
        ids.sort();
        ids
    };
    let none: Vec<String> = Vec::new();
    for id in ["a", "z"] {
        // Wherever the new name stands among the others.
        let [placed, unplaced, earlier] = with(&[moved(&before[5], id, 1)]);
        assert_eq!((placed, unplaced, earlier), (instead(5, id), none.clone(), vec![names[5].clone()]));
    }
    assert_eq!(with(&[moved(&before[5], "a", 0)]), [instead(5, "a"), vec![names[5].clone()], none.clone()]);
    assert_eq!(with(&[moved(&before[5], "z", 0)]), [names.clone(), vec!["z".to_owned()], none.clone()]);
    let twice = [moved(&before[5], "a", 1), moved(&before[5], "b", 2)];
    assert_eq!(with(&twice), [instead(5, "b"), none.clone(), vec!["a".to_owned(), names[5].clone()]]);
    // Somebody has swept over the table: where the pieces lay is no second puzzle.
    let swept: Vec<Piece> = before.iter().map(|p| moved(p, &format!("{}_again", p.id), 1)).collect();
    let again: Vec<String> = names.iter().map(|id| format!("{id}_again")).collect();
    assert_eq!(with(&swept), [again, none, names]);
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
    let pieces = puzzle.exact().expect("features of true outlines");
    let mut solver = Solver::new(Params::default()).expect("valid parameters");
    solver.insert(pieces[0].clone()).expect("first");
    let error = solver.insert(pieces[0].clone()).expect_err("twice").to_string();
    assert!(error.contains(&pieces[0].id), "{error}");
    let mut broken = pieces[1].clone();
    broken.features.border.points[5].x = f64::NAN;
    let error = solver.insert(broken).expect_err("not a number").to_string();
    assert!(error.contains("finite"), "{error}");
}

/// Of the matings said to be 0.95 sure, at least 95 % are right, also where nearly all edges are alike.
#[test]
fn confidence_means_what_it_says() {
    const SURE: f64 = 0.95;
    let (mut right, mut all) = (0, 0);
    for (seed, similarity) in [(1, 0.9), (2, 0.98), (3, 0.99), (4, 0.995), (5, 0.999)] {
        let puzzle = Puzzle::generate(&Options { seed, similarity, ..Options::default() }).expect("valid options");
        let pieces = puzzle.exact().expect("features of true outlines");
        let mut assembly = jigsaw::assemble(&pieces, &Params::default()).expect("valid pieces");
        assembly.matings.retain(|m| m.confidence >= SURE);
        right += puzzle.score(&pieces, &assembly).right_matings;
        all += assembly.matings.len();
    }
    assert!(all > 0 && right as f64 >= SURE * all as f64, "{right} of {all}");
}

#[test]
fn what_is_less_sure_than_asked_for_stays_out() {
    let params = Params { minimum_confidence: 0.999_999, ..Params::default() };
    let (score, assembly) = solve(&Options { rows: 1, columns: 6, seed: 2, ..Options::default() }, &params);
    let (_, all) = solve(&Options { rows: 1, columns: 6, seed: 2, ..Options::default() }, &Params::default());
    assert!(assembly.matings.iter().all(|m| m.confidence >= params.minimum_confidence), "{score:?}");
    assert!(assembly.placements.iter().all(|p| p.confidence >= params.minimum_confidence), "{score:?}");
    assert!(all.matings.iter().all(|m| m.confidence >= Params::default().minimum_confidence));
    assert!(assembly.matings.len() <= all.matings.len());
}

/// A piece as a camera sees it that measures its axes differently (`[x, y]`, negative: in a mirror).
fn scaled(piece: &Piece, scale: [f64; 2]) -> Piece {
    let mut border = piece.features.border.clone();
    border.points.iter_mut().for_each(|p| (p.x, p.y) = (scale[0] * p.x, scale[1] * p.y));
    if scale[0] * scale[1] < 0.0 {
        border.points.reverse();
    }
    let noise = piece.features.noise;
    Piece { features: isthmus::Features::from_border(border, noise).expect("a border"), ..piece.clone() }
}

/// Scanners stretch what they scan: a piece that is off by 2 % is laid where its whole border fits, but its mirror image
/// stays left over.
#[test]
fn a_strained_piece_is_filled_in_and_a_mirrored_one_is_not() {
    for seed in 51..54 {
        let options = Options { seed, noise: 10.0, blur: 2.0, ..Options::default() };
        let puzzle = Puzzle::generate(&options).expect("valid options");
        let seen = puzzle.seen().expect("pieces in their frames");
        // A mating of the strained piece is off by so much that in one assembly of five a tab beside it passes for its own.
        for (scale, placed, wrong) in [([1.0, 1.02], 24, 1), ([-1.0, 1.0], 23, 0)] {
            let mut pieces = seen.clone();
            pieces[8] = scaled(&seen[8], scale);
            let assembly = jigsaw::assemble(&pieces, &Params::default()).expect("valid pieces");
            let score = puzzle.score(&pieces, &assembly);
            assert_eq!(assembly.placements.len(), placed, "{seed} {scale:?}: {score:?}");
            assert!(score.wrong_matings <= wrong, "{seed} {scale:?}: {score:?}");
        }
    }
}
