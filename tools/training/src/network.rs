//! The trainable PointPillars detector of a model.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use candle_core::{Tensor, TensorId};
use rayon::prelude::*;
use realo_nn::loss::{HeadMaps, Loss, Settings, loss};
use realo_nn::model::Model;
use realo_nn::targets::Targets;
use realo_nn::weights::{Weights, WeightsError, expected};

use crate::layers::{
    Bias, Conv, MapShape, Moments, Norm, PillarBatch, PillarLayer, Pointwise, Statistics, WeightOrder, buffer, tensor,
    with_numbers,
};
use crate::random::Stream;
use crate::tape::Tape;

/// Share of a batch's statistics in the running ones.
const MOMENTUM: f32 = 0.01;

/// Score that every anchor begins with, so that background does not drown the first steps (Lin et al. 2017, Sec. 4.1).
const PRIOR: f64 = 0.01;

/// A tensor of the network, under the key that its file of weights has.
#[derive(Clone, Debug)]
pub struct Parameter {
    /// Key.
    pub name: String,
    /// Numbers.
    pub value: Tensor,
    /// Whether gradients move it; running statistics follow the batches instead.
    pub trained: bool,
    /// Whether large values are discouraged: weights of layers, not biases and norms.
    pub decayed: bool,
}

/// Layers as indices of their first parameter: weight, or batch norm's weight, bias, running mean, running variance.
#[derive(Clone, Debug)]
struct Plan {
    pillars: Normed,
    blocks: Vec<Vec<(usize, Normed)>>,
    deblocks: Vec<Normed>,
    shrink: Vec<usize>,
    class_head: usize,
    box_head: usize,
}

#[derive(Clone, Copy, Debug)]
struct Normed {
    weight: usize,
    norm: usize,
}

/// The network: its model and all tensors in the order of its weights.
#[derive(Clone, Debug)]
pub struct Network {
    model: Model,
    parameters: Vec<Parameter>,
    plan: Plan,
}

/// What the heads give for a batch, as maps with a border.
pub struct Heads {
    /// Logits, `[batch, rows + 2, columns + 2, anchors * classes]`.
    pub scores: Tensor,
    /// Deltas, `[batch, rows + 2, columns + 2, anchors * 7]`.
    pub deltas: Tensor,
    /// Each batch norm (index of its first parameter) with the statistics that it used.
    statistics: Vec<(usize, Statistics)>,
}

/// Gradients by parameter, in the network's order; `None` for what is not trained.
pub type Gradients = Vec<Option<Vec<f32>>>;

/// What one training step found.
pub struct Pass {
    /// Loss of each sample; the batch's is the sum.
    pub losses: Vec<Loss>,
    /// Gradients of the sum.
    pub gradients: Gradients,
}

impl Network {
    /// A network with random weights.
    ///
    /// # Errors
    /// Those of candle.
    pub fn random(model: &Model, seed: u64) -> candle_core::Result<Self> {
        Self::with(model, |index, name, shape| {
            Ok(initial(&mut Stream::new(seed, "weights", index as u64), name, shape))
        })
    }

    /// A network with the weights of a file.
    ///
    /// # Errors
    /// [`WeightsError`] if they do not fit the model.
    pub fn read(model: &Model, path: &Path) -> Result<Self, WeightsError> {
        let weights = Weights::read(path, model)?;
        let network = Self::with(model, |_, name, _| Ok(weights.tensor(name).to_vec()));
        Ok(network.expect("the shapes of weights that fit the model"))
    }

    /// A network of given numbers for each key.
    pub(crate) fn with(
        model: &Model,
        mut values: impl FnMut(usize, &str, &[usize]) -> candle_core::Result<Vec<f32>>,
    ) -> candle_core::Result<Self> {
        let mut parameters = Vec::new();
        for (index, (name, shape)) in expected(model).into_iter().enumerate() {
            parameters.push(Parameter {
                value: tensor(values(index, &name, &shape)?, shape.clone())?,
                trained: !name.contains(".running_"),
                decayed: shape.len() > 1,
                name,
            });
        }
        Ok(Network {
            model: model.clone(),
            plan: Plan::of(model),
            parameters,
        })
    }

    /// Whether all its numbers are finite.
    pub(crate) fn is_finite(&self) -> bool {
        let finite = |p: &Parameter| with_numbers(&p.value, |values| Ok(values.iter().all(|v| v.is_finite())));
        self.parameters.iter().all(|p| finite(p).unwrap_or(false))
    }

    /// The model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// All tensors, in the order of the file of weights.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    pub(crate) fn set(&mut self, index: usize, values: Vec<f32>) -> candle_core::Result<()> {
        let parameter = &mut self.parameters[index];
        parameter.value = tensor(values, parameter.value.shape().clone())?;
        Ok(())
    }

    /// The forward pass. In training, batch norms use the batch's statistics.
    ///
    /// # Errors
    /// Those of the layers.
    pub fn forward(&self, tape: &mut Tape, batch: &Arc<PillarBatch>, training: bool) -> candle_core::Result<Heads> {
        let mut run = Run {
            network: self,
            tape,
            training,
            statistics: Vec::new(),
        };
        let plan = &self.plan;
        let mut map = run.pillars(plan.pillars, batch)?;
        let mut enlarged = Vec::new();
        for (block, (layers, deblock)) in plan.blocks.iter().zip(&plan.deblocks).enumerate() {
            for (index, (_, layer)) in layers.iter().enumerate() {
                let stride = if index == 0 {
                    self.model.backbone.strides[block]
                } else {
                    1
                };
                let conv = run.tape.apply2(Conv { stride }, &map, self.value(layer.weight))?;
                map = run.norm(layer.norm, conv)?;
            }
            let op = Pointwise {
                order: WeightOrder::Transposed,
            };
            let up = run.tape.apply2(op, &map, self.value(deblock.weight))?;
            enlarged.push(run.norm(deblock.norm, up)?);
        }
        map = run.tape.join(&enlarged)?;
        drop(enlarged);
        for (&weight, shrink) in plan.shrink.iter().zip(&self.model.shrink) {
            map = run.biased(weight, shrink.kernel, true, &map)?;
        }
        let scores = run.biased(plan.class_head, 1, false, &map)?;
        let deltas = run.biased(plan.box_head, 1, false, &map)?;
        Ok(Heads {
            scores,
            deltas,
            statistics: run.statistics,
        })
    }

    /// Forward and backward pass of one batch with the targets of its samples; the running statistics move on.
    ///
    /// # Errors
    /// Those of the layers.
    pub fn pass(
        &mut self,
        batch: &Arc<PillarBatch>,
        targets: &[Targets],
        settings: &Settings,
    ) -> candle_core::Result<Pass> {
        let mut tape = Tape::new();
        let heads = self.forward(&mut tape, batch, true)?;
        let (losses, of_scores, of_deltas) = losses(&heads, targets, settings)?;
        let results = vec![(heads.scores.id(), of_scores), (heads.deltas.id(), of_deltas)];
        self.follow(&heads.statistics)?;
        drop((heads.scores, heads.deltas));
        let mut gradients = tape.backward(results)?;
        let gradients = self
            .parameters
            .iter()
            .map(|parameter| self.gradient(&mut gradients, parameter));
        Ok(Pass {
            losses,
            gradients: gradients.collect::<candle_core::Result<_>>()?,
        })
    }

    fn gradient(
        &self,
        gradients: &mut HashMap<TensorId, Tensor>,
        parameter: &Parameter,
    ) -> candle_core::Result<Option<Vec<f32>>> {
        match gradients.remove(&parameter.value.id()) {
            Some(gradient) if parameter.trained => with_numbers(&gradient, |g| Ok(Some(g.to_vec()))),
            _ => Ok(None),
        }
    }

    /// Moves the running statistics towards a batch's.
    fn follow(&mut self, statistics: &[(usize, Statistics)]) -> candle_core::Result<()> {
        for (norm, statistics) in statistics {
            let Some(moments) = statistics.moments() else { continue };
            // The running variance estimates that of all data.
            let unbiased = moments.count as f32 / moments.count.saturating_sub(1).max(1) as f32;
            let variance: Vec<f32> = moments.variance.iter().map(|v| v * unbiased).collect();
            for (index, new) in [(norm + 2, &moments.mean), (norm + 3, &variance)] {
                let moved = with_numbers(self.value(index), |old| {
                    Ok(old
                        .iter()
                        .zip(new)
                        .map(|(old, new)| old + MOMENTUM * (new - old))
                        .collect::<Vec<f32>>())
                })?;
                self.set(index, moved)?;
            }
        }
        Ok(())
    }

    fn value(&self, index: usize) -> &Tensor {
        &self.parameters[index].value
    }
}

/// A forward pass.
struct Run<'a> {
    network: &'a Network,
    tape: &'a mut Tape,
    training: bool,
    statistics: Vec<(usize, Statistics)>,
}

impl Run<'_> {
    fn statistics(&mut self, norm: usize) -> candle_core::Result<Statistics> {
        let statistics = if self.training {
            Statistics::batch()
        } else {
            let [mean, variance] =
                [norm + 2, norm + 3].map(|index| with_numbers(self.network.value(index), |values| Ok(values.to_vec())));
            Statistics::Running(Moments {
                mean: mean?,
                variance: variance?,
                count: 1,
            })
        };
        self.statistics.push((norm, statistics.clone()));
        Ok(statistics)
    }

    fn pillars(&mut self, layer: Normed, batch: &Arc<PillarBatch>) -> candle_core::Result<Tensor> {
        let op = PillarLayer::new(batch.clone(), self.statistics(layer.norm)?);
        let [linear, weight, bias] = [layer.weight, layer.norm, layer.norm + 1].map(|index| self.network.value(index));
        self.tape.apply3(op, linear, weight, bias)
    }

    fn norm(&mut self, norm: usize, map: Tensor) -> candle_core::Result<Tensor> {
        let op = Norm {
            statistics: self.statistics(norm)?,
        };
        let [weight, bias] = [norm, norm + 1].map(|index| self.network.value(index));
        self.tape.apply3(op, &map, weight, bias)
    }

    fn biased(&mut self, weight: usize, kernel: usize, relu: bool, map: &Tensor) -> candle_core::Result<Tensor> {
        let (w, bias) = (self.network.value(weight), self.network.value(weight + 1));
        let out = match kernel {
            1 => self.tape.apply2(
                Pointwise {
                    order: WeightOrder::Plain,
                },
                map,
                w,
            )?,
            _ => self.tape.apply2(Conv { stride: 1 }, map, w)?,
        };
        self.tape.apply2(Bias { relu }, &out, bias)
    }
}

impl Plan {
    /// Follows the order of [`expected`].
    fn of(model: &Model) -> Self {
        let mut next = 0;
        let mut take = |count: usize| {
            next += count;
            next - count
        };
        let mut normed = || Normed {
            weight: take(1),
            norm: take(4),
        };
        let pillars = normed();
        let blocks = model
            .backbone
            .layers
            .iter()
            .map(|layers| (0..=*layers).map(|i| (i, normed())).collect())
            .collect();
        let deblocks = model.backbone.layers.iter().map(|_| normed()).collect();
        let shrink = model.shrink.iter().map(|_| take(2)).collect();
        Plan {
            pillars,
            blocks,
            deblocks,
            shrink,
            class_head: take(2),
            box_head: take(2),
        }
    }
}

/// Random numbers for a tensor, by its key and shape.
fn initial(draws: &mut Stream, name: &str, shape: &[usize]) -> Vec<f32> {
    let count = shape.iter().product();
    let normal = |draws: &mut Stream, deviation: f64| (0..count).map(|_| (deviation * draws.normal()) as f32).collect();
    match (name, shape) {
        ("cls_head.bias", _) => vec![-((1.0 - PRIOR) / PRIOR).ln() as f32; count],
        ("cls_head.weight" | "reg_head.weight", _) => normal(draws, 0.01),
        (_, [_]) if name.ends_with("norm.weight") || name.ends_with("running_var") => vec![1.0; count],
        (_, [_]) if is_norm_weight(name) => vec![1.0; count],
        (_, [_]) => vec![0.0; count],
        // Each output of a transposed convolution sees one cell of the input.
        (_, [ins, _, _, _]) if name.contains("deblocks") => normal(draws, (2.0 / *ins as f64).sqrt()),
        // Variance is kept through ReLU (He et al. 2015).
        (_, [_, rest @ ..]) => normal(draws, (2.0 / rest.iter().product::<usize>() as f64).sqrt()),
        (_, []) => vec![0.0; count],
    }
}

/// One-dimensional weights belong to batch norms.
fn is_norm_weight(name: &str) -> bool {
    name.ends_with(".weight")
}

/// Each sample's loss, and the gradients of their sum as maps with a border.
fn losses(heads: &Heads, targets: &[Targets], settings: &Settings) -> candle_core::Result<(Vec<Loss>, Tensor, Tensor)> {
    let (scores, deltas) = (MapShape::of(heads.scores.shape())?, MapShape::of(heads.deltas.shape())?);
    if scores.batch != targets.len() {
        candle_core::bail!("{} samples have {} targets", scores.batch, targets.len());
    }
    let (mut of_scores, mut of_deltas) = (buffer(scores.len()), buffer(deltas.len()));
    let losses = with_numbers(&heads.scores, |score_values| {
        with_numbers(&heads.deltas, |delta_values| {
            let gradients = of_scores
                .par_chunks_mut(scores.image())
                .zip(of_deltas.par_chunks_mut(deltas.image()));
            let samples = targets.par_iter().zip(gradients).enumerate();
            Ok(samples
                .map(|(image, (targets, (of_scores, of_deltas)))| {
                    let (mut a, mut b) = (inner(&scores, score_values, image), inner(&deltas, delta_values, image));
                    let (mut da, mut db) = (vec![0.0; a.len()], vec![0.0; b.len()]);
                    let maps = HeadMaps {
                        scores: &*a,
                        deltas: &*b,
                    };
                    let mut gradient = HeadMaps {
                        scores: &mut *da,
                        deltas: &mut *db,
                    };
                    let loss = loss(&maps, targets, settings, scores.batch, &mut gradient);
                    (a, b) = (da, db);
                    outer(&scores, of_scores, &a);
                    outer(&deltas, of_deltas, &b);
                    loss
                })
                .collect())
        })
    })?;
    Ok((
        losses,
        tensor(of_scores, scores.dims())?,
        tensor(of_deltas, deltas.dims())?,
    ))
}

/// A sample's cells without the border.
pub(crate) fn inner(map: &MapShape, data: &[f32], image: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(map.rows * map.columns * map.channels);
    (0..map.rows).for_each(|row| out.extend_from_slice(map.row(data, image, row)));
    out
}

/// Writes cells into one image inside its border, which is already 0.
fn outer(map: &MapShape, image: &mut [f32], cells: &[f32]) {
    for (row, cells) in cells.chunks_exact(map.columns * map.channels).enumerate() {
        let at = map.at(0, row as isize, 0);
        image[at..at + cells.len()].copy_from_slice(cells);
    }
}
