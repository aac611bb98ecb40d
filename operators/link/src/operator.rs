use std::collections::{BTreeMap, BTreeSet, VecDeque};

use realo_operator::{
    Argument, Counter, Decided, Describe, Error, Lane, Operator, Outputs, Port, PortId, StreamKey, unexpected,
    wrong_port,
};
use realo_schemas::report::{Fate, Traffic};
use realo_schemas::{AgentState, Header, Message, Name, Nanos, Packet, PayloadType};
use serde::{Deserialize, Serialize};

use crate::{Arrivals, Medium, Model, Passed, Profile, transmit};

const EGO_STATE: PortId = PortId(0);
const STATES: PortId = PortId(1);
const EGO: PortId = PortId(2);
const OTHERS: PortId = PortId(3);
const POORER: PortId = PortId(4);
const POOREST: PortId = PortId(5);
const TO_EGO: PortId = PortId(0);
const TO_OTHERS: PortId = PortId(1);

/// Settings of the link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LinkConfig {
    /// Name of a built-in profile, or a file.
    pub profile: String,
    /// Largest distance over which packets are sent, m; an agent whose position is unknown is out of range.
    pub range_m: f64,
    /// Keeps the gate and the counts, without delay, jitter or loss.
    pub offline: bool,
    /// The ego's name; empty: the first agent that says something on `ego` or `ego_state`.
    pub ego: String,
    /// Seed of jitter, loss and copies.
    pub seed: u64,
}

impl Default for LinkConfig {
    fn default() -> Self {
        LinkConfig {
            profile: "perfect".into(),
            range_m: 70.0,
            offline: false,
            ego: String::new(),
            seed: 0,
        }
    }
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
    fn settle(&self, fault: &'static Counter, agent: &Name, out: &mut Outputs) {
        let is_start = self.last.saturating_sub(self.first) <= START;
        let counter = if is_start { &BEFORE_START } else { fault };
        out.count_of(counter, agent, self.count, 0);
    }
}

/// Carries packets between the ego and the others.
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

impl Describe for Link {
    type Config = LinkConfig;
    const NAME: &'static str = "link";
    const ABOUT: &'static str = "Carries packets between the ego and the others: range, delay, jitter, loss";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "profile",
            about: "channel model: perfect, paper, a .toml or .yml file, or settings: delay_ms=90,loss=0.05",
        },
        Argument {
            name: "range_m",
            about: "max distance in (x, y) over which packets are sent, m; inclusive",
        },
        Argument {
            name: "offline",
            about: "keep the range gate and the counts, without delay, jitter, loss or copies",
        },
        Argument {
            name: "ego",
            about: "the ego; empty: the first agent on `ego` or `ego_state`",
        },
        Argument {
            name: "seed",
            about: "seed of jitter, loss and copies",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("ego_state", &[PayloadType::AgentState], "where the ego is")
            .state()
            .of(Lane::Ego),
        Port::new("states", &[PayloadType::AgentState], "where the others are")
            .state()
            .of(Lane::Others),
        Port::new("ego", &[PayloadType::Packet], "what the ego sends")
            .optional()
            .of(Lane::Ego),
        Port::new("others", &[PayloadType::Packet], "what the others send")
            .optional()
            .of(Lane::Others),
        Port::new(
            "fallback",
            &[PayloadType::Packet],
            "the same moments in a fallback form, as boxes for points",
        )
        .optional()
        .of(Lane::Others),
        Port::new(
            "last_fallback",
            &[PayloadType::Packet],
            "the same in a fallback form still",
        )
        .optional()
        .of(Lane::Others),
    ];
    const OUTPUTS: &'static [Port] = &[
        Port::new(
            "to_ego",
            &[PayloadType::Packet],
            "the others' packets, delivered to the ego",
        )
        .of(Lane::OthersReceived),
        Port::new(
            "to_others",
            &[PayloadType::Packet],
            "the ego's packets, a copy for each other agent that is known",
        )
        .of(Lane::EgoReceived),
    ];
    const COUNTERS: &'static [Counter] = &[NO_RECEIVER, BEFORE_START, UNPLACED];
    const DECIDED: &'static [(Decided, &'static str)] = &[
        (Decided::Ego, "ego"),
        (Decided::Offline, "offline"),
        (Decided::Link, "profile"),
        (Decided::Seed, "seed"),
    ];
}

impl Link {
    /// The ego's name, learned from its lane unless an argument names it.
    fn ego_lane(&mut self, agent: &Name) -> Result<(), Error> {
        let ego = self.ego.get_or_insert_with(|| agent.clone());
        if ego != agent {
            return Err(format!("the ego's lane carries a message of {agent}, the ego is {ego}; mend the wiring, or the argument `ego` of the link").into());
        }
        Ok(())
    }

    fn others_lane(&mut self, agent: &Name) -> Result<(), Error> {
        if self.ego.as_ref() == Some(agent) {
            return Err(format!("the others' lane carries a message of the ego, {agent}; mend the wiring").into());
        }
        if !self.others.contains(agent) {
            self.others.insert(agent.clone());
        }
        Ok(())
    }

    fn state(&mut self, header: Header, state: &AgentState, out: &mut Outputs) -> Result<(), Error> {
        let t = &state.map_from_body.translation.vector;
        if !(t.x.is_finite() && t.y.is_finite()) {
            return Err(format!("position ({}, {}) is not finite", t.x, t.y).into());
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
            self.carry(TO_EGO, &ego, &sent, out);
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
    fn hear_other(&mut self, sent: Sent, out: &mut Outputs) {
        let Some(ego) = self.ego.clone() else {
            return TooEarly::add(&mut self.unreceived, sent.1.agent, sent.0);
        };
        for (sender, early) in std::mem::take(&mut self.unreceived) {
            early.settle(&NO_RECEIVER, &sender, out);
        }
        let sender = sent.1.agent.clone();
        if !self.waits(&sender, &ego) {
            return self.carry(TO_EGO, &ego, &sent, out);
        }
        let early = self.early.entry(sender).or_default();
        early.push_back(sent);
        if early.len() > EARLY
            && let Some(oldest) = early.pop_front()
        {
            self.carry(TO_EGO, &ego, &oldest, out);
        }
    }

    /// Whether two agents are in reach of each other; `None` while a position is unknown.
    fn in_range(&self, from: &Name, to: &Name) -> Option<bool> {
        let ((_, a), (_, b)) = (self.fixes.get(from)?, self.fixes.get(to)?);
        let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
        Some(dx * dx + dy * dy <= self.range_m * self.range_m)
    }

    /// When a packet of so many bytes arrives, after it was sent.
    fn arrivals(&mut self, sent: Nanos, header: &Header, to: &Name, bytes: usize) -> Arrivals {
        let from = &header.agent;
        let draws = self.key.draws(from, to, header.kind, header.seq);
        let model = self.profile.model(header.kind);
        let Some(medium) = &mut self.medium else {
            return transmit(model, bytes, draws);
        };
        let Some(Passed { delay, loss }) = medium.pass(from, to, sent, bytes) else {
            return Arrivals {
                first: None,
                second: None,
            };
        };
        let model = Model {
            loss: 1.0 - (1.0 - model.loss) * (1.0 - loss),
            ..*model
        };
        let Arrivals { first, second } = transmit(&model, bytes, draws);
        let later = |arrival: Nanos| arrival.saturating_add(delay);
        Arrivals {
            first: first.map(later),
            second: second.map(later),
        }
    }

    fn carry(&mut self, port: PortId, to: &Name, Sent(sent, header, packet): &Sent, out: &mut Outputs) {
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
        let arrivals = self.arrivals(*sent, header, to, packet.bytes.len());
        let Arrivals { first, second } = arrivals;
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
        if first.is_none() {
            out.report(&header, Fate::Lost);
        }
        for delay in [first, second].into_iter().flatten() {
            let ready = sent.saturating_add(delay);
            let header = Header {
                ready,
                ..header.clone()
            };
            out.send(port, Message::new(header, packet.clone()));
        }
    }
}

impl Operator for Link {
    fn new(config: LinkConfig) -> Result<Self, Error> {
        if !(config.range_m.is_finite() && config.range_m >= 0.0) {
            return Err(format!(
                "argument `range_m`: expected metres, at least 0, found {}",
                config.range_m
            )
            .into());
        }
        let mut profile = Profile::load(&config.profile)?;
        if config.offline {
            profile = Profile {
                about: profile.about,
                ..Profile::default()
            };
        }
        Ok(Link {
            medium: profile.channel.as_ref().map(Medium::new),
            profile,
            range_m: config.range_m,
            offline: config.offline,
            key: StreamKey::new(config.seed, "link"),
            ego: (!config.ego.is_empty()).then(|| config.ego.into()),
            others: BTreeSet::new(),
            fixes: BTreeMap::new(),
            unreceived: BTreeMap::new(),
            unplaced: BTreeMap::new(),
            early: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        match port {
            EGO_STATE | EGO => self.ego_lane(&message.header.agent)?,
            STATES | OTHERS | POORER | POOREST => self.others_lane(&message.header.agent)?,
            _ => return Err(wrong_port(Self::INPUTS, port)),
        }
        if matches!(port, EGO_STATE | STATES) {
            let (header, state): (Header, AgentState) = message.into_parts().map_err(unexpected)?;
            return self.state(header, &state, out);
        }
        let (header, packet): (Header, Packet) = message.into_parts().map_err(unexpected)?;
        let sent = Sent(out.now(), header, packet);
        if port == EGO {
            for other in self.others.clone() {
                self.carry(TO_OTHERS, &other, &sent, out);
            }
            return Ok(());
        }
        self.hear_other(sent, out);
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        let early = std::mem::take(&mut self.early).into_values().flatten();
        if let Some(ego) = self.ego.clone() {
            early.for_each(|sent| self.carry(TO_EGO, &ego, &sent, out));
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
