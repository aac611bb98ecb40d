//! What can be asked of a simulation, and what is refused.

use std::sync::Arc;

use realo_schemas::Nanos;

use crate::random::Stream;
use crate::sensor::Sensor;

/// Log time at which every simulation starts: 2026-01-01T00:00:00Z.
pub const EPOCH: Nanos = 1_767_225_600_000_000_000;

/// Time from one sweep's start to the next, ns.
pub const SWEEP_PERIOD: Nanos = 100_000_000;

/// Time from one pose to the next, ns.
pub const POSE_PERIOD: Nanos = 10_000_000;

/// The agents that record unless options say otherwise, in order.
pub const AGENTS: [&str; 4] = ["cav1", "cav2", "rsu1", "rsu2"];

/// Agents of a fleet at most.
pub const MOST_AGENTS: usize = 16;

/// The names of a fleet's agents: vehicles `cav1`, `cav2`, … and roadside units `rsu1`, `rsu2`, …
///
/// # Errors
/// A fleet of none, or of more than [`MOST_AGENTS`].
pub fn fleet(vehicles: usize, roadside: usize) -> Result<Vec<String>, Error> {
    let count = vehicles.saturating_add(roadside);
    if count > MOST_AGENTS {
        return Err(Error::TooManyAgents { found: count });
    }
    if count == 0 {
        return Err(Error::NoAgent);
    }
    let names = |kind: &'static str, count: usize| (1..=count).map(move |k| format!("{kind}{k}"));
    Ok(names("cav", vehicles).chain(names("rsu", roadside)).collect())
}

/// Whether a name is that of a vehicle, and its number from 0; `None` for names that no agent has.
pub(crate) fn agent_of(name: &str) -> Option<(bool, usize)> {
    let (vehicle, digits) = match (name.strip_prefix("cav"), name.strip_prefix("rsu")) {
        (Some(digits), _) => (true, digits),
        (_, Some(digits)) => (false, digits),
        _ => return None,
    };
    let number: usize = digits.parse().ok()?;
    let usual = (1..=MOST_AGENTS).contains(&number) && number.to_string() == digits;
    usual.then(|| (vehicle, number - 1))
}

/// What is in the air.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Weather {
    /// Rain, mm/h; 0 for none.
    pub rain_mm_h: f64,
    /// Meteorological visibility in fog, m; `None` for clear air.
    pub visibility_m: Option<f64>,
}

impl Weather {
    /// What the air takes of the light, 1/m. Rain: 1.076·R^0.67 dB/km (ITU-R P.1814). Fog: ln 20 / V, the extinction at
    /// which a black object at the visibility keeps a contrast of 5 % (Koschmieder; the meteorological optical range).
    pub(crate) fn extinction(self) -> f64 {
        let rain = match self.rain_mm_h > 0.0 {
            true => 1.076 * libm::pow(self.rain_mm_h, 0.67) * std::f64::consts::LN_10 / 10.0 / 1000.0,
            false => 0.0,
        };
        rain + self.visibility_m.map_or(0.0, |visibility| libm::log(20.0) / visibility)
    }
}

/// Which place is built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scenario {
    /// Two straight roads that cross squarely under traffic lights, between houses.
    #[default]
    Intersection,
    /// A straight road with a signalised crossing for pedestrians, between houses.
    Corridor,
    /// Two bent roads that cross at a slant, with lights or without, in the open.
    Junction,
    /// A road that ends at another, at a slant.
    Tee,
    /// Three or four roads that meet in a ring.
    Roundabout,
    /// A winding road with entries.
    Curve,
    /// Narrow streets between gardens, cars parked on both sides.
    Residential,
    /// Three lanes each way at up to 100 km/h, in a bend, with an entry.
    Motorway,
    /// A car park with its street.
    CarPark,
    /// A boulevard with a planted median.
    Avenue,
    /// A winding road over open, sloping land, without kerbs.
    Rural,
    /// A shopping street: many walkers, vans at the kerb.
    Market,
    /// One of all these, as the place's number says.
    Mixed,
}

impl Scenario {
    /// All that are places of their own.
    pub const PLACES: [Scenario; 12] = [
        Scenario::Intersection,
        Scenario::Corridor,
        Scenario::Junction,
        Scenario::Tee,
        Scenario::Roundabout,
        Scenario::Curve,
        Scenario::Residential,
        Scenario::Motorway,
        Scenario::CarPark,
        Scenario::Avenue,
        Scenario::Rural,
        Scenario::Market,
    ];

    /// The places whose roads run at any angle: all but the two on a grid.
    pub const NETWORKS: [Scenario; 10] = {
        let [_, _, networks @ ..] = Self::PLACES;
        networks
    };

    /// Its name, as it is asked for.
    pub fn name(self) -> &'static str {
        match self {
            Scenario::Intersection => "intersection",
            Scenario::Corridor => "corridor",
            Scenario::Junction => "junction",
            Scenario::Tee => "tee",
            Scenario::Roundabout => "roundabout",
            Scenario::Curve => "curve",
            Scenario::Residential => "residential",
            Scenario::Motorway => "motorway",
            Scenario::CarPark => "car_park",
            Scenario::Avenue => "avenue",
            Scenario::Rural => "rural",
            Scenario::Market => "market",
            Scenario::Mixed => "mixed",
        }
    }

    /// The scenario of a name.
    ///
    /// # Errors
    /// [`Error::UnknownScenario`] lists the names.
    pub fn from_name(name: &str) -> Result<Self, Error> {
        let mut all = Self::PLACES.into_iter().chain([Scenario::Mixed]);
        all.find(|scenario| scenario.name() == name)
            .ok_or_else(|| Error::UnknownScenario { found: name.into() })
    }

    /// The place that is built for a place's number: what `mixed` draws, else itself.
    pub fn resolve(self, place: u64) -> Self {
        match self {
            Scenario::Mixed => Self::PLACES[Stream::new(place, "scenario", 0).below(Self::PLACES.len())],
            own => own,
        }
    }
}

/// How the agents' sweeps lie to each other in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Phase {
    /// All sweeps start within 1 ms, as GPS-locked sensors do.
    #[default]
    Locked,
    /// The sweeps of the first four agents start at least 15 ms apart; those of more agents anywhere in the period.
    Spread,
}

impl Phase {
    /// All, with their names and what they mean.
    pub const ALL: &[(Phase, &str, &str)] = &[(Phase::Locked, "locked", ""), (Phase::Spread, "spread", "")];
}

/// What a simulation is asked for; everything is derived from it, bit for bit.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Which place is built.
    pub scenario: Scenario,
    /// Whether there is heavy traffic: at least 120 road users at all times.
    pub dense: bool,
    /// Fixes roads and buildings; `None` takes `seed`.
    pub place: Option<u64>,
    /// How the agents' sweeps lie to each other.
    pub phase: Phase,
    /// Fixes the traffic, the noise and, without `place`, the place.
    pub seed: u64,
    /// Length of the log, s; a multiple of 0.1 within [0.1, 3600] (rounded to sweeps).
    pub seconds: f64,
    /// Scored frames per second; a divisor of 10, at most 10.
    pub key_hz: f64,
    /// Only scored sweeps are recorded, and each agent's first; the poses are all there. An offline run scores the same
    /// frames in a tenth of the time, but a link then judges distances by positions up to a key period old.
    pub key_sweeps_only: bool,
    /// Where the place's centre lies in `map`, (east, north), m.
    pub map_offset_m: [f64; 2],
    /// Recorded detections are the truth of what the agent has `detection_min_points` points on.
    pub noise_free_detections: bool,
    /// Own points from which an object can be in the recorded detections.
    pub detection_min_points: u32,
    /// The agents that record: `cav1`, `cav2`, … and `rsu1`, `rsu2`, …, at most [`MOST_AGENTS`]; the other cars are still
    /// there.
    pub agents: Vec<String>,
    /// Whether sweeps carry their points; without them, counts are the same.
    pub clouds: bool,
    /// Whether sweeps say which object each point lies on.
    pub labels: bool,
    /// Only each n-th column fires; 1 for what the sensor really does, more for previews and tests.
    pub column_stride: usize,
    /// How the agents' own poses err.
    pub pose_noise: PoseNoise,
    /// The vehicles' sensors, dealt out in turn; empty: those of the first places.
    pub vehicle_sensors: Vec<Arc<Sensor>>,
    /// The roadside units' sensors, dealt out in turn; empty: those of the first places.
    pub roadside_sensors: Vec<Arc<Sensor>>,
    /// Rain and fog.
    pub weather: Weather,
    /// Whether road users on a grid too have the bodies that they have elsewhere: rounded, inside their boxes.
    pub rounded_bodies: bool,
}

impl Options {
    /// The demo log that shipped graphs play: two vehicles and a roadside unit at an intersection.
    pub fn demo() -> Self {
        Options {
            seed: 900,
            seconds: 10.0,
            agents: ["cav1", "cav2", "rsu1"].map(String::from).to_vec(),
            ..Options::default()
        }
    }
}

impl Default for Options {
    /// 10 s at the intersection with every agent, seed 0.
    fn default() -> Self {
        Options {
            scenario: Scenario::Intersection,
            dense: false,
            place: None,
            phase: Phase::Locked,
            seed: 0,
            seconds: 10.0,
            key_hz: 1.0,
            key_sweeps_only: false,
            map_offset_m: [0.0; 2],
            noise_free_detections: false,
            detection_min_points: 5,
            agents: AGENTS.map(String::from).to_vec(),
            clouds: true,
            labels: false,
            column_stride: 1,
            pose_noise: PoseNoise::default(),
            vehicle_sensors: Vec::new(),
            roadside_sensors: Vec::new(),
            weather: Weather::default(),
            rounded_bodies: false,
        }
    }
}

/// The error model `gnss-ins-rtk-like` of the poses that agents believe.
///
/// A vehicle's error is a first-order Gauss-Markov walk (bias) plus white noise at each pose. A roadside unit was
/// surveyed once: one draw of the bias, no white noise. Covariances are the sums of both variances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseNoise {
    /// Standard deviation of the bias (east, north, up), m. RTK receivers: 0.015, 0.015, 0.03.
    pub position_bias_m: [f64; 3],
    /// Time in which the bias of the position loses 63 % of itself, s (a modelling choice: 60).
    pub position_correlation_s: f64,
    /// White noise of the position on each axis, m (a modelling choice: 0.005).
    pub position_white_m: f64,
    /// Standard deviation of the heading's bias, degrees. Two antennas 2 m apart: 0.08.
    pub heading_bias_deg: f64,
    /// Standard deviation of the bias of roll and pitch, degrees (a modelling choice: 0.02).
    pub tilt_bias_deg: f64,
    /// Time in which the biases of the angles lose 63 % of themselves, s (a modelling choice: 30).
    pub angle_correlation_s: f64,
    /// White noise of each angle, degrees (a modelling choice: 0.01).
    pub angle_white_deg: f64,
    /// White noise of the velocity on each axis, m/s. CPT7: 0.03.
    pub velocity_white_m_s: f64,
    /// White noise of the angular rate on each axis, degrees/s (a modelling choice: 0.05).
    pub rate_white_deg_s: f64,
}

impl PoseNoise {
    /// The model's name, for a log's metadata.
    pub const NAME: &'static str = "gnss-ins-rtk-like";

    /// Poses without error.
    pub fn none() -> Self {
        PoseNoise {
            position_bias_m: [0.0; 3],
            position_correlation_s: 60.0,
            position_white_m: 0.0,
            heading_bias_deg: 0.0,
            tilt_bias_deg: 0.0,
            angle_correlation_s: 30.0,
            angle_white_deg: 0.0,
            velocity_white_m_s: 0.0,
            rate_white_deg_s: 0.0,
        }
    }

    fn check(&self) -> Result<(), Error> {
        let [x, y, z] = self.position_bias_m;
        let deviations = [
            ("position_bias_m", x),
            ("position_bias_m", y),
            ("position_bias_m", z),
            ("position_white_m", self.position_white_m),
            ("heading_bias_deg", self.heading_bias_deg),
            ("tilt_bias_deg", self.tilt_bias_deg),
            ("angle_white_deg", self.angle_white_deg),
            ("velocity_white_m_s", self.velocity_white_m_s),
            ("rate_white_deg_s", self.rate_white_deg_s),
        ];
        for (field, value) in deviations {
            require(
                value >= 0.0 && value.is_finite(),
                field,
                value,
                "a finite number, 0 or more",
            )?;
        }
        for (field, value) in [
            ("position_correlation_s", self.position_correlation_s),
            ("angle_correlation_s", self.angle_correlation_s),
        ] {
            require(
                value > 0.0 && value.is_finite(),
                field,
                value,
                "a finite number greater than 0",
            )?;
        }
        Ok(())
    }
}

impl Default for PoseNoise {
    fn default() -> Self {
        PoseNoise {
            position_bias_m: [0.015, 0.015, 0.03],
            position_correlation_s: 60.0,
            position_white_m: 0.005,
            heading_bias_deg: 0.08,
            tilt_bias_deg: 0.02,
            angle_correlation_s: 30.0,
            angle_white_deg: 0.01,
            velocity_white_m_s: 0.03,
            rate_white_deg_s: 0.05,
        }
    }
}

/// Options that no simulation can meet.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// A number out of its range.
    #[error("simulation option `{field}`: expected {expected}, found {found}")]
    Range {
        /// The option.
        field: &'static str,
        /// What it takes.
        expected: &'static str,
        /// What came.
        found: String,
    },
    /// An agent that no place has.
    #[error("simulation option `agents`: no agent `{found}`; a place has cav1 to cav16 and rsu1 to rsu16")]
    UnknownAgent {
        /// The name that came.
        found: String,
    },
    /// The same agent twice.
    #[error("simulation option `agents`: `{found}` is named twice; name each agent once")]
    AgentTwice {
        /// The name that came twice.
        found: String,
    },
    /// A scenario that there is not.
    #[error(
        "simulation option `scenario`: no scenario `{found}`; there are intersection, corridor, junction, tee, roundabout, \
         curve, residential, motorway, car_park, avenue, rural, market and mixed"
    )]
    UnknownScenario {
        /// The name that came.
        found: String,
    },
    /// A place whose traffic has no two cars that can carry agents.
    #[error(
        "simulation options `scenario`, `seed` and `place`: in {scenario}, place {place}, no two cars of seed {seed}'s \
         traffic are near each other; take another seed"
    )]
    NoRoom {
        /// What was built.
        scenario: &'static str,
        /// The place's number.
        place: u64,
        /// The traffic's.
        seed: u64,
    },
    /// Nobody records.
    #[error("simulation option `agents`: nobody records; name at least one of cav1, cav2, rsu1 and rsu2")]
    NoAgent,
    /// More agents than a fleet has.
    #[error("simulation option `agents`: expected at most {MOST_AGENTS} agents, found {found}")]
    TooManyAgents {
        /// How many came.
        found: usize,
    },
    /// A vehicle that no car can be.
    #[error(
        "simulation option `agents`: no car for `{name}`: {found} cars stay for the whole log; \
         ask for fewer vehicles, a shorter log or dense traffic"
    )]
    NoCar {
        /// The agent.
        name: String,
        /// Cars that could be agents.
        found: usize,
    },
    /// A roadside unit for which there is no place.
    #[error("simulation option `agents`: no place beside the roads for `{name}`; ask for fewer roadside units")]
    NoStand {
        /// The agent.
        name: String,
    },
}

fn require(holds: bool, field: &'static str, value: f64, expected: &'static str) -> Result<(), Error> {
    if holds {
        Ok(())
    } else {
        Err(Error::Range {
            field,
            expected,
            found: value.to_string(),
        })
    }
}

impl Options {
    /// Sweeps of each agent.
    pub fn sweeps_per_agent(&self) -> u64 {
        (self.seconds * 10.0).round() as u64
    }

    /// Whether a sweep of an agent is scored.
    pub(crate) fn is_key(&self, seq: u64) -> bool {
        // In the middle of each key period, so that everybody has been heard before the first scored frame.
        seq % self.key_period() == self.key_period() / 2
    }

    /// The numbers of an agent's sweeps that are recorded.
    pub(crate) fn recorded_sweeps(&self) -> impl Iterator<Item = u64> {
        (0..self.sweeps_per_agent()).filter(|seq| !self.key_sweeps_only || *seq == 0 || self.is_key(*seq))
    }

    /// Sweeps from one key frame to the next.
    pub(crate) fn key_period(&self) -> u64 {
        (10.0 / self.key_hz).round() as u64
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        let seconds = self.seconds;
        require(
            (0.1..=3600.0).contains(&seconds),
            "seconds",
            seconds,
            "a number within [0.1, 3600]",
        )?;
        let period = 10.0 / self.key_hz;
        let divides = self.key_hz > 0.0 && self.key_hz <= 10.0 && (period - period.round()).abs() < 1e-6;
        require(divides, "key_hz", self.key_hz, "a rate in (0, 10] that divides 10")?;
        for value in self.map_offset_m {
            require(value.abs() <= 1e8, "map_offset_m", value, "metres within ±1e8")?;
        }
        let stride = self.column_stride as f64;
        require(
            (1..=1000).contains(&self.column_stride),
            "column_stride",
            stride,
            "a number within [1, 1000]",
        )?;
        let Weather {
            rain_mm_h,
            visibility_m,
        } = self.weather;
        let rains = (0.0..=300.0).contains(&rain_mm_h);
        require(rains, "weather.rain_mm_h", rain_mm_h, "mm/h within [0, 300]")?;
        let visibility = visibility_m.unwrap_or(1000.0);
        let sees = (5.0..=1e6).contains(&visibility);
        require(sees, "weather.visibility_m", visibility, "metres within [5, 1e6]")?;
        self.pose_noise.check()?;
        self.check_agents()
    }

    fn check_agents(&self) -> Result<(), Error> {
        if self.agents.is_empty() {
            return Err(Error::NoAgent);
        }
        if self.agents.len() > MOST_AGENTS {
            let found = self.agents.len();
            return Err(Error::TooManyAgents { found });
        }
        for (i, found) in self.agents.iter().enumerate() {
            let found = found.clone();
            if agent_of(&found).is_none() {
                return Err(Error::UnknownAgent { found });
            }
            if self.agents[..i].contains(&found) {
                return Err(Error::AgentTwice { found });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refuses_by_name_what_it_cannot_do() {
        type Case = (fn(&mut Options), &'static str);
        let cases: [Case; 13] = [
            (|o| o.seconds = f64::NAN, "seconds"),
            (|o| o.seconds = 0.0, "seconds"),
            (|o| o.key_hz = 3.0, "key_hz"),
            (|o| o.key_hz = 0.0, "key_hz"),
            (|o| o.map_offset_m = [f64::INFINITY, 0.0], "map_offset_m"),
            (|o| o.column_stride = 0, "column_stride"),
            (|o| o.agents = vec!["cav17".into()], "cav17"),
            (
                |o| o.agents = (1..=16).map(|k| format!("cav{k}")).chain(["rsu1".into()]).collect(),
                "16 agents, found 17",
            ),
            (|o| o.weather.rain_mm_h = -1.0, "rain_mm_h"),
            (|o| o.weather.visibility_m = Some(f64::NAN), "visibility_m"),
            (|o| o.agents = vec!["cav01".into()], "cav01"),
            (|o| o.agents = vec!["cav1".into(), "cav1".into()], "twice"),
            (|o| o.pose_noise.heading_bias_deg = -1.0, "heading_bias_deg"),
        ];
        for (spoil, named) in cases {
            let mut options = Options::default();
            spoil(&mut options);
            let error = options.check().unwrap_err().to_string();
            assert!(error.contains(named), "{error} does not name {named}");
        }
        assert_eq!(Options::default().check(), Ok(()));
        assert_eq!(fleet(8, 4).unwrap().len(), 12);
        assert_eq!(fleet(13, 4), Err(Error::TooManyAgents { found: 17 }));
        assert_eq!(fleet(0, 0), Err(Error::NoAgent));
    }

    #[test]
    fn air_takes_what_its_sources_say() {
        let extinction = |rain_mm_h, visibility_m| {
            Weather {
                rain_mm_h,
                visibility_m,
            }
            .extinction()
        };
        assert_eq!(extinction(0.0, None), 0.0);
        // 10 mm/h: 5.03 dB/km.
        assert!((extinction(10.0, None) * 1000.0 * 10.0 / std::f64::consts::LN_10 - 5.03).abs() < 0.01);
        assert!((extinction(0.0, Some(100.0)) - 0.029_957).abs() < 1e-5);
    }
}
