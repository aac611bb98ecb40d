//! Files of the data set, and numbers as it writes them.

use std::fs;
use std::io::{Error, ErrorKind};
use std::path::{Component, Path, PathBuf};

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};

use crate::ImportError;

/// The bytes of a file that must be there, and hold something.
pub fn read(path: &Path) -> Result<Vec<u8>, ImportError> {
    let bytes = fs::read(path).map_err(ImportError::io(path))?;
    match bytes.is_empty() {
        true => Err(ImportError::io(path)(Error::new(ErrorKind::UnexpectedEof, EMPTY))),
        false => Ok(bytes),
    }
}

/// What a file without a byte is.
pub const EMPTY: &str = "an empty file";

/// A file of JSON; some editors put a mark of UTF-8 before it.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, ImportError> {
    let bytes = read(path)?;
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(ImportError::content(
            path,
            "expected UTF-8, found UTF-16; save it as UTF-8",
        ));
    }
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    serde_json::from_slice(text).map_err(|error| ImportError::content(path, error))
}

/// A path of the data set's lists, which some tools write with backslashes.
pub fn local(path: PathBuf) -> PathBuf {
    let text = path.to_string_lossy().replace('\\', "/");
    Path::new(&text)
        .components()
        .filter(|part| *part != Component::CurDir)
        .collect()
}

/// A number, also one written as text, as some files of the dataset do.
pub struct Number(pub f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        number(deserializer).map(Number)
    }
}

/// A number, also one written as text.
pub fn number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Number(f64),
        Text(String),
    }
    match Written::deserialize(deserializer)? {
        Written::Number(value) => Ok(value),
        Written::Text(text) => text
            .parse()
            .map_err(|_| D::Error::custom(format!("expected a number, found `{text}`"))),
    }
}
