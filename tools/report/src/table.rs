//! Runs as text side by side: a column for each.

use std::ops::Range;

use realo_results::Run;

use crate::cells::NONE;
use crate::sections::{Section, sections};
use crate::text::{Align, lines, paragraph, width_of, write_row};
use crate::{Options, foot};

/// So many runs stand side by side; more have a row each.
pub const SIDE_BY_SIDE: usize = 2;
/// Between columns.
const GAP: usize = 3;
/// Settings and names are broken into lines of at most so many columns.
const WORDS: usize = 24;
/// A label takes at most this share of the width.
const LABELS: usize = 2;

/// Runs side by side, each under its name, in as many tables as it takes to fit the terminal's width. What else than the
/// strategy makes them hard to compare stands above.
pub fn table(runs: &[(&str, &Run)], options: &Options) -> String {
    let width = options.width;
    let sections = sections(&runs.iter().map(|(_, run)| *run).collect::<Vec<_>>(), options.full);
    let names: Vec<&str> = runs.iter().map(|(name, _)| *name).collect();
    let labels = sections.iter().flat_map(|section| &section.rows);
    let labels = labels.map(|row| width_of(&row.label) + 2).max().unwrap_or(0);
    let labels = labels.min(width / LABELS);
    let most = width.saturating_sub(labels + GAP).max(1);
    // Words are broken into more lines before columns part.
    let beside = names.len().clamp(1, SIDE_BY_SIDE);
    let for_words = (width.saturating_sub(labels) / beside).saturating_sub(GAP).min(WORDS);
    let widths: Vec<usize> = (0..names.len())
        .map(|run| column_width(&sections, names[run], run, for_words).min(most))
        .collect();
    let mut text = String::new();
    for difference in crate::differences::of_data(runs) {
        text.push_str(&paragraph(&format!("note: {difference}"), width));
    }
    let above = text.len();
    let mut from = 0;
    while from < names.len() {
        let block = Block {
            names: &names,
            labels,
            runs: from..columns_that_fit(&widths, from, labels, width),
            widths: &widths,
            width,
        };
        if from > 0 {
            text.push('\n');
        }
        block.write(&mut text, &sections);
        from = block.runs.end;
    }
    let below = foot::below(runs, &text[above..], width);
    text + &below
}

/// What the widest cell takes; settings and names are broken into lines of at most `words` columns, numbers are not.
fn column_width(sections: &[Section], name: &str, run: usize, words: usize) -> usize {
    let cells = |section: &Section| {
        let cells = section
            .rows
            .iter()
            .map(|row| row.cells[run].as_deref().map_or(1, width_of));
        cells.max().unwrap_or(0)
    };
    let (settings, numbers) = sections.split_first().map_or((0, 0), |(settings, numbers)| {
        (cells(settings), numbers.iter().map(cells).max().unwrap_or(0))
    });
    numbers.max(settings.min(words)).max(width_of(name).min(words))
}

fn columns_that_fit(widths: &[usize], from: usize, labels: usize, most: usize) -> usize {
    let mut used = labels;
    let fitting = widths[from..].iter().take_while(|width| {
        used += GAP + **width;
        used <= most
    });
    from + fitting.count().max(1)
}

/// Runs that stand side by side.
struct Block<'a> {
    names: &'a [&'a str],
    labels: usize,
    runs: Range<usize>,
    widths: &'a [usize],
    width: usize,
}

impl Block<'_> {
    fn write(&self, text: &mut String, sections: &[Section]) {
        self.row(text, "", |run| self.names[run]);
        let line: usize = self.labels + self.runs.clone().map(|run| GAP + self.widths[run]).sum::<usize>();
        text.push_str(&"─".repeat(line));
        text.push('\n');
        for section in sections {
            // A row that says nothing of these runs is left out.
            let has_cells = |cells: &[Option<String>]| cells[self.runs.clone()].iter().any(Option::is_some);
            let rows: Vec<_> = section.rows.iter().filter(|row| has_cells(&row.cells)).collect();
            if rows.is_empty() {
                continue;
            }
            text.push_str(&paragraph(&section.title, self.width));
            for row in rows {
                self.row(text, &row.label, |run| row.cells[run].as_deref().unwrap_or(NONE));
            }
        }
    }

    fn row<'a>(&self, text: &mut String, label: &str, cell: impl Fn(usize) -> &'a str) {
        // Labels are indented below their section.
        let indent = label.chars().take_while(|letter| *letter == ' ').count() + 2;
        let mut label = lines(label, self.labels.saturating_sub(indent));
        label
            .iter_mut()
            .for_each(|line| line.insert_str(0, &" ".repeat(indent)));
        let cells: Vec<(Vec<String>, usize)> = self
            .runs
            .clone()
            .map(|run| (lines(cell(run), self.widths[run]), self.widths[run]))
            .collect();
        let cells = cells
            .iter()
            .map(|(lines, width)| (&lines[..], *width, GAP, Align::Right));
        write_row(
            text,
            std::iter::once((&label[..], self.labels, 0, Align::Left)).chain(cells),
        );
    }
}
