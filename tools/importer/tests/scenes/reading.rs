//! Imports and reads back.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Isometry3, Point3};
use realo_importer::{ImportError, Imported, SceneSummary, importer};
use realo_logs::{Log, Stream};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud};

/// Imports with options; what went wrong, in words.
pub fn import(kind: &str, dir: &Path, out: &Path, set: &[(&str, &str)]) -> Result<Vec<SceneSummary>, String> {
    match run(kind, dir, out, set).map_err(|error| error.to_string())? {
        Imported::Scenes(scenes, _) => Ok(scenes),
        other => panic!("{other}"),
    }
}

fn run(kind: &str, dir: &Path, out: &Path, set: &[(&str, &str)]) -> Result<Imported, ImportError> {
    let importer = importer(kind).unwrap();
    let mut options = importer.kind().defaults();
    for (name, value) in set {
        importer.kind().set(&mut options, name, value)?;
    }
    importer.job(dir, out, &options)?.run(&mut |_, _, _| {})
}

/// An agent at a stamp.
#[derive(Default)]
pub struct Read {
    pub map_from_body: Isometry3<f64>,
    pub ready: Nanos,
    pub cloud: Option<PointCloud>,
    pub truth: Vec<Box3>,
    pub truth_points: Vec<u32>,
    pub own: Vec<Box3>,
    pub own_points: Vec<u32>,
    pub views: usize,
}

impl Read {
    /// Points in the map.
    pub fn in_map(&self) -> Vec<Point3<f64>> {
        let cloud = self.cloud.as_ref().unwrap();
        let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
        points
            .map(|((x, y), z)| self.map_from_body * Point3::new(*x, *y, *z).cast())
            .collect()
    }

    /// Middles of boxes in the map, with their headings there, degrees.
    pub fn boxes_in_map<'a>(&self, boxes: &'a [Box3]) -> Vec<([f64; 3], f64, &'a Box3)> {
        let moved = |object: &'a Box3| {
            let there = realo_schemas::geometry::transform_box(&self.map_from_body, object);
            (there.center, there.yaw.to_degrees(), object)
        };
        boxes.iter().map(moved).collect()
    }
}

/// All of a log, by agent and stamp.
pub fn read(path: &Path) -> (Log, BTreeMap<(String, Nanos), Read>) {
    let log = Log::open(path).unwrap();
    let streams = [
        Stream::Pose,
        Stream::Points,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
        Stream::GroundTruthViews,
        Stream::OwnLabels,
        Stream::OwnLabelsInfo,
    ];
    let names: Vec<String> = log.info().agents.iter().map(|agent| agent.name.clone()).collect();
    let all = names
        .iter()
        .flat_map(|name| streams.map(|stream| (name.as_str(), stream)));
    let wanted: Vec<(&str, Stream)> = all.filter(|(name, stream)| log.has(name, *stream)).collect();
    let mut found: BTreeMap<(String, Nanos), Read> = BTreeMap::new();
    let mut reader = log.read_all(&wanted).unwrap();
    while let Some(entry) = reader.next().unwrap() {
        let read = found.entry((entry.agent.to_string(), entry.stamp())).or_default();
        match entry.stream {
            Stream::Pose => read.map_from_body = entry.pose().unwrap().map_from_body,
            Stream::Points => (read.cloud, read.ready) = (Some(entry.cloud().unwrap()), entry.ready()),
            Stream::GroundTruth => read.truth = entry.boxes().unwrap().0,
            Stream::OwnLabels => read.own = entry.boxes().unwrap().0,
            Stream::GroundTruthViews => read.views = entry.views().unwrap().len(),
            stream => {
                let is_truth = stream == Stream::GroundTruthInfo;
                let boxes = if is_truth { &mut read.truth } else { &mut read.own };
                let mut whole = Boxes(std::mem::take(boxes));
                let info = entry.info(&mut whole).unwrap();
                *boxes = whole.0;
                assert!(info.key);
                let points = if is_truth {
                    &mut read.truth_points
                } else {
                    &mut read.own_points
                };
                // Cooperative labels that a file gives are of all agents, and have no points of one.
                let is_given = is_truth && log.info().protocol == "dair";
                assert_eq!(info.points.is_none(), is_given);
                *points = info.points.unwrap_or_default();
            }
        }
    }
    (log, found)
}
