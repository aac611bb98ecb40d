//! How long the steps of a call take.

use realo_schemas::Nanos;

/// Times the steps of a call by the clock of its driver; where that has none, as in virtual time, steps just run.
///
/// An operator names its steps, and learns nothing of time.
#[derive(Clone, Debug, Default)]
pub struct Steps {
    /// Time from any fixed moment on.
    clock: Option<fn() -> Nanos>,
    took: Vec<(&'static str, Nanos)>,
}

impl Steps {
    /// Steps that a clock times; it must never go back.
    pub fn timed_by(clock: fn() -> Nanos) -> Self {
        Steps {
            clock: Some(clock),
            took: Vec::new(),
        }
    }

    /// Does a step.
    pub fn time<T>(&mut self, step: &'static str, work: impl FnOnce() -> T) -> T {
        let Some(clock) = self.clock else { return work() };
        let begun = clock();
        let done = work();
        self.took.push((step, clock() - begun));
        done
    }

    /// Notes a step that took so long elsewhere, unless there is no clock.
    pub fn took(&mut self, step: &'static str, took: Nanos) {
        if self.clock.is_some() {
            self.took.push((step, took));
        }
    }

    /// The steps so far and what each took, in order.
    pub fn take(&mut self) -> Vec<(&'static str, Nanos)> {
        std::mem::take(&mut self.took)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicI64, Ordering};

    use super::*;

    #[test]
    fn steps_are_timed_by_a_clock_only() {
        static NOW: AtomicI64 = AtomicI64::new(0);
        let mut timed = Steps::timed_by(|| NOW.fetch_add(7, Ordering::Relaxed));
        assert_eq!(timed.time("one", || 1) + timed.time("two", || 2), 3);
        assert_eq!(timed.take(), [("one", 7), ("two", 7)]);
        assert_eq!(timed.take(), []);
        let mut free = Steps::default();
        assert_eq!(free.time("one", || 1), 1);
        assert_eq!(free.take(), []);
    }
}
