//! A checkpoint's tensors held against a model's list.

use std::collections::HashMap;
use std::path::PathBuf;

use realo_methods::Model;
use realo_methods::full;
use realo_nn::model::Architecture;
use realo_nn::model::compression_of;
use realo_nn::weights::{Tensor, Weights, WeightsError, expected, first_of, is_counter};

use crate::checkpoint::{Checkpoint, ReadError};
use crate::shown;

/// A model with the weights of a checkpoint.
pub struct Converted {
    /// The model.
    pub model: Model,
    /// Its weights.
    pub weights: Weights,
    /// The checkpoint in words: its file and, if it has one, its epoch.
    pub origin: String,
}

/// Why a checkpoint gives a model no weights.
#[derive(Debug, thiserror::Error)]
pub enum ConvertError {
    /// It cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// Its tensors are others.
    #[error(
        "{}: not the weights of model `{model}`; differences: {}\n{}\n{hint}",
        path.display(), problems.len(), listed(problems)
    )]
    Mismatch {
        /// The checkpoint.
        path: PathBuf,
        /// The model's name.
        model: String,
        /// Every tensor that is missing, extra, of another shape or type, or not finite.
        problems: Vec<String>,
        /// What to try.
        hint: String,
    },
}

/// Differences that are listed; a network of another kind has hundreds.
const LISTED: usize = 40;

fn listed(problems: &[String]) -> String {
    let lines: Vec<String> = first_of(problems, LISTED)
        .iter()
        .map(|line| format!("  {line}"))
        .collect();
    lines.join("\n")
}

pub(crate) type Shapes<'a> = HashMap<&'a str, &'a [usize]>;

/// V2X-Real's network of an architecture at full size, with the compressor that the checkpoint has; `None` if there is no
/// such architecture.
pub fn full_size(checkpoint: &Checkpoint, arch: &str) -> Option<Model> {
    Some(compressed(full::of_arch(arch)?, &shapes(checkpoint)))
}

/// V2X-Real's network at full size with these tensors, compressor included.
pub(crate) fn fitting(shapes: &Shapes) -> Option<Model> {
    let models = full::models().into_iter().map(|model| compressed(model, shapes));
    let mut fitting = models.filter(|model| fits(model, shapes));
    fitting.next()
}

/// Whether tensors have the names and shapes of a model's.
pub(crate) fn fits(model: &Model, shapes: &Shapes) -> bool {
    let expected = expected(model);
    expected.len() == shapes.len()
        && expected
            .iter()
            .all(|(key, shape)| shapes.get(&**key) == Some(&&**shape))
}

/// The tensors that take part in a network.
fn shapes(checkpoint: &Checkpoint) -> Shapes<'_> {
    let weights = checkpoint.tensors().filter(|(name, ..)| !is_counter(name));
    weights.map(|(name, shape, _)| (name, shape)).collect()
}

/// The model with the compressor that the tensors tell, if it can have that.
fn compressed(model: Model, shapes: &Shapes) -> Model {
    let mut with = model.clone();
    with.arch
        .set_compression(compression_of(|name| shapes.get(name).copied()));
    match with.validate() {
        Ok(()) => with,
        Err(_) => model,
    }
}

/// The weights of a model from a checkpoint: its names and shapes, all of them and no others but batch counters, as f32.
///
/// # Errors
/// A damaged file, and [`ConvertError::Mismatch`] with every difference.
pub fn convert(checkpoint: &mut Checkpoint, model: Model) -> Result<Converted, ConvertError> {
    checkpoint.look_behind(|shapes| fits(&model, shapes));
    let wanted: HashMap<String, Vec<usize>> = expected(&model).into_iter().collect();
    let (mut tensors, mut problems) = (HashMap::new(), Vec::new());
    let found: Vec<_> = checkpoint
        .tensors()
        .filter(|(name, ..)| !is_counter(name))
        .map(|(name, shape, dtype)| (name.to_string(), shape.to_vec(), dtype))
        .collect();
    for (name, shape, dtype) in found {
        let data = match wanted.get(&name) == Some(&shape) {
            true if dtype.is_float() => checkpoint.numbers(&name)?,
            true => {
                problems.push(format!("`{name}`: expected numbers with fractions, found {dtype}"));
                vec![0.0; shape.iter().product()]
            }
            // What does not fit is not read, however much it is.
            false => Vec::new(),
        };
        tensors.insert(shown(&name), Tensor { shape, data });
    }
    let others = checkpoint.others().iter();
    problems.extend(others.map(|name| format!("`{}` is no tensor", shown(name))));
    let weights = match Weights::new(&model, tensors) {
        Ok(weights) if problems.is_empty() => {
            let origin = origin(checkpoint);
            return Ok(Converted { model, weights, origin });
        }
        weights => weights,
    };
    if let Err(WeightsError::Mismatch { problems: more, .. }) = weights {
        problems.extend(more);
    }
    Err(ConvertError::Mismatch {
        path: checkpoint.path().into(),
        hint: hint(checkpoint, &model),
        model: model.name,
        problems,
    })
}

fn origin(checkpoint: &Checkpoint) -> String {
    let file = checkpoint.path().file_name().unwrap_or_default().to_string_lossy();
    match checkpoint.epoch() {
        Some(epoch) => format!("{} (epoch {epoch})", shown(&file)),
        None => shown(&file),
    }
}

fn hint(checkpoint: &Checkpoint, model: &Model) -> String {
    let shapes = shapes(checkpoint);
    if fits(model, &shapes) {
        return "names and shapes fit: save the weights again, in a type with fractions and without NaN".into();
    }
    let Some(fitting) = fitting(&shapes) else {
        return "none of V2X-Real's networks at full size has these tensors: --model FILE.toml describes one of another size, \
                and `realo checkpoint show` lists what is there"
            .into();
    };
    let arch = fitting.arch.to_string();
    let compression = fitting.arch.sharing().map_or(0, |sharing| sharing.compression);
    match compression {
        0 => format!("names and shapes are those of --arch {arch}"),
        _ => format!(
            "names and shapes are those of --arch {arch}, which finds the compressor by itself; a --model file says \
             `compression = {compression}`"
        ),
    }
}
