//! `dataflows/types/realo/v1.yml` says what the wire says.

use std::fmt::Write;
use std::path::Path;

use realo_schemas::{PayloadType, layout};

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
        PayloadType::Motion => {
            "What an agent's IMU, GNSS receiver and wheels gave: stamps from the header's stamp, arrivals from its ready, ns; vehicle axes, SI"
        }
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
    for payload in PayloadType::ALL {
        writeln!(
            text,
            "  {payload}:\n    arrow: Struct\n    description: \"{}\"\n    fields:",
            about(payload)
        )
        .unwrap();
        for (name, data_type) in layout::all(payload) {
            writeln!(text, "      - {{ name: \"{name}\", type: \"{data_type}\" }}").unwrap();
        }
    }
    text
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
        assert_eq!(
            found,
            layout::payload(payload),
            "{payload}: docs/reference/plugins.md, wire"
        );
    }
}

#[test]
fn types_file_says_what_the_wire_says() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dataflows/types/realo/v1.yml");
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    let expected = types_file();
    assert!(written == expected, "{} should be:\n{expected}", file.display());
}
