//! The composed cell: the three nodes in one process, joined by channels instead of DDS.
//!
//! Camera topics, services, parameters and results are on DDS as ever; what goes between the nodes (`pieces/image`,
//! `pieces/features`, `pieces/reset`) is not. The nodes keep their names, so that `-p solver_node:policy:=paper` or a
//! parameter file addresses one of them. A parameter without a node goes to every node that has it.

use std::path::PathBuf;
use std::process::ExitCode;

use futures::channel::mpsc;
use futures::future;

use crate::ros::exit::{ProcessError, exit_code};
use crate::ros::params::Spec;
use crate::ros::process::{Process, Program, Work};
use crate::ros::session::{CHANNEL_DEPTH, Session};
use crate::{capture, feature, solver};

/// Run the three nodes in one process, joined by channels instead of DDS.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct CellArgs {
    /// Folder of pictures to take instead of the topics of a camera.
    #[arg(long, value_name = "FOLDER")]
    pub source: Option<PathBuf>,
    /// Arguments for the nodes: --ros-args, remapping rules, parameters.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "--ros-args …")]
    pub ros: Vec<String>,
}

const NAME: &str = "jigsaw cell";

/// The parameters of all nodes.
const TABLES: &[&[Spec]] = &[capture::params::PARAMETERS, feature::params::PARAMETERS, solver::params::PARAMETERS];

/// Runs the cell until a signal ends it. To be called before any thread is started.
pub fn run(args: CellArgs) -> ExitCode {
    let mut ros = args.ros;
    if let Some(folder) = args.source {
        ros.extend(["--ros-args", "-p"].map(str::to_owned));
        // Quoted, so that a folder named 12 or yes stays a text.
        ros.push(format!(
            "{}:{}:={:?}",
            capture::PROGRAM.name,
            capture::params::SOURCE.name,
            folder.display().to_string()
        ));
    }
    let result = Process::start(NAME, ros).and_then(|process| {
        process.only_ros_arguments()?;
        process.composed_of(TABLES).started_again().run(open)
    });
    exit_code(NAME, result)
}

fn node(process: &mut Process, program: Program) -> Result<Session, ProcessError> {
    process.node(program.name, program.parameters)
}

fn open(process: &mut Process) -> Result<Work, ProcessError> {
    let (to_feature, pieces) = mpsc::channel(CHANNEL_DEPTH);
    let (to_solver, features) = mpsc::channel(CHANNEL_DEPTH);
    let (to_capture, resets) = mpsc::channel(CHANNEL_DEPTH);
    let solver = solver::open(node(process, solver::PROGRAM)?, features, to_capture)?;
    let feature = feature::open(node(process, feature::PROGRAM)?, pieces, to_solver)?;
    let capture = capture::open(node(process, capture::PROGRAM)?, resets, to_feature)?;
    Ok(Box::pin(async move { future::try_join3(capture, feature, solver).await.map(drop) }))
}
