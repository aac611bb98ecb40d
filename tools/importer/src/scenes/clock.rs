//! Times of frames that have numbers only.

use std::collections::BTreeMap;

use realo_schemas::Nanos;

use super::{Scene, SweepFiles};
use crate::Options;

const SECOND: Nanos = 1_000_000_000;
/// 1 January 2020, where a scene has no date, ns since 1970.
const NO_DATE: Nanos = 1_577_836_800 * SECOND;

/// Stamps of a scene's frames.
#[derive(Clone, Debug, PartialEq)]
pub struct Clock {
    start: Nanos,
    /// Number of the scene's first frame.
    first: u64,
    /// By how many the number of a frame exceeds the number of the frame before.
    pub step: u64,
    /// Duration of a sweep.
    pub period: Nanos,
    times: Times,
}

/// What times a data set has.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Times {
    /// None: numbers of frames stand for them.
    Numbers,
    /// Since the first frame.
    SinceFirst,
    /// Of the day.
    Stamps,
}

impl Clock {
    /// The clock of a whole scene, whatever part of it is wanted: its parts fit together.
    pub fn of(scene: &Scene, options: &Options) -> Self {
        let numbers: BTreeMap<u64, ()> = scene
            .agents
            .iter()
            .flat_map(|agent| agent.sweeps.keys().map(|number| (*number, ())))
            .collect();
        let has = |is: &dyn Fn(&SweepFiles) -> bool| scene.agents.iter().any(|agent| agent.sweeps.values().any(is));
        Clock {
            start: start(&scene.name),
            first: numbers.keys().next().copied().unwrap_or(0),
            step: commonest_step(numbers.keys().copied()),
            period: (1e9 / options.rate_hz).round() as Nanos,
            times: match (
                has(&|files| files.at.is_some()),
                has(&|files| files.since_first.is_some()),
            ) {
                (true, _) => Times::Stamps,
                (false, true) => Times::SinceFirst,
                (false, false) => Times::Numbers,
            },
        }
    }

    /// Stamp of a frame, ns; a time that is recorded counts before a number.
    pub fn stamp(&self, number: u64, files: &SweepFiles) -> Nanos {
        if let Some(at) = files.at {
            return at;
        }
        let by_number = || {
            let since = i128::from(number - self.first.min(number)) * i128::from(self.period) / i128::from(self.step);
            Nanos::try_from(since).unwrap_or(Nanos::MAX)
        };
        self.start.saturating_add(files.since_first.unwrap_or_else(by_number))
    }

    /// In words.
    pub fn words(&self, options: &Options) -> String {
        let Clock { first, step, .. } = self;
        let (end, seconds) = (options.stamp.as_str(), self.period as f64 / 1e9);
        let sweep = format!("a stamp is the {end} of its sweep, which takes {seconds:.4} s (--stamp, --rate)");
        let since_1970 = self.start / SECOND;
        let begin = match self.start == NO_DATE {
            true => "1 January 2020, for the scene's name has no date".into(),
            false => format!("the date in the scene's name, taken as UTC ({since_1970} s since 1970)"),
        };
        match self.times {
            Times::Stamps => format!("stamps: those of the data set; {sweep}"),
            Times::SinceFirst => format!("stamps: times of the data set count from {begin}; {sweep}"),
            Times::Numbers => format!(
                "stamps: number {first} is at {begin}; numbers rise by {step} each {seconds:.4} s; a stamp is the {end} of its sweep \
                 (--rate, --stamp)"
            ),
        }
    }
}

/// The commonest difference of numbers that rise; 1 without any.
fn commonest_step(numbers: impl Iterator<Item = u64>) -> u64 {
    let (mut counts, mut before) = (BTreeMap::<u64, usize>::new(), None);
    for number in numbers {
        if let Some(before) = before.replace(number) {
            *counts.entry(number - before).or_default() += 1;
        }
    }
    // Of two that are as common, the smaller.
    let common = counts.iter().rev().max_by_key(|(_, count)| **count);
    common.map_or(1, |(step, _)| (*step).max(1))
}

/// The date in the name of a scene, as `2021_08_18_19_48_05` or `2023-03-17-15-53-02_1_0`, ns since 1970.
fn start(name: &str) -> Nanos {
    let of_part = |part: &str| {
        let numbers: Vec<i64> = part
            .split(|c: char| !c.is_ascii_digit())
            .filter(|digits| !digits.is_empty())
            .map_while(|digits| digits.parse().ok())
            .collect();
        numbers.windows(6).find_map(|six| date(six.try_into().ok()?))
    };
    name.rsplit('/').find_map(of_part).unwrap_or(NO_DATE)
}

/// A date and time of the civil calendar, UTC, ns since 1970; `None` if it is none after 2000.
fn date([year, month, day, hour, minute, second]: [i64; 6]) -> Option<Nanos> {
    let fits = (2000..2038).contains(&year)
        && (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && (0..24).contains(&hour)
        && (0..60).contains(&minute)
        && (0..=60).contains(&second);
    if !fits {
        return None;
    }
    // Years begin in March, so that the day that leaps is the last.
    let (year, month) = if month > 2 {
        (year, month - 3)
    } else {
        (year - 1, month + 9)
    };
    let days = 365 * year + year / 4 - year / 100 + year / 400 + (153 * month + 2) / 5 + day - 1 - 719_468;
    Some((((days * 24 + hour) * 60 + minute) * 60 + second) * SECOND)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_date_of_a_scene_is_where_its_clock_begins() {
        assert_eq!(start("train/2021_08_18_19_48_05"), 1_629_316_085 * SECOND);
        assert_eq!(start("test/2023-03-17-15-53-02_1_0"), 1_679_068_382 * SECOND);
        assert_eq!(
            start("testoutput_CAV_data_2022-03-15-09-54-40_1"),
            1_647_338_080 * SECOND
        );
        assert_eq!(start("train/scene 7"), NO_DATE);
        assert_eq!(start("2021_13_18_19_48_05"), NO_DATE);
    }

    #[test]
    fn numbers_that_step_by_two_are_one_sweep_apart() {
        assert_eq!(commonest_step([68, 70, 72, 76].into_iter()), 2);
        assert_eq!(commonest_step([5].into_iter()), 1);
        let clock = Clock {
            start: 0,
            first: 68,
            step: 2,
            period: SECOND / 10,
            times: Times::Numbers,
        };
        let files = SweepFiles::default();
        assert_eq!(
            [68, 70, 76].map(|number| clock.stamp(number, &files)),
            [0, SECOND / 10, 4 * SECOND / 10]
        );
    }
}
