//! The agents: what carries a sensor, where it is, when it measures.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use realo_schemas::{EgoState, Name, Nanos, PoseStatus, from_seconds, to_seconds};

use crate::options::{AGENTS, EPOCH, Options, Phase, SWEEP_PERIOD};
use crate::path::Pose2;
use crate::place::Scenery;
use crate::random::Stream;
use crate::sensor::Sensor;
use crate::traffic::Traffic;

/// Height of the vehicles' sensors over the ground, m.
const VEHICLE_SENSOR: f64 = 1.9;
/// Height of the roadside units' sensors, m.
const ROADSIDE_SENSOR: f64 = 5.0;
/// From the body frame's origin (below the sensor) forward to the vehicle's middle, m.
pub(crate) const MIDDLE_AHEAD: f64 = 0.5;

/// What an agent is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AgentKind {
    /// Drives in the traffic.
    Vehicle,
    /// Stands on a pole.
    Roadside,
}

/// What a log says of an agent.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentInfo {
    /// Name.
    pub name: Name,
    /// What it is.
    pub kind: AgentKind,
    /// The vehicle's own extent in its body frame, [x min, x max, y min, y max], m.
    pub footprint: Option<[f64; 4]>,
    /// Height of the sensor over the body frame's origin, m.
    pub sensor_height: f64,
    /// Model of the sensor.
    pub sensor: &'static str,
    /// Track id of the vehicle in the truth of others.
    pub track: Option<u64>,
}

/// An agent of a simulation.
pub(crate) struct Agent {
    pub info: AgentInfo,
    /// Number in [`AGENTS`]; names its random streams.
    pub number: u64,
    pub sensor: &'static Sensor,
    /// The road user that carries it.
    pub user: Option<usize>,
    /// Where it stands, if nobody carries it: pose and height of the ground.
    stands: (Pose2, f64),
    /// Start of the first sweep after [`EPOCH`], ns.
    pub phase: Nanos,
}

/// The body frame's pose and motion in the place's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BodyState {
    pub position: [f64; 3],
    pub heading: f64,
    pub velocity: [f64; 3],
    pub turn_rate: f64,
    /// Slope of the carrier along and across its heading.
    pub slope: [f64; 2],
}

impl Agent {
    /// The agents that options ask for, in their fixed order.
    pub fn all(options: &Options, place: &Scenery, traffic: &Traffic) -> Vec<Agent> {
        let phases = phases(options);
        (0..AGENTS.len())
            .filter(|i| options.agents.iter().any(|name| name == AGENTS[*i]))
            .map(|i| Agent::new(i, phases[i], place, traffic))
            .collect()
    }

    fn new(number: usize, phase: Nanos, place: &Scenery, traffic: &Traffic) -> Agent {
        let vehicle = number < 2;
        let user = vehicle.then(|| traffic.cavs[number]);
        let sensor = match number {
            0 | 1 => Sensor::ruby_plus(),
            2 => Sensor::os1_128(),
            _ => Sensor::os1_64(),
        };
        let footprint = user.map(|user| {
            let [length, width, _] = traffic.users[user].size;
            [
                MIDDLE_AHEAD - length / 2.0,
                MIDDLE_AHEAD + length / 2.0,
                -width / 2.0,
                width / 2.0,
            ]
        });
        let info = AgentInfo {
            name: AGENTS[number].into(),
            kind: if vehicle {
                AgentKind::Vehicle
            } else {
                AgentKind::Roadside
            },
            footprint,
            sensor_height: if vehicle { VEHICLE_SENSOR } else { ROADSIDE_SENSOR },
            sensor: sensor.model,
            track: user.map(|user| traffic.users[user].track),
        };
        Agent {
            info,
            number: number as u64,
            sensor,
            user,
            stands: place.roadside(number == 3),
            phase,
        }
    }

    /// Start of a sweep, ns since the epoch.
    pub fn sweep_start(&self, seq: u64) -> Nanos {
        EPOCH + self.phase + seq as Nanos * SWEEP_PERIOD
    }

    /// The body frame `t` seconds after [`EPOCH`].
    pub fn body(&self, place: &Scenery, traffic: &Traffic, t: f64) -> BodyState {
        let Some(user) = self.user.map(|user| &traffic.users[user]) else {
            let (pose, z) = self.stands;
            let position = [pose.x, pose.y, z];
            return BodyState {
                position,
                heading: pose.heading,
                velocity: [0.0; 3],
                turn_rate: 0.0,
                slope: [0.0; 2],
            };
        };
        let state = user.course.at(t).expect("vehicles that carry agents stay in the place");
        let Pose2 { x, y, heading } = state.pose;
        let (sin, cos) = libm::sincos(heading);
        let (x, y) = (x - MIDDLE_AHEAD * cos, y - MIDDLE_AHEAD * sin);
        let aside = MIDDLE_AHEAD * state.turn_rate;
        let (vx, vy) = (state.speed * cos + aside * sin, state.speed * sin - aside * cos);
        let z = place.road_height(x, y);
        // The ground's height is smooth over a metre, not differentiable at the borders of its cells.
        let step = 0.02;
        let vz = (place.road_height(x + step * vx, y + step * vy) - place.road_height(x - step * vx, y - step * vy))
            / (2.0 * step);
        BodyState {
            position: [x, y, z],
            heading,
            velocity: [vx, vy, vz],
            turn_rate: state.turn_rate,
            slope: user.footing(place, &state).slope,
        }
    }
}

impl BodyState {
    /// The state as a message says it, exact.
    pub fn to_ego_state(self, place: &Scenery, map_offset: [f64; 2]) -> EgoState {
        let (sin, cos) = libm::sincos(place.heading);
        let turn = |x: f64, y: f64| (x * cos - y * sin, x * sin + y * cos);
        let (x, y) = turn(self.position[0], self.position[1]);
        let (vx, vy) = turn(self.velocity[0], self.velocity[1]);
        let rotation = rotation(0.0, 0.0, self.heading + place.heading);
        let translation = Translation3::new(x + map_offset[0], y + map_offset[1], self.position[2]);
        EgoState {
            map_from_body: Isometry3::from_parts(translation, rotation),
            covariance: None,
            velocity: Some(Vector3::new(vx, vy, self.velocity[2])),
            angular_rate: Some(Vector3::new(0.0, 0.0, self.turn_rate)),
            status: PoseStatus::Truth,
        }
    }
}

/// The rotation by yaw, then pitch, then roll, rad; with the same bits on every machine.
pub(crate) fn rotation(roll: f64, pitch: f64, yaw: f64) -> UnitQuaternion<f64> {
    let half = |angle: f64, axis: [f64; 3]| {
        let (sin, cos) = libm::sincos(0.5 * angle);
        UnitQuaternion::new_unchecked(Quaternion::new(cos, sin * axis[0], sin * axis[1], sin * axis[2]))
    };
    half(yaw, [0.0, 0.0, 1.0]) * half(pitch, [0.0, 1.0, 0.0]) * half(roll, [1.0, 0.0, 0.0])
}

/// Start of each agent's first sweep after [`EPOCH`], ns.
fn phases(options: &Options) -> [Nanos; 4] {
    let mut draws = Stream::new(options.seed, "phases", 0);
    match options.phase {
        Phase::Locked => [(); 4].map(|()| from_seconds(draws.between(0.0, 0.000_9))),
        Phase::Spread => {
            // Slots of 25 ms, each used within 8 ms: at least 17 ms apart, over the end of the period as well.
            let mut slots = [0.0, 0.025, 0.05, 0.075];
            for i in (1..4).rev() {
                slots.swap(i, draws.below(i + 1));
            }
            slots.map(|slot| from_seconds(slot + draws.between(0.0, 0.008)))
        }
    }
}

/// Seconds from [`EPOCH`] to a time.
pub(crate) fn since_epoch(stamp: Nanos) -> f64 {
    to_seconds(stamp - EPOCH)
}
