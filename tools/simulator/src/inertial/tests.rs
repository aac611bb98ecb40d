use nalgebra::{UnitQuaternion, Vector3};
use realo_logs::MapOrigin;

use super::errors::{Bias, Multipath, Wandering};
use super::track::Track;
use super::*;
use crate::cast::World;
use crate::place::Scenery;
use crate::traffic::{Demand, Traffic};
use crate::{Scenario, Simulation};
use realo_state_estimation::{STANDARD_GRAVITY as GRAVITY, Unit};

fn options(scenario: Scenario, seconds: f64) -> Options {
    Options {
        scenario,
        seed: 3,
        seconds,
        agents: ["cav1", "rsu1"].map(String::from).to_vec(),
        vehicle_sensors: vec![crate::Sensor::named("pandar40p").unwrap()],
        clouds: false,
        inertial: Some(MotionUnit::Tactical),
        ..Options::default()
    }
}

/// Calls with a world of these options, and the vehicle.
fn with_world<T>(options: &Options, call: impl FnOnce(&World, &Agent) -> T) -> T {
    let place = Scenery::new(options.scenario, options.seed);
    let demand = Demand {
        place: &place,
        seed: options.seed,
        dense: false,
        seconds: options.seconds,
        rounded_bodies: false,
    };
    let traffic = Traffic::new(&demand).unwrap();
    let agents = Agent::all(options, &place, &traffic).unwrap();
    let world = World {
        place: &place,
        traffic: &traffic,
    };
    call(&world, &agents[0])
}

/// Position, velocity and attitude after integrating readings from a true start, as a strapdown unit is mechanised.
fn mechanise(
    readings: &[Timed<ImuReading>],
    (mut position, mut velocity, mut attitude): (Vector3<f64>, Vector3<f64>, UnitQuaternion<f64>),
) -> (Vector3<f64>, Vector3<f64>, UnitQuaternion<f64>) {
    let dt = 1e-9 * POSE_PERIOD as f64;
    for (.., reading) in readings {
        let turned = Vector3::from(reading.angular_rate) * dt;
        let middle = attitude * UnitQuaternion::from_scaled_axis(0.5 * turned);
        let before = velocity;
        let force = Vector3::from(reading.specific_force);
        velocity += (middle * force - Vector3::new(0.0, 0.0, GRAVITY)) * dt;
        position += 0.5 * (before + velocity) * dt;
        attitude *= UnitQuaternion::from_scaled_axis(turned);
    }
    (position, velocity, attitude)
}

#[test]
fn samples_integrate_to_the_true_path() {
    let options = options(Scenario::Loop, 14.0);
    with_world(&options, |world, agent| {
        let first = agent.sweep_start(0) - SWEEP_PERIOD;
        let track = Track::new(world, agent, first, 1_420);
        let point = [0.5, 0.0, UNIT_HEIGHT];
        let state = |k: usize| {
            let time = first + k as Nanos * POSE_PERIOD;
            track.motion(time, point)
        };
        let exact = Options {
            exact_motion: true,
            ..options.clone()
        };
        let measured = |options: &Options, unit| measure(world, agent, options, unit).imu;
        let driven = (state(1_100).0 - state(100).0).norm();
        assert!(driven > 15.0, "the car has to drive, and went {driven} m");
        let off = |readings: &[Timed<ImuReading>]| {
            let (position, velocity, attitude) = mechanise(&readings[100..1_100], state(100));
            let (there, speed, turned) = state(1_100);
            [
                (position - there).norm(),
                (velocity - speed).norm(),
                attitude.angle_to(&turned),
            ]
        };
        // Without errors 10 s lead to the place: the rest is what ten milliseconds leave open.
        let [far, slow, turned] = off(&measured(&exact, MotionUnit::Tactical));
        assert!(
            far < 0.01 && slow < 1e-6 && turned < 1e-8,
            "{far} m, {slow} m/s, {turned} rad"
        );
        // With errors, what their biases make of 10 s, within four standard deviations.
        for unit in [MotionUnit::Tactical, MotionUnit::Consumer] {
            let (rate, force) = (unit.gyroscopes(), unit.accelerometers());
            let tilt = (rate.turn_on + rate.in_run) * 10.0 + rate.white * 10f64.sqrt() + rate.scale * 3.2;
            let pull = force.turn_on + force.in_run + force.scale * GRAVITY + GRAVITY * tilt / 3.0;
            let bound = 4.0 * 3f64.sqrt() * (0.5 * pull * 100.0 + force.white * 10f64.powf(1.5));
            let [far, _, turned] = off(&measured(&options, unit));
            assert!(far < bound && far > 0.005, "{}: {far} m of {bound}", unit.name());
            assert!(
                turned < 4.0 * 3f64.sqrt() * tilt,
                "{}: {turned} rad of {tilt}",
                unit.name()
            );
        }
    });
}

#[test]
fn the_vehicle_frame_follows_the_true_body() {
    let options = options(Scenario::Junction, 6.0);
    with_world(&options, |world, agent| {
        let first = agent.sweep_start(0) - SWEEP_PERIOD;
        let track = Track::new(world, agent, first, 600);
        for k in 0..=600 {
            let time = first + k * POSE_PERIOD;
            let body = agent.body(world.place, world.traffic, since_epoch(time));
            let [x, y, z] = track.place(time, [0.0; 3]);
            let [dx, dy, dz] = [x - body.position[0], y - body.position[1], z - body.position[2]];
            assert!(dx == 0.0 && dy == 0.0 && dz.abs() < 1e-2, "{dx} {dy} {dz}");
        }
    });
}

fn deviation(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

#[test]
fn positions_scatter_as_they_should() {
    let receiver = Unit::Tactical.receiver();
    let mut errors = Wandering::new(&receiver, Stream::new(1, "fixes", 0), false);
    let all: Vec<[f64; 3]> = (0..400_000).map(|_| errors.next()).collect();
    for (axis, expected) in receiver.deviation_m.into_iter().enumerate() {
        let along: Vec<f64> = all.iter().map(|error| error[axis]).collect();
        let found = deviation(&along);
        // 40,000 s are 400 times of correlation.
        assert!((found / expected - 1.0).abs() < 0.1, "axis {axis}: {found}");
        let lagged = |lag: usize| {
            let pairs = along.iter().zip(&along[lag..]);
            pairs.map(|(a, b)| a * b).sum::<f64>() / (along.len() - lag) as f64 / (found * found)
        };
        // Most of the variance is still there after 1 s, a third of that after 100 s.
        assert!((lagged(10) - 0.693).abs() < 0.06, "axis {axis}: {}", lagged(10));
        assert!(
            (lagged(1_000) - 0.7 / std::f64::consts::E).abs() < 0.12,
            "axis {axis}: {}",
            lagged(1_000)
        );
    }
}

#[test]
fn jumps_are_there_between_buildings_a_third_of_the_time() {
    let receiver = MotionUnit::Tactical.receiver();
    let mut multipath = Multipath::new(receiver, Stream::new(1, "multipath", 0), false);
    let narrow: Vec<[f64; 3]> = (0..100_000).map(|_| multipath.next(Sky::Narrow)).collect();
    let jumped = narrow.iter().filter(|jump| **jump != [0.0; 3]).count() as f64 / 1e5;
    assert!((jumped - 1.0 / 3.0).abs() < 0.04, "{jumped}");
    let steps = narrow.array_windows().filter(|[a, b]| a != b).count();
    assert!((1_300..2_000).contains(&steps), "{steps} steps in 10,000 s");
    assert!((0..1_000).all(|_| multipath.next(Sky::Open) == [0.0; 3]));
}

#[test]
fn biases_and_noise_are_those_of_the_unit() {
    let of = MotionUnit::Consumer.gyroscopes();
    let readings = |seed: u64, count: usize| -> Vec<f64> {
        let mut bias = Bias::new(of, Stream::new(seed, "gyroscopes", 0), false);
        (0..count).map(|_| bias.next([0.0; 3])[2]).collect()
    };
    let all = readings(1, 6_000);
    let steps: Vec<f64> = all.array_windows().map(|[a, b]| (b - a) / 2f64.sqrt()).collect();
    assert!((deviation(&steps) / (10.0 * of.white) - 1.0).abs() < 0.05);
    let means: Vec<f64> = (0..200)
        .map(|seed| readings(seed, 100).iter().sum::<f64>() / 100.0)
        .collect();
    assert!(
        (deviation(&means) / of.turn_on - 1.0).abs() < 0.15,
        "{}",
        deviation(&means)
    );
    let mut bias = Bias::new(of, Stream::new(1, "gyroscopes", 0), false);
    assert_eq!(bias.next([1e3; 3]), [of.range; 3], "readings end at the range");
}

#[test]
fn a_drive_round_the_block_stops_and_loses_its_position_for_twenty_seconds() {
    let simulation = Simulation::new(&options(Scenario::Loop, 110.0)).unwrap();
    let record = simulation.motion("cav1").unwrap();
    assert_eq!(
        (record.imu.len(), record.fixes.len(), record.wheels.len()),
        (11_020, 1_103, 5_511)
    );
    let mut longest = 0;
    let mut silent = 0;
    for (.., fix) in &record.fixes {
        silent = if fix.quality.is_none() { silent + 1 } else { 0 };
        longest = longest.max(silent);
    }
    assert!(longest >= 200, "the longest outage takes {longest} positions");
    let stopped = record
        .wheels
        .iter()
        .filter(|(.., wheels)| wheels.velocity[0] == 0.0)
        .count();
    assert!(stopped > 25, "it stands for {stopped} speeds");
    let poses = simulation.poses("cav1").unwrap();
    let still = |stamp: Nanos| {
        let pose = poses.iter().find(|pose| pose.stamp == stamp).unwrap();
        pose.truth.velocity.unwrap().norm() < 1e-9
    };
    let standing: Vec<f64> = record
        .wheels
        .iter()
        .filter(|(stamp, ..)| still(*stamp))
        .map(|(.., w)| w.velocity[0])
        .collect();
    assert!(
        !standing.is_empty() && standing.iter().all(|speed| *speed == 0.0),
        "wheels that stand read 0"
    );
    // Where it has one, its position is the truth within what the receiver says.
    let origin = MapOrigin::new(MAP_ORIGIN).unwrap();
    let off: Vec<f64> = record
        .fixes
        .iter()
        .filter(|(.., fix)| fix.quality.is_some())
        .map(|(stamp, _, fix)| {
            let pose = poses.iter().min_by_key(|pose| pose.stamp.abs_diff(*stamp)).unwrap();
            let place = origin.to_map(fix.geodetic);
            let truth = pose.truth.map_from_body * nalgebra::Point3::new(-ANTENNA_BEHIND, 0.0, ROOF);
            (place[0] - truth.x).hypot(place[1] - truth.y)
        })
        .collect();
    let mut sorted = off.clone();
    sorted.sort_by(f64::total_cmp);
    assert!(
        sorted[sorted.len() / 2] < 5.0 && sorted[sorted.len() - 1] < 40.0,
        "{:?}",
        sorted.last()
    );
    // A roadside unit has a receiver alone.
    let unit = simulation.motion("rsu1").unwrap();
    assert!(unit.imu.is_empty() && unit.wheels.is_empty() && unit.fixes.len() == 1_103);
}

#[test]
fn another_day_has_the_same_houses_and_route_and_other_traffic_and_foliage() {
    let on = |day: u64| Options {
        day,
        ..options(Scenario::Loop, 20.0)
    };
    let [place, other] = [0, 2].map(|day| Scenery::new(Scenario::Loop, 3).on_day(day));
    let fixtures = |place: &Scenery| {
        place
            .fixtures
            .iter()
            .map(|fixture| (fixture.pose, fixture.z))
            .collect::<Vec<_>>()
    };
    assert_eq!(fixtures(&place), fixtures(&other));
    assert!(other.foliage.len() < place.foliage.len() && other.foliage.len() > place.foliage.len() * 8 / 10);
    let [first, second] = [0, 2].map(|day| Simulation::new(&on(day)).unwrap());
    assert_eq!((first.place(), second.asked().seed), (second.place(), 3));
    let parked = |simulation: &Simulation| {
        let (sweep, _) = simulation.sweep(0, 0);
        sweep
            .truth
            .iter()
            .filter(|object| object.velocity == Some([0.0; 3]))
            .count()
    };
    assert_ne!(parked(&first), parked(&second));
    let motion = |simulation: &Simulation| simulation.motion("cav1").unwrap().imu[50].2;
    assert_ne!(motion(&first), motion(&second));
    // Both days it goes along the same streets: every place of one is near one of the other, where they overlap.
    let network = place.network();
    for simulation in [&first, &second] {
        for pose in simulation.poses("cav1").unwrap().iter().step_by(100) {
            let at = pose.truth.map_from_body.translation;
            let [x, y] = super::track::turn(-place.heading, [at.x, at.y]);
            assert!(network.surface.off_road(x, y) < 0.0, "({x}, {y}) is off the road");
        }
    }
}

#[test]
fn everything_is_drawn_from_the_options_alone() {
    let of = |unit| {
        let simulation = Simulation::new(&Options {
            inertial: unit,
            ..options(Scenario::Junction, 2.0)
        });
        simulation.unwrap()
    };
    let tactical = Some(MotionUnit::Tactical);
    assert_eq!(of(tactical).motion("cav1"), of(tactical).motion("cav1"));
    assert_eq!(of(None).motion("cav1"), None);
    assert_eq!(of(tactical).motion("cav2"), None, "it does not record");
    // Who measures does not change what is there.
    assert_eq!(of(None).poses("cav1"), of(tactical).poses("cav1"));
    assert_eq!(of(None).sweep(0, 3).0, of(tactical).sweep(0, 3).0);
}
