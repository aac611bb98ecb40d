use std::collections::BTreeMap;
use std::path::Path;

use safetensors::{Dtype, SafeTensors};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::reference::Corners;

/// A line of the manifest.
#[derive(Clone, Debug, Deserialize)]
pub struct Entry {
    /// The file, below the folder of vectors.
    pub file: String,
    /// How near results must be: a number, or words that begin with one, or `exact`.
    pub tolerance: Value,
    /// Settings of the case.
    #[serde(default)]
    pub config: Value,
    /// The tensors of a file of tensors, each with its type and shape.
    #[serde(default)]
    pub tensors: BTreeMap<String, Value>,
    /// The keys of a JSON document.
    #[serde(default)]
    pub keys: Vec<String>,
}

impl Entry {
    /// Whether it has a tensor or a key of this name.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name) || self.keys.iter().any(|key| key == name)
    }
}

/// One vector on disk, and what lies beside it.
#[derive(Clone, Copy)]
pub(crate) struct Vector<'a> {
    pub dir: &'a Path,
    pub entry: &'a Entry,
    pub all: &'a [Entry],
}

impl Vector<'_> {
    /// Largest difference t: |found - expected| ≤ t + t |expected|.
    pub fn tolerance(&self) -> Result<f64, String> {
        let words = self
            .entry
            .tolerance
            .as_str()
            .and_then(|text| text.split_whitespace().next());
        match (self.entry.tolerance.as_f64(), words) {
            (Some(number), _) => Ok(number),
            (None, Some("exact")) => Ok(0.0),
            (None, Some(word)) => word
                .parse()
                .map_err(|_| format!("the manifest's tolerance `{word}` is no number")),
            (None, None) => Err(format!(
                "the manifest's tolerance {} is no number",
                self.entry.tolerance
            )),
        }
    }

    /// A list of numbers of the case's configuration.
    pub fn setting<const N: usize>(&self, key: &str) -> Result<[f64; N], String> {
        let list = self.entry.config.get(key).cloned().unwrap_or_default();
        let list: Vec<f64> = serde_json::from_value(list).map_err(|error| format!("config `{key}`: {error}"))?;
        list.try_into()
            .map_err(|list: Vec<f64>| format!("config `{key}`: expected {N} numbers, found {}", list.len()))
    }

    /// A number of the case's configuration.
    pub fn number(&self, key: &str) -> Result<f64, String> {
        let value = &self.entry.config[key];
        value
            .as_f64()
            .ok_or_else(|| format!("config `{key}`: expected a number, found {value}"))
    }

    /// The tensors of the file.
    pub fn tensors(&self) -> Result<Tensors, String> {
        Tensors::read(&self.dir.join(&self.entry.file))
    }

    /// The vectors of the manifest that have a tensor or key of this name.
    pub fn others(&self, name: &str) -> Vec<Vector<'_>> {
        let others = self.all.iter().filter(|entry| entry.has(name));
        others.map(|entry| Vector { entry, ..*self }).collect()
    }

    /// A text of the case's configuration.
    pub fn text(&self, key: &str) -> Result<&str, String> {
        let value = &self.entry.config[key];
        value
            .as_str()
            .ok_or_else(|| format!("config `{key}`: expected a text, found {value}"))
    }

    /// A file in the same folder, below the folder of vectors.
    pub fn beside(&self, file: &str) -> String {
        match self.entry.file.rsplit_once('/') {
            Some((folder, _)) => format!("{folder}/{file}"),
            None => file.into(),
        }
    }

    /// The document of the file, or of one beside it.
    pub fn json<T: DeserializeOwned>(&self, file: Option<&str>) -> Result<T, String> {
        let file = file.unwrap_or(&self.entry.file);
        let text = std::fs::read_to_string(self.dir.join(file)).map_err(|error| format!("{file}: {error}"))?;
        serde_json::from_str(&text).map_err(|error| format!("{file}: {error}"))
    }
}

/// A file of tensors, read whole.
pub(crate) struct Tensors {
    file: String,
    bytes: Vec<u8>,
}

impl Tensors {
    fn read(path: &Path) -> Result<Self, String> {
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let bytes = std::fs::read(path).map_err(|error| format!("{file}: {error}"))?;
        SafeTensors::deserialize(&bytes).map_err(|error| format!("{file} is no safetensors file: {error}"))?;
        Ok(Tensors { file, bytes })
    }

    fn parsed(&self) -> Result<SafeTensors<'_>, String> {
        SafeTensors::deserialize(&self.bytes).map_err(|error| format!("{}: {error}", self.file))
    }

    /// Names that begin so, in order of the name.
    pub fn names(&self, prefix: &str) -> Result<Vec<String>, String> {
        let mut names: Vec<String> = self
            .parsed()?
            .names()
            .into_iter()
            .map(|name| name.to_string())
            .collect();
        names.retain(|name| name.starts_with(prefix));
        names.sort();
        Ok(names)
    }

    /// A tensor's numbers, exactly; row-major.
    pub fn numbers(&self, name: &str) -> Result<Vec<f64>, String> {
        let parsed = self.parsed()?;
        let tensor = parsed
            .tensor(name)
            .map_err(|error| format!("{}: tensor `{name}`: {error}", self.file))?;
        let data = tensor.data();
        let numbers = match tensor.dtype() {
            Dtype::F64 => each(data, f64::from_le_bytes),
            Dtype::F32 => each(data, |bytes| f64::from(f32::from_le_bytes(bytes))),
            Dtype::I64 => each(data, |bytes| i64::from_le_bytes(bytes) as f64),
            Dtype::I32 => each(data, |bytes| f64::from(i32::from_le_bytes(bytes))),
            Dtype::I8 => each(data, |bytes| f64::from(i8::from_le_bytes(bytes))),
            Dtype::U8 => each(data, |[byte]: [u8; 1]| f64::from(byte)),
            other => {
                return Err(format!(
                    "{}: tensor `{name}` is {other:?}, which no check reads",
                    self.file
                ));
            }
        };
        Ok(numbers)
    }

    /// A tensor's numbers as rows of `N`.
    pub fn rows<const N: usize>(&self, name: &str) -> Result<Vec<[f64; N]>, String> {
        let numbers = self.numbers(name)?;
        let (rows, rest) = numbers.as_chunks::<N>();
        if rest.is_empty() {
            Ok(rows.to_vec())
        } else {
            Err(format!(
                "{}: tensor `{name}` has {} numbers, not rows of {N}",
                self.file,
                numbers.len()
            ))
        }
    }

    /// A tensor's numbers in single precision.
    pub fn singles(&self, name: &str) -> Result<Vec<f32>, String> {
        Ok(self.numbers(name)?.into_iter().map(|number| number as f32).collect())
    }

    /// A `[samples, channels, rows, columns]` tensor, channels last, in single precision; and its shape as it is stored.
    pub fn channels_last(&self, name: &str) -> Result<(Vec<f32>, [usize; 4]), String> {
        let shape = self.shape(name)?;
        let [samples, channels, rows, columns] = shape[..] else {
            return Err(format!(
                "{}: tensor `{name}` has shape {shape:?}, not four sizes",
                self.file
            ));
        };
        let (numbers, cells) = (self.singles(name)?, rows * columns);
        let mut last = Vec::with_capacity(numbers.len());
        for sample in 0..samples {
            for cell in 0..cells {
                last.extend((0..channels).map(|channel| numbers[(sample * channels + channel) * cells + cell]));
            }
        }
        Ok((last, [samples, channels, rows, columns]))
    }

    /// A tensor's shape.
    pub fn shape(&self, name: &str) -> Result<Vec<usize>, String> {
        let parsed = self.parsed()?;
        let tensor = parsed
            .tensor(name)
            .map_err(|error| format!("{}: tensor `{name}`: {error}", self.file))?;
        Ok(tensor.shape().to_vec())
    }

    /// A tensor's numbers, if it has a shape.
    pub fn shaped(&self, name: &str, expected: &[usize]) -> Result<Vec<f64>, String> {
        let shape = self.shape(name)?;
        match shape == expected {
            true => self.numbers(name),
            false => Err(format!(
                "{}: tensor `{name}`: expected shape {expected:?}, found {shape:?}",
                self.file
            )),
        }
    }

    /// A `[boxes, 8, 3]` tensor.
    pub fn corners(&self, name: &str) -> Result<Vec<Corners>, String> {
        let rows = self.rows::<24>(name)?;
        Ok(rows
            .iter()
            .map(|row| std::array::from_fn(|i| [row[3 * i], row[3 * i + 1], row[3 * i + 2]]))
            .collect())
    }
}

/// All numbers of rows.
pub(crate) fn flat<const N: usize>(rows: &[[f64; N]]) -> Vec<f64> {
    rows.iter().flatten().copied().collect()
}

fn each<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f64) -> Vec<f64> {
    data.as_chunks::<N>().0.iter().map(|bytes| read(*bytes)).collect()
}

/// Whether all numbers are as expected, within t + t |expected|; else the first difference.
pub(crate) fn compare(what: &str, found: &[f64], expected: &[f64], t: f64) -> Result<(), String> {
    if found.len() != expected.len() {
        return Err(format!(
            "{what}: expected {} numbers, found {}",
            expected.len(),
            found.len()
        ));
    }
    for (index, (found, expected)) in found.iter().zip(expected).enumerate() {
        // NaN is never near.
        let near = (found - expected).abs() <= t + t * expected.abs();
        if !near {
            return Err(format!(
                "{what}[{index}]: expected {expected}, found {found} (tolerance {t})"
            ));
        }
    }
    Ok(())
}

/// Whether two lists are equal; else the first difference.
pub(crate) fn equal<T: PartialEq + std::fmt::Debug>(what: &str, found: &[T], expected: &[T]) -> Result<(), String> {
    if let Some(index) = found
        .iter()
        .zip(expected)
        .position(|(found, expected)| found != expected)
    {
        return Err(format!(
            "{what}[{index}]: expected {:?}, found {:?}",
            expected[index], found[index]
        ));
    }
    if found.len() != expected.len() {
        return Err(format!(
            "{what}: expected {} items, found {}",
            expected.len(),
            found.len()
        ));
    }
    Ok(())
}
