//! Late fusion: brings the boxes of selected collaborators to the ego's body frame and lists them after the ego's own.
//! Duplicates stay; the next stage is `nms`, whose order at equal scores is the order here.
//!
//! The transform is `ego_from_sender` of the two stamps, from the poses in the headers. It removes the motion of agents between
//! the stamps. With `move_boxes` that of objects is removed too: a box that says its velocity is moved by velocity × (stamp of
//! the ego's message − stamp of the box's message), which the truth of the ego's sweep asks for.

use realo_fusion::{Collaborator, Input, Pairing, Set};
use realo_operator::{Counter, Describe, Error, Operator, Outputs, Settings};
use realo_schemas::geometry::{detection_fault, transform_box};
use realo_schemas::{Box3, Boxes, Header, Nanos, to_seconds};
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
    /// Whether collaborators' boxes are moved by their velocities to the stamp of the ego's; such come from `tracker`.
    pub move_boxes: bool,
    /// Boxes are moved over no longer a time than this, ms; of messages that are older they stay where they were.
    #[setting(default = 1000, range = 0..=60_000)]
    pub max_move_ms: u32,
}

/// The ego's boxes, then the collaborators', in the ego's frame. `max_move`: over how long a time the collaborators' are moved
/// by their velocities, ns; `None`: they are not. And how many of the collaborators' were moved.
pub fn fuse(set: &Set<Boxes>, ego_boxes: bool, max_move: Option<Nanos>) -> (Vec<Box3>, u64) {
    let mut fused = if ego_boxes { set.ego.0.clone() } else { Vec::new() };
    let mut moved = 0;
    for collaborator in &set.collaborators {
        let age = set.header.stamp.saturating_sub(collaborator.header.stamp);
        let is_moved = max_move.is_some_and(|max| age.saturating_abs() <= max);
        moved += place(collaborator, is_moved.then(|| to_seconds(age)), &mut fused);
    }
    (fused, moved)
}

/// Lists a collaborator's boxes in the ego's frame, moved by their velocities over a time, s; how many were moved.
fn place(collaborator: &Collaborator<Boxes>, seconds: Option<f64>, fused: &mut Vec<Box3>) -> u64 {
    let mut moved = 0;
    for object in &collaborator.payload.0 {
        // A velocity that no object has moves nothing.
        let by = seconds
            .zip(object.velocity)
            .filter(|_| detection_fault(object).is_none());
        let mut object = object.clone();
        if let Some((seconds, velocity)) = by {
            moved += 1;
            for (center, velocity) in object.center.iter_mut().zip(velocity) {
                *center += velocity * seconds;
            }
        }
        fused.push(transform_box(&collaborator.ego_from_sender, &object));
    }
    moved
}

/// Late fusion: brings collaborators' boxes to the ego's frame and lists them after its own.
#[derive(Describe)]
#[stage(
    input = Input<Boxes>,
    counters(LOW_SCORE_BOXES, MOVED_BOXES, UNMOVED_BOXES, realo_fusion::OVER_LIMIT_MESSAGES, realo_fusion::REJECTED_MESSAGES, realo_fusion::OTHER_LEVEL)
)]
pub struct FusionBoxes {
    settings: Settings,
    pairing: Pairing<Boxes>,
}

const LOW_SCORE_BOXES: Counter = Counter::plain("low_score_boxes", "boxes of all agents dropped: below `min_score`");
const MOVED_BOXES: Counter = Counter::plain(
    "moved_boxes",
    "boxes of collaborators that were moved by their velocities (`move_boxes`)",
);
const UNMOVED_BOXES: Counter = Counter::plain(
    "unmoved_boxes",
    "boxes of collaborators that were not moved: of unknown velocity, or of a message older than `max_move_ms`",
);

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
        let settings = &self.settings;
        let max_move = settings
            .move_boxes
            .then(|| Nanos::from(settings.max_move_ms) * 1_000_000);
        let (mut boxes, moved) = fuse(&set, settings.ego_boxes, max_move);
        if settings.move_boxes {
            let theirs: usize = set.collaborators.iter().map(|one| one.payload.0.len()).sum();
            out.count(&MOVED_BOXES, "", moved);
            out.count(&UNMOVED_BOXES, "", theirs as u64 - moved);
        }
        let before = boxes.len();
        // A score that is NaN is left to `nms`, which counts it as invalid.
        boxes.retain(|object| object.score.is_nan() || object.score >= settings.min_score);
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

    /// A collaborator's boxes of 300 ms before the ego's, as the ego fuses them with `move_boxes`.
    fn moved(settings: Settings, sender: Isometry3<f64>, theirs: Vec<Box3>) -> (Vec<Box3>, [u64; 2]) {
        let mut entry = boxes("rsu1", Some(sender), theirs);
        entry.header.stamp -= 300_000_000;
        let settings = Settings {
            move_boxes: true,
            ..settings
        };
        // The ego's own velocity moves nothing.
        let own = object([40.0, 0.0, 0.8], 0.0, 0.9);
        let (mut fused, _, out) = fuse_set(settings, vec![own.clone()], vec![entry]);
        assert_eq!(fused.remove(0), own);
        (fused, ["moved_boxes", "unmoved_boxes"].map(|name| out.counted(name)))
    }

    #[test]
    fn boxes_are_moved_by_their_velocities_to_the_time_of_the_ego() {
        let (ego, sender) = (pose(1e5, -1e5, 0.4), pose(1e5 + 30.0, -1e5 + 5.0, -2.0));
        let mut seen = object([10.0, -3.0, 0.8], 0.7, 0.9);
        seen.velocity = Some([6.0, -8.0, 0.0]);
        let mut unknown = seen.clone();
        unknown.velocity = None;
        let mut wrong = seen.clone();
        wrong.velocity = Some([f64::INFINITY, 0.0, 0.0]);
        let (fused, counts) = moved(Settings::default(), sender, vec![seen.clone(), unknown, wrong]);
        assert_eq!(counts, [1, 2]);
        let from = sender * Point3::from(seen.center);
        let by = sender.rotation * nalgebra::Vector3::new(6.0, -8.0, 0.0) * 0.3;
        let expected = [from + by, from, from];
        for (found, expected) in fused.iter().zip(expected) {
            let found = ego * Point3::from(found.center);
            assert!((found - expected).norm() < 1e-9, "{found} for {expected}");
        }
    }

    #[test]
    fn boxes_of_messages_that_are_too_old_stay() {
        let at = pose(1e5, -1e5, 0.4);
        let seen = object([10.0, -3.0, 0.8], 0.7, 0.9);
        for (max_move_ms, counts) in [(300, [1, 0]), (299, [0, 1])] {
            let settings = Settings {
                max_move_ms,
                ..Settings::default()
            };
            let (fused, found) = moved(settings, at, vec![seen.clone()]);
            assert_eq!(found, counts);
            let by = fused[0].center[0] - seen.center[0];
            assert!((by - 0.6 * counts[0] as f64).abs() < 1e-9, "{by}");
        }
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
