//! Whether one of the two sensors of an IMU stands still while the other goes on.

use realo_schemas::{ImuSample, Nanos};

use crate::motion_faults::STUCK_IMU;
use crate::motion_turns::Place;

/// Of samples with equal readings of one sensor, this share at least has others of the other one: else the whole unit is stuck.
const ALIVE: f64 = 0.5;
/// An agent that came less far, m, may have stood, and a sensor with coarse steps then says the same all the time.
const MOVED: f64 = 2.0;

/// Gyroscopes that say the same all the time while accelerometers do not, and the other way round.
pub(crate) fn stuck_faults(samples: &[ImuSample], poses: &[Place]) -> Vec<String> {
    let named = [
        ("angular rates", "forces", "gyroscopes are"),
        ("specific forces", "rates", "accelerometers are"),
    ];
    let longest = [0, 1].map(|part| longest_alone(samples, poses, part));
    let found = named.into_iter().zip(longest).filter(|(_, run)| *run >= STUCK_IMU);
    let words = |((these, others, stuck), run)| {
        format!(
            "{these} of {run} samples in a row are equal to the bit, and {others} are not: the {stuck} stuck; leave such samples out"
        )
    };
    let whole: Vec<String> = found.map(words).collect();
    if !whole.is_empty() {
        return whole;
    }
    let sensors = [("angular rate", "gyroscope"), ("specific force", "accelerometer")];
    let axes = sensors
        .into_iter()
        .enumerate()
        .flat_map(|(part, names)| (0..3).map(move |axis| (part, axis, names)));
    let runs = axes.map(|(part, axis, names)| (longest_of_axis(samples, poses, part, axis), axis, names));
    let words = |(run, axis, (reading, sensor)): (usize, usize, (&str, &str))| {
        let axis = ["x", "y", "z"][axis];
        format!(
            "the {reading} about {axis} of {run} samples in a row is equal to the bit, while others change: this {sensor} is stuck; leave \
             such samples out"
        )
    };
    runs.filter(|(run, ..)| *run >= STUCK_IMU).map(words).collect()
}

/// The longest run of samples of a moving agent with an equal reading of one axis that has others elsewhere.
fn longest_of_axis(samples: &[ImuSample], poses: &[Place], part: usize, axis: usize) -> usize {
    let reading = |sample: &ImuSample| [sample.angular_rate, sample.specific_force][part][axis];
    let runs = samples.chunk_by(|one, next| reading(one) == reading(next));
    // The whole unit that stands still has words of its own.
    let is_alone =
        |run: &&[ImuSample]| run.len() < samples.len() && run.array_windows().any(|[one, next]| !is_same(one, next));
    let long = runs.filter(|run| run.len() >= STUCK_IMU).filter(is_alone);
    let moving = long.filter(|run| moved_during(run, poses));
    moving.map(<[ImuSample]>::len).max().unwrap_or(0)
}

fn is_same(one: &ImuSample, next: &ImuSample) -> bool {
    one.angular_rate == next.angular_rate && one.specific_force == next.specific_force
}

/// The longest run of samples of a moving agent with equal readings of a sensor, while the other one's change.
fn longest_alone(samples: &[ImuSample], poses: &[Place], part: usize) -> usize {
    let reading = |sample: &ImuSample, part: usize| [sample.angular_rate, sample.specific_force][part];
    let runs = samples.chunk_by(|one, next| reading(one, part) == reading(next, part));
    let is_alone = |run: &&[ImuSample]| {
        let other = |sample: &ImuSample| reading(sample, 1 - part);
        let changes = run
            .array_windows()
            .filter(|[one, next]| other(one) != other(next))
            .count();
        changes as f64 >= ALIVE * (run.len() - 1) as f64 && changes > 0
    };
    let long = runs.filter(|run| run.len() >= STUCK_IMU).filter(is_alone);
    let moving = long.filter(|run| moved_during(run, poses));
    moving.map(<[ImuSample]>::len).max().unwrap_or(0)
}

fn moved_during(run: &[ImuSample], poses: &[Place]) -> bool {
    match run {
        [first, .., last] => moved(poses, first.taken.stamp, last.taken.stamp),
        _ => false,
    }
}

/// Whether an agent moved from one time to another. Without poses in between it may have moved.
fn moved(poses: &[Place], from: Nanos, to: Nanos) -> bool {
    let at = |stamp: Nanos| poses.partition_point(|(known, _)| *known < stamp);
    match &poses[at(from)..at(to).max(at(from))] {
        [] => true,
        [(_, first), rest @ ..] => {
            let far = |place: &[f64; 3]| {
                let squares = place.iter().zip(first).map(|(a, b)| (a - b) * (a - b));
                squares.sum::<f64>() > MOVED * MOVED
            };
            rest.iter().any(|(_, place)| far(place))
        }
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::motion::Taken;

    use super::*;

    const MS: Nanos = 1_000_000;

    fn samples(stuck_from: [usize; 2]) -> Vec<ImuSample> {
        let noise = |seed: usize, k: usize| ((k * seed) % 101) as f64 * 1e-3;
        let sample = |k: usize| ImuSample {
            taken: Taken {
                stamp: k as Nanos * 10 * MS,
                arrival: k as Nanos * 10 * MS,
            },
            angular_rate: [37, 41, 43].map(|seed| noise(seed, k.min(stuck_from[0]))),
            specific_force: [47, 53, 59].map(|seed| noise(seed, k.min(stuck_from[1]))),
        };
        (0..400).map(sample).collect()
    }

    #[test]
    fn the_sensor_that_stands_still_alone_is_named() {
        let driven: Vec<Place> = (0..40).map(|k| (k * 100 * MS, [0.8 * k as f64, 5.0, 0.0])).collect();
        let never = usize::MAX;
        let said = |stuck_from, poses: &[Place]| stuck_faults(&samples(stuck_from), poses).join("; ");
        assert_eq!(said([never, never], &driven), "");
        let gyroscopes = "angular rates of 100 samples in a row are equal to the bit, and forces are not: the gyroscopes are stuck; leave such \
                          samples out";
        assert_eq!(said([300, never], &driven), gyroscopes);
        assert_eq!(said([300, never], &[]), gyroscopes);
        assert!(said([never, 300], &driven).contains("the accelerometers are stuck"));
        // The whole unit has its own words, and an agent that stands says nothing.
        assert_eq!(said([300, 300], &driven), "");
        // One axis, which said other things before. What a unit never measures is no fault.
        let axis = |from: usize, poses: &[Place]| {
            let mut axis = samples([never, never]);
            let held = axis[from].angular_rate[2];
            axis[from..].iter_mut().for_each(|sample| sample.angular_rate[2] = held);
            stuck_faults(&axis, poses).join("; ")
        };
        let gyroscope = "the angular rate about z of 100 samples in a row is equal to the bit, while others change: this gyroscope is stuck; \
                         leave such samples out";
        assert_eq!(axis(300, &driven), gyroscope);
        assert_eq!(axis(0, &driven), "");
        let stands: Vec<Place> = driven.iter().map(|(stamp, _)| (*stamp, [3.0, 5.0, 0.0])).collect();
        assert_eq!(said([300, never], &stands), "");
        assert_eq!(axis(300, &stands), "");
    }
}
