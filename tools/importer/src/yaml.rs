//! Label files of YAML, with the tags that numpy leaves in them: these are read as numbers and lists, and never executed.

use std::path::{Path, PathBuf};

use serde_yaml::Value;

use crate::ImportError;
use crate::files::read_text;

/// A file of YAML: a mapping.
pub struct Document {
    path: PathBuf,
    root: Value,
}

impl Document {
    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, or is not a mapping of YAML.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let text = read_text(path)?;
        let root: Value = realo_documents::yaml(&text)
            .map_err(|reason| ImportError::content(path, format!("{reason}; if the file was cut, fetch it anew")))?;
        let root = plain(root);
        match root {
            Value::Mapping(_) => Ok(Document {
                path: path.into(),
                root,
            }),
            other => Err(ImportError::content(
                path,
                format!(
                    "expected keys and values, found {}; if the file was cut, fetch it anew",
                    what(&other)
                ),
            )),
        }
    }

    /// The value of a key.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.root.get(key)
    }

    /// Its keys.
    pub fn keys(&self) -> impl Iterator<Item = String> {
        self.root.as_mapping().into_iter().flatten().map(|(key, _)| text(key))
    }

    /// An error in this file.
    pub fn error(&self, reason: impl ToString) -> ImportError {
        ImportError::content(&self.path, reason)
    }
}

/// What a value is, in words.
pub fn what(value: &Value) -> String {
    match value {
        Value::Null => "nothing".into(),
        Value::Sequence(items) => format!("a list of {}", items.len()),
        Value::Mapping(keys) => format!("{} keys", keys.len()),
        other => format!("`{}`", crate::shown(&text(other))),
    }
}

/// A scalar as text: `7`, `-1`, `Car`.
pub fn text(value: &Value) -> String {
    match value {
        Value::String(text) => text.trim().into(),
        Value::Number(number) => number.to_string(),
        Value::Bool(value) => value.to_string(),
        Value::Tagged(tagged) => text(&tagged.value),
        _ => String::new(),
    }
}

/// A value without its tag.
fn plain(value: Value) -> Value {
    match value {
        Value::Tagged(tagged) => plain(tagged.value),
        other => other,
    }
}

/// All numbers of a value in their order, out of lists in lists and what numpy's tags hold.
///
/// # Errors
/// What is not a number.
pub fn numbers(value: &Value) -> Result<Vec<f64>, String> {
    let mut found = Vec::new();
    collect(value, &mut found)?;
    Ok(found)
}

fn collect(value: &Value, found: &mut Vec<f64>) -> Result<(), String> {
    match value {
        Value::Tagged(tagged) => collect(&tagged.value, found),
        Value::Sequence(items) => match numpy_scalar(items) {
            Some(numbers) => {
                found.extend(numbers?);
                Ok(())
            }
            None => items.iter().try_for_each(|item| collect(item, found)),
        },
        Value::Mapping(_) => {
            found.extend(numpy_array(value)?);
            Ok(())
        }
        scalar => {
            let number = scalar.as_f64().or_else(|| text(scalar).parse().ok());
            found.push(number.ok_or_else(|| format!("expected numbers, found {}", what(scalar)))?);
            Ok(())
        }
    }
}

/// `[dtype, bytes]`, as `numpy.core.multiarray.scalar` is written.
fn numpy_scalar(items: &[Value]) -> Option<Result<Vec<f64>, String>> {
    match items {
        [Value::Mapping(dtype), Value::String(bytes)] => Some(decode(&Value::Mapping(dtype.clone()), bytes)),
        _ => None,
    }
}

/// `state: [version, shape, dtype, is_fortran, bytes]`, as `numpy.core.multiarray._reconstruct` is written.
fn numpy_array(value: &Value) -> Result<Vec<f64>, String> {
    let state = value.get("state").and_then(Value::as_sequence).map(Vec::as_slice);
    let Some([_, shape, dtype, is_fortran, Value::String(bytes)]) = state else {
        return Err(format!("expected numbers, found {}", what(value)));
    };
    let found = decode(dtype, bytes)?;
    let shape: Vec<usize> = numbers(shape)?.into_iter().map(|edge| edge as usize).collect();
    let count = shape.iter().try_fold(1, |count: usize, edge| count.checked_mul(*edge));
    match (is_fortran.as_bool(), count) {
        (Some(true), _) if shape.len() > 1 => {
            Err("expected a numpy array in the order of C, found that of Fortran".into())
        }
        (_, count) if count != Some(found.len()) => Err(format!(
            "expected a numpy array of {shape:?} numbers, found {}",
            found.len()
        )),
        _ => Ok(found),
    }
}

/// Numbers of a numpy type, written in base64.
fn decode(dtype: &Value, bytes: &str) -> Result<Vec<f64>, String> {
    let of = |key: &str, index: usize| dtype.get(key).and_then(|list| list.get(index)).map(text);
    let name = of("args", 0).unwrap_or_default();
    if of("state", 1).is_some_and(|order| order == ">") {
        return Err(format!("expected numpy numbers of little endian, found `>{name}`"));
    }
    let bytes = base64(bytes).ok_or("expected numpy numbers in base64, found other text")?;
    fn all<const N: usize>(bytes: &[u8], number: impl Fn([u8; N]) -> f64) -> Option<Vec<f64>> {
        let (chunks, rest) = bytes.as_chunks::<N>();
        rest.is_empty()
            .then(|| chunks.iter().map(|chunk| number(*chunk)).collect())
    }
    let found = match name.as_str() {
        "f8" => all(&bytes, f64::from_le_bytes),
        "f4" => all(&bytes, |number| f32::from_le_bytes(number).into()),
        "i8" => all(&bytes, |number| i64::from_le_bytes(number) as f64),
        "i4" => all(&bytes, |number| i32::from_le_bytes(number).into()),
        "u8" => all(&bytes, |number| u64::from_le_bytes(number) as f64),
        "b1" | "u1" => all(&bytes, |[number]| number.into()),
        _ => {
            return Err(format!(
                "expected numpy numbers of type f8, f4, i8 or i4, found `{}`",
                crate::shown(&name)
            ));
        }
    };
    found.ok_or_else(|| {
        format!(
            "expected whole numpy numbers of type {name}, found {} bytes",
            bytes.len()
        )
    })
}

/// Bytes of base64; `None` for other text.
fn base64(text: &str) -> Option<Vec<u8>> {
    let value = |byte: u8| match byte {
        b'A'..=b'Z' => Some(byte - b'A'),
        b'a'..=b'z' => Some(byte - b'a' + 26),
        b'0'..=b'9' => Some(byte - b'0' + 52),
        b'+' => Some(62),
        b'/' => Some(63),
        _ => None,
    };
    let (mut bytes, mut bits, mut held) = (Vec::new(), 0_u32, 0);
    for byte in text.bytes().filter(|byte| !byte.is_ascii_whitespace() && *byte != b'=') {
        bits = bits << 6 | u32::from(value(byte)?);
        held += 6;
        if held >= 8 {
            held -= 8;
            bytes.push((bits >> held) as u8);
            bits &= (1 << held) - 1;
        }
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(text: &str) -> Value {
        realo_documents::yaml(text).unwrap()
    }

    const ARRAY: &str = "!!python/object/apply:numpy.core.multiarray._reconstruct
args:
- !!python/name:numpy.ndarray ''
- !!python/tuple [0]
- !!binary |
  Yg==
state: !!python/tuple
- 1
- !!python/tuple [2]
- &id001 !!python/object/apply:numpy.dtype
  args: [f8, false, true]
  state: !!python/tuple [3, <, null, null, null, -1, -1, 0]
- false
- !!binary |
  AAAAAAAA8D8AAAAAAAAEwA==
";

    #[test]
    fn numpy_tags_are_numbers() {
        assert_eq!(numbers(&value(ARRAY)).unwrap(), [1.0, -2.5]);
        let scalar = "!!python/object/apply:numpy.core.multiarray.scalar
- !!python/object/apply:numpy.dtype
  args: [f4, 0, 1]
- !!binary |
  AACAPw==
";
        assert_eq!(numbers(&value(scalar)).unwrap(), [1.0]);
        assert_eq!(
            numbers(&value("!!python/tuple [1, '2.5', -3e-1]")).unwrap(),
            [1.0, 2.5, -0.3]
        );
        assert_eq!(numbers(&value("[[1, 2], [3, 4]]")).unwrap(), [1.0, 2.0, 3.0, 4.0]);
    }

    #[test]
    fn other_values_are_refused_by_what_they_are() {
        for (text, expected) in [
            ("{a: 1}", "found 1 keys"),
            ("[1, x]", "found `x`"),
            ("[1, null]", "found nothing"),
            ("!!python/object/apply:os.system [rm]", "found `rm`"),
        ] {
            let error = numbers(&value(text)).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
        let broken = ARRAY.replace("[2]", "[3]");
        assert!(
            numbers(&value(&broken))
                .unwrap_err()
                .contains("of [3] numbers, found 2")
        );
        let big = ARRAY.replace("3, <", "3, '>'");
        assert!(numbers(&value(&big)).unwrap_err().contains("little endian"));
    }
}
