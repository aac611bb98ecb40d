//! Measures how fast a scene in the layout of OPV2V becomes a log: `cargo run --release -p realo-importer --example speed`.

use std::error::Error;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::time::Instant;

use realo_importer::{Imported, importer};

const AGENTS: [&str; 4] = ["641", "650", "660", "670"];
const FRAMES: usize = 40;
const POINTS: usize = 60_000;
/// Objects of a label file.
const OBJECTS: usize = 40;

fn main() -> Result<(), Box<dyn Error>> {
    let dir = tempfile::tempdir()?;
    let (data, log) = (dir.path().join("data"), dir.path().join("log.mcap"));
    for (number, agent) in AGENTS.iter().enumerate() {
        write(&data.join("scene").join(agent), number)?;
    }
    let kind = importer("opv2v")?;
    let start = Instant::now();
    let imported = kind.job(&data, &log, &kind.kind().defaults())?.run(&mut |_, _, _| {})?;
    let seconds = start.elapsed().as_secs_f64();
    let Imported::Scenes(scenes, _) = imported else {
        return Err("scenes were imported as something else".into());
    };
    let agents = scenes.iter().flat_map(|scene| &scene.agents);
    let points: usize = agents.map(|agent| agent.points).sum();
    println!(
        "{:.1} ms a frame of {} agents, {:.1} million points a second",
        seconds * 1e3 / FRAMES as f64,
        AGENTS.len(),
        points as f64 / seconds / 1e6
    );
    Ok(())
}

/// Frames of an agent on a flat ground, with a row of cars.
fn write(folder: &Path, number: usize) -> Result<(), Box<dyn Error>> {
    fs::create_dir_all(folder)?;
    let mut labels = format!("lidar_pose: [{}.0, 0.0, 1.9, 0.0, 0.0, 0.0]\nvehicles:\n", 10 * number);
    for object in 0..OBJECTS {
        write!(
            labels,
            "  {object}:\n    angle: [0.0, 30.0, 0.0]\n    center: [0.0, 0.0, 0.7]\n    extent: [2.2, 0.9, 0.7]\n    \
             location: [{}.0, 8.0, 0.0]\n    speed: 12.5\n",
            8 * object
        )?;
    }
    let mut cloud = format!(
        "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {POINTS}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {POINTS}\nDATA binary\n"
    )
    .into_bytes();
    for point in 0..POINTS {
        let (ring, along) = ((point / 600) as f32, (point % 600) as f32);
        let row = [0.2 * (along - 300.0), 0.6 * (ring - 50.0), -1.9 + 0.001 * ring, 0.5];
        cloud.extend(row.map(f32::to_le_bytes).concat());
    }
    for frame in 0..FRAMES {
        fs::write(folder.join(format!("{:06}.yaml", 68 + 2 * frame)), &labels)?;
        fs::write(folder.join(format!("{:06}.pcd", 68 + 2 * frame)), &cloud)?;
    }
    Ok(())
}
