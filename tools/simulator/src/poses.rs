//! What agents believe of their own poses: the truth and the errors of a GNSS/INS.

use nalgebra::{Isometry3, Translation3, Vector3};
use realo_schemas::{AgentState, Nanos, PoseStatus};

use crate::agents::{Agent, AgentKind, rotation, since_epoch};
use crate::cast::World;
use crate::options::{Options, POSE_PERIOD, SWEEP_PERIOD};
use crate::random::Stream;

/// An agent's pose at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseSample {
    /// When.
    pub stamp: Nanos,
    /// Where the agent is.
    pub truth: AgentState,
    /// Where it believes to be; with covariance.
    pub believed: AgentState,
}

/// 100 poses a second, from a period before the first sweep until a period after the last, one at the start, the
/// middle and the end of each sweep.
pub(crate) fn poses(world: &World, agent: &Agent, options: &Options) -> Vec<PoseSample> {
    let per_sweep = SWEEP_PERIOD / POSE_PERIOD;
    let count = (options.sweeps_per_agent() as Nanos + 2) * per_sweep;
    let first = agent.sweep_start(0) - SWEEP_PERIOD;
    let mut errors = Errors::new(options, agent);
    (0..=count)
        .map(|k| {
            let stamp = first + k * POSE_PERIOD;
            let body = agent.body(world.place, world.traffic, since_epoch(stamp));
            let truth = body.to_agent_state(world.place, options.map_offset_m);
            let believed = errors.next(&truth, body.heading + world.place.heading);
            PoseSample { stamp, truth, believed }
        })
        .collect()
}

/// The walk of an agent's errors.
struct Errors {
    draws: Stream,
    /// Biases of x, y, z, roll, pitch, yaw; m, rad.
    bias: [f64; 6],
    deviation: [f64; 6],
    /// What is left of a bias after a period; 1 for a survey.
    keep: [f64; 6],
    white: [f64; 6],
    velocity: f64,
    rate: f64,
}

impl Errors {
    fn new(options: &Options, agent: &Agent) -> Self {
        let noise = &options.pose_noise;
        let [x, y, z] = noise.position_bias_m;
        let (tilt, heading) = (noise.tilt_bias_deg.to_radians(), noise.heading_bias_deg.to_radians());
        let deviation = [x, y, z, tilt, tilt, heading];
        let mut draws = Stream::new(options.seed, "poses", agent.number);
        let bias = deviation.map(|deviation| deviation * draws.normal());
        let drives = agent.info.kind == AgentKind::Vehicle;
        let period = realo_schemas::to_seconds(POSE_PERIOD);
        let keep = |time: f64| if drives { libm::exp(-period / time) } else { 1.0 };
        let (position, angle) = (keep(noise.position_correlation_s), keep(noise.angle_correlation_s));
        let share = if drives { 1.0 } else { 0.0 };
        let (place, turn) = (
            share * noise.position_white_m,
            share * noise.angle_white_deg.to_radians(),
        );
        Errors {
            draws,
            bias,
            deviation,
            keep: [position, position, position, angle, angle, angle],
            white: [place, place, place, turn, turn, turn],
            velocity: share * noise.velocity_white_m_s,
            rate: share * noise.rate_white_deg_s.to_radians(),
        }
    }

    /// The next belief; `heading`: the body's true heading in `map`.
    fn next(&mut self, truth: &AgentState, heading: f64) -> AgentState {
        let mut error = [0.0; 6];
        for (k, error) in error.iter_mut().enumerate() {
            let step = self.deviation[k] * (1.0 - self.keep[k] * self.keep[k]).sqrt();
            self.bias[k] = self.keep[k] * self.bias[k] + step * self.draws.normal();
            *error = self.bias[k] + self.white[k] * self.draws.normal();
        }
        let t = &truth.map_from_body.translation.vector;
        let translation = Translation3::new(t.x + error[0], t.y + error[1], t.z + error[2]);
        let rotation = rotation(error[3], error[4], heading + error[5]);
        let mut covariance = Box::new([0.0; 36]);
        for k in 0..6 {
            covariance[7 * k] = self.deviation[k] * self.deviation[k] + self.white[k] * self.white[k];
        }
        let mut scatter = |deviation: f64| Vector3::from_fn(|_, _| deviation * self.draws.normal());
        let (velocity, rate) = (scatter(self.velocity), scatter(self.rate));
        AgentState {
            map_from_body: Isometry3::from_parts(translation, rotation),
            covariance: Some(covariance),
            velocity: truth.velocity.map(|v| v + velocity),
            angular_rate: truth.angular_rate.map(|r| r + rate),
            status: PoseStatus::Recorded,
        }
    }
}
