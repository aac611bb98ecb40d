//! What a model's `arch` must say of itself.

use std::fmt;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::problems::Problems;
use super::sharing::Sharing;
use crate::layers::MapSize;
use crate::tensors::TensorSpec;

/// How a model's layers are put together beyond those of a single agent's detector: whether agents share maps, and the tensors
/// of what fuses them. The default is a detector of a single agent.
pub trait Architecture: Clone + fmt::Debug + Default + PartialEq + Serialize + DeserializeOwned {
    /// How agents share their maps; `None` if maps are not fused.
    fn sharing(&self) -> Option<Sharing>;

    /// Notes which of its settings do not fit; `map`: rows, columns and channels of the map that is fused.
    fn check(&self, map: MapSize, problems: &mut Problems);

    /// The tensors of its fusion of maps of so many channels, in the order of the state dict.
    fn tensors(&self, channels: usize) -> Vec<TensorSpec>;
}
