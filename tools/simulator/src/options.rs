//! What can be asked of a simulation, and what is refused.

mod error;
mod pose_noise;
mod scenario;

use std::collections::BTreeMap;
use std::sync::Arc;

use realo_logs::ClockError;
use realo_schemas::{Nanos, from_seconds, to_seconds};

use crate::inertial::MotionUnit;
use crate::random::Stream;
use crate::sensor::Sensor;
pub use error::Error;
use error::require;
pub use pose_noise::PoseNoise;
pub use scenario::Scenario;

/// Log time at which every simulation starts: 2026-01-01T00:00:00Z.
pub const EPOCH: Nanos = 1_767_225_600_000_000_000;

/// Logs have no later stamps, ns: 2038.
const LAST_STAMP: Nanos = 2_147_483_000 * 1_000_000_000;

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

    /// What the reader of a log learns of it.
    pub fn about(self) -> &'static str {
        match self {
            Phase::Locked => "the agents' sweeps start together",
            Phase::Spread => "the agents' sweeps start apart",
        }
    }
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
    /// The day of the drive: another one has other traffic, parked cars and noise, and foliage that was cut or grew, in the
    /// same place. 0 is the first.
    pub day: u64,
    /// What measures the agents' motion; roadside units have its receiver alone. `None`: nothing does.
    pub inertial: Option<MotionUnit>,
    /// Motion sensors without errors; outages are there all the same. For tests.
    pub exact_motion: bool,
    /// How wrong the clocks of agents are, by agent: all their stamps carry it, times at which messages are there do not.
    pub clock_errors: BTreeMap<String, ClockError>,
    /// When the first sweep of an agent starts, ms after [`EPOCH`], in the place of what `phase` says.
    pub sweep_phase_ms: BTreeMap<String, f64>,
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
            day: 0,
            inertial: None,
            exact_motion: false,
            clock_errors: BTreeMap::new(),
            sweep_phase_ms: BTreeMap::new(),
        }
    }
}

impl Options {
    /// Sweeps of each agent.
    pub fn sweeps_per_agent(&self) -> u64 {
        (self.seconds * 10.0).round() as u64
    }

    /// The options by which everything is drawn: those of another day have another seed, and the same place.
    pub(crate) fn of_day(&self) -> Options {
        let place = Some(self.place.unwrap_or(self.seed));
        let seed = match self.day {
            0 => self.seed,
            day => Stream::new(self.seed, "day", day).bits(),
        };
        Options {
            place,
            seed,
            ..self.clone()
        }
    }

    /// What the stamps of an agent say at a true time, ns.
    pub fn stamp_of(&self, agent: &str, time: Nanos) -> Nanos {
        let error = self.clock_errors.get(agent);
        time + error.map_or(0, |error| error.at(time - EPOCH))
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
        self.check_agents()?;
        self.check_times()
    }

    fn check_times(&self) -> Result<(), Error> {
        let known = |field: &'static str, agent: &String| match self.agents.contains(agent) {
            true => Ok(()),
            false => Err(Error::NotAnAgent {
                field,
                agent: agent.clone(),
                agents: self.agents.join(", "),
            }),
        };
        for (agent, phase) in &self.sweep_phase_ms {
            known("sweep_phase_ms", agent)?;
            let fits = (0.0..100.0).contains(phase);
            require(fits, "sweep_phase_ms", *phase, "ms within [0, 100)")?;
        }
        for (agent, error) in &self.clock_errors {
            known("clock_errors", agent)?;
            require(
                error.drift.abs() <= 0.01,
                "clock_errors.drift",
                error.drift,
                "s/s within ±0.01",
            )?;
            // What a log can hold: seconds of 31 bits since 1970.
            let latest = from_seconds(self.seconds) + 10 * SWEEP_PERIOD;
            let times = [0, error.step_at, latest].map(|since| since.clamp(0, latest));
            for since in times {
                let stamp = EPOCH.saturating_add(error.at(since)) - SWEEP_PERIOD;
                let fits = (0..LAST_STAMP).contains(&stamp);
                let offset = 1e3 * to_seconds(error.offset);
                require(
                    fits,
                    "clock_errors.offset",
                    offset,
                    "ms that keep stamps within 1970 to 2038",
                )?;
            }
        }
        Ok(())
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
        let cases: [Case; 17] = [
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
            (|o| _ = o.sweep_phase_ms.insert("cav1".into(), 100.0), "sweep_phase_ms"),
            (
                |o| _ = o.sweep_phase_ms.insert("cav3".into(), 1.0),
                "`cav3` does not record",
            ),
            (
                |o| {
                    let off = ClockError {
                        offset: -EPOCH,
                        ..ClockError::default()
                    };
                    o.clock_errors.insert("cav1".into(), off);
                },
                "clock_errors.offset",
            ),
            (
                |o| {
                    let fast = ClockError {
                        drift: 0.5,
                        ..ClockError::default()
                    };
                    o.clock_errors.insert("rsu1".into(), fast);
                },
                "clock_errors.drift",
            ),
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
