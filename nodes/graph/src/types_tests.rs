//! `dataflows/types/realo/v1.yml` says what the wire says.

use std::fmt::Write;
use std::path::Path;

use arrow::datatypes::DataType;
use realo_schemas::wire::to_arrow;
use realo_schemas::{
    AgentState, Boxes, DType, FeatureMap, GroundTruth, Header, Kind, Message, Packet, Payload, PayloadType, PointCloud,
    Pose, PoseStatus, Report, Selection,
};

fn example(payload: PayloadType) -> Payload {
    match payload {
        PayloadType::PointCloud => PointCloud::empty().into(),
        PayloadType::AgentState => AgentState {
            map_from_body: Pose::from_parts([0.0; 3], [0.0, 0.0, 0.0, 1.0]).unwrap().map_from_frame,
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
    }
}

fn name(data_type: &DataType) -> String {
    match data_type {
        DataType::List(item) => format!("List<{}>", name(item.data_type())),
        DataType::FixedSizeList(item, size) => format!("FixedSizeList<{}, {size}>", name(item.data_type())),
        other => other.to_string(),
    }
}

fn about(payload: PayloadType) -> &'static str {
    match payload {
        PayloadType::PointCloud => "Points of one sweep: metres in the header's frame, time in ns from its stamp",
        PayloadType::AgentState => {
            "Where an agent is and how it moves: x y z qx qy qz qw, m/s, rad/s; empty if unknown"
        }
        PayloadType::FeatureMap => {
            "A BEV feature map, [rows (y), columns (x), channels]; cell and origin in metres; cells of confidence 0 are not there"
        }
        PayloadType::Packet => "What crosses a link: codecs, first applied first, and bytes",
        PayloadType::Selection => {
            "The bank's answer to one query; entries follow as entry_0, entry_1, ...: whole messages"
        }
        PayloadType::Report => "Counters, timings or scores as a JSON document",
        PayloadType::Boxes => "Detections in the header's frame: metres, radians, score in [0, 1]",
        PayloadType::GroundTruth => {
            "What is there around the ego, in its true body frame; points is [objects, agents]; own_ is what its own side labelled"
        }
    }
}

/// The whole file, as the wire has it.
fn types_file() -> String {
    let mut text = String::from(
        "# Types of the messages, for `dora validate --strict-types`; graphs name them realo/v1/NAME.\n\
         # A message is one row: the header's fields, then the payload's. A test keeps this file equal to the wire.\n\
         types:\n",
    );
    let header = Header::origin(&"".into(), &"".into(), Kind::Points, 0, 0, 0);
    for payload in PayloadType::ALL {
        let row = to_arrow(&Message {
            header: header.clone(),
            payload: example(payload),
        });
        writeln!(
            text,
            "  {payload}:\n    arrow: Struct\n    description: \"{}\"\n    fields:",
            about(payload)
        )
        .unwrap();
        for field in row.fields() {
            let data_type = name(field.data_type());
            writeln!(text, "      - {{ name: \"{}\", type: \"{data_type}\" }}", field.name()).unwrap();
        }
    }
    text
}

/// The columns of a payload and their types, without the header's.
fn columns(payload: PayloadType) -> Vec<(String, String)> {
    let header = Header::origin(&"".into(), &"".into(), Kind::Points, 0, 0, 0);
    let message = Message {
        header,
        payload: example(payload),
    };
    let row = to_arrow(&message);
    let fields = row.fields().iter();
    let own = fields.skip_while(|field| field.name() != "trace_ready").skip(1);
    own.map(|field| (field.name().clone(), name(field.data_type())))
        .collect()
}

#[test]
fn the_guide_lists_the_columns_of_all_payloads() {
    let guide = include_str!("../../../docs/reference/plugins.md");
    let (_, table) = guide
        .split_once("## Columns of the payloads")
        .expect("the guide has the section");
    let rows = table.split("\n## ").next().unwrap_or_default().lines();
    let cells = rows.filter_map(|row| {
        let cells: Vec<&str> = row.strip_prefix("| ")?.split('|').map(str::trim).collect();
        Some((cells[0], *cells.get(1)?, *cells.get(2)?))
    });
    let listed: Vec<(&str, &str, &str)> = cells.collect();
    for payload in PayloadType::ALL {
        let of = listed.iter().filter(|(name, ..)| *name == payload.to_string());
        let found: Vec<(String, String)> = of
            .flat_map(|(_, columns, kind)| {
                let names = columns.split_whitespace().map(|name| name.trim_matches('`'));
                names.map(|name| (name.to_string(), kind.to_string()))
            })
            .collect();
        assert_eq!(found, columns(payload), "{payload}: docs/reference/plugins.md, wire");
    }
}

#[test]
fn types_file_says_what_the_wire_says() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows/types/realo/v1.yml");
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    let expected = types_file();
    assert!(written == expected, "{} should be:\n{expected}", file.display());
}
