//! Names of nodes, topics and services, and the rules that remap them. They are resolved here, because the client library knows
//! neither remapping nor private (`~/`) names.

/// A name that breaks the rules of ROS names.
#[derive(Debug, Clone, thiserror::Error)]
#[error("name '{name}': {rule}")]
pub struct NameError {
    /// The name.
    pub name: String,
    /// The rule it breaks.
    pub rule: &'static str,
}

/// A rule: what a node calls so is to be called otherwise.
#[derive(Debug, Clone)]
pub(super) struct Remap {
    node: Option<String>,
    from: String,
    to: String,
}

impl Remap {
    /// The rule `[node:]from:=to`.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn new(node: Option<&str>, from: &str, to: &str) -> Result<Self, String> {
        if from.is_empty() || to.is_empty() || node == Some("") {
            return Err("a part of it is empty".to_owned());
        }
        if from.starts_with("__") && !["__ns", "__node", "__name"].contains(&from) {
            return Err("only __ns, __node and __name begin with '__'".to_owned());
        }
        // Any node will do to find out whether the names can be expanded at all.
        let probe = NodeNames { namespace: "/".to_owned(), name: "node".to_owned(), remaps: Vec::new() };
        let checked = match from {
            "__ns" => absolute_namespace(to).map(drop),
            "__node" | "__name" => check_token(to, to),
            _ => probe
                .topic(from.split_once("://").map_or(from, |(_, name)| name))
                .and_then(|_| probe.topic(to))
                .map(drop),
        };
        checked.map_err(|e| e.to_string())?;
        Ok(Self { node: node.map(str::to_owned), from: from.to_owned(), to: to.to_owned() })
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
    /// Those of the node that its program calls so, after the rules.
    ///
    /// # Errors
    /// [`NameError`] where a rule gives the node a name ROS does not allow.
    pub(super) fn new(namespace: &str, name: &str, remaps: &[Remap]) -> Result<Self, NameError> {
        let rule = |keys: &[&str]| {
            remaps
                .iter()
                .find(|r| keys.contains(&r.from.as_str()) && r.node.as_deref().is_none_or(|n| n == name))
                .map(|r| r.to.clone())
        };
        let own = rule(&["__node", "__name"]).unwrap_or_else(|| name.to_owned());
        let namespace = rule(&["__ns"]).unwrap_or_else(|| namespace.to_owned());
        check_token(&own, &own)?;
        let namespace = absolute_namespace(&namespace)?;
        let remaps = remaps
            .iter()
            .filter(|r| !r.from.starts_with("__") && r.node.as_deref().is_none_or(|n| n == own || n == name))
            .cloned()
            .collect();
        Ok(Self { namespace, name: own, remaps })
    }

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
    /// [`NameError`] where the name or what it is remapped to breaks the rules of ROS names.
    pub fn topic(&self, name: &str) -> Result<String, NameError> {
        self.resolve(name, "rostopic://")
    }

    /// The absolute name of a service (or action) after remapping.
    ///
    /// # Errors
    /// As for [`Self::topic`].
    pub fn service(&self, name: &str) -> Result<String, NameError> {
        self.resolve(name, "rosservice://")
    }

    fn resolve(&self, name: &str, scheme: &str) -> Result<String, NameError> {
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

    fn expand(&self, name: &str) -> Result<String, NameError> {
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

fn join(namespace: &str, name: &str) -> String {
    if namespace == "/" { format!("/{name}") } else { format!("{namespace}/{name}") }
}

fn absolute_namespace(namespace: &str) -> Result<String, NameError> {
    let absolute = if namespace.starts_with('/') { namespace.to_owned() } else { format!("/{namespace}") };
    if absolute != "/" {
        check_name(&absolute, namespace)?;
    }
    Ok(absolute)
}

fn check_name(full_name: &str, given: &str) -> Result<(), NameError> {
    let rule = |rule| Err(NameError { name: given.to_owned(), rule });
    let Some(tokens) = full_name.strip_prefix('/') else { return rule("must not be empty") };
    if full_name.ends_with('/') {
        return rule("must not end with '/'");
    }
    tokens.split('/').try_for_each(|token| check_token(token, given))
}

fn check_token(token: &str, given: &str) -> Result<(), NameError> {
    let rule = |rule| Err(NameError { name: given.to_owned(), rule });
    match token.chars().next() {
        None => rule("must hold no empty part (no '//')"),
        Some(c) if c.is_ascii_digit() => rule("no part of it may start with a digit"),
        Some(_) if !token.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') => {
            rule("may hold letters, digits, '_' and '/' alone")
        }
        Some(_) => Ok(()),
    }
}
