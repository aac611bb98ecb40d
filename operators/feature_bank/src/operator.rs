use std::collections::{BTreeMap, BTreeSet};

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::report::Fate;
use realo_schemas::{Header, Message, Name, Nanos, OFFLINE_REACH, Selection};
use serde::{Deserialize, Serialize};

use crate::{Bank, Taken};

/// Selections of a bank before this one whose queries have not come here.
const AHEAD: usize = 64;

const NANOS_PER_MILLI: Nanos = 1_000_000;

/// Settings of the bank.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Max age of what is selected online, ms.
    #[setting(default = 400, range = 0..=3_600_000)]
    pub window_ms: u32,
    /// How long a query waits online for a message that its sender's rhythm announces, ms; 0 = nobody waits.
    #[setting(range = 0..=3_600_000)]
    pub patience_ms: u32,
    /// Select the nearest stamp within ±50 ms instead of the newest in the window.
    #[setting(role = "offline")]
    pub offline: bool,
    /// How far a stamp may lie after its message's arrival, ms.
    #[setting(default = 1000, range = 0..=3_600_000)]
    pub ahead_ms: u32,
    /// Other agents that are known at the same time; one more is rejected.
    #[setting(default = 256, range = 1..=1_000_000)]
    pub max_agents: usize,
    /// Agents unheard of for longer are forgotten, ms.
    #[setting(default = 60_000, range = 1..=86_400_000)]
    pub forget_ms: u32,
}

/// Agents would be forgotten while their messages are of use.
#[derive(Debug, thiserror::Error)]
#[error("setting `forget_ms`: expected at least `window_ms` = {window}, found {forget}")]
pub struct Forgetful {
    window: u32,
    forget: u32,
}

/// Holds what collaborators sent and selects what each message of the ego is fused with.
#[derive(Describe)]
#[stage(counters(ENTRIES, REPEATED, FROM_EGO))]
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

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// What the ego says of itself; each message is a query.
    #[port(any_of(PointCloud, FeatureMap, Boxes), query, of(Ego))]
    Ego(Message),
    /// What collaborators say.
    #[port(any_of(PointCloud, FeatureMap, Boxes), accounting, of(OthersReceived))]
    Others(Message),
    /// Whom the ego's message of a seq has in it already, from a bank before this one.
    #[port(optional, of(Ego))]
    Fused(Header, Selection),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// One for each query, with the query's header.
    #[port(of(Ego))]
    Selections(Header, Selection),
}

impl FeatureBank {
    fn ask(&mut self, query: Header, out: &mut Outputs<Output>) {
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
    fn go_on(&mut self, sender: &Name, out: &mut Outputs<Output>) {
        let Some(mut first) = self.pending.first_entry() else {
            return;
        };
        let came = first.get_mut().awaited.remove(sender);
        if came && first.get().awaited.is_empty() {
            let waiting = first.remove();
            self.answer(waiting.query, out);
        }
    }

    fn answer(&mut self, query: Header, out: &mut Outputs<Output>) {
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
        out.send(Output::Selections(query, selection));
    }
}

impl Operator for FeatureBank {
    fn build(settings: Settings) -> Result<Self, Error> {
        let nanos = |millis: u32| Nanos::from(millis) * NANOS_PER_MILLI;
        if settings.forget_ms < settings.window_ms {
            let (forget, window) = (settings.forget_ms, settings.window_ms);
            return Err(Forgetful { window, forget }.into());
        }
        let (window, ahead, forget) = (
            nanos(settings.window_ms),
            nanos(settings.ahead_ms),
            nanos(settings.forget_ms),
        );
        let bank = Bank::new(window, settings.offline, ahead, settings.max_agents, forget);
        Ok(FeatureBank {
            bank,
            window_ms: settings.window_ms,
            patience: nanos(settings.patience_ms),
            pending: BTreeMap::new(),
            queries: 0,
            fused: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Ego(message) => {
                self.bank.expect(message.payload.payload_type());
                self.ask(message.header, out);
            }
            Input::Others(message) => {
                let sender = message.header.agent.clone();
                match self.bank.insert(message)? {
                    Taken::Held { newest: true } => self.go_on(&sender, out),
                    Taken::Held { newest: false } => {}
                    Taken::Repeated => out.count(&REPEATED, &sender, 1),
                    Taken::FromEgo => out.count(&FROM_EGO, &sender, 1),
                }
            }
            Input::Fused(_, Selection { query, entries }) => {
                let agents = entries.into_iter().map(|entry| entry.header.agent).collect();
                self.fused.insert(query, agents);
                if self.fused.len() > AHEAD {
                    self.fused.pop_first();
                }
            }
        }
        Ok(())
    }

    fn on_wake(&mut self, now: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        let later = self.pending.split_off(&(now.saturating_add(1), 0));
        for waiting in std::mem::replace(&mut self.pending, later).into_values() {
            self.answer(waiting.query, out);
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
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
