use std::borrow::Cow;
use std::collections::BTreeMap;

use realo_schemas::report::SensorClock;
use serde::{Deserialize, Serialize};

/// What a count above 0 means to whoever reads a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Meaning {
    /// How much was done, or what was left out on purpose: no note.
    #[default]
    Plain,
    /// Data were lost or changed: a note.
    Loss,
    /// Data were lost because of what the log holds: a note, and `realo run` exits with 3.
    LogFault,
}

/// What an operator or node counts, with the words for whoever reads a result.
///
/// In [`note`](Counter::note) and [`remedy`](Counter::remedy) `{node}` stands for the id of the node in its graph.
#[derive(Clone, Copy, Debug)]
pub struct Counter {
    /// Name in `result.json`.
    pub name: &'static str,
    /// What is counted, in a line, for the reference.
    pub about: &'static str,
    /// What a count above 0 means.
    pub meaning: Meaning,
    /// A share that makes no note, percent.
    pub quiet_percent: u8,
    /// Goes on after "rsu1: 3 of 20 ", e.g. "sweeps were dropped, because …".
    pub note: &'static str,
    /// What to try.
    pub remedy: &'static str,
}

impl Counter {
    /// Counts what is no loss.
    pub const fn plain(name: &'static str, about: &'static str) -> Self {
        Counter::new(name, about, Meaning::Plain, ["", ""])
    }

    /// Counts data that were lost or changed.
    pub const fn loss(name: &'static str, about: &'static str, note: &'static str, remedy: &'static str) -> Self {
        Counter::new(name, about, Meaning::Loss, [note, remedy])
    }

    /// Counts data that were lost because of what the log holds.
    pub const fn log_fault(name: &'static str, about: &'static str, note: &'static str, remedy: &'static str) -> Self {
        Counter::new(name, about, Meaning::LogFault, [note, remedy])
    }

    const fn new(name: &'static str, about: &'static str, meaning: Meaning, [note, remedy]: [&'static str; 2]) -> Self {
        Counter {
            name,
            about,
            meaning,
            quiet_percent: 0,
            note,
            remedy,
        }
    }

    /// Makes no note of an agent of whom no more than this share was lost, as at the start of every run.
    pub const fn quiet_up_to(self, quiet_percent: u8) -> Self {
        Counter { quiet_percent, ..self }
    }
}

/// What a stage counted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counts {
    /// By counter.
    pub counters: BTreeMap<Cow<'static, str>, u64>,
    /// More about those that are losses.
    pub losses: BTreeMap<Cow<'static, str>, Loss>,
    /// What it knows of clocks; of each sensor the newest counts.
    pub clocks: Vec<SensorClock>,
}

/// A counter that is a loss, with its words: results need not know the stage.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    /// What it means.
    pub meaning: Meaning,
    /// See [`Counter::quiet_up_to`].
    #[serde(default, skip_serializing_if = "is_default")]
    pub quiet_percent: u8,
    /// See [`Counter::note`].
    pub note: Cow<'static, str>,
    /// See [`Counter::remedy`].
    pub remedy: Cow<'static, str>,
    /// By agent; empty: of nobody in particular.
    pub agents: BTreeMap<String, Share>,
    /// By agent: what was found of the first, e.g. "poses 200 ms apart".
    #[serde(default, skip_serializing_if = "is_default")]
    pub found: BTreeMap<String, String>,
}

/// How many of how many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Share {
    /// How many.
    pub count: u64,
    /// Of how many; 0 where that is not known.
    #[serde(default, skip_serializing_if = "is_default")]
    pub of: u64,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl Share {
    fn add(&mut self, other: Share) {
        self.count = self.count.saturating_add(other.count);
        self.of = self.of.saturating_add(other.of);
    }
}

impl Loss {
    /// Of all agents together.
    pub fn count(&self) -> u64 {
        self.agents
            .values()
            .fold(0, |sum, share| sum.saturating_add(share.count))
    }

    /// Those of whom so much was lost that it is worth a note.
    pub fn worth_a_note(&self) -> impl Iterator<Item = (&str, Share)> {
        let is_quiet = |share: &Share| {
            let [count, of] = [share.count, share.of].map(u128::from);
            of > 0 && count * 100 <= of * u128::from(self.quiet_percent)
        };
        let lost = self
            .agents
            .iter()
            .filter(move |(_, share)| share.count > 0 && !is_quiet(share));
        lost.map(|(agent, share)| (agent.as_str(), *share))
    }

    /// Adds what the same counter has elsewhere; its words are the newest.
    pub fn add(&mut self, other: &Loss) {
        (self.meaning, self.quiet_percent) = (other.meaning, other.quiet_percent);
        self.note.clone_from(&other.note);
        self.remedy.clone_from(&other.remedy);
        for (agent, share) in &other.agents {
            self.agents.entry(agent.clone()).or_default().add(*share);
        }
        for (agent, found) in &other.found {
            self.found.entry(agent.clone()).or_insert_with(|| found.clone());
        }
    }
}

impl Counts {
    /// Adds `n` of `of` things of an agent; where `n` is 0 only the number of things grows.
    ///
    /// `agent` is empty where the count is of nobody in particular, `of` is 0 where it is not known.
    pub fn add(&mut self, counter: &'static Counter, agent: &str, n: u64, of: u64) {
        self.add_named(counter.name, n);
        if counter.meaning == Meaning::Plain || (n == 0 && of == 0) {
            return;
        }
        let loss = self.losses.entry(counter.name.into()).or_insert_with(|| Loss {
            meaning: counter.meaning,
            quiet_percent: counter.quiet_percent,
            note: counter.note.into(),
            remedy: counter.remedy.into(),
            ..Loss::default()
        });
        let share = match loss.agents.get_mut(agent) {
            Some(share) => share,
            None => loss.agents.entry(agent.into()).or_default(),
        };
        share.add(Share { count: n, of });
    }

    /// Says what was found of the first that an agent lost; the note has it in brackets. Does nothing before a loss was counted.
    pub fn found(&mut self, counter: &'static Counter, agent: &str, words: impl FnOnce() -> String) {
        if let Some(loss) = self.losses.get_mut(counter.name) {
            loss.found.entry(agent.into()).or_insert_with(words);
        }
    }

    /// Adds to a counter that is known by its name only, as those of plug-ins are.
    pub fn add_named(&mut self, counter: impl Into<Cow<'static, str>>, n: u64) {
        if n > 0 {
            let count = self.counters.entry(counter.into()).or_default();
            *count = count.saturating_add(n);
        }
    }

    /// Adds the counts of another call.
    pub fn extend(&mut self, other: Counts) {
        for (counter, n) in other.counters {
            self.add_named(counter, n);
        }
        for (counter, loss) in other.losses {
            self.losses.entry(counter).or_default().add(&loss);
        }
        newest(&mut self.clocks, other.clocks);
    }

    /// A counter's value.
    pub fn get(&self, counter: &str) -> u64 {
        self.counters.get(counter).copied().unwrap_or(0)
    }
}

/// Puts what is known of clocks in the place of what was known before.
pub(crate) fn newest(known: &mut Vec<SensorClock>, newer: Vec<SensorClock>) {
    for clock in newer {
        let same = |old: &&mut SensorClock| (&old.agent, &old.sensor) == (&clock.agent, &clock.sensor);
        match known.iter_mut().find(same) {
            Some(old) => *old = clock,
            None => known.push(clock),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEPT: Counter = Counter::plain("kept", "boxes that were kept");
    const LATE: Counter = Counter::loss("late", "boxes dropped: late", "boxes were late", "wait longer");

    #[test]
    fn losses_know_their_agents_and_how_many_there_were() {
        let mut counts = Counts::default();
        for n in [1, 0, 2] {
            counts.add(&LATE, "rsu1", n, 5);
            counts.add(&KEPT, "rsu1", n, 5);
        }
        counts.add(&LATE, "cav2", 0, 5);
        let mut sum = Counts::default();
        sum.extend(counts.clone());
        sum.extend(counts);
        assert_eq!((sum.get("late"), sum.get("kept"), sum.get("other")), (6, 6, 0));
        let late = &sum.losses["late"];
        assert_eq!(
            (late.agents["rsu1"], late.agents["cav2"]),
            (Share { count: 6, of: 30 }, Share { count: 0, of: 10 })
        );
        assert_eq!(
            (late.count(), &*late.note, late.meaning),
            (6, "boxes were late", Meaning::Loss)
        );
        assert!(!sum.losses.contains_key("kept"));
        assert_eq!(late.worth_a_note().count(), 1);
        let quiet = |quiet_percent| Loss {
            quiet_percent,
            ..late.clone()
        };
        assert_eq!([19, 20].map(|percent| quiet(percent).worth_a_note().count()), [1, 0]);
    }
}
