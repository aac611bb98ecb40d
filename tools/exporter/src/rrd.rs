//! A run or a log as a recording of rerun, by its Python package: poses, native boxes, points.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use realo_logs::{Log, McapFile, RawMessage, Schema, Stream, boxes, cloud, pose};
use realo_schemas::{Box3, Nanos, PointCloud, PoseStatus};
use serde_json::{Value, json};

use crate::ExportError;

/// What calls rerun.
const PROGRAM: &str = include_str!("rrd.py");
/// How rerun is installed.
const INSTALL: &str = "-m pip install 'rerun-sdk>=0.24'";
/// Boxes of recordings and logs.
const BOXES: [&str; 3] = ["boxes", "detections", "ground_truth"];

/// What a recording of rerun is made of.
#[derive(Clone, Debug)]
pub struct RrdRequest {
    /// A recording of a run, or a log.
    pub recording: PathBuf,
    /// The log whose sweeps are shown too.
    pub points: Option<PathBuf>,
    /// The file to write.
    pub output: PathBuf,
    /// Whether an earlier file may be replaced.
    pub force: bool,
    /// The Python that has rerun.
    pub python: PathBuf,
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RrdCounts {
    /// Poses of agents.
    pub poses: u64,
    /// Lists of boxes.
    pub lists: u64,
    /// Boxes in them.
    pub boxes: u64,
    /// Sweeps with points.
    pub sweeps: u64,
    /// Sweeps whose points cannot be placed.
    pub unplaced: u64,
    /// Whether a file was cut, so that its rest is missing.
    pub cut: bool,
}

/// Writes a recording of rerun; the file appears when it is complete.
///
/// # Errors
/// A Python without rerun, with the command that installs it; a file that cannot be read, or is there already; what Python said.
pub fn export_rrd(request: &RrdRequest, progress: &mut dyn FnMut(&RrdCounts)) -> Result<RrdCounts, ExportError> {
    let output = &request.output;
    if output.exists() && !request.force {
        return Err(ExportError::Occupied {
            path: output.clone(),
            expected: "nothing",
            found: "a file".into(),
            next: "choose another name, or --force to replace it",
        });
    }
    let file = McapFile::open(&request.recording)?;
    let cut = file.truncation().is_some();
    let log = request.points.as_ref().map(Log::open).transpose()?;
    need_rerun(&request.python)?;
    let partial = output.with_added_extension("partial");
    let written = Sender::start(&request.python, &partial, &request.recording)?.send_all(&file, log.as_ref(), progress);
    let counts = written.inspect_err(|_| {
        // The first error is the one that matters.
        let _ = std::fs::remove_file(&partial);
    })?;
    std::fs::rename(&partial, output).map_err(ExportError::io(output, "write"))?;
    let cut = cut || log.is_some_and(|log| log.truncation().is_some());
    Ok(RrdCounts { cut, ..counts })
}

/// Refuses a Python without rerun.
fn need_rerun(python: &Path) -> Result<(), ExportError> {
    let tried = Command::new(python)
        .args(["-c", "import numpy, rerun; rerun.Boxes3D"])
        .stdin(Stdio::null())
        .output();
    let lacks = |found: String| {
        let python = python.display();
        ExportError::Option(format!(
            "--python {python}: expected Python 3 with the package rerun-sdk, found {found}; install it by `{python} {INSTALL}`, best in \
             an environment of its own (`python3 -m venv rerun-env`), and name its Python by --python rerun-env/bin/python"
        ))
    };
    match tried {
        Err(error) => Err(lacks(format!("no such program ({error})"))),
        Ok(tried) if tried.status.success() => Ok(()),
        Ok(tried) => {
            let said = String::from_utf8_lossy(&tried.stderr);
            let last = said.lines().rfind(|line| !line.trim().is_empty());
            Err(lacks(format!("`{}`", last.unwrap_or("an error without words").trim())))
        }
    }
}

/// Sends things to Python.
struct Sender {
    python: Child,
    pipe: BufWriter<std::process::ChildStdin>,
    counts: RrdCounts,
    recording: PathBuf,
}

impl Sender {
    fn start(python: &Path, output: &Path, recording: &Path) -> Result<Self, ExportError> {
        let name = recording.canonicalize().unwrap_or_else(|_| recording.into());
        let mut python = Command::new(python)
            .args(["-c", PROGRAM])
            .arg(output)
            .arg(name)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .map_err(ExportError::io(python, "start"))?;
        let pipe = python.stdin.take().expect("it is piped");
        Ok(Sender {
            python,
            pipe: BufWriter::new(pipe),
            counts: RrdCounts::default(),
            recording: recording.into(),
        })
    }

    fn send_all(
        mut self,
        file: &McapFile,
        log: Option<&Log>,
        progress: &mut dyn FnMut(&RrdCounts),
    ) -> Result<RrdCounts, ExportError> {
        let sent = self.send_recording(file, log.is_none(), progress);
        let sent = sent.and_then(|()| log.map_or(Ok(()), |log| self.send_sweeps(log, progress)));
        // Python knows better than the pipe what went wrong.
        let flushed = self.pipe.flush();
        drop(self.pipe);
        let ended = self.python.wait().map_err(ExportError::io(&self.recording, "export"))?;
        if !ended.success() {
            return Err(ExportError::unfit(
                &self.recording,
                format!("rerun could not write it: Python ended with {ended}"),
            ));
        }
        sent?;
        flushed.map_err(ExportError::io(&self.recording, "export"))?;
        match self.counts.lists + self.counts.sweeps {
            0 => Err(ExportError::unfit(
                &self.recording,
                "expected boxes or points, found none: name the recording of a run, `RUN/LOG/EGO/recording.mcap`, or a log",
            )),
            _ => Ok(self.counts),
        }
    }

    /// Sends what a recording has; of points only where `points` says so.
    fn send_recording(
        &mut self,
        file: &McapFile,
        points: bool,
        progress: &mut dyn FnMut(&RrdCounts),
    ) -> Result<(), ExportError> {
        let wanted = file.channels().iter().filter_map(|(id, channel)| {
            let (agent, topic) = channel.topic.strip_prefix('/')?.split_once('/')?;
            let schema = Schema::named(&channel.schema)?;
            let is_wanted = match schema {
                Schema::PoseWithCovarianceStamped => topic == "pose",
                Schema::Detection3DArray => BOXES.contains(&topic),
                Schema::PointCloud2 => points && topic == "points",
                _ => false,
            };
            is_wanted.then(|| (*id, (agent.to_string(), topic.to_string(), schema)))
        });
        let wanted: std::collections::BTreeMap<_, _> = wanted.collect();
        let mut messages = file.messages(wanted.keys().copied().collect(), 0..u64::MAX)?;
        while let Some(raw) = messages.next()? {
            let (agent, topic, schema) = &wanted[&raw.channel];
            let sent = self.send(agent, topic, *schema, &raw);
            sent.map_err(|reason| ExportError::unfit(file.path(), format!("topic /{agent}/{topic}: {reason}")))?;
            progress(&self.counts);
        }
        Ok(())
    }

    fn send(&mut self, agent: &str, topic: &str, schema: Schema, raw: &RawMessage) -> Result<(), String> {
        match schema {
            Schema::PoseWithCovarianceStamped => {
                let (stamp, state) = pose::decode(raw.data(), PoseStatus::Recorded)?;
                let place = &state.map_from_body;
                let (at, turned) = (place.translation.vector, place.rotation.coords);
                self.counts.poses += 1;
                let thing = json!({ "kind": "pose", "translation": at.as_slice(), "rotation": turned.as_slice() });
                self.put(agent, stamp, thing, &[])
            }
            Schema::Detection3DArray => {
                let (stamp, found) = boxes::decode(raw.data())?;
                self.put_boxes(agent, topic, stamp, &found.0)
            }
            _ => {
                let (stamp, cloud) = cloud::decode(raw.data())?;
                self.put_cloud(agent, stamp, &cloud)
            }
        }
    }

    fn send_sweeps(&mut self, log: &Log, progress: &mut dyn FnMut(&RrdCounts)) -> Result<(), ExportError> {
        let agents = &log.info().agents;
        let wanted: Vec<(&str, Stream)> = agents.iter().map(|agent| (&*agent.name, Stream::Points)).collect();
        let mut reader = log.read_all(&wanted)?;
        while let Some(entry) = reader.next()? {
            match entry.cloud() {
                Ok(cloud) => self
                    .put_cloud(&entry.agent, entry.stamp(), &cloud)
                    .map_err(|reason| ExportError::unfit(log.path(), reason))?,
                Err(realo_logs::LogError::Unplaced { .. }) => self.counts.unplaced += 1,
                Err(error) => return Err(error.into()),
            }
            progress(&self.counts);
        }
        Ok(())
    }

    fn put_boxes(&mut self, agent: &str, topic: &str, stamp: Nanos, boxes: &[Box3]) -> Result<(), String> {
        self.counts.lists += 1;
        self.counts.boxes += boxes.len() as u64;
        let row = |object: &Box3| {
            let [x, y, z] = object.center;
            [x, y, z, object.length, object.width, object.height, object.yaw]
        };
        let rows: Vec<[f64; 7]> = boxes.iter().map(row).collect();
        let labels: Vec<String> = boxes
            .iter()
            .map(|object| format!("{} {:.2}", object.class, object.score))
            .collect();
        self.put(
            agent,
            stamp,
            json!({ "kind": "boxes", "topic": topic, "rows": rows, "labels": labels }),
            &[],
        )
    }

    fn put_cloud(&mut self, agent: &str, stamp: Nanos, cloud: &PointCloud) -> Result<(), String> {
        self.counts.sweeps += 1;
        let mut data = Vec::with_capacity(13 * cloud.len());
        for at in 0..cloud.len() {
            for value in [cloud.x[at], cloud.y[at], cloud.z[at]] {
                data.extend(value.to_le_bytes());
            }
        }
        data.extend((0..cloud.len()).map(|at| cloud.intensity[at]));
        self.put(agent, stamp, json!({ "kind": "points", "points": cloud.len() }), &data)
    }

    fn put(&mut self, agent: &str, stamp: Nanos, mut thing: Value, data: &[u8]) -> Result<(), String> {
        thing["agent"] = agent.into();
        thing["stamp"] = stamp.into();
        thing["bytes"] = data.len().into();
        let mut write = || -> std::io::Result<()> {
            writeln!(self.pipe, "{thing}")?;
            self.pipe.write_all(data)
        };
        write().map_err(|error| format!("Python takes no more: {error}"))
    }
}
