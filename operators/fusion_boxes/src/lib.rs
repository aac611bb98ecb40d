//! Late fusion: brings the boxes of selected collaborators to the ego's body frame and lists them after the ego's own.
//! Duplicates stay; the next stage is `nms`, whose order at equal scores is the order here.
//!
//! The transform is `ego_from_sender` of the two stamps, from the poses in the headers. The motion of objects between the
//! stamps is not removed.

use realo_fusion::{Input, Pairing, Set};
use realo_operator::{Counter, Describe, Error, Operator, Outputs, Settings};
use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, Boxes, Header};
use serde::{Deserialize, Serialize};

/// Settings of [`FusionBoxes`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Whether the ego's own boxes take part; false: the collaborators alone.
    #[setting(default = true)]
    pub ego_boxes: bool,
    /// Collaborators that a fusion takes, the nearest to the ego; null = all.
    pub max_collaborators: Option<usize>,
    /// Boxes of a lower score are dropped, the ego's own included.
    #[setting(range = ..=1.0)]
    pub min_score: f32,
}

/// The ego's boxes, then the collaborators', in the ego's frame.
pub fn fuse(set: &Set<Boxes>, ego_boxes: bool) -> Vec<Box3> {
    let own = if ego_boxes { &set.ego.0[..] } else { &[] };
    let theirs = set.collaborators.iter().flat_map(|collaborator| {
        let boxes = collaborator.payload.0.iter();
        boxes.map(|object| transform_box(&collaborator.ego_from_sender, object))
    });
    own.iter().cloned().chain(theirs).collect()
}

/// Late fusion: brings collaborators' boxes to the ego's frame and lists them after its own.
#[derive(Describe)]
#[stage(input = Input<Boxes>, counters(LOW_SCORE_BOXES, realo_fusion::OVER_LIMIT_MESSAGES, realo_fusion::REJECTED_MESSAGES))]
pub struct FusionBoxes {
    settings: Settings,
    pairing: Pairing<Boxes>,
}

const LOW_SCORE_BOXES: Counter = Counter::plain("low_score_boxes", "boxes of all agents dropped: below `min_score`");

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The ego's boxes, then the collaborators', in the ego's frame.
    Proposals(Header, Boxes),
}

impl Operator for FusionBoxes {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(FusionBoxes {
            settings,
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: Input<Boxes>, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(set) = self.pairing.take(input, self.settings.max_collaborators)? else {
            return Ok(());
        };
        let mut boxes = fuse(&set, self.settings.ego_boxes);
        let before = boxes.len();
        // A score that is NaN is left to `nms`, which counts it as invalid.
        boxes.retain(|object| object.score.is_nan() || object.score >= self.settings.min_score);
        out.count(&LOW_SCORE_BOXES, "", (before - boxes.len()) as u64);
        set.send(Output::Proposals, Boxes(boxes), out);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3};
    use realo_engine::testkit::FusionCase;
    use realo_schemas::report::Fate;
    use realo_schemas::{Kind, Message, PointCloud, Pose, Selection};

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
        header.to = Some("cav1".into());
        header
    }

    /// Who, and what became of its message.
    type Reported = Vec<(String, Fate)>;

    fn boxes(agent: &str, map_from_body: Option<Isometry3<f64>>, boxes: Vec<Box3>) -> Message {
        Message::new(header(agent, 3, map_from_body), Boxes(boxes))
    }

    /// Feeds one set of an ego 100 km from the map's origin.
    fn fuse_set(
        settings: Settings,
        ego_boxes: Vec<Box3>,
        entries: Vec<Message>,
    ) -> (Vec<Box3>, Reported, Outputs<Output>) {
        let mut operator = FusionBoxes::new(settings).unwrap();
        let mut out = Outputs::at(100);
        let ego = header("cav1", 7, Some(pose(1e5, -1e5, 0.4)));
        let selection = Message::new(ego.clone(), Selection { query: 7, entries });
        operator
            .on_message(
                Input::<Boxes>::EGO,
                Message::new(ego.clone(), Boxes(ego_boxes)),
                &mut out,
            )
            .unwrap();
        operator
            .on_message(Input::<Boxes>::SELECTIONS, selection, &mut out)
            .unwrap();
        let mut sent = out.take_sent();
        assert_eq!(sent.len(), 1);
        let (port, fused) = sent.remove(0);
        assert_eq!(port, Output::PROPOSALS);
        let (fused_header, Boxes(fused)) = fused.into_parts().unwrap();
        assert_eq!(
            (fused_header.agent, fused_header.seq, fused_header.pose),
            (ego.agent, 7, ego.pose)
        );
        let reported = out
            .take_fates()
            .into_iter()
            .map(|fated| (fated.message.from, fated.fate));
        (fused, reported.collect(), out)
    }

    #[test]
    fn brings_boxes_to_the_ego_frame() {
        let (ego, sender) = (pose(1e5, -1e5, 0.4), pose(1e5 + 30.0, -1e5 + 5.0, -2.0));
        let seen = object([10.0, -3.0, 0.8], 0.7, 0.9);
        let (fused, ..) = fuse_set(
            Settings::default(),
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
        let (fused, reported, _) = fuse_set(Settings::default(), vec![numbered(1), numbered(2)], entries);
        assert_eq!(
            fused.iter().map(|b| b.track.unwrap()).collect::<Vec<_>>(),
            [1, 2, 3, 4, 5]
        );
        assert_eq!(
            reported,
            [("cav2".to_string(), Fate::Used), ("rsu1".to_string(), Fate::Used)]
        );
    }

    #[test]
    fn passes_the_ego_alone_on_without_entries() {
        let own = object([1.0, 2.0, 0.0], 0.0, 0.5);
        let (fused, reported, _) = fuse_set(Settings::default(), vec![own.clone()], vec![]);
        assert_eq!(fused, [own]);
        assert_eq!(reported, []);
    }

    #[test]
    fn leaves_the_ego_boxes_out_when_the_collaborators_speak_alone() {
        let theirs = boxes(
            "rsu1",
            Some(pose(1e5, -1e5, 0.4)),
            vec![object([9.0, 2.0, 0.0], 0.0, 0.5)],
        );
        let settings = Settings {
            ego_boxes: false,
            ..Settings::default()
        };
        let (fused, reported, _) = fuse_set(settings, vec![object([1.0, 2.0, 0.0], 0.0, 0.9)], vec![theirs]);
        assert_eq!(fused.iter().map(|b| b.score).collect::<Vec<_>>(), [0.5]);
        assert_eq!(reported, [("rsu1".to_string(), Fate::Used)]);
    }

    #[test]
    fn reports_collaborators_beyond_its_limit() {
        let at = Some(pose(1e5, -1e5, 0.4));
        let entries: Vec<_> = ["rsu1", "cav3", "cav2"]
            .map(|agent| boxes(agent, at, vec![object([0.0; 3], 0.0, 0.5)]))
            .into();
        let settings = Settings {
            max_collaborators: Some(1),
            ..Settings::default()
        };
        let (fused, reported, out) = fuse_set(settings, vec![], entries);
        assert_eq!(fused.len(), 1);
        let expected = [
            ("cav2", Fate::Used),
            ("cav3", Fate::OverLimit),
            ("rsu1", Fate::OverLimit),
        ];
        assert_eq!(reported, expected.map(|(agent, fate)| (agent.to_string(), fate)));
        assert_eq!(out.counted("over_limit_messages"), 2);
    }

    #[test]
    fn rejects_entries_that_have_no_pose_or_are_no_boxes() {
        let cloud = Message::new(header("cav3", 1, Some(pose(0.0, 0.0, 0.0))), PointCloud::empty());
        let entries = vec![boxes("cav2", None, vec![object([0.0; 3], 0.0, 0.5)]), cloud];
        let (fused, reported, out) = fuse_set(Settings::default(), vec![object([0.0; 3], 0.0, 0.1)], entries);
        assert_eq!(fused.len(), 1);
        assert_eq!(
            reported,
            ["cav2", "cav3"].map(|agent| (agent.to_string(), Fate::Rejected))
        );
        assert_eq!(out.counted("rejected_messages"), 2);
    }

    #[test]
    fn places_nothing_without_a_pose_of_the_ego() {
        let mut operator = FusionBoxes::new(Settings::default()).unwrap();
        let mut out = Outputs::at(100);
        let entry = boxes("cav2", Some(pose(0.0, 0.0, 0.0)), vec![object([0.0; 3], 0.0, 0.5)]);
        let selection = Selection {
            query: 7,
            entries: vec![entry],
        };
        let ego = header("cav1", 7, None);
        let own = Boxes(vec![object([0.0; 3], 0.0, 0.1)]);
        operator
            .on_message(Input::<Boxes>::EGO, Message::new(ego.clone(), own), &mut out)
            .unwrap();
        operator
            .on_message(Input::<Boxes>::SELECTIONS, Message::new(ego, selection), &mut out)
            .unwrap();
        let (_, fused) = out.take_sent().swap_remove(0);
        assert_eq!(fused.into_parts::<Boxes>().unwrap().1.0.len(), 1);
        assert_eq!(out.counted("rejected_messages"), 1);
    }

    #[test]
    fn drops_boxes_below_the_least_score() {
        let entry = boxes("cav2", Some(pose(0.0, 0.0, 0.0)), vec![object([0.0; 3], 0.0, 0.5)]);
        let settings = Settings {
            min_score: 0.3,
            ..Settings::default()
        };
        let (fused, _, out) = fuse_set(settings, vec![object([0.0; 3], 0.0, 0.1)], vec![entry]);
        assert_eq!((fused.len(), out.counted("low_score_boxes")), (1, 1));
    }

    #[test]
    fn refuses_parts_of_different_sets() {
        let mut operator = FusionBoxes::new(Settings::default()).unwrap();
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
            .on_message(Input::<Boxes>::SELECTIONS, selection(7), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("without the ego's message"), "{error}");
        operator
            .on_message(
                Input::<Boxes>::EGO,
                Message::new(header("cav1", 6, None), Boxes(vec![])),
                &mut out,
            )
            .unwrap();
        let error = operator
            .on_message(Input::<Boxes>::SELECTIONS, selection(7), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("query 7") && error.contains("seq 6"), "{error}");
        assert!(out.take_sent().is_empty());
    }
}
