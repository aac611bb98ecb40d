//! What stands about, as a detector's grid would find it: connected cells of points.

/// Side of a cell, m, and the region in the body frame.
const CELL: f64 = 0.4;
const REGION: [f64; 2] = [100.0, 40.0];
const COLUMNS: usize = (2.0 * REGION[0] / CELL) as usize;
const ROWS: usize = (2.0 * REGION[1] / CELL) as usize;
/// Points that make a cluster.
const LEAST: usize = 4;

/// A cluster's middle in the plane, and its size: length and width along its own axes, top above ground, m.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cluster {
    pub middle: [f64; 2],
    pub length: f64,
    pub width: f64,
    pub top: f64,
}

/// The clusters of points (x, y, height above ground); cells touch by a side or a corner.
pub(super) fn clusters(points: &[[f64; 3]]) -> Vec<Cluster> {
    let mut cells: Vec<Vec<u32>> = vec![Vec::new(); COLUMNS * ROWS];
    for (index, point) in points.iter().enumerate() {
        let (u, v) = ((point[0] + REGION[0]) / CELL, (point[1] + REGION[1]) / CELL);
        if (0.0..COLUMNS as f64).contains(&u) && (0.0..ROWS as f64).contains(&v) {
            cells[v as usize * COLUMNS + u as usize].push(index as u32);
        }
    }
    let mut found = Vec::new();
    let mut open = Vec::new();
    for first in 0..cells.len() {
        if cells[first].is_empty() {
            continue;
        }
        let mut members = std::mem::take(&mut cells[first]);
        open.push(first);
        while let Some(cell) = open.pop() {
            let (column, row) = (cell % COLUMNS, cell / COLUMNS);
            for r in row.saturating_sub(1)..(row + 2).min(ROWS) {
                for c in column.saturating_sub(1)..(column + 2).min(COLUMNS) {
                    let next = r * COLUMNS + c;
                    if !cells[next].is_empty() {
                        members.append(&mut cells[next]);
                        open.push(next);
                    }
                }
            }
        }
        if members.len() >= LEAST {
            let members: Vec<[f64; 3]> = members.iter().map(|i| points[*i as usize]).collect();
            found.push(measure(&members));
        }
    }
    found
}

/// Along the principal axis of the points and across it.
fn measure(points: &[[f64; 3]]) -> Cluster {
    let n = points.len() as f64;
    let mean = [0, 1].map(|k| points.iter().map(|p| p[k]).sum::<f64>() / n);
    let moment = |i: usize, j: usize| points.iter().map(|p| (p[i] - mean[i]) * (p[j] - mean[j])).sum::<f64>();
    let angle = 0.5 * libm::atan2(2.0 * moment(0, 1), moment(0, 0) - moment(1, 1));
    let (sin, cos) = libm::sincos(angle);
    let span = |axis: [f64; 2]| {
        let along = points.iter().map(|p| p[0] * axis[0] + p[1] * axis[1]);
        let (low, high) = along.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        high - low
    };
    let (a, b) = (span([cos, sin]), span([-sin, cos]));
    Cluster {
        middle: mean,
        length: a.max(b),
        width: a.min(b),
        top: points.iter().map(|p| p[2]).fold(f64::MIN, f64::max),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn separates_what_lies_apart_and_measures_it() {
        let mut points: Vec<[f64; 3]> = (0..40)
            .map(|i| f64::from(i) * 0.1)
            .map(|s| [10.0 + s, 5.0 + s, 0.5])
            .collect();
        points.extend([[20.0, -5.0, 1.2], [20.1, -5.0, 1.0], [20.0, -5.2, 2.0]]);
        assert_eq!(clusters(&points).len(), 1, "three points make no cluster");
        points.push([20.2, -5.1, 1.5]);
        let found = clusters(&points);
        assert_eq!(found.len(), 2);
        let (post, line) = (found[0], found[1]);
        assert!((line.length - 3.9 * 2f64.sqrt()).abs() < 1e-6 && line.width < 1e-6 && line.top == 0.5);
        assert!(post.length < 0.3 && post.top == 2.0);
        assert!((line.middle[0] - 11.95).abs() < 1e-9 && (post.middle[1] + 5.075).abs() < 1e-9);
    }
}
