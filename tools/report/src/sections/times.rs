//! Rows of latency and ages.

use std::collections::BTreeSet;

use realo_results::{END_TO_END, FRAMEWORK, Run, Spread};

use super::{Rows, is_offline, names};
use crate::cells::spread;

/// Offline nothing takes time: what stamps say of it is no latency.
pub(super) fn latency(rows: &mut Rows, full: bool) {
    let of = |run: &Run, stage: &str| -> Option<Spread> {
        (!is_offline(run)).then(|| run.timing.latency_ms.get(stage).copied())?
    };
    rows.add("end to end", |run| {
        spread(of(run, END_TO_END).filter(|spread| spread.max > Some(0.0)).as_ref())
    });
    rows.add("without modelled link delay", |run| {
        spread(
            of(run, FRAMEWORK)
                .filter(|framework| Some(*framework) != of(run, END_TO_END))
                .as_ref(),
        )
    });
    if !full {
        return;
    }
    let stages = names(rows.runs.iter().flat_map(|run| run.timing.latency_ms.keys()));
    for stage in stages
        .iter()
        .filter(|stage| ![END_TO_END, FRAMEWORK].contains(&stage.as_str()))
    {
        rows.add(stage.clone(), |run| {
            spread(of(run, stage).filter(|spread| spread.max > Some(0.0)).as_ref())
        });
    }
    let sources = names(rows.runs.iter().flat_map(|run| run.timing.late_ms.keys()));
    for source in sources {
        rows.add(format!("{source}, late by"), |run| {
            spread(run.timing.late_ms.get(&source).filter(|_| !is_offline(run)))
        });
    }
}

pub(super) fn steps(rows: &mut Rows) {
    let stages = rows.runs.iter().flat_map(|run| &run.timing.steps_ms);
    let all: BTreeSet<(String, String)> = stages
        .flat_map(|(stage, steps)| steps.keys().map(|step| (stage.clone(), step.clone())))
        .collect();
    for (stage, step) in all {
        rows.add(format!("{stage}, {step}"), |run| {
            spread(run.timing.steps_ms.get(&stage)?.get(&step))
        });
    }
}

pub(super) fn ages(rows: &mut Rows) {
    let kinds = names(rows.runs.iter().flat_map(|run| run.result.age_ms.by_kind.keys()));
    for kind in kinds {
        rows.add(kind.clone(), |run| {
            spread(run.result.age_ms.by_kind.get(&kind).filter(|_| !is_offline(run)))
        });
    }
}
