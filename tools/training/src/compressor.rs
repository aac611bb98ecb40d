//! Initial weights of a compressor: the principal components of what the layers after the fusion make of the encoder's maps. From random
//! numbers it would take thousands of steps to come so far.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use realo_methods::Pillarer;
use realo_methods::network::{Network as Inference, NetworkOptions};
use realo_nn::layers::{ConvLayer, Layer, Layers};
use realo_nn::tensors::{Role, norm_key};
use realo_nn::weights::{BATCH_NORM_EPS, Weights};

use crate::TrainError;
use crate::data::{Augmentation, Frames, PlacedSweep, Scene};
use crate::fusing::beginning;
use crate::network::Network;
use crate::random::Stream;
use crate::teacher::FLOOR;

/// Frames whose agents' maps are looked at.
const FRAMES: usize = 16;
/// Standard deviations below the mean at which ReLU cuts a component off.
const LOWEST: f64 = 4.0;
/// Weight of directions that no layer reads, as a share of the mean one.
const UNREAD: f64 = 1e-3;

/// Gives the compressor of a network, if it has one that `start` lacks, the numbers to begin with.
///
/// # Errors
/// [`TrainError`] if a frame cannot be had or a layer fails.
pub(crate) fn begin(
    network: &mut Network,
    start: &Weights,
    seed: u64,
    frames: &Arc<dyn Frames>,
) -> Result<(), TrainError> {
    let layers = network.layers();
    let steps = layers.between(&[layers.own], &[layers.restored]);
    let convolutions = steps.iter().map(|step| match &step.layer {
        Layer::Convolution(layer) => Some(layer.clone()),
        _ => None,
    });
    let convolutions: Vec<ConvLayer> = convolutions.flatten().collect();
    // A detector alone and a fusion of whole maps have none.
    let [encoder, decoder, _] = &convolutions[..] else {
        assert!(convolutions.is_empty(), "a compressor of {} layers", convolutions.len());
        return Ok(());
    };
    if fitting(start, encoder).is_some() && fitting(start, decoder).is_some() {
        return Ok(());
    }
    let moments = moments(network, start, seed, frames)?;
    let principal = moments.principal(encoder.outputs, &readers(layers, start));
    let numbers = principal.numbers(&convolutions);
    for (key, numbers) in numbers {
        network.set(network.place(&key), numbers)?;
    }
    Ok(())
}

/// The weights of a layer that begin as given; others have its key and another shape.
fn fitting<'a>(start: &'a Weights, layer: &ConvLayer) -> Option<&'a [f32]> {
    let count = layer.outputs * layer.inputs * layer.kernel * layer.kernel;
    start.find(&layer.weight_key()).filter(|numbers| numbers.len() == count)
}

/// How much a difference of two cells changes what the convolutions behind the fusion make of them, as a quadratic form: the sum of
/// `w wᵀ` over their outputs and taps. A little of the identity keeps directions apart that none of them reads.
fn readers(layers: &Layers, start: &Weights) -> DMatrix<f64> {
    let channels = layers.size(layers.fused)[2];
    let mut form = DMatrix::zeros(channels, channels);
    for step in layers.steps().iter().filter(|step| step.from.contains(&layers.fused)) {
        let Layer::Convolution(layer) = &step.layer else {
            continue;
        };
        let Some(weights) = fitting(start, layer) else {
            continue;
        };
        let of_norm = |part: Role| layer.norm.as_ref().and_then(|norm| start.find(&norm_key(norm, part)));
        let factor = |output: usize| match (of_norm(Role::NormWeight), of_norm(Role::RunningVariance)) {
            (Some(weight), Some(variance)) => f64::from(weight[output] / (variance[output] + BATCH_NORM_EPS).sqrt()),
            _ => 1.0,
        };
        let taps = layer.kernel * layer.kernel;
        for (output, weights) in weights.chunks_exact(channels * taps).enumerate() {
            for tap in 0..taps {
                let row = weights.iter().skip(tap).step_by(taps).map(|weight| f64::from(*weight));
                let row = DVector::from_iterator(channels, row);
                form.syger(factor(output).powi(2), &row, &row, 1.0);
            }
        }
    }
    form.fill_upper_triangle_with_lower_triangle();
    let mean = form.trace() / channels as f64;
    let little = if mean > 0.0 { UNREAD * mean } else { 1.0 };
    form + DMatrix::identity(channels, channels) * little
}

/// What the maps of some frames' agents are like; a cell counts as much as the heads are sure that it holds an object.
fn moments(network: &Network, start: &Weights, seed: u64, frames: &Arc<dyn Frames>) -> Result<Moments, TrainError> {
    let mut model = network.model().clone();
    model.arch.set_compression(0);
    let weights = beginning(&model, start, seed)?.weights()?;
    let options = NetworkOptions {
        threads: 1,
        ..NetworkOptions::default()
    };
    let mut inference = Inference::new(&model, &weights, options)?;
    let mut pillarer = Pillarer::beside(&inference, &model, &weights);
    let (how, mut draws) = (Augmentation::none(), Stream::new(0, "compressor", 0));
    let mut moments = Moments::of(model.map_channels());
    let looked_at = frames.len().min(FRAMES);
    for index in (0..looked_at).map(|number| number * frames.len() / looked_at) {
        let frame = frames.load(index)?;
        for agent in &frame.agents {
            let scene = Scene::new(&frame, &[PlacedSweep::exact(agent)], &model, &how, &mut draws);
            let (canvas, _) = pillarer.run(&scene.points());
            let map = inference.encode(canvas)?;
            let shares = inference.confidence(&map)?;
            for (cell, share) in map.data.chunks_exact(map.channels).zip(shares) {
                moments.add(cell, f64::from(share + FLOOR));
            }
        }
    }
    Ok(moments)
}

/// Weighted sums over cells.
struct Moments {
    weight: f64,
    sum: DVector<f64>,
    /// Of products, its lower half.
    products: DMatrix<f64>,
}

impl Moments {
    fn of(channels: usize) -> Self {
        Moments {
            weight: 0.0,
            sum: DVector::zeros(channels),
            products: DMatrix::zeros(channels, channels),
        }
    }

    fn add(&mut self, cell: &[f32], weight: f64) {
        let cell = DVector::from_iterator(cell.len(), cell.iter().map(|value| f64::from(*value)));
        self.weight += weight;
        self.sum.axpy(weight, &cell, 1.0);
        self.products.syger(weight, &cell, &cell, 1.0);
    }

    /// The directions along which cells differ most, differences measured by a quadratic form.
    fn principal(self, count: usize, form: &DMatrix<f64>) -> Principal {
        let weight = self.weight.max(f64::MIN_POSITIVE);
        let mean = self.sum / weight;
        let mut covariance = self.products / weight;
        covariance.syger(-1.0, &mean, &mean, 1.0);
        covariance.fill_upper_triangle_with_lower_triangle();
        let root = by_eigenvalue(form, f64::sqrt);
        let inverse = by_eigenvalue(form, |value| 1.0 / value.sqrt());
        let eigen = SymmetricEigen::new(&root * covariance * &root);
        let mut order: Vec<usize> = (0..mean.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let components = order.into_iter().take(count).map(|index| {
            let direction = eigen.eigenvectors.column(index);
            Component {
                to: &root * direction,
                back: &inverse * direction,
                deviation: eigen.eigenvalues[index].max(0.0).sqrt(),
            }
        });
        Principal {
            components: components.collect(),
            mean,
        }
    }
}

/// The symmetric matrix of the same eigenvectors whose eigenvalues are functions of the given one's.
fn by_eigenvalue(matrix: &DMatrix<f64>, of: impl Fn(f64) -> f64) -> DMatrix<f64> {
    let eigen = SymmetricEigen::new(matrix.clone());
    let values = DMatrix::from_diagonal(&eigen.eigenvalues.map(of));
    &eigen.eigenvectors * values * eigen.eigenvectors.transpose()
}

/// A cell as components and back: `component = to · (cell - mean) + LOWEST · deviation`, and the cell is the mean and the sum of
/// `back · (component - LOWEST · deviation)`.
struct Principal {
    mean: DVector<f64>,
    components: Vec<Component>,
}

struct Component {
    to: DVector<f64>,
    back: DVector<f64>,
    deviation: f64,
}

impl Component {
    fn lowest(&self) -> f64 {
        LOWEST * self.deviation
    }
}

impl Principal {
    /// Numbers of the compressor's layers by key: the first makes components of a cell, the second a cell of them, the third leaves it.
    /// Batch norms have the mean and variance of what reaches them, and change nothing.
    fn numbers(&self, layers: &[ConvLayer]) -> Vec<(String, Vec<f32>)> {
        let (mean, components) = (&self.mean, &self.components);
        let lowest: Vec<f64> = components.iter().map(Component::lowest).collect();
        let shifts = components.iter().map(|of| of.lowest() - of.to.dot(mean)).collect();
        let back = components
            .iter()
            .fold(mean.clone(), |back, of| back - &of.back * of.lowest());
        let variance = |channel: usize| {
            let parts = components.iter().map(|of| (of.back[channel] * of.deviation).powi(2));
            parts.sum::<f64>()
        };
        let variances: Vec<f64> = (0..mean.len()).map(variance).collect();
        let squares = components.iter().map(|of| of.deviation * of.deviation).collect();
        let weights: [&dyn Fn(usize, usize) -> f64; 3] = [
            &|output, input| components[output].to[input],
            &|output, input| components[input].back[output],
            &|output, input| f64::from(u8::from(output == input)),
        ];
        let biases = [shifts, back.as_slice().to_vec(), vec![0.0; mean.len()]];
        let means = [&lowest[..], mean.as_slice(), mean.as_slice()];
        let variances = [squares, variances.clone(), variances];
        let mut numbers = Vec::new();
        for (place, layer) in layers.iter().enumerate() {
            numbers.push((layer.weight_key(), cell_by_cell(layer, weights[place])));
            numbers.extend(layer.bias_key().map(|key| (key, singles(&biases[place]))));
            if let Some(norm) = &layer.norm {
                numbers.extend(unchanging(norm, means[place], &variances[place]));
            }
        }
        numbers
    }
}

fn singles(numbers: &[f64]) -> Vec<f32> {
    numbers.iter().map(|number| *number as f32).collect()
}

/// A batch norm that gives what has this mean and variance as it is.
fn unchanging(norm: &str, mean: &[f64], variance: &[f64]) -> [(String, Vec<f32>); 4] {
    let deviations: Vec<f64> = variance
        .iter()
        .map(|v| (v + f64::from(BATCH_NORM_EPS)).sqrt())
        .collect();
    [
        (Role::NormWeight, singles(&deviations)),
        (Role::NormBias, singles(mean)),
        (Role::RunningMean, singles(mean)),
        (Role::RunningVariance, singles(variance)),
    ]
    .map(|(part, numbers)| (norm_key(norm, part), numbers))
}

/// Weights of a convolution that looks at nothing but the cell itself.
fn cell_by_cell(layer: &ConvLayer, weight: impl Fn(usize, usize) -> f64) -> Vec<f32> {
    let (area, middle) = (layer.kernel * layer.kernel, layer.kernel * layer.kernel / 2);
    let mut numbers = vec![0.0; layer.outputs * layer.inputs * area];
    for output in 0..layer.outputs {
        for input in 0..layer.inputs {
            numbers[(output * layer.inputs + input) * area + middle] = weight(output, input) as f32;
        }
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layer(key: &str, inputs: usize, outputs: usize) -> ConvLayer {
        ConvLayer {
            key: key.into(),
            inputs,
            outputs,
            kernel: 3,
            stride: 1,
            transposed: false,
            bias: true,
            norm: Some(format!("{key}.norm")),
            relu: true,
        }
    }

    /// The middle of a convolution on cells, with its batch norm, by running statistics or those of the cells, and ReLU.
    fn run(layer: &ConvLayer, numbers: &[(String, Vec<f32>)], cells: &[Vec<f32>], by_batch: bool) -> Vec<Vec<f32>> {
        let of = |key: &str| &numbers.iter().find(|(name, _)| name == key).expect("numbers").1;
        let (weight, bias) = (of(&layer.weight_key()), of(&layer.bias_key().expect("it has biases")));
        let part = |part: Role| of(&norm_key(layer.norm.as_ref().expect("a norm"), part));
        let convolved = |cell: &Vec<f32>, output: usize| {
            let products = cell.iter().enumerate();
            let products = products.map(|(input, value)| value * weight[(output * layer.inputs + input) * 9 + 4]);
            products.sum::<f32>() + bias[output]
        };
        let normed = |output: usize| {
            let made: Vec<f32> = cells.iter().map(|cell| convolved(cell, output)).collect();
            let count = made.len() as f32;
            let mean = made.iter().sum::<f32>() / count;
            let variance = made.iter().map(|value| (value - mean).powi(2)).sum::<f32>() / count;
            let (mean, variance) = match by_batch {
                true => (mean, variance),
                false => (part(Role::RunningMean)[output], part(Role::RunningVariance)[output]),
            };
            let factor = part(Role::NormWeight)[output] / (variance + BATCH_NORM_EPS).sqrt();
            let to = part(Role::NormBias)[output];
            made.into_iter()
                .map(move |value| (factor * (value - mean) + to).max(0.0))
                .collect::<Vec<f32>>()
        };
        let channels: Vec<Vec<f32>> = (0..layer.outputs).map(normed).collect();
        (0..cells.len())
            .map(|cell| channels.iter().map(|channel| channel[cell]).collect())
            .collect()
    }

    #[test]
    fn cells_of_a_plane_come_back_from_two_channels() {
        let mut draws = Stream::new(3, "test", 0);
        let cells: Vec<Vec<f32>> = (0..500)
            .map(|_| {
                let [a, b] = [draws.normal(), 0.3 * draws.normal()].map(|value| value as f32);
                vec![9.0 + a, 8.0 - 0.5 * a + b, 7.0 + b, 6.0 + 0.2 * a]
            })
            .collect();
        let mut moments = Moments::of(4);
        cells.iter().for_each(|cell| moments.add(cell, 0.5));
        let layers = [layer("a", 4, 2), layer("b", 2, 4), layer("c", 4, 4)];
        let mut form = DMatrix::identity(4, 4) * 0.5;
        form[(0, 1)] = 0.2;
        form[(1, 0)] = 0.2;
        let numbers = moments.principal(2, &form).numbers(&layers);
        for by_batch in [false, true] {
            let back = layers
                .iter()
                .fold(cells.clone(), |cells, layer| run(layer, &numbers, &cells, by_batch));
            for (cell, back) in cells.iter().zip(&back) {
                let off = cell.iter().zip(back).map(|(a, b)| (a - b).abs());
                assert!(
                    off.fold(0.0, f32::max) < 5e-3,
                    "{cell:?} came back as {back:?}, by_batch {by_batch}"
                );
            }
        }
    }

    #[test]
    fn what_layers_read_crosses_before_what_differs_most() {
        let mut draws = Stream::new(5, "test", 0);
        let cells: Vec<Vec<f32>> = (0..500)
            .map(|_| {
                [3.0, 1.0]
                    .map(|deviation| 20.0 + (deviation * draws.normal()) as f32)
                    .to_vec()
            })
            .collect();
        let mut moments = Moments::of(2);
        cells.iter().for_each(|cell| moments.add(cell, 1.0));
        let layers = [layer("a", 2, 1), layer("b", 1, 2), layer("c", 2, 2)];
        let form = DMatrix::from_diagonal(&DVector::from_vec(vec![0.01, 1.0]));
        let numbers = moments.principal(1, &form).numbers(&layers);
        let back = layers
            .iter()
            .fold(cells.clone(), |cells, layer| run(layer, &numbers, &cells, false));
        for (cell, back) in cells.iter().zip(&back) {
            assert!((cell[1] - back[1]).abs() < 0.2, "{cell:?} came back as {back:?}");
        }
        // Of what differs nine times as much only chance correlation is left.
        let left = back.iter().map(|back| (back[0] - 20.0).powi(2)).sum::<f32>() / 500.0;
        assert!(left < 0.9, "{left} of 9");
    }
}
