//! Parameters: declared once, in a table of each node, and checked wherever a value comes from.
//!
//! A table names every parameter with type, default, unit, rule and description. From it come the start-up check, the
//! parameter services ([`super::services`]), the tables of the README ([`markdown`]) and the files under
//! `launch-scripts/` ([`yaml`]). A value that breaks its rule is refused with the reason, and the old value stays.

use std::sync::{Mutex, PoisonError, RwLock};

use futures::channel::mpsc;
use ros2_client::ParameterValue;
use ros2_client::parameters::raw;

use super::arguments::assignments::Override;

/// Default value of a parameter; its variant is the type.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Default {
    /// `bool`
    Bool(bool),
    /// `int64`
    Integer(i64),
    /// `float64`
    Double(f64),
    /// `string`
    Text(&'static str),
    /// `string[]`
    Texts(&'static [&'static str]),
}

/// What a value has to keep to, beside its type.
#[derive(Debug, Clone, Copy)]
pub enum Rule {
    /// Any value of the type.
    Any,
    /// A whole number from the first to the last, both allowed.
    Integers(i64, i64),
    /// A finite number from the first to the last, both allowed.
    Doubles(f64, f64),
    /// One of these words.
    OneOf(&'static [&'static str]),
    /// A text (each text of a list) for which the function holds; the words say what it wants.
    Texts(&'static str, fn(&str) -> bool),
}

/// A parameter as it is declared.
#[derive(Debug, Clone, Copy)]
pub struct Spec {
    /// Name.
    pub name: &'static str,
    /// Default value, and with it the type.
    pub default: Default,
    /// Unit, empty where it has none.
    pub unit: &'static str,
    /// What a value must keep to.
    pub rule: Rule,
    /// What it does, one sentence.
    pub description: &'static str,
    /// Whether it can be set at start-up alone.
    pub read_only: bool,
}

/// Why a value was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// No such parameter.
    #[error("parameter '{name}' is unknown to {node}; it has: {known}")]
    Unknown {
        /// The name given.
        name: String,
        /// The node.
        node: String,
        /// The names of its parameters.
        known: String,
    },
    /// A value of another type.
    #[error("parameter '{name}': {value} is of type {given}, wanted is {wanted}")]
    Type {
        /// Parameter.
        name: String,
        /// Value given.
        value: String,
        /// Its type.
        given: &'static str,
        /// The declared type.
        wanted: &'static str,
    },
    /// A value that breaks the rule.
    #[error("parameter '{name}': {value} breaks the rule: {rule}")]
    Rule {
        /// Parameter.
        name: String,
        /// Value given.
        value: String,
        /// The rule.
        rule: String,
    },
    /// A parameter that can't be set while the node runs.
    #[error("parameter '{name}' is read-only: it can be set at start-up alone")]
    ReadOnly {
        /// Parameter.
        name: String,
    },
}

impl Spec {
    /// Name of the type, as in ROS.
    pub fn type_name(&self) -> &'static str {
        type_name(&self.default_value())
    }

    /// The default as a value.
    pub fn default_value(&self) -> ParameterValue {
        match self.default {
            Default::Bool(b) => ParameterValue::Boolean(b),
            Default::Integer(i) => ParameterValue::Integer(i),
            Default::Double(d) => ParameterValue::Double(d),
            Default::Text(t) => ParameterValue::String(t.to_owned()),
            Default::Texts(t) => ParameterValue::StringArray(t.iter().map(|&t| t.to_owned()).collect()),
        }
    }

    /// The rule in words, empty where there is none.
    pub fn rule_text(&self) -> String {
        match self.rule {
            Rule::Any => String::new(),
            Rule::Integers(from, i64::MAX) => format!("at least {from}"),
            Rule::Integers(from, to) => format!("{from} to {to}"),
            Rule::Doubles(from, to) => format!("{from:?} to {to:?}"),
            Rule::OneOf(words) => format!("one of {}", words.join(", ")),
            Rule::Texts(words, _) => words.to_owned(),
        }
    }

    fn check(&self, value: &ParameterValue) -> Result<(), ParameterError> {
        if std::mem::discriminant(value) != std::mem::discriminant(&self.default_value()) {
            return Err(ParameterError::Type {
                name: self.name.to_owned(),
                value: show(value),
                given: type_name(value),
                wanted: self.type_name(),
            });
        }
        let holds = match (self.rule, value) {
            (Rule::Integers(from, to), ParameterValue::Integer(i)) => (from..=to).contains(i),
            (Rule::Doubles(from, to), ParameterValue::Double(d)) => (from..=to).contains(d),
            (Rule::OneOf(words), ParameterValue::String(s)) => words.contains(&s.as_str()),
            (Rule::Texts(_, holds), ParameterValue::String(s)) => holds(s),
            (Rule::Texts(_, holds), ParameterValue::StringArray(all)) => all.iter().all(|s| holds(s)),
            _ => true,
        };
        if holds {
            Ok(())
        } else {
            Err(ParameterError::Rule { name: self.name.to_owned(), value: show(value), rule: self.rule_text() })
        }
    }

    /// The ROS description of the parameter.
    pub fn descriptor(&self) -> raw::ParameterDescriptor {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" [{}]", self.unit) };
        let constraint = match self.rule {
            Rule::OneOf(_) | Rule::Texts(..) => self.rule_text(),
            _ => String::new(),
        };
        raw::ParameterDescriptor {
            name: self.name.to_owned(),
            r#type: ParameterValue::to_parameter_type_raw(&self.default_value()),
            description: format!("{}{unit}", self.description),
            additional_constraints: constraint,
            read_only: self.read_only,
            dynamic_typing: false,
            floating_point_range: match self.rule {
                Rule::Doubles(from_value, to_value) => {
                    vec![raw::FloatingPointRange { from_value, to_value, step: 0.0 }]
                }
                _ => Vec::new(),
            },
            integer_range: match self.rule {
                Rule::Integers(from_value, to_value) => vec![raw::IntegerRange { from_value, to_value, step: 1 }],
                _ => Vec::new(),
            },
        }
    }
}

/// The parameters of a node with their values. Shared by the node's loop, which reads, and the services, which set.
#[derive(Debug)]
pub struct Parameters {
    node: String,
    specs: Vec<&'static Spec>,
    values: RwLock<Vec<ParameterValue>>,
    watchers: Mutex<Vec<mpsc::Sender<()>>>,
}

impl Parameters {
    /// Declares the parameters of some tables, all at their defaults.
    pub fn declare(node: &str, tables: &[&'static [Spec]]) -> Self {
        let specs: Vec<&'static Spec> = tables.iter().flat_map(|table| table.iter()).collect();
        let values = specs.iter().map(|spec| spec.default_value()).collect();
        Self { node: node.to_owned(), specs, values: RwLock::new(values), watchers: Mutex::new(Vec::new()) }
    }

    /// Every parameter with its value.
    pub fn all(&self) -> Vec<(String, ParameterValue)> {
        let values = self.values.read().unwrap_or_else(PoisonError::into_inner);
        self.specs.iter().zip(values.iter()).map(|(spec, value)| (spec.name.to_owned(), value.clone())).collect()
    }

    /// Takes over the values of the command line and of parameter files. A whole number is taken for a `double`, and a
    /// number for a `string`, because YAML can't tell what was meant; `yes` and `off` for a `bool`, as in ROS.
    ///
    /// # Errors
    /// The first value that breaks a rule. Names that files give to all nodes alike are passed over where they are
    /// unknown.
    pub fn start_with(&self, overrides: &[Override]) -> Result<(), ParameterError> {
        for given in overrides {
            match self.find(&given.name) {
                Ok(index) => {
                    let value = coerce(&given.value, self.specs[index].default);
                    self.specs[index].check(&value)?;
                    self.store(&[(index, value)]);
                }
                Err(unknown) if given.addressed => return Err(unknown),
                Err(_) => log::debug!("parameter '{}' is not one of {}", given.name, self.node),
            }
        }
        Ok(())
    }

    /// Sets one parameter while the node runs.
    ///
    /// # Errors
    /// An unknown name, another type, a value that breaks the rule, or a read-only parameter.
    pub fn set(&self, name: &str, value: &ParameterValue) -> Result<(), ParameterError> {
        self.set_all(&[(name, value)])
    }

    /// Sets some parameters together: all of them or, with the first reason against one, none.
    ///
    /// # Errors
    /// As for [`Self::set`].
    pub fn set_all(&self, changes: &[(&str, &ParameterValue)]) -> Result<(), ParameterError> {
        let checked: Vec<_> = changes
            .iter()
            .map(|&(name, value)| {
                let index = self.find(name)?;
                let spec = self.specs[index];
                spec.check(value)?;
                if spec.read_only {
                    return Err(ParameterError::ReadOnly { name: name.to_owned() });
                }
                Ok((index, value.clone()))
            })
            .collect::<Result<_, _>>()?;
        self.store(&checked);
        // A watcher that has not looked yet will see this change too: its channel is full, which is fine.
        let mut watchers = self.watchers.lock().unwrap_or_else(PoisonError::into_inner);
        watchers.retain_mut(|watcher| watcher.try_send(()).map_or_else(|e| !e.is_disconnected(), |()| true));
        Ok(())
    }

    /// The value of a parameter, `None` if there is none of this name.
    pub fn get(&self, name: &str) -> Option<ParameterValue> {
        let index = self.find(name).ok()?;
        self.values.read().unwrap_or_else(PoisonError::into_inner).get(index).cloned()
    }

    /// How the parameter of this name was declared.
    pub fn spec(&self, name: &str) -> Option<&'static Spec> {
        self.find(name).ok().map(|index| self.specs[index])
    }

    /// The declarations.
    pub fn specs(&self) -> &[&'static Spec] {
        &self.specs
    }

    /// Full name of the node.
    pub fn node(&self) -> &str {
        &self.node
    }

    /// A stream that yields after values have been set (once for several changes if nobody looked between).
    pub fn changes(&self) -> mpsc::Receiver<()> {
        let (sender, receiver) = mpsc::channel(0);
        self.watchers.lock().unwrap_or_else(PoisonError::into_inner).push(sender);
        receiver
    }

    /// The value of a `bool`.
    pub fn bool(&self, spec: &Spec) -> bool {
        match (self.get(spec.name), spec.default) {
            (Some(ParameterValue::Boolean(b)), _) | (_, Default::Bool(b)) => b,
            _ => false,
        }
    }

    /// The value of an `int64`.
    pub fn integer(&self, spec: &Spec) -> i64 {
        match (self.get(spec.name), spec.default) {
            (Some(ParameterValue::Integer(i)), _) | (_, Default::Integer(i)) => i,
            _ => 0,
        }
    }

    /// The value of a `float64`.
    pub fn double(&self, spec: &Spec) -> f64 {
        match (self.get(spec.name), spec.default) {
            (Some(ParameterValue::Double(d)), _) | (_, Default::Double(d)) => d,
            _ => f64::NAN,
        }
    }

    /// The value of a `string`.
    pub fn text(&self, spec: &Spec) -> String {
        match (self.get(spec.name), spec.default) {
            (Some(ParameterValue::String(s)), _) => s,
            (_, Default::Text(s)) => s.to_owned(),
            _ => String::new(),
        }
    }

    /// The value of a `string[]`.
    pub fn texts(&self, spec: &Spec) -> Vec<String> {
        match self.get(spec.name) {
            Some(ParameterValue::StringArray(all)) => all,
            _ => Vec::new(),
        }
    }

    /// How many pieces of work to do at a time: the value of an `int64`, for 0 as many as there are processors.
    pub fn threads(&self, spec: &Spec) -> usize {
        match usize::try_from(self.integer(spec)) {
            Ok(0) | Err(_) => std::thread::available_parallelism().map_or(1, usize::from),
            Ok(threads) => threads,
        }
    }

    fn find(&self, name: &str) -> Result<usize, ParameterError> {
        self.specs.iter().position(|spec| spec.name == name).ok_or_else(|| ParameterError::Unknown {
            name: name.to_owned(),
            node: self.node.clone(),
            known: self.specs.iter().map(|spec| spec.name).collect::<Vec<_>>().join(", "),
        })
    }

    fn store(&self, changes: &[(usize, ParameterValue)]) {
        let mut values = self.values.write().unwrap_or_else(PoisonError::into_inner);
        for (index, value) in changes {
            if let Some(slot) = values.get_mut(*index) {
                *slot = value.clone();
            }
        }
    }
}

/// The table of the README for some declarations.
pub fn markdown(tables: &[&[Spec]]) -> String {
    let mut text = String::from("| parameter | type | default | unit | allowed | what it does |\n");
    text.push_str("| --- | --- | --- | --- | --- | --- |\n");
    for spec in tables.iter().flat_map(|table| table.iter()) {
        let fixed = if spec.read_only { " Read-only." } else { "" };
        text.push_str(&format!(
            "| `{}` | {} | `{}` | {} | {} | {}{fixed} |\n",
            spec.name,
            spec.type_name(),
            show(&spec.default_value()),
            spec.unit,
            spec.rule_text(),
            spec.description
        ));
    }
    text
}

/// The parameter file of a node: every parameter at its default, with a comment.
pub fn yaml(node: &str, tables: &[&[Spec]]) -> String {
    let mut text = format!("# Parameters of {node}, all at their defaults.\n/**/{node}:\n  ros__parameters:\n");
    for spec in tables.iter().flat_map(|table| table.iter()) {
        let mut notes = vec![spec.type_name().to_owned()];
        notes.extend((!spec.unit.is_empty()).then(|| spec.unit.to_owned()));
        notes.extend(Some(spec.rule_text()).filter(|rule| !rule.is_empty()));
        notes.extend(spec.read_only.then(|| "read-only".to_owned()));
        text.push_str(&format!("    # {} ({})\n", spec.description, notes.join("; ")));
        text.push_str(&format!("    {}: {}\n", spec.name, show(&spec.default_value())));
    }
    text
}

/// A value as one writes it in YAML.
pub fn show(value: &ParameterValue) -> String {
    fn list<T>(items: &[T], item: impl Fn(&T) -> String) -> String {
        format!("[{}]", items.iter().map(item).collect::<Vec<_>>().join(", "))
    }
    match value {
        ParameterValue::NotSet => "nothing".to_owned(),
        ParameterValue::Boolean(b) => b.to_string(),
        ParameterValue::Integer(i) => i.to_string(),
        ParameterValue::Double(d) => format!("{d:?}"),
        ParameterValue::String(s) => format!("{s:?}"),
        ParameterValue::ByteArray(b) => list(b, u8::to_string),
        ParameterValue::BooleanArray(b) => list(b, bool::to_string),
        ParameterValue::IntegerArray(i) => list(i, i64::to_string),
        ParameterValue::DoubleArray(d) => list(d, |d| format!("{d:?}")),
        ParameterValue::StringArray(s) => list(s, |s| format!("{s:?}")),
    }
}

fn type_name(value: &ParameterValue) -> &'static str {
    match value {
        ParameterValue::NotSet => "not set",
        ParameterValue::Boolean(_) => "bool",
        ParameterValue::Integer(_) => "int",
        ParameterValue::Double(_) => "double",
        ParameterValue::String(_) => "string",
        ParameterValue::ByteArray(_) => "byte[]",
        ParameterValue::BooleanArray(_) => "bool[]",
        ParameterValue::IntegerArray(_) => "int[]",
        ParameterValue::DoubleArray(_) => "double[]",
        ParameterValue::StringArray(_) => "string[]",
    }
}

fn coerce(value: &ParameterValue, wanted: Default) -> ParameterValue {
    match (value, wanted) {
        (ParameterValue::Integer(i), Default::Double(_)) => ParameterValue::Double(*i as f64),
        (ParameterValue::Integer(_) | ParameterValue::Double(_) | ParameterValue::Boolean(_), Default::Text(_)) => {
            ParameterValue::String(show(value))
        }
        // The words of YAML 1.1, which ROS goes by, that YAML 1.2 has no more.
        (ParameterValue::String(s), Default::Bool(_)) => match s.as_str() {
            "y" | "Y" | "yes" | "Yes" | "YES" | "on" | "On" | "ON" => ParameterValue::Boolean(true),
            "n" | "N" | "no" | "No" | "NO" | "off" | "Off" | "OFF" => ParameterValue::Boolean(false),
            _ => value.clone(),
        },
        _ => value.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALE: Spec = Spec {
        name: "scale",
        default: Default::Double(0.5),
        unit: "m/px",
        rule: Rule::Doubles(0.1, 1.0),
        description: "Scale.",
        read_only: false,
    };
    const COUNT: Spec = Spec {
        name: "count",
        default: Default::Integer(3),
        unit: "",
        rule: Rule::Integers(1, 9),
        description: "Count.",
        read_only: false,
    };
    const MODE: Spec = Spec {
        name: "mode",
        default: Default::Text("a"),
        unit: "",
        rule: Rule::OneOf(&["a", "b"]),
        description: "Mode.",
        read_only: true,
    };
    const SWITCH: Spec = Spec {
        name: "switch",
        default: Default::Bool(false),
        unit: "",
        rule: Rule::Any,
        description: "Switch.",
        read_only: false,
    };
    const TABLE: &[Spec] = &[SCALE, COUNT, MODE, SWITCH];

    fn given(name: &str, value: ParameterValue, addressed: bool) -> Override {
        Override { name: name.to_owned(), value, addressed }
    }

    #[test]
    fn start_values_are_checked() {
        let cases = [
            ("scale", ParameterValue::Double(2.0), "'scale': 2.0 breaks the rule: 0.1 to 1.0"),
            ("scale", ParameterValue::Double(f64::NAN), "NaN breaks the rule"),
            ("scale", ParameterValue::String("x".into()), "\"x\" is of type string, wanted is double"),
            ("count", ParameterValue::Integer(0), "0 breaks the rule: 1 to 9"),
            ("mode", ParameterValue::String("c".into()), "one of a, b"),
            ("mod", ParameterValue::String("a".into()), "'mod' is unknown to n; it has: scale, count, mode, switch"),
        ];
        for (name, value, said) in cases {
            let message =
                Parameters::declare("n", &[TABLE]).start_with(&[given(name, value, true)]).unwrap_err().to_string();
            assert!(message.contains(said), "{message}");
        }
        let parameters = Parameters::declare("n", &[TABLE]);
        parameters
            .start_with(&[
                given("scale", ParameterValue::Integer(1), true),
                given("mode", ParameterValue::String("b".into()), false),
                given("of another node", ParameterValue::Integer(1), false),
            ])
            .unwrap();
        assert_eq!((parameters.double(&SCALE), parameters.text(&MODE)), (1.0, "b".to_owned()));
        for (word, meant) in [("yes", true), ("Off", false), ("ON", true), ("n", false)] {
            parameters.start_with(&[given("switch", ParameterValue::String(word.into()), true)]).unwrap();
            assert_eq!(parameters.bool(&SWITCH), meant, "{word}");
        }
        assert!(parameters.start_with(&[given("switch", ParameterValue::String("maybe".into()), true)]).is_err());
    }

    #[test]
    fn a_set_is_all_or_nothing() {
        let parameters = Parameters::declare("n", &[TABLE]);
        let (good, bad) = (ParameterValue::Integer(5), ParameterValue::Double(5.0));
        assert!(parameters.set_all(&[("count", &good), ("scale", &bad)]).is_err());
        assert_eq!(parameters.integer(&COUNT), 3);
        parameters.set("count", &good).unwrap();
        assert_eq!(parameters.integer(&COUNT), 5);
        let read_only = parameters.set("mode", &ParameterValue::String("b".into())).unwrap_err();
        assert_eq!(read_only, ParameterError::ReadOnly { name: "mode".into() });
    }

    #[test]
    fn watchers_hear_of_changes() {
        let parameters = Parameters::declare("n", &[TABLE]);
        let mut changes = parameters.changes();
        assert!(changes.try_recv().is_err());
        parameters.set("count", &ParameterValue::Integer(5)).unwrap();
        parameters.set("count", &ParameterValue::Integer(6)).unwrap();
        assert!(changes.try_recv().is_ok());
        assert!(parameters.set("count", &ParameterValue::Integer(0)).is_err());
        assert!(changes.try_recv().is_err());
    }

    #[test]
    fn descriptors_carry_range_unit_and_rule() {
        let scale = SCALE.descriptor();
        assert_eq!(scale.description, "Scale. [m/px]");
        assert_eq!((scale.floating_point_range[0].from_value, scale.floating_point_range[0].to_value), (0.1, 1.0));
        assert_eq!(COUNT.descriptor().integer_range[0].to_value, 9);
        let mode = MODE.descriptor();
        assert!(mode.read_only && mode.additional_constraints == "one of a, b" && mode.r#type == 4);
    }

    #[test]
    fn the_written_file_reads_back_as_the_defaults() {
        let folder = std::env::temp_dir().join(format!("jigsaw-params-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("n.param.yaml");
        std::fs::write(&file, yaml("n", &[TABLE])).unwrap();
        let args =
            super::super::arguments::RosArgs::parse(["--ros-args", "--params-file", file.to_str().unwrap()]).unwrap();
        let overrides = args.overrides(&args.node("/any", "n").unwrap());
        assert_eq!(overrides.len(), TABLE.len());
        let parameters = Parameters::declare("n", &[TABLE]);
        parameters.start_with(&overrides).unwrap();
        for spec in TABLE {
            assert_eq!(parameters.get(spec.name), Some(spec.default_value()));
        }
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn the_readme_table_has_a_line_for_each() {
        let text = markdown(&[TABLE]);
        assert_eq!(text.lines().count(), TABLE.len() + 2);
        assert!(text.contains("| `scale` | double | `0.5` | m/px | 0.1 to 1.0 | Scale. |"));
    }
}
