//! Messages survive the way through Arrow, and what is no message is refused by name.

use std::sync::Arc;

use arrow_array::{Array, ArrayRef, Float32Array, StructArray, UInt64Array};
use arrow_schema::{DataType, Field, Fields};
use nalgebra::{Isometry3, Vector3};
use realo_schemas::wire::{WireError, from_arrow, to_arrow};
use realo_schemas::*;

fn header(kind: Kind) -> Header {
    let mut header = Header::origin(&"run".into(), &"cav1".into(), kind, 7, 1_000, 2_000);
    header.hop = 3;
    header.clock = Some(Clock {
        wall_origin: 5,
        log_origin: 6,
        rate: 0.5,
    });
    header.pose = Some(Pose {
        covariance: Some(Box::new(std::array::from_fn(|i| i as f64))),
        ..Pose::exact(Isometry3::new(
            Vector3::new(1e5, -2.0, 0.5),
            Vector3::new(0.01, 0.02, 3.0),
        ))
    });
    header.to = Some("rsu1".into());
    header.trace.push(TraceEntry {
        node: "ego.sync".into(),
        input: 1,
        start: 2,
        done: 3,
        ready: 4,
    });
    header
}

fn object(track: Option<u64>) -> Box3 {
    Box3 {
        center: [1.0, 2.0, 3.0],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.3,
        velocity: track.map(|_| [1.0, 0.0, 0.0]),
        class: "Car".into(),
        score: 0.5,
        track,
        covariance: track.map(|_| [0.1; 9]),
    }
}

fn payloads() -> Vec<(Kind, Payload)> {
    let cloud = PointCloud::new(
        vec![1.0f32, 2.0],
        vec![3.0f32, 4.0],
        vec![5.0f32, f32::INFINITY],
        vec![6u8, 7],
        vec![-8, 9],
        vec![1u16, 2],
    );
    let state = EgoState {
        map_from_body: Isometry3::translation(1.0, 2.0, 3.0),
        covariance: None,
        velocity: Some(Vector3::new(1.0, 2.0, 3.0)),
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    let map = FeatureMap {
        rows: 2,
        columns: 1,
        channels: 2,
        cell: 0.4,
        origin: [-1.0, -2.0],
        dtype: DType::F16,
        data: vec![1u8, 2, 3, 4, 5, 6, 7, 8].into(),
        model: "abc".into(),
    };
    let boxes = Boxes(vec![object(None), object(Some(9))]);
    let entry = Message::new(header(Kind::Boxes), boxes.clone());
    let other = Message::new(header(Kind::Boxes), Boxes::default());
    let truth = GroundTruth {
        boxes: boxes.0.clone(),
        agents: vec!["cav1".into(), "rsu1".into()],
        points: vec![1, 2, 3, 4],
        ego_footprint: Some([-1.0, 3.0, -1.0, 1.0]),
        key: true,
    };
    vec![
        (Kind::Points, cloud.expect("columns of one length").into()),
        (Kind::Points, PointCloud::empty().into()),
        (Kind::EgoState, state.into()),
        (Kind::Features, map.into()),
        (
            Kind::Boxes,
            Packet {
                codec: vec!["plain".into()],
                bytes: vec![1u8, 2, 3].into(),
            }
            .into(),
        ),
        (
            Kind::Boxes,
            Selection {
                query: 7,
                entries: vec![entry, other],
            }
            .into(),
        ),
        (
            Kind::Boxes,
            Selection {
                query: 7,
                entries: vec![],
            }
            .into(),
        ),
        (
            Kind::Report,
            Report {
                topic: "bank".into(),
                json: "{}".into(),
            }
            .into(),
        ),
        (Kind::Boxes, boxes.into()),
        (Kind::Boxes, Boxes::default().into()),
        (Kind::Truth, truth.into()),
        (Kind::Truth, GroundTruth::default().into()),
    ]
}

#[test]
fn every_payload_survives() {
    for (kind, payload) in payloads() {
        let message = Message {
            header: header(kind),
            payload,
        };
        assert_eq!(from_arrow(&to_arrow(&message)).as_ref(), Ok(&message));
        let mut bare = message.clone();
        bare.header = Header::origin(&"".into(), &"a".into(), kind, 0, -5, -5);
        assert_eq!(from_arrow(&to_arrow(&bare)).as_ref(), Ok(&bare));
    }
}

fn replace(row: &StructArray, name: &str, column: Option<ArrayRef>) -> StructArray {
    let (fields, columns): (Vec<_>, Vec<_>) = row
        .fields()
        .iter()
        .zip(row.columns())
        .filter_map(|(field, old)| match (&column, field.name() == name) {
            (Some(new), true) => Some((Field::new(name, new.data_type().clone(), true), new.clone())),
            (None, true) => None,
            _ => Some((field.as_ref().clone(), old.clone())),
        })
        .unzip();
    StructArray::new(Fields::from(fields), columns, None)
}

#[test]
fn refuses_what_is_no_message_by_field() {
    let message = Message::new(header(Kind::Boxes), Boxes(vec![object(None)]));
    let row = to_arrow(&message);
    let error = from_arrow(&replace(&row, "yaw", None)).unwrap_err();
    assert!(
        matches!(&error, WireError::Field { field, found, .. } if field == "yaw" && found == "nothing"),
        "{error}"
    );
    let number: ArrayRef = Arc::new(Float32Array::from(vec![1.0]));
    let error = from_arrow(&replace(&row, "seq", Some(number.clone()))).unwrap_err();
    assert!(
        matches!(&error, WireError::Field { field, .. } if field == "seq"),
        "{error}"
    );
    assert!(
        error.to_string().contains("UInt64") && error.to_string().contains("Float32"),
        "{error}"
    );
    assert!(matches!(from_arrow(number.as_ref()), Err(WireError::Shape(_))));
    let null: ArrayRef = Arc::new(UInt64Array::from(vec![None]));
    let error = from_arrow(&replace(&row, "seq", Some(null))).unwrap_err();
    assert!(
        matches!(&error, WireError::Content { field, .. } if field == "seq"),
        "{error}"
    );
    let empty = arrow_array::new_empty_array(&DataType::Struct(row.fields().clone()));
    assert!(matches!(from_arrow(empty.as_ref()), Err(WireError::Shape(_))));
}

#[test]
fn big_columns_are_shared_not_copied() {
    let x: Vec<f32> = (0..1000).map(|i| i as f32).collect();
    let (bytes, n) = (x.clone(), x.len());
    let cloud =
        PointCloud::new(x, bytes.clone(), bytes, vec![0u8; n], vec![0i32; n], vec![0u16; n]).expect("one length");
    let pointer = cloud.x.as_ptr();
    let back = from_arrow(&to_arrow(&Message::new(header(Kind::Points), cloud))).expect("a message");
    let (_, back): (Header, PointCloud) = back.into_parts().expect("a cloud");
    assert_eq!(back.x.as_ptr(), pointer);
}
