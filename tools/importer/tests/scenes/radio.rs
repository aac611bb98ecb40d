//! The measured radio of CooperScene: recordings as its viewer's layout names their topics, written here, become traces for links.

use std::fs;
use std::path::Path;

use realo_link::Profile;

use crate::layouts::COOPERSCENE;
use crate::reading::import;
use crate::world::Agent;
use crate::{AGENTS, layouts};

const T0: u64 = 1_700_000_000_000_000_000;
const MS: u64 = 1_000_000;

/// A message of JSON, or of other bytes, on a topic at a time after the first sweep, ms.
type Said = (&'static str, &'static str, u64, Vec<u8>);

fn throughput(topic: &'static str, ms: u64, mbit: f64) -> Said {
    (
        topic,
        "foxglove.Vector3",
        ms,
        format!(r#"{{"x": {mbit}, "y": 0, "z": 0}}"#).into_bytes(),
    )
}

/// An MCAP file without chunks.
fn mcap(path: &Path, said: &[Said]) {
    let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
    let mut file = b"\x89MCAP0\r\n".to_vec();
    let mut put = |opcode: u8, body: Vec<u8>| {
        file.push(opcode);
        file.extend((body.len() as u64).to_le_bytes());
        file.extend(body);
    };
    put(1, [text(""), text("a test")].concat());
    let mut known: Vec<&str> = Vec::new();
    for (sequence, (topic, kind, ms, data)) in said.iter().enumerate() {
        let id = match known.iter().position(|other| other == topic) {
            Some(id) => id as u16 + 1,
            None => {
                known.push(topic);
                let id = known.len() as u16;
                let number = id.to_le_bytes().to_vec();
                put(3, [number.clone(), text(kind), text("jsonschema"), text("{}")].concat());
                put(
                    4,
                    [number.clone(), number, text(topic), text("json"), text("")].concat(),
                );
                id
            }
        };
        let time = (T0 + ms * MS).to_le_bytes();
        let head = [&id.to_le_bytes()[..], &(sequence as u32).to_le_bytes(), &time, &time].concat();
        put(5, [head, data.clone()].concat());
    }
    put(15, vec![0; 4]);
    put(2, vec![0; 20]);
    file.extend(b"\x89MCAP0\r\n");
    layouts::write(path, &file);
}

/// A take of the set below `test/`.
fn take(data: &Path) {
    let named = |agent: Agent, folder| Agent { folder, ..agent };
    let agents = [named(AGENTS[0], "1"), named(AGENTS[1], "2"), named(AGENTS[2], "0")];
    COOPERSCENE.write(&data.join("test/7"), &agents);
}

#[test]
fn measured_throughputs_become_traces_and_a_profile_for_each_receiver() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("my data"), dir.path().join("out"));
    take(&data);
    mcap(
        &data.join("mcap/7.mcap"),
        &[
            throughput("/1_Throughput_from_agent_2", 0, 1.0),
            ("/0_LIDAR", "foxglove.PointCloud", 40, b"{}".to_vec()),
            throughput("/1_Throughput_from_agent_0", 60, 3.0),
            throughput("/1_Throughput_from_agent_2", 140, 2.0),
            throughput("/0_Throughput_from_agent_1", 150, 1.6),
            ("/0_Throughput_from_agent_1", "foxglove.Vector3", 160, b"{}".to_vec()),
            throughput("/1_Throughput_from_agent_2", 240, 0.0),
            ("/1_Latency_from_agent_2", "foxglove.Vector3", 250, b"{}".to_vec()),
        ],
    );
    let summary = import("cooperscene", &data, &out, &[]).unwrap().remove(0);
    let folder = out.join("test-7.radio");
    let read = |name: &str| fs::read_to_string(folder.join(name)).unwrap();
    let head = "seconds,bits_per_second,delay_ms,loss\n";
    for (name, lines) in [
        (
            "cav_1_from_cav_2.csv",
            "0.000000,1000000,0,0\n0.100000,2000000,0,0\n0.200000,0,0,0\n",
        ),
        ("cav_1_from_rsu_0.csv", "0.000000,3000000,0,0\n"),
        (
            "cav_1_from_all.csv",
            "0.000000,2000000,0,0\n0.100000,2500000,0,0\n0.200000,1500000,0,0\n",
        ),
        ("rsu_0_from_cav_1.csv", "0.000000,1600000,0,0\n"),
    ] {
        assert_eq!(read(name), format!("{head}{lines}"), "{name}");
    }
    for receiver in ["cav_1", "rsu_0"] {
        let profile = folder.join(format!("{receiver}.toml"));
        Profile::load(profile.to_str().unwrap()).unwrap();
    }
    let said = summary.to_string();
    for part in [
        "measured radio: 5 throughputs of 3 ways in",
        "traces begin at the first sweep",
        "left, for their form is not known: /1_Latency_from_agent_2",
        "1 messages cannot be read, the first: `/0_Throughput_from_agent_1`: expected a number `x`",
        "test-7.radio/AGENT.toml",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
}

#[test]
fn a_radio_that_is_missing_or_of_another_form_is_said_and_the_log_is_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (data, log) = (dir.path().join("data"), dir.path().join("log.mcap"));
    take(&data);
    let said = |name: &str| {
        let log = log.with_file_name(name);
        let summary = import("cooperscene", &data.join("test"), &log, &[]).unwrap().remove(0);
        assert!(log.is_file() && !log.with_extension("radio").exists());
        summary.to_string()
    };
    let none = said("none.mcap");
    assert!(
        none.contains("`mcap/` is not imported: there is no `mcap/7.mcap`"),
        "{none}"
    );
    mcap(
        &data.join("mcap/7.mcap"),
        &[("/0_LIDAR", "foxglove.PointCloud", 0, b"{}".to_vec())],
    );
    let other = said("other.mcap");
    assert!(
        other.contains("expected topics `/0_Throughput_from_agent_1` and the like, found /0_LIDAR"),
        "{other}"
    );
}
