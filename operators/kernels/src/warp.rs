//! Where the cells of one map lie in another. [`crate::agents::sample`] reads a map there, with SIMD and threads in mind: the path of
//! all shipped fusions. Its weights are of f32, so its last digits are not those of the other two, `realo-fusion` and
//! `realo-methods`.

/// Where the cells of a map lie in another map of the same grid, in cells: `other = warp * (column, row, 1)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Warp(pub [[f64; 3]; 2]);

impl Warp {
    /// Both maps lie alike.
    pub const IDENTITY: Warp = Warp([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);

    /// From how the ground moves, in metres, between the frames of two maps whose first cell has its corner at `origin` and
    /// sides of `cell` m.
    pub fn of_ground(other_from_ego: [[f64; 3]; 2], origin: [f64; 2], cell: f64) -> Warp {
        let center = origin.map(|corner| corner + 0.5 * cell);
        let axis = |axis: usize| {
            let [along_x, along_y, shift] = other_from_ego[axis];
            let first = along_x * center[0] + along_y * center[1] + shift;
            [along_x, along_y, (first - center[axis]) / cell]
        };
        Warp([axis(0), axis(1)])
    }

    /// From the other map's cells back to the map's own.
    pub fn inverse(&self) -> Warp {
        let [[a, b, x], [c, d, y]] = self.0;
        let determinant = a * d - b * c;
        let [a, b, c, d] = [d, -b, -c, a].map(|entry| entry / determinant);
        Warp([[a, b, -(a * x + b * y)], [c, d, -(c * x + d * y)]])
    }

    /// First another warp, then this one.
    pub fn after(&self, first: &Warp) -> Warp {
        let [[a, b, x], [c, d, y]] = first.0;
        Warp(
            self.0
                .map(|[p, q, shift]| [p * a + q * c, p * b + q * d, p * x + q * y + shift]),
        )
    }

    /// Where a cell lies, as column and row in parts of a cell.
    #[inline(always)]
    pub fn at(&self, column: usize, row: usize) -> [f64; 2] {
        let (column, row) = (column as f64, row as f64);
        self.0.map(|[a, b, c]| a * column + b * row + c)
    }
}

/// Column and row of the cell that is nearest to a place, if the map has it.
#[inline(always)]
pub fn nearest(place: [f64; 2], size: [usize; 2]) -> Option<[usize; 2]> {
    let cell = place.map(f64::round_ties_even);
    let inside = |axis: usize| cell[axis] >= 0.0 && cell[axis] < size[axis] as f64;
    (inside(0) && inside(1)).then(|| cell.map(|index| index as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warps_follow_each_other_and_lead_back() {
        let (a, b) = (
            Warp([[0.8, -0.3, 2.0], [0.4, 0.9, -1.0]]),
            Warp([[1.0, 0.2, -5.0], [-0.1, 1.1, 3.0]]),
        );
        let [x, y] = b.at(7, 3);
        let there = |warp: &Warp, [x, y]: [f64; 2]| warp.0.map(|[p, q, shift]| p * x + q * y + shift);
        let near = |a: [f64; 2], b: [f64; 2]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(a.after(&b).at(7, 3), there(&a, [x, y])));
        assert!(near(there(&b.inverse(), [x, y]), [7.0, 3.0]));
    }
}
