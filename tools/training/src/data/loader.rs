//! Prepares batches on a thread of its own.

use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use crate::targets::Targets;
use realo_methods::Model;
use realo_nn::model::Grid;

use super::decoys::Supply;
use super::frame::Frame;
use super::frames::Frames;
use super::maps::{Member, Party, Project};
use super::sample::{Augmentation, Cast, Change, Sample, Scene};
use crate::TrainError;
use crate::fusing::fuses;
use crate::layers::PillarBatch;
use crate::random::Stream;
use crate::teacher::{Lesson, Teacher};

/// Batches that wait for the trainer.
const AHEAD: usize = 3;

/// What is found after a step changes the batches from so many steps later on: those before may have been made.
pub(crate) const LATER: u64 = 2 * AHEAD as u64;

/// Probability that the others of a step on the whole range bring their points to the ego's frame before they encode them; on parts they
/// always do.
const BY_SENDER: f64 = 0.5;

/// Samples are drawn from so many frames, those that joined last.
const POOL: u64 = 400;

/// The samples of a step.
pub struct Batch {
    /// What the network sees: of each sample the points of its agents, in the order of the parties.
    pub pillars: Arc<PillarBatch>,
    /// The agents of each sample, the ego first; one where several agents' points are merged in one cloud.
    pub parties: Vec<Vec<Member>>,
    /// What the heads should answer.
    pub targets: Vec<Targets>,
    /// The maps that those which the heads read should be like, where there is a teacher.
    pub lessons: Vec<Option<Lesson>>,
}

/// What batches are made of; a step's batch depends on nothing else.
#[derive(Clone)]
pub struct Sampling {
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
    /// Samples from one frame that joins those that are drawn from to the next.
    pub uses: u64,
    /// Probability that a step sees parts of the range.
    pub parts: f64,
    /// Steps from here on see the whole range.
    pub whole_from: u64,
    /// What is pasted into samples.
    pub supply: Arc<Mutex<Supply>>,
    /// Whose maps are examples.
    pub teacher: Option<Arc<Teacher>>,
}

impl Sampling {
    /// The frame that a sample is drawn from. Frames join in their order, so that those yet to be made are asked for at an
    /// even pace.
    fn frame(&self, sample: u64) -> usize {
        let newest = sample / self.uses;
        let pool = POOL.min(newest + 1) as usize;
        let back = Stream::new(self.seed, "frame", sample).below(pool) as u64;
        ((newest - back) % self.frames.len() as u64) as usize
    }

    /// The batch of a step.
    ///
    /// # Errors
    /// [`TrainError`] if a frame cannot be had.
    fn batch(&self, step: u64) -> Result<Batch, TrainError> {
        let mut draws = Stream::new(self.seed, "batch", step);
        let parts = step < self.whole_from && draws.chance(self.parts);
        let mut frames = Vec::with_capacity(self.batch);
        for number in (0..self.batch as u64).map(|i| step * self.batch as u64 + i) {
            let frame = self.frames.load(self.frame(number))?;
            frames.push((frame, Stream::new(self.seed, "sample", number)));
        }
        Ok(match fuses(&self.model) {
            true => self.of_parties(frames, parts, &mut draws)?,
            false => self.of_merged(step, frames, parts)?,
        })
    }

    /// Samples of one cloud each.
    fn of_merged(&self, step: u64, frames: Vec<(Frame, Stream)>, parts: bool) -> Result<Batch, TrainError> {
        let how = &self.augmentation;
        let decoys = self.supply.lock().unwrap_or_else(PoisonError::into_inner).at(step);
        let (mut samples, mut lessons) = (Vec::with_capacity(frames.len()), Vec::new());
        let mut model = self.model.clone();
        for (frame, mut draws) in frames {
            let cast = Cast::draw(&frame, how, &mut draws);
            let parts_of = cast.parts(&frame, how, &mut draws);
            let mut scene = Scene::new(&frame, &parts_of, &self.model, how, &mut draws);
            if let Some(decoys) = &decoys {
                decoys.paste(&mut scene, how.decoys, &mut draws);
            }
            let change = self.change(parts, &mut draws);
            scene.change(&change);
            if parts {
                model = square(&self.model, &change, &mut draws);
            }
            lessons.push(self.lesson(&scene, &model)?);
            samples.push(scene.sample(&model));
        }
        // All squares have one size, and no more than that is asked of the last one here.
        let (pillars, targets) = gather(&model, samples);
        Ok(Batch {
            pillars,
            parties: vec![vec![Member::EGO]; targets.len()],
            targets,
            lessons,
        })
    }

    /// How a sample is changed: what is seen on squares is turned by any angle.
    fn change(&self, parts: bool, draws: &mut Stream) -> Change {
        let how = &self.augmentation;
        let rotation = if parts { std::f64::consts::PI } else { how.rotation };
        Change::draw(how, rotation, draws)
    }

    /// Samples of several agents, whose maps are fused. On parts of the range all maps are of the ego's part, which only senders can
    /// bring their points to.
    fn of_parties(&self, frames: Vec<(Frame, Stream)>, parts: bool, of_step: &mut Stream) -> Result<Batch, TrainError> {
        let how = &self.augmentation;
        let project = match parts || of_step.chance(BY_SENDER) {
            true => Project::Sender,
            false => Project::Receiver,
        };
        let (mut pillars, mut parties, mut targets, mut lessons) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut model = self.model.clone();
        for (frame, mut draws) in frames {
            let party = Party::draw(&frame, &self.model, project, how, &mut draws);
            let mut view = party.view(&frame, &self.model, how, &mut draws);
            let change = self.change(parts, &mut draws);
            view.change(&change);
            if parts {
                model = square(&self.model, &change, &mut draws);
            }
            let looks = view.looks(&model);
            pillars.extend(looks.iter().map(|look| look.scene.pillars(&model)));
            parties.push(looks.iter().map(|look| look.member).collect());
            targets.push(view.scene.targets(&model));
            // Points of before are not where things are.
            lessons.push(match view.is_of_now() {
                true => self.lesson(&view.scene, &model)?,
                false => None,
            });
        }
        // All squares have one size, and no more than that is asked of the last one here.
        Ok(Batch {
            pillars: Arc::new(PillarBatch::new(&model.grid, &model.pillars, pillars)),
            parties,
            targets,
            lessons,
        })
    }

    fn lesson(&self, scene: &Scene, model: &Model) -> Result<Option<Lesson>, TrainError> {
        let teacher = self.teacher.as_ref();
        teacher.map(|teacher| teacher.lesson(scene, &model.grid)).transpose()
    }

    /// Batches from a step on, made by one thread; it ends with the receiver.
    pub fn start(self, first: u64) -> (Receiver<Result<Batch, TrainError>>, JoinHandle<()>) {
        let (sender, receiver) = sync_channel(AHEAD);
        let thread = std::thread::spawn(move || {
            for step in first.. {
                let batch = self.batch(step);
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

/// The model on a square as wide as its grid is along its shorter side. It lies where a change brings the middle of the
/// grid, or, as often, that of another square on it, so that the turn of a long grid takes no part of it away.
fn square(model: &Model, change: &Change, draws: &mut Stream) -> Model {
    let mut model = model.clone();
    // Maps of all blocks keep whole cells, a fusion whole windows.
    let strides = model.backbone.strides.iter().product::<usize>().max(1);
    let sides = model.arch.method().map(|method| method.sides()).unwrap_or_default();
    let sides = sides.into_iter().map(|side| side * model.stride());
    let step = sides.fold(strides, least_common_multiple);
    let Grid { x, y, cell, .. } = model.grid;
    let cells = model.grid.rows().min(model.grid.columns()) / step * step;
    let side = cells as f64 * cell;
    let in_the_middle = draws.chance(0.5);
    let [along, across] = [x, y].map(|[from, to]| {
        let aside = if in_the_middle { 0.5 } else { draws.unit() };
        from + 0.5 * side + aside * (to - from - side)
    });
    let center = change.point([along, across, 0.0]);
    let part = |center: f64, [from, _]: [f64; 2]| {
        let start = from + ((center - 0.5 * side - from) / cell).round() * cell;
        [start, start + side]
    };
    (model.grid.x, model.grid.y) = (part(center[0], x), part(center[1], y));
    model
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::super::decoys::Decoys;
    use super::super::frame::{AgentSweep, Seen};
    use super::*;

    /// Frames with a car each on even ground; its distance reports which frame it is.
    struct Rows(usize);

    impl Frames for Rows {
        fn len(&self) -> usize {
            self.0
        }

        fn load(&self, index: usize) -> Result<Frame, TrainError> {
            let car = Seen {
                track: 1,
                class: 0,
                lwh: [12.0 + index as f64, 3.0, 0.8, 4.5, 1.9, 1.6, 0.4],
                points: 60,
            };
            let points = (0..60).map(|i| ([12.0 + index as f32 + 0.01 * i as f32, 3.0, 0.9], i));
            let ground = (0..6400).map(|i| ([(i % 80) as f32 - 40.0, (i / 80) as f32 - 40.0, 0.0], 0));
            let points = points.chain(ground);
            let agent = AgentSweep::new("cav1", false, Isometry3::identity(), points, vec![car]);
            Ok(Frame {
                classes: vec!["vehicle".into()],
                agents: vec![agent],
                earlier: None,
            })
        }
    }

    fn model() -> Model {
        Model::read(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models/lite.toml")).unwrap()
    }

    fn sampling(frames: usize, uses: u64) -> Sampling {
        Sampling {
            frames: Arc::new(Rows(frames)),
            model: model(),
            augmentation: Augmentation::default(),
            seed: 3,
            batch: 2,
            uses,
            parts: 0.5,
            whole_from: u64::MAX,
            supply: Arc::default(),
            teacher: None,
        }
    }

    #[test]
    fn frames_join_at_an_even_pace_and_are_used_alike() {
        let sampling = sampling(1000, 5);
        let mut uses = vec![0; 1000];
        for sample in 0..5000 {
            let frame = sampling.frame(sample);
            assert!(
                frame as u64 <= sample / 5,
                "frame {frame} is asked for at sample {sample}"
            );
            assert!(frame as u64 + POOL > sample / 5);
            uses[frame] += 1;
        }
        let later = &uses[100..500];
        assert!(later.iter().all(|uses| (0..20).contains(uses)));
        assert!((later.iter().sum::<i32>() as f64 / 400.0 - 5.0).abs() < 1.0);
    }

    #[test]
    fn a_batch_is_the_same_whoever_makes_it() {
        let samples = |batch: Result<Batch, TrainError>| batch.unwrap().targets;
        let whole: Vec<_> = (0..4).map(|step| samples(sampling(8, 1).batch(step))).collect();
        let (batches, thread) = sampling(8, 1).start(2);
        let resumed: Vec<_> = batches.iter().take(2).map(samples).collect();
        drop(batches);
        thread.join().unwrap();
        assert_eq!(resumed, whole[2..]);
    }

    #[test]
    fn samples_hold_decoys_from_the_step_on_that_has_them() {
        let count = |sampling: &Sampling, step| sampling.batch(step).unwrap().pillars.count();
        let (plain, pasting) = (sampling(8, 1), sampling(8, 1));
        let post: Vec<f32> = (1..40).flat_map(|i| [0.0, 0.9, 15.0, 0.0, 0.04 * i as f32]).collect();
        pasting.supply.lock().unwrap().add(4, Decoys::from_numbers(&post));
        for step in 0..4 {
            assert_eq!(count(&pasting, step), count(&plain, step), "{step}");
        }
        let more = (4..24).filter(|step| count(&pasting, *step) > count(&plain, *step));
        assert!(more.count() > 5);
    }

    #[test]
    fn squares_keep_the_cells_and_hold_what_was_on_the_long_grid() {
        let model = model();
        let how = Augmentation::none();
        let (mut far, mut ahead) = (0, 0);
        for number in 0..200 {
            let mut draws = Stream::new(1, "test", number);
            let change = Change::draw(&how, std::f64::consts::PI, &mut draws);
            let part = square(&model, &change, &mut draws).grid;
            assert_eq!((part.rows(), part.columns()), (200, 200));
            for (part, whole) in [(part.x, model.grid.x), (part.y, model.grid.y)] {
                let cells = (part[0] - whole[0]) / model.grid.cell;
                assert!((cells - cells.round()).abs() < 1e-6, "cells keep their places");
            }
            let holds = |point: [f64; 3]| {
                let [x, y, _] = change.point(point);
                (part.x[0]..part.x[1]).contains(&x) && (part.y[0]..part.y[1]).contains(&y)
            };
            far += usize::from(holds([85.0, 0.0, 0.0]));
            ahead += usize::from(holds([30.0, 0.0, 0.0]));
        }
        assert!(
            far > 10 && ahead > 140,
            "of 200 squares {far} hold what is far, {ahead} what is near"
        );
    }
}
