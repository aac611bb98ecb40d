//! Attention within windows on tensors, of several sizes, and how much each of them counts.

use candle_core::{Result, Tensor};

use super::settings::Window;
use super::tensor_parts::Transformer;
use crate::tensors::ops::softmax;

impl Transformer<'_> {
    /// What all windows give a map.
    pub fn over_windows(&self, key: &str, map: &Tensor) -> Result<Tensor> {
        let normed = self.norm(&format!("{key}.norm"), map)?;
        let windows = self.settings.windows.iter().enumerate();
        let made = windows.map(|(index, window)| self.within(&format!("{key}.fn.pwmsa.{index}"), *window, &normed));
        self.split(&format!("{key}.fn.split_attn"), &made.collect::<Result<Vec<Tensor>>>()?)
    }

    /// Attention within windows of one size.
    fn within(&self, key: &str, window: Window, normed: &Tensor) -> Result<Tensor> {
        let Window {
            side,
            heads,
            head_width,
        } = window;
        let [down, across] = self.size.map(|cells| cells / side);
        let area = side * side;
        let all = self.tensors.linear(&format!("{key}.to_qkv"), normed)?;
        // From cells with queries, keys and values to each of these with its windows, heads and their cells.
        let all = all.reshape(vec![down, side, across, side, 3, heads, head_width])?;
        let all = all.permute(vec![4, 0, 2, 5, 1, 3, 6])?.contiguous()?;
        let all = all.reshape((3, down * across * heads, area, head_width))?;
        let [queries, keys, values] = [all.get(0)?, all.get(1)?, all.get(2)?];
        let scores = (queries.matmul(&keys.t()?)? / (head_width as f64).sqrt())?;
        let positions = self.positions(&format!("{key}.pos_embedding"), side)?;
        let weights = softmax(&scores.broadcast_add(&positions)?, 2)?;
        let attended = weights.matmul(&values)?;
        let attended = attended.reshape(vec![down, across, heads, side, side, head_width])?;
        let attended = attended.permute(vec![0, 3, 1, 4, 2, 5])?.contiguous()?;
        let attended = attended.reshape((normed.dim(0)?, window.width()))?;
        self.tensors.linear(&format!("{key}.to_out.0"), &attended)
    }

    /// `[cells of a window, cells of a window]`: what the offset from who asks to who is asked adds to a score.
    fn positions(&self, key: &str, side: usize) -> Result<Tensor> {
        let table = self.tensors.get(key)?;
        let area = side * side;
        let offset = |asks: usize, asked: usize| {
            let along = |asks: usize, asked: usize| asked + side - 1 - asks;
            along(asks / side, asked / side) * (2 * side - 1) + along(asks % side, asked % side)
        };
        let pairs = (0..area).flat_map(|asks| (0..area).map(move |asked| (asks, asked)));
        let offsets: Vec<u32> = pairs.map(|(asks, asked)| offset(asks, asked) as u32).collect();
        let offsets = Tensor::from_vec(offsets, area * area, table.device())?;
        table.flatten_all()?.index_select(&offsets, 0)?.reshape((area, area))
    }

    /// The sum of what was made, each by how much it counts in each channel.
    fn split(&self, key: &str, made: &[Tensor]) -> Result<Tensor> {
        let all = Tensor::stack(made, 0)?;
        let mean = all.sum(0)?.mean_keepdim(0)?;
        let hidden = self.tensors.linear(&format!("{key}.fc1"), &mean)?;
        let hidden = self.norm(&format!("{key}.bn1"), &hidden)?.relu()?;
        let counts = self.tensors.linear(&format!("{key}.fc2"), &hidden)?;
        let counts = softmax(&counts.reshape((made.len(), 1, ()))?, 0)?;
        all.broadcast_mul(&counts)?.sum(0)
    }
}
