//! Rows of identities and velocities.

use realo_results::Run;
use realo_scoring::TrackScores;

use super::{Rows, classes_of};
use crate::cells::{NONE, count, fraction, values};

fn of<'a>(run: &'a Run, class: &str) -> Option<&'a TrackScores> {
    run.result.tracking.as_ref()?.get(class)
}

/// The classes of which some run knows identities.
fn known(rows: &Rows) -> Vec<String> {
    classes_of(
        rows.runs
            .iter()
            .filter_map(|run| run.result.tracking.as_ref())
            .flat_map(|all| all.keys()),
    )
}

pub(super) fn identities(rows: &mut Rows) {
    for class in known(rows) {
        rows.add(class.clone(), |run| {
            let found = of(run, &class)?;
            Some(values(
                [found.hota, found.detection, found.association].map(|part| fraction(Some(part))),
            ))
        });
    }
}

pub(super) fn changes(rows: &mut Rows) {
    for class in known(rows) {
        rows.add(class.clone(), |run| {
            let found = of(run, &class)?;
            Some(values([found.identity_changes?, found.identity_swaps?].map(count)))
        });
    }
}

pub(super) fn velocities(rows: &mut Rows) {
    for class in known(rows) {
        rows.add(class.clone(), |run| {
            let found = of(run, &class).filter(|found| found.velocities > 0)?;
            let metres = |error: Option<f64>| error.map_or(NONE.into(), |error| format!("{error:.2}"));
            Some(values([found.velocity_error, found.velocity_error_moving].map(metres)))
        });
    }
}
