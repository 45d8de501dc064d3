//! Reads interface definitions (`.msg`, `.srv`, `.action`) strictly: what is not understood is an error that names file,
//! line and rule, never skipped.
//!
//! The syntax is that of the [ROS 2 interface definition](https://design.ros2.org/articles/legacy_interface_definition.html).
//! Stricter than there: every file opens with a comment that says what it is for, and every name obeys the naming rules.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Name of the byte that ROS puts into a structure without fields, because IDL allows no empty structure.
pub(crate) const DUMMY_FIELD: &str = "structure_needs_at_least_one_member";

/// Longest fixed array that serde (de)serialises; longer ones occur in none of the packages.
const LONGEST_ARRAY: usize = 32;

/// Field names that Rust cannot have, not even as raw identifiers.
const NOT_RAW: [&str; 3] = ["self", "super", "crate"];

/// What a definition breaks.
#[derive(Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum Rule {
    #[error("cannot be read: {0}")]
    Unreadable(String),
    #[error("a file name is CamelCase, as in `PieceImage.msg`, not `{0}`")]
    FileName(String),
    #[error("the file opens with a comment that says what it is for, and an empty line after it")]
    Purpose,
    #[error("`---` parts a {folder} file into {expected} sections, found {found}")]
    Sections { folder: &'static str, expected: usize, found: usize },
    #[error("a line is `type name`, `type name default` or `type NAME=value`, not `{0}`")]
    Line(String),
    #[error("a field name is lower case with single underscores, as in `frame_id`, not `{0}`")]
    FieldName(String),
    #[error("a constant name is upper case with single underscores, as in `NOT_SET`, not `{0}`")]
    ConstantName(String),
    #[error("`{0}` stands twice")]
    Twice(String),
    #[error("`{0}` is no type: it is a primitive, `Name` or `package/Name`, with `[]`, `[n]` or `[<=n]` for arrays")]
    Type(String),
    #[error("type `{0}` is not supported")]
    Unsupported(String),
    #[error("an array size is a whole number from 1 to {LONGEST_ARRAY}, a bound one from 1, not `{0}`")]
    ArraySize(String),
    #[error("a constant is a primitive or a string, not `{0}`")]
    ConstantType(String),
    #[error("`{value}` is no {ty}")]
    Value { value: String, ty: String },
    #[error("no definition of `{0}` is at hand")]
    Unknown(String),
    #[error("`{0}` contains itself")]
    Cycle(String),
}

/// A definition that breaks a rule, and where.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("{}:{line}: {rule}", file.display())]
pub(crate) struct DefinitionError {
    /// The file.
    pub(crate) file: PathBuf,
    /// The line, from 1.
    pub(crate) line: usize,
    /// What it breaks.
    pub(crate) rule: Rule,
}

/// What kind of file an interface is defined in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Message,
    Service,
    Action,
}

impl Kind {
    /// The folder and file ending of the kind.
    pub(crate) fn folder(self) -> &'static str {
        match self {
            Kind::Message => "msg",
            Kind::Service => "srv",
            Kind::Action => "action",
        }
    }

    /// The names that ROS adds to the file's for each section.
    pub(crate) fn sections(self) -> &'static [&'static str] {
        match self {
            Kind::Message => &[""],
            Kind::Service => &["Request", "Response"],
            Kind::Action => &["Goal", "Result", "Feedback"],
        }
    }
}

/// A primitive type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Primitive {
    Bool,
    /// `byte`, and its name in a type description differs from that of `uint8`.
    Byte,
    /// `uint8`, also called `char`.
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

/// A type without its array part.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Base {
    Primitive(Primitive),
    /// Text, with the longest length in bytes where it is bounded.
    String(Option<usize>),
    /// A message of some package.
    Nested {
        package: String,
        name: String,
    },
}

/// The array part of a type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Array {
    None,
    Fixed(usize),
    Bounded(usize),
    Unbounded,
}

/// The type of a field.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Type {
    pub(crate) base: Base,
    pub(crate) array: Array,
}

/// A value of a constant or a default, known to fit its type.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Value {
    Bool(bool),
    Integer(i128),
    Float(f64),
    String(String),
    List(Vec<Value>),
}

/// A named constant.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Constant {
    pub(crate) name: String,
    pub(crate) base: Base,
    pub(crate) value: Value,
    pub(crate) docs: Vec<String>,
    pub(crate) line: String,
}

/// A field.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) ty: Type,
    pub(crate) default: Option<Value>,
    pub(crate) docs: Vec<String>,
    /// The definition without its comment.
    pub(crate) line: String,
    number: usize,
}

/// One structure: a message, or a section of a service or an action.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Structure {
    /// Its section's name, empty for a message.
    pub(crate) section: &'static str,
    pub(crate) constants: Vec<Constant>,
    pub(crate) fields: Vec<Field>,
    /// Its part of the file as it stands.
    pub(crate) text: String,
}

/// One definition file.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Definition {
    pub(crate) file: PathBuf,
    pub(crate) package: String,
    pub(crate) kind: Kind,
    /// The name of the file.
    pub(crate) name: String,
    /// What it is for.
    pub(crate) docs: Vec<String>,
    pub(crate) structures: Vec<Structure>,
}

impl Definition {
    /// The name of one of its structures as ROS writes it, such as `std_srvs/srv/Trigger_Request`.
    pub(crate) fn full_name(&self, structure: &Structure) -> String {
        let joint = if structure.section.is_empty() { "" } else { "_" };
        format!("{}/{}/{}{joint}{}", self.package, self.kind.folder(), self.name, structure.section)
    }
}

/// Every definition of a set of packages, with nothing left unresolved.
#[derive(Debug)]
pub(crate) struct Definitions {
    /// By package, kind and name.
    pub(crate) files: Vec<Definition>,
    messages: BTreeMap<(String, String), usize>,
}

impl Definitions {
    /// Reads the `msg`, `srv` and `action` folders of each package folder given.
    pub(crate) fn read(packages: &[(String, PathBuf)]) -> Result<Self, DefinitionError> {
        let mut files = Vec::new();
        for (package, folder) in packages {
            for kind in [Kind::Message, Kind::Service, Kind::Action] {
                let folder = folder.join(kind.folder());
                if !folder.is_dir() {
                    continue;
                }
                for file in sorted_entries(&folder)? {
                    let text = fs::read_to_string(&file).map_err(|error| unreadable(&file, &error))?;
                    files.push(parse(package, kind, &file, &text)?);
                }
            }
        }
        Self::resolve(files)
    }

    /// Takes parsed definitions together; every type they name must be among them, and none may contain itself.
    pub(crate) fn resolve(files: Vec<Definition>) -> Result<Self, DefinitionError> {
        let messages = files
            .iter()
            .enumerate()
            .filter(|(_, definition)| definition.kind == Kind::Message)
            .map(|(index, definition)| ((definition.package.clone(), definition.name.clone()), index))
            .collect();
        let definitions = Self { files, messages };
        for definition in &definitions.files {
            for structure in &definition.structures {
                definitions.check(definition, structure, &mut Vec::new())?;
            }
        }
        Ok(definitions)
    }

    /// The message that a field's type names, if it names one.
    pub(crate) fn nested(&self, ty: &Type) -> Option<&Definition> {
        match &ty.base {
            Base::Nested { package, name } => {
                self.messages.get(&(package.clone(), name.clone())).map(|&index| &self.files[index])
            }
            _ => None,
        }
    }

    /// The messages that a structure contains at any depth, each once, in the order in which they are met.
    pub(crate) fn dependencies<'a>(&'a self, structure: &'a Structure) -> Vec<&'a Definition> {
        let mut found: Vec<&Definition> = Vec::new();
        let mut open: Vec<&Structure> = vec![structure];
        while let Some(next) = open.pop() {
            for nested in next.fields.iter().filter_map(|field| self.nested(&field.ty)) {
                if !found.iter().any(|known| known.package == nested.package && known.name == nested.name) {
                    found.push(nested);
                    open.extend(&nested.structures);
                }
            }
        }
        found
    }

    fn check(
        &self,
        definition: &Definition,
        structure: &Structure,
        above: &mut Vec<String>,
    ) -> Result<(), DefinitionError> {
        let name = definition.full_name(structure);
        if above.contains(&name) {
            return Err(DefinitionError { file: definition.file.clone(), line: 1, rule: Rule::Cycle(name) });
        }
        above.push(name);
        for field in &structure.fields {
            if let Base::Nested { package, name } = &field.ty.base {
                let nested = self.nested(&field.ty).ok_or_else(|| DefinitionError {
                    file: definition.file.clone(),
                    line: field.number,
                    rule: Rule::Unknown(format!("{package}/{name}")),
                })?;
                for structure in &nested.structures {
                    self.check(nested, structure, above)?;
                }
            }
        }
        above.pop();
        Ok(())
    }
}

/// The entries of a folder in the order of their names, so that the same files give the same code.
pub(crate) fn sorted_entries(folder: &Path) -> Result<Vec<PathBuf>, DefinitionError> {
    let entries = fs::read_dir(folder).map_err(|error| unreadable(folder, &error))?;
    let mut paths = entries
        .map(|entry| entry.map(|entry| entry.path()).map_err(|error| unreadable(folder, &error)))
        .collect::<Result<Vec<_>, _>>()?;
    paths.sort();
    Ok(paths)
}

fn unreadable(file: &Path, error: &std::io::Error) -> DefinitionError {
    DefinitionError { file: file.to_owned(), line: 0, rule: Rule::Unreadable(error.to_string()) }
}

/// Parses one file's text.
pub(crate) fn parse(package: &str, kind: Kind, file: &Path, text: &str) -> Result<Definition, DefinitionError> {
    let at = |line: usize, rule: Rule| DefinitionError { file: file.to_owned(), line, rule };

    let file_name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let name = file_name
        .strip_suffix(kind.folder())
        .and_then(|stem| stem.strip_suffix('.'))
        .filter(|stem| is_camel_case(stem))
        .ok_or_else(|| at(1, Rule::FileName(file_name.clone())))?
        .to_owned();

    let head: Vec<&str> = text.lines().take_while(|line| line.starts_with('#')).collect();
    let next = text.lines().nth(head.len()).unwrap_or_default();
    if head.is_empty() || !next.trim().is_empty() {
        return Err(at(head.len() + 1, Rule::Purpose));
    }
    let docs = head.iter().map(|line| comment_text(line)).collect();

    let sections: Vec<&str> = split_sections(text);
    if sections.len() != kind.sections().len() {
        let (folder, expected, found) = (kind.folder(), kind.sections().len(), sections.len());
        return Err(at(1, Rule::Sections { folder, expected, found }));
    }

    let mut structures = Vec::new();
    let mut number = head.len();
    for (index, (&section, text)) in kind.sections().iter().zip(sections).enumerate() {
        let mut structure = Structure { section, constants: Vec::new(), fields: Vec::new(), text: text.to_owned() };
        let mut names = BTreeSet::new();
        let mut comment: Vec<String> = Vec::new();
        let skip = if index == 0 { head.len() } else { 0 };
        for line in text.lines().skip(skip) {
            number += 1;
            let (code, trailing) = match line.find('#') {
                Some(hash) => (line[..hash].trim(), Some(comment_text(&line[hash..]))),
                None => (line.trim(), None),
            };
            if code.is_empty() {
                match trailing {
                    Some(text) => comment.push(text),
                    None => comment.clear(),
                }
                continue;
            }
            let mut docs = std::mem::take(&mut comment);
            docs.extend(trailing);
            let name = parse_line(package, code, number, docs, &mut structure).map_err(|rule| at(number, rule))?;
            if !names.insert(name.clone()) {
                return Err(at(number, Rule::Twice(name)));
            }
        }
        number += 1; // the line that parts the sections
        structures.push(structure);
    }
    Ok(Definition { file: file.to_owned(), package: package.to_owned(), kind, name, docs, structures })
}

/// Splits a file at its `---` lines, which belong to neither side.
fn split_sections(text: &str) -> Vec<&str> {
    let mut sections = Vec::new();
    let (mut start, mut position) = (0, 0);
    for line in text.split_inclusive('\n') {
        if line.trim_end() == "---" {
            sections.push(&text[start..position]);
            start = position + line.len();
        }
        position += line.len();
    }
    sections.push(&text[start..]);
    sections
}

fn comment_text(line: &str) -> String {
    line.trim_start_matches('#').trim().to_owned()
}

/// Parses a field or constant into the structure and gives its name.
fn parse_line(
    package: &str,
    code: &str,
    number: usize,
    docs: Vec<String>,
    structure: &mut Structure,
) -> Result<String, Rule> {
    let not_understood = || Rule::Line(code.to_owned());
    let (ty, rest) = code.split_once(char::is_whitespace).ok_or_else(not_understood)?;
    let rest = rest.trim_start();
    let name_end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
    let (name, rest) = (rest[..name_end].to_owned(), &rest[name_end..]);
    if name.is_empty() {
        return Err(not_understood());
    }
    let ty = parse_type(package, ty)?;

    if let Some(value) = rest.trim_start().strip_prefix('=') {
        if !is_constant_name(&name) {
            return Err(Rule::ConstantName(name));
        }
        if ty.array != Array::None || matches!(ty.base, Base::Nested { .. }) {
            return Err(Rule::ConstantType(describe(&ty)));
        }
        let value = parse_value(&ty, value.trim())?;
        structure.constants.push(Constant { name: name.clone(), base: ty.base, value, docs, line: code.to_owned() });
        return Ok(name);
    }

    if !is_field_name(&name) {
        return Err(Rule::FieldName(name));
    }
    if !rest.is_empty() && !rest.starts_with(char::is_whitespace) {
        return Err(not_understood());
    }
    let default = match rest.trim() {
        "" => None,
        value => Some(parse_value(&ty, value)?),
    };
    structure.fields.push(Field { name: name.clone(), ty, default, docs, line: code.to_owned(), number });
    Ok(name)
}

fn parse_type(package: &str, text: &str) -> Result<Type, Rule> {
    let no_type = || Rule::Type(text.to_owned());
    let (base, array) = match text.strip_suffix(']') {
        None => (text, Array::None),
        Some(open) => {
            let (base, size) = open.rsplit_once('[').ok_or_else(no_type)?;
            let array = match size.strip_prefix("<=") {
                _ if size.is_empty() => Array::Unbounded,
                Some(bound) => Array::Bounded(parse_size(bound, usize::MAX)?),
                None => Array::Fixed(parse_size(size, LONGEST_ARRAY)?),
            };
            (base, array)
        }
    };
    if let Some(bound) = base.strip_prefix("string<=") {
        if array != Array::None {
            return Err(Rule::Unsupported(text.to_owned()));
        }
        return Ok(Type { base: Base::String(Some(parse_size(bound, usize::MAX)?)), array });
    }
    let base = match base {
        "bool" => Base::Primitive(Primitive::Bool),
        "byte" => Base::Primitive(Primitive::Byte),
        "uint8" | "char" => Base::Primitive(Primitive::U8),
        "int8" => Base::Primitive(Primitive::I8),
        "uint16" => Base::Primitive(Primitive::U16),
        "int16" => Base::Primitive(Primitive::I16),
        "uint32" => Base::Primitive(Primitive::U32),
        "int32" => Base::Primitive(Primitive::I32),
        "uint64" => Base::Primitive(Primitive::U64),
        "int64" => Base::Primitive(Primitive::I64),
        "float32" => Base::Primitive(Primitive::F32),
        "float64" => Base::Primitive(Primitive::F64),
        "string" => Base::String(None),
        wide if wide.starts_with("wstring") => return Err(Rule::Unsupported(text.to_owned())),
        other => {
            let (package, name) = other.split_once('/').unwrap_or((package, other));
            if !is_field_name(package) || !is_camel_case(name) {
                return Err(no_type());
            }
            Base::Nested { package: package.to_owned(), name: name.to_owned() }
        }
    };
    Ok(Type { base, array })
}

fn parse_size(text: &str, longest: usize) -> Result<usize, Rule> {
    text.parse().ok().filter(|size| (1..=longest).contains(size)).ok_or_else(|| Rule::ArraySize(text.to_owned()))
}

fn parse_value(ty: &Type, text: &str) -> Result<Value, Rule> {
    let wrong = || Rule::Value { value: text.to_owned(), ty: describe(ty) };
    if ty.array != Array::None {
        let inner = text.strip_prefix('[').and_then(|text| text.strip_suffix(']')).ok_or_else(wrong)?;
        let element = Type { base: ty.base.clone(), array: Array::None };
        let values = inner
            .split(',')
            .map(str::trim)
            .filter(|part| !part.is_empty())
            .map(|part| parse_value(&element, part))
            .collect::<Result<Vec<_>, _>>()?;
        let fits = match ty.array {
            Array::Fixed(size) => values.len() == size,
            Array::Bounded(bound) => values.len() <= bound,
            Array::None | Array::Unbounded => true,
        };
        return if fits { Ok(Value::List(values)) } else { Err(wrong()) };
    }
    let integer = |low: i128, high: i128| {
        let value = text.parse().ok().filter(|value| (low..=high).contains(value));
        value.map(Value::Integer).ok_or_else(wrong)
    };
    match &ty.base {
        Base::Nested { .. } => Err(wrong()),
        Base::String(bound) => {
            let quoted = |quote: char| text.strip_prefix(quote).and_then(|text| text.strip_suffix(quote));
            let text = quoted('"').or_else(|| quoted('\'')).unwrap_or(text);
            if bound.is_some_and(|bound| text.len() > bound) || text.contains(['"', '\\']) {
                return Err(wrong());
            }
            Ok(Value::String(text.to_owned()))
        }
        Base::Primitive(primitive) => match primitive {
            Primitive::Bool => match text {
                "true" | "True" | "1" => Ok(Value::Bool(true)),
                "false" | "False" | "0" => Ok(Value::Bool(false)),
                _ => Err(wrong()),
            },
            Primitive::F32 | Primitive::F64 => {
                text.parse().ok().filter(|value: &f64| value.is_finite()).map(Value::Float).ok_or_else(wrong)
            }
            Primitive::Byte | Primitive::U8 => integer(0, u8::MAX.into()),
            Primitive::I8 => integer(i8::MIN.into(), i8::MAX.into()),
            Primitive::U16 => integer(0, u16::MAX.into()),
            Primitive::I16 => integer(i16::MIN.into(), i16::MAX.into()),
            Primitive::U32 => integer(0, u32::MAX.into()),
            Primitive::I32 => integer(i32::MIN.into(), i32::MAX.into()),
            Primitive::U64 => integer(0, u64::MAX.into()),
            Primitive::I64 => integer(i64::MIN.into(), i64::MAX.into()),
        },
    }
}

fn describe(ty: &Type) -> String {
    let base = match &ty.base {
        Base::Primitive(primitive) => format!("{primitive:?}").to_lowercase(),
        Base::String(None) => "string".to_owned(),
        Base::String(Some(bound)) => format!("string of at most {bound} bytes"),
        Base::Nested { package, name } => format!("{package}/{name}"),
    };
    match ty.array {
        Array::None => base,
        Array::Fixed(size) => format!("list of {size} {base}"),
        Array::Bounded(bound) => format!("list of at most {bound} {base}"),
        Array::Unbounded => format!("list of {base}"),
    }
}

fn is_camel_case(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_uppercase()) && name.chars().all(|c| c.is_ascii_alphanumeric())
}

fn is_field_name(name: &str) -> bool {
    is_snake(name, |c| c.is_ascii_lowercase()) && !NOT_RAW.contains(&name)
}

fn is_constant_name(name: &str) -> bool {
    is_snake(name, |c| c.is_ascii_uppercase())
}

/// Words of letters of one case and digits, joined by single underscores, a letter first.
fn is_snake(name: &str, letter: impl Fn(char) -> bool) -> bool {
    name.starts_with(&letter)
        && name.chars().all(|c| letter(c) || c.is_ascii_digit() || c == '_')
        && !name.contains("__")
        && !name.ends_with('_')
}
