//! What a network says.

use realo_nn::decode::score;

/// What the detection head says at every anchor; anchors run by (class, rotation).
#[derive(Clone, Debug, PartialEq)]
pub struct Heads {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Scores before the sigmoid, `[rows, columns, anchors, classes]`.
    pub scores: Vec<f32>,
    /// Boxes as deltas to their anchors, `[rows, columns, anchors, 7]`.
    pub deltas: Vec<f32>,
}

impl Heads {
    /// The score of the surest class and anchor of each cell, 0 to 1, `[rows, columns]`.
    pub fn confidence(&self) -> Vec<f32> {
        let cells = self.scores.chunks_exact(self.scores.len() / (self.rows * self.columns));
        let max = cells.map(|scores| scores.iter().copied().fold(f32::NEG_INFINITY, f32::max));
        max.map(score).collect()
    }
}
