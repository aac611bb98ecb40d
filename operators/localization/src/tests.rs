//! Drives of a vehicle and a roadside unit through a street, localised by their sensors.

use nalgebra::{Isometry3, Point3, Vector3};
use realo_operator::{Operator, Outputs};
use realo_registration::{MapBuilder, MapSettings, PosedSweep};
use realo_schemas::motion::Taken;
use realo_schemas::{
    AgentState, FixQuality, GnssFix, Header, ImuSample, Kind, Message, Motion, Name, Nanos, PointCloud, PoseStatus,
    WheelSpeed,
};

use crate::operator::{Input, Localization, Output, Settings, Source, UnitChoice};

const MS: Nanos = 1_000_000;
const GRAVITY: f64 = 9.806_65;
/// Speed, m/s, and angular rate, rad/s, of the drive: round a circle.
const SPEED: f64 = 8.0;
const TURN: f64 = 0.12;

/// A number of 0 to 1 by two others.
fn draw(seed: u64, n: u64) -> f64 {
    let mut x = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ n.wrapping_mul(0xD1B5_4A32_D192_ED03);
    for _ in 0..3 {
        x ^= x >> 29;
        x = x.wrapping_mul(0xBF58_476D_1CE4_E5B9);
    }
    (x >> 11) as f64 / (1u64 << 53) as f64
}

/// Standard deviation 1, from -1.7 to 1.7.
fn noise(seed: u64, n: u64) -> f64 {
    (draw(seed, n) - 0.5) * 12f64.sqrt()
}

/// The vehicle's true pose, s after the beginning.
fn truth(seconds: f64) -> Isometry3<f64> {
    let yaw = 0.4 + TURN * seconds;
    let radius = SPEED / TURN;
    let place = Vector3::new(radius * yaw.sin(), -radius * yaw.cos(), 0.0);
    Isometry3::new(place, Vector3::z() * yaw)
}

/// Houses of different sizes on both sides of the way, in `map`.
fn street() -> Vec<Point3<f64>> {
    let mut points = Vec::new();
    for house in 0..40u64 {
        let angle = 0.157 * house as f64;
        for (side, seed) in [(-1.0, 1), (1.0, 2)] {
            let radius = SPEED / TURN + side * (9.0 + 5.0 * draw(seed, house));
            let center = Vector3::new(radius * angle.sin(), -radius * angle.cos(), 0.0);
            let house_frame = Isometry3::new(center, Vector3::z() * (angle + 0.5 * draw(seed + 2, house)));
            let [length, width] = [4.0 + 3.0 * draw(seed + 4, house), 3.0 + 2.0 * draw(seed + 6, house)];
            for step in 0..60 {
                let along = f64::from(step) / 60.0 * 4.0;
                let [x, y] = match along as u32 {
                    0 => [along, 0.0],
                    1 => [1.0, along - 1.0],
                    2 => [3.0 - along, 1.0],
                    _ => [0.0, 4.0 - along],
                };
                for height in 0..12 {
                    let point = Point3::new((x - 0.5) * length, (y - 0.5) * width, 0.3 + 0.4 * f64::from(height));
                    points.push(house_frame * point);
                }
            }
        }
    }
    for x in -48..48 {
        for y in -48..48 {
            // Three points of a cell of the map, since one alone is no plane.
            for [aside, along] in [[0.1, 0.1], [0.6, 0.1], [0.1, 0.6]] {
                points.push(Point3::new(2.0 * f64::from(x) + aside, 2.0 * f64::from(y) + along, 0.0));
            }
        }
    }
    points
}

/// What a sweep has of the street, with an error of 2 cm, in the body frame.
fn sweep(street: &[Point3<f64>], map_from_body: &Isometry3<f64>, seed: u64) -> PointCloud {
    let body_from_map = map_from_body.inverse();
    let seen = street.iter().map(|point| body_from_map * point);
    let mut near: Vec<Point3<f64>> = seen.filter(|point| point.coords.norm() < 45.0).collect();
    // In an order that prefers no height: of the points of a cell the first is used.
    for at in (1..near.len()).rev() {
        near.swap(at, (draw(seed, at as u64) * at as f64) as usize);
    }
    let axis = |axis: usize| -> Vec<f32> {
        let noisy =
            |(n, point): (usize, &Point3<f64>)| (point[axis] + 0.02 * noise(seed, 3 * n as u64 + axis as u64)) as f32;
        near.iter().enumerate().map(noisy).collect()
    };
    let n = near.len();
    PointCloud::new(axis(0), axis(1), axis(2), vec![0; n], vec![0; n], vec![0; n]).unwrap()
}

/// Writes the map of the street, moved by so much.
fn map(street: &[Point3<f64>], path: &std::path::Path, shift: f64) {
    let settings = MapSettings {
        min_points: 4,
        apart_s: 0.0,
        empty_share: 1.0,
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, "map").unwrap();
    for n in 0..52u64 {
        let pose = truth(n as f64);
        let cloud = sweep(street, &pose, 100 + n);
        let placed = Isometry3::translation(shift, 0.0, 0.0) * pose;
        builder
            .add(&PosedSweep {
                agent: "mapper",
                stamp: n as Nanos * 1_000 * MS,
                cloud: &cloud,
                map_from_body: &placed,
                sensor: [0.0, 0.0, 1.9],
                sigmas: [0.0; 3],
            })
            .unwrap();
    }
    builder.finish(|_, _| ()).unwrap().write(path).unwrap();
}

/// What the sensors measure in the 100 ms that end at the sweep's end, 50 ms after its stamp.
fn motion(number: u64, change: impl Fn(&mut Motion)) -> Motion {
    let at = |offset: i64| Taken {
        stamp: offset * MS,
        arrival: (offset - 50) * MS,
    };
    let sample = |k: i64| {
        let n = 10 * number + k as u64;
        ImuSample {
            taken: at(-40 + 10 * k),
            angular_rate: [1e-4 * noise(7, n), 1e-4 * noise(8, n), TURN + 1e-4 * noise(9, n)],
            specific_force: [
                0.005 * noise(10, n),
                SPEED * TURN + 0.005 * noise(11, n),
                GRAVITY + 0.005 * noise(12, n),
            ],
        }
    };
    let antenna = truth(0.1 * number as f64 - 0.05) * Point3::new(-0.3, 0.0, 1.5);
    let fix = GnssFix {
        taken: at(-50),
        position: std::array::from_fn(|axis| antenna[axis] + 0.5 * noise(20 + axis as u64, number)),
        has_height: true,
        covariance: Some([0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.25]),
        quality: FixQuality::Single,
    };
    let wheel = |k: i64| WheelSpeed {
        taken: at(-30 + 20 * k),
        speed: SPEED + 0.02 * noise(30, 5 * number + k as u64),
        variance: None,
    };
    let mut motion = Motion {
        imu: (0..10).map(sample).collect(),
        imu_variance: None,
        fixes: vec![fix],
        wheels: (0..5).map(wheel).collect(),
        imu_position: [0.0, 0.0, 0.4],
        antenna: [-0.3, 0.0, 1.5],
        axle: [0.0; 3],
    };
    change(&mut motion);
    motion
}

/// A run of the stage.
struct Run {
    stage: Localization,
    out: Outputs<Output>,
    agent: Name,
}

impl Run {
    fn new(agent: &str, source: Source, map: &std::path::Path) -> Self {
        let settings = Settings {
            source,
            map: map.into(),
            unit: UnitChoice::Tactical,
            roadside: "rsu1, rsu2".into(),
            ..Settings::default()
        };
        Run {
            stage: Localization::new(settings).unwrap(),
            out: Outputs::at(0),
            agent: agent.into(),
        }
    }

    fn header(&self, kind: Kind, number: u64) -> Header {
        let stamp = number as Nanos * 100 * MS;
        Header::origin(&"run".into(), &self.agent, kind, number, stamp, stamp + 50 * MS)
    }

    fn measure(&mut self, number: u64, motion: Motion) {
        let message = Message::new(self.header(Kind::Motion, number), motion);
        self.stage.on_message(Input::MOTION, message, &mut self.out).unwrap();
    }

    /// The state that leaves for a sweep, and whether the sweep has a pose.
    fn locate(&mut self, number: u64, cloud: PointCloud, recorded: &Isometry3<f64>) -> (AgentState, bool) {
        let state = AgentState {
            map_from_body: *recorded,
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Recorded,
        };
        let cloud = Message::new(self.header(Kind::Points, number), cloud);
        let state = Message::new(self.header(Kind::AgentState, number), state);
        self.stage.on_message(Input::CLOUDS, cloud, &mut self.out).unwrap();
        self.stage.on_message(Input::STATES, state, &mut self.out).unwrap();
        let mut sent = self.out.take_sent().into_iter();
        let (_, state) = sent.next().unwrap();
        let (_, cloud) = sent.next().unwrap();
        assert_eq!(state.header.pose, cloud.header.pose);
        let has_pose = cloud.header.pose.is_some();
        let (_, state): (Header, AgentState) = state.into_parts().unwrap();
        assert_eq!(has_pose, state.status.is_usable());
        (state, has_pose)
    }

    /// Statuses and position errors, sweep by sweep. Recorded poses are wrong: nobody may use them.
    fn drive(
        &mut self,
        sweeps: std::ops::Range<u64>,
        cloud: impl Fn(u64) -> PointCloud,
        change: impl Fn(u64, &mut Motion),
    ) -> Vec<(PoseStatus, f64)> {
        let wrong = Isometry3::translation(1e3, 1e3, 1e3);
        let of = |number: u64| {
            self.measure(number, motion(number, |motion| change(number, motion)));
            let (state, _) = self.locate(number, cloud(number), &wrong);
            let off = state.map_from_body.translation.vector - truth(0.1 * number as f64).translation.vector;
            (state.status, off.norm())
        };
        sweeps.map(of).collect()
    }
}

#[test]
fn a_vehicle_finds_itself_by_gnss_within_five_seconds() {
    let mut run = Run::new("cav1", Source::Gnss, "".as_ref());
    let drive = run.drive(0..150, |_| PointCloud::empty(), |_, _| ());
    assert_eq!(drive[0].0, PoseStatus::Init);
    assert!(
        drive[50..].iter().all(|(status, _)| *status == PoseStatus::Tracking),
        "{drive:?}"
    );
    assert!(drive[80..].iter().all(|(_, off)| *off < 1.0), "{drive:?}");
    let counted = ["init", "tracking", "lost"].map(|name| run.out.counted(name));
    assert_eq!(counted[0] + counted[1], 150);
    assert_eq!(counted[2], 0);
}

#[test]
fn a_map_makes_it_exact_and_carries_it_through_a_tunnel() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 0.0);
    let mut run = Run::new("cav1", Source::Map, &path);
    let drive = run.drive(
        0..120,
        |number| sweep(&street, &truth(0.1 * number as f64), number),
        |number, motion| {
            if (40..100).contains(&number) {
                motion.fixes.clear();
            }
        },
    );
    assert!(
        drive[2..].iter().all(|(status, _)| *status == PoseStatus::Tracking),
        "{drive:?}"
    );
    assert!(drive[10..].iter().all(|(_, off)| *off < 0.1), "{drive:?}");
    assert!(run.out.counted("searches") >= 1 && run.out.counted("scans") > 100);
}

#[test]
fn the_map_is_believed_where_a_receiver_is_off_by_metres() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 0.0);
    for off in [5.0, 10.0] {
        let mut run = Run::new("cav1", Source::Map, &path);
        let drive = run.drive(
            0..60,
            |number| sweep(&street, &truth(0.1 * number as f64), number),
            |_, motion| motion.fixes.iter_mut().for_each(|fix| fix.position[1] += off),
        );
        assert!(
            drive[20..]
                .iter()
                .all(|(status, off)| *status == PoseStatus::Tracking && *off < 0.2),
            "{off} m: {drive:?}"
        );
        assert!(run.out.counted("gnss_offset") > 10, "{off} m");
    }
}

#[test]
fn the_map_of_another_place_is_named_and_never_believed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 37.0);
    let mut run = Run::new("cav1", Source::Map, &path);
    let drive = run.drive(
        0..60,
        |number| sweep(&street, &truth(0.1 * number as f64), number),
        |_, _| (),
    );
    assert!(run.out.counted("scan_unfit") + run.out.counted("scan_gate") > 20);
    let usable = drive.iter().filter(|(status, _)| status.is_usable());
    assert!(usable.clone().all(|(_, off)| *off < 3.0), "{drive:?}");
}

#[test]
fn sweeps_of_few_points_and_faults_of_sensors_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 0.0);
    let mut run = Run::new("cav1", Source::Map, &path);
    let cloud = |number: u64| match number % 40 {
        20 => PointCloud::empty(),
        21 => {
            let n = 50;
            PointCloud::new(
                vec![9.0; n],
                vec![1.0; n],
                vec![0.0; n],
                vec![0; n],
                vec![0; n],
                vec![0; n],
            )
            .unwrap()
        }
        _ => sweep(&street, &truth(0.1 * number as f64), number),
    };
    let drive = run.drive(0..80, cloud, |number, motion| match number {
        30 => motion.fixes[0].position[0] += 10.0,
        40..45 => motion
            .imu
            .iter_mut()
            .for_each(|sample| sample.specific_force[2] = -GRAVITY),
        50..55 => {
            let first = motion.imu[0];
            motion.imu.iter_mut().for_each(|sample| {
                (sample.angular_rate, sample.specific_force) = (first.angular_rate, first.specific_force);
            });
        }
        60 => motion.fixes[0].has_height = false,
        65 => motion.imu[3].angular_rate[0] = 50.0,
        70 => motion.fixes[0].position[0] = 7e5,
        _ => {}
    });
    let names = [
        "scan_few_points",
        "gnss_gate",
        "imu_gravity",
        "imu_stuck",
        "gnss_height_zero",
        "imu_saturated",
        "gnss_elsewhere",
    ];
    for name in names {
        assert!(run.out.counted(name) > 0, "{name}");
    }
    assert_eq!(run.out.counted("scan_few_points"), 4);
    assert!(
        drive[10..]
            .iter()
            .all(|(status, off)| !status.is_usable() || *off < 0.3),
        "{drive:?}"
    );
}

#[test]
fn gyroscopes_that_stand_still_or_turn_otherwise_than_sweeps_leave_the_estimate_to_the_map() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 0.0);
    for (is_stuck, counter) in [(true, "imu_stuck"), (false, "imu_excluded")] {
        let mut run = Run::new("cav1", Source::Map, &path);
        let drive = run.drive(
            0..90,
            |number| sweep(&street, &truth(0.1 * number as f64), number),
            |number, motion| {
                // 0.12 rad/s to the other side.
                let wrong = |sample: &mut ImuSample| match is_stuck {
                    true => sample.angular_rate = [0.0, 0.0, -TURN],
                    false => sample.angular_rate[2] -= 2.0 * TURN,
                };
                if number >= 30 {
                    motion.imu.iter_mut().for_each(wrong);
                }
            },
        );
        assert!(run.out.counted(counter) > 400, "{counter}");
        assert_eq!(run.out.counted("imu_track") > 0, !is_stuck);
        let usable = |(status, off): &(PoseStatus, f64)| status.is_usable() && *off < 0.3;
        assert!(drive[10..30].iter().chain(&drive[45..]).all(usable), "{drive:?}");
        assert!(
            drive[30..45]
                .iter()
                .all(|(status, off)| !status.is_usable() || *off < 0.5),
            "{drive:?}"
        );
        let found = run.out.into_made().counts.losses[counter].found.clone();
        let words: Vec<&str> = found.values().map(String::as_str).collect();
        let alone = "the angular rates of its gyroscopes, all or one axis";
        assert_eq!(words, if is_stuck { vec![alone] } else { vec![] });
    }
}

#[test]
fn an_agent_without_sensors_has_no_pose_and_says_so() {
    let mut run = Run::new("cav1", Source::Gnss, "".as_ref());
    for number in 0..5 {
        let (state, has_pose) = run.locate(number, PointCloud::empty(), &Isometry3::identity());
        assert_eq!((state.status, has_pose), (PoseStatus::Init, false));
    }
    assert_eq!([run.out.counted("no_motion"), run.out.counted("init")], [5, 5]);
}

#[test]
fn a_roadside_unit_is_localised_once_and_held() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.map");
    let street = street();
    map(&street, &path, 0.0);
    let place = Isometry3::new(
        truth(12.0).translation.vector + Vector3::new(1.5, -2.0, 0.0),
        Vector3::z() * 2.4,
    );
    let fixes = |number: u64| Motion {
        fixes: vec![GnssFix {
            position: std::array::from_fn(|axis| {
                place.translation.vector[axis] + 0.5 * noise(40 + axis as u64, number)
            }),
            ..motion(0, |_| ()).fixes[0]
        }],
        antenna: [0.0; 3],
        ..Motion::default()
    };
    for (source, file, limit) in [
        (Source::Map, path.as_path(), 0.05),
        (Source::Gnss, std::path::Path::new(""), 0.6),
    ] {
        let mut run = Run::new("rsu1", source, file);
        let mut last = None;
        for number in 0..60 {
            run.measure(number, fixes(number));
            let (state, _) = run.locate(number, sweep(&street, &place, number), &place);
            if number >= 50 {
                assert_eq!(state.status, PoseStatus::Tracking, "{source:?}");
                let off = state.map_from_body.translation.vector - place.translation.vector;
                let turned = state.map_from_body.rotation.angle_to(&place.rotation).to_degrees();
                assert!(off.norm() < limit && turned < 0.1, "{source:?} {off} {turned}");
                assert!(last.is_none_or(|last| last == state.map_from_body), "it is held");
                last = Some(state.map_from_body);
            }
        }
    }
}

#[test]
fn maps_that_are_none_are_refused_by_name() {
    let error = |source: Source, map: &str| {
        let settings = Settings {
            source,
            map: map.into(),
            ..Settings::default()
        };
        Localization::new(settings)
            .err()
            .map(|error| error.to_string())
            .unwrap_or_default()
    };
    assert!(error(Source::Map, "").contains("expected a file made by `realo map build`"));
    assert!(error(Source::Map, "/nowhere/a.map").contains("/nowhere/a.map"));
    assert!(error(Source::Gnss, "/nowhere/a.map").contains("source=map alone"));
    assert_eq!(error(Source::Gnss, ""), "");
}
