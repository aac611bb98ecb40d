//! Trains detectors and networks that fuse the maps of several agents, on the CPU.
//!
//! Frames ([`data`]) become batches on a thread of their own. A network ([`network`]) is made of custom operations ([`layers`]) that
//! a [`tape`] leads gradients back through, its fusion of candle's. [`train`] is the loop around it.

mod checkpoint;
mod compressor;
mod curve;
pub mod data;
mod error;
mod freeze;
mod fusing;
pub mod layers;
mod memory;
pub mod network;
pub mod optimizer;
mod quantize;
mod random;
pub mod recipe;
mod scored;
pub mod tape;
mod teacher;
mod train;
mod validate;
mod widen;

pub use checkpoint::{Checkpoint, TrainingPlan, write_weights};
pub use curve::{Curve, Point};
pub use error::TrainError;
pub use freeze::{Frozen, Part, UnknownPart};
pub use fusing::fuses;
pub use quantize::{Quantized, quantize};
pub use realo_objective::{loss, targets};
pub use scored::{Before, Comparison, FRAMES_APART, MAX_GAP_MS};
pub use train::{
    Data, News, PER_SEED, Progress, SEEDS, TrainOptions, Trained, frames, train, train_with, validation_frames,
};
pub use validate::{ClassScore, Validation, score, validate};
