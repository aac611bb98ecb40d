use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use eyre::{Result, eyre};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_cli::Progress;
use realo_registration::{MapBuilder, MapSettings, PosedSweep, Registrar, RegistrarSettings, Search, VoxelMap};
use realo_schemas::geometry::{Motion, PoseTrack, transform_cloud};
use realo_schemas::{Nanos, PointCloud};
use realo_simulator::{Options, Simulation};
use serde::Serialize;
use serde_json::json;

use super::detector::spread;
use super::peer::{Peer, PeerTimes};

const ROUNDS: usize = 30;
/// Sweeps that the map is made of, and sweeps between them that are aligned with it.
const IN_MAP: [u64; 20] = [
    0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30, 32, 34, 36, 38,
];
const ALIGNED: [u64; 3] = [11, 19, 27];
/// One in so many points of the map's sweeps goes to the other program, which samples them itself.
const THINNED: usize = 8;
/// How far off guesses are, m and rad.
const SHIFT: [f64; 3] = [0.25, -0.2, 0.05];
const TURN: f64 = 0.01;
/// Points nearer than that are on the vehicle itself, m.
const NEAR: f64 = 3.0;
const GOAL: f64 = 0.25;

/// Simulated sweeps of 128 beams on a map of others, one thread.
#[derive(Serialize)]
pub struct Registration {
    /// Points of a sweep, on average.
    points: usize,
    voxels: usize,
    map_bytes: usize,
    cases: Vec<Case>,
}

#[derive(Serialize)]
struct Case {
    /// Side of the cells by which sweeps are sampled, m.
    sample_m: f64,
    minimum_ms: f64,
    median_ms: f64,
    /// Largest error of the three poses, mm and degrees.
    error_mm: f64,
    error_deg: f64,
    /// Most iterations.
    iterations: u32,
    peer: Option<PeerTimes>,
}

/// A sweep at its stamp, and where it was taken.
struct Taken {
    stamp: Nanos,
    cloud: PointCloud,
    map_from_body: Isometry3<f64>,
    sensor: [f64; 3],
}

/// Times the way from points to a pose; with an interpreter also small_gicp's.
pub fn bench(python: Option<&Path>, progress: &Progress) -> Result<Registration> {
    let in_map = sweeps(&IN_MAP)?;
    let aligned = sweeps(&ALIGNED)?;
    let settings = MapSettings {
        range_m: [NEAR, 80.0],
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, "map")?;
    for sweep in &in_map {
        builder.add(&PosedSweep {
            agent: "cav1",
            stamp: sweep.stamp,
            cloud: &sweep.cloud,
            map_from_body: &sweep.map_from_body,
            sensor: sweep.sensor,
            sigmas: [0.0; 3],
        })?;
    }
    let map = builder.finish(|_, _| ())?;
    progress.count("rounds", 2.0 * ROUNDS as f64);
    let files = python.map(|python| files(python, &in_map, &aligned)).transpose()?;
    let cases = [1.0, 0.5].map(|sample_m| case(sample_m, &map, &aligned, files.as_ref(), progress));
    Ok(Registration {
        points: aligned.iter().map(|sweep| sweep.cloud.len()).sum::<usize>() / aligned.len(),
        voxels: map.len(),
        map_bytes: map.as_bytes().len(),
        cases: cases.into_iter().collect::<Result<_>>()?,
    })
}

/// Sweeps of a vehicle without its motion.
fn sweeps(numbers: &[u64]) -> Result<Vec<Taken>> {
    let simulation = Simulation::new(&Options {
        seed: 901,
        seconds: 4.0,
        agents: vec!["cav1".into()],
        ..Options::default()
    })?;
    let mut track = PoseTrack::new(Nanos::MAX, 100_000_000);
    for pose in simulation.poses("cav1").ok_or_else(|| eyre!("no poses of cav1"))? {
        track.insert(pose.stamp, pose.truth.map_from_body);
    }
    let agent = simulation.agents().next().ok_or_else(|| eyre!("no agent"))?;
    let sensor = [0.0, 0.0, agent.sensor_height];
    let taken = |number: &u64| {
        let (sweep, _) = simulation.sweep(0, *number);
        let [first, last] = [sweep.cloud.time.iter().min(), sweep.cloud.time.iter().max()]
            .map(|time| time.map_or(0, |time| Nanos::from(*time)));
        let unknown = || eyre!("no pose at {}", sweep.stamp);
        let motion = Motion::new(&track, sweep.stamp, first, last).ok_or_else(unknown)?;
        let cloud = &sweep.cloud;
        let [x, y, z] = motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time);
        let cloud = PointCloud {
            x: x.into(),
            y: y.into(),
            z: z.into(),
            ..cloud.clone()
        };
        Ok(Taken {
            stamp: sweep.stamp,
            cloud,
            map_from_body: track.at(sweep.stamp).ok_or_else(unknown)?,
            sensor,
        })
    };
    numbers.iter().map(taken).collect()
}

/// What the other program reads.
struct Files<'a> {
    python: &'a Path,
    target: PathBuf,
    /// Points, true pose and guess of each sweep, relative to the first pose on the map.
    sources: Vec<(PathBuf, Isometry3<f64>, Isometry3<f64>)>,
}

/// Writes points as 32-bit floats, of the map and of sweeps, in a frame of whose origin all of them are near.
fn files<'a>(python: &'a Path, in_map: &[Taken], aligned: &[Taken]) -> Result<Files<'a>> {
    let folder = super::framework::folder()?;
    let local_from_map = in_map[0].map_from_body.inverse();
    let target = folder.join("map.f32");
    let mut bytes = Vec::new();
    for sweep in in_map {
        let moved = transform_cloud(&(local_from_map * sweep.map_from_body), &sweep.cloud);
        bytes.extend(far_points(&sweep.cloud, &moved, THINNED));
    }
    fs::write(&target, bytes)?;
    let mut sources = Vec::new();
    for (number, sweep) in aligned.iter().enumerate() {
        let file = folder.join(format!("sweep{number}.f32"));
        fs::write(&file, far_points(&sweep.cloud, &sweep.cloud, 1).collect::<Vec<u8>>())?;
        let truth = local_from_map * sweep.map_from_body;
        sources.push((file, truth, local_from_map * guess(&sweep.map_from_body)));
    }
    Ok(Files {
        python,
        target,
        sources,
    })
}

/// The bytes of every so many points that are not on the vehicle itself.
fn far_points<'a>(cloud: &'a PointCloud, moved: &'a PointCloud, every: usize) -> impl Iterator<Item = u8> + 'a {
    let near = (NEAR * NEAR) as f32;
    let is_far =
        move |i: &usize| cloud.x[*i] * cloud.x[*i] + cloud.y[*i] * cloud.y[*i] + cloud.z[*i] * cloud.z[*i] > near;
    let points = (0..cloud.len()).step_by(every).filter(is_far);
    points
        .flat_map(|i| [moved.x[i], moved.y[i], moved.z[i]])
        .flat_map(f32::to_le_bytes)
}

/// A pose that is off as a prediction may be.
fn guess(truth: &Isometry3<f64>) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * TURN);
    Isometry3::from_parts(
        Translation3::from(truth.translation.vector + Vector3::from(SHIFT)),
        turn * truth.rotation,
    )
}

fn rows(pose: &Isometry3<f64>) -> Vec<Vec<f64>> {
    let matrix = pose.to_homogeneous();
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

fn case(sample_m: f64, map: &VoxelMap, aligned: &[Taken], files: Option<&Files>, progress: &Progress) -> Result<Case> {
    let mut registrar = Registrar::new(RegistrarSettings {
        sample_m,
        range_m: [NEAR, 100.0],
        ..RegistrarSettings::default()
    })?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    // Timed within the pool: what it costs to get there is not the registrar's.
    let mut align = |sweep: &Taken| {
        pool.install(|| {
            let start = Instant::now();
            let found = registrar.align(map, &sweep.cloud, &guess(&sweep.map_from_body), Search::Track);
            found.map(|found| (found, start.elapsed().as_secs_f64()))
        })
    };
    let (mut error_mm, mut error_deg, mut iterations) = (0f64, 0f64, 0);
    for sweep in aligned {
        let (found, _) = align(sweep)?;
        let off = found.map_from_body.translation.vector - sweep.map_from_body.translation.vector;
        let turn = found.map_from_body.rotation.angle_to(&sweep.map_from_body.rotation);
        error_mm = error_mm.max(off.norm() * 1e3);
        error_deg = error_deg.max(turn.to_degrees());
        iterations = iterations.max(found.iterations);
    }
    let mut peer = files.map(|files| peer(sample_m, files)).transpose()?;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for round in 0..ROUNDS {
        let (found, seconds) = align(&aligned[round % aligned.len()])?;
        std::hint::black_box(found);
        ours.push(seconds);
        if let Some(peer) = &mut peer {
            theirs.push(peer.run()?);
        }
        progress.add(1.0);
    }
    let (minimum, median) = spread(&ours);
    Ok(Case {
        sample_m,
        minimum_ms: minimum * 1e3,
        median_ms: median * 1e3,
        error_mm,
        error_deg,
        iterations,
        peer: peer.map(|peer| PeerTimes::of(peer.name.clone(), &ours, &theirs, GOAL)),
    })
}

fn peer(sample_m: f64, files: &Files) -> Result<Peer> {
    let sources = files
        .sources
        .iter()
        .map(|(file, truth, guess)| json!({ "points": file, "truth": rows(truth), "guess": rows(guess) }));
    let reported = json!({
        "target": files.target,
        "target_m": 0.5,
        "sample_m": sample_m,
        "sources": sources.collect::<Vec<_>>(),
    });
    Peer::start(files.python, "registration", &reported)
}

impl fmt::Display for Registration {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "sweeps of {} points on a map of {} voxels ({} bytes), 1 thread, ms",
            self.points, self.voxels, self.map_bytes
        )?;
        for case in &self.cases {
            write!(
                f,
                "\nsampled by {} m: min {:.2}, median {:.2}; at most {:.1} mm and {:.3}° off, {} iterations",
                case.sample_m, case.minimum_ms, case.median_ms, case.error_mm, case.error_deg, case.iterations
            )?;
            match &case.peer {
                Some(peer) => write!(
                    f,
                    "\n  {}: min {:.2}, median {:.2}; ours is {:.3} of it (minima), {:.3} (paired; goal {})",
                    peer.name, peer.minimum_ms, peer.median_ms, peer.minimum_ratio, peer.paired_ratio, peer.goal
                )?,
                None => write!(
                    f,
                    "\n  add --python PYTHON, one with numpy and small_gicp, to compare it"
                )?,
            }
        }
        Ok(())
    }
}
