//! Messages survive the way through Arrow, and what is no message is refused by name.

use std::sync::Arc;

use arrow_array::{Array, ArrayRef, Float32Array, StructArray, UInt64Array};
use arrow_schema::{DataType, Field, Fields};
use nalgebra::{Isometry3, Vector3};
use realo_schemas::geometry::View;
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
    header.position = Some([1e5, -3.0, 0.5]);
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
    let state = AgentState {
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
        confidence: None,
    };
    let sparse = FeatureMap {
        confidence: Some(vec![0.0, 0.75].into()),
        ..map.clone()
    };
    let boxes = Boxes(vec![object(None), object(Some(9))]);
    let entry = Message::new(header(Kind::Boxes), boxes.clone());
    let other = Message::new(header(Kind::Boxes), Boxes::default());
    let truth = GroundTruth {
        boxes: boxes.0.clone(),
        agents: vec!["cav1".into(), "rsu1".into()],
        points: vec![1, 2, 3, 4],
        ego_footprint: Some([-1.0, 3.0, -1.0, 1.0]),
        other_footprints: vec![None],
        key: true,
        ..GroundTruth::default()
    };
    let view = View {
        frame_from_camera: Isometry3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.2, 0.3)),
        focal: [800.0, 810.0],
        center: [960.5, 540.25],
        size: [1920, 1080],
        margin: 2.0,
    };
    let labelled = GroundTruth {
        agents: vec!["rsu1".into(), "cav1".into()],
        ego_footprint: None,
        other_footprints: vec![Some([-1.0, 3.0, -1.0, 1.0])],
        views: vec![view.clone(), view.clone()],
        own: Some(Box::new(OwnLabels {
            boxes: vec![object(Some(1))],
            points: vec![7],
            key: true,
            views: vec![view],
        })),
        ..truth.clone()
    };
    vec![
        (Kind::Points, cloud.expect("columns of one length").into()),
        (Kind::Points, PointCloud::empty().into()),
        (Kind::AgentState, state.into()),
        (Kind::Features, map.into()),
        (Kind::Features, sparse.into()),
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
        (Kind::Truth, labelled.into()),
        (Kind::Truth, GroundTruth::default().into()),
        (Kind::Motion, motion().into()),
        (Kind::Motion, Motion::default().into()),
    ]
}

fn motion() -> Motion {
    let taken = |stamp: Nanos| motion::Taken {
        stamp,
        arrival: stamp - 40,
    };
    let sample = |stamp: Nanos| ImuSample {
        taken: taken(stamp),
        angular_rate: [0.01, -0.02, 0.3],
        specific_force: [0.5, -0.25, 9.81],
    };
    let fix = |stamp: Nanos, covariance: Option<[f64; 9]>| GnssFix {
        taken: taken(stamp),
        position: [1e5, -3.0, 0.5],
        has_height: covariance.is_some(),
        covariance,
        quality: FixQuality::Differential,
    };
    let wheel = |speed: f64, variance: Option<f64>| WheelSpeed {
        taken: taken(-5),
        speed,
        variance,
    };
    Motion {
        imu: vec![sample(-20), sample(-10)],
        imu_variance: Some([1e-6, 1e-4]),
        fixes: vec![fix(-7, Some([0.25; 9])), fix(-3, None)],
        wheels: vec![wheel(0.0, None), wheel(-1.5, Some(0.01))],
        imu_position: [0.5, 0.0, 0.4],
        antenna: [-0.2, 0.1, 1.6],
        axle: [0.5, 0.0, 0.0],
    }
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

fn column<A: Array + 'static>(array: A) -> ArrayRef {
    Arc::new(array)
}

/// One list that holds all values.
fn list(values: ArrayRef) -> ArrayRef {
    use arrow_array::ListArray;
    use arrow_buffer::OffsetBuffer;
    let field = Arc::new(Field::new("item", values.data_type().clone(), true));
    column(ListArray::new(
        field,
        OffsetBuffer::from_lengths([values.len()]),
        values,
        None,
    ))
}

fn numbers(values: &[f64]) -> ArrayRef {
    list(column(arrow_array::Float64Array::from(values.to_vec())))
}

/// As many agents' footprints.
fn outlines(count: usize) -> ArrayRef {
    let numbers = arrow_array::Float64Array::from(vec![1.0; 4 * count]);
    let field = Arc::new(Field::new("item", numbers.data_type().clone(), true));
    list(Arc::new(arrow_array::FixedSizeListArray::new(
        field,
        4,
        Arc::new(numbers),
        None,
    )))
}

fn times(values: &[i64]) -> ArrayRef {
    list(column(arrow_array::Int64Array::from(values.to_vec())))
}

fn word(text: &str) -> ArrayRef {
    column(arrow_array::StringArray::from(vec![text]))
}

/// The message of a payload type, as it travels.
fn row_of(payload: PayloadType) -> StructArray {
    let (kind, payload) = payloads()
        .into_iter()
        .find(|(_, known)| known.payload_type() == payload)
        .expect("every type has an example");
    to_arrow(&Message {
        header: header(kind),
        payload,
    })
}

#[test]
fn every_field_is_held_to_its_content() {
    use PayloadType::*;
    use arrow_array::UInt32Array;
    let f32s = |n: usize| list(column(Float32Array::from(vec![0.0; n])));
    let u32s = |values: &[u32]| list(column(UInt32Array::from(values.to_vec())));
    let size = |n: u32| column(UInt32Array::from(vec![n]));
    let cases: Vec<(PayloadType, &str, ArrayRef, &str)> = vec![
        (Boxes, "payload", word("Cars"), "payload"),
        (Boxes, "kind", word("cars"), "unknown message kind `cars`"),
        (Boxes, "clock_origins", times(&[5]), "2 origins"),
        (Boxes, "clock_origins", times(&[]), "2 origins"),
        (Boxes, "clock_rate", numbers(&[0.0]), "a positive rate"),
        (Boxes, "clock_rate", numbers(&[-1.0]), "a positive rate"),
        (Boxes, "clock_rate", numbers(&[f64::INFINITY]), "a positive rate"),
        (Boxes, "clock_rate", numbers(&[]), "a positive rate"),
        (Boxes, "pose", numbers(&[0.0; 6]), "7 numbers, found 6"),
        (Boxes, "pose", numbers(&[0.0; 7]), "not a finite pose"),
        (Boxes, "pose_covariance", numbers(&[0.0; 35]), "36 numbers, found 35"),
        (
            Boxes,
            "position",
            numbers(&[0.0; 2]),
            "3 finite numbers, found [0.0, 0.0]",
        ),
        (Boxes, "position", numbers(&[f64::NAN; 3]), "3 finite numbers"),
        (Boxes, "trace_input", times(&[]), "0 times for 1 nodes"),
        (Boxes, "trace_start", times(&[1, 2]), "2 times for 1 nodes"),
        (Boxes, "trace_done", times(&[]), "0 times for 1 nodes"),
        (Boxes, "trace_ready", times(&[]), "0 times for 1 nodes"),
        (Boxes, "score", f32s(1), "differ in length"),
        (Boxes, "yaw", numbers(&[0.0; 3]), "differ in length"),
        (Boxes, "velocity", numbers(&[0.0; 2]), "expected FixedSizeListArray"),
        (PointCloud, "y", f32s(3), "differ in length"),
        (AgentState, "map_from_body", numbers(&[]), "needs a pose"),
        (AgentState, "velocity", numbers(&[1.0]), "3 numbers, found 1"),
        (AgentState, "angular_rate", numbers(&[1.0, 2.0]), "3 numbers, found 2"),
        (AgentState, "status", word("guessed"), "unknown status `guessed`"),
        (FeatureMap, "dtype", word("f64"), "unknown element type `f64`"),
        (FeatureMap, "dtype", word("f32"), "[2, 1, 2] needs 16 bytes, found 8"),
        (FeatureMap, "rows", size(3), "[3, 1, 2] needs 12 bytes, found 8"),
        (FeatureMap, "origin", numbers(&[1.0]), "x and y"),
        (
            FeatureMap,
            "confidence",
            list(column(Float32Array::from(vec![1.0; 3]))),
            "3 numbers for 2 cells",
        ),
        (Selection, "entry_1", word("x"), "an entry is a struct"),
        (
            GroundTruth,
            "points",
            u32s(&[1, 2, 3]),
            "3 counts for 2 objects and 2 agents",
        ),
        (GroundTruth, "ego_footprint", numbers(&[1.0; 3]), "4 numbers, found 3"),
        (
            GroundTruth,
            "other_footprints",
            outlines(2),
            "2 footprints for 1 agents",
        ),
        (Motion, "imu_arrival", times(&[1]), "1 values for 2 stamps"),
        (Motion, "imu_stamp", times(&[-5, i64::MIN]), "within an hour"),
        (Motion, "imu_stamp", times(&[-5; 3]), "2 values for 3 stamps"),
        (
            Motion,
            "imu_angular_rate",
            numbers(&[0.0; 2]),
            "expected FixedSizeListArray",
        ),
        (Motion, "imu_variance", numbers(&[1.0]), "2 numbers or none, found 1"),
        (Motion, "imu_variance", numbers(&[-1.0, 0.0]), "a variance of 0"),
        (
            Motion,
            "fix_quality",
            list(column(arrow_array::UInt8Array::from(vec![0, 9]))),
            "unknown number 9",
        ),
        (Motion, "wheel_speed", numbers(&[0.0, f64::NAN]), "a speed within"),
        (Motion, "wheel_variance", numbers(&[0.0]), "1 values for 2 stamps"),
        (Motion, "antenna_at", numbers(&[0.0; 2]), "3 numbers, found 2"),
        (Motion, "axle_at", numbers(&[0.0, f64::INFINITY, 0.0]), "`axle`"),
    ];
    for (payload, field, content, expected) in cases {
        let error = from_arrow(&replace(&row_of(payload), field, Some(content)));
        let error = error.expect_err(field).to_string();
        assert!(error.contains(expected), "{payload} {field}: {error}");
    }
    let huge = replace(&row_of(FeatureMap), "rows", Some(size(u32::MAX)));
    let huge = replace(&huge, "columns", Some(size(u32::MAX)));
    let error = from_arrow(&huge).unwrap_err().to_string();
    assert!(error.contains("no possible shape"), "{error}");
}

#[test]
fn every_column_of_boxes_counts() {
    for field in ["y", "z", "length", "width", "height", "yaw"] {
        let short = replace(&row_of(PayloadType::Boxes), field, Some(numbers(&[0.0])));
        let error = from_arrow(&short).expect_err(field).to_string();
        assert!(error.contains("differ in length"), "{field}: {error}");
    }
}

#[test]
fn a_selection_holds_no_selection() {
    let inner = row_of(PayloadType::Selection);
    let error = from_arrow(&replace(&inner, "entry_0", Some(column(inner.clone()))));
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("entry_0") && error.contains("within a Selection"),
        "{error}"
    );
    // What is wrong in an entry names the entry.
    let entry = replace(&row_of(PayloadType::Boxes), "kind", Some(word("cars")));
    let error = from_arrow(&replace(&inner, "entry_1", Some(column(entry))));
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("entry_1") && error.contains("unknown message kind"),
        "{error}"
    );
}

#[test]
fn every_element_type_and_status_survives() {
    for (dtype, bytes) in [(DType::F32, 16), (DType::F16, 8), (DType::Bf16, 8), (DType::U8, 4)] {
        let map = FeatureMap {
            rows: 2,
            columns: 1,
            channels: 2,
            cell: 0.4,
            origin: [-1.0, -2.0],
            dtype,
            data: vec![7u8; bytes].into(),
            model: "m".into(),
            confidence: None,
        };
        let message = Message::new(header(Kind::Features), map);
        assert_eq!(from_arrow(&to_arrow(&message)).as_ref(), Ok(&message));
    }
    for status in PoseStatus::ALL {
        let state = AgentState {
            map_from_body: Isometry3::translation(1.0, 2.0, 3.0),
            covariance: Some(Box::new([0.5; 36])),
            velocity: None,
            angular_rate: Some(Vector3::new(0.1, 0.2, 0.3)),
            status,
        };
        let message = Message::new(header(Kind::AgentState), state);
        assert_eq!(from_arrow(&to_arrow(&message)).as_ref(), Ok(&message));
    }
}

#[test]
fn columns_that_are_slices_are_read_where_they_lie() {
    use arrow_array::ListArray;
    // Two lists in one column, of which the row has the second.
    let whole = replace(&row_of(PayloadType::Boxes), "yaw", None);
    let values = arrow_array::Float64Array::from(vec![9.0, 9.0, 9.0, 0.25, 0.5]);
    let item = Arc::new(Field::new("item", values.data_type().clone(), true));
    let offsets = arrow_buffer::OffsetBuffer::from_lengths([3, 2]);
    let both = ListArray::new(item, offsets, column(values), None);
    let second: ArrayRef = column(both.slice(1, 1));
    let mut fields: Vec<Field> = whole.fields().iter().map(|field| field.as_ref().clone()).collect();
    fields.push(Field::new("yaw", second.data_type().clone(), true));
    let columns = whole.columns().iter().cloned().chain([second]).collect();
    let row = StructArray::new(Fields::from(fields), columns, None);
    let (_, Boxes(boxes)) = from_arrow(&row).expect("a message").into_parts().expect("boxes");
    let yaws: Vec<f64> = boxes.iter().map(|object| object.yaw).collect();
    assert_eq!(yaws, [0.25, 0.5]);
}
