//! Whether the stages of a process keep up.

use std::fmt;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

/// How a line begins that says which stage does not keep up, in words and then in JSON.
const SLOW: &str = "realo: does not keep up: ";
/// What is measured at a time: short enough to be reported within ten seconds.
const WINDOW: Duration = Duration::from_secs(4);
/// The share of its time in which a stage that does not keep up is busy.
const BUSY: f64 = 0.85;
/// The share of what comes that a stage may skip: a start that is late is not slow.
const SKIPPED: f64 = 0.1;

/// A stage that does not keep up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slow {
    /// Its id.
    pub node: String,
    /// What a call takes, ms.
    pub call_ms: f64,
    /// The share of what comes that it does, 0 to 1.
    pub share: f64,
}

impl Slow {
    /// The line of a process's standard error that says so.
    pub fn to_line(&self) -> String {
        let json = serde_json::to_string(self).expect("its fields are JSON");
        format!("{SLOW}{self} {json}")
    }

    /// What a line says; `None` of any other line.
    pub fn from_line(line: &str) -> Option<Self> {
        let (_, said) = line.split_once(SLOW)?;
        let mut begins = said.match_indices('{').map(|(at, _)| said[at..].trim());
        begins.find_map(|json| serde_json::from_str(json).ok())
    }
}

impl fmt::Display for Slow {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let (node, call_ms, done) = (&self.node, self.call_ms, self.share * 100.0);
        write!(
            f,
            "node `{node}` takes {call_ms:.0} ms a call and does {done:.0} % of what comes"
        )
    }
}

/// What the calls of each stage took.
pub(super) struct Load {
    stages: Vec<Calls>,
    since: Option<Instant>,
    reported: bool,
}

#[derive(Clone, Copy, Default)]
struct Calls {
    made: u64,
    took: Duration,
    /// Messages that were skipped before.
    skipped: u64,
}

impl Load {
    pub fn of(stages: usize) -> Self {
        Load {
            stages: vec![Calls::default(); stages],
            since: None,
            reported: false,
        }
    }

    /// Takes a call; the first one, which many a stage prepares in, is not counted.
    pub fn call(&mut self, stage: usize, took: Duration) {
        if self.since.is_none() {
            self.since = Some(Instant::now());
            return;
        }
        self.stages[stage].made += 1;
        self.stages[stage].took += took;
    }

    /// Once, the stage that holds the process up; `skipped` are the messages that a stage skipped so far, `id` its name.
    pub fn slow(&mut self, skipped: impl Fn(usize) -> u64, id: impl Fn(usize) -> String) -> Option<Slow> {
        let passed = self.since?.elapsed();
        if self.reported || passed < WINDOW {
            return None;
        }
        self.since = Some(Instant::now());
        let mut slowest: Option<(usize, f64, f64)> = None;
        for (stage, calls) in self.stages.iter_mut().enumerate() {
            let before = std::mem::take(calls);
            calls.skipped = skipped(stage);
            let missed = (calls.skipped - before.skipped) as f64;
            let share = before.made as f64 / (before.made as f64 + missed).max(1.0);
            let busy = before.took.as_secs_f64() / passed.as_secs_f64();
            let is_slow = before.made > 0 && busy > BUSY && share < 1.0 - SKIPPED;
            if is_slow && slowest.is_none_or(|(_, min, _)| share < min) {
                slowest = Some((stage, share, before.took.as_secs_f64() * 1e3 / before.made as f64));
            }
        }
        let (stage, share, call_ms) = slowest?;
        self.reported = true;
        Some(Slow {
            node: id(stage),
            call_ms,
            share,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(took: Duration, skipped: u64) -> Option<Slow> {
        let mut load = Load::of(2);
        load.call(1, took);
        (0..10).for_each(|_| load.call(1, took));
        load.since = Instant::now().checked_sub(WINDOW);
        load.slow(|_| skipped, |stage| format!("stage {stage}"))
    }

    #[test]
    fn a_stage_that_is_always_busy_and_skips_messages_does_not_keep_up() {
        let slow = measured(WINDOW / 10, 10).expect("it is slow");
        assert_eq!((&*slow.node, slow.call_ms, slow.share), ("stage 1", 400.0, 0.5));
        assert_eq!(
            slow.to_string(),
            "node `stage 1` takes 400 ms a call and does 50 % of what comes"
        );
        let line = format!("17:48:16 stdout ego: {}", slow.to_line());
        assert!(line.contains(&format!("does not keep up: {slow} {{")), "{line}");
        assert_eq!(Slow::from_line(&line), Some(slow));
        assert_eq!(Slow::from_line("realo: does not keep up: {}"), None);
        assert_eq!(measured(WINDOW / 10, 0), None, "it skips nothing");
        assert_eq!(measured(WINDOW / 40, 10), None, "it has time left");
    }
}
