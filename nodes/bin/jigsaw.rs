//! The command line `jigsaw`; see `jigsaw --help`.

fn main() -> std::process::ExitCode {
    jigsaw_nodes::cli::run(std::env::args_os())
}
