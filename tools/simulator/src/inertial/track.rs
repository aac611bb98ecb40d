//! The true motion of a vehicle's frame, smooth enough to be felt.

use nalgebra::{UnitQuaternion, Vector3};
use realo_schemas::{Nanos, to_seconds};
use realo_state_estimation::STANDARD_GRAVITY;

use crate::agents::{Agent, rotation, since_epoch};
use crate::cast::World;
use crate::options::POSE_PERIOD;

/// Time between the known states, ns.
const STEP: Nanos = 5_000_000;
/// Heights and slopes are means over so many states to each side.
const SPREAD: usize = 8;

/// The vehicle frame in the place's frame, every 5 ms.
pub(super) struct Track {
    /// Time of the first state.
    first: Nanos,
    states: Vec<(Vector3<f64>, UnitQuaternion<f64>)>,
}

/// Position, heading and slope of a body.
type Placed = ([f64; 3], f64, [f64; 2]);

impl Track {
    /// The track of a vehicle, from a sample's period before `first` to one after `count` of them.
    pub fn new(world: &World, agent: &Agent, first: Nanos, count: Nanos) -> Self {
        let begin = first - 2 * POSE_PERIOD;
        let states = ((count + 4) * POSE_PERIOD / STEP + 1) as usize;
        let margin = SPREAD as Nanos * STEP;
        let raw = (0..states + 2 * SPREAD).map(|k| {
            let t = since_epoch(begin - margin + k as Nanos * STEP);
            let body = agent.body(world.place, world.traffic, t);
            (body.position, body.heading, body.slope)
        });
        let raw: Vec<Placed> = raw.collect();
        let smooth = |k: usize| {
            let around = &raw[k..=k + 2 * SPREAD];
            let mean = |of: fn(&Placed) -> f64| around.iter().map(of).sum::<f64>() / around.len() as f64;
            let ([x, y, _], heading, _) = raw[k + SPREAD];
            let (z, along, across) = (mean(|s| s.0[2]), mean(|s| s.2[0]), mean(|s| s.2[1]));
            // Nose and left side up are a pitch below 0 and a roll above 0.
            let pitch = -libm::atan(along);
            let roll = libm::atan(across * libm::cos(pitch));
            (Vector3::new(x, y, z), rotation(roll, pitch, heading))
        };
        Track {
            first: begin,
            states: (0..states).map(smooth).collect(),
        }
    }

    fn state(&self, time: Nanos) -> &(Vector3<f64>, UnitQuaternion<f64>) {
        let at = ((time - self.first) as f64 / STEP as f64).round().max(0.0) as usize;
        &self.states[at.min(self.states.len() - 1)]
    }

    /// Where a point of the vehicle frame is in the place's frame, at the nearest known state.
    pub fn place(&self, time: Nanos, point: [f64; 3]) -> [f64; 3] {
        let (position, rotation) = self.state(time);
        (position + rotation * Vector3::from(point)).into()
    }

    /// Velocity of a point, over the 10 ms around a time.
    fn velocity(&self, time: Nanos, point: [f64; 3]) -> Vector3<f64> {
        let [before, after] = [time - STEP, time + STEP].map(|time| Vector3::from(self.place(time, point)));
        (after - before) / to_seconds(2 * STEP)
    }

    /// Where a point is, how fast it moves, and how the vehicle is turned, in the place's frame.
    #[cfg(test)]
    pub fn motion(&self, time: Nanos, point: [f64; 3]) -> (Vector3<f64>, Vector3<f64>, UnitQuaternion<f64>) {
        let place = Vector3::from(self.place(time, point));
        (place, self.velocity(time, point), self.state(time).1)
    }

    /// Mean angular rate and specific force of a point over the period that ends at a time, along the axes of the vehicle
    /// frame in its middle.
    pub fn inertial(&self, time: Nanos, point: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let dt = to_seconds(POSE_PERIOD);
        let before = time - POSE_PERIOD;
        let (from, to) = (self.state(before).1, self.state(time).1);
        let turned = (from.inverse() * to).scaled_axis();
        let middle = from * UnitQuaternion::from_scaled_axis(0.5 * turned);
        let acceleration = (self.velocity(time, point) - self.velocity(before, point)) / dt;
        let force = middle.inverse() * (acceleration + Vector3::new(0.0, 0.0, STANDARD_GRAVITY));
        ((turned / dt).into(), force.into())
    }
}

/// A vector of the plane turned by an angle.
pub(super) fn turn(angle: f64, [x, y]: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = libm::sincos(angle);
    [x * cos - y * sin, x * sin + y * cos]
}
