//! The learned compressor: what crosses has a fraction of the map's channels.

use serde::{Deserialize, Serialize};

use super::problems::Problems;
use crate::layers::{Builder, ConvLayer, MapId};

/// What fusions of features have in common.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sharing {
    /// Agents that are fused at most, the ego among them.
    pub agents: usize,
    /// How many times fewer channels cross than the map has; 0: all of them cross.
    pub compression: usize,
    /// Whether an agent's own map loses channels in its own fusion, too, as in V2X-Real; if not, it is fused whole.
    pub compress_own: bool,
}

impl Default for Sharing {
    fn default() -> Self {
        Sharing {
            agents: 4,
            compression: 0,
            compress_own: true,
        }
    }
}

/// Agents that a model can be made for.
const MOST_AGENTS: usize = 64;

impl Sharing {
    /// `channels`: of the map that is compressed.
    pub(super) fn check(&self, channels: usize, problems: &mut Problems) {
        problems.within("arch.agents", self.agents, 1, MOST_AGENTS);
        let fits = self.compression == 0 || channels.is_multiple_of(self.compression);
        problems.require(fits, || {
            let found = self.compression;
            format!("arch.compression: expected 0 or a divisor of the map's {channels} channels, found {found}")
        });
        // Maps that are kept and maps that crossed are told apart by their channels.
        problems.require(self.compress_own || self.compression != 1, || {
            "arch.compression: expected 0 or at least 2 with compress_own = false, found 1".into()
        });
    }

    /// Whether an agent keeps a map for its own fusion that is not the one that crosses.
    pub(super) fn keeps_own(&self) -> bool {
        self.compression != 0 && !self.compress_own
    }

    /// The map that crosses.
    pub(super) fn compress(&self, builder: &mut Builder, map: MapId) -> MapId {
        match self.compression {
            0 => map,
            ratio => {
                let outputs = builder.size(map)[2] / ratio;
                convolution(builder, "encoder", 0, outputs, map)
            }
        }
    }

    /// The map that was compressed, as far as it can be had back.
    pub(super) fn restore(&self, builder: &mut Builder, crossed: MapId) -> MapId {
        match self.compression {
            0 => crossed,
            ratio => {
                let outputs = builder.size(crossed)[2] * ratio;
                let wide = convolution(builder, "decoder", 0, outputs, crossed);
                convolution(builder, "decoder", 3, outputs, wide)
            }
        }
    }
}

/// The compression of a network by the shapes of its weights; 0 if it has no such compressor.
pub fn compression_of<'a>(shape_of: impl Fn(&str) -> Option<&'a [usize]>) -> usize {
    match shape_of(&format!("{}.weight", key("encoder", 0))) {
        Some([outputs, inputs, ..]) if *outputs > 0 && inputs.is_multiple_of(*outputs) => inputs / outputs,
        _ => 0,
    }
}

fn key(part: &str, index: usize) -> String {
    format!("naive_compressor.{part}.{index}")
}

fn convolution(builder: &mut Builder, part: &str, index: usize, outputs: usize, from: MapId) -> MapId {
    let layer = ConvLayer {
        key: key(part, index),
        inputs: builder.size(from)[2],
        outputs,
        kernel: 3,
        stride: 1,
        transposed: false,
        bias: true,
        norm: Some(key(part, index + 1)),
        relu: true,
    };
    builder.convolution(layer, from)
}
