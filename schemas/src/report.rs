//! What stages say of messages that cross a link, and documents as JSON in a [`crate::Report`].

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{Header, Kind, Name, Nanos, Report};

/// What became of a message that crossed a link. The first that fits is the message's fate, so that joining what several
/// stages say of it is a minimum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// In at least one fusion that took place.
    Used,
    /// Skipped by a busy stage, or only in Selections that were.
    Skipped,
    /// Only in fusions that took no more collaborators.
    OverLimit,
    /// Left out by a guard, because the ego could not confirm it or saw that it is not so.
    Distrusted,
    /// Older than the window when asked for.
    Stale,
    /// A newer one of its sender took its place, or it came older than what was held.
    Superseded,
    /// The channel dropped it.
    Lost,
    /// A stage or a fusion could not take it.
    Rejected,
    /// Never asked for, after the last query.
    InFlight,
}

impl Fate {
    /// All, in the order in which they are tried.
    pub const ALL: [Fate; 9] = [
        Fate::Used,
        Fate::Skipped,
        Fate::OverLimit,
        Fate::Distrusted,
        Fate::Stale,
        Fate::Superseded,
        Fate::Lost,
        Fate::Rejected,
        Fate::InFlight,
    ];
}

/// One message to one receiver, as accounting names it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Crossing {
    /// Its sender.
    pub from: String,
    /// Its receiver.
    pub to: String,
    /// Its kind.
    pub kind: Kind,
    /// Its number, per sender and kind.
    pub seq: u64,
}

impl Crossing {
    /// The message of a header; `None` for one that crossed no link.
    pub fn of(header: &Header) -> Option<Self> {
        Some(Crossing {
            from: header.agent.to_string(),
            to: header.to.as_ref()?.to_string(),
            kind: header.kind,
            seq: header.seq,
        })
    }
}

/// A fusion in which a message took part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Use {
    /// Number of the ego's message.
    pub query: u64,
    /// From the message's stamp to when the ego's message was ready, ns; offline it may be negative.
    pub age_ns: Nanos,
}

/// How a message entered its channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// Its payload bytes.
    pub bytes: u64,
    /// When it entered, or came where only that is known, ns.
    pub at_ns: Nanos,
}

/// What a stage said of a message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fated {
    /// The message.
    #[serde(flatten)]
    pub message: Crossing,
    /// What became of it.
    pub fate: Fate,
    /// Of [`Fate::Used`], the fusion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub r#use: Option<Use>,
    /// Only that the message entered its channel: nothing has become of it yet, and accounts wait for who says what.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub entry: Option<Entry>,
}

impl Fated {
    /// What became of a message, if it crossed a link.
    pub fn of(header: &Header, fate: Fate) -> Option<Self> {
        let message = Crossing::of(header)?;
        Some(Fated {
            message,
            fate,
            r#use: None,
            entry: None,
        })
    }

    /// That a message entered its channel.
    pub fn entered(header: &Header, entry: Entry) -> Option<Self> {
        Some(Fated {
            entry: Some(entry),
            ..Fated::of(header, Fate::InFlight)?
        })
    }
}

/// What one channel carried.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Channel {
    /// Sender.
    pub from: String,
    /// Receiver.
    pub to: String,
    /// What was sent.
    pub kind: Kind,
    /// What crossed.
    #[serde(flatten)]
    pub traffic: Traffic,
}

/// Messages and bytes of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Traffic {
    /// Messages that entered the channel.
    pub sent: u64,
    /// Their payload bytes.
    pub bytes: u64,
    /// Extra copies that the channel delivered.
    pub duplicated: u64,
    /// Messages that were not sent because the receiver was out of range.
    pub out_of_range: u64,
}

impl Traffic {
    /// Adds the traffic of other books.
    pub fn add(&mut self, other: &Traffic) {
        self.sent += other.sent;
        self.bytes += other.bytes;
        self.duplicated += other.duplicated;
        self.out_of_range += other.out_of_range;
    }
}

/// Topic of the reports to a sender about its own packets, an [`OnAir`] each.
pub const ON_AIR: &str = "on_air";

/// What a sender's radio knows of a packet that it took: when it had crossed, and how busy the channel was before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnAir {
    /// Bytes of the packet.
    pub bytes: u64,
    /// Whether it was dropped, because it would have waited too long before the channel.
    pub dropped: bool,
    /// Time that its own bytes took on the channel, ns; 0 of one that was dropped, and where bytes take no time.
    pub air_ns: Nanos,
    /// Time since the sender's packet before it had crossed, ns; 0 where there was none.
    pub span_ns: Nanos,
    /// The part of `span_ns` in which the channel was taken, whoever sent, ns.
    pub busy_ns: Nanos,
}

/// Topic of the reports about the agents on other machines, a list of [`Peer`].
pub const PEERS: &str = "peers";

/// How the offset of a peer's clock was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockBy {
    /// By questions and answers about the time.
    Exchanges,
    /// By what both machines say, whose clocks GNSS, PTP or NTP synchronise.
    Machines,
}

/// What an agent knows of one on another machine.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Peer {
    /// Its name.
    pub name: String,
    /// Messages that came from it.
    pub messages: u64,
    /// Its clock minus this agent's at the end, ms.
    pub clock_ms: Option<f64>,
    /// What that is likely off by, ms.
    pub clock_uncertainty_ms: Option<f64>,
    /// What its clock gains on this agent's, ms in a second.
    pub clock_drift_ms_s: Option<f64>,
    /// Where these three are from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_by: Option<ClockBy>,
    /// By how much exchanges contradict what the two machines say of their clocks, one of which is wrong, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock_contradiction_ms: Option<f64>,
    /// Smallest round trip of late, of parts or, where none was sent, of questions about the time, ms.
    pub round_trip_ms: Option<f64>,
    /// What the way to it was found to carry at the end, bits/s.
    pub bits_per_second: Option<f64>,
    /// What came in its name and was not taken, by reason.
    #[serde(default)]
    pub refused: BTreeMap<String, u64>,
    /// What the way from it was like, second by second.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub course: Vec<Phase>,
}

/// How the offset of a sensor's clock was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OffsetBy {
    /// By when its messages arrived.
    Arrival,
    /// By the turning that another sensor of the agent saw too, and when messages of that one arrived.
    Motion,
}

/// What a stage knows at the end of the clock of one sensor of an agent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorClock {
    /// The agent.
    pub agent: String,
    /// The sensor: `lidar`, `poses`, `imu`, `gnss` or `wheels`.
    pub sensor: String,
    /// Messages that came.
    pub messages: u64,
    /// What is to be added to its stamps to have the time by which messages arrive, ms; `None` while nothing shows it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset_ms: Option<f64>,
    /// The truth lies within so much of it in at least 95 % of cases, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bound_ms: Option<f64>,
    /// How fast it changes, ms in a second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drift_ms_s: Option<f64>,
    /// Where these three are from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<OffsetBy>,
    /// Of an IMU: what is to be added to its stamps to have those of the poses, by the turning that both see, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_poses_ms: Option<f64>,
    /// The truth lies within so much of it in at least 95 % of cases, ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub to_poses_bound_ms: Option<f64>,
    /// Whether arrivals and motion contradict each other.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub contradicted: bool,
    /// What the clock counts, where that is not the time by which messages arrive: `tai`, `gps`, `boot`, `weeks` or `other`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub counts: Option<String>,
    /// By how much it stepped last, ms; above 0 ahead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step_ms: Option<f64>,
    /// Messages by what is wrong with their stamps.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, u64>,
}

/// Offsets below this are not worth a word, ms.
const SMALL_MS: f64 = 1.0;

impl SensorClock {
    /// Whether it is surely off, steps, stands still or contradicts itself.
    pub fn is_notable(&self) -> bool {
        let off = self.offset_ms.zip(self.bound_ms);
        let apart = self.to_poses_ms.zip(self.to_poses_bound_ms);
        let surely = |(offset, bound): (f64, f64)| offset.abs() > bound + SMALL_MS;
        // A stamp now and then that comes twice is counted where it is left out.
        let often = |(fault, count): (&String, &u64)| match fault.as_str() {
            "stamp_repeated" | "stamp_backwards" | "stamp_ahead" => count.saturating_mul(20) > self.messages,
            _ => true,
        };
        self.contradicted
            || self.counts.is_some()
            || off.is_some_and(surely)
            || apart.is_some_and(surely)
            || self.faults.iter().any(often)
    }

    /// Whether these are the stamps as they were written, and `offset_ms` is what whoever plays the log adds to them.
    fn is_as_written(&self) -> bool {
        self.offset_ms.is_some() && self.by.is_none()
    }

    /// Takes in what another stage of the same run found of the same messages. Where one of the two put the stamps right and the other
    /// saw them so, the offset is that of the stamps as they were written.
    pub fn join(&mut self, other: &SensorClock) {
        let mut seen = other.clone();
        if other.is_as_written() && !self.is_as_written() {
            std::mem::swap(self, &mut seen);
        }
        let messages = self.messages.max(seen.messages);
        if self.is_as_written() && !seen.is_as_written() {
            for (fault, count) in &seen.faults {
                let known = self.faults.entry(fault.clone()).or_default();
                *known = known.saturating_add(*count);
            }
            let offset_ms = self.offset_ms.zip(seen.offset_ms).map(|(moved, left)| moved + left);
            let (counts, step_ms) = (self.counts.take(), self.step_ms.take());
            *self = SensorClock {
                offset_ms: offset_ms.or(self.offset_ms),
                counts: counts.or(seen.counts.take()),
                step_ms: step_ms.or(seen.step_ms.take()),
                faults: std::mem::take(&mut self.faults),
                ..seen
            };
        } else if seen.certainty() > self.certainty() || (self.offset_ms.is_none() && !self.is_notable()) {
            *self = seen;
        }
        self.messages = messages;
    }

    /// By which of two is told: what is worth a word, and is the more surely off.
    fn certainty(&self) -> (bool, f64) {
        let [offset, bound] = [self.offset_ms, self.bound_ms].map(|value| value.unwrap_or(0.0));
        (self.is_notable(), offset.abs() - bound)
    }

    /// Adds what another run found of the same clock: faults of both, and the offset that is more surely one.
    pub fn add(&mut self, other: &SensorClock) {
        let mut faults = std::mem::take(&mut self.faults);
        for (fault, count) in &other.faults {
            let known = faults.entry(fault.clone()).or_default();
            *known = known.saturating_add(*count);
        }
        let messages = self.messages.saturating_add(other.messages);
        if other.certainty() > self.certainty() || self.offset_ms.is_none() {
            self.clone_from(other);
        }
        (self.faults, self.messages) = (faults, messages);
    }
}

/// What a way between agents is like from a time on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Phase {
    /// Since the first one, s.
    pub seconds: f64,
    /// Rate, bit/s; 0: nothing crosses.
    pub bits_per_second: f64,
    /// What a message without bytes takes, ms.
    pub delay_ms: f64,
    /// Share of messages that are lost.
    pub loss: f64,
}

impl Phase {
    /// First line of a trace.
    pub const COLUMNS: &str = "seconds,bits_per_second,delay_ms,loss";

    /// Phases as a trace, which `link` replays.
    pub fn trace(phases: &[Phase]) -> String {
        let lines = phases.iter().map(|phase| {
            let Phase {
                seconds,
                bits_per_second,
                delay_ms,
                loss,
            } = phase;
            format!("{seconds},{bits_per_second:.0},{delay_ms:.3},{loss:.4}\n")
        });
        std::iter::once(format!("{}\n", Phase::COLUMNS)).chain(lines).collect()
    }
}

/// A report of a document.
pub fn to_report<T: Serialize>(topic: &str, document: &T) -> Report {
    let json = serde_json::to_string(document).expect("report documents have text keys only");
    Report {
        topic: Name::from(topic),
        json,
    }
}

/// The document of a report.
///
/// # Errors
/// What JSON says against it, with the topic.
pub fn from_report<'a, T: Deserialize<'a>>(report: &'a Report) -> Result<T, String> {
    serde_json::from_str(&report.json).map_err(|error| format!("report `{}`: {error}", report.topic))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(to: Option<&str>) -> Header {
        let mut header = Header::origin(&"run".into(), &"rsu1".into(), Kind::Features, 7, 10, 20);
        header.to = to.map(Name::from);
        header
    }

    fn crossing() -> Crossing {
        Crossing {
            from: "rsu1".into(),
            to: "cav1".into(),
            kind: Kind::Features,
            seq: 7,
        }
    }

    #[test]
    fn the_first_fate_that_fits_is_the_min() {
        assert!(Fate::ALL.is_sorted_by(|a, b| a < b));
        assert_eq!(Fate::Stale.min(Fate::OverLimit), Fate::OverLimit);
    }

    #[test]
    fn only_what_crossed_a_link_is_a_crossing() {
        assert_eq!(Crossing::of(&header(Some("cav1"))), Some(crossing()));
        assert_eq!(Crossing::of(&header(None)), None);
    }

    #[test]
    fn clocks_are_notable_where_they_are_surely_off() {
        let clock = |offset: f64, faults: &[(&str, u64)]| SensorClock {
            agent: "cav1".into(),
            sensor: "imu".into(),
            messages: 100,
            offset_ms: Some(offset),
            bound_ms: Some(3.0),
            faults: faults.iter().map(|(fault, n)| (fault.to_string(), *n)).collect(),
            ..SensorClock::default()
        };
        for (offset, faults, expected) in [
            (-3.9, &[][..], false),
            (4.1, &[], true),
            (0.0, &[("stamp_repeated", 5)], false),
            (0.0, &[("stamp_repeated", 6)], true),
            (0.0, &[("stamp_jump", 1)], true),
        ] {
            assert_eq!(clock(offset, faults).is_notable(), expected, "{offset} {faults:?}");
        }
        let mut sum = clock(1.0, &[("stamp_jump", 1)]);
        sum.add(&clock(-80.0, &[("stamp_jump", 2), ("stamp_tai", 3)]));
        sum.add(&clock(0.5, &[]));
        assert_eq!((sum.offset_ms, sum.messages), (Some(-80.0), 300));
        assert_eq!(sum.faults.values().copied().collect::<Vec<_>>(), [3, 3]);
    }

    #[test]
    fn one_run_s_messages_count_once_and_stamps_are_those_that_were_written() {
        let clock = |offset_ms: Option<f64>, faults: &[(&str, u64)]| SensorClock {
            agent: "cav2".into(),
            sensor: "imu".into(),
            messages: 100,
            offset_ms,
            faults: faults.iter().map(|(fault, n)| (fault.to_string(), *n)).collect(),
            ..SensorClock::default()
        };
        let moved = SensorClock {
            step_ms: Some(700.0),
            ..clock(Some(-700.0), &[("stamp_ahead", 1)])
        };
        let seen = SensorClock {
            messages: 99,
            bound_ms: Some(2.5),
            by: Some(OffsetBy::Arrival),
            ..clock(Some(-1.0), &[("stamp_repeated", 2)])
        };
        let unseen = SensorClock {
            messages: 99,
            ..clock(None, &[])
        };
        for stages in [[&moved, &seen, &seen], [&seen, &moved, &seen], [&seen, &seen, &moved]] {
            let mut sum = stages[0].clone();
            stages[1..].iter().for_each(|stage| sum.join(stage));
            assert_eq!((sum.messages, sum.step_ms), (100, Some(700.0)));
            assert_eq!((sum.offset_ms, sum.bound_ms), (Some(-701.0), Some(2.5)));
            assert_eq!(sum.faults.values().copied().collect::<Vec<_>>(), [1, 2]);
        }
        for [first, second] in [[&moved, &unseen], [&unseen, &moved]] {
            let mut sum = first.clone();
            sum.join(second);
            assert_eq!((sum.messages, sum.offset_ms, sum.bound_ms), (100, Some(-700.0), None));
            assert_eq!((sum.by, sum.step_ms), (None, Some(700.0)));
        }
    }

    #[test]
    fn traffic_adds_up_term_by_term() {
        let traffic = |n: u64| Traffic {
            sent: n,
            bytes: 10 * n,
            duplicated: 100 * n,
            out_of_range: 1000 * n,
        };
        let mut sum = traffic(2);
        sum.add(&traffic(3));
        assert_eq!(sum, traffic(5));
    }

    #[test]
    fn documents_come_back_from_reports_and_errors_name_the_topic() {
        let fated = Fated {
            message: crossing(),
            fate: Fate::OverLimit,
            r#use: None,
            entry: None,
        };
        let report = to_report("fates", &fated);
        let json = r#"{"from":"rsu1","to":"cav1","kind":"features","seq":7,"fate":"over_limit"}"#;
        assert_eq!((&*report.topic, &*report.json), ("fates", json));
        assert_eq!(from_report(&report), Ok(fated.clone()));
        let entry = Entry { bytes: 800, at_ns: -3 };
        let entered = Fated {
            fate: Fate::InFlight,
            entry: Some(entry),
            ..fated
        };
        let report = to_report("fates", &entered);
        assert!(
            report
                .json
                .ends_with(r#""fate":"in_flight","entry":{"bytes":800,"at_ns":-3}}"#),
            "{}",
            report.json
        );
        assert_eq!(from_report(&report), Ok(entered));
        let error = from_report::<Traffic>(&report).unwrap_err();
        assert!(error.starts_with("report `fates`: missing field `sent`"), "{error}");
    }
}
