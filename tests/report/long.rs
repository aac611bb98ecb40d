//! A run of half an hour: its page stays within its bounds, and says what it left out.

use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::{AgentState, Box3, Boxes, Nanos, PointCloud, PoseStatus};

use super::common::{REALO, folder, once, root, run_virtual, text};
use super::document;

const SECONDS: u64 = 1800;
const SWEEPS: u64 = 10 * SECONDS;
const TENTH: Nanos = 100_000_000;
const START: Nanos = 1_700_000_000_000_000_000;
/// Agents with the radius of the circle on which they drive, m.
const AGENTS: [(&str, f64); 2] = [("cav1", 60.0), ("rsu1", 0.0)];
const OBJECTS: u64 = 16;
const POINTS: usize = 40;
/// Memory that the program may take, KiB, its threads' and what it only reserves included.
const MOST_KIB: u64 = 2 << 20;

/// Where an agent is at a sweep.
fn map_from_agent(radius: f64, sweep: u64) -> Isometry3<f64> {
    // Once around in two minutes.
    let angle = sweep as f64 / 1200.0 * std::f64::consts::TAU;
    let (place, heading) = match radius > 0.0 {
        true => ([radius * angle.cos(), radius * angle.sin()], angle + 1.57),
        false => ([0.0; 2], 0.0),
    };
    Isometry3::from_parts(
        Translation3::new(place[0], place[1], 0.0),
        UnitQuaternion::from_euler_angles(0.0, 0.0, heading),
    )
}

/// The objects around an agent: cars that are parked along the circle.
fn objects(map_from_agent: &Isometry3<f64>) -> Vec<Box3> {
    let (_, _, heading) = map_from_agent.rotation.euler_angles();
    let car = |number: u64| {
        let angle = number as f64 / OBJECTS as f64 * std::f64::consts::TAU;
        let at = nalgebra::Point3::new(70.0 * angle.cos(), 70.0 * angle.sin(), 0.8);
        let at = map_from_agent.inverse_transform_point(&at);
        Box3 {
            track: Some(number),
            ..Box3::new("Car", at.coords.into(), [4.0, 2.0, 1.6], angle - heading)
        }
    };
    (0..OBJECTS).map(car).collect()
}

fn cloud(sweep: u64) -> PointCloud {
    let number = |step: usize| (0..POINTS).map(move |at| ((at * step + sweep as usize * 7) % 997) as f32 * 0.06 - 30.0);
    let z = (0..POINTS).map(|at| at as f32 * 0.01).collect::<Vec<f32>>();
    let columns = (number(13).collect::<Vec<f32>>(), number(29).collect::<Vec<f32>>());
    PointCloud::new(
        columns.0,
        columns.1,
        z,
        vec![9u8; POINTS],
        vec![0i32; POINTS],
        vec![0u16; POINTS],
    )
    .expect("columns of one length")
}

fn write(path: &Path) {
    let agents = AGENTS.map(|(name, radius)| AgentInfo {
        name: name.into(),
        kind: if radius > 0.0 {
            AgentKind::Vehicle
        } else {
            AgentKind::Roadside
        },
        footprint: (radius > 0.0).then_some([-1.0, 3.5, -0.9, 0.9]),
        sensor: String::new(),
        sensor_position: None,
    });
    let mut log =
        LogWriter::create_atomic(path, &LogInfo::new("half an hour", agents.to_vec())).expect("the log can be made");
    for sweep in 0..SWEEPS {
        let now = START + sweep as Nanos * TENTH;
        let ready = now + TENTH / 2;
        for (at, (agent, radius)) in AGENTS.into_iter().enumerate() {
            let pose = map_from_agent(radius, sweep);
            let state = AgentState {
                map_from_body: pose,
                covariance: None,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Recorded,
            };
            let objects = objects(&pose);
            // Each agent sees every second object.
            let sees = |object: &Box3| object.track.is_some_and(|track| track % 2 == at as u64);
            let points: Vec<u32> = objects.iter().map(|object| if sees(object) { 40 } else { 0 }).collect();
            let seen = objects.iter().filter(|object| sees(object)).cloned().collect();
            log.pose(agent, now, ready, &state).expect("it can be written");
            log.cloud(agent, now, ready, &cloud(sweep)).expect("it can be written");
            log.truth(agent, now, ready, &objects, Some(&points), sweep % 10 == 0)
                .expect("it can be written");
            log.detections(agent, now, ready, &Boxes(seen))
                .expect("it can be written");
        }
    }
    log.finish().expect("it can be written");
}

fn log() -> PathBuf {
    once("half_an_hour.mcap", write)
}

/// Writes the page in bounded memory, and gives what was said.
fn report(run: &Path, page: &Path, more: &[&str]) -> String {
    let said = Command::new("sh")
        .args([
            "-c",
            &format!("ulimit -v {MOST_KIB}; exec \"$0\" \"$@\""),
            REALO,
            "report",
        ])
        .arg(run)
        .arg("-o")
        .arg(page)
        .args(more)
        .current_dir(root())
        .env("COLUMNS", "400")
        // Each thread and its arena reserve memory, whatever they use.
        .env("RAYON_NUM_THREADS", "2")
        .env("MALLOC_ARENA_MAX", "2")
        .output()
        .expect("a shell can be started");
    let words = format!("{}{}", text(&said.stdout), text(&said.stderr));
    assert_eq!(said.status.code(), Some(0), "{words}");
    words
}

#[test]
fn a_run_of_half_an_hour_fits_its_page_which_says_what_it_left_out() {
    let log = log();
    let run = once("report_half_an_hour", |_| {
        run_virtual(
            "report_half_an_hour",
            "late_fusion",
            &log,
            &["--recorded-detections", "--link", "delay_ms=60,loss=0.1"],
        );
    });
    let log = log.to_string_lossy();
    for (points, most) in [(false, 5_000_000), (true, 40_000_000)] {
        let page = folder("report_long").join("report.html");
        let options = ["--log", &log, "--points"];
        let said = report(&run, &page, &options[..if points { 3 } else { 2 }]);
        let size = std::fs::metadata(&page).expect("it is there").len();
        assert!(size <= most && size > 2_500_000, "{size} bytes: {said}");
        let document = document(&page);
        let scene = &document["scenes"][0];
        let frames: Vec<u64> = scene["frames"]
            .as_object()
            .expect("sweeps")
            .keys()
            .map(|seq| seq.parse().expect("a number"))
            .collect();
        // Evenly spread, to the end.
        let mut gaps: Vec<u64> = frames.windows(2).map(|pair| pair[1] - pair[0]).collect();
        gaps.dedup();
        assert!(gaps.len() == 1 && gaps[0] <= 16, "{gaps:?}");
        assert!(
            frames.last().is_some_and(|last| last + gaps[0] >= SWEEPS),
            "{:?}",
            frames.last()
        );
        assert_eq!(scene["runs"][0]["recorded"], SWEEPS);
        let sweeps = format!("one sweep of {}, {} of {SWEEPS}", gaps[0], frames.len());
        assert!(said.contains(&sweeps) && said.contains("of 18000 messages"), "{said}");
        assert_eq!(said.matches("the player has").count(), 1, "it is said once: {said}");
        // Points are for the sweeps of the player alone: none of them is thinned.
        if points {
            let count = AGENTS.len() * frames.len() * POINTS;
            assert!(
                said.contains(&format!("{count} points")) && !said.contains("thinned"),
                "{said}"
            );
        }
        // All bytes that were sent, second by second.
        let carried = scene["runs"][0]["carried"].as_array().expect("rows");
        assert!(carried.len() as u64 >= SECONDS - 2, "{} seconds", carried.len());
    }
}
