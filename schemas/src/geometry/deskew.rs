//! The motion of an agent during one sweep.

use nalgebra::Isometry3;

use crate::Nanos;
use crate::geometry::cloud::Affine;
use crate::geometry::{PoseTrack, relative};

/// Longest stretch of a sweep over which the motion is taken as straight, ns.
const STEP: Nanos = 1_000_000;

/// One frame, seen from the body frame during a sweep: the body frame at its stamp, or another.
///
/// Knots every millisecond at most; between two of them points are moved by both and weighted, which is within 0.1 mm
/// at 100 m of a pose for each point.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Time of each knot, ns from the stamp; ascending, at least two.
    times: Vec<Nanos>,
    knots: Vec<Affine>,
}

impl Motion {
    /// The motion from `first` to `last`, offsets from the stamp in ns; `None` unless the track knows the poses then.
    pub fn new(track: &PoseTrack, stamp: Nanos, first: Nanos, last: Nanos) -> Option<Self> {
        let map_from_body = track.at(stamp)?;
        let stamp_from_body = |time: Nanos| {
            let then = track.at(stamp.checked_add(time)?)?;
            Some(relative(&map_from_body, &then))
        };
        // The ends first: a span that the track does not cover costs nothing.
        stamp_from_body(first).and(stamp_from_body(last))?;
        let times = knots(first, last);
        let known: Option<Vec<_>> = times.iter().map(|time| stamp_from_body(*time)).collect();
        Some(Self::of(times, &known?))
    }

    /// The motion by a frame's place from `first` to `last`, offsets from the stamp in ns.
    pub fn by(first: Nanos, last: Nanos, frame_from_body: impl Fn(Nanos) -> Isometry3<f64>) -> Self {
        let times = knots(first, last);
        let known: Vec<_> = times.iter().map(|time| frame_from_body(*time)).collect();
        Self::of(times, &known)
    }

    fn of(times: Vec<Nanos>, known: &[Isometry3<f64>]) -> Self {
        let knots = known.iter().map(Affine::new).collect();
        Motion { times, knots }
    }

    /// Points `[x, y, z]` that were measured `time` ns from the stamp, in the one frame; columns of one length, and times
    /// from `first` to `last`.
    pub fn at_stamp(&self, [x, y, z]: [&[f32]; 3], time: &[i32]) -> [Vec<f32>; 3] {
        let mut moved = [vec![0.0; time.len()], vec![0.0; time.len()], vec![0.0; time.len()]];
        let mut start = 0;
        while let Some(first) = time.get(start) {
            // Neighbours mostly lie between the same two knots, and are moved together.
            let knot = self.before(Nanos::from(*first));
            let (from, to) = (self.times[knot], self.times[knot + 1]);
            let [lo, hi] = [from, to].map(|t| t.clamp(i32::MIN.into(), i32::MAX.into()) as i32);
            // A knot belongs to what follows it, the last one to the last pair.
            let until = if knot + 2 == self.knots.len() {
                hi.saturating_add(1)
            } else {
                hi
            };
            let alike = |t: &&i32| **t >= lo && **t < until;
            let end = start + 1 + time[start + 1..].iter().take_while(alike).count();
            let run = start..end;
            let input = [&x[run.clone()], &y[run.clone()], &z[run.clone()]];
            let per_nano = if hi > lo { 1.0 / (hi - lo) as f32 } else { 0.0 };
            let (a, b) = (&self.knots[knot], &self.knots[knot + 1]);
            for (axis, out) in moved.iter_mut().enumerate() {
                let toward: [f32; 4] = std::array::from_fn(|i| b.0[axis][i] - a.0[axis][i]);
                let row = Row {
                    at: a.0[axis],
                    toward,
                    from: lo,
                    per_nano,
                };
                row.apply(input, &time[run.clone()], &mut out[run.clone()]);
            }
            start = end;
        }
        moved
    }

    /// The knot before a time, or the first or last pair's.
    fn before(&self, time: Nanos) -> usize {
        self.times
            .partition_point(|t| *t <= time)
            .clamp(1, self.times.len() - 1)
            - 1
    }
}

/// Times of the knots of a sweep from `first` to `last`.
fn knots(first: Nanos, last: Nanos) -> Vec<Nanos> {
    let span = last - first;
    let steps = span.div_euclid(STEP) + 1;
    (0..=steps).map(|i| first + span * i / steps).collect()
}

/// One coordinate between two knots.
struct Row {
    at: [f32; 4],
    /// Change until the next knot.
    toward: [f32; 4],
    from: i32,
    per_nano: f32,
}

impl Row {
    /// Nothing depends on a neighbour, so that the compiler takes several points at once.
    fn apply(&self, [x, y, z]: [&[f32]; 3], time: &[i32], out: &mut [f32]) {
        let ([a, b, c, d], [da, db, dc, dd]) = (self.at, self.toward);
        for ((((x, y), z), time), out) in x.iter().zip(y).zip(z).zip(time).zip(out) {
            let share = time.wrapping_sub(self.from) as f32 * self.per_nano;
            *out = (a * x + b * y + c * z + d) + share * (da * x + db * y + dc * z + dd);
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};

    use super::*;

    const MS: Nanos = 1_000_000;

    fn moved(motion: &Motion, [x, y, z]: [f32; 3], time: i32) -> [f32; 3] {
        motion.at_stamp([&[x], &[y], &[z]], &[time]).map(|column| column[0])
    }

    /// A vehicle that drives a bend at 15 m/s, 100 km from the map's origin.
    fn pose(time: Nanos) -> Isometry3<f64> {
        let t = time as f64 * 1e-9;
        let (yaw, radius) = (0.5 * t, 30.0);
        Isometry3::from_parts(
            Vector3::new(1e5 + radius * yaw.sin(), -1e5 - radius * yaw.cos(), 12.0 + 0.1 * t).into(),
            UnitQuaternion::from_euler_angles(0.01 * t, -0.02 * t, yaw),
        )
    }

    fn track(until: Nanos) -> PoseTrack {
        let mut track = PoseTrack::new(2000 * MS, 150 * MS);
        (0..=until / (10 * MS)).for_each(|i| track.insert(10 * MS * i, pose(10 * MS * i)));
        track
    }

    #[test]
    fn brings_what_stands_still_to_one_place() {
        let (track, stamp) = (track(400 * MS), 203 * MS);
        let motion = Motion::new(&track, stamp, -50 * MS, 50 * MS).unwrap();
        let still = pose(stamp) * Point3::new(80.0, -30.0, 4.0);
        for time in (-50_000_000..=50_000_000).step_by(137_911) {
            let seen = pose(stamp + Nanos::from(time)).inverse() * still;
            let found = moved(&motion, [seen.x as f32, seen.y as f32, seen.z as f32], time);
            let off = (Point3::from(found.map(f64::from)) - Point3::new(80.0, -30.0, 4.0)).norm();
            // The track's own error between poses 10 ms apart is 0.2 mm here.
            assert!(off < 1e-3, "{off} m at {time} ns");
        }
    }

    #[test]
    fn agrees_with_one_pose_for_each_point() {
        let (track, stamp) = (track(400 * MS), 203 * MS);
        let motion = Motion::new(&track, stamp, -50 * MS, 50 * MS).unwrap();
        for time in (-50_000_000..=50_000_000).step_by(77_777) {
            let exact = relative(&track.at(stamp).unwrap(), &track.at(stamp + Nanos::from(time)).unwrap());
            let expected = exact * Point3::new(100.0, 20.0, 1.0);
            let found = moved(&motion, [100.0, 20.0, 1.0], time).map(f64::from);
            let off = (Point3::from(found) - expected).norm();
            assert!(off < 1e-4, "{off} m at {time} ns");
        }
    }

    #[test]
    fn points_in_any_order_of_time_are_moved_alike() {
        let (track, stamp) = (track(400 * MS), 203 * MS);
        let motion = Motion::new(&track, stamp, -50 * MS, 50 * MS).unwrap();
        let times: Vec<i32> = (0..1000).map(|i| (i * 7919 % 1001) * 100_000 - 50_000_000).collect();
        let [x, y, z] = [0.1, 0.2, 0.3].map(|by| (0..1000).map(|i| i as f32 * by).collect::<Vec<f32>>());
        let all = motion.at_stamp([&x, &y, &z], &times);
        for i in 0..1000 {
            let alone = moved(&motion, [x[i], y[i], z[i]], times[i]);
            assert_eq!([all[0][i], all[1][i], all[2][i]], alone, "point {i}");
        }
    }

    #[test]
    fn carries_on_over_the_max_gap_and_no_further() {
        let track = track(200 * MS);
        assert!(Motion::new(&track, 250 * MS, -50 * MS, 100 * MS).is_some());
        assert!(Motion::new(&track, 250 * MS, -50 * MS, 101 * MS).is_none());
        assert!(
            Motion::new(&track, 40 * MS, -50 * MS, 50 * MS).is_none(),
            "nothing is known before the first pose"
        );
    }

    #[test]
    fn a_sweep_of_one_instant_is_moved_by_one_transform() {
        let track = track(200 * MS);
        let motion = Motion::new(&track, 100 * MS, 0, 0).unwrap();
        assert_eq!(moved(&motion, [1.0, 2.0, 3.0], 0), [1.0, 2.0, 3.0]);
    }
}
