//! From values to runs: which there are, which of them have something in common, and how they are made.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use eyre::{Result, WrapErr, bail};
use realo_cli::campaign::{self, Campaign, Ended, Item, Plan, Task};
use realo_host::{Outline, Shared};
use realo_logs::{Log, Stream};

use super::points::Point;
use super::vary::{self, Vary};
use super::{Args, worlds};
use crate::run::{self, Networks, Prepared, RunPlan};

const MIB: u64 = 1 << 20;
/// Where results of runs are, as [`realo_cli::campaign`] has them, and the logs of worlds.
const RUNS: &str = "runs";
const LOGS: &str = "logs";

/// All that is to be run.
pub struct Planned {
    pub plan: Plan,
    /// Graph by graph, combination by combination.
    pub points: Vec<Point>,
    /// The runs by their keys.
    pub runs: BTreeMap<String, RunPlan>,
    /// Logs that cannot be played, and why.
    pub not_played: Vec<String>,
}

/// A run of a point, before it has a place in the plan.
struct Found {
    run: RunPlan,
    /// By what runs are ordered: those that have much in common are neighbours.
    order: (PathBuf, String, usize),
    key: String,
    parts: BTreeMap<String, String>,
}

/// Plans the runs of all graphs over all combinations. Runs that are the same in all that decides them are one.
///
/// # Errors
/// A setting, value, graph or log with which no run can be made.
pub fn plan(args: &Args, graphs: Vec<PathBuf>, names: Vec<String>) -> Result<Planned> {
    let out = std::path::absolute(&args.out)?;
    let profile = profile(args, &graphs)?;
    let combinations = vary::combinations(&args.vary);
    let mut networks = Networks::default();
    let (mut found, mut known) = (Vec::<Found>::new(), BTreeMap::<String, usize>::new());
    let (mut points, mut not_played, mut notes) = (Vec::new(), BTreeSet::new(), BTreeSet::new());
    for values in &combinations {
        let mut own = args.run(graphs.clone());
        vary::apply(&args.vary, values, &profile, &mut own)?;
        own.driver()?;
        let world = vary::world(&args.vary, values);
        if !world.is_empty() {
            own.log = worlds::logs(&out.join(LOGS), &world)?;
        }
        let words = vary::in_words(&args.vary, values);
        let folder = |name: &str| Path::new(name).join(words.replace('/', "_"));
        let prepared = run::prepared(&own, &names, &mut networks, |name| out.join(RUNS).join(folder(name)));
        let prepared = prepared.wrap_err_with(|| format!("--vary {words}"))?;
        for (graph, (name, Prepared { plans, failed, skipped })) in names.iter().zip(prepared).enumerate() {
            not_played.extend(failed);
            notes.extend(skipped.map(|_| name.clone()));
            let mut runs = Vec::new();
            for run in plans {
                let parts = run.parts()?;
                let (log, hash) = run.log();
                let identity = format!("{hash} {log} {parts:?}");
                let next = found.len();
                let at = *known.entry(identity).or_insert(next);
                if at == next {
                    let ego = run.ego().to_string();
                    let key = format!("{}/{log}/{ego}", folder(name).display());
                    // The ego alone comes last: all that it computes, graphs with more stages compute as well.
                    let order = (run.log_path(), ego, graph);
                    found.push(Found { run, order, key, parts });
                }
                runs.push(at);
            }
            points.push(Point::new(graph, values.clone(), runs));
        }
    }
    for name in &notes {
        eprintln!("realo: {name} has no place for some of these settings: it is the same for all their values");
    }
    place(args, &names, found, points, not_played.into_iter().collect())
}

/// Refuses a log without ground truth of any of its egos: nothing of it could be scored.
///
/// # Errors
/// The log and the egos.
pub fn refuse_without_truth(runs: &BTreeMap<String, RunPlan>) -> Result<()> {
    let mut egos: BTreeMap<PathBuf, BTreeSet<&str>> = BTreeMap::new();
    for run in runs.values() {
        egos.entry(run.log_path()).or_default().insert(run.ego());
    }
    for (path, egos) in &egos {
        let log = Log::open(path)?;
        if !egos.iter().any(|ego| log.has(ego, Stream::GroundTruth)) {
            let egos: Vec<&str> = egos.iter().copied().collect();
            bail!(
                "{}: expected ground truth of an ego, found none of `{}`: a sweep compares scores, and nothing of this log can be scored; \
                 simulate or import a log with labels (docs/guide/your-data.md), or take the values one by one by `realo run`",
                path.display(),
                egos.join("`, `")
            );
        }
    }
    Ok(())
}

/// Orders the runs, and makes the plan.
fn place(
    args: &Args,
    names: &[String],
    found: Vec<Found>,
    mut points: Vec<Point>,
    not_played: Vec<String>,
) -> Result<Planned> {
    let mut order: Vec<usize> = (0..found.len()).collect();
    order.sort_by_key(|at| (&found[*at].order, *at));
    let mut places = vec![0; found.len()];
    order.iter().enumerate().for_each(|(place, at)| places[*at] = place);
    for point in &mut points {
        point.place(&places);
    }
    let mut all: Vec<Option<Found>> = found.into_iter().map(Some).collect();
    let (mut items, mut runs) = (Vec::new(), BTreeMap::new());
    for at in order {
        let Some(Found { run, key, parts, .. }) = all[at].take() else {
            continue;
        };
        items.push(Item {
            key: key.clone(),
            parts,
        });
        runs.insert(key, run);
    }
    points.sort_by_key(|point| (point.graph + 1 < names.len(), point.graph));
    let points = points.into_iter().map(|point| point.named(names)).collect();
    Ok(Planned {
        plan: Plan::new("realo sweep", asked(args, names), items)?,
        points,
        runs,
        not_played,
    })
}

/// The links' profile that settings of it change: the option's, else the one that all graphs have.
fn profile(args: &Args, graphs: &[PathBuf]) -> Result<String> {
    if !args.vary.iter().any(Vary::is_of_profile) {
        return Ok(String::new());
    }
    let profiles = run::link_of(graphs)?;
    let names: Vec<&str> = profiles.iter().map(String::as_str).collect();
    match names.as_slice() {
        [] => bail!("--vary link.…: none of these graphs has a link"),
        // Settings by themselves change the link that delays and loses nothing.
        [run::PERFECT] => Ok(String::new()),
        [one] => Ok((*one).into()),
        _ if args.choices.link.is_some() => Ok(String::new()),
        several => bail!(
            "--vary link.…: the links of these graphs have several profiles ({}): say by --link which one is changed",
            several.join("; ")
        ),
    }
}

/// What was asked for, by the names of the options: another sweep differs in one of them.
fn asked(args: &Args, names: &[String]) -> BTreeMap<String, String> {
    let Args { choices, .. } = args;
    let file = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let option = |value: &Option<String>| value.clone().unwrap_or_default();
    let flag = |value: bool| if value { "true".to_string() } else { String::new() };
    let logs: Vec<String> = args.log.iter().map(file).collect();
    let options = [
        ("graphs", names.join(" ")),
        ("--log", logs.join(" ")),
        ("--offline", flag(args.offline)),
        (
            "--coop",
            args.coop.map(|coop| coop.as_str().to_string()).unwrap_or_default(),
        ),
        ("--ego", option(&args.ego)),
        ("--agents", args.agents.join(",")),
        ("--compute", args.compute.as_ref().map(file).unwrap_or_default()),
        ("--protocol", option(&args.protocol)),
        ("--link", option(&choices.link)),
        ("--recorded-detections", flag(choices.recorded_detections)),
        ("--model", choices.model.as_ref().map(file).unwrap_or_default()),
        ("--stamps", option(&choices.stamps)),
        ("--isa", option(&choices.isa)),
        ("--precision", option(&choices.precision)),
        ("--device", option(&choices.device)),
        (
            "--project",
            choices
                .project
                .map(|project| project.as_str().to_string())
                .unwrap_or_default(),
        ),
        ("--seed", choices.seed.map(|seed| seed.to_string()).unwrap_or_default()),
        ("--set", choices.set.join(" ")),
        ("--replace", choices.replace.join(" ")),
    ];
    let mut values = campaign::values(options);
    for Vary { name, values: varied } in &args.vary {
        values.insert(format!("--vary {name}"), varied.join(","));
    }
    values
}

/// Makes the runs that are not done; those of one log and ego share what they have in common.
///
/// # Errors
/// A graph that virtual time cannot run.
pub fn run(args: &Args, campaign: &Campaign, plan: &Plan, runs: &BTreeMap<String, RunPlan>) -> Result<Ended> {
    let left: Vec<&RunPlan> = campaign
        .left()
        .iter()
        .map(|item| &runs[&plan.items[*item].key])
        .collect();
    let mut groups: BTreeMap<(PathBuf, &str), Vec<usize>> = BTreeMap::new();
    for (place, run) in left.iter().enumerate() {
        groups.entry((run.log_path(), run.ego())).or_default().push(place);
    }
    let at_once = groups.len().min(campaign.jobs()).max(1) as u64;
    let left_tasks = campaign.tasks();
    let (mut tasks, mut all) = (Vec::new(), Vec::new());
    let mut shares: BTreeMap<&str, (Arc<Shared>, Outline)> = BTreeMap::new();
    for places in groups.into_values() {
        if args.share_mib == 0 {
            tasks.extend(places.iter().map(|place| left_tasks[*place].clone()));
            continue;
        }
        let shared = Arc::new(Shared::new(args.share_mib * MIB / at_once));
        let outline = |place: usize| Ok((place, run::outline(left[place], &shared)?));
        let mut outlined: Vec<(usize, Outline)> = places.into_iter().map(outline).collect::<Result<_>>()?;
        outlined.sort_by(|(_, a), (_, b)| a.order().cmp(b.order()));
        let outlines: Vec<Outline> = outlined.iter().map(|(_, outline)| outline.clone()).collect();
        let first = tasks.len();
        for ((place, outline), before) in outlined.into_iter().zip(shared.plan(&outlines)) {
            let item = left_tasks[place].item;
            let after = before.into_iter().map(|at| first + at).collect();
            tasks.push(Task { item, after });
            shares.insert(&plan.items[item].key, (shared.clone(), outline));
        }
        all.push(shared);
    }
    let ended = campaign.run("sweeping", &tasks, |item, _| {
        let share = shares.get(&*item.key);
        run::one(&runs[&item.key], share.map(|(shared, outline)| (&**shared, outline)))
    });
    report(&all);
    Ok(ended)
}

/// Says how much was shared.
fn report(all: &[Arc<Shared>]) {
    let (mut repeated, mut computed, mut held, mut too_large) = (0, 0, 0, BTreeSet::new());
    for sharing in all.iter().map(|shared| shared.sharing()) {
        repeated += sharing.repeated;
        computed += sharing.computed;
        held = held.max(sharing.held_most);
        too_large.extend(sharing.too_large);
    }
    if repeated > 0 {
        eprintln!(
            "realo: of {} stages in these runs {repeated} took their calls from an earlier run; that held {:.0} MiB at most",
            repeated + computed,
            held as f64 / MIB as f64
        );
    }
    if !too_large.is_empty() {
        let stages: Vec<String> = too_large.into_iter().collect();
        eprintln!(
            "realo: computed more than once, because not all of it fits into the memory: {}; --share-mib gives more",
            stages.join(", ")
        );
    }
}
