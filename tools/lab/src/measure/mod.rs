//! `realo-lab measure`: runs what a page of docs/measured needs, and writes the page.
//!
//! A page is a file in `pages/`: its steps are commands of `realo` and `realo-lab`, its tables name results and paths into
//! them. Nothing in a written page is typed by hand. Pages of scores hold nothing that differs between machines.

mod cell;
mod check;
mod json;
mod lock;
mod output;
mod page;
mod plan;
mod process;
mod programs;
mod provenance;
mod recipes;
mod render;
mod source;
mod steps;
mod table;
mod template;

use std::path::{Path, PathBuf};

use eyre::{Result, bail, ensure, eyre};

pub(crate) use json::find as find_in;
pub(crate) use output::{COMMIT, write_page};
use page::Kind;
pub(crate) use page::{Column, Page, Program, Row, Table};
pub(crate) use process::run;
pub(crate) use programs::Programs;
pub(crate) use provenance::{Tree, machine, sha256};
pub(crate) use recipes::{Recipes, page_file, root};
pub(crate) use render::words;
pub(crate) use source::derived;
pub(crate) use table::markdown as table;

/// Runs what a page of docs/measured needs, and writes the page
#[derive(clap::Args)]
pub struct Args {
    /// The pages to write
    #[arg(required_unless_present_any = ["list", "all"])]
    pages: Vec<String>,
    /// Write every page; those that need data which is not there are skipped
    #[arg(long, conflicts_with = "pages")]
    all: bool,
    /// With --all: only pages of this kind
    #[arg(long, value_enum, requires = "all")]
    kind: Option<Kind>,
    /// List the pages
    #[arg(long)]
    list: bool,
    /// Where pages go [default: docs/measured, and the table of README.md]
    #[arg(long)]
    out: Option<PathBuf>,
    /// name=number: changes a parameter of the page, as seeds=20
    #[arg(long = "set")]
    set: Vec<String>,
    /// Measure anew what was measured before
    #[arg(long)]
    fresh: bool,
    /// Measure a tree with changes that are not committed; the page says so
    #[arg(long)]
    allow_dirty: bool,
}

/// What all pages of a call share.
struct Bench {
    recipes: Recipes,
    tree: Tree,
    programs: Programs,
}

/// Writes the pages that were asked for.
///
/// # Errors
/// A tree with changes; an unknown page; a page that another call measures; a step that failed, with its command and its last
/// lines.
pub fn main(args: &Args) -> Result<()> {
    let root = root(Path::new("."))?;
    let recipes = Recipes::read(&root)?;
    if args.list {
        print!("{}", recipes.list());
        return Ok(());
    }
    let pages = chosen(args, &recipes)?;
    let tree = Tree::of(root)?;
    tree.refuse_changes(args.allow_dirty)?;
    let programs = Programs::find(&tree.root)?;
    let bench = Bench {
        recipes,
        tree,
        programs,
    };
    let mut failed = Vec::new();
    for name in &pages {
        if let Err(error) = bench.write(name, args) {
            eprintln!("realo-lab: page {name}: {error:#}");
            failed.push(name.as_str());
        }
    }
    ensure!(failed.is_empty(), "not written: {}", failed.join(", "));
    Ok(())
}

/// The names of the pages that were asked for.
fn chosen(args: &Args, recipes: &Recipes) -> Result<Vec<String>> {
    if !args.all {
        args.pages.iter().try_for_each(|name| recipes.page(name).map(drop))?;
        return Ok(args.pages.clone());
    }
    let mut names = Vec::new();
    for (name, page) in recipes.pages() {
        if args.kind.is_some_and(|kind| kind != page.kind) {
            continue;
        }
        match page.missing_variable() {
            Some(variable) => eprintln!("realo-lab: page {name} is skipped: {variable} is not set"),
            None => names.push(name.clone()),
        }
    }
    Ok(names)
}

impl Bench {
    fn write(&self, name: &str, args: &Args) -> Result<()> {
        let mut page = self.recipes.page(name)?.clone();
        set_parameters(&mut page, &args.set)?;
        if let Some(variable) = page.missing_variable() {
            bail!("it needs {variable}, the folder that holds its data: set it");
        }
        let root = &self.tree.root;
        let readme = root.join("README.md");
        let in_place = args.out.is_none();
        if in_place && page.tables.iter().any(|table| table.readme) {
            output::check_markers(&readme, name)?;
        }
        let plan = plan::Plan::new(name, &page)?;
        let _lock = lock::Lock::of_page(&plan.folder(root), &plan.lock(root))?;
        let runner = steps::Runner {
            plan: &plan,
            programs: &self.programs,
            root,
        };
        runner.run(page.kind, args.fresh)?;
        let results = source::Results::new(&plan, root, self.recipes.paper());
        let sheet = render::Sheet {
            page: &page,
            plan: &plan,
            results: &results,
            columns: self.recipes.columns(),
        };
        let provenance = self.tree.provenance(&page, command(name, &args.set))?;
        let text = sheet.markdown(&provenance)?;
        let folder = args.out.clone().unwrap_or_else(|| root.join("docs/measured"));
        for (drawing, from) in sheet.drawings()? {
            output::copy(&from, &folder.join(drawing))?;
        }
        output::write_page(&folder.join(format!("{name}.md")), &text)?;
        if let (true, Some(table)) = (in_place, sheet.readme_table()?) {
            // Tables of other pages are in that file too.
            let _lock = lock::Lock::wait(&plan::readme_lock(root))?;
            output::write_block(&readme, name, &table)?;
        }
        Ok(())
    }
}

/// The command that writes a page, as the page says it.
fn command(name: &str, set: &[String]) -> String {
    let set: String = set.iter().map(|set| format!(" --set {set}")).collect();
    format!("realo-lab measure {name}{set}")
}

/// Changes the parameters of a page by `name=number`.
fn set_parameters(page: &mut Page, set: &[String]) -> Result<()> {
    for text in set {
        let (name, value) = text
            .split_once('=')
            .ok_or_else(|| eyre!("--set {text}: expected name=number"))?;
        let known = page.parameters.keys().cloned().collect::<Vec<_>>().join(", ");
        let parameter = page.parameters.get_mut(name);
        let parameter = parameter.ok_or_else(|| eyre!("--set {text}: the page has no `{name}`, but: {known}"))?;
        *parameter = value
            .parse()
            .map_err(|_| eyre!("--set {text}: `{value}` is not a whole number"))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page() -> Page {
        toml::from_str("title = 'T'\nkind = 'scores'\nabout = 'A'\n[parameters]\nseeds = 100\n").unwrap()
    }

    #[test]
    fn parameters_are_set_by_name() {
        let mut page = page();
        set_parameters(&mut page, &["seeds=3".into()]).unwrap();
        assert_eq!(page.parameters["seeds"], 3);
        assert_eq!(
            command("detector", &["seeds=3".into()]),
            "realo-lab measure detector --set seeds=3"
        );
    }

    #[test]
    fn unknown_parameters_and_values_are_refused() {
        for (text, expected) in [
            ("seeds", "expected name=number"),
            ("logs=3", "the page has no `logs`, but: seeds"),
            ("seeds=many", "`many` is not a whole number"),
        ] {
            let error = set_parameters(&mut page(), &[text.into()]).unwrap_err();
            assert!(error.to_string().contains(expected), "{error}");
        }
    }
}
