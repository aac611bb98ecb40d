use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use realo_operator::{Describe, Error, Inputs, Operator, Outputs, Settings, StreamKey};
use realo_schemas::{AgentState, Header, Kind, Motion, Name, PointCloud, Pose, PoseStatus};
use realo_state_estimation::{SettingsError, Unit};
use serde::{Deserialize, Serialize};

use crate::agent::{Agent, Rules};
use crate::faults::{COUNTERS, DEAD_RECKONING, INIT, LOST, NO_MOTION, TRACKING};
use crate::motion::Order;
use crate::place::{Place, PlaceError};
use crate::{PoseError, PoseNoise};

/// Where poses come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// As the log gives them, whatever their status.
    #[default]
    Recorded,
    /// True ones; any other is an error.
    True,
    /// Estimated from IMU, GNSS and wheels.
    Gnss,
    /// Estimated from the same, and from each sweep by a map.
    Map,
}

/// Which motion sensors the agents have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UnitChoice {
    /// By the noise that each IMU says of itself; those that say nothing are as `consumer`.
    #[default]
    Auto,
    /// MEMS chips, GNSS without corrections.
    Consumer,
    /// Fibre-optic gyroscopes, GNSS without corrections.
    Tactical,
    /// The same gyroscopes, GNSS with RTK.
    Rtk,
}

impl UnitChoice {
    fn unit(self) -> Option<Unit> {
        match self {
            UnitChoice::Auto => None,
            UnitChoice::Consumer => Some(Unit::Consumer),
            UnitChoice::Tactical => Some(Unit::Tactical),
            UnitChoice::Rtk => Some(Unit::Rtk),
        }
    }
}

/// Which errors of poses are one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseDraws {
    /// Every agent and sweep has its own.
    #[default]
    Each,
    /// All agents and sweeps have the same one, that of V2X-Real.
    Same,
}

/// Settings of localization.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Where poses come from: `recorded` (as the log gives them), `true` (refuses any other), `gnss` (estimated from IMU, GNSS and wheels)
    /// or `map` (from the same and each sweep on a map).
    #[setting(role = "localization")]
    pub source: Source,
    /// With source=map, the map's file, made by `realo map build`.
    #[setting(role = "map", path)]
    pub map: PathBuf,
    /// With source=gnss or map, the motion sensors: `auto` (by the noise that an IMU says of itself), `consumer`, `tactical` or `rtk`.
    pub unit: UnitChoice,
    /// With source=map, share of a sweep's points off the ground that must be near the map's surfaces.
    #[setting(default = 0.35, range = 0.0..=1.0)]
    pub min_share: f64,
    /// With source=gnss or map, whether the motion within a sweep is removed by the estimated motion; set `deskew=false` at `sync` then, which
    /// does it by recorded poses.
    pub deskew: bool,
    /// Agents that are roadside units, by name, separated by commas: they are localised once and held; others are vehicles.
    #[setting(role = "roadside")]
    pub roadside: String,
    /// Standard deviation of normal errors of x, y and z, m.
    #[setting(range = 0.0..=1000.0)]
    pub position_noise_m: f64,
    /// Standard deviation of normal errors of the heading, degrees.
    #[setting(range = 0.0..=180.0)]
    pub heading_noise_deg: f64,
    /// Errors of poses: `each` (one for each agent and sweep) or `same` (one for all, as V2X-Real draws it).
    pub noise: NoiseDraws,
    /// Seed of the errors.
    #[setting(role = "seed")]
    pub seed: u64,
}

/// The noise that is asked for; `None` without any.
fn noise_of(settings: &Settings) -> Result<Option<Noise>, LocalizationError> {
    let deviations = [settings.position_noise_m, settings.heading_noise_deg];
    if deviations == [0.0; 2] {
        return Ok(None);
    }
    let noise = PoseNoise {
        position_m: settings.position_noise_m,
        heading_deg: settings.heading_noise_deg,
    };
    let draws = match settings.noise {
        NoiseDraws::Each => Draw::Each(StreamKey::new(settings.seed, "localization")),
        NoiseDraws::Same => {
            let seed = u32::try_from(settings.seed).map_err(|_| LocalizationError::Seed(settings.seed))?;
            Draw::Same(noise.reference(seed))
        }
    };
    Ok(Some(Noise { noise, draws }))
}

/// Noise that is ready to be drawn.
struct Noise {
    noise: PoseNoise,
    draws: Draw,
}

enum Draw {
    Each(StreamKey),
    Same(PoseError),
}

impl Noise {
    /// The state with the error of its agent and sweep.
    fn of(&self, header: &Header, mut state: AgentState) -> AgentState {
        let error = match &self.draws {
            Draw::Each(key) => self
                .noise
                .drawn(key.draws(&header.agent, "", Kind::AgentState, header.seq)),
            Draw::Same(error) => *error,
        };
        state.map_from_body = error.of(&state.map_from_body);
        if let Some(covariance) = &mut state.covariance {
            self.noise.widen(covariance);
        }
        if state.status == PoseStatus::Truth {
            state.status = PoseStatus::Recorded;
        }
        state
    }
}

/// The state of an agent at a sweep, from what is known before.
///
/// # Errors
/// If true poses are asked for and the state is not one.
pub fn localize(source: Source, prior: AgentState) -> Result<AgentState, LocalizationError> {
    if source == Source::True && prior.status != PoseStatus::Truth {
        return Err(LocalizationError::NotTrue(prior.status));
    }
    Ok(prior)
}

/// Why an agent is not localised.
#[derive(Debug, thiserror::Error)]
pub enum LocalizationError {
    /// A seed that the reference's generator does not take.
    #[error("setting `seed`: expected 0 to {max} with noise=same, found {0}; or set noise=each", max = u32::MAX)]
    Seed(u64),
    /// A pose that is not true.
    #[error(
        "setting `source`: expected true poses, found one that is {0:?}; play the log's true poses, or set source=recorded"
    )]
    NotTrue(PoseStatus),
    /// No map.
    #[error(
        "setting `map`: expected a file made by `realo map build` with source=map, found none; set map=FILE or source=gnss"
    )]
    NoMap,
    /// A map that is not looked at.
    #[error("setting `map`: it is used with source=map alone; set source=map or leave it out")]
    UnusedMap,
    /// A map that is none.
    #[error("setting `map`: {0}")]
    Map(#[from] PlaceError),
    /// Sensors that cannot be where they are.
    #[error("the agent's motion sensors: {0}")]
    Sensors(#[from] SettingsError),
    /// A state alone.
    #[error("a state whose sweep did not come before it")]
    NoSweep,
}

/// Estimates where agents are.
struct Estimation {
    rules: Rules,
    roadside: BTreeSet<Name>,
    place: Option<Place>,
    deskew: bool,
    agents: BTreeMap<Name, Agent>,
}

impl Estimation {
    /// Of the settings; `None` where poses are not estimated.
    fn of(settings: &Settings) -> Result<Option<Self>, LocalizationError> {
        let has_file = !settings.map.as_os_str().is_empty();
        let place = match (settings.source, has_file) {
            (Source::Map, false) => return Err(LocalizationError::NoMap),
            (Source::Map, true) => Some(Place::open(&settings.map, settings.min_share)?),
            (_, true) => return Err(LocalizationError::UnusedMap),
            (Source::Gnss, false) => None,
            (Source::Recorded | Source::True, false) => return Ok(None),
        };
        let names = settings.roadside.split(',').map(str::trim);
        Ok(Some(Estimation {
            rules: Rules {
                unit: settings.unit.unit(),
                has_map: place.is_some(),
            },
            roadside: names.filter(|name| !name.is_empty()).map(Name::from).collect(),
            place,
            deskew: settings.deskew,
            agents: BTreeMap::new(),
        }))
    }

    fn agent(&mut self, name: &Name) -> &mut Agent {
        let is_roadside = self.roadside.contains(name);
        self.agents
            .entry(name.clone())
            .or_insert_with(|| Agent::new(is_roadside))
    }

    /// The state of an agent at a sweep, and the sweep.
    fn locate(
        &mut self,
        header: &Header,
        mut cloud: PointCloud,
        recorded: &AgentState,
        out: &mut Outputs<Output>,
    ) -> (AgentState, PointCloud) {
        let name = header.agent.clone();
        self.agent(&name).survey(recorded);
        let Estimation { agents, place, .. } = self;
        let Some(agent) = agents.get_mut(&name) else {
            return (recorded.clone(), cloud);
        };
        if self.deskew
            && let Some(deskewed) = agent.deskewed(header, &cloud)
        {
            cloud = deskewed;
        }
        let state = agent.locate(header, &cloud, place.as_mut(), out);
        let is = |status| u64::from(state.status == status);
        out.count(&TRACKING, &name, is(PoseStatus::Tracking));
        out.count(&DEAD_RECKONING, &name, is(PoseStatus::DeadReckoning));
        out.count_of(&INIT, &name, is(PoseStatus::Init), 1);
        out.count_of(&LOST, &name, is(PoseStatus::Lost), 1);
        out.count_of(&NO_MOTION, &name, u64::from(!agent.has_motion()), 1);
        (state, cloud)
    }
}

/// Says where each agent is at each sweep: the pose that the log gives, or that its sensors and a map give; with noise if asked for.
#[derive(Describe)]
#[stage(counters = COUNTERS)]
pub struct Localization {
    source: Source,
    estimation: Option<Estimation>,
    noise: Option<Noise>,
    /// The sweep whose state comes next.
    sweep: Option<(Header, PointCloud)>,
    order: Order,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What motion sensors measured since the message before; used with `source=gnss` or `map`.
    #[port(optional)]
    Motion(Header, Motion),
    /// Sweeps in the body frame at their stamp.
    #[port(latest, joined("sweep"))]
    Clouds(Header, PointCloud),
    /// What is known of pose and motion then.
    #[port(latest, joined("sweep"))]
    States(Header, AgentState),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The sweeps with the estimated pose; without one while the agent does not know where it is.
    Clouds(Header, PointCloud),
    /// The estimated pose and motion at the sweep's stamp.
    State(Header, AgentState),
}

impl Operator for Localization {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(Localization {
            noise: noise_of(&settings)?,
            source: settings.source,
            estimation: Estimation::of(&settings)?,
            sweep: None,
            order: Order::default(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Motion(header, motion) => {
                self.order.count(&header, &motion, out);
                if let Some(estimation) = &mut self.estimation {
                    let rules = estimation.rules;
                    let agent = estimation.agent(&header.agent);
                    agent
                        .measure(&header, &motion, &rules, out)
                        .map_err(LocalizationError::from)?;
                }
            }
            Input::Clouds(header, cloud) => self.sweep = Some((header, cloud)),
            Input::States(state_header, prior) => {
                let sweep = self.sweep.take();
                let same = |(header, _): &(Header, PointCloud)| {
                    (&header.agent, header.seq, header.stamp)
                        == (&state_header.agent, state_header.seq, state_header.stamp)
                };
                let (cloud_header, cloud) = sweep.filter(same).ok_or(LocalizationError::NoSweep)?;
                let (mut state, cloud) = match &mut self.estimation {
                    Some(estimation) => estimation.locate(&cloud_header, cloud, &prior, out),
                    None => (localize(self.source, prior)?, cloud),
                };
                if let Some(noise) = &self.noise {
                    state = noise.of(&state_header, state);
                }
                let pose = state.status.is_usable().then(|| Pose {
                    map_from_frame: state.map_from_body,
                    covariance: state.covariance.clone(),
                });
                let state_header = Header {
                    pose: pose.clone(),
                    ..state_header
                };
                out.send(Output::State(state_header, state));
                let cloud_header = Header { pose, ..cloud_header };
                out.send(Output::Clouds(cloud_header, cloud));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry3;
    use realo_schemas::Message;

    fn header(kind: Kind, seq: u64) -> Header {
        Header::origin(&"run".into(), &"cav1".into(), kind, seq, 100, 150)
    }

    fn cloud(seq: u64) -> Message {
        Message::new(header(Kind::Points, seq), PointCloud::empty())
    }

    fn state(seq: u64, status: PoseStatus) -> Message {
        let state = AgentState {
            map_from_body: Isometry3::translation(1.0, 2.0, 3.0),
            covariance: Some(Box::new([0.5; 36])),
            velocity: None,
            angular_rate: None,
            status,
        };
        Message::new(header(Kind::AgentState, seq), state)
    }

    #[test]
    fn passes_the_pose_into_the_sweep() {
        let mut localization = Localization::new(Settings::default()).unwrap();
        let mut out = Outputs::at(150);
        localization.on_message(Input::CLOUDS, cloud(4), &mut out).unwrap();
        assert_eq!(out.take_sent(), []);
        localization
            .on_message(Input::STATES, state(4, PoseStatus::Extrapolated), &mut out)
            .unwrap();
        let sent = out.take_sent();
        let pose = Pose {
            map_from_frame: Isometry3::translation(1.0, 2.0, 3.0),
            covariance: Some(Box::new([0.5; 36])),
        };
        assert_eq!(sent.len(), 2);
        assert_eq!(
            (sent[0].0, sent[0].1.header.kind, sent[0].1.header.pose.as_ref()),
            (Output::STATE, Kind::AgentState, Some(&pose))
        );
        assert_eq!(
            (sent[1].0, sent[1].1.header.kind, sent[1].1.header.pose.as_ref()),
            (Output::CLOUDS, Kind::Points, Some(&pose))
        );
        assert_eq!(sent[0].1.payload, state(4, PoseStatus::Extrapolated).payload);
    }

    #[test]
    fn refuses_what_is_not_true_when_truth_is_asked_for() {
        let mut localization = Localization::new(Settings {
            source: Source::True,
            ..Settings::default()
        })
        .unwrap();
        let mut out = Outputs::at(150);
        localization.on_message(Input::CLOUDS, cloud(4), &mut out).unwrap();
        let error = localization
            .on_message(Input::STATES, state(4, PoseStatus::Recorded), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("`source`") && error.contains("Recorded"), "{error}");
        localization.on_message(Input::CLOUDS, cloud(5), &mut out).unwrap();
        localization
            .on_message(Input::STATES, state(5, PoseStatus::Truth), &mut out)
            .unwrap();
        assert_eq!(out.take_sent().len(), 2);
    }

    #[test]
    fn refuses_a_state_of_another_sweep() {
        let mut localization = Localization::new(Settings::default()).unwrap();
        let mut out = Outputs::at(150);
        assert!(
            localization
                .on_message(Input::STATES, state(4, PoseStatus::Truth), &mut out)
                .is_err()
        );
        localization.on_message(Input::CLOUDS, cloud(4), &mut out).unwrap();
        assert!(
            localization
                .on_message(Input::STATES, state(5, PoseStatus::Truth), &mut out)
                .is_err()
        );
        assert_eq!(out.take_sent(), []);
    }

    fn noisy(noise: NoiseDraws, seed: u64) -> Settings {
        Settings {
            position_noise_m: 0.2,
            heading_noise_deg: 0.4,
            noise,
            seed,
            ..Settings::default()
        }
    }

    /// The state that leaves for a true one of an agent.
    fn state_of(settings: Settings, agent: &str, seq: u64) -> AgentState {
        let mut localization = Localization::new(settings).unwrap();
        let mut out = Outputs::at(150);
        for (port, mut message) in [
            (Input::CLOUDS, cloud(seq)),
            (Input::STATES, state(seq, PoseStatus::Truth)),
        ] {
            message.header.agent = agent.into();
            localization.on_message(port, message, &mut out).unwrap();
        }
        let sent = out.take_sent();
        let poses: Vec<_> = sent.iter().map(|(_, message)| message.header.pose.clone()).collect();
        assert_eq!(poses[0], poses[1], "the sweep has the pose of the state");
        let (_, state): (Header, AgentState) = sent.into_iter().next().unwrap().1.into_parts().unwrap();
        assert_eq!(poses[0].as_ref().unwrap().map_from_frame, state.map_from_body);
        state
    }

    #[test]
    fn noise_is_of_seed_agent_and_sweep_or_the_same_for_all() {
        let at = |noise, seed, agent: &str, seq| state_of(noisy(noise, seed), agent, seq).map_from_body;
        let each = at(NoiseDraws::Each, 1, "cav1", 4);
        assert_eq!(each, at(NoiseDraws::Each, 1, "cav1", 4));
        for other in [
            at(NoiseDraws::Each, 2, "cav1", 4),
            at(NoiseDraws::Each, 1, "cav2", 4),
            at(NoiseDraws::Each, 1, "cav1", 5),
        ] {
            assert_ne!(each, other);
        }
        let same = at(NoiseDraws::Same, 1, "cav1", 4);
        assert_eq!(same, at(NoiseDraws::Same, 1, "rsu2", 9));
        assert_ne!(same, at(NoiseDraws::Same, 2, "cav1", 4));
    }

    /// `numpy.random.seed(0)`, then `normal(0, 0.2, 3)` and the middle one of `normal(0, 0.4, 3)`.
    #[test]
    fn the_same_noise_is_that_of_the_reference() {
        let state = state_of(noisy(NoiseDraws::Same, 0), "cav1", 4);
        let shift = state.map_from_body.translation.vector - nalgebra::Vector3::new(1.0, 2.0, 3.0);
        let expected = [0.3528104691935328, 0.08003144167344467, 0.19574759682114784];
        assert!(
            shift.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12),
            "{shift}"
        );
        let heading = realo_schemas::geometry::yaw_of(&state.map_from_body.rotation).to_degrees();
        assert!((heading - 0.747023196059987).abs() < 1e-12, "{heading}");
        let variances = state
            .covariance
            .map(|covariance| [0, 7, 14, 21, 28, 35].map(|at| covariance[at]));
        let turned = 0.5 + 0.4f64.to_radians() * 0.4f64.to_radians();
        assert_eq!(variances, Some([0.54, 0.54, 0.54, 0.5, 0.5, turned]));
        assert_eq!(state.status, PoseStatus::Recorded);
    }

    #[test]
    fn drawn_noise_is_as_great_as_it_says() {
        let errors: Vec<[f64; 2]> = (0..2000)
            .map(|seq| {
                let pose = state_of(noisy(NoiseDraws::Each, 7), "cav1", seq).map_from_body;
                let heading = realo_schemas::geometry::yaw_of(&pose.rotation).to_degrees();
                [pose.translation.x - 1.0, heading]
            })
            .collect();
        for (axis, deviation) in [0.2, 0.4].into_iter().enumerate() {
            let mean = errors.iter().map(|error| error[axis]).sum::<f64>() / 2000.0;
            let square = errors.iter().map(|error| error[axis] * error[axis]).sum::<f64>() / 2000.0;
            assert!(mean.abs() < 0.1 * deviation, "{mean}");
            assert!((square.sqrt() / deviation - 1.0).abs() < 0.05, "{square}");
        }
    }

    #[test]
    fn refuses_noise_that_is_none() {
        let error = |settings| {
            Localization::new(settings)
                .err()
                .map(|error| error.to_string())
                .unwrap_or_default()
        };
        let of = |position_noise_m, heading_noise_deg| Settings {
            position_noise_m,
            heading_noise_deg,
            ..Settings::default()
        };
        assert!(error(of(-1.0, 0.0)).contains("`position_noise_m`: expected 0 to 1000, found -1"));
        assert!(error(of(0.0, f64::NAN)).contains("`heading_noise_deg`: expected 0 to 180, found NaN"));
        assert!(error(noisy(NoiseDraws::Same, 1 << 32)).contains("`seed`"));
    }
}
