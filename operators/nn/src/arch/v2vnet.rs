//! V2VNet: agents send each other messages before the ego detects (Wang et al. 2020), as V2X-Real builds it.

use serde::{Deserialize, Serialize};

use super::pointpillars::{backbone, heads, pillars, shrink};
use super::sharing::Sharing;
use crate::layers::{Builder, Fusion, Layers};
use crate::model::{Model, Problems};

/// Settings of the messages; those of V2X-Real by default.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MessagePassing {
    /// Agents that are fused at most, the ego among them.
    pub agents: usize,
    /// How many times fewer channels cross than the map has; 0: all of them cross.
    pub compression: usize,
    /// How often all agents send.
    pub rounds: usize,
}

impl Default for MessagePassing {
    fn default() -> Self {
        MessagePassing {
            agents: 4,
            compression: 0,
            rounds: 2,
        }
    }
}

impl MessagePassing {
    fn sharing(&self) -> Sharing {
        Sharing {
            agents: self.agents,
            compression: self.compression,
        }
    }

    pub(crate) fn check(&self, channels: usize, problems: &mut Problems) {
        self.sharing().check(channels, problems);
        problems.within("arch.rounds", self.rounds, 1, 16);
    }
}

/// The layers in the order of the state dict.
pub fn layers(model: &Model, settings: &MessagePassing) -> Layers {
    let mut builder = Builder::default();
    let canvas = pillars(&mut builder, model);
    let joined = backbone(&mut builder, &model.backbone, canvas);
    let features = shrink(&mut builder, model, joined);
    let crossed = settings.sharing().compress(&mut builder, features);
    let restored = settings.sharing().restore(&mut builder, crossed);
    let rounds = settings.rounds;
    let fused = builder.fuse(Fusion::Messages { rounds }, restored);
    let outputs = heads(&mut builder, model, fused);
    builder.finish_fused(canvas, [crossed, restored, fused], outputs)
}
