//! Which sweeps of a log a recording is of.

use std::collections::VecDeque;

use eyre::{Result, ensure, eyre};
use realo_results::scoring::same_truth;
use realo_schemas::{GroundTruth, Header, Nanos};

use crate::truth_reader::TruthReader;

/// Truth of a sweep.
pub type Sweep = (Header, GroundTruth);

/// Gives the truth of a log's sweeps, in order of their numbers.
pub trait TruthSource {
    /// The next sweep; `None` at the end.
    ///
    /// # Errors
    /// A log that cannot be read.
    fn next(&mut self) -> Result<Option<Sweep>>;
}

impl TruthSource for TruthReader {
    fn next(&mut self) -> Result<Option<Sweep>> {
        TruthReader::next(self)
    }
}

/// So many sweeps of the log are kept for recorded ones that come out of order.
const KEPT: usize = 64;

/// A log's truth by sweep, read along with a recording, and how the player numbers it in later passes.
pub struct Sweeps<O, N> {
    /// Reads the log from its beginning.
    open: O,
    next: N,
    /// The newest sweeps that were read.
    kept: VecDeque<Sweep>,
    /// Sweeps that were read since the beginning.
    read: usize,
    at_end: bool,
    per_pass: u64,
    /// Log time between two passes, once a recording has shown it.
    period: Option<Nanos>,
    fitted: usize,
}

impl<O, N> Sweeps<O, N>
where
    O: Fn() -> Result<N>,
    N: TruthSource,
{
    /// `open` reads the log from its beginning, sweeps in order of their numbers; `per_pass`: by how much a sweep's number
    /// rises from pass to pass.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn new(open: O, per_pass: u64) -> Result<Self> {
        Ok(Sweeps {
            next: open()?,
            open,
            kept: VecDeque::new(),
            read: 0,
            at_end: false,
            per_pass: per_pass.max(1),
            period: None,
            fitted: 0,
        })
    }

    /// The log's truth of a sweep that was recorded, numbered and stamped as it was played.
    ///
    /// # Errors
    /// A recorded sweep that the log does not have, or has at another time or with other objects.
    pub fn find(&mut self, sweep: &Sweep) -> Result<Sweep, Misfit> {
        match self.fitting(sweep) {
            Ok(found) => {
                self.fitted += 1;
                Ok(found)
            }
            Err(reason) => Err(Misfit {
                fitted: self.fitted,
                beyond: self.last().is_ok_and(|last| last.is_none_or(|last| sweep.0.seq > last)),
                reason,
            }),
        }
    }

    /// The sweeps of the log.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn count(&mut self) -> Result<usize> {
        while self.advance()? {}
        Ok(self.read)
    }

    /// What reads the log, once it has read all of it.
    ///
    /// # Errors
    /// A log that cannot be read.
    pub fn into_reader(mut self) -> Result<N> {
        self.count()?;
        Ok(self.next)
    }

    /// Number of the last sweep of the log; `None` without any.
    fn last(&mut self) -> Result<Option<u64>> {
        self.count()?;
        Ok(self.kept.back().map(|(header, _)| header.seq))
    }

    /// Reads a sweep; whether there was one.
    fn advance(&mut self) -> Result<bool> {
        let next = if self.at_end { None } else { self.next.next()? };
        let Some(sweep) = next else {
            self.at_end = true;
            return Ok(false);
        };
        if self.kept.len() == KEPT {
            self.kept.pop_front();
        }
        self.kept.push_back(sweep);
        self.read += 1;
        Ok(true)
    }

    /// The log's sweep of a number. What lies before those that are kept is read again, once for each pass over a log.
    fn logged(&mut self, seq: u64) -> Result<Option<&Sweep>> {
        let is_past = self.kept.front().is_some_and(|(header, _)| seq < header.seq);
        if is_past && self.read > self.kept.len() {
            self.next = (self.open)()?;
            self.kept.clear();
            (self.read, self.at_end) = (0, false);
        }
        while self.kept.back().is_none_or(|(header, _)| header.seq < seq) {
            if !self.advance()? {
                break;
            }
        }
        Ok(self.kept.iter().find(|(header, _)| header.seq == seq))
    }

    fn fitting(&mut self, (header, recorded): &Sweep) -> Result<Sweep> {
        let (pass, seq) = (header.seq / self.per_pass, header.seq % self.per_pass);
        let period = self.period;
        let Some((logged, truth)) = self.logged(seq)? else {
            return Err(self.unknown(header)?);
        };
        let shift = header.stamp - logged.stamp;
        let fits = match (pass, period) {
            (0, _) => shift == 0,
            (_, Some(period)) => shift == period * pass as Nanos,
            (_, None) => shift > 0 && shift % pass as Nanos == 0,
        };
        ensure!(
            fits,
            "sweep {} of {} has stamp {} ns in the recording, {} ns in the log{}",
            header.seq,
            header.agent,
            header.stamp,
            logged.stamp,
            later(pass)
        );
        same_truth(recorded, truth)
            .map_err(|reason| eyre!("the truth of sweep {} of {}: {reason}", header.seq, header.agent))?;
        let found = (header.clone(), truth.clone());
        if pass > 0 {
            self.period = Some(shift / pass as Nanos);
        }
        Ok(found)
    }

    fn unknown(&mut self, header: &Header) -> Result<eyre::Report> {
        Ok(eyre!(
            "sweep {} of {}, stamp {} ns, is in the recording but not in the log, which has {} sweeps of that agent",
            header.seq,
            header.agent,
            header.stamp,
            self.count()?
        ))
    }
}

fn later(pass: u64) -> String {
    match pass {
        0 => String::new(),
        pass => format!(" (played in pass {} over it)", pass + 1),
    }
}

/// A recorded sweep that the log does not have as it was recorded.
#[derive(Debug)]
pub struct Misfit {
    /// Recorded sweeps before it that the log has.
    pub fitted: usize,
    /// Whether its number lies beyond all that the log has.
    pub beyond: bool,
    /// What differs.
    pub reason: eyre::Report,
}

#[cfg(test)]
mod tests {
    use super::*;
    use realo_schemas::{Box3, Kind};

    /// Sweeps without a log.
    impl<N: FnMut() -> Result<Option<Sweep>>> TruthSource for N {
        fn next(&mut self) -> Result<Option<Sweep>> {
            self()
        }
    }

    const PER_PASS: u64 = 4;
    const PERIOD: Nanos = 1_900;

    fn car(x: f64) -> Box3 {
        Box3 {
            track: Some(1),
            ..Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0)
        }
    }

    fn sweep(seq: u64, stamp: Nanos, x: f64) -> Sweep {
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Truth, seq, stamp, stamp);
        let truth = GroundTruth {
            boxes: vec![car(x)],
            agents: vec!["cav1".into()],
            points: vec![9],
            ego_footprint: None,
            key: true,
            ..GroundTruth::default()
        };
        (header, truth)
    }

    /// Finds recorded sweeps in a log of these.
    fn played(logged: &[Sweep], per_pass: u64, recorded: &[Sweep]) -> Result<Vec<Sweep>, Misfit> {
        let open = || {
            let mut left = logged.iter().cloned();
            Ok(move || Ok(left.next()))
        };
        let mut sweeps = Sweeps::new(open, per_pass).unwrap();
        recorded.iter().map(|sweep| sweeps.find(sweep)).collect()
    }

    fn log() -> Vec<Sweep> {
        let sweeps = (0..PER_PASS).map(|seq| sweep(seq, 100 * seq as Nanos, seq as f64));
        sweeps.collect()
    }

    fn numbers(recorded: &[Sweep]) -> Result<Vec<(u64, Nanos, f64)>, Misfit> {
        let played = played(&log(), PER_PASS, recorded)?;
        let number = |(header, truth): &Sweep| (header.seq, header.stamp, truth.boxes[0].center[0]);
        Ok(played.iter().map(number).collect())
    }

    #[test]
    fn only_the_sweeps_that_were_played_are_given() {
        let recorded = [sweep(2, 200, 2.0), sweep(3, 300, 3.0)];
        assert_eq!(numbers(&recorded).unwrap(), [(2, 200, 2.0), (3, 300, 3.0)]);
    }

    #[test]
    fn later_passes_are_scored_by_the_sweep_that_was_played_again() {
        let recorded = [
            sweep(3, 300, 3.0),
            sweep(7, 300 + PERIOD, 3.0),
            sweep(11, 300 + 2 * PERIOD, 3.0),
        ];
        let stamps = [300, 300 + PERIOD, 300 + 2 * PERIOD];
        let expected = [3, 7, 11].into_iter().zip(stamps).map(|(seq, stamp)| (seq, stamp, 3.0));
        assert_eq!(numbers(&recorded).unwrap(), expected.collect::<Vec<_>>());
    }

    #[test]
    fn a_recording_of_another_log_is_refused() {
        let other_points = {
            let (header, truth) = sweep(1, 100, 1.0);
            (
                header,
                GroundTruth {
                    points: vec![8],
                    ..truth
                },
            )
        };
        let cases = [
            (vec![sweep(1, 101, 1.0)], "101 ns"),
            (vec![sweep(1, 100, 1.5)], "1.50"),
            (vec![other_points], "object 0"),
            (vec![sweep(5, 100, 1.0)], "pass 2"),
            (vec![sweep(5, 2_000, 1.0), sweep(6, 2_101, 2.0)], "2101 ns"),
        ];
        for (recorded, named) in cases {
            let error = numbers(&recorded).unwrap_err().reason.to_string();
            assert!(error.contains(named), "`{named}` in: {error}");
        }
    }

    #[test]
    fn a_sweep_that_the_log_lacks_is_named() {
        let short = [sweep(0, 0, 0.0)];
        let misfit = played(&short, PER_PASS, &[sweep(0, 0, 0.0), sweep(2, 200, 2.0)]).unwrap_err();
        let error = misfit.reason.to_string();
        assert!(
            error.contains("sweep 2 of cav1") && error.contains("not in the log"),
            "{error}"
        );
        assert_eq!((misfit.fitted, misfit.beyond), (1, true));
        let misfit = played(&log(), PER_PASS, &[sweep(3, 301, 3.0)]).unwrap_err();
        assert_eq!((misfit.fitted, misfit.beyond), (0, false));
    }

    #[test]
    fn a_log_of_any_length_is_read_along_with_a_few_sweeps_in_hand() {
        const LONG: u64 = 5_000;
        let opened = std::cell::Cell::new(0);
        let open = || {
            opened.set(opened.get() + 1);
            let mut left = (0..LONG).map(|seq| sweep(seq, 100 * seq as Nanos, 1.0));
            Ok(move || Ok(left.next()))
        };
        let mut sweeps = Sweeps::new(open, LONG).unwrap();
        // Two passes, in each of which neighbours change places.
        for number in 0..2 * LONG {
            let (pass, seq) = (number / LONG, (number % LONG) ^ 1);
            let stamp = 100 * seq as Nanos + 700_000 * pass as Nanos;
            let found = sweeps.find(&sweep(pass * LONG + seq, stamp, 1.0)).unwrap();
            assert_eq!(found.0.seq, pass * LONG + seq);
            assert!(sweeps.kept.len() <= KEPT);
        }
        assert_eq!((opened.get(), sweeps.count().unwrap()), (2, LONG as usize));
    }
}
