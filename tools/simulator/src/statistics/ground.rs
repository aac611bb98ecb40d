//! The ground under a cloud, estimated from the cloud alone.

/// Side of a cell, m, and cells along a side of the field around the sensor.
const CELL: f64 = 2.0;
const CELLS: usize = 128;
const HALF: f64 = CELL * CELLS as f64 / 2.0;
/// The plane is fitted to what lies within this of the sensor, m.
const NEAR: f64 = 40.0;

/// A plane, and how far the ground lies from it in each cell.
pub(super) struct Ground {
    /// z = a + b x + c y.
    pub plane: [f64; 3],
    rest: Vec<f64>,
}

impl Ground {
    /// `points` relative to a sensor that stands over the origin.
    pub fn new(points: &[[f64; 3]]) -> Self {
        let lows = lows(points);
        let plane = plane(&lows);
        let off = |low: &[f64; 3]| low[2] - at(&plane, low[0], low[1]);
        let mut order: Vec<usize> = (0..CELLS * CELLS).collect();
        let far = |cell: usize| {
            let [x, y] = center(cell);
            x * x + y * y
        };
        order.sort_by(|a, b| far(*a).total_cmp(&far(*b)).then(a.cmp(b)));
        // Outwards from the sensor: a cell's low point is ground if it goes on from what is nearer.
        let mut rest = vec![f64::NAN; CELLS * CELLS];
        for cell in order {
            let (column, row) = (cell % CELLS, cell / CELLS);
            let (mut sum, mut weight) = (0.0, 0.0);
            for r in row.saturating_sub(2)..(row + 3).min(CELLS) {
                for c in column.saturating_sub(2)..(column + 3).min(CELLS) {
                    let known = rest[r * CELLS + c];
                    if !known.is_nan() {
                        let apart = (r.abs_diff(row) + c.abs_diff(column)) as f64;
                        sum += known / apart;
                        weight += 1.0 / apart;
                    }
                }
            }
            let expected = if weight > 0.0 { sum / weight } else { 0.0 };
            let found = lows[cell]
                .as_ref()
                .map(off)
                .filter(|found| (found - expected).abs() < 0.2);
            rest[cell] = found.unwrap_or(expected);
        }
        Ground { plane, rest }
    }

    /// Height of the ground, m; beyond the field, that of its border.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let place = |v: f64| ((v + HALF) / CELL - 0.5).clamp(0.0, (CELLS - 1) as f64 - 1e-6);
        let (u, v) = (place(x), place(y));
        let (i, j) = (u as usize, v as usize);
        let (u, v) = (u - i as f64, v - j as f64);
        let rest = |i: usize, j: usize| self.rest[j * CELLS + i];
        let low = rest(i, j) * (1.0 - u) + rest(i + 1, j) * u;
        let high = rest(i, j + 1) * (1.0 - u) + rest(i + 1, j + 1) * u;
        at(&self.plane, x, y) + low * (1.0 - v) + high * v
    }
}

fn at(plane: &[f64; 3], x: f64, y: f64) -> f64 {
    plane[0] + plane[1] * x + plane[2] * y
}

fn center(cell: usize) -> [f64; 2] {
    [cell % CELLS, cell / CELLS].map(|i| (i as f64 + 0.5) * CELL - HALF)
}

/// A low point of each cell with three points: the third lowest, so that a stray one below does not count.
fn lows(points: &[[f64; 3]]) -> Vec<Option<[f64; 3]>> {
    let mut cells: Vec<Vec<[f64; 3]>> = vec![Vec::new(); CELLS * CELLS];
    for point in points {
        let index = |v: f64| (v + HALF) / CELL;
        let (u, v) = (index(point[0]), index(point[1]));
        let inside = 0.0..CELLS as f64;
        if inside.contains(&u) && inside.contains(&v) {
            cells[v as usize * CELLS + u as usize].push(*point);
        }
    }
    let low = |mut cell: Vec<[f64; 3]>| {
        cell.sort_by(|a, b| a[2].total_cmp(&b[2]));
        cell.get(2).copied()
    };
    cells.into_iter().map(low).collect()
}

/// The plane through the low points near the sensor, by least squares over those that lie ever nearer to it.
fn plane(lows: &[Option<[f64; 3]>]) -> [f64; 3] {
    let near = |p: &&[f64; 3]| p[0] * p[0] + p[1] * p[1] < NEAR * NEAR;
    let near: Vec<&[f64; 3]> = lows.iter().flatten().filter(near).collect();
    let mut heights: Vec<f64> = near.iter().map(|p| p[2]).collect();
    heights.sort_by(f64::total_cmp);
    let Some(start) = heights.get(heights.len() / 3) else {
        return [0.0; 3];
    };
    let mut plane = [*start, 0.0, 0.0];
    for within in [1.0, 0.6, 0.4, 0.3, 0.25, 0.2, 0.2, 0.2] {
        let mut matrix = nalgebra::Matrix3::<f64>::zeros();
        let mut right = nalgebra::Vector3::<f64>::zeros();
        for p in near.iter().filter(|p| (p[2] - at(&plane, p[0], p[1])).abs() < within) {
            let row = nalgebra::Vector3::new(1.0, p[0], p[1]);
            matrix += row * row.transpose();
            right += row * p[2];
        }
        if let Some(solved) = matrix.cholesky().map(|factors| factors.solve(&right)) {
            plane = [solved[0], solved[1], solved[2]];
        }
    }
    plane
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_a_slope_under_hedges() {
        let mut points = Vec::new();
        for i in 0..200_000u64 {
            let unit = |k| crate::random::unit_of(crate::random::mix(3 * i + k));
            let (x, y) = (unit(0) * 120.0 - 60.0, unit(1) * 120.0 - 60.0);
            let hedge = (8.0..11.0).contains(&y) && unit(2) < 0.9;
            let z = -2.0 + 0.02 * x - 0.01 * y;
            points.push([x, y, if hedge { z + unit(2) } else { z }]);
        }
        let ground = Ground::new(&points);
        for (x, y) in [(0.0, 0.0), (30.0, 9.0), (-40.0, 20.0), (50.0, -50.0)] {
            let truth = -2.0 + 0.02 * x - 0.01 * y;
            assert!(
                (ground.height(x, y) - truth).abs() < 0.05,
                "{} for {truth} at {x} {y}",
                ground.height(x, y)
            );
        }
        assert!((ground.plane[1] - 0.02).abs() < 1e-3 && (ground.plane[2] + 0.01).abs() < 1e-3);
    }
}
