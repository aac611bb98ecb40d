//! Files of data sets, and numbers as they write them.

use std::fs;
use std::io::{Error, ErrorKind};
use std::os::unix::fs::FileTypeExt;
use std::path::{Component, Path, PathBuf};

use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};

use crate::ImportError;

/// The bytes of a file. What is no regular file is refused: whoever opens a named pipe waits for its other end, and a device may
/// never end.
pub fn bytes(path: &Path) -> Result<Vec<u8>, ImportError> {
    let kind = fs::metadata(path).map_err(ImportError::io(path))?.file_type();
    // Of a folder the system says it itself.
    if kind.is_file() || kind.is_dir() {
        return fs::read(path).map_err(ImportError::io(path));
    }
    let found = match kind {
        kind if kind.is_fifo() => "a named pipe",
        kind if kind.is_socket() => "a socket",
        _ => "a device",
    };
    let reason = format!("{found}, expected a file; put the file itself there");
    Err(ImportError::io(path)(Error::other(reason)))
}

/// The bytes of a file that must be there, and hold something.
pub fn read(path: &Path) -> Result<Vec<u8>, ImportError> {
    let bytes = bytes(path)?;
    if bytes.is_empty() {
        return Err(ImportError::io(path)(Error::new(ErrorKind::UnexpectedEof, EMPTY)));
    }
    match bytes.starts_with(LFS) {
        true => Err(ImportError::content(
            path,
            "expected the file itself, found a pointer of Git LFS; run `git lfs pull` in the data set",
        )),
        false => Ok(bytes),
    }
}

/// How a file begins that Git LFS has left in the place of another.
const LFS: &[u8] = b"version https://git-lfs";

/// The text of a file; some editors put a mark of UTF-8 before it.
pub fn read_text(path: &Path) -> Result<String, ImportError> {
    let bytes = read(path)?;
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(ImportError::content(
            path,
            "expected UTF-8, found UTF-16; save it as UTF-8",
        ));
    }
    let text = String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        ImportError::content(
            path,
            format!("expected UTF-8, found another byte at {at}; save it as UTF-8, or fetch it anew"),
        )
    })?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(text) => text.into(),
        None => text,
    })
}

/// What a file without a byte is.
pub const EMPTY: &str = "an empty file";

/// A file of JSON.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, ImportError> {
    serde_json::from_str(&read_text(path)?).map_err(|error| ImportError::content(path, error))
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

/// A text, also one written as a whole number.
pub fn text<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Written {
        Text(String),
        Number(i64),
    }
    match Written::deserialize(deserializer) {
        Ok(Written::Text(text)) => Ok(text),
        Ok(Written::Number(number)) => Ok(number.to_string()),
        Err(_) => Err(D::Error::custom("expected a text or a whole number")),
    }
}
