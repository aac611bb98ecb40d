//! Scenes of vectors as a folder in V2X-Real's layout, through the importer, into logs.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_importer::{Imported, importer};
use realo_logs::{Log, LogError, Stream};
use realo_schemas::{Box3, Nanos, PointCloud};
use serde::Deserialize;
use serde_json::Value;

/// A scene as a vector's document has it.
#[derive(Deserialize)]
pub struct Document {
    pub agents_in_order: Vec<DocumentAgent>,
}

/// An agent of a scene.
#[derive(Deserialize)]
pub struct DocumentAgent {
    /// Its folder.
    pub agent: String,
    /// How many frames its data are late.
    pub time_delay_frames: i64,
    /// Its label files by the names of their frames.
    pub frames: BTreeMap<String, LabelFile>,
}

/// A label file; what is not named here is in `rest`.
#[derive(Clone, Deserialize, serde::Serialize)]
pub struct LabelFile {
    pub lidar_pose: [f64; 6],
    pub vehicles: BTreeMap<String, Vehicle>,
    #[serde(flatten)]
    pub rest: BTreeMap<String, Value>,
}

/// A labelled object.
#[derive(Clone, Deserialize, serde::Serialize)]
pub struct Vehicle {
    pub location: [f64; 3],
    pub center: [f64; 3],
    /// Half sizes.
    pub extent: [f64; 3],
    pub angle: [f64; 3],
    pub obj_type: String,
}

/// An agent of a log at a stamp.
#[derive(Default)]
pub struct Sweep {
    pub map_from_lidar: Isometry3<f64>,
    pub cloud: Option<PointCloud>,
    pub own: Vec<Box3>,
    pub truth: Vec<Box3>,
}

/// What a scene became.
pub struct Recording {
    /// The log.
    pub log: Log,
    /// Names in the log by folders.
    pub names: BTreeMap<String, String>,
    /// Sweeps by agent.
    pub sweeps: BTreeMap<String, BTreeMap<Nanos, Sweep>>,
}

/// Data sets that are made of vectors, and the logs of their import.
pub struct Workspace {
    folder: tempfile::TempDir,
}

impl Workspace {
    /// An empty one.
    pub fn new() -> Result<Self, String> {
        let folder = tempfile::tempdir().map_err(|error| format!("no folder for the scene: {error}"))?;
        Ok(Workspace { folder })
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    /// Writes a frame of an agent.
    pub fn write(
        &self,
        [scene, agent, frame]: [&str; 3],
        labels: &LabelFile,
        points: &[[f32; 4]],
    ) -> Result<(), String> {
        let folder = self.data().join(scene).join(agent);
        // JSON is YAML.
        let text = serde_json::to_string(labels).map_err(|error| format!("frame {frame}: {error}"))?;
        let bytes: Vec<u8> = points
            .iter()
            .flatten()
            .flat_map(|number| number.to_le_bytes())
            .collect();
        let write = |end: &str, bytes: &[u8]| std::fs::write(folder.join(format!("{frame}.{end}")), bytes);
        std::fs::create_dir_all(&folder)
            .and_then(|()| write("yaml", text.as_bytes()))
            .and_then(|()| write("bin", &bytes))
            .map_err(|error| format!("{}: {error}", folder.display()))
    }

    /// Imports all scenes, with frames as the files have them, unlevelled. `set`: options of the import.
    pub fn import(&self, set: &[(&str, &str)]) -> Result<Vec<(String, Recording)>, String> {
        let importer = importer("v2x-real").map_err(|error| error.to_string())?;
        let mut options = importer.kind().defaults();
        for (name, value) in [("level", "none"), ("height", "0"), ("jobs", "1")].iter().chain(set) {
            let done = importer.kind().set(&mut options, name, value);
            done.map_err(|error| error.to_string())?;
        }
        let output = tempfile::tempdir_in(self.folder.path())
            .map_err(|error| error.to_string())?
            .keep();
        let job = importer.job(&self.data(), &output, &options);
        let imported = job.and_then(|job| job.run(&mut |_, _, _| {}));
        let Imported::Scenes(scenes, _) = imported.map_err(|error| error.to_string())? else {
            return Err("V2X-Real was not imported as scenes".into());
        };
        let read = |scene: realo_importer::SceneSummary| {
            let log = scene.log.as_deref().ok_or("a scene has no log")?;
            let names = scene.agents.into_iter().map(|agent| (agent.folder, agent.name));
            let recording = Recording::read(log, names.collect()).map_err(|error| error.to_string())?;
            Ok((scene.scene, recording))
        };
        scenes.into_iter().map(read).collect()
    }
}

impl Recording {
    fn read(path: &Path, names: BTreeMap<String, String>) -> Result<Self, LogError> {
        let log = Log::open(path)?;
        let streams = [Stream::Pose, Stream::Points, Stream::OwnLabels, Stream::GroundTruth];
        let all = names
            .values()
            .flat_map(|name| streams.map(|stream| (name.as_str(), stream)));
        let wanted: Vec<(&str, Stream)> = all.filter(|(name, stream)| log.has(name, *stream)).collect();
        let mut sweeps: BTreeMap<String, BTreeMap<Nanos, Sweep>> = BTreeMap::new();
        let mut reader = log.read_all(&wanted)?;
        while let Some(entry) = reader.next()? {
            let of_agent = sweeps.entry(entry.agent.to_string()).or_default();
            let sweep = of_agent.entry(entry.stamp()).or_default();
            match entry.stream {
                Stream::Pose => sweep.map_from_lidar = entry.pose()?.map_from_body,
                Stream::Points => sweep.cloud = Some(entry.cloud()?),
                Stream::OwnLabels => sweep.own = entry.boxes()?.0,
                _ => sweep.truth = entry.boxes()?.0,
            }
        }
        Ok(Recording { log, names, sweeps })
    }

    /// The sweeps of the agent in a folder, in order.
    pub fn of(&self, folder: &str) -> Result<&BTreeMap<Nanos, Sweep>, String> {
        let sweeps = self.names.get(folder).and_then(|name| self.sweeps.get(name));
        sweeps.ok_or_else(|| format!("the log has no agent of the folder `{folder}`"))
    }

    /// The folder of an agent.
    pub fn folder(&self, name: &str) -> Result<&str, String> {
        let found = self.names.iter().find(|(_, known)| *known == name);
        found
            .map(|(folder, _)| folder.as_str())
            .ok_or_else(|| format!("no folder has become `{name}`"))
    }
}
