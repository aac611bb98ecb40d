//! Arrays of numpy: `.npy` files, and the `.npz` archives that hold several.

use std::io::{Cursor, Read as _};
use std::path::Path;

use realo_bags::{PICKLE, is_pickle};
use realo_documents::shown;
use zip::ZipArchive;
use zip::result::ZipError;

use crate::ImportError;
use crate::files::read;

/// How a `.npy` file begins.
const MAGIC: &[u8] = b"\x93NUMPY";
/// Bytes of an array, at most: a quarter of a gigabyte is no sweep.
const MOST: u64 = 1 << 28;
/// Items of an array, and texts, at most.
const MOST_ITEMS: [u64; 2] = [1 << 26, 1 << 16];
/// Axes of an array, at most.
const AXES: usize = 4;

/// An array in the order of C, with its numbers or texts.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Lengths of its axes.
    pub shape: Vec<usize>,
    /// What it holds.
    pub items: Items,
}

/// The items of an array.
#[derive(Clone, Debug, PartialEq)]
pub enum Items {
    /// Numbers of any type, and the type as intensities are told apart: `uint8`, `uint16`, `float32` and the like.
    Numbers(Vec<f64>, &'static str),
    /// Texts.
    Texts(Vec<String>),
}

/// Type of an item.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Item {
    Number(Number, &'static str),
    /// Characters of four bytes.
    Unicode(usize),
    /// Bytes.
    Ascii(usize),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Number {
    F4,
    F8,
    U1,
    U2,
    U4,
    U8,
    I1,
    I2,
    I4,
    I8,
}

impl Number {
    const ALL: [(&str, Number, &str); 11] = [
        ("f4", Number::F4, "float32"),
        ("f8", Number::F8, "float64"),
        ("u1", Number::U1, "uint8"),
        ("b1", Number::U1, "uint8"),
        ("u2", Number::U2, "uint16"),
        ("u4", Number::U4, "uint32"),
        ("u8", Number::U8, "uint64"),
        ("i1", Number::I1, "int8"),
        ("i2", Number::I2, "int16"),
        ("i4", Number::I4, "int32"),
        ("i8", Number::I8, "int64"),
    ];

    fn size(self) -> usize {
        match self {
            Number::U1 | Number::I1 => 1,
            Number::U2 | Number::I2 => 2,
            Number::F4 | Number::U4 | Number::I4 => 4,
            Number::F8 | Number::U8 | Number::I8 => 8,
        }
    }

    /// One from its bytes, the least first.
    fn read(self, bytes: [u8; 8]) -> f64 {
        let [a, b, c, d, ..] = bytes;
        match self {
            Number::F4 => f32::from_le_bytes([a, b, c, d]).into(),
            Number::F8 => f64::from_le_bytes(bytes),
            Number::U1 => a.into(),
            Number::U2 => u16::from_le_bytes([a, b]).into(),
            Number::U4 => u32::from_le_bytes([a, b, c, d]).into(),
            Number::U8 => u64::from_le_bytes(bytes) as f64,
            Number::I1 => i8::from_le_bytes([a]).into(),
            Number::I2 => i16::from_le_bytes([a, b]).into(),
            Number::I4 => i32::from_le_bytes([a, b, c, d]).into(),
            Number::I8 => i64::from_le_bytes(bytes) as f64,
        }
    }
}

impl Array {
    /// Reads a `.npy` file.
    ///
    /// # Errors
    /// Why it is none, or one that holds objects.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        Array::parse(&read(path)?).map_err(|reason| ImportError::content(path, reason))
    }

    /// Reads the bytes of a `.npy` file.
    ///
    /// # Errors
    /// The same, without its name.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let Some(rest) = bytes.strip_prefix(MAGIC) else {
            not_pickled(bytes, "an array of numpy", "numpy.save(FILE, array)")?;
            return Err("expected an array of numpy, as numpy.save writes it, found other bytes".into());
        };
        let cut = || "expected the head of an array, found less; fetch the file anew".to_string();
        let &[major, _, ref rest @ ..] = rest else {
            return Err(cut());
        };
        let (length, rest) = match (major, rest) {
            (1, &[a, b, ref rest @ ..]) => (usize::from(u16::from_le_bytes([a, b])), rest),
            (2 | 3, &[a, b, c, d, ref rest @ ..]) => (u32::from_le_bytes([a, b, c, d]) as usize, rest),
            (1..=3, _) => return Err(cut()),
            _ => return Err(format!("expected an array of numpy's version 1 to 3, found {major}")),
        };
        let head = rest.get(..length).ok_or_else(cut)?;
        let head = std::str::from_utf8(head).map_err(|_| "the head of the array is not UTF-8".to_string())?;
        let (item, is_big, is_fortran, shape) = head_of(head)?;
        items(&rest[length..], item, is_big, is_fortran, shape)
    }

    /// Its shape and type, in words.
    pub fn words(&self) -> String {
        let kind = match &self.items {
            Items::Numbers(_, kind) => *kind,
            Items::Texts(_) => "texts",
        };
        format!("the shape {:?} of {kind}", self.shape)
    }

    /// Rows of a matrix with at least so many columns; a vector is no matrix.
    ///
    /// # Errors
    /// Another shape, or texts.
    pub fn rows(&self, columns: std::ops::RangeInclusive<usize>) -> Result<impl Iterator<Item = &[f64]>, String> {
        let (numbers, _) = self.numbers()?;
        match self.shape[..] {
            [_, width] if columns.contains(&width) => Ok(numbers.chunks_exact(width.max(1))),
            _ if columns.start() == columns.end() => Err(format!(
                "expected a matrix of {} columns, found {}",
                columns.start(),
                self.words()
            )),
            _ => Err(format!(
                "expected a matrix of {} to {} columns, found {}",
                columns.start(),
                columns.end(),
                self.words()
            )),
        }
    }

    /// All numbers, and their type.
    ///
    /// # Errors
    /// Texts.
    pub fn numbers(&self) -> Result<(&[f64], &'static str), String> {
        match &self.items {
            Items::Numbers(numbers, kind) => Ok((numbers, kind)),
            Items::Texts(_) => Err(format!("expected numbers, found {}", self.words())),
        }
    }
}

/// Type, byte order, order of axes and shape, as the head of an array says them: a dictionary of Python.
fn head_of(head: &str) -> Result<(Item, bool, bool, Vec<usize>), String> {
    let wrong = |what: &str| {
        format!(
            "expected a head that says {what} of the array, found `{}`; the file is damaged: save it anew by numpy.save",
            shown(head.trim())
        )
    };
    let value = |key: &str, what: &str| {
        let (_, rest) = head.split_once(&format!("'{key}':")).ok_or_else(|| wrong(what))?;
        Ok::<&str, String>(rest.trim_start())
    };
    let descr = value("descr", "the type")?;
    let descr = descr
        .strip_prefix('\'')
        .and_then(|rest| rest.split_once('\''))
        .map(|(descr, _)| descr);
    let Some(descr) = descr else {
        return Err("expected an array of numbers or texts, found one of named fields; save its columns as one array of float32".into());
    };
    let (order, name) = descr.split_at_checked(1).unwrap_or(("", descr));
    let sized = |letter: char| name.strip_prefix(letter).and_then(|size| size.parse::<usize>().ok());
    let known = Number::ALL.iter().find(|(known, _, _)| *known == name);
    let item = match (known, sized('U'), sized('S')) {
        (Some((_, number, kind)), _, _) => Item::Number(*number, kind),
        (None, Some(size @ 1..=4096), _) => Item::Unicode(size),
        (None, None, Some(size @ 1..=4096)) => Item::Ascii(size),
        _ if name.starts_with('O') => {
            return Err("expected an array of numbers or texts, found one of Python's objects, which only Python could read; save it \
                        with allow_pickle=False"
                .into());
        }
        _ => {
            return Err(format!(
                "expected numbers or texts, found items of the type `{}`{}; save them as numbers by array.astype(numpy.float32)",
                shown(descr),
                in_words(name)
            ));
        }
    };
    let is_fortran = value("fortran_order", "the order")?.starts_with("True");
    let shape = value("shape", SHAPE)?
        .strip_prefix('(')
        .and_then(|rest| rest.split_once(')'));
    let shape = shape.ok_or_else(|| wrong(SHAPE))?.0;
    let axes = shape.split(',').map(str::trim).filter(|axis| !axis.is_empty());
    let axes: Result<Vec<usize>, String> = axes.map(|axis| axis.parse().map_err(|_| wrong(SHAPE))).collect();
    Ok((item, order == ">", is_fortran, axes?))
}

/// What a head says of an array's axes.
const SHAPE: &str = "the shape";

/// The type of numpy that is not read, as its users call it.
fn in_words(name: &str) -> String {
    let known = match name {
        "f2" => "float16",
        "f16" => "longdouble",
        "c8" => "complex64",
        "c16" => "complex128",
        _ if name.starts_with('M') => "dates",
        _ if name.starts_with('m') => "times",
        _ if name.starts_with('V') => "raw bytes",
        _ => return String::new(),
    };
    format!(" ({known})")
}

fn items(bytes: &[u8], item: Item, is_big: bool, is_fortran: bool, shape: Vec<usize>) -> Result<Array, String> {
    let size = match item {
        Item::Number(number, _) => number.size(),
        Item::Unicode(characters) => 4 * characters,
        Item::Ascii(bytes) => bytes,
    };
    let count = shape.iter().try_fold(1u64, |all, axis| all.checked_mul(*axis as u64));
    let wanted = count
        .and_then(|count| count.checked_mul(size as u64))
        .filter(|wanted| *wanted <= MOST);
    let [numbers, texts] = MOST_ITEMS;
    let most = match item {
        Item::Number(..) => numbers,
        Item::Unicode(_) | Item::Ascii(_) => texts,
    };
    let Some(wanted) = wanted.filter(|_| shape.len() <= AXES && count <= Some(most)) else {
        return Err(format!(
            "expected at most {AXES} axes, {MOST} bytes, {numbers} numbers and {texts} texts, found the shape {shape:?}"
        ));
    };
    if bytes.len() as u64 != wanted {
        return Err(format!(
            "expected {wanted} bytes for the shape {shape:?}, found {}; the file may be cut: fetch it anew",
            bytes.len()
        ));
    }
    let words = bytes.chunks_exact(size);
    let items = match item {
        Item::Number(number, kind) => {
            let read = |word: &[u8]| {
                let mut bytes = [0; 8];
                bytes[..size].copy_from_slice(word);
                if is_big {
                    bytes[..size].reverse();
                }
                number.read(bytes)
            };
            Items::Numbers(in_order(words.map(read).collect(), is_fortran, &shape)?, kind)
        }
        Item::Unicode(_) => {
            let character = |word: &[u8]| {
                let mut word: [u8; 4] = word.try_into().unwrap_or_default();
                if is_big {
                    word.reverse();
                }
                char::from_u32(u32::from_le_bytes(word)).filter(|c| *c != '\0')
            };
            Items::Texts(
                words
                    .map(|word| word.chunks_exact(4).filter_map(character).collect())
                    .collect(),
            )
        }
        Item::Ascii(_) => {
            let text = |word: &[u8]| String::from_utf8_lossy(word).trim_end_matches('\0').to_string();
            Items::Texts(words.map(text).collect())
        }
    };
    Ok(Array { shape, items })
}

/// Refuses a pickle by its first bytes; none of it is run.
fn not_pickled(bytes: &[u8], expected: &str, save: &str) -> Result<(), String> {
    match is_pickle(bytes) {
        true => Err(format!(
            "expected {expected}, found {PICKLE}; where you trust it, load it in Python, and save what it holds by {save}"
        )),
        false => Ok(()),
    }
}

/// The numbers of a matrix whose columns lie one after another, row by row.
fn in_order(numbers: Vec<f64>, is_fortran: bool, shape: &[usize]) -> Result<Vec<f64>, String> {
    match (is_fortran, shape) {
        (false, _) | (true, [] | [_]) => Ok(numbers),
        (true, &[rows, columns]) => {
            let at = |place: usize| numbers[place % columns * rows + place / columns];
            Ok((0..numbers.len()).map(at).collect())
        }
        (true, axes) => Err(format!(
            "expected numbers that lie row by row, found the shape {axes:?} column by column; save numpy.ascontiguousarray(array)"
        )),
    }
}

/// An archive of arrays.
pub struct Arrays {
    archive: ZipArchive<Cursor<Vec<u8>>>,
}

impl Arrays {
    /// Reads a `.npz` file.
    ///
    /// # Errors
    /// A file that is none.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let bytes = read(path)?;
        not_pickled(
            &bytes,
            "arrays as numpy.savez writes them",
            "numpy.savez(FILE, points=points, pose=pose, boxes=boxes)",
        )
        .map_err(|reason| ImportError::content(path, reason))?;
        let archive = ZipArchive::new(Cursor::new(bytes));
        archive.map(|archive| Arrays { archive }).map_err(|error| {
            let reason = format!("expected arrays as numpy.savez writes them, found no such archive ({error}); fetch it anew if it was cut");
            ImportError::content(path, reason)
        })
    }

    /// Names of its arrays.
    pub fn names(&self) -> String {
        let names = self.archive.file_names().flatten();
        let names = names.map(|name| format!("`{}`", shown(name.trim_end_matches(".npy"))));
        names.collect::<Vec<_>>().join(", ")
    }

    /// An array that is none of these.
    pub fn other_than(&self, known: &[&str]) -> Option<String> {
        let names = self.archive.file_names().flatten();
        let mut names = names.map(|name| name.trim_end_matches(".npy").to_string());
        let other = names.find(|name| !known.contains(&&**name));
        other.map(|name| shown(&name))
    }

    /// An array, if it is there.
    ///
    /// # Errors
    /// One that cannot be read.
    pub fn array(&mut self, name: &str) -> Result<Option<Array>, String> {
        let file = match self.archive.by_name(&format!("{name}.npy")) {
            Err(ZipError::FileNotFound) => return Ok(None),
            file => file.map_err(|error| {
                format!("array `{name}`: {error}; save it with numpy.savez or numpy.savez_compressed")
            })?,
        };
        let mut bytes = Vec::new();
        // A little file may say that it holds much.
        let read = file.take(MOST).read_to_end(&mut bytes);
        read.map_err(|error| format!("array `{name}`: {error}; fetch the file anew"))?;
        Array::parse(&bytes)
            .map(Some)
            .map_err(|reason| format!("array `{name}`: {reason}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn npy(head: &str, bytes: &[u8]) -> Vec<u8> {
        let mut file = [MAGIC, &[1, 0], &(head.len() as u16).to_le_bytes(), head.as_bytes()].concat();
        file.extend(bytes);
        file
    }

    fn head(descr: &str, is_fortran: &str, shape: &str) -> String {
        format!("{{'descr': '{descr}', 'fortran_order': {is_fortran}, 'shape': ({shape}), }}\n")
    }

    #[test]
    fn numbers_of_every_type_and_order_are_read() {
        let floats = [1.5f32, -2.0, 3.0, 4.0, 5.0, 6.0];
        let little = floats.map(f32::to_le_bytes).concat();
        let read = |head: String, bytes: &[u8]| Array::parse(&npy(&head, bytes)).unwrap();
        let rows = read(head("<f4", "False", "2, 3"), &little);
        assert_eq!(rows.shape, [2, 3]);
        assert_eq!(rows.numbers().unwrap(), (&floats.map(f64::from)[..], "float32"));
        let big = floats.map(f32::to_be_bytes).concat();
        assert_eq!(read(head(">f4", "False", "2, 3"), &big), rows);
        let columns = [1.5f32, 4.0, -2.0, 5.0, 3.0, 6.0].map(f32::to_le_bytes).concat();
        assert_eq!(read(head("<f4", "True", "2, 3"), &columns), rows);
        let one = read(
            head("<i8", "False", "2,"),
            &[(-7i64).to_le_bytes(), 9i64.to_le_bytes()].concat(),
        );
        assert_eq!(one.numbers().unwrap(), (&[-7.0, 9.0][..], "int64"));
        let texts = read(
            head("<U3", "False", "2,"),
            &['C', 'a', 'r', 'B', 'u', '\0']
                .map(|c| (c as u32).to_le_bytes())
                .concat(),
        );
        assert_eq!(texts.items, Items::Texts(vec!["Car".into(), "Bu".into()]));
        assert_eq!(read(head("|S3", "False", "2,"), b"CarBu\0"), texts);
        assert_eq!(read(head("<f4", "False", "0, 4"), &[]).rows(4..=4).unwrap().count(), 0);
    }

    #[test]
    fn what_is_no_array_of_numbers_is_refused_with_the_cause() {
        for (file, expected) in [
            (b"PK\x03\x04".to_vec(), "expected an array of numpy"),
            (
                b"\x80\x04\x95".to_vec(),
                "found a pickle of Python, which is never loaded, as loading one runs what is in it; where you trust it, load it in \
                 Python, and save what it holds by numpy.save(FILE, array)",
            ),
            (npy(&head("|O", "False", "1,"), &[0; 8]), "allow_pickle=False"),
            (
                npy(&head("<f4", "False", "2, 2"), &[0; 12]),
                "expected 16 bytes for the shape [2, 2], found 12",
            ),
            (
                npy(&head("<f4", "False", "99999999999, 99999999999"), &[]),
                "found the shape",
            ),
            (npy(&head("é4", "False", "1,"), &[0; 4]), "items of the type `é4`"),
            (
                npy(&head("|S1", "False", "99999,"), &[0; 99999]),
                "found the shape [99999]",
            ),
            (npy(&head("<c8", "False", "1,"), &[0; 8]), "items of the type `<c8`"),
            (
                npy(
                    "{'descr': [('x', '<f4')], 'fortran_order': False, 'shape': (1,)}",
                    &[0; 4],
                ),
                "named fields",
            ),
            (
                npy("{}", &[]),
                "expected a head that says the type of the array, found `{}`; the file is damaged: save it anew by numpy.save",
            ),
            (
                npy(&head("<f2", "False", "1,"), &[0; 2]),
                "items of the type `<f2` (float16); save them as numbers by array.astype(numpy.float32)",
            ),
            (npy(&head("<M8[ns]", "False", "1,"), &[0; 8]), "(dates)"),
            (
                npy(&head("<f4", "True", "1, 1, 1"), &[0; 4]),
                "found the shape [1, 1, 1] column by column; save numpy.ascontiguousarray(array)",
            ),
            (MAGIC.to_vec(), "found less"),
            ([MAGIC, &[9, 0, 0, 0]].concat(), "version 1 to 3, found 9"),
        ] {
            let error = Array::parse(&file).unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        let flat = Array::parse(&npy(&head("<f4", "False", "2,"), &[0; 8])).unwrap();
        assert!(
            flat.rows(3..=6)
                .err()
                .unwrap()
                .contains("3 to 6 columns, found the shape [2]")
        );
    }
}
