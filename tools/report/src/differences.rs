use std::collections::BTreeSet;

use realo_results::{Run, RunResult};
use realo_scoring::{Evaluation, Frame, Protocol, Scene};

/// So many names are listed; what there is beside is counted.
const NAMED: usize = 5;

/// Picks a list of names.
type Names = fn(&RunResult) -> &Vec<String>;

/// What differs between runs although a comparison of strategies wants it alike: logs, egos, agents, protocol, truth. One
/// sentence each, which names the runs; nothing where all is alike.
pub fn differences(runs: &[(&str, &Run)]) -> Vec<String> {
    let lists: [(&str, Names); 3] = [
        ("logs", |result| &result.logs),
        ("egos", |result| &result.egos),
        ("agents", |result| &result.agents),
    ];
    let mut found: Vec<String> = lists
        .iter()
        .filter_map(|(what, get)| of_names(what, runs, get))
        .collect();
    found.extend(of_protocols(runs));
    found.extend(of_truth(runs));
    found
}

/// Which names some runs have and others do not.
fn of_names(what: &str, runs: &[(&str, &Run)], get: impl Fn(&RunResult) -> &Vec<String>) -> Option<String> {
    let sets: Vec<BTreeSet<&str>> = runs
        .iter()
        .map(|(_, run)| get(&run.result).iter().map(String::as_str).collect())
        .collect();
    let (first, others) = sets.split_first()?;
    if others.iter().all(|set| set == first) {
        return None;
    }
    let common: BTreeSet<&str> = others
        .iter()
        .fold(first.clone(), |common, set| common.intersection(set).copied().collect());
    let own = sets
        .iter()
        .map(|set| listed(set.difference(&common).copied().collect()));
    let beside = match common.len() {
        0 => String::new(),
        n => format!(" beside the {n} of all"),
    };
    Some(format!("{what} differ: {}{beside}", by_value(runs, own)))
}

fn listed(names: Vec<&str>) -> String {
    match names.len() {
        0 => "none".into(),
        n if n <= NAMED => names.join(", "),
        n => format!("{} and {} more", names[..NAMED].join(", "), n - NAMED),
    }
}

/// `a in one, two; b in three`: the runs of each value, in order of appearance.
fn by_value(runs: &[(&str, &Run)], values: impl Iterator<Item = String>) -> String {
    let mut groups: Vec<(String, Vec<&str>)> = Vec::new();
    for ((name, _), value) in runs.iter().zip(values) {
        match groups.iter_mut().find(|(known, _)| *known == value) {
            Some((_, names)) => names.push(name),
            None => groups.push((value, vec![name])),
        }
    }
    let groups = groups
        .iter()
        .map(|(value, names)| format!("{value} in {}", names.join(", ")));
    groups.collect::<Vec<_>>().join("; ")
}

fn of_protocols(runs: &[(&str, &Run)]) -> Option<String> {
    let names: Vec<String> = runs
        .iter()
        .map(|(_, run)| run.result.protocol.clone().unwrap_or_else(|| "no evaluation".into()))
        .collect();
    if names.iter().any(|name| *name != names[0]) {
        return Some(format!("protocols differ: {}", by_value(runs, names.into_iter())));
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

/// The first scene that two runs of one protocol have, and of which they were told different things.
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
            let told = by_value(&[(earlier, *run), (*name, *run)], [known, scene].into_iter().map(told));
            let told = match told.split_once("; ") {
                Some(_) => told,
                None => format!("as many, but not the same objects: {told}"),
            };
            return Some(format!("truth differs, first in log `{log}`, ego {ego}: {told}"));
        }
    }
    None
}

fn told(scene: &Scene) -> String {
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
