//! Measures how fast clouds are written and read: `cargo run --release -p realo-logs --example throughput`.

use std::time::Instant;

use realo_logs::{AgentInfo, AgentKind, Log, LogError, LogInfo, LogWriter, Stream};
use realo_schemas::{Nanos, PointCloud};

const SWEEPS: usize = 60;
const POINTS: usize = 150_000;

fn main() -> Result<(), LogError> {
    let path = std::env::temp_dir().join(format!("realo-throughput-{}.mcap", std::process::id()));
    let agent = AgentInfo {
        name: "cav1".into(),
        kind: AgentKind::Vehicle,
        footprint: None,
        sensor: String::new(),
        sensor_position: None,
    };
    let cloud = cloud();
    let raw = (SWEEPS * POINTS * 20) as f64 / 1e6;
    let start = Instant::now();
    let mut writer = LogWriter::create(&path, &LogInfo::new("throughput", vec![agent]))?;
    for sweep in 0..SWEEPS {
        let stamp = sweep as Nanos * 100_000_000;
        writer.cloud("cav1", stamp, stamp, &cloud)?;
    }
    writer.finish()?;
    report("write", raw, start);
    let packed = std::fs::metadata(&path).map_or(0.0, |file| file.len() as f64 / 1e6);
    println!("{raw:.0} MB of points became {packed:.0} MB");

    let start = Instant::now();
    let mut reader = Log::open(&path)?.read_all(&[("cav1", Stream::Points)])?;
    let mut points = 0;
    while let Some(entry) = reader.next()? {
        points += entry.cloud()?.len();
    }
    assert_eq!(points, SWEEPS * POINTS);
    report("read", raw, start);
    let _ = std::fs::remove_file(&path);
    Ok(())
}

fn report(what: &str, megabytes: f64, start: Instant) {
    println!(
        "{what}: {:.0} MB/s of points",
        megabytes / start.elapsed().as_secs_f64()
    );
}

/// Ranges that vary smoothly along a beam, with millimetre noise: compresses like a real sweep.
fn cloud() -> PointCloud {
    let mut x = Vec::new();
    let mut y = Vec::new();
    let mut z = Vec::new();
    let mut noise = 1u32;
    for i in 0..POINTS {
        noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let (azimuth, beam) = ((i / 128) as f32 * 0.005, (i % 128) as f32);
        let range = 8.0 + beam * 0.4 + (noise >> 16) as f32 / 65536.0 * 0.02;
        x.push(range * azimuth.cos());
        y.push(range * azimuth.sin());
        z.push(beam * 0.01 - 1.8);
    }
    let time: Vec<i32> = (0..POINTS).map(|i| (i / 128) as i32 * 85_000 - 50_000_000).collect();
    let ring: Vec<u16> = (0..POINTS).map(|i| (i % 128) as u16).collect();
    let intensity: Vec<u8> = (0..POINTS).map(|i| (i * 7 % 200) as u8).collect();
    PointCloud::new(x, y, z, intensity, time, ring).expect("columns of one length")
}
