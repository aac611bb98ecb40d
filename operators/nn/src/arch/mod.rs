//! The architectures: what a model's `arch` may be, each with its layers in a file of its own.

mod attfuse;
mod fcooper;
mod pointpillars;
mod sharing;
mod v2vnet;
mod v2xvit;

use std::fmt;

#[cfg(test)]
pub(crate) use pointpillars::heads;
use serde::{Deserialize, Serialize};
pub use sharing::{Sharing, compression_of};
pub use v2vnet::MessagePassing;
pub use v2xvit::{Transformer, Window};

use crate::layers::Layers;
use crate::model::{Model, Problems};

/// How a model's layers are put together, with the settings that only this architecture has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum Arch {
    /// Pillars, backbone, shrink layers and heads of one agent (PointPillars, Lang et al. 2019, as in V2X-Real).
    PointPillars {},
    /// Agents' maps fused by their maximum.
    FCooper(Sharing),
    /// Agents' maps fused by attention.
    AttFuse(Sharing),
    /// Agents' maps fused by a transformer.
    V2XViT(Box<Transformer>),
    /// Agents' maps fused by messages between them.
    V2VNet(MessagePassing),
}

impl fmt::Display for Arch {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Arch::PointPillars {} => "pointpillars",
            Arch::FCooper(_) => "fcooper",
            Arch::AttFuse(_) => "attfuse",
            Arch::V2XViT(_) => "v2xvit",
            Arch::V2VNet(_) => "v2vnet",
        })
    }
}

impl Default for Arch {
    fn default() -> Self {
        Arch::PointPillars {}
    }
}

impl Arch {
    /// Whether it is the one that a model has which names none.
    pub(crate) fn is_default(&self) -> bool {
        *self == Arch::default()
    }

    /// Whether maps of several agents become one.
    pub fn fuses(&self) -> bool {
        !matches!(self, Arch::PointPillars {})
    }

    /// Agents that a network takes, the ego among them.
    pub fn agents(&self) -> usize {
        match self {
            Arch::PointPillars {} => 1,
            Arch::FCooper(sharing) | Arch::AttFuse(sharing) => sharing.agents,
            Arch::V2XViT(settings) => settings.agents,
            Arch::V2VNet(settings) => settings.agents,
        }
    }

    /// How many times fewer channels cross than the map has, of an architecture that shares maps; 0: all of them cross.
    pub fn compression_mut(&mut self) -> Option<&mut usize> {
        match self {
            Arch::PointPillars {} => None,
            Arch::FCooper(sharing) | Arch::AttFuse(sharing) => Some(&mut sharing.compression),
            Arch::V2XViT(settings) => Some(&mut settings.compression),
            Arch::V2VNet(settings) => Some(&mut settings.compression),
        }
    }

    /// What of a model, whose parts are within their bounds, does not fit together.
    pub(crate) fn check(&self, model: &Model, problems: &mut Problems) {
        pointpillars::check(model, problems);
        match self {
            Arch::PointPillars {} => {}
            Arch::FCooper(sharing) | Arch::AttFuse(sharing) => sharing.check(pointpillars::channels(model), problems),
            Arch::V2XViT(settings) => settings.check(pointpillars::map(model), problems),
            Arch::V2VNet(settings) => settings.check(pointpillars::channels(model), problems),
        }
    }

    /// The layers of a model that has been checked.
    pub(crate) fn layers(&self, model: &Model) -> Layers {
        match self {
            Arch::PointPillars {} => pointpillars::layers(model),
            Arch::FCooper(sharing) => fcooper::layers(model, sharing),
            Arch::AttFuse(sharing) => attfuse::layers(model, sharing),
            Arch::V2XViT(settings) => v2xvit::layers(model, settings),
            Arch::V2VNet(settings) => v2vnet::layers(model, settings),
        }
    }
}
