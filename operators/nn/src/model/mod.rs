//! The typed model file: everything about a network that is not a weight.
//!
//! A model is `<name>.toml` beside `<name>.safetensors`, or beside what `weights` and `encoder` name (see
//! [`crate::weights`]). With `extends = "other.toml"` it says only what differs from the model of another file, key by key; `arch` as a whole.

mod architecture;
mod check;
mod detector;
mod error;
mod file;
mod precision;
mod problems;
mod settings;
mod sharing;

pub use architecture::Architecture;
pub use detector::{REFINE, heads};
pub use error::ModelError;
pub use file::ModelFile;
pub use precision::{Precision, UnknownPrecision};
pub use problems::Problems;
pub use settings::{Backbone, ClassAnchor, Frame, Grid, Matching, Model, PillarSettings, Shrink};
pub use sharing::{Sharing, compression_of};
