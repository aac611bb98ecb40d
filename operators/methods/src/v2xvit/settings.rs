//! The settings in a model file.

use realo_nn::layers::MapSize;
use realo_nn::model::Problems;
use serde::{Deserialize, Serialize};

/// Settings of the transformer; those of V2X-Real by default.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Agents that are fused at most, the ego among them.
    pub agents: usize,
    /// How many times fewer channels cross than the map has; 0: all of them cross.
    pub compression: usize,
    /// Whether an agent's own map loses channels in its own fusion, too; if not, it is fused whole.
    pub compress_own: bool,
    /// Rounds of attention and feed-forward.
    pub depth: usize,
    /// Attentions over agents, then over windows, in a round.
    pub blocks: usize,
    /// Heads of the attention over agents.
    pub heads: usize,
    /// Channels of each of these heads.
    pub head_width: usize,
    /// The attentions over windows that stand side by side.
    pub windows: Vec<Window>,
    /// Channels between the two layers of a feed-forward.
    pub feed_forward: usize,
    /// Rows of the table of delays.
    pub delays: usize,
    /// Rows of that table for each frame of delay.
    pub delay_ratio: usize,
}

/// An attention within windows of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// Cells along each side.
    pub side: usize,
    /// Heads.
    pub heads: usize,
    /// Channels of each head.
    pub head_width: usize,
}

impl Window {
    /// Channels of all heads.
    pub fn width(&self) -> usize {
        self.heads * self.head_width
    }

    /// Where in a table of `[2 side - 1, 2 side - 1]` the offset from a cell that asks to one that is asked is.
    pub(super) fn offset(&self, asks: usize, asked: usize) -> usize {
        let side = self.side;
        let along = |asks: usize, asked: usize| asked + side - 1 - asks;
        along(asks / side, asked / side) * (2 * side - 1) + along(asks % side, asked % side)
    }
}

impl Default for Settings {
    fn default() -> Self {
        let window = |side, heads, head_width| Window {
            side,
            heads,
            head_width,
        };
        Settings {
            agents: 4,
            compression: 0,
            compress_own: true,
            depth: 1,
            blocks: 1,
            heads: 8,
            head_width: 32,
            windows: vec![window(2, 16, 16), window(4, 8, 32), window(8, 4, 64)],
            feed_forward: 256,
            delays: 100,
            delay_ratio: 2,
        }
    }
}

impl Settings {
    /// Notes which of them do not fit; `map`: rows, columns and channels of the map that is fused.
    pub fn note_problems(&self, [rows, columns, channels]: MapSize, problems: &mut Problems) {
        problems.within("arch.depth", self.depth, 1, 16);
        problems.within("arch.blocks", self.blocks, 1, 16);
        problems.within("arch.heads", self.heads, 1, 256);
        problems.within("arch.head_width", self.head_width, 1, 4096);
        problems.within("arch.feed_forward", self.feed_forward, 1, 65_536);
        problems.within("arch.delays", self.delays, 1, 65_536);
        problems.within("arch.delay_ratio", self.delay_ratio, 1, 1024);
        problems.within("number of arch.windows", self.windows.len(), 1, 16);
        problems.require(self.heads * self.head_width == channels, || {
            format!(
                "arch.heads and arch.head_width: expected a product of {channels}, the map's channels, found {} x {}",
                self.heads, self.head_width
            )
        });
        for (index, window) in self.windows.iter().enumerate() {
            let at = |key: &str| format!("arch.windows[{index}].{key}");
            problems.within(&at("side"), window.side, 1, 64);
            problems.within(&at("heads"), window.heads, 1, 256);
            problems.within(&at("head_width"), window.head_width, 1, 4096);
            let fits = window.side > 0 && rows.is_multiple_of(window.side) && columns.is_multiple_of(window.side);
            problems.require(fits, || {
                format!(
                    "{}: expected a divisor of the map's {rows} rows and {columns} columns, found {}",
                    at("side"),
                    window.side
                )
            });
        }
    }
}
