//! Late fusion that keeps, of several boxes of one object, the one whose sender is nearest to it.

use nalgebra::{Isometry3, Vector3};
use realo_fusion::{Input, Pairing, Set};
use realo_operator::{Counter, Describe, Error, Operator, Outputs, Settings};
use realo_schemas::geometry::{Footprint, iou_exceeds, transform_box};
use realo_schemas::{Box3, Boxes, Header};
use serde::{Deserialize, Serialize};

/// Settings of [`FusionNearest`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// IoU above which two boxes are one object; 1: every box stays.
    #[setting(default = 0.15, range = 0.0..=1.0)]
    pub threshold: f64,
}

/// A box in the ego's frame, and how far its sender was from it.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// The box, in the ego's body frame.
    pub object: Box3,
    /// From the origin of the sender's body frame to the centre, m.
    pub range_m: f64,
}

impl Seen {
    /// A box of a sender, brought to the ego's frame.
    fn new(object: &Box3, ego_from_sender: &Isometry3<f64>) -> Self {
        Seen {
            range_m: Vector3::from(object.center).norm(),
            object: transform_box(ego_from_sender, object),
        }
    }
}

/// Of boxes that overlap by an IoU above `threshold` keeps the one seen from nearest; of those at one range the first.
/// The order of the kept ones stays.
pub fn keep_nearest(seen: Vec<Seen>, threshold: f64) -> Vec<Box3> {
    let footprints: Vec<Footprint> = seen.iter().map(|seen| Footprint::of(&seen.object)).collect();
    let mut order: Vec<usize> = (0..seen.len()).collect();
    order.sort_by(|a, b| seen[*a].range_m.total_cmp(&seen[*b].range_m));
    let mut kept: Vec<usize> = Vec::new();
    for candidate in order {
        let doubles = |k: &usize| iou_exceeds(&footprints[*k], &footprints[candidate], threshold);
        if threshold >= 1.0 || !kept.iter().any(doubles) {
            kept.push(candidate);
        }
    }
    kept.sort_unstable();
    kept.into_iter().map(|index| seen[index].object.clone()).collect()
}

/// Late fusion: of several boxes of one object keeps the one seen from nearest.
#[derive(Describe)]
#[stage(input = Input<Boxes>, counters(FARTHER_BOXES, realo_fusion::OVER_LIMIT_MESSAGES, realo_fusion::REJECTED_MESSAGES, realo_fusion::OTHER_LEVEL))]
pub struct FusionNearest {
    settings: Settings,
    pairing: Pairing<Boxes>,
}

const FARTHER_BOXES: Counter = Counter::plain(
    "farther_boxes",
    "boxes dropped because somebody nearer saw the same object",
);

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The joint list, in the ego's frame.
    Proposals(Header, Boxes),
}

impl Operator for FusionNearest {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(FusionNearest {
            settings,
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: Input<Boxes>, out: &mut Outputs<Output>) -> Result<(), Error> {
        let Some(set) = self.pairing.take(input, None)? else {
            return Ok(());
        };
        let seen = all_seen(&set);
        let all = seen.len();
        let kept = keep_nearest(seen, self.settings.threshold);
        out.count(&FARTHER_BOXES, "", (all - kept.len()) as u64);
        set.send(Output::Proposals, Boxes(kept), out);
        Ok(())
    }
}

/// What anybody of a set saw, in the ego's frame.
fn all_seen(set: &Set<Boxes>) -> Vec<Seen> {
    let own = set.ego.0.iter().map(|object| Seen {
        range_m: Vector3::from(object.center).norm(),
        object: object.clone(),
    });
    let theirs = set.collaborators.iter().flat_map(|collaborator| {
        let boxes = collaborator.payload.0.iter();
        boxes.map(|object| Seen::new(object, &collaborator.ego_from_sender))
    });
    own.chain(theirs).collect()
}

#[cfg(test)]
mod tests {
    use realo_engine::testkit::FusionCase;
    use realo_schemas::{Kind, Message, Pose};

    use super::*;

    fn object(x: f64, y: f64) -> Box3 {
        Box3 {
            center: [x, y, 0.8],
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw: 0.1,
            velocity: None,
            class: "Car".into(),
            score: 0.5,
            track: None,
            covariance: None,
        }
    }

    fn message(agent: &str, x_in_map: f64, boxes: Vec<Box3>) -> Message {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, 0, 50, 80);
        header.pose = Some(Pose::exact(Isometry3::translation(x_in_map, 0.0, 0.0)));
        Message::new(header, Boxes(boxes))
    }

    #[test]
    fn holds_what_every_fusion_owes_its_graph() {
        let own = vec![object(10.0, 0.0), object(30.0, 5.0)];
        for threshold in [0.15, 1.0] {
            let case = FusionCase {
                args: vec![format!("threshold={threshold}")],
                ego: message("cav1", 0.0, own.clone()),
                entries: vec![
                    message("rsu1", 25.0, vec![object(5.1, 5.0), object(-10.0, 8.0)]),
                    message("cav2", 60.0, vec![object(-49.8, 0.0)]),
                ],
                alone: Boxes(own.clone()).into(),
            };
            case.check::<FusionNearest>();
        }
    }

    #[test]
    fn keeps_the_box_that_is_seen_from_nearest_at_its_place_in_the_list() {
        let seen = |x, range_m| Seen {
            object: object(x, 0.0),
            range_m,
        };
        let list = vec![seen(10.0, 10.0), seen(50.0, 50.0), seen(50.2, 5.0), seen(10.1, 40.0)];
        let places = |kept: Vec<Box3>| kept.iter().map(|object| object.center[0]).collect::<Vec<_>>();
        assert_eq!(places(keep_nearest(list.clone(), 0.15)), [10.0, 50.2]);
        assert_eq!(places(keep_nearest(list, 1.0)), [10.0, 50.0, 50.2, 10.1]);
    }

    #[test]
    fn refuses_a_threshold_that_is_no_iou() {
        let error = FusionNearest::new(Settings { threshold: 1.5 }).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains("expected 0 to 1, found 1.5"), "{error}");
    }
}
