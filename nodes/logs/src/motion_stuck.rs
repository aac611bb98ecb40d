//! Whether a sensor of an IMU, or one axis of it, stands still while the rest goes on.

use realo_schemas::{ImuSample, Nanos, motion};

use crate::motion_faults::STUCK_IMU;
use crate::motion_turns::Place;

/// Of samples with equal readings, this share at least has others of the rest: else the whole unit is stuck.
const ALIVE: f64 = 0.5;
/// An agent that came less far, m, may have stood, and a sensor with coarse steps then says the same all the time.
const MOVED: f64 = 2.0;

/// Gyroscopes that say the same all the time while accelerometers do not, the other way round, or one axis of either.
pub(crate) fn stuck_faults(samples: &[ImuSample], poses: &[Place]) -> Vec<String> {
    let found = sensor_faults(samples, poses);
    // A sensor that is stuck has three axes that are.
    match found.is_empty() {
        true => axis_faults(samples, poses),
        false => found,
    }
}

fn sensor_faults(samples: &[ImuSample], poses: &[Place]) -> Vec<String> {
    let named = [
        ("angular rates", "forces", "gyroscopes are"),
        ("specific forces", "rates", "accelerometers are"),
    ];
    let longest = [0, 1].map(|part| {
        let other = move |sample: &ImuSample| readings(sample)[1 - part];
        let is_moving = |run: &[ImuSample]| moved_during(run, poses).unwrap_or(true);
        longest(samples, |sample| readings(sample)[part], other, is_moving)
    });
    let found = named.into_iter().zip(longest).filter(|(_, run)| *run >= STUCK_IMU);
    let words = |((these, others, stuck), run)| {
        format!(
            "{these} of {run} samples in a row are equal to the bit, and {others} are not: the {stuck} stuck; leave such samples out"
        )
    };
    found.map(words).collect()
}

/// What one axis repeats while the agent moves, as its poses say. An axis that hardly ever changes is one that the unit does not have.
fn axis_faults(samples: &[ImuSample], poses: &[Place]) -> Vec<String> {
    let sensors = [
        ("angular rate about", "gyroscope"),
        ("specific force along", "accelerometer"),
    ];
    let most = motion::STUCK_AXIS as usize;
    let axes = (0..2).flat_map(|part| {
        let steps = [0, 1, 2].map(|axis| steps(samples, part, axis));
        let finest = steps.iter().flatten().copied().fold(f64::INFINITY, f64::min);
        let is_measured = move |axis: &usize| finest <= motion::FINE_STEPS[part] && steps[*axis].len() >= most;
        (0..3).filter(is_measured).map(move |axis| (part, axis))
    });
    let stuck = axes.filter_map(|(part, axis)| {
        let rest = |sample: &ImuSample| {
            let mut all = readings(sample);
            all[part][axis] = 0.0;
            all
        };
        let is_moving = |run: &[ImuSample]| moved_during(run, poses) == Some(true);
        let run = longest(samples, |sample| readings(sample)[part][axis], rest, is_moving);
        let (reading, sensor) = sensors[part];
        let words = || {
            format!(
                "the {reading} {} of {run} samples in a row is equal to the bit, while others change: this {sensor} is stuck; leave such \
                 samples out",
                ["x", "y", "z"][axis]
            )
        };
        (run >= most).then(words)
    });
    stuck.collect()
}

/// By how much one axis changed, each time that it did.
fn steps(samples: &[ImuSample], part: usize, axis: usize) -> Vec<f64> {
    let all = samples
        .array_windows()
        .map(|[one, next]| (readings(next)[part][axis] - readings(one)[part][axis]).abs());
    all.filter(|step| *step > motion::ROUNDING).collect()
}

/// Angular rates and specific forces.
fn readings(sample: &ImuSample) -> [[f64; 3]; 2] {
    [sample.angular_rate, sample.specific_force]
}

/// The longest run of samples of a moving agent with one equal reading, while the rest changes.
fn longest<T: PartialEq, R: PartialEq>(
    samples: &[ImuSample],
    reading: impl Fn(&ImuSample) -> T,
    rest: impl Fn(&ImuSample) -> R,
    is_moving: impl Fn(&[ImuSample]) -> bool,
) -> usize {
    let runs = samples.chunk_by(|one, next| reading(one) == reading(next));
    let is_alive = |run: &&[ImuSample]| {
        let changes = run.array_windows().filter(|[one, next]| rest(one) != rest(next));
        let changes = changes.count();
        changes as f64 >= ALIVE * (run.len() - 1) as f64 && changes > 0
    };
    let long = runs.filter(|run| run.len() >= STUCK_IMU).filter(is_alive);
    long.filter(|run| is_moving(run))
        .map(<[ImuSample]>::len)
        .max()
        .unwrap_or(0)
}

/// Whether an agent moved in the time of samples; `None` where no poses say it.
fn moved_during(run: &[ImuSample], poses: &[Place]) -> Option<bool> {
    match run {
        [first, .., last] => moved(poses, first.taken.stamp, last.taken.stamp),
        _ => Some(false),
    }
}

/// Whether an agent moved from one time to another.
fn moved(poses: &[Place], from: Nanos, to: Nanos) -> Option<bool> {
    let at = |stamp: Nanos| poses.partition_point(|(known, _)| *known < stamp);
    let ((_, first), rest) = poses[at(from)..at(to).max(at(from))].split_first()?;
    let far = |place: &[f64; 3]| {
        let squares = place.iter().zip(first).map(|(a, b)| (a - b) * (a - b));
        squares.sum::<f64>() > MOVED * MOVED
    };
    Some(rest.iter().any(|(_, place)| far(place)))
}

#[cfg(test)]
mod tests {
    use realo_schemas::motion::Taken;

    use super::*;

    const MS: Nanos = 1_000_000;

    fn samples(stuck_from: [usize; 2]) -> Vec<ImuSample> {
        let noise = |seed: usize, k: usize| ((k * seed) % 101) as f64 * 1e-6;
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
        let stuck = |from: usize, poses: &[Place], of: fn(&mut ImuSample) -> &mut f64| {
            let mut samples = samples([never, never]);
            let held = *of(&mut samples[from]);
            samples[from..].iter_mut().for_each(|sample| *of(sample) = held);
            stuck_faults(&samples, poses).join("; ")
        };
        let axis = |from: usize, poses: &[Place]| stuck(from, poses, |sample| &mut sample.angular_rate[2]);
        let gyroscope = "the angular rate about z of 100 samples in a row is equal to the bit, while others change: this gyroscope is stuck; \
                         leave such samples out";
        assert_eq!(axis(300, &driven), gyroscope);
        assert_eq!(
            (axis(0, &driven), axis(301, &driven), axis(300, &[])),
            Default::default()
        );
        let force = stuck(300, &driven, |sample| &mut sample.specific_force[0]);
        assert!(
            force.starts_with("the specific force along x of 100 samples")
                && force.contains("this accelerometer is stuck"),
            "{force}"
        );
        let stands: Vec<Place> = driven.iter().map(|(stamp, _)| (*stamp, [3.0, 5.0, 0.0])).collect();
        assert_eq!(said([300, never], &stands), "");
        assert_eq!(axis(300, &stands), "");
    }
}
