//! The same frame of several runs.

use std::path::{Path, PathBuf};

use crate::run::{choose_with, egos};
use crate::{Chosen, RenderError, Request, Watch};

/// Finds the frame that is asked for in several runs: the same sweep of the same ego and log in all. Without a number it is
/// the one of the run where cooperation added most; without an ego the first by name that all runs have.
///
/// # Errors
/// As [`crate::choose`]; runs that have no ego in common.
pub fn choose_all(runs: &[PathBuf], request: &Request, watch: &Watch) -> Result<Vec<Chosen>, RenderError> {
    let egos = match &request.ego {
        Some(ego) => vec![ego.clone()],
        None => common_egos(runs)?,
    };
    let mut missing = None;
    for ego in egos {
        let of_ego = Request {
            ego: Some(ego),
            ..request.clone()
        };
        match same_frame(runs, &of_ego, watch) {
            // Another ego may have one.
            Err(error @ RenderError::NoFrame { .. }) => missing = missing.or(Some(error)),
            found => return found,
        }
    }
    Err(missing.unwrap_or_else(|| RenderError::NoFrame {
        run: runs.first().cloned().unwrap_or_default(),
        asked: "ego".into(),
        there: "no run".into(),
    }))
}

/// The egos that all runs have, by name.
fn common_egos(runs: &[PathBuf]) -> Result<Vec<String>, RenderError> {
    let all: Vec<Vec<String>> = runs.iter().map(|run| egos(run)).collect::<Result<_, _>>()?;
    let is_common = |ego: &&String| all.iter().all(|egos| egos.contains(ego));
    let common: Vec<String> = all.iter().flatten().filter(is_common).cloned().collect();
    let mut common: Vec<String> = common;
    common.sort();
    common.dedup();
    if common.is_empty() {
        let has = |(run, egos): (&PathBuf, &Vec<String>)| format!("{} has {}", run.display(), egos.join(", "));
        let there: Vec<String> = runs.iter().zip(&all).map(has).collect();
        return Err(RenderError::NoCommonEgo {
            there: there.join("; "),
        });
    }
    Ok(common)
}

fn same_frame(runs: &[PathBuf], request: &Request, watch: &Watch) -> Result<Vec<Chosen>, RenderError> {
    let of_run = |run: &Path, request: &Request| {
        let request = Request {
            run: run.into(),
            ..request.clone()
        };
        choose_with(&request, watch)
    };
    let mut chosen: Vec<Chosen> = runs.iter().map(|run| of_run(run, request)).collect::<Result<_, _>>()?;
    let gain = |chosen: &Chosen| (chosen.judged.added(), chosen.judged.hits());
    // Of equals the first.
    let Some(most) = (0..chosen.len()).rev().max_by_key(|at| gain(&chosen[*at])) else {
        return Ok(chosen);
    };
    let (seq, log) = (chosen[most].seq, chosen[most].log.path().to_path_buf());
    let same = Request {
        frame: Some(seq),
        log: Some(log.clone()),
        ..request.clone()
    };
    for (run, chosen) in runs.iter().zip(&mut chosen) {
        if chosen.seq != seq || chosen.log.path() != log {
            *chosen = of_run(run, &same)?;
        }
    }
    Ok(chosen)
}
