//! What stands around a table: what its runs have in common, and what a reader must know.

use realo_results::{Run, UNUSED};

use crate::cells::{count, fraction, values};
use crate::columns::OFFLINE;
use crate::differences::{listed, of_settings};
use crate::sections::{classes, ious, said_of_clocks};
use crate::text::paragraph;
use crate::words::explained;

/// What the order `v2x-real` is, for whoever reads a number of it.
pub const V2X_REAL: &str = "as V2X-Real's evaluator orders detections; only for comparing with its published numbers";

/// Whether messages were lost that no link lost, or scored frames have no boxes.
pub fn is_disturbed(run: &Run) -> bool {
    run.result.transport.total_lost > 0 || run.result.frames.key_skipped > 0
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
    for clocks in of_clocks(runs) {
        say(clocks);
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

/// Whose clocks are off, each once with the names of the runs.
fn of_clocks(runs: &[(&str, &Run)]) -> Vec<String> {
    let mut known: Vec<(String, Vec<&str>)> = Vec::new();
    for (name, run) in runs {
        let said = said_of_clocks(run);
        match known.iter_mut().find(|(other, _)| *other == said) {
            _ if said.is_empty() => {}
            Some((_, names)) => names.push(name),
            None => known.push((said, vec![name])),
        }
    }
    let words = |(said, names): (String, Vec<&str>)| {
        let whose = match names.len() == runs.len() {
            true => String::new(),
            false => format!(" ({})", listed(&names)),
        };
        format!("clocks{whose}, to be added to stamps ± bound, ms: {said}.")
    };
    known.into_iter().map(words).collect()
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
    let Some(min) = frames.iter().min() else {
        return String::new();
    };
    let whose = match frames.len() == runs.len() {
        true => String::new(),
        false => format!(" ({} of {} runs)", frames.len(), runs.len()),
    };
    format!(
        "note: one log{whose}, {} scored frames: there is no 95 % interval, and a small difference may be chance; play more \
         logs (--log A.mcap --log B.mcap).",
        count(*min)
    )
}

/// The notes of runs, each once, with the names of those that have it; first which stages failed on messages, then the faults
/// of the log that concern an ego, then whose messages were never used.
pub fn notes(runs: &[(&str, &Run)]) -> Vec<String> {
    let mut notes: Vec<(&str, Vec<usize>)> = Vec::new();
    for (at, (_, run)) in runs.iter().enumerate() {
        for note in &run.result.notes {
            match notes.iter_mut().find(|(known, _)| known == note) {
                Some((_, having)) if having.contains(&at) => {}
                Some((_, having)) => having.push(at),
                None => notes.push((note, vec![at])),
            }
        }
    }
    let notes = with_reasons_once(notes);
    let first: Vec<[Vec<String>; 3]> = runs.iter().map(|(_, run)| run.result.first_notes()).collect();
    let place = |note: &str| {
        let is_in = |part: usize| first.iter().any(|parts| parts[part].iter().any(|known| known == note));
        (0..3).find(|part| is_in(*part)).unwrap_or(3)
    };
    let mut notes: Vec<(usize, &str, Vec<usize>)> = notes
        .into_iter()
        .map(|(note, having)| (place(note), note, having))
        .collect();
    notes.sort_by_key(|(place, ..)| *place);
    let named = |(_, note, having): &(usize, &str, Vec<usize>)| {
        let mut names: Vec<&str> = Vec::new();
        for at in having {
            if !names.contains(&runs[*at].0) {
                names.push(runs[*at].0);
            }
        }
        match having.len() == runs.len() && runs.len() > 2 {
            true => format!("note (all {}): {note}", runs.len()),
            false => format!("note ({}): {note}", listed(&names)),
        }
    };
    notes.iter().map(named).collect()
}

/// What keeps an agent's messages from the fusion of one run is the same note as the loss in a run without fusion.
fn with_reasons_once(mut notes: Vec<(&str, Vec<usize>)>) -> Vec<(&str, Vec<usize>)> {
    let unused = format!(": {UNUSED}: ");
    for at in 0..notes.len() {
        let plain = notes[at].0.replacen(&unused, ": ", 1);
        let same = notes
            .iter()
            .position(|(note, _)| *note == plain)
            .filter(|same| *same != at);
        if let Some(same) = same {
            let mut having = [std::mem::take(&mut notes[at].1), std::mem::take(&mut notes[same].1)].concat();
            having.sort_unstable();
            having.dedup();
            notes[at.min(same)] = (notes[at].0, having);
        }
    }
    notes.retain(|(_, having)| !having.is_empty());
    notes
}
