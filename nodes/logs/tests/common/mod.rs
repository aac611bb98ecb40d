//! A small log with everything in it.

use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use realo_logs::{AgentInfo, AgentKind, LogError, LogInfo, LogWriter};
use realo_schemas::{AgentState, Box3, Boxes, Nanos, PointCloud, PoseStatus};

pub const START: Nanos = 1_700_000_000_000_000_000;
pub const MS: Nanos = 1_000_000;

pub fn info() -> LogInfo {
    let agent = |name: &str, kind| AgentInfo {
        name: name.into(),
        kind,
        footprint: Some([-1.0, 3.5, -0.9, 0.9]),
        sensor: "64 beams".into(),
        sensor_position: Some([0.0, 0.0, 1.8]),
    };
    let mut info = LogInfo::new(
        "a test",
        vec![agent("cav1", AgentKind::Vehicle), agent("rsu1", AgentKind::Roadside)],
    );
    (info.start, info.end) = (Some(START), Some(START + 3000 * MS));
    info
}

/// Noise that does not compress, so that chunks have their real size.
pub fn cloud(points: usize, seed: u32) -> PointCloud {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(1);
    let mut draw = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state
    };
    let mut column = |scale: f32| {
        (0..points)
            .map(|_| (draw() as f32 / u32::MAX as f32 - 0.5) * scale)
            .collect::<Vec<_>>()
    };
    let (x, y, z) = (column(200.0), column(80.0), column(5.0));
    let time: Vec<i32> = (0..points).map(|i| i as i32 * 100 - 50_000_000).collect();
    let ring: Vec<u16> = (0..points).map(|i| (i % 64) as u16).collect();
    let intensity: Vec<u8> = (0..points).map(|i| (i % 251) as u8).collect();
    PointCloud::new(x, y, z, intensity, time, ring).unwrap()
}

pub fn state(seconds: f64, status: PoseStatus) -> AgentState {
    let rotation = UnitQuaternion::from_euler_angles(0.001, -0.002, 0.3 * seconds);
    let pose = Isometry3::from_parts(Translation3::new(1e5 + 10.0 * seconds, -2.0, 0.3), rotation);
    AgentState {
        map_from_body: pose,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status,
    }
}

pub fn objects(n: usize) -> Vec<Box3> {
    let object = |i: usize| Box3 {
        center: [10.0 + i as f64 / 3.0, -4.0, 0.8],
        length: 4.5,
        width: 1.9,
        height: 1.6,
        yaw: 0.1 * i as f64,
        velocity: Some([i as f64 / 7.0, 0.0, 0.0]),
        class: "car".into(),
        score: 1.0,
        track: Some(100 + i as u64),
        covariance: None,
    };
    (0..n).map(object).collect()
}

pub const SWEEPS: usize = 30;
pub const POINTS: usize = 20_000;

/// Three seconds of two agents: poses at 100 Hz, sweeps at 10 Hz.
pub fn fill(writer: &mut LogWriter) -> Result<(), LogError> {
    for tick in 0..SWEEPS * 10 {
        let stamp = START + tick as Nanos * 10 * MS;
        let seconds = tick as f64 * 0.01;
        for agent in ["cav1", "rsu1"] {
            writer.pose(agent, stamp, stamp + MS, &state(seconds + 0.001, PoseStatus::Recorded))?;
            writer.pose_truth(agent, stamp, stamp + MS, &state(seconds, PoseStatus::Truth))?;
            if tick % 10 == 5 {
                let sweep = tick / 10;
                let ready = stamp + 50 * MS;
                writer.cloud(agent, stamp, ready, &cloud(POINTS, sweep as u32))?;
                writer.detections(agent, stamp, ready, &Boxes(objects(sweep % 4)))?;
                let points: Vec<u32> = (0..sweep as u32 % 5).collect();
                writer.truth(
                    agent,
                    stamp,
                    ready,
                    &objects(points.len()),
                    Some(&points),
                    sweep % 2 == 0,
                )?;
            }
        }
    }
    Ok(())
}

pub fn make(path: &Path) {
    let mut writer = LogWriter::create(path, &info()).unwrap();
    fill(&mut writer).unwrap();
    writer.finish().unwrap();
}
