//! The objects of a frame: what all agents labelled together, as one agent has them in its body frame.

use std::collections::BTreeSet;

use nalgebra::Isometry3;
use realo_schemas::Box3;
use realo_schemas::geometry::yaw_of;

use super::Label;

/// The labels of an agent with where its body is.
#[derive(Clone)]
pub struct Labelled {
    /// The agent's folder.
    pub folder: String,
    /// Where its body is.
    pub map_from_body: Isometry3<f64>,
    /// What its side labelled.
    pub labels: Vec<Label>,
}

/// The objects that an agent is scored against.
pub struct Truth {
    /// First its own labels, then what only others labelled.
    pub boxes: Vec<Box3>,
    /// How many of them are its own.
    pub own: usize,
    /// Its own points on each box, where its files count them.
    pub points: Vec<Option<u32>>,
}

/// Who an agent itself is among the objects.
pub struct Itself {
    /// Its outline about its LiDAR: a box centred in it is the agent.
    pub footprint: Option<[f64; 4]>,
    /// Whether the id of its object is the name of its folder.
    pub is_object: bool,
}

impl Itself {
    fn is(&self, folder: &str, label: &Label, object: &Box3) -> bool {
        let [x, y, _] = object.center;
        let inside = |[x0, x1, y0, y1]: [f64; 4]| (x0..=x1).contains(&x) && (y0..=y1).contains(&y);
        (self.is_object && label.id == folder) || self.footprint.is_some_and(inside)
    }
}

/// All objects of a frame in the body frame of one of its agents, without the agent itself. Of an object that several agents
/// labelled its own label counts, else that of the first other agent.
pub fn truth_of(frame: &[Labelled], agent: usize, itself: &Itself) -> Truth {
    let ours = &frame[agent];
    let body_from_map = ours.map_from_body.inverse();
    let (mut boxes, mut points, mut known, mut own) = (Vec::new(), Vec::new(), BTreeSet::new(), 0);
    let others = frame.iter().enumerate().filter(|(index, _)| *index != agent);
    for (index, side) in std::iter::once((agent, ours)).chain(others) {
        for label in &side.labels {
            let object = label.to_box(&body_from_map);
            if !itself.is(&ours.folder, label, &object) && known.insert(&label.id) {
                boxes.push(object);
                points.push(label.points.filter(|_| index == agent));
                own += usize::from(index == agent);
            }
        }
    }
    Truth { boxes, own, points }
}

impl Label {
    /// The box in a body frame: the centre is moved, and the heading is that of its x axis.
    pub fn to_box(&self, body_from_map: &Isometry3<f64>) -> Box3 {
        let body_from_object = body_from_map * self.map_from_object;
        let yaw = yaw_of(&body_from_object.rotation);
        let (sin, cos) = libm::sincos(yaw);
        let mut object = Box3::new(
            self.class.as_str(),
            body_from_object.translation.vector.into(),
            self.size,
            yaw,
        );
        object.velocity = self.speed.map(|speed| [speed * cos, speed * sin, 0.0]);
        object.track = self.track;
        object
    }
}

#[cfg(test)]
mod tests {
    use realo_logs::track_of;

    use super::*;

    fn label(id: &str, x: f64) -> Label {
        Label {
            id: id.into(),
            track: track_of(id),
            class: "Car".into(),
            map_from_object: Isometry3::translation(x, 0.0, 1.0),
            size: [4.0, 2.0, 1.5],
            speed: Some(5.0),
            points: None,
        }
    }

    fn side(folder: &str, x: f64, labels: Vec<Label>) -> Labelled {
        Labelled {
            folder: folder.into(),
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            labels,
        }
    }

    #[test]
    fn one_object_of_two_agents_is_one_box_and_an_agent_is_not_its_own_object() {
        let frame = [
            side("7", 0.0, vec![label("1", 10.0), label("2", 20.0)]),
            side(
                "8",
                30.0,
                vec![label("2", 20.4), label("3", 40.0), label("7", 0.5), label("x", -0.5)],
            ),
        ];
        let by_id = Itself {
            footprint: None,
            is_object: true,
        };
        let truth = truth_of(&frame, 0, &by_id);
        let found: Vec<_> = truth
            .boxes
            .iter()
            .map(|object| (object.track, object.center[0]))
            .collect();
        assert_eq!(truth.own, 2);
        assert_eq!(found[..3], [(Some(1), 10.0), (Some(2), 20.0), (Some(3), 40.0)]);
        assert_eq!(found.len(), 4, "`x` is not known to be the agent");
        let by_place = Itself {
            footprint: Some([-2.0, 2.0, -1.0, 1.0]),
            is_object: false,
        };
        assert_eq!(truth_of(&frame, 0, &by_place).boxes.len(), 3);
        let other = truth_of(&frame, 1, &by_place);
        let of_two = other.boxes.iter().find(|object| object.track == Some(2)).unwrap();
        assert!((of_two.center[0] - -9.6).abs() < 1e-12, "each has its own label");
        assert_eq!(of_two.velocity, Some([5.0, 0.0, 0.0]));
    }
}
