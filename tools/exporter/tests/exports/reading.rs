//! Exports, imports, and reads logs.

use std::path::Path;

use nalgebra::Isometry3;
use realo_exporter::{Exported, Options, export, exporter};
use realo_importer::importer;
use realo_logs::{Log, MAX_GAP, Stream, pose_track};
use realo_schemas::{Box3, Nanos, PointCloud};

/// Exports with options; what went wrong, in words.
pub fn try_export(kind: &str, log: &Path, out: &Path, set: &[(&str, &str)], force: bool) -> Result<Exported, String> {
    let exporter = exporter(kind).unwrap();
    let mut options = Options::default();
    for (name, value) in set {
        exporter
            .kind()
            .set(&mut options, name, value)
            .map_err(|error| error.to_string())?;
    }
    let log = Log::open(log).unwrap();
    export(exporter, &log, out, &options, force, &mut |_, _| {}).map_err(|error| error.to_string())
}

/// Imports with the options that the export names.
pub fn import(exported: &Exported, log: &Path) {
    let words: Vec<&str> = exported.read_back.split_whitespace().collect();
    assert_eq!(words[..2], ["realo-lab", "import"], "{words:?}");
    let importer = importer(words[2]).unwrap();
    let mut options = importer.kind().defaults();
    for pair in words[6..].chunks(2) {
        let name = pair[0].strip_prefix("--").unwrap();
        importer.kind().set(&mut options, name, pair[1]).unwrap();
    }
    importer
        .job(&exported.path, log, &options)
        .unwrap()
        .run(&mut |_, _, _| {})
        .unwrap();
}

/// A sweep of an agent.
pub struct Read {
    pub stamp: Nanos,
    pub map_from_body: Isometry3<f64>,
    pub cloud: PointCloud,
    pub truth: Vec<Box3>,
    /// Points on each box.
    pub points: Option<Vec<u32>>,
    pub is_scored: bool,
}

/// The sweeps of an agent of a log, with its true poses where there are some.
pub fn sweeps(log: &Log, agent: &str) -> Vec<Read> {
    let is_true = log.has(agent, Stream::PoseTruth);
    let track = pose_track(
        log,
        agent,
        if is_true { Stream::PoseTruth } else { Stream::Pose },
        MAX_GAP,
    )
    .unwrap();
    let wanted = [Stream::Points, Stream::GroundTruth, Stream::GroundTruthInfo].map(|stream| (agent, stream));
    let mut reader = log.read_all(&wanted).unwrap();
    let (mut found, mut boxes) = (Vec::<Read>::new(), realo_schemas::Boxes::default());
    while let Some(entry) = reader.next().unwrap() {
        match entry.stream {
            Stream::Points => found.push(Read {
                stamp: entry.stamp(),
                map_from_body: track.at(entry.stamp()).unwrap(),
                cloud: entry.cloud().unwrap(),
                truth: Vec::new(),
                points: None,
                is_scored: true,
            }),
            Stream::GroundTruth => boxes = entry.boxes().unwrap(),
            _ => {
                let info = entry.info(&mut boxes).unwrap();
                let of = found.iter_mut().find(|read| read.stamp == entry.stamp()).unwrap();
                of.truth = std::mem::take(&mut boxes).0;
                (of.points, of.is_scored) = (info.points, info.key);
            }
        }
    }
    found
}

/// Whether two numbers have the same digits in single precision.
pub fn assert_same(a: f64, b: f64, what: &str) {
    let step = f64::from(f32::EPSILON) * a.abs().max(b.abs()).max(1.0);
    assert!((a - b).abs() <= step, "{what}: {a} and {b}");
}

/// Compares clouds of a LiDAR so high over the body: heights over the LiDAR are rounded once more.
pub fn assert_same_clouds(a: &PointCloud, b: &PointCloud, height: f64) {
    assert_eq!(a.len(), b.len());
    assert_eq!((&a.x[..], &a.y[..]), (&b.x[..], &b.y[..]));
    assert_eq!(a.intensity, b.intensity);
    for (a, b) in a.z.iter().zip(b.z.iter()) {
        let (a, b) = (f64::from(*a), f64::from(*b));
        let step = f64::from(f32::EPSILON) * (a - height).abs().max(a.abs());
        assert!((a - b).abs() <= step, "{a} and {b}");
    }
}

/// Compares boxes but for their tracks and velocities.
pub fn assert_same_boxes(a: &[Box3], b: &[Box3]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert_eq!(a.class, b.class);
        let all = |object: &Box3| {
            let [x, y, z] = object.center;
            [x, y, z, object.length, object.width, object.height]
        };
        all(a)
            .into_iter()
            .zip(all(b))
            .for_each(|(a, b)| assert_same(a, b, "box"));
        let turned = realo_schemas::geometry::normalize_yaw(a.yaw - b.yaw);
        assert_same(turned, 0.0, "heading");
    }
}

/// Compares poses.
pub fn assert_same_poses(a: &Isometry3<f64>, b: &Isometry3<f64>) {
    for axis in 0..3 {
        assert_same(a.translation.vector[axis], b.translation.vector[axis], "place");
    }
    assert_same(a.rotation.angle_to(&b.rotation), 0.0, "turn");
}
