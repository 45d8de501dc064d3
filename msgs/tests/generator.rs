//! The generator of the Rust types: what it refuses, and that its output and the definition files say the same.

#![allow(clippy::unwrap_used)] // also in what the tests share

use std::fs;
use std::path::{Path, PathBuf};

use jigsaw_msgs::{MESSAGE_TYPES, Message, MessageType, Visitor, visit};
use serde_json::Value as Json;

#[path = "../generator/mod.rs"]
mod generator;

use generator::definition::{Definitions, Kind, parse};
use generator::rust;

const FOLDER: &str = env!("CARGO_MANIFEST_DIR");

fn error_of(kind: Kind, file: &str, text: &str) -> String {
    let parsed = parse("a_package", kind, Path::new(file), text).and_then(|parsed| Definitions::resolve(vec![parsed]));
    match parsed {
        Ok(_) => panic!("accepted: {text:?}"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn an_error_names_file_line_and_rule() {
    let cases = [
        ("", "Shape.msg:1: the file opens with a comment"),
        ("# Shape.\nint32 x\n", "Shape.msg:2: the file opens with a comment"),
        ("# Shape.\n\nint32\n", "Shape.msg:3: a line is `type name`"),
        ("# Shape.\n\nint32 x # fine\nint32 X\n", "Shape.msg:4: a field name is lower case"),
        ("# Shape.\n\nint32 a__b\n", "Shape.msg:3: a field name is lower case"),
        ("# Shape.\n\nint32 self\n", "Shape.msg:3: a field name is lower case"),
        ("# Shape.\n\nint32 x\nint64 x\n", "Shape.msg:4: `x` stands twice"),
        ("# Shape.\n\nint32 lower=1\n", "Shape.msg:3: a constant name is upper case"),
        ("# Shape.\n\nuint8 BIG=256\n", "Shape.msg:3: `256` is no u8"),
        ("# Shape.\n\nuint8[2] PAIR=1\n", "Shape.msg:3: a constant is a primitive or a string"),
        ("# Shape.\n\nbool flag maybe\n", "Shape.msg:3: `maybe` is no bool"),
        ("# Shape.\n\nfloat64 x nan\n", "Shape.msg:3: `nan` is no f64"),
        ("# Shape.\n\nint8[2] pair [1, 2, 3]\n", "Shape.msg:3: `[1, 2, 3]` is no list of 2 i8"),
        ("# Shape.\n\nint8[0] none\n", "Shape.msg:3: an array size is a whole number from 1 to 32"),
        ("# Shape.\n\nint8[33] many\n", "Shape.msg:3: an array size is a whole number from 1 to 32"),
        ("# Shape.\n\nint8[<=x] some\n", "Shape.msg:3: an array size is a whole number from 1 to 32"),
        ("# Shape.\n\nint33 x\n", "Shape.msg:3: `int33` is no type"),
        ("# Shape.\n\nint32] x\n", "Shape.msg:3: `int32]` is no type"),
        ("# Shape.\n\nwstring wide\n", "Shape.msg:3: type `wstring` is not supported"),
        ("# Shape.\n\nstring<=5[] words\n", "Shape.msg:3: type `string<=5[]` is not supported"),
        ("# Shape.\n\nint32 x\nother_package/Thing y\n", "Shape.msg:4: no definition of `other_package/Thing`"),
        ("# Shape.\n\nShape[] parts\n", "Shape.msg:1: `a_package/msg/Shape` contains itself"),
        ("# Shape.\n\nint32 x\n---\nint32 y\n", "Shape.msg:1: `---` parts a msg file into 1 sections, found 2"),
    ];
    for (text, expected) in cases {
        let error = error_of(Kind::Message, "Shape.msg", text);
        assert!(error.starts_with(expected), "{text:?} gave {error:?}");
    }
    assert!(error_of(Kind::Message, "shape.msg", "# Shape.\n\n").starts_with("shape.msg:1: a file name is CamelCase"));
    assert!(error_of(Kind::Service, "Ask.srv", "# Ask.\n\n").contains("into 2 sections, found 1"));
    let error = error_of(Kind::Action, "Do.action", "# Do.\n\n---\nint32 a\n---\nint32 b\nint32 b\n");
    assert_eq!(error, "Do.action:7: `b` stands twice");
}

#[test]
fn constants_defaults_and_arrays_become_rust() {
    let text = "# A [shape] of <parts>, see `a_b[0]`.\n\nuint8 ROUND=1 # like a disc\nstring NAME=\"disc\"\n\n\
                float64[3] axis [0, 0, 1.5]\nint32[<=4] sizes [1, 2]\nbyte[] data\nstring<=9 label round\nbool type true\n";
    let parsed = parse("a_package", Kind::Message, Path::new("Shape.msg"), text);
    let definitions = parsed.and_then(|parsed| Definitions::resolve(vec![parsed])).unwrap();
    let code = rust::write(&definitions, "a_package");
    for expected in [
        r"/// A \[shape\] of \<parts\>, see `a_b[0]`.",
        "/// like a disc\npub const ROUND: u8 = 1;",
        "pub const NAME: &'static str = \"disc\";",
        "pub axis: [f64; 3],",
        "axis: [0.0, 0.0, 1.5],",
        "#[serde(with = \"crate::AtMost::<4>\")]\npub sizes: ::std::vec::Vec<i32>,",
        "sizes: ::std::vec![1, 2],",
        "#[serde(with = \"::serde_bytes\")]\npub data: ::std::vec::Vec<u8>,",
        "#[serde(with = \"crate::AtMost::<9>\")]\npub label: ::std::string::String,",
        "label: \"round\".to_owned(),",
        "pub r#type: bool,",
    ] {
        assert!(code.contains(expected), "no {expected:?} in\n{code}");
    }
}

/// The fields of a type in their order, with their default values.
struct DefaultFields;

impl Visitor for DefaultFields {
    type Output = Vec<(String, Json)>;
    fn visit<M: Message>(self) -> Self::Output {
        let json = serde_json::to_string(&M::default()).unwrap();
        serde_json::from_str::<InOrder>(&json).unwrap().0
    }
}

/// A JSON object whose order is kept.
struct InOrder(Vec<(String, Json)>);

impl<'de> serde::Deserialize<'de> for InOrder {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Entries;
        impl<'de> serde::de::Visitor<'de> for Entries {
            type Value = InOrder;
            fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                formatter.write_str("an object")
            }
            fn visit_map<A: serde::de::MapAccess<'de>>(self, mut map: A) -> Result<InOrder, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(InOrder(entries))
            }
        }
        deserializer.deserialize_map(Entries)
    }
}

/// Fields of each section of a definition file, read without the generator: what is neither comment nor constant.
fn fields_in_file(file: &Path) -> Vec<Vec<(String, String)>> {
    let text = fs::read_to_string(file).unwrap();
    let mut sections = vec![Vec::new()];
    for line in text.lines().map(|line| line.split('#').next().unwrap_or_default().trim()) {
        if line == "---" {
            sections.push(Vec::new());
        } else if !line.is_empty() && !line.contains('=') || line.contains("<=") {
            let mut words = line.split_whitespace().map(str::to_owned);
            sections.last_mut().unwrap().push((words.next().unwrap(), words.next().unwrap()));
        }
    }
    sections
}

fn definition_files() -> Vec<(String, PathBuf)> {
    let mut packages = vec![("jigsaw_msgs".to_owned(), PathBuf::from(FOLDER))];
    for folder in fs::read_dir(Path::new(FOLDER).join("standard")).unwrap() {
        let folder = folder.unwrap();
        packages.push((folder.file_name().into_string().unwrap(), folder.path()));
    }
    let mut files = Vec::new();
    for (package, folder) in packages {
        for kind in ["msg", "srv", "action"] {
            let Ok(entries) = fs::read_dir(folder.join(kind)) else { continue };
            for file in entries.map(|entry| entry.unwrap().path()) {
                let stem = file.file_stem().unwrap().to_str().unwrap();
                files.push((format!("{package}/{kind}/{stem}"), file.clone()));
            }
        }
    }
    files
}

#[test]
fn rust_types_and_definition_files_say_the_same() {
    let mut seen = 0;
    for (full_name, file) in definition_files() {
        let sections = fields_in_file(&file);
        let names: &[&str] = match sections.len() {
            1 => &[""],
            2 => &["_Request", "_Response"],
            _ => &["_Goal", "_Result", "_Feedback"],
        };
        for (section, fields) in names.iter().zip(sections) {
            let type_name = format!("{full_name}{section}");
            let rust = visit(&type_name, DefaultFields).unwrap_or_else(|| panic!("no Rust type for {type_name}"));
            let rust_fields: Vec<&String> = rust.iter().map(|(name, _)| name).collect();
            if fields.is_empty() {
                assert_eq!(rust_fields, ["structure_needs_at_least_one_member"], "{type_name}");
            } else {
                assert_eq!(rust_fields, fields.iter().map(|(_, name)| name).collect::<Vec<_>>(), "{type_name}");
            }
            for ((ty, name), (_, value)) in fields.iter().zip(&rust) {
                let fits = match ty.as_str() {
                    list if list.ends_with(']') => value.is_array(),
                    "bool" => value.is_boolean(),
                    "float32" | "float64" => value.is_f64(),
                    text if text.starts_with("string") => value.is_string(),
                    int if int.starts_with("int") || int.starts_with("uint") || int == "byte" => {
                        value.is_i64() || value.is_u64()
                    }
                    _ => value.is_object(),
                };
                assert!(fits, "{type_name}.{name} is {ty} in the file and {value} by default in Rust");
            }
            seen += 1;
        }
    }
    assert_eq!(seen, MESSAGE_TYPES.len());
    let definitions = generator::read(Path::new(FOLDER)).unwrap();
    assert_eq!(definitions.files.len(), definition_files().len());
}

#[test]
fn types_are_found_by_name() {
    for known in MESSAGE_TYPES {
        assert_eq!(MessageType::find(known.full_name), Some(known));
    }
    assert_eq!(MessageType::find("std_msgs/msg/Nonsense"), None);
    assert!(visit("std_msgs/msg/Nonsense", DefaultFields).is_none());
}

#[test]
fn definitions_hold_all_they_name_once() {
    let assembly = jigsaw_msgs::msg::Assembly::TYPE.definition;
    let rule = "=".repeat(80);
    let parts: Vec<&str> = assembly.split(&format!("{rule}\nMSG: ")).collect();
    let mut names: Vec<&str> = parts[1..].iter().map(|part| part.lines().next().unwrap()).collect();
    names.sort_unstable();
    assert_eq!(
        names,
        [
            "builtin_interfaces/Time",
            "geometry_msgs/Point",
            "geometry_msgs/Pose",
            "geometry_msgs/Quaternion",
            "jigsaw_msgs/CandidateCounts",
            "jigsaw_msgs/Mating",
            "jigsaw_msgs/PiecePose",
            "std_msgs/Header"
        ]
    );
    assert!(parts[0].contains("uint8 COMPLETE=2"));
}

/// Hashes as ROS 2 Kilted has them in the type descriptions of the same packages.
#[test]
fn type_hashes_are_those_of_ros() {
    for (name, hash) in [
        ("builtin_interfaces/msg/Time", "RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197"),
        ("std_msgs/msg/Header", "RIHS01_f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01"),
    ] {
        assert_eq!(MessageType::find(name).map(|known| known.type_hash), Some(hash), "{name}");
    }
}
