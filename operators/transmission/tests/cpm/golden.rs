//! Our bytes and those of an independent encoder: `vectors.py` makes them, and says how.

use std::path::Path;

use realo_operator::Steps;
use realo_schemas::{Box3, Header, Kind, Message, Nanos};
use realo_transmission::cpm::{Unused, received};
use realo_transmission::{Encoder, EncoderConfig};
use serde::Deserialize;

use super::*;

#[derive(Deserialize)]
struct Vectors {
    stamp: Nanos,
    ours: Vec<Ours>,
    theirs: Vec<Theirs>,
}

#[derive(Deserialize)]
struct Ours {
    name: String,
    agent: String,
    roadside: String,
    seq: u64,
    origin: [f64; 3],
    /// x, y, z, yaw.
    pose: [f64; 4],
    boxes: Vec<Object>,
}

#[derive(Deserialize)]
struct Theirs {
    name: String,
    agent: String,
    origin: [f64; 3],
    boxes: Vec<Object>,
    /// Objects, assumed, containers, segments.
    unused: [u64; 4],
}

#[derive(Deserialize)]
struct Object {
    center: [f64; 3],
    extents: [f64; 3],
    yaw: f64,
    velocity: Option<[f64; 3]>,
    class: String,
    score: f32,
    track: Option<u64>,
    /// Variances of x, y, yaw.
    covariance: Option<[f64; 3]>,
}

impl Object {
    fn to_box(&self) -> Box3 {
        let [length, width, height] = self.extents;
        let diagonal = |[x, y, yaw]: [f64; 3]| [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, yaw];
        Box3 {
            center: self.center,
            length,
            width,
            height,
            yaw: self.yaw,
            velocity: self.velocity,
            class: self.class.as_str().into(),
            score: self.score,
            track: self.track,
            covariance: self.covariance.map(diagonal),
        }
    }
}

fn folder() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests"))
}

fn vectors() -> Vectors {
    let text = std::fs::read_to_string(folder().join("cpm/vectors.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

fn bytes_of(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(format!("corpus/cpm/{name}.uper"))).unwrap()
}

#[test]
fn our_bytes_are_those_of_an_independent_encoder() {
    let vectors = vectors();
    for case in &vectors.ours {
        let [latitude, longitude, height] = case.origin;
        let config = EncoderConfig {
            roadside: case.roadside.clone(),
            ..config(place(latitude, longitude, height))
        };
        let [x, y, z, yaw] = case.pose;
        let map_from_body = level([x, y, z], yaw);
        let mut header = header(&case.agent, case.seq, map_from_body);
        header.stamp = vectors.stamp;
        let sent: Vec<Box3> = case.boxes.iter().map(Object::to_box).collect();
        let (packet, dropped) = encode(&header, &sent, &config).unwrap();
        assert_eq!((packet.codec.join(" "), dropped), ("cpm".into(), Dropped::default()));
        let expected = bytes_of(&case.name);
        assert_eq!(*packet.bytes, *expected, "{}", case.name);

        let (found, unused) = decode(&header, &packet, config.origin).unwrap();
        assert_eq!(unused, Unused::default(), "{}", case.name);
        assert_eq!(
            (found.header.stamp, &*found.header.frame),
            (vectors.stamp, "map"),
            "the exact stamp is the packet's"
        );
        assert_eq!(boxes_of(&found).len(), sent.len());
        for (found, sent) in boxes_of(&found).iter().zip(&sent) {
            check(found, &in_map(&map_from_body, sent));
            assert_eq!(found.track, sent.track, "{}", case.name);
            let known = if &*sent.class == "sofa" {
                "unknown"
            } else {
                &*sent.class
            };
            assert_eq!(&*found.class, known);
            assert_eq!(found.covariance.is_some(), sent.covariance.is_some());
        }
    }
}

#[test]
fn cpms_of_another_stack_become_boxes() {
    let vectors = vectors();
    for case in &vectors.theirs {
        let bytes = bytes_of(&case.name);
        let message = received(&bytes, &"run".into(), 7, vectors.stamp + 5).unwrap();
        let header = &message.header;
        // A CPM has whole milliseconds.
        assert_eq!(
            (&*header.agent, header.kind, header.seq, header.stamp),
            (&*case.agent, Kind::Boxes, 7, vectors.stamp - 300_000),
            "{}",
            case.name
        );
        let [latitude, longitude, height] = case.origin;
        let (header, packet): (Header, Packet) = message.into_parts().unwrap();
        let (found, unused) = decode(&header, &packet, place(latitude, longitude, height)).unwrap();
        let [objects, assumed, containers, segments] = case.unused;
        let expected = Unused {
            objects,
            assumed,
            containers,
            segments,
        };
        assert_eq!(unused, expected, "{}", case.name);
        assert_eq!(boxes_of(&found).len(), case.boxes.len(), "{}", case.name);
        for (found, expected) in boxes_of(&found).iter().zip(&case.boxes) {
            let expected = expected.to_box();
            // The reference position is the map's origin: numbers are exact but for rounding.
            let away = Vector3::from(found.center) - Vector3::from(expected.center);
            assert!(away.norm() < 1e-6, "{}: {away}", case.name);
            check(found, &expected);
            assert!((found.yaw - expected.yaw).abs() < 1e-6, "{}", case.name);
            assert_eq!(
                (&found.class, found.score, found.track, found.covariance),
                (&expected.class, expected.score, expected.track, None),
                "{}",
                case.name
            );
        }
    }
}

#[test]
fn what_another_stack_said_can_be_said_again() {
    for case in &vectors().theirs {
        let [latitude, longitude, height] = case.origin;
        let origin = place(latitude, longitude, height);
        let message = received(&bytes_of(&case.name), &"run".into(), 7, 0).unwrap();
        let (header, packet): (Header, Packet) = message.into_parts().unwrap();
        let (first, _) = decode(&header, &packet, origin).unwrap();
        let again = Message::new(first.header.clone(), first.payload.clone());
        let mut encoder = Encoder::new(&config(origin)).unwrap();
        let (packet, dropped) = encoder.encode(&again, &mut Steps::default()).unwrap();
        assert_eq!(dropped, Dropped::default());
        let (second, unused) = decode(&header, &packet, origin).unwrap();
        assert_eq!(unused, Unused::default());
        assert_eq!(boxes_of(&second).len(), boxes_of(&first).len());
        for (second, first) in boxes_of(&second).iter().zip(boxes_of(&first)) {
            check(second, first);
        }
    }
}
