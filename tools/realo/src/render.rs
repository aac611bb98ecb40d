//! `realo render`: a frame of a run from above.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use eyre::{Result, bail};
use realo_cli::{Force, Outcome, Output, Progress};
use realo_registration::{MAGIC, VoxelMap};
use realo_render::{Format, Request, Scene, Town};

use crate::compare::names;
use crate::demo;

/// Draws a frame of a run from above: truth, boxes, each agent's points, and what only cooperation saw. Of several runs it
/// draws the same frame side by side; of a map of `realo map build` what stands where
#[derive(clap::Args)]
pub struct Args {
    /// Folders that `realo run` wrote: of a graph, or of a log and an ego in it; or a map
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// Number of the ego's sweep [default: the scored one where cooperation added most]
    #[arg(long)]
    frame: Option<u64>,
    /// The ego [default: the first by name that all runs have]
    #[arg(long)]
    ego: Option<String>,
    /// The log that was played [default: where the run says that it was, else by its name here or in target/realo]
    #[arg(long)]
    log: Option<PathBuf>,
    /// The picture to write: .svg or .png
    #[arg(short = 'o', long = "output")]
    output: PathBuf,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    force: Force,
}

/// Writes the picture and says what it shows.
pub fn main(args: &Args) -> Result<Outcome> {
    let kind = match Format::of(&args.output)? {
        Format::Svg => Output::SVG,
        Format::Png => Output::PNG,
    };
    args.force.check(&args.output, kind)?;
    if let Some(map) = args.runs.iter().find(|path| is_map(path)) {
        return town(args, map);
    }
    let request = Request {
        run: PathBuf::new(),
        frame: args.frame,
        ego: args.ego.clone(),
        log: args.log.clone(),
        log_folders: log_folders(),
    };
    let progress = Progress::new("rendering", "sweeps", Some(0.0));
    let chosen = realo_render::choose_all(&args.runs, &request, &|folder, done, all| {
        // Each folder has its own pace.
        if done <= 1 {
            progress.rename(format!("choosing a sweep of {}", folder.display()), "sweeps");
            progress.begin(0.0, all as f64);
        }
        progress.of(done as f64, all as f64);
    })?;
    progress.rename("drawing", "runs");
    progress.count("runs", chosen.len() as f64);
    let mut scenes: Vec<Scene> = chosen
        .into_iter()
        .map(|chosen| Scene::of(chosen).inspect(|_| progress.add(1.0)))
        .collect::<Result<_, _>>()?;
    tell_apart(&mut scenes, &names(&args.runs));
    let drawings = scenes.iter().map(realo_render::draw).collect();
    realo_render::write(&args.output, &realo_render::beside(drawings))?;
    progress.finish();
    for scene in &scenes {
        for line in &scene.left_out {
            eprintln!("realo: {}, sweep {}: {line}", scene.log, scene.seq);
        }
        println!("{}: {}", args.output.display(), in_words(scene));
    }
    Ok(Outcome::Complete)
}

fn is_map(path: &Path) -> bool {
    let mut head = [0; MAGIC.len()];
    let opened = File::open(path).and_then(|mut file| file.read_exact(&mut head));
    opened.is_ok() && head == *MAGIC
}

/// Writes the picture of a map.
fn town(args: &Args, path: &Path) -> Result<Outcome> {
    let is_chosen = args.frame.is_some() || args.ego.is_some() || args.log.is_some();
    if args.runs.len() > 1 || is_chosen {
        bail!(
            "{}: a map is drawn alone, and has no frame, ego or log: give the map and --output, and draw runs by another call",
            path.display()
        );
    }
    let map = VoxelMap::open(path)?;
    let info = map.info();
    let mut town = Town {
        title: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        about: format!(
            "{} voxels of {} m of what stands still, frame {}, x to the right",
            map.len(),
            info.voxel_m,
            info.frame
        ),
        cell_m: info.voxel_m,
        ..Town::default()
    };
    for voxel in map.voxels() {
        town.add([voxel.cell[0], voxel.cell[1]], voxel.mean.z);
    }
    realo_render::write(&args.output, &town.draw())?;
    println!("{}: {}, {}", args.output.display(), town.title, town.about);
    Ok(Outcome::Complete)
}

/// Runs of one graph are titled by their folders.
fn tell_apart(scenes: &mut [Scene], names: &[String]) {
    let graphs: BTreeSet<&String> = scenes.iter().map(|scene| &scene.graph).collect();
    if graphs.len() < scenes.len() {
        for (scene, name) in scenes.iter_mut().zip(names) {
            scene.graph.clone_from(name);
        }
    }
}

fn in_words(scene: &Scene) -> String {
    let (graph, log, seq, judged) = (&scene.graph, &scene.log, scene.seq, &scene.judged);
    let frame = format!("{graph}, {log}, sweep {seq}");
    if !scene.has_truth {
        return format!("{frame}: {} detected", judged.detected.len());
    }
    let (hits, wrong, missed) = (judged.hits(), judged.wrong(), judged.missed());
    let gain = match judged.knows_gain() {
        true => format!("; {} only by cooperation", judged.added()),
        false => String::new(),
    };
    format!("{frame}: {hits} true, {wrong} false, {missed} missed{gain}")
}

/// Where logs usually are: here, and where the demo log is made.
pub(crate) fn log_folders() -> Vec<PathBuf> {
    let demo = PathBuf::from("target").join(demo::FILE);
    let folder = demo.parent().map(PathBuf::from).unwrap_or_default();
    vec![PathBuf::new(), folder]
}
