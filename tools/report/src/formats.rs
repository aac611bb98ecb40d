//! Tables for programs and papers.

use realo_results::Run;

use crate::cells::NONE;
use crate::columns::{self, Cell, Column};
use crate::differences::{of_data, values_of_settings};
use crate::foot::{V2X_REAL, notes};
use crate::sections::{ious, sections};
use crate::settings::common;
use crate::text::one_line;

/// A table: its head and its rows; what is first in a row names it.
struct Grid {
    /// So many columns name a row.
    labels: usize,
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

/// A row for each run, with the main columns.
fn by_run(
    runs: &[(&str, &Run)],
    columns: &[Column],
    name: impl Fn(&Column) -> String,
    cell: impl Fn(&Cell) -> String,
) -> Grid {
    let row = |(at, (run, _)): (usize, &(&str, &Run))| {
        let cells = columns.iter().map(|column| cell(&column.cells[at]));
        std::iter::once(run.to_string()).chain(cells).collect()
    };
    Grid {
        labels: 1,
        head: std::iter::once("run".into()).chain(columns.iter().map(name)).collect(),
        rows: runs.iter().enumerate().map(row).collect(),
    }
}

/// All rows, with a column for each run.
fn side_by_side(runs: &[(&str, &Run)]) -> Grid {
    let all = all(runs);
    let names = runs.iter().map(|(name, _)| name.to_string());
    let mut rows = Vec::new();
    for section in sections(&all, true) {
        for row in section.rows.iter().filter(|row| row.cells.iter().any(Option::is_some)) {
            let cells = row.cells.iter().map(|cell| cell.clone().unwrap_or(NONE.into()));
            let label = [section.title.clone(), row.label.trim().into()];
            rows.push(label.into_iter().chain(cells).collect());
        }
    }
    Grid {
        labels: 2,
        head: ["part".to_string(), "row".into()].into_iter().chain(names).collect(),
        rows,
    }
}

fn all<'a>(runs: &[(&str, &'a Run)]) -> Vec<&'a Run> {
    runs.iter().map(|(_, run)| *run).collect()
}

/// For readers: what is known of each run in the main columns.
fn for_readers(runs: &[(&str, &Run)], full: bool) -> Grid {
    if full {
        return side_by_side(runs);
    }
    let name = |column: &Column| format!("{} {}", column.head, column.part);
    let mut grid = by_run(runs, &columns::main(&all(runs)), name, |cell| cell.shown().into());
    // What differs is a label of the run.
    for (at, (name, values)) in values_of_settings(runs).into_iter().enumerate() {
        grid.head.insert(1 + at, name);
        for (row, value) in grid.rows.iter_mut().zip(values) {
            row.insert(1 + at, value.unwrap_or(NONE.into()));
        }
        grid.labels += 1;
    }
    grid
}

/// As Markdown, with the runs' settings and notes below.
pub fn markdown(runs: &[(&str, &Run)], full: bool) -> String {
    let grid = for_readers(runs, full);
    let line = |cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|cell| one_line(cell).replace('|', "\\|")).collect();
        format!("| {} |\n", cells.join(" | "))
    };
    let align = (0..grid.head.len()).map(|at| if at < grid.labels { "---".into() } else { "---:".into() });
    let mut text = line(&grid.head) + &line(&align.collect::<Vec<String>>());
    text.extend(grid.rows.iter().map(|row| line(row)));
    let said: Vec<String> = below(runs, full).map(|sentence| format!("- {sentence}\n")).collect();
    if !said.is_empty() {
        text.push('\n');
        text.extend(said);
    }
    text
}

/// What a reader must know: what all runs were made with, what of their data differs, the other order of the scores, and the
/// notes.
fn below(runs: &[(&str, &Run)], full: bool) -> impl Iterator<Item = String> {
    let common = match (common(runs), runs.len()) {
        (common, _) if common.is_empty() => None,
        (common, 1) => Some(format!("Settings: {common}.")),
        (common, _) => Some(format!("Settings of all runs: {common}.")),
    };
    let scored = !full && !ious(&all(runs)).is_empty();
    let order = scored.then(|| format!("mAP and AP: all detections sorted by score. --full also has AP {V2X_REAL}."));
    let data = of_data(runs);
    let all = common.into_iter().chain(data).chain(order).chain(notes(runs));
    all.map(|sentence| one_line(&sentence))
}

/// As comma-separated values (RFC 4180).
pub fn csv(runs: &[(&str, &Run)], full: bool) -> String {
    let grid = match full {
        true => side_by_side(runs),
        false => by_run(
            runs,
            &columns::exact(&all(runs)),
            |column| column.field.clone(),
            Cell::exact,
        ),
    };
    let quoted = |cell: &String| {
        let cell = one_line(cell);
        match cell.contains([',', '"']) {
            true => format!("\"{}\"", cell.replace('"', "\"\"")),
            false => cell,
        }
    };
    let line = |cells: &Vec<String>| cells.iter().map(quoted).collect::<Vec<_>>().join(",") + "\n";
    std::iter::once(&grid.head).chain(&grid.rows).map(line).collect()
}

/// As a LaTeX `tabular`, with the runs' settings and notes as comments below.
pub fn latex(runs: &[(&str, &Run)], full: bool) -> String {
    let grid = for_readers(runs, full);
    let line = |cells: &[String]| {
        let cells: Vec<String> = cells.iter().map(|cell| escaped(&one_line(cell))).collect();
        format!("{} \\\\\n", cells.join(" & "))
    };
    let align = "l".repeat(grid.labels) + &"r".repeat(grid.head.len() - grid.labels);
    let mut text = format!("\\begin{{tabular}}{{{align}}}\n\\hline\n{}\\hline\n", line(&grid.head));
    text.extend(grid.rows.iter().map(|row| line(row)));
    text.push_str("\\hline\n\\end{tabular}\n");
    text.extend(below(runs, full).map(|sentence| format!("% {sentence}\n")));
    text
}

/// Text in which no letter is a command.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => safe.extend(['\\', letter]),
            '\\' => safe.push_str("\\textbackslash{}"),
            '~' => safe.push_str("\\textasciitilde{}"),
            '^' => safe.push_str("\\textasciicircum{}"),
            '–' => safe.push_str("--"),
            '±' => safe.push_str("$\\pm$"),
            letter => safe.push(letter),
        }
    }
    safe
}
