//! How far poses are from the truth.

use nalgebra::{Isometry3, Vector3};
use realo_schemas::geometry::{normalize_yaw, yaw_of};

use crate::align::{Pair, align};

/// Errors of many poses.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spread {
    /// In the mean.
    pub mean: f64,
    /// 95 % are smaller.
    pub p95: f64,
    /// The largest.
    pub max: f64,
}

/// Errors of poses: on the ground and up, m, and of the heading, degrees.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Poses that were compared.
    pub poses: usize,
    /// As they are.
    pub absolute: [Spread; 3],
    /// After the one turn about the vertical and shift that brings all of them onto the truth best.
    pub aligned: [Spread; 3],
    /// That shift at the middle of the poses, m, and turn, degrees.
    pub offset: [f64; 2],
}

/// Errors of poses, each with the truth; `None` without any.
pub fn errors(poses: &[[Isometry3<f64>; 2]]) -> Option<Errors> {
    let pairs: Vec<Pair> = poses.iter().map(|[pose, truth]| pair(pose, truth)).collect();
    let moved = align(&pairs)?.to_from_from;
    let middle = poses
        .iter()
        .map(|[pose, _]| pose.translation.vector)
        .sum::<Vector3<f64>>()
        / poses.len() as f64;
    let shift = (moved * nalgebra::Point3::from(middle)).coords - middle;
    let absolute: Vec<[f64; 3]> = poses.iter().map(|[pose, truth]| error(pose, truth)).collect();
    let aligned: Vec<[f64; 3]> = poses
        .iter()
        .map(|[pose, truth]| error(&(moved * pose), truth))
        .collect();
    let each = |errors: &[[f64; 3]]| [0, 1, 2].map(|of| spread(errors.iter().map(|error| error[of]).collect()));
    Some(Errors {
        poses: poses.len(),
        absolute: each(&absolute),
        aligned: each(&aligned),
        offset: [shift.xy().norm(), yaw_of(&moved.rotation).to_degrees().abs()],
    })
}

fn pair(pose: &Isometry3<f64>, truth: &Isometry3<f64>) -> Pair {
    Pair {
        from: pose.translation.vector,
        to: truth.translation.vector,
        weights: [1.0; 2],
        width: f64::INFINITY,
    }
}

fn error(pose: &Isometry3<f64>, truth: &Isometry3<f64>) -> [f64; 3] {
    let off = truth.translation.vector - pose.translation.vector;
    let heading = normalize_yaw(yaw_of(&truth.rotation) - yaw_of(&pose.rotation));
    [off.xy().norm(), off.z.abs(), heading.to_degrees().abs()]
}

fn spread(mut values: Vec<f64>) -> Spread {
    values.sort_unstable_by(f64::total_cmp);
    let (Some(max), count) = (values.last(), values.len()) else {
        return Spread::default();
    };
    Spread {
        mean: values.iter().sum::<f64>() / count as f64,
        p95: values[(count * 95).div_ceil(100) - 1],
        max: *max,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    #[test]
    fn an_offset_of_all_is_told_from_errors_among_them() {
        let moved = Isometry3::from_parts(
            Translation3::new(1.2, -0.9, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.01),
        );
        let poses: Vec<[Isometry3<f64>; 2]> = (0..100)
            .map(|at| {
                let truth = Isometry3::translation(f64::from(at % 10) - 4.5, f64::from(at / 10) - 4.5, 0.0);
                let mut pose = moved * truth;
                pose.translation.x += if at == 37 { 0.5 } else { 0.0 };
                [pose, truth]
            })
            .collect();
        let errors = errors(&poses).unwrap();
        let [absolute, _, heading] = errors.absolute;
        assert!((absolute.mean - 1.5).abs() < 0.02 && absolute.max > 1.8, "{absolute:?}");
        assert!((heading.p95 - 0.573).abs() < 1e-3, "{heading:?}");
        let [aligned, up, heading] = errors.aligned;
        assert!(aligned.p95 < 0.02 && (aligned.max - 0.5).abs() < 0.02, "{aligned:?}");
        assert!(heading.max < 0.05 && up.max < 1e-9, "{heading:?} {up:?}");
        assert!(
            (errors.offset[0] - 1.5).abs() < 0.02 && (errors.offset[1] - 0.573).abs() < 0.05,
            "{errors:?}"
        );
        assert_eq!(super::errors(&[]), None);
    }
}
