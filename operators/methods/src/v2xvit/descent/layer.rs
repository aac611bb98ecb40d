//! Linear layers and norms that gradients lead back through.

use realo_kernels::cells::{Linear, line, line_mut, packed};
use realo_kernels::conv::{Isa, Map};
use realo_kernels::math::{product, sum};
use realo_kernels::simd::dispatch;

use super::super::norm::{LAYER_NORM_EPS, Norm};
use super::super::tiles::Worker;
use super::rows::add_rows;
use super::sums::Sums;

/// The way back through a linear layer.
pub struct LinearBack {
    /// From what the layer gives to what it reads.
    turned: Linear<f32>,
    weights: String,
    bias: Option<String>,
}

impl LinearBack {
    /// `layer`: `[outputs, inputs]` and, as many as outputs, biases.
    pub fn new(key: &str, layer: &(Vec<f32>, Vec<f32>), has_bias: bool, isa: Isa) -> Self {
        let (weights, bias) = layer;
        let (outputs, inputs) = (bias.len(), weights.len() / bias.len());
        let column = |input: usize| weights[input..].iter().step_by(inputs).copied();
        let turned = (0..inputs).flat_map(column).collect();
        LinearBack {
            turned: packed(turned, vec![0.0; inputs], [outputs, 1], isa),
            weights: format!("{key}.weight"),
            bias: has_bias.then(|| format!("{key}.bias")),
        }
    }

    /// The gradient of what the layer read, from that of what it gave.
    pub fn run(&self, from: &Map<f32>, gradient: &Map<f32>, sums: &mut Sums, worker: &mut Worker<f32>) -> Map<f32> {
        let [outputs, inputs] = [gradient.channels, from.channels];
        let of_weights = sums.of(&self.weights, outputs * inputs);
        add_products(line(gradient), line(from), inputs, of_weights);
        if let Some(bias) = &self.bias {
            add_cells(line(gradient), sums.of(bias, outputs));
        }
        worker.run(&self.turned, gradient)
    }
}

dispatch! {
    /// Adds products of cells' gradients and inputs to `[outputs, inputs]`.
    fn add_products(gradient: &[f32], from: &[f32], inputs: usize, to: &mut [f32]) {
        let (outputs, cells) = (to.len() / inputs, from.len() / inputs);
        for (output, to) in to.chunks_exact_mut(inputs).enumerate() {
            add_rows(cells, |cell| gradient[cell * outputs + output], |cell| &from[cell * inputs..][..inputs], to);
        }
    }
}

dispatch! {
    /// Adds cells to a sum of each channel.
    fn add_cells(cells: &[f32], to: &mut [f32]) {
        let channels = to.len();
        add_rows(cells.len() / channels, |_| 1.0, |cell| &cells[cell * channels..][..channels], to);
    }
}

/// The way back through the norm of cells.
pub struct NormBack {
    weights: String,
    bias: String,
}

impl NormBack {
    pub fn new(key: &str) -> Self {
        NormBack {
            weights: format!("{key}.weight"),
            bias: format!("{key}.bias"),
        }
    }

    /// The gradient of the cells that a norm read, from that of what it gave.
    pub fn run(
        &self,
        norm: &Norm,
        from: &Map<f32>,
        gradient: &Map<f32>,
        sums: &mut Sums,
        worker: &mut Worker<f32>,
    ) -> Map<f32> {
        let mut to = worker.single(from.columns, from.channels);
        self.cells(norm, [line(from), line(gradient)], sums, line_mut(&mut to));
        to
    }

    /// As [`NormBack::run`], of cells one after the other.
    pub fn cells(&self, norm: &Norm, read: [&[f32]; 2], sums: &mut Sums, to: &mut [f32]) {
        let [mut of_weights, mut of_bias] = [(); 2].map(|()| vec![0.0; norm.weight.len()]);
        normalize_back(read, &norm.weight, [&mut of_weights, &mut of_bias], to);
        sums.add(&self.weights, &of_weights);
        sums.add(&self.bias, &of_bias);
    }
}

dispatch! {
    /// `read`: cells, and gradients of what their norm gave; `sums`: of its weights and biases.
    fn normalize_back(read: [&[f32]; 2], weight: &[f32], sums: [&mut [f32]; 2], to: &mut [f32]) {
        let [of_weight, of_bias] = sums;
        let channels = weight.len();
        let count = channels as f32;
        let [mut normed, mut along] = [(); 2].map(|()| vec![0.0; channels]);
        let cells = read[0].chunks_exact(channels).zip(read[1].chunks_exact(channels));
        for ((cell, gradient), to) in cells.zip(to.chunks_exact_mut(channels)) {
            let mean = sum(cell) / count;
            normed.iter_mut().zip(cell).for_each(|(normed, value)| *normed = value - mean);
            let factor = 1.0 / (product(&normed, &normed) / count + LAYER_NORM_EPS).sqrt();
            normed.iter_mut().for_each(|normed| *normed *= factor);
            of_bias.iter_mut().zip(gradient).for_each(|(sum, gradient)| *sum += gradient);
            let numbers = of_weight.iter_mut().zip(gradient).zip(&normed);
            numbers.for_each(|((sum, gradient), normed)| *sum += gradient * normed);
            let numbers = along.iter_mut().zip(gradient).zip(weight);
            numbers.for_each(|((along, gradient), weight)| *along = gradient * weight);
            let (mean, slope) = (sum(&along) / count, product(&along, &normed) / count);
            for ((to, along), normed) in to.iter_mut().zip(&along).zip(&normed) {
                *to = factor * (along - mean - normed * slope);
            }
        }
    }
}
