//! What is wrong with the motion sensors of a log: numbers that cannot be, sensors that stand still, jump or are mounted otherwise.

use realo_schemas::{GnssFix, ImuSample, Motion, Nanos, WheelSpeed, to_seconds};

use crate::motion_stuck::stuck_faults;
use crate::motion_turns::{Place, turn_faults};
use crate::words::seconds;
use crate::{Log, LogError, Stream};

/// What is said of measurements that cannot be used, after how many of how many: what happened, and what to try.
pub const MOTION_UNUSABLE: [&str; 2] = [
    "measurements of motion sensors cannot be used and were left out",
    "`realo info` says how many of which topic, and what is wrong with the first",
];

/// Readings that are equal to the bit so often in a row are of a sensor that is stuck.
pub(crate) const STUCK_IMU: usize = 50;
const STUCK_FIXES: usize = 20;
const STUCK_WHEELS: usize = 100;
/// Extreme readings that are equal so often in a row are at the end of the sensor's range.
const SATURATED: usize = 5;
/// A rate of so much, rad/s, or a force, m/s², may be the end of a range.
const EXTREME: [f64; 2] = [1.5, 19.0];
/// Positions jump that are so far from the one before, m, faster than this, m/s, and this many of their standard deviations away.
const JUMP: [f64; 3] = [5.0, 70.0, 6.0];
/// Positions so far from the poses of the agent, m, are of another place.
const ELSEWHERE: f64 = 200.0;
/// A unit that is silent for so many periods has a gap.
const GAP_PERIODS: i64 = 10;
/// Wheels are compared with poses above this speed, m/s.
const ROLLING: f64 = 2.0;
/// Speeds of poses are taken from so long before to so long after, ns.
const ASIDE: Nanos = 250_000_000;

/// What is wrong with an agent's motion sensors, a sentence each.
///
/// # Errors
/// A log that cannot be read.
pub(crate) fn motion_faults(log: &Log, agent: &str) -> Result<Vec<String>, LogError> {
    let mut found = Vec::new();
    let streams = [Stream::Imu, Stream::Fix, Stream::Wheels].into_iter();
    let there: Vec<Stream> = streams.filter(|stream| log.has(agent, *stream)).collect();
    if there.is_empty() {
        return Ok(found);
    }
    let poses = positions(log, agent)?;
    for stream in there {
        let Measured { all, stamps, unusable } = measured(log, agent, stream)?;
        let topic = stream.topic(agent);
        found.extend(unusable.map(|words| format!("{topic}: {words}")));
        if stream == Stream::Fix && all.fixes.is_empty() && !stamps.is_empty() {
            found.push(format!(
                "{topic}: none of {} messages has a position, all say that the receiver has no fix (status -1): look at its antenna",
                stamps.len()
            ));
        }
        let faults = [
            disorder(&stamps),
            stuck_faults(&all.imu, &poses),
            imu_faults(&all.imu),
            turn_faults(&all.imu, &poses),
            fix_faults(&all.fixes, &poses),
            wheel_faults(&all.wheels, &poses),
        ];
        found.extend(faults.into_iter().flatten().map(|words| format!("{topic}: {words}")));
    }
    Ok(found)
}

/// What a stream has.
#[derive(Default)]
struct Measured {
    all: Motion,
    /// Of all messages that can be used, also those of receivers that have no position.
    stamps: Vec<Nanos>,
    /// How many cannot be used, in words.
    unusable: Option<String>,
}

fn measured(log: &Log, agent: &str, stream: Stream) -> Result<Measured, LogError> {
    let mut reader = log.read_all(&[(agent, stream)])?;
    let (mut found, mut messages, mut lost, mut first) = (Measured::default(), 0, 0, None);
    while let Some(entry) = reader.next()? {
        messages += 1;
        match entry.motion() {
            Ok(motion) => {
                found.stamps.push(entry.stamp());
                found.all.imu.extend(motion.imu);
                found.all.fixes.extend(motion.fixes);
                found.all.wheels.extend(motion.wheels);
            }
            Err(error) => {
                lost += 1;
                first.get_or_insert(error.reason());
            }
        }
    }
    let words = |first: String| format!("{lost} of {messages} {}; the first: {first}", MOTION_UNUSABLE[0]);
    found.unusable = first.map(words);
    Ok(found)
}

/// Stamps that do not rise, or pause.
fn disorder(stamps: &[Nanos]) -> Vec<String> {
    let mut found = Vec::new();
    let steps: Vec<Nanos> = stamps
        .array_windows()
        .map(|[one, next]| next.saturating_sub(*one))
        .collect();
    let wrong = steps.iter().filter(|step| **step <= 0).count();
    if wrong > 0 {
        found.push(format!(
            "{wrong} of {} stamps do not rise: the sensor's clock stands still, runs backwards or was set; write the time of each \
             measurement",
            stamps.len()
        ));
    }
    let Some(period) = median(steps.iter().map(|step| *step as f64).collect()) else {
        return found;
    };
    let gaps: Vec<&Nanos> = steps
        .iter()
        .filter(|step| **step as f64 > GAP_PERIODS as f64 * period)
        .collect();
    if let Some(longest) = gaps.iter().max() {
        found.push(format!(
            "{} pauses of more than {GAP_PERIODS} periods, the longest of {} s: record all of its messages",
            gaps.len(),
            seconds(**longest)
        ));
    }
    found
}

/// The longest run of equal things.
fn longest_run<T>(things: &[T], is_same: impl Fn(&T, &T) -> bool) -> usize {
    let (mut longest, mut run) = (usize::from(!things.is_empty()), 1);
    for [one, next] in things.array_windows() {
        run = if is_same(one, next) { run + 1 } else { 1 };
        longest = longest.max(run);
    }
    longest
}

fn median(mut numbers: Vec<f64>) -> Option<f64> {
    numbers.sort_by(f64::total_cmp);
    numbers.get(numbers.len() / 2).copied()
}

fn norm(v: &[f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn imu_faults(samples: &[ImuSample]) -> Vec<String> {
    let mut found = Vec::new();
    let readings: Vec<[[f64; 3]; 2]> = samples.iter().map(|s| [s.angular_rate, s.specific_force]).collect();
    let run = longest_run(&readings, |one, other| one == other);
    if run >= STUCK_IMU {
        found.push(format!(
            "{run} samples in a row are equal to the bit: the unit is stuck; leave such samples out"
        ));
    }
    for (part, name, unit) in [(0, "angular rate", "rad/s"), (1, "specific force", "m/s²")] {
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            let along: Vec<f64> = readings.iter().map(|reading| reading[part][axis]).collect();
            let is_same = |one: &f64, other: &f64| one == other && one.abs() > EXTREME[part];
            let run = longest_run(&along, is_same);
            if (SATURATED..STUCK_IMU).contains(&run) {
                let most = along.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
                found.push(format!(
                    "{run} samples in a row have one extreme {name} along {letter}, up to {most:.2} {unit}: the end of the unit's range; \
                     take a unit with a larger one"
                ));
            }
        }
    }
    found.extend(gravity(samples));
    if let Some(rate) = median(samples.iter().map(|s| norm(&s.angular_rate)).collect())
        && rate > 4.0
    {
        found.push(format!(
            "angular rates of {rate:.1} in the median: rad/s are expected, these look like degrees/s; multiply them by π/180"
        ));
    }
    found
}

/// What the mean specific force says of units and of the way that the sensor is mounted.
fn gravity(samples: &[ImuSample]) -> Option<String> {
    let n = samples.len() as f64;
    let mean: [f64; 3] = std::array::from_fn(|axis| samples.iter().map(|s| s.specific_force[axis]).sum::<f64>() / n);
    let (size, up) = (norm(&mean), mean[2]);
    let words = match (samples.is_empty(), size) {
        (true, _) => return None,
        (_, size) if (0.8..1.3).contains(&size) => "looks like multiples of g: write m/s²",
        (_, size) if size < 5.0 => "gravity is not in it: write what the unit measures, 9.8 m/s² upwards at rest",
        (_, size) if size > 15.0 => "write m/s²",
        _ if up < -5.0 => {
            "the unit is upside down: put how it is turned on /tf_static, and its frame into its messages"
        }
        _ if up < 7.0 => {
            "z does not point up: put how the unit is turned on /tf_static, and its frame into its messages"
        }
        _ => return None,
    };
    let [x, y, z] = mean;
    Some(format!(
        "the mean specific force is ({x:.2}, {y:.2}, {z:.2}), expected about (0, 0, 9.8) m/s² in the body's axes; {words}"
    ))
}

fn positions(log: &Log, agent: &str) -> Result<Vec<Place>, LogError> {
    if !log.has(agent, Stream::Pose) {
        return Ok(Vec::new());
    }
    let mut reader = log.read_all(&[(agent, Stream::Pose)])?;
    let mut places = Vec::new();
    loop {
        match reader.next() {
            Ok(Some(entry)) => {
                let place = entry.pose().map(|state| state.map_from_body.translation.vector.into());
                places.extend(place.map(|place| (entry.stamp(), place)));
            }
            // Poses that start again are named with their times.
            Ok(None) | Err(LogError::Content { .. }) => break,
            Err(error) => return Err(error),
        }
    }
    places.sort_by_key(|(stamp, _)| *stamp);
    Ok(places)
}

/// The places before and after a time, at most a second apart.
fn around(places: &[Place], stamp: Nanos) -> Option<[&Place; 2]> {
    let next = places.partition_point(|(known, _)| *known <= stamp);
    let (before, after) = (places.get(next.checked_sub(1)?)?, places.get(next)?);
    (after.0 - before.0 <= 1_000_000_000).then_some([before, after])
}

fn apart(one: &[f64; 3], other: &[f64; 3]) -> f64 {
    norm(&std::array::from_fn(|axis| one[axis] - other[axis]))
}

fn fix_faults(fixes: &[GnssFix], poses: &[Place]) -> Vec<String> {
    let mut found = Vec::new();
    let run = longest_run(fixes, |one, other| one.position == other.position);
    if run >= STUCK_FIXES {
        found.push(format!(
            "{run} positions in a row are equal to the bit: the receiver repeats the last one; leave out what is no new position"
        ));
    }
    let jump = |[one, next]: &[GnssFix; 2]| {
        let (far, time) = (
            apart(&one.position, &next.position),
            to_seconds(next.taken.stamp - one.taken.stamp),
        );
        let variance = next.covariance.map_or(0.0, |of| of[0] + of[4] + of[8]);
        (far > JUMP[0] && far > JUMP[1] * time && far > JUMP[2] * variance.sqrt()).then_some(far)
    };
    let jumps: Vec<f64> = fixes.array_windows().filter_map(jump).collect();
    if let Some(first) = jumps.first() {
        found.push(format!(
            "{} of {} positions jump by more than anything drives, the first by {first:.1} m: leave out what has no fix, and say its \
             covariance",
            jumps.len(),
            fixes.len()
        ));
    }
    let off = fixes.iter().filter_map(|fix| {
        let [before, _] = around(poses, fix.taken.stamp)?;
        Some([apart(&before.1, &fix.position), (fix.position[2] - before.1[2]).abs()])
    });
    let (off, height): (Vec<f64>, Vec<f64>) = off.map(|[far, height]| (far, height)).unzip();
    let (off, height) = (median(off).unwrap_or(0.0), median(height).unwrap_or(0.0));
    if off > ELSEWHERE {
        found.push(format!(
            "positions are {off:.0} m off the agent's poses in the median ({height:.0} m of it in height): `map_origin` is of another \
             place, or heights are not over the ellipsoid"
        ));
    }
    found
}

fn wheel_faults(wheels: &[WheelSpeed], poses: &[Place]) -> Vec<String> {
    let mut found = Vec::new();
    let run = longest_run(wheels, |one, other| one.speed == other.speed && one.speed != 0.0);
    if run >= STUCK_WHEELS {
        found.push(format!(
            "{run} speeds in a row are equal to the bit, and not 0: the sensor is stuck; leave such speeds out"
        ));
    }
    let ratio = |wheel: &WheelSpeed| {
        // From one pose to the next the noise of poses may be all of their speed.
        let [before, _] = around(poses, wheel.taken.stamp - ASIDE)?;
        let [_, after] = around(poses, wheel.taken.stamp + ASIDE)?;
        let speed = apart(&before.1, &after.1) / to_seconds(after.0 - before.0);
        (speed > ROLLING).then_some(wheel.speed / speed)
    };
    let words = match median(wheels.iter().filter_map(ratio).collect()) {
        Some(ratio) if (3.3..3.9).contains(&ratio) => "these look like km/h: divide them by 3.6",
        Some(ratio) if (2.1..2.4).contains(&ratio) => "these look like miles/h: multiply them by 0.44704",
        Some(ratio) if ratio < -0.5 => "ahead is above 0: change their sign",
        Some(ratio) if !(0.5..2.0).contains(&ratio) => "write the speed of the middle of the fixed axle in m/s",
        _ => return found,
    };
    found.push(format!("speeds do not fit the agent's poses, expected m/s; {words}"));
    found
}

#[cfg(test)]
mod tests {
    use realo_schemas::FixQuality;
    use realo_schemas::motion::Taken;

    use super::*;

    const MS: Nanos = 1_000_000;

    fn taken(k: usize, period: Nanos) -> Taken {
        Taken {
            stamp: k as Nanos * period,
            arrival: k as Nanos * period,
        }
    }

    fn samples(reading: impl Fn(usize) -> [[f64; 3]; 2]) -> Vec<ImuSample> {
        let sample = |k: usize| {
            let [angular_rate, specific_force] = reading(k);
            ImuSample {
                taken: taken(k, 10 * MS),
                angular_rate,
                specific_force,
            }
        };
        (0..400).map(sample).collect()
    }

    fn wave(k: usize) -> f64 {
        libm::sin(0.1 * k as f64)
    }

    #[test]
    fn a_sound_unit_has_no_fault_and_each_damage_its_words() {
        let sound = |k: usize| [[0.01 * wave(k), 0.0, 0.2], [0.1, wave(k), 9.8 + 0.01 * wave(k)]];
        assert_eq!(imu_faults(&samples(sound)), Vec::<String>::new());
        let with = |change: &dyn Fn(usize, &mut [[f64; 3]; 2])| {
            let damaged = samples(|k| {
                let mut reading = sound(k);
                change(k, &mut reading);
                reading
            });
            imu_faults(&damaged).join("; ")
        };
        for (found, words) in [
            (
                with(&|k, r| {
                    if k > 300 {
                        *r = sound(300)
                    }
                }),
                "100 samples in a row are equal",
            ),
            (
                with(&|k, r| {
                    if (50..60).contains(&k) {
                        r[0][2] = 2.0
                    }
                }),
                "10 samples in a row have one extreme angular rate along z",
            ),
            (with(&|_, r| r[1] = r[1].map(|v| v / 9.8)), "multiples of g"),
            (with(&|_, r| r[1][2] -= 9.8), "gravity is not in it"),
            (with(&|_, r| r[1][2] = -r[1][2]), "upside down"),
            (with(&|_, r| r[1].swap(0, 2)), "z does not point up"),
            (with(&|_, r| r[0] = r[0].map(|v| 57.3 * v)), "degrees/s"),
        ] {
            assert!(found.contains(words), "{words}: {found}");
        }
    }

    #[test]
    fn stamps_that_stand_still_run_back_or_pause_are_named() {
        let stamps =
            |change: &dyn Fn(i64) -> i64| disorder(&(0..100).map(|k| change(k) * MS).collect::<Vec<_>>()).join("; ");
        assert_eq!(stamps(&|k| 10 * k), "");
        assert!(stamps(&|k| 10 * k.min(50)).contains("49 of 100 stamps do not rise"));
        assert!(stamps(&|k| if k == 60 { 20 } else { 10 * k }).contains("1 of 100 stamps do not rise"));
        assert!(
            stamps(&|k| if k > 60 { 10 * k + 990 } else { 10 * k })
                .contains("1 pauses of more than 10 periods, the longest of 1.000 s")
        );
    }

    fn driven() -> Vec<Place> {
        (0..2_000).map(|k| (k * 10 * MS, [0.1 * k as f64, 5.0, 0.0])).collect()
    }

    #[test]
    fn positions_that_jump_stand_still_or_are_elsewhere_are_named() {
        let fixes = |at: &dyn Fn(usize) -> [f64; 3]| -> Vec<GnssFix> {
            let fix = |k: usize| GnssFix {
                taken: taken(k, 100 * MS),
                position: at(k),
                has_height: true,
                covariance: None,
                quality: FixQuality::Single,
            };
            (0..100).map(fix).collect()
        };
        let sound = |k: usize| [1.0 * k as f64, 5.0 + wave(k), 1.5];
        let found = |at: &dyn Fn(usize) -> [f64; 3]| fix_faults(&fixes(at), &driven()).join("; ");
        assert_eq!(found(&sound), "");
        assert!(found(&|k| sound(k.min(40))).contains("60 positions in a row are equal"));
        assert!(
            found(&|k| if k < 50 { sound(k) } else { sound(k).map(|v| v + 12.0) }).contains("1 of 100 positions jump")
        );
        assert!(found(&|k| sound(k).map(|v| v + 5e5)).contains("m off the agent's poses"));
    }

    #[test]
    fn wheels_of_another_unit_or_sign_are_named() {
        let found = |speed: &dyn Fn(usize) -> f64| {
            let wheel = |k: usize| WheelSpeed {
                taken: taken(k, 20 * MS),
                speed: speed(k),
                variance: None,
            };
            wheel_faults(&(0..500).map(wheel).collect::<Vec<_>>(), &driven()).join("; ")
        };
        let sound = |k: usize| 10.0 + 0.01 * wave(k);
        assert_eq!(found(&sound), "");
        assert!(found(&|k| 3.6 * sound(k)).contains("km/h"));
        assert!(found(&|k| -sound(k)).contains("change their sign"));
        assert!(found(&|_| 10.0).contains("500 speeds in a row are equal"));
        assert_eq!(
            found(&|_| 0.0),
            "speeds do not fit the agent's poses, expected m/s; write the speed of the middle of the fixed axle in m/s"
        );
    }
}
