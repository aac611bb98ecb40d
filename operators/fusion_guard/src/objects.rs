//! Boxes as the guard compares them: on the ground plane of the ego's frame.

use nalgebra::{Isometry3, Vector2};
use realo_schemas::Box3;
use realo_schemas::geometry::{detection_fault, transform_box};

/// A box seen from above, in the ego's frame at the ego's stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Its place in the message that it is from.
    pub index: usize,
    /// Centre, m.
    pub center: Vector2<f64>,
    /// Heading, rad.
    pub yaw: f64,
    /// Length and width, m.
    pub size: [f64; 2],
    /// Velocity, m/s; zero where it is not known.
    pub velocity: Vector2<f64>,
    /// Confidence in [0, 1].
    pub score: f64,
}

/// A longer object has a heading that counts, m.
const LONG_M: f64 = 2.5;
/// Lengths and widths of one object differ by no more than this factor between two agents.
const ALIKE: f64 = 1.7;

impl Object {
    /// Whether the heading says anything, up to half a turn.
    pub fn is_long(&self) -> bool {
        self.size[0] > LONG_M && self.size[0] > 1.5 * self.size[1]
    }

    /// Whether both may be the same object, by their extents.
    pub fn is_like(&self, other: &Object) -> bool {
        let close = |a: f64, b: f64| a <= ALIKE * b && b <= ALIKE * a;
        self.is_long() == other.is_long()
            && close(self.size[0], other.size[0])
            && (self.is_long() || close(self.size[1], other.size[1]))
    }
}

/// The best boxes of a message that an object can have, at most `max`, in their order.
///
/// `ego_from_frame` brings them to the ego's frame, and their velocities over `seconds` to its time.
pub fn objects(boxes: &[Box3], ego_from_frame: &Isometry3<f64>, seconds: f64, max: usize) -> Vec<Object> {
    let mut sound: Vec<usize> = (0..boxes.len())
        .filter(|index| detection_fault(&boxes[*index]).is_none())
        .collect();
    if sound.len() > max {
        sound.sort_by(|a, b| boxes[*b].score.total_cmp(&boxes[*a].score).then(a.cmp(b)));
        sound.truncate(max);
        sound.sort_unstable();
    }
    let object = |index: usize| {
        let there = transform_box(ego_from_frame, &boxes[index]);
        let velocity = there.velocity.map_or(Vector2::zeros(), |[x, y, _]| Vector2::new(x, y));
        Object {
            index,
            center: Vector2::new(there.center[0], there.center[1]) + velocity * seconds,
            yaw: there.yaw,
            size: [there.length, there.width],
            velocity,
            score: f64::from(there.score),
        }
    };
    sound.into_iter().map(object).collect()
}

/// The places of the `max` surest objects, surest first; of equal ones the first.
pub(crate) fn surest(objects: &[Object], max: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..objects.len()).collect();
    order.sort_by(|a, b| objects[*b].score.total_cmp(&objects[*a].score));
    order.truncate(max);
    order
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A car of score 0.9.
    pub(crate) fn car(x: f64, y: f64, yaw: f64) -> Box3 {
        Box3 {
            score: 0.9,
            ..Box3::new("Car", [x, y, 0.8], [4.5, 1.9, 1.6], yaw)
        }
    }

    /// A pedestrian of score 0.8.
    pub(crate) fn pedestrian(x: f64, y: f64) -> Box3 {
        Box3 {
            score: 0.8,
            ..Box3::new("Pedestrian", [x, y, 0.9], [0.6, 0.6, 1.8], 0.0)
        }
    }

    #[test]
    fn boxes_are_brought_to_the_frame_and_the_time_of_the_ego() {
        let mut moving = car(10.0, 2.0, 0.1);
        moving.velocity = Some([5.0, 0.0, 0.0]);
        let turned = Isometry3::from_parts(
            nalgebra::Translation3::new(1.0, 0.0, 0.0),
            nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2),
        );
        let found = objects(&[moving], &turned, 0.2, 8);
        assert!(
            (found[0].center - Vector2::new(-1.0, 11.0)).norm() < 1e-9,
            "{:?}",
            found[0].center
        );
        assert!((found[0].yaw - std::f64::consts::FRAC_PI_2 - 0.1).abs() < 1e-9);
    }

    #[test]
    fn the_best_are_kept_and_what_no_object_has_is_not() {
        let mut boxes: Vec<Box3> = (0..10).map(|x| car(f64::from(x), 0.0, 0.0)).collect();
        boxes[3].score = 0.95;
        boxes[7].score = 0.97;
        boxes[5].center[0] = f64::NAN;
        let found = objects(&boxes, &Isometry3::identity(), 0.0, 3);
        let indices: Vec<usize> = found.iter().map(|object| object.index).collect();
        assert_eq!(indices, [0, 3, 7]);
    }

    #[test]
    fn alike_are_objects_of_one_kind() {
        let of = |boxes: &[Box3]| objects(boxes, &Isometry3::identity(), 0.0, 8);
        let mut truck = car(0.0, 0.0, 0.0);
        truck.length = 9.0;
        let all = of(&[car(0.0, 0.0, 0.0), pedestrian(0.0, 0.0), truck]);
        assert!(all[0].is_like(&all[0]) && !all[0].is_like(&all[1]) && !all[0].is_like(&all[2]));
    }
}
