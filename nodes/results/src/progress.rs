//! What a run says of itself while it goes on, where nobody else says it.

use std::time::{Duration, Instant};

use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Nanos, to_millis, to_seconds};

/// Between two lines.
const EVERY: Duration = Duration::from_secs(2);

/// Counts since the last line.
pub(crate) struct Progress {
    last: Instant,
    /// Stamp of the first boxes.
    begun: Option<Nanos>,
    boxes: u64,
    ages: Vec<Nanos>,
    /// Of the whole run.
    lost: u64,
    reported: u64,
}

impl Progress {
    pub fn new() -> Self {
        Progress {
            last: Instant::now(),
            begun: None,
            boxes: 0,
            ages: Vec::new(),
            lost: 0,
            reported: 0,
        }
    }

    /// Takes boxes of a stamp; prints when it is time.
    pub fn boxes(&mut self, stamp: Nanos) {
        let begun = *self.begun.get_or_insert(stamp);
        self.boxes += 1;
        let passed = self.last.elapsed();
        if passed < EVERY {
            return;
        }
        println!("realo: {}", self.line(stamp - begun, passed));
        self.last = Instant::now();
        (self.boxes, self.ages) = (0, Vec::new());
    }

    /// Takes what was said of messages over links.
    pub fn fates(&mut self, fates: &[Fated]) {
        self.ages
            .extend(fates.iter().filter_map(|fated| Some(fated.r#use?.age_ns)));
        self.reported += fates.len() as u64;
        self.lost += fates.iter().filter(|fated| fated.fate == Fate::Lost).count() as u64;
    }

    fn line(&mut self, into_log: Nanos, passed: Duration) -> String {
        let rate = self.boxes as f64 / passed.as_secs_f64();
        let mut line = format!("{:.1} s into the log, {rate:.1} Hz", to_seconds(into_log));
        self.ages.sort_unstable();
        if let Some(age) = self.ages.get(self.ages.len() / 2) {
            line.push_str(&format!(", data {:.0} ms old when fused", to_millis(*age)));
        }
        if self.reported > 0 {
            line.push_str(&format!(", {} messages lost on links", self.lost));
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::Kind;
    use realo_schemas::report::{Crossing, Use};

    use super::*;

    fn fated(fate: Fate, age_ms: i64) -> Fated {
        Fated {
            message: Crossing {
                from: "rsu1".into(),
                to: "cav1".into(),
                kind: Kind::Boxes,
                seq: 0,
            },
            fate,
            r#use: (fate == Fate::Used).then_some(Use {
                query: 0,
                age_ns: age_ms * 1_000_000,
            }),
        }
    }

    #[test]
    fn says_where_the_log_is_how_fast_how_old_and_what_was_lost() {
        let mut progress = Progress::new();
        progress.boxes = 19;
        let two = Duration::from_secs(2);
        assert_eq!(progress.line(4_000_000_000, two), "4.0 s into the log, 9.5 Hz");
        let fates = [(Fate::Used, 150), (Fate::Used, 90), (Fate::Used, 160), (Fate::Lost, 0)];
        progress.fates(&fates.map(|(fate, age)| fated(fate, age)));
        let expected = "4.0 s into the log, 9.5 Hz, data 150 ms old when fused, 1 messages lost on links";
        assert_eq!(progress.line(4_000_000_000, two), expected);
    }
}
