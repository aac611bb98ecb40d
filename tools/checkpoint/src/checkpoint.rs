//! A checkpoint with its state dict found.

use std::collections::HashSet;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use zip::result::ZipError;

use crate::dtype::Dtype;
use crate::pickle::{Pickle, PickleError, Value, entry};
use crate::shown;
use crate::source::Source;
use crate::view::{Storage, View};

/// Keys under which training scripts keep the state dict where more is saved beside it.
const NESTED: [&str; 3] = ["state_dict", "model_state_dict", "model"];

/// What `DataParallel` puts before every name.
const PARALLEL: &str = "module.";

/// A checkpoint that PyTorch wrote. Numbers are read when they are asked for.
pub struct Checkpoint {
    path: PathBuf,
    source: Source,
    tensors: Vec<(String, View)>,
    others: Vec<String>,
    within: Option<&'static str>,
    epoch: Option<i64>,
    /// The storage read last: tensors may share one.
    last: Option<(Storage, Vec<u8>)>,
}

/// Why a checkpoint was not read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct ReadError {
    path: PathBuf,
    problem: Problem,
}

/// What is wrong with a checkpoint.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Problem {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error("a damaged archive: {0}; take a whole copy of the file")]
    Zip(#[from] ZipError),
    #[error("expected a file that torch.save wrote, a zip archive or the format before it; this is neither")]
    Unknown,
    #[error("expected an archive of torch.save with one folder that holds data.pkl")]
    NoPickle,
    #[error("expected numbers with the lowest byte first, or the highest in an archive that says so")]
    ByteOrder,
    #[error("a damaged file of the format before PyTorch 1.6: {0}; take a whole copy of it")]
    Legacy(&'static str),
    #[error(transparent)]
    Pickle(#[from] PickleError),
    #[error(
        "storage `{}`: expected {expected} bytes, found none or another number; take a whole copy of the file",
        shown(key)
    )]
    Storage { key: String, expected: u64 },
    #[error(
        "expected a state dict, plain or under {}, found {found}; save one: torch.save(model.state_dict(), FILE)",
        NESTED.map(|key| format!("`{key}`")).join(", ")
    )]
    NoStateDict { found: String },
    #[error("its state dict holds no tensor: nothing would be loaded; save it after the model was built")]
    Empty,
    #[error("`{}` is in the state dict twice", shown(.0))]
    Twice(String),
    #[error("`{}`: expected numbers with fractions, found {dtype}", shown(key))]
    Whole { key: String, dtype: Dtype },
}

impl Checkpoint {
    /// Opens a checkpoint and finds its state dict; names lose the `module.` of `DataParallel` if all have it.
    ///
    /// # Errors
    /// A file that is no checkpoint, is damaged, asks for more than data, or holds no tensor.
    pub fn open(path: &Path) -> Result<Checkpoint, ReadError> {
        let open = || -> Result<Checkpoint, Problem> {
            let (source, pickle) = Source::open(File::open(path)?)?;
            let found = find(&pickle)?;
            Ok(Checkpoint {
                path: path.into(),
                source,
                tensors: found.tensors,
                others: found.others,
                within: found.within,
                epoch: found.epoch,
                last: None,
            })
        };
        open().map_err(|problem| ReadError {
            path: path.into(),
            problem,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Name, shape and type of each tensor, in the order of the state dict.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[usize], Dtype)> {
        let tensors = self.tensors.iter();
        tensors.map(|(name, view)| (name.as_str(), view.shape(), view.storage.dtype))
    }

    /// Shape of a tensor.
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        let found = self.tensors.iter().find(|(known, _)| known == name);
        found.map(|(_, view)| view.shape())
    }

    /// Entries of the state dict that are no tensors.
    pub fn others(&self) -> &[String] {
        &self.others
    }

    /// The key under which the state dict was found, if not at the top.
    pub fn within(&self) -> Option<&str> {
        self.within
    }

    /// The epoch that is told beside the state dict.
    pub fn epoch(&self) -> Option<i64> {
        self.epoch
    }

    /// The numbers of a tensor in row-major order, as f32.
    ///
    /// # Errors
    /// A damaged file, and a tensor of whole numbers.
    ///
    /// # Panics
    /// If there is no such tensor.
    pub fn numbers(&mut self, name: &str) -> Result<Vec<f32>, ReadError> {
        let found = self.tensors.iter().find(|(known, _)| known == name);
        let (_, view) = found.expect("a tensor that the checkpoint has");
        let view = view.clone();
        self.read(name, &view).map_err(|problem| ReadError {
            path: self.path.clone(),
            problem,
        })
    }

    fn read(&mut self, name: &str, view: &View) -> Result<Vec<f32>, Problem> {
        let dtype = view.storage.dtype;
        if !dtype.is_float() {
            return Err(Problem::Whole {
                key: name.into(),
                dtype,
            });
        }
        let is_there = self.last.as_ref().is_some_and(|(storage, _)| *storage == view.storage);
        if !is_there {
            self.last = None;
            self.last = Some((view.storage.clone(), self.source.read(&view.storage)?));
        }
        let (_, bytes) = self.last.as_ref().expect("it was read");
        let numbers = view.numbers(bytes, self.source.big_endian());
        Ok(numbers.expect("a type with fractions"))
    }
}

/// A state dict in a pickle.
struct Found {
    tensors: Vec<(String, View)>,
    others: Vec<String>,
    within: Option<&'static str>,
    epoch: Option<i64>,
}

fn find(pickle: &Pickle) -> Result<Found, Problem> {
    let top = pickle.dict(&pickle.root).ok_or_else(|| Problem::NoStateDict {
        found: "something that is no dict".into(),
    })?;
    let epoch = match entry(top, "epoch") {
        Some(Value::Int(epoch)) => i64::try_from(*epoch).ok(),
        _ => None,
    };
    let holds_tensors = top.iter().any(|(_, value)| pickle.tensor(value).is_some());
    let inner = |key: &&'static str| Some((*key, pickle.dict(entry(top, key)?)?));
    let inner: Vec<_> = NESTED.iter().filter_map(inner).collect();
    let (within, dict) = match (holds_tensors, &inner[..]) {
        (true, _) => (None, top),
        (false, [(key, dict)]) => (Some(*key), *dict),
        (false, []) if top.is_empty() => return Err(Problem::Empty),
        (false, []) => {
            let found = format!("a dict of {}", keys(top));
            return Err(Problem::NoStateDict { found });
        }
        (false, several) => {
            let keys: Vec<String> = several.iter().map(|(key, _)| format!("`{key}`")).collect();
            let found = format!("several: {}", keys.join(", "));
            return Err(Problem::NoStateDict { found });
        }
    };
    let (tensors, others) = entries(pickle, dict)?;
    Ok(Found {
        tensors,
        others,
        within,
        epoch,
    })
}

/// The first keys of a dict, for an error.
fn keys(dict: &[(Value, Value)]) -> String {
    let name = |(key, _): &(Value, Value)| match key {
        Value::Text(text) => format!("`{}`", shown(text)),
        _ => "a key that is no text".into(),
    };
    let mut names: Vec<String> = dict.iter().take(8).map(name).collect();
    if dict.len() > names.len() {
        names.push("…".into());
    }
    names.join(", ")
}

type Entries = (Vec<(String, View)>, Vec<String>);

/// The tensors of a state dict, and the names of what is none; an `epoch` among them is nothing of the model's.
fn entries(pickle: &Pickle, dict: &[(Value, Value)]) -> Result<Entries, Problem> {
    let (mut tensors, mut others, mut seen) = (Vec::new(), Vec::new(), HashSet::new());
    for (key, value) in dict {
        let Value::Text(name) = key else {
            others.push("a key that is no text".into());
            continue;
        };
        if !seen.insert(name.clone()) {
            return Err(Problem::Twice(name.to_string()));
        }
        match pickle.tensor(value) {
            Some(view) => tensors.push((name.to_string(), view.clone())),
            None if **name == *"epoch" => {}
            None => others.push(name.to_string()),
        }
    }
    if tensors.is_empty() {
        return Err(Problem::Empty);
    }
    if tensors.iter().all(|(name, _)| name.starts_with(PARALLEL)) {
        tensors
            .iter_mut()
            .for_each(|(name, _)| _ = name.drain(..PARALLEL.len()));
    }
    Ok((tensors, others))
}
