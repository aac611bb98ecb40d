//! `realo report`: runs as one page for a browser.

use std::path::PathBuf;

use eyre::{Result, bail};
use realo_cli::{Force, Outcome, Output, Progress, expect_ending, write_whole};
use realo_page::Request;

use crate::compare::names;
use crate::graph;
use crate::render::log_folders;

/// Largest page without points, bytes: small enough for a mail.
const MOST_BYTES: usize = 5_000_000;
/// Largest points, bytes; with the rest they stay below 40 MB.
const MOST_POINT_BYTES: usize = 34_000_000;

/// Writes runs as one page for a browser: the verdict, a player of what was found and missed, tables and charts. The file
/// needs nothing beside it, and no network
#[derive(clap::Args)]
pub struct Args {
    /// Folders that `realo run` wrote: of a graph, or of a log and an ego in it
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// The page also has the points of all agents, out of the log: up to 40 MB in place of 5
    #[arg(long)]
    points: bool,
    /// The log that was played [default: where the runs say that it was, else by its name here or in target/realo]
    #[arg(long)]
    log: Option<PathBuf>,
    /// The page to write: .html
    #[arg(short = 'o', long = "output", default_value = "report.html")]
    output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
}

/// Writes the page and says what is on it.
pub fn main(args: &Args) -> Result<Outcome> {
    expect_ending(&args.output, &["html", "htm"])?;
    args.force.check(&args.output, Output::HTML)?;
    if let Some(log) = args.log.as_ref().filter(|log| !log.exists()) {
        bail!(
            "{}: no such file; give the log that was played with --log",
            log.display()
        );
    }
    let request = Request {
        runs: names(&args.runs).into_iter().zip(args.runs.clone()).collect(),
        log: args.log.clone(),
        log_folders: log_folders(),
        points: args.points,
        most_bytes: MOST_BYTES,
        most_point_bytes: MOST_POINT_BYTES,
    };
    let progress = Progress::new("reading", "runs", Some(0.0));
    let page = realo_page::page(&request, &graph::picture, &|what, done, all| {
        progress.rename(what, "");
        progress.of(done as f64, all as f64);
    })?;
    progress.finish();
    write_whole(&args.output, &page.html)?;
    for line in &page.left_out {
        eprintln!("realo: {line}");
    }
    println!(
        "{}: {}; open it in a browser",
        args.output.display(),
        in_words(&page, page.runs)
    );
    Ok(match page.failed {
        0 => Outcome::Complete,
        _ => Outcome::Partial,
    })
}

fn in_words(page: &realo_page::Page, runs: usize) -> String {
    let megabytes = page.html.len() as f64 / 1e6;
    let runs = if runs == 1 {
        "1 run".into()
    } else {
        format!("{runs} runs")
    };
    let points = match page.points {
        0 => String::new(),
        points => format!(", {points} points"),
    };
    format!(
        "{runs}, {} sweeps in the player{points}, {megabytes:.1} MB",
        page.sweeps
    )
}
