//! Rows of what crosses links, and what becomes of it.

use realo_results::{Fates, LinkBooks, Run};
use realo_schemas::report::ClockBy;

use super::{Rows, names};
use crate::cells::{NONE, count, values};
use crate::columns::STATE;

/// Kinds of messages over links, in alphabetical order but for the states of agents, which come last.
pub(super) fn kinds(runs: &[&Run]) -> Vec<String> {
    let mut kinds = names(
        runs.iter()
            .flat_map(|run| run.result.links.values())
            .flat_map(|kinds| kinds.keys()),
    );
    kinds.sort_by_key(|kind| kind == STATE);
    kinds
}

/// Whether states that cross links are of use: where senders project, or something used one.
pub(super) fn are_states_used(runs: &[&Run]) -> bool {
    runs.iter().any(|run| {
        let states = run.result.channels().filter(|(_, kind, _)| *kind == STATE);
        let mut used = states.filter_map(|(.., books)| Some(books.accounted?.fates.used));
        run.result.settings.project.contains("sender") || used.any(|used| used > 0)
    })
}

/// What all channels of a kind carried together; `None` without any.
pub(super) fn sum<'a>(channels: impl Iterator<Item = &'a LinkBooks>) -> Option<LinkBooks> {
    channels.cloned().reduce(|mut sum, books| {
        sum.add(&books);
        sum
    })
}

/// Agents on other machines.
pub(super) fn peers(rows: &mut Rows) {
    let all = rows.runs.iter().flat_map(|run| &run.result.peers);
    for name in names(all.map(|peer| &peer.name)) {
        rows.add(name.clone(), |run| {
            let peer = run.result.peers.iter().find(|peer| peer.name == name)?;
            let number =
                |value: Option<f64>, places: usize| value.map_or(NONE.into(), |value| format!("{value:.places$}"));
            let by = match (peer.clock_by, peer.clock_contradiction_ms) {
                (_, Some(differs)) => format!(" (machines say otherwise, by {differs:.2}: one is wrong)"),
                (Some(ClockBy::Machines), None) => " (synchronised)".into(),
                _ => String::new(),
            };
            let clock = format!(
                "{} ± {}{by}",
                number(peer.clock_ms, 2),
                number(peer.clock_uncertainty_ms, 2)
            );
            let rate = number(peer.bits_per_second.map(|rate| rate * 1e-6), 1);
            let refused = peer.refused.iter().map(|(why, count)| format!(", {count} {why}"));
            let refused: String = refused.collect();
            Some(format!("{clock}, {}; {rate}{refused}", number(peer.round_trip_ms, 1)))
        });
    }
}

pub(super) fn volume(rows: &mut Rows) {
    for kind in kinds(rows.runs) {
        rows.add(kind.clone(), |run| {
            let books = sum(run
                .result
                .channels()
                .filter(|(_, k, _)| *k == kind)
                .map(|(.., books)| books))?;
            let frames = run.result.frames.total;
            let per_frame = |n: f64| (frames > 0).then(|| n / frames as f64);
            let places = |value: Option<f64>| value.map_or(NONE.into(), |value| format!("{value:.2}"));
            Some(values([
                places(per_frame(books.sent as f64)),
                places(per_frame(books.bytes as f64 / 1000.0)),
            ]))
        });
    }
}

pub(super) fn accounting(rows: &mut Rows, kind: &str) {
    let books = |run: &Run| {
        let channels = run
            .result
            .channels()
            .filter(|(_, k, _)| *k == kind)
            .map(|(.., books)| books);
        sum(channels.filter(|books| books.accounted.is_some()))
    };
    let fate = |get: fn(&Fates) -> u64| move |run: &Run| books(run)?.accounted.map(|accounted| get(&accounted.fates));
    if !rows.runs.iter().any(|run| books(run).is_some()) {
        return;
    }
    // What stands below `sent` adds up to it; what was not sent stands apart, as do copies.
    rows.add_counts("not sent: out of range", |run| Some(books(run)?.out_of_range));
    rows.add_counts("copies made on the way", |run| Some(books(run)?.duplicated));
    rows.add("sent", |run| Some(count(books(run)?.sent)));
    rows.add("  used", |run| fate(|fates| fates.used)(run).map(count));
    rows.add_counts("  skipped", fate(|fates| fates.skipped));
    rows.add_counts("  over limit", fate(|fates| fates.over_limit));
    rows.add_counts("  distrusted", fate(|fates| fates.distrusted));
    rows.add_counts("  stale", fate(|fates| fates.stale));
    let superseded = match kind == STATE {
        true => "  replaced by the next state (normal)",
        false => "  superseded",
    };
    rows.add_counts(superseded, fate(|fates| fates.superseded));
    rows.add_counts("  lost", |run| Some(books(run)?.lost));
    rows.add_counts("  rejected", fate(|fates| fates.rejected));
    rows.add_counts("  in flight", fate(|fates| fates.in_flight));
    if rows
        .runs
        .iter()
        .filter_map(|run| books(run)?.accounted)
        .any(|accounted| accounted.unaccounted != 0)
    {
        rows.add("  unaccounted", |run| match books(run)?.accounted?.unaccounted {
            0 => Some(count(0)),
            differs => Some(format!("! {differs}")),
        });
    }
}
