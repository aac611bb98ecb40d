use arrow::buffer::Buffer;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use proptest::prelude::*;
use realo_operator::{Operator, Outputs, PortId, Steps};
use realo_schemas::{
    AgentState, Box3, Boxes, DType, Elements, FeatureMap, Header, Kind, Message, Name, Nanos, Packet, Payload,
    PointCloud, Pose, PoseStatus,
};

use super::*;
use crate::{DecoderSettings, EncoderSettings, TransmissionDecoder, TransmissionEncoder};

fn pose() -> Pose {
    let covariance =
        std::array::from_fn(|i| f64::from(1u32 << (i / 6).min(i % 6)) / f64::from(1u32 << (i / 6).max(i % 6)));
    Pose {
        map_from_frame: Isometry3::from_parts(
            Vector3::new(100_000.123_456_789, -2e5, 3.25).into(),
            UnitQuaternion::from_euler_angles(0.01, -0.02, 2.5),
        ),
        covariance: Some(Box::new(covariance)),
    }
}

fn header(kind: Kind) -> Header {
    let (run, agent): (Name, Name) = ("run".into(), "rsu1".into());
    let mut header = Header::origin(
        &run,
        &agent,
        kind,
        41,
        1_700_000_000_123_456_789,
        1_700_000_000_223_456_789,
    );
    header.pose = Some(pose());
    header
}

fn object(i: u32) -> Box3 {
    Box3 {
        center: [f64::from(i) * 1.5, -20.25, 0.5],
        length: 4.5,
        width: 1.875,
        height: 1.5,
        yaw: -3.125,
        velocity: Some([1.5, -0.25, 0.0]),
        class: ["Car", "Pedestrian", "ConcreteTruck"][i as usize % 3].into(),
        score: 0.1 + 0.01 * i as f32,
        track: Some(u64::from(i) + 4_000_000_000),
        covariance: Some([1.0, 0.5, 0.25, 0.5, 2.0, 0.125, 0.25, 0.125, 0.0625]),
    }
}

fn messages() -> Vec<Message> {
    let bare = Box3 {
        velocity: None,
        track: None,
        covariance: None,
        ..object(7)
    };
    let long = Box3 {
        track: Some(u64::MAX),
        ..object(8)
    };
    let mut boxes: Vec<Box3> = (0..5).map(object).collect();
    boxes.extend([bare, long]);
    let cloud = PointCloud::new(
        vec![1.5f32, -2.0],
        vec![0.1f32, 3.0],
        vec![0.0f32, -1.6],
        vec![7u8, 255],
        vec![-50_000_000, 50_000_000],
        vec![0u16, 127],
    );
    let state = AgentState {
        map_from_body: pose().map_from_frame,
        covariance: pose().covariance,
        velocity: Some(Vector3::new(13.9, 0.1, -0.01)),
        angular_rate: Some(Vector3::new(0.0, 0.001, 0.2)),
        status: PoseStatus::Extrapolated,
    };
    let map = FeatureMap {
        rows: 2,
        columns: 3,
        channels: 4,
        cell: 0.8,
        origin: [-102.4, -40.0],
        dtype: DType::F16,
        data: Buffer::from((0..48).collect::<Vec<u8>>()),
        model: "0123abcd".into(),
        confidence: None,
    };
    let bare_state = AgentState {
        covariance: None,
        velocity: None,
        angular_rate: None,
        ..state.clone()
    };
    let mut no_pose = header(Kind::Boxes);
    no_pose.pose = None;
    no_pose.frame = "map".into();
    vec![
        Message::new(header(Kind::Boxes), Boxes(boxes)),
        Message::new(no_pose, Boxes::default()),
        Message::new(header(Kind::Points), cloud.unwrap()),
        Message::new(header(Kind::Points), PointCloud::empty()),
        Message::new(header(Kind::AgentState), state),
        Message::new(header(Kind::AgentState), bare_state),
        Message::new(header(Kind::Features), map),
    ]
}

/// Everything crosses as it is.
const ALL: EncoderSettings = EncoderSettings {
    follow: false,
    detected: false,
    covered: 1.0,
    time: true,
    ring: true,
    step_m: 0.0,
    elements: Elements::F32,
    shuffle: false,
    min_confidence: 0.0,
    budget_bytes: None,
    zstd: None,
    boxes: BoxesLayout::Plain,
    origin: Geodetic {
        latitude_deg: 0.0,
        longitude_deg: 0.0,
        height_m: 0.0,
    },
    roadside: String::new(),
    max_objects: 255,
};

/// Largest map that is made in these tests, bytes.
const LIMIT: usize = 1 << 20;

fn packed(message: &Message, config: &EncoderSettings) -> Result<(Packet, Dropped), EncodeError> {
    Encoder::new(config)?.encode(message, &mut Steps::default())
}

fn encode(message: &Message, config: &EncoderSettings) -> Result<(Vec<u8>, Dropped), EncodeError> {
    packed(message, config).map(|(packet, dropped)| (packet.bytes.to_vec(), dropped))
}

fn decode(bytes: &[u8]) -> Result<Content, DecodeError> {
    Decoder::new(LIMIT).unwrap().decode(bytes, &mut Steps::default())
}

#[test]
fn what_comes_out_is_what_went_in() {
    for message in messages() {
        let (packet, dropped) = packed(&message, &ALL).unwrap();
        let found = decode(&packet.bytes).unwrap();
        let found = found.into_message(message.header.clone(), &packet.codec).unwrap();
        assert_eq!(dropped, Dropped::default());
        assert_eq!(found.header, message.header);
        match (&found.payload, &message.payload) {
            (Payload::Boxes(found), Payload::Boxes(expected)) => {
                assert_eq!(found.0, expected.0, "all numbers of these boxes are exact in f32");
            }
            (found, expected) => assert_eq!(found, expected),
        }
    }
}

#[test]
fn fifty_boxes_with_everything_known_fit_four_kilobytes() {
    let message = Message::new(header(Kind::Boxes), Boxes((0..50).map(object).collect()));
    let (bytes, _) = encode(&message, &EncoderSettings::default()).unwrap();
    assert!(bytes.len() <= 4000, "{} bytes", bytes.len());
}

#[test]
fn invalid_boxes_and_points_stay_behind_and_are_counted() {
    let nan = Box3 {
        center: [f64::NAN, 0.0, 0.0],
        ..object(0)
    };
    let flat = Box3 {
        height: 0.0,
        ..object(0)
    };
    let far = Box3 {
        center: [1e300, 0.0, 0.0],
        ..object(0)
    };
    let fast = Box3 {
        velocity: Some([f64::INFINITY, 0.0, 0.0]),
        ..object(0)
    };
    let message = Message::new(header(Kind::Boxes), Boxes(vec![nan, flat, object(1), far, fast]));
    let (bytes, dropped) = encode(&message, &ALL).unwrap();
    assert_eq!(dropped.boxes, 4);
    let Payload::Boxes(found) = decode(&bytes).unwrap().payload else {
        panic!("not boxes")
    };
    assert_eq!(found.0, [object(1)]);

    let x = vec![1.0f32, f32::NAN, 3.0];
    let y = vec![1.0f32, 2.0, f32::NEG_INFINITY];
    let cloud = PointCloud::new(x, y, vec![0.0f32; 3], vec![9u8, 8, 7], vec![1, 2, 3], vec![4u16, 5, 6]).unwrap();
    let (bytes, dropped) = encode(&Message::new(header(Kind::Points), cloud), &EncoderSettings::default()).unwrap();
    assert_eq!(dropped.points, 2);
    let Payload::PointCloud(found) = decode(&bytes).unwrap().payload else {
        panic!("not points")
    };
    assert_eq!((found.x.to_vec(), found.intensity.to_vec()), (vec![1.0], vec![9]));
    assert_eq!(
        (found.time.to_vec(), found.ring.to_vec()),
        (vec![0], vec![0]),
        "columns that did not cross are 0"
    );
}

#[test]
fn refuses_to_send_what_no_link_carries() {
    let error = encode(&Message::new(header(Kind::Points), Boxes::default()), &ALL)
        .unwrap_err()
        .to_string();
    assert!(error.contains("Boxes") && error.contains("points"), "{error}");
    let mut bad = header(Kind::Boxes);
    bad.pose = Some(Pose::exact(Isometry3::translation(f64::NAN, 0.0, 0.0)));
    assert_eq!(
        encode(&Message::new(bad, Boxes::default()), &ALL),
        Err(EncodeError::NotFinite("pose"))
    );
}

#[test]
fn every_cut_and_every_extra_byte_is_refused() {
    for message in messages() {
        let (mut bytes, _) = encode(&message, &ALL).unwrap();
        for length in 0..bytes.len() {
            let error = decode(&bytes[..length])
                .err()
                .expect("a part of a message is no message");
            assert!(
                matches!(error, DecodeError::Truncated { .. }),
                "{length} bytes: {error}"
            );
        }
        bytes.push(0);
        assert!(matches!(decode(&bytes), Err(DecodeError::Trailing(1))));
    }
}

#[test]
fn numbers_that_cannot_be_are_refused() {
    let (bytes, _) = encode(&messages()[0], &ALL).unwrap();
    let changed = |at: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[at] = value;
        decode(&bytes).err().map(|error| error.to_string()).unwrap_or_default()
    };
    assert!(changed(0, b'x').contains("`magic`"));
    assert!(changed(2, 9).contains("`version`: expected 2, found 9: run one release"));
    assert!(changed(3, 5).contains("`content`"));
    assert!(changed(4, 0xff).contains("`flags of the envelope`"));
    assert!(changed(21, 0).contains("`agent`"));
    assert!(changed(22, 0xff).contains("UTF-8"));
    // The score of the last box: its covariance (24), track (8) and velocity (12) follow.
    let mut bytes = bytes.clone();
    let score = bytes.len() - 24 - 8 - 12 - 4;
    bytes[score..score + 4].copy_from_slice(&2.0f32.to_le_bytes());
    assert!(decode(&bytes).err().unwrap().to_string().contains("score in [0, 1]"));
}

fn packet_of(message: Message) -> Message {
    let mut out = Outputs::at(message.header.ready);
    let mut encoder = TransmissionEncoder::new(ALL).unwrap();
    encoder.on_message(PortId(0), message, &mut out).unwrap();
    out.take_sent().remove(0).1
}

#[test]
fn packets_keep_the_receivers_header_and_the_senders_content() {
    for message in messages() {
        let mut packet = packet_of(message.clone());
        assert_eq!(packet.header.pose, None, "the pose crosses in the bytes");
        packet.header.to = Some("cav1".into());
        packet.header.ready += 10;
        let mut out = Outputs::at(packet.header.ready);
        let mut decoder = TransmissionDecoder::new(DecoderSettings::default()).unwrap();
        decoder.on_message(PortId(0), packet.clone(), &mut out).unwrap();
        let (port, found) = out.take_sent().remove(0);
        let is_state = matches!(message.payload, Payload::AgentState(_));
        assert_eq!(port, PortId(usize::from(is_state)), "states have a port of their own");
        let expected = Header {
            to: packet.header.to,
            ready: packet.header.ready,
            ..message.header
        };
        assert_eq!(found.header, expected);
    }
}

#[test]
fn decoder_rejects_forged_oversized_and_unknown_packets() {
    let packet = packet_of(messages().remove(0));
    let refuse = |config: DecoderSettings, change: &dyn Fn(&mut Header, &mut Packet)| {
        let (mut header, mut content): (Header, Packet) = packet.clone().into_parts().unwrap();
        change(&mut header, &mut content);
        let mut out = Outputs::at(0);
        let mut decoder = TransmissionDecoder::new(config).unwrap();
        let error = decoder
            .on_message(PortId(0), Message::new(header, content), &mut out)
            .unwrap_err()
            .to_string();
        assert_eq!(out.take_sent(), []);
        error
    };
    let usual = DecoderSettings::default;
    let limited = |max_bytes| DecoderSettings { max_bytes, ..usual() };
    assert!(refuse(usual(), &|header, _| header.agent = "cav9".into()).contains("agent cav9"));
    assert!(refuse(usual(), &|header, _| header.kind = Kind::Points).contains("kind points"));
    assert!(refuse(usual(), &|header, _| header.seq += 1).contains("seq 42"));
    assert!(refuse(usual(), &|header, _| header.stamp += 1).contains("stamp"));
    assert!(refuse(usual(), &|_, packet| packet.codec = vec!["zstd".into()]).contains("[zstd]"));
    assert!(
        refuse(usual(), &|_, packet| packet.codec.insert(0, "zstd".into()))
            .contains("says codec zstd, plain, its bytes say plain")
    );
    assert!(refuse(usual(), &|_, packet| packet.codec.clear()).contains("end with plain"));
    assert!(refuse(limited(100), &|_, _| ()).contains("`max_bytes`"));
    assert!(TransmissionDecoder::new(limited(0)).is_err());
}

#[test]
fn a_packet_moved_to_another_time_line_has_the_stamp_there() {
    let mut decoder = Decoder::new(1 << 20).unwrap();
    let mut read = |header: Header, packet: &Packet| decoder.message(header, packet, &mut Steps::default());
    for message in messages() {
        let (header, packet): (Header, Packet) = packet_of(message.clone()).into_parts().unwrap();
        let moved = packet.clone().moved(-5_000_000_007);
        let there = Header {
            stamp: header.stamp - 5_000_000_007,
            ..header.clone()
        };
        let (found, _) = read(there.clone(), &moved).unwrap();
        assert_eq!(found.header.stamp, there.stamp);
        assert_eq!(found.payload, read(header.clone(), &packet).unwrap().0.payload);
        assert!(read(header, &moved).is_err());
        assert!(read(there.clone(), &packet).is_err());
        let twice = moved.moved(0);
        assert!(matches!(read(there, &twice), Err(DecodeError::Codec(_))));
    }
    let largest = packet_of(messages().remove(0)).into_parts::<Packet>().unwrap();
    let far = largest.1.moved(Nanos::MAX);
    assert!(matches!(read(largest.0, &far), Err(DecodeError::Forged { .. })));
}

/// Whatever is accepted is sound, and says the same when it is sent on.
fn holds(bytes: &[u8]) {
    let Ok(content) = decode(bytes) else { return };
    let header = header(content.envelope.kind);
    let Envelope {
        kind,
        seq,
        stamp,
        agent,
        frame,
        pose,
        position,
    } = content.envelope;
    let message = Message {
        header: Header {
            kind,
            seq,
            stamp,
            agent,
            frame,
            pose,
            position,
            ..header
        },
        payload: content.payload,
    };
    let (again, dropped) = encode(&message, &ALL).expect("what was accepted can be sent");
    assert_eq!(dropped, Dropped::default());
    let again = decode(&again).expect("what was sent is accepted");
    let codec = again.codec.clone();
    let again = again.into_message(message.header.clone(), &codec);
    let payload = again.unwrap().payload;
    assert_eq!(payload, message.payload);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn any_bytes_are_taken_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        holds(&bytes);
        // Past the magic and version, where arbitrary bytes hardly ever get.
        for content in 1..=4 {
            let mut framed = vec![b'r', b'l', 2, content];
            framed.extend(&bytes);
            holds(&framed);
        }
    }

    #[test]
    fn changed_bytes_are_taken_or_refused(
        which in 0usize..7,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let (mut bytes, _) = encode(&messages()[which], &ALL).unwrap();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len() + 1));
        }
        holds(&bytes);
    }
}
