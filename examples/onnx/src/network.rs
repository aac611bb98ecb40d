//! An ONNX file whose inputs and outputs are bound by name and checked when it is loaded.

use std::collections::BTreeMap;
use std::error::Error;
use std::fmt;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use realo_operator::{KnownMap, Settings};
use rten::{
    DataType, Dimension, LoadError, LoadErrorKind, Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value,
    ValueOrView, ValueType,
};
use rten_tensor::Tensor;
use rten_tensor::prelude::*;
use serde::{Deserialize, Serialize};

/// How a pointer of Git LFS begins.
const POINTER: &[u8] = b"version https://git-lfs";

/// Settings of every stage that runs a file.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Onnx {
    /// The ONNX file.
    #[setting(filled)]
    pub model: PathBuf,
    /// Names of the file's inputs and outputs that are not those of this page, as `ours:theirs`, separated by commas.
    pub names: Vec<String>,
    /// Threads that compute; 0: one for each core.
    #[setting(range = 0..=256)]
    pub threads: usize,
}

/// An input or output that a role knows.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// Its name, unless the setting `names` says another.
    pub name: &'static str,
    /// Its dimensions in words; a number is fixed, 1 may be missing at the start.
    pub dimensions: &'static [&'static str],
    /// Whether it holds whole numbers (or truth values) in place of floats.
    pub whole: bool,
    /// Whether a file need not have it.
    pub optional: bool,
}

impl Wanted {
    /// One of floats that a file needs.
    pub const fn floats(name: &'static str, dimensions: &'static [&'static str]) -> Self {
        Wanted {
            name,
            dimensions,
            whole: false,
            optional: false,
        }
    }

    /// One of whole numbers that a file needs.
    pub const fn whole(name: &'static str, dimensions: &'static [&'static str]) -> Self {
        Wanted {
            whole: true,
            ..Wanted::floats(name, dimensions)
        }
    }

    /// The same, which a file need not have.
    pub const fn optional(self) -> Self {
        Wanted { optional: true, ..self }
    }
}

impl fmt::Display for Wanted {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let kind = if self.whole { "int64, int32 or bool" } else { "float32" };
        write!(f, "`{}` [{}] of {kind}", self.name, self.dimensions.join(", "))
    }
}

/// Why a file is not run.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// No file, or nothing of one.
    #[error("{}: {reason}", .path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What it is, and what to do.
        reason: String,
    },
    /// Inputs or outputs that are not the role's.
    #[error("{}: {side}s: {reason}; the file has {found}", .path.display())]
    Port {
        /// The file.
        path: PathBuf,
        /// `input` or `output`.
        side: &'static str,
        /// What was expected.
        reason: String,
        /// All that the file has on that side.
        found: String,
    },
    /// The setting `names` does not fit.
    #[error("setting `names`: {0}")]
    Names(String),
    /// A network that cannot compute what it is given.
    #[error("{}: it cannot compute: {reason}", .path.display())]
    Run {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// What it gave is not what its role gives.
    #[error("{}: output `{name}`: expected {expected}, found {found}", .path.display())]
    Output {
        /// The file.
        path: PathBuf,
        /// The output.
        name: &'static str,
        /// Its dimensions.
        expected: String,
        /// Those that came.
        found: String,
    },
}

/// A bound input or output.
#[derive(Clone, Debug)]
struct Bound {
    id: NodeId,
    /// `None`: the file does not say.
    shape: Option<Vec<Dimension>>,
    /// Whether it takes floats.
    floats: bool,
}

/// A file, ready to run.
pub struct Network {
    path: PathBuf,
    model: Model,
    inputs: BTreeMap<&'static str, Bound>,
    outputs: BTreeMap<&'static str, Bound>,
    pool: Arc<ThreadPool>,
    identity: String,
}

/// A network that was loaded to see what maps its stage takes, before the stage is built.
struct Kept {
    settings: Onnx,
    /// Names of what was wanted of it.
    wanted: Vec<&'static str>,
    network: Network,
}

/// Of the one stage of a program, whose file it need not load twice.
static LOADED: Mutex<Vec<Kept>> = Mutex::new(Vec::new());

fn wanted_names(inputs: &[Wanted], outputs: &[Wanted]) -> Vec<&'static str> {
    inputs.iter().chain(outputs).map(|wanted| wanted.name).collect()
}

/// Why the runtime does not take a file, in a line.
fn unread(error: &LoadError) -> String {
    let (node, cause) = match (error.node(), error.source()) {
        (Some(node), Some(cause)) => (format!("node `{node}`: "), cause.to_string()),
        (None, Some(cause)) => (String::new(), cause.to_string()),
        (_, None) => (String::new(), error.to_string()),
    };
    match error.kind() {
        LoadErrorKind::OperatorInvalid => format!(
            "expected operators of ONNX that the runtime rten computes, found {node}{cause}; export with another `opset_version`, or \
             write that layer by other operators"
        ),
        _ => format!("cannot be read as ONNX: {node}{cause}; export the network anew by torch.onnx.export"),
    }
}

impl Network {
    /// Loads a file, and binds what a role reads and gives.
    ///
    /// # Errors
    /// A file that is missing or none of ONNX; inputs and outputs with other names, types or shapes.
    pub fn load(settings: &Onnx, inputs: &[Wanted], outputs: &[Wanted]) -> Result<Self, NetworkError> {
        let wanted = wanted_names(inputs, outputs);
        let is_it = |kept: &Kept| kept.settings == *settings && kept.wanted == wanted;
        let mut loaded = LOADED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if let Some(place) = loaded.iter().position(is_it) {
            return Ok(loaded.swap_remove(place).network);
        }
        drop(loaded);
        Self::read(settings, inputs, outputs)
    }

    /// What `of` finds in a file, nothing where it cannot be loaded. The network is kept: [`Network::load`] gives it next.
    pub fn look<T: Default>(
        settings: &Onnx,
        inputs: &[Wanted],
        outputs: &[Wanted],
        of: impl FnOnce(&Network) -> T,
    ) -> T {
        // Why it cannot be loaded is said where the stage is built.
        let Ok(network) = Self::load(settings, inputs, outputs) else {
            return T::default();
        };
        let found = of(&network);
        let kept = Kept {
            settings: settings.clone(),
            wanted: wanted_names(inputs, outputs),
            network,
        };
        LOADED
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .push(kept);
        found
    }

    fn read(settings: &Onnx, inputs: &[Wanted], outputs: &[Wanted]) -> Result<Self, NetworkError> {
        let path = settings.model.clone();
        let bytes = read(&path)?;
        let identity = crate::identity::identity(&path, &bytes)?;
        let mut options = ModelOptions::with_all_ops();
        options.prepack_weights(true);
        let loaded = match crate::whole::others(&bytes).is_empty() {
            true => options.load(bytes).or_else(|error| match error.kind() {
                // By its first bytes it may be something else; its name says what it is.
                LoadErrorKind::UnknownFileType | LoadErrorKind::FormatNotEnabled => options.load_file(&path),
                _ => Err(error),
            }),
            // The loader finds by the path what a file keeps in a second one.
            false => options.load_file(&path),
        };
        let model = loaded.map_err(|error| NetworkError::File {
            path: path.clone(),
            reason: unread(&error),
        })?;
        let names = Names::of(&settings.names, inputs.iter().chain(outputs))?;
        let threads = match settings.threads {
            0 => std::thread::available_parallelism().map_or(1, |count| count.get()),
            threads => threads,
        };
        Ok(Network {
            inputs: bind(&path, &model, "input", model.input_ids(), inputs, &names)?,
            outputs: bind(&path, &model, "output", model.output_ids(), outputs, &names)?,
            pool: Arc::new(ThreadPool::with_num_threads(threads)),
            identity,
            model,
            path,
        })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// A name that changes with the bytes of the file, and of files beside it that hold its weights.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// Whether the file has an input.
    pub fn takes(&self, input: &str) -> bool {
        self.inputs.contains_key(input)
    }

    /// A dimension of an input, where the file fixes it; counted from the last one.
    pub fn fixed_input(&self, input: &str, from_last: usize) -> Option<usize> {
        fixed(self.inputs.get(input)?, from_last)
    }

    /// What the file says of an input's map: rows, columns and channels where it fixes them.
    pub fn known_input(&self, input: &str) -> KnownMap {
        let size = [1, 0, 2].map(|from_last| self.fixed_input(input, from_last));
        self.known(size, "input", input)
    }

    /// What the file says of an output's map, as [`Network::known_input`].
    pub fn known_output(&self, output: &str) -> KnownMap {
        let size = [1, 0, 2].map(|from_last| self.fixed_output(output, from_last));
        self.known(size, "output", output)
    }

    fn known(&self, size: [Option<usize>; 3], side: &str, name: &str) -> KnownMap {
        KnownMap {
            size: size.map(|count| count.and_then(|count| u32::try_from(count).ok())),
            by: format!("{}, {side} `{name}`", self.path.display()),
        }
    }

    /// A dimension of an output, where the file fixes it; counted from the last one.
    pub fn fixed_output(&self, output: &str, from_last: usize) -> Option<usize> {
        fixed(self.outputs.get(output)?, from_last)
    }

    /// Refuses an input's size of the file's that cannot be.
    pub fn input_error(&self, reason: String) -> NetworkError {
        self.port_error("input", self.model.input_ids(), reason)
    }

    /// As [`Network::input_error`], of an output.
    pub fn output_error(&self, reason: String) -> NetworkError {
        self.port_error("output", self.model.output_ids(), reason)
    }

    fn port_error(&self, side: &'static str, ids: &[NodeId], reason: String) -> NetworkError {
        NetworkError::Port {
            path: self.path.clone(),
            side,
            reason,
            found: listed(&self.model, ids),
        }
    }

    /// Computes the outputs of inputs, each a tensor of floats.
    ///
    /// # Errors
    /// What the runtime says.
    pub fn run<const N: usize>(
        &self,
        inputs: Vec<(&'static str, Input)>,
        outputs: [&'static str; N],
    ) -> Result<[Tensor<f32>; N], NetworkError> {
        let failed = |reason: String| NetworkError::Run {
            path: self.path.clone(),
            reason,
        };
        let given = inputs.into_iter().filter_map(|(name, input)| {
            let bound = self.inputs.get(name)?;
            Some((bound.id, ValueOrView::from(input.value(bound))))
        });
        let wanted = outputs.map(|name| self.outputs[name].id);
        let mut options = RunOptions::default();
        options.thread_pool = Some(self.pool.clone());
        let made = self.model.run(given.collect(), &wanted, Some(options));
        let made = made.map_err(|error| failed(error.to_string()))?;
        let tensors = made.into_iter().zip(outputs).map(|(value, name)| {
            let found = value.dtype();
            let floats = Tensor::<f32>::try_from(value);
            floats.map_err(|_| failed(format!("output `{name}`: expected float32, found {found}")))
        });
        let tensors: Vec<Tensor<f32>> = tensors.collect::<Result<_, _>>()?;
        Ok(tensors
            .try_into()
            .unwrap_or_else(|_| unreachable!("one for each output")))
    }

    /// The numbers of an output, and its dimensions without those of 1 before the last `rank`.
    ///
    /// # Errors
    /// An output of fewer dimensions, or with another number than 1 before the last ones.
    pub fn plain<const RANK: usize>(
        &self,
        wanted: &Wanted,
        tensor: Tensor<f32>,
    ) -> Result<([usize; RANK], Vec<f32>), NetworkError> {
        let shape = tensor.shape().to_vec();
        let split = shape.len().checked_sub(RANK);
        let last: Option<[usize; RANK]> = split
            .filter(|split| shape[..*split].iter().all(|n| *n == 1))
            .and_then(|split| shape[split..].try_into().ok());
        let last = last.ok_or_else(|| NetworkError::Output {
            path: self.path.clone(),
            name: wanted.name,
            expected: format!("[{}]", wanted.dimensions.join(", ")),
            found: format!("{shape:?}"),
        })?;
        Ok((last, tensor.into_data()))
    }
}

/// What a network is given.
pub enum Input {
    /// Floats.
    Floats(Tensor<f32>),
    /// Whole numbers.
    Whole(Tensor<i32>),
}

impl Input {
    /// Floats with these dimensions.
    pub fn floats(dimensions: &[usize], numbers: Vec<f32>) -> Self {
        Input::Floats(Tensor::from_data(dimensions, numbers))
    }

    /// Whole numbers with these dimensions.
    pub fn whole(dimensions: &[usize], numbers: Vec<i32>) -> Self {
        Input::Whole(Tensor::from_data(dimensions, numbers))
    }

    /// In the type that the file asks for.
    fn value(self, bound: &Bound) -> Value {
        match (self, bound.floats) {
            (Input::Floats(numbers), _) => numbers.into(),
            (Input::Whole(numbers), true) => numbers.map(|number| *number as f32).into(),
            (Input::Whole(numbers), false) => numbers.into(),
        }
    }
}

/// The bytes of a file that may be one of ONNX.
fn read(path: &Path) -> Result<Vec<u8>, NetworkError> {
    let refused = |reason: String| NetworkError::File {
        path: path.into(),
        reason,
    };
    if path.is_dir() {
        return Err(refused("expected an ONNX file, found a folder".into()));
    }
    let mut bytes = Vec::new();
    let opened = std::fs::File::open(path).and_then(|mut file| file.read_to_end(&mut bytes));
    opened.map_err(|error| {
        refused(format!(
            "expected an ONNX file, found one that cannot be read: {error}; correct `model`, which is relative to the graph's folder"
        ))
    })?;
    if bytes.is_empty() {
        let reason = "expected an ONNX file, found an empty file; export the network anew by torch.onnx.export, or copy the file again";
        return Err(refused(reason.into()));
    }
    if bytes.starts_with(POINTER) {
        let reason = "expected an ONNX file, found a pointer of Git LFS: `git lfs pull` fetches the file itself";
        return Err(refused(reason.into()));
    }
    if bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"\x80") {
        let reason = "expected an ONNX file, found a checkpoint of PyTorch: export the network by torch.onnx.export";
        return Err(refused(reason.into()));
    }
    if !path
        .extension()
        .is_some_and(|ending| ending.eq_ignore_ascii_case("onnx"))
    {
        return Err(refused("expected a file that ends in .onnx".into()));
    }
    match crate::whole::missing(&bytes) {
        Some(missing) => Err(refused(format!("cannot be read as ONNX: {missing}"))),
        None => Ok(bytes),
    }
}

/// Names in the file by ours.
struct Names(BTreeMap<String, String>);

impl Names {
    fn of<'a>(given: &[String], wanted: impl Iterator<Item = &'a Wanted>) -> Result<Self, NetworkError> {
        let known: Vec<&str> = wanted.map(|wanted| wanted.name).collect();
        let mut names = BTreeMap::new();
        for pair in given {
            let Some((ours, theirs)) = pair.split_once(':').filter(|(_, theirs)| !theirs.is_empty()) else {
                return Err(NetworkError::Names(format!("expected `ours:theirs`, found `{pair}`")));
            };
            if !known.contains(&ours) {
                let known = known.join(", ");
                return Err(NetworkError::Names(format!(
                    "expected one of {known} before the colon, found `{ours}`"
                )));
            }
            if names.insert(ours.to_string(), theirs.to_string()).is_some() {
                return Err(NetworkError::Names(format!("`{ours}` is given twice: keep one")));
            }
        }
        Ok(Names(names))
    }

    fn theirs<'a>(&'a self, ours: &'a str) -> &'a str {
        self.0.get(ours).map_or(ours, String::as_str)
    }
}

fn bind(
    path: &Path,
    model: &Model,
    side: &'static str,
    ids: &[NodeId],
    wanted: &[Wanted],
    names: &Names,
) -> Result<BTreeMap<&'static str, Bound>, NetworkError> {
    let refused = |reason: String| NetworkError::Port {
        path: path.into(),
        side,
        reason,
        found: listed(model, ids),
    };
    let mut bound = BTreeMap::new();
    for one in wanted {
        let theirs = names.theirs(one.name);
        let id = ids.iter().find(|id| name_of(model, **id) == theirs);
        let Some(id) = id else {
            if one.optional && theirs == one.name {
                continue;
            }
            let renamed = if theirs == one.name {
                String::new()
            } else {
                format!(" under the name `{theirs}`")
            };
            return Err(refused(format!(
                "expected {one}{renamed}; the setting `names={}:THEIRS` says another name",
                one.name
            )));
        };
        bound.insert(one.name, checked(model, *id, one).map_err(&refused)?);
    }
    let is_bound = |id: &NodeId| bound.values().any(|bound| bound.id == *id);
    if side == "input"
        && let Some(other) = ids.iter().find(|id| !is_bound(id))
    {
        let known: Vec<String> = wanted.iter().map(Wanted::to_string).collect();
        return Err(refused(format!(
            "expected no other than {}, found `{}`; the setting `names=OURS:THEIRS` says which is which",
            known.join(", "),
            name_of(model, *other)
        )));
    }
    Ok(bound)
}

/// An input or output whose type and shape are as wanted, as far as the file says them.
fn checked(model: &Model, id: NodeId, wanted: &Wanted) -> Result<Bound, String> {
    let info = model.node_info(id);
    let kind = info.as_ref().and_then(|info| info.dtype());
    let shape = info.and_then(|info| info.shape());
    let floats = match kind {
        None => !wanted.whole,
        Some(ValueType::Tensor(DataType::Float)) => true,
        Some(ValueType::Tensor(DataType::Int32)) if wanted.whole => false,
        Some(_) => return Err(format!("expected {wanted}, found it of another type")),
    };
    if let Some(shape) = &shape {
        let extra = shape.len().checked_sub(wanted.dimensions.len());
        let fits = extra.is_some_and(|extra| {
            let is_one = |dimension: &Dimension| !matches!(dimension, Dimension::Fixed(n) if *n != 1);
            let pairs = shape[extra..].iter().zip(wanted.dimensions);
            let mut pairs = pairs.filter_map(|(found, wanted)| Some((found, wanted.parse::<usize>().ok()?)));
            let are_same = pairs.all(|(found, n)| !matches!(found, Dimension::Fixed(found) if *found != n));
            extra <= 1 && shape[..extra].iter().all(is_one) && are_same
        });
        if !fits {
            return Err(format!("expected {wanted}, found it as {}", shape_in_words(shape)));
        }
    }
    Ok(Bound { id, shape, floats })
}

fn fixed(bound: &Bound, from_last: usize) -> Option<usize> {
    let shape = bound.shape.as_ref()?;
    match shape.get(shape.len().checked_sub(from_last + 1)?)? {
        Dimension::Fixed(n) => Some(*n),
        Dimension::Symbolic(_) => None,
    }
}

fn name_of(model: &Model, id: NodeId) -> String {
    let name = model.node_info(id).and_then(|info| info.name().map(str::to_string));
    name.unwrap_or_default()
}

/// All inputs or outputs, for an error.
fn listed(model: &Model, ids: &[NodeId]) -> String {
    let words = ids.iter().map(|id| {
        let info = model.node_info(*id);
        let shape = info.as_ref().and_then(|info| info.shape());
        let kind = info.and_then(|info| info.dtype());
        format!(
            "`{}`{}{}",
            name_of(model, *id),
            shape
                .map(|shape| format!(" {}", shape_in_words(&shape)))
                .unwrap_or_default(),
            kind.map(|kind| format!(" of {}", kind_in_words(kind)))
                .unwrap_or_default(),
        )
    });
    match words.collect::<Vec<String>>() {
        none if none.is_empty() => "none".into(),
        words => words.join(", "),
    }
}

/// A type as the ONNX file calls it; the runtime reads int64 and bool as int32, and float64 as float32.
fn kind_in_words(kind: ValueType) -> String {
    match kind {
        ValueType::Tensor(DataType::Float) => "float32".into(),
        ValueType::Tensor(DataType::Int32) => "int32 or int64".into(),
        other => other.to_string(),
    }
}

fn shape_in_words(shape: &[Dimension]) -> String {
    let words = shape.iter().map(|dimension| match dimension {
        Dimension::Fixed(n) => n.to_string(),
        Dimension::Symbolic(name) => name.clone(),
    });
    format!("[{}]", words.collect::<Vec<String>>().join(", "))
}
