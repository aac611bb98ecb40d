//! Times of points of a clock that is not that of the frames: sets of the family number their frames, and times begin anywhere.

use realo_schemas::Nanos;

use crate::Options;
use crate::options::SweepStamp;
use crate::pcd::Points;

/// A sweep is no longer, ns.
const LONGEST: f64 = 1e9;
/// A sweep takes at most so many periods of the frames.
const PERIODS: f64 = 1.5;
/// What a number of `t` may count, ns, the longest first.
const UNITS: [(f64, &str); 3] = [(1e6, "ms"), (1e3, "µs"), (1.0, "ns")];

/// Makes times of points offsets from the begin of their sweep, or from its end where the stamps of frames are that. Times beside
/// a stamp that the files state are taken by that stamp.
///
/// # Errors
/// Times that are more than a second apart.
pub fn relative(points: &mut Points, stated: Option<Nanos>, options: &Options) -> Result<(), String> {
    if points.offset_ns.is_some() {
        return Ok(());
    }
    let is_seconds = points.timestamp.is_some();
    let (name, times) = match (points.timestamp.take(), points.t.take()) {
        (Some(times), _) => ("timestamp", times),
        (None, Some(times)) => (if points.t_is_timestamp { "timestamp" } else { "t" }, times),
        (None, None) => return Ok(()),
    };
    let Some([first, last]) = ends(points, &times) else {
        return Ok(());
    };
    let near = |time: f64| stated.is_some_and(|stamp| (time - stamp as f64 / 1e9).abs() < 1.0);
    if is_seconds && near(first) && near(last) {
        points.timestamp = Some(times);
        return Ok(());
    }
    let (unit, words) = match is_seconds {
        true => (1e9, "s"),
        false => unit_of(last - first, 1e9 / options.rate_hz),
    };
    if (last - first) * unit >= LONGEST {
        return Err(format!(
            "field `{name}`: expected times within 1 s of each other ({words}), found {first} to {last}; correct it, or leave it out"
        ));
    }
    let (from, end) = match options.stamp {
        SweepStamp::Start => (first, "first"),
        SweepStamp::End => (last, "last"),
    };
    let offset = |time: f64| ((time - from) * unit).round();
    // Points without a return have no time.
    let offset = |time: f64| {
        if offset(time).abs() < LONGEST {
            offset(time) as i32
        } else {
            0
        }
    };
    points.offset_ns = Some(times.into_iter().map(offset).collect());
    points.times = Some(format!("the field `{name}` ({words}), from the {end} of each sweep"));
    Ok(())
}

/// The first and the last time of a return.
fn ends(points: &Points, times: &[f64]) -> Option<[f64; 2]> {
    let places = points.x.iter().zip(&points.y).zip(&points.z);
    let returns = places.map(|((x, y), z)| [x, y, z].iter().all(|v| v.is_finite()) && [*x, *y, *z] != [0.0; 3]);
    let there = returns.zip(times).filter(|(there, time)| *there && time.is_finite());
    there
        .map(|(_, time)| [*time; 2])
        .reduce(|[a, b], [c, d]| [a.min(c), b.max(d)])
}

/// The longest unit in which a sweep takes no more than its period and a half.
fn unit_of(span: f64, period: f64) -> (f64, &'static str) {
    let fits = UNITS.iter().find(|(unit, _)| span * unit <= PERIODS * period);
    *fits.unwrap_or(&UNITS[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(times: &[f64], is_stamp: bool) -> Points {
        let times = times.to_vec();
        Points {
            x: vec![1.0; times.len()],
            y: vec![1.0; times.len()],
            z: vec![1.0; times.len()],
            timestamp: is_stamp.then(|| times.clone()),
            t: (!is_stamp).then_some(times),
            ..Points::default()
        }
    }

    #[test]
    fn times_of_any_origin_count_from_the_first_or_the_last() {
        let start = Options::default();
        let end = Options {
            stamp: SweepStamp::End,
            ..Options::default()
        };
        for (times, is_stamp, unit) in [
            ([1.7e9, 1.7e9 + 0.05, 1.7e9 + 0.1], true, "(s)"),
            ([0.0, 0.05, 0.1], true, "(s)"),
            ([7e9, 7.05e9, 7.1e9], false, "(ns)"),
            ([0.0, 5e4, 1e5], false, "(µs)"),
            ([3.0, 53.0, 103.0], false, "(ms)"),
        ] {
            for (options, expected) in [
                (&start, [0, 50_000_000, 100_000_000]),
                (&end, [-100_000_000, -50_000_000, 0]),
            ] {
                let mut points = points(&times, is_stamp);
                relative(&mut points, None, options).unwrap();
                let found = points.offset_ns.unwrap();
                let off = found
                    .iter()
                    .zip(expected)
                    .map(|(a, b): (&i32, i32)| (a - b).abs())
                    .max();
                // Seconds since 1970 have a quarter of a microsecond.
                assert!(off <= Some(300), "{found:?}");
                assert!(points.timestamp.is_none() && points.times.unwrap().contains(unit));
            }
        }
    }

    #[test]
    fn counts_of_a_timestamp_are_taken_as_those_of_a_driver() {
        let mut points = Points {
            t_is_timestamp: true,
            ..points(&[2e5, 2.5e5, 3e5], false)
        };
        // A stamp that the file states says nothing of counts.
        relative(&mut points, Some(200_000_000_000_000), &Options::default()).unwrap();
        assert_eq!(points.offset_ns.unwrap(), [0, 50_000_000, 100_000_000]);
        assert!(points.times.unwrap().contains("the field `timestamp` (µs)"));
    }

    #[test]
    fn a_stated_stamp_counts_and_far_times_are_refused() {
        let mut near = points(&[1.7e9, 1.7e9 + 0.1], true);
        relative(&mut near, Some(1_700_000_000_000_000_000), &Options::default()).unwrap();
        assert!(near.timestamp.is_some() && near.offset_ns.is_none());
        let mut far = points(&[0.0, 5.0], true);
        let error = relative(&mut far, None, &Options::default()).unwrap_err();
        assert!(
            error.contains("field `timestamp`: expected times within 1 s of each other"),
            "{error}"
        );
        let mut empty = points(&[0.0, 1.7e9, 1.7e9 + 0.1], true);
        (empty.x[0], empty.y[0], empty.z[0]) = (0.0, 0.0, 0.0);
        relative(&mut empty, None, &Options::default()).unwrap();
        assert_eq!(empty.offset_ns.unwrap()[..2], [0, 0], "no return, no time");
    }
}
