//! The frames that a training draws from, and the threads that make them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::TrainError;
use crate::data::{Frames, LoggedData, LoggedFrames, SimulatedFrames};
use crate::scored::{FRAMES_APART, MAX_GAP_MS};
use crate::train::Data;

/// The frames that options ask for.
pub struct Source {
    /// As they are drawn from.
    pub frames: Arc<dyn Frames>,
    /// What they are of, in words that tell them from others.
    pub name: String,
    /// Frames that may have to be made yet.
    pub missing: Option<SimulatedFrames>,
}

impl Source {
    /// Opens them. `earlier`: whether simulated frames have earlier sweeps too.
    pub fn open(data: &Data, earlier: bool) -> Result<Self, TrainError> {
        match data {
            Data::Simulated { cache, seeds, per_seed } => {
                let mut frames = SimulatedFrames::new(cache, seeds.clone(), *per_seed)?;
                let world = crate::data::world();
                let mut name = format!("simulator seeds {seeds:?}, {per_seed} frames each, {world}");
                if earlier {
                    frames = frames.with_earlier();
                    name.push_str(" and earlier");
                }
                Ok(Source {
                    frames: Arc::new(frames.clone()),
                    name,
                    missing: Some(frames),
                })
            }
            Data::Logged { cache, logged } => {
                let frames = LoggedFrames::new(cache, logged)?;
                let LoggedData {
                    logs,
                    apart,
                    max_gap_ms,
                } = logged;
                let spacing = match *apart == FRAMES_APART {
                    true => String::new(),
                    false => format!(", {apart} s apart"),
                };
                let bridged = match *max_gap_ms == MAX_GAP_MS {
                    true => String::new(),
                    false => format!(", gaps between poses of up to {max_gap_ms} ms bridged"),
                };
                Ok(Source {
                    name: format!("logs {logs:?}, {}{spacing}{bridged}", frames.identity()),
                    frames: Arc::new(frames),
                    missing: None,
                })
            }
        }
    }
}

/// Threads that make frames; they end with the training.
#[derive(Default)]
pub struct Filling {
    /// Reports the threads to end.
    pub stop: Arc<AtomicBool>,
    /// Threads that make frames.
    pub threads: Vec<std::thread::JoinHandle<Result<(), TrainError>>>,
}

impl Drop for Filling {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // The loader meets the same error where it matters.
            let _ = thread.join();
        }
    }
}

/// The frames of a few validation seeds.
///
/// # Errors
/// [`TrainError::Write`] if there can be no folder for them.
pub fn validation_frames(data: &Data) -> Result<Arc<dyn Frames>, TrainError> {
    let (Data::Simulated { cache, .. } | Data::Logged { cache, .. }) = data;
    Ok(Arc::new(SimulatedFrames::new(cache, 800..812, 1)?))
}

/// The frames of some data.
///
/// # Errors
/// [`TrainError`] if there can be no folder for them, or logs have none.
pub fn frames(data: &Data) -> Result<Arc<dyn Frames>, TrainError> {
    Ok(Source::open(data, false)?.frames)
}
