//! What a training is scored on, before and after.

use std::sync::Arc;

use crate::TrainError;
use crate::data::Frames;
use crate::train::{Data, TrainOptions, frames, validation_frames};
use crate::validate::Validation;

/// A network before and after a training, scored on the same frames.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The frames, in words.
    pub frames: String,
    /// The weights that the training began with; none where these were random numbers.
    pub before: Option<Validation>,
    /// The weights that it made.
    pub after: Validation,
}

/// Max frames of logs on which a training is validated.
const VALIDATED: usize = 24;

/// Usual time between two frames of a log, s.
pub const FRAMES_APART: f64 = 1.0;

/// Frames on which the network is scored.
pub(crate) struct Scored {
    pub frames: Arc<dyn Frames>,
    /// In words.
    pub name: String,
}

impl Scored {
    /// Frames of validation logs; else of validation seeds, or of logs some that the training is of: `trained`.
    pub fn of(options: &TrainOptions, trained: &Arc<dyn Frames>) -> Result<Self, TrainError> {
        let (of, whose, apart) = match &options.data {
            Data::Simulated { cache, .. } | Data::Logged { cache, .. } if !options.validation_logs.is_empty() => {
                let apart = match options.data {
                    Data::Logged { apart, .. } => apart,
                    Data::Simulated { .. } => FRAMES_APART,
                };
                let of = frames(&Data::Logged {
                    cache: cache.clone(),
                    logs: options.validation_logs.clone(),
                    apart,
                })?;
                (of, "the validation logs", apart)
            }
            Data::Simulated { .. } => {
                return Ok(Scored {
                    frames: validation_frames(&options.data)?,
                    name: "simulator seeds 800 to 811".into(),
                });
            }
            Data::Logged { apart, .. } => (trained.clone(), "the logs of the training itself", *apart),
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
}
