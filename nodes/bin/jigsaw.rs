//! jigsaw

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use jigsaw_nodes::bag::cli::BagCommand;

#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    #[command(subcommand)]
    Bag(BagCommand),
    Watch(jigsaw_nodes::watch::WatchArgs),
}

fn main() -> ExitCode {
    match Cli::parse().command {
        Command::Bag(command) => jigsaw_nodes::bag::cli::run(command),
        Command::Watch(args) => jigsaw_nodes::watch::run(args),
    }
}
