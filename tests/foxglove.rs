//! `realo run --foxglove`: viewers of Foxglove's protocol see all channels of a run while it goes on, and the run does not know of it.

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;

use common::python::environment;
use common::watched::{PATIENCE, Watched, options};
use common::{assert_same_files, folder, json, realo, root, text};
use realo_logs::cdr::CdrReader;
use realo_logs::{Schema, boxes, cloud};
use serde_json::{Value, json};

/// Topics of every run over the small log.
const TOPICS: [&str; 11] = [
    "/cav1/points",
    "/rsu1/points",
    "/cav1/boxes",
    "/cav1/boxes_scene",
    "/cav1/boxes_info",
    "/cav1/ground_truth",
    "/cav1/ground_truth_scene",
    "/cav1/footprint",
    "/rsu1/pose",
    "/tf",
    "/reports",
];

/// A viewer as this test plays it.
struct Viewer {
    stream: TcpStream,
    info: Value,
    /// Topic and schema by channel.
    channels: BTreeMap<u64, (String, String)>,
}

impl Viewer {
    fn open(host: &str, more: &str) -> (TcpStream, String) {
        let mut stream = TcpStream::connect(host).expect("it listens");
        stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
        let request = format!(
            "GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{more}\r\n"
        );
        stream.write_all(request.as_bytes()).expect("it listens");
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).expect("it answers");
            head.push(byte[0]);
        }
        (stream, text(&head))
    }

    fn looks(host: &str) -> Self {
        let (stream, head) = Viewer::open(host, "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n");
        assert!(
            head.starts_with("HTTP/1.1 101 ") && head.contains("Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n"),
            "{head}"
        );
        Viewer {
            stream,
            info: Value::Null,
            channels: BTreeMap::new(),
        }
    }

    fn frame(&mut self) -> (u8, Vec<u8>) {
        let mut bytes = |count: usize| {
            let mut bytes = vec![0; count];
            self.stream.read_exact(&mut bytes).expect("the server goes on");
            bytes
        };
        let head = bytes(2);
        let length = match head[1] {
            126 => u64::from(u16::from_be_bytes(bytes(2).try_into().expect("two"))),
            127 => u64::from_be_bytes(bytes(8).try_into().expect("eight")),
            short => u64::from(short),
        };
        (head[0] & 0x0f, bytes(length as usize))
    }

    fn say(&mut self, said: &Value) {
        let said = said.to_string();
        let mut frame = vec![0x81, 0x80 | 126];
        frame.extend((said.len() as u16).to_be_bytes());
        // A mask that changes nothing.
        frame.extend([0; 4]);
        frame.extend(said.as_bytes());
        self.stream.write_all(&frame).expect("the server goes on");
    }

    /// The next message: topic, schema and payload. Asks for every channel that is offered.
    fn message(&mut self) -> (String, String, Vec<u8>) {
        loop {
            match self.frame() {
                (1, said) => self.hear(&serde_json::from_slice(&said).expect("JSON")),
                (2, bytes) if bytes[0] == 1 => {
                    let channel = u64::from(u32::from_le_bytes(bytes[1..5].try_into().expect("four"))) - 7;
                    let (topic, schema) = self.channels[&channel].clone();
                    return (topic, schema, bytes[13..].to_vec());
                }
                (2, bytes) => assert_eq!((bytes[0], bytes.len()), (2, 9), "the time"),
                (kind, _) => assert_eq!(kind, 9, "a ping"),
            }
        }
    }

    fn hear(&mut self, said: &Value) {
        match said["op"].as_str() {
            Some("serverInfo") => self.info = said.clone(),
            Some("advertise") => {
                let channels = said["channels"].as_array().expect("channels");
                let mut asked = Vec::new();
                for channel in channels {
                    let id = channel["id"].as_u64().expect("a number");
                    let word = |name: &str| channel[name].as_str().expect("a text").to_string();
                    assert_eq!((&*word("encoding"), &*word("schemaEncoding")), ("cdr", "ros2msg"));
                    self.channels.insert(id, (word("topic"), word("schemaName")));
                    asked.push(json!({ "id": id + 7, "channelId": id }));
                }
                self.say(&json!({ "op": "subscribe", "subscriptions": asked }));
            }
            _ => panic!("{said}"),
        }
    }

    /// Looks until all these topics have come, and gives how many points and boxes were among them.
    fn until(&mut self, topics: &[&str]) -> (usize, usize) {
        let mut missing: BTreeSet<&str> = topics.iter().copied().collect();
        let (mut points, mut objects) = (0, 0);
        while !missing.is_empty() || points == 0 || objects == 0 {
            let (topic, schema, payload) = self.message();
            missing.remove(&*topic);
            if schema == Schema::PointCloud2.name() {
                points += cloud::decode(&payload).expect("a sweep").1.len();
            } else if topic.ends_with("/boxes") {
                objects += boxes::decode(&payload).expect("boxes").1.0.len();
            } else if topic == "/reports" {
                let report = CdrReader::new(&payload).and_then(|mut input| input.string().map(String::from));
                let report: Value = serde_json::from_str(&report.expect("a text")).expect("JSON");
                assert!(report["topic"].is_string(), "{report}");
            }
        }
        (points, objects)
    }
}

/// The small log's runs with late fusion.
fn watched(out: &Path, more: &[&str]) -> Watched {
    Watched::start(options("late_fusion", out, more), "ws://")
}

#[test]
fn a_viewer_sees_all_channels_of_a_run_on_dora_and_decodes_them() {
    let run = watched(&folder("foxglove_realtime"), &["--foxglove", "0"]);
    let mut viewer = Viewer::looks(&run.host);
    let (points, objects) = viewer.until(&TOPICS);
    assert!(points > 100 && objects > 0, "{points} points, {objects} boxes");
    assert_eq!(viewer.info["capabilities"], json!(["time"]));
    assert!(
        viewer.info["name"]
            .as_str()
            .expect("a name")
            .contains("late_fusion, view_small, cav1")
    );
    run.until("the last run stays at");
    // Who comes late gets the newest of each.
    Viewer::looks(&run.host).until(&TOPICS);
    assert_eq!(run.close(), Some(0), "the run had come to its end");
}

#[test]
fn a_run_in_virtual_time_is_the_same_to_the_bit_when_viewers_look() {
    let (seen, alone) = (folder("foxglove_seen"), folder("foxglove_alone"));
    let link = ["--mode", "virtual", "--link", "delay_ms=60,loss=0.2"];
    let run = watched(&seen, &[&link[..], &["--foxglove", "0"]].concat());
    Viewer::looks(&run.host).until(&TOPICS);
    run.until("the last run stays at");
    assert_eq!(run.close(), Some(0));
    let said = realo(options("late_fusion", &alone, &link));
    assert_eq!(said.status.code(), Some(0), "{}", text(&said.stderr));
    let files = [
        "result.json",
        "view_small/cav1/result.json",
        "view_small/cav1/evaluation.json",
        "view_small/cav1/recording.mcap",
    ];
    assert_same_files(&seen, &alone, &files);
}

#[test]
fn both_views_show_one_run() {
    let out = folder("foxglove_both");
    let both = ["--mode", "virtual", "--foxglove", "0", "--view"];
    let run = watched(&out, &both);
    let page = run.until("watch at http://");
    let page = page
        .split_once("http://")
        .expect("an address")
        .1
        .trim_end_matches('/')
        .to_string();
    run.until("the last run stays at");
    Viewer::looks(&run.host).until(&TOPICS);
    let mut stream = TcpStream::connect(&page).expect("it listens");
    let request = format!("GET / HTTP/1.1\r\nHost: {page}\r\n\r\n");
    stream.write_all(request.as_bytes()).expect("it listens");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    assert!(answer.starts_with("HTTP/1.1 200 "));
    assert_eq!(run.close(), Some(0));
}

#[test]
fn a_client_in_python_decodes_every_topic_by_the_schemas_that_come_with_it() {
    let home = common::folder("foxglove_python").with_file_name("python_foxglove");
    let packages = ["websockets>=13,<18", "mcap>=1.2,<2", "mcap-ros2-support>=0.5,<1"];
    let Some(bin) = environment(&home, &packages, "websockets.asyncio.client, mcap, mcap_ros2.decoder") else {
        return;
    };
    let run = watched(&folder("foxglove_to_python"), &["--mode", "virtual", "--foxglove", "0"]);
    let client = root().join("tests/foxglove/client.py");
    for protocol in ["foxglove.sdk.v1", "foxglove.websocket.v1"] {
        let said = Command::new(bin.join("python"))
            .arg(&client)
            .args([&run.host, protocol])
            .args(TOPICS)
            .output();
        let said = said.expect("it can be started");
        assert!(said.status.success(), "{protocol}: {}", text(&said.stderr));
        let said: Value = serde_json::from_slice(&said.stdout).expect("JSON");
        for (topic, schema) in [
            ("/cav1/points", "sensor_msgs/msg/PointCloud2"),
            ("/cav1/boxes", "vision_msgs/msg/Detection3DArray"),
            ("/cav1/boxes_scene", "foxglove_msgs/msg/SceneUpdate"),
            ("/cav1/boxes_markers", "visualization_msgs/msg/MarkerArray"),
            ("/cav1/ground_truth_info", "realo_msgs/msg/BoxesInfo"),
            ("/tf", "tf2_msgs/msg/TFMessage"),
            ("/cav1/footprint", "geometry_msgs/msg/PolygonStamped"),
        ] {
            assert_eq!(said["channels"][topic], schema, "{topic}: {said}");
        }
        assert!(
            said["points"].as_u64() > Some(100) && said["cubes"].as_u64() > Some(0),
            "{said}"
        );
        assert_eq!(said["time_ran_back"], false, "{said}");
    }
    run.until("the last run stays at");
    assert_eq!(run.close(), Some(0));
}

#[test]
fn the_layout_that_ships_names_topics_that_there_are() {
    let layout = json(&root().join("docs/foxglove-layout.json"));
    let run = watched(&folder("foxglove_layout"), &["--mode", "virtual", "--foxglove", "0"]);
    run.until("the last run stays at");
    let mut viewer = Viewer::looks(&run.host);
    viewer.until(&TOPICS);
    let offered: BTreeSet<&str> = viewer.channels.values().map(|(topic, _)| &**topic).collect();
    let panels = layout["configById"].as_object().expect("panels");
    let shown = |panel: &Value| -> Vec<String> {
        let three = panel["topics"]
            .as_object()
            .into_iter()
            .flat_map(|topics| topics.keys().cloned());
        let path = panel["topicPath"].as_str().and_then(|path| path.split('.').next());
        three.chain(path.map(String::from)).collect()
    };
    let topics: BTreeSet<String> = panels.values().flat_map(shown).collect();
    assert!(topics.len() > 7, "{topics:?}");
    for topic in &topics {
        // Each vehicle is the ego in turn; here it is the first.
        let of_ego = topic.replace("/cav2/", "/cav1/");
        assert!(offered.contains(&*of_ego), "{topic} is not among {offered:?}");
    }
    let drawn: BTreeSet<&str> = offered
        .iter()
        .copied()
        .filter(|topic| {
            ["_scene", "/points", "/footprint"]
                .iter()
                .any(|ending| topic.ends_with(ending))
        })
        .collect();
    assert!(
        drawn.iter().all(|topic| topics.contains(*topic)),
        "{drawn:?} are not all in {topics:?}"
    );
    // Without a field to colour by, viewers choose one, and a map of colours in place of the agent's own.
    let settings = panels
        .values()
        .filter_map(|panel| panel["topics"].as_object())
        .flatten();
    for (topic, settings) in settings.filter(|(topic, _)| topic.ends_with("/points")) {
        let colours = [&settings["colorMode"], &settings["colorField"]];
        assert_eq!(colours, ["flat", "intensity"], "{topic}");
    }
    assert_eq!(run.close(), Some(0));
}

#[test]
fn a_port_that_is_taken_and_an_address_that_is_none_are_errors_before_the_run() {
    let out = folder("foxglove_errors").join("out");
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let at = taken.local_addr().expect("it has an address");
    let said = realo(options(
        "late_fusion",
        &out,
        &["--mode", "virtual", "--foxglove", &at.port().to_string()],
    ));
    let words = text(&said.stderr);
    assert_eq!(said.status.code(), Some(1), "{words}");
    assert!(
        words.contains("--foxglove") && words.contains(&at.to_string()) && words.contains("choose another port"),
        "{words}"
    );
    let said = realo(options("late_fusion", &out, &["--foxglove", "somewhere"]));
    let words = text(&said.stderr);
    assert_eq!(said.status.code(), Some(2), "{words}");
    assert!(words.contains("--foxglove") && words.contains("`somewhere`"), "{words}");
    assert!(!out.exists(), "nothing was run");
}

#[test]
fn clients_that_send_junk_or_stop_reading_do_not_disturb_a_run() {
    let out = folder("foxglove_hostile");
    let mut run = watched(&out, &["--foxglove", "0", "--view-exit"]);
    let host = run.host.clone();
    let mut asleep: Vec<Viewer> = (0..6).map(|_| Viewer::looks(&host)).collect();
    // They ask for all, and read no more.
    asleep.iter_mut().for_each(|viewer| drop(viewer.message()));
    let mut talker = Viewer::looks(&host);
    let talking = std::thread::spawn(move || {
        let mut said = 0;
        let frame = [&[0x81, 0x84, 0, 0, 0, 0][..], b"junk"].concat();
        while talker.stream.write_all(&frame).is_ok() {
            said += 1;
        }
        said
    });
    let hammer = std::thread::spawn(move || {
        let mut times = 0;
        while let Ok(mut stream) = TcpStream::connect(&host) {
            let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: evil\r\n\r\n");
            times += 1;
        }
        times
    });
    let code = run.process.wait().expect("it was started").code();
    let said: Vec<String> = run.lines.try_iter().collect();
    assert_eq!(code, Some(0), "{said:#?}");
    assert!(talking.join().expect("it ends with the server") > 0);
    assert!(hammer.join().expect("it ends with the server") > 0);
    let result = json(&out.join("result.json"));
    assert!(result["frames"]["processed"].as_u64() > Some(0));
    drop(asleep);
}
