//! What estimated poses cost: the same runs with the poses of the log, to compare with.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail};
use realo_cli::signals;
use realo_logs::{Log, Stream};
use realo_results::{Run, read_run};

use super::batch::Batch;
use super::folders::Folders;
use super::prepare::RunPlan;
use super::{Args, Choices, Mode, Planned, PoseSource, beside, choices, dir_of, pool, prepare, resume};

/// What follows the name of a graph's folder where the same was run with the poses of the log.
const RECORDED: &str = "_recorded";
/// A file that marks such a folder, which may be replaced.
const MARK: &str = ".recorded-poses";

/// For each graph that fused by estimated poses: the same with those of the log, and where its results lie. One that lies beside is taken as
/// it is; else it is run. What keeps one from it is said, and costs nothing else.
pub fn references(args: &Args, mode: Mode, planned: &[Planned], runs: &[(&str, Run)]) -> Vec<(String, Run)> {
    if args.no_cost || !args.choices.localization.is_some_and(PoseSource::is_estimated) {
        return Vec::new();
    }
    let mut found = Vec::new();
    for (name, run) in runs {
        let is_whole = run.result.complete && run.result.ended_by.is_none() && signals::first().is_none();
        let fuses = run.result.cooperation.is_some() && is_scored(run);
        let Some(planned) = planned.iter().find(|planned| planned.name == *name) else {
            continue;
        };
        if !is_whole || !fuses {
            continue;
        }
        match reference(args, mode, planned) {
            Ok(reference) => found.extend(reference),
            Err(reason) => eprintln!("realo: {name}: what localization costs is not known: {reason:#}"),
        }
    }
    found
}

fn reference(args: &Args, mode: Mode, planned: &Planned) -> Result<Option<(String, Run)>> {
    if let Some(agent) = without_poses(args, planned.batch.plans())? {
        eprintln!(
            "realo: {}: what localization costs is not known: the log has no poses of `{agent}` to compare with",
            planned.name
        );
        return Ok(None);
    }
    let folder = dir_of(args, planned.name);
    let out = beside_as(&folder, RECORDED)?;
    let own = Args {
        graphs: vec![planned.graph.clone()],
        out: Some(out.clone()),
        resume: false,
        ..args.clone()
    };
    let mut batch = with_recorded_poses(&own, mode, planned)?;
    let beside = beside::folders(&folder);
    if let Some(known) = beside.iter().find_map(|known| known_run(known, &own, &batch)) {
        return Ok(Some(known));
    }
    if !is_free(&out) {
        bail!(
            "{} holds something else, which the run with the poses of the log would replace: move it, choose another --out, or add --no-cost",
            out.display()
        );
    }
    eprintln!(
        "realo: {}: once more with the poses of the log, for what localization costs (--no-cost leaves it out)",
        planned.name
    );
    let mut folders = Folders::default();
    folders.lock(&out)?;
    if own.leaves_profile(mode) {
        folders.claim_profile(&out)?;
    }
    batch.claim(&mut folders, false)?;
    let done = batch.run(mode, own.rate.unwrap_or(1.0), None)?;
    let run = pool(&own, mode, planned.name, batch.notes(), batch.ended_by(), &done)?;
    folders.keep_new();
    std::fs::write(out.join(MARK), "").wrap_err_with(|| out.display().to_string())?;
    Ok(Some((out.display().to_string(), run)))
}

/// Whether anything was scored.
fn is_scored(run: &Run) -> bool {
    let accuracies = run.result.accuracy.iter();
    let mut aps = accuracies.flat_map(|accuracy| accuracy.sorted.ap.values().flat_map(|by_iou| by_iou.values()));
    aps.any(Option::is_some)
}

/// Whether a folder is not there, is empty, or was made here.
fn is_free(folder: &Path) -> bool {
    match std::fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_none() || folder.join(MARK).is_file(),
        Err(_) => folder.symlink_metadata().is_err(),
    }
}

/// The first agent that takes part and has no poses in its log.
fn without_poses(args: &Args, plans: &[RunPlan]) -> Result<Option<String>> {
    for plan in plans {
        let path = plan.log_path();
        let log = Log::open(&path).wrap_err_with(|| path.display().to_string())?;
        let takes_part = |name: &String| args.agents.is_empty() || args.agents.contains(name) || name == plan.ego();
        let is_bare = |name: &str| {
            let has_poses = log.has(name, Stream::Pose) || (args.offline && log.has(name, Stream::PoseTruth));
            log.has(name, Stream::Points) && !has_poses
        };
        let mut names = log.info().agents.iter().map(|agent| &agent.name);
        if let Some(name) = names.find(|name| takes_part(name) && is_bare(name)) {
            return Ok(Some(name.to_string()));
        }
    }
    Ok(None)
}

/// The runs of a graph with the poses of the log: as the graph has it, if that is so.
fn with_recorded_poses(own: &Args, mode: Mode, planned: &Planned) -> Result<Batch> {
    let prepared = |localization: Option<PoseSource>| {
        let mut fitted = choices::fit(&own.choices, &own.graphs);
        let choices = Choices {
            localization,
            map: None,
            ..fitted.remove(0).choices
        };
        let own = Args { choices, ..own.clone() };
        prepare::batch(&own, mode, &planned.graph, planned.name)
    };
    let as_it_is = prepared(None)?;
    match as_it_is.plans().iter().any(RunPlan::estimates_poses) {
        true => prepared(Some(PoseSource::Recorded)),
        false => Ok(as_it_is),
    }
}

/// What a folder has, if it is of just these runs, complete.
fn known_run(folder: &Path, own: &Args, batch: &Batch) -> Option<(String, Run)> {
    let out = own.out.as_deref().and_then(|out| std::path::absolute(out).ok());
    let is_there = |plan: &RunPlan| {
        let within = out.as_deref().and_then(|out| plan.out.strip_prefix(out).ok());
        within.is_some_and(|within| resume::is_in(&folder.join(within), plan.fingerprint()))
    };
    if !batch.plans().iter().all(is_there) {
        return None;
    }
    let run = read_run(folder).ok()?;
    let logs: BTreeSet<String> = batch.plans().iter().map(|plan| plan.log().0).collect();
    (run.result.logs.iter().cloned().collect::<BTreeSet<String>>() == logs).then(|| (folder.display().to_string(), run))
}

/// A folder beside another one, whose name goes on.
fn beside_as(folder: &Path, ending: &str) -> Result<PathBuf> {
    // `.` and `..` have no name of their own.
    let folder = match folder.file_name() {
        Some(_) => folder.to_path_buf(),
        None => folder.canonicalize().wrap_err_with(|| folder.display().to_string())?,
    };
    let mut name = folder.file_name().unwrap_or("results".as_ref()).to_os_string();
    name.push(ending);
    Ok(folder.with_file_name(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_lies_beside() {
        let named = |folder: &str| beside_as(Path::new(folder), RECORDED).unwrap().display().to_string();
        assert_eq!(named("out/late"), "out/late_recorded");
        assert_eq!(named("out/late.v2/"), "out/late.v2_recorded");
        assert_eq!(named("late"), "late_recorded");
        let root = tempfile::tempdir().unwrap();
        let inner = root.path().canonicalize().unwrap().join("a/b");
        std::fs::create_dir_all(&inner).unwrap();
        let upper = inner.join("..");
        assert_eq!(
            named(upper.to_str().unwrap()),
            root.path()
                .canonicalize()
                .unwrap()
                .join("a_recorded")
                .display()
                .to_string()
        );
    }

    #[test]
    fn only_what_was_made_for_this_is_replaced() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("x_recorded");
        assert!(is_free(&folder));
        std::fs::create_dir(&folder).unwrap();
        assert!(is_free(&folder));
        std::fs::write(folder.join("result.json"), "{}").unwrap();
        assert!(!is_free(&folder));
        std::fs::write(folder.join(MARK), "").unwrap();
        assert!(is_free(&folder));
        assert!(!is_free(&folder.join("result.json")), "a file");
    }
}
