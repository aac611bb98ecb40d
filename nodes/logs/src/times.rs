//! Times of points as drivers write them, as offsets from the sweep's stamp.

use std::fmt;

use realo_schemas::Nanos;

/// Points are measured within this of their sweep's stamp, ns.
pub const REACH: f64 = 1e9;
/// A sweep takes more, ns: so its length shows the unit.
const SHORTEST: f64 = 5e6;
/// All points of a sweep that takes less are of one time, ns: whatever lies between is of a unit that is not known.
const INSTANT: f64 = 2e5;
/// A sweep takes at most so many periods.
const OVERLAP: f64 = 1.5;
/// Sweeps of fewer points do not tell how long one takes.
const ENOUGH: usize = 100;
/// Times that are rounded by more than this say nothing, ns.
const COARSE: f64 = 1e6;
const HOUR: i64 = 3_600_000_000_000;
const UNITS: [(f64, &str); 4] = [(1e9, "s"), (1.0, "ns"), (1e3, "µs"), (1e6, "ms")];

/// From when times count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// From the sweep's stamp.
    Stamp,
    /// Since 1970.
    Epoch,
    /// Since the full hour, as Velodyne's packets have them.
    Hour,
}

/// How the times of a field are read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeRule {
    /// What 1 of the field is, ns.
    pub unit: f64,
    /// From when they count.
    pub base: Base,
}

impl fmt::Display for TimeRule {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let unit = UNITS.iter().find(|(unit, _)| *unit == self.unit);
        f.write_str(unit.map_or("?", |(_, name)| name))?;
        f.write_str(match self.base {
            Base::Stamp => " from the stamp",
            Base::Epoch => " since 1970",
            Base::Hour => " since the full hour",
        })
    }
}

/// What the times of a sweep look like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// The sweep's stamp, ns.
    pub stamp: Nanos,
    /// Earliest and latest time, as the field has them.
    pub ends: [f64; 2],
    /// How many points have a time.
    pub points: usize,
}

/// The type of a field of times.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeType {
    /// Any integer.
    Integer,
    /// Single precision.
    Single,
    /// Double precision.
    Double,
}

impl TimeRule {
    /// ns from the stamp where times are integers, s from the stamp where they are floats.
    pub fn usual(kind: TimeType) -> Self {
        TimeRule {
            unit: if kind == TimeType::Integer { 1.0 } else { 1e9 },
            base: Base::Stamp,
        }
    }

    /// What explains the times of the sweeps that were looked at; `None` if nothing does.
    pub fn of(looks: &[Look], kind: TimeType) -> Option<Self> {
        let usual = Self::usual(kind);
        let spans = looks.iter().filter(|look| look.points >= ENOUGH);
        let span = spans.map(|look| look.ends[1] - look.ends[0]).fold(0.0, f64::max);
        let longest = longest(looks);
        let as_long_as_a_sweep = |rule: &TimeRule| {
            let length = span * rule.unit;
            length > SHORTEST && length <= longest
        };
        let at_once = |rule: &TimeRule| span * rule.unit <= INSTANT;
        let rules = || {
            [Base::Stamp, Base::Epoch, Base::Hour]
                .into_iter()
                .flat_map(move |base| {
                    // The usual unit goes first; offsets in whole seconds say nothing.
                    let others = UNITS.map(|(unit, _)| unit).into_iter();
                    let others = others.filter(move |unit| {
                        *unit != usual.unit && (kind != TimeType::Integer || base != Base::Stamp || *unit < 1e9)
                    });
                    std::iter::once(usual.unit)
                        .chain(others)
                        .map(move |unit| TimeRule { unit, base })
                })
        };
        let fits = |rule: &TimeRule| looks.iter().all(|look| rule.fits(look, kind));
        let reported = rules().find(|rule| as_long_as_a_sweep(rule) && fits(rule));
        // Without a span, what lies at the stamp: offsets in the usual unit, times since 1970 in any.
        reported.or_else(|| {
            rules().find(|rule| (rule.base != Base::Stamp || *rule == usual) && at_once(rule) && fits(rule))
        })
    }

    fn fits(&self, look: &Look, kind: TimeType) -> bool {
        look.ends.iter().all(|end| {
            let fine = kind != TimeType::Single || end.abs() * self.unit * f64::from(f32::EPSILON) <= COARSE;
            fine && self.offset(*end, look.stamp).is_some()
        })
    }

    /// The offset of a time from the stamp, ns; `None` beyond a second.
    pub fn offset(&self, value: f64, stamp: Nanos) -> Option<i32> {
        let offset = match self.base {
            Base::Stamp => value * self.unit,
            // Doubles hold a time since 1970 to 0.25 µs: nothing is lost by the subtraction in integers.
            Base::Epoch => {
                let whole = (value * self.unit).round();
                (whole.abs() < 9e18).then(|| (whole as i64).saturating_sub(stamp) as f64)?
            }
            Base::Hour => {
                let since = value * self.unit;
                let inside = (0.0..HOUR as f64).contains(&since);
                let ahead = inside.then(|| (since.round() as i64).saturating_sub(stamp.rem_euclid(HOUR)))?;
                ((ahead + HOUR / 2).rem_euclid(HOUR) - HOUR / 2) as f64
            }
        };
        // Within ±1 s, so the cast is exact.
        (offset.abs() <= REACH).then(|| offset.round() as i32)
    }
}

/// How long a sweep takes at most, by the stamps of those that were looked at, ns.
fn longest(looks: &[Look]) -> f64 {
    let mut stamps: Vec<Nanos> = looks.iter().map(|look| look.stamp).collect();
    stamps.sort_unstable();
    stamps.dedup();
    let mut periods: Vec<Nanos> = stamps.array_windows().map(|[one, next]| next - one).collect();
    periods.sort_unstable();
    let median = periods.get(periods.len() / 2);
    median.map_or(REACH, |period| (OVERLAP * *period as f64).min(REACH))
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAMP: Nanos = 1_700_000_000_000_000_000;

    fn look(from: f64, until: f64) -> Look {
        Look {
            stamp: STAMP,
            ends: [from, until],
            points: 1000,
        }
    }

    #[test]
    fn times_of_drivers_are_understood() {
        let (s, ns) = (1.7e9, 1.7e18);
        // 1.7e9 s are 800 s behind the hour.
        let hour = 800e6;
        for (kind, ends, unit, base) in [
            (TimeType::Integer, [0.0, 99.9e6], 1.0, Base::Stamp),
            (TimeType::Integer, [-50e6, 50e6], 1.0, Base::Stamp),
            (TimeType::Integer, [0.0, 99_900.0], 1e3, Base::Stamp),
            (TimeType::Integer, [0.0, 99.0], 1e6, Base::Stamp),
            (TimeType::Single, [0.0, 0.0999], 1e9, Base::Stamp),
            (TimeType::Single, [0.0, 99_900.0], 1e3, Base::Stamp),
            (TimeType::Single, [-99.9, 0.0], 1e6, Base::Stamp),
            (TimeType::Single, [0.0, 99.9e6], 1.0, Base::Stamp),
            (TimeType::Double, [s, s + 0.0999], 1e9, Base::Epoch),
            (TimeType::Double, [ns - 99.9e6, ns], 1.0, Base::Epoch),
            (TimeType::Double, [1e6 * s, 1e6 * s + 99_900.0], 1e3, Base::Epoch),
            (TimeType::Integer, [hour, hour + 99_900.0], 1e3, Base::Hour),
            // All at one time, and what is too short for a sweep.
            (TimeType::Double, [s, s], 1e9, Base::Epoch),
            (TimeType::Integer, [0.0, 0.0], 1.0, Base::Stamp),
            (TimeType::Single, [0.0, 1e-4], 1e9, Base::Stamp),
        ] {
            let found = TimeRule::of(&[look(ends[0], ends[1])], kind);
            assert_eq!(found, Some(TimeRule { unit, base }), "{kind:?} {ends:?}");
        }
        let few = Look {
            points: 3,
            ..look(0.0, 99_900.0)
        };
        assert_eq!(
            TimeRule::of(&[few], TimeType::Integer),
            Some(TimeRule::usual(TimeType::Integer))
        );
    }

    #[test]
    fn what_no_rule_explains_is_refused() {
        for (kind, ends) in [
            // Another clock, since boot, an hour that is not the stamp's, epoch seconds that single precision rounds to 128 s.
            (TimeType::Double, [1.7e9 + 37.0, 1.7e9 + 37.1]),
            (TimeType::Double, [5123.0, 5123.1]),
            (TimeType::Integer, [2_900e6, 2_900.1e6]),
            (TimeType::Single, [1.7e9, 1.7e9]),
            (TimeType::Double, [0.0, 1.5]),
            (TimeType::Double, [-f64::MAX, f64::MAX]),
            // In 100 ns: too short for a sweep in ns, too long in µs.
            (TimeType::Integer, [0.0, 1_200_000.0]),
        ] {
            assert_eq!(TimeRule::of(&[look(ends[0], ends[1])], kind), None, "{kind:?} {ends:?}");
        }
    }

    #[test]
    fn no_sweep_is_longer_than_its_period() {
        let every = |period: Nanos, until: f64| {
            let look = |k| Look {
                stamp: STAMP + k * period,
                ..look(0.0, until)
            };
            (0..5).map(look).collect::<Vec<_>>()
        };
        // Fractions of a turn, and 100 ns, at 10 Hz.
        assert_eq!(TimeRule::of(&every(100_000_000, 0.9999), TimeType::Single), None);
        assert_eq!(TimeRule::of(&every(100_000_000, 999_000.0), TimeType::Integer), None);
        // A sweep a second that takes as long.
        let slow = TimeRule::of(&every(1_000_000_000, 0.9999), TimeType::Single);
        assert_eq!(slow, Some(TimeRule::usual(TimeType::Single)));
        let usual = TimeRule::of(&every(100_000_000, 0.0999), TimeType::Single);
        assert_eq!(usual, Some(TimeRule::usual(TimeType::Single)));
    }

    #[test]
    fn offsets_are_exact_and_never_saturate() {
        let epoch = TimeRule {
            unit: 1.0,
            base: Base::Epoch,
        };
        assert_eq!(epoch.offset(1.7e18 + 256.0, STAMP), Some(256));
        let usual = TimeRule::usual(TimeType::Single);
        assert_eq!(usual.offset(1.0, STAMP), Some(1_000_000_000));
        assert_eq!(usual.offset(-0.25, STAMP), Some(-250_000_000));
        for value in [1.1, -1.1, 1e30, f64::INFINITY, f64::NAN] {
            assert_eq!(usual.offset(value, STAMP), None, "{value}");
            assert_eq!(epoch.offset(value, STAMP), None, "{value}");
        }
        // A sweep whose stamp is behind the hour's turn.
        let hour = TimeRule {
            unit: 1e3,
            base: Base::Hour,
        };
        assert_eq!(hour.offset(3_599_950_000.0, HOUR + 10_000_000), Some(-60_000_000));
        assert_eq!(usual.to_string(), "s from the stamp");
        assert_eq!(
            (epoch.to_string(), hour.to_string()),
            ("ns since 1970".into(), "µs since the full hour".into())
        );
    }
}
