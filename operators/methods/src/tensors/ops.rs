//! Operations that several networks share.

use candle_core::{D, Result, Tensor};

/// The softmax along a dimension.
pub fn softmax(scores: &Tensor, dimension: usize) -> Result<Tensor> {
    // The largest only keeps numbers small: nothing depends on it.
    let max = scores.detach().max_keepdim(dimension)?;
    let weights = scores.broadcast_sub(&max)?.exp()?;
    weights.broadcast_div(&weights.sum_keepdim(dimension)?)
}

/// The layer norm of the last dimension.
pub fn layer_norm(from: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> Result<Tensor> {
    let centered = from.broadcast_sub(&from.mean_keepdim(D::Minus1)?)?;
    let variance = centered.sqr()?.mean_keepdim(D::Minus1)?;
    let normed = centered.broadcast_div(&(variance + eps)?.sqrt()?)?;
    normed.broadcast_mul(weight)?.broadcast_add(bias)
}

/// The sigmoid.
pub fn sigmoid(from: &Tensor) -> Result<Tensor> {
    (from.neg()?.exp()? + 1.0)?.recip()
}
