//! The agents: what carries a sensor, where it is, when it measures.

mod carriers;
mod sway;

use std::sync::Arc;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use realo_schemas::{AgentState, Name, Nanos, PoseStatus, from_seconds, to_seconds};

use crate::options::{EPOCH, Error, Options, SWEEP_PERIOD, agent_of};
use crate::path::{Pose2, State};
use crate::place::Scenery;
use crate::random::Stream;
use crate::sensor::{Mount, Sensor};
use crate::traffic::{Traffic, User};
use carriers::{Carrier, cars, late_phase, phases, stands};
use sway::Sway;

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
    pub sensor: Name,
    /// Track id of the vehicle in the truth of others.
    pub track: Option<u64>,
}

/// An agent of a simulation.
pub(crate) struct Agent {
    pub info: AgentInfo,
    /// Names its random streams; 0 to 3 for the first two vehicles and roadside units.
    pub number: u64,
    pub sensor: Arc<Sensor>,
    /// Where its sensor is mounted; the sensor's own, or that of the agent's kind.
    pub mount: Mount,
    /// Roll and pitch of the sensor that nobody knows of, rad.
    pub misalignment: [f64; 2],
    /// What the carrier's springs do, if it has any.
    sway: Option<Sway>,
    /// The road user that carries it.
    pub user: Option<usize>,
    /// Where it stands, if nobody carries it: pose and height of the ground.
    stands: Option<(Pose2, f64)>,
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

/// The sensor of an agent: the options' in turn, else what its kind usually has.
fn sensor_of(options: &Options, vehicle: bool, of_kind: usize) -> Arc<Sensor> {
    let own = if vehicle {
        &options.vehicle_sensors
    } else {
        &options.roadside_sensors
    };
    match (own.is_empty(), vehicle, of_kind % 2) {
        (false, ..) => own[of_kind % own.len()].clone(),
        (_, true, _) => Sensor::ruby_plus(),
        (_, _, 0) => Sensor::os1_128(),
        _ => Sensor::os1_64(),
    }
}

impl Agent {
    /// The agents that options ask for: vehicles, then roadside units, by number.
    ///
    /// # Errors
    /// [`Error::NoCar`], [`Error::NoStand`].
    pub fn all(options: &Options, place: &Scenery, traffic: &Traffic) -> Result<Vec<Agent>, Error> {
        let mut wanted: Vec<(bool, usize)> = options.agents.iter().filter_map(|name| agent_of(name)).collect();
        wanted.sort_by_key(|(vehicle, number)| (!vehicle, *number));
        let most = |kind: bool| {
            wanted
                .iter()
                .filter(|(vehicle, _)| *vehicle == kind)
                .map(|(_, k)| k + 1)
                .max()
        };
        let cars = cars(traffic, options.seconds, most(true).unwrap_or(0));
        let stands = stands(place, most(false).unwrap_or(0));
        let phases = phases(options);
        let agent = |(vehicle, number): (bool, usize)| {
            let name = format!("{}{}", if vehicle { "cav" } else { "rsu" }, number + 1);
            let carrier = match vehicle {
                true => cars.get(number).map(|car| Carrier::Car(*car)),
                false => stands.get(number).map(|stand| Carrier::Stand(*stand)),
            };
            let found = cars.len();
            let missing = || match vehicle {
                true => Error::NoCar {
                    name: name.clone(),
                    found,
                },
                false => Error::NoStand { name: name.clone() },
            };
            let carrier = carrier.ok_or_else(missing)?;
            // The first four keep the numbers of their streams.
            let stream = match (vehicle, number) {
                (true, 0 | 1) => number,
                (false, 0 | 1) => number + 2,
                (true, _) => 100 + number,
                (false, _) => 200 + number,
            };
            let own = options.sweep_phase_ms.get(&name);
            let drawn = || {
                phases
                    .get(stream)
                    .copied()
                    .unwrap_or_else(|| late_phase(options, stream))
            };
            let phase = own.map_or_else(drawn, |ms| from_seconds(1e-3 * ms));
            Ok(Agent::new(options, (&name, number, stream), phase, carrier, traffic))
        };
        wanted.into_iter().map(agent).collect()
    }

    fn new(
        options: &Options,
        (name, of_kind, stream): (&str, usize, usize),
        phase: Nanos,
        carrier: Carrier,
        traffic: &Traffic,
    ) -> Agent {
        let (user, stands) = match carrier {
            Carrier::Car(user) => (Some(user), None),
            Carrier::Stand(stand) => (None, Some(stand)),
        };
        let vehicle = user.is_some();
        let sensor = sensor_of(options, vehicle, of_kind);
        let mount = sensor.mount.unwrap_or(Mount {
            height: if vehicle { VEHICLE_SENSOR } else { ROADSIDE_SENSOR },
            pitch: 0.0,
            roll: 0.0,
            yaw: 0.0,
            misalignment: 0.0,
        });
        let mut draws = Stream::new(options.seed, "mount", stream as u64);
        let misalignment = [draws.normal(), draws.normal()].map(|v| mount.misalignment * v.clamp(-3.0, 3.0));
        let sway = (vehicle && sensor.mount.is_some()).then(|| Sway::new(&mut draws));
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
            name: name.into(),
            kind: if vehicle {
                AgentKind::Vehicle
            } else {
                AgentKind::Roadside
            },
            footprint,
            sensor_height: mount.height,
            sensor: sensor.model.clone(),
            track: user.map(|user| traffic.users[user].track),
        };
        Agent {
            info,
            number: stream as u64,
            sensor,
            mount,
            misalignment,
            sway,
            user,
            stands,
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
            let (pose, z) = self.stands.expect("who is not carried stands");
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
            slope: self.leaning(user.footing(place, &state).slope, user, &state, t),
        }
    }

    /// How fast the carrier rolls ahead `t` seconds after [`EPOCH`], along the road, m/s; 0 of who stands on a pole.
    pub fn speed(&self, place: &Scenery, traffic: &Traffic, t: f64) -> f64 {
        let user = self.user.map(|user| &traffic.users[user]);
        user.and_then(|user| Some((user, user.course.at(t)?)))
            .map_or(0.0, |(user, state)| {
                let [along, _] = user.footing(place, &state).slope;
                state.speed * (1.0 + along * along).sqrt()
            })
    }

    /// The slope of the carrier on its springs: the ground's, and what braking, bends and the road's roughness add.
    fn leaning(&self, ground: [f64; 2], user: &User, state: &State, t: f64) -> [f64; 2] {
        let Some(sway) = &self.sway else { return ground };
        const STEP: f64 = 0.1;
        let speed = |t: f64| user.course.at(t).map_or(state.speed, |state| state.speed);
        let acceleration = (speed(t + STEP) - speed(t - STEP)) / (2.0 * STEP);
        let (pitch, roll) = sway.at(t, state.speed, acceleration, state.speed * state.turn_rate);
        [ground[0] + pitch, ground[1] + roll]
    }
}

impl BodyState {
    /// The state as a message says it, exact.
    pub fn to_agent_state(self, place: &Scenery, map_offset: [f64; 2]) -> AgentState {
        let (sin, cos) = libm::sincos(place.heading);
        let turn = |x: f64, y: f64| (x * cos - y * sin, x * sin + y * cos);
        let (x, y) = turn(self.position[0], self.position[1]);
        let (vx, vy) = turn(self.velocity[0], self.velocity[1]);
        let rotation = rotation(0.0, 0.0, self.heading + place.heading);
        let translation = Translation3::new(x + map_offset[0], y + map_offset[1], self.position[2]);
        AgentState {
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

/// Seconds from [`EPOCH`] to a time.
pub(crate) fn since_epoch(stamp: Nanos) -> f64 {
    to_seconds(stamp - EPOCH)
}
