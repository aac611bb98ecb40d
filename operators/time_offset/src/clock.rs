use realo_schemas::Nanos;

use crate::{ArrivalOffset, Epoch, Handling, Offset, StampFaults, StampWatch, Watched};

/// A sensor whose messages have stamps of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Sensor {
    /// LiDAR: sweeps.
    Lidar,
    /// Whatever gives the agent's poses.
    Poses,
    /// Inertial unit.
    Imu,
    /// Satellite receiver.
    Gnss,
    /// Speed of the wheels.
    Wheels,
}

impl Sensor {
    /// Its name in results.
    pub fn name(self) -> &'static str {
        match self {
            Sensor::Lidar => "lidar",
            Sensor::Poses => "poses",
            Sensor::Imu => "imu",
            Sensor::Gnss => "gnss",
            Sensor::Wheels => "wheels",
        }
    }
}

/// The clock of one sensor: its stamps are watched, and its offset estimated.
#[derive(Clone, Debug)]
pub struct SensorClock {
    watch: StampWatch,
    arrival: ArrivalOffset,
    motion: Option<Offset>,
}

/// What is known of a clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// What it counts.
    pub epoch: Epoch,
    /// What is to be added to the sensor's own stamps, with the smaller bound of both ways; `None` while neither shows it.
    pub offset: Option<Offset>,
    /// Whether motion gave it.
    pub is_by_motion: bool,
    /// Whether arrivals and motion contradict each other: one of the two assumptions, the least delay or the common motion, is
    /// wrong.
    pub is_contradicted: bool,
}

impl SensorClock {
    /// A clock of which nothing is known. `least_delay`: range of the least time from stamp to arrival, ns; `window`: over which
    /// arrivals are looked at, ns.
    pub fn new(handling: Handling, least_delay: [Nanos; 2], window: Nanos) -> Self {
        SensorClock {
            watch: StampWatch::new(handling),
            arrival: ArrivalOffset::new(least_delay, window),
            motion: None,
        }
    }

    /// Takes a message: what its stamp is taken for. `lasts`: measuring went on for so long after the stamp, ns, before which the
    /// message cannot have arrived.
    pub fn take(&mut self, stamp: Nanos, lasts: Nanos, arrival: Nanos) -> Watched {
        let watched = self.watch.take(stamp, arrival);
        if watched.is_new_clock {
            self.arrival.restart();
            self.motion = None;
        }
        if watched.is_of_the_clock() {
            self.arrival.take(stamp.saturating_add(lasts), arrival);
        }
        watched
    }

    /// Takes what motion says of the offset of the sensor's own stamps, against the reference clock.
    pub fn set_motion(&mut self, offset: Offset) {
        self.motion = Some(offset);
    }

    /// The offset by arrivals alone.
    pub fn by_arrival(&self) -> Option<Offset> {
        self.arrival.offset()
    }

    /// What is known of the clock; `None` before its first message.
    pub fn judged(&self) -> Option<Judged> {
        let epoch = self.watch.epoch()?;
        let arrival = self.arrival.offset();
        let (offset, is_by_motion, is_contradicted) = match (arrival, self.motion) {
            (Some(arrival), Some(motion)) => {
                let is_better = motion.bound < arrival.bound;
                let better = if is_better { motion } else { arrival };
                (Some(better), is_better, !motion.agrees(&arrival))
            }
            (arrival, motion) => (arrival.or(motion), arrival.is_none() && motion.is_some(), false),
        };
        Some(Judged {
            epoch,
            offset,
            is_by_motion,
            is_contradicted,
        })
    }

    /// What was wrong with stamps so far.
    pub fn faults(&self) -> StampFaults {
        self.watch.faults()
    }

    /// By how much the clock stepped last, ns; 0 where it never did.
    pub fn last_step(&self) -> Nanos {
        self.watch.last_step()
    }
}
