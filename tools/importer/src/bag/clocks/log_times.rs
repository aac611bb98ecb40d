//! How far the stamps of agents are from the times when their messages were recorded.

use std::collections::BTreeMap;

use realo_bags::map_file::PoseSource;
use realo_logs::kind_of_clock;
use realo_schemas::{Nanos, to_millis, to_seconds};

use super::super::Import;
use super::super::small::{At, Small};
use super::{ONE_CLOCK, median};

const SECOND: Nanos = 1_000_000_000;
const HOUR: Nanos = 3600 * SECOND;
/// What is not known of a delay is mostly less, ns.
const UNKNOWN_DELAY: Nanos = 100_000_000;
/// The least bound that is printed, ns.
const LEAST_BOUND: Nanos = 1_000_000;
/// Clocks that differ by leap seconds differ by less, ns.
const LEAPS: Nanos = 60 * SECOND;

/// What messages are of. A sweep ends with its last point, where points have times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Sort {
    Inertial,
    Wheels,
    Poses,
    Positions,
    SweepEnds,
    Clouds,
}

impl Sort {
    fn words(self) -> &'static str {
        match self {
            Sort::Inertial => "the inertial unit",
            Sort::Wheels => "the wheels",
            Sort::Poses => "the poses",
            Sort::Positions => "the positions",
            Sort::SweepEnds => "the ends of sweeps",
            Sort::Clouds => "the clouds",
        }
    }
}

/// Log times less stamps of messages, ns.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Delay {
    least: Nanos,
    /// Median less least.
    jitter: Nanos,
}

/// The delays of an agent's messages that have the clock of its clouds.
struct Delays {
    by: BTreeMap<Sort, Delay>,
    /// Log time of the first cloud, ns.
    at: Nanos,
    /// Median of the first clouds, ns.
    of_clouds: Nanos,
}

impl Delays {
    fn of(import: &Import, small: &Small, place: usize) -> Delays {
        let (agent, ours) = (&import.agents[place], &small.agents[place]);
        let clouds: Vec<[Nanos; 2]> = ours.heads.iter().flat_map(|heads| heads.stamps.clone()).collect();
        let mut late: Vec<Nanos> = clouds.iter().map(|times| delay(*times)).collect();
        let mut delays = Delays {
            by: BTreeMap::new(),
            at: clouds.first().map_or(0, |[_, log_time]| *log_time),
            of_clouds: median(&mut late).unwrap_or(0),
        };
        delays.add(Sort::Clouds, clouds.into_iter());
        let timed = ours.heads.iter().filter(|heads| heads.times.is_some());
        let ends = timed.flat_map(|heads| {
            let end = |[stamp, log_time]: &[Nanos; 2]| [stamp.saturating_add(heads.lasts), *log_time];
            heads.stamps.iter().map(end).collect::<Vec<_>>()
        });
        delays.add(Sort::SweepEnds, ends);
        delays.add(Sort::Poses, times(&ours.poses, |pose| pose.stamp));
        if agent.map.pose == PoseSource::Tf {
            let moving = small.bags[agent.bag].moving.iter();
            delays.add(Sort::Poses, moving.map(|(stamp, log_time)| [*stamp, *log_time]));
        }
        delays.add(Sort::Inertial, times(&ours.motion.imu, |said| said.stamp));
        delays.add(Sort::Positions, times(&ours.motion.fixes, |said| said.stamp));
        delays.add(Sort::Wheels, times(&ours.motion.wheels, |said| said.stamp));
        delays
    }

    /// Adds stamps with log times; those of another clock than the clouds' are left out.
    fn add(&mut self, sort: Sort, times: impl Iterator<Item = [Nanos; 2]>) {
        let is_near = |late: &Nanos| late.saturating_sub(self.of_clouds).saturating_abs() <= ONE_CLOCK;
        let mut late: Vec<Nanos> = times.map(delay).filter(is_near).collect();
        if let Some(usual) = median(&mut late) {
            let least = late[0];
            let jitter = usual.saturating_sub(least);
            self.by.insert(sort, Delay { least, jitter });
        }
    }

    /// The messages that were recorded the soonest.
    fn quickest(&self) -> (Sort, Delay) {
        let quickest = self.by.iter().min_by_key(|(_, delay)| delay.least);
        let none = (Sort::Clouds, Delay { least: 0, jitter: 0 });
        quickest.map_or(none, |(sort, delay)| (*sort, *delay))
    }

    /// Whether stamps and log times are of one clock.
    fn is_in_step(&self) -> bool {
        self.quickest().1.least.saturating_abs() <= ONE_CLOCK
    }

    /// What is added to stamps where the kind of their clock says it to the second, ns, with the kind.
    fn known(&self) -> Option<(Nanos, String)> {
        let least = self.quickest().1.least;
        let kind = kind_of_clock(self.at.saturating_sub(least), self.at)?;
        let shift = (least as f64 / SECOND as f64).round() as Nanos * SECOND;
        // A clock that counts from a start says another time an hour later.
        let later = self.at.saturating_add(HOUR);
        let is_exact = kind_of_clock(later.saturating_sub(shift), later).as_ref() == Some(&kind);
        (is_exact && !self.is_in_step()).then_some((shift, kind))
    }

    /// What is added to stamps so that they are of the clock of the log times, by this agent alone, and what may be wrong with it, ns.
    fn own_to_log(&self) -> (Nanos, Nanos) {
        match self.known() {
            _ if self.is_in_step() => (0, 0),
            Some((shift, _)) => (shift, 0),
            None => (self.quickest().1.least, UNKNOWN_DELAY),
        }
    }
}

fn delay([stamp, log_time]: [Nanos; 2]) -> Nanos {
    log_time.saturating_sub(stamp)
}

fn times<T>(messages: &[At<T>], stamp: impl Fn(&T) -> Nanos) -> impl Iterator<Item = [Nanos; 2]> {
    messages
        .iter()
        .map(move |message| [stamp(&message.said), message.log_time])
}

/// How the stamps of an agent are brought to the clock of its log times.
#[derive(Clone, Debug, PartialEq)]
pub struct ToLog {
    /// What is added to them, ns.
    pub shift: Nanos,
    /// How it was found, with a bound.
    pub words: String,
    /// Whether stamps are ahead by leap seconds.
    pub is_leap: bool,
}

/// What log times say of the clocks of all agents.
pub struct LogTimes<'a> {
    import: &'a Import,
    delays: Vec<Delays>,
    /// The agent that the others are compared with.
    pub reference: usize,
}

impl<'a> LogTimes<'a> {
    /// Of what bags say. The reference is the first agent whose stamps are in step with its log times; else the first one whose kind of
    /// clock is known, or the first of all.
    pub fn new(import: &'a Import, small: &Small) -> Self {
        let delays: Vec<Delays> = (0..import.agents.len())
            .map(|place| Delays::of(import, small, place))
            .collect();
        let in_step = delays.iter().position(Delays::is_in_step);
        let known = || delays.iter().position(|delays| delays.known().is_some());
        LogTimes {
            reference: in_step.or_else(known).unwrap_or(0),
            import,
            delays,
        }
    }

    /// Whether the stamps of the reference are in step with its log times.
    pub fn has_reference_in_step(&self) -> bool {
        self.delays[self.reference].is_in_step()
    }

    /// How an agent's stamps are brought to its log times; `None` where they are in step.
    pub fn to_log(&self, place: usize) -> Option<ToLog> {
        let delays = &self.delays[place];
        if delays.is_in_step() {
            return None;
        }
        let (measured, bound, by) = self.measured(place);
        let measured_words = format!(
            "{:+.3} s ± {} ms by log times of {by}",
            to_seconds(measured),
            millis(bound)
        );
        Some(match delays.known() {
            Some((shift, kind)) => ToLog {
                shift,
                words: format!(
                    "{:+.3} s, because its clock looks like {kind} ({measured_words})",
                    to_seconds(shift)
                ),
                is_leap: (-LEAPS..0).contains(&shift),
            },
            None => ToLog {
                shift: measured,
                words: measured_words,
                is_leap: false,
            },
        })
    }

    /// What log times say is to be added to an agent's stamps, its bound, both ns, and by which messages.
    fn measured(&self, place: usize) -> (Nanos, Nanos, String) {
        let (own, reference) = (&self.delays[place], &self.delays[self.reference]);
        let (to_log, unknown) = reference.own_to_log();
        let both = own.by.iter().filter_map(|(sort, delay)| {
            let other = reference.by.get(sort).filter(|_| place != self.reference)?;
            let takes = other.least.saturating_sub(to_log);
            let bounds = [delay.jitter, other.jitter, takes.saturating_abs(), unknown];
            let bound = bounds.into_iter().fold(0, Nanos::saturating_add);
            Some((delay.least.saturating_sub(takes), bound, *sort))
        });
        if let Some((measured, bound, sort)) = both.min_by_key(|(_, bound, _)| *bound) {
            let name = &self.import.agents[self.reference].name;
            let by = format!("{}, which take as long as those of `{name}`", sort.words());
            return (measured, bound, by);
        }
        let (sort, delay) = own.quickest();
        let by = format!("{}, of which the quickest is taken as recorded at once", sort.words());
        (delay.least, delay.jitter.saturating_add(UNKNOWN_DELAY), by)
    }
}

/// Whole milliseconds of a bound.
fn millis(bound: Nanos) -> i64 {
    to_millis(bound.max(LEAST_BOUND)).ceil() as i64
}
