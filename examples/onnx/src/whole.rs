//! Whether the parts of a file of ONNX end within it: the runtime makes room for a part before it reads it. And which
//! files beside it belong to it.

use std::collections::BTreeSet;

/// The messages of onnx.proto: which of their fields are messages again. All other fields are numbers, texts and bytes.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Model,
    Graph,
    Node,
    Attribute,
    Tensor,
    Sparse,
    Value,
    Type,
    TensorType,
    Shape,
    Inner,
    Map,
    Function,
    /// One without messages in it.
    Plain,
}

impl Kind {
    /// The message in a field.
    fn field(self, number: u64) -> Option<Kind> {
        Some(match (self, number) {
            (Kind::Model, 7) | (Kind::Attribute, 6 | 11) => Kind::Graph,
            (Kind::Model, 8 | 14) | (Kind::Graph, 14 | 16) | (Kind::Node, 9) => Kind::Plain,
            (Kind::Tensor, 3 | 13 | 16) | (Kind::Value, 4) | (Kind::Shape, 1) | (Kind::Function, 9 | 14) => Kind::Plain,
            (Kind::Model, 25) => Kind::Function,
            (Kind::Graph, 1) | (Kind::Function, 7) => Kind::Node,
            (Kind::Graph, 5) | (Kind::Attribute, 5 | 10) | (Kind::Sparse, 1 | 2) => Kind::Tensor,
            (Kind::Graph, 11..=13) | (Kind::Function, 12) => Kind::Value,
            (Kind::Graph, 15) | (Kind::Attribute, 22 | 23) => Kind::Sparse,
            (Kind::Node, 5) | (Kind::Function, 11) => Kind::Attribute,
            (Kind::Attribute, 14 | 15) | (Kind::Value, 2) | (Kind::Inner, 1) | (Kind::Map, 2) => Kind::Type,
            (Kind::Type, 1 | 8) => Kind::TensorType,
            (Kind::Type, 4 | 9) => Kind::Inner,
            (Kind::Type, 5) => Kind::Map,
            (Kind::TensorType, 2) => Kind::Shape,
            _ => return None,
        })
    }
}

/// Messages within each other.
const DEEPEST: usize = 100;

/// What a file of ONNX lacks; `None` if each of its parts ends within it.
pub fn missing(bytes: &[u8]) -> Option<String> {
    within(bytes, 0, Kind::Model, DEEPEST, &mut BTreeSet::new()).err()
}

/// Names of the files beside it that hold numbers of its tensors.
pub fn others(bytes: &[u8]) -> BTreeSet<String> {
    let mut others = BTreeSet::new();
    // What is damaged was refused when the file was read.
    let _ = within(bytes, 0, Kind::Model, DEEPEST, &mut others);
    others
}

/// A field of a message.
struct Field<'a> {
    number: u64,
    /// Its number, where it is one of type 0.
    value: u64,
    /// Its bytes, where it is a message, a text or bytes.
    part: Option<&'a [u8]>,
}

/// The field at `at`, which is then behind it; the message's first byte is the file's byte `first`.
fn field<'a>(bytes: &'a [u8], first: usize, at: &mut usize) -> Result<Field<'a>, String> {
    let begin = first + *at;
    let tag = varint(bytes, at);
    let (value, length) = match tag.map(|tag| tag & 7) {
        Some(0) => (varint(bytes, at), Some(0)),
        Some(1) => (Some(0), Some(8)),
        Some(2) => (Some(0), varint(bytes, at)),
        Some(5) => (Some(0), Some(4)),
        _ => (None, None),
    };
    let (Some(tag), Some(value), Some(length)) = (tag, value, length) else {
        return Err(format!(
            "what begins at byte {begin} is no part of such a file, or is cut off"
        ));
    };
    let rest = &bytes[*at..];
    // At most as many as there are bytes, so it is an index.
    let part = usize::try_from(length).ok().and_then(|length| rest.get(..length)).ok_or_else(|| {
        format!(
            "the part that begins at byte {begin} has {length} bytes, and there are {} of them: a download that broke off?",
            rest.len()
        )
    })?;
    *at += part.len();
    Ok(Field {
        number: tag >> 3,
        value,
        part: (tag & 7 == 2).then_some(part),
    })
}

/// Looks at a message whose first byte is the file's byte `first`.
fn within(bytes: &[u8], first: usize, kind: Kind, deeper: usize, others: &mut BTreeSet<String>) -> Result<(), String> {
    let (mut at, mut is_elsewhere, mut location) = (0, false, None);
    while at < bytes.len() {
        let begin = first + at;
        let Field { number, value, part } = field(bytes, first, &mut at)?;
        let Some(part) = part else {
            is_elsewhere = if (kind, number) == DATA_LOCATION {
                value == 1
            } else {
                is_elsewhere
            };
            continue;
        };
        if (kind, number) == EXTERNAL_DATA {
            location = location_of(part).or(location);
        }
        match (kind.field(number), deeper) {
            (Some(_), 0) => {
                return Err(format!(
                    "more than {DEEPEST} messages within each other at byte {begin}"
                ));
            }
            (Some(inner), deeper) => within(part, first + at - part.len(), inner, deeper - 1, others)?,
            (None, _) => {}
        }
    }
    others.extend(location.filter(|_| is_elsewhere));
    Ok(())
}

/// The field of a tensor that says whether its numbers are in another file, which is 1.
const DATA_LOCATION: (Kind, u64) = (Kind::Tensor, 14);
/// Its pairs of a key and a value that say where they are.
const EXTERNAL_DATA: (Kind, u64) = (Kind::Tensor, 13);

/// The value of a pair whose key is `location`.
fn location_of(pair: &[u8]) -> Option<String> {
    let (mut at, mut is_location, mut text) = (0, false, None);
    while at < pair.len() {
        match field(pair, 0, &mut at).ok()? {
            Field { number: 1, part, .. } => is_location = part == Some(&b"location"[..]),
            Field { number: 2, part, .. } => text = part,
            _ => {}
        }
    }
    let text = text.filter(|_| is_location)?;
    Some(String::from_utf8_lossy(text).into_owned())
}

/// A number of up to ten groups of seven bits; `None` where the bytes end within it, or it is longer.
fn varint(bytes: &[u8], at: &mut usize) -> Option<u64> {
    let mut value = 0_u64;
    for group in 0..10 {
        let byte = *bytes.get(*at)?;
        *at += 1;
        value |= u64::from(byte & 0x7f).checked_shl(7 * group)?;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_that_go_beyond_the_file_are_found() {
        // Field 1 is the number 8, field 2 a text of three bytes; field 4 has eight bytes, field 3 four.
        let sound = [&[0x08, 8, 0x12, 3, 1, 2, 3, 0x21][..], &[0; 8], &[0x1d, 0, 0, 0, 0]].concat();
        assert_eq!(missing(&sound), None);
        assert_eq!(missing(&[]), None);
        let cases = [
            (1, "byte 0"),
            (3, "byte 2"),
            (6, "3 bytes, and there are 2"),
            (18, "byte 16"),
        ];
        for (end, expected) in cases {
            let found = missing(&sound[..end]).unwrap();
            assert!(found.contains(expected), "{found}");
        }
        // A graph with a node whose operator would have 100 bytes.
        let found = missing(&[0x3a, 5, 0x0a, 3, 0x22, 100, 0]).unwrap();
        assert!(
            found.contains("begins at byte 4 has 100 bytes, and there are 1"),
            "{found}"
        );
        assert!(missing(&[0x12, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x01]).is_some());
        assert!(missing(&[0xff; 11]).is_some());
    }

    #[test]
    fn files_beside_it_are_those_of_tensors_that_are_elsewhere() {
        let inner = |field: u8, bytes: &[u8]| [&[field << 3 | 2, bytes.len() as u8], bytes].concat();
        let pair = |key: &str, value: &str| inner(13, &[inner(1, key.as_bytes()), inner(2, value.as_bytes())].concat());
        let tensor = |name: &str, elsewhere: u8| {
            let pairs = [pair("offset", "0"), pair("location", name), pair("length", "4")].concat();
            inner(5, &[pairs, vec![14 << 3, elsewhere]].concat())
        };
        // A graph of one tensor each, so that lengths are one byte.
        let tensors = [("b.data", 1), ("a.data", 1), ("b.data", 1), ("none.data", 0)];
        let file = tensors
            .map(|(name, elsewhere)| inner(7, &tensor(name, elsewhere)))
            .concat();
        assert_eq!(missing(&file), None);
        assert_eq!(Vec::from_iter(others(&file)), ["a.data", "b.data"]);
    }
}
