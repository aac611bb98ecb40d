use std::path::Path;

use realo_methods::{AUTO, Kernels, Loaded};
use realo_operator::{Error, Settings};
use serde::{Deserialize, Serialize};

use crate::Device;

/// Settings of every stage that computes a network.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Computing {
    /// Kernels: `auto`, `portable`, `avx2`, `avx512`, `avx512bf16` or `amx`.
    #[setting(default = AUTO.into(), role = "isa")]
    pub isa: String,
    /// Number type: `auto` (the model's), `f32`, `bf16` or `int8`.
    #[setting(default = AUTO.into(), role = "precision")]
    pub precision: String,
    /// Threads of the network; 0: one for each processor.
    #[setting(range = 0..=1024)]
    pub threads: usize,
    /// What computes the network: `cpu`, or `cuda` where the build has it.
    #[setting(role = "device")]
    pub device: Device,
}

impl Computing {
    /// Loads a model as these settings say.
    ///
    /// # Errors
    /// A file that is not a model, or kernels that this machine or the model does not have.
    pub fn load(&self, model: &Path) -> Result<Loaded, Error> {
        let kernels = Kernels {
            isa: &self.isa,
            precision: &self.precision,
            threads: self.threads,
        };
        Ok(realo_methods::load(model, kernels)?)
    }
}
