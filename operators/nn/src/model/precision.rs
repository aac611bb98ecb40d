//! Number types.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Number type of maps and weights in the convolutions; sums of floating-point numbers are f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// bfloat16.
    Bf16,
    /// Single precision.
    F32,
    /// Maps in bytes and weights in signed bytes, sums in whole numbers, from the canvas to the map that the fusion reads;
    /// fusion and heads in bf16, or f32 where the CPU has no products of bf16.
    Int8,
}

impl Precision {
    /// All.
    pub const ALL: [Precision; 3] = [Precision::Bf16, Precision::F32, Precision::Int8];
}

/// No number type has this name.
#[derive(Debug, thiserror::Error)]
#[error("expected one of {}, found `{name}`", Precision::ALL.map(|precision| precision.to_string()).join(", "), name = .0)]
pub struct UnknownPrecision(String);

impl FromStr for Precision {
    type Err = UnknownPrecision;

    fn from_str(name: &str) -> Result<Self, UnknownPrecision> {
        let named = Precision::ALL
            .into_iter()
            .find(|precision| precision.to_string() == name);
        named.ok_or_else(|| UnknownPrecision(name.into()))
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Precision::Bf16 => "bf16",
            Precision::F32 => "f32",
            Precision::Int8 => "int8",
        })
    }
}
