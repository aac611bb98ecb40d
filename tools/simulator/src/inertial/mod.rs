//! Motion sensors: what inertial unit, satellite receiver and wheels of an agent measure of its true motion.
//!
//! The vehicle frame leans with the carrier: pitch and roll follow the ground's slope and the springs, the origin stays that
//! of the body frame. The unit feels the vertical motion and the leaning as means over 80 ms, as tyres and springs give them;
//! the rest is the motion of the true poses, to less than 1 cm. A sample is the mean over the 10 ms that end at its stamp.

mod errors;
mod track;

use nalgebra::Isometry3;
use realo_logs::{FixReading, ImuReading, MapOrigin, WheelReading};
use realo_schemas::{Nanos, from_seconds};
use realo_state_estimation::Wheels;

use crate::agents::{Agent, AgentKind, since_epoch};
use crate::cast::World;
use crate::options::{Options, POSE_PERIOD, SWEEP_PERIOD};
use crate::random::Stream;
use errors::{Bias, Multipath, Wandering};
pub use realo_state_estimation::Unit as MotionUnit;
use track::{Track, turn};

/// Where the map of every simulation has its origin: latitude and longitude, degrees, and height over the ellipsoid, m.
pub const MAP_ORIGIN: [f64; 3] = [48.0, 11.0, 500.0];

/// Time from one position of a receiver to the next, and of the wheels' speeds, ns.
pub const FIX_PERIOD: Nanos = 100_000_000;
/// Time from one speed of the wheels to the next, ns.
pub const WHEEL_PERIOD: Nanos = 20_000_000;

/// A reading with its true time and the time at which it arrives.
pub type Timed<T> = (Nanos, Nanos, T);

/// What an agent's motion sensors measure during a log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MotionRecord {
    /// 100 a second; none of a roadside unit.
    pub imu: Vec<Timed<ImuReading>>,
    /// 10 a second.
    pub fixes: Vec<Timed<FixReading>>,
    /// 50 a second; none of a roadside unit.
    pub wheels: Vec<Timed<WheelReading>>,
    /// How the unit lies in the vehicle frame.
    pub imu_mount: Isometry3<f64>,
    /// Where the antenna is in the vehicle frame.
    pub antenna: Isometry3<f64>,
    /// Where the axle is in the vehicle frame: the point that never moves aside.
    pub axle: Isometry3<f64>,
}

/// What the sky over an agent is like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sky {
    Open,
    /// Between buildings: signals come by detours.
    Narrow,
    /// Too little of it for a position.
    Hidden,
}

/// Height of the inertial unit over the ground, and of the antenna on the roof, m.
const UNIT_HEIGHT: f64 = 0.4;
const ROOF: f64 = 1.55;
/// The antenna is so far behind the body frame's origin, m.
const ANTENNA_BEHIND: f64 = 0.3;

/// Measures an agent's motion by a unit's errors, from a period before its first sweep until one after the last.
pub(crate) fn measure(world: &World, agent: &Agent, options: &Options, unit: MotionUnit) -> MotionRecord {
    let per_sweep = SWEEP_PERIOD / POSE_PERIOD;
    let count = (options.sweeps_per_agent() as Nanos + 2) * per_sweep;
    let first = agent.sweep_start(0) - SWEEP_PERIOD;
    let drives = agent.info.kind == AgentKind::Vehicle;
    let mut record = MotionRecord {
        antenna: Isometry3::translation(-ANTENNA_BEHIND, 0.0, ROOF),
        ..MotionRecord::default()
    };
    if !drives {
        record.antenna = Isometry3::translation(0.0, 0.0, agent.info.sensor_height);
        let place = |_: Nanos| agent.body(world.place, world.traffic, 0.0).position;
        record.fixes = fixes(world, agent, options, unit, (first, count), |stamp| {
            let [x, y, z] = place(stamp);
            [x, y, z + agent.info.sensor_height]
        });
        return record;
    }
    let ahead = crate::agents::MIDDLE_AHEAD;
    record.imu_mount = Isometry3::translation(ahead, 0.0, UNIT_HEIGHT);
    record.axle = Isometry3::translation(ahead, 0.0, 0.0);
    let track = Track::new(world, agent, first, count);
    record.imu = imu(&track, agent, options, unit, [ahead, 0.0, UNIT_HEIGHT], (first, count));
    record.wheels = wheels(world, agent, options, unit.wheels(), (first, count));
    let antenna = record.antenna.translation.vector.into();
    record.fixes = fixes(world, agent, options, unit, (first, count), |stamp| {
        track.place(stamp, antenna)
    });
    record
}

/// When something measured at a time arrives.
fn arrival(stamp: Nanos, latency_ms: [f64; 2], draws: &mut Stream) -> Nanos {
    stamp + from_seconds(1e-3 * draws.between(latency_ms[0], latency_ms[1]))
}

fn imu(
    track: &Track,
    agent: &Agent,
    options: &Options,
    unit: MotionUnit,
    at: [f64; 3],
    (first, count): (Nanos, Nanos),
) -> Vec<Timed<ImuReading>> {
    let (gyroscopes, accelerometers) = (unit.gyroscopes(), unit.accelerometers());
    let stream = |name| Stream::new(options.seed, name, agent.number);
    let mut rates = Bias::new(gyroscopes, stream("gyroscopes"), options.exact_motion);
    let mut forces = Bias::new(accelerometers, stream("accelerometers"), options.exact_motion);
    let mut latency = stream("imu_latency");
    let variance = [gyroscopes, accelerometers].map(|of| of.white * of.white * errors::IMU_HZ);
    let sample = |k: Nanos| {
        let stamp = first + k * POSE_PERIOD;
        let (rate, force) = track.inertial(stamp, at);
        let reading = ImuReading {
            angular_rate: rates.next(rate),
            specific_force: forces.next(force),
            variance: Some(variance),
        };
        (stamp, arrival(stamp, MotionUnit::IMU_LATENCY_MS, &mut latency), reading)
    };
    (1..=count).map(sample).collect()
}

fn wheels(
    world: &World,
    agent: &Agent,
    options: &Options,
    of: Wheels,
    (first, count): (Nanos, Nanos),
) -> Vec<Timed<WheelReading>> {
    let mut draws = Stream::new(options.seed, "wheels", agent.number);
    let exact = options.exact_motion;
    let scale = if exact { 1.0 } else { 1.0 + of.scale * draws.normal() };
    let every = WHEEL_PERIOD / POSE_PERIOD;
    let sample = |k: Nanos| {
        let stamp = first + k * WHEEL_PERIOD;
        let speed = agent.speed(world.place, world.traffic, since_epoch(stamp));
        let noise = if exact { 0.0 } else { of.noise * draws.normal() };
        // Wheels that stand give no pulses.
        let read = if speed.abs() < of.stops {
            0.0
        } else {
            scale * speed + noise
        };
        let reading = WheelReading {
            velocity: [read, 0.0, 0.0],
            variance: Some(of.noise * of.noise),
        };
        (stamp, arrival(stamp, of.latency_ms, &mut draws), reading)
    };
    (0..=count / every).map(sample).collect()
}

/// Positions of an antenna whose place in the place's frame is known at each time.
fn fixes(
    world: &World,
    agent: &Agent,
    options: &Options,
    unit: MotionUnit,
    (first, count): (Nanos, Nanos),
    place: impl Fn(Nanos) -> [f64; 3],
) -> Vec<Timed<FixReading>> {
    let receiver = unit.receiver();
    let draws = |name| Stream::new(options.seed, name, agent.number);
    let mut wandering = Wandering::new(&receiver, draws("fixes"), options.exact_motion);
    let mut multipath = Multipath::new(receiver, draws("multipath"), options.exact_motion);
    let mut latency = draws("fix_latency");
    let origin = MapOrigin::new(MAP_ORIGIN).expect("the origin is on the Earth");
    let sample = |k: Nanos| {
        let stamp = first + k * FIX_PERIOD;
        let at = place(stamp);
        let sky = world.place.sky(at[0], at[1]);
        let (error, jump) = (wandering.next(), multipath.next(sky));
        let [x, y, z] = into_map(world, options, at);
        let off: [f64; 3] = std::array::from_fn(|axis| error[axis] + jump[axis]);
        let wider = if sky == Sky::Open {
            1.0
        } else {
            receiver.between_buildings
        };
        let [east, north, up] = receiver
            .deviation_m
            .map(|deviation| (wider * deviation) * (wider * deviation));
        let reading = match sky {
            Sky::Hidden => FixReading {
                quality: None,
                geodetic: [f64::NAN; 3],
                covariance: None,
            },
            Sky::Open | Sky::Narrow => FixReading {
                quality: Some(receiver.quality),
                geodetic: origin.from_map([x + off[0], y + off[1], z + off[2]]),
                covariance: Some([east, 0.0, 0.0, 0.0, north, 0.0, 0.0, 0.0, up]),
            },
        };
        (stamp, arrival(stamp, receiver.latency_ms, &mut latency), reading)
    };
    (0..=count * POSE_PERIOD / FIX_PERIOD).map(sample).collect()
}

/// A point of the place in `map`.
fn into_map(world: &World, options: &Options, [x, y, z]: [f64; 3]) -> [f64; 3] {
    let [x, y] = turn(world.place.heading, [x, y]);
    [x + options.map_offset_m[0], y + options.map_offset_m[1], z]
}

#[cfg(test)]
mod tests;
