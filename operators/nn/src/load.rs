//! A model as the operators load it: file, weights and a network that is ready to run.

use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::conv::{Isa, UnknownIsa};
use crate::model::{Model, ModelError};
use crate::network::{Network, NetworkError, NetworkOptions};
use crate::weights::{Weights, WeightsError};

/// A model with its weights and its network.
pub struct Loaded {
    /// The model file.
    pub model: Model,
    /// Its weights.
    pub weights: Weights,
    /// Its network.
    pub network: Network,
    /// Name and digest of file and weights: the same only for the same network.
    pub identity: String,
}

/// Why there is no network.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The model file.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The weights.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The network.
    #[error("{}: {error}", path.display())]
    Network {
        /// The model file.
        path: PathBuf,
        /// What is wrong.
        error: NetworkError,
    },
    /// The kernels.
    #[error("argument `isa`: {0}")]
    Isa(#[from] UnknownIsa),
    /// More threads than any machine has.
    #[error("argument `threads`: expected at most {MOST_THREADS}, found {0}")]
    Threads(usize),
}

const MOST_THREADS: usize = 1024;

/// Loads the model of a file and the weights beside it.
///
/// `isa`: `auto`, or the name of kernels. `threads`: of the convolutions; 0 for one on each processor.
///
/// # Errors
/// A file that cannot be read or does not fit, kernels that do not exist or that this processor lacks.
pub fn load(model_file: &Path, isa: &str, threads: usize) -> Result<Loaded, LoadError> {
    if threads > MOST_THREADS {
        return Err(LoadError::Threads(threads));
    }
    let model = Model::read(model_file)?;
    let path = model.weights_beside(model_file);
    let weights = Weights::read(&path, &model)?;
    let mut options = NetworkOptions::default();
    if isa != "auto" {
        options.isa = isa.parse::<Isa>()?;
    }
    if threads > 0 {
        options.threads = threads;
    }
    let network = Network::new(&model, &weights, options).map_err(|error| LoadError::Network {
        path: model_file.into(),
        error,
    })?;
    let identity = format!("{}-{}", model.name, digest(&[model_file, &path])?);
    Ok(Loaded {
        model,
        weights,
        network,
        identity,
    })
}

/// The first 16 digits of the SHA-256 of the files' bytes.
fn digest(files: &[&Path]) -> Result<String, LoadError> {
    let mut sum = Sha256::new();
    for path in files {
        let bytes = std::fs::read(path).map_err(|error| WeightsError::Read {
            path: path.into(),
            error,
        })?;
        sum.update((bytes.len() as u64).to_le_bytes());
        sum.update(&bytes);
    }
    Ok(sum
        .finalize()
        .iter()
        .take(8)
        .map(|byte| format!("{byte:02x}"))
        .collect())
}
