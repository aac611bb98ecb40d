//! Which sweeps of a log a recording is of.

use std::collections::BTreeMap;

use eyre::{Result, ensure, eyre};
use realo_schemas::{GroundTruth, Header, Nanos};
use realo_scoring::same_truth;

/// Truth of a sweep.
pub type Sweep = (Header, GroundTruth);

/// A log's truth by sweep, and how the player numbers it in later passes.
pub struct Sweeps {
    by_seq: BTreeMap<u64, Sweep>,
    per_pass: u64,
    /// Log time between two passes, once a recording has shown it.
    period: Option<Nanos>,
}

impl Sweeps {
    /// `per_pass`: by how much a sweep's number rises from pass to pass.
    pub fn new(truths: Vec<Sweep>, per_pass: u64) -> Self {
        let by_seq = truths.into_iter().map(|sweep| (sweep.0.seq, sweep)).collect();
        Sweeps {
            by_seq,
            per_pass: per_pass.max(1),
            period: None,
        }
    }

    /// The log's truth of the sweeps that were recorded, numbered and stamped as they were played.
    ///
    /// # Errors
    /// A recorded sweep that the log does not have, or has at another time or with other objects.
    pub fn played(mut self, recorded: &[Sweep]) -> Result<Vec<Sweep>, Misfit> {
        let mut found = Vec::with_capacity(recorded.len());
        for sweep in recorded {
            found.push(self.find(sweep).map_err(|reason| Misfit {
                fitted: found.len(),
                beyond: self.by_seq.keys().next_back().is_none_or(|last| sweep.0.seq > *last),
                reason,
            })?);
        }
        Ok(found)
    }

    fn find(&mut self, (header, recorded): &Sweep) -> Result<Sweep> {
        let (pass, seq) = (header.seq / self.per_pass, header.seq % self.per_pass);
        let (logged, truth) = self.by_seq.get(&seq).ok_or_else(|| self.unknown(header))?;
        let shift = header.stamp - logged.stamp;
        let fits = match (pass, self.period) {
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
        if pass > 0 {
            self.period = Some(shift / pass as Nanos);
        }
        same_truth(recorded, truth)
            .map_err(|reason| eyre!("the truth of sweep {} of {}: {reason}", header.seq, header.agent))?;
        Ok((header.clone(), truth.clone()))
    }

    fn unknown(&self, header: &Header) -> eyre::Report {
        eyre!(
            "sweep {} of {}, stamp {} ns, is in the recording but not in the log, which has {} sweeps of that agent",
            header.seq,
            header.agent,
            header.stamp,
            self.by_seq.len()
        )
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

    const PER_PASS: u64 = 4;
    const PERIOD: Nanos = 1_900;

    fn car(x: f64) -> Box3 {
        Box3 {
            center: [x, 0.0, 0.8],
            length: 4.0,
            width: 2.0,
            height: 1.6,
            yaw: 0.0,
            velocity: None,
            class: "Car".into(),
            score: 1.0,
            track: Some(1),
            covariance: None,
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

    fn log() -> Sweeps {
        let sweeps = (0..PER_PASS).map(|seq| sweep(seq, 100 * seq as Nanos, seq as f64));
        Sweeps::new(sweeps.collect(), PER_PASS)
    }

    fn numbers(recorded: &[Sweep]) -> Result<Vec<(u64, Nanos, f64)>, Misfit> {
        let played = log().played(recorded)?;
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
        let short = Sweeps::new(vec![sweep(0, 0, 0.0)], PER_PASS);
        let misfit = short.played(&[sweep(0, 0, 0.0), sweep(2, 200, 2.0)]).unwrap_err();
        let error = misfit.reason.to_string();
        assert!(
            error.contains("sweep 2 of cav1") && error.contains("not in the log"),
            "{error}"
        );
        assert_eq!((misfit.fitted, misfit.beyond), (1, true));
        let misfit = log().played(&[sweep(3, 301, 3.0)]).unwrap_err();
        assert_eq!((misfit.fitted, misfit.beyond), (0, false));
    }
}
