//! Whether an IMU turns and is pushed as its agent's poses do: a wrong sign, or axes that are swapped.

use realo_schemas::{ImuSample, Nanos, to_seconds};

/// Stamp and place of a pose.
pub(crate) type Place = (Nanos, [f64; 3]);

/// Courses are taken over so long, from one such time to the next, ns.
const LEG: Nanos = 1_000_000_000;
/// And need a way of so much, m.
const WAY: f64 = 3.0;
/// A turn is one from so much on, rad; so much of them, as a sum of squares, tells.
const TURN: f64 = 0.1;
const TELLS: f64 = 0.5;
/// The measured part of what poses say is 1; of a sound unit it is between.
const SOUND: [f64; 2] = [0.5, 2.0];
/// Less is none.
const NONE: f64 = 0.3;

/// Sums over legs: of what poses say, squared, and of that times what was measured.
#[derive(Clone, Copy, Default)]
struct Share {
    square: f64,
    product: f64,
}

impl Share {
    fn add(&mut self, said: f64, measured: f64) {
        self.square += said * said;
        self.product += said * measured;
    }

    fn of(self) -> f64 {
        self.product / self.square
    }
}

/// What the yaw rate and the force to the left say against the turns of poses.
pub(crate) fn turn_faults(samples: &[ImuSample], poses: &[Place]) -> Vec<String> {
    let (Some(first), Some(last)) = (samples.first(), samples.last()) else {
        return Vec::new();
    };
    let (mut turns, mut pushes) = (Share::default(), Share::default());
    let mut from = first.taken.stamp;
    while from.saturating_add(2 * LEG) <= last.taken.stamp {
        let middle = from + LEG;
        if let Some([turn, way]) = turn_of(poses, from) {
            let within = samples.partition_point(|s| s.taken.stamp < middle - LEG / 2)
                ..samples.partition_point(|s| s.taken.stamp < middle + LEG / 2);
            if let Some([rate, force]) = means(&samples[within])
                && turn.abs() >= TURN
            {
                let seconds = to_seconds(LEG);
                turns.add(turn, rate * seconds);
                pushes.add(turn, force * seconds * seconds / way);
            }
        }
        from += LEG / 2;
        // Over a gap in one step: between two wrong stamps there may be years.
        let next = samples.partition_point(|s| s.taken.stamp < from.saturating_add(LEG / 2));
        let Some(next) = samples.get(next) else { break };
        from = from.max(next.taken.stamp.saturating_sub(3 * LEG / 2));
    }
    if turns.square < TELLS {
        return Vec::new();
    }
    words(turns.of(), pushes.of()).into_iter().collect()
}

fn words(turns: f64, pushes: f64) -> Option<String> {
    let [least, most] = SOUND;
    let words = match (turns, pushes) {
        (turns, _) if turns < -least => "the rate about z has the wrong sign: it is above 0 to the left",
        (turns, _) if turns > most => "rates are rad/s, and larger than the poses turn",
        (turns, _) if turns < least => "its axes are others than those of the body, or rates are no rad/s",
        (_, pushes) if pushes < -least => "the force along y has the wrong sign: y is to the left",
        (_, pushes) if pushes < NONE => "the force along y is none in turns, as if x and y were swapped",
        _ => return None,
    };
    Some(format!(
        "the unit measures {turns:.2} of the turns of the agent's poses, and {pushes:.2} of the force to the left in them, expected 1; \
         {words}; correct it, or the unit's frame on /tf_static"
    ))
}

/// The turn from the leg after a time to the next, rad, and the way of a leg, m.
fn turn_of(poses: &[Place], from: Nanos) -> Option<[f64; 2]> {
    let [a, b, c] = [0, 1, 2].map(|leg| place_at(poses, from + leg * LEG));
    let (a, b, c) = (a?, b?, c?);
    let [one, next] = [[b[0] - a[0], b[1] - a[1]], [c[0] - b[0], c[1] - b[1]]];
    let way = |leg: [f64; 2]| libm::hypot(leg[0], leg[1]);
    let shortest = way(one).min(way(next));
    let turn = libm::atan2(one[0] * next[1] - one[1] * next[0], one[0] * next[0] + one[1] * next[1]);
    (shortest >= WAY).then_some([turn, 0.5 * (way(one) + way(next))])
}

/// The place between the poses around a time, which are at most a second apart.
fn place_at(poses: &[Place], stamp: Nanos) -> Option<[f64; 3]> {
    let next = poses.partition_point(|(known, _)| *known <= stamp);
    let (before, after) = (poses.get(next.checked_sub(1)?)?, poses.get(next)?);
    let step = after.0 - before.0;
    (step <= 1_000_000_000).then(|| {
        let share = to_seconds(stamp - before.0) / to_seconds(step);
        std::array::from_fn(|axis| before.1[axis] + share * (after.1[axis] - before.1[axis]))
    })
}

/// Mean yaw rate, rad/s, and force to the left, m/s².
fn means(samples: &[ImuSample]) -> Option<[f64; 2]> {
    let n = samples.len() as f64;
    let mean = |of: &dyn Fn(&ImuSample) -> f64| samples.iter().map(of).sum::<f64>() / n;
    (!samples.is_empty()).then(|| [mean(&|s| s.angular_rate[2]), mean(&|s| s.specific_force[1])])
}

#[cfg(test)]
mod tests {
    use realo_schemas::motion::Taken;

    use super::*;

    const MS: Nanos = 1_000_000;

    /// Eight seconds straight on, then round a circle, at 8 m/s; what a unit measures, changed.
    fn found(change: impl Fn(&mut ImuSample)) -> String {
        let (mut yaw, mut place) = (0.3f64, [0.0; 3]);
        let (mut samples, mut poses) = (Vec::new(), Vec::new());
        for k in 0..2_000i64 {
            let rate = if k > 800 { 0.3 } else { 0.0 };
            let stamp = k * 10 * MS;
            let mut sample = ImuSample {
                taken: Taken { stamp, arrival: stamp },
                angular_rate: [0.0, 0.0, rate],
                specific_force: [0.1, 8.0 * rate, 9.81],
            };
            change(&mut sample);
            samples.push(sample);
            if k % 10 == 0 {
                poses.push((stamp, place));
            }
            place[0] += 0.08 * libm::cos(yaw);
            place[1] += 0.08 * libm::sin(yaw);
            yaw += 0.01 * rate;
        }
        turn_faults(&samples, &poses).join("; ")
    }

    #[test]
    fn years_between_two_stamps_are_no_work() {
        let after_a_gap = |s: &mut ImuSample| {
            if s.taken.stamp > 0 {
                s.taken.stamp += 1_767_225_600_000_000_000;
            }
        };
        assert_eq!(found(after_a_gap), "", "no pose is near");
    }

    #[test]
    fn units_of_a_wrong_sign_or_with_swapped_axes_are_named() {
        assert_eq!(found(|_| ()), "");
        assert!(found(|s| s.angular_rate[2] = -s.angular_rate[2]).contains("wrong sign: it is above 0 to the left"));
        assert!(found(|s| s.specific_force.swap(0, 1)).contains("x and y were swapped"));
        assert!(found(|s| s.angular_rate.swap(0, 2)).contains("its axes are others"));
        assert!(found(|s| s.specific_force[1] = -s.specific_force[1]).contains("y is to the left"));
        assert!(found(|s| s.angular_rate[2] *= 57.3).contains("rates are rad/s"));
    }
}
