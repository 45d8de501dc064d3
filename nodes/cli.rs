//! The command line `jigsaw`: arguments in, exit code out.
//!
//! Exit codes: 0 done (for `assemble`: every piece placed in one assembly), 1 done in part, 2 bad input, with one line on
//! stderr that says what is wrong.

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Mutex;

use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use jigsaw::generate::{self, Puzzle};
use jigsaw::{Params, Policy};

use crate::bag::cli::BagCommand;
use crate::cell::CellArgs;
use crate::console::{complain, say};
use crate::offline::{self, OfflineError, Progress};
use crate::results::ASSEMBLY_FILE;
use crate::watch::WatchArgs;

/// Everything is done.
const DONE: u8 = 0;
/// Something is left over.
const PARTIAL: u8 = 1;
/// The input or the arguments can't be used.
const BAD_INPUT: u8 = 2;

/// Assemble jigsaw puzzles by shape alone.
#[derive(Debug, Parser)]
#[command(name = "jigsaw", version, arg_required_else_help = true, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "\
Examples:
  jigsaw generate --rows 4 --columns 6 --seed 7 --out puzzle   make a puzzle of 24 pieces, with truth.json
  jigsaw assemble puzzle --out solved                          solve it; see solved/assembly.png
  jigsaw inspect puzzle/piece_0000.png --out look              see what the shape analysis finds on a piece

Exit codes: 0 done, 1 done in part, 2 bad input.";

#[derive(Debug, Subcommand)]
enum Command {
    Assemble(AssembleArgs),
    Inspect(InspectArgs),
    Generate(Box<GenerateArgs>),
    #[command(subcommand)]
    Bag(BagCommand),
    Cell(CellArgs),
    Watch(WatchArgs),
}

/// Assemble the pieces seen in images or in a bag, and write assembly.json, assembly.png and matches.csv.
///
/// An image may show one piece or many, brighter or darker than the ground. Exit code 0 only if every piece is placed in
/// one assembly, 1 if some are left over, 2 if nothing can be used.
#[derive(Debug, Args)]
struct AssembleArgs {
    /// Image files, folders of images, and rosbag2 bags.
    #[arg(required = true, value_name = "PATH")]
    paths: Vec<PathBuf>,
    /// Folder for the results; made if it isn't there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Rules that decide.
    #[arg(long, value_enum, default_value_t = PolicyArg::Standard)]
    policy: PolicyArg,
    /// Seconds for solving, after which the best assembly so far is taken; 0 for no limit.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0)]
    time_budget: f64,
    /// Threads; 0 for one each processor.
    #[arg(long, value_name = "N", default_value_t = 0)]
    threads: usize,
    /// Leave out pieces that are less sure than this.
    #[arg(long, value_name = "0..1", default_value_t = Params::default().minimum_confidence)]
    minimum_confidence: f64,
    /// Say nothing but errors.
    #[arg(long, short)]
    quiet: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum PolicyArg {
    /// Refined poses with clearance, loop closure, pose graph.
    Standard,
    /// The literal rules of Webster et al. 1990.
    Paper,
}

/// Show what the shape analysis finds: a picture of each piece and features.json.
#[derive(Debug, Args)]
struct InspectArgs {
    /// Image files and folders of images.
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    /// Folder for the results; made if it isn't there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Say nothing but errors.
    #[arg(long, short)]
    quiet: bool,
}

/// Make a synthetic puzzle: images as a camera over a light table sees the pieces, and truth.json.
///
/// The same options make the same puzzle, pixel by pixel.
#[derive(Debug, Args)]
struct GenerateArgs {
    /// Rows of pieces.
    #[arg(long, value_name = "N", default_value_t = 4)]
    rows: usize,
    /// Columns of pieces.
    #[arg(long, visible_alias = "cols", value_name = "N", default_value_t = 6)]
    columns: usize,
    /// Seed of everything random.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Folder for the images and truth.json; made if it isn't there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Write a rosbag2 bag of PNG frames instead of image files; --out must not exist yet.
    #[arg(long, help_heading = "Bag")]
    bag: bool,
    /// Frames a second.
    #[arg(long, value_name = "HZ", default_value_t = 5.0, value_parser = parse_rate, help_heading = "Bag")]
    rate: f64,

    /// How the sheet is divided.
    #[arg(long, value_enum, default_value_t = CutArg::Grid, help_heading = "Shape")]
    cut: CutArg,
    /// What the rim looks like.
    #[arg(long, value_enum, default_value_t = RimArg::Straight, help_heading = "Shape")]
    rim: RimArg,
    /// Size of a piece without its tabs, in pixels [default: 0.24 of the frame].
    #[arg(long, value_name = "PX", help_heading = "Shape")]
    piece_size: Option<f64>,
    /// 0: every joint its own shape; 1: all joints alike.
    #[arg(long, value_name = "0..1", default_value_t = 0.0, help_heading = "Shape")]
    similarity: f64,
    /// Clearance (kerf) between joined borders, in pixels: one number, or LOW..HIGH for a random one at each joint.
    #[arg(long, value_name = "PX", default_value = "0", value_parser = parse_range, help_heading = "Shape")]
    clearance: Range,
    /// Fraction of the joints that are waves without a neck.
    #[arg(long, value_name = "0..1", default_value_t = 0.0, help_heading = "Shape")]
    wavy: f64,

    /// Pieces taken away.
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Heap")]
    missing: usize,
    /// Pieces that lie there twice.
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Heap")]
    duplicate: usize,
    /// Pieces that lie face down.
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Heap")]
    flipped: usize,
    /// Puzzles mixed in one heap.
    #[arg(long, value_name = "N", default_value_t = 1, help_heading = "Heap")]
    puzzles: usize,

    /// Size of a frame [default: 1024x1024, more where it holds more than one piece].
    #[arg(long, value_name = "WxH", value_parser = parse_size, help_heading = "Camera")]
    frame: Option<Size>,
    /// Pieces in one frame.
    #[arg(long, value_name = "N", default_value_t = 1, help_heading = "Camera")]
    pieces_per_frame: usize,
    /// Light table (dark pieces on bright ground) or light from above (bright pieces on dark ground).
    #[arg(long, value_enum, default_value_t = LightArg::Back, help_heading = "Camera")]
    light: LightArg,
    /// Standard deviation of the sensor noise, in grey levels.
    #[arg(long, value_name = "LEVELS", default_value_t = 0.0, help_heading = "Camera")]
    noise: f64,
    /// Standard deviation of the blur, in pixels.
    #[arg(long, value_name = "PX", default_value_t = 0.0, help_heading = "Camera")]
    blur: f64,
    /// Fraction of the light that is lost in the corners of the frame.
    #[arg(long, value_name = "0..1", default_value_t = 0.0, help_heading = "Camera")]
    vignette: f64,
    /// Say nothing but errors.
    #[arg(long, short)]
    quiet: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum CutArg {
    /// Corners meet four by four.
    Grid,
    /// Shifted rows: corners meet three by three.
    Brick,
    /// Pieces with about six sides.
    Honeycomb,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum RimArg {
    /// A rectangle with straight sides.
    Straight,
    /// Wavy sides, some cells left out.
    Ragged,
    /// The inner part of a larger puzzle.
    Patch,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LightArg {
    /// Dark pieces on bright ground.
    Back,
    /// Bright pieces on dark ground.
    Front,
}

fn parse_rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if (0.01..=1000.0).contains(&rate) => Ok(rate),
        _ => Err("must be 0.01 to 1000 frames a second".into()),
    }
}

/// Two numbers `LOW..HIGH`, or one for both.
#[derive(Debug, Clone, Copy)]
struct Range([f64; 2]);

fn parse_range(text: &str) -> Result<Range, String> {
    let number = |part: &str| part.trim().parse::<f64>().map_err(|_| format!("{part:?} is not a number"));
    match text.split_once("..") {
        Some((low, high)) => Ok(Range([number(low)?, number(high)?])),
        None => number(text).map(|v| Range([v, v])),
    }
}

/// `WIDTHxHEIGHT`, in pixels.
#[derive(Debug, Clone, Copy)]
struct Size([u32; 2]);

fn parse_size(text: &str) -> Result<Size, String> {
    let parts = text.split_once(['x', 'X']);
    let numbers = parts.and_then(|(width, height)| Some([width.parse().ok()?, height.parse().ok()?]));
    numbers.map(Size).ok_or_else(|| "expected WIDTHxHEIGHT, for example 1024x1024".into())
}

/// Runs the command line; `arguments` begin with the name of the program.
pub fn run(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) if !error.use_stderr() => {
            // Help and version go to stdout; a closed pipe there is no error.
            let _ = error.print();
            return DONE.into();
        }
        Err(error) => {
            complain!("jigsaw: {}", usage_error(&error));
            return BAD_INPUT.into();
        }
    };
    let code = match cli.command {
        Command::Assemble(args) => assemble(&args),
        Command::Inspect(args) => inspect(&args),
        Command::Generate(args) => generate(&args),
        Command::Bag(command) => return crate::bag::cli::run(command),
        Command::Cell(args) => return crate::cell::run(args),
        Command::Watch(args) => return crate::watch::run(args),
    };
    match code {
        Ok(code) => code.into(),
        Err(error) => {
            complain!("jigsaw: {error}");
            BAD_INPUT.into()
        }
    }
}

/// Why a command can't run.
#[derive(Debug, thiserror::Error)]
enum CliError {
    #[error(transparent)]
    Offline(#[from] OfflineError),
    #[error(transparent)]
    Generate(#[from] generate::GenerateError),
    #[error(transparent)]
    Params(#[from] jigsaw::ParamsError),
}

/// The first paragraph of clap's message on one line, and where to read on.
fn usage_error(error: &clap::Error) -> String {
    let text = error.to_string();
    let first = text.split("\n\n").next().unwrap_or_default();
    let line = first.split_whitespace().collect::<Vec<_>>().join(" ");
    let line = line.strip_prefix("error: ").unwrap_or(&line);
    format!("{line} (see jigsaw --help)")
}

fn assemble(args: &AssembleArgs) -> Result<u8, CliError> {
    let params = Params {
        policy: match args.policy {
            PolicyArg::Standard => Policy::Standard,
            PolicyArg::Paper => Policy::Paper,
        },
        time_budget: args.time_budget,
        threads: args.threads,
        minimum_confidence: args.minimum_confidence,
        ..Params::default()
    };
    params.validate()?;
    let display = Display::new(args.quiet);
    let run = || offline::assemble(&args.paths, &args.out, &params, &display);
    let outcome = match rayon::ThreadPoolBuilder::new().num_threads(args.threads).build() {
        Ok(pool) => pool.install(run),
        // Without threads of its own it runs on the shared ones.
        Err(_) => run(),
    };
    display.finish();
    let outcome = outcome?;
    let seconds = outcome.seconds;
    display.say(&format!(
        "{}/{} pieces placed, {} matings, {} ({:.2} s: segment {:.2}, features {:.2}, match {:.2}, assemble {:.2})",
        outcome.placed,
        outcome.pieces,
        outcome.matings,
        if outcome.components == 1 { "1 assembly".into() } else { format!("{} assemblies", outcome.components) },
        seconds.segment + seconds.features + seconds.r#match + seconds.assemble,
        seconds.segment,
        seconds.features,
        seconds.r#match,
        seconds.assemble,
    ));
    display.say(&format!("{}", args.out.join(ASSEMBLY_FILE).display()));
    Ok(if outcome.is_complete() { DONE } else { PARTIAL })
}

fn inspect(args: &InspectArgs) -> Result<u8, CliError> {
    let display = Display::new(args.quiet);
    let pieces = offline::inspect(&args.images, &args.out, &display);
    display.finish();
    display.say(&format!("{} pieces, {}", pieces?, args.out.join("features.json").display()));
    Ok(DONE)
}

fn generate(args: &GenerateArgs) -> Result<u8, CliError> {
    let options = generate::Options {
        rows: args.rows,
        columns: args.columns,
        seed: args.seed,
        puzzles: args.puzzles,
        cut: match args.cut {
            CutArg::Grid => generate::Cut::Grid,
            CutArg::Brick => generate::Cut::Brick,
            CutArg::Honeycomb => generate::Cut::Honeycomb,
        },
        rim: match args.rim {
            RimArg::Straight => generate::Rim::Straight,
            RimArg::Ragged => generate::Rim::Ragged,
            RimArg::Patch => generate::Rim::Patch,
        },
        piece_size: args.piece_size,
        similarity: args.similarity,
        clearance: args.clearance.0,
        wavy: args.wavy,
        missing: args.missing,
        duplicate: args.duplicate,
        flipped: args.flipped,
        frame: args.frame.map(|size| size.0),
        pieces_per_frame: args.pieces_per_frame,
        lighting: match args.light {
            LightArg::Back => generate::Lighting::Back,
            LightArg::Front => generate::Lighting::Front,
        },
        noise: args.noise,
        blur: args.blur,
        vignette: args.vignette,
    };
    let puzzle = Puzzle::generate(&options)?;
    let display = Display::new(args.quiet);
    let written = if args.bag {
        offline::write_bag(&puzzle, &args.out, args.rate, &display)
    } else {
        offline::write_images(&puzzle, &args.out, &display)
    };
    display.finish();
    written?;
    display.say(&format!(
        "{} pieces in {} frames, {}",
        puzzle.pieces().len(),
        puzzle.frame_count(),
        args.out.join("truth.json").display()
    ));
    Ok(DONE)
}

/// Progress on stderr: a bar where a person looks on, warnings always.
struct Display {
    bar: Mutex<ProgressBar>,
    quiet: bool,
    person: bool,
}

impl Display {
    fn new(quiet: bool) -> Self {
        Self { bar: Mutex::new(ProgressBar::hidden()), quiet, person: std::io::stderr().is_terminal() && !quiet }
    }

    fn bar(&self) -> ProgressBar {
        // A thread that panicked while it held the bar leaves a usable bar behind.
        self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }

    fn finish(&self) {
        self.bar().finish_and_clear();
    }

    /// A result on stdout.
    fn say(&self, text: &str) {
        if !self.quiet {
            say!("{text}");
        }
    }
}

impl Progress for Display {
    fn stage(&self, name: &str, steps: usize) {
        if !self.person {
            return;
        }
        let bar = if steps > 0 { ProgressBar::new(steps as u64) } else { ProgressBar::new_spinner() };
        let template = if steps > 0 { "{msg} [{bar:40}] {pos}/{len} {eta}" } else { "{msg} {spinner} {elapsed}" };
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_message(name.to_owned());
        bar.enable_steady_tick(std::time::Duration::from_millis(100));
        let before = {
            let mut current = self.bar.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            std::mem::replace(&mut *current, bar)
        };
        before.finish_and_clear();
    }

    fn step(&self) {
        self.bar().inc(1);
    }

    fn warning(&self, text: &str) {
        self.bar().suspend(|| {
            complain!("warning: {text}");
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }

    #[test]
    fn usage_errors_take_one_line() {
        for arguments in
            [&["jigsaw", "assemble", "x"][..], &["jigsaw", "--fast"], &["jigsaw", "generate", "--rows", "many"]]
        {
            let error = Cli::try_parse_from(arguments).unwrap_err();
            let line = usage_error(&error);
            assert!(!line.contains('\n') && line.ends_with("(see jigsaw --help)"), "{line}");
        }
    }

    #[test]
    fn ranges_and_sizes_are_read() {
        assert_eq!(parse_range("2").unwrap().0, [2.0, 2.0]);
        assert_eq!(parse_range("0.5..4").unwrap().0, [0.5, 4.0]);
        assert!(parse_range("a..4").is_err());
        assert_eq!(parse_size("640x480").unwrap().0, [640, 480]);
        assert!(parse_size("640").is_err());
    }
}
