//! The columns of messages and their types, for other languages and for type files.

use arrow_schema::DataType;

use crate::wire::to_arrow;
use crate::{
    AgentState, Boxes, DType, FeatureMap, GroundTruth, Header, Kind, Message, Motion, Packet, Payload, PayloadType,
    PointCloud, Pose, PoseStatus, Report, Selection,
};

/// The name of a column, and its type as Arrow writes it: `List<Float64>`.
pub type Column = (String, String);

/// The last column of the header.
const LAST_OF_HEADER: &str = "trace_ready";

/// The columns of every message, in their order: the payload's name, then the header's.
pub fn header() -> Vec<Column> {
    let mut all = all(PayloadType::Packet);
    let own = all.iter().position(|(name, _)| name == LAST_OF_HEADER);
    all.truncate(own.map_or(0, |last| last + 1));
    all
}

/// The columns of a payload, in their order; those of the entries of a selection are not among them.
pub fn payload(payload: PayloadType) -> Vec<Column> {
    all(payload).split_off(header().len())
}

/// The columns of a whole message.
pub fn all(payload: PayloadType) -> Vec<Column> {
    let header = Header::origin(&"".into(), &"".into(), Kind::Points, 0, 0, 0);
    let payload = example(payload);
    let row = to_arrow(&Message { header, payload });
    let fields = row.fields().iter();
    fields
        .map(|field| (field.name().clone(), name(field.data_type())))
        .collect()
}

fn example(payload: PayloadType) -> Payload {
    match payload {
        PayloadType::PointCloud => PointCloud::empty().into(),
        PayloadType::AgentState => AgentState {
            map_from_body: Pose::from_parts([0.0; 3], [0.0, 0.0, 0.0, 1.0])
                .map_or_else(Default::default, |pose| pose.map_from_frame),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        }
        .into(),
        PayloadType::FeatureMap => FeatureMap {
            rows: 0,
            columns: 0,
            channels: 0,
            cell: 0.4,
            origin: [0.0; 2],
            dtype: DType::F32,
            data: Vec::<u8>::new().into(),
            model: "".into(),
            confidence: None,
        }
        .into(),
        PayloadType::Packet => Packet {
            codec: Vec::new(),
            bytes: Vec::<u8>::new().into(),
        }
        .into(),
        PayloadType::Selection => Selection {
            query: 0,
            entries: Vec::new(),
        }
        .into(),
        PayloadType::Report => Report {
            topic: "".into(),
            json: String::new(),
        }
        .into(),
        PayloadType::Boxes => Boxes::default().into(),
        PayloadType::GroundTruth => GroundTruth::default().into(),
        PayloadType::Motion => Motion::default().into(),
    }
}

fn name(data_type: &DataType) -> String {
    match data_type {
        DataType::List(item) => format!("List<{}>", name(item.data_type())),
        DataType::FixedSizeList(item, size) => format!("FixedSizeList<{}, {size}>", name(item.data_type())),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_has_the_headers_columns_and_the_payloads() {
        let header = header();
        assert_eq!(
            header[..2],
            [("payload".into(), "Utf8".into()), ("run".into(), "Utf8".into())]
        );
        for of in PayloadType::ALL {
            let (whole, own) = (all(of), payload(of));
            assert_eq!(whole, [&header[..], &own].concat(), "{of}");
        }
        let boxes = payload(PayloadType::Boxes);
        assert!(
            boxes.contains(&("velocity".into(), "List<FixedSizeList<Float64, 3>>".into())),
            "{boxes:?}"
        );
        let truth = payload(PayloadType::GroundTruth);
        assert!(truth.iter().any(|(name, _)| name == "own_views") && truth.len() > boxes.len());
    }
}
