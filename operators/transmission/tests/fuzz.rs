//! Packets that lie about counts, kinds and lengths are messages or errors; what is taken is sound, says the same when it
//! is sent on, and took no more memory than its size allows.
//!
//! `REALO_FUZZ_CASES=1000000 cargo test --release -p realo-transmission --test fuzz` runs as many cases.

use arrow::buffer::Buffer;
use damage::{Draw, cases, most_held};
use nalgebra::{Isometry3, Vector3};
use realo_operator::Steps;
use realo_schemas::{
    AgentState, Box3, Boxes, DType, Elements, FeatureMap, Header, Kind, Message, Payload, PointCloud, Pose, PoseStatus,
};
use realo_transmission::{Content, Decoder, Encoder, EncoderSettings};

/// Largest feature map that the decoders make here, bytes.
const LIMIT: usize = 1 << 18;

/// A box of 34 bytes takes 200, and twice as many more while their list grows. A compressed map or cloud of few bytes may be one of
/// the limit, which is held three times on the way, and zstd has 160 KB of its own.
fn bound(bytes: usize) -> u64 {
    (256 << 10) + 3 * LIMIT as u64 + 32 * bytes as u64
}

fn decode(bytes: &[u8]) -> Option<Content> {
    Decoder::new(LIMIT).ok()?.decode(bytes, &mut Steps::default()).ok()
}

fn header(draw: &mut Draw, kind: Kind) -> Header {
    let agent = draw.pick(&["a", "rsu1", "cooperating-vehicle"]);
    let mut header = Header::origin(&"run".into(), &agent.into(), kind, draw.number(), 1_700_000_000_000, 5);
    if draw.chance(2) {
        header.pose = Some(Pose {
            map_from_frame: Isometry3::translation(1.0, -2.0, 0.5),
            covariance: draw.chance(2).then(|| Box::new([0.25; 36])),
        });
    }
    if draw.chance(4) {
        header.frame = "map".into();
    }
    header
}

fn object(draw: &mut Draw) -> Box3 {
    let track = draw.number() >> draw.pick(&[0, 32, 60]);
    Box3 {
        center: [draw.below(100) as f64, -2.5, 0.5],
        length: 4.5,
        width: 1.875,
        height: 1.5,
        yaw: 0.25,
        velocity: draw.chance(2).then_some([1.5, -0.25, 0.0]),
        class: draw.pick(&["car", "truck", "pedestrian", ""]).into(),
        score: 0.5,
        track: draw.chance(2).then_some(track),
        covariance: draw
            .chance(2)
            .then_some([1.0, 0.5, 0.25, 0.5, 2.0, 0.125, 0.25, 0.125, 0.0625]),
    }
}

fn message(draw: &mut Draw) -> Message {
    let payload: Payload = match draw.below(4) {
        0 => {
            let n = draw.pick(&[0, 1, 50]);
            // Beams that fire in turn, each at its own distance.
            let beams = draw.pick(&[1, 8]);
            let column = |v: f32| (0..n).map(|i| v * (i % beams) as f32).collect::<Vec<f32>>();
            let cloud = PointCloud::new(
                column(1.0),
                column(20.0),
                column(0.5),
                vec![9u8; n],
                (0..n as i32).map(|i| 70_000 * i).collect::<Vec<_>>(),
                (0..n).map(|i| (i % beams) as u16).collect::<Vec<_>>(),
            );
            cloud.unwrap().into()
        }
        1 => Boxes((0..draw.below(9)).map(|_| object(draw)).collect()).into(),
        2 => AgentState {
            map_from_body: Isometry3::translation(5.0, 6.0, 7.0),
            covariance: draw.chance(2).then(|| Box::new([0.5; 36])),
            velocity: draw.chance(2).then(|| Vector3::new(1.0, 2.0, 3.0)),
            angular_rate: draw.chance(2).then(|| Vector3::new(0.0, 0.0, 0.125)),
            status: draw.pick(&PoseStatus::ALL),
        }
        .into(),
        _ => {
            let (rows, columns, channels) = (1 + draw.below(4), 1 + draw.below(4), 1 + draw.below(4));
            let dtype = draw.pick(&[DType::F32, DType::F32, DType::F32, DType::F16, DType::Bf16, DType::U8]);
            FeatureMap {
                rows: rows as u32,
                columns: columns as u32,
                channels: channels as u32,
                cell: 0.5,
                origin: [-1.0, 2.0],
                dtype,
                data: (0..dtype.size() * rows * columns * channels)
                    .map(|_| draw.below(120) as u8)
                    .collect::<Vec<u8>>()
                    .into(),
                model: "0123".into(),
                confidence: Some(
                    (0..rows * columns)
                        .map(|_| draw.below(9) as f32 / 8.0)
                        .collect::<Vec<f32>>()
                        .into(),
                ),
            }
            .into()
        }
    };
    let kind = match &payload {
        Payload::PointCloud(_) => Kind::Points,
        Payload::Boxes(_) => Kind::Boxes,
        Payload::AgentState(_) => Kind::AgentState,
        _ => Kind::Features,
    };
    Message::new(header(draw, kind), payload)
}

fn bytes_of(draw: &mut Draw, message: &Message) -> Vec<u8> {
    let config = EncoderSettings {
        time: draw.chance(2),
        ring: draw.chance(2),
        step_m: draw.pick(&[0.0, 0.01, 0.001]),
        elements: draw.pick(&[Elements::F32, Elements::F16, Elements::Int8]),
        shuffle: draw.chance(2),
        min_confidence: draw.pick(&[0.0, 0.0, 0.3, 1.0]),
        budget_bytes: draw.chance(3).then_some(300),
        zstd: draw.chance(2).then(|| draw.pick(&[-7, 1, 3])),
        ..EncoderSettings::default()
    };
    encode(message, &config)
}

fn encode(message: &Message, config: &EncoderSettings) -> Vec<u8> {
    let encoder = &mut Encoder::new(config).expect("a sound configuration");
    let packed = encoder.encode(message, &mut Steps::default());
    packed.expect("sound messages can be sent").0.bytes.to_vec()
}

/// Whether the bytes were taken.
fn check(case: u64, bytes: &[u8]) -> bool {
    let mut content = None;
    let held = most_held(|| content = decode(bytes));
    assert!(
        held <= bound(bytes.len()),
        "case {case} of {} bytes took {held} bytes",
        bytes.len()
    );
    let Some(content) = content else { return false };
    let sizes = match &content.payload {
        // A quantised cloud of equal points takes no more bytes than an empty one.
        Payload::PointCloud(cloud) if 19 * cloud.len() <= LIMIT => 0,
        Payload::PointCloud(cloud) => 13 * cloud.len(),
        Payload::Boxes(boxes) => 34 * boxes.0.len(),
        Payload::FeatureMap(map) => {
            assert!(map.rows > 0 && map.columns > 0 && map.channels > 0, "case {case}");
            let elements = map.rows as usize * map.columns as usize * map.channels as usize;
            assert_eq!(map.data.len(), elements * map.dtype.size(), "case {case}");
            assert!(map.data.len() <= LIMIT, "case {case}");
            if let Some(confidence) = &map.confidence {
                let cells = map.rows as usize * map.columns as usize;
                assert_eq!(confidence.len(), cells, "case {case}");
                assert!(
                    confidence.iter().all(|confidence| (0.0..=1.0).contains(confidence)),
                    "case {case}"
                );
            }
            if let Ok(numbers) = map.numbers() {
                assert!(numbers.iter().all(|number| number.is_finite()), "case {case}");
            }
            60
        }
        _ => 58,
    };
    assert!(
        sizes <= bytes.len(),
        "case {case}: {sizes} bytes of content from {}",
        bytes.len()
    );
    true
}

#[test]
fn forged_packets_are_messages_or_errors() {
    let (mut taken, mut refused) = (0, 0);
    for case in 0..cases(50_000) {
        let mut draw = Draw::new(case);
        let sound = message(&mut draw);
        let mut bytes = bytes_of(&mut draw, &sound);
        assert!(check(case, &bytes), "case {case}: a sound packet is taken");
        match draw.below(4) {
            // The content of another kind, or of two messages.
            0 => bytes[3] = 1 + draw.below(5) as u8,
            1 => {
                let other = message(&mut draw);
                let other = bytes_of(&mut draw, &other);
                let (at, from) = (draw.below(bytes.len()), draw.below(other.len()));
                bytes.truncate(at);
                bytes.extend(&other[from..]);
            }
            _ => {}
        }
        if !draw.chance(4) {
            draw.damage(&mut bytes);
        }
        match check(case, &bytes) {
            true => taken += 1,
            false => refused += 1,
        }
    }
    assert!(
        taken > refused / 20 && refused > taken / 20,
        "{taken} taken, {refused} refused"
    );
}

#[test]
fn a_map_without_elements_is_refused_on_both_sides() {
    let mut draw = Draw::new(0);
    let map = |rows, columns, channels, bytes: usize| FeatureMap {
        rows,
        columns,
        channels,
        cell: 0.5,
        origin: [0.0; 2],
        dtype: DType::U8,
        data: Buffer::from(vec![0u8; bytes]),
        model: "m".into(),
        confidence: None,
    };
    let header = header(&mut draw, Kind::Features);
    let plain = EncoderSettings {
        elements: Elements::F32,
        shuffle: false,
        zstd: None,
        ..EncoderSettings::default()
    };
    let bytes = encode(&Message::new(header.clone(), map(1, 1, 1, 1)), &plain);
    // Behind the dimensions: cell, origin, type, model, conversion, flags, the element.
    let dimensions = bytes.len() - 1 - 2 - 2 - 1 - 24 - 12;
    assert_eq!(bytes[dimensions..dimensions + 12], [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
    for (k, [rows, columns, channels]) in [[0, 1, 1], [1, 0, 1], [1, 1, 0]].into_iter().enumerate() {
        let mut forged = bytes.clone();
        forged[dimensions + 4 * k] = 0;
        forged[dimensions + 4 * ((k + 1) % 3)..][..4].copy_from_slice(&u32::MAX.to_le_bytes());
        forged.pop();
        let mut decoder = Decoder::new(LIMIT).unwrap();
        let error = decoder
            .decode(&forged, &mut Steps::default())
            .err()
            .unwrap()
            .to_string();
        assert!(
            error.contains("rows, columns and channels") && error.contains("at least 1"),
            "{error}"
        );
        let empty = Message::new(header.clone(), map(rows, columns, channels, 0));
        let mut encoder = Encoder::new(&plain).unwrap();
        let error = encoder.encode(&empty, &mut Steps::default()).unwrap_err().to_string();
        assert!(error.contains("no elements"), "{error}");
    }
}
