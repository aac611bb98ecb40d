//! Times of points as whole numbers, in a field `timestamp` that some drivers have in place of doubles.

/// The years 2000 to 2100 in s since 1970.
const YEARS: [f64; 2] = [946_684_800.0, 4_102_444_800.0];
/// Units of whole numbers since 1970: so many a second.
const UNITS: [f64; 3] = [1e9, 1e6, 1e3];
/// A sweep is no longer, s.
const LONGEST: f64 = 1.0;

/// The times of a field.
#[derive(Debug, PartialEq)]
pub(super) enum Stamps {
    /// In s since 1970, to half a microsecond as doubles have them.
    Seconds(Vec<f64>),
    /// Counts from an unknown time in an unknown unit.
    Counts(Vec<f64>),
}

impl Stamps {
    /// Of whole numbers: ns, µs or ms since 1970 where these are times of one sweep in this century.
    pub fn of_whole(counts: Vec<f64>) -> Self {
        let ends = ends(&counts);
        let fits = |unit: &f64| {
            ends.is_none_or(|[first, last]| {
                let in_years = |count: f64| (YEARS[0]..YEARS[1]).contains(&(count / unit));
                in_years(first) && in_years(last) && (last - first) / unit < LONGEST
            })
        };
        match UNITS.into_iter().find(fits) {
            Some(unit) => Stamps::Seconds(counts.into_iter().map(|count| count / unit).collect()),
            None => Stamps::Counts(counts),
        }
    }
}

/// The least and the largest count; 0 stands for no return.
fn ends(counts: &[f64]) -> Option<[f64; 2]> {
    let counts = counts.iter().filter(|count| **count != 0.0);
    counts
        .map(|count| [*count; 2])
        .reduce(|[a, b], [c, d]| [a.min(c), b.max(d)])
}

/// Why counts are no times since 1970.
pub(super) fn unknown(counts: &[f64]) -> String {
    let [first, last] = ends(counts).unwrap_or_default();
    format!(
        "field `timestamp`: expected s since 1970 as TYPE F SIZE 8, or whole ns, µs or ms since 1970, within {LONGEST} s of each other, found \
         whole numbers from {first} to {last}; save it as doubles, or leave it out"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_since_1970_are_seconds() {
        for unit in UNITS {
            // The third point has no return.
            let counts = [0.0, 0.05, -1.7e9, 0.099].map(|time| ((1.7e9 + time) * unit).round());
            let Stamps::Seconds(found) = Stamps::of_whole(counts.to_vec()) else {
                panic!("{unit}")
            };
            for (found, time) in found.iter().zip([1.7e9, 1.7e9 + 0.05, 0.0, 1.7e9 + 0.099]) {
                assert!((found - time).abs() < 5e-7, "{unit}: {found} {time}");
            }
        }
        assert_eq!(Stamps::of_whole(Vec::new()), Stamps::Seconds(Vec::new()));
    }

    #[test]
    fn other_counts_are_named() {
        for counts in [
            // ns, µs and ms from the begin of the sweep.
            [0.0, 5e7, 1e8],
            [0.0, 5e4, 1e5],
            [0.0, 50.0, 100.0],
            // ns since a sensor was switched on, some minutes and some days ago, which could be other units by their size alone.
            [1e12, 1.00005e12, 1.0001e12],
            [1e15, 1e15 + 5e7, 1e15 + 1e8],
            // Whole seconds: no time of a point.
            [1.7e9, 1.7e9, 1.7e9],
            // Sweeps of a minute.
            [1.7e18, 1.7e18 + 1e10, 1.7e18 + 6e10],
        ] {
            assert_eq!(Stamps::of_whole(counts.to_vec()), Stamps::Counts(counts.to_vec()));
            let said = unknown(&counts);
            assert!(
                said.contains("field `timestamp`") && said.contains("save it as doubles"),
                "{said}"
            );
        }
    }
}
