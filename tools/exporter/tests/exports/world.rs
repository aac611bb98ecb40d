//! The logs that are exported.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3, Vector3};
use realo_logs::{AgentInfo, AgentKind, LogInfo, LogWriter};
use realo_schemas::{AgentState, Box3, Nanos, PointCloud, PoseStatus};
use realo_simulator::{Options, write_log};

/// Agents of a simulated log.
pub const AGENTS: [&str; 3] = ["cav1", "cav2", "rsu1"];
/// Its sweeps of each agent.
pub const SWEEPS: usize = 3;

/// Two vehicles and a roadside unit, three sweeps.
pub fn simulated(dir: &Path) -> PathBuf {
    let log = dir.join("simulated.mcap");
    let options = Options {
        seed: 11,
        seconds: 0.3,
        agents: AGENTS.map(String::from).to_vec(),
        column_stride: 8,
        map_offset_m: [1234.5, -678.25],
        ..Options::default()
    };
    write_log(&options, &log, |_| {}).unwrap();
    log
}

/// When made-up logs begin.
pub const START: Nanos = 1_767_225_600_000_000_000;
const PERIOD: Nanos = 100_000_000;

/// What a made-up log has.
pub struct MadeUp {
    pub clouds: bool,
    pub truth: bool,
    pub tilt_rad: f64,
    pub object: Box3,
}

impl Default for MadeUp {
    fn default() -> Self {
        MadeUp {
            clouds: true,
            truth: true,
            tilt_rad: 0.0,
            object: Box3::new("Car", [12.0, 3.0, 0.8], [4.2, 1.8, 1.6], 0.4),
        }
    }
}

impl MadeUp {
    /// Writes a log of one vehicle that drives ahead, two sweeps.
    pub fn write(&self, dir: &Path) -> PathBuf {
        let path = dir.join("made_up.mcap");
        let mut log = LogWriter::create(&path, &LogInfo::new("a test", vec![car()])).unwrap();
        let (x, y, z) = (
            vec![10.0_f32, 11.5, -3.25],
            vec![2.0_f32, 2.5, 8.125],
            vec![0.1_f32, 1.2, 0.01],
        );
        let cloud = PointCloud::new(x, y, z, vec![0_u8, 100, 255], vec![0_i32; 3], vec![0_u16; 3]).unwrap();
        for sweep in 0..2 {
            let stamp = START + sweep * PERIOD;
            let ready = stamp + PERIOD;
            let place = Vector3::new(sweep as f64, 0.0, 0.0);
            let state = recorded(Isometry3::new(place, Vector3::new(0.0, self.tilt_rad, 0.0)));
            log.pose("car", stamp, stamp, &state).unwrap();
            match self.clouds {
                true => log.cloud("car", stamp, ready, &cloud).unwrap(),
                false => log.sweep("car", stamp, ready).unwrap(),
            }
            if self.truth {
                log.truth("car", stamp, ready, std::slice::from_ref(&self.object), None, true)
                    .unwrap();
            }
        }
        log.finish().unwrap();
        path
    }
}

/// The vehicle of made-up logs.
fn car() -> AgentInfo {
    AgentInfo {
        name: "car".into(),
        kind: AgentKind::Vehicle,
        footprint: Some([-1.0, 3.5, -0.9, 0.9]),
        sensor: String::new(),
        sensor_position: None,
    }
}

/// A pose as a log has it.
pub fn recorded(map_from_body: Isometry3<f64>) -> AgentState {
    AgentState {
        map_from_body,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    }
}

/// Sweeps of the log of a vehicle that moves during them.
pub const MOVING_SWEEPS: usize = 3;
/// The sweep of it that is not scored.
pub const UNSCORED: usize = 1;
/// Points on each of its two objects: as recorded, not as a count of the cloud's points would have them.
pub const POINTS: [u32; 2] = [7, 3];
/// A point on the vehicle itself, in its body frame.
pub const ON_ITSELF: [f32; 3] = [2.0, 0.25, 1.0];

/// Where the vehicle is: 20 m/s ahead, and it turns.
pub fn moving(stamp: Nanos) -> Isometry3<f64> {
    let seconds = (stamp - START) as f64 / 1e9;
    Isometry3::new(
        Vector3::new(20.0 * seconds, 3.0, 0.0),
        Vector3::new(0.0, 0.0, 0.5 * seconds),
    )
}

/// Points that stand still, in the map, each with the time in its sweep at which it is measured, ns.
pub fn standing() -> [(Point3<f64>, i32); 4] {
    [
        ([30.0, 8.0, 0.5], 0),
        ([12.0, -9.0, 2.0], 33_000_000),
        ([-15.0, 6.0, 1.0], 61_500_000),
        ([40.0, 1.0, 1.5], 99_000_000),
    ]
    .map(|(place, time)| (place.into(), time))
}

/// Writes the log of a vehicle that moves during its sweeps, with a sweep that is not scored.
pub fn write_moving(dir: &Path) -> PathBuf {
    let path = dir.join("moving.mcap");
    let mut log = LogWriter::create(&path, &LogInfo::new("a test", vec![car()])).unwrap();
    let objects = [[20.0, 3.0, 0.8], [-14.0, -5.0, 0.9]].map(|center| Box3::new("Car", center, [4.2, 1.8, 1.6], 0.4));
    for step in 0..=10 * MOVING_SWEEPS as i64 {
        let stamp = START + step * PERIOD / 10;
        log.pose("car", stamp, stamp, &recorded(moving(stamp))).unwrap();
    }
    for sweep in 0..MOVING_SWEEPS {
        let stamp = START + sweep as i64 * PERIOD;
        let measured = standing().map(|(place, time)| moving(stamp + i64::from(time)).inverse() * place);
        let points = measured
            .iter()
            .map(|point| [point.x as f32, point.y as f32, point.z as f32]);
        let points: Vec<[f32; 3]> = points.chain([ON_ITSELF]).collect();
        let axis = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let times: Vec<i32> = standing().iter().map(|(_, time)| *time).chain([70_000_000]).collect();
        let cloud = PointCloud::new(axis(0), axis(1), axis(2), vec![51_u8; 5], times, vec![0_u16; 5]).unwrap();
        log.cloud("car", stamp, stamp + PERIOD, &cloud).unwrap();
        let is_scored = sweep != UNSCORED;
        log.truth("car", stamp, stamp + PERIOD, &objects, Some(&POINTS), is_scored)
            .unwrap();
    }
    log.finish().unwrap();
    path
}
