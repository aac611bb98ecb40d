//! The files that say what is measured: pages, the columns that they share, and the figures of the paper.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, eyre};
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::check::check_name;
use super::page::{Column, Kind, Page};

/// Where they are in the tree.
const FOLDER: &str = "tools/lab/src/measure";

/// The tree of this project around a folder.
///
/// # Errors
/// A folder outside of it.
pub fn root(folder: &Path) -> Result<PathBuf> {
    let folder = folder.canonicalize().wrap_err_with(|| folder.display().to_string())?;
    let found = folder
        .ancestors()
        .find(|above| above.join(FOLDER).join("pages").is_dir());
    found.map(Path::to_path_buf).ok_or_else(|| {
        eyre!(
            "{}: expected the repository of realo, found no folder {FOLDER} here or above: change to the repository",
            folder.display()
        )
    })
}

/// All pages, and what they share.
pub struct Recipes {
    pages: BTreeMap<String, Page>,
    columns: BTreeMap<String, Column>,
    paper: Value,
}

/// A page from its text, which names results that are not of its own steps.
///
/// # Errors
/// What is wrong in it.
pub fn page_file(text: &str) -> Result<Page> {
    Ok(toml::from_str(text)?)
}

fn read<T: DeserializeOwned>(path: &Path) -> Result<T> {
    let text = fs::read_to_string(path).wrap_err_with(|| path.display().to_string())?;
    toml::from_str(&text).wrap_err_with(|| path.display().to_string())
}

impl Recipes {
    /// Reads and checks them.
    ///
    /// # Errors
    /// The file with what is wrong in it.
    pub fn read(root: &Path) -> Result<Self> {
        let folder = root.join(FOLDER);
        let columns = read(&folder.join("columns.toml"))?;
        let paper = read(&folder.join("paper.toml"))?;
        let mut pages = BTreeMap::new();
        let folder = folder.join("pages");
        for entry in fs::read_dir(&folder).wrap_err_with(|| folder.display().to_string())? {
            let path = entry?.path();
            if path.extension().is_none_or(|extension| extension != "toml") {
                continue;
            }
            let page: Page = read(&path)?;
            let name = path.file_stem().unwrap_or_default().to_string_lossy();
            check_name(&name)
                .and_then(|()| page.check(&columns))
                .wrap_err_with(|| path.display().to_string())?;
            pages.insert(name.into_owned(), page);
        }
        Ok(Recipes { pages, columns, paper })
    }

    /// All pages by name.
    pub fn pages(&self) -> &BTreeMap<String, Page> {
        &self.pages
    }

    /// A page.
    ///
    /// # Errors
    /// A name that no page has, with those that there are.
    pub fn page(&self, name: &str) -> Result<&Page> {
        let known = || self.pages.keys().cloned().collect::<Vec<_>>().join(", ");
        let page = self.pages.get(name);
        page.ok_or_else(|| eyre!("there is no page `{name}`, but: {}", known()))
    }

    /// The columns that all pages know.
    pub fn columns(&self) -> &BTreeMap<String, Column> {
        &self.columns
    }

    /// The figures of the paper.
    pub fn paper(&self) -> &Value {
        &self.paper
    }

    /// A line for each page.
    pub fn list(&self) -> String {
        let line = |(name, page): (&String, &Page)| {
            let kind = match page.kind {
                Kind::Scores => "scores",
                Kind::Times => "times",
            };
            format!("{name:14} {kind:7} {}\n", page.title)
        };
        self.pages.iter().map(line).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::{json, plan::Plan};

    fn root() -> PathBuf {
        super::root(Path::new(env!("CARGO_MANIFEST_DIR"))).unwrap()
    }

    #[test]
    fn a_folder_outside_of_the_tree_is_named() {
        let outside = tempfile::tempdir().unwrap();
        let said = super::root(outside.path()).unwrap_err().to_string();
        assert!(said.contains("change to the repository"), "{said}");
    }

    #[test]
    fn shipped_pages_name_what_there_is() {
        let recipes = Recipes::read(&root()).unwrap();
        assert!(recipes.list().contains("small          scores"));
        for (name, page) in recipes.pages() {
            Plan::new(name, page).unwrap();
            // Boxes that logs record need no network: a page may be of such runs alone.
            let makes_logs_or_maps = |args: &[String]| ["simulate", "map"].contains(&args[0].as_str());
            let is_recorded = |args: &[String]| args.iter().any(|arg| arg == "--recorded-detections");
            let mut steps = page.steps.iter().map(|step| &step.args);
            let needs_no_weights = steps.all(|args| makes_logs_or_maps(args) || is_recorded(args));
            assert!(
                !page.weights.is_empty() || page.kind == Kind::Times || needs_no_weights,
                "{name}: no weights"
            );
            for weights in &page.weights {
                assert!(root().join(weights).is_file(), "{name}: {weights}");
            }
            let rows = page.tables.iter().flat_map(|table| &table.rows);
            for result in rows.flat_map(|row| row.results.values()) {
                if let Some(path) = result.strip_prefix("paper:") {
                    json::find(recipes.paper(), &format!("/{path}")).unwrap();
                }
            }
        }
        let error = recipes.page("other").unwrap_err().to_string();
        assert!(
            error.contains("there is no page `other`, but: agents, bytes"),
            "{error}"
        );
    }

    /// The table in README.md is never edited by hand: it is one of the page's, and there is none without the page.
    #[test]
    fn the_table_of_the_readme_is_in_its_page() {
        let readme = fs::read_to_string(root().join("README.md")).unwrap();
        let page = fs::read_to_string(root().join("docs/measured/demo.md")).unwrap_or_default();
        let (_, block) = readme.split_once("<!-- measured: demo -->").unwrap();
        let (block, _) = block.split_once("<!-- /measured -->").unwrap();
        assert_eq!(block.trim().is_empty(), page.is_empty(), "{block}");
        assert!(page.contains(block.trim()), "{block}");
    }
}
