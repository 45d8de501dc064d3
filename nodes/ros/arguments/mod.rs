//! ROS 2 command line: `--ros-args`, remapping, parameters and names.
//!
//! The grammar is that of rcl: ROS arguments stand between `--ros-args` and `--` (or the end), any number of times;
//! everything else is left to the program.
//!
//! | argument | meaning |
//! | --- | --- |
//! | `-r`, `--remap [node:]from:=to` | remap a topic or service; `__ns`, `__node` (or `__name`) rename the node |
//! | `-p`, `--param [node:]name:=value` | set a parameter; the value is YAML |
//! | `--params-file FILE` | set the parameters of a YAML file, for the nodes its keys name (`*` and `**` as in ROS) |
//! | `--log-level [logger:=]LEVEL` | debug, info, warn, error, fatal; of all lines, or those of a node or namespace |
//! | `-e`, `--enclave NAME` | security enclave |
//! | `--[en\|dis]able-rosout-logs`, `--[en\|dis]able-stdout-logs`, `--[en\|dis]able-external-lib-logs` | logging |
//!
//! Where a parameter is given more than once, the last one on the command line wins.

use std::path::PathBuf;

use log::LevelFilter;

pub mod assignments;
pub mod names;

use assignments::{Assignment, Override, parse_file};
use names::{NameError, NodeNames, Remap};

/// Why a command line was not understood. Every message names the argument and the rule it breaks.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ArgsError {
    /// An option stands last that needs a value.
    #[error("{option} needs a value: {wanted}")]
    MissingValue {
        /// The option.
        option: String,
        /// The form of the value.
        wanted: &'static str,
    },
    /// A ROS argument nobody knows.
    #[error("unknown ROS argument '{0}' (see `--help`; arguments after `--` are left to the program)")]
    Unknown(String),
    /// A remap rule without `:=`, or with a bad name in it.
    #[error("remap rule '{rule}': {reason} (form: [node:]from:=to)")]
    Remap {
        /// The rule as given.
        rule: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A parameter assignment without `:=`, or with a value of no ROS type.
    #[error("parameter '{rule}': {reason} (form: [node:]name:=value)")]
    Parameter {
        /// The assignment as given.
        rule: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A parameter file that can't be read or has not the form of one.
    #[error("parameter file {}: {reason}", file.display())]
    ParametersFile {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A log level nobody knows.
    #[error("log level '{0}' is none of debug, info, warn, error, fatal")]
    LogLevel(String),
    /// A name that breaks the rules of ROS names.
    #[error(transparent)]
    Name(#[from] NameError),
    /// A variable of the environment with a value out of range.
    #[error("{variable}='{value}': {rule}")]
    Environment {
        /// Name of the variable.
        variable: &'static str,
        /// Its value.
        value: String,
        /// The rule it breaks.
        rule: &'static str,
    },
}

/// Everything ROS in a command line.
#[derive(Debug, Clone)]
pub struct RosArgs {
    /// What is not ROS's, for the program.
    pub rest: Vec<String>,
    /// Lowest level that is logged, if one was given.
    pub log_level: Option<LevelFilter>,
    /// Levels of single loggers.
    pub logger_levels: Vec<(String, LevelFilter)>,
    /// Whether log lines go to `/rosout`.
    pub rosout: bool,
    /// Whether log lines go to the console.
    pub console: bool,
    /// Security enclave.
    pub enclave: Option<String>,
    remaps: Vec<Remap>,
    assignments: Vec<Assignment>,
}

impl RosArgs {
    /// Parses the arguments of a program, its own name not among them. Parameter files are read.
    ///
    /// ```
    /// use jigsaw_nodes::ros::arguments::RosArgs;
    /// let args = RosArgs::parse(["--ros-args", "-r", "__ns:=/cell", "-r", "image:=/camera/image", "-p", "k:=2"])?;
    /// let names = args.node("/", "capture_node")?;
    /// assert_eq!(names.full_name(), "/cell/capture_node");
    /// assert_eq!(names.topic("image")?, "/camera/image");
    /// assert_eq!(names.topic("pieces/image")?, "/cell/pieces/image");
    /// # Ok::<(), jigsaw_nodes::ros::arguments::ArgsError>(())
    /// ```
    ///
    /// # Errors
    /// [`ArgsError`] names the first argument that is not understood.
    pub fn parse<S: Into<String>>(args: impl IntoIterator<Item = S>) -> Result<Self, ArgsError> {
        let mut parsed = Self {
            rest: Vec::new(),
            log_level: None,
            logger_levels: Vec::new(),
            rosout: true,
            console: true,
            enclave: None,
            remaps: Vec::new(),
            assignments: Vec::new(),
        };
        let mut args = args.into_iter().map(Into::into);
        let mut ros = false;
        while let Some(argument) = args.next() {
            match (ros, argument.as_str()) {
                (_, "--ros-args") => ros = true,
                (true, "--") => ros = false,
                (true, _) => parsed.ros_argument(&argument, &mut args)?,
                (false, _) => parsed.rest.push(argument),
            }
        }
        Ok(parsed)
    }

    fn ros_argument(&mut self, argument: &str, args: &mut impl Iterator<Item = String>) -> Result<(), ArgsError> {
        let (option, inline) = match argument.split_once('=') {
            // `--log-level=debug` is one argument, `-r a:=b` is not of this form.
            Some((option, value)) if option.starts_with("--") && !option.ends_with(':') => {
                (option, Some(value.to_owned()))
            }
            _ => (argument, None),
        };
        let mut value = |wanted: &'static str| {
            inline
                .clone()
                .or_else(|| args.next())
                .ok_or_else(|| ArgsError::MissingValue { option: option.to_owned(), wanted })
        };
        match option {
            "-r" | "--remap" => {
                let rule = value("[node:]from:=to")?;
                let remap = split_rule(&rule).and_then(|(node, from, to)| Remap::new(node, from, to));
                self.remaps.push(remap.map_err(|reason| ArgsError::Remap { rule, reason })?);
            }
            "-p" | "--param" => {
                let rule = value("[node:]name:=value")?;
                let given = split_rule(&rule).and_then(|(node, name, value)| Assignment::new(node, name, value));
                self.assignments.push(given.map_err(|reason| ArgsError::Parameter { rule, reason })?);
            }
            "--params-file" => {
                let file = value("a YAML file")?;
                let text = std::fs::read_to_string(&file).map_err(|e| e.to_string());
                let given = text.and_then(|text| parse_file(&text));
                self.assignments
                    .extend(given.map_err(|reason| ArgsError::ParametersFile { file: file.into(), reason })?);
            }
            "--log-level" => {
                let text = value("[logger:=]level")?;
                match text.split_once(":=") {
                    Some((logger, level)) => self.logger_levels.push((logger.to_owned(), parse_level(level)?)),
                    None => self.log_level = Some(parse_level(&text)?),
                }
            }
            "-e" | "--enclave" => self.enclave = Some(value("the name of an enclave")?),
            "--enable-rosout-logs" => self.rosout = true,
            "--disable-rosout-logs" => self.rosout = false,
            "--enable-stdout-logs" => self.console = true,
            "--disable-stdout-logs" => self.console = false,
            "--enable-external-lib-logs" | "--disable-external-lib-logs" => {}
            "--log-config-file" | "--log-file-name" => {
                value("a file")?;
            }
            _ => return Err(ArgsError::Unknown(argument.to_owned())),
        }
        Ok(())
    }

    /// The names of one node: its own after `__ns` and `__node`, and the rules for its topics and services.
    ///
    /// # Errors
    /// [`ArgsError::Name`] where a rule gives the node a name ROS does not allow.
    pub fn node(&self, namespace: &str, name: &str) -> Result<NodeNames, ArgsError> {
        Ok(NodeNames::new(namespace, name, &self.remaps)?)
    }

    /// The values given to the parameters of a node, in the order in which they apply.
    pub fn overrides(&self, node: &NodeNames) -> Vec<Override> {
        self.assignments.iter().filter_map(|assignment| assignment.given_to(node)).collect()
    }
}

/// Splits `[node:]from:=to` into the three; a `:` of `rostopic://` is not one of a node.
fn split_rule(text: &str) -> Result<(Option<&str>, &str, &str), String> {
    let (left, right) = text.split_once(":=").ok_or("':=' is missing")?;
    Ok(match left.split_once(':') {
        Some((node, from)) if !from.starts_with("//") => (Some(node), from, right),
        _ => (None, left, right),
    })
}

fn parse_level(text: &str) -> Result<LevelFilter, ArgsError> {
    match text.to_ascii_lowercase().as_str() {
        "debug" => Ok(LevelFilter::Debug),
        "info" => Ok(LevelFilter::Info),
        "warn" | "warning" => Ok(LevelFilter::Warn),
        "error" | "fatal" => Ok(LevelFilter::Error),
        _ => Err(ArgsError::LogLevel(text.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use ros2_client::ParameterValue;

    use super::*;

    fn parse(args: &[&str]) -> RosArgs {
        RosArgs::parse(args.iter().copied()).unwrap()
    }

    fn error(args: &[&str]) -> String {
        RosArgs::parse(args.iter().copied()).unwrap_err().to_string()
    }

    fn values(args: &RosArgs, name: &str) -> Vec<(String, ParameterValue)> {
        let node = args.node("/", name).unwrap();
        args.overrides(&node).into_iter().map(|o| (o.name, o.value)).collect()
    }

    #[test]
    fn ros_arguments_are_told_from_those_of_the_program() {
        let args = parse(&["a", "--ros-args", "-p", "x:=1", "--", "b", "--ros-args", "-p", "y:=2"]);
        assert_eq!(args.rest, ["a", "b"]);
        assert_eq!(
            values(&args, "n"),
            [("x".to_owned(), ParameterValue::Integer(1)), ("y".to_owned(), ParameterValue::Integer(2))]
        );
    }

    #[test]
    fn values_have_the_types_of_yaml() {
        let cases = [
            ("x:=true", ParameterValue::Boolean(true)),
            ("x:=-3", ParameterValue::Integer(-3)),
            ("x:=1e-4", ParameterValue::Double(1e-4)),
            ("x:=2.0", ParameterValue::Double(2.0)),
            ("x:=text", ParameterValue::String("text".into())),
            ("x:='12'", ParameterValue::String("12".into())),
            ("x:=[1, 2]", ParameterValue::IntegerArray(vec![1, 2])),
            ("x:=[1.5, 2.0]", ParameterValue::DoubleArray(vec![1.5, 2.0])),
            ("x:=[a, b]", ParameterValue::StringArray(vec!["a".into(), "b".into()])),
            ("x:=[true]", ParameterValue::BooleanArray(vec![true])),
            ("x:=/a/folder:with=signs", ParameterValue::String("/a/folder:with=signs".into())),
        ];
        for (text, value) in cases {
            assert_eq!(values(&parse(&["--ros-args", "-p", text]), "n"), [("x".to_owned(), value)], "{text}");
        }
    }

    #[test]
    fn names_follow_namespace_node_and_rules() {
        let args = parse(&[
            "--ros-args",
            "-r",
            "__ns:=/cell",
            "-r",
            "__node:=eye",
            "-r",
            "image:=/camera/image",
            "-r",
            "~/own:=shared",
            "-r",
            "other:pieces/image:=nowhere",
            "-r",
            "eye:pieces/image:=cut/image",
            "-r",
            "rosservice://capture:=shoot",
        ]);
        let node = args.node("/", "capture_node").unwrap();
        assert_eq!(node.full_name(), "/cell/eye");
        for (name, resolved) in [
            ("image", "/camera/image"),
            ("/cell/image", "/camera/image"),
            ("~/own", "/cell/shared"),
            ("~/else", "/cell/eye/else"),
            ("pieces/image", "/cell/cut/image"),
            ("/tf_static", "/tf_static"),
            ("{node}/x", "/cell/eye/x"),
            ("{ns}/x", "/cell/x"),
            ("{namespace}/{node}/x", "/cell/eye/x"),
            ("/cam__0/image", "/cam__0/image"),
            ("capture", "/cell/capture"),
        ] {
            assert_eq!(node.topic(name).unwrap(), resolved, "{name}");
        }
        assert_eq!(node.service("capture").unwrap(), "/cell/shoot");
        assert!(node.topic("bad name").is_err());
    }

    #[test]
    fn a_rule_for_one_node_leaves_the_others_alone() {
        let args = parse(&["--ros-args", "-r", "a:__node:=b", "-r", "a:__ns:=/x", "-p", "a:k:=1", "-p", "b:k:=2"]);
        assert_eq!(args.node("/", "a").unwrap().full_name(), "/x/b");
        assert_eq!(args.node("/", "c").unwrap().full_name(), "/c");
        assert_eq!(values(&args, "c"), []);
        assert_eq!(values(&args, "a"), [("k".to_owned(), ParameterValue::Integer(2))]);
    }

    #[test]
    fn parameter_files_address_nodes_as_in_ros() {
        let text = "
/**:
  ros__parameters: {all: 1, deep: {er: 2.5}}
eye:
  ros__parameters: {named: true}
cell:
  eye:
    ros__parameters: {nested: [1, 2]}
/*/eye:
  ros__parameters: {star: a}
/cell/**/eye:
  ros__parameters: {stars: a}
/other/eye:
  ros__parameters: {missed: 1}
";
        let mut args = parse(&[]);
        args.assignments = parse_file(text).unwrap();
        let names = |namespace: &str| -> Vec<String> {
            let node = args.node(namespace, "eye").unwrap();
            args.overrides(&node).into_iter().map(|o| o.name).collect()
        };
        assert_eq!(names("/cell"), ["all", "deep.er", "nested", "star", "stars"]);
        assert_eq!(names("/"), ["all", "deep.er", "named"]);
        assert_eq!(names("/cell/a"), ["all", "deep.er", "stars"]);
    }

    #[test]
    fn mistakes_are_named() {
        for (args, said) in [
            (&["--ros-args", "-r"][..], "-r needs a value"),
            (&["--ros-args", "-r", "a=b"], "'a=b': ':=' is missing"),
            (&["--ros-args", "-r", "a:=b c"], "'b c': may hold letters"),
            (&["--ros-args", "-r", "__foo:=b"], "__ns, __node and __name"),
            (&["--ros-args", "-r", "__ns:=/a//b"], "no empty part"),
            (&["--ros-args", "-p", "x"], "'x': ':=' is missing"),
            (&["--ros-args", "-p", "x:="], "it has no value"),
            (&["--ros-args", "-p", "x:=[1, a]"], "of one type"),
            (&["--ros-args", "-p", "x:={a: 1}"], "a map is no value"),
            (&["--ros-args", "-p", "x:=[1"], "not YAML"),
            (&["--ros-args", "--params-file", "/no/such.yaml"], "/no/such.yaml"),
            (&["--ros-args", "--log-level", "loud"], "'loud' is none of"),
            (&["--ros-args", "--frobnicate"], "'--frobnicate'"),
        ] {
            let message = error(args);
            assert!(message.contains(said) && !message.contains('\n'), "{args:?}: {message}");
        }
    }

    #[test]
    fn log_levels() {
        let args = parse(&["--ros-args", "--log-level", "debug", "--log-level", "solver_node:=warn"]);
        assert_eq!(args.log_level, Some(LevelFilter::Debug));
        assert_eq!(args.logger_levels, [("solver_node".to_owned(), LevelFilter::Warn)]);
        assert_eq!(parse(&["--ros-args", "--log-level=error"]).log_level, Some(LevelFilter::Error));
    }
}
