//! Initial weights of a compressor: the principal components of the encoder's maps. From random numbers it would take thousands of steps
//! to come so far.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, SymmetricEigen};
use realo_methods::Pillarer;
use realo_methods::network::{Network as Inference, NetworkOptions};
use realo_nn::layers::{ConvLayer, Layer};
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
    let has = |layer: &ConvLayer| {
        let count = layer.outputs * layer.inputs * layer.kernel * layer.kernel;
        start
            .find(&layer.weight_key())
            .is_some_and(|numbers| numbers.len() == count)
    };
    if has(encoder) && has(decoder) {
        return Ok(());
    }
    let moments = moments(network, start, seed, frames)?;
    let numbers = moments.principal(encoder.outputs).numbers(&convolutions);
    for (key, numbers) in numbers {
        network.set(network.place(&key), numbers)?;
    }
    Ok(())
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

    /// The directions along which cells differ most.
    fn principal(self, count: usize) -> Principal {
        let weight = self.weight.max(f64::MIN_POSITIVE);
        let mean = self.sum / weight;
        let mut covariance = self.products / weight;
        covariance.syger(-1.0, &mean, &mean, 1.0);
        covariance.fill_upper_triangle_with_lower_triangle();
        let eigen = SymmetricEigen::new(covariance);
        let mut order: Vec<usize> = (0..mean.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        let taken = order.into_iter().take(count).map(|index| {
            let direction = eigen.eigenvectors.column(index).into_owned();
            let deviation = eigen.eigenvalues[index].max(0.0).sqrt();
            (direction, deviation)
        });
        let (directions, deviations) = taken.unzip();
        Principal {
            mean,
            directions,
            deviations,
        }
    }
}

/// A cell as components and back: `component = direction · (cell - mean) + LOWEST · deviation`.
struct Principal {
    mean: DVector<f64>,
    directions: Vec<DVector<f64>>,
    deviations: Vec<f64>,
}

impl Principal {
    /// Numbers of the compressor's layers by key: the first makes components of a cell, the second a cell of them, the third leaves it.
    /// Batch norms have the mean and variance of what reaches them, and change nothing.
    fn numbers(&self, layers: &[ConvLayer]) -> Vec<(String, Vec<f32>)> {
        let lowest: Vec<f64> = self.deviations.iter().map(|deviation| LOWEST * deviation).collect();
        let shifts = self.directions.iter().zip(&lowest);
        let shifts = shifts.map(|(direction, lowest)| lowest - direction.dot(&self.mean));
        let components = self.directions.iter().zip(&lowest);
        let back = components.fold(self.mean.clone(), |back, (direction, lowest)| {
            back - direction * *lowest
        });
        let variance = |channel: usize| {
            let parts = self.directions.iter().zip(&self.deviations);
            parts
                .map(|(direction, deviation)| (direction[channel] * deviation).powi(2))
                .sum::<f64>()
        };
        let squares = self.deviations.iter().map(|deviation| deviation * deviation);
        let (mean, variances) = (
            self.mean.as_slice(),
            (0..self.mean.len()).map(variance).collect::<Vec<f64>>(),
        );
        let weights: [&dyn Fn(usize, usize) -> f64; 3] = [
            &|output, input| self.directions[output][input],
            &|output, input| self.directions[input][output],
            &|output, input| f64::from(u8::from(output == input)),
        ];
        let biases = [shifts.collect(), back.as_slice().to_vec(), vec![0.0; mean.len()]];
        let means = [&lowest[..], mean, mean];
        let variances = [squares.collect(), variances.clone(), variances];
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
        let numbers = moments.principal(2).numbers(&layers);
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
}
