//! The heading and shift that bring places onto others.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// Rounds in which far pairs lose their weight.
const ROUNDS: u32 = 30;
/// The kernel begins so wide, m, and narrows by a factor each round.
const WIDEST_M: f64 = 50.0;
const NARROWING: f64 = 0.8;
/// Places that spread less do not tell a heading, m.
const SPREAD_M: f64 = 5.0;

/// Two places that are one, and how sure that is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    pub from: Vector3<f64>,
    pub to: Vector3<f64>,
    /// Weight on the ground, and up; 0: not known.
    pub weights: [f64; 2],
    /// Width of the kernel of Geman and McClure, m; infinite: trusted.
    pub width: f64,
}

/// A turn about the vertical and a shift.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Planar {
    /// The transform.
    pub to_from_from: Isometry3<f64>,
    /// Root mean square distance of the places from their middle, on the ground, m: over a short one nobody sees a heading.
    pub spread_m: f64,
}

impl Planar {
    /// Whether the places tell the heading.
    pub fn has_heading(&self) -> bool {
        self.spread_m >= SPREAD_M
    }
}

/// The least squares of all pairs, with kernels that narrow; `None` without any.
pub(crate) fn align(pairs: &[Pair]) -> Option<Planar> {
    let mut found = weighed(pairs, None)?;
    let is_robust = pairs.iter().any(|pair| pair.width.is_finite());
    let mut least = WIDEST_M;
    for _ in 0..if is_robust { ROUNDS } else { 0 } {
        found = weighed(pairs, Some((&found.to_from_from, least)))?;
        least *= NARROWING;
    }
    Some(found)
}

/// One round: with weights by the distances that are left.
fn weighed(pairs: &[Pair], before: Option<(&Isometry3<f64>, f64)>) -> Option<Planar> {
    let robust = |pair: &Pair| {
        let Some((pose, least)) = before else { return 1.0 };
        let off = (pose * nalgebra::Point3::from(pair.from)).coords - pair.to;
        let width = pair.width.max(least);
        let share = 1.0 / (1.0 + off.xy().norm_squared() / (width * width));
        if width.is_finite() { share * share } else { 1.0 }
    };
    let weights: Vec<[f64; 2]> = pairs
        .iter()
        .map(|pair| pair.weights.map(|weight| weight * robust(pair)))
        .collect();
    let total: f64 = weights.iter().map(|[ground, _]| ground).sum();
    // False for what is not a number too.
    let has_weight = total > 0.0;
    if !has_weight {
        return None;
    }
    let mean = |of: &dyn Fn(&Pair) -> Vector3<f64>| {
        let sum = pairs.iter().zip(&weights).map(|(pair, [weight, _])| of(pair) * *weight);
        sum.sum::<Vector3<f64>>() / total
    };
    let (from, to) = (mean(&|pair| pair.from), mean(&|pair| pair.to));
    let (mut dot, mut cross, mut square) = (0.0, 0.0, 0.0);
    for (pair, [weight, _]) in pairs.iter().zip(&weights) {
        let (a, b) = (pair.from - from, pair.to - to);
        dot += weight * (a.x * b.x + a.y * b.y);
        cross += weight * (a.x * b.y - a.y * b.x);
        square += weight * a.xy().norm_squared();
    }
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), libm::atan2(cross, dot));
    let high: f64 = weights.iter().map(|[_, up]| up).sum();
    let up = pairs
        .iter()
        .zip(&weights)
        .map(|(pair, [_, up])| up * (pair.to.z - pair.from.z));
    let mut shift = to - rotation * from;
    shift.z = if high > 0.0 { up.sum::<f64>() / high } else { 0.0 };
    Some(Planar {
        to_from_from: Isometry3::from_parts(Translation3::from(shift), rotation),
        spread_m: (square / total).sqrt(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pairs(pose: &Isometry3<f64>, places: &[[f64; 3]], width: f64) -> Vec<Pair> {
        let of = |place: &[f64; 3]| Pair {
            from: (*place).into(),
            to: (pose * nalgebra::Point3::from(*place)).coords,
            weights: [1.0; 2],
            width,
        };
        places.iter().map(of).collect()
    }

    proptest! {
        #[test]
        fn a_heading_and_a_shift_are_found_again_under_jumps(
            places in prop::collection::vec(prop::array::uniform3(-100f64..100.0), 12..40),
            yaw in -3.1..3.1f64, x in -1e4..1e4f64, z in -50.0..50f64, jump in 30.0..200f64,
        ) {
            let pose = Isometry3::from_parts(
                Translation3::new(x, -x, z),
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw),
            );
            let exact = align(&pairs(&pose, &places, f64::INFINITY)).unwrap().to_from_from;
            prop_assert!((exact.translation.vector - pose.translation.vector).norm() < 1e-6 * (1.0 + x.abs()));
            prop_assert!(exact.rotation.angle_to(&pose.rotation) < 1e-7);
            let mut robust = pairs(&pose, &places, 1.0);
            for pair in robust.iter_mut().step_by(6) {
                pair.to.x += jump;
            }
            let found = align(&robust).unwrap().to_from_from;
            let off = found * nalgebra::Point3::origin() - pose * nalgebra::Point3::origin();
            prop_assert!(off.xy().norm() < 0.6, "{off}");
        }
    }

    #[test]
    fn places_of_one_spot_tell_no_heading() {
        let found = align(&pairs(&Isometry3::identity(), &[[1.0, 2.0, 3.0]; 5], 1.0)).unwrap();
        assert!(!found.has_heading());
        assert!(align(&[]).is_none());
    }
}
