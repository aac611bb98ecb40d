//! A checkpoint with its state dict found.

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

use realo_nn::weights::is_counter;
use zip::result::ZipError;

use crate::convert::{Shapes, fitting};
use crate::dtype::Dtype;
use crate::pickle::{Pickle, PickleError, Value, entry};
use crate::shown;
use crate::source::Source;
use crate::view::{Storage, View};

/// Keys under which training scripts keep the state dict where more is saved beside it. If there is one of these, dicts of
/// tensors under other keys do not matter.
const NESTED: [&str; 7] = [
    "state_dict",
    "model_state_dict",
    "model_state",
    "model",
    "net",
    "network",
    "weights",
];

/// How deep the state dict may lie below the top.
const DEEPEST: usize = 3;

/// What wrappers put before all names: `DataParallel`, Lightning, and scripts.
const WRAPPERS: [&str; 6] = ["module.", "model.", "state_dict.", "net.", "network.", "detector."];
/// What `torch.compile` puts before the names of what it compiled, the whole or a part.
const COMPILED: &str = "_orig_mod";

/// Tensors behind a prefix, at least, for them to be a network.
const FEWEST: usize = 8;

/// A checkpoint that PyTorch wrote. Numbers are read when they are asked for.
pub struct Checkpoint {
    path: PathBuf,
    source: Source,
    tensors: Vec<(String, View)>,
    others: Vec<String>,
    within: Option<String>,
    left_out: Vec<String>,
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
    #[error("expected a file that torch.save wrote, a zip archive or the format before it; this is neither, but {0}")]
    Unknown(&'static str),
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
    /// Opens a checkpoint and finds its state dict; names lose what wrappers put before them, if all have it.
    ///
    /// # Errors
    /// A file that is no checkpoint, is damaged, asks for more than data, or holds no tensor.
    pub fn open(path: &Path) -> Result<Checkpoint, ReadError> {
        let open = || -> Result<Checkpoint, Problem> {
            let (source, pickle) = Source::open(File::open(path)?)?;
            let found = find(&pickle)?;
            let mut checkpoint = Checkpoint {
                path: path.into(),
                source,
                tensors: found.tensors,
                others: found.others,
                within: found.within,
                left_out: Vec::new(),
                epoch: found.epoch,
                last: None,
            };
            checkpoint.look_behind(|shapes| fitting(shapes).is_some());
            Ok(checkpoint)
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

    /// The keys under which the state dict was found, if not at the top.
    pub fn within(&self) -> Option<&str> {
        self.within.as_deref()
    }

    /// Tensors and other entries beside the network's, which all stand behind one prefix.
    pub fn left_out(&self) -> &[String] {
        &self.left_out
    }

    /// Keeps what stands behind a prefix if that, and only that, fits; leaves all as it is if the whole fits.
    pub(crate) fn look_behind(&mut self, fits: impl Fn(&Shapes) -> bool) {
        let behind = |prefix: &str| -> Shapes {
            let weights = self.tensors.iter().filter(|(name, _)| !is_counter(name));
            let behind = weights.filter_map(|(name, view)| Some((name.strip_prefix(prefix)?, view.shape())));
            behind.collect()
        };
        if fits(&behind("")) {
            return;
        }
        let mut counts: HashMap<&str, usize> = HashMap::new();
        for (name, _) in &self.tensors {
            for (dot, _) in name.match_indices('.').take(DEEPEST + 1) {
                *counts.entry(&name[..=dot]).or_default() += 1;
            }
        }
        let many = counts.iter().filter(|(_, count)| **count >= FEWEST);
        let mut found = many.map(|(prefix, _)| *prefix).filter(|prefix| fits(&behind(prefix)));
        if let (Some(prefix), None) = (found.next(), found.next()) {
            let prefix = prefix.to_string();
            self.keep_behind(&prefix);
        }
    }

    fn keep_behind(&mut self, prefix: &str) {
        let is_behind = |name: &String| name.starts_with(prefix);
        let (kept, beside) = std::mem::take(&mut self.tensors)
            .into_iter()
            .partition(|(name, _)| is_behind(name));
        self.tensors = kept;
        let (kept, others) = std::mem::take(&mut self.others).into_iter().partition(is_behind);
        self.others = kept;
        self.left_out
            .extend(beside.into_iter().map(|(name, _): (String, View)| name));
        self.left_out.extend::<Vec<String>>(others);
        let names = self.tensors.iter_mut().map(|(name, _)| name).chain(&mut self.others);
        names.for_each(|name| _ = name.drain(..prefix.len()));
    }

    /// The epoch beside the state dict.
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
    within: Option<String>,
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
    let mut dicts = Vec::new();
    state_dicts(pickle, &pickle.root, "", &mut HashSet::new(), &mut dicts);
    let known = |path: &str| NESTED.contains(&path);
    let usual: Vec<_> = dicts.iter().filter(|(path, _)| known(path)).collect();
    let (within, dict) = match (&dicts[..], &usual[..]) {
        ([one], _) => one,
        (_, [one]) => *one,
        ([], _)
            if top.is_empty()
                || top
                    .iter()
                    .any(|(key, value)| is_named(key, &NESTED) && pickle.dict(value).is_some()) =>
        {
            return Err(Problem::Empty);
        }
        ([], _) => {
            let found = format!("a dict of {}", keys(top));
            return Err(Problem::NoStateDict { found });
        }
        (several, _) => {
            let keys: Vec<String> = several.iter().map(|(path, _)| format!("`{}`", shown(path))).collect();
            let found = format!("several: {}", keys.join(", "));
            return Err(Problem::NoStateDict { found });
        }
    };
    let within = Some(within.clone()).filter(|path| !path.is_empty());
    let (tensors, others) = entries(pickle, dict)?;
    Ok(Found {
        tensors,
        others,
        within,
        epoch,
    })
}

/// Dicts that hold tensors, by their keys from the top; what is below one is not looked at, nor an optimizer.
fn state_dicts<'a>(
    pickle: &'a Pickle,
    value: &Value,
    path: &str,
    seen: &mut HashSet<usize>,
    found: &mut Vec<(String, &'a [(Value, Value)])>,
) {
    let (Value::Object(place), Some(dict)) = (value, pickle.dict(value)) else {
        return;
    };
    if !seen.insert(*place) {
        return;
    }
    if dict.iter().any(|(_, value)| pickle.tensor(value).is_some()) {
        return found.push((path.into(), dict));
    }
    if path.matches('.').count() + 1 >= DEEPEST {
        return;
    }
    for (key, value) in dict {
        if let Value::Text(key) = key
            && !key.to_lowercase().contains("optim")
        {
            let below = if path.is_empty() {
                key.to_string()
            } else {
                format!("{path}.{key}")
            };
            state_dicts(pickle, value, &below, seen, found);
        }
    }
}

fn is_named(key: &Value, names: &[&str]) -> bool {
    matches!(key, Value::Text(text) if names.contains(&&**text))
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
    for (name, _) in &mut tensors {
        if name.contains(COMPILED) {
            *name = name
                .split('.')
                .filter(|part| *part != COMPILED)
                .collect::<Vec<_>>()
                .join(".");
        }
    }
    let shared = |tensors: &[(String, View)]| {
        let has_all = |wrapper: &&&str| tensors.iter().all(|(name, _)| name.starts_with(**wrapper));
        WRAPPERS.iter().find(has_all).copied()
    };
    while let Some(wrapper) = shared(&tensors) {
        let names = tensors.iter_mut().map(|(name, _)| name);
        names.for_each(|name| _ = name.drain(..wrapper.len()));
        others.iter_mut().for_each(|name| {
            if name.starts_with(wrapper) {
                name.drain(..wrapper.len());
            }
        });
    }
    let mut seen = HashSet::new();
    match tensors.iter().find(|(name, _)| !seen.insert(name.as_str())) {
        Some((name, _)) => Err(Problem::Twice(name.clone())),
        None => Ok((tensors, others)),
    }
}
