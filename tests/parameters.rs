//! The parameter files under `launch-scripts/` and the tables of the README say what the nodes declare.
//!
//! `UPDATE_PARAMETER_FILES=1 cargo test --test parameters` writes the files anew; with `--
//! --nocapture` the tables for the README are printed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::Path;

use jigsaw_nodes::ros::node_params::COMMON_PARAMETERS;
use jigsaw_nodes::ros::params::{Spec, markdown, show, yaml};
use jigsaw_nodes::ros::process::Program;
use jigsaw_nodes::{capture, feature, solver};

const PROGRAMS: [Program; 3] = [capture::PROGRAM, feature::PROGRAM, solver::PROGRAM];

fn update() -> bool {
    std::env::var_os("UPDATE_PARAMETER_FILES").is_some()
}

fn tables(program: &Program) -> [&'static [Spec]; 2] {
    [program.parameters, COMMON_PARAMETERS]
}

#[test]
fn parameter_files_are_those_of_the_tables() {
    for program in PROGRAMS {
        let file =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("launch-scripts").join(format!("{}.param.yaml", program.name));
        let wanted = yaml(program.name, &tables(&program));
        if update() {
            std::fs::write(&file, &wanted).unwrap();
        }
        assert_eq!(std::fs::read_to_string(&file).unwrap(), wanted, "{}", file.display());
    }
}

/// A row of a Markdown table that begins with this parameter.
fn row<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find(|line| line.starts_with(&format!("| `{name}` |")))
}

#[test]
fn the_readme_names_every_parameter_with_its_default() {
    for program in PROGRAMS {
        println!("### {}\n\n{}", program.name, markdown(&[program.parameters]));
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    let Ok(readme) = std::fs::read_to_string(file) else { return };
    for spec in PROGRAMS.iter().flat_map(|program| tables(program)).flatten() {
        let row = row(&readme, spec.name).unwrap_or_else(|| panic!("README.md has no row for `{}`", spec.name));
        assert!(row.contains(&show(&spec.default_value())), "README.md: {row}");
    }
}
