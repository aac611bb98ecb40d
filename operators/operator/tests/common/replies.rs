//! Replies for tests of the pipe: those within the crate and those beside it.

use arrow_buffer::Buffer;
use realo_schemas::report::{Crossing, Fate, Fated, Use};
use realo_schemas::{Box3, Boxes, Header, Kind, Message, Nanos, PointCloud, Selection};

use super::{Reply, Reported};

pub fn boxes(agent: &str, n: usize) -> Message {
    let object = Box3 {
        center: [1.0, -2.0, 0.5],
        length: 4.5,
        width: 1.9,
        height: 1.6,
        yaw: 0.3,
        velocity: Some([1.0, 0.0, 0.0]),
        class: "Car".into(),
        score: 0.7,
        track: Some(u64::MAX),
        covariance: None,
    };
    let header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, 3, 50, 80);
    Message::new(header, Boxes(vec![object; n]))
}

/// Something of everything that a reply can hold; its cloud has as many points.
pub fn reply(points: usize) -> Reply {
    let entries = vec![boxes("cav2", 2), boxes("rsu1", 0)];
    let selection = Message::new(boxes("cav1", 0).header, Selection { query: 3, entries });
    let column = |value: f32| vec![value; points];
    let cloud = PointCloud::new(
        column(1.0),
        column(2.0),
        column(3.0),
        vec![4; points],
        vec![5; points],
        vec![6; points],
    );
    let cloud = cloud.expect("the columns are as long as each other");
    Reply {
        error: Some("no pose".into()),
        sent: vec![
            ("boxes".into(), boxes("cav1", 3)),
            ("a".into(), selection),
            ("b".into(), Message::new(boxes("cav1", 0).header, cloud)),
        ],
        wakes: vec![-5, Nanos::MAX],
        counts: vec![("low".into(), u64::MAX)],
        reported: Reported {
            fates: vec![Fated {
                message: Crossing {
                    from: "rsu1".into(),
                    to: "cav1".into(),
                    kind: Kind::Boxes,
                    seq: 3,
                },
                fate: Fate::Used,
                r#use: Some(Use { query: 4, age_ns: -5 }),
                entry: None,
            }],
            traffic: vec![],
            losses: Default::default(),
            explained: Default::default(),
        },
    }
}

/// The parts of a frame in one piece.
pub fn whole(parts: Result<Vec<Buffer>, String>) -> Vec<u8> {
    let parts = parts.expect("it can be written");
    parts.iter().flat_map(|part| part.to_vec()).collect()
}
