//! Clocks that are off: their offsets are known within the bound that is reported, and stamps are handled as the setting says.

use nalgebra::{Isometry3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use realo_operator::{Operator, Outputs};
use realo_schemas::motion::Taken;
use realo_schemas::report::{OffsetBy, SensorClock};
use realo_schemas::{
    AgentState, Header, ImuSample, Kind, Message, Motion, Nanos, PointCloud, PoseStatus, from_seconds, to_seconds,
};
use realo_sync::{Input, Settings, Sync};
use realo_time_offset::StampRule;

const T0: Nanos = 1_790_000_000_000_000_000;
const MS: Nanos = 1_000_000;
const S: Nanos = 1_000 * MS;

struct Draws(ChaCha8Rng);

impl Draws {
    fn uniform(&mut self) -> f64 {
        ((self.0.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// What is to be added to the stamps of each sensor, at a true time, ns.
#[derive(Clone, Copy)]
struct Clocks {
    imu: Nanos,
    others: Nanos,
    drift: f64,
    step: (Nanos, Nanos),
}

impl Clocks {
    fn right() -> Self {
        Clocks {
            imu: 0,
            others: 0,
            drift: 0.0,
            step: (Nanos::MAX, 0),
        }
    }

    fn at(&self, offset: Nanos, time: Nanos) -> Nanos {
        let step = if time >= self.step.0 { self.step.1 } else { 0 };
        offset + step + from_seconds(self.drift * to_seconds(time - T0))
    }

    fn stamp(&self, offset: Nanos, time: Nanos) -> Nanos {
        time - self.at(offset, time)
    }
}

fn header(kind: Kind, seq: u64, stamp: Nanos, ready: Nanos) -> Header {
    Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, ready)
}

fn pose(seq: u64, [stamp, ready]: [Nanos; 2], along: f64, yaw: f64) -> Message {
    let state = AgentState {
        map_from_body: Isometry3::new(Vector3::new(along, 0.0, 0.0), Vector3::z() * yaw),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    Message::new(header(Kind::AgentState, seq, stamp, ready), state)
}

fn sweep(seq: u64, [stamp, ready]: [Nanos; 2]) -> Message {
    let times = vec![-50_000_000, 49_000_000];
    let at = vec![20.0; 2];
    let cloud = PointCloud::new(at.clone(), at.clone(), at, vec![0u8; 2], times, vec![0u16; 2]).unwrap();
    Message::new(header(Kind::Points, seq, stamp, ready), cloud)
}

/// A drive of some seconds with curves: its messages in order of arrival.
fn drive(draws: &mut Draws, clocks: Clocks, seconds: usize) -> Vec<Message> {
    let (mut rate, mut aim, mut yaw, bias) = (0.0, 0.0, 1.0, 3e-3 * draws.normal());
    let mut sampled = yaw;
    let mut messages = Vec::new();
    let mut imu = Vec::new();
    for step in 0..seconds * 1_000 {
        let now = T0 + step as Nanos * MS;
        if step % 4_000 == 0 {
            aim = if step % 8_000 == 0 { 0.3 * draws.normal() } else { 0.0 };
        }
        let last = rate;
        rate += (aim - rate) * 2e-3;
        yaw += 0.5 * (last + rate) * 1e-3;
        if step % 10 == 0 {
            let arrival = now + from_seconds(1e-3 * (1.0 + 2.0 * draws.uniform()));
            // The mean of the time since the sample before.
            let mean = (yaw - sampled) / 1e-2;
            sampled = yaw;
            imu.push((
                clocks.stamp(clocks.imu, now),
                arrival,
                mean + bias + 2.4e-3 * draws.normal(),
            ));
        }
        let number = step as u64 / 100;
        if step % 100 == 50 {
            let delay = from_seconds(1e-3 * (20.0 + 30.0 * draws.uniform()));
            let seen = yaw + 1.7e-3 * draws.normal();
            let times = [clocks.stamp(clocks.others, now), now + delay];
            messages.push(pose(number, times, 1e-2 * step as f64, seen));
        }
        if step % 100 == 99 {
            // Stamped in its middle, complete now, a little under way.
            let ready = now + from_seconds(1e-3 * (5.0 - 10.0 * draws.uniform().ln()));
            messages.push(sweep(number, [clocks.stamp(clocks.others, now - 49 * MS), ready]));
            let (stamp, release) = (clocks.stamp(clocks.others, now - 49 * MS), now + 5 * MS);
            messages.push(motion(number, [stamp, release], std::mem::take(&mut imu)));
        }
    }
    messages.sort_by_key(|message| message.header.ready);
    messages
}

fn motion(seq: u64, [stamp, ready]: [Nanos; 2], imu: Vec<(Nanos, Nanos, f64)>) -> Message {
    let sample = |(at, arrival, rate): (Nanos, Nanos, f64)| ImuSample {
        taken: Taken {
            stamp: at - stamp,
            arrival: arrival - ready,
        },
        angular_rate: [0.0, 0.0, rate],
        specific_force: [0.0, 0.0, 9.8],
    };
    let motion = Motion {
        imu: imu.into_iter().map(sample).collect(),
        ..Motion::default()
    };
    Message::new(header(Kind::Motion, seq, stamp, ready), motion)
}

/// Stamps and numbers of the sweeps that left, what is known of clocks, and what was counted by name.
struct Ran {
    sweeps: Vec<(u64, Nanos)>,
    clocks: Vec<SensorClock>,
    counted: [u64; 3],
}

fn run(settings: Settings, messages: Vec<Message>) -> Ran {
    let mut sync = Sync::new(settings).unwrap();
    let (mut sweeps, mut counted) = (Vec::new(), [0; 3]);
    let last = messages.last().map_or(0, |message| message.header.ready);
    let mut note = |out: &mut Outputs<realo_sync::Output>| {
        let sent = out.take_sent().into_iter().map(|(_, message)| message.header);
        sweeps.extend(
            sent.filter(|header| header.kind == Kind::Points)
                .map(|header| (header.seq, header.stamp)),
        );
        let names = ["clock_steps", "stamps_rebased", "stamps_left_out"];
        counted
            .iter_mut()
            .zip(names)
            .for_each(|(sum, name)| *sum += out.counted(name));
    };
    for message in messages {
        let port = match message.header.kind {
            Kind::AgentState => Input::POSES,
            Kind::Points => Input::CLOUDS,
            _ => Input::MOTION,
        };
        let mut out = Outputs::at(message.header.ready);
        // A stamp that is refused is an error of its own.
        drop(sync.on_message(port, message, &mut out));
        note(&mut out);
    }
    let mut out = Outputs::at(last + S);
    sync.on_end(&mut out).unwrap();
    note(&mut out);
    let clocks = out.clocks().to_vec();
    Ran {
        sweeps,
        clocks,
        counted,
    }
}

fn with(stamps: StampRule) -> Settings {
    Settings {
        stamps,
        ..Settings::default()
    }
}

fn of<'a>(ran: &'a Ran, sensor: &str) -> &'a SensorClock {
    ran.clocks.iter().find(|clock| clock.sensor == sensor).unwrap()
}

#[test]
fn the_truth_is_within_the_bound_of_each_sensor() {
    const SEEDS: u64 = 60;
    // Right, estimated, and the sum of bounds, ms: inertial unit, poses, LiDAR, and the unit to the poses.
    let mut found = [(0, 0, 0.0); 4];
    for seed in 0..SEEDS {
        let mut draws = Draws(ChaCha8Rng::seed_from_u64(seed));
        let others = from_seconds(0.3 * draws.normal());
        let apart = if seed % 2 == 0 {
            0
        } else {
            from_seconds(0.1 * draws.normal())
        };
        let clocks = Clocks {
            imu: others + apart,
            others,
            drift: 2e-5 * draws.normal(),
            ..Clocks::right()
        };
        let ran = run(Settings::default(), drive(&mut draws, clocks, 40));
        let end = T0 + 40 * S;
        let ms = |time: Nanos| time as f64 * 1e-6;
        let [imu, poses, lidar] = ["imu", "poses", "lidar"].map(|sensor| of(&ran, sensor));
        let all = [
            (imu.offset_ms, imu.bound_ms, clocks.at(clocks.imu, end)),
            (poses.offset_ms, poses.bound_ms, clocks.at(others, end)),
            (lidar.offset_ms, lidar.bound_ms, clocks.at(others, end)),
            (imu.to_poses_ms, imu.to_poses_bound_ms, apart),
        ];
        for ((right, estimated, sum), (offset, bound, truth)) in found.iter_mut().zip(all) {
            if let Some((offset, bound)) = offset.zip(bound) {
                *estimated += 1;
                *right += u32::from((offset - ms(truth)).abs() <= bound);
                *sum += bound;
            }
        }
        assert!(imu.bound_ms.unwrap() <= 5.0, "{imu:?}");
        if poses.by == Some(OffsetBy::Motion) {
            assert!(poses.bound_ms.unwrap() <= 9.0, "{poses:?}");
        }
    }
    for (name, (right, estimated, sum)) in ["imu", "poses", "lidar", "imu to poses"].into_iter().zip(found) {
        let (share, mean) = (f64::from(right) / f64::from(estimated), sum / f64::from(estimated));
        println!("{name}: {right} of {estimated} within, mean bound {mean:.2} ms");
        assert!(
            estimated as u64 * 10 >= SEEDS * 8,
            "{name}: estimated in {estimated} of {SEEDS}"
        );
        assert!(share >= 0.95, "{name}: {right} of {estimated}");
    }
}

#[test]
fn an_inertial_unit_whose_delay_is_known_is_within_a_millisecond() {
    let mut draws = Draws(ChaCha8Rng::seed_from_u64(9));
    let clocks = Clocks {
        imu: -80 * MS,
        others: -80 * MS,
        ..Clocks::right()
    };
    let settings = Settings {
        imu_delay_ms: vec![0.5, 1.5],
        ..Settings::default()
    };
    let ran = run(settings, drive(&mut draws, clocks, 30));
    let imu = of(&ran, "imu");
    let [offset, bound] = [imu.offset_ms, imu.bound_ms].map(Option::unwrap);
    assert!((offset + 80.0).abs() <= bound && bound <= 1.0, "{imu:?}");
    assert!(imu.is_notable() && imu.faults.is_empty(), "{imu:?}");
}

#[test]
fn clocks_that_are_right_are_not_worth_a_word_and_change_nothing() {
    let messages = || drive(&mut Draws(ChaCha8Rng::seed_from_u64(1)), Clocks::right(), 20);
    let usual = run(Settings::default(), messages());
    assert!(
        usual.clocks.iter().all(|clock| !clock.is_notable()),
        "{:?}",
        usual.clocks
    );
    for rule in [StampRule::Drop, StampRule::Rebase, StampRule::Trust] {
        let ran = run(with(rule), messages());
        assert_eq!((ran.sweeps, ran.counted), (usual.sweeps.clone(), [0; 3]), "{rule:?}");
    }
    let without_motion = messages()
        .into_iter()
        .filter(|message| message.header.kind != Kind::Motion);
    let ran = run(Settings::default(), without_motion.collect());
    assert_eq!(ran.sweeps, usual.sweeps);
}

#[test]
fn offline_arrivals_are_no_measurements() {
    let offline = |mut message: Message| {
        message.header.ready = message.header.stamp;
        message
    };
    let mut messages: Vec<Message> = drive(&mut Draws(ChaCha8Rng::seed_from_u64(2)), Clocks::right(), 20)
        .into_iter()
        .filter(|message| message.header.kind != Kind::Motion)
        .map(offline)
        .collect();
    messages.sort_by_key(|message| message.header.ready);
    let ran = run(Settings::default(), messages);
    assert!(ran.clocks.len() == 2 && ran.clocks.iter().all(|clock| clock.offset_ms.is_none()));
}

/// Right stamps of all sweeps of a drive, by number.
fn truth(number: u64) -> Nanos {
    T0 + (number as Nanos * 100 + 50) * MS
}

#[test]
fn a_clock_that_steps_is_named_and_taken_back() {
    for step in [-S, S, -600 * MS] {
        let clocks = Clocks {
            step: (T0 + 10 * S, step),
            ..Clocks::right()
        };
        let messages = || drive(&mut Draws(ChaCha8Rng::seed_from_u64(3)), clocks, 20);
        let rebased = run(with(StampRule::Rebase), messages());
        let [steps, moved, left_out] = rebased.counted;
        assert_eq!(steps, 2, "{step}: of sweeps and of poses");
        assert!(
            moved >= 150 && (1..=40).contains(&left_out),
            "{step}: {moved}, {left_out}"
        );
        // Delays of 5 ms and more make a step a little unsure.
        let off = |from: u64| {
            let sweeps = rebased.sweeps.iter().filter(|(number, _)| *number >= from);
            sweeps
                .map(|(number, stamp)| (stamp - truth(*number)).abs())
                .max()
                .unwrap()
        };
        assert!(rebased.sweeps.len() >= 180, "{step}: {}", rebased.sweeps.len());
        assert!(
            off(0) <= 50 * MS && off(170) <= 10 * MS,
            "{step}: {} {}",
            off(0),
            off(170)
        );
        assert!(rebased.sweeps.is_sorted_by_key(|(_, stamp)| *stamp));
        let lidar = of(&rebased, "lidar");
        assert!(lidar.is_notable() && lidar.faults["stamp_jump"] == 1, "{lidar:?}");
        assert!((lidar.step_ms.unwrap() + step as f64 * 1e-6).abs() < 40.0, "{lidar:?}");

        let dropped = run(with(StampRule::Drop), messages());
        assert!(dropped.sweeps.iter().all(|(number, _)| *number < 102), "{step}");
        let usual = run(Settings::default(), messages());
        assert_eq!(usual.counted, [2, 0, 0], "{step}: named");
    }
}

#[test]
fn clocks_that_count_something_else_are_named_and_handled() {
    let weeks = 1_024 * 7 * 86_400 * S;
    for (offset, counts) in [
        (-37 * S, "tai"),
        (-18 * S, "gps"),
        (weeks, "weeks"),
        (T0 - 4_280 * S, "boot"),
        (7_200 * S, "other"),
    ] {
        let clocks = Clocks {
            imu: offset,
            others: offset,
            ..Clocks::right()
        };
        let messages = || drive(&mut Draws(ChaCha8Rng::seed_from_u64(4)), clocks, 15);
        let rebased = run(with(StampRule::Rebase), messages());
        assert_eq!(rebased.sweeps.len(), 150, "{counts}");
        // A clock that counts something unknown is right to the delay of the first message.
        let slack = if ["boot", "other"].contains(&counts) {
            110 * MS
        } else {
            0
        };
        let off = rebased
            .sweeps
            .iter()
            .map(|(number, stamp)| (stamp - truth(*number)).abs());
        assert!(off.max().unwrap() <= slack, "{counts}");
        for sensor in ["lidar", "poses", "imu"] {
            let clock = of(&rebased, sensor);
            assert_eq!(clock.counts.as_deref(), Some(counts), "{sensor}");
            let [found, bound] = [clock.offset_ms, clock.bound_ms].map(Option::unwrap);
            assert!((found - offset as f64 * 1e-6).abs() <= bound, "{clock:?}");
        }
        assert_eq!(run(with(StampRule::Drop), messages()).sweeps, [], "{counts}");
        // Trusted ones pair with poses of the same clock; by default those that are far ahead are refused.
        let trusted = run(with(StampRule::Trust), messages());
        assert!(trusted.sweeps.len() == 150 && trusted.counted == [0; 3], "{counts}");
        let usual = run(Settings::default(), messages()).sweeps.len();
        assert_eq!(usual, if offset < 0 { 0 } else { 150 }, "{counts}");
    }
}

#[test]
fn delays_that_are_none_are_refused() {
    for (settings, name) in [
        (
            Settings {
                imu_delay_ms: vec![4.0, 0.0],
                ..Settings::default()
            },
            "imu_delay_ms",
        ),
        (
            Settings {
                lidar_delay_ms: vec![1.0],
                ..Settings::default()
            },
            "lidar_delay_ms",
        ),
        (
            Settings {
                lidar_delay_ms: vec![0.0, f64::NAN],
                ..Settings::default()
            },
            "lidar_delay_ms",
        ),
    ] {
        let error = Sync::new(settings).err().unwrap().to_string();
        assert!(error.contains(name), "{error}");
    }
}
