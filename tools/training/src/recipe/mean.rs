//! The mean of weights.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use realo_methods::Model;
use realo_nn::layers::Layers;
use realo_nn::weights::{Tensor, Weights};

use crate::TrainError;

/// The mean of weights of one model, tensor by tensor.
///
/// # Errors
/// [`TrainError::OtherMaps`] of files that are not the model's.
pub fn mean(model: &Model, all: &[(PathBuf, Arc<Weights>)]) -> Result<Weights, TrainError> {
    let mut tensors = HashMap::new();
    for spec in Layers::of(model).tensors() {
        let mut sum = vec![0.0f64; spec.count()];
        for (file, weights) in all {
            let numbers = weights.find(&spec.key).filter(|numbers| numbers.len() == sum.len());
            let numbers = numbers.ok_or_else(|| TrainError::OtherMaps {
                model: model.name.clone(),
                from: file.clone(),
                differences: format!("`{}`: expected {:?}, found another size or none", spec.key, spec.shape),
            })?;
            sum.iter_mut()
                .zip(numbers)
                .for_each(|(sum, number)| *sum += f64::from(*number));
        }
        let data = sum.iter().map(|sum| (sum / all.len() as f64) as f32).collect();
        let shape = spec.shape.to_vec();
        tensors.insert(spec.key, Tensor { shape, data });
    }
    Ok(Weights::new(model, tensors)?)
}
