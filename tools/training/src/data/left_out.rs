//! What of logs is not learnt from: agents, counts, causes and remedies.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use realo_schemas::{Nanos, to_millis};
use serde::{Deserialize, Serialize};

use super::frames::Frames;
use super::logged::NEAR;

/// What of a log is not learnt from, or not scored on. Its text is a sentence with the remedy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOut {
    /// The log.
    pub log: PathBuf,
    /// Whose data it is.
    pub agent: String,
    /// Whether the labels that frames are made for are this agent's: without it there is no frame.
    pub is_labelled: bool,
    /// Why.
    pub cause: Cause,
    /// How many: frames without the agent, or what the cause says.
    pub count: usize,
    /// Of how many.
    pub of: usize,
}

/// Why something of a log is left out. [`Cause::Cut`] is of no agent.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Cause {
    /// The log has no points of the agent.
    NoPoints,
    /// The agent has no sweep near the labels.
    NoSweep,
    /// The agent's pose is not known at its sweep.
    NoPose {
        /// Max gap between poses that is bridged, ms.
        max_gap_ms: u32,
    },
    /// Neither labels of its own at its sweep, nor a pose that brings others' there.
    NoLabels,
    /// Points that stay as they were recorded, since poses do not tell the motion during the sweep.
    NotDeskewed,
    /// Pose messages that do not hold a valid pose.
    BadPoses {
        /// What is wrong with the first.
        reason: String,
    },
    /// The file was cut.
    Cut {
        /// Where, and what it lacks.
        reason: String,
    },
    /// Labels of a class that the log's protocol does not score.
    UnknownClass {
        /// The class.
        class: String,
        /// The protocol.
        protocol: String,
    },
}

impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let LeftOut {
            log, agent, count, of, ..
        } = self;
        write!(f, "{}: ", log.display())?;
        if let Cause::Cut { reason } = &self.cause {
            return f.write_str(reason);
        }
        let frames = match self.is_labelled {
            true => format!("{count} of {of} frames are left out: `{agent}`, whose labels they have,"),
            false => format!("{count} of {of} frames are without `{agent}`: it"),
        };
        match &self.cause {
            Cause::Cut { .. } => Ok(()),
            Cause::NoPoints => write!(
                f,
                "{frames} has no points in the log; record its clouds, or take a log that has them"
            ),
            Cause::NoSweep => write!(
                f,
                "{frames} has no sweep within {} ms of the labels; record sweeps at 10 Hz or more, and see by `realo info` \
                 whether the agents' clocks agree",
                to_millis(NEAR)
            ),
            Cause::NoPose { max_gap_ms } => write!(
                f,
                "{frames} has no pose at its sweep: poses must be at most {max_gap_ms} ms apart and span the sweeps; record \
                 them at 10 Hz or more, or bridge longer gaps with --max-gap-ms"
            ),
            Cause::NoLabels => write!(
                f,
                "{frames} has no labels within 1 µs of its sweep, and no pose brings others' labels there; give labels the \
                 stamps of the sweeps, or record poses at them"
            ),
            Cause::NotDeskewed => write!(
                f,
                "{count} of {of} sweeps of `{agent}` are taken as they were recorded: poses do not span them; record poses until \
                 the last point of each"
            ),
            Cause::BadPoses { reason } => write!(
                f,
                "{count} of {of} poses of `{agent}` are left out: {reason}; write finite poses with quaternions of length 1"
            ),
            Cause::UnknownClass { class, protocol } => write!(
                f,
                "{count} of {of} labels of `{agent}` are left out: the protocol `{protocol}` has no class `{class}`; rename it, \
                 or give the log a protocol that has it"
            ),
        }
    }
}

/// What is left out of the frames of a training and of its validation, each once.
pub fn left_out_once(trained: &dyn Frames, validation: &dyn Frames) -> Vec<LeftOut> {
    let mut left_out = trained.left_out().to_vec();
    for more in validation.left_out() {
        if !left_out.contains(more) {
            left_out.push(more.clone());
        }
    }
    left_out
}

/// What was left out of one log.
#[derive(Debug, Default)]
pub(super) struct Account {
    counts: BTreeMap<(String, Cause), [usize; 2]>,
}

impl Account {
    /// Adds so many of so many.
    pub fn add(&mut self, agent: &str, cause: Cause, count: usize, of: usize) {
        if count > 0 {
            let [all, whole] = self.counts.entry((agent.into(), cause)).or_default();
            (*all, *whole) = (*all + count, of);
        }
    }

    /// All of it. `labelled`: the agent whose labels frames are made for.
    pub fn of(self, log: &Path, labelled: &str) -> Vec<LeftOut> {
        let left_out = |((agent, cause), [count, of]): ((String, Cause), [usize; 2])| LeftOut {
            log: log.into(),
            is_labelled: agent == labelled,
            agent,
            cause,
            count,
            of,
        };
        self.counts.into_iter().map(left_out).collect()
    }
}

/// Max gap between poses that is bridged, ns.
pub(super) fn gap(max_gap_ms: u32) -> Nanos {
    Nanos::from(max_gap_ms) * 1_000_000
}
