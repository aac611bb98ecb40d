//! Trains the PointPillars detector on the CPU.
//!
//! Frames ([`data`]) become batches on a thread of their own; the network ([`network`]) is made of custom operations
//! ([`layers`]) that a [`tape`] leads gradients back through; [`train`] is the loop around it.

mod checkpoint;
mod curve;
pub mod data;
mod error;
pub mod layers;
pub mod network;
pub mod optimizer;
mod quantize;
mod random;
pub mod tape;
mod train;
mod validate;

pub use checkpoint::{Checkpoint, TrainingPlan, write_weights};
pub use curve::{Curve, Point};
pub use error::TrainError;
pub use quantize::{Quantized, quantize};
pub use train::{Data, Progress, TrainOptions, Trained, frames, train, validation_frames};
pub use validate::{ClassScore, Validation, validate};
