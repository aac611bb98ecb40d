//! What is known of the clocks of an agent's sensors.

use std::collections::{BTreeMap, VecDeque};

use realo_schemas::geometry::yaw_of;
use realo_schemas::motion::Taken;
use realo_schemas::report::{self, OffsetBy};
use realo_schemas::{AgentState, Header, Motion, Nanos, to_millis};
use realo_time_offset::{
    Epoch, Handling, Heading, Middles, MotionLimits, Offset, Sensor, SensorClock, StampFault, Watched, YawRate,
    motion_offset,
};

/// Over which arrivals and motion are looked at, ns.
const WINDOW: Nanos = 60_000_000_000;
/// Rates that are kept at most.
const RATES: usize = 8_192;
/// Headings are at least so far apart, ns: ten a second.
const HEADING_PERIOD: Nanos = 95_000_000;
/// Least times from the end of measuring to the arrival that are usual, ms. Within it an offset cannot be told from a delay.
const GNSS_DELAY: [f64; 2] = [0.0, 300.0];
const WHEELS_DELAY: [f64; 2] = [0.0, 50.0];
const POSES_DELAY: [f64; 2] = [0.0, 200.0];

/// How clocks are judged.
#[derive(Clone, Copy, Debug)]
pub struct ClockRules {
    /// What becomes of messages whose stamps are wrong.
    pub handling: Handling,
    /// Least time from a sweep's last point to its arrival, ms: from, to.
    pub lidar_delay: [f64; 2],
    /// The same from a sample of the inertial unit.
    pub imu_delay: [f64; 2],
}

impl ClockRules {
    fn clock(&self, sensor: Sensor) -> ClockSeen {
        let delay = match sensor {
            Sensor::Lidar => self.lidar_delay,
            Sensor::Imu => self.imu_delay,
            Sensor::Poses => POSES_DELAY,
            Sensor::Gnss => GNSS_DELAY,
            Sensor::Wheels => WHEELS_DELAY,
        };
        let delay = delay.map(|millis| realo_schemas::from_seconds(1e-3 * millis));
        ClockSeen {
            clock: SensorClock::new(self.handling, delay, WINDOW),
            messages: 0,
            arrives: false,
        }
    }
}

/// A clock, and the messages that were seen of it.
#[derive(Clone, Debug)]
struct ClockSeen {
    clock: SensorClock,
    messages: u64,
    /// Whether a message arrived at another time than it is stamped with. Where none does, arrivals are no measurements: so it is
    /// offline, and in logs that were written without a time of arrival.
    arrives: bool,
}

impl ClockSeen {
    fn by_arrival(&self) -> Option<Offset> {
        self.clock.by_arrival().filter(|_| self.arrives)
    }
}

/// The clocks of one agent's sensors, and the turning that two of them see.
#[derive(Clone, Debug)]
pub struct AgentClocks {
    rules: ClockRules,
    sensors: BTreeMap<Sensor, ClockSeen>,
    rates: VecDeque<YawRate>,
    headings: VecDeque<Heading>,
}

impl AgentClocks {
    /// Clocks of which nothing is known.
    pub fn new(rules: ClockRules) -> Self {
        AgentClocks {
            rules,
            sensors: BTreeMap::new(),
            rates: VecDeque::new(),
            headings: VecDeque::new(),
        }
    }

    /// Takes the stamp of a sensor's message that lasted for so long after it; what the stamp is taken for.
    pub fn take(&mut self, sensor: Sensor, stamp: Nanos, lasts: Nanos, arrival: Nanos) -> Watched {
        let rules = &self.rules;
        let seen = self.sensors.entry(sensor).or_insert_with(|| rules.clock(sensor));
        seen.messages += 1;
        seen.arrives |= stamp != arrival;
        let watched = seen.clock.take(stamp, lasts, arrival);
        // What was turned by another clock is no part of the same curve.
        match sensor {
            Sensor::Imu if watched.is_new_clock => self.rates.clear(),
            Sensor::Poses if watched.is_new_clock => self.headings.clear(),
            _ => {}
        }
        watched
    }

    /// Takes a pose, by the stamp that it was written with.
    pub fn turn_of_pose(&mut self, stamp: Nanos, state: &AgentState) {
        let is_due = self
            .headings
            .back()
            .is_none_or(|last| stamp.saturating_sub(last.stamp) >= HEADING_PERIOD);
        if is_due {
            let yaw = yaw_of(&state.map_from_body.rotation);
            self.headings.push_back(Heading { stamp, yaw });
        }
        while self.headings.front().is_some_and(|first| is_old(first.stamp, stamp)) {
            self.headings.pop_front();
        }
    }

    /// Takes what an agent's motion sensors measured.
    pub fn take_motion(&mut self, header: &Header, motion: &Motion) {
        let times = |taken: &Taken| (taken.stamp_in(header), taken.arrival_in(header));
        for sample in &motion.imu {
            let (stamp, arrival) = times(&sample.taken);
            let watched = self.take(Sensor::Imu, stamp, 0, arrival);
            let rises = self.rates.back().is_none_or(|last| stamp > last.stamp);
            if watched.is_of_the_clock() && rises {
                let rate = sample.angular_rate[2];
                self.rates.push_back(YawRate { stamp, rate });
            }
            while self.rates.len() > RATES || self.rates.front().is_some_and(|first| is_old(first.stamp, stamp)) {
                self.rates.pop_front();
            }
        }
        for fix in &motion.fixes {
            let (stamp, arrival) = times(&fix.taken);
            self.take(Sensor::Gnss, stamp, 0, arrival);
        }
        for wheels in &motion.wheels {
            let (stamp, arrival) = times(&wheels.taken);
            self.take(Sensor::Wheels, stamp, 0, arrival);
        }
    }

    /// What is to be added to stamps of the inertial unit to have those of the poses, where both saw the agent turn.
    fn imu_to_poses(&self) -> Option<Offset> {
        let mut middles = Middles::default();
        let in_the_middle = |rate: &YawRate| YawRate {
            stamp: middles.of(rate.stamp),
            ..*rate
        };
        let rates: Vec<YawRate> = self.rates.iter().map(in_the_middle).collect();
        let headings: Vec<Heading> = self.headings.iter().copied().collect();
        motion_offset(&rates, &headings, &MotionLimits::default()).ok()
    }

    /// What is known of all clocks.
    pub fn report(&mut self, agent: &str) -> Vec<report::SensorClock> {
        let apart = self.imu_to_poses();
        if let Some(apart) = apart {
            self.share(&apart);
        }
        let entries = self.sensors.iter().map(|(sensor, seen)| {
            let apart = apart.filter(|_| *sensor == Sensor::Imu);
            entry(agent, *sensor, seen, apart)
        });
        entries.collect()
    }

    /// What arrivals say of one of the two that saw the agent turn is known of the other too.
    fn share(&mut self, apart: &Offset) {
        let of = |sensor: Sensor| self.sensors.get(&sensor).and_then(ClockSeen::by_arrival);
        let (imu, poses) = (of(Sensor::Imu), of(Sensor::Poses));
        let moved = |known: Offset, by: Nanos| Offset {
            offset: known.offset.saturating_add(by),
            bound: known.bound.saturating_add(apart.bound),
            ..known
        };
        let shared = [
            (Sensor::Poses, imu.map(|imu| moved(imu, -apart.offset))),
            (Sensor::Imu, poses.map(|poses| moved(poses, apart.offset))),
        ];
        for (sensor, offset) in shared {
            if let (Some(seen), Some(offset)) = (self.sensors.get_mut(&sensor), offset) {
                seen.clock.set_motion(offset);
            }
        }
    }
}

fn is_old(first: Nanos, now: Nanos) -> bool {
    now.saturating_sub(first) > WINDOW
}

/// What a result has of a clock.
fn entry(agent: &str, sensor: Sensor, seen: &ClockSeen, apart: Option<Offset>) -> report::SensorClock {
    let judged = seen.clock.judged();
    // Without arrivals only what the other sensor says counts.
    let offset = judged.and_then(|judged| judged.offset.filter(|_| seen.arrives || judged.is_by_motion));
    let is_by_motion = judged.is_some_and(|judged| judged.is_by_motion);
    let counts = judged.map_or(Epoch::Same, |judged| judged.epoch);
    let step = seen.clock.last_step();
    report::SensorClock {
        agent: agent.into(),
        sensor: sensor.name().into(),
        messages: seen.messages,
        offset_ms: offset.map(|offset| to_millis(offset.offset)),
        bound_ms: offset.map(|offset| to_millis(offset.bound)),
        drift_ms_s: offset.map(|offset| offset.drift * 1e-6).filter(|drift| *drift != 0.0),
        by: offset.map(|_| {
            if is_by_motion {
                OffsetBy::Motion
            } else {
                OffsetBy::Arrival
            }
        }),
        to_poses_ms: apart.map(|apart| to_millis(apart.offset)),
        to_poses_bound_ms: apart.map(|apart| to_millis(apart.bound)),
        contradicted: seen.arrives && judged.is_some_and(|judged| judged.is_contradicted),
        counts: counts.name().map(String::from),
        step_ms: (step != 0).then(|| to_millis(step)),
        faults: seen
            .clock
            .faults()
            .seen()
            .map(|(fault, n)| (fault.name().into(), n))
            .collect(),
    }
}

/// What is wrong with a stamp, in words.
pub fn fault_words(sensor: Sensor, watched: &Watched, stamp: Nanos, arrival: Nanos) -> String {
    let what = match watched.fault {
        Some(StampFault::Repeated) => "that of the message before".into(),
        Some(StampFault::StandsStill) => "the same five times or more".into(),
        Some(StampFault::Backwards) => "before that of the message before".into(),
        Some(StampFault::Ahead) => "earlier than the message can be".into(),
        Some(StampFault::Jump) => "of a clock that stepped".into(),
        Some(StampFault::Boot) => "counted from boot".into(),
        Some(StampFault::Tai) => "TAI, 37 s ahead".into(),
        Some(StampFault::Gps) => "GPS time, 18 s ahead".into(),
        Some(StampFault::Weeks) => "some 1,024 weeks off".into(),
        Some(StampFault::Unknown) | None => {
            let ahead = realo_schemas::to_seconds(stamp.saturating_sub(arrival));
            format!("{ahead:.3} s after the arrival")
        }
    };
    format!("{}: stamp {what}", sensor.name())
}
