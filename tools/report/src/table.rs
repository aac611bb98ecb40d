use realo_results::Run;

use crate::cells::NONE;
use crate::differences;
use crate::sections::{Section, sections};

/// Columns of the terminal.
const WIDTH: usize = 100;
/// Between columns.
const GAP: usize = 3;

/// Runs side by side, each under its name. More runs than fit in 100 columns follow in further tables. What else than
/// the strategy differs between them stands above.
pub fn table(runs: &[(&str, &Run)]) -> String {
    let sections = sections(&runs.iter().map(|(_, run)| *run).collect::<Vec<_>>());
    let names: Vec<&str> = runs.iter().map(|(name, _)| *name).collect();
    let widths: Vec<usize> = (0..names.len()).map(|run| width(&sections, names[run], run)).collect();
    let labels = sections
        .iter()
        .flat_map(|section| &section.rows)
        .map(|row| width_of(&row.label) + 2);
    let labels = labels.max().unwrap_or(0);
    let mut text = String::new();
    for difference in differences(runs) {
        text.push_str(&wrapped(&format!("note: {difference}")));
    }
    let mut from = 0;
    while from < names.len() {
        let to = columns_that_fit(&widths, from, labels);
        if from > 0 {
            text.push('\n');
        }
        write_block(&mut text, &sections, &names, &widths, from..to, labels);
        from = to;
    }
    write_notes(&mut text, runs);
    text
}

fn width_of(text: &str) -> usize {
    text.chars().count()
}

fn width(sections: &[Section], name: &str, run: usize) -> usize {
    let cells = sections.iter().flat_map(|section| &section.rows);
    let cells = cells.map(|row| row.cells[run].as_deref().map_or(1, width_of));
    cells.max().unwrap_or(0).max(width_of(name))
}

fn columns_that_fit(widths: &[usize], from: usize, labels: usize) -> usize {
    let mut used = labels;
    let fitting = widths[from..].iter().take_while(|width| {
        used += GAP + **width;
        used <= WIDTH
    });
    from + fitting.count().max(1)
}

fn write_block(
    text: &mut String,
    sections: &[Section],
    names: &[&str],
    widths: &[usize],
    runs: std::ops::Range<usize>,
    labels: usize,
) {
    write_line(text, "", labels, runs.clone().map(|run| (names[run], widths[run])));
    let line: usize = labels + runs.clone().map(|run| GAP + widths[run]).sum::<usize>();
    text.push_str(&"─".repeat(line));
    text.push('\n');
    for section in sections {
        // A row that says nothing of these runs is left out.
        let rows = || {
            section
                .rows
                .iter()
                .filter(|row| row.cells[runs.clone()].iter().any(Option::is_some))
        };
        if rows().next().is_none() {
            continue;
        }
        text.push_str(&section.title);
        text.push('\n');
        for row in rows() {
            let cells = runs
                .clone()
                .map(|run| (row.cells[run].as_deref().unwrap_or(NONE), widths[run]));
            write_line(text, &format!("  {}", row.label), labels, cells);
        }
    }
}

fn write_line<'a>(text: &mut String, label: &str, labels: usize, cells: impl Iterator<Item = (&'a str, usize)>) {
    let mut line = format!("{label:<labels$}");
    for (cell, width) in cells {
        line.push_str(&format!("{:GAP$}{cell:>width$}", ""));
    }
    text.push_str(line.trim_end());
    text.push('\n');
}

fn write_notes(text: &mut String, runs: &[(&str, &Run)]) {
    for (name, run) in runs {
        for note in &run.result.notes {
            let note = format!("note ({name}): {note}");
            text.push_str(&wrapped(&note));
        }
    }
}

/// Lines of at most the terminal's width, the later ones indented.
fn wrapped(note: &str) -> String {
    let (mut text, mut used) = (String::new(), 0);
    for word in note.split_whitespace() {
        if used > 0 && used + 1 + width_of(word) > WIDTH {
            text.push_str("\n  ");
            used = 2;
        } else if used > 0 {
            text.push(' ');
            used += 1;
        }
        text.push_str(word);
        used += width_of(word);
    }
    text.push('\n');
    text
}
