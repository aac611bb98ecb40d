//! The page of the tables, from what all runs came to.

use std::collections::BTreeMap;
use std::path::PathBuf;

use eyre::{Result, WrapErr, eyre};
use realo_cli::campaign;
use serde_json::Value;

use super::plan::{BENCHES, METHODS, MODES, Runs, WAYS, bench_key, cells, run_key};
use crate::measure::{
    COMMIT, Column, Page, Recipes, Row, Table, Tree, derived, find_in, page_file, sha256, table, words,
};

/// The tables and columns of the page; those of each mode are made from one.
const PAGE: &str = include_str!("page.toml");

/// A page that can be written.
pub struct Sheet<'a> {
    runs: &'a Runs,
    recipes: &'a Recipes,
    page: Page,
    results: BTreeMap<String, Value>,
    columns: BTreeMap<String, Column>,
    tables: Vec<Table>,
}

/// What crossed and what was found, of all scenes of a cell.
fn pooled(folders: &[PathBuf]) -> Result<Value> {
    let runs = folders
        .iter()
        .map(|folder| realo_report::read_run(folder.join("run")).wrap_err_with(|| campaign::remedy(folder)));
    let run = realo_report::pool(&runs.collect::<Result<Vec<_>>>()?)?;
    let mut value = serde_json::to_value(&run.result)?;
    value["derived"] = derived(&value);
    Ok(value)
}

impl<'a> Sheet<'a> {
    /// Pools what is in the folders of a plan.
    ///
    /// # Errors
    /// Results that cannot be read or pooled, with the cell.
    pub fn new(runs: &'a Runs, found: &[Option<(PathBuf, Value)>], recipes: &'a Recipes) -> Result<Self> {
        let known: BTreeMap<&str, &(PathBuf, Value)> = runs
            .plan
            .items
            .iter()
            .zip(found)
            .filter_map(|(item, found)| Some((item.key.as_str(), found.as_ref()?)))
            .collect();
        let of = |key: &str| known.get(key).copied().ok_or_else(|| eyre!("`{key}` is not done"));
        let mut results = BTreeMap::new();
        for bench in BENCHES {
            results.insert(bench.to_string(), of(&bench_key(bench))?.1.clone());
        }
        for cell in cells() {
            let folders: Result<Vec<PathBuf>> = (0..runs.scenes)
                .map(|scene| Ok(of(&run_key(&cell, scene))?.0.clone()))
                .collect();
            let pooled = pooled(&folders?).wrap_err_with(|| cell.to_string())?;
            results.insert(cell.to_string(), pooled);
        }
        let page = page_file(PAGE)?;
        let of_pages = recipes.columns().clone();
        let columns = of_pages.into_iter().chain(page.columns.clone()).collect();
        let mut tables: Vec<Table> = page.tables.iter().flat_map(every).collect();
        // The paper has no figures for some cells.
        let is_there = |of: &String| match of.strip_prefix("paper:") {
            Some(path) => find_in(recipes.paper(), &format!("/{path}")).is_ok(),
            None => true,
        };
        let rows = tables.iter_mut().flat_map(|table| &mut table.rows);
        rows.for_each(|row| row.results.retain(|_, of| is_there(of)));
        Ok(Sheet {
            runs,
            recipes,
            page,
            results,
            columns,
            tables,
        })
    }

    /// All tables, in Markdown.
    ///
    /// # Errors
    /// A path that leads nowhere.
    pub fn tables(&self) -> Result<String> {
        let mut text = String::new();
        for one in &self.tables {
            text += &format!("\n## {}\n\n", one.title);
            if let Some(about) = &one.about {
                text += &format!("{}\n\n", about.trim());
            }
            text += &table(one, &self.used(one), |name| self.find(name))?;
        }
        Ok(text)
    }

    /// The page; `command` writes it.
    ///
    /// # Errors
    /// As [`Sheet::tables`].
    pub fn markdown(&self, tree: &Tree, command: &str) -> Result<String> {
        let page = &self.page;
        let mut text = format!(
            "<!-- Written by `{command}`: what is edited here is lost. -->\n# {}\n\n",
            page.title
        );
        let about = page.about.trim().replace("{scenes}", &self.runs.scenes.to_string());
        text += &format!("{}\n\n", about.replace("{seconds}", &self.runs.seconds.to_string()));
        text += &format!(
            "| | |\n|---|---|\n{COMMIT} {} |\n| written by | `{command}` |\n",
            tree.commit()
        );
        let isa = self.results.values().find_map(|result| result["isa"].as_str());
        text += &format!("| networks computed in | {} |\n", isa.unwrap_or("no network"));
        for file in &page.weights {
            text += &format!("| sha256 of `{file}` | `{}` |\n", sha256(&tree.root.join(file))?);
        }
        text += &self.tables()?;
        text += &words(self.tables.iter().flat_map(|table| self.used(table)));
        Ok(text)
    }

    fn used(&self, table: &Table) -> Vec<&Column> {
        table.columns.iter().filter_map(|name| self.columns.get(name)).collect()
    }

    /// A result: `MODE/WAY/METHOD`, a bench, or `paper`, and behind a colon the path of a part.
    fn find(&self, name: &str) -> Result<Value> {
        let (of, path) = name.split_once(':').unwrap_or((name, ""));
        let path = if path.is_empty() {
            String::new()
        } else {
            format!("/{path}")
        };
        let whole = match of {
            "paper" => self.recipes.paper(),
            _ => self.results.get(of).ok_or_else(|| eyre!("there is no result `{of}`"))?,
        };
        find_in(whole, &path).cloned()
    }
}

/// A table for each mode where its title names `{mode}`, with a row for each method where it has none of its own.
fn every(table: &Table) -> Vec<Table> {
    if !table.title.contains("{mode}") {
        return vec![table.clone()];
    }
    let of_mode = |(mode, title): &(&str, &str)| {
        let row = |(method, label): &(&str, &str)| Row {
            label: label.to_string(),
            results: results(mode, method),
        };
        Table {
            title: table.title.replace("{mode}", title),
            rows: METHODS.iter().rev().map(row).collect(),
            ..table.clone()
        }
    };
    MODES.iter().map(of_mode).collect()
}

/// What a method's row reads: a result for each way, and the paper's.
fn results(mode: &str, method: &str) -> BTreeMap<String, String> {
    let ways = WAYS
        .iter()
        .map(|(way, _)| (way.to_string(), format!("{mode}/{way}/{method}")));
    let paper = ["offline", "online"].map(|way| (format!("paper_{way}"), format!("paper:{way}/{mode}/{method}")));
    let usual = [
        ("run".to_string(), format!("{mode}/online/{method}")),
        ("paper".to_string(), format!("paper:online/{mode}/{method}")),
    ];
    ways.chain(paper).chain(usual).collect()
}
