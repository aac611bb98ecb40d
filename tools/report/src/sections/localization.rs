//! Rows of how well agents knew where they were.

use std::collections::BTreeSet;

use realo_results::Run;
use realo_schemas::PoseStatus;
use realo_scoring::{ErrorSpread, LocalizationScores};

use super::Rows;
use crate::cells::{NONE, values};

fn of<'a>(run: &'a Run, agent: &str) -> Option<&'a LocalizationScores> {
    run.result.localization.as_ref()?.get(agent)
}

fn agents(rows: &Rows) -> Vec<String> {
    let all = rows.runs.iter().filter_map(|run| run.result.localization.as_ref());
    let names: BTreeSet<&String> = all.flat_map(|agents| agents.keys()).collect();
    names.into_iter().cloned().collect()
}

/// A share in percent, to a place.
fn percent(share: f64) -> String {
    format!("{:.1}", 100.0 * share)
}

fn spread(found: Option<ErrorSpread>) -> Option<String> {
    let ErrorSpread { mean, p95, max } = found?;
    Some(values([mean, p95, max].map(|error| format!("{error:.3}"))))
}

pub(super) fn positions(rows: &mut Rows) {
    for agent in agents(rows) {
        rows.add(agent.clone(), |run| spread(of(run, &agent)?.position_m));
    }
}

pub(super) fn heights(rows: &mut Rows) {
    for agent in agents(rows) {
        rows.add(agent.clone(), |run| spread(of(run, &agent)?.height_m));
    }
}

pub(super) fn headings(rows: &mut Rows) {
    for agent in agents(rows) {
        rows.add(agent.clone(), |run| spread(of(run, &agent)?.heading_deg));
    }
}

/// Shares of sweeps by status, and of NEES inside its band.
pub(super) fn statuses(rows: &mut Rows) {
    for agent in agents(rows) {
        rows.add(agent.clone(), |run| {
            let found = of(run, &agent)?;
            let of_status = |status: PoseStatus| {
                let count = found.by_status.get(&status).copied().unwrap_or(0);
                percent(count as f64 / found.frames.max(1) as f64)
            };
            let shares = [
                PoseStatus::Tracking,
                PoseStatus::DeadReckoning,
                PoseStatus::Init,
                PoseStatus::Lost,
            ];
            let inside = found.nees_inside.map_or(NONE.into(), percent);
            Some(values(shares.map(of_status).into_iter().chain([inside])))
        });
    }
}
