//! What runs were made with: what all share, and what differs.

use std::collections::{BTreeMap, BTreeSet};

use realo_results::{Run, Settings};
use serde_json::{Map, Value};

use crate::cells::count;
use crate::columns::OFFLINE;
use crate::differences::listed;

/// A setting: its name, as `result.json` and options have it, and its value.
pub type Setting = (&'static str, fn(&Settings) -> &String);

pub const LINK: Setting = ("link", |settings| &settings.link);
pub const COMPUTE: Setting = ("compute", |settings| &settings.compute);
pub const SEED: Setting = ("seed", |settings| &settings.seed);
pub const PROJECT: Setting = ("project", |settings| &settings.project);
/// Where poses were estimated from.
pub const POSE_SOURCE: Setting = ("pose_source", |settings| &settings.pose_source);
pub const PRECOMPUTED: Setting = ("precomputed", |settings| &settings.precomputed);
pub const MODEL: Setting = ("model", |settings| &settings.model);
pub const ISA: Setting = ("isa", |settings| &settings.isa);
/// Arguments and stages that were changed by hand.
pub const SET: Setting = ("set", |settings| &settings.set);
pub const PROGRAMS: Setting = ("programs", |settings| &settings.programs);
pub const GRAPH_HASH: Setting = ("graph_hash", |settings| &settings.graph_hash);
pub const RATE: Setting = ("rate", |settings| &settings.rate);

/// Whether whoever started a run chose this setting.
pub fn is_given(run: &Run, name: &str) -> bool {
    run.samples.given.iter().any(|given| given == name)
}

/// What a run was made with: `link perfect`.
struct Fact {
    name: String,
    /// What is said behind the value in place of the name before it.
    unit: Option<&'static str>,
    /// Run by run; `None` where a run has no such thing.
    values: Vec<Option<String>>,
}

impl Fact {
    fn of(name: &str, runs: &[&Run], value: impl Fn(&Run) -> Option<String>) -> Self {
        Fact {
            name: name.into(),
            unit: None,
            values: runs.iter().map(|run| value(run)).collect(),
        }
    }

    fn counted(self, unit: &'static str) -> Self {
        let unit = Some(unit);
        Fact { unit, ..self }
    }

    /// The value of all runs that have one.
    fn shared(&self) -> Option<&str> {
        let mut known = self.values.iter().flatten();
        let first = known.next()?;
        known.all(|value| value == first).then_some(first)
    }

    /// `link perfect (no_fusion has none)`.
    fn in_words(&self, names: &[&str]) -> Option<String> {
        let value = self.shared()?;
        let said = match self.unit {
            Some("") => value.to_string(),
            Some(unit) => {
                let number = value.parse().map_or(value.to_string(), count);
                format!("{number} {unit}")
            }
            None if self.name.contains('.') => format!("{}={value}", self.name),
            None => format!("{} {value}", self.name),
        };
        let pick = |has: bool| {
            let mut picked: Vec<&str> = Vec::new();
            for (name, value) in names.iter().zip(&self.values) {
                if value.is_some() == has && !picked.contains(name) {
                    picked.push(name);
                }
            }
            picked
        };
        let (with, without) = (pick(true), pick(false));
        Some(match (with.len(), without.len()) {
            (_, 0) => said,
            (_, 1) => format!("{said} ({} has none)", without[0]),
            (1, _) => format!("{said} (only {} has one)", with[0]),
            (with_it, without_it) if with_it < without_it => format!("{said} (only {} have one)", listed(&with)),
            _ => format!("{said} ({} have none)", listed(&without)),
        })
    }
}

fn text(value: &str) -> Option<String> {
    (!value.is_empty()).then(|| value.to_string())
}

/// Whether detections came out of the log and not from a network.
pub fn has_recorded_detections(run: &Run) -> bool {
    let mut nodes = run.result.nodes.values();
    nodes.any(|node| node.operator == "recorded-detections")
}

/// What runs may share, in the order in which it is said.
fn facts(runs: &[&Run]) -> Vec<Fact> {
    let of = |name: &str, value: &dyn Fn(&Run) -> Option<String>| Fact::of(name, runs, value);
    let setting = |(name, get): Setting| of(name, &|run| text(get(&run.result.settings)));
    let is_online = |run: &Run| run.result.settings.mode != OFFLINE;
    let mut facts = vec![
        setting(("mode", |settings| &settings.mode)).counted(""),
        setting(("ego", |settings| &settings.ego)),
        of("coop", &|run| {
            text(&run.result.settings.coop).filter(|coop| coop != "all")
        }),
        // Offline a link does nothing.
        of("link", &|run| {
            text(&run.result.settings.link).filter(|_| is_online(run))
        }),
        setting(SEED),
        setting(COMPUTE),
        setting(PROJECT),
        setting(POSE_SOURCE),
        setting(PRECOMPUTED),
        setting(MODEL),
        setting(ISA),
        setting(PROGRAMS),
        setting(RATE),
    ];
    facts.extend(changed(runs));
    facts.extend([
        of("detections", &|run| {
            has_recorded_detections(run).then(|| "recorded".into())
        }),
        of("agents", &|run| {
            let agents: BTreeSet<&str> = run.result.agents.iter().map(String::as_str).collect();
            (!agents.is_empty()).then(|| listed(&agents.into_iter().collect::<Vec<_>>()))
        }),
        of("log", &|run| match run.result.logs.len() {
            0 | 1 => text(&run.result.logs.concat()),
            _ => None,
        }),
        of("logs", &|run| match run.result.logs.len() {
            0 | 1 => None,
            logs => Some(logs.to_string()),
        })
        .counted("logs"),
        of("protocol", &|run| run.result.protocol.as_deref().and_then(text)),
        of("scored_frames", &|run| match run.result.frames.key {
            0 => None,
            frames => Some(frames.to_string()),
        })
        .counted("scored frames"),
    ]);
    facts
}

/// The arguments and stages that were changed by hand, one by one. A run whose graph has no such stage has no value; a run
/// that could have been changed says `not set`.
fn changed(runs: &[&Run]) -> Vec<Fact> {
    let changes: Vec<BTreeMap<String, String>> = runs.iter().map(|run| changes(&run.result.settings.set)).collect();
    let arguments: BTreeSet<&String> = changes.iter().flat_map(BTreeMap::keys).collect();
    let of_argument = |argument: &String| {
        let stages = stages_of(argument);
        // Stages below the results are in no run's result.
        let has_stage = |run: &Run| stages.iter().any(|stage| run.result.nodes.contains_key(*stage));
        let is_known = runs.iter().any(|run| has_stage(run));
        let value = |(run, changes): (&&Run, &BTreeMap<String, String>)| match changes.get(argument) {
            Some(value) => Some(value.clone()),
            None => (has_stage(run) || !is_known).then(|| NOT_SET.to_string()),
        };
        Fact {
            name: argument.clone(),
            unit: None,
            values: runs.iter().zip(&changes).map(value).collect(),
        }
    };
    arguments.into_iter().map(of_argument).collect()
}

/// What is said of an argument that a run could have been given.
const NOT_SET: &str = "not set";

/// The stage of `a.b.key=…`, and what `a.b+c,d.b+c=…` replaces.
fn stages_of(argument: &str) -> Vec<&str> {
    let stage = argument.rsplit_once('.').map_or(argument, |(stage, _)| stage);
    std::iter::once(stage).chain(places_of(argument)).collect()
}

/// What a change by hand names: an argument, or the stages that `a.b+c,d.b+c=…` replaces.
pub fn places_of(argument: &str) -> impl Iterator<Item = &str> {
    argument.split([',', '+'])
}

/// The arguments changed by hand, with the values that differ among the runs that could have them.
pub fn changed_differently(runs: &[(&str, &Run)]) -> Vec<(String, Vec<Option<String>>)> {
    let all: Vec<&Run> = runs.iter().map(|(_, run)| *run).collect();
    let differ = changed(&all).into_iter().filter(|fact| fact.shared().is_none());
    differ.map(|fact| (fact.name, fact.values)).collect()
}

/// `a.b=1, c.d=2,3` by its arguments: values may hold commas.
pub fn changes(set: &str) -> BTreeMap<String, String> {
    let mut found: Vec<(String, String)> = Vec::new();
    for part in set.split(", ").filter(|part| !part.is_empty()) {
        match (part.split_once('='), found.last_mut()) {
            (Some((name, value)), _) => found.push((name.into(), value.into())),
            (None, Some((_, value))) => value.push_str(&format!(", {part}")),
            (None, None) => found.push((part.into(), String::new())),
        }
    }
    found.into_iter().collect()
}

/// What all runs were made with: `offline; ego cav1; log demo; protocol default; 20 scored frames`. What only some have is
/// said of these.
pub fn common(runs: &[(&str, &Run)]) -> String {
    let names: Vec<&str> = runs.iter().map(|(name, _)| *name).collect();
    let all: Vec<&Run> = runs.iter().map(|(_, run)| *run).collect();
    let said = facts(&all).into_iter().filter_map(|fact| fact.in_words(&names));
    said.collect::<Vec<_>>().join("; ")
}

/// The same by name; arguments changed by hand under `set`.
pub fn common_fields(runs: &[(&str, &Run)]) -> Value {
    let all: Vec<&Run> = runs.iter().map(|(_, run)| *run).collect();
    let (mut fields, mut set) = (Map::new(), Map::new());
    for fact in facts(&all) {
        let Some(value) = fact.shared() else { continue };
        let number = fact.unit.and_then(|_| value.parse::<u64>().ok());
        match (fact.name.contains('.'), number) {
            (true, _) => set.insert(fact.name.clone(), value.into()),
            (false, Some(number)) => fields.insert(fact.name.clone(), number.into()),
            (false, None) => fields.insert(fact.name.clone(), value.into()),
        };
    }
    if !set.is_empty() {
        fields.insert(SET.0.into(), set.into());
    }
    fields.into()
}

#[cfg(test)]
mod tests {
    use crate::tests::{names, run, table};
    use crate::{Format, Options, Run, pool, shown};

    #[test]
    fn long_words_do_not_part_two_runs() {
        let [mut one, mut other] = [run("a", "cav1", 1), run("a", "cav1", 2)];
        one.result.settings.model = "lite-2e46ebab164e18a4".into();
        other.result.settings.model = "lite-attfuse-2e46ebab164e18a4, lite-2e46ebab164e18a4".into();
        let text = table(&[("one", &one), ("other", &other)], false, 80);
        assert_eq!(text.lines().filter(|line| line.starts_with('─')).count(), 1, "{text}");
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
    }

    #[test]
    fn model_and_isa_are_main_rows_where_they_differ_or_were_chosen() {
        let [mut one, mut other] = [run("a", "cav1", 1), run("a", "cav1", 2)];
        for run in [&mut one, &mut other] {
            (run.result.settings.model, run.result.settings.isa) = ("lite-1".into(), "f32 on avx2".into());
        }
        let rows = |one: &Run, other: &Run| {
            let text = table(&[("one", one), ("other", other)], false, 100);
            ["model", "isa", "seed"].map(|row| {
                text.lines()
                    .any(|line| line.trim_start().starts_with(&format!("{row} ")))
            })
        };
        assert_eq!(rows(&one, &other), [false; 3], "alike, and nobody chose");
        one.samples.given = names(["isa"]);
        assert_eq!(rows(&one, &other), [false, true, false]);
        other.result.settings.model = "lite-attfuse-2".into();
        assert_eq!(rows(&one, &other), [true, true, false]);
        other.result.settings.model.clear();
        assert!(!rows(&one, &other)[0], "no network is no other network");
        assert_eq!(pool(&[one.clone()]).unwrap().samples.given, ["isa"]);
        // Each graph has its model; a chosen one is named beside others all the same.
        let mut third = run("a", "cav1", 3);
        third.result.settings.graph = "v2xvit".into();
        third.result.settings.model = "lite-attfuse-2".into();
        let markdown = |third: &Run| {
            let options = Options {
                format: Format::Markdown,
                ..Options::default()
            };
            shown(&[("one", &one), ("other", &one), ("third", third)], &options)
        };
        assert!(!markdown(&third).contains("lite-attfuse-2"));
        third.samples.given = names(["model"]);
        assert!(markdown(&third).starts_with("| run | model |"), "{}", markdown(&third));
    }
}
