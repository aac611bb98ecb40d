//! `realo graph`: a graph as a picture, or what a run measured of it.

mod measured;
mod stages;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use eyre::Result;
use realo_cli::{Force, Outcome, Output, expect_ending, find, write_whole};
use realo_diagram::{Diagram, Terminal};
use realo_graph::FlatGraph;
use realo_results::{Run, run_folder};

use crate::tables;

/// Draws a graph: its processes, stages, ports, payload types and wires; of a finished run with what was measured. Prints it, or
/// writes an SVG picture
#[derive(clap::Args)]
pub struct Args {
    /// Dataflow file, name of a shipped one, or folder that `realo run` wrote
    graph: PathBuf,
    /// The picture to write: .svg [default: prints to the terminal]
    #[arg(short = 'o', long = "output")]
    output: Option<PathBuf>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
}

/// Prints the graph, or writes its picture.
pub fn main(args: &Args) -> Result<Outcome> {
    if let Some(output) = &args.output {
        expect_ending(output, &["svg"])?;
        args.force.check(output, Output::SVG)?;
    }
    let diagram = diagram(&args.graph)?;
    match &args.output {
        None => {
            let colour =
                std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|set| set.is_empty());
            let width = tables::width();
            print!("{}", realo_diagram::text(&diagram, Terminal { width, colour }));
        }
        Some(output) => {
            let picture = realo_diagram::svg(&diagram);
            write_whole(output, &picture)?;
            println!(
                "{}: {}, {:.0} KB",
                output.display(),
                diagram.title,
                (picture.len() as f64 / 1000.0).ceil()
            );
        }
    }
    Ok(Outcome::Complete)
}

/// The picture of a graph, or of a run where the path is a folder or one of a run's files.
///
/// # Errors
/// A graph or run that cannot be read; a run that does not say its graph.
pub fn diagram(path: &Path) -> Result<Diagram> {
    let folder = run_folder(path);
    if folder.is_dir() {
        return measured::of_run(&folder);
    }
    let file = find::graph(path)?;
    let graph = FlatGraph::load(&file)?;
    of_graph(&graph)
}

/// The picture of a run's graph as an SVG document; `None` where the run does not say its graph.
pub fn picture(folder: &Path, run: &Run) -> Option<String> {
    measured::of(run, folder)
        .ok()
        .map(|diagram| realo_diagram::svg(&diagram))
}

fn of_graph(graph: &FlatGraph) -> Result<Diagram> {
    let name = graph
        .file
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    let mut diagram = stages::diagram(graph)?;
    diagram.title = stages::title(&name, &diagram);
    Ok(diagram)
}
