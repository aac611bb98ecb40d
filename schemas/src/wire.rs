//! Messages as Arrow: one struct array of one row, the header's fields first, then the payload's columns as lists.
//!
//! A recording, a graph's edge and a test carry the same thing. Big columns share their memory with the message on the
//! way in and on the way out. The column `payload` names the [`PayloadType`]; a reader refuses what it does not expect,
//! naming the field, what it wanted and what it found.

mod columns;
mod motion;

use std::sync::Arc;

use arrow_array::{
    Array, ArrayRef, BinaryArray, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int32Array, Int64Array,
    ListArray, StringArray, StructArray, UInt8Array, UInt16Array, UInt32Array, UInt64Array,
};
use arrow_buffer::{NullBuffer, OffsetBuffer};
use arrow_schema::{DataType, Field, Fields};
use nalgebra::Vector3;

use crate::geometry::View;
use crate::{
    AgentState, Box3, Boxes, Clock, DType, FeatureMap, GroundTruth, Header, Kind, Message, Name, OwnLabels, Packet,
    Payload, PayloadType, PointCloud, Pose, PoseStatus, Report, Selection, TraceEntry,
};
use columns::{Builder, Row};

/// Why an Arrow array is not a message.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WireError {
    /// The array is not a struct of one row.
    #[error("a message is a struct array of 1 row, found {0}")]
    Shape(String),
    /// A field is missing or of another type.
    #[error("field `{field}`: expected {expected}, found {found}")]
    Field {
        /// The field's name.
        field: String,
        /// The type that the format asks for.
        expected: String,
        /// The type that came, or `nothing`.
        found: String,
    },
    /// A field whose content breaks the format.
    #[error("field `{field}`: {reason}")]
    Content {
        /// The field's name.
        field: String,
        /// What is wrong.
        reason: String,
    },
}

impl WireError {
    fn content(field: &str, reason: impl Into<String>) -> Self {
        WireError::Content {
            field: field.into(),
            reason: reason.into(),
        }
    }
}

/// The message as one Arrow row.
pub fn to_arrow(message: &Message) -> StructArray {
    let mut row = Builder::default();
    header_columns(&message.header, message.payload.payload_type(), &mut row);
    match &message.payload {
        Payload::PointCloud(cloud) => cloud_columns(cloud, &mut row),
        Payload::AgentState(state) => state_columns(state, &mut row),
        Payload::FeatureMap(map) => map_columns(map, &mut row),
        Payload::Packet(packet) => packet_columns(packet, &mut row),
        Payload::Selection(selection) => selection_columns(selection, &mut row),
        Payload::Report(report) => {
            row.text("topic", &report.topic);
            row.text("json", &report.json);
        }
        Payload::Boxes(boxes) => box_columns(&boxes.0, "", &mut row),
        Payload::GroundTruth(truth) => truth_columns(truth, &mut row),
        Payload::Motion(measured) => motion::write(measured, &mut row),
    }
    row.finish()
}

/// The message of an Arrow row.
///
/// # Errors
/// [`WireError`] names the first field that does not fit.
pub fn from_arrow(array: &dyn Array) -> Result<Message, WireError> {
    let rows = array.as_any().downcast_ref::<StructArray>();
    match rows {
        Some(rows) if rows.len() == 1 => read_row(&Row::new(rows, 0)),
        Some(rows) => Err(WireError::Shape(format!("{} rows", rows.len()))),
        None => Err(WireError::Shape(array.data_type().to_string())),
    }
}

fn read_row(row: &Row) -> Result<Message, WireError> {
    let payload_type: PayloadType = row
        .text("payload")?
        .parse()
        .map_err(|reason: String| WireError::content("payload", reason))?;
    let header = read_header(row)?;
    let payload = match payload_type {
        PayloadType::PointCloud => read_cloud(row)?.into(),
        PayloadType::AgentState => read_state(row)?.into(),
        PayloadType::FeatureMap => read_map(row)?.into(),
        PayloadType::Packet => Packet {
            codec: row.texts("codec")?.into_iter().map(Into::into).collect(),
            bytes: row.bytes("bytes")?,
        }
        .into(),
        PayloadType::Selection => read_selection(row)?.into(),
        PayloadType::Report => Report {
            topic: row.text("topic")?.into(),
            json: row.text("json")?.into(),
        }
        .into(),
        PayloadType::Boxes => Boxes(read_boxes(row, "")?).into(),
        PayloadType::GroundTruth => read_truth(row)?.into(),
        PayloadType::Motion => motion::read(row)?.into(),
    };
    Ok(Message { header, payload })
}

fn header_columns(header: &Header, payload: PayloadType, row: &mut Builder) {
    row.text("payload", payload.as_str());
    row.text("run", &header.run);
    row.text("agent", &header.agent);
    row.text("kind", header.kind.as_str());
    row.push("seq", UInt64Array::from(vec![header.seq]));
    row.push("hop", UInt64Array::from(vec![header.hop]));
    let clock = header.clock;
    row.list_i64(
        "clock_origins",
        clock.map(|c| vec![c.wall_origin, c.log_origin]).unwrap_or_default(),
    );
    row.list_f64("clock_rate", clock.map(|c| vec![c.rate]).unwrap_or_default());
    row.push("stamp", Int64Array::from(vec![header.stamp]));
    row.push("ready", Int64Array::from(vec![header.ready]));
    row.text("frame", &header.frame);
    let (pose, covariance) = match &header.pose {
        Some(pose) => {
            let (t, q) = pose.to_parts();
            (
                [t.as_slice(), &q].concat(),
                pose.covariance.as_ref().map(|c| c.to_vec()).unwrap_or_default(),
            )
        }
        None => Default::default(),
    };
    row.list_f64("pose", pose);
    row.list_f64("pose_covariance", covariance);
    row.list_f64("position", header.position.map(|p| p.to_vec()).unwrap_or_default());
    row.text("to", header.to.as_deref().unwrap_or_default());
    row.list_text("trace_node", header.trace.iter().map(|entry| &*entry.node));
    let times = |get: fn(&TraceEntry) -> i64| header.trace.iter().map(get).collect();
    row.list_i64("trace_input", times(|entry| entry.input));
    row.list_i64("trace_start", times(|entry| entry.start));
    row.list_i64("trace_done", times(|entry| entry.done));
    row.list_i64("trace_ready", times(|entry| entry.ready));
}

fn read_header(row: &Row) -> Result<Header, WireError> {
    let kind: Kind = row
        .text("kind")?
        .parse()
        .map_err(|reason: String| WireError::content("kind", reason))?;
    let clock = match (&row.list_i64("clock_origins")?[..], &row.list_f64("clock_rate")?[..]) {
        ([], []) => None,
        ([wall, log], [rate]) if *rate > 0.0 && rate.is_finite() => Some(Clock {
            wall_origin: *wall,
            log_origin: *log,
            rate: *rate,
        }),
        _ => {
            return Err(WireError::content(
                "clock_origins",
                "needs 2 origins and a positive rate, or nothing",
            ));
        }
    };
    let to = row.text("to")?;
    Ok(Header {
        run: row.text("run")?.into(),
        agent: row.text("agent")?.into(),
        kind,
        seq: row.value::<UInt64Array>("seq")?.value(row.index()),
        hop: row.value::<UInt64Array>("hop")?.value(row.index()),
        clock,
        stamp: row.value::<Int64Array>("stamp")?.value(row.index()),
        ready: row.value::<Int64Array>("ready")?.value(row.index()),
        frame: row.text("frame")?.into(),
        pose: read_pose(row, "pose", "pose_covariance")?,
        position: read_position(row)?,
        to: (!to.is_empty()).then(|| to.into()),
        trace: read_trace(row)?,
    })
}

fn read_pose(row: &Row, field: &str, covariance_field: &str) -> Result<Option<Pose>, WireError> {
    let covariance = read_covariance(row, covariance_field)?;
    match &row.list_f64(field)?[..] {
        [] => Ok(None),
        [x, y, z, qx, qy, qz, qw] => {
            let pose = Pose::from_parts([*x, *y, *z], [*qx, *qy, *qz, *qw]);
            let pose = pose.ok_or_else(|| WireError::content(field, "not a finite pose"))?;
            Ok(Some(Pose { covariance, ..pose }))
        }
        other => Err(WireError::content(
            field,
            format!("a pose has 7 numbers, found {}", other.len()),
        )),
    }
}

fn read_position(row: &Row) -> Result<Option<[f64; 3]>, WireError> {
    match &row.list_f64("position")?[..] {
        [] => Ok(None),
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => Ok(Some([*x, *y, *z])),
        other => Err(WireError::content(
            "position",
            format!("a position has 3 finite numbers, found {other:?}"),
        )),
    }
}

fn read_covariance(row: &Row, field: &str) -> Result<Option<Box<[f64; 36]>>, WireError> {
    let numbers = row.list_f64(field)?;
    if numbers.is_empty() {
        return Ok(None);
    }
    let covariance: [f64; 36] = numbers[..]
        .try_into()
        .map_err(|_| WireError::content(field, format!("a covariance has 36 numbers, found {}", numbers.len())))?;
    Ok(Some(Box::new(covariance)))
}

fn read_trace(row: &Row) -> Result<Vec<TraceEntry>, WireError> {
    let nodes = row.texts("trace_node")?;
    let [input, start, done, ready] = ["trace_input", "trace_start", "trace_done", "trace_ready"].map(|field| {
        let times = row.list_i64(field)?;
        if times.len() != nodes.len() {
            return Err(WireError::content(
                field,
                format!("{} times for {} nodes", times.len(), nodes.len()),
            ));
        }
        Ok(times)
    });
    let (input, start, done, ready) = (input?, start?, done?, ready?);
    let entries = nodes.iter().enumerate().map(|(i, node)| TraceEntry {
        node: Name::from(*node),
        input: input[i],
        start: start[i],
        done: done[i],
        ready: ready[i],
    });
    Ok(entries.collect())
}

fn cloud_columns(cloud: &PointCloud, row: &mut Builder) {
    row.list("x", Float32Array::new(cloud.x.clone(), None));
    row.list("y", Float32Array::new(cloud.y.clone(), None));
    row.list("z", Float32Array::new(cloud.z.clone(), None));
    row.list("intensity", UInt8Array::new(cloud.intensity.clone(), None));
    row.list("time", Int32Array::new(cloud.time.clone(), None));
    row.list("ring", UInt16Array::new(cloud.ring.clone(), None));
}

fn read_cloud(row: &Row) -> Result<PointCloud, WireError> {
    let cloud = PointCloud::new(
        row.list::<Float32Array>("x")?.values().clone(),
        row.list::<Float32Array>("y")?.values().clone(),
        row.list::<Float32Array>("z")?.values().clone(),
        row.list::<UInt8Array>("intensity")?.values().clone(),
        row.list::<Int32Array>("time")?.values().clone(),
        row.list::<UInt16Array>("ring")?.values().clone(),
    );
    cloud.ok_or_else(|| WireError::content("x", "the columns of a cloud differ in length"))
}

fn state_columns(state: &AgentState, row: &mut Builder) {
    let (t, q) = Pose::exact(state.map_from_body).to_parts();
    row.list_f64("map_from_body", [t.as_slice(), &q].concat());
    row.list_f64(
        "covariance",
        state.covariance.as_ref().map(|c| c.to_vec()).unwrap_or_default(),
    );
    let vector = |v: &Option<Vector3<f64>>| v.map(|v| vec![v.x, v.y, v.z]).unwrap_or_default();
    row.list_f64("velocity", vector(&state.velocity));
    row.list_f64("angular_rate", vector(&state.angular_rate));
    row.text("status", state.status.name());
}

fn read_state(row: &Row) -> Result<AgentState, WireError> {
    let pose = read_pose(row, "map_from_body", "covariance")?
        .ok_or_else(|| WireError::content("map_from_body", "a state needs a pose"))?;
    let vector = |field: &str| match &row.list_f64(field)?[..] {
        [] => Ok(None),
        [x, y, z] => Ok(Some(Vector3::new(*x, *y, *z))),
        other => Err(WireError::content(
            field,
            format!("a vector has 3 numbers, found {}", other.len()),
        )),
    };
    let name = row.text("status")?;
    let unknown = || WireError::content("status", format!("unknown status `{name}`"));
    let status = PoseStatus::ALL.into_iter().find(|status| status.name() == name);
    let status = status.ok_or_else(unknown)?;
    Ok(AgentState {
        map_from_body: pose.map_from_frame,
        covariance: pose.covariance,
        velocity: vector("velocity")?,
        angular_rate: vector("angular_rate")?,
        status,
    })
}

fn map_columns(map: &FeatureMap, row: &mut Builder) {
    row.push("rows", UInt32Array::from(vec![map.rows]));
    row.push("columns", UInt32Array::from(vec![map.columns]));
    row.push("channels", UInt32Array::from(vec![map.channels]));
    row.push("cell", Float64Array::from(vec![map.cell]));
    row.list_f64("origin", map.origin.to_vec());
    let dtype = match map.dtype {
        DType::F32 => "f32",
        DType::F16 => "f16",
        DType::Bf16 => "bf16",
        DType::U8 => "u8",
    };
    row.text("dtype", dtype);
    row.bytes("data", &map.data);
    row.text("model", &map.model);
    let confidence = map.confidence.clone().unwrap_or_else(|| Vec::new().into());
    row.list("confidence", Float32Array::new(confidence, None));
}

fn read_map(row: &Row) -> Result<FeatureMap, WireError> {
    let size = |field: &str| Ok(row.value::<UInt32Array>(field)?.value(row.index()));
    let (rows, columns, channels) = (size("rows")?, size("columns")?, size("channels")?);
    let dtype = match row.text("dtype")? {
        "f32" => DType::F32,
        "f16" => DType::F16,
        "bf16" => DType::Bf16,
        "u8" => DType::U8,
        other => return Err(WireError::content("dtype", format!("unknown element type `{other}`"))),
    };
    let data = row.bytes("data")?;
    let expected = [rows, columns, channels]
        .iter()
        .try_fold(dtype.size(), |bytes, n| bytes.checked_mul(*n as usize))
        .ok_or_else(|| WireError::content("rows", format!("[{rows}, {columns}, {channels}] is no possible shape")))?;
    if data.len() != expected {
        let reason = format!(
            "[{rows}, {columns}, {channels}] needs {expected} bytes, found {}",
            data.len()
        );
        return Err(WireError::content("data", reason));
    }
    let origin = row.list_f64("origin")?;
    let origin = origin[..]
        .try_into()
        .map_err(|_| WireError::content("origin", "needs x and y"))?;
    let cell = row.value::<Float64Array>("cell")?.value(row.index());
    let confidence = row.list::<Float32Array>("confidence")?.values().clone();
    let cells = rows as usize * columns as usize;
    if !confidence.is_empty() && confidence.len() != cells {
        let found = confidence.len();
        return Err(WireError::content(
            "confidence",
            format!("{found} numbers for {cells} cells"),
        ));
    }
    Ok(FeatureMap {
        rows,
        columns,
        channels,
        cell,
        origin,
        dtype,
        data,
        model: row.text("model")?.into(),
        confidence: (!confidence.is_empty()).then_some(confidence),
    })
}

fn packet_columns(packet: &Packet, row: &mut Builder) {
    row.list_text("codec", packet.codec.iter().map(String::as_str));
    row.bytes("bytes", &packet.bytes);
}

fn selection_columns(selection: &Selection, row: &mut Builder) {
    row.push("query", UInt64Array::from(vec![selection.query]));
    // One field for each entry, not a list: entries may differ in type, and their big columns are not copied together.
    let rows: Vec<StructArray> = selection.entries.iter().map(to_arrow).collect();
    for (index, entry) in rows.into_iter().enumerate() {
        row.push_owned(format!("entry_{index}"), Arc::new(entry));
    }
}

fn read_selection(row: &Row) -> Result<Selection, WireError> {
    let query = row.value::<UInt64Array>("query")?.value(row.index());
    let mut entries = Vec::new();
    while let Some(entry) = row.optional(&format!("entry_{}", entries.len())) {
        let field = format!("entry_{}", entries.len());
        let entry = entry.as_any().downcast_ref::<StructArray>();
        let entry = entry.ok_or_else(|| WireError::content(&field, "an entry is a struct"))?;
        let message =
            read_row(&Row::new(entry, row.index())).map_err(|error| WireError::content(&field, error.to_string()))?;
        if matches!(message.payload, Payload::Selection(_)) {
            return Err(WireError::content(&field, "a Selection within a Selection"));
        }
        entries.push(message);
    }
    Ok(Selection { query, entries })
}

/// Columns of boxes, their names behind a prefix.
fn box_columns(boxes: &[Box3], prefix: &str, row: &mut Builder) {
    let named = |field: &str| format!("{prefix}{field}");
    let mut number = |field: &str, get: &dyn Fn(&Box3) -> f64| {
        row.list_f64(&named(field), boxes.iter().map(get).collect());
    };
    number("x", &|b| b.center[0]);
    number("y", &|b| b.center[1]);
    number("z", &|b| b.center[2]);
    number("length", &|b| b.length);
    number("width", &|b| b.width);
    number("height", &|b| b.height);
    number("yaw", &|b| b.yaw);
    row.list_text(&named("class"), boxes.iter().map(|b| &*b.class));
    let scores = Float32Array::from_iter_values(boxes.iter().map(|b| b.score));
    row.list(&named("score"), scores);
    row.list(&named("track"), UInt64Array::from_iter(boxes.iter().map(|b| b.track)));
    row.list(
        &named("velocity"),
        optional_vectors(boxes, |b| b.velocity.as_ref().map(|v| v.as_slice()), 3),
    );
    row.list(
        &named("covariance"),
        optional_vectors(boxes, |b| b.covariance.as_ref().map(|c| c.as_slice()), 9),
    );
}

fn optional_vectors<T>(of: &[T], get: fn(&T) -> Option<&[f64]>, size: usize) -> FixedSizeListArray {
    let zeros = vec![0.0; size];
    let values: Vec<f64> = of
        .iter()
        .flat_map(|one| get(one).unwrap_or(&zeros).iter().copied())
        .collect();
    let known = NullBuffer::from_iter(of.iter().map(|one| get(one).is_some()));
    let field = Arc::new(Field::new("item", DataType::Float64, true));
    FixedSizeListArray::new(field, size as i32, Arc::new(Float64Array::from(values)), Some(known))
}

fn read_boxes(row: &Row, prefix: &str) -> Result<Vec<Box3>, WireError> {
    let named = |field: &str| format!("{prefix}{field}");
    let number = |field: &str| row.list_f64(&named(field));
    let (x, y, z) = (number("x")?, number("y")?, number("z")?);
    let (length, width, height, yaw) = (number("length")?, number("width")?, number("height")?, number("yaw")?);
    let class = row.texts(&named("class"))?;
    let score = row.list::<Float32Array>(&named("score"))?;
    let track = row.list::<UInt64Array>(&named("track"))?;
    let velocity = row.list::<FixedSizeListArray>(&named("velocity"))?;
    let covariance = row.list::<FixedSizeListArray>(&named("covariance"))?;
    let n = x.len();
    let lengths = [
        y.len(),
        z.len(),
        length.len(),
        width.len(),
        height.len(),
        yaw.len(),
        class.len(),
    ];
    let others = [score.len(), track.len(), velocity.len(), covariance.len()];
    if lengths.iter().chain(&others).any(|len| *len != n) {
        return Err(WireError::content(
            &named("x"),
            "the columns of the boxes differ in length",
        ));
    }
    (0..n)
        .map(|i| {
            Ok(Box3 {
                center: [x[i], y[i], z[i]],
                length: length[i],
                width: width[i],
                height: height[i],
                yaw: yaw[i],
                velocity: columns::vector(&velocity, i, &named("velocity"))?,
                class: class[i].into(),
                score: score.value(i),
                track: track.is_valid(i).then(|| track.value(i)),
                covariance: columns::vector(&covariance, i, &named("covariance"))?,
            })
        })
        .collect()
}

fn truth_columns(truth: &GroundTruth, row: &mut Builder) {
    box_columns(&truth.boxes, "", row);
    row.list_text("agents", truth.agents.iter().map(|agent| &**agent));
    row.list("points", UInt32Array::from(truth.points.clone()));
    row.list_f64(
        "ego_footprint",
        truth.ego_footprint.map(|f| f.to_vec()).unwrap_or_default(),
    );
    let footprints = &truth.other_footprints;
    row.list(
        "other_footprints",
        optional_vectors(footprints, |known| known.as_ref().map(|sides| sides.as_slice()), 4),
    );
    row.push("key", BooleanArray::from(vec![truth.key]));
    row.list("views", views_column(&truth.views));
    let nothing = OwnLabels::default();
    let own = truth.own.as_deref().unwrap_or(&nothing);
    row.list(
        OWN_KEY,
        BooleanArray::from_iter(truth.own.iter().map(|own| Some(own.key))),
    );
    box_columns(&own.boxes, OWN, row);
    row.list("own_points", UInt32Array::from(own.points.clone()));
    row.list("own_views", views_column(&own.views));
}

/// Prefix of the columns of the ego's own labels.
const OWN: &str = "own_";
/// Their flag: an empty list where there are none.
const OWN_KEY: &str = "own_key";

fn views_column(views: &[View]) -> FixedSizeListArray {
    let values: Vec<f64> = views.iter().flat_map(View::numbers).collect();
    let field = Arc::new(Field::new("item", DataType::Float64, true));
    FixedSizeListArray::new(field, View::NUMBERS as i32, Arc::new(Float64Array::from(values)), None)
}

fn read_views(row: &Row, field: &str) -> Result<Vec<View>, WireError> {
    let views = row.list::<FixedSizeListArray>(field)?;
    let read = |index: usize| {
        let numbers = columns::vector(&views, index, field)?.ok_or_else(|| WireError::content(field, "is null"))?;
        View::from_numbers(&numbers).map_err(|reason| WireError::content(field, format!("view {index}: {reason}")))
    };
    (0..views.len()).map(read).collect()
}

fn read_own(row: &Row) -> Result<Option<OwnLabels>, WireError> {
    let key = row.list::<BooleanArray>(OWN_KEY)?;
    if key.is_empty() {
        return Ok(None);
    }
    let boxes = read_boxes(row, OWN)?;
    let points = row.list::<UInt32Array>("own_points")?.values().to_vec();
    if !points.is_empty() && points.len() != boxes.len() {
        let reason = format!("{} counts for {} objects", points.len(), boxes.len());
        return Err(WireError::content("own_points", reason));
    }
    Ok(Some(OwnLabels {
        boxes,
        points,
        key: key.value(0),
        views: read_views(row, "own_views")?,
    }))
}

/// The footprints of so many agents, or of none.
fn read_footprints(row: &Row, agents: usize) -> Result<Vec<Option<[f64; 4]>>, WireError> {
    const FIELD: &str = "other_footprints";
    let lists = row.list::<FixedSizeListArray>(FIELD)?;
    if !lists.is_empty() && lists.len() != agents {
        let reason = format!("{} footprints for {agents} agents beside the ego", lists.len());
        return Err(WireError::content(FIELD, reason));
    }
    (0..lists.len())
        .map(|index| columns::vector(&lists, index, FIELD))
        .collect()
}

fn read_truth(row: &Row) -> Result<GroundTruth, WireError> {
    let boxes = read_boxes(row, "")?;
    let agents: Vec<Name> = row.texts("agents")?.into_iter().map(Name::from).collect();
    let points = row.list::<UInt32Array>("points")?.values().to_vec();
    if !points.is_empty() && points.len() != boxes.len() * agents.len() {
        let reason = format!(
            "{} counts for {} objects and {} agents",
            points.len(),
            boxes.len(),
            agents.len()
        );
        return Err(WireError::content("points", reason));
    }
    let ego_footprint = match &row.list_f64("ego_footprint")?[..] {
        [] => None,
        [a, b, c, d] => Some([*a, *b, *c, *d]),
        other => {
            return Err(WireError::content(
                "ego_footprint",
                format!("needs 4 numbers, found {}", other.len()),
            ));
        }
    };
    let other_footprints = read_footprints(row, agents.len().saturating_sub(1))?;
    let key = row.value::<BooleanArray>("key")?.value(row.index());
    Ok(GroundTruth {
        boxes,
        agents,
        points,
        ego_footprint,
        other_footprints,
        key,
        views: read_views(row, "views")?,
        own: read_own(row)?.map(Box::new),
    })
}
