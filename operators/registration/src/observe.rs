//! In which directions a sweep tells where it was taken.

use crate::eigen::eigen;
use crate::rows::Sums;

/// A direction in which the pose may be off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Direction {
    /// Share of the points that tell it, 0 to about 1: an eigenvalue of the information matrix over the sum of weights, with turns counted
    /// as the way that they move a point at the lever's length.
    pub share: f64,
    /// Unit vector: shift along x, y, z in the map's axes, then turn about x, y, z times the lever.
    pub vector: [f64; 6],
    /// Whether so few tell it that the guess was kept along it.
    pub is_degenerate: bool,
}

/// What the sums of all points say.
#[derive(Clone, Debug)]
pub(crate) struct Observed {
    /// The one that is told worst first.
    pub directions: [Direction; 6],
    /// Root mean square distance of the points from the body's origin, m.
    pub lever_m: f64,
    /// The step that makes the distances smallest: shift, m, and turn, rad, about the body's origin.
    pub step: [f64; 6],
}

impl Observed {
    /// Solves the normal equations; along directions whose share is below `degenerate_share` there is no step (Zhang et al. 2016).
    /// `None` without any weight.
    pub fn new(sums: &Sums, degenerate_share: f64) -> Option<Self> {
        let lever_m = (sums.lever / sums.weight).sqrt();
        // Both are false for what is not a number.
        if !(sums.weight > 0.0 && lever_m > 0.0) {
            return None;
        }
        let scale = [1.0, 1.0, 1.0, 1.0 / lever_m, 1.0 / lever_m, 1.0 / lever_m];
        let mut matrix = sums.matrix();
        for (i, row) in matrix.iter_mut().enumerate() {
            for (j, value) in row.iter_mut().enumerate() {
                *value *= scale[i] * scale[j];
            }
        }
        let (values, vectors) = eigen(matrix);
        let directions: [Direction; 6] = std::array::from_fn(|k| {
            let share = values[k].max(0.0) / sums.weight;
            Direction {
                share,
                vector: vectors[k],
                is_degenerate: share <= degenerate_share,
            }
        });
        let mut step = [0.0; 6];
        for direction in directions.iter().filter(|direction| !direction.is_degenerate) {
            let along: f64 = (0..6).map(|i| direction.vector[i] * scale[i] * sums.right[i]).sum();
            for i in 0..6 {
                step[i] -= direction.vector[i] * scale[i] * along / (direction.share * sums.weight);
            }
        }
        Some(Observed {
            directions,
            lever_m,
            step,
        })
    }
}
