//! A network's weights: a safetensors file with the keys and shapes of V2X-Real's state dict.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};

use crate::model::Model;

/// Added to the variance by every batch norm.
pub const BATCH_NORM_EPS: f32 = 1e-3;

/// Numbers that describe a point of a pillar: x, y, z, intensity, offsets to the pillar's mean and to its centre.
pub const POINT_FEATURES: usize = 10;

/// Keys and shapes of a model's tensors, in the order of the state dict. Convolutions are `[out, in, k, k]`, transposed
/// ones `[in, out, k, k]`, linear layers `[out, in]`.
pub fn expected(model: &Model) -> Vec<(String, Vec<usize>)> {
    let mut all = Vec::new();
    let pillars = "pillar_vfe.pfn_layers.0";
    let mut channels = model.pillars.channels;
    all.push((format!("{pillars}.linear.weight"), vec![channels, POINT_FEATURES]));
    norm(&mut all, &format!("{pillars}.norm"), channels);
    let backbone = &model.backbone;
    for (block, (layers, out)) in backbone.layers.iter().zip(&backbone.channels).enumerate() {
        for layer in 0..=*layers {
            let (conv, norm_key) = block_keys(block, layer);
            all.push((format!("{conv}.weight"), vec![*out, channels, 3, 3]));
            norm(&mut all, &norm_key, *out);
            channels = *out;
        }
    }
    for (block, (up, out)) in backbone.up_strides.iter().zip(&backbone.up_channels).enumerate() {
        let (conv, norm_key) = deblock_keys(block);
        all.push((format!("{conv}.weight"), vec![backbone.channels[block], *out, *up, *up]));
        norm(&mut all, &norm_key, *out);
    }
    channels = backbone.up_channels.iter().sum();
    for (index, shrink) in model.shrink.iter().enumerate() {
        let shape = vec![shrink.channels, channels, shrink.kernel, shrink.kernel];
        with_bias(&mut all, &shrink_key(index), shape);
        channels = shrink.channels;
    }
    let anchors = model.anchors();
    with_bias(
        &mut all,
        "cls_head",
        vec![anchors * model.classes.len(), channels, 1, 1],
    );
    with_bias(&mut all, "reg_head", vec![anchors * 7, channels, 1, 1]);
    all
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
        "{}: {error}; weights lie beside their model file, under the model's `name`; `realo train` makes some",
        path.display()
    )]
    Read {
        /// The file of weights.
        path: PathBuf,
        /// What failed.
        error: std::io::Error,
    },
    /// It is not a safetensors file.
    #[error("{}: {error}", path.display())]
    Syntax {
        /// The file of weights.
        path: PathBuf,
        /// What is wrong with it.
        error: safetensors::SafeTensorError,
    },
    /// The weights of a file.
    #[error("{}: {error}", path.display())]
    File {
        /// The file of weights.
        path: PathBuf,
        /// What is wrong with them.
        error: Box<WeightsError>,
    },
    /// The tensors are not those of the model.
    #[error(
        "weights do not fit model `{model}`: {}; take the weights that belong to this model file, or train it anew",
        problems.join("; ")
    )]
    Mismatch {
        /// The model's name.
        model: String,
        /// Every tensor that is missing, extra, of another shape or type, or not finite.
        problems: Vec<String>,
    },
}

impl Weights {
    /// Reads the weights of a model.
    ///
    /// # Errors
    /// [`WeightsError::Read`], [`WeightsError::Syntax`], and [`WeightsError::File`] with that of [`Weights::new`], where a
    /// tensor that is not F32 is a problem too.
    pub fn read(path: &Path, model: &Model) -> Result<Weights, WeightsError> {
        let bytes = std::fs::read(path).map_err(|error| WeightsError::Read {
            path: path.into(),
            error,
        })?;
        let file = SafeTensors::deserialize(&bytes).map_err(|error| WeightsError::Syntax {
            path: path.into(),
            error,
        })?;
        let (mut tensors, mut problems) = (HashMap::new(), Vec::new());
        // In an order that is the same every time, for the problems.
        let mut views: Vec<_> = file.iter().filter(|(key, _)| !is_counter(key)).collect();
        views.sort_by_key(|(key, _)| *key);
        for (key, view) in views {
            if view.dtype() != Dtype::F32 {
                problems.push(format!("`{key}`: expected F32, found {:?}", view.dtype()));
            }
            // A tensor of another type keeps its shape, so that only its type is reported.
            let data = match view.dtype() {
                Dtype::F32 => view
                    .data()
                    .as_chunks::<4>()
                    .0
                    .iter()
                    .copied()
                    .map(f32::from_le_bytes)
                    .collect(),
                _ => vec![0.0; view.shape().iter().product()],
            };
            let shape = view.shape().to_vec();
            tensors.insert(key.to_string(), Tensor { shape, data });
        }
        Weights::checked(model, tensors, problems).map_err(|error| WeightsError::File {
            path: path.into(),
            error: Box::new(error),
        })
    }

    /// The weights of a model from tensors by key; `num_batches_tracked` of a batch norm is ignored.
    ///
    /// # Errors
    /// [`WeightsError::Mismatch`] with all that differs from what [`expected`] lists.
    pub fn new(model: &Model, tensors: HashMap<String, Tensor>) -> Result<Weights, WeightsError> {
        Weights::checked(model, tensors, Vec::new())
    }

    fn checked(
        model: &Model,
        mut tensors: HashMap<String, Tensor>,
        mut problems: Vec<String>,
    ) -> Result<Weights, WeightsError> {
        tensors.retain(|key, _| !is_counter(key));
        let mut fitting = HashMap::new();
        for (key, shape) in expected(model) {
            let Some(tensor) = tensors.remove(&key) else {
                problems.push(format!("`{key}` {shape:?} is missing"));
                continue;
            };
            problems.extend(tensor.problem(&key, &shape));
            fitting.insert(key, tensor.data);
        }
        let mut extra: Vec<String> = tensors.into_keys().collect();
        extra.sort();
        problems.extend(extra.iter().map(|key| format!("`{key}` is not part of the model")));
        if problems.is_empty() {
            return Ok(Weights { tensors: fitting });
        }
        Err(WeightsError::Mismatch {
            model: model.name.clone(),
            problems,
        })
    }

    /// The numbers of a tensor, in the order of its shape.
    ///
    /// # Panics
    /// If the model has no such tensor.
    pub fn tensor(&self, key: &str) -> &[f32] {
        match self.tensors.get(key) {
            Some(data) => data,
            None => panic!("the model has no tensor `{key}`"),
        }
    }

    /// A batch norm with its running statistics as factor and summand of each channel.
    ///
    /// # Panics
    /// If the model has no batch norm of this key.
    pub fn batch_norm(&self, key: &str) -> Vec<[f64; 2]> {
        let part = |name: &str| {
            self.tensor(&format!("{key}.{name}"))
                .iter()
                .map(|value| f64::from(*value))
        };
        let affine = part("weight").zip(part("bias"));
        let statistics = part("running_mean").zip(part("running_var"));
        affine
            .zip(statistics)
            .map(|((weight, bias), (mean, variance))| {
                let factor = weight / (variance + f64::from(BATCH_NORM_EPS)).sqrt();
                [factor, bias - mean * factor]
            })
            .collect()
    }
}

impl Tensor {
    fn problem(&self, key: &str, shape: &[usize]) -> Option<String> {
        if self.shape != shape {
            return Some(format!("`{key}`: expected shape {shape:?}, found {:?}", self.shape));
        }
        let numbers = shape.iter().product::<usize>();
        if self.data.len() != numbers {
            return Some(format!(
                "`{key}`: expected {numbers} numbers, found {}",
                self.data.len()
            ));
        }
        let bad = self.data.iter().filter(|value| !value.is_finite()).count();
        if bad > 0 {
            return Some(format!("`{key}`: {bad} of {numbers} numbers are not finite"));
        }
        let negative = key.ends_with(".running_var") && self.data.iter().any(|value| *value < 0.0);
        negative.then(|| format!("`{key}`: a variance is negative"))
    }
}

/// Torch counts the batches that a norm has seen; inference has no use for it.
fn is_counter(key: &str) -> bool {
    key.ends_with(".num_batches_tracked")
}

/// Keys of a block's convolution and batch norm; index 0 of a block is padding and every third after it a ReLU.
pub(crate) fn block_keys(block: usize, layer: usize) -> (String, String) {
    let key = |index: usize| format!("backbone.blocks.{block}.{index}");
    (key(1 + 3 * layer), key(2 + 3 * layer))
}

pub(crate) fn deblock_keys(block: usize) -> (String, String) {
    let key = |index: usize| format!("backbone.deblocks.{block}.{index}");
    (key(0), key(1))
}

/// Every second entry of the list is a ReLU.
pub(crate) fn shrink_key(index: usize) -> String {
    format!("shrink_conv.layers.0.double_conv.{}", 2 * index)
}

fn norm(all: &mut Vec<(String, Vec<usize>)>, key: &str, channels: usize) {
    for part in ["weight", "bias", "running_mean", "running_var"] {
        all.push((format!("{key}.{part}"), vec![channels]));
    }
}

fn with_bias(all: &mut Vec<(String, Vec<usize>)>, key: &str, shape: Vec<usize>) {
    let out = shape[0];
    all.push((format!("{key}.weight"), shape));
    all.push((format!("{key}.bias"), vec![out]));
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
    fn the_weights_of_another_model_do_not_fit() {
        let mut wide = lite();
        wide.pillars.channels = 64;
        let found = problems(random_tensors(&wide, 1));
        assert_eq!(found.len(), 6, "{found:?}");
        assert!(found.iter().all(|line| line.contains("expected shape")), "{found:?}");
    }

    #[test]
    fn reads_files_strictly() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("lite.safetensors");
        let error = |path: &Path| Weights::read(path, &lite()).unwrap_err().to_string();
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
        let weights = Weights::read(&path, &lite()).unwrap();
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

    /// Keys and shapes of a build of the reference (`state_dict_keys`), where its folder of vectors is at hand.
    #[test]
    fn keys_and_shapes_are_those_of_the_reference() {
        let Some(shared) = crate::testing::shared() else { return };
        for (file, shrink) in [("early_fusion", vec![]), ("fcooper", vec![(1, 256), (3, 256)])] {
            let path = shared.join(format!("conformance/state_dict_keys/point_pillar_{file}.json"));
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
