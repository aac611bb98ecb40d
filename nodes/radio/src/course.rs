//! What the way from a peer was like, second by second, by what came over it: a trace that a `link` replays.

use realo_schemas::report::Phase;
use realo_schemas::{Nanos, to_millis};

const SECOND: Nanos = 1_000_000_000;
/// Rate of a way on which nothing was large enough to tell, bit/s.
const UNKNOWN: f64 = 1e9;
/// What takes less from its first part to its last shows pauses, not the way.
const SHORTEST: Nanos = 5_000_000;
/// Seconds that are kept: of a longer run the first ones.
const MOST: usize = 100_000;

/// A message that came.
#[derive(Clone, Copy, Debug)]
pub struct Came {
    /// What crossed.
    pub bytes: usize,
    /// From its sender's radio to this one, by both clocks; `None` while they are not known.
    pub on_the_way: Option<Nanos>,
    /// What its parts took at the pace at which they came.
    pub took: Nanos,
}

/// The way from a peer so far.
#[derive(Clone, Debug, Default)]
pub struct Course {
    /// Whether the way is cut where nothing comes for a second.
    is_busy: bool,
    begun: Option<Nanos>,
    phases: Vec<Phase>,
    /// Of the second that is not over.
    delay: Option<Nanos>,
    rate: Option<f64>,
    came: u64,
    lost: u64,
}

impl Course {
    /// Of a peer that sends all the time: where nothing comes for a second, the way was cut.
    pub fn busy() -> Self {
        Course {
            is_busy: true,
            ..Course::default()
        }
    }

    /// A message came.
    pub fn came(&mut self, now: Nanos, came: &Came) {
        self.pass(now);
        self.came += 1;
        let known = match came.took {
            took if took >= SHORTEST => {
                let rate = 8e9 * came.bytes as f64 / took as f64;
                self.rate = Some(self.rate.map_or(rate, |known| known.max(rate)));
                rate
            }
            _ => self.last().bits_per_second.max(1.0),
        };
        let crossing = (8e9 * came.bytes as f64 / known) as Nanos;
        if let Some(on_the_way) = came.on_the_way {
            let delay = (on_the_way - crossing).max(0);
            self.delay = Some(self.delay.map_or(delay, |min| min.min(delay)));
        }
    }

    /// Messages were lost.
    pub fn lost(&mut self, now: Nanos, messages: u64) {
        self.pass(now);
        self.lost += messages;
    }

    /// All seconds, the last one as far as it went.
    pub fn close(mut self) -> Vec<Phase> {
        if self.came + self.lost > 0 {
            self.end_second();
        }
        self.phases
    }

    /// What was known last.
    fn last(&self) -> Phase {
        let crossing = self.phases.iter().rev().find(|phase| phase.bits_per_second > 0.0);
        crossing.copied().unwrap_or(Phase {
            bits_per_second: UNKNOWN,
            ..Phase::default()
        })
    }

    /// Ends the seconds that are over.
    fn pass(&mut self, now: Nanos) {
        let begun = *self.begun.get_or_insert(now);
        let over = ((now - begun) / SECOND).max(0) as usize;
        while self.phases.len() < over.min(MOST) {
            self.end_second();
        }
    }

    fn end_second(&mut self) {
        let last = self.last();
        let is_open = self.came + self.lost > 0 || !self.is_busy;
        let all = (self.came + self.lost).max(1);
        self.phases.push(Phase {
            seconds: self.phases.len() as f64,
            bits_per_second: if is_open {
                self.rate.unwrap_or(last.bits_per_second)
            } else {
                0.0
            },
            delay_ms: self.delay.map_or(last.delay_ms, to_millis),
            loss: self.lost as f64 / all as f64,
        });
        *self = Course {
            is_busy: self.is_busy,
            begun: self.begun,
            phases: std::mem::take(&mut self.phases),
            ..Course::default()
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Nanos = 1_000_000;

    fn small(ms: Nanos) -> Came {
        Came {
            bytes: 100,
            on_the_way: Some(ms * MS),
            took: 0,
        }
    }

    #[test]
    fn a_second_has_the_rate_of_what_is_large_and_the_least_delay() {
        let mut course = Course::busy();
        course.came(7 * SECOND, &small(25));
        course.came(7 * SECOND + 100 * MS, &small(21));
        // 100 kB in 40 ms are 20 Mbit/s; of 61 ms on the way 21 are the way's own.
        let large = Came {
            bytes: 100_000,
            on_the_way: Some(61 * MS),
            took: 40 * MS,
        };
        course.came(8 * SECOND, &large);
        course.lost(8 * SECOND + 10 * MS, 1);
        course.came(8 * SECOND + 20 * MS, &small(22));
        // A second of silence, then the last one, that says what was known before.
        course.came(10 * SECOND, &small(30));
        let phases = course.close();
        let found: Vec<_> = phases
            .iter()
            .map(|phase| {
                (
                    phase.seconds,
                    phase.bits_per_second.round(),
                    phase.delay_ms.round(),
                    phase.loss,
                )
            })
            .collect();
        let expected = [
            (0.0, 1e9, 21.0, 0.0),
            (1.0, 2e7, 21.0, 1.0 / 3.0),
            (2.0, 0.0, 21.0, 0.0),
            (3.0, 2e7, 30.0, 0.0),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn a_way_of_which_nothing_came_has_no_course() {
        assert!(Course::default().close().is_empty());
    }

    #[test]
    fn silence_cuts_only_a_way_that_is_busy() {
        for (mut course, expected) in [(Course::default(), 1e9), (Course::busy(), 0.0)] {
            course.came(0, &small(20));
            course.came(2 * SECOND, &small(20));
            let phases = course.close();
            assert_eq!((phases.len(), phases[1].bits_per_second), (3, expected));
        }
    }
}
