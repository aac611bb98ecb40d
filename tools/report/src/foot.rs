//! What stands around a table: what its runs have in common, and what a reader must know.

use realo_results::Run;

use crate::cells::{count, fraction, values};
use crate::columns::OFFLINE;
use crate::differences::{listed, of_settings};
use crate::sections::{classes, ious};
use crate::text::paragraph;
use crate::words::explained;

/// What the order `v2x-real` is, for whoever reads a number of it.
pub const V2X_REAL: &str = "as V2X-Real's evaluator orders detections; only for comparing with its published numbers";

/// Whether messages were lost that no link lost, or scored frames have no boxes.
pub fn is_disturbed(run: &Run) -> bool {
    run.result.transport.total_lost > 0 || run.result.frames.key_skipped > 0
}

/// What all runs were made with: `offline; ego cav1; log demo; protocol default; 20 scored frames`.
pub fn common(runs: &[&Run]) -> String {
    let facts: [fn(&Run) -> String; 8] = [
        |run| run.result.settings.mode.clone(),
        |run| named("ego", &run.result.settings.ego),
        |run| match run.result.settings.coop.as_str() {
            "all" => String::new(),
            coop => named("cooperation", coop),
        },
        |run| match run.result.settings.mode == OFFLINE {
            true => String::new(),
            false => named("link", &run.result.settings.link),
        },
        |run| named("compute", &run.result.settings.compute),
        |run| match run.result.logs.len() {
            0 | 1 => named("log", &run.result.logs.concat()),
            logs => format!("{logs} logs"),
        },
        |run| named("protocol", run.result.protocol.as_deref().unwrap_or_default()),
        |run| match run.result.frames.key {
            0 => String::new(),
            frames => format!("{} scored frames", count(frames)),
        },
    ];
    let same = facts.iter().filter_map(|fact| {
        let mut values = runs.iter().map(|run| fact(run));
        let first = values.next()?;
        (!first.is_empty() && values.all(|value| value == first)).then_some(first)
    });
    same.collect::<Vec<_>>().join("; ")
}

fn named(what: &str, value: &str) -> String {
    match value.is_empty() {
        true => String::new(),
        false => format!("{what} {value}"),
    }
}

/// All that stands below a table with a row for each run.
pub fn foot(runs: &[(&str, &Run)], table: &str, width: usize) -> String {
    let mut text = String::new();
    let mut say = |sentence: String| {
        if !sentence.is_empty() {
            text.push_str(&paragraph(&sentence, width));
        }
    };
    say(v2x_real(runs));
    say(of_classes(runs));
    say(explained(table));
    let is_offline = |run: &Run| run.result.settings.mode == OFFLINE;
    if runs.iter().any(|(_, run)| is_offline(run)) && table.contains("  age") {
        say("Offline nothing is late: there, age is how far the stamps of what was fused lie from the ego's.".into());
    }
    if runs.iter().any(|(_, run)| is_disturbed(run)) {
        say("!: messages between nodes were lost, or scored frames have no boxes; the notes say how many.".into());
    }
    for difference in of_settings(runs) {
        say(difference);
    }
    for note in notes(runs) {
        say(note);
    }
    say(of_one_log(runs));
    text
}

/// What stands below a table with a column for each run.
pub fn below(runs: &[(&str, &Run)], table: &str, width: usize) -> String {
    let mut sentences = vec![explained(table)];
    sentences.extend(notes(runs));
    sentences.push(of_one_log(runs));
    let said = sentences.iter().filter(|sentence| !sentence.is_empty());
    said.map(|sentence| paragraph(sentence, width)).collect()
}

fn of_classes(runs: &[(&str, &Run)]) -> String {
    let accuracies = runs.iter().filter_map(|(_, run)| run.result.accuracy.as_ref());
    let classes = classes(accuracies.map(|accuracy| &accuracy.sorted.ap));
    match classes.is_empty() {
        true => String::new(),
        false => format!(
            "{}: AP of the class (average precision, from 0 to 1, of all detections sorted by score) at the IoU in the head.",
            classes.join(", ")
        ),
    }
}

fn v2x_real(runs: &[(&str, &Run)]) -> String {
    let all: Vec<&Run> = runs.iter().map(|(_, run)| *run).collect();
    let ious = ious(&all);
    let of_run = |(name, run): &(&str, &Run)| {
        let mean = &run.result.accuracy.as_ref()?.v2x_real.mean_ap;
        let means: Vec<_> = ious.iter().map(|iou| mean.get(iou).copied().flatten()).collect();
        let known = means.iter().any(Option::is_some);
        known.then(|| format!("{name} {}", values(means.into_iter().map(fraction))))
    };
    let runs: Vec<String> = runs.iter().filter_map(of_run).collect();
    match runs.is_empty() {
        true => String::new(),
        false => format!("mAP at IoU {}, {V2X_REAL}: {}.", ious.join(" / "), runs.join("; ")),
    }
}

/// Says that scores have no interval.
fn of_one_log(runs: &[(&str, &Run)]) -> String {
    let scored = |run: &Run| run.result.accuracy.is_some() && run.result.frames.key > 0;
    let lacking = runs
        .iter()
        .filter(|(_, run)| scored(run) && run.result.intervals.is_none());
    let frames: Vec<u64> = lacking.map(|(_, run)| run.result.frames.key).collect();
    let Some(least) = frames.iter().min() else {
        return String::new();
    };
    let whose = match frames.len() == runs.len() {
        true => String::new(),
        false => format!(" ({} of {} runs)", frames.len(), runs.len()),
    };
    format!(
        "note: one log{whose}, {} scored frames: there is no 95 % interval, and a small difference may be chance; play more \
         logs (--log A.mcap --log B.mcap).",
        count(*least)
    )
}

/// The notes of runs, each once, with the names of those that have it; first whose messages were never used.
pub fn notes(runs: &[(&str, &Run)]) -> Vec<String> {
    let mut notes: Vec<(&str, Vec<&str>)> = Vec::new();
    for (name, run) in runs {
        for note in &run.result.notes {
            match notes.iter_mut().find(|(known, _)| known == note) {
                Some((_, names)) => names.push(name),
                None => notes.push((note, vec![name])),
            }
        }
    }
    let first: Vec<String> = runs
        .iter()
        .flat_map(|(_, run)| run.result.notes_of_cooperation())
        .collect();
    notes.sort_by_key(|(note, _)| !first.iter().any(|known| known == note));
    let named = |(note, names): &(&str, Vec<&str>)| match names.len() == runs.len() && runs.len() > 2 {
        true => format!("note (all {}): {note}", runs.len()),
        false => format!("note ({}): {note}", listed(names)),
    };
    notes.iter().map(named).collect()
}
