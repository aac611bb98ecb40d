//! The radio as a node of a graph.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use realo_operator::{Describe, Error, Gateway, Inputs, Outputs, Settings, Waker};
use realo_schemas::report::{self, ClockBy, Entry, Fate, Peer, to_report};
use realo_schemas::{Header, Kind, Name, Nanos, Packet, are_one_time_line, to_millis};
use serde::{Deserialize, Serialize};

use crate::body;
use crate::books::News;
use crate::clock::{steady, wall};
use crate::course::{Came, Course};
use crate::endpoint::Endpoint;
use crate::error::RadioError;
use crate::keys::{Own, Trusted, is_name};
use crate::network::Network;
use crate::offset::{Basis, Estimate};
use crate::protocol::{self, Arrived, Offer, is_bulk};
use crate::refusal::{self, ALONE, NO_CLOCK, OVERRUN, OVERSIZED_FRAMES, Refusal, Refusals, UNSENT_BOXES};
use crate::seal::Seal;
use crate::session::{self, Place};
use crate::station::{Event, MOST_BYTES, MOST_PEERS, MessageId, Report, Station};
use crate::unheard;

/// Bytes of boxes and states at most, which cross in one frame.
const MOST_SMALL: usize = MOST_BYTES - 1024;
/// Messages of a peer and a kind that are given to the graph at once.
const AT_ONCE: usize = 4;
/// A message that was measured later than now by more is refused, ns.
const FUTURE: Nanos = 1_000_000_000;
/// Time lines that differ by more are of runs that have nothing to do with each other, ns.
const APART: Nanos = 10_000_000_000;

/// Settings of the radio.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Who this is.
    #[setting(role = "ego")]
    pub agent: String,
    /// Agents of one site hear each other.
    #[setting(default = "realo")]
    pub site: String,
    /// Addresses where others connect, `tcp/HOST:PORT` or `tls/HOST:PORT`; each takes the port behind it too.
    pub listen: Vec<Endpoint>,
    /// Addresses of others.
    pub connect: Vec<Endpoint>,
    /// File of this agent's private key (`realo keys new`): signs all that it sends, and takes only what is signed.
    pub key: PathBuf,
    /// File of the agents that are trusted, and their keys (`realo keys trust`).
    pub trust: PathBuf,
    /// YAML file of further settings of Zenoh, such as certificates and access control.
    pub zenoh: PathBuf,
    /// What GNSS or PTP leave this machine's wall clock off by at most; null: what the kernel says.
    #[setting(range = 0.0..=1e6)]
    pub clock_error_ms: Option<f64>,
    /// Age at which points and features must have arrived, or they are not sent.
    #[setting(default = 400.0, range = 0.0<..=1e6)]
    pub deadline_ms: f64,
    /// What points and features may add to the delay of everything else.
    #[setting(default = 20.0, range = 0.0<..=1e6)]
    pub queue_ms: f64,
    /// Max message that is taken, bytes.
    #[setting(default = 16 << 20, range = 1024..)]
    pub max_bytes: usize,
    /// A peer of whom nothing was heard for so long has gone, ms.
    #[setting(default = 2000, range = 100..)]
    pub lease_ms: u64,
}

/// Exchanges packets with agents on other machines, over Zenoh.
#[derive(Describe)]
#[stage(counters = refusal::COUNTERS, examine = examine)]
pub struct Radio {
    place: Place,
    settings: protocol::Settings,
    max_bytes: usize,
    seal: Option<Seal>,
    network: Option<Network>,
    /// What the network has refused so far.
    counted: Refusals,
    overrun: u64,
    /// Whether time here began before what comes next.
    has_begun: bool,
    /// Frames that Zenoh had dropped so far.
    unheard: u64,
    /// Messages that came whole, and that the graph does not take.
    refused: BTreeMap<Name, Refusals>,
    courses: BTreeMap<Name, Course>,
    reports: Vec<Report>,
    /// What was said of own messages so far.
    words: u64,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What this agent has for all others.
    #[port(optional)]
    Packets(Header, Packet),
    /// Where this agent is, for all others.
    #[port(optional, of(Ego))]
    State(Header, Packet),
    /// The same moments in a fallback form, as features or boxes for points: of large kinds the richest goes that arrives in
    /// time.
    #[port(optional)]
    Fallback(Header, Packet),
    /// The same in a fallback form still.
    #[port(optional)]
    LastFallback(Header, Packet),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// What the others have for this agent.
    #[port(of(OthersReceived))]
    ToEgo(Header, Packet),
    /// Topic `peers`: what is known of the others, at the end.
    Peers(Header, realo_schemas::Report),
    /// Where the others are.
    #[port(of(EgoReceived), ends_early)]
    States(Header, Packet),
    /// Topic `on_air`: to this agent how long its own points and features took to a peer, or that they did not go.
    #[port(of(Ego), ends_early)]
    OnAir(Header, realo_schemas::Report),
}

impl Gateway for Radio {
    fn build(settings: Settings) -> Result<Self, Error> {
        check(&settings)?;
        let seal = seal(&settings)?;
        let millis = |value: f64| (value * 1e6) as Nanos;
        Ok(Radio {
            place: Place {
                site: settings.site,
                agent: settings.agent.into(),
                listen: settings.listen,
                connect: settings.connect,
                lease: Duration::from_millis(settings.lease_ms),
                zenoh: settings.zenoh,
                clock_error: settings.clock_error_ms.map(millis),
            },
            settings: protocol::Settings {
                queue: millis(settings.queue_ms),
                deadline: millis(settings.deadline_ms),
                ..protocol::Settings::default()
            },
            max_bytes: settings.max_bytes,
            seal,
            network: None,
            counted: Refusals::new(),
            overrun: 0,
            has_begun: false,
            unheard: 0,
            refused: BTreeMap::new(),
            courses: BTreeMap::new(),
            reports: Vec::new(),
            words: 0,
        })
    }

    fn open(&mut self, waker: Waker) -> Result<(), Error> {
        unheard::listen();
        self.unheard = unheard::dropped();
        let (agent, settings) = (self.place.agent.clone(), self.settings.clone());
        let station = Station::new(agent, settings, self.max_bytes, wall() as u64, self.seal.take());
        self.network = Some(Network::join(&self.place, station, waker)?);
        Ok(())
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        let (Input::Packets(header, packet)
        | Input::State(header, packet)
        | Input::Fallback(header, packet)
        | Input::LastFallback(header, packet)) = input;
        let Some(network) = &self.network else { return Ok(()) };
        tell(network, out);
        if matches!(header.kind, Kind::Truth | Kind::Report | Kind::Motion) {
            return Err(RadioError::Kind(header.kind).into());
        }
        let bytes = body::to_bytes(&packet, out.now())?;
        if !is_bulk(header.kind) && bytes.len() > MOST_SMALL {
            out.count(&UNSENT_BOXES, &self.place.agent, 1);
            return Ok(());
        }
        let age = (out.now() - header.stamp).max(0);
        let offer = Offer {
            kind: header.kind,
            seq: header.seq,
            stamp: header.stamp,
            born: steady() - age,
            bytes,
        };
        if !network.offer(offer) {
            out.count(&OVERRUN, &self.place.agent, 1);
        }
        Ok(())
    }

    fn on_wake(&mut self, _: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(network) = &self.network else { return Ok(()) };
        tell(network, out);
        let taken = network.take();
        self.reports = taken.reports;
        self.counted = taken.refused;
        out.count(&OVERRUN, "", taken.overrun - self.overrun);
        self.overrun = taken.overrun;
        let unheard = unheard::dropped();
        out.count(&OVERSIZED_FRAMES, "", unheard - self.unheard);
        self.unheard = unheard;
        // What came before this agent's sensors began waited for them, not for a clock.
        let has_begun = std::mem::replace(&mut self.has_begun, true);
        let is_skipped = skipped(&taken.events);
        for (event, is_skipped) in taken.events.into_iter().zip(is_skipped) {
            match event {
                Event::Arrived(from, message, _) if is_skipped => {
                    self.take(Event::Skipped(from, MessageId::from(&message)), out);
                }
                event => {
                    let waited = match &event {
                        Event::Arrived(from, ..) => Some((from, 0)),
                        Event::Skipped(from, _) if has_begun => Some((from, 1)),
                        Event::Skipped(..) | Event::Books(..) | Event::OnAir(..) => None,
                    };
                    if let Some((from, in_vain)) = waited {
                        out.count_of(&NO_CLOCK, from, in_vain, 1);
                    }
                    self.take(event, out);
                }
            }
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        if let Some(network) = &mut self.network {
            network.leave();
        }
        let now = out.now();
        self.has_begun = true;
        self.on_wake(now, out)?;
        self.network = None;
        self.count_refused(out);
        let is_alone = self.reports.iter().all(|report| report.received.messages == 0);
        out.count(&ALONE, "", u64::from(is_alone));
        let peers: Vec<Peer> = self.reports.iter().map(|report| self.peer(report)).collect();
        let header = Header::origin(&Name::default(), &self.place.agent, Kind::Report, 0, now, now);
        out.send(Output::Peers(header, to_report(report::PEERS, &peers)));
        Ok(())
    }
}

impl Radio {
    /// Counts what the network refused, by the name in which it came; of more names than are known, of nobody.
    fn count_refused(&self, out: &mut Outputs<Output>) {
        for (refusal, total) in &self.counted {
            let mut nameless = *total;
            for report in &self.reports {
                let named = report.refused.get(refusal).copied().unwrap_or(0);
                out.count(refusal.counter(), &report.peer, named);
                nameless = nameless.saturating_sub(named);
            }
            out.count(refusal.counter(), "", nameless);
        }
    }

    fn take(&mut self, event: Event, out: &mut Outputs<Output>) {
        match event {
            Event::Arrived(from, message, clock) => self.deliver(&from, message, &clock, out),
            Event::Skipped(from, message) => {
                let header = self.header(&from, message, out);
                out.report(&header, Fate::Superseded);
            }
            Event::Books(from, News { traffic, fates }) => {
                for (kind, traffic) in traffic {
                    out.carried(&from, &self.place.agent, kind, traffic);
                }
                let lost = fates.iter().filter(|fated| fated.fate == Fate::Lost).count();
                if lost > 0 {
                    self.course(&from).lost(out.now(), lost as u64);
                }
                out.know(fates);
            }
            Event::OnAir(_, word) => {
                let (agent, now) = (&self.place.agent, out.now());
                let header = Header::origin(&Name::default(), agent, Kind::Report, self.words, now, now);
                self.words += 1;
                out.send(Output::OnAir(header, to_report(report::ON_AIR, &word)));
            }
        }
    }

    /// Gives a message of a peer to the graph, on this agent's time line.
    fn deliver(&mut self, from: &Name, message: Arrived, clock: &Estimate, out: &mut Outputs<Output>) {
        let reported = MessageId::from(&message);
        match self.moved(from, &message, clock, out) {
            Ok((packet, stamp)) => {
                let is_state = message.kind == Kind::AgentState;
                let header = self.header(from, MessageId { stamp, ..reported }, out);
                let entry = Entry {
                    bytes: packet.bytes.len() as u64,
                    at_ns: header.ready,
                };
                out.entered(&header, entry);
                match is_state {
                    true => out.send(Output::States(header, packet)),
                    false => out.send(Output::ToEgo(header, packet)),
                }
            }
            Err(refusal) => {
                out.count(refusal.counter(), from, 1);
                out.report(&self.header(from, reported, out), Fate::Rejected);
                let refused = self.refused.entry(from.clone()).or_default();
                *refused.entry(refusal).or_default() += 1;
            }
        }
    }

    fn header(&self, from: &Name, of: MessageId, out: &Outputs<Output>) -> Header {
        Header {
            to: Some(self.place.agent.clone()),
            ..Header::origin(&Name::default(), from, of.kind, of.seq, of.stamp, out.now())
        }
    }

    /// The packet of a message and when it was measured, on this agent's time line.
    fn moved(
        &mut self,
        from: &Name,
        message: &Arrived,
        clock: &Estimate,
        out: &mut Outputs<Output>,
    ) -> Result<(Packet, Nanos), Refusal> {
        let (packet, given) = body::of_bytes(&message.bytes).ok_or(Refusal::Malformed)?;
        let now = out.now();
        let on_the_way = now.saturating_add(clock.offset).saturating_sub(given).max(0);
        out.steps().took(on_the_way_of(message.kind), on_the_way);
        let (bytes, took) = (message.bytes.len(), message.took);
        self.course(from).came(
            now,
            &Came {
                bytes,
                on_the_way: Some(on_the_way),
                took,
            },
        );
        let shift = shift(clock).ok_or(Refusal::OtherTimeLine)?;
        let stamp = message.stamp.checked_add(shift).ok_or(Refusal::Malformed)?;
        if stamp.saturating_sub(now) > FUTURE {
            return Err(Refusal::Future);
        }
        let packet = match shift {
            0 => packet,
            _ => packet.moved(shift),
        };
        Ok((packet, stamp))
    }

    /// What results tell of a peer.
    fn peer(&self, report: &Report) -> Peer {
        let (name, clock) = (&report.peer, report.clock);
        let mut refused = BTreeMap::new();
        for (refusal, count) in report
            .refused
            .iter()
            .chain(self.refused.get(name).into_iter().flatten())
        {
            *refused.entry(refusal.as_str().to_string()).or_default() += count;
        }
        Peer {
            name: name.to_string(),
            messages: report.received.messages,
            clock_ms: clock.map(|clock| to_millis(clock.offset)),
            clock_uncertainty_ms: clock.map(|clock| to_millis(clock.uncertainty)),
            clock_drift_ms_s: clock.map(|clock| clock.drift * 1e-6),
            clock_by: clock.map(|clock| match clock.basis {
                Basis::Machines => ClockBy::Machines,
                Basis::Exchanges | Basis::Contradiction(_) => ClockBy::Exchanges,
            }),
            clock_contradiction_ms: clock.and_then(|clock| match clock.basis {
                Basis::Contradiction(differs) => Some(to_millis(differs)),
                Basis::Exchanges | Basis::Machines => None,
            }),
            round_trip_ms: report.round_trip.or(clock.map(|clock| 2 * clock.bound)).map(to_millis),
            bits_per_second: report.rate.map(|rate| 8.0 * rate),
            refused,
            course: self.courses.get(name).cloned().unwrap_or_default().close(),
        }
    }

    /// Of as many peers as are heard at a time; of more, that of the last.
    fn course(&mut self, from: &Name) -> &mut Course {
        if self.courses.len() >= MOST_PEERS && !self.courses.contains_key(from) {
            self.courses.pop_last();
        }
        self.courses.entry(from.clone()).or_insert_with(Course::busy)
    }
}

/// Tells the network where the log lies on the wall clock: what a call takes it for is late by what the call waited.
fn tell(network: &Network, out: &Outputs<Output>) {
    if let Some(clock) = out.log_clock() {
        network.set_clock(clock);
    }
}

/// What a peer's stamps are moved by; `None`: its time line has nothing to do with this one.
fn shift(clock: &Estimate) -> Option<Nanos> {
    let differs = clock.offset.saturating_abs();
    match differs {
        _ if differs > APART => None,
        _ if are_one_time_line(clock.offset, clock.uncertainty) => Some(0),
        _ => Some(-clock.offset),
    }
}

/// Which events are messages of a kind of which a peer's newer ones came at once, more of them than the stages below may find in
/// their queues: what came before this agent's time began, or while its process stood still.
fn skipped(events: &[Event]) -> Vec<bool> {
    let mut newer: BTreeMap<(&Name, Kind), usize> = BTreeMap::new();
    let mut skipped: Vec<bool> = events
        .iter()
        .rev()
        .map(|event| match event {
            Event::Arrived(from, message, _) => {
                let newer = newer.entry((from, message.kind)).or_default();
                *newer += 1;
                *newer > AT_ONCE
            }
            Event::Skipped(..) | Event::Books(..) | Event::OnAir(..) => false,
        })
        .collect();
    skipped.reverse();
    skipped
}

/// Looks at the settings and the files that they name.
fn examine(settings: &Settings) -> Result<(), Error> {
    check(settings)?;
    if !settings.zenoh.as_os_str().is_empty() {
        session::examine(&settings.zenoh)?;
    }
    seal(settings)?;
    Ok(())
}

/// What no range says.
fn check(settings: &Settings) -> Result<(), RadioError> {
    if !is_name(&settings.agent) {
        return Err(RadioError::Agent(settings.agent.clone()));
    }
    if !settings.site.split('/').all(is_name) {
        return Err(RadioError::Site(settings.site.clone()));
    }
    if settings.listen.is_empty() && settings.connect.is_empty() {
        return Err(RadioError::Nobody);
    }
    for (at, first) in settings.listen.iter().enumerate() {
        if let Some(second) = settings.listen[at + 1..].iter().find(|second| first.collides(second)) {
            let [first, second] = [first, second].map(|endpoint| endpoint.to_string());
            return Err(RadioError::Ports { first, second });
        }
    }
    Ok(())
}

/// What signs and checks, where keys are given.
fn seal(settings: &Settings) -> Result<Option<Seal>, RadioError> {
    let is_there = |path: &Path| !path.as_os_str().is_empty();
    let alone = |given, missing| Err(RadioError::HalfSealed { given, missing });
    match [is_there(&settings.key), is_there(&settings.trust)] {
        [false, false] => return Ok(None),
        [true, true] => {}
        [true, false] => return alone("key", "trust"),
        [false, true] => return alone("trust", "key"),
    }
    let named = |setting| move |error| RadioError::Keys { setting, error };
    let own = Own::read(&settings.key).map_err(named("key"))?;
    let trusted = Trusted::read(&settings.trust).map_err(named("trust"))?;
    if *own.agent != *settings.agent {
        return Err(RadioError::OtherKey {
            file: settings.key.clone(),
            agent: settings.agent.clone(),
            found: own.agent.to_string(),
        });
    }
    Ok(Some(Seal::new(&settings.site, own, trusted)))
}

/// The step that shows how long a message took, from its sender's radio to this one, by both clocks.
fn on_the_way_of(kind: Kind) -> &'static str {
    match kind {
        Kind::Points => "points on the way",
        Kind::Features => "features on the way",
        Kind::Boxes => "boxes on the way",
        _ => "states on the way",
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    #[test]
    fn of_many_messages_at_once_the_newest_are_given() {
        let arrived = |from: &str, kind, seq| {
            let message = Arrived {
                kind,
                seq,
                stamp: 0,
                bytes: Bytes::new(),
                took: 0,
            };
            let clock = Estimate {
                offset: 0,
                uncertainty: 0,
                bound: 0,
                drift: 0.0,
                basis: Basis::Exchanges,
            };
            Event::Arrived(from.into(), message, clock)
        };
        let mut events: Vec<Event> = (0..30).map(|seq| arrived("rsu1", Kind::Boxes, seq)).collect();
        events.insert(3, Event::Books("rsu1".into(), News::default()));
        events.extend((0..AT_ONCE as u64).map(|seq| arrived("rsu1", Kind::AgentState, seq)));
        events.extend((0..AT_ONCE as u64).map(|seq| arrived("rsu2", Kind::Boxes, seq)));
        let is_skipped = skipped(&events);
        let given = events.iter().zip(&is_skipped).filter(|(_, is_skipped)| !**is_skipped);
        let given: Vec<String> = given
            .map(|(event, _)| match event {
                Event::Arrived(from, message, _) => format!("{from} {} {}", message.kind, message.seq),
                Event::Skipped(from, _) => format!("{from} skipped"),
                Event::Books(from, _) => format!("{from} books"),
                Event::OnAir(from, _) => format!("{from} on air"),
            })
            .collect();
        let mut expected = vec!["rsu1 books".to_string()];
        expected.extend((26..30).map(|seq| format!("rsu1 boxes {seq}")));
        expected.extend((0..4).map(|seq| format!("rsu1 agent_state {seq}")));
        expected.extend((0..4).map(|seq| format!("rsu2 boxes {seq}")));
        assert_eq!(given, expected);
    }
}
