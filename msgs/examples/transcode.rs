//! Decodes messages that another implementation encoded, and encodes them again, so that the two can be compared.
//!
//! Each line of standard input is `full_type_name hex_of_cdr`, without the four-byte CDR header. The answer is a line of JSON:
//! `{"type", "hash", "definition", "consumed", "message", "cdr"}`, or `{"type", "error"}`. A type name alone stands for the
//! type's default. `--types` prints the names of all types instead.

use std::io::{self, BufRead, Write};

use byteorder::LittleEndian;
use jigsaw_msgs::{MESSAGE_TYPES, Message, Visitor, visit};
use serde_json::{Value, json};

/// Decodes the bytes as some type, or takes its default, and encodes the result.
struct Transcode {
    cdr: Option<Vec<u8>>,
}

impl Visitor for Transcode {
    type Output = Result<Value, String>;

    fn visit<M: Message>(self) -> Self::Output {
        let (message, consumed) = match self.cdr {
            None => (M::default(), 0),
            Some(cdr) => cdr_encoding::from_bytes::<M, LittleEndian>(&cdr).map_err(|error| error.to_string())?,
        };
        let cdr = cdr_encoding::to_vec::<M, LittleEndian>(&message).map_err(|error| error.to_string())?;
        let message = serde_json::to_value(&message).map_err(|error| error.to_string())?;
        let hex: String = cdr.iter().map(|byte| format!("{byte:02x}")).collect();
        let (hash, definition) = (M::TYPE.type_hash, M::TYPE.definition);
        Ok(json!({"hash": hash, "definition": definition, "consumed": consumed, "message": message, "cdr": hex}))
    }
}

fn from_hex(text: &str) -> Result<Vec<u8>, String> {
    let digit =
        |byte: u8| char::from(byte).to_digit(16).ok_or_else(|| format!("`{}` is no hex digit", char::from(byte)));
    text.as_bytes()
        .chunks(2)
        .map(|pair| match pair {
            [high, low] => Ok((digit(*high)? * 16 + digit(*low)?) as u8),
            _ => Err("an odd number of hex digits".to_owned()),
        })
        .collect()
}

fn answer(line: &str) -> Value {
    let (name, cdr) = match line.split_once(' ') {
        Some((name, hex)) => (name, from_hex(hex).map(Some)),
        None => (line, Ok(None)),
    };
    let done =
        cdr.and_then(|cdr| visit(name, Transcode { cdr }).unwrap_or_else(|| Err("the type is not known".to_owned())));
    let mut answer = done.unwrap_or_else(|error| json!({"error": error}));
    answer["type"] = name.into();
    answer
}

fn main() -> io::Result<()> {
    let mut out = io::stdout().lock();
    if std::env::args().any(|argument| argument == "--types") {
        for known in MESSAGE_TYPES {
            writeln!(out, "{}", known.full_name)?;
        }
        return Ok(());
    }
    for line in io::stdin().lock().lines() {
        writeln!(out, "{}", answer(&line?))?;
        out.flush()?;
    }
    Ok(())
}
