//! Where a collaborator is when it does not say so: two constellations of objects laid over each other.

use nalgebra::Vector2;
use realo_assignment::AssignmentError;
use realo_schemas::geometry::normalize_yaw;

use crate::fit::{Fit, Noise, Scene, fit};
use crate::objects::{Object, surest};
use crate::shift::{Shift, half_turn, turned};

/// Objects of each side that are compared, the surest.
const OBJECTS: usize = 24;
/// Two objects are so far apart at least and at most, m.
const APART_M: [f64; 2] = [4.0, 80.0];
/// By which two agents differ about that, m.
const SAME_M: f64 = 0.7;
/// By which a long object's heading may differ, rad.
const HEADING: f64 = 0.3;
/// Motions that are looked at.
const MOTIONS: usize = 6000;
/// Motions that are refined.
const REFINED: usize = 16;
/// Pairs that have to agree.
const PAIRS: usize = 4;
/// By which their support has to exceed that of any other place.
const CLEAR: f64 = 1.5;

/// Two objects of one side.
struct Edge {
    ends: [usize; 2],
    /// From the first to the second, m.
    along: Vector2<f64>,
    length: f64,
}

/// The motion that lays `theirs`, in a frame of their own, over the ego's objects, if one does so clearly (FreeAlign, Lei et al. 2024: edges
/// of equal lengths between alike objects).
///
/// # Errors
/// [`AssignmentError`] for more objects than an assignment takes.
pub fn lay_over(ego: &[Object], theirs: &[Object], noise: &Noise) -> Result<Option<Fit>, AssignmentError> {
    let anywhere = Noise {
        pose_m: 1e4,
        pose_rad: 1e2,
        ..*noise
    };
    let scene = Scene::new(ego, theirs);
    let mut motions: Vec<(f64, Shift)> = motions(&scene)
        .into_iter()
        .map(|shift| (quick_support(&scene, &shift), shift))
        .collect();
    motions.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut refined: Vec<(f64, Shift)> = motions
        .into_iter()
        .take(REFINED)
        .map(|(_, start)| {
            let (shift, pairs) = scene.refine(start, &anywhere);
            (scene.support(&shift, &pairs), shift)
        })
        .collect();
    refined.sort_by(|a, b| b.0.total_cmp(&a.0));
    let Some((support, best)) = refined.first().copied() else {
        return Ok(None);
    };
    let elsewhere =
        |shift: &Shift| (shift.by - best.by).norm() > 1.0 || normalize_yaw(shift.turn - best.turn).abs() > 0.1;
    let other = refined
        .iter()
        .find(|(_, shift)| elsewhere(shift))
        .map_or(0.0, |(support, _)| *support);
    let fit = fit(&scene, &best, &anywhere, None)?;
    Ok((fit.pairs.len() >= PAIRS && support > CLEAR * other).then_some(fit))
}

fn edges(objects: &[Object], both_ways: bool) -> Vec<Edge> {
    let surest = surest(objects, OBJECTS);
    let mut edges = Vec::new();
    for (place, from) in surest.iter().enumerate() {
        for (other, to) in surest.iter().enumerate() {
            let along = objects[*to].center - objects[*from].center;
            let length = along.norm();
            if place != other && (both_ways || place < other) && (APART_M[0]..=APART_M[1]).contains(&length) {
                let ends = [*from, *to];
                edges.push(Edge { ends, along, length });
            }
        }
    }
    edges.sort_by(|a, b| a.length.total_cmp(&b.length));
    edges
}

/// Motions that lay an edge of theirs over one of the ego's.
fn motions(scene: &Scene) -> Vec<Shift> {
    let (own, theirs) = (edges(scene.ego, false), edges(scene.theirs, true));
    let mut motions = Vec::new();
    for edge in &own {
        let first = theirs.partition_point(|other| other.length < edge.length - SAME_M);
        let alike = theirs[first..]
            .iter()
            .take_while(|other| other.length <= edge.length + SAME_M);
        for other in alike {
            motions.extend(motion(scene, edge, other));
            if motions.len() >= MOTIONS {
                return motions;
            }
        }
    }
    motions
}

fn motion(scene: &Scene, own: &Edge, other: &Edge) -> Option<Shift> {
    let ends = || own.ends.iter().zip(&other.ends);
    if !ends().all(|(own, other)| scene.is_alike(*own, *other)) {
        return None;
    }
    let angle = |along: &Vector2<f64>| libm::atan2(along.y, along.x);
    let turn = normalize_yaw(angle(&own.along) - angle(&other.along));
    let fits = |(own, other): (&usize, &usize)| {
        let (own, other) = (&scene.ego[*own], &scene.theirs[*other]);
        !own.is_long() || half_turn(own.yaw - other.yaw - turn).abs() <= HEADING
    };
    let middle = |objects: &[Object], ends: [usize; 2]| 0.5 * (objects[ends[0]].center + objects[ends[1]].center);
    let by = middle(scene.ego, own.ends) - turned(&middle(scene.theirs, other.ends), turn);
    let pivot = Vector2::zeros();
    ends().all(fits).then_some(Shift { pivot, by, turn })
}

/// What speaks for a motion, without pairs: their objects that lie near an alike one of the ego's.
fn quick_support(scene: &Scene, shift: &Shift) -> f64 {
    let of = |(other, at): (usize, Vector2<f64>)| {
        let near = (0..scene.ego.len())
            .filter(|own| (scene.ego[*own].center - at).norm_squared() < 1.0 && scene.is_alike(*own, other));
        near.map(|own| scene.weight(own, other)).fold(0.0, f64::max)
    };
    scene.placed(shift).into_iter().enumerate().map(of).sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
    use realo_schemas::Box3;
    use realo_schemas::geometry::transform_box;

    use super::*;
    use crate::objects::objects;
    use crate::objects::tests::{car, pedestrian};

    const NOISE: Noise = Noise {
        place_m: 0.3,
        heading_rad: 0.07,
        pose_m: 5.0,
        pose_rad: 0.07,
    };

    fn town() -> Vec<Box3> {
        let mut boxes: Vec<Box3> = [
            (12.0, 3.0, 0.1),
            (25.0, -4.0, 3.1),
            (-8.0, 14.0, 1.6),
            (31.0, 22.0, 1.5),
            (-22.0, -9.0, 0.0),
            (6.0, -17.0, 0.4),
        ]
        .map(|(x, y, yaw)| car(x, y, yaw))
        .into();
        boxes.push(pedestrian(4.0, 8.0));
        boxes
    }

    #[test]
    fn an_agent_without_a_pose_is_found_from_what_both_see() {
        for yaw in [0.0, 1.0, 2.5, -2.0] {
            let ego_from_sender = Isometry3::from_parts(
                Translation3::new(18.0, -25.0, 0.0),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            );
            let theirs: Vec<Box3> = town()
                .iter()
                .map(|object| transform_box(&ego_from_sender.inverse(), object))
                .collect();
            let [own, theirs] = [town(), theirs].map(|boxes| objects(&boxes, &Isometry3::identity(), 0.0, 64));
            let fit = lay_over(&own, &theirs, &NOISE).unwrap().expect("they see the same");
            let point = Point3::new(9.0, -3.0, 0.0);
            let off = (fit.shift.isometry() * point - ego_from_sender * point).norm();
            assert!(off < 0.05 && fit.pairs.len() == 7, "{off} {fit:?}");
        }
    }

    #[test]
    fn agents_that_see_other_things_are_not_laid_over() {
        let other: Vec<Box3> = [
            (3.0, 3.0, 0.0),
            (14.0, 31.0, 0.5),
            (40.0, -12.0, 1.0),
            (-17.0, 2.0, 2.0),
            (-5.0, -33.0, 0.3),
        ]
        .map(|(x, y, yaw)| car(x, y, yaw))
        .into();
        let [own, theirs] = [town(), other].map(|boxes| objects(&boxes, &Isometry3::identity(), 0.0, 64));
        assert_eq!(lay_over(&own, &theirs, &NOISE).unwrap(), None);
        assert_eq!(lay_over(&own, &[], &NOISE).unwrap(), None);
        assert_eq!(lay_over(&[], &theirs, &NOISE).unwrap(), None);
    }
}
