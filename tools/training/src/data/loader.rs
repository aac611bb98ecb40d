//! Prepares batches on a thread of its own.

use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use realo_nn::anchors::Anchors;
use realo_nn::arch::Arch;
use realo_nn::model::Model;
use realo_nn::targets::{Targets, assign};
use realo_nn_candle::transformer::Agent;

use super::frame::Frame;
use super::frames::Frames;
use super::maps::{MapEncoder, Party};
use super::sample::{Augmentation, Cast, Sample, Scene};
use crate::TrainError;
use crate::layers::PillarBatch;
use crate::random::Stream;

/// Batches that wait for the trainer.
const AHEAD: usize = 3;

/// The samples of a step.
pub struct Batch {
    /// What the network sees.
    pub input: Input,
    /// What the heads should answer.
    pub targets: Vec<Targets>,
}

/// What a network sees in training.
pub enum Input {
    /// The points of an agent, or of several in one cloud, for a network as a whole.
    Points(Arc<PillarBatch>),
    /// For each sample the maps of agents, the ego's first, for a fusion and the heads behind it.
    Maps(Vec<Vec<Agent>>),
}

/// What batches are made of; a step's batch depends on nothing else.
#[derive(Clone)]
pub struct Recipe {
    /// The frames.
    pub frames: Arc<dyn Frames>,
    /// The network's model.
    pub model: Model,
    /// How samples are drawn.
    pub augmentation: Augmentation,
    /// Of all draws.
    pub seed: u64,
    /// Samples of a step.
    pub batch: usize,
    /// Probability that a step sees half of the range along x.
    pub half_range: f64,
    /// What makes maps of points, for a network that learns to fuse them.
    pub(crate) encoder: Option<Arc<Mutex<MapEncoder>>>,
}

impl Recipe {
    /// Frames in the order in which an epoch takes them.
    pub fn order(&self, epoch: u64) -> Vec<usize> {
        let mut draws = Stream::new(self.seed, "order", epoch);
        let mut order: Vec<usize> = (0..self.frames.len()).collect();
        for i in (1..order.len()).rev() {
            order.swap(i, draws.below(i + 1));
        }
        order
    }

    /// The batch of a step; `orders` remembers an epoch.
    ///
    /// # Errors
    /// [`TrainError`] if a frame cannot be had.
    fn batch(&self, step: u64, order: &mut (u64, Vec<usize>)) -> Result<Batch, TrainError> {
        let mut draws = Stream::new(self.seed, "batch", step);
        let half = draws.chance(self.half_range);
        let mut frames = Vec::with_capacity(self.batch);
        for number in (0..self.batch as u64).map(|i| step * self.batch as u64 + i) {
            let (epoch, place) = (number / self.frames.len() as u64, number % self.frames.len() as u64);
            if order.0 != epoch {
                *order = (epoch, self.order(epoch));
            }
            let frame = self.frames.load(order.1[place as usize])?;
            frames.push((frame, Stream::new(self.seed, "sample", number)));
        }
        match &self.encoder {
            None => Ok(self.of_points(frames, half)),
            Some(encoder) => self.of_maps(frames, half, encoder),
        }
    }

    fn of_points(&self, frames: Vec<(Frame, Stream)>, half: bool) -> Batch {
        let mut samples = Vec::with_capacity(frames.len());
        let mut model = self.model.clone();
        for (frame, mut draws) in frames {
            let cast = Cast::draw(&frame, &self.augmentation, &mut draws);
            let mut scene = Scene::new(&frame, &cast, &self.model, &self.augmentation, &mut draws);
            scene.augment(&self.augmentation, &mut draws);
            if half {
                model = window(&self.model, &mut draws);
            }
            samples.push(scene.sample(&model));
        }
        // All windows have one size, and no more than that is asked of the last one here.
        let (pillars, targets) = gather(&model, samples);
        Batch {
            input: Input::Points(pillars),
            targets,
        }
    }

    fn of_maps(
        &self,
        frames: Vec<(Frame, Stream)>,
        half: bool,
        encoder: &Mutex<MapEncoder>,
    ) -> Result<Batch, TrainError> {
        let mut encoder = encoder.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut samples, mut targets) = (Vec::new(), Vec::new());
        for (frame, mut draws) in frames {
            let party = Party::draw(&frame, &self.model, &self.augmentation, &mut draws);
            let maps = encoder.run(&frame, &party, &self.augmentation, &mut draws)?;
            let model = match half {
                true => window(&self.model, &mut draws),
                false => self.model.clone(),
            };
            let placed = maps.iter().map(|map| map.on(&self.model, &model.grid));
            samples.push(placed.collect::<candle_core::Result<_>>()?);
            let (objects, _) = party.objects(&frame, &model).objects_within(&model.grid);
            targets.push(assign(&Anchors::of(&model), &objects));
        }
        Ok(Batch {
            input: Input::Maps(samples),
            targets,
        })
    }

    /// Batches from a step on, made by one thread; it ends with the receiver.
    pub fn start(self, first: u64) -> (Receiver<Result<Batch, TrainError>>, JoinHandle<()>) {
        let (sender, receiver) = sync_channel(AHEAD);
        let thread = std::thread::spawn(move || {
            let mut order = (u64::MAX, Vec::new());
            for step in first.. {
                let batch = self.batch(step, &mut order);
                let failed = batch.is_err();
                if sender.send(batch).is_err() || failed {
                    break;
                }
            }
        });
        (receiver, thread)
    }
}

/// Samples on grids of one size.
pub(crate) fn gather(model: &Model, samples: Vec<Sample>) -> (Arc<PillarBatch>, Vec<Targets>) {
    let (frames, targets) = samples
        .into_iter()
        .map(|sample| (sample.pillars, sample.targets))
        .unzip();
    (Arc::new(PillarBatch::new(&model.grid, &model.pillars, frames)), targets)
}

fn least_common_multiple(a: usize, b: usize) -> usize {
    let mut multiples = (1..=b).map(|factor| a * factor);
    multiples.find(|multiple| multiple.is_multiple_of(b)).unwrap_or(a)
}

/// The model on half of its range along x: the middle, or any other part. Cells keep their places in the world.
fn window(model: &Model, draws: &mut Stream) -> Model {
    let mut model = model.clone();
    let [from, to] = model.grid.x;
    // Maps of all blocks keep whole cells, a fusion whole windows.
    let strides = model.backbone.strides.iter().product::<usize>().max(1);
    let windows = match &model.arch {
        Arch::V2XViT(settings) => &settings.windows[..],
        _ => &[],
    };
    let sides = windows.iter().map(|window| window.side * model.stride());
    let step = sides.fold(strides, least_common_multiple);
    let half = model.grid.columns() / 2 / step * step;
    let free = (model.grid.columns() - half) / step;
    let place = if draws.chance(0.5) {
        free / 2
    } else {
        draws.below(free + 1)
    };
    let start = from + (place * step) as f64 * model.grid.cell;
    model.grid.x = [start, (start + half as f64 * model.grid.cell).min(to)];
    model
}
