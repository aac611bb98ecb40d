//! The maximum on tensors.

use candle_core::{Result, Tensor};

use crate::tensors::Placed;

/// The largest of each feature, `[rows, columns, channels]`; the first map is the ego's.
pub fn max(maps: &[Placed]) -> Result<Tensor> {
    let present = |placed: &Placed| placed.map.broadcast_add(&placed.absence()?);
    let all = maps.iter().map(present).collect::<Result<Vec<Tensor>>>()?;
    Tensor::stack(&all, 0)?.max(0)
}
