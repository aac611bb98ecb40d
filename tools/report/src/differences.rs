use std::collections::{BTreeMap, BTreeSet};

use realo_results::{Run, RunResult};
use realo_scoring::{Evaluation, Frame, Protocol, Scene};

use crate::graphs::of_graphs;
use crate::settings::{self, Setting};

/// So many names are listed; what there is beside is counted.
const NAMED: usize = 5;

/// Picks a list of names.
type Names = fn(&RunResult) -> &Vec<String>;

/// What differs between runs besides the strategy: logs, egos, agents, protocol and truth, then every setting. One sentence
/// each, which names the runs; nothing where all is alike.
pub fn differences(runs: &[(&str, &Run)]) -> Vec<String> {
    let mut found = of_data(runs);
    found.extend(of_detections(runs));
    found.extend(all_settings(runs));
    found
}

/// Which runs have detections of the log, where others have those of a network.
fn of_detections(runs: &[(&str, &Run)]) -> Option<String> {
    let [recorded, own] = [true, false].map(|recorded| -> Vec<&str> {
        let of = runs
            .iter()
            .filter(|(_, run)| settings::has_recorded_detections(run) == recorded);
        of.map(|(name, _)| *name).collect()
    });
    let differ = !recorded.is_empty() && !own.is_empty();
    differ.then(|| {
        format!(
            "detections differ: the log's in {}, a network's in {}",
            listed(&recorded),
            listed(&own)
        )
    })
}

/// What makes numbers hard to compare: other logs, egos, agents, another graph of the name, protocol or truth.
pub fn of_data(runs: &[(&str, &Run)]) -> Vec<String> {
    let lists: [(&str, Names); 3] = [
        ("logs", |result| &result.logs),
        ("egos", |result| &result.egos),
        ("agents", |result| &result.agents),
    ];
    let mut found: Vec<String> = lists
        .iter()
        .filter_map(|(what, get)| of_names(what, runs, get))
        .collect();
    found.extend(of_graphs(runs));
    found.extend(of_contents(runs));
    found.extend(of_protocols(runs));
    found.extend(of_truth(runs));
    found
}

/// A setting, and what stands where it has no value; without that, such runs cannot choose it.
type Named = (Setting, Option<&'static str>);

const SETTINGS: [Named; 9] = [
    (("mode", |settings| &settings.mode), Some("not known")),
    (("coop", |settings| &settings.coop), Some("not known")),
    (settings::LINK, None),
    (settings::SEED, None),
    (settings::COMPUTE, Some("none")),
    (settings::PROJECT, None),
    (settings::POSE_SOURCE, Some("recorded")),
    (settings::PRECOMPUTED, Some("none")),
    (settings::RATE, Some("not set")),
];
/// What mostly comes with a strategy.
const OF_STRATEGY: [Named; 3] = [
    (settings::MODEL, None),
    (settings::ISA, None),
    (settings::PROGRAMS, Some("none")),
];

/// A setting that differs, by its name, and its value run by run; `None` where a run has none and cannot choose it.
pub type Differing = (String, Vec<Option<String>>);

/// Every setting that differs.
fn all_settings(runs: &[(&str, &Run)]) -> Vec<String> {
    let named = SETTINGS.iter().chain(&OF_STRATEGY);
    in_words(runs, with_changes(runs, named))
}

/// The settings that differ beside those that each graph has once and nobody chose.
pub fn of_settings(runs: &[(&str, &Run)]) -> Vec<String> {
    in_words(runs, values_of_settings(runs))
}

/// The same as values, run by run.
pub fn values_of_settings(runs: &[(&str, &Run)]) -> Vec<Differing> {
    let by_graph = |((_, get), _): &&Named| {
        let mut known = BTreeMap::new();
        runs.iter().all(|(_, run)| {
            let settings = &run.result.settings;
            *known.entry(&settings.graph).or_insert(get(settings)) == get(settings)
        })
    };
    let is_given = |((name, _), _): &&Named| runs.iter().any(|(_, run)| settings::is_given(run, name));
    let of_strategy = OF_STRATEGY
        .iter()
        .filter(|setting| is_given(setting) || !by_graph(setting));
    with_changes(runs, SETTINGS.iter().chain(of_strategy))
}

fn with_changes<'a>(runs: &[(&str, &Run)], named: impl Iterator<Item = &'a Named>) -> Vec<Differing> {
    let mut found: Vec<Differing> = named.filter_map(|setting| of_setting(runs, setting)).collect();
    found.extend(settings::changed_differently(runs));
    found
}

fn of_setting(runs: &[(&str, &Run)], ((name, get), missing): &Named) -> Option<Differing> {
    let value = |(_, run): &(&str, &Run)| {
        let value = get(&run.result.settings);
        match value.is_empty() {
            true => missing.map(String::from),
            false => Some(value.clone()),
        }
    };
    let values: Vec<Option<String>> = runs.iter().map(value).collect();
    let known: BTreeSet<&String> = values.iter().flatten().collect();
    (known.len() > 1).then(|| (name.to_string(), values))
}

/// A sentence for each.
fn in_words(runs: &[(&str, &Run)], found: Vec<Differing>) -> Vec<String> {
    let said = |(name, values): Differing| {
        let of_run = |((run, _), value): (&(&str, &Run), Option<String>)| Some((run.to_string(), value?));
        let known: Vec<(String, String)> = runs.iter().zip(values).filter_map(of_run).collect();
        let known: Vec<(&str, String)> = known.iter().map(|(run, value)| (run.as_str(), value.clone())).collect();
        format!("{name} differs: {}", by_value(&known))
    };
    found.into_iter().map(said).collect()
}

/// Which names some runs have and others do not.
fn of_names(what: &str, runs: &[(&str, &Run)], get: impl Fn(&RunResult) -> &Vec<String>) -> Option<String> {
    // The names that the same runs have, in order of appearance.
    let mut groups: Vec<(Vec<bool>, Vec<&str>)> = Vec::new();
    for name in runs.iter().flat_map(|(_, run)| get(&run.result)) {
        if groups.iter().any(|(_, names)| names.contains(&name.as_str())) {
            continue;
        }
        let having: Vec<bool> = runs.iter().map(|(_, run)| get(&run.result).contains(name)).collect();
        match groups.iter_mut().find(|(known, _)| *known == having) {
            Some((_, names)) => names.push(name),
            None => groups.push((having, vec![name])),
        }
    }
    let (common, own): (Vec<_>, Vec<_>) = groups
        .into_iter()
        .partition(|(having, _)| having.iter().all(|has| *has));
    if own.is_empty() {
        return None;
    }
    let mut said: Vec<String> = own.iter().map(|(having, names)| whose(runs, having, names)).collect();
    said.extend(common.iter().map(|(_, names)| format!("all have {}", sorted(names))));
    Some(format!("{what} differ: {}", said.join("; ")))
}

fn sorted(names: &[&str]) -> String {
    let names: BTreeSet<&str> = names.iter().copied().collect();
    listed(&names.into_iter().collect::<Vec<_>>())
}

/// Says of names which runs have them, or which do not if these are fewer.
fn whose(runs: &[(&str, &Run)], having: &[bool], names: &[&str]) -> String {
    let pick = |wanted: bool| -> Vec<&str> {
        let picked = runs.iter().zip(having).filter(|(_, has)| **has == wanted);
        picked.map(|((name, _), _)| *name).collect()
    };
    let (with, without, names) = (pick(true), pick(false), sorted(names));
    match (with.len(), without.len()) {
        (1, _) => format!("only {} has {names}", with[0]),
        (_, 1) => format!("{} lacks {names}", without[0]),
        (with_it, without_it) if with_it <= without_it => format!("only {} have {names}", listed(&with)),
        _ => format!("{} lack {names}", listed(&without)),
    }
}

/// Names in a row; of many the first.
pub fn listed(names: &[&str]) -> String {
    match names.len() {
        0 => "none".into(),
        n if n <= NAMED => names.join(", "),
        n => format!("{} and {} more", names[..NAMED].join(", "), n - NAMED),
    }
}

/// `a in one, two; b in three`: the runs of each value, in order of appearance.
pub fn by_value(values: &[(&str, String)]) -> String {
    let mut groups: Vec<(&String, Vec<&str>)> = Vec::new();
    for (name, value) in values {
        match groups.iter_mut().find(|(known, _)| *known == value) {
            // A run may be there twice.
            Some((_, names)) if names.contains(name) => {}
            Some((_, names)) => names.push(name),
            None => groups.push((value, vec![name])),
        }
    }
    let groups = groups
        .iter()
        .map(|(value, names)| format!("{value} in {}", listed(names)));
    groups.collect::<Vec<_>>().join("; ")
}

/// The first log of one name that does not hold the same in all runs that have it.
fn of_contents(runs: &[(&str, &Run)]) -> Option<String> {
    let mut known: BTreeMap<&String, (&str, &String)> = BTreeMap::new();
    for (name, run) in runs {
        for (log, hash) in &run.samples.logs {
            let (first, held) = *known.entry(log).or_insert((name, hash));
            if held != hash {
                return Some(format!(
                    "logs differ: the log `{log}` does not hold the same in {first} and {name}"
                ));
            }
        }
    }
    None
}

fn of_protocols(runs: &[(&str, &Run)]) -> Option<String> {
    let protocol = |run: &Run| run.result.protocol.clone().unwrap_or_else(|| "no evaluation".into());
    let names: Vec<_> = runs.iter().map(|(name, run)| (*name, protocol(run))).collect();
    if names.iter().any(|(_, name)| *name != names[0].1) {
        return Some(format!("protocols differ: {}", by_value(&names)));
    }
    // Two files may have one name.
    let mut evaluated = runs.iter().filter_map(|(name, run)| Some((name, evaluation(run)?)));
    let (first, known) = evaluated.next()?;
    let (other, found) = evaluated.find(|(_, other)| other.protocol != known.protocol)?;
    let field = field_that_differs(&known.protocol, &found.protocol);
    Some(format!(
        "protocols differ: both are named `{}`, but {field} is not the same in {first} and {other}",
        known.protocol.name
    ))
}

fn evaluation(run: &Run) -> Option<&Evaluation> {
    run.samples.evaluation.as_ref()
}

fn field_that_differs(one: &Protocol, other: &Protocol) -> String {
    let fields = [one, other].map(|protocol| serde_json::to_value(protocol).unwrap_or_default());
    let names = fields[0].as_object().into_iter().flatten();
    let mut differing = names.filter(|(name, value)| fields[1].get(name) != Some(value));
    differing
        .next()
        .map_or("something".into(), |(name, _)| format!("`{name}`"))
}

/// The first scene that two runs of one protocol have, and of which they were reported different things.
fn of_truth(runs: &[(&str, &Run)]) -> Option<String> {
    for (index, (name, run)) in runs.iter().enumerate() {
        let Some(evaluation) = evaluation(run) else {
            continue;
        };
        for scene in &evaluation.scenes {
            // The first run that has the scene stands for all before this one.
            let earlier = runs[..index].iter().find_map(|(name, run)| {
                let other = self::evaluation(run).filter(|other| other.protocol == evaluation.protocol)?;
                let same = |known: &&Scene| (&known.name, &known.ego) == (&scene.name, &scene.ego);
                Some((*name, other.scenes.iter().find(same)?))
            });
            let Some((earlier, known)) = earlier.filter(|(_, known)| !same_truth(known, scene)) else {
                continue;
            };
            let (log, ego) = (&scene.name, &scene.ego);
            let reported = by_value(&[(earlier, reported(known)), (*name, reported(scene))]);
            let reported = match reported.split_once("; ") {
                Some(_) => reported,
                None => format!("as many, but not the same objects: {reported}"),
            };
            return Some(format!("truth differs, first in log `{log}`, ego {ego}: {reported}"));
        }
    }
    None
}

fn reported(scene: &Scene) -> String {
    let keys = keys(scene);
    let objects: usize = keys.iter().map(|frame| frame.truths.len()).sum();
    format!("{objects} objects in {} scored frames", keys.len())
}

fn keys(scene: &Scene) -> Vec<&Frame> {
    scene.frames.iter().filter(|frame| frame.key).collect()
}

/// Whether scores of two scenes are against the same objects. Points of all agents decide which objects those are, and
/// need not be the same beyond that.
fn same_truth(one: &Scene, other: &Scene) -> bool {
    let object = |frame: &Frame| -> Vec<_> {
        let truths = frame.truths.iter();
        truths
            .map(|truth| (truth.class, truth.outline, truth.points.map(|[_, ego]| ego)))
            .collect()
    };
    let [one, other] = [one, other].map(|scene| -> Vec<_> {
        let keys = keys(scene).into_iter();
        keys.map(|frame| (frame.seq, frame.stamp, object(frame))).collect()
    });
    one == other
}
