//! Late fusion: brings the boxes of selected collaborators to the ego's body frame and lists them after the ego's own.
//! Duplicates stay; the next stage is `nms`, whose order at equal scores is the order here.
//!
//! | port | type | content |
//! |---|---|---|
//! | in `ego` | Boxes | the ego's detections; joined with `selections` by (agent, seq) |
//! | in `selections` | Selection | what the bank chose for the ego's message of that seq |
//! | out `boxes` | Boxes | the ego's boxes, then those of the collaborators by agent name and index, in the ego's frame |
//! | out `report` | Report | topic `fusion`: one for each fusion that took place |
//!
//! The transform is `ego_from_sender` of the two stamps, from the poses in the headers. The motion of objects between the
//! stamps is not removed.

use nalgebra::Isometry3;
use realo_runtime::{Argument, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port};
use realo_schemas::geometry::{relative, transform_box};
use realo_schemas::report::{FusionReport, MessageId, to_report};
use realo_schemas::{Box3, Boxes, Header, Kind, Message, Payload, PayloadType, Selection};
use serde::{Deserialize, Serialize};

/// Settings of [`FusionBoxes`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Whether the ego's own boxes take part; without them the collaborators speak alone, in the ego's frame.
    pub ego_boxes: bool,
    /// Collaborators that a fusion takes, the first by agent name; `None`: all.
    pub max_collaborators: Option<usize>,
    /// Least score of a box, the ego's own included.
    pub min_score: f32,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            ego_boxes: true,
            max_collaborators: None,
            min_score: 0.0,
        }
    }
}

/// What a fusion made.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fused {
    /// The ego's boxes, then the collaborators', in the ego's frame.
    pub boxes: Vec<Box3>,
    /// Collaborators beyond the greatest number.
    pub over_limit: Vec<MessageId>,
    /// Entries without a pose, or that are no boxes.
    pub rejected: Vec<MessageId>,
    /// Boxes below the least score.
    pub low_score: u64,
}

/// Brings the entries' boxes to the ego's frame.
///
/// `map_from_ego`: where the ego's frame lies in `map` at its stamp; without it no entry can be placed.
pub fn fuse(
    ego_boxes: Vec<Box3>,
    map_from_ego: Option<&Isometry3<f64>>,
    mut entries: Vec<Message>,
    config: &Config,
) -> Fused {
    entries.sort_by(|a, b| a.header.agent.cmp(&b.header.agent));
    let mut fused = Fused {
        boxes: if config.ego_boxes { ego_boxes } else { Vec::new() },
        ..Fused::default()
    };
    let mut taken = 0;
    for entry in entries {
        let id = MessageId::of(&entry.header);
        let pose = entry.header.pose.as_ref().map(|pose| &pose.map_from_frame);
        let (Payload::Boxes(Boxes(boxes)), Some(map_from_ego), Some(map_from_sender)) =
            (&entry.payload, map_from_ego, pose)
        else {
            fused.rejected.push(id);
            continue;
        };
        if config.max_collaborators.is_some_and(|limit| taken >= limit) {
            fused.over_limit.push(id);
            continue;
        }
        taken += 1;
        let ego_from_sender = relative(map_from_ego, map_from_sender);
        fused
            .boxes
            .extend(boxes.iter().map(|object| transform_box(&ego_from_sender, object)));
    }
    let before = fused.boxes.len();
    // A score that is NaN is left to `nms`, which counts it as invalid.
    fused
        .boxes
        .retain(|object| object.score.is_nan() || object.score >= config.min_score);
    fused.low_score = (before - fused.boxes.len()) as u64;
    fused
}

/// The operator `fusion-boxes`.
pub struct FusionBoxes {
    config: Config,
    /// The ego's part of a set, until its selection comes.
    ego: Option<(Header, Boxes)>,
}

const EGO: PortId = PortId(0);
const SELECTIONS: PortId = PortId(1);
const BOXES: PortId = PortId(0);
const REPORT: PortId = PortId(1);

impl Describe for FusionBoxes {
    type Config = Config;
    const NAME: &'static str = "fusion-boxes";
    const ABOUT: &'static str =
        "late fusion: brings collaborators' boxes to the ego's frame and lists them after its own";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "ego_boxes",
            about: "whether the ego's own boxes take part; false: the collaborators alone",
        },
        Argument {
            name: "max_collaborators",
            about: "collaborators that a fusion takes, the first by agent name; null = all",
        },
        Argument {
            name: "min_score",
            about: "boxes of a lower score are dropped, the ego's own included",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("ego", &[PayloadType::Boxes], "the ego's detections")
            .latest()
            .joined("frame"),
        Port::new(
            "selections",
            &[PayloadType::Selection],
            "what the bank chose for that message",
        )
        .latest()
        .joined("frame"),
    ];
    const OUTPUTS: &'static [Port] = &[
        Port::new(
            "boxes",
            &[PayloadType::Boxes],
            "the ego's boxes, then the collaborators', in the ego's frame",
        ),
        Port::new(
            "report",
            &[PayloadType::Report],
            "topic `fusion`: one for each fusion that took place",
        ),
    ];
}

impl Operator for FusionBoxes {
    fn new(config: Config) -> Result<Self, Error> {
        if config.min_score.is_nan() {
            return Err("argument `min_score`: expected a number, found NaN".into());
        }
        Ok(FusionBoxes { config, ego: None })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        match port {
            EGO => {
                self.ego = Some(message.into_parts().map_err(unexpected)?);
                Ok(())
            }
            SELECTIONS => self.fuse(message, out),
            _ => Err(wrong_port(Self::INPUTS, port)),
        }
    }
}

impl FusionBoxes {
    fn fuse(&mut self, message: Message, out: &mut Outputs) -> Result<(), Error> {
        let ego = self.ego.take();
        let (asked, Selection { query, entries }): (Header, Selection) = message.into_parts().map_err(unexpected)?;
        let Some((header, Boxes(ego_boxes))) = ego else {
            return Err(format!("a selection without the ego's boxes of the same set ({asked})").into());
        };
        if (&header.agent, header.seq) != (&asked.agent, query) {
            return Err(format!(
                "a selection for query {query} of {}, but the ego's message is {header}",
                asked.agent
            )
            .into());
        }
        let map_from_ego = header.pose.as_ref().map(|pose| &pose.map_from_frame);
        let fused = fuse(ego_boxes, map_from_ego, entries, &self.config);
        out.count("over_limit_messages", fused.over_limit.len() as u64);
        out.count("rejected_messages", fused.rejected.len() as u64);
        out.count("low_score_boxes", fused.low_score);
        let report = FusionReport {
            query,
            agent: header.agent.to_string(),
            over_limit: fused.over_limit,
            rejected: fused.rejected,
        };
        let report_header = Header {
            kind: Kind::Report,
            ..header.clone()
        };
        out.send(BOXES, Message::new(header, Boxes(fused.boxes)));
        out.send(REPORT, Message::new(report_header, to_report("fusion", &report)));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use realo_runtime::testkit::FusionCase;
    use realo_schemas::report::from_report;
    use realo_schemas::{PointCloud, Pose, Report};

    use super::*;

    fn object(center: [f64; 3], yaw: f64, score: f32) -> Box3 {
        Box3 {
            center,
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw,
            velocity: Some([2.0, 0.0, 0.0]),
            class: "Car".into(),
            score,
            track: None,
            covariance: None,
        }
    }

    fn pose(x: f64, y: f64, yaw: f64) -> Isometry3<f64> {
        let rotation = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, yaw);
        Isometry3::from_parts(nalgebra::Translation3::new(x, y, 12.0), rotation)
    }

    fn header(agent: &str, seq: u64, map_from_body: Option<Isometry3<f64>>) -> Header {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, 50, 80);
        header.pose = map_from_body.map(Pose::exact);
        header
    }

    fn boxes(agent: &str, map_from_body: Option<Isometry3<f64>>, boxes: Vec<Box3>) -> Message {
        Message::new(header(agent, 3, map_from_body), Boxes(boxes))
    }

    /// Feeds one set of an ego 100 km from the map's origin.
    fn fuse_set(config: Config, ego_boxes: Vec<Box3>, entries: Vec<Message>) -> (Vec<Box3>, FusionReport, Outputs) {
        let mut operator = FusionBoxes::new(config).unwrap();
        let mut out = Outputs::at(100);
        let ego = header("cav1", 7, Some(pose(1e5, -1e5, 0.4)));
        let selection = Message::new(ego.clone(), Selection { query: 7, entries });
        operator
            .on_input(EGO, Message::new(ego.clone(), Boxes(ego_boxes)), &mut out)
            .unwrap();
        operator.on_input(SELECTIONS, selection, &mut out).unwrap();
        let mut sent = out.take_sent();
        assert_eq!(sent.len(), 2);
        let (report_port, report) = sent.pop().unwrap();
        let (boxes_port, fused) = sent.pop().unwrap();
        assert_eq!((boxes_port, report_port), (BOXES, REPORT));
        let (fused_header, Boxes(fused)) = fused.into_parts().unwrap();
        assert_eq!(
            (fused_header.agent, fused_header.seq, fused_header.pose),
            (ego.agent, 7, ego.pose)
        );
        let (report_header, report): (Header, Report) = report.into_parts().unwrap();
        assert_eq!((report_header.kind, &*report.topic), (Kind::Report, "fusion"));
        (fused, from_report(&report).unwrap(), out)
    }

    #[test]
    fn brings_boxes_to_the_ego_frame() {
        let (ego, sender) = (pose(1e5, -1e5, 0.4), pose(1e5 + 30.0, -1e5 + 5.0, -2.0));
        let seen = object([10.0, -3.0, 0.8], 0.7, 0.9);
        let (fused, ..) = fuse_set(
            Config::default(),
            vec![],
            vec![boxes("rsu1", Some(sender), vec![seen.clone()])],
        );
        // One object has one place in the map, whoever looks.
        let (there, here) = (sender * Point3::from(seen.center), ego * Point3::from(fused[0].center));
        assert!((there - here).norm() < 1e-9, "{there} {here}");
        assert!(((fused[0].yaw + 0.4) - (0.7 - 2.0)).sin().abs() < 1e-12);
        let speed = fused[0].velocity.unwrap();
        assert!((speed[0] - 2.0 * (-2.4f64).cos()).abs() < 1e-12 && (speed[1] - 2.0 * (-2.4f64).sin()).abs() < 1e-12);
        assert_eq!((fused[0].length, fused[0].score), (seen.length, seen.score));
    }

    #[test]
    fn holds_what_every_fusion_owes_its_graph() {
        let own = vec![object([10.0, 0.0, 0.8], 0.1, 0.9), object([30.0, 5.0, 0.8], 2.0, 0.4)];
        let case = FusionCase {
            args: vec![],
            ego: boxes("cav1", Some(pose(1e5, -1e5, 0.4)), own.clone()),
            entries: vec![
                boxes(
                    "rsu1",
                    Some(pose(1e5 + 30.0, -1e5, -2.0)),
                    vec![object([4.0, 1.0, 0.7], 0.3, 0.8)],
                ),
                boxes(
                    "cav2",
                    Some(pose(1e5, -1e5 + 40.0, 1.0)),
                    vec![object([9.0, 2.0, 0.7], 0.0, 0.8)],
                ),
            ],
            alone: Boxes(own).into(),
        };
        case.check::<FusionBoxes>();
    }

    #[test]
    fn lists_the_ego_first_then_agents_by_name_and_index() {
        let at = Some(pose(1e5, -1e5, 0.4));
        let numbered = |track| Box3 {
            track: Some(track),
            ..object([1.0, 2.0, 0.0], 0.0, 0.5)
        };
        let entries = vec![
            boxes("rsu1", at, vec![numbered(5)]),
            boxes("cav2", at, vec![numbered(3), numbered(4)]),
        ];
        let (fused, report, _) = fuse_set(Config::default(), vec![numbered(1), numbered(2)], entries);
        assert_eq!(
            fused.iter().map(|b| b.track.unwrap()).collect::<Vec<_>>(),
            [1, 2, 3, 4, 5]
        );
        assert_eq!((report.query, &*report.agent, report.over_limit.len()), (7, "cav1", 0));
    }

    #[test]
    fn passes_the_ego_alone_on_without_entries() {
        let own = object([1.0, 2.0, 0.0], 0.0, 0.5);
        let (fused, report, _) = fuse_set(Config::default(), vec![own.clone()], vec![]);
        assert_eq!(fused, [own]);
        assert!(report.over_limit.is_empty() && report.rejected.is_empty());
    }

    #[test]
    fn leaves_the_ego_boxes_out_when_the_collaborators_speak_alone() {
        let theirs = boxes(
            "rsu1",
            Some(pose(1e5, -1e5, 0.4)),
            vec![object([9.0, 2.0, 0.0], 0.0, 0.5)],
        );
        let config = Config {
            ego_boxes: false,
            ..Config::default()
        };
        let (fused, report, _) = fuse_set(config, vec![object([1.0, 2.0, 0.0], 0.0, 0.9)], vec![theirs]);
        assert_eq!(fused.iter().map(|b| b.score).collect::<Vec<_>>(), [0.5]);
        assert_eq!(report.query, 7);
    }

    #[test]
    fn reports_collaborators_beyond_its_limit() {
        let at = Some(pose(1e5, -1e5, 0.4));
        let entries: Vec<_> = ["rsu1", "cav3", "cav2"]
            .map(|agent| boxes(agent, at, vec![object([0.0; 3], 0.0, 0.5)]))
            .into();
        let config = Config {
            max_collaborators: Some(1),
            ..Config::default()
        };
        let (fused, report, out) = fuse_set(config, vec![], entries);
        assert_eq!(fused.len(), 1);
        let over: Vec<_> = report
            .over_limit
            .iter()
            .map(|id| (&*id.agent, id.kind, id.seq))
            .collect();
        assert_eq!(over, [("cav3", Kind::Boxes, 3), ("rsu1", Kind::Boxes, 3)]);
        assert_eq!(out.counted("over_limit_messages"), 2);
    }

    #[test]
    fn rejects_entries_that_have_no_pose_or_are_no_boxes() {
        let cloud = Message::new(header("cav3", 1, Some(pose(0.0, 0.0, 0.0))), PointCloud::empty());
        let entries = vec![boxes("cav2", None, vec![object([0.0; 3], 0.0, 0.5)]), cloud];
        let (fused, report, out) = fuse_set(Config::default(), vec![object([0.0; 3], 0.0, 0.1)], entries);
        assert_eq!(fused.len(), 1);
        assert_eq!(
            report.rejected.iter().map(|id| &*id.agent).collect::<Vec<_>>(),
            ["cav2", "cav3"]
        );
        assert_eq!(out.counted("rejected_messages"), 2);
    }

    #[test]
    fn places_nothing_without_a_pose_of_the_ego() {
        let entry = boxes("cav2", Some(pose(0.0, 0.0, 0.0)), vec![object([0.0; 3], 0.0, 0.5)]);
        let fused = fuse(vec![object([0.0; 3], 0.0, 0.1)], None, vec![entry], &Config::default());
        assert_eq!((fused.boxes.len(), fused.rejected.len()), (1, 1));
    }

    #[test]
    fn drops_boxes_below_the_least_score() {
        let entry = boxes("cav2", Some(pose(0.0, 0.0, 0.0)), vec![object([0.0; 3], 0.0, 0.5)]);
        let config = Config {
            min_score: 0.3,
            ..Config::default()
        };
        let (fused, _, out) = fuse_set(config, vec![object([0.0; 3], 0.0, 0.1)], vec![entry]);
        assert_eq!((fused.len(), out.counted("low_score_boxes")), (1, 1));
    }

    #[test]
    fn refuses_parts_of_different_sets() {
        let mut operator = FusionBoxes::new(Config::default()).unwrap();
        let mut out = Outputs::at(0);
        let selection = |seq| {
            Message::new(
                header("cav1", seq, None),
                Selection {
                    query: seq,
                    entries: vec![],
                },
            )
        };
        let error = operator
            .on_input(SELECTIONS, selection(7), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("without the ego's boxes"), "{error}");
        operator
            .on_input(EGO, Message::new(header("cav1", 6, None), Boxes(vec![])), &mut out)
            .unwrap();
        let error = operator
            .on_input(SELECTIONS, selection(7), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("query 7") && error.contains("seq 6"), "{error}");
        assert!(out.take_sent().is_empty());
    }

    #[test]
    fn describes_every_argument() {
        let names: Vec<_> = FusionBoxes::ARGUMENTS.iter().map(|argument| argument.name).collect();
        let keys: Vec<_> = realo_runtime::config::defaults::<Config>().keys().cloned().collect();
        assert_eq!(names, keys);
    }
}
