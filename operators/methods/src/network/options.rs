//! What a network computes with.

use std::fmt;

use realo_kernels::conv::Isa;
use realo_nn::model::Precision;

use super::error::NetworkError;
use crate::arch::Model;
use crate::method::Arithmetic;

/// How a network computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkOptions {
    /// Instructions.
    pub isa: Isa,
    /// Number type. `None`: the model's, or f32 instead of bf16 where the instructions have no products of it. `Some(Bf16)`
    /// computes in bf16 everywhere, slowly where the CPU lacks it.
    pub precision: Option<Precision>,
    /// Threads, the caller's included; 0 counts as 1.
    pub threads: usize,
}

impl Default for NetworkOptions {
    /// The best instructions and all cores of this machine, in the model's precision.
    fn default() -> Self {
        NetworkOptions {
            isa: Isa::detect(),
            precision: None,
            threads: std::thread::available_parallelism().map_or(1, |cores| cores.get()),
        }
    }
}

/// What a network was found to compute with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Choice {
    /// Instructions.
    pub isa: Isa,
    /// Number type of weights and maps.
    pub precision: Precision,
    /// Number type that the model asks for.
    pub wanted: Precision,
    /// Threads.
    pub threads: usize,
}

impl Choice {
    /// Number type of what is not computed in bytes.
    pub(super) fn float(self) -> Precision {
        match self.precision {
            Precision::Int8 if self.isa.has_bf16() => Precision::Bf16,
            Precision::Int8 => Precision::F32,
            precision => precision,
        }
    }
}

impl Choice {
    /// Numbers and instructions of a fusion.
    pub(super) fn of_fusion(self) -> Arithmetic {
        Arithmetic {
            isa: self.isa,
            half: self.float() == Precision::Bf16,
        }
    }
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} on {}", self.precision, self.isa)?;
        if self.wanted != self.precision {
            write!(f, " (the model asks for {})", self.wanted)?;
        }
        write!(
            f,
            ", {} thread{}",
            self.threads,
            if self.threads == 1 { "" } else { "s" }
        )
    }
}

/// What a model is computed with.
///
/// # Errors
/// [`NetworkError::Isa`] and [`NetworkError::NoActivations`].
pub(super) fn choose(model: &Model, options: &NetworkOptions) -> Result<Choice, NetworkError> {
    if !options.isa.is_available() {
        return Err(NetworkError::Isa {
            asked: options.isa,
            best: Isa::detect(),
        });
    }
    let usual = match model.precision {
        Precision::Bf16 if !options.isa.has_bf16() => Precision::F32,
        precision => precision,
    };
    let precision = options.precision.unwrap_or(usual);
    if precision == Precision::Int8 && model.activations.is_empty() {
        return Err(NetworkError::NoActivations {
            model: model.name.clone(),
        });
    }
    Ok(Choice {
        isa: options.isa,
        precision,
        wanted: model.precision,
        threads: options.threads.max(1),
    })
}
