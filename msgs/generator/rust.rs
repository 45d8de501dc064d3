//! Writes the Rust types: a module per package and kind, a structure per message, with comments turned into rustdoc.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::definition::{
    Array, Base, Constant, DUMMY_FIELD, Definition, Definitions, Field, Kind, Primitive, Structure, Type, Value,
};
use super::type_hash::type_hash;

/// What parts the definitions in a concatenated one, and its length.
const SEPARATOR: char = '=';
const SEPARATOR_LENGTH: usize = 80;

/// Rust's keywords that are allowed as field names in ROS.
const KEYWORDS: [&str; 49] = [
    "abstract", "as", "async", "await", "become", "box", "break", "const", "continue", "do", "dyn", "else", "enum",
    "extern", "false", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro", "match", "mod", "move",
    "mut", "override", "priv", "pub", "ref", "return", "static", "struct", "trait", "true", "try", "type", "typeof",
    "unsafe", "unsized", "use", "virtual", "where", "while", "yield", "union",
];

/// The code for all definitions; those of the package `root` lie at the top, the others in modules named as their package.
pub(crate) fn write(definitions: &Definitions, root: &str) -> String {
    let mut modules: BTreeMap<(&str, &str), Vec<&Definition>> = BTreeMap::new();
    for definition in &definitions.files {
        modules.entry((&definition.package, definition.kind.folder())).or_default().push(definition);
    }
    let mut code = String::new();
    let mut packages: BTreeMap<&str, String> = BTreeMap::new();
    for ((package, folder), members) in modules {
        let out = packages.entry(package).or_default();
        push(out, &format!("/// The `{folder}` files of the ROS package `{package}`."));
        push(out, &format!("pub mod {folder} {{"));
        for definition in members {
            write_definition(out, definitions, root, definition);
        }
        push(out, "}");
    }
    for (package, content) in packages {
        if package == root {
            push(&mut code, &content);
        } else {
            push(&mut code, &format!("/// Types of the ROS package `{package}`.\npub mod {package} {{\n{content}}}"));
        }
    }
    write_registry(&mut code, definitions, root);
    code
}

fn push(out: &mut String, line: &str) {
    out.push_str(line);
    out.push('\n');
}

fn write_definition(out: &mut String, definitions: &Definitions, root: &str, definition: &Definition) {
    for structure in &definition.structures {
        write_structure(out, definitions, root, definition, structure);
    }
    let (package, name) = (&definition.package, &definition.name);
    let (bound, sections) = match definition.kind {
        Kind::Message => return,
        Kind::Service => ("Service", definition.kind.sections()),
        Kind::Action => ("Action", definition.kind.sections()),
    };
    write_docs(out, &definition.docs);
    push(out, "#[derive(Debug, Clone, Copy)]");
    push(out, &format!("pub enum {name} {{}}"));
    push(out, &format!("impl crate::{bound} for {name} {{"));
    for section in sections {
        push(out, &format!("type {section} = {name}{section};"));
    }
    push(out, &format!("const PACKAGE: &'static str = {package:?};"));
    push(out, &format!("const NAME: &'static str = {name:?};"));
    push(out, "}");
}

fn write_structure(
    out: &mut String,
    definitions: &Definitions,
    root: &str,
    definition: &Definition,
    structure: &Structure,
) {
    let rust_name = rust_name(definition, structure);
    let plain_default = structure.fields.iter().all(|field| field.default.as_ref().is_none_or(is_rust_default));
    match structure.section {
        "" => write_docs(out, &definition.docs),
        section => push(out, &format!("/// {section} of [`{}`].", definition.name)),
    }
    let default = if plain_default { "Default, " } else { "" };
    push(out, &format!("#[derive(Debug, Clone, PartialEq, {default}::serde::Serialize, ::serde::Deserialize)]"));
    push(out, &format!("pub struct {rust_name} {{"));
    for field in &structure.fields {
        write_field(out, root, field);
    }
    if structure.fields.is_empty() {
        push(out, "/// Always zero: a structure without fields is sent as one byte.");
        push(out, &format!("pub {DUMMY_FIELD}: u8,"));
    }
    push(out, "}");

    if !structure.constants.is_empty() {
        push(out, &format!("impl {rust_name} {{"));
        for constant in &structure.constants {
            write_constant(out, constant);
        }
        push(out, "}");
    }
    if !plain_default {
        push(out, &format!("impl Default for {rust_name} {{ fn default() -> Self {{ Self {{"));
        for field in &structure.fields {
            let value = field.default.as_ref().map_or("Default::default()".to_owned(), |value| {
                if field.ty.array == Array::None { literal(value) } else { list_literal(&field.ty, value) }
            });
            push(out, &format!("{}: {value},", raw(&field.name)));
        }
        push(out, "} } }");
    }

    let full_name = definition.full_name(structure);
    let ros_name = full_name.rsplit('/').next().unwrap_or_default().to_owned();
    let (package, folder) = (&definition.package, definition.kind.folder());
    let text = concatenated(definitions, structure);
    let hash = type_hash(definitions, definition, structure);
    push(out, &format!("impl crate::Message for {rust_name} {{"));
    push(out, "const TYPE: crate::MessageType = crate::MessageType {");
    push(out, &format!("package: {package:?}, name: {ros_name:?}, full_name: {full_name:?},"));
    push(out, &format!("dds_name: \"{package}::{folder}::dds_::{ros_name}_\","));
    push(out, &format!("definition: {text:?}, type_hash: {hash:?},"));
    push(out, "}; }");
}

/// The definition with those of all that it contains after it, as bags hold it.
fn concatenated(definitions: &Definitions, structure: &Structure) -> String {
    let mut text = structure.text.clone();
    for nested in definitions.dependencies(structure) {
        let separator: String = std::iter::repeat_n(SEPARATOR, SEPARATOR_LENGTH).collect();
        let _ = writeln!(text, "{separator}\nMSG: {}/{}", nested.package, nested.name);
        text.extend(nested.structures.iter().map(|part| part.text.as_str()));
    }
    text
}

fn write_field(out: &mut String, root: &str, field: &Field) {
    if field.docs.is_empty() {
        push(out, &format!("/// `{}`", field.line));
    } else {
        write_docs(out, &field.docs);
    }
    let byte = matches!(field.ty.base, Base::Primitive(Primitive::U8 | Primitive::Byte));
    let bound = match (&field.ty.base, field.ty.array) {
        (_, Array::Bounded(bound)) => Some(bound),
        (Base::String(bound), Array::None) => *bound,
        _ => None,
    };
    if byte && field.ty.array == Array::Unbounded {
        // Bytes in one go; one by one they would take 40 times longer.
        push(out, "#[serde(with = \"::serde_bytes\")]");
    } else if let Some(bound) = bound {
        push(out, &format!("#[serde(with = \"crate::AtMost::<{bound}>\")]"));
    }
    push(out, &format!("pub {}: {},", raw(&field.name), rust_type(root, &field.ty)));
}

fn write_constant(out: &mut String, constant: &Constant) {
    if constant.docs.is_empty() {
        push(out, &format!("/// `{}`", constant.line));
    } else {
        write_docs(out, &constant.docs);
    }
    let (ty, value) = match &constant.base {
        Base::Primitive(primitive) => (primitive_name(*primitive), literal(&constant.value)),
        Base::String(_) | Base::Nested { .. } => (
            "&'static str",
            match &constant.value {
                Value::String(text) => format!("{text:?}"),
                other => literal(other),
            },
        ),
    };
    push(out, &format!("pub const {}: {ty} = {value};", constant.name));
}

/// Writes comment lines as rustdoc; what Markdown would take for a link or a tag is escaped outside of backticks.
fn write_docs(out: &mut String, lines: &[String]) {
    for line in lines {
        let mut code = false;
        out.push_str("/// ");
        for c in line.chars() {
            code ^= c == '`';
            if !code && ['[', ']', '<', '>', '*', '_'].contains(&c) {
                out.push('\\');
            }
            out.push(c);
        }
        out.push('\n');
    }
}

fn rust_name(definition: &Definition, structure: &Structure) -> String {
    format!("{}{}", definition.name, structure.section)
}

fn raw(name: &str) -> String {
    if KEYWORDS.contains(&name) { format!("r#{name}") } else { name.to_owned() }
}

fn rust_type(root: &str, ty: &Type) -> String {
    // Full paths, because a message may be called `String` itself.
    let base = match &ty.base {
        Base::Primitive(primitive) => primitive_name(*primitive).to_owned(),
        Base::String(_) => "::std::string::String".to_owned(),
        Base::Nested { package, name } if package == root => format!("crate::msg::{name}"),
        Base::Nested { package, name } => format!("crate::{package}::msg::{name}"),
    };
    match ty.array {
        Array::None => base,
        Array::Fixed(size) => format!("[{base}; {size}]"),
        Array::Bounded(_) | Array::Unbounded => format!("::std::vec::Vec<{base}>"),
    }
}

fn primitive_name(primitive: Primitive) -> &'static str {
    match primitive {
        Primitive::Bool => "bool",
        Primitive::Byte | Primitive::U8 => "u8",
        Primitive::I8 => "i8",
        Primitive::U16 => "u16",
        Primitive::I16 => "i16",
        Primitive::U32 => "u32",
        Primitive::I32 => "i32",
        Primitive::U64 => "u64",
        Primitive::I64 => "i64",
        Primitive::F32 => "f32",
        Primitive::F64 => "f64",
    }
}

fn literal(value: &Value) -> String {
    match value {
        Value::Bool(value) => value.to_string(),
        Value::Integer(value) => value.to_string(),
        Value::Float(value) => format!("{value:?}"),
        Value::String(text) => format!("{text:?}.to_owned()"),
        Value::List(values) => values.iter().map(literal).collect::<Vec<_>>().join(", "),
    }
}

/// Whether Rust's own default of the type is the same value.
fn is_rust_default(value: &Value) -> bool {
    match value {
        Value::Bool(value) => !value,
        Value::Integer(value) => *value == 0,
        Value::Float(value) => *value == 0.0,
        Value::String(text) => text.is_empty(),
        // A fixed list of zeros would be as well, but nobody writes that.
        Value::List(values) => values.is_empty(),
    }
}

fn list_literal(ty: &Type, value: &Value) -> String {
    let macro_name = if matches!(ty.array, Array::Fixed(_)) { "" } else { "::std::vec!" };
    format!("{macro_name}[{}]", literal(value))
}

/// The table of all types, and the call of a visitor by name.
fn write_registry(out: &mut String, definitions: &Definitions, root: &str) {
    let mut types: Vec<(String, String)> = Vec::new();
    for definition in &definitions.files {
        let folder = definition.kind.folder();
        let module =
            if definition.package == root { folder.to_owned() } else { format!("{}::{folder}", definition.package) };
        for structure in &definition.structures {
            let path = format!("crate::{module}::{}", rust_name(definition, structure));
            types.push((definition.full_name(structure), path));
        }
    }
    types.sort();
    push(out, "/// Every message type of the crate, in the order of their full names.");
    push(out, "pub const MESSAGE_TYPES: &[crate::MessageType] = &[");
    for (_, path) in &types {
        push(out, &format!("<{path} as crate::Message>::TYPE,"));
    }
    push(out, "];");
    push(
        out,
        "/// Calls the visitor with the Rust type of a full name such as `sensor_msgs/msg/Image`; `None` if unknown.",
    );
    push(out, "pub fn visit<V: crate::Visitor>(full_name: &str, visitor: V) -> Option<V::Output> {");
    push(out, "match full_name {");
    for (name, path) in &types {
        push(out, &format!("{name:?} => Some(visitor.visit::<{path}>()),"));
    }
    push(out, "_ => None,\n}\n}");
}
