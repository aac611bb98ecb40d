//! Many runs as text: a row for each.

use realo_results::Run;

use crate::columns::{self, Column};
use crate::text::{Align, lines, paragraph, width_of, write_row};
use crate::{foot, settings};

/// Between columns under different heads.
const GAP: usize = 2;
/// Between columns under one head.
const NARROW: usize = 1;
/// A run's name is broken into lines of at least so many columns before the table is.
const LEAST_NAME: usize = 10;

/// A row for each run, in as many tables as it takes to fit the terminal's width; what they have in common stands above, all
/// else below.
pub fn list(runs: &[(&str, &Run)], width: usize) -> String {
    let all: Vec<&Run> = runs.iter().map(|(_, run)| *run).collect();
    let mut head = String::new();
    for difference in crate::differences::of_data(runs) {
        head.push_str(&paragraph(&format!("note: {difference}"), width));
    }
    let common = settings::common(runs);
    if !common.is_empty() {
        head.push_str(&paragraph(&common, width));
    }
    let names: Vec<String> = runs.iter().map(|(name, run)| marked(name, run)).collect();
    let columns = columns::main(&all);
    let tables: Vec<String> = blocks(&columns, &names, width)
        .into_iter()
        .map(|block| block.text(&names))
        .collect();
    let table = tables.join("\n");
    head + &table + &foot::foot(runs, &table, width)
}

/// A disturbed run's name has a mark.
fn marked(name: &str, run: &Run) -> String {
    match foot::is_disturbed(run) {
        true => format!("{name} !"),
        false => name.into(),
    }
}

/// Columns under one head.
struct Group<'a> {
    head: &'a str,
    columns: Vec<(&'a Column, usize)>,
}

impl Group<'_> {
    fn width(&self) -> usize {
        let columns: usize = self.columns.iter().map(|(_, width)| width).sum();
        columns + NARROW * self.columns.len().saturating_sub(1)
    }
}

fn groups(columns: &[Column]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group> = Vec::new();
    for column in columns {
        let cells = column.cells.iter().map(|cell| width_of(cell.shown()));
        let width = cells.max().unwrap_or(0).max(width_of(&column.part));
        match groups.last_mut().filter(|group| group.head == column.head) {
            Some(group) => group.columns.push((column, width)),
            None => groups.push(Group {
                head: &column.head,
                columns: vec![(column, width)],
            }),
        }
    }
    for group in &mut groups {
        let lacks = width_of(group.head).saturating_sub(group.width());
        if let Some((_, width)) = group.columns.first_mut() {
            *width += lacks;
        }
    }
    groups
}

/// Groups that stand in one table.
struct Block<'a> {
    /// Width of the runs' names.
    names: usize,
    groups: Vec<Group<'a>>,
}

/// As few tables as fit: names are broken first.
fn blocks<'a>(columns: &'a [Column], names: &[String], width: usize) -> Vec<Block<'a>> {
    let longest = names.iter().map(|name| width_of(name)).max().unwrap_or(0);
    let min = longest.min(LEAST_NAME);
    let mut blocks: Vec<Block> = Vec::new();
    let mut used = 0;
    for group in groups(columns) {
        let more = GAP + group.width();
        match blocks.last_mut().filter(|_| min + used + more <= width) {
            Some(block) => {
                block.groups.push(group);
                used += more;
            }
            None => {
                used = more;
                let groups = vec![group];
                blocks.push(Block { names: 0, groups });
            }
        }
    }
    for block in &mut blocks {
        let used: usize = block.groups.iter().map(|group| GAP + group.width()).sum();
        block.names = longest.min(width.saturating_sub(used)).max(min);
    }
    blocks
}

impl Block<'_> {
    fn text(&self, names: &[String]) -> String {
        let mut text = String::new();
        let line = |text: &str| vec![text.to_string()];
        let heads: Vec<(Vec<String>, usize, usize, Align)> = self
            .groups
            .iter()
            .map(|group| {
                let align = match group.columns.len() {
                    1 => Align::Right,
                    _ => Align::Left,
                };
                (line(group.head), group.width(), GAP, align)
            })
            .collect();
        self.row(&mut text, "", &heads);
        let columns = || {
            self.groups.iter().flat_map(|group| {
                let columns = group.columns.iter().enumerate();
                columns.map(|(at, (column, width))| (*column, *width, if at == 0 { GAP } else { NARROW }))
            })
        };
        let parts: Vec<_> = columns()
            .map(|(column, width, gap)| (line(&column.part), width, gap, Align::Right))
            .collect();
        self.row(&mut text, "", &parts);
        let width: usize = self.names + self.groups.iter().map(|group| GAP + group.width()).sum::<usize>();
        text.push_str(&"─".repeat(width));
        text.push('\n');
        for (at, name) in names.iter().enumerate() {
            let cells: Vec<_> = columns()
                .map(|(column, width, gap)| (line(column.cells[at].shown()), width, gap, Align::Right))
                .collect();
            self.row(&mut text, name, &cells);
        }
        text
    }

    fn row(&self, text: &mut String, name: &str, cells: &[(Vec<String>, usize, usize, Align)]) {
        let name = lines(name, self.names);
        let cells = cells
            .iter()
            .map(|(lines, width, gap, align)| (&lines[..], *width, *gap, *align));
        write_row(
            text,
            std::iter::once((&name[..], self.names, 0, Align::Left)).chain(cells),
        );
    }
}
