//! Boxes as ETSI's CPMs: held against an independent encoder, there and back, at the edges, and what is refused.

mod edges;
mod golden;
mod round_trip;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_operator::Steps;
use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, Boxes, Header, Kind, Message, Nanos, Packet, Payload, Pose};
use realo_transmission::cpm::{Geodetic, Unused};
use realo_transmission::{BoxesLayout, DecodeError, Decoder, Dropped, EncodeError, Encoder, EncoderConfig};

/// The last tenth of a second of 2025, and a third of a millisecond.
const STAMP: Nanos = 1_767_225_599_900_300_000;

fn place(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> Geodetic {
    Geodetic {
        latitude_deg,
        longitude_deg,
        height_m,
    }
}

fn config(origin: Geodetic) -> EncoderConfig {
    EncoderConfig {
        boxes: BoxesLayout::Cpm,
        origin,
        ..EncoderConfig::default()
    }
}

fn level(translation: [f64; 3], yaw: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Vector3::from(translation).into(),
        UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
    )
}

fn header(agent: &str, seq: u64, map_from_body: Isometry3<f64>) -> Header {
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, STAMP, STAMP);
    header.pose = Some(Pose::exact(map_from_body));
    header
}

fn car() -> Box3 {
    Box3 {
        center: [10.0, -5.0, 0.75],
        length: 4.5,
        width: 1.8,
        height: 1.5,
        yaw: 0.5,
        velocity: None,
        class: "vehicle".into(),
        score: 0.9,
        track: None,
        covariance: None,
    }
}

fn encode(header: &Header, boxes: &[Box3], config: &EncoderConfig) -> Result<(Packet, Dropped), EncodeError> {
    let message = Message::new(header.clone(), Boxes(boxes.to_vec()));
    Encoder::new(config)?.encode(&message, &mut Steps::default())
}

fn decode(header: &Header, packet: &Packet, origin: Geodetic) -> Result<(Message, Unused), DecodeError> {
    // As a link delivers it.
    let header = Header {
        pose: None,
        ..header.clone()
    };
    let decoder = Decoder::new(1 << 20).unwrap();
    decoder
        .with_origin(origin)
        .message(header, packet, &mut Steps::default())
}

fn cpm(bytes: Vec<u8>) -> Packet {
    Packet {
        codec: vec!["cpm".into()],
        bytes: bytes.into(),
    }
}

fn boxes_of(message: &Message) -> &[Box3] {
    let Payload::Boxes(boxes) = &message.payload else {
        panic!("not boxes")
    };
    &boxes.0
}

/// Holds a box that came back against the one that was sent, both in `map`.
fn check(found: &Box3, sent: &Box3) {
    let moved = Vector3::from(found.center) - Vector3::from(sent.center);
    // Half a centimetre on each axis, of which the sender's lie a little aslant.
    assert!(moved.norm() < 0.008_67, "{moved} m: {found:?}, {sent:?}");
    let turned = realo_schemas::geometry::normalize_yaw(found.yaw - sent.yaw).to_degrees();
    // Half a tenth of a degree. The sender's plane is aslant to the map's too, and a heading that climbs by 0.07 turns by as much as
    // 0.07 × 10 km / 6,357 km in it.
    assert!(turned.abs() < 0.05 + 0.0064, "{turned} degrees: {found:?}, {sent:?}");
    for (found, sent) in [
        (found.length, sent.length),
        (found.width, sent.width),
        (found.height, sent.height),
    ] {
        let min = sent.max(0.1);
        assert!((found - min).abs() < 0.050_001, "{found} m, {sent} m");
    }
    match (found.velocity, sent.velocity) {
        (Some(found), Some(sent)) => {
            let other = Vector3::from(found) - Vector3::from(sent);
            assert!(other.norm() < 0.008_67, "{other} m/s");
        }
        (found, sent) => assert_eq!(found, sent),
    }
    let min = sent.score.max(0.01);
    assert!(
        (found.score - min).abs() < 0.005_001,
        "{} of {}",
        found.score,
        sent.score
    );
}

fn in_map(map_from_body: &Isometry3<f64>, object: &Box3) -> Box3 {
    transform_box(map_from_body, object)
}
