//! Maps with channels first, as convolutions take them.

use candle_core::{Result, Tensor};

/// A map with channels first, from `[rows, columns, channels]`.
pub fn planes(map: &Tensor) -> Result<Tensor> {
    map.permute((2, 0, 1))?.unsqueeze(0)?.contiguous()
}

/// A map with channels last, `[rows, columns, channels]`.
pub fn cells(map: &Tensor) -> Result<Tensor> {
    map.squeeze(0)?.permute((1, 2, 0))?.contiguous()
}
