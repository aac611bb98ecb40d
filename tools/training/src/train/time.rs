//! How long a training may take, and its steps do.

use std::time::{Duration, Instant};

/// The time that a training has.
pub struct Time {
    begin: Instant,
    budget: Option<Duration>,
}

impl Time {
    /// Begins now.
    pub fn new(minutes: Option<f64>) -> Self {
        Time {
            begin: Instant::now(),
            budget: minutes.map(|minutes| Duration::from_secs_f64(minutes * 60.0)),
        }
    }

    /// Whether it went by.
    pub fn is_over(&self) -> bool {
        self.budget.is_some_and(|budget| self.begin.elapsed() >= budget)
    }

    /// Share of it that went by; `None` where it has no end.
    pub fn share(&self) -> Option<f64> {
        let share = |budget: Duration| self.begin.elapsed().as_secs_f64() / budget.as_secs_f64();
        self.budget.map(share)
    }

    /// Seconds until its end.
    pub fn left(&self) -> f64 {
        let left = |budget: Duration| budget.saturating_sub(self.begin.elapsed()).as_secs_f64();
        self.budget.map_or(f64::INFINITY, left)
    }
}

/// Running means of the times of a step.
#[derive(Default)]
pub struct Pace {
    /// Of a step, s.
    pub seconds: f64,
    /// Of it, waiting for data, s.
    pub waiting: f64,
    steps: u32,
}

impl Pace {
    /// Adds a step.
    pub fn add(&mut self, seconds: f64, waiting: f64) {
        self.steps = (self.steps + 1).min(50);
        let share = 1.0 / f64::from(self.steps);
        self.seconds += share * (seconds - self.seconds);
        self.waiting += share * (waiting - self.waiting);
    }
}
