use std::collections::BTreeMap;

use realo_schemas::geometry::Region;

/// Points lower than this above the ego's ground are drawn faintly, m.
const GROUND_M: f32 = 0.3;
/// Dots that all agents together may have: about 1 MB of SVG.
const MOST_DOTS: usize = 120_000;
/// Cells grow by this factor until that holds.
const GROWTH: f64 = 1.2;

/// Steps of a cell to which dots are rounded, so that they do not stand in rows.
pub const STEPS: i32 = 4;

/// The points of an agent, at most one in each cell of a grid, (row, column) in steps of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Dots {
    /// Of cells that hold points on the ground only.
    pub ground: Vec<[i32; 2]>,
    /// Of cells that hold a point above the ground: the first of those.
    pub raised: Vec<[i32; 2]>,
}

/// Thins each agent's points on a grid of cells with this side at least, m, over a part of the ground plane; gives the
/// side that was taken. Rows run along y, and both count from the region's smallest x and y; cells are in order.
pub fn thin(clouds: &[&[[f32; 3]]], region: &Region, min_cell_m: f64) -> (f64, Vec<Dots>) {
    let mut cell = min_cell_m;
    loop {
        let dots: Vec<Dots> = clouds.iter().map(|cloud| thin_one(cloud, region, cell)).collect();
        let total: usize = dots.iter().map(|dots| dots.ground.len() + dots.raised.len()).sum();
        if total <= MOST_DOTS {
            return (cell, dots);
        }
        cell *= GROWTH;
    }
}

fn thin_one(cloud: &[[f32; 3]], region: &Region, cell: f64) -> Dots {
    let mut cells: BTreeMap<[i32; 2], (bool, [i32; 2])> = BTreeMap::new();
    let step = |value: f64, from: f64| ((value - from) / cell * f64::from(STEPS)).floor() as i32;
    for [x, y, z] in cloud {
        let (x, y) = (f64::from(*x), f64::from(*y));
        if region.contains([x, y]) {
            let place = [step(y, region.y[0]), step(x, region.x[0])];
            let raised = *z >= GROUND_M;
            let held = cells.entry(place.map(|v| v / STEPS)).or_insert((raised, place));
            if raised && !held.0 {
                *held = (true, place);
            }
        }
    }
    let mut dots = Dots::default();
    for (raised, place) in cells.into_values() {
        match raised {
            true => dots.raised.push(place),
            false => dots.ground.push(place),
        }
    }
    dots
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGION: Region = Region {
        x: [-10.0, 10.0],
        y: [-10.0, 10.0],
    };

    #[test]
    fn a_cell_has_one_dot_that_is_raised_if_any_of_its_points_is() {
        let cloud = [[0.1, 0.1, 0.0], [0.2, 0.2, 1.0], [5.1, -3.0, 0.1], [99.0, 0.0, 0.0]];
        let (cell, dots) = thin(&[&cloud], &REGION, 0.5);
        assert_eq!(cell, 0.5);
        assert_eq!(dots[0].raised, [[81, 81]]);
        assert_eq!(dots[0].ground, [[56, 120]]);
    }

    #[test]
    fn cells_grow_until_there_are_few_dots() {
        let side = 600;
        let at = |i: usize| i as f32 * 20.0 / side as f32 - 10.0;
        let cloud: Vec<[f32; 3]> = (0..side * side).map(|i| [at(i % side), at(i / side), 0.0]).collect();
        let (cell, dots) = thin(&[&cloud], &REGION, 0.01);
        assert!(cell > 0.01);
        assert!(dots[0].ground.len() <= MOST_DOTS && dots[0].ground.len() > MOST_DOTS / 3);
    }
}
