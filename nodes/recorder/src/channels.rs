//! What messages of a graph become on the topics of a recording, or of who watches.

use realo_logs::cdr::CdrWriter;
use realo_logs::{BoxesInfo, Schema, boxes, cloud, outline, pose, views};
use realo_schemas::geometry::View;
use realo_schemas::report::Fated;
use realo_schemas::{AgentState, Box3, Boxes, GroundTruth, Header, Nanos, Packet, PointCloud, Report, body_frame};
use serde_json::{Value, json};

/// Topic of the reports that say what became of messages.
pub const FATES: &str = "fates";
/// Ending of the topics of agents' outlines.
pub(crate) const FOOTPRINT: &str = "footprint";
/// The topic of reports.
const REPORTS: &str = "/reports";
/// The frame of poses.
const MAP: &str = "map";

/// Takes messages of topics, each with a schema and encoded as CDR.
pub trait Channels {
    /// Why one could not be taken.
    type Error;

    /// Takes one. `ready` and `stamp`: when it existed, and when it was measured, ns.
    ///
    /// # Errors
    /// What keeps it from being taken.
    fn put(
        &mut self,
        topic: &str,
        schema: Schema,
        times: Times,
        encode: impl FnOnce(&mut Vec<u8>),
    ) -> Result<(), Self::Error>;
}

/// The times of a message, ns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Times {
    /// When it existed.
    pub ready: Nanos,
    /// When it was measured.
    pub stamp: Nanos,
}

impl Times {
    fn of(header: &Header) -> Self {
        let Header { ready, stamp, .. } = *header;
        Times { ready, stamp }
    }

    /// Of something that has only one.
    pub fn at(time: Nanos) -> Self {
        Times {
            ready: time,
            stamp: time,
        }
    }
}

/// Puts boxes and their companions on `/<agent>/<topic>`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_boxes<C: Channels>(to: &mut C, topic: &str, header: &Header, boxes: &Boxes) -> Result<(), C::Error> {
    put_with_info(to, topic, header, &boxes.0, BoxesInfo::default())
}

/// Puts what is there on `/<agent>/ground_truth` and `/<agent>/own_labels`, and the outline of each agent on
/// `/<agent>/footprint`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_truth<C: Channels>(to: &mut C, header: &Header, truth: &GroundTruth) -> Result<(), C::Error> {
    let counted = truth.points.len() == truth.boxes.len() * truth.agents.len();
    let info = BoxesInfo {
        key: truth.key,
        agents: truth.agents.clone(),
        points: counted.then(|| truth.points.clone()),
        ..BoxesInfo::default()
    };
    put_with_info(to, "ground_truth", header, &truth.boxes, info)?;
    put_views(to, "ground_truth", header, &truth.views)?;
    put_footprints(to, header, truth)?;
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
    put_with_info(to, "own_labels", header, &own.boxes, info)?;
    put_views(to, "own_labels", header, &own.views)
}

/// The outlines of agents, as far as they are known.
fn put_footprints<C: Channels>(to: &mut C, header: &Header, truth: &GroundTruth) -> Result<(), C::Error> {
    for (agent, footprint) in truth.footprints() {
        let (topic, frame) = (format!("/{agent}/{FOOTPRINT}"), body_frame(agent));
        to.put(&topic, Schema::PolygonStamped, Times::of(header), |out| {
            outline::encode(out, header.stamp, &frame, footprint)
        })?;
    }
    Ok(())
}

/// Where the boxes of a topic could be labelled, if that is known.
fn put_views<C: Channels>(to: &mut C, topic: &str, header: &Header, views: &[View]) -> Result<(), C::Error> {
    if views.is_empty() {
        return Ok(());
    }
    let topic = format!("/{}/{topic}_views", header.agent);
    to.put(&topic, Schema::Views, Times::of(header), |out| {
        views::encode(out, header.stamp, &header.frame, views)
    })
}

fn put_with_info<C: Channels>(
    to: &mut C,
    topic: &str,
    header: &Header,
    boxes: &[Box3],
    info: BoxesInfo,
) -> Result<(), C::Error> {
    let (stamp, frame, times) = (header.stamp, &*header.frame, Times::of(header));
    let info = BoxesInfo {
        seq: header.seq,
        map_from_frame: header.pose.as_ref().map(|pose| pose.map_from_frame),
        ..info
    };
    let topic = format!("/{}/{topic}", header.agent);
    to.put(&topic, Schema::Detection3DArray, times, |out| {
        boxes::encode(out, stamp, frame, boxes)
    })?;
    to.put(&format!("{topic}_info"), Schema::BoxesInfo, times, |out| {
        boxes::encode_info(out, stamp, frame, boxes, &info);
    })?;
    to.put(&format!("{topic}_markers"), Schema::MarkerArray, times, |out| {
        boxes::encode_markers(out, stamp, frame, &topic, boxes);
    })
}

/// Puts a pose on `/<agent>/pose` and `/tf`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_state<C: Channels>(to: &mut C, header: &Header, state: &AgentState) -> Result<(), C::Error> {
    let (stamp, topic, times) = (header.stamp, format!("/{}/pose", header.agent), Times::of(header));
    let schema = Schema::PoseWithCovarianceStamped;
    to.put(&topic, schema, times, |out| pose::encode(out, stamp, MAP, state))?;
    let body = body_frame(&header.agent);
    to.put("/tf", Schema::TfMessage, times, |out| {
        pose::encode_transform(out, stamp, MAP, &body, &state.map_from_body);
    })
}

/// Puts a sweep on `/<agent>/points`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_cloud<C: Channels>(to: &mut C, header: &Header, cloud: &PointCloud) -> Result<(), C::Error> {
    let (stamp, topic) = (header.stamp, format!("/{}/points", header.agent));
    to.put(&topic, Schema::PointCloud2, Times::of(header), |out| {
        cloud::encode(out, stamp, &header.frame, cloud)
    })
}

/// Puts the header of what crossed a link on `/packets`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_packet<C: Channels>(to: &mut C, header: &Header, packet: &Packet) -> Result<(), C::Error> {
    to.put("/packets", Schema::PacketInfo, Times::of(header), |out| {
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

/// Puts a report of a stage on `/reports`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_report<C: Channels>(to: &mut C, header: &Header, report: &Report) -> Result<(), C::Error> {
    let document: Value = serde_json::from_str(&report.json).unwrap_or_else(|_| Value::String(report.json.clone()));
    let text = json!({ "topic": &*report.topic, "agent": &*header.agent, "report": document });
    put_document(to, Times::of(header), &text)
}

/// Puts what became of messages that crossed a link on `/reports`.
///
/// # Errors
/// As [`Channels::put`].
pub fn put_fates<C: Channels>(to: &mut C, now: Nanos, fates: &[Fated]) -> Result<(), C::Error> {
    put_document(to, Times::at(now), &json!({ "topic": FATES, "report": fates }))
}

/// Puts a JSON document on `/reports`.
pub(crate) fn put_document<C: Channels>(to: &mut C, times: Times, document: &Value) -> Result<(), C::Error> {
    let text = document.to_string();
    to.put(REPORTS, Schema::String, times, |out| CdrWriter::new(out).string(&text))
}
