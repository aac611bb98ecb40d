//! How commands print runs.

use clap::ValueEnum;
use realo_report::{Options, Run, notes, shown};

/// How runs are printed.
#[derive(clap::Args, Clone, Copy, Default, Debug)]
pub struct Show {
    /// As what runs are printed
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    /// The same as --format json
    #[arg(long, conflicts_with = "format")]
    json: bool,
    /// All rows, a column for each run [default: the main ones, from three runs on a row for each run]
    #[arg(long, visible_alias = "verbose")]
    full: bool,
}

/// As what runs are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A table for the terminal
    #[default]
    Table,
    /// A Markdown table
    Md,
    /// Comma-separated values: a row for each run, with its settings and all digits
    Csv,
    /// A LaTeX tabular
    Latex,
    /// All that result.json and timing.json have, and what differs between the runs
    Json,
}

impl Show {
    /// Whether a reader gets the table, not a program.
    pub fn is_table(self) -> bool {
        self.format == Format::Table && !self.json
    }

    /// Prints runs with their names; what a format has no place for goes to standard error.
    pub fn print(self, runs: &[(&str, &Run)]) {
        let format = match (self.json, self.format) {
            (true, _) | (_, Format::Json) => realo_report::Format::Json,
            (_, Format::Table) => realo_report::Format::Text,
            (_, Format::Md) => realo_report::Format::Markdown,
            (_, Format::Csv) => realo_report::Format::Csv,
            (_, Format::Latex) => realo_report::Format::Latex,
        };
        let (full, width) = (self.full, width());
        print!("{}", shown(runs, &Options { format, full, width }));
        if format == realo_report::Format::Csv {
            notes(runs).iter().for_each(|note| eprintln!("realo: {note}"));
        }
    }
}

/// What a reader wants to know first: the numbers that matter, what they say, and what to look at next. `earlier`: runs that are not part of
/// the table; a run by itself is compared with them. `references`: the same runs with the poses of the log.
pub fn print_opening(runs: &[(&str, &Run)], earlier: &[(&str, &Run)], references: &[(&str, &Run)], next: &str) {
    let mut sentences = realo_page::verdict(runs);
    if let [(_, only)] = runs
        && let Some(first) = sentences.first_mut()
        && let Some(beside) = realo_page::beside(only, earlier)
    {
        *first = format!("{first} {beside}");
    }
    let others = [references, earlier].concat();
    sentences.extend(realo_page::localization_cost(runs, &others));
    sentences.push(format!("Next: {next}"));
    println!("{}", realo_report::opening(runs, &sentences, width()));
}

/// The table of a run that is not asked how it is printed.
pub fn table(runs: &[(&str, &Run)]) -> String {
    let width = width();
    let options = Options {
        width,
        ..Options::default()
    };
    shown(runs, &options)
}

/// Columns of the terminal: what `COLUMNS` says, else what standard output has, else 80.
pub(crate) fn width() -> usize {
    const USUAL: usize = 80;
    const LEAST: usize = 40;
    let said = std::env::var("COLUMNS").ok().and_then(|columns| columns.parse().ok());
    let found = || terminal_size::terminal_size_of(std::io::stdout()).map(|(width, _)| usize::from(width.0));
    said.filter(|columns| *columns > 0)
        .or_else(found)
        .unwrap_or(USUAL)
        .max(LEAST)
}
