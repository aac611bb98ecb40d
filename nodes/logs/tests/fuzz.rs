//! Files that lie about lengths, counts, nesting and compression are answers or errors, and take no more memory than
//! their size allows.
//!
//! `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-logs --test fuzz` runs as many cases of each test.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use damage::{Draw, cases, most_held};
use mcap::records::op;
use nalgebra::Isometry3;
use realo_logs::cdr::CdrWriter;
use realo_logs::{
    BoxesInfo, FixReading, ImuReading, Log, LogError, McapFile, SentPacket, Stream, WheelReading, boxes, cloud,
    describe_any, motion, packets, pose, views,
};
use realo_schemas::geometry::View;
use realo_schemas::{AgentState, Box3, Boxes, FixQuality, Kind, Nanos, PointCloud, PoseStatus};

const MAGIC: &[u8] = b"\x89MCAP0\r\n";
const START: u64 = 1_700_000_000_000_000_000;

/// Memory that a file may take: four times what its largest chunk may unpack to.
fn bound(bytes: usize) -> u64 {
    4 * ((16 << 20) + 1024 * bytes as u64)
}

/// A folder in memory where there is one: a case is a file.
fn folder() -> tempfile::TempDir {
    let shm = Path::new("/dev/shm");
    match shm.is_dir() {
        true => tempfile::tempdir_in(shm).unwrap(),
        false => tempfile::tempdir().unwrap(),
    }
}

/// Reads everything that a file may hold, as all readers of the project do.
fn read(path: &Path) -> Result<u64, LogError> {
    let mut read = 0;
    if let Ok(file) = McapFile::open(path) {
        let mut messages = file.messages(file.channels().keys().copied().collect(), 0..u64::MAX)?;
        while let Ok(Some(message)) = messages.next() {
            read += 1 + message.data().len() as u64 / (1 << 40);
        }
        for id in file.channels().keys() {
            let _ = file.times_of(*id);
        }
    }
    let _ = describe_any(path).map(|described| (described.to_string(), serde_json::to_string(&described)));
    let log = Log::open(path)?;
    let _ = log.key_frames();
    let agents: Vec<String> = log.info().agents.iter().map(|agent| agent.name.clone()).collect();
    let wanted: Vec<(&str, Stream)> = agents
        .iter()
        .flat_map(|agent| Stream::ALL.map(|stream| (agent.as_str(), stream)))
        .filter(|(agent, stream)| log.has(agent, *stream))
        .collect();
    let mut reader = log.read_all(&wanted)?;
    let mut last = Nanos::MIN;
    let mut kept: BTreeMap<(String, Stream), Boxes> = BTreeMap::new();
    while let Some(entry) = reader.next()? {
        assert!(log.truncation().is_none() || log.span().is_none_or(|(_, end)| entry.ready() <= end));
        last = last.max(entry.ready());
        match entry.stream {
            Stream::Points => drop(entry.cloud().map(|cloud| assert_eq!(cloud.x.len(), cloud.time.len()))),
            Stream::Pose | Stream::PoseTruth => drop(entry.pose()),
            Stream::Sweeps => drop(entry.header_stamp()),
            Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                if let Ok(boxes) = entry.boxes() {
                    kept.insert((entry.agent.to_string(), entry.stream), boxes);
                }
            }
            Stream::DetectionsInfo | Stream::GroundTruthInfo | Stream::OwnLabelsInfo => {
                let array = match entry.stream {
                    Stream::DetectionsInfo => Stream::Detections,
                    Stream::GroundTruthInfo => Stream::GroundTruth,
                    _ => Stream::OwnLabels,
                };
                let mut boxes = kept.remove(&(entry.agent.to_string(), array)).unwrap_or_default();
                let _ = entry.info(&mut boxes);
            }
            Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                if let Ok(views) = entry.views() {
                    assert!(views.into_iter().all(|view| view.checked().is_ok()));
                }
            }
            Stream::GroundTruthMarkers => {}
            Stream::Packets => drop(entry.packet()),
            Stream::Imu | Stream::Fix | Stream::Wheels => {
                if let Ok(motion) = entry.motion() {
                    assert_eq!(motion.fault(), None);
                }
            }
        }
        read += 1;
    }
    Ok(read)
}

/// A file in the making, whose lengths lie now and then.
struct Forge<'a> {
    draw: &'a mut Draw,
    /// One length in so many lies; 0: none.
    lies: usize,
    out: Vec<u8>,
}

impl Forge<'_> {
    fn lie(&mut self, truth: u64) -> u64 {
        match self.lies != 0 && self.draw.chance(self.lies) {
            true => self.draw.length(truth),
            false => truth,
        }
    }

    fn u16(&mut self, value: u16) {
        self.out.extend(value.to_le_bytes());
    }

    fn u32(&mut self, value: u32) {
        self.out.extend(value.to_le_bytes());
    }

    fn u64(&mut self, value: u64) {
        self.out.extend(value.to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        let length = self.lie(text.len() as u64) as u32;
        self.u32(length);
        self.out.extend(text.as_bytes());
    }

    /// What `write` appends, behind a length of 32 bits.
    fn sized(&mut self, write: impl FnOnce(&mut Self)) {
        let outer = std::mem::take(&mut self.out);
        write(self);
        let inner = std::mem::replace(&mut self.out, outer);
        let length = self.lie(inner.len() as u64) as u32;
        self.u32(length);
        self.out.extend(inner);
    }

    /// A record; returns where it begins and how long it really is.
    fn record(&mut self, opcode: u8, write: impl FnOnce(&mut Self)) -> (u64, u64) {
        let at = self.out.len() as u64;
        let outer = std::mem::take(&mut self.out);
        write(self);
        let body = std::mem::replace(&mut self.out, outer);
        self.out.push(opcode);
        let length = self.lie(body.len() as u64);
        self.u64(length);
        self.out.extend(body);
        (at, self.out.len() as u64 - at)
    }

    fn map(&mut self, entries: &[(&str, String)]) {
        self.sized(|forge| {
            for (key, value) in entries {
                forge.text(key);
                forge.text(value);
            }
        });
    }

    fn definitions(&mut self, channels: &[Channel]) {
        for (id, channel) in channels.iter().enumerate() {
            let id = id as u16;
            self.record(op::SCHEMA, |forge| {
                forge.u16(id + 1);
                forge.text(channel.schema);
                forge.text("ros2msg");
                forge.sized(|forge| forge.out.extend(b"x"));
            });
            self.record(op::CHANNEL, |forge| {
                forge.u16(id);
                forge.u16(id + 1);
                forge.text(&channel.topic);
                forge.text("cdr");
                forge.map(&[]);
            });
        }
    }

    fn message(&mut self, channel: u16, sequence: u32, time: u64, stamp: u64, payload: &[u8]) {
        let time = if self.lies != 0 && self.draw.chance(60) {
            self.draw.length(time)
        } else {
            time
        };
        self.record(op::MESSAGE, |forge| {
            forge.u16(channel);
            forge.u32(sequence);
            forge.u64(time);
            forge.u64(stamp);
            forge.out.extend(payload);
        });
    }
}

struct Channel {
    topic: String,
    schema: &'static str,
    payloads: Vec<Vec<u8>>,
}

fn object() -> Box3 {
    Box3 {
        center: [10.0, -4.0, 0.8],
        length: 4.5,
        width: 1.9,
        height: 1.6,
        yaw: 0.3,
        velocity: Some([1.0, 0.0, 0.0]),
        class: "car".into(),
        score: 1.0,
        track: Some(7),
        covariance: None,
    }
}

/// Two agents with every stream; the second one's points lie in a frame of their own.
fn channels() -> Vec<Channel> {
    let mut channels = Vec::new();
    let stamp = |k: u64| (START + k * 100_000_000) as Nanos;
    let payloads = |encode: &dyn Fn(&mut Vec<u8>, u64)| {
        let payload = |k| {
            let mut out = Vec::new();
            encode(&mut out, k);
            out
        };
        (0..3).map(payload).collect::<Vec<_>>()
    };
    let state = AgentState {
        map_from_body: Isometry3::translation(1.0, 2.0, 3.0),
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    let column = |v: f32| vec![v; 20];
    let points = PointCloud::new(
        column(1.0),
        column(2.0),
        column(0.5),
        vec![9u8; 20],
        vec![1i32; 20],
        vec![3u16; 20],
    );
    let points = points.unwrap();
    let info = BoxesInfo {
        key: true,
        agents: vec!["a".into()],
        points: Some(vec![5]),
        ..BoxesInfo::default()
    };
    let packet = SentPacket {
        seq: 3,
        kind: Kind::Features,
        frame: "a/body".into(),
        codec: vec!["plain".into()],
        bytes: (0..99).collect(),
    };
    let imu = ImuReading {
        angular_rate: [0.1, 0.2, 0.3],
        specific_force: [0.0, 0.5, 9.8],
        variance: Some([1e-6, 1e-4]),
    };
    let fix = FixReading {
        quality: Some(FixQuality::Single),
        geodetic: [48.1, 11.6, 519.0],
        covariance: Some([1.0; 9]),
    };
    let wheels = WheelReading {
        velocity: [5.0, 0.0, 0.0],
        variance: None,
    };
    let view = View {
        frame_from_camera: Isometry3::translation(0.0, 0.0, 1.5),
        focal: [800.0, 800.0],
        center: [960.0, 540.0],
        size: [1920, 1080],
        margin: 1.0,
    };
    for agent in ["a", "b"] {
        let (body, sensor) = (format!("{agent}/body"), if agent == "b" { "b/lidar" } else { "a/body" });
        for stream in Stream::ALL {
            let payloads = match stream {
                Stream::Pose | Stream::PoseTruth => payloads(&|out, k| pose::encode(out, stamp(k), "map", &state)),
                Stream::Sweeps => payloads(&|out, k| CdrWriter::new(out).header(stamp(k), &body)),
                Stream::Points => payloads(&|out, k| cloud::encode(out, stamp(k), sensor, &points)),
                Stream::Detections | Stream::GroundTruth | Stream::OwnLabels => {
                    payloads(&|out, k| boxes::encode(out, stamp(k), &body, &[object()]))
                }
                Stream::DetectionsInfo | Stream::GroundTruthInfo | Stream::OwnLabelsInfo => {
                    payloads(&|out, k| boxes::encode_info(out, stamp(k), &body, &[object()], &info))
                }
                Stream::GroundTruthViews | Stream::OwnLabelsViews => {
                    payloads(&|out, k| views::encode(out, stamp(k), &body, &[view.clone(), view.clone()]))
                }
                Stream::GroundTruthMarkers => {
                    payloads(&|out, k| boxes::encode_markers(out, stamp(k), &body, "x", &[object()]))
                }
                Stream::Packets => payloads(&|out, k| packets::encode(out, stamp(k), &packet)),
                Stream::Imu => payloads(&|out, k| motion::encode_imu(out, stamp(k), sensor, &imu)),
                Stream::Fix => payloads(&|out, k| motion::encode_fix(out, stamp(k), &body, &fix)),
                Stream::Wheels => payloads(&|out, k| motion::encode_wheels(out, stamp(k), &body, &wheels)),
            };
            channels.push(Channel {
                topic: stream.topic(agent),
                schema: stream.schema().name().leak(),
                payloads,
            });
        }
    }
    let moved = Isometry3::translation(0.0, 0.0, 1.8);
    channels.push(Channel {
        topic: "/tf_static".into(),
        schema: "tf2_msgs/msg/TFMessage",
        payloads: payloads(&|out, k| pose::encode_transform(out, stamp(k), "b/body", "b/lidar", &moved)),
    });
    channels
}

fn agents() -> String {
    let agent = |name: &str| format!(r#"{{"name":"{name}","kind":"vehicle","footprint":[-1.0,3.0,-1.0,1.0]}}"#);
    format!("[{},{}]", agent("a"), agent("b"))
}

struct Entry {
    at: (u64, u64),
    channels: Vec<u16>,
    packed: u64,
    unpacked: u64,
}

fn lz4(data: &[u8]) -> Vec<u8> {
    let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
    encoder.write_all(data).unwrap();
    let (packed, result) = encoder.finish();
    result.unwrap();
    packed
}

/// A file of our sort. Without lies it is sound, with an index or without.
fn forge(draw: &mut Draw, channels: &[Channel], lies: usize) -> Vec<u8> {
    let indexed = !draw.chance(3);
    let mut f = Forge {
        draw,
        lies,
        out: MAGIC.to_vec(),
    };
    f.record(op::HEADER, |f| {
        f.text("ros2");
        f.text("fuzz");
    });
    let entries = [
        ("format", "1".to_string()),
        ("program", "fuzz".into()),
        ("source", "fuzz".into()),
        ("agents", agents()),
        ("map_frame", "map".into()),
        ("protocol", "default".into()),
        ("key_frames", "all".into()),
        ("end", (START + 300_000_000).to_string()),
    ];
    let mut metadata = vec![f.record(op::METADATA, |f| {
        f.text("realo");
        f.map(&entries);
    })];
    let mut chunks = Vec::new();
    let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
    for k in 0..3u64 {
        let mut members: Vec<u16> = (0..channels.len() as u16).collect();
        if f.lies != 0 {
            let wanted = f.draw.below(6);
            members.retain(|_| f.draw.chance(6) || wanted == 0);
        }
        let outer = std::mem::take(&mut f.out);
        if k == 0 || f.draw.chance(2) {
            f.definitions(channels);
        }
        for id in &members {
            let time = START + k * 100_000_000 + 50_000_000;
            let mut payload = channels[usize::from(*id)].payloads[k as usize].clone();
            if f.lies != 0 && f.draw.chance(12) {
                f.draw.damage(&mut payload);
            }
            f.message(*id, k as u32, time, START + k * 100_000_000, &payload);
            *counts.entry(*id).or_default() += 1;
        }
        if f.lies != 0 && f.draw.chance(8) {
            // A record that does not belong into a chunk, or zeros that pack well.
            let opcode = f.draw.pick(&[
                op::CHUNK,
                op::METADATA,
                op::FOOTER,
                op::DATA_END,
                op::ATTACHMENT,
                0,
                0x99,
            ]);
            let zeros = f.draw.pick(&[0, 40, 1000, 200_000]);
            f.record(opcode, |f| f.out.extend(vec![0; zeros]));
        }
        let records = std::mem::replace(&mut f.out, outer);
        let outside = f.lies != 0 && f.draw.chance(10);
        if outside {
            f.out.extend(records);
            continue;
        }
        let (compression, packed) = match f.draw.below(3) {
            0 => ("", records.clone()),
            1 => ("zstd", zstd::bulk::compress(&records, 1).unwrap()),
            _ => ("lz4", lz4(&records)),
        };
        let (first, last) = (
            START + k * 100_000_000 + 50_000_000,
            START + k * 100_000_000 + 50_000_000,
        );
        let mut packed_bytes = packed;
        if f.lies != 0 && f.draw.chance(12) {
            f.draw.damage(&mut packed_bytes);
        }
        let said = if f.lies != 0 && f.draw.chance(20) {
            "zstd"
        } else {
            compression
        };
        let at = f.record(op::CHUNK, |f| {
            f.u64(first);
            f.u64(last);
            let size = f.lie(records.len() as u64);
            f.u64(size);
            let crc = if f.lies == 0 || f.draw.chance(2) {
                crc32fast::hash(&records)
            } else {
                0
            };
            f.u32(crc);
            f.text(said);
            let length = f.lie(packed_bytes.len() as u64);
            f.u64(length);
            f.out.extend(&packed_bytes);
        });
        chunks.push(Entry {
            at,
            channels: members,
            packed: packed_bytes.len() as u64,
            unpacked: records.len() as u64,
        });
        if f.draw.chance(2) {
            f.record(op::MESSAGE_INDEX, |f| {
                f.u16(0);
                f.sized(|_| {});
            });
        }
    }
    metadata.push(f.record(op::METADATA, |f| {
        f.text("realo_end");
        f.map(&[("key_frames", r#"{"a":[1]}"#.into())]);
    }));
    f.record(op::DATA_END, |f| f.u32(0));
    let summary = f.out.len();
    if indexed {
        write_index(&mut f, channels, &chunks, &metadata, &counts);
    }
    let start = if indexed { f.lie(summary as u64) } else { 0 };
    let body = [start.to_le_bytes(), 0u64.to_le_bytes()].concat();
    let mut footer = vec![op::FOOTER];
    footer.extend(20u64.to_le_bytes());
    footer.extend(body);
    let checked = f.lies == 0 || f.draw.chance(2);
    let crc = if checked {
        crc32fast::hash(&[&f.out[summary..], &footer].concat())
    } else {
        0
    };
    footer.extend(crc.to_le_bytes());
    f.out.extend(footer);
    f.out.extend(MAGIC);
    f.out
}

fn write_index(
    f: &mut Forge,
    channels: &[Channel],
    chunks: &[Entry],
    metadata: &[(u64, u64)],
    counts: &BTreeMap<u16, u64>,
) {
    f.definitions(channels);
    f.record(op::STATISTICS, |f| {
        let total = f.lie(counts.values().sum());
        f.u64(total);
        f.u16(channels.len() as u16);
        f.u32(channels.len() as u32);
        f.u32(0);
        f.u32(metadata.len() as u32);
        let n = f.lie(chunks.len() as u64) as u32;
        f.u32(n);
        let (first, last) = (f.lie(START + 50_000_000), f.lie(START + 250_000_000));
        f.u64(first);
        f.u64(last);
        f.sized(|f| {
            for (id, count) in counts {
                f.u16(*id);
                let count = f.lie(*count);
                f.u64(count);
            }
        });
    });
    for (k, chunk) in chunks.iter().enumerate() {
        // The same chunk over and over.
        let times = if f.lies != 0 && f.draw.chance(20) { 40 } else { 1 };
        for _ in 0..times {
            f.record(op::CHUNK_INDEX, |f| {
                let time = START + k as u64 * 100_000_000 + 50_000_000;
                let (first, last) = (f.lie(time), f.lie(time));
                let (at, length) = (f.lie(chunk.at.0), f.lie(chunk.at.1));
                [first, last, at, length].into_iter().for_each(|v| f.u64(v));
                f.sized(|f| {
                    for id in &chunk.channels {
                        f.u16(*id);
                        f.u64(0);
                    }
                });
                f.u64(0);
                f.text("zstd");
                let (packed, unpacked) = (f.lie(chunk.packed), f.lie(chunk.unpacked));
                f.u64(packed);
                f.u64(unpacked);
            });
        }
    }
    for (offset, length) in metadata {
        f.record(op::METADATA_INDEX, |f| {
            let (offset, length) = (f.lie(*offset), f.lie(*length));
            f.u64(offset);
            f.u64(length);
            f.text("realo");
        });
    }
}

/// Runs a case; its number and file say what failed.
fn check(path: &Path, case: u64, bytes: &[u8]) -> Option<u64> {
    fs::write(path, bytes).unwrap();
    let mut outcome = None;
    let run = std::panic::AssertUnwindSafe(|| most_held(|| outcome = read(path).ok()));
    let held = std::panic::catch_unwind(run).unwrap_or_else(|panic| {
        let kept = keep(bytes, case);
        panic!(
            "case {case} panics, its file is `{}`: {:?}",
            kept.display(),
            panic.downcast_ref::<String>()
        )
    });
    if held > bound(bytes.len()) {
        let kept = keep(bytes, case);
        panic!(
            "case {case} of {} bytes took {held} bytes, its file is `{}`",
            bytes.len(),
            kept.display()
        );
    }
    outcome
}

fn keep(bytes: &[u8], case: u64) -> PathBuf {
    let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("fuzz-{case}.mcap"));
    fs::write(&kept, bytes).unwrap();
    kept
}

/// Seeds that stay in every run: sound files, and cases that went wrong once.
const KEPT: [u64; 8] = [0, 1, 2, 3, 5, 8, 13, 21];

#[test]
fn forged_structure_is_an_answer_or_an_error() {
    let dir = folder();
    let path = dir.path().join("a.mcap");
    let channels = channels();
    let all = 3 * channels.len() as u64;
    for seed in KEPT {
        let sound = forge(&mut Draw::new(seed), &channels, 0);
        let streams = 3 * 2 * Stream::ALL.len() as u64;
        assert_eq!(check(&path, seed, &sound), Some(all + streams), "seed {seed}");
    }
    let (mut opened, mut refused) = (0, 0);
    for case in KEPT.into_iter().chain(0..cases(12_000)) {
        let mut draw = Draw::new(case);
        let lies = draw.pick(&[20, 100, 400, 1000]);
        let mut bytes = forge(&mut draw, &channels, lies);
        if draw.chance(4) {
            draw.damage(&mut bytes);
        }
        match check(&path, case, &bytes) {
            Some(_) => opened += 1,
            None => refused += 1,
        }
    }
    // Both must be common, or the cases test nothing.
    assert!(
        opened > refused / 50 && refused > opened / 50,
        "{opened} opened, {refused} refused"
    );
}

#[test]
fn damaged_files_of_others_are_answers_or_errors() {
    let Some(shared) = skipped::shared("data/mcap-conformance") else {
        return;
    };
    let mut files = Vec::new();
    for folder in fs::read_dir(shared).unwrap() {
        let Ok(entries) = fs::read_dir(folder.unwrap().path()) else {
            continue;
        };
        files.extend(
            entries
                .map(|entry| entry.unwrap().path())
                .filter(|path| path.extension().is_some_and(|e| e == "mcap")),
        );
    }
    files.sort();
    let files: Vec<Vec<u8>> = files.iter().map(|path| fs::read(path).unwrap()).collect();
    assert!(files.len() > 100);
    let dir = folder();
    let path = dir.path().join("a.mcap");
    for case in 0..cases(6_000) {
        let mut draw = Draw::new(case ^ 0x5eed);
        let mut bytes = files[draw.below(files.len())].clone();
        draw.damage(&mut bytes);
        check(&path, case, &bytes);
    }
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// A file of one chunk.
fn one_chunk(compression: &str, size: u64, packed: &[u8]) -> Vec<u8> {
    let mut chunk = vec![0; 16];
    chunk.extend(size.to_le_bytes());
    chunk.extend(0u32.to_le_bytes());
    put_text(&mut chunk, compression);
    chunk.extend((packed.len() as u64).to_le_bytes());
    chunk.extend(packed);
    let mut out = MAGIC.to_vec();
    out.push(op::HEADER);
    out.extend(8u64.to_le_bytes());
    out.extend([0; 8]);
    out.push(op::CHUNK);
    out.extend((chunk.len() as u64).to_le_bytes());
    out.extend(chunk);
    out
}

#[test]
fn a_record_longer_than_its_chunk_cuts_the_file_there() {
    let dir = folder();
    let path = dir.path().join("a.mcap");
    for length in [1u64 << 62, 1 << 63, u64::MAX, u64::MAX - 8, 1 << 40] {
        let mut record = vec![op::MESSAGE];
        record.extend(length.to_le_bytes());
        for (compression, packed) in [
            ("", record.clone()),
            ("lz4", lz4(&record)),
            ("zstd", zstd::bulk::compress(&record, 1).unwrap()),
        ] {
            let bytes = one_chunk(compression, record.len() as u64, &packed);
            fs::write(&path, &bytes).unwrap();
            let mut cut = None;
            let held = most_held(|| cut = McapFile::open(&path).unwrap().truncation().cloned());
            let reason = cut.unwrap().reason;
            assert!(
                reason.contains(&format!("a record of {length} bytes in a chunk with 0 bytes left")),
                "{compression}: {reason}"
            );
            assert!(held < 1 << 20, "{compression}: {held}");
        }
    }
}

#[test]
fn small_chunks_that_unpack_to_much_do_not_add_up() {
    let dir = folder();
    let path = dir.path().join("a.mcap");
    let mut f = Forge {
        draw: &mut Draw::new(0),
        lies: 0,
        out: Vec::new(),
    };
    f.record(op::CHANNEL, |f| {
        f.u16(0);
        f.u16(0);
        f.text("/x");
        f.text("cdr");
        f.map(&[]);
    });
    f.message(0, 0, 5, 5, &vec![0; 15 << 20]);
    let records = f.out;
    let packed = zstd::bulk::compress(&records, 1).unwrap();
    let mut bytes = one_chunk("zstd", records.len() as u64, &packed);
    let chunk = bytes[MAGIC.len() + 17..].to_vec();
    (0..29).for_each(|_| bytes.extend(&chunk));
    fs::write(&path, &bytes).unwrap();
    let file = McapFile::open(&path).unwrap();
    assert_eq!(file.channels()[&0].messages, 30);
    let mut error = None;
    let held = most_held(|| {
        let mut messages = file.messages([0].into(), 0..u64::MAX).unwrap();
        let first = messages.next();
        error = first.err().map(|error| error.to_string());
    });
    assert!(
        30 * (15 << 20) > bound(bytes.len()) && held < bound(bytes.len()),
        "{held} of {}",
        bytes.len()
    );
    assert!(error.unwrap().contains("chunks that overlap in time unpack to"));
}
