use std::collections::{BTreeMap, BTreeSet};

use realo_operator::{
    Argument, Counter, Decided, Describe, Error, Lane, Operator, Outputs, Port, PortId, unexpected, wrong_port,
};
use realo_schemas::report::Fate;
use realo_schemas::{Header, Message, Name, Nanos, PayloadType, Selection};
use serde::{Deserialize, Serialize};

use crate::{Bank, OFFLINE_REACH, Taken};

const FUSABLE: &[PayloadType] = &[PayloadType::PointCloud, PayloadType::FeatureMap, PayloadType::Boxes];

const EGO: PortId = PortId(0);
const OTHERS: PortId = PortId(1);
const FUSED: PortId = PortId(2);
const SELECTIONS: PortId = PortId(0);

/// Selections of a bank before this one whose queries have not come here.
const AHEAD: usize = 64;

const NANOS_PER_MILLI: Nanos = 1_000_000;

/// Settings of the bank.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BankConfig {
    /// Largest age of what is selected, ms.
    pub window_ms: u32,
    /// How long a query waits online for a message that its sender's rhythm announces, ms.
    pub patience_ms: u32,
    /// Nearest stamp within ±50 ms instead of the newest ready message.
    pub offline: bool,
    /// How far a stamp may lie after its message's arrival, ms.
    pub ahead_ms: u32,
    /// Other agents that are known at the same time.
    pub max_agents: usize,
    /// Agents unheard of for longer are forgotten, ms.
    pub forget_ms: u32,
}

impl Default for BankConfig {
    fn default() -> Self {
        BankConfig {
            window_ms: 400,
            patience_ms: 0,
            offline: false,
            ahead_ms: 1000,
            max_agents: 256,
            forget_ms: 60_000,
        }
    }
}

/// Holds what collaborators sent and answers the ego's queries.
pub struct FeatureBank {
    bank: Bank,
    window_ms: u32,
    patience: Nanos,
    /// Queries that wait, by the time at which they are answered at the latest, and arrival.
    pending: BTreeMap<(Nanos, u64), Waiting>,
    /// Queries so far.
    queries: u64,
    /// By seq: whom the ego's message has in it already.
    fused: BTreeMap<u64, BTreeSet<Name>>,
}

/// A query that waits.
struct Waiting {
    query: Header,
    /// Online: senders whose next message would let it go on; offline it waits out its time.
    awaited: BTreeSet<Name>,
}

const ENTRIES: Counter = Counter::plain("entries", "messages given to queries, once for each");
const REPEATED: Counter = Counter::plain("repeated", "messages that are held already (copies made by a channel)");
const FROM_EGO: Counter = Counter::plain("from_ego", "messages of the ego itself, which nobody needs");

impl Describe for FeatureBank {
    type Config = BankConfig;
    const NAME: &'static str = "feature-bank";
    const ABOUT: &'static str = "Holds what collaborators sent and selects what each message of the ego is fused with";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "window_ms",
            about: "max age of what is selected online, ms",
        },
        Argument {
            name: "patience_ms",
            about: "how long a query waits online for a message that its sender's rhythm announces, ms; 0 = nobody waits",
        },
        Argument {
            name: "offline",
            about: "select the nearest stamp within ±50 ms instead of the newest in the window",
        },
        Argument {
            name: "ahead_ms",
            about: "how far a stamp may lie after its message's arrival, ms",
        },
        Argument {
            name: "max_agents",
            about: "other agents that are known at the same time; one more is rejected",
        },
        Argument {
            name: "forget_ms",
            about: "agents unheard of for longer are forgotten, ms",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("ego", FUSABLE, "what the ego says of itself; each message is a query")
            .query()
            .of(Lane::Ego),
        Port::new("others", FUSABLE, "what collaborators say")
            .accounting()
            .of(Lane::OthersReceived),
        Port::new(
            "fused",
            &[PayloadType::Selection],
            "whom the ego's message of a seq has in it already, from a bank before this one",
        )
        .optional()
        .of(Lane::Ego),
    ];
    const OUTPUTS: &'static [Port] = &[Port::new(
        "selections",
        &[PayloadType::Selection],
        "one for each query, with the query's header",
    )
    .of(Lane::Ego)];
    const COUNTERS: &'static [Counter] = &[ENTRIES, REPEATED, FROM_EGO];
    const DECIDED: &'static [(Decided, &'static str)] = &[(Decided::Offline, "offline")];
}

impl FeatureBank {
    fn ask(&mut self, query: Header, out: &mut Outputs) {
        let (until, awaited) = if self.bank.offline {
            (query.stamp.saturating_add(OFFLINE_REACH), BTreeSet::new())
        } else {
            // Selections leave in the order of the queries.
            for waiting in std::mem::take(&mut self.pending).into_values() {
                self.answer(waiting.query, out);
            }
            let until = query.ready.saturating_add(self.patience);
            // Its patience may be over before its turn comes.
            let mut awaited = match self.patience > 0 && until > out.now() {
                true => self.bank.awaited(&query, self.patience),
                false => BTreeSet::new(),
            };
            if let Some(fused) = self.fused.get(&query.seq) {
                awaited.retain(|agent| !fused.contains(agent));
            }
            if awaited.is_empty() {
                return self.answer(query, out);
            }
            (until, awaited)
        };
        out.wake_at(until);
        self.pending.insert((until, self.queries), Waiting { query, awaited });
        self.queries += 1;
    }

    /// What `stale` means here.
    fn stale(&self) -> String {
        match self.bank.offline {
            true => format!(
                "had stamps more than {} ms from the ego's",
                OFFLINE_REACH / NANOS_PER_MILLI
            ),
            false => format!("were older than {} ms", self.window_ms),
        }
    }

    /// A message has come: who has waited for it, and for nobody else, goes on.
    fn go_on(&mut self, sender: &Name, out: &mut Outputs) {
        let Some(mut first) = self.pending.first_entry() else {
            return;
        };
        let came = first.get_mut().awaited.remove(sender);
        if came && first.get().awaited.is_empty() {
            let waiting = first.remove();
            self.answer(waiting.query, out);
        }
    }

    fn answer(&mut self, query: Header, out: &mut Outputs) {
        // A query that has only waited for its turn must not see what became ready after it.
        let asked = match self.patience {
            0 => query.ready,
            _ => query.ready.max(out.now()),
        };
        let later = self.fused.split_off(&query.seq.saturating_add(1));
        let fused = std::mem::replace(&mut self.fused, later).remove(&query.seq);
        let answer = self.bank.answer(&query, asked, &fused.unwrap_or_default());
        out.count(&ENTRIES, "", answer.entries.len() as u64);
        answer
            .departed
            .iter()
            .for_each(|(header, fate)| out.report(header, *fate));
        let selection = Selection {
            query: query.seq,
            entries: answer.entries,
        };
        out.send(SELECTIONS, Message::new(query, selection));
    }
}

impl Operator for FeatureBank {
    fn new(config: BankConfig) -> Result<Self, Error> {
        if config.max_agents == 0 {
            return Err("argument `max_agents`: expected at least 1, found 0; nothing could be fused".into());
        }
        let nanos = |millis: u32| Nanos::from(millis) * NANOS_PER_MILLI;
        if config.forget_ms < config.window_ms {
            let (forget, window) = (config.forget_ms, config.window_ms);
            return Err(
                format!("argument `forget_ms`: expected at least `window_ms` = {window}, found {forget}").into(),
            );
        }
        let (window, ahead, forget) = (nanos(config.window_ms), nanos(config.ahead_ms), nanos(config.forget_ms));
        let bank = Bank::new(window, config.offline, ahead, config.max_agents, forget);
        Ok(FeatureBank {
            bank,
            window_ms: config.window_ms,
            patience: nanos(config.patience_ms),
            pending: BTreeMap::new(),
            queries: 0,
            fused: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        match port {
            EGO => {
                self.bank.expect(message.payload.payload_type());
                self.ask(message.header, out);
            }
            OTHERS => {
                let sender = message.header.agent.clone();
                match self.bank.insert(message)? {
                    Taken::Held { newest: true } => self.go_on(&sender, out),
                    Taken::Held { newest: false } => {}
                    Taken::Repeated => out.count(&REPEATED, &sender, 1),
                    Taken::FromEgo => out.count(&FROM_EGO, &sender, 1),
                }
            }
            FUSED => {
                let (_, Selection { query, entries }) = message.into_parts().map_err(unexpected)?;
                let agents = entries.into_iter().map(|entry| entry.header.agent).collect();
                self.fused.insert(query, agents);
                if self.fused.len() > AHEAD {
                    self.fused.pop_first();
                }
            }
            _ => return Err(wrong_port(Self::INPUTS, port)),
        }
        Ok(())
    }

    fn on_wake(&mut self, now: Nanos, out: &mut Outputs) -> Result<(), Error> {
        let later = self.pending.split_off(&(now.saturating_add(1), 0));
        for waiting in std::mem::replace(&mut self.pending, later).into_values() {
            self.answer(waiting.query, out);
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        out.explain(Fate::Stale, self.stale());
        for waiting in std::mem::take(&mut self.pending).into_values() {
            self.answer(waiting.query, out);
        }
        let departed = self.bank.close();
        departed.iter().for_each(|(header, fate)| out.report(header, *fate));
        Ok(())
    }
}

#[cfg(test)]
mod tests;
