//! The weighted mean on tensors.

use candle_core::{Result, Tensor};
use realo_methods::tensors::Placed;
use realo_methods::tensors::ops::sigmoid;

/// The mean of maps, `[rows, columns, channels]`, the ego's first; `logits` say by channel how much others count.
pub fn mean(logits: &Tensor, maps: &[Placed]) -> Result<Tensor> {
    let share = sigmoid(logits)?.reshape((1, 1, ()))?;
    let mut sum = maps[0].map.clone();
    let mut count = sum.ones_like()?;
    for Placed { map, covered, .. } in &maps[1..] {
        sum = (sum + map.broadcast_mul(covered)?.broadcast_mul(&share)?)?;
        count = (count + covered.broadcast_mul(&share)?)?;
    }
    sum / count
}
