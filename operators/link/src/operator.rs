use std::collections::{BTreeMap, BTreeSet, VecDeque};

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings, StreamKey};
use realo_schemas::report::{Entry, Fate, ON_AIR, OnAir, Traffic, to_report};
use realo_schemas::{AgentState, Header, Kind, Name, Nanos, Packet, PoseStatus, Report};
use serde::{Deserialize, Serialize};

use crate::{Arrivals, Medium, Model, Passed, Profile, transmit};

/// Settings of the link.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Channel model: `perfect`, `paper`, `cv2x-measured`, a .toml or .yml file, or settings: `delay_ms=90,loss=0.05`.
    #[setting(default = "perfect", role = "link", path)]
    pub profile: String,
    /// Max distance in (x, y) over which packets are sent, m; inclusive.
    #[setting(default = 70.0, range = 0.0..=1e9)]
    pub range_m: f64,
    /// Keep the range gate and the counts, without delay, jitter, loss or copies.
    #[setting(role = "offline")]
    pub offline: bool,
    /// The ego; empty: the first agent on `ego` or `ego_state`.
    #[setting(role = "ego")]
    pub ego: String,
    /// Seed of jitter, loss and copies.
    #[setting(role = "seed")]
    pub seed: u64,
}

/// Whether agents at two places, (x, y) in m, are in reach of each other: the range gate.
pub fn in_reach(a: [f64; 2], b: [f64; 2], range_m: f64) -> bool {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    dx * dx + dy * dy <= range_m * range_m
}

/// Packets of one sender that may wait for first positions; more are out of range and `unplaced`, the oldest first.
const EARLY: usize = 16;

/// Packets may come so long before the first positions, as when a graph starts, ns.
const START: Nanos = 3_000_000_000;

/// A position and when it was measured.
type Fix = (Nanos, [f64; 2]);

/// A packet, and when it was sent, ns.
struct Sent(Nanos, Header, Packet);

/// Packets that came before it was known where to; whether that was a start or a fault shows later.
struct TooEarly {
    first: Nanos,
    last: Nanos,
    count: u64,
}

impl TooEarly {
    fn add<K: Ord>(known: &mut BTreeMap<K, TooEarly>, key: K, sent: Nanos) {
        let early = known.entry(key).or_insert(TooEarly {
            first: sent,
            last: sent,
            count: 0,
        });
        (early.last, early.count) = (early.last.max(sent), early.count + 1);
    }

    /// Counts them once all is known: a short while is how a graph starts, a longer one is a fault.
    fn settle(&self, fault: &'static Counter, agent: &Name, out: &mut Outputs<Output>) {
        let is_start = self.last.saturating_sub(self.first) <= START;
        let counter = if is_start { &BEFORE_START } else { fault };
        out.count_of(counter, agent, self.count, 0);
    }
}

/// A message that the link cannot carry.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// Another agent speaks where the ego should.
    #[error(
        "the ego's lane carries a message of {agent}, the ego is {ego}; correct the wiring, or the setting `ego` of the link"
    )]
    NotTheEgo {
        /// Who speaks.
        agent: Name,
        /// The ego.
        ego: Name,
    },
    /// The ego speaks where the others should.
    #[error("the others' lane carries a message of the ego, {0}; correct the wiring")]
    TheEgo(Name),
    /// A position that is not a number.
    #[error("position ({0}, {1}) is not finite")]
    Position(f64, f64),
}

/// Carries packets between the ego and the others: range, delay, jitter, loss.
#[derive(Describe)]
#[stage(counters(NO_RECEIVER, BEFORE_START, UNPLACED))]
pub struct Link {
    profile: Profile,
    medium: Option<Medium>,
    range_m: f64,
    offline: bool,
    key: StreamKey,
    ego: Option<Name>,
    others: BTreeSet<Name>,
    fixes: BTreeMap<Name, Fix>,
    /// By sender: packets that came while no ego was known.
    unreceived: BTreeMap<Name, TooEarly>,
    /// By sender and receiver: packets that came while the position of one was not known.
    unplaced: BTreeMap<(Name, Name), TooEarly>,
    /// Packets for the ego that wait for a first position.
    early: BTreeMap<Name, VecDeque<Sent>>,
}

const NO_RECEIVER: Counter = Counter::loss(
    "no_receiver",
    "packets that came before any ego was known; not sent",
    "packets were not sent, because no ego was known yet",
    "`--set {node}.ego=NAME` names it from the start",
);
const BEFORE_START: Counter = Counter::plain(
    "before_start",
    "packets of the first 3 s of a sender, not sent because its position, the ego or the ego's position was not known yet",
);
const UNPLACED: Counter = Counter::loss(
    "unplaced",
    "those of `out_of_range` for which an agent's position was not known",
    "packets were not sent, because the position of their sender or receiver was not known",
    "an agent whose position is not known is out of range: look at its poses (`realo info`)",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// Where the ego is.
    #[port(state, of(Ego))]
    EgoState(Header, AgentState),
    /// Where the others are.
    #[port(state, of(Others))]
    States(Header, AgentState),
    /// What the ego sends.
    #[port(optional, of(Ego))]
    Ego(Header, Packet),
    /// What the others send.
    #[port(optional, of(Others))]
    Others(Header, Packet),
    /// The same moments in a fallback form, as boxes for points.
    #[port(optional, of(Others))]
    Fallback(Header, Packet),
    /// The same in a fallback form still.
    #[port(optional, of(Others))]
    LastFallback(Header, Packet),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The others' packets, delivered to the ego.
    #[port(of(OthersReceived))]
    ToEgo(Header, Packet),
    /// The ego's packets, a copy for each other agent that is known.
    #[port(of(EgoReceived))]
    ToOthers(Header, Packet),
    /// Topic `on_air`: to each of the others when a packet of it had crossed, and how busy the channel was.
    #[port(of(Others))]
    OnAir(Header, Report),
}

impl Link {
    /// The ego's name, learned from its lane unless a setting names it.
    fn ego_lane(&mut self, agent: &Name) -> Result<(), LinkError> {
        let ego = self.ego.get_or_insert_with(|| agent.clone());
        if ego != agent {
            return Err(LinkError::NotTheEgo {
                agent: agent.clone(),
                ego: ego.clone(),
            });
        }
        Ok(())
    }

    fn others_lane(&mut self, agent: &Name) -> Result<(), LinkError> {
        if self.ego.as_ref() == Some(agent) {
            return Err(LinkError::TheEgo(agent.clone()));
        }
        if !self.others.contains(agent) {
            self.others.insert(agent.clone());
        }
        Ok(())
    }

    fn state(&mut self, header: Header, state: &AgentState, out: &mut Outputs<Output>) -> Result<(), LinkError> {
        // An agent that does not know yet where it is is as one of which nothing came.
        if state.status == PoseStatus::Init {
            return Ok(());
        }
        let t = &state.map_from_body.translation.vector;
        if !(t.x.is_finite() && t.y.is_finite()) {
            return Err(LinkError::Position(t.x, t.y));
        }
        let fix = (header.stamp, [t.x, t.y]);
        let known = self.fixes.entry(header.agent).or_insert(fix);
        if fix.0 >= known.0 {
            *known = fix;
        }
        let Some(ego) = self.ego.clone() else {
            return Ok(());
        };
        let early = std::mem::take(&mut self.early).into_iter();
        let (placed, waiting): (BTreeMap<_, _>, BTreeMap<_, _>) =
            early.partition(|(sender, _)| !self.waits(sender, &ego));
        self.early = waiting;
        for sent in placed.into_values().flatten() {
            self.carry(Output::ToEgo, &ego, &sent, out);
        }
        Ok(())
    }

    /// Whether a packet of this sender has to wait. An agent's first packet derives from its first state and may overtake
    /// it, for they come on different edges. The ego's first state may come after others' packets; only offline, where no
    /// data is late, may they wait for it.
    fn waits(&self, sender: &Name, ego: &Name) -> bool {
        let is_placed = |agent: &Name| self.fixes.contains_key(agent);
        !is_placed(sender) || (self.offline && !is_placed(ego))
    }

    /// Carries a packet of another agent, or keeps it for a while.
    fn hear_other(&mut self, sent: Sent, out: &mut Outputs<Output>) {
        let Some(ego) = self.ego.clone() else {
            return TooEarly::add(&mut self.unreceived, sent.1.agent, sent.0);
        };
        for (sender, early) in std::mem::take(&mut self.unreceived) {
            early.settle(&NO_RECEIVER, &sender, out);
        }
        let sender = sent.1.agent.clone();
        if !self.waits(&sender, &ego) {
            return self.carry(Output::ToEgo, &ego, &sent, out);
        }
        let early = self.early.entry(sender).or_default();
        early.push_back(sent);
        if early.len() > EARLY
            && let Some(oldest) = early.pop_front()
        {
            self.carry(Output::ToEgo, &ego, &oldest, out);
        }
    }

    /// Whether two agents are in reach of each other; `None` while a position is unknown.
    fn in_range(&self, from: &Name, to: &Name) -> Option<bool> {
        let ((_, a), (_, b)) = (self.fixes.get(from)?, self.fixes.get(to)?);
        Some(in_reach(*a, *b, self.range_m))
    }

    /// When a packet of so many bytes arrives, after it was sent; when it has left its sender, and what the sender knows then.
    fn arrivals(&mut self, sent: Nanos, header: &Header, to: &Name, bytes: usize) -> (Arrivals, Nanos, OnAir) {
        let on_air = OnAir {
            bytes: bytes as u64,
            ..OnAir::default()
        };
        let from = &header.agent;
        let draws = self.key.draws(from, to, header.kind, header.seq);
        let model = self.profile.model(header.kind);
        let Some(medium) = &mut self.medium else {
            return (transmit(model, bytes, draws), 0, on_air);
        };
        let Some(passed) = medium.pass(from, to, sent, bytes) else {
            let lost = Arrivals {
                first: None,
                second: None,
            };
            let dropped = OnAir {
                dropped: true,
                ..on_air
            };
            return (lost, 0, dropped);
        };
        let Passed { delay, loss, .. } = passed;
        let [span_ns, busy_ns] = passed.since.unwrap_or_default();
        let on_air = OnAir {
            air_ns: passed.air,
            span_ns,
            busy_ns,
            ..on_air
        };
        let model = Model {
            loss: 1.0 - (1.0 - model.loss) * (1.0 - loss),
            ..*model
        };
        let Arrivals { first, second } = transmit(&model, bytes, draws);
        let later = |arrival: Nanos| arrival.saturating_add(delay);
        let arrivals = Arrivals {
            first: first.map(later),
            second: second.map(later),
        };
        (arrivals, passed.left, on_air)
    }

    fn carry(
        &mut self,
        output: fn(Header, Packet) -> Output,
        to: &Name,
        Sent(sent, header, packet): &Sent,
        out: &mut Outputs<Output>,
    ) {
        let from = &header.agent;
        let in_range = self.in_range(from, to);
        match in_range {
            None => TooEarly::add(&mut self.unplaced, (from.clone(), to.clone()), *sent),
            Some(_) => {
                if let Some(early) = self.unplaced.remove(&(from.clone(), to.clone())) {
                    early.settle(&UNPLACED, from, out);
                }
            }
        }
        out.count_of(&UNPLACED, from, 0, 1);
        if in_range != Some(true) {
            let traffic = Traffic {
                out_of_range: 1,
                ..Traffic::default()
            };
            return out.carried(from, to, header.kind, traffic);
        }
        let (arrivals, left, on_air) = self.arrivals(*sent, header, to, packet.bytes.len());
        let Arrivals { first, second } = arrivals;
        if self.ego.as_ref() == Some(to) {
            let header = Header {
                kind: Kind::Report,
                ready: sent.saturating_add(left),
                ..header.clone()
            };
            out.send(Output::OnAir(header, to_report(ON_AIR, &on_air)));
        }
        let traffic = Traffic {
            sent: 1,
            bytes: packet.bytes.len() as u64,
            duplicated: u64::from(second.is_some()),
            out_of_range: 0,
        };
        out.carried(from, to, header.kind, traffic);
        let header = Header {
            to: Some(to.clone()),
            ..header.clone()
        };
        let entry = Entry {
            bytes: packet.bytes.len() as u64,
            at_ns: *sent,
        };
        out.entered(&header, entry);
        if first.is_none() {
            out.report(&header, Fate::Lost);
        }
        for delay in [first, second].into_iter().flatten() {
            let ready = sent.saturating_add(delay);
            let header = Header {
                ready,
                ..header.clone()
            };
            out.send(output(header, packet.clone()));
        }
    }
}

impl Operator for Link {
    fn build(settings: Settings) -> Result<Self, Error> {
        let mut profile = Profile::load(&settings.profile)?;
        if settings.offline {
            profile = Profile {
                about: profile.about,
                ..Profile::default()
            };
        }
        Ok(Link {
            medium: profile.channel.as_ref().map(Medium::new),
            profile,
            range_m: settings.range_m,
            offline: settings.offline,
            key: StreamKey::new(settings.seed, "link"),
            ego: (!settings.ego.is_empty()).then(|| settings.ego.into()),
            others: BTreeSet::new(),
            fixes: BTreeMap::new(),
            unreceived: BTreeMap::new(),
            unplaced: BTreeMap::new(),
            early: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::EgoState(header, state) => {
                self.ego_lane(&header.agent)?;
                Ok(self.state(header, &state, out)?)
            }
            Input::States(header, state) => {
                self.others_lane(&header.agent)?;
                Ok(self.state(header, &state, out)?)
            }
            Input::Ego(header, packet) => {
                self.ego_lane(&header.agent)?;
                let sent = Sent(out.now(), header, packet);
                for other in self.others.clone() {
                    self.carry(Output::ToOthers, &other, &sent, out);
                }
                Ok(())
            }
            Input::Others(header, packet) | Input::Fallback(header, packet) | Input::LastFallback(header, packet) => {
                self.others_lane(&header.agent)?;
                self.hear_other(Sent(out.now(), header, packet), out);
                Ok(())
            }
        }
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        let early = std::mem::take(&mut self.early).into_values().flatten();
        if let Some(ego) = self.ego.clone() {
            early.for_each(|sent| self.carry(Output::ToEgo, &ego, &sent, out));
        }
        // What never became known is not a start.
        for ((sender, _), early) in std::mem::take(&mut self.unplaced) {
            out.count_of(&UNPLACED, &sender, early.count, 0);
        }
        for (sender, early) in std::mem::take(&mut self.unreceived) {
            out.count_of(&NO_RECEIVER, &sender, early.count, 0);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
