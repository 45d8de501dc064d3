//! The candidate table, the budget, and that neither order nor threads change anything.

use isthmus::contour::Border;
use isthmus::{Features, Point};
use jigsaw::generate::{Options, Puzzle};
use jigsaw::{Assembly, Budget, Candidate, Fate, Params, Piece, Policy, Rule, Solver};
use nalgebra::Vector2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashSet;
use std::sync::atomic::{AtomicUsize, Ordering};

fn pieces(options: &Options) -> Vec<Piece> {
    let puzzle = Puzzle::generate(options).expect("valid options");
    puzzle.exact().expect("features of true outlines")
}

fn solver(pieces: &[Piece], params: Params) -> Solver {
    let mut solver = Solver::new(params).expect("valid parameters");
    for piece in pieces {
        solver.insert(piece.clone()).expect("unique ids");
    }
    solver
}

fn dropped(rows: &[Candidate], rules: &[Rule]) -> usize {
    rows.iter().filter(|c| rules.iter().any(|r| c.fate == Fate::Dropped(*r))).count()
}

/// Every pair has one row, and the rows that each rule drops are the steps of the counts.
#[test]
fn the_table_explains_every_pair_of_a_small_puzzle() {
    let pieces = pieces(&Options { rows: 3, columns: 4, clearance: [1.0, 1.0], seed: 6, ..Options::default() });
    // So few candidates that the shape index has to choose; one of each mouth is so few that contacts make up for some.
    for (policy, candidates) in [(Policy::Standard, 6), (Policy::Standard, 1), (Policy::Paper, 6)] {
        let mut solver = solver(&pieces, Params { policy, candidates, backtracks: 20, ..Params::default() });
        let assembly = solver.solve();
        let (rows, t) = (solver.candidates(), assembly.table);
        assert_eq!(rows.len(), t.pairs, "{policy:?}");
        let pairs: HashSet<_> =
            rows.iter().map(|c| (c.positive_piece, c.positive_isthmus, c.negative_piece, c.negative_isthmus)).collect();
        assert_eq!(pairs.len(), rows.len(), "{policy:?}: each pair once");
        let (third, fourth) = match policy {
            Policy::Standard => (&[Rule::Shape][..], &[Rule::Placement, Rule::Overlap][..]),
            Policy::Paper => (&[Rule::Correlation][..], &[Rule::Overlap][..]),
        };
        let mated = rows.iter().filter(|c| c.fate == Fate::Mated).count();
        assert_eq!(dropped(&rows, &[Rule::Opening]), t.pairs - t.after_opening, "{policy:?} {t:?}");
        assert_eq!(dropped(&rows, &[Rule::PathLength]), t.after_opening - t.after_length, "{policy:?} {t:?}");
        assert_eq!(dropped(&rows, third), t.after_length - t.after_correlation, "{policy:?} {t:?}");
        assert_eq!(dropped(&rows, fourth), t.after_correlation - t.after_overlap, "{policy:?} {t:?}");
        assert_eq!(mated + dropped(&rows, &[Rule::Rival, Rule::Support]), t.after_overlap, "{policy:?} {t:?}");
        assert_eq!(mated, assembly.matings.len(), "{policy:?}");
        assert!(candidates == 1 || dropped(&rows, fourth) > 0, "{policy:?} {t:?}");
        assert!(dropped(&rows, &[Rule::Opening]) > 0, "{policy:?} {t:?}");
        assert!(policy == Policy::Paper || dropped(&rows, third) > 0, "{t:?}");
        // What was dropped before it was posed has no pose, and what is mated has one.
        assert!(rows.iter().filter(|c| c.fate == Fate::Mated).all(|c| c.posed.is_some()));
        assert!(rows.iter().filter(|c| c.fate == Fate::Dropped(Rule::Opening)).all(|c| c.posed.is_none()));
    }
}

/// Of a large puzzle the refined pairs are listed, which are few for each mouth, and the rest is counted.
#[test]
fn the_table_of_a_large_puzzle_stays_small() {
    let pieces = pieces(&Options { rows: 8, columns: 12, frame: Some([512, 512]), ..Options::default() });
    let mut solver = solver(&pieces, Params::default());
    let assembly = solver.solve();
    let (rows, t) = (solver.candidates(), assembly.table);
    assert!(rows.len() < t.after_correlation && t.after_correlation <= t.after_length, "{} {t:?}", rows.len());
    assert!(t.after_length <= t.after_opening && t.after_opening <= t.pairs, "{t:?}");
    assert!(rows.iter().all(|c| c.posed.is_some()));
    assert_eq!(rows.iter().filter(|c| c.fate == Fate::Mated).count(), assembly.matings.len());
}

/// A budget of so many questions.
struct Questions {
    asked: AtomicUsize,
    most: usize,
}

impl Budget for Questions {
    fn spent(&self) -> f64 {
        self.asked.fetch_add(1, Ordering::Relaxed) as f64 / self.most as f64
    }
}

/// Wherever the budget ends, what there is of an assembly is given and called partial; the next solution does the rest.
#[test]
fn a_budget_cuts_matching_and_assembly_short() {
    let pieces = pieces(&Options { rows: 3, columns: 4, seed: 5, ..Options::default() });
    let whole = solver(&pieces, Params::default()).solve();
    assert!(!whole.partial && whole.placements.len() == pieces.len());
    let mut placed = Vec::new();
    for most in [1, 8, 16, 24, 32, 64, 100_000] {
        let mut solver = solver(&pieces, Params { threads: 1, ..Params::default() });
        let cut = solver.solve_within(&Questions { asked: AtomicUsize::new(0), most });
        assert_eq!(cut.placements.len() + cut.unplaced.len(), pieces.len(), "{most} questions");
        assert!(cut.partial || cut.placements == whole.placements, "{most} questions");
        placed.push((cut.partial, cut.placements.len()));
        let mended = solver.solve();
        assert!(!mended.partial, "{most} questions");
        assert_eq!((&mended.placements, &mended.matings), (&whole.placements, &whole.matings), "{most} questions");
        assert_eq!(mended.table, whole.table, "{most} questions");
    }
    assert_eq!(placed.first(), Some(&(true, 0)), "{placed:?}");
    assert!(placed.iter().any(|p| p.0 && p.1 > 0), "{placed:?}");
    assert_eq!(placed.last(), Some(&(false, pieces.len())), "{placed:?}");
}

/// Everything in an assembly but the times, with ids in place of indices.
fn text(pieces: &[Piece], assembly: &Assembly, table: &[Candidate]) -> String {
    let id = |k: usize| pieces[k].id.as_str();
    let placements: Vec<String> = assembly
        .placements
        .iter()
        .map(|p| format!("{} {:?} {} {:?}", id(p.piece), p.puzzle_from_image, p.component, p.confidence))
        .collect();
    let matings: Vec<String> = assembly
        .matings
        .iter()
        .map(|m| {
            let ends = (id(m.positive_piece), m.positive_isthmus, id(m.negative_piece), m.negative_isthmus);
            format!("{ends:?} {:?}", (m.correlation, m.ave_gap, m.clearance, m.confidence))
        })
        .collect();
    let left: Vec<&str> = assembly.unplaced.iter().map(|k| id(*k)).collect();
    let rows: Vec<String> = table
        .iter()
        .map(|c| {
            let ends = (id(c.positive_piece), c.positive_isthmus, id(c.negative_piece), c.negative_isthmus);
            format!("{ends:?} {:?} {} {:?}", c.posed, c.support, c.fate)
        })
        .collect();
    format!("{placements:#?}\n{matings:#?}\n{left:?}\n{:?}\n{rows:#?}", assembly.table)
}

/// To the last bit: taken in in any order, on any number of threads, all at once or one by one, with pieces taken out
/// again in between, copies among them.
#[test]
fn neither_order_nor_threads_change_a_bit() {
    let mut pieces = pieces(&Options { rows: 4, columns: 5, seed: 8, duplicate: 2, missing: 1, ..Options::default() });
    let n = pieces.len();
    // Of one of the two that are there twice the copy was seen later.
    pieces[n - 1].seen = 1;
    let mut first = None;
    let mut check = |solver: &mut Solver, what: String| {
        let assembly = solver.solve();
        assert_eq!(assembly.earlier.len(), 1, "{what}");
        let text = text(solver.pieces(), &assembly, &solver.candidates());
        assert!(first.get_or_insert_with(|| text.clone()) == &text, "{what} made a difference");
    };
    for (threads, step) in [(1, 1), (2, 5), (5, 7), (2, 3)] {
        // A step that shares no factor with the number of pieces visits all of them.
        let step = (step..).find(|s| (2..=*s).all(|d| s % d + n % d > 0)).expect("there are such numbers");
        let order: Vec<Piece> = (0..n).map(|k| pieces[k * step % n].clone()).collect();
        let params = Params { threads, ..Params::default() };
        check(&mut solver(&order, params), format!("{threads} threads, every {step}-th"));
        let mut growing = Solver::new(params).expect("valid parameters");
        for (k, piece) in order.iter().enumerate() {
            growing.insert(piece.clone()).expect("unique ids");
            if k % 3 == 0 {
                growing.solve();
            }
        }
        let taken = growing.remove(&order[n / 2].id).expect("is there");
        growing.solve();
        growing.insert(taken).expect("was taken out");
        check(&mut growing, format!("{threads} threads, every {step}-th, one by one"));
    }
}

/// A joint as templates for laser cutters have it: three cubic curves. All tabs are alike; they sit a little aside, higher or lower, lean a little, and their
/// flanks leave the corners in somewhat different directions.
fn template(from: Point, to: Point, rng: &mut ChaCha8Rng) -> Vec<Point> {
    const TAB: f64 = 0.1;
    const JITTER: f64 = 0.04;
    const STEPS: usize = 24;
    let [a, b, c, d, e] = std::array::from_fn(|_| rng.random_range(-JITTER..JITTER));
    let along = to - from;
    let up = Vector2::new(along.y, -along.x) * if rng.random() { 1.0 } else { -1.0 };
    let controls = [
        (0.0, 0.0),
        (0.2, a),
        (0.5 + b + d, c - TAB),
        (0.5 + b - TAB, c + TAB),
        (0.5 + b - d - 2.0 * TAB, c + 3.0 * TAB),
        (0.5 + b - d + 2.0 * TAB, c + 3.0 * TAB),
        (0.5 + b + TAB, c + TAB),
        (0.5 + b + d, c - TAB),
        (0.8, e),
        (1.0, 0.0),
    ]
    .map(|(x, y)| from + along * x + up * y);
    let curve = |k: usize| {
        let [p, q, r, s] = std::array::from_fn(|i| controls[k + i].coords);
        (0..STEPS).map(move |i| {
            let t = i as f64 / STEPS as f64;
            let u = 1.0 - t;
            Point::from(p * (u * u * u) + q * (3.0 * u * u * t) + r * (3.0 * u * t * t) + s * (t * t * t))
        })
    };
    [0, 3, 6].into_iter().flat_map(curve).chain([to]).collect()
}

/// Of hundreds of tabs after one template the flanks tell which belongs into a mouth: few candidates are enough.
#[test]
fn tabs_of_one_template_are_told_by_their_flanks() {
    const PITCH: f64 = 100.0;
    /// Waves of each piece's own on its border: wear.
    const WAVES: f64 = 0.15;
    let (rows, columns) = (12, 16);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let corner = |row: usize, column: usize| Point::new(column as f64 * PITCH, row as f64 * PITCH);
    let mut lines = |is_down: bool| -> Vec<Vec<Vec<Point>>> {
        let mut line = |row: usize, column: usize| {
            let (next, is_rim) = if is_down {
                (corner(row + 1, column), column == 0 || column == columns)
            } else {
                (corner(row, column + 1), row == 0 || row == rows)
            };
            let from = corner(row, column);
            if is_rim { vec![from, next] } else { template(from, next, &mut rng) }
        };
        let [last_row, last_column] = if is_down { [rows, columns + 1] } else { [rows + 1, columns] };
        (0..last_row).map(|row| (0..last_column).map(|column| line(row, column)).collect()).collect()
    };
    let (across, down) = (lines(false), lines(true));
    let piece = |k: usize| {
        let (row, column) = (k / columns, k % columns);
        let back = |line: &[Point]| line.iter().rev().copied().collect::<Vec<_>>();
        let sides = [
            across[row][column].clone(),
            down[row][column + 1].clone(),
            back(&across[row + 1][column]),
            back(&down[row][column]),
        ];
        let phase = k as f64;
        let worn = |p: Point| p + Vector2::new((p.y / 3.0 + phase).sin(), (p.x / 3.0 - phase).sin()) * WAVES;
        let outline: Vec<Point> = sides.into_iter().flatten().map(worn).collect();
        let border = Border::from_points(&outline).expect("an outline");
        Piece { id: format!("{k}"), seen: 0, features: Features::from_border(border, 0.02).expect("features") }
    };
    let pieces: Vec<Piece> = (0..rows * columns).map(piece).collect();
    let assembly = solver(&pieces, Params { candidates: 16, ..Params::default() }).solve();
    assert_eq!(assembly.unplaced, [] as [usize; 0]);
    assert!(assembly.placements.iter().all(|p| p.component == 0));
    assert_eq!(assembly.matings.len(), rows * (columns - 1) + (rows - 1) * columns);
}
