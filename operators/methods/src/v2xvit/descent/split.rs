//! The way back through how much windows of each size count.

use realo_kernels::math::product;

use super::super::norm::normalize;
use super::super::windows::Split;
use super::layer::NormBack;
use super::sums::Sums;

/// As [`Split`].
pub struct SplitBack {
    pub first: String,
    pub norm: NormBack,
    pub second: String,
}

impl SplitBack {
    /// The gradient of the mean that counts were made of, from theirs, `[attentions, channels]`.
    pub fn run(&self, split: &Split, mean: &[f32], counts: &[f32], of_counts: &[f32], sums: &mut Sums) -> Vec<f32> {
        let channels = mean.len();
        let wide: Vec<f32> = split
            .first
            .chunks_exact(channels)
            .map(|row| product(row, mean))
            .collect();
        let mut hidden = vec![0.0; channels];
        normalize(&wide, [&split.norm.weight, &split.norm.bias], channels, &mut hidden);
        let mut of_scores = vec![0.0; counts.len()];
        for channel in 0..channels {
            let of = || (channel..counts.len()).step_by(channels);
            let mean: f32 = of().map(|at| counts[at] * of_counts[at]).sum();
            of().for_each(|at| of_scores[at] = counts[at] * (of_counts[at] - mean));
        }
        let active: Vec<f32> = hidden.iter().map(|value: &f32| value.max(0.0)).collect();
        let mut of_hidden = layer_back(&self.second, &split.second, &active, &of_scores, sums);
        let cut = of_hidden.iter_mut().zip(&hidden).filter(|(_, value)| **value <= 0.0);
        cut.for_each(|(gradient, _)| *gradient = 0.0);
        let mut of_wide = vec![0.0; channels];
        self.norm.cells(&split.norm, [&wide, &of_hidden], sums, &mut of_wide);
        layer_back(&self.first, &split.first, mean, &of_wide, sums)
    }
}

/// The gradient of what a layer without biases read.
fn layer_back(key: &str, weights: &[f32], from: &[f32], gradient: &[f32], sums: &mut Sums) -> Vec<f32> {
    let mut of_from = vec![0.0; from.len()];
    let rows = sums.of(&format!("{key}.weight"), weights.len());
    let rows = rows.chunks_exact_mut(from.len()).zip(weights.chunks_exact(from.len()));
    for ((of_weights, weights), gradient) in rows.zip(gradient) {
        for (((of_weight, weight), from), of_from) in of_weights.iter_mut().zip(weights).zip(from).zip(&mut of_from) {
            *of_weight += gradient * from;
            *of_from += gradient * weight;
        }
    }
    of_from
}
