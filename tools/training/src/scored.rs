//! What a training is scored on, before and after.

use std::sync::Arc;

use crate::TrainError;
use crate::data::{Frames, LeftOut};
use crate::train::{Data, TrainOptions, frames, validation_frames};
use crate::validate::Validation;

/// A network before and after a training, scored on the same frames.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The frames, in words.
    pub frames: String,
    /// What it is compared with; none where the training began with random numbers and no other weights are beside the
    /// model file.
    pub before: Option<Before>,
    /// The weights that it made.
    pub after: Validation,
}

/// A score that a training is compared with.
#[derive(Clone, Debug, PartialEq)]
pub struct Before {
    /// The frames, in words.
    pub frames: String,
    /// Whether the training begins with these weights; otherwise they are those beside the model file.
    pub begins: bool,
    /// How good they are.
    pub score: Validation,
}

/// Max frames of logs on which a training is validated.
const VALIDATED: usize = 24;

/// Usual time between two frames of a log, s.
pub const FRAMES_APART: f64 = 1.0;

/// Max gap between poses that is usually bridged, ms: the default of the operator `sync`.
pub const MAX_GAP_MS: u32 = (realo_logs::MAX_GAP / 1_000_000) as u32;

/// Frames on which the network is scored.
pub(crate) struct Scored {
    pub frames: Arc<dyn Frames>,
    /// In words.
    pub name: String,
}

impl Scored {
    /// Frames of validation logs; else of validation seeds, or of logs some that the training is of: `trained`.
    pub fn of(options: &TrainOptions, trained: &Arc<dyn Frames>) -> Result<Self, TrainError> {
        let (of, whose, apart) = match (&options.validation, &options.data) {
            (Some(logged), Data::Simulated { cache, .. } | Data::Logged { cache, .. }) => {
                let of = frames(&Data::Logged {
                    cache: cache.clone(),
                    logged: logged.clone(),
                })?;
                (of, "the validation logs", logged.apart)
            }
            (None, Data::Simulated { .. }) => {
                return Ok(Scored {
                    frames: validation_frames(&options.data)?,
                    name: "simulator seeds 800 to 811".into(),
                });
            }
            (None, Data::Logged { logged, .. }) => (trained.clone(), "the logs of the training itself", logged.apart),
        };
        let some = SomeFrames {
            count: of.len().min(VALIDATED),
            of,
        };
        let of_all = match some.of.len() > some.count {
            true => format!(" of {}", some.of.len()),
            false => String::new(),
        };
        Ok(Scored {
            name: format!("{}{of_all} frames of {whose}, at least {apart} s apart", some.count),
            frames: Arc::new(some),
        })
    }
}

/// Some frames, evenly spread.
struct SomeFrames {
    of: Arc<dyn Frames>,
    count: usize,
}

impl Frames for SomeFrames {
    fn len(&self) -> usize {
        self.count
    }

    fn load(&self, index: usize) -> Result<crate::data::Frame, TrainError> {
        self.of.load(index * self.of.len() / self.count)
    }

    fn left_out(&self) -> &[LeftOut] {
        self.of.left_out()
    }
}
