//! A network's weights: a safetensors file with the keys and shapes of V2X-Real's state dict.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};

use crate::bounded::{ReadError, read_bounded};
use crate::layers::Layers;
use crate::model::{Architecture, Model, ModelFile};
use crate::tensors::{Role, TensorSpec, norm_key};

/// Added to the variance by every batch norm.
pub const BATCH_NORM_EPS: f32 = 1e-3;

/// A file of weights has at most so many bytes; the largest network of the reference has 61 MB.
const MOST_BYTES: u64 = 1 << 31;

/// Keys and shapes of a model's tensors, in the order of the state dict. Convolutions are `[out, in, k, k]`, transposed
/// ones `[in, out, k, k]`, linear layers `[out, in]`.
pub fn expected<A: Architecture>(model: &Model<A>) -> Vec<(String, Vec<usize>)> {
    let layers = Layers::of(model);
    layers.tensors().map(|tensor| (tensor.key, tensor.shape)).collect()
}

/// The tensors of one model: every key that [`expected`] lists, with its shape, all numbers finite.
#[derive(Clone, Debug)]
pub struct Weights {
    tensors: HashMap<String, Vec<f32>>,
}

/// A tensor in row-major order.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Size of each dimension.
    pub shape: Vec<usize>,
    /// Its numbers.
    pub data: Vec<f32>,
}

/// Why there are no weights.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file cannot be read.
    #[error(
        "{}: {error}; weights are in the folder of their model file, under the model's `name` or as its `weights` and `encoder` say: \
         `realo-lab checkpoint convert` makes them of a PyTorch checkpoint, `realo-lab train` trains detectors and fusions",
        path.display()
    )]
    Read {
        /// The file of weights.
        path: PathBuf,
        /// What failed.
        error: ReadError,
    },
    /// It is not a safetensors file.
    #[error("{}: expected a safetensors file: {error}; take the weights that belong to the model file, or train it anew", path.display())]
    Syntax {
        /// The file of weights.
        path: PathBuf,
        /// What is wrong with it.
        error: safetensors::SafeTensorError,
    },
    /// The file has other bytes than the model file says.
    #[error(
        "{}: expected SHA-256 {expected}, as the model file says under `sha256`, found {found}: the file is damaged, or belongs to \
         another model file; take the weights that belong to this one, or remove that line if the weights are yours",
        path.display()
    )]
    Checksum {
        /// The file of weights.
        path: PathBuf,
        /// What the model file says.
        expected: String,
        /// What the file has.
        found: String,
    },
    /// The weights of a model's files.
    #[error("{}: {error}", joined(paths))]
    File {
        /// The files of weights.
        paths: Vec<PathBuf>,
        /// What is wrong with them.
        error: Box<WeightsError>,
    },
    /// The tensors are not those of the model.
    #[error(
        "weights do not fit model `{model}`: {}; take the weights that belong to this model file, or train it anew",
        first_of(problems, NAMED).join("; ")
    )]
    Mismatch {
        /// The model's name.
        model: String,
        /// Every tensor that is missing, extra, of another shape or type, or not finite.
        problems: Vec<String>,
    },
}

/// SHA-256 of bytes, in hexadecimal digits.
pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn check_sum<A>(path: &Path, bytes: &[u8], model: &Model<A>) -> Result<(), WeightsError> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let Some(expected) = model.sha256.get(&*stem) else {
        return Ok(());
    };
    let found = sha256(bytes);
    match found == *expected {
        true => Ok(()),
        false => Err(WeightsError::Checksum {
            path: path.into(),
            expected: expected.clone(),
            found,
        }),
    }
}

impl Weights {
    /// Reads the weights of a model from its files, in the order of [`Model::weights_beside`]: of all but the first the tensors of the
    /// compressor and the encoder that are lacking.
    ///
    /// # Errors
    /// [`WeightsError::Read`], [`WeightsError::Syntax`], and [`WeightsError::File`] with that of [`Weights::new`], where a
    /// tensor that is not F32 is a problem too.
    pub fn read<A: Architecture>(paths: &[impl AsRef<Path>], model: &Model<A>) -> Result<Weights, WeightsError> {
        Weights::parse(&read_files(paths)?, model)
    }

    /// Reads the weights of a model from the bytes of its files.
    ///
    /// # Errors
    /// As [`Weights::read`], but for reading; [`WeightsError::Checksum`].
    pub fn parse<A: Architecture>(files: &[ModelFile], model: &Model<A>) -> Result<Weights, WeightsError> {
        let (mut tensors, mut problems) = (HashMap::new(), Vec::new());
        let layers = Layers::of(model);
        let compressor = model.compressor.as_ref().map(|_| keys(layers.compressor()));
        let of_others: Vec<HashSet<String>> = compressor.into_iter().chain([keys(layers.encoder())]).collect();
        for (index, (path, bytes)) in files.iter().enumerate() {
            check_sum(path, bytes, model)?;
            let file = SafeTensors::deserialize(bytes).map_err(|error| WeightsError::Syntax {
                path: path.clone(),
                error,
            })?;
            let of_file = |key: &str| match index.checked_sub(1) {
                None => true,
                Some(other) => of_others.get(other).is_some_and(|keys| keys.contains(key)),
            };
            add_tensors(&file, of_file, &mut tensors, &mut problems);
        }
        Weights::checked(&layers, &model.name, tensors, problems).map_err(|error| WeightsError::File {
            paths: files.iter().map(|(path, _)| path.clone()).collect(),
            error: Box::new(error),
        })
    }

    /// The weights of a model from tensors by key; `num_batches_tracked` of a batch norm is ignored.
    ///
    /// # Errors
    /// [`WeightsError::Mismatch`] with all that differs from what [`expected`] lists.
    pub fn new<A: Architecture>(model: &Model<A>, tensors: HashMap<String, Tensor>) -> Result<Weights, WeightsError> {
        Weights::of_layers(&Layers::of(model), &model.name, tensors)
    }

    /// As [`Weights::new`], of layers by themselves; `name` is for errors.
    ///
    /// # Errors
    /// As [`Weights::new`].
    pub fn of_layers(layers: &Layers, name: &str, tensors: HashMap<String, Tensor>) -> Result<Weights, WeightsError> {
        let tensors = tensors
            .into_iter()
            .map(|(key, tensor)| (key, (tensor.shape, Some(tensor.data))));
        Weights::checked(layers, name, tensors.collect(), Vec::new())
    }

    /// Numbers that are `None` are of another type than F32.
    fn checked(
        layers: &Layers,
        name: &str,
        mut tensors: Found,
        mut problems: Vec<String>,
    ) -> Result<Weights, WeightsError> {
        tensors.retain(|key, _| !is_counter(key));
        let mut fitting = HashMap::new();
        for spec in layers.tensors() {
            let Some((shape, data)) = tensors.remove(&spec.key) else {
                problems.push(format!("`{}` {:?} is missing", spec.key, spec.shape));
                continue;
            };
            problems.extend(problem(&spec, &shape, data.as_deref()));
            fitting.insert(spec.key, data.unwrap_or_default());
        }
        let mut extra: Vec<String> = tensors.into_keys().collect();
        extra.sort();
        problems.extend(extra.iter().map(|key| format!("`{key}` is not part of the model")));
        if problems.is_empty() {
            return Ok(Weights { tensors: fitting });
        }
        Err(WeightsError::Mismatch {
            model: name.into(),
            problems,
        })
    }

    /// The tensors of a part of a network that is known to have them; nobody checks their numbers.
    pub fn of_part(tensors: HashMap<String, Vec<f32>>) -> Weights {
        Weights { tensors }
    }

    /// The numbers of a tensor, in the order of its shape.
    ///
    /// # Panics
    /// If the model has no such tensor.
    pub fn tensor(&self, key: &str) -> &[f32] {
        self.find(key)
            .unwrap_or_else(|| panic!("the model has no tensor `{key}`"))
    }

    /// The numbers of a tensor, if the model has it.
    pub fn find(&self, key: &str) -> Option<&[f32]> {
        self.tensors.get(key).map(Vec::as_slice)
    }

    /// A batch norm with its running statistics as factor and summand of each channel.
    ///
    /// # Panics
    /// If the model has no batch norm of this key.
    pub fn batch_norm(&self, key: &str) -> Vec<[f64; 2]> {
        let part = |role: Role| self.tensor(&norm_key(key, role)).iter().map(|value| f64::from(*value));
        let affine = part(Role::NormWeight).zip(part(Role::NormBias));
        let statistics = part(Role::RunningMean).zip(part(Role::RunningVariance));
        affine
            .zip(statistics)
            .map(|((weight, bias), (mean, variance))| {
                let factor = weight / (variance + f64::from(BATCH_NORM_EPS)).sqrt();
                [factor, bias - mean * factor]
            })
            .collect()
    }
}

fn keys(tensors: impl Iterator<Item = TensorSpec>) -> HashSet<String> {
    tensors.map(|tensor| tensor.key).collect()
}

/// Shapes and numbers by key, `None` in place of numbers of another type than F32.
type Found = HashMap<String, (Vec<usize>, Option<Vec<f32>>)>;

/// Adds the tensors of a file that are wanted and not there yet.
fn add_tensors(file: &SafeTensors, wanted: impl Fn(&str) -> bool, tensors: &mut Found, problems: &mut Vec<String>) {
    let is_new = |key: &str| wanted(key) && !is_counter(key) && !tensors.contains_key(key);
    // In an order that is the same every time, for the problems.
    let mut views: Vec<_> = file.iter().filter(|(key, _)| is_new(key)).collect();
    views.sort_by_key(|(key, _)| *key);
    for (key, view) in views {
        let data = match view.dtype() {
            Dtype::F32 => {
                let numbers = view.data().as_chunks::<4>().0.iter().copied();
                Some(numbers.map(f32::from_le_bytes).collect())
            }
            // Only its type is reported.
            other => {
                problems.push(format!("`{key}`: expected F32, found {other:?}"));
                None
            }
        };
        tensors.insert(key.to_string(), (view.shape().to_vec(), data));
    }
}

/// Files of weights with their bytes.
///
/// # Errors
/// [`WeightsError::Read`].
pub fn read_files(paths: &[impl AsRef<Path>]) -> Result<Vec<ModelFile>, WeightsError> {
    let read = |path: &Path| match read_bounded(path, MOST_BYTES) {
        Ok(bytes) => Ok((path.to_path_buf(), bytes)),
        Err(error) => Err(WeightsError::Read {
            path: path.into(),
            error,
        }),
    };
    paths.iter().map(|path| read(path.as_ref())).collect()
}

/// Differences that [`WeightsError::Mismatch`] names; the weights of another network have hundreds.
const NAMED: usize = 8;

/// The first lines, at most `most`, and how many more there are.
pub fn first_of(lines: &[String], most: usize) -> Vec<String> {
    let more = lines.len().saturating_sub(most);
    let rest = (more > 0).then(|| format!("… and {more} more"));
    lines.iter().take(most).cloned().chain(rest).collect()
}

fn joined(paths: &[PathBuf]) -> String {
    let paths: Vec<String> = paths.iter().map(|path| path.display().to_string()).collect();
    paths.join(" with ")
}

/// What keeps a tensor from being the one that a layer expects; its numbers are `None` if they are of another type.
fn problem(spec: &TensorSpec, shape: &[usize], data: Option<&[f32]>) -> Option<String> {
    let (key, numbers) = (&spec.key, spec.count());
    if shape != spec.shape {
        return Some(format!("`{key}`: expected shape {:?}, found {shape:?}", spec.shape));
    }
    let data = data?;
    if data.len() != numbers {
        return Some(format!("`{key}`: expected {numbers} numbers, found {}", data.len()));
    }
    let bad = data.iter().filter(|value| !value.is_finite()).count();
    if bad > 0 {
        return Some(format!("`{key}`: {bad} of {numbers} numbers are not finite"));
    }
    let negative = spec.role == Role::RunningVariance && data.iter().any(|value| *value < 0.0);
    negative.then(|| format!("`{key}`: a variance is negative"))
}

/// Whether a tensor of a state dict counts the batches that a norm has seen, which inference has no use for.
pub fn is_counter(key: &str) -> bool {
    key.ends_with(".num_batches_tracked")
}

#[cfg(test)]
mod tests {
    use safetensors::tensor::TensorView;

    use super::*;
    use crate::testing::{lite, random_tensors};

    fn problems(tensors: HashMap<String, Tensor>) -> Vec<String> {
        match Weights::new(&lite(), tensors) {
            Err(WeightsError::Mismatch { problems, .. }) => problems,
            other => panic!("expected a mismatch, found {other:?}"),
        }
    }

    #[test]
    fn a_flipped_bit_is_found_by_the_sum_of_the_model_file() {
        let model = lite();
        let tensors = expected(&model).into_iter().map(|(key, shape)| {
            let bytes = vec![0; 4 * shape.iter().product::<usize>()];
            (key, shape, bytes)
        });
        let tensors: Vec<_> = tensors.collect();
        let views = tensors.iter().map(|(key, shape, bytes)| {
            let view = TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap();
            (key.as_str(), view)
        });
        let mut bytes = safetensors::serialize(views, None).unwrap();
        let summed = Model {
            sha256: [("lite".into(), sha256(&bytes))].into(),
            ..model
        };
        let parse = |bytes: &[u8]| Weights::parse(&[("models/lite.safetensors".into(), bytes.to_vec())], &summed);
        parse(&bytes).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        let said = parse(&bytes).unwrap_err().to_string();
        assert!(
            said.contains("models/lite.safetensors: expected SHA-256") && said.contains("damaged"),
            "{said}"
        );
        let other = [("models/other.safetensors".into(), bytes)];
        Weights::parse(&other, &summed).expect("weights that the model file does not name");
    }

    #[test]
    fn lists_everything_that_differs_from_the_model() {
        let mut tensors = random_tensors(&lite(), 1);
        tensors.remove("cls_head.bias");
        tensors.insert("cls_head.gain".into(), tensors["reg_head.bias"].clone());
        tensors.get_mut("backbone.blocks.1.4.weight").unwrap().shape = vec![64, 64, 9];
        tensors.get_mut("reg_head.weight").unwrap().data[7] = f32::NAN;
        tensors.get_mut("backbone.deblocks.2.1.running_var").unwrap().data[0] = -1.0;
        tensors.get_mut("reg_head.bias").unwrap().data.pop();
        let expected = [
            "`backbone.blocks.1.4.weight`: expected shape [64, 64, 3, 3], found [64, 64, 9]",
            "`backbone.deblocks.2.1.running_var`: a variance is negative",
            "`cls_head.bias` [18] is missing",
            "`reg_head.weight`: 1 of 2688 numbers are not finite",
            "`reg_head.bias`: expected 42 numbers, found 41",
            "`cls_head.gain` is not part of the model",
        ];
        assert_eq!(problems(tensors), expected);
    }

    #[test]
    fn names_the_first_of_many_differences() {
        let error = Weights::new(&lite(), HashMap::new()).unwrap_err().to_string();
        assert_eq!(error.matches(" is missing; ").count(), NAMED, "{error}");
        let more = expected(&lite()).len() - NAMED;
        assert!(error.contains(&format!("; … and {more} more; take ")), "{error}");
    }

    #[test]
    fn the_weights_of_another_model_do_not_fit() {
        let mut wide = lite();
        wide.pillars.channels = 64;
        let found = problems(random_tensors(&wide, 1));
        assert_eq!(found.len(), 6, "{found:?}");
        assert!(found.iter().all(|line| line.contains("expected shape")), "{found:?}");
    }

    /// The bytes of a file of tensors, all numbers of which are one.
    fn file(tensors: impl Iterator<Item = TensorSpec>, dtype: Dtype, number: f32) -> Vec<u8> {
        let tensors: Vec<(TensorSpec, Vec<u8>)> = tensors
            .map(|spec| {
                let bytes = (0..spec.count()).flat_map(|_| number.to_le_bytes()).collect();
                (spec, bytes)
            })
            .collect();
        let views = tensors.iter().map(|(spec, bytes)| {
            let view = TensorView::new(dtype, spec.shape.clone(), bytes).unwrap();
            (spec.key.clone(), view)
        });
        safetensors::serialize(views, None).unwrap()
    }

    #[test]
    fn another_file_has_the_encoder_and_nothing_else() {
        let (model, layers) = (lite(), Layers::of(&lite()));
        let heads = || layers.tensors().filter(|tensor| tensor.key.contains("_head"));
        let own = |dtype| ("own.safetensors".into(), file(heads(), dtype, 1.0));
        let other = |bytes| ("other.safetensors".into(), bytes);
        let whole = file(layers.tensors(), Dtype::F32, 2.0);
        let weights = Weights::parse(&[own(Dtype::F32), other(whole.clone())], &model).unwrap();
        for tensor in layers.tensors() {
            let expected = if tensor.key.contains("_head") { 1.0 } else { 2.0 };
            assert!(
                weights.tensor(&tensor.key).iter().all(|number| *number == expected),
                "{}",
                tensor.key
            );
        }
        let error = |files: &[ModelFile]| Weights::parse(files, &model).unwrap_err().to_string();
        let without_heads = file(layers.encoder(), Dtype::F32, 1.0);
        let lacking = error(&[("own.safetensors".into(), without_heads), other(whole.clone())]);
        assert!(
            lacking.starts_with("own.safetensors with other.safetensors: "),
            "{lacking}"
        );
        assert!(
            lacking.contains("`cls_head.weight`") && lacking.contains("is missing"),
            "{lacking}"
        );
        let hidden = error(&[own(Dtype::I32), other(whole)]);
        assert!(hidden.contains("`cls_head.bias`: expected F32, found I32"), "{hidden}");
        let syntax = error(&[own(Dtype::F32), other(b"no tensors".to_vec())]);
        assert!(
            syntax.starts_with("other.safetensors: expected a safetensors file"),
            "{syntax}"
        );
    }

    #[test]
    fn reads_files_strictly() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lite.safetensors");
        let error = |path: &Path| Weights::read(&[path], &lite()).unwrap_err().to_string();
        assert!(error(&path).contains("lite.safetensors"));
        std::fs::write(&path, b"no tensors").unwrap();
        assert!(error(&path).contains("lite.safetensors"));

        let tensors = random_tensors(&lite(), 3);
        let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = tensors
            .iter()
            .map(|(key, tensor)| {
                let bytes = tensor.data.iter().flat_map(|value| value.to_le_bytes()).collect();
                (key.clone(), tensor.shape.clone(), bytes)
            })
            .collect();
        let write = |counter_key: &str, kind: Dtype| {
            let counter = 5i64.to_le_bytes();
            let views = bytes.iter().map(|(key, shape, data)| {
                let kind = if key == "cls_head.bias" { kind } else { Dtype::F32 };
                (key.as_str(), TensorView::new(kind, shape.clone(), data).unwrap())
            });
            let counter = (counter_key, TensorView::new(Dtype::I64, vec![], &counter).unwrap());
            safetensors::serialize_to_file(views.chain([counter]), None, &path).unwrap();
        };
        write("backbone.blocks.0.2.num_batches_tracked", Dtype::F32);
        let weights = Weights::read(&[&path], &lite()).unwrap();
        assert_eq!(weights.tensor("cls_head.bias"), tensors["cls_head.bias"].data);
        write("backbone.blocks.0.2.other", Dtype::I32);
        let error = error(&path);
        assert!(error.contains("`cls_head.bias`: expected F32, found I32"), "{error}");
        assert!(error.contains("`backbone.blocks.0.2.other` is not part"), "{error}");
    }

    #[test]
    fn batch_norm_becomes_factor_and_summand() {
        let mut tensors = random_tensors(&lite(), 4);
        for (part, value) in [
            ("weight", 3.0),
            ("bias", 0.5),
            ("running_mean", 2.0),
            ("running_var", 0.249),
        ] {
            let tensor = tensors.get_mut(&format!("backbone.deblocks.0.1.{part}")).unwrap();
            tensor.data.fill(value);
        }
        let weights = Weights::new(&lite(), tensors).unwrap();
        for [factor, summand] in weights.batch_norm("backbone.deblocks.0.1") {
            assert!(
                (factor - 6.0).abs() < 1e-6 && (summand + 11.5).abs() < 1e-6,
                "{factor} {summand}"
            );
        }
    }

    /// Keys and shapes of a build of the reference (`state_dict_keys`).
    #[test]
    fn keys_and_shapes_are_those_of_the_reference() {
        for (file, shrink) in [("early_fusion", vec![]), ("fcooper", vec![(1, 256), (3, 256)])] {
            let path = crate::vectors::folder().join(format!("state_dict_keys/point_pillar_{file}.json"));
            let document: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
            let entries = document["entries"].as_array().unwrap();
            let reference: Vec<(String, Vec<usize>)> = entries
                .iter()
                .map(|entry| {
                    let key = entry["key"].as_str().unwrap().to_string();
                    (key, serde_json::from_value(entry["shape"].clone()).unwrap())
                })
                .filter(|(key, _)| !is_counter(key))
                .collect();
            assert_eq!(expected(&crate::testing::full(&shrink)), reference, "{file}");
        }
    }
}
