//! Values given to parameters before any node has looked at them: on the command line, and in YAML files.

use ros2_client::ParameterValue;
use serde_yaml_ng::Value;

use super::names::NodeNames;

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

/// A value for a parameter of some nodes.
#[derive(Debug, Clone)]
pub(super) struct Assignment {
    /// Pattern for the full node name (with `*`, `**`), or a plain node name for `-p node:name:=value`.
    node: String,
    addressed: bool,
    name: String,
    value: ParameterValue,
}

impl Assignment {
    /// The assignment `[node:]name:=value`.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn new(node: Option<&str>, name: &str, value: &str) -> Result<Self, String> {
        if name.is_empty() {
            return Err("the name is empty".to_owned());
        }
        let value = serde_yaml_ng::from_str(value).map_err(|e| format!("the value is not YAML: {e}"))?;
        Ok(Self {
            node: node.unwrap_or("/**").to_owned(),
            addressed: true,
            name: name.to_owned(),
            value: parameter_value(&value)?,
        })
    }

    /// What it gives to a node, if anything.
    pub(super) fn given_to(&self, node: &NodeNames) -> Option<Override> {
        let is_meant =
            if self.node.contains('/') { matches(&self.node, &node.full_name()) } else { self.node == node.name() };
        is_meant.then(|| Override { name: self.name.clone(), value: self.value.clone(), addressed: self.addressed })
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
    fn of_one_type<T>(
        values: Vec<ParameterValue>,
        plain: fn(ParameterValue) -> Option<T>,
        list: fn(Vec<T>) -> ParameterValue,
    ) -> Result<ParameterValue, String> {
        let plain: Option<Vec<T>> = values.into_iter().map(plain).collect();
        plain.map(list).ok_or_else(|| "the values of a list must be of one type".to_owned())
    }
    use ParameterValue as P;
    let values: Vec<P> = items.iter().map(parameter_value).collect::<Result<_, _>>()?;
    match values.first() {
        None => Ok(P::StringArray(Vec::new())),
        Some(P::Boolean(_)) => {
            of_one_type(values, |v| if let P::Boolean(b) = v { Some(b) } else { None }, P::BooleanArray)
        }
        Some(P::Integer(_)) => {
            of_one_type(values, |v| if let P::Integer(i) = v { Some(i) } else { None }, P::IntegerArray)
        }
        Some(P::Double(_)) => {
            of_one_type(values, |v| if let P::Double(d) = v { Some(d) } else { None }, P::DoubleArray)
        }
        Some(P::String(_)) => {
            of_one_type(values, |v| if let P::String(s) = v { Some(s) } else { None }, P::StringArray)
        }
        Some(_) => Err("a list holds plain values alone".to_owned()),
    }
}

/// The assignments of a parameter file's text.
///
/// # Errors
/// What is wrong with it.
pub(super) fn parse_file(text: &str) -> Result<Vec<Assignment>, String> {
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

    #[test]
    fn broken_parameter_files_are_refused() {
        for (text, said) in [
            ("[1, 2]", "map of node names"),
            ("node: 1", "'node' must hold"),
            ("ros__parameters: {a: 1}", "outside of any node"),
            ("node: {ros__parameters: {a: [1, b]}}", "'a' of /node"),
            ("a: [", "not YAML"),
        ] {
            let message = parse_file(text).unwrap_err();
            assert!(message.contains(said), "{text}: {message}");
        }
        assert!(parse_file("").unwrap().is_empty());
    }
}
