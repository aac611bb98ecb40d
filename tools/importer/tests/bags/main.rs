//! Bags that are written here by hand, in every container and compression, imported, and read back.

mod apart;
mod bad_input;
mod clocks;
mod containers;
mod fields;
mod fuzz;
mod joined;
mod motion;
mod poses;
mod real_files;
mod said;
mod wire;
mod world;
mod writers;

use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_importer::{BagSummary, ImportError, Imported, Options, importer};
use realo_logs::{Log, Stream};
use realo_schemas::{Box3, Nanos, PointCloud};

/// Imports bags, by a map file or without.
pub fn import(paths: &[PathBuf], map: Option<&str>, output: &Path) -> Result<BagSummary, ImportError> {
    let file = output.with_extension("yml");
    if let Some(map) = map {
        std::fs::write(&file, map).unwrap();
    }
    let options = Options {
        map: map.map(|_| file),
        more: paths[1..].to_vec(),
        ..importer("bag")?.kind().defaults()
    };
    let job = importer("bag")?.job(&paths[0], output, &options)?;
    match job.run(&mut |_, _, _| {})? {
        Imported::Bags(summary) => Ok(*summary),
        other => panic!("{other}"),
    }
}

/// What a log has of an agent.
#[derive(Debug, Default, PartialEq)]
pub struct Played {
    /// Stamp, ready and points.
    pub clouds: Vec<(Nanos, Nanos, PointCloud)>,
    /// Stamp, and map from body.
    pub poses: Vec<(Nanos, Isometry3<f64>)>,
    /// Stamp and objects.
    pub truth: Vec<(Nanos, Vec<Box3>)>,
    /// Stamp and objects.
    pub detections: Vec<(Nanos, Vec<Box3>)>,
}

/// Reads what a log has of an agent.
pub fn played(log: &Path, agent: &str) -> Played {
    let log = Log::open(log).unwrap();
    let mut played = Played::default();
    let streams = [Stream::Points, Stream::Pose, Stream::GroundTruth, Stream::Detections];
    let streams = streams.into_iter().filter(|stream| log.has(agent, *stream));
    let streams: Vec<(&str, Stream)> = streams.map(|stream| (agent, stream)).collect();
    let mut reader = log.read_all(&streams).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        match entry.stream {
            Stream::Points => played
                .clouds
                .push((entry.stamp(), entry.ready(), entry.cloud().unwrap())),
            Stream::Pose => played.poses.push((entry.stamp(), entry.pose().unwrap().map_from_body)),
            Stream::GroundTruth => played.truth.push((entry.stamp(), entry.boxes().unwrap().0)),
            _ => played.detections.push((entry.stamp(), entry.boxes().unwrap().0)),
        }
    }
    played
}
