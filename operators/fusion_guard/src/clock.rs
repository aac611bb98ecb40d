//! How far a collaborator's clock is ahead: what moves is not where its velocity should have brought it.

use nalgebra::Vector2;

use crate::fit::Scene;
use crate::shift::{Shift, turned};

/// Slower objects say nothing of clocks, m/s.
const MOVES_MPS: f64 = 2.0;
/// A pair may be so far apart across the way, m.
const ACROSS_M: f64 = 0.8;
/// Votes that are so near to each other are of one offset, s.
const NEAR_S: f64 = 0.1;
/// A smaller offset is left as it is, s.
const SMALLEST_S: f64 = 0.08;
/// What has to speak for an offset: two sure objects.
const SUPPORT: f64 = 1.3;

/// How far their clock is ahead, s, from pairs of moving objects that the same offset brings together; `None` where too few say so, or as
/// many say that it is right.
///
/// `max_s`: the largest offset that is looked for, to either side.
pub fn ahead_s(scene: &Scene, shift: &Shift, max_s: f64) -> Option<f64> {
    let votes = votes(scene, shift, max_s);
    let near = |offset: f64| votes.iter().filter(move |(of, _)| (of - offset).abs() <= NEAR_S);
    let support = |offset: f64| near(offset).map(|(_, weight)| weight).sum::<f64>();
    let sums = votes.iter().map(|(offset, _)| (support(*offset), *offset));
    let (best, offset) = sums.fold((0.0, 0.0), |best, one| if one.0 > best.0 { one } else { best });
    let mean = near(offset).map(|(of, weight)| of * weight).sum::<f64>() / best;
    let is_clear = best >= SUPPORT && best > 1.5 * support(0.0) && near(offset).count() >= 2;
    (is_clear && mean.abs() >= SMALLEST_S).then_some(mean)
}

/// Offsets (s) that would bring pairs together, with what each pair says.
fn votes(scene: &Scene, shift: &Shift, max_s: f64) -> Vec<(f64, f64)> {
    let mut votes = Vec::new();
    for (other, object) in scene.theirs.iter().enumerate() {
        let velocity = turned(&object.velocity, shift.turn);
        let square = velocity.norm_squared();
        if square < MOVES_MPS * MOVES_MPS {
            continue;
        }
        let at = shift.place(&object.center);
        for (own, ego) in scene.ego.iter().enumerate() {
            let away: Vector2<f64> = ego.center - at;
            let offset = away.dot(&velocity) / square;
            let across = (away - velocity * offset).norm();
            if across <= ACROSS_M && offset.abs() <= max_s && scene.is_alike(own, other) {
                votes.push((offset, scene.weight(own, other)));
            }
        }
    }
    votes
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;
    use crate::objects::objects;
    use crate::objects::tests::car;

    /// Three cars that drive and two that stand, as an agent whose clock is ahead by `late` s has them.
    fn found(late: f64) -> Option<f64> {
        let ways = [
            (10.0, 2.0, [8.0, 0.0]),
            (25.0, -3.0, [-11.0, 0.5]),
            (-12.0, 6.0, [0.3, 6.0]),
            (5.0, 9.0, [0.0, 0.0]),
            (30.0, 9.0, [0.0, 0.0]),
        ];
        let at = |seconds: f64| {
            ways.map(|(x, y, [vx, vy]): (f64, f64, [f64; 2])| {
                let mut object = car(x + vx * seconds, y + vy * seconds, libm::atan2(vy, vx));
                object.velocity = Some([vx, vy, 0.0]);
                object
            })
        };
        let [own, theirs] = [at(0.0), at(-late)].map(|boxes| objects(&boxes, &Isometry3::identity(), 0.0, 9));
        ahead_s(&Scene::new(&own, &theirs), &Shift::none(Vector2::zeros()), 2.5)
    }

    #[test]
    fn the_offset_is_what_brings_moving_objects_together() {
        for late in [-1.5, -0.4, 0.3, 0.9, 2.0] {
            let ahead = found(late).expect("three cars say so");
            assert!((ahead - late).abs() < 0.02, "{ahead} for {late}");
        }
        assert_eq!(found(0.0), None);
        assert_eq!(found(0.03), None, "too small to matter");
    }

    #[test]
    fn one_object_says_nothing_of_a_clock() {
        let moving = |x: f64| {
            let mut object = car(x, 0.0, 0.0);
            object.velocity = Some([10.0, 0.0, 0.0]);
            objects(&[object], &Isometry3::identity(), 0.0, 9)
        };
        let (own, theirs) = (moving(10.0), moving(4.0));
        assert_eq!(
            ahead_s(&Scene::new(&own, &theirs), &Shift::none(Vector2::zeros()), 2.5),
            None
        );
    }
}
