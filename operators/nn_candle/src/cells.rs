//! Fusions that look at one cell at a time, as `realo_nn::fuse` says them. An agent takes no part where its map does not reach.

use candle_core::{D, Result, Tensor, bail};

use crate::ops::softmax;
use crate::warp::Placed;

/// The largest of each feature, `[rows, columns, channels]`; the first map is the ego's.
pub(crate) fn max(maps: &[Placed]) -> Result<Tensor> {
    let present = |placed: &Placed| placed.map.broadcast_add(&placed.absence()?);
    let all = maps.iter().map(present).collect::<Result<Vec<Tensor>>>()?;
    Tensor::stack(&all, 0)?.max(0)
}

/// Attention of the ego, `[rows, columns, channels]`, with products scaled for `width` channels; the first map is the ego's.
pub(crate) fn attention(maps: &[Placed], width: usize) -> Result<Tensor> {
    let Some(ego) = maps.first() else {
        bail!("a fusion of no maps: expected the ego's at least");
    };
    let query = (&ego.map / (width as f64).sqrt())?;
    let score = |placed: &Placed| query.mul(&placed.map)?.sum_keepdim(D::Minus1)? + placed.absence()?;
    let scores = maps.iter().map(score).collect::<Result<Vec<Tensor>>>()?;
    let all: Vec<&Tensor> = maps.iter().map(|placed| &placed.map).collect();
    let weights = softmax(&Tensor::stack(&scores, 0)?, 0)?;
    Tensor::stack(&all, 0)?.broadcast_mul(&weights)?.sum(0)
}
