use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use realo_logs::cdr::CdrWriter;
use realo_logs::{
    BoxesInfo, ChannelId, ChunkGroup, LogError, McapWriter, Owner, RECORDING_RECORD, Schema, boxes, cloud, pose,
    program, refuse_foreign, views,
};
use realo_operator::Books;
use realo_schemas::geometry::View;
use realo_schemas::report::Fated;
use realo_schemas::{AgentState, Box3, Boxes, GroundTruth, Header, Nanos, Packet, PointCloud, Report, body_frame};
use serde_json::{Value, json};

/// Topic of the reports that say what became of messages.
pub const FATES: &str = "fates";

/// A recording in the making.
pub struct Recording {
    path: PathBuf,
    mcap: McapWriter,
    channels: BTreeMap<String, ChannelId>,
    last: Nanos,
}

impl Recording {
    pub fn create(path: &Path) -> Result<Self, LogError> {
        let io = |action| {
            move |reason| LogError::Io {
                path: path.into(),
                action,
                reason,
            }
        };
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(io("make the folder of"))?;
        }
        refuse_foreign(path)?;
        if Owner::of(path).map_err(io("look at"))? == Owner::Log {
            let reason = "it is a log, and would be lost; choose another `path`";
            return Err(LogError::Io {
                path: path.into(),
                action: "record into",
                reason: std::io::Error::other(reason),
            });
        }
        let file = File::create(path).map_err(io("create"))?;
        let metadata = BTreeMap::from([("format".into(), "1".into()), ("program".into(), program())]);
        let mcap = McapWriter::new(file, &program(), RECORDING_RECORD, &metadata).map_err(io("start writing"))?;
        Ok(Recording {
            path: path.into(),
            mcap,
            channels: BTreeMap::new(),
            last: 0,
        })
    }

    pub fn boxes(&mut self, topic: &str, header: &Header, boxes: &Boxes) -> Result<(), LogError> {
        self.write_boxes(topic, header, &boxes.0, &BoxesInfo::default())
    }

    pub fn truth(&mut self, header: &Header, truth: &GroundTruth) -> Result<(), LogError> {
        let counted = truth.points.len() == truth.boxes.len() * truth.agents.len();
        let info = BoxesInfo {
            key: truth.key,
            agents: truth.agents.clone(),
            points: counted.then(|| truth.points.clone()),
            ..BoxesInfo::default()
        };
        self.write_boxes("ground_truth", header, &truth.boxes, &info)?;
        self.views("ground_truth", header, &truth.views)?;
        let Some(own) = &truth.own else {
            return Ok(());
        };
        let counted = !own.points.is_empty();
        let info = BoxesInfo {
            key: own.key,
            agents: counted.then(|| header.agent.clone()).into_iter().collect(),
            points: counted.then(|| own.points.clone()),
            ..BoxesInfo::default()
        };
        self.write_boxes("own_labels", header, &own.boxes, &info)?;
        self.views("own_labels", header, &own.views)
    }

    /// Where the boxes of a topic could be labelled, if that is known.
    fn views(&mut self, topic: &str, header: &Header, views: &[View]) -> Result<(), LogError> {
        if views.is_empty() {
            return Ok(());
        }
        let topic = format!("/{}/{topic}_views", header.agent);
        self.write(&topic, Schema::Views, header, |out| {
            views::encode(out, header.stamp, &header.frame, views)
        })
    }

    fn write_boxes(&mut self, topic: &str, header: &Header, boxes: &[Box3], info: &BoxesInfo) -> Result<(), LogError> {
        let (stamp, frame) = (header.stamp, &*header.frame);
        let map_from_frame = header.pose.as_ref().map(|pose| pose.map_from_frame);
        let info = BoxesInfo {
            seq: header.seq,
            map_from_frame,
            ..info.clone()
        };
        let topic = format!("/{}/{topic}", header.agent);
        self.write(&topic, Schema::Detection3DArray, header, |out| {
            boxes::encode(out, stamp, frame, boxes)
        })?;
        self.write(&format!("{topic}_info"), Schema::BoxesInfo, header, |out| {
            boxes::encode_info(out, stamp, frame, boxes, &info);
        })?;
        self.write(&format!("{topic}_markers"), Schema::MarkerArray, header, |out| {
            boxes::encode_markers(out, stamp, frame, &topic, boxes);
        })
    }

    pub fn state(&mut self, header: &Header, state: &AgentState) -> Result<(), LogError> {
        let (stamp, topic) = (header.stamp, format!("/{}/pose", header.agent));
        let schema = Schema::PoseWithCovarianceStamped;
        self.write(&topic, schema, header, |out| pose::encode(out, stamp, "map", state))?;
        let body = body_frame(&header.agent);
        self.write("/tf", Schema::TfMessage, header, |out| {
            pose::encode_transform(out, stamp, "map", &body, &state.map_from_body);
        })
    }

    pub fn cloud(&mut self, header: &Header, cloud: &PointCloud) -> Result<(), LogError> {
        let (stamp, topic) = (header.stamp, format!("/{}/points", header.agent));
        self.write(&topic, Schema::PointCloud2, header, |out| {
            cloud::encode(out, stamp, &header.frame, cloud)
        })
    }

    pub fn packet(&mut self, header: &Header, packet: &Packet) -> Result<(), LogError> {
        self.write("/packets", Schema::PacketInfo, header, |out| {
            let mut out = CdrWriter::new(out);
            out.header(header.stamp, &header.frame);
            out.string(&header.agent);
            out.string(header.to.as_deref().unwrap_or_default());
            out.string(header.kind.as_str());
            out.u64(header.seq);
            out.u64(header.ready as u64);
            out.length(packet.codec.len());
            packet.codec.iter().for_each(|codec| out.string(codec));
            out.u64(packet.bytes.len() as u64);
        })
    }

    pub fn report(&mut self, header: &Header, report: &Report) -> Result<(), LogError> {
        let document: Value = serde_json::from_str(&report.json).unwrap_or_else(|_| Value::String(report.json.clone()));
        let text = json!({ "topic": &*report.topic, "agent": &*header.agent, "report": document }).to_string();
        self.write("/reports", Schema::String, header, |out| {
            CdrWriter::new(out).string(&text)
        })
    }

    /// What became of messages that crossed a link.
    pub fn fates(&mut self, fates: &[Fated]) -> Result<(), LogError> {
        let text = json!({ "topic": FATES, "report": fates }).to_string();
        let last = self.last;
        self.put("/reports", Schema::String, last, last, |out| {
            CdrWriter::new(out).string(&text)
        })
    }

    pub fn finish(mut self, books: &Books) -> Result<(), LogError> {
        let books = json!({ "topic": "books", "report": books }).to_string();
        let last = self.last;
        self.put("/reports", Schema::String, last, last, |out| {
            CdrWriter::new(out).string(&books)
        })?;
        self.mcap.finish().map_err(|failure| failure.of(&self.path))
    }

    fn write(
        &mut self,
        topic: &str,
        schema: Schema,
        header: &Header,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), LogError> {
        self.put(topic, schema, header.ready, header.stamp, encode)
    }

    fn put(
        &mut self,
        topic: &str,
        schema: Schema,
        ready: Nanos,
        stamp: Nanos,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), LogError> {
        self.last = self.last.max(ready);
        let channel = match self.channels.get(topic) {
            Some(channel) => *channel,
            None => {
                let channel = self.mcap.channel(topic, schema, ChunkGroup::of(&schema.name()));
                self.channels.insert(topic.into(), channel);
                channel
            }
        };
        let written = self
            .mcap
            .write(channel, ready.max(0) as u64, stamp.max(0) as u64, encode);
        written.map(|_| ()).map_err(|failure| failure.of(&self.path))
    }
}
