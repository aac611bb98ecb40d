//! The line under points that shows how fast a clock drifts.

/// The edge of the lower convex hull that spans the points' mean `x`: of all lines that have no point below them, the one that is
/// nearest to all points together (Moon, Skelly and Towsley 1999). Gives its slope, and its height at the mean.
///
/// `points`: (x, y) with x not falling. `None` for points at one x.
pub(crate) fn lower_edge(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let mean = points.iter().map(|(x, _)| x).sum::<f64>() / points.len() as f64;
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for &point in points {
        // Of points at one x the lowest counts.
        if let Some(last) = hull.last()
            && last.0 == point.0
        {
            if last.1 <= point.1 {
                continue;
            }
            hull.pop();
        }
        while let [.., a, b] = hull[..] {
            let turn = (b.0 - a.0) * (point.1 - a.1) - (b.1 - a.1) * (point.0 - a.0);
            if turn > 0.0 {
                break;
            }
            hull.pop();
        }
        hull.push(point);
    }
    let edge = hull.windows(2).find(|edge| edge[0].0 <= mean && mean <= edge[1].0)?;
    let slope = (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0);
    Some((slope, edge[0].1 + slope * (mean - edge[0].0)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_edge_lies_under_the_middle() {
        let points = [
            (0.0, 1.0),
            (1.0, 5.0),
            (2.0, 0.0),
            (3.0, 4.0),
            (4.0, 2.0),
            (4.0, 1.0),
            (5.0, 9.0),
        ];
        // The mean of x is 19/7, between (2, 0) and (4, 1).
        let (slope, height) = lower_edge(&points).unwrap();
        assert!((slope - 0.5).abs() < 1e-12 && (height - 0.5 * (19.0 / 7.0 - 2.0)).abs() < 1e-12);
        assert_eq!(lower_edge(&[(1.0, 2.0), (1.0, 3.0)]), None);
        assert_eq!(lower_edge(&[]), None);
    }

    proptest! {
        #[test]
        fn no_point_is_below(heights in prop::collection::vec(-5.0..5.0f64, 2..60)) {
            let points: Vec<(f64, f64)> = heights.iter().enumerate().map(|(x, y)| (x as f64, *y)).collect();
            let mean = (points.len() - 1) as f64 / 2.0;
            let (slope, height) = lower_edge(&points).unwrap();
            for (x, y) in points {
                prop_assert!(y >= height + slope * (x - mean) - 1e-9);
            }
        }
    }
}
