//! ROS 2 command line: `--ros-args`, remapping, parameters and names.
//!
//! The grammar is that of rcl: ROS arguments stand between `--ros-args` and `--` (or the end), any number of times;
//! everything else is left to the program. Names are resolved here, because the client library knows neither
//! remapping nor private (`~/`) names.
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

use std::path::{Path, PathBuf};

use log::LevelFilter;
use ros2_client::ParameterValue;
use serde_yaml_ng::Value;

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
    #[error("name '{name}': {rule}")]
    Name {
        /// The name.
        name: String,
        /// The rule it breaks.
        rule: &'static str,
    },
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

/// A value given to a parameter, before any node has looked at it.
#[derive(Debug, Clone, PartialEq)]
pub struct Override {
    /// Parameter name.
    pub name: String,
    /// Its value.
    pub value: ParameterValue,
    /// Whether it was meant for this node alone (`-p`, or a file key that names the node) rather than for every node
    /// of a launch (`/**` in a file): only then is a name the node doesn't know a mistake.
    pub addressed: bool,
}

#[derive(Debug, Clone)]
struct Assignment {
    /// Pattern for the full node name (with `*`, `**`), or a plain node name for `-p node:name:=value`.
    node: String,
    addressed: bool,
    name: String,
    value: ParameterValue,
}

#[derive(Debug, Clone)]
struct Remap {
    node: Option<String>,
    from: String,
    to: String,
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
    /// use jigsaw_nodes::ros::args::RosArgs;
    /// let args = RosArgs::parse(["--ros-args", "-r", "__ns:=/cell", "-r", "image:=/camera/image", "-p", "k:=2"])?;
    /// let names = args.node("/", "capture_node")?;
    /// assert_eq!(names.full_name(), "/cell/capture_node");
    /// assert_eq!(names.topic("image")?, "/camera/image");
    /// assert_eq!(names.topic("pieces/image")?, "/cell/pieces/image");
    /// # Ok::<(), jigsaw_nodes::ros::args::ArgsError>(())
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
            "-r" | "--remap" => self.remaps.push(parse_remap(&value("[node:]from:=to")?)?),
            "-p" | "--param" => self.assignments.push(parse_assignment(&value("[node:]name:=value")?)?),
            "--params-file" => {
                let file = value("a YAML file")?;
                self.assignments.extend(read_parameters_file(Path::new(&file))?);
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
        let rule = |keys: &[&str]| {
            self.remaps
                .iter()
                .find(|r| keys.contains(&r.from.as_str()) && r.node.as_deref().is_none_or(|n| n == name))
                .map(|r| r.to.clone())
        };
        let own = rule(&["__node", "__name"]).unwrap_or_else(|| name.to_owned());
        let namespace = rule(&["__ns"]).unwrap_or_else(|| namespace.to_owned());
        check_token(&own, &own)?;
        let namespace = absolute_namespace(&namespace)?;
        let remaps = self
            .remaps
            .iter()
            .filter(|r| !r.from.starts_with("__") && r.node.as_deref().is_none_or(|n| n == own || n == name))
            .cloned()
            .collect();
        Ok(NodeNames { namespace, name: own, remaps })
    }

    /// The values given to the parameters of a node, in the order in which they apply.
    pub fn overrides(&self, node: &NodeNames) -> Vec<Override> {
        let full_name = node.full_name();
        self.assignments
            .iter()
            .filter(|a| if a.node.contains('/') { matches(&a.node, &full_name) } else { a.node == node.name })
            .map(|a| Override { name: a.name.clone(), value: a.value.clone(), addressed: a.addressed })
            .collect()
    }
}

/// The names of a node and of everything it opens.
#[derive(Debug, Clone)]
pub struct NodeNames {
    namespace: String,
    name: String,
    remaps: Vec<Remap>,
}

impl NodeNames {
    /// Namespace, absolute.
    pub fn namespace(&self) -> &str {
        &self.namespace
    }

    /// Name without the namespace.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Namespace and name.
    pub fn full_name(&self) -> String {
        join(&self.namespace, &self.name)
    }

    /// The absolute name of a topic after remapping; `name` may be relative, absolute or private (`~/`).
    ///
    /// # Errors
    /// [`ArgsError::Name`] where the name or what it is remapped to breaks the rules of ROS names.
    pub fn topic(&self, name: &str) -> Result<String, ArgsError> {
        self.resolve(name, "rostopic://")
    }

    /// The absolute name of a service (or action) after remapping.
    ///
    /// # Errors
    /// As for [`Self::topic`].
    pub fn service(&self, name: &str) -> Result<String, ArgsError> {
        self.resolve(name, "rosservice://")
    }

    fn resolve(&self, name: &str, scheme: &str) -> Result<String, ArgsError> {
        let full_name = self.expand(name)?;
        for rule in &self.remaps {
            let from = match rule.from.split_once("://") {
                Some(_) => match rule.from.strip_prefix(scheme) {
                    Some(from) => from,
                    None => continue,
                },
                None => &rule.from,
            };
            if self.expand(from)? == full_name {
                return self.expand(&rule.to);
            }
        }
        Ok(full_name)
    }

    fn expand(&self, name: &str) -> Result<String, ArgsError> {
        let namespace = self.namespace.trim_end_matches('/');
        let substituted =
            name.replace("{node}", &self.name).replace("{ns}", namespace).replace("{namespace}", namespace);
        let full_name = match substituted.as_str() {
            "~" => self.full_name(),
            s if s.starts_with("~/") => join(&self.full_name(), &s[2..]),
            s if s.starts_with('/') => s.to_owned(),
            s => join(&self.namespace, s),
        };
        check_name(&full_name, name)?;
        Ok(full_name)
    }
}

/// The DDS domain that `ROS_DOMAIN_ID` names, 0 where it is not set.
///
/// # Errors
/// [`ArgsError::Environment`] for anything but a whole number of 0 to 232, the range for which the ports of RTPS exist.
pub fn domain_id(variable: Option<&str>) -> Result<u16, ArgsError> {
    const LAST_DOMAIN: u16 = 232;
    match variable.map(str::trim) {
        None | Some("") => Ok(0),
        Some(text) => text.parse().ok().filter(|&id| id <= LAST_DOMAIN).ok_or_else(|| ArgsError::Environment {
            variable: "ROS_DOMAIN_ID",
            value: text.to_owned(),
            rule: "must be a whole number of 0 to 232",
        }),
    }
}

fn join(namespace: &str, name: &str) -> String {
    if namespace == "/" { format!("/{name}") } else { format!("{namespace}/{name}") }
}

fn absolute_namespace(namespace: &str) -> Result<String, ArgsError> {
    let absolute = if namespace.starts_with('/') { namespace.to_owned() } else { format!("/{namespace}") };
    if absolute != "/" {
        check_name(&absolute, namespace)?;
    }
    Ok(absolute)
}

fn check_name(full_name: &str, given: &str) -> Result<(), ArgsError> {
    let rule = |rule| Err(ArgsError::Name { name: given.to_owned(), rule });
    let Some(tokens) = full_name.strip_prefix('/') else { return rule("must not be empty") };
    if full_name.ends_with('/') {
        return rule("must not end with '/'");
    }
    tokens.split('/').try_for_each(|token| check_token(token, given))
}

fn check_token(token: &str, given: &str) -> Result<(), ArgsError> {
    let rule = |rule| Err(ArgsError::Name { name: given.to_owned(), rule });
    match token.chars().next() {
        None => rule("must hold no empty part (no '//')"),
        Some(c) if c.is_ascii_digit() => rule("no part of it may start with a digit"),
        Some(_) if !token.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') => {
            rule("may hold letters, digits, '_' and '/' alone")
        }
        Some(_) => Ok(()),
    }
}

/// Splits `[node:]from:=to` into the three; a `:` of `rostopic://` is not one of a node.
fn split_rule(text: &str) -> Option<(Option<&str>, &str, &str)> {
    let (left, right) = text.split_once(":=")?;
    match left.split_once(':') {
        Some((node, from)) if !from.starts_with("//") => Some((Some(node), from, right)),
        _ => Some((None, left, right)),
    }
}

fn parse_remap(text: &str) -> Result<Remap, ArgsError> {
    let error = |reason: &str| ArgsError::Remap { rule: text.to_owned(), reason: reason.to_owned() };
    let (node, from, to) = split_rule(text).ok_or_else(|| error("':=' is missing"))?;
    if from.is_empty() || to.is_empty() || node == Some("") {
        return Err(error("a part of it is empty"));
    }
    if from.starts_with("__") && !["__ns", "__node", "__name"].contains(&from) {
        return Err(error("only __ns, __node and __name begin with '__'"));
    }
    // Any node will do to find out whether the names can be expanded at all.
    let probe = NodeNames { namespace: "/".to_owned(), name: "node".to_owned(), remaps: Vec::new() };
    let checked = match from {
        "__ns" => absolute_namespace(to).map(drop),
        "__node" | "__name" => check_token(to, to),
        _ => probe.topic(from.split_once("://").map_or(from, |(_, name)| name)).and_then(|_| probe.topic(to)).map(drop),
    };
    checked.map_err(|e| error(&e.to_string()))?;
    Ok(Remap { node: node.map(str::to_owned), from: from.to_owned(), to: to.to_owned() })
}

fn parse_assignment(text: &str) -> Result<Assignment, ArgsError> {
    let error = |reason: String| ArgsError::Parameter { rule: text.to_owned(), reason };
    let (node, name, value) = split_rule(text).ok_or_else(|| error("':=' is missing".to_owned()))?;
    if name.is_empty() {
        return Err(error("the name is empty".to_owned()));
    }
    let value = serde_yaml_ng::from_str(value).map_err(|e| error(format!("the value is not YAML: {e}")))?;
    Ok(Assignment {
        node: node.unwrap_or("/**").to_owned(),
        addressed: true,
        name: name.to_owned(),
        value: parameter_value(&value).map_err(error)?,
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

/// The ROS type of a YAML value: a scalar, or a sequence of scalars of one type.
fn parameter_value(value: &Value) -> Result<ParameterValue, String> {
    match value {
        Value::Bool(b) => Ok(ParameterValue::Boolean(*b)),
        Value::Number(n) => match (n.as_i64(), n.as_f64()) {
            (Some(i), _) => Ok(ParameterValue::Integer(i)),
            (None, Some(d)) if n.is_f64() => Ok(ParameterValue::Double(d)),
            _ => Err(format!("{n} does not fit a 64-bit integer")),
        },
        Value::String(s) => Ok(ParameterValue::String(s.clone())),
        Value::Tagged(tagged) => parameter_value(&tagged.value),
        Value::Sequence(items) => sequence_value(items),
        Value::Null => Err("it has no value".to_owned()),
        Value::Mapping(_) => Err("a map is no value of a parameter".to_owned()),
    }
}

fn sequence_value(items: &[Value]) -> Result<ParameterValue, String> {
    let values: Vec<ParameterValue> = items.iter().map(parameter_value).collect::<Result<_, _>>()?;
    let mixed = || "the values of a list must be of one type".to_owned();
    match values.first() {
        None => Ok(ParameterValue::StringArray(Vec::new())),
        Some(ParameterValue::Boolean(_)) => values
            .iter()
            .map(|v| if let ParameterValue::Boolean(b) = v { Ok(*b) } else { Err(mixed()) })
            .collect::<Result<_, _>>()
            .map(ParameterValue::BooleanArray),
        Some(ParameterValue::Integer(_)) => values
            .iter()
            .map(|v| if let ParameterValue::Integer(i) = v { Ok(*i) } else { Err(mixed()) })
            .collect::<Result<_, _>>()
            .map(ParameterValue::IntegerArray),
        Some(ParameterValue::Double(_)) => values
            .iter()
            .map(|v| if let ParameterValue::Double(d) = v { Ok(*d) } else { Err(mixed()) })
            .collect::<Result<_, _>>()
            .map(ParameterValue::DoubleArray),
        Some(ParameterValue::String(_)) => values
            .iter()
            .map(|v| if let ParameterValue::String(s) = v { Ok(s.clone()) } else { Err(mixed()) })
            .collect::<Result<_, _>>()
            .map(ParameterValue::StringArray),
        Some(_) => Err("a list holds plain values alone".to_owned()),
    }
}

fn read_parameters_file(file: &Path) -> Result<Vec<Assignment>, ArgsError> {
    let error = |reason: String| ArgsError::ParametersFile { file: file.to_owned(), reason };
    let text = std::fs::read_to_string(file).map_err(|e| error(e.to_string()))?;
    parse_parameters(&text).map_err(error)
}

fn parse_parameters(text: &str) -> Result<Vec<Assignment>, String> {
    let mut assignments = Vec::new();
    match serde_yaml_ng::from_str(text).map_err(|e| format!("not YAML: {e}"))? {
        Value::Mapping(nodes) => collect_nodes(&nodes, "", &mut assignments)?,
        Value::Null => {}
        _ => return Err("must be a map of node names".to_owned()),
    }
    Ok(assignments)
}

/// Node keys may nest (`ns:` `node:` `ros__parameters:`) and hold slashes and wildcards.
fn collect_nodes(nodes: &serde_yaml_ng::Mapping, prefix: &str, found: &mut Vec<Assignment>) -> Result<(), String> {
    for (key, value) in nodes {
        let key = key.as_str().ok_or_else(|| format!("node name {key:?} is no text"))?;
        let Value::Mapping(inner) = value else {
            return Err(format!("'{key}' must hold 'ros__parameters'"));
        };
        if key == "ros__parameters" {
            if prefix.is_empty() {
                return Err("'ros__parameters' stands outside of any node".to_owned());
            }
            collect_parameters(inner, "", prefix, found)?;
        } else {
            collect_nodes(inner, &format!("{prefix}/{}", key.trim_matches('/')), found)?;
        }
    }
    Ok(())
}

fn collect_parameters(
    parameters: &serde_yaml_ng::Mapping,
    prefix: &str,
    node: &str,
    found: &mut Vec<Assignment>,
) -> Result<(), String> {
    for (key, value) in parameters {
        let key = key.as_str().ok_or_else(|| format!("parameter name {key:?} of {node} is no text"))?;
        let name = format!("{prefix}{key}");
        if let Value::Mapping(inner) = value {
            collect_parameters(inner, &format!("{name}."), node, found)?;
        } else {
            let value = parameter_value(value).map_err(|e| format!("parameter '{name}' of {node}: {e}"))?;
            let addressed = node.rsplit('/').next().is_some_and(|last| !last.contains('*'));
            found.push(Assignment { node: node.to_owned(), addressed, name, value });
        }
    }
    Ok(())
}

/// Whether a full node name fits a pattern in which `*` stands for one part and `**` for any number of them.
fn matches(pattern: &str, full_name: &str) -> bool {
    fn parts_match(pattern: &[&str], name: &[&str]) -> bool {
        match (pattern.split_first(), name.split_first()) {
            (None, None) => true,
            (Some((&"**", rest)), _) => (0..=name.len()).any(|skip| parts_match(rest, &name[skip..])),
            (Some((&"*", rest)), Some((_, name))) => parts_match(rest, name),
            (Some((part, rest)), Some((token, name))) => part == token && parts_match(rest, name),
            _ => false,
        }
    }
    let split =
        |text: &'_ str| -> Vec<String> { text.split('/').filter(|part| !part.is_empty()).map(str::to_owned).collect() };
    let (pattern, name) = (split(pattern), split(full_name));
    let pattern: Vec<&str> = pattern.iter().map(String::as_str).collect();
    let name: Vec<&str> = name.iter().map(String::as_str).collect();
    parts_match(&pattern, &name)
}

#[cfg(test)]
mod tests {
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
        args.assignments = parse_parameters(text).unwrap();
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
    fn broken_parameter_files_are_refused() {
        for (text, said) in [
            ("[1, 2]", "map of node names"),
            ("node: 1", "'node' must hold"),
            ("ros__parameters: {a: 1}", "outside of any node"),
            ("node: {ros__parameters: {a: [1, b]}}", "'a' of /node"),
            ("a: [", "not YAML"),
        ] {
            let message = parse_parameters(text).unwrap_err();
            assert!(message.contains(said), "{text}: {message}");
        }
        assert!(parse_parameters("").unwrap().is_empty());
    }

    #[test]
    fn the_domain_is_a_number_in_range() {
        assert_eq!(domain_id(None).unwrap(), 0);
        assert_eq!(domain_id(Some("42")).unwrap(), 42);
        for bad in ["233", "-1", "x", "1.5"] {
            assert!(domain_id(Some(bad)).unwrap_err().to_string().contains(bad));
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
