//! `realo render`: a frame of a run from above.

use std::path::PathBuf;

use eyre::Result;
use realo_render::{Format, Request, Scene};

use crate::{Outcome, demo};

/// Draws a frame of a run from above: truth, boxes, each agent's points, and what only cooperation saw
#[derive(clap::Args)]
pub struct Args {
    /// A folder that `realo run` wrote
    run: PathBuf,
    /// Number of the ego's sweep [default: the scored one where cooperation added most]
    #[arg(long)]
    frame: Option<u64>,
    /// The ego [default: any]
    #[arg(long)]
    ego: Option<String>,
    /// The log that was played [default: found by its name]
    #[arg(long)]
    log: Option<PathBuf>,
    /// The picture to write: .svg or .png
    #[arg(short = 'o', long = "output")]
    output: PathBuf,
}

/// Writes the picture and says what it shows.
pub fn main(args: &Args) -> Result<Outcome> {
    Format::of(&args.output)?;
    let chosen = realo_render::choose(&Request {
        run: args.run.clone(),
        frame: args.frame,
        ego: args.ego.clone(),
        log: args.log.clone(),
        log_folders: log_folders(),
    })?;
    let scene = Scene::of(chosen)?;
    realo_render::write(&args.output, &realo_render::draw(&scene))?;
    let judged = &scene.judged;
    let (hits, wrong, missed, added) = (judged.hits(), judged.wrong(), judged.missed(), judged.added());
    println!(
        "{}: {}, {}, sweep {}: {hits} true, {wrong} false, {missed} missed; {added} only by cooperation",
        args.output.display(),
        scene.graph,
        scene.log,
        scene.seq,
    );
    Ok(Outcome::Complete)
}

/// Where logs usually are: here, and where the demo log is made.
fn log_folders() -> Vec<PathBuf> {
    let demo = PathBuf::from("target").join(demo::FILE);
    let folder = demo.parent().map(PathBuf::from).unwrap_or_default();
    vec![PathBuf::new(), folder]
}
