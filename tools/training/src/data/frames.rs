//! Where frames come from: a folder that is filled from simulator seeds as they are needed, or a log.

use std::collections::BTreeSet;
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;

use super::frame::Frame;
use super::left_out::LeftOut;
use super::simulated;
use crate::TrainError;

/// Rises with every change of how frames are made of sweeps.
const RECIPE: u32 = 6;

/// What decides, beside the seed, what is in a simulated frame.
pub(crate) fn world() -> String {
    format!("world{}.{RECIPE}", realo_simulator::WORLD)
}

/// Frames by number.
pub trait Frames: Send + Sync {
    /// Number of frames.
    fn len(&self) -> usize;

    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A frame.
    ///
    /// # Errors
    /// [`TrainError`] if it can be neither read nor made.
    fn load(&self, index: usize) -> Result<Frame, TrainError>;

    /// What there was and is in no frame.
    fn left_out(&self) -> &[LeftOut] {
        &[]
    }
}

/// Frames of simulator seeds, kept in a folder. What is missing is made when it is asked for, and meanwhile by threads
/// in the background; every file is whole, so a kill costs the seed in work at most.
#[derive(Clone)]
pub struct SimulatedFrames {
    folder: PathBuf,
    seeds: Range<u64>,
    per_seed: usize,
    /// Whether each frame has earlier sweeps too.
    earlier: bool,
    busy: Arc<(Mutex<BTreeSet<u64>>, Condvar)>,
}

impl SimulatedFrames {
    /// Frames of some seeds in a folder, which is made if need be.
    ///
    /// # Errors
    /// [`TrainError::Write`] if there can be no such folder.
    pub fn new(folder: &Path, seeds: Range<u64>, per_seed: usize) -> Result<Self, TrainError> {
        fs::create_dir_all(folder).map_err(|error| TrainError::Write {
            path: folder.into(),
            error,
        })?;
        Ok(SimulatedFrames {
            folder: folder.into(),
            seeds,
            per_seed,
            earlier: false,
            busy: Arc::default(),
        })
    }

    /// The same with what was some sweeps before each frame.
    #[must_use]
    pub fn with_earlier(self) -> Self {
        SimulatedFrames { earlier: true, ..self }
    }

    /// Makes what is missing of a seed, unless somebody else is at it; then waits for him.
    fn make(&self, seed: u64) -> Result<(), TrainError> {
        let (busy, done) = &*self.busy;
        let mut at_work = busy.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        while at_work.contains(&seed) {
            at_work = done.wait(at_work).unwrap_or_else(|poisoned| poisoned.into_inner());
        }
        if (0..self.per_seed).all(|number| self.made(seed, number).is_some()) {
            return Ok(());
        }
        at_work.insert(seed);
        drop(at_work);
        let made = self.write(seed);
        busy.lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .remove(&seed);
        done.notify_all();
        made
    }

    fn write(&self, seed: u64) -> Result<(), TrainError> {
        let frames = simulated::frames(&simulated::options(seed), self.per_seed, self.earlier)?;
        frames
            .iter()
            .enumerate()
            .try_for_each(|(number, frame)| frame.write(&self.path(seed, number, self.earlier)))
    }

    /// The file of a frame that was made: one with earlier sweeps serves those who do not ask for them too.
    fn made(&self, seed: u64, number: usize) -> Option<PathBuf> {
        let mut paths = [self.earlier, true]
            .map(|earlier| self.path(seed, number, earlier))
            .into_iter();
        paths.find(|path| path.exists())
    }

    fn path(&self, seed: u64, number: usize, earlier: bool) -> PathBuf {
        // The number of frames is part of the name: it decides which moments they are.
        let (world, of) = (world(), self.per_seed);
        let earlier = if earlier { "-and-earlier" } else { "" };
        self.folder
            .join(format!("{world}-seed-{seed:06}-{number}-of-{of}{earlier}.frame"))
    }

    /// Makes what is missing in the background, in order, until all is there or `stop` says so.
    pub fn fill(&self, stop: Arc<AtomicBool>) -> JoinHandle<Result<(), TrainError>> {
        let frames = self.clone();
        std::thread::spawn(move || {
            let mut seeds = frames.seeds.clone();
            let going = |_: &u64| !stop.load(Ordering::Relaxed);
            seeds.by_ref().take_while(going).try_for_each(|seed| frames.make(seed))
        })
    }
}

impl Frames for SimulatedFrames {
    fn len(&self) -> usize {
        (self.seeds.end - self.seeds.start) as usize * self.per_seed
    }

    fn load(&self, index: usize) -> Result<Frame, TrainError> {
        let (seed, number) = (self.seeds.start + (index / self.per_seed) as u64, index % self.per_seed);
        let made = match self.made(seed, number) {
            Some(path) => path,
            None => {
                self.make(seed)?;
                self.made(seed, number)
                    .unwrap_or_else(|| self.path(seed, number, self.earlier))
            }
        };
        Frame::read(&made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_with_earlier_sweeps_serve_those_who_do_not_ask_for_them() {
        let dir = tempfile::tempdir().unwrap();
        let plain = SimulatedFrames::new(dir.path(), 3..4, 1).unwrap();
        let all = plain.clone().with_earlier();
        let frame = all.load(0).unwrap();
        assert!(frame.earlier.is_some());
        assert_eq!(plain.load(0).unwrap().agents, frame.agents);
        assert!(!plain.path(3, 0, false).exists(), "nothing is simulated twice");
        fs::remove_file(all.path(3, 0, true)).unwrap();
        assert!(plain.load(0).unwrap().earlier.is_none());
        assert!(plain.path(3, 0, false).exists());
    }
}
