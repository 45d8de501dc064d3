//! The encapsulation header that a bag keeps in front of each CDR message, and typed access to such messages.
//!
//! A bag's message is what `rmw_serialize` yields: `00 XX 00 00`, then CDR, where XX tells the byte order. Over DDS the
//! same header travels in the RTPS payload, but RustDDS strips it.

use serde::{Serialize, de::DeserializeOwned};
use thiserror::Error;

/// Length of the encapsulation header in bytes.
pub const HEADER_LEN: usize = 4;

/// Header of plain little-endian CDR, which is what ROS 2 writes.
pub const LITTLE_ENDIAN_HEADER: [u8; HEADER_LEN] = [0, 1, 0, 0];

/// Byte order of a CDR message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ByteOrder {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

/// Why bytes are not a CDR message, or not one of the type asked for.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CdrError {
    /// Too short for the encapsulation header.
    #[error("message of {len} bytes is shorter than its {HEADER_LEN}-byte CDR header")]
    TooShort {
        /// Length of the message.
        len: usize,
    },
    /// Not plain CDR (for example XCDR2 or a parameter list).
    #[error("CDR representation {identifier:#06x} is not plain CDR (0x0000 or 0x0001)")]
    Representation {
        /// The identifier found in the header.
        identifier: u16,
    },
    /// The content does not decode as the type asked for.
    #[error("message does not decode as {type_name}: {reason}")]
    Decode {
        /// The Rust type asked for.
        type_name: &'static str,
        /// What the decoder says.
        reason: String,
    },
    /// The value cannot be encoded.
    #[error("value does not encode as CDR: {reason}")]
    Encode {
        /// What the encoder says.
        reason: String,
    },
}

/// Splits a message into byte order and content.
///
/// # Errors
/// [`CdrError::TooShort`] and [`CdrError::Representation`].
pub fn split_header(cdr: &[u8]) -> Result<(ByteOrder, &[u8]), CdrError> {
    let Some((header, content)) = cdr.split_at_checked(HEADER_LEN) else {
        return Err(CdrError::TooShort { len: cdr.len() });
    };
    // The last two bytes are options (padding at the end), without a meaning for the decoder.
    match u16::from_be_bytes([header[0], header[1]]) {
        0 => Ok((ByteOrder::Big, content)),
        1 => Ok((ByteOrder::Little, content)),
        identifier => Err(CdrError::Representation { identifier }),
    }
}

/// Decodes a bag's message, either byte order, as a `T`.
///
/// # Errors
/// See [`CdrError`].
///
/// ```
/// use jigsaw_nodes::bag::cdr::{decode, encode};
/// let cdr = encode(&(7_u32, "tab".to_owned()))?;
/// assert_eq!(cdr[..4], [0, 1, 0, 0]);
/// assert_eq!(decode::<(u32, String)>(&cdr)?, (7, "tab".to_owned()));
/// assert_eq!(decode::<u32>(&[0, 0, 0, 0, 0, 0, 1, 2])?, 258); // big-endian
/// # Ok::<(), jigsaw_nodes::bag::cdr::CdrError>(())
/// ```
pub fn decode<T: DeserializeOwned>(cdr: &[u8]) -> Result<T, CdrError> {
    let (order, content) = split_header(cdr)?;
    match order {
        ByteOrder::Little => cdr_encoding::from_bytes::<T, byteorder::LittleEndian>(content),
        ByteOrder::Big => cdr_encoding::from_bytes::<T, byteorder::BigEndian>(content),
    }
    .map(|(value, _)| value)
    .map_err(|e| CdrError::Decode { type_name: std::any::type_name::<T>(), reason: e.to_string() })
}

/// Encodes a value as little-endian CDR with its header.
///
/// # Errors
/// [`CdrError::Encode`] for a type CDR has no encoding for.
pub fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, CdrError> {
    // Encoded apart and joined, since alignment counts from the first byte after the header.
    let content = cdr_encoding::to_vec::<T, byteorder::LittleEndian>(value)
        .map_err(|e| CdrError::Encode { reason: e.to_string() })?;
    let mut cdr = Vec::with_capacity(HEADER_LEN + content.len());
    cdr.extend_from_slice(&LITTLE_ENDIAN_HEADER);
    cdr.extend_from_slice(&content);
    Ok(cdr)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_headers_are_refused_by_name() {
        assert!(matches!(split_header(&[0, 1]), Err(CdrError::TooShort { len: 2 })));
        assert!(matches!(split_header(&[0, 7, 0, 0, 1]), Err(CdrError::Representation { identifier: 7 })));
    }

    #[test]
    fn claimed_lengths_beyond_the_message_are_errors() {
        let huge = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0x7f, 1, 2, 3];
        assert!(decode::<Vec<u8>>(&huge).is_err());
        assert!(decode::<String>(&huge).is_err());
        assert!(decode::<Vec<String>>(&huge).is_err());
    }
}
