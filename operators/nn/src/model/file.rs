//! Model files, and those that extend each other.

use std::path::{Path, PathBuf};

use super::architecture::Architecture;
use super::error::ModelError;
use super::settings::Model;
use crate::bounded::read_bounded;

/// Bytes of a model file at most.
const MOST_BYTES: u64 = 1 << 20;

/// Model files that extend each other, at most.
const MOST_EXTENDED: usize = 8;

impl<A: Architecture> Model<A> {
    /// Reads and checks a model file.
    ///
    /// # Errors
    /// [`ModelError::Read`], [`ModelError::Syntax`], and [`ModelError::File`] with what [`Model::validate`] finds.
    pub fn read(path: &Path) -> Result<Model<A>, ModelError> {
        Ok(Model::read_with_files(path)?.0)
    }

    /// A model of texts that are built in: what the first says, and the second where the first says nothing.
    ///
    /// # Errors
    /// Those of [`Model::parse`].
    pub fn of_texts(above: &str, below: &str) -> Result<Model<A>, ModelError> {
        let path = Path::new("a model that is built in");
        let syntax = |error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        };
        let mut above: toml::Table = toml::from_str(above).map_err(syntax)?;
        above.remove("extends");
        let table = over(toml::from_str(below).map_err(syntax)?, above);
        Model::checked(table.try_into().map_err(syntax)?, path)
    }

    /// Reads and checks a model file; beside the model the file and those that it extends, each with its bytes.
    ///
    /// # Errors
    /// As [`Model::read`], and [`ModelError::Extends`].
    pub fn read_with_files(path: &Path) -> Result<(Model<A>, Vec<ModelFile>), ModelError> {
        let text = read_text(path)?;
        // Errors of a file that extends none tell the place in it.
        let Some(mut table) = extending(&text) else {
            return Ok((Model::parse(&text, path)?, vec![(path.into(), text)]));
        };
        let mut files = vec![(path.to_path_buf(), text)];
        let mut file = path.to_path_buf();
        while let Some(base) = table.remove("extends") {
            let wrong = |reason: String| ModelError::Extends {
                path: file.clone(),
                reason,
            };
            let base = base
                .as_str()
                .ok_or_else(|| wrong(format!("expected the name of a model file, found {base}")))?;
            if files.len() > MOST_EXTENDED {
                return Err(wrong(format!("more than {MOST_EXTENDED} files in a row")));
            }
            if Path::new(base).file_name() != Some(base.as_ref()) {
                return Err(wrong(format!(
                    "expected the name of a model file beside it, found `{base}`"
                )));
            }
            let next = file.with_file_name(base);
            let text = read_text(&next).map_err(|error| wrong(error.to_string()))?;
            file = next;
            let below = toml::from_slice(&text).map_err(|error| ModelError::Syntax {
                path: file.clone(),
                error: Box::new(error),
            })?;
            files.push((file.clone(), text));
            table = over(below, table);
        }
        let model = table.try_into().map_err(|error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        })?;
        Model::checked(model, path).map(|model| (model, files))
    }

    /// Reads and checks the bytes of a model file; `path` is for errors.
    ///
    /// # Errors
    /// [`ModelError::Syntax`], and [`ModelError::File`] with what [`Model::validate`] finds.
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Model<A>, ModelError> {
        let model: Model<A> = toml::from_slice(bytes).map_err(|error| ModelError::Syntax {
            path: path.into(),
            error: Box::new(error),
        })?;
        Model::checked(model, path)
    }

    fn checked(model: Model<A>, path: &Path) -> Result<Model<A>, ModelError> {
        model.validate().map_err(|error| ModelError::File {
            path: path.into(),
            error: Box::new(error),
        })?;
        Ok(model)
    }
}

fn read_text(path: &Path) -> Result<Vec<u8>, ModelError> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let beside = path.with_extension("toml");
    let mend = match &*ending {
        "safetensors" if beside.is_file() => format!("give `{}`", beside.display()),
        "safetensors" => "give the model file that names them (docs/reference/networks.md)".into(),
        "pth" | "pt" | "ckpt" => format!(
            "`realo-lab checkpoint convert {}` makes weights and a model file of it (docs/guide/your-checkpoint.md)",
            path.display()
        ),
        "onnx" => "`realo-onnx` runs such a file (docs/guide/your-model.md)".into(),
        _ => String::new(),
    };
    if !mend.is_empty() && path.is_file() {
        let path = path.into();
        return Err(ModelError::Weights { path, mend });
    }
    read_bounded(path, MOST_BYTES).map_err(|error| ModelError::Read {
        path: path.into(),
        error,
    })
}

/// A model file, one that it extends or one of its weights, and its bytes.
pub type ModelFile = (PathBuf, Vec<u8>);

/// The table of a model file that extends another.
fn extending(text: &[u8]) -> Option<toml::Table> {
    let table: toml::Table = toml::from_slice(text).ok()?;
    table.contains_key("extends").then_some(table)
}

/// What `above` says, and what `below` says where it says nothing.
fn over(mut below: toml::Table, above: toml::Table) -> toml::Table {
    for (key, value) in above {
        let value = match (below.remove(&key), value) {
            (Some(toml::Value::Table(below)), toml::Value::Table(above)) if key != "arch" => {
                toml::Value::Table(over(below, above))
            }
            (_, value) => value,
        };
        below.insert(key, value);
    }
    below
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_no_model_file_and_the_error_leads_on() {
        let folder = tempfile::tempdir().unwrap();
        for (name, beside, expected) in [
            ("a.safetensors", true, "give `"),
            ("b.safetensors", false, "give the model file that names them"),
            ("c.pth", false, "realo-lab checkpoint convert"),
            ("d.onnx", false, "realo-onnx"),
        ] {
            let path = folder.path().join(name);
            std::fs::write(&path, [0xff; 9]).unwrap();
            if beside {
                std::fs::write(path.with_extension("toml"), "").unwrap();
            }
            let said = read_text(&path).unwrap_err().to_string();
            assert!(said.contains(name) && said.contains(expected), "{said}");
        }
    }
}
