//! How the sources of absolute positions get on with the estimate, and when they overrule it.

use nalgebra::Vector3;
use realo_schemas::Nanos;

use crate::correct::Outcome;
use crate::fault::Fault;
use crate::rules::Rules;

/// Two sources that agree against the estimate need so long, ns, and so many samples.
const BOTH: (Nanos, u32) = (1_000_000_000, 5);

/// One source.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Source {
    /// When a sample of it was used last.
    pub used: Option<Nanos>,
    refusals: Option<Refusals>,
}

/// Samples that were refused one after the other.
#[derive(Clone, Debug, PartialEq)]
struct Refusals {
    since: Nanos,
    count: u32,
    /// How far the last one was off, m in `map`.
    residual: Vector3<f64>,
}

impl Source {
    /// Notes what became of a sample.
    pub fn note(&mut self, outcome: Outcome, stamp: Nanos, residual: Vector3<f64>) {
        if outcome == Outcome::Used {
            self.used = Some(stamp);
            self.refusals = None;
            return;
        }
        let (since, count) = self
            .refusals
            .as_ref()
            .map_or((stamp, 0), |last| (last.since, last.count));
        self.refusals = Some(Refusals {
            since,
            count: count.saturating_add(1),
            residual,
        });
    }

    /// Whether a sample was used in the last `span` ns.
    pub fn is_used(&self, now: Nanos, span: Nanos) -> bool {
        self.used.is_some_and(|used| now - used <= span)
    }

    /// Whether the last sample was used, in the last `span` ns.
    pub fn supports(&self, now: Nanos, span: Nanos) -> bool {
        self.refusals.is_none() && self.is_used(now, span)
    }

    /// How far off samples are that were refused all through the last `span` ns, m; `None` where one was used.
    pub fn off(&self, now: Nanos, span: Nanos) -> Option<f64> {
        let residual = self.refusals.as_ref()?.residual.xy().norm();
        self.is_refused(now, span).then_some(residual)
    }

    /// Whether samples were refused all through the last `span` ns.
    fn is_refused(&self, now: Nanos, span: Nanos) -> bool {
        self.refusals
            .as_ref()
            .is_some_and(|refusals| now - refusals.since >= span && refusals.count >= BOTH.1)
    }
}

/// Whether the sources are to be believed rather than the estimate: both agree against it, or one contradicts it for long
/// without the other's support. Scans stand against a receiver that is off by no more than such receivers are.
pub(crate) fn conflict(fixes: &Source, scans: &Source, now: Nanos, rules: &Rules) -> Option<Fault> {
    let limits = &rules.limits;
    if let (Some(fix), Some(scan)) = (&fixes.refusals, &scans.refusals)
        && fixes.is_refused(now, BOTH.0)
        && scans.is_refused(now, BOTH.0)
    {
        let apart = (fix.residual - scan.residual).xy().norm();
        let [east, north, _] = rules.noise.gnss;
        if apart <= 3.0 * libm::hypot(east, north) + 0.5 {
            return Some(Fault::GnssConflict);
        }
    }
    let alone = fixes.is_refused(now, limits.gnss_conflict) && !scans.is_used(now, limits.gnss_conflict);
    // A receiver without corrections is off by metres for minutes.
    let off = fixes.off(now, limits.map_conflict);
    if alone || off.is_some_and(|off| off > rules.gnss_bias()) {
        return Some(Fault::GnssConflict);
    }
    let by_scans = scans.is_refused(now, limits.scan_conflict) && !fixes.is_used(now, limits.scan_conflict);
    by_scans.then_some(Fault::ScanConflict)
}

#[cfg(test)]
mod tests {
    use realo_geodesy::{Geodetic, LocalFrame};
    use realo_schemas::from_seconds;

    use super::*;
    use crate::{Settings, Unit};

    fn source(outcome: Outcome, seconds: std::ops::Range<u32>, residual: f64) -> Source {
        let mut source = Source::default();
        for tenth in 10 * seconds.start..10 * seconds.end {
            source.note(
                outcome,
                from_seconds(0.1 * f64::from(tenth)),
                Vector3::new(residual, 0.0, 0.0),
            );
        }
        source
    }

    #[test]
    fn sources_overrule_an_estimate_together_or_after_long() {
        let frame = LocalFrame::new(Geodetic::default()).unwrap();
        let rules = Rules::new(Settings::new(Unit::Tactical, frame));
        let at = from_seconds;
        let refused = |seconds, residual| source(Outcome::Gated, seconds, residual);
        let none = Source::default();
        // (GNSS, scans, now, expected)
        let cases = [
            (refused(0..2, 10.0), refused(0..2, 9.0), 2.0, Some(Fault::GnssConflict)),
            (refused(0..2, 10.0), refused(0..2, 1.0), 2.0, None),
            (refused(0..29, 10.0), none.clone(), 29.0, None),
            (refused(0..31, 10.0), none.clone(), 31.0, Some(Fault::GnssConflict)),
            (refused(0..31, 10.0), source(Outcome::Used, 0..31, 0.0), 31.0, None),
            (
                refused(0..61, 30.0),
                source(Outcome::Used, 0..61, 0.0),
                61.0,
                Some(Fault::GnssConflict),
            ),
            // As far as a receiver without corrections may be off.
            (refused(0..61, 10.0), source(Outcome::Used, 0..61, 0.0), 61.0, None),
            (none.clone(), refused(0..6, 1.0), 6.0, Some(Fault::ScanConflict)),
            (source(Outcome::Used, 0..6, 0.0), refused(0..6, 1.0), 6.0, None),
        ];
        for (number, (fixes, scans, now, expected)) in cases.into_iter().enumerate() {
            assert_eq!(conflict(&fixes, &scans, at(now), &rules), expected, "case {number}");
        }
    }
}
