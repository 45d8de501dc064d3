//! Type hashes of the form `RIHS01_<SHA-256>` ([REP 2016](https://reps.openrobotics.org/rep-2016/)): the hash of a canonical
//! JSON description of a type and of all types that it contains. Two sides with the same hash mean the same fields.

use sha2::{Digest, Sha256};

use super::definition::{Array, Base, DUMMY_FIELD, Definition, Definitions, Primitive, Structure, Type};

/// What REP 2016 adds to a type's number for a fixed array, a bounded and an unbounded sequence of it.
const FIXED_ARRAY: u8 = 48;
const BOUNDED_SEQUENCE: u8 = 96;
const UNBOUNDED_SEQUENCE: u8 = 144;

/// The hash of one structure of a definition.
pub(crate) fn type_hash(definitions: &Definitions, definition: &Definition, structure: &Structure) -> String {
    let mut referenced: Vec<(String, String)> = definitions
        .dependencies(structure)
        .into_iter()
        .flat_map(|nested| nested.structures.iter().map(|part| (nested.full_name(part), describe(nested, part))))
        .collect();
    referenced.sort();
    let referenced: Vec<String> = referenced.into_iter().map(|(_, text)| text).collect();
    let json = format!(
        r#"{{"type_description": {}, "referenced_type_descriptions": [{}]}}"#,
        describe(definition, structure),
        referenced.join(", ")
    );
    let digits: String = Sha256::digest(json.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect();
    format!("RIHS01_{digits}")
}

fn describe(definition: &Definition, structure: &Structure) -> String {
    let mut fields: Vec<String> = structure.fields.iter().map(|field| describe_field(&field.name, &field.ty)).collect();
    if fields.is_empty() {
        let byte = Type { base: Base::Primitive(Primitive::U8), array: Array::None };
        fields.push(describe_field(DUMMY_FIELD, &byte));
    }
    format!(r#"{{"type_name": "{}", "fields": [{}]}}"#, definition.full_name(structure), fields.join(", "))
}

fn describe_field(name: &str, ty: &Type) -> String {
    let (number, string_capacity) = match &ty.base {
        Base::Nested { .. } => (1, 0),
        Base::Primitive(primitive) => (primitive_number(*primitive), 0),
        Base::String(None) => (17, 0),
        Base::String(Some(bound)) => (21, *bound),
    };
    let (offset, capacity) = match ty.array {
        Array::None => (0, 0),
        Array::Fixed(size) => (FIXED_ARRAY, size),
        Array::Bounded(bound) => (BOUNDED_SEQUENCE, bound),
        Array::Unbounded => (UNBOUNDED_SEQUENCE, 0),
    };
    let nested = match &ty.base {
        Base::Nested { package, name } => format!("{package}/msg/{name}"),
        _ => String::new(),
    };
    let type_id = number + offset;
    format!(
        r#"{{"name": "{name}", "type": {{"type_id": {type_id}, "capacity": {capacity}, "string_capacity": {string_capacity}, "nested_type_name": "{nested}"}}}}"#
    )
}

/// The numbers of `type_description_interfaces/msg/FieldType`.
fn primitive_number(primitive: Primitive) -> u8 {
    match primitive {
        Primitive::I8 => 2,
        Primitive::U8 => 3,
        Primitive::I16 => 4,
        Primitive::U16 => 5,
        Primitive::I32 => 6,
        Primitive::U32 => 7,
        Primitive::I64 => 8,
        Primitive::U64 => 9,
        Primitive::F32 => 10,
        Primitive::F64 => 11,
        Primitive::Bool => 15,
        Primitive::Byte => 16,
    }
}
