//! What the guard knows of a collaborator from its earlier messages: bounded, and soon forgotten.

use realo_schemas::{Nanos, to_seconds};

use crate::verdict::Apart;

/// What was confirmed before anything was, so that a newcomer is believed and a few mistakes do not condemn it.
const WELCOME: f64 = 2.0;
/// What contradicts the ego weighs more than what is confirmed: an honest detector errs seldom.
const HARM: f64 = 6.0;
/// What an honest detector gets wrong now and then.
const FORGIVEN: f64 = 1.0;
/// Most that a record holds, so that no long good conduct pays for a lie.
const BOUND: f64 = 40.0;
/// Pairs that a newcomer is credited with: those of them that are far apart, and all.
const NEWCOMER: [f64; 2] = [1.5, 6.0];
/// Standard deviation of a pose of which nothing is known, m, and for how many corrections that counts.
const POSE_M: f64 = 0.5;
const POSES: f64 = 1.0;

/// The record of one collaborator.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Record {
    confirmed: f64,
    contradicted: f64,
    /// How far its boxes were from the ego's.
    apart: Apart,
    /// Sum of squared corrections, m², and their number.
    corrected: f64,
    poses: f64,
    /// How far its clock is ahead, s, and how sure that is.
    clock: f64,
    clocks: f64,
    stamp: Option<Nanos>,
}

impl Record {
    /// Forgets what is old by now: half of it in each `memory_s`.
    pub fn forget(&mut self, now: Nanos, memory_s: f64) {
        let since = self
            .stamp
            .map_or(0.0, |last| to_seconds(now.saturating_sub(last)).max(0.0));
        self.stamp = Some(self.stamp.map_or(now, |last| last.max(now)));
        let share = libm::exp2(-since / memory_s);
        for what in [
            &mut self.confirmed,
            &mut self.contradicted,
            &mut self.apart.far,
            &mut self.apart.pairs,
            &mut self.corrected,
            &mut self.poses,
            &mut self.clocks,
        ] {
            *what *= share;
        }
    }

    /// Takes what a message said that the ego could check, each box at most 1.
    pub fn observe(&mut self, confirmed: f64, contradicted: f64) {
        self.confirmed += confirmed;
        self.contradicted += contradicted;
        let all = self.confirmed + self.contradicted;
        if all > BOUND {
            self.confirmed *= BOUND / all;
            self.contradicted *= BOUND / all;
        }
    }

    /// Takes how far its boxes are from the ego's.
    pub fn observe_apart(&mut self, apart: &Apart) {
        self.apart.far += apart.far;
        self.apart.pairs += apart.pairs;
        if self.apart.pairs > BOUND {
            self.apart.far *= BOUND / self.apart.pairs;
            self.apart.pairs = BOUND;
        }
    }

    /// Share of its boxes that are far from the ego's.
    pub fn scatter(&self) -> f64 {
        let [far, pairs] = NEWCOMER;
        (self.apart.far + far) / (self.apart.pairs + pairs)
    }

    /// Takes how far a pose had to be corrected, m.
    pub fn observe_pose(&mut self, metres: f64) {
        self.corrected += metres * metres;
        self.poses += 1.0;
    }

    /// Takes how far its clock was found to be ahead of what is known, s.
    pub fn observe_clock(&mut self, ahead_s: f64) {
        self.clocks = (self.clocks + 1.0).min(10.0);
        self.clock += ahead_s / self.clocks;
    }

    /// How far its clock is ahead, s.
    pub fn clock_s(&self) -> f64 {
        self.clock
    }

    /// How much of what it says is true where the ego can see, 0 to 1; 1 of a newcomer.
    pub fn trust(&self) -> f64 {
        let good = self.confirmed + WELCOME;
        good / (good + HARM * (self.contradicted - FORGIVEN).max(0.0))
    }

    /// Standard deviation of its place that earlier corrections show, m; `stated`: what it says itself.
    pub fn pose_error_m(&self, stated: Option<f64>) -> f64 {
        let before = stated.unwrap_or(POSE_M).max(0.05);
        ((self.corrected + POSES * before * before) / (self.poses + POSES)).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    #[test]
    fn newcomers_are_trusted_liars_are_not_and_both_are_forgotten() {
        let mut record = Record::default();
        assert_eq!(record.trust(), 1.0);
        record.forget(0, 10.0);
        record.observe(6.0, 12.0);
        assert!(record.trust() < 0.3, "{}", record.trust());
        record.forget(100 * SECOND, 10.0);
        assert!(record.trust() > 0.95, "{}", record.trust());
    }

    #[test]
    fn an_honest_detector_that_errs_at_times_stays_trusted() {
        let mut record = Record::default();
        for sweep in 0..200 {
            record.forget(sweep * SECOND / 10, 10.0);
            record.observe(9.0, if sweep % 2 == 0 { 1.0 } else { 0.0 });
            assert!(record.trust() > 0.75, "{sweep}: {}", record.trust());
        }
    }

    #[test]
    fn long_good_conduct_does_not_pay_for_a_lie() {
        let mut record = Record::default();
        for sweep in 0..1000 {
            record.forget(sweep * SECOND / 10, 10.0);
            record.observe(10.0, 0.0);
        }
        record.observe(5.0, 15.0);
        record.observe(5.0, 15.0);
        assert!(record.trust() < 0.5, "{}", record.trust());
    }

    #[test]
    fn poses_that_had_to_be_corrected_are_not_believed_unseen() {
        let mut record = Record::default();
        assert_eq!(record.pose_error_m(None), 0.5);
        assert!((record.pose_error_m(Some(0.1)) - 0.1).abs() < 1e-12);
        for _ in 0..5 {
            record.observe_pose(3.0);
        }
        assert!(record.pose_error_m(Some(0.1)) > 2.5);
    }

    #[test]
    fn clocks_settle_on_what_is_found() {
        let mut record = Record::default();
        record.observe_clock(0.8);
        assert_eq!(record.clock_s(), 0.8);
        record.observe_clock(0.1);
        assert!((record.clock_s() - 0.85).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn trust_is_a_share_whatever_happens(
            steps in proptest::collection::vec((-SECOND..50 * SECOND, 0.0..200.0f64, 0.0..200.0f64), 1..50),
        ) {
            let (mut record, mut now) = (Record::default(), 0);
            for (by, confirmed, contradicted) in steps {
                now += by;
                record.forget(now, 10.0);
                record.observe(confirmed, contradicted);
                prop_assert!((0.0..=1.0).contains(&record.trust()));
                prop_assert!(record.confirmed + record.contradicted <= BOUND * (1.0 + 1e-9));
            }
        }
    }
}
