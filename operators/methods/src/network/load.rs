//! A model as the operators load it: file, weights and a network that is ready to run.
//!
//! In one process a model is loaded once: who loads the same files for the same instructions gets the same model and
//! weights, and networks with the same number of threads share the threads. Only the maps are each network's own.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, Weak};

use realo_kernels::conv::{Isa, Pool, UnknownIsa, lock};
use realo_nn::model::{ModelError, Precision, UnknownPrecision};
use realo_nn::weights::{self, Weights, WeightsError};
use sha2::{Digest, Sha256};

use super::core::Core;
use super::error::NetworkError;
use super::options::NetworkOptions;
use super::running::Network;
use crate::arch::Model;

/// A model with its weights and its network.
pub struct Loaded {
    /// The model file.
    pub model: Arc<Model>,
    /// Its weights.
    pub weights: Arc<Weights>,
    /// Its network.
    pub network: Network,
    /// Number type that was asked for, or else the model's.
    pub precision: Precision,
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
    #[error("setting `isa`: {0}")]
    Isa(UnknownIsa),
    /// The number type.
    #[error("setting `precision`: {0}")]
    Precision(UnknownPrecision),
    /// More threads than any machine has.
    #[error("setting `threads`: expected at most {MOST_THREADS}, found {0}")]
    Threads(usize),
}

const MOST_THREADS: usize = 1024;

/// What computes a network, as operators' settings name it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kernels<'a> {
    /// Instructions; `auto` for the best that the processor has.
    pub isa: &'a str,
    /// Number type; `auto` for the model's.
    pub precision: &'a str,
    /// Threads; 0 for one on each processor.
    pub threads: usize,
}

impl Kernels<'_> {
    /// The best, on so many threads.
    pub fn auto(threads: usize) -> Self {
        Kernels {
            isa: AUTO,
            precision: AUTO,
            threads,
        }
    }

    fn options(self) -> Result<NetworkOptions, LoadError> {
        if self.threads > MOST_THREADS {
            return Err(LoadError::Threads(self.threads));
        }
        let mut options = NetworkOptions::default();
        if self.isa != AUTO {
            options.isa = self.isa.parse::<Isa>().map_err(LoadError::Isa)?;
        }
        if self.precision != AUTO {
            options.precision = Some(self.precision.parse::<Precision>().map_err(LoadError::Precision)?);
        }
        if self.threads > 0 {
            options.threads = self.threads;
        }
        Ok(options)
    }
}

/// The setting that leaves the choice to the loader.
pub const AUTO: &str = "auto";

/// Loads the model of a file and the weights beside it.
///
/// # Errors
/// A file that cannot be read or does not fit, kernels that do not exist or that this processor lacks.
pub fn load(model_file: &Path, kernels: Kernels) -> Result<Loaded, LoadError> {
    let options = kernels.options()?;
    let (model, files) = Model::read_with_files(model_file)?;
    let parts = weights::read_files(&model.weights_beside(model_file))?;
    let bytes = files.iter().chain(&parts).map(|(_, bytes)| bytes);
    let identity = format!("{}-{}", model.name, digest(bytes));

    let mut known = lock(&KNOWN);
    let shared = match known.model(&identity, &options) {
        Some(shared) => shared,
        None => {
            let weights = Weights::parse(&parts, &model)?;
            let core = Core::new(&model, &weights, &options).map_err(|error| LoadError::Network {
                path: model_file.into(),
                error,
            })?;
            known.add(&identity, &options, Shared { model, weights, core })
        }
    };
    Ok(Loaded {
        precision: options.precision.unwrap_or(shared.model.precision),
        model: shared.model,
        weights: shared.weights,
        network: Network::sharing(shared.core, known.pool(options.threads)),
        identity,
    })
}

/// What is the same for everybody who loads a model.
struct Shared<M = Arc<Model>, W = Arc<Weights>, C = Arc<Core>> {
    model: M,
    weights: W,
    core: C,
}

type Unowned = Shared<Weak<Model>, Weak<Weights>, Weak<Core>>;

/// What is in use in this process.
struct Known {
    /// By identity, instructions and number type.
    models: BTreeMap<(String, Isa, Option<Precision>), Unowned>,
    /// By number of threads.
    pools: BTreeMap<usize, Weak<Mutex<Pool>>>,
}

static KNOWN: Mutex<Known> = Mutex::new(Known {
    models: BTreeMap::new(),
    pools: BTreeMap::new(),
});

impl Known {
    fn model(&self, identity: &str, options: &NetworkOptions) -> Option<Shared> {
        let shared = self.models.get(&(identity.into(), options.isa, options.precision))?;
        Some(Shared {
            model: shared.model.upgrade()?,
            weights: shared.weights.upgrade()?,
            core: shared.core.upgrade()?,
        })
    }

    fn add(
        &mut self,
        identity: &str,
        options: &NetworkOptions,
        Shared { model, weights, core }: Shared<Model, Weights, Core>,
    ) -> Shared {
        let shared = Shared {
            model: Arc::new(model),
            weights: Arc::new(weights),
            core: Arc::new(core),
        };
        self.models.retain(|_, shared| shared.core.strong_count() > 0);
        let weak = Shared {
            model: Arc::downgrade(&shared.model),
            weights: Arc::downgrade(&shared.weights),
            core: Arc::downgrade(&shared.core),
        };
        self.models
            .insert((identity.into(), options.isa, options.precision), weak);
        shared
    }

    fn pool(&mut self, threads: usize) -> Arc<Mutex<Pool>> {
        if let Some(pool) = self.pools.get(&threads).and_then(Weak::upgrade) {
            return pool;
        }
        let pool = Arc::new(Mutex::new(Pool::new(threads)));
        self.pools.insert(threads, Arc::downgrade(&pool));
        pool
    }
}

/// The first 16 digits of the SHA-256 of the files' bytes.
fn digest<'a>(files: impl Iterator<Item = &'a Vec<u8>>) -> String {
    let mut sum = Sha256::new();
    for bytes in files {
        sum.update((bytes.len() as u64).to_le_bytes());
        sum.update(bytes);
    }
    let digits = sum.finalize();
    digits.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{small, write};
    use realo_kernels::canvas::Canvas;

    fn load_from(folder: &Path, isa: &str, threads: usize) -> Loaded {
        let kernels = Kernels {
            isa,
            ..Kernels::auto(threads)
        };
        load(&folder.join("small.toml"), kernels).unwrap()
    }

    fn folder(seed: u64) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let mut model = small(8, 12, true);
        model.name = "small".into();
        write(folder.path(), &model, seed);
        folder
    }

    #[test]
    fn a_model_is_loaded_once_and_its_networks_share_weights_and_threads() {
        let folder = folder(1);
        let (a, b) = (
            load_from(folder.path(), "portable", 2),
            load_from(folder.path(), "portable", 2),
        );
        assert!(Arc::ptr_eq(&a.model, &b.model) && Arc::ptr_eq(&a.weights, &b.weights));
        assert!(a.network.shares_layers_with(&b.network) && a.network.shares_threads_with(&b.network));
        let other = load_from(folder.path(), "portable", 1);
        assert!(other.network.shares_layers_with(&a.network) && !other.network.shares_threads_with(&a.network));
        let auto = load_from(folder.path(), "auto", 2);
        assert_eq!(
            auto.network.shares_layers_with(&a.network),
            Isa::detect() == Isa::Portable
        );
        assert_eq!(auto.identity, a.identity);
    }

    #[test]
    fn a_file_that_has_changed_is_another_model() {
        let folder = folder(2);
        let before = load_from(folder.path(), "auto", 1);
        write(folder.path(), &before.model, 3);
        let after = load_from(folder.path(), "auto", 1);
        assert_ne!(before.identity, after.identity);
        assert!(!after.network.shares_layers_with(&before.network));
    }

    #[test]
    fn nothing_stays_of_a_model_that_nobody_uses() {
        let folder = folder(4);
        let loaded = load_from(folder.path(), "auto", 1);
        let (model, identity) = (Arc::downgrade(&loaded.model), loaded.identity.clone());
        drop(loaded);
        assert!(model.upgrade().is_none());
        assert!(lock(&KNOWN).model(&identity, &NetworkOptions::default()).is_none());
    }

    #[test]
    fn networks_of_one_model_work_at_the_same_time() {
        let folder = folder(5);
        let map = |threads: usize, value: f32| {
            let mut network = load_from(folder.path(), "auto", threads).network;
            let mut canvas = Canvas::new(8, 12, 7);
            canvas.cell_mut(3, 4).fill(value);
            let map = network.encode(&canvas).unwrap();
            (network.heads(&map).unwrap().clone(), map)
        };
        let expected = [1.0, 2.0].map(|value| map(2, value));
        let _kept = load_from(folder.path(), "auto", 2);
        std::thread::scope(|scope| {
            let runs: Vec<_> = (0..8).map(|i| scope.spawn(move || map(2, [1.0, 2.0][i % 2]))).collect();
            for (i, run) in runs.into_iter().enumerate() {
                assert!(run.join().unwrap() == expected[i % 2]);
            }
        });
    }

    #[test]
    fn errors_name_file_and_field() {
        let folder = folder(6);
        let file = folder.path().join("small.toml");
        let error = |isa: &str, threads: usize| {
            let kernels = Kernels {
                isa,
                ..Kernels::auto(threads)
            };
            load(&file, kernels).err().expect("refused").to_string()
        };
        assert!(
            error("sse9", 1).contains("setting `isa`: expected auto or one of"),
            "{}",
            error("sse9", 1)
        );
        assert!(error("auto", 5000).contains("`threads`: expected at most 1024, found 5000"));
        let weights = folder.path().join("small.safetensors");
        std::fs::remove_file(&weights).unwrap();
        let missing = error("auto", 1);
        assert!(
            missing.contains("small.safetensors") && missing.contains("realo-lab train"),
            "{missing}"
        );
        std::fs::write(&weights, [255; 16]).unwrap();
        assert!(error("auto", 1).contains("small.safetensors"));
    }
}
