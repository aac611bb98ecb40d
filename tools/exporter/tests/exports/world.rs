//! The logs that are exported.

use std::path::{Path, PathBuf};

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
        let agent = AgentInfo {
            name: "car".into(),
            kind: AgentKind::Vehicle,
            footprint: Some([-1.0, 3.5, -0.9, 0.9]),
            sensor: String::new(),
            sensor_position: None,
        };
        let mut log = LogWriter::create(&path, &LogInfo::new("a test", vec![agent])).unwrap();
        let (x, y, z) = (
            vec![10.0_f32, 11.5, -3.25],
            vec![2.0_f32, 2.5, 8.125],
            vec![0.1_f32, 1.2, 0.01],
        );
        let cloud = PointCloud::new(x, y, z, vec![0_u8, 100, 255], vec![0_i32; 3], vec![0_u16; 3]).unwrap();
        for sweep in 0..2 {
            let stamp = START + sweep * PERIOD;
            let ready = stamp + PERIOD;
            let state = AgentState {
                map_from_body: nalgebra::Isometry3::new(
                    nalgebra::Vector3::new(sweep as f64, 0.0, 0.0),
                    nalgebra::Vector3::new(0.0, self.tilt_rad, 0.0),
                ),
                covariance: None,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Recorded,
            };
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
