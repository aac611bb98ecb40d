//! What the file of a page holds.

use std::collections::BTreeMap;

use clap::ValueEnum;
use serde::Deserialize;

use super::cell::Format;
use super::template;

/// A page of docs/measured: what is run for it, and which tables come of it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Page {
    /// The heading.
    pub title: String,
    /// Whether its figures are scores or times.
    pub kind: Kind,
    /// One paragraph: what is measured. May name parameters, as `{seeds}`.
    pub about: String,
    /// Files of weights that the networks of its steps load; their sha256 is in the page.
    #[serde(default)]
    pub weights: Vec<String>,
    /// Numbers that `--set` changes.
    #[serde(default)]
    pub parameters: BTreeMap<String, u64>,
    /// Commands, in the order in which they run.
    #[serde(default)]
    pub steps: Vec<Step>,
    /// Columns beside those that all pages know.
    #[serde(default)]
    pub columns: BTreeMap<String, Column>,
    /// The tables, from top to bottom.
    #[serde(default)]
    pub tables: Vec<Table>,
    /// Curves below them, from top to bottom.
    #[serde(default)]
    pub curves: Vec<Curves>,
}

/// What the figures of a page are.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Scores and bytes: every run gives the same digits
    Scores,
    /// Times of one machine
    Times,
}

/// A command, or one for each value of a variable.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// What later steps and tables call it.
    pub name: String,
    /// Which program runs.
    pub program: Program,
    /// Its arguments. `{out}` is the step's place for files, `{NAME}` a parameter or what the step NAME wrote (an argument
    /// with the files of several commands stands once for each), and `{env:NAME}` a variable of the environment.
    pub args: Vec<String>,
    /// The file or folder that it writes.
    #[serde(default = "out")]
    pub output: String,
    /// Runs it once for each value of a variable.
    #[serde(default)]
    pub each: Option<Each>,
}

fn out() -> String {
    "{out}".into()
}

/// Values of a variable: whole numbers in sequence.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Each {
    /// The variable's name in arguments.
    pub variable: String,
    /// The first value.
    pub from: u64,
    /// The parameter that says how many.
    pub count: String,
}

/// A program of this project.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
pub enum Program {
    /// What runs in the car.
    #[serde(rename = "realo")]
    Realo,
    /// The workbench.
    #[serde(rename = "realo-lab")]
    Lab,
}

impl Program {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Program::Realo => "realo",
            Program::Lab => "realo-lab",
        }
    }
}

/// A column: where in a result its values are, and how they are written.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Column {
    /// The header, with the unit.
    pub title: String,
    /// One sentence for readers to whom the header is not plain.
    #[serde(default)]
    pub about: Option<String>,
    /// Which of a row's results it reads.
    #[serde(default = "run")]
    pub of: String,
    /// Paths into the result; several values are written as `a / b`.
    pub paths: Vec<String>,
    /// How a value is written.
    pub format: Format,
    /// What values are multiplied by.
    #[serde(default = "one")]
    pub scale: f64,
}

fn run() -> String {
    "run".into()
}

fn one() -> f64 {
    1.0
}

/// A table: rows that the page names, or a row for each element of a list in a result.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Table {
    /// The heading above it.
    pub title: String,
    /// A paragraph below the heading.
    #[serde(default)]
    pub about: Option<String>,
    /// Whether README.md has it too.
    #[serde(default)]
    pub readme: bool,
    /// The header of the first column.
    pub head: String,
    /// Names of columns.
    pub columns: Vec<String>,
    /// Rows by name.
    #[serde(default)]
    pub rows: Vec<Row>,
    /// Rows out of a list.
    #[serde(default)]
    pub list: Option<List>,
}

/// The curves of a sweep over one setting, drawn and as a table.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Curves {
    /// The heading above them.
    pub title: String,
    /// A paragraph below the heading.
    #[serde(default)]
    pub about: Option<String>,
    /// The step that ran the sweep.
    pub step: String,
    /// The setting, as the sweep names it.
    pub setting: String,
}

/// A row: its label, and the results that its columns read.
#[derive(Clone, Debug, Deserialize)]
pub struct Row {
    /// The first cell.
    pub label: String,
    /// Results by the name that columns know: `STEP`, `STEP/GRAPH`, `STEP:PATH` or `paper:PATH`.
    #[serde(flatten)]
    pub results: BTreeMap<String, String>,
}

/// A list in a result, each element of which is a row.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct List {
    /// The result.
    pub of: String,
    /// Path of the list.
    pub path: String,
    /// Paths of what labels an element.
    pub label: Vec<String>,
}

impl Page {
    /// The first variable of the environment that its steps need and that is not set.
    pub fn missing_variable(&self) -> Option<String> {
        let args = self.steps.iter().flat_map(|step| &step.args);
        let mut needed = args.flat_map(|arg| template::names(arg)).filter_map(template::variable);
        needed.find(|name| std::env::var_os(name).is_none()).map(str::to_string)
    }

    /// The step of a name.
    pub fn step(&self, name: &str) -> Option<&Step> {
        self.steps.iter().find(|step| step.name == name)
    }
}
