use std::collections::{BTreeMap, BTreeSet};

use realo_results::{Run, RunResult, Samples, Settings, Timing, TimingSamples, add_name};

use crate::settings::{self, Setting};

/// Runs that cannot be pooled.
#[derive(Debug, thiserror::Error)]
pub enum PoolError {
    /// Nothing to pool.
    #[error("there is no run to pool")]
    Empty,
    /// Runs of different things.
    #[error("runs with {what} `{one}` and `{other}` cannot be pooled; put them side by side instead (`realo compare`)")]
    Differ {
        /// The setting.
        what: &'static str,
        /// Of the first run.
        one: String,
        /// Of another one.
        other: String,
    },
    /// Frames that would count twice.
    #[error("log `{log}` with ego `{ego}` is there twice; pool each run once")]
    Twice {
        /// The log.
        log: String,
        /// The ego.
        ego: String,
    },
    /// Evaluations that do not fit together.
    #[error(transparent)]
    Evaluation(#[from] realo_scoring::PoolError),
}

/// Several logs and egos as one run, whatever their order: sums are added, distributions merged, and all frames scored
/// together, as if they were of one run.
///
/// # Errors
/// [`PoolError`] if there is none, if settings or protocols differ, or if a log and ego is there twice.
pub fn pool(runs: &[Run]) -> Result<Run, PoolError> {
    let first = runs.first().ok_or(PoolError::Empty)?;
    runs.iter()
        .try_for_each(|run| same(&first.result.settings, &run.result.settings))?;
    let mut ordered: Vec<&Run> = runs.iter().collect();
    ordered.sort_by(|a, b| (&a.result.logs, &a.result.egos).cmp(&(&b.result.logs, &b.result.egos)));
    let samples = pool_samples(&ordered)?;
    let mut timing = TimingSamples::default();
    let mut result = RunResult::new(first.result.settings.clone());
    (result.runs, result.settings.seed) = (0, String::new());
    let (mut seeds, mut precomputed) = (Vec::new(), Vec::new());
    for run in &ordered {
        timing.merge(&run.timing.samples);
        add(&mut result, &run.result);
        add_name(&mut seeds, &run.result.settings.seed);
        add_name(&mut precomputed, &run.result.settings.precomputed);
    }
    result.settings.precomputed = precomputed.join("; ");
    result.settings.seed = seeds.join(", ");
    result.settings.ego = result.egos.join(", ");
    result.conclude(&samples);
    let silent = runs.iter().filter(|run| run.samples.evaluation.is_none()).count();
    if silent > 0 && silent < runs.len() {
        result.notes.push(format!(
            "{silent} of {} runs have no evaluation: they do not count in scores",
            runs.len()
        ));
    }
    let mut timing = Timing::of(timing);
    result.notes.extend(timing.late_note(&result.settings));
    let path = &first.timing.log_path;
    if runs.iter().all(|run| run.timing.log_path == *path) {
        timing.log_path.clone_from(path);
    }
    let machine = &first.timing.machine;
    if runs.iter().all(|run| run.timing.machine == *machine) {
        timing.machine.clone_from(machine);
    }
    Ok(Run {
        result,
        timing,
        samples,
    })
}

fn same(one: &Settings, other: &Settings) -> Result<(), PoolError> {
    let settings: [Setting; 13] = [
        ("graph", |s| &s.graph),
        settings::GRAPH_HASH,
        ("mode", |s| &s.mode),
        ("coop", |s| &s.coop),
        settings::LINK,
        settings::COMPUTE,
        settings::ISA,
        settings::MODEL,
        settings::PROJECT,
        settings::POSE_SOURCE,
        settings::SET,
        settings::PROGRAMS,
        settings::RATE,
    ];
    let differ = |what, get: fn(&Settings) -> &String| PoolError::Differ {
        what,
        one: get(one).clone(),
        other: get(other).clone(),
    };
    // Each ego has other collaborators; but either all of them computed, or none.
    if one.precomputed.is_empty() != other.precomputed.is_empty() {
        return Err(differ("precomputed", |s| &s.precomputed));
    }
    match settings.into_iter().find(|(_, get)| get(one) != get(other)) {
        Some((what, get)) => Err(differ(what, get)),
        None => Ok(()),
    }
}

fn pool_samples(runs: &[&Run]) -> Result<Samples, PoolError> {
    let mut samples = Samples::default();
    for (kind, ages) in runs.iter().flat_map(|run| &run.samples.ages_ns) {
        samples.ages_ns.entry(*kind).or_default().merge(ages);
    }
    if let Some(first) = runs.first() {
        samples.graph.clone_from(&first.samples.graph);
        samples.given.clone_from(&first.samples.given);
    }
    for (agent, frames) in runs.iter().flat_map(|run| &run.samples.localization) {
        samples.localization.entry(agent.clone()).or_default().extend(frames);
    }
    for (log, hash) in runs.iter().flat_map(|run| &run.samples.logs) {
        samples.logs.insert(log.clone(), hash.clone());
    }
    let evaluations: Vec<_> = runs.iter().filter_map(|run| run.samples.evaluation.clone()).collect();
    if !evaluations.is_empty() {
        let evaluation = realo_scoring::pool(evaluations)?;
        let mut known = BTreeSet::new();
        for scene in evaluation.scenes.iter().filter(|scene| !scene.name.is_empty()) {
            if !known.insert((&scene.name, &scene.ego)) {
                let (log, ego) = (scene.name.clone(), scene.ego.clone());
                return Err(PoolError::Twice { log, ego });
            }
        }
        samples.evaluation = Some(evaluation);
    }
    Ok(samples)
}

/// Adds all that is counted.
fn add(sum: &mut RunResult, run: &RunResult) {
    sum.runs += run.runs;
    run.logs.iter().for_each(|log| add_name(&mut sum.logs, log));
    run.logs_cut.iter().for_each(|log| add_name(&mut sum.logs_cut, log));
    run.egos.iter().for_each(|ego| add_name(&mut sum.egos, ego));
    run.agents.iter().for_each(|agent| add_name(&mut sum.agents, agent));
    sum.frames.add(&run.frames);
    if let Some(boxes) = &run.boxes {
        sum.boxes.get_or_insert_default().add(boxes);
    }
    sum.peers.extend(run.peers.iter().cloned());
    run.clocks.iter().for_each(|clock| sum.add_clock(clock));
    for (link, kinds) in &run.links {
        let sums: &mut BTreeMap<_, _> = sum.links.entry(link.clone()).or_default();
        for (kind, books) in kinds {
            match sums.get_mut(kind) {
                None => _ = sums.insert(kind.clone(), books.clone()),
                Some(sum) => sum.add(books),
            }
        }
    }
    if let Some(cooperation) = &run.cooperation {
        sum.cooperation.get_or_insert_default().add(cooperation);
    }
    for (edge, books) in &run.transport.edges {
        sum.transport.add(edge, books);
    }
    for (id, node) in &run.nodes {
        sum.nodes.entry(id.clone()).or_default().add(node);
    }
}
