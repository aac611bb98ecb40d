//! The simulation as its users see it: agents, poses, sweeps.

use rayon::prelude::*;
use realo_schemas::{Box3, Boxes, Name, Nanos, PointCloud};

use crate::agents::{Agent, AgentInfo, BodyState, since_epoch};
use crate::cast::{Cast, Casting, World, cast};
use crate::detections::detect;
use crate::inertial::{MotionRecord, measure};
use crate::options::{Error, Options, SWEEP_PERIOD, Scenario};
use crate::place::Scenery;
use crate::poses::{PoseSample, poses};
use crate::random::Stream;
use crate::traffic::{Demand, Traffic, User};

/// A place, its traffic, and the agents that record it.
pub struct Simulation {
    /// What was asked for, and by what everything is drawn.
    asked: Options,
    options: Options,
    place: Scenery,
    traffic: Traffic,
    agents: Vec<Agent>,
    /// Class names, shared by all boxes.
    classes: Vec<Name>,
}

/// One turn of an agent's sensor, and what was really there.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// The agent.
    pub agent: Name,
    /// Number of the sweep, per agent.
    pub seq: u64,
    /// Reference time: the middle of the sweep.
    pub stamp: Nanos,
    /// The end of the sweep.
    pub ready: Nanos,
    /// The points, in order of time. Each is in the agent's true body frame of the instant at which it was measured
    /// (`stamp` + its time): motion within the sweep is still in them. Coordinates are multiples of 2⁻¹⁰ m. Empty if
    /// `Options::clouds` is off.
    pub cloud: PointCloud,
    /// For each point, the index in `truth` plus one of the object that it lies on, 0 for anything else; empty unless
    /// `Options::labels` and `Options::clouds` are on.
    pub labels: Vec<u32>,
    /// Every road user in the place but the agent's own vehicle, in the agent's true body frame at `stamp`; score 1.
    pub truth: Vec<Box3>,
    /// The agent's own points on each object of `truth`.
    pub points: Vec<u32>,
    /// The simulated recorded detections, in the body frame at `stamp`.
    pub detections: Boxes,
    /// Whether the frame is scored.
    pub key: bool,
}

impl Simulation {
    /// Builds the place and lets the traffic run; sweeps are cast when asked for.
    ///
    /// # Errors
    /// [`Error`] names the option that cannot be met.
    pub fn new(options: &Options) -> Result<Self, Error> {
        options.check()?;
        let asked = options.clone();
        let options = options.of_day();
        let number = options.place.unwrap_or(options.seed);
        let place = Scenery::new(options.scenario, number).on_day(options.day);
        let demand = Demand {
            place: &place,
            seed: options.seed,
            dense: options.dense,
            seconds: options.seconds,
            rounded_bodies: options.rounded_bodies,
        };
        let traffic = Traffic::new(&demand)?;
        let agents = Agent::all(&options, &place, &traffic)?;
        let classes = traffic.users.iter().map(|user| Name::from(user.class.name())).collect();
        Ok(Simulation {
            asked,
            options,
            place,
            traffic,
            agents,
            classes,
        })
    }

    /// What was asked for.
    pub fn asked(&self) -> &Options {
        &self.asked
    }

    /// Which place it is: what was asked for, or what `mixed` drew.
    pub fn scenario(&self) -> Scenario {
        self.place.scenario
    }

    /// Number of the place: its roads and buildings.
    pub fn place(&self) -> u64 {
        self.options.place.unwrap_or(self.options.seed)
    }

    /// Road users at the start of the log.
    pub fn road_users(&self) -> usize {
        self.traffic
            .users
            .iter()
            .filter(|user| user.course.at(0.0).is_some())
            .count()
    }

    /// The agents that record, in a fixed order.
    pub fn agents(&self) -> impl Iterator<Item = &AgentInfo> {
        self.agents.iter().map(|agent| &agent.info)
    }

    /// Number of sweeps of all agents together.
    pub fn sweep_count(&self) -> usize {
        self.agents.len() * self.options.recorded_sweeps().count()
    }

    /// An agent's poses, 100 a second, from a sweep's period before its first sweep until one after its last; one
    /// falls on the start, the middle and the end of each sweep. `None` if the agent does not record.
    pub fn poses(&self, agent: &str) -> Option<Vec<PoseSample>> {
        let agent = self.agents.iter().find(|a| &*a.info.name == agent)?;
        Some(poses(&self.world(), agent, &self.options))
    }

    /// What an agent's motion sensors measure, with true times; `None` if the agent does not record, or without
    /// `Options::inertial`.
    pub fn motion(&self, agent: &str) -> Option<MotionRecord> {
        let agent = self.agents.iter().find(|a| &*a.info.name == agent)?;
        Some(measure(&self.world(), agent, &self.options, self.options.inertial?))
    }

    /// All sweeps, by time of their end, then by agent. Casts a few at a time on rayon's current pool; what comes out
    /// does not depend on the number of threads.
    pub fn sweeps(&self) -> Sweeps<'_> {
        let mut jobs: Vec<Job> = (self.options.recorded_sweeps())
            .flat_map(|seq| (0..self.agents.len()).map(move |agent| (agent, seq)))
            .map(|(agent, seq)| Job {
                ready: self.agents[agent].sweep_start(seq) + SWEEP_PERIOD,
                agent,
                seq,
            })
            .collect();
        jobs.sort_by_key(|job| (job.ready, job.agent));
        Sweeps {
            simulation: self,
            jobs: jobs.into_iter(),
            cast: Vec::new().into_iter(),
        }
    }

    /// One sweep of the agent with the given index in [`Simulation::agents`], and the number of rays that it cast.
    pub fn sweep(&self, agent: usize, seq: u64) -> (Sweep, usize) {
        let agent = &self.agents[agent];
        let start = agent.sweep_start(seq);
        let stamp = start + SWEEP_PERIOD / 2;
        let options = &self.options;
        let stream = agent.number << 32 | seq;
        let casting = Casting {
            key: Stream::new(options.seed, "rays", stream).bits(),
            start,
            stamp,
            clouds: options.clouds,
            labels: options.labels,
            column_stride: options.column_stride,
            extinction: options.weather.extinction(),
        };
        let Cast {
            cloud,
            points: on_user,
            labels: user_labels,
            finished,
        } = cast(&self.world(), agent, &casting);
        let body = agent.body(&self.place, &self.traffic, since_epoch(stamp));
        let mut index_of = vec![0; self.traffic.users.len() + 1];
        let (mut truth, mut points) = (Vec::new(), Vec::new());
        for (index, user) in self.traffic.users.iter().enumerate() {
            if agent.user == Some(index) {
                continue;
            }
            if let Some(object) = self.object(user, index, &body, since_epoch(stamp)) {
                truth.push(object);
                points.push(on_user[index]);
                index_of[index + 1] = truth.len() as u32;
            }
        }
        let draws = Stream::new(options.seed, "detections", stream);
        let sweep = Sweep {
            agent: agent.info.name.clone(),
            seq,
            stamp,
            ready: start + SWEEP_PERIOD,
            cloud,
            labels: user_labels.into_iter().map(|user| index_of[user as usize]).collect(),
            detections: detect(options, &truth, &points, draws),
            truth,
            points,
            key: options.is_key(seq),
        };
        (sweep, finished)
    }

    /// A road user as an object in a body frame.
    fn object(&self, user: &User, index: usize, body: &BodyState, t: f64) -> Option<Box3> {
        let state = user.course.at(t)?;
        let footing = user.footing(&self.place, &state);
        let (sin, cos) = libm::sincos(body.heading);
        let into_body = |x: f64, y: f64| (x * cos + y * sin, y * cos - x * sin);
        let (x, y) = into_body(state.pose.x - body.position[0], state.pose.y - body.position[1]);
        let yaw = state.pose.heading - body.heading;
        let (yaw_sin, yaw_cos) = libm::sincos(yaw);
        let climb = state.speed * footing.slope[0];
        let [length, width, height] = user.size;
        Some(Box3 {
            center: [x, y, footing.z + height / 2.0 - body.position[2]],
            length,
            width,
            height,
            yaw: realo_schemas::geometry::normalize_yaw(yaw),
            velocity: Some([state.speed * yaw_cos, state.speed * yaw_sin, climb]),
            class: self.classes[index].clone(),
            score: 1.0,
            track: Some(user.track),
            covariance: None,
        })
    }

    fn world(&self) -> World<'_> {
        World {
            place: &self.place,
            traffic: &self.traffic,
        }
    }
}

#[derive(Clone, Copy)]
struct Job {
    ready: Nanos,
    agent: usize,
    seq: u64,
}

/// The sweeps of a simulation; see [`Simulation::sweeps`].
pub struct Sweeps<'a> {
    simulation: &'a Simulation,
    jobs: std::vec::IntoIter<Job>,
    cast: std::vec::IntoIter<Sweep>,
}

impl Iterator for Sweeps<'_> {
    type Item = Sweep;

    fn next(&mut self) -> Option<Sweep> {
        if self.cast.len() == 0 {
            let batch: Vec<Job> = self.jobs.by_ref().take(4 * rayon::current_num_threads()).collect();
            let cast: Vec<Sweep> = batch
                .into_par_iter()
                .map(|job| self.simulation.sweep(job.agent, job.seq).0)
                .collect();
            self.cast = cast.into_iter();
        }
        self.cast.next()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.jobs.len() + self.cast.len();
        (left, Some(left))
    }
}

impl ExactSizeIterator for Sweeps<'_> {}
