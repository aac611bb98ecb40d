//! The pillar net in training: linear layer, batch norm over all points, ReLU, maximum over a pillar's points, scatter.

use std::sync::{Arc, OnceLock};

use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;
use realo_methods::detect::pillar_net::decorate;
use realo_methods::detect::pillars::Pillars;
use realo_nn::layers::POINT_FEATURES;
use realo_nn::model::{Grid, PillarSettings};

use super::map::{MapShape, numbers, tensor, with_numbers};
use super::norm::{Moments, Statistics};

/// Pillars that one task takes.
const CHUNK: usize = 512;

/// Channels that are computed together.
const LANES: usize = 16;
type Lanes = [f32; LANES];

/// Point of an empty slot, whose features are all 0.
const EMPTY: u32 = u32::MAX;

/// The features of one sample's points.
#[derive(Clone, Debug)]
pub struct PillarFrame {
    cells: Vec<u32>,
    starts: Vec<u32>,
    features: Vec<[f32; POINT_FEATURES]>,
    sums: Sums,
}

/// Sums over points of the features and of their products; batch norm needs no more of a linear layer's input.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    first: [f64; POINT_FEATURES],
    second: [[f64; POINT_FEATURES]; POINT_FEATURES],
}

impl Sums {
    fn of(features: &[[f32; POINT_FEATURES]]) -> Self {
        let mut sums = Sums::default();
        for point in features {
            let point = point.map(f64::from);
            for i in 0..POINT_FEATURES {
                sums.first[i] += point[i];
                for j in 0..POINT_FEATURES {
                    sums.second[i][j] += point[i] * point[j];
                }
            }
        }
        sums
    }

    fn add(mut self, other: &Sums) -> Self {
        for i in 0..POINT_FEATURES {
            self.first[i] += other.first[i];
            for j in 0..POINT_FEATURES {
                self.second[i][j] += other.second[i][j];
            }
        }
        self
    }

    /// The second moments times a vector.
    fn times(&self, w: &[f64; POINT_FEATURES]) -> [f64; POINT_FEATURES] {
        self.second.map(|row| row.iter().zip(w).map(|(m, w)| m * w).sum())
    }
}

/// The pillars of a batch.
#[derive(Clone, Debug)]
pub struct PillarBatch {
    rows: usize,
    columns: usize,
    /// Pillars with fewer points have empty slots that take part.
    slots: Option<usize>,
    frames: Vec<PillarFrame>,
    sums: Sums,
    /// Points, and empty slots where they take part.
    count: usize,
}

impl PillarBatch {
    /// Points, and empty slots where they take part.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        self.count
    }
}

impl PillarFrame {
    /// The features of a sample's pillars on a grid.
    pub fn new(grid: &Grid, pillars: &Pillars, settings: &PillarSettings) -> Self {
        let features = decorate(grid, pillars, settings.intensity);
        let (cells, starts) = (pillars.cells.clone(), pillars.starts.clone());
        PillarFrame {
            cells,
            starts,
            sums: Sums::of(&features),
            features,
        }
    }

    fn points(&self, pillar: usize) -> &[[f32; POINT_FEATURES]] {
        &self.features[self.starts[pillar] as usize..self.starts[pillar + 1] as usize]
    }
}

impl PillarBatch {
    /// Samples on one grid.
    pub fn new(grid: &Grid, settings: &PillarSettings, frames: Vec<PillarFrame>) -> Self {
        let slots = settings.empty_slots.then_some(settings.points);
        let points: usize = frames.iter().map(|frame| frame.features.len()).sum();
        let pillars: usize = frames.iter().map(|frame| frame.cells.len()).sum();
        PillarBatch {
            rows: grid.rows(),
            columns: grid.columns(),
            slots,
            sums: frames.iter().fold(Sums::default(), |sums, frame| sums.add(&frame.sums)),
            count: slots.map_or(points, |slots| pillars * slots),
            frames,
        }
    }

    /// Points of all samples.
    pub fn points(&self) -> usize {
        self.frames.iter().map(|frame| frame.features.len()).sum()
    }

    fn map(&self, channels: usize) -> MapShape {
        MapShape {
            batch: self.frames.len(),
            rows: self.rows,
            columns: self.columns,
            channels,
        }
    }

    /// (frame, pillars) of each task.
    fn chunks(&self) -> Vec<(usize, std::ops::Range<usize>)> {
        let of = |(index, frame): (usize, &PillarFrame)| {
            let n = frame.cells.len();
            (0..n.div_ceil(CHUNK)).map(move |chunk| (index, chunk * CHUNK..n.min((chunk + 1) * CHUNK)))
        };
        self.frames.iter().enumerate().flat_map(of).collect()
    }
}

/// From the linear layer's weights `[channels, 10]` and a batch norm's weight and bias to a map of the batch.
#[derive(Clone, Debug)]
pub struct PillarLayer {
    /// The points.
    pub batch: Arc<PillarBatch>,
    /// Of the batch norm.
    pub statistics: Statistics,
    /// For each chunk, pillar and channel the point with the largest value.
    winners: Arc<OnceLock<Vec<Vec<u32>>>>,
}

impl PillarLayer {
    /// The layer for one batch.
    pub fn new(batch: Arc<PillarBatch>, statistics: Statistics) -> Self {
        PillarLayer {
            batch,
            statistics,
            winners: Arc::default(),
        }
    }

    fn moments_of(&self, linear: &[f32]) -> Moments {
        let (sums, n) = (&self.batch.sums, self.batch.count.max(1) as f64);
        let (mean, variance) = linear
            .as_chunks::<POINT_FEATURES>()
            .0
            .iter()
            .map(|w| {
                let w = w.map(f64::from);
                let mean = dot(&w, &sums.first) / n;
                (
                    mean as f32,
                    (dot(&w, &sums.times(&w)) / n - mean * mean).max(0.0) as f32,
                )
            })
            .unzip();
        Moments {
            mean,
            variance,
            count: self.batch.count,
        }
    }
}

impl CustomOp3 for PillarLayer {
    fn name(&self) -> &'static str {
        "pillar net"
    }

    fn cpu_fwd(
        &self,
        linear: &CpuStorage,
        ll: &Layout,
        weight: &CpuStorage,
        wl: &Layout,
        bias: &CpuStorage,
        bl: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (channels, features) = ll.shape().dims2()?;
        let (linear, weight, bias) = (numbers(linear, ll)?, numbers(weight, wl)?, numbers(bias, bl)?);
        if features != POINT_FEATURES || weight.len() != channels || bias.len() != channels {
            bail!(
                "pillar net: expected weights [{channels}, {POINT_FEATURES}] and batch norm of {channels}, found [{channels}, {features}], {} and {}",
                weight.len(),
                bias.len()
            );
        }
        let moments = match &self.statistics {
            Statistics::Batch(own) => own.get_or_init(|| self.moments_of(linear)),
            Statistics::Running(moments) => moments,
        };
        let (scale, shift) = moments.affine(weight, bias);
        let blocks = Block::all(linear, &scale, &shift);
        let map = self.batch.map(channels);
        let mut out = vec![0.0; map.len()];
        let done: Vec<(Vec<f32>, Vec<u32>)> = self
            .batch
            .chunks()
            .into_par_iter()
            .map(|(frame, pillars)| encode(&self.batch.frames[frame], pillars, &blocks, channels, self.batch.slots))
            .collect();
        let mut winners = Vec::with_capacity(done.len());
        for ((frame, pillars), (values, won)) in self.batch.chunks().into_iter().zip(done) {
            let cells = &self.batch.frames[frame].cells[pillars];
            for (cell, values) in cells.iter().zip(values.chunks_exact(channels)) {
                let at = place(&map, frame, *cell);
                out[at..at + channels].copy_from_slice(values);
            }
            winners.push(won);
        }
        // A second forward pass of the same layer finds the same winners.
        let _ = self.winners.set(winners);
        Ok((CpuStorage::F32(out), map.dims()))
    }

    fn bwd(
        &self,
        linear: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        out: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (Some(moments), Some(winners)) = (self.statistics.moments(), self.winners.get()) else {
            bail!("pillar net: the backward pass came before the forward pass");
        };
        let channels = weight.elem_count();
        let map = self.batch.map(channels);
        let sums = with_numbers(out, |out| {
            with_numbers(grad, |grad| Ok(self.gradient_sums(&map, winners, out, grad)))
        })?;
        let fixed = matches!(self.statistics, Statistics::Running(_));
        let (mut dl, mut dw, mut db) = (Vec::new(), Vec::new(), Vec::new());
        with_numbers(linear, |linear| {
            with_numbers(weight, |weight| {
                for (c, w) in linear.as_chunks::<POINT_FEATURES>().0.iter().enumerate() {
                    let channel = Channel {
                        w: w.map(f64::from),
                        mean: f64::from(moments.mean[c]),
                        inverse: f64::from(moments.inverse()[c]),
                        weight: f64::from(weight[c]),
                    };
                    let count = if fixed {
                        f64::INFINITY
                    } else {
                        self.batch.count.max(1) as f64
                    };
                    let (gradient, of_weight, of_bias) = channel.gradients(&sums[c], &self.batch.sums, count);
                    dl.extend(gradient.map(|v| v as f32));
                    dw.push(of_weight as f32);
                    db.push(of_bias as f32);
                }
                Ok(())
            })
        })?;
        let (linear, bias) = (linear.shape().clone(), bias.shape().clone());
        Ok((
            Some(tensor(dl, linear)?),
            Some(tensor(dw, weight.shape().clone())?),
            Some(tensor(db, bias)?),
        ))
    }
}

impl PillarLayer {
    /// For each channel, over the points that won: the sum of gradients times features, then of gradients.
    fn gradient_sums(
        &self,
        map: &MapShape,
        winners: &[Vec<u32>],
        out: &[f32],
        grad: &[f32],
    ) -> Vec<[f64; POINT_FEATURES + 1]> {
        let c = map.channels;
        let parts: Vec<Vec<[f32; POINT_FEATURES + 1]>> = self
            .batch
            .chunks()
            .into_par_iter()
            .zip(winners)
            .map(|((index, pillars), winners)| {
                let frame = &self.batch.frames[index];
                let mut sums = vec![[0.0; POINT_FEATURES + 1]; c];
                for (pillar, winners) in pillars.zip(winners.chunks_exact(c)) {
                    let at = place(map, index, frame.cells[pillar]);
                    let (out, grad) = (&out[at..at + c], &grad[at..at + c]);
                    for (((sum, winner), out), g) in sums.iter_mut().zip(winners).zip(out).zip(grad) {
                        if *out > 0.0 {
                            add_point(sum, *g, (*winner != EMPTY).then(|| &frame.features[*winner as usize]));
                        }
                    }
                }
                sums
            })
            .collect();
        let mut total = vec![[0.0; POINT_FEATURES + 1]; c];
        for part in parts {
            for (total, part) in total.iter_mut().zip(part) {
                total
                    .iter_mut()
                    .zip(part)
                    .for_each(|(total, value)| *total += f64::from(value));
            }
        }
        total
    }
}

fn add_point(sum: &mut [f32; POINT_FEATURES + 1], g: f32, point: Option<&[f32; POINT_FEATURES]>) {
    if let Some(point) = point {
        for (sum, feature) in sum.iter_mut().zip(point) {
            *sum += g * feature;
        }
    }
    sum[POINT_FEATURES] += g;
}

/// One channel of the layer.
struct Channel {
    w: [f64; POINT_FEATURES],
    mean: f64,
    inverse: f64,
    weight: f64,
}

impl Channel {
    /// Gradients of the linear weights and of the batch norm's weight and bias.
    fn gradients(
        &self,
        sums: &[f64; POINT_FEATURES + 1],
        points: &Sums,
        count: f64,
    ) -> ([f64; POINT_FEATURES], f64, f64) {
        let (features, of_bias) = (&sums[..POINT_FEATURES], sums[POINT_FEATURES]);
        let of_weight = self.inverse * (dot(&self.w, features) - self.mean * of_bias);
        let products = points.times(&self.w);
        let gradient = std::array::from_fn(|i| {
            let normalised = self.inverse * (products[i] - self.mean * points.first[i]);
            let through_statistics = (of_bias * points.first[i] + of_weight * normalised) / count;
            self.weight * self.inverse * (features[i] - through_statistics)
        });
        (gradient, of_weight, of_bias)
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Where a cell of a frame lies in the map.
fn place(map: &MapShape, frame: usize, cell: u32) -> usize {
    let (row, column) = (cell as usize / map.columns, cell as usize % map.columns);
    map.at(frame, row as isize, column as isize)
}

/// Weights of some channels, with the batch norm folded in.
struct Block {
    features: [Lanes; POINT_FEATURES],
    shift: Lanes,
}

impl Block {
    fn all(linear: &[f32], scale: &[f32], shift: &[f32]) -> Vec<Block> {
        let channels = scale.len();
        (0..channels.div_ceil(LANES))
            .map(|block| {
                let mut out = Block {
                    features: [[0.0; LANES]; POINT_FEATURES],
                    shift: [0.0; LANES],
                };
                for lane in 0..LANES.min(channels - block * LANES) {
                    let c = block * LANES + lane;
                    for (i, weights) in out.features.iter_mut().enumerate() {
                        weights[lane] = linear[c * POINT_FEATURES + i] * scale[c];
                    }
                    out.shift[lane] = shift[c];
                }
                out
            })
            .collect()
    }

    /// The largest value of each channel before the shift, and which point has it.
    fn best(&self, points: &[[f32; POINT_FEATURES]]) -> (Lanes, [u32; LANES]) {
        let (mut best, mut winner) = ([f32::NEG_INFINITY; LANES], [0; LANES]);
        for (index, point) in points.iter().enumerate() {
            let mut value = [0.0; LANES];
            for (feature, weights) in point.iter().zip(&self.features) {
                for lane in 0..LANES {
                    value[lane] += feature * weights[lane];
                }
            }
            for lane in 0..LANES {
                let better = value[lane] > best[lane];
                best[lane] = if better { value[lane] } else { best[lane] };
                winner[lane] = if better { index as u32 } else { winner[lane] };
            }
        }
        (best, winner)
    }
}

/// The features of some pillars, and the points that they come from.
fn encode(
    frame: &PillarFrame,
    pillars: std::ops::Range<usize>,
    blocks: &[Block],
    channels: usize,
    slots: Option<usize>,
) -> (Vec<f32>, Vec<u32>) {
    let mut values = Vec::with_capacity(pillars.len() * channels);
    let mut winners = Vec::with_capacity(pillars.len() * channels);
    for pillar in pillars {
        let (start, points) = (frame.starts[pillar], frame.points(pillar));
        let empty = slots.is_some_and(|slots| points.len() < slots);
        for (index, block) in blocks.iter().enumerate() {
            let (best, winner) = block.best(points);
            for lane in 0..LANES.min(channels - index * LANES) {
                let beaten = empty && best[lane] < 0.0;
                let top = if beaten { 0.0 } else { best[lane] };
                // Not `max`, which would hide NaN.
                let value = top + block.shift[lane];
                values.push(if value < 0.0 { 0.0 } else { value });
                winners.push(if beaten { EMPTY } else { start + winner[lane] });
            }
        }
    }
    (values, winners)
}

#[cfg(test)]
impl PillarBatch {
    /// The definition: every point through the layer, statistics over all of them.
    pub(super) fn plain(&self, linear: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let map = self.map(weight.len());
        let mut out = vec![0.0; map.len()];
        for c in 0..weight.len() {
            let w: Vec<f64> = linear[c * POINT_FEATURES..][..POINT_FEATURES]
                .iter()
                .map(|v| f64::from(*v))
                .collect();
            let value = |point: &[f32; POINT_FEATURES]| dot(&w, &point.map(f64::from));
            let mut rows = Vec::new();
            for (index, frame) in self.frames.iter().enumerate() {
                for (pillar, cell) in frame.cells.iter().enumerate() {
                    let mut values: Vec<f64> = frame.points(pillar).iter().map(value).collect();
                    values.resize(self.slots.unwrap_or(values.len()), 0.0);
                    rows.push((place(&map, index, *cell) + c, values));
                }
            }
            let all: Vec<f64> = rows.iter().flat_map(|(_, values)| values.clone()).collect();
            let mean = all.iter().sum::<f64>() / all.len() as f64;
            let variance = all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len() as f64;
            let norm = |v: &f64| (v - mean) / (variance + 1e-3).sqrt() * f64::from(weight[c]) + f64::from(bias[c]);
            for (at, values) in rows {
                out[at] = values.iter().map(norm).fold(0.0, f64::max) as f32;
            }
        }
        out
    }
}
