//! `realo-lab paper`: the tables of V2X-ReaLO's paper with ours beside them, from as many scenes as one asks for.
//!
//! A run is a method over a scene, with who cooperates and how late messages are. So a run that failed, or one that a kill took,
//! costs seconds, and several machines can share them.

mod page;
mod plan;
mod worlds;

use std::path::{Path, PathBuf};

use eyre::{Result, bail};
use realo_cli::campaign::{self, Campaign, Parts, Task};
use realo_cli::{Outcome, signals};

use crate::measure::{Programs, Recipes, Tree, root, write_page};
use page::Sheet;
use plan::{BENCHES, Cell, Runs};
use worlds::Worlds;

/// Where a page goes.
const PAGE: &str = "docs/measured/paper.md";

/// Runs every method in every setting of V2X-ReaLO's paper, and writes its tables with ours beside them
#[derive(clap::Args)]
pub struct Args {
    /// Scenes, over which intervals are: simulator seeds from 900 on, a place each, every third one dense
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(2..=100))]
    scenes: u64,
    /// Seconds of a scene
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=60))]
    seconds: u64,
    /// Make only these cells, as v2v/online/attfuse, anew where they are there; all else stays. The page is written where the others are
    /// there, else the exit code is 3
    #[arg(long, value_name = "MODE/WAY/METHOD")]
    cell: Vec<Cell>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    parts: Parts,
    /// Folder of logs and runs; what is done there stays
    #[arg(short, long, default_value = "target/realo/paper")]
    out: PathBuf,
    /// Where the page goes [default: docs/measured/paper.md]
    #[arg(long)]
    page: Option<PathBuf>,
    /// Run a tree with changes that are not committed; the page says so
    #[arg(long)]
    allow_dirty: bool,
}

/// Makes what is missing, or some cells anew, and writes the page once all is there.
///
/// # Errors
/// A tree with changes; a folder or shard of another plan; runs that failed, the others being done.
pub fn main(args: &Args) -> Result<Outcome> {
    if !args.cell.is_empty() && (!args.parts.merge.is_empty() || args.parts.shard.is_some()) {
        bail!("--cell: cells are made in one folder: drop --shard or --merge");
    }
    let root = root(Path::new("."))?;
    let tree = Tree::of(root.clone())?;
    tree.refuse_changes(args.allow_dirty)?;
    let programs = Programs::find(&root)?;
    let recipes = Recipes::read(&root)?;
    signals::catch(|| ())?;
    let runs = Runs::new(args.scenes, args.seconds, &tree)?;
    let mut campaign = match args.cell.is_empty() {
        true => Campaign::open(&args.out, &runs.plan, &args.parts)?,
        false => Campaign::open_anew(&args.out, &runs.plan, &args.parts, |item| runs.is_of(item, &args.cell))?,
    };
    let worlds = Worlds::new(&args.out, args.seconds, &programs, &root);
    signals::begin();
    let mut tasks = campaign.tasks();
    set_benches_apart(&mut campaign, &tasks);
    plan::order(&mut tasks);
    let ended = campaign.run("the paper's tables", &tasks, |item, folder| {
        runs.make(item, folder, &worlds, &programs, &root)
    });
    if let Some(failed) = campaign::failed(&ended) {
        return Err(failed);
    }
    if let Some(ending) = signals::first() {
        let (left, goes_on) = (campaign::runs(ended.not_run), goes_on(args));
        eprintln!("realo-lab: ended by {ending}; left: {left}. The same command {goes_on}");
        return Ok(Outcome::Ended(ending.number()));
    }
    let results = campaign.results()?;
    let missing = results.iter().filter(|result| result.is_none()).count();
    if missing > 0 {
        return Ok(no_page(args, missing, results.len()));
    }
    let sheet = Sheet::new(&runs, &results, &recipes)?;
    let text = sheet.markdown(&tree, &command(args))?;
    print!("{}", sheet.tables()?);
    write_page(&args.page.clone().unwrap_or_else(|| root.join(PAGE)), &text)?;
    Ok(Outcome::Complete)
}

/// Says what is left out of the time of all runs.
fn set_benches_apart(campaign: &mut Campaign, tasks: &[Task]) {
    let benches = plan::benches(tasks);
    let words = format!(
        "{} ({}) in addition, some minutes each, beside which nothing runs",
        if benches == 1 { "a bench" } else { "the benches" },
        BENCHES[BENCHES.len() - benches..].join(", ")
    );
    if benches > 0 && benches == tasks.len() {
        eprintln!("realo-lab: no run, {words}");
    }
    campaign.set_apart(benches, words);
}

/// What a command does that is given again after a signal.
fn goes_on(args: &Args) -> &'static str {
    match args.cell.is_empty() {
        true => "goes on",
        false => "makes these cells again from the first; what was there of those that are left is there still",
    }
}

/// Says what a page lacks.
fn no_page(args: &Args, missing: usize, all: usize) -> Outcome {
    let (are, them) = if missing == 1 { ("is", "it") } else { ("are", "them") };
    let missing = campaign::runs(missing);
    if args.cell.is_empty() {
        eprintln!("realo-lab: {missing} of {all} {are} not here yet, so there is no page");
        // A shard has done its part.
        return match args.parts.merge.is_empty() {
            true => Outcome::Complete,
            false => Outcome::Partial,
        };
    }
    eprintln!(
        "realo-lab: these cells are made; {missing} of {all} {are} not here yet, or made of what has changed since, so no page is \
         written: the same command without --cell makes {them}"
    );
    Outcome::Partial
}

/// The command that writes the page.
fn command(args: &Args) -> String {
    format!("realo-lab paper --scenes {} --seconds {}", args.scenes, args.seconds)
}
