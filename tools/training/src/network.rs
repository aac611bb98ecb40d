//! The trainable PointPillars detector of a model.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use crate::loss::{HeadMaps, Loss, LossWeights, loss};
use crate::targets::Targets;
use candle_core::{Tensor, TensorId};
use rayon::prelude::*;
use realo_methods::Model;
use realo_nn::layers::{ConvLayer, Layer, Layers, MapId, PointLayer, Step};
use realo_nn::model::REFINE;
use realo_nn::tensors::{Role, TensorSpec, norm_key};

use crate::data::{Batch, Member};
use crate::freeze::Frozen;
use crate::fusing::fuse;
use crate::layers::{
    Arithmetic, Bias, Conv, MapShape, Moments, Norm, PillarBatch, PillarLayer, Pointwise, Statistics, WeightOrder,
    buffer, tensor, with_numbers,
};
use crate::random::Stream;
use crate::tape::Tape;
use crate::teacher::Lesson;

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
    /// Whether gradients move it; running statistics follow the batches instead, and an encoder that is given stays.
    pub trained: bool,
    /// Whether large values are discouraged: weights of layers, not biases and norms.
    pub decayed: bool,
}

/// The network: its model, its layers and all tensors in the order of its weights.
#[derive(Clone, Debug)]
pub struct Network {
    model: Model,
    layers: Layers,
    parameters: Vec<Parameter>,
    /// Where a key's tensor is.
    places: HashMap<String, usize>,
    /// Of the products of convolutions, forward and backward.
    pub(crate) arithmetic: Arithmetic,
    /// Whether batch norms take the running statistics in training too, which then stay.
    pub(crate) frozen_norms: bool,
}

/// What the heads give for a batch, as maps with a border.
pub struct Heads {
    /// Logits, `[batch, rows + 2, columns + 2, anchors * classes]`.
    pub scores: Tensor,
    /// Deltas, `[batch, rows + 2, columns + 2, anchors * 7]`.
    pub deltas: Tensor,
    /// The map that they read.
    pub(crate) fused: Tensor,
    /// Each batch norm, by its key, with the statistics that it used.
    statistics: Vec<(String, Statistics)>,
}

/// Gradients by parameter, in the network's order; `None` for what is not trained.
pub type Gradients = Vec<Option<Vec<f32>>>;

/// What one training step found.
pub struct Pass {
    /// Loss of each sample; the batch's is the sum.
    pub losses: Vec<Loss>,
    /// Loss of the lessons of the batch, which is added to that.
    pub lesson: f64,
    /// Gradients of the sum.
    pub gradients: Gradients,
}

impl Network {
    /// A network with random weights.
    ///
    /// # Errors
    /// Those of candle.
    pub fn random(model: &Model, seed: u64) -> candle_core::Result<Self> {
        Self::beginning(model, seed, |_| None)
    }

    /// A network that begins with given numbers for each tensor, and with random ones where there are none.
    ///
    /// # Errors
    /// Those of candle.
    pub(crate) fn beginning<'a>(
        model: &Model,
        seed: u64,
        given: impl Fn(&TensorSpec) -> Option<&'a [f32]>,
    ) -> candle_core::Result<Self> {
        let layers = Layers::of(model);
        let mut number = 0..;
        let mut values = Vec::new();
        for step in layers.steps() {
            let of_heads = OfHeads {
                scores: step.to == layers.scores,
                deltas: step.to == layers.deltas,
            };
            let changes_nothing = is_refining(&step.layer);
            let method = model.arch.method().filter(|_| matches!(step.layer, Layer::Fuse(_)));
            for (spec, number) in step.layer.tensors().into_iter().zip(number.by_ref()) {
                let mut draws = Stream::new(seed, "weights", number);
                values.push(match (given(&spec), method) {
                    (Some(given), _) => given.to_vec(),
                    _ if changes_nothing => identity(&spec),
                    (None, Some(method)) => method.initial(&spec, &mut || draws.normal()),
                    (None, None) => initial(&mut draws, &spec, of_heads),
                });
            }
        }
        let mut values = values.into_iter();
        Self::with(model, |_| values.next().expect("a value for each tensor"))
    }

    /// A network of given numbers for each tensor, asked for in the order of the weights.
    pub(crate) fn with(model: &Model, mut values: impl FnMut(&TensorSpec) -> Vec<f32>) -> candle_core::Result<Self> {
        let layers = Layers::of(model);
        let (mut parameters, mut places) = (Vec::new(), HashMap::new());
        for spec in layers.tensors() {
            places.insert(spec.key.clone(), parameters.len());
            parameters.push(Parameter {
                value: tensor(values(&spec), spec.shape)?,
                trained: spec.role.is_trained(),
                decayed: matches!(spec.role, Role::Weight { .. }),
                name: spec.key,
            });
        }
        Ok(Network {
            model: model.clone(),
            layers,
            parameters,
            places,
            arithmetic: Arithmetic::F32,
            frozen_norms: false,
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

    pub(crate) fn layers(&self) -> &Layers {
        &self.layers
    }

    /// All tensors, in the order of the file of weights.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Leaves parts as they are, with the running statistics of their norms.
    pub(crate) fn freeze(&mut self, parts: &Frozen) {
        let keys = parts.keys(&self.layers);
        for parameter in self
            .parameters
            .iter_mut()
            .filter(|parameter| keys.contains(&parameter.name))
        {
            parameter.trained = false;
        }
    }

    pub(crate) fn set(&mut self, index: usize, values: Vec<f32>) -> candle_core::Result<()> {
        let parameter = &mut self.parameters[index];
        parameter.value = tensor(values, parameter.value.shape().clone())?;
        Ok(())
    }

    /// The forward pass; `parties`: the agents of each sample, whose points follow each other in the batch. In training, batch
    /// norms use the batch's statistics, unless they are frozen.
    ///
    /// # Errors
    /// Those of the layers.
    pub fn forward(
        &self,
        tape: &mut Tape,
        batch: &Arc<PillarBatch>,
        parties: &[Vec<Member>],
        training: bool,
    ) -> candle_core::Result<Heads> {
        let mut run = Run {
            network: self,
            tape,
            by_batch: false,
            statistics: Vec::new(),
        };
        let layers = &self.layers;
        let order = layers.between(&[], &[layers.scores, layers.deltas]);
        let mut maps = Maps::of(&order);
        let mut fused = None;
        let mut learning = HashSet::new();
        for step in order {
            let learns = self.learns(&step.layer);
            run.by_batch = training && learns && !self.frozen_norms;
            // What leads to nothing that learns needs no gradients.
            let needs_gradients = learns || step.from.iter().any(|map| learning.contains(map));
            run.tape.pause(!needs_gradients);
            if needs_gradients {
                learning.insert(step.to);
            }
            let made = match &step.layer {
                Layer::Points(layer) => run.points(layer, batch)?,
                Layer::Convolution(layer) => run.convolution(layer, &maps.read(step.from[0]))?,
                Layer::Join => {
                    let parts: Vec<Tensor> = step.from.iter().map(|map| maps.read(*map)).collect();
                    run.tape.join(&parts)?
                }
                Layer::Fuse(layer) => {
                    let restored = maps.read(step.from[0]);
                    let fused = match step.from.get(1) {
                        Some(kept) => run.tape.choose([&restored, &maps.read(*kept)], &owns(parties))?,
                        None => restored,
                    };
                    fuse(self, run.tape, layer, &fused, parties)?
                }
            };
            if step.to == layers.fused {
                fused = Some(made.clone());
            }
            maps.made.insert(step.to, made);
        }
        Ok(Heads {
            scores: maps.read(layers.scores),
            deltas: maps.read(layers.deltas),
            fused: fused.expect("heads read a map"),
            statistics: run.statistics,
        })
    }

    fn learns(&self, layer: &Layer) -> bool {
        let mut tensors = layer.tensors().into_iter();
        tensors.any(|spec| self.parameters[self.places[&spec.key]].trained)
    }

    /// Forward and backward pass of one batch; the running statistics move on.
    ///
    /// # Errors
    /// Those of the layers.
    pub fn pass(&mut self, batch: &Batch, settings: &LossWeights) -> candle_core::Result<Pass> {
        let mut tape = Tape::new();
        let heads = self.forward(&mut tape, &batch.pillars, &batch.parties, true)?;
        let (losses, of_scores, of_deltas) = losses(&heads, &batch.targets, settings)?;
        let mut results = vec![(heads.scores.id(), of_scores), (heads.deltas.id(), of_deltas)];
        let mut lesson = 0.0;
        if batch.lessons.iter().any(Option::is_some) {
            let (loss, of_fused) = lesson_losses(&heads.fused, &batch.lessons)?;
            lesson = loss;
            results.push((heads.fused.id(), of_fused));
        }
        if !self.frozen_norms {
            self.follow(&heads.statistics)?;
        }
        drop((heads.scores, heads.deltas, heads.fused));
        let mut gradients = tape.backward(results)?;
        let gradients = self
            .parameters
            .iter()
            .map(|parameter| self.gradient(&mut gradients, parameter));
        Ok(Pass {
            losses,
            lesson,
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
    fn follow(&mut self, statistics: &[(String, Statistics)]) -> candle_core::Result<()> {
        for (norm, statistics) in statistics {
            let Some(moments) = statistics.moments() else { continue };
            // The running variance estimates that of all data.
            let unbiased = moments.count as f32 / moments.count.saturating_sub(1).max(1) as f32;
            let variance: Vec<f32> = moments.variance.iter().map(|v| v * unbiased).collect();
            for (part, new) in [(Role::RunningMean, &moments.mean), (Role::RunningVariance, &variance)] {
                let key = norm_key(norm, part);
                let moved = with_numbers(self.value(&key), |old| {
                    Ok(old
                        .iter()
                        .zip(new)
                        .map(|(old, new)| old + MOMENTUM * (new - old))
                        .collect::<Vec<f32>>())
                })?;
                self.set(self.place(&key), moved)?;
            }
        }
        Ok(())
    }

    /// A tensor by its key.
    ///
    /// # Panics
    /// If the network has none of this key.
    pub(crate) fn value(&self, key: &str) -> &Tensor {
        &self.parameters[self.place(key)].value
    }

    /// Where a tensor is by its key, as [`Network::set`] takes it.
    ///
    /// # Panics
    /// If the network has none of this key.
    pub(crate) fn place(&self, key: &str) -> usize {
        self.places[key]
    }
}

/// The maps of a forward pass; one that nobody reads any more is let go.
struct Maps {
    made: HashMap<MapId, Tensor>,
    readers: HashMap<MapId, usize>,
}

impl Maps {
    fn of(order: &[&Step]) -> Self {
        let mut readers = HashMap::new();
        for map in order.iter().flat_map(|step| &step.from) {
            *readers.entry(*map).or_default() += 1;
        }
        Maps {
            made: HashMap::new(),
            readers,
        }
    }

    fn read(&mut self, map: MapId) -> Tensor {
        let left = self.readers.entry(map).or_default();
        *left = left.saturating_sub(1);
        let made = match left {
            0 => self.made.remove(&map),
            _ => self.made.get(&map).cloned(),
        };
        made.expect("steps in an order in which they can be computed")
    }
}

/// A forward pass.
struct Run<'a> {
    network: &'a Network,
    tape: &'a mut Tape,
    /// Whether batch norms take the batch's statistics.
    by_batch: bool,
    statistics: Vec<(String, Statistics)>,
}

impl Run<'_> {
    fn statistics(&mut self, norm: &str) -> candle_core::Result<Statistics> {
        let statistics = if self.by_batch {
            Statistics::batch()
        } else {
            let [mean, variance] = [Role::RunningMean, Role::RunningVariance].map(|part| {
                let value = self.network.value(&norm_key(norm, part));
                with_numbers(value, |values| Ok(values.to_vec()))
            });
            Statistics::Running(Moments {
                mean: mean?,
                variance: variance?,
                count: 1,
            })
        };
        self.statistics.push((norm.to_string(), statistics.clone()));
        Ok(statistics)
    }

    fn points(&mut self, layer: &PointLayer, batch: &Arc<PillarBatch>) -> candle_core::Result<Tensor> {
        let op = PillarLayer::new(batch.clone(), self.statistics(&layer.norm)?);
        let network = self.network;
        let [weight, bias] = norm_keys(&layer.norm).map(|key| network.value(&key));
        self.tape.apply3(op, network.value(&layer.weight_key()), weight, bias)
    }

    fn convolution(&mut self, layer: &ConvLayer, map: &Tensor) -> candle_core::Result<Tensor> {
        let network = self.network;
        let weight = network.value(&layer.weight_key());
        let made = match (layer.transposed, layer.kernel) {
            (true, _) => self.pointwise(WeightOrder::Transposed, map, weight),
            (false, 1) if layer.stride == 1 => self.pointwise(WeightOrder::Plain, map, weight),
            (false, 3) => {
                let (stride, arithmetic) = (layer.stride, network.arithmetic);
                self.tape.apply2(Conv { stride, arithmetic }, map, weight)
            }
            (false, kernel) => candle_core::bail!(
                "`{}`: there is no training for a kernel of {kernel} at stride {}",
                layer.key,
                layer.stride
            ),
        }?;
        let biased = match layer.bias_key() {
            Some(key) => {
                let relu = layer.relu && layer.norm.is_none();
                self.tape.apply2(Bias { relu }, &made, network.value(&key))?
            }
            None => made,
        };
        match &layer.norm {
            Some(norm) if layer.relu => self.norm(norm, &biased),
            None if layer.bias || !layer.relu => Ok(biased),
            _ => candle_core::bail!(
                "`{}`: there is no training for a ReLU without bias or a norm without ReLU",
                layer.key
            ),
        }
    }

    fn pointwise(&mut self, order: WeightOrder, map: &Tensor, weight: &Tensor) -> candle_core::Result<Tensor> {
        let arithmetic = self.network.arithmetic;
        self.tape.apply2(Pointwise { order, arithmetic }, map, weight)
    }

    /// Batch norm and ReLU.
    fn norm(&mut self, norm: &str, map: &Tensor) -> candle_core::Result<Tensor> {
        let op = Norm {
            statistics: self.statistics(norm)?,
        };
        let network = self.network;
        let [weight, bias] = norm_keys(norm).map(|key| network.value(&key));
        self.tape.apply3(op, map, weight, bias)
    }
}

/// What of a batch norm gradients move.
fn norm_keys(norm: &str) -> [String; 2] {
    [Role::NormWeight, Role::NormBias].map(|part| norm_key(norm, part))
}

/// Whether a layer makes the scores or the deltas.
#[derive(Clone, Copy, Debug)]
struct OfHeads {
    scores: bool,
    deltas: bool,
}

/// Whether a layer stands between the fused map and the heads, and can begin by giving that map as it is.
fn is_refining(layer: &Layer) -> bool {
    matches!(layer, Layer::Convolution(layer) if layer.key.starts_with(REFINE) && layer.inputs == layer.outputs)
}

/// The numbers of a convolution that gives each channel as it is.
fn identity(spec: &TensorSpec) -> Vec<f32> {
    let mut numbers = vec![0.0; spec.count()];
    if let ([outputs, inputs, rows, columns], Role::Weight { .. }) = (&spec.shape[..], spec.role) {
        let (area, middle) = (rows * columns, rows / 2 * columns + columns / 2);
        (0..*outputs).for_each(|channel| numbers[(channel * inputs + channel) * area + middle] = 1.0);
    }
    numbers
}

/// Random numbers for a tensor.
fn initial(draws: &mut Stream, spec: &TensorSpec, of_heads: OfHeads) -> Vec<f32> {
    let count = spec.count();
    let normal = |draws: &mut Stream, deviation: f64| (0..count).map(|_| (deviation * draws.normal()) as f32).collect();
    match spec.role {
        Role::Bias if of_heads.scores => vec![-((1.0 - PRIOR) / PRIOR).ln() as f32; count],
        Role::Weight { .. } if of_heads.scores || of_heads.deltas => normal(draws, 0.01),
        // Variance is kept through ReLU (He et al. 2015).
        Role::Weight { fan_in } => normal(draws, (2.0 / fan_in as f64).sqrt()),
        Role::NormWeight | Role::RunningVariance => vec![1.0; count],
        Role::Bias | Role::NormBias | Role::Delays | Role::RunningMean => vec![0.0; count],
    }
}

/// Each sample's loss, and the gradients of their sum as maps with a border.
fn losses(
    heads: &Heads,
    targets: &[Targets],
    settings: &LossWeights,
) -> candle_core::Result<(Vec<Loss>, Tensor, Tensor)> {
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

/// The loss of the lessons of a batch, and its gradient as a map with a border.
fn lesson_losses(fused: &Tensor, lessons: &[Option<Lesson>]) -> candle_core::Result<(f64, Tensor)> {
    let shape = MapShape::of(fused.shape())?;
    if shape.batch != lessons.len() {
        candle_core::bail!("{} samples have {} lessons", shape.batch, lessons.len());
    }
    let mut of_fused = buffer(shape.len());
    let loss = with_numbers(fused, |numbers| {
        let images = of_fused.par_chunks_mut(shape.image()).zip(lessons).enumerate();
        let losses = images.filter_map(|(image, (to, lesson))| {
            let cells = inner(&shape, numbers, image);
            let mut gradient = vec![0.0; cells.len()];
            let loss = lesson.as_ref()?.loss(&cells, shape.batch, &mut gradient);
            outer(&shape, to, &gradient);
            Some(loss)
        });
        // In order, so that the sum is the same every time.
        Ok(losses.collect::<Vec<f64>>().iter().sum())
    })?;
    Ok((loss, tensor(of_fused, shape.dims())?))
}

/// A sample's cells without the border.
pub(crate) fn inner(map: &MapShape, data: &[f32], image: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(map.rows * map.columns * map.channels);
    (0..map.rows).for_each(|row| out.extend_from_slice(map.row(data, image, row)));
    out
}

/// Writes cells into one image inside its border, which is already 0.
pub(crate) fn outer(map: &MapShape, image: &mut [f32], cells: &[f32]) {
    for (row, cells) in cells.chunks_exact(map.columns * map.channels).enumerate() {
        let at = map.at(0, row as isize, 0);
        image[at..at + cells.len()].copy_from_slice(cells);
    }
}

/// Which maps of a batch are of their fusion's agent itself.
fn owns(parties: &[Vec<Member>]) -> Vec<bool> {
    parties.iter().flatten().map(|member| member.own).collect()
}
