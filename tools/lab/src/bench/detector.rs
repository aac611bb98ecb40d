use std::fmt;
use std::fs;
use std::path::Path;
use std::time::Instant;

use eyre::{Result, eyre};
use realo_cli::Progress;
use realo_kernels::canvas::Canvas;
use realo_methods::Kernels;
use realo_methods::Model;
use realo_methods::detect::pillar_net::PillarNet;
use realo_methods::detect::pillars::{Pillariser, Points};
use realo_schemas::PointCloud;
use realo_simulator::{Options, Simulation};
use serde::Serialize;
use serde_json::json;

use super::peer::{Peer, PeerTimes};

pub(super) const MODEL: &str = "models/lite.toml";
const POINTS: usize = 100_000;
const PILLARS: usize = 10_000;
const ROUNDS: usize = 41;
/// Our pillar step as a share of spconv's, at most.
const GOAL: f64 = 0.7;

/// From points to the canvas, with the detector that ships.
#[derive(Serialize)]
pub struct Detector {
    /// Pillars that the cloud falls into.
    pillars: usize,
    steps: Vec<Step>,
    peer: Option<PeerTimes>,
}

#[derive(Serialize)]
struct Step {
    name: String,
    minimum_ms: f64,
    median_ms: f64,
    goal_ms: Option<f64>,
}

/// Times the pillar step and the pillar net; with an interpreter also spconv's pillar step.
pub fn bench(python: Option<&Path>, progress: &Progress) -> Result<Detector> {
    let model = Model::read(Path::new(MODEL))?;
    let cloud = cloud()?;
    let points = points(&cloud);
    let mut pillariser = Pillariser::new(&model.grid, model.pillars.points, model.pillars.pillars);
    let mut steps = Vec::new();

    let mut peer = python.map(|python| peer(python, &model, &cloud)).transpose()?;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    progress.count("rounds", 2.0 * ROUNDS as f64);
    for _ in 0..ROUNDS {
        ours.push(time(|| {
            std::hint::black_box(pillariser.run(&points));
        }));
        if let Some(peer) = &mut peer {
            theirs.push(peer.run()?);
        }
        progress.add(1.0);
    }
    steps.push(step("pillar step, 100,000 points, 1 thread", &ours, None));
    let peer = peer.map(|peer| PeerTimes::of(peer.name.clone(), &ours, &theirs, GOAL));
    let pillars = pillariser.run(&points).clone();

    let loaded = realo_methods::load(Path::new(MODEL), Kernels::auto(1))?;
    let net = PillarNet::of(&loaded.model, &loaded.weights);
    let mut canvas = Canvas::new(model.grid.rows(), model.grid.columns(), model.pillars.channels);
    let [x, y, z] = even_cloud(&model);
    let mut even = Pillariser::new(&model.grid, model.pillars.points, model.pillars.pillars);
    let even = even.run(&Points {
        x: &x,
        y: &y,
        z: &z,
        intensity: None,
    });
    let times: Vec<f64> = (0..ROUNDS)
        .map(|_| {
            progress.add(1.0);
            time(|| net.run(even, &mut canvas))
        })
        .collect();
    let name = format!("pillar net, {} pillars, 1 thread", even.len());
    steps.push(step(&name, &times, Some(1.5)));

    Ok(Detector {
        pillars: pillars.len(),
        steps,
        peer,
    })
}

/// Every other point of a simulated sweep, up to 100,000.
pub(super) fn cloud() -> Result<PointCloud> {
    let options = Options {
        seed: 900,
        seconds: 0.1,
        agents: vec!["cav1".into()],
        ..Options::default()
    };
    let simulation = Simulation::new(&options)?;
    let (sweep, _) = simulation.sweep(0, 0);
    let cloud = &sweep.cloud;
    let every = cloud.x.len() / POINTS;
    if every == 0 {
        return Err(eyre!("the simulated sweep has {} points, not {POINTS}", cloud.x.len()));
    }
    let take = |column: &[f32]| column.iter().step_by(every).take(POINTS).copied().collect::<Vec<f32>>();
    let [x, y, z] = [&cloud.x, &cloud.y, &cloud.z].map(|column| take(column));
    PointCloud::new(x, y, z, vec![0; POINTS], vec![0; POINTS], vec![0; POINTS]).ok_or_else(|| eyre!("uneven columns"))
}

pub fn points(cloud: &PointCloud) -> Points<'_> {
    Points {
        x: &cloud.x,
        y: &cloud.y,
        z: &cloud.z,
        intensity: None,
    }
}

/// Seven points in each of 10,000 cells.
fn even_cloud(model: &Model) -> [Vec<f32>; 3] {
    let grid = &model.grid;
    let mut columns = [(); 3].map(|()| Vec::new());
    for pillar in 0..PILLARS {
        let cell = pillar * 7919 % (grid.rows() * grid.columns());
        let (row, column) = (cell / grid.columns(), cell % grid.columns());
        for point in 0..7 {
            let off = (point as f64 + 0.5) / 7.0;
            let place = [
                grid.x[0] + (column as f64 + off) * grid.cell,
                grid.y[0] + (row as f64 + 1.0 - off) * grid.cell,
                2.0 * off,
            ];
            columns
                .iter_mut()
                .zip(place)
                .for_each(|(column, value)| column.push(value as f32));
        }
    }
    columns
}

fn peer(python: &Path, model: &Model, cloud: &PointCloud) -> Result<Peer> {
    let folder = super::framework::folder()?;
    let file = folder.join("points.f32");
    let xyz = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
    let bytes = xyz.flat_map(|((x, y), z)| [*x, *y, *z, 0.0]).flat_map(f32::to_le_bytes);
    fs::write(&file, bytes.collect::<Vec<u8>>())?;
    let grid = &model.grid;
    let reported = json!({
        "points": file,
        "size": [grid.cell, grid.cell, grid.z[1] - grid.z[0]],
        "range": [grid.x[0], grid.y[0], grid.z[0], grid.x[1], grid.y[1], grid.z[1]],
        "max_points": model.pillars.points,
        "max_pillars": model.pillars.pillars,
    });
    Peer::start(python, "voxels", &reported)
}

fn time(run: impl FnOnce()) -> f64 {
    let start = Instant::now();
    run();
    start.elapsed().as_secs_f64()
}

fn step(name: &str, seconds: &[f64], goal_ms: Option<f64>) -> Step {
    let (minimum, median) = spread(seconds);
    Step {
        name: name.into(),
        minimum_ms: minimum * 1e3,
        median_ms: median * 1e3,
        goal_ms,
    }
}

/// Smallest and median.
pub fn spread(values: &[f64]) -> (f64, f64) {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    (values[0], values[values.len() / 2])
}

impl fmt::Display for Detector {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "models/lite, {POINTS} points of a simulated sweep in {} pillars, ms",
            self.pillars
        )?;
        for step in &self.steps {
            write!(
                f,
                "{:<60} min {:.2}, median {:.2}",
                step.name, step.minimum_ms, step.median_ms
            )?;
            match step.goal_ms {
                Some(goal) => writeln!(f, " (goal {goal})")?,
                None => writeln!(f)?,
            }
        }
        match &self.peer {
            Some(peer) => write!(
                f,
                "{:<60} min {:.2}, median {:.2}; ours is {:.2} of it (minima), {:.2} (paired; goal {})",
                format!("the same by {}", peer.name),
                peer.minimum_ms,
                peer.median_ms,
                peer.minimum_ratio,
                peer.paired_ratio,
                peer.goal
            ),
            None => write!(
                f,
                "add --python PYTHON, one with numpy and spconv, to compare the pillar step"
            ),
        }
    }
}
