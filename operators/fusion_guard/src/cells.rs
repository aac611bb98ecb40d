//! Cells of the ground in which something stands, compared where no boxes are.

use nalgebra::{Isometry3, Point3, Vector2};
use realo_schemas::PointCloud;

use crate::search::Reach;
use crate::shift::Shift;
use crate::view::{Seen, View};

/// Side of a cell, m, and cells along a side of the ground around the ego.
const CELL_M: f64 = 0.5;
const SIDE: usize = 240;
/// What a cell where nothing stands says against who says that something does.
const FREE: f32 = -0.5;
/// Places of a collaborator that are compared: in the first search and later.
const FIRST: usize = 300;
const LATER: usize = 1500;
/// Steps of the first search, m and rad.
const STEP_M: f64 = 1.5;
const STEP_RAD: f64 = 0.035;
/// Motions that are improved.
const CANDIDATES: usize = 12;
/// Heights over the ground between which points stand on it, m.
const STANDS_M: [f64; 2] = [0.4, 2.5];

/// The ground around the ego by what it knows of it, `[SIDE, SIDE]`: 1 where something stands, below 0 where nothing does, 0 unknown.
pub struct Ground {
    values: Vec<f32>,
}

/// A motion that lays their places over the ego's, and how well.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Overlay {
    /// The motion.
    pub shift: Shift,
    /// Mean value of their places after it, up to 1.
    pub score: f64,
    /// The same without it.
    pub stated: f64,
    /// The best of a motion that moves them elsewhere.
    pub runner_up: f64,
}

impl Ground {
    /// What a sweep shows.
    pub fn of_view(view: &View) -> Self {
        Ground::of(|place| match view.at(place) {
            Seen::Something => 1.0,
            Seen::Free => FREE,
            Seen::Nothing => 0.0,
        })
    }

    /// Values of places, smoothed over neighbours so that a search feels its way.
    fn of(value: impl Fn(&Vector2<f64>) -> f32) -> Self {
        let center = |cell: usize| (cell as f64 + 0.5 - SIDE as f64 / 2.0) * CELL_M;
        let raw: Vec<f32> = (0..SIDE * SIDE)
            .map(|cell| value(&Vector2::new(center(cell % SIDE), center(cell / SIDE))))
            .collect();
        let near = |at: usize| at.saturating_sub(1)..(at + 2).min(SIDE);
        let smooth = |cell: usize| {
            let rows =
                near(cell / SIDE).map(|row| near(cell % SIDE).map(|column| raw[row * SIDE + column]).sum::<f32>());
            0.5 * raw[cell] + 0.5 * rows.sum::<f32>() / 9.0
        };
        Ground {
            values: (0..SIDE * SIDE).map(smooth).collect(),
        }
    }

    /// The value of a place; 0 outside.
    fn at(&self, place: &Vector2<f64>) -> f64 {
        let [x, y] = [place.x, place.y].map(|along| (along / CELL_M + SIDE as f64 / 2.0).floor());
        let is_inside = x >= 0.0 && y >= 0.0 && x < SIDE as f64 && y < SIDE as f64;
        if is_inside {
            f64::from(self.values[y as usize * SIDE + x as usize])
        } else {
            0.0
        }
    }

    fn score(&self, places: &[Vector2<f64>], shift: &Shift) -> f64 {
        let moved = shift.mover();
        let sum: f64 = places.iter().map(|place| self.at(&moved(place))).sum();
        sum / places.len().max(1) as f64
    }

    /// The motion that lays their places over what the ego knows best; `None` without places.
    pub fn lay(&self, places: &[Vector2<f64>], pivot: Vector2<f64>, reach: &Reach) -> Option<Overlay> {
        if places.is_empty() {
            return None;
        }
        let [few, many] = [FIRST, LATER].map(|most| thinned(places, most));
        let (steps, turns) = ((reach.metres / STEP_M) as i32, (reach.turn / STEP_RAD) as i32);
        let mut first: Vec<(f64, Shift)> = Vec::new();
        for turn in -turns..=turns {
            for x in -steps..=steps {
                for y in -steps..=steps {
                    let by = Vector2::new(f64::from(x), f64::from(y)) * STEP_M;
                    let shift = Shift {
                        pivot,
                        by,
                        turn: f64::from(turn) * STEP_RAD,
                    };
                    first.push((self.score(&few, &shift) - against(&shift), shift));
                }
            }
        }
        first.push((self.score(&few, &Shift::none(pivot)), Shift::none(pivot)));
        // The stated place is improved, too, however bad it looks.
        let stated = first.len() - 1;
        first.swap(0, stated);
        first[1..].sort_by(|a, b| b.0.total_cmp(&a.0));
        first.truncate(CANDIDATES);
        let mut improved: Vec<(f64, Shift)> = first.into_iter().map(|(_, shift)| self.improve(&many, shift)).collect();
        improved.sort_by(|a, b| b.0.total_cmp(&a.0));
        let best = improved[0].1;
        let elsewhere = |shift: &Shift| (shift.by - best.by).norm() > 2.0 || (shift.turn - best.turn).abs() > 0.07;
        let runner_up = improved
            .iter()
            .find(|(_, shift)| elsewhere(shift))
            .map_or(FREE.into(), |(score, _)| *score);
        let stated = self.score(&many, &Shift::none(pivot));
        Some(Overlay {
            shift: best,
            score: self.score(&many, &best),
            stated,
            runner_up,
        })
    }

    /// The best of smaller and smaller steps.
    fn improve(&self, places: &[Vector2<f64>], start: Shift) -> (f64, Shift) {
        let value = |shift: &Shift| self.score(places, shift) - against(shift);
        let mut best = (value(&start), start);
        for half in 0..=4 {
            let size = 0.5f64.powi(half);
            for _ in 0..6 {
                let (before, center) = best;
                for (x, y, turn) in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)] {
                    let by = center.by + Vector2::new(f64::from(x), f64::from(y)) * (STEP_M * size);
                    let turn = center.turn + f64::from(turn) * STEP_RAD * size;
                    let shift = Shift { by, turn, ..center };
                    let found = value(&shift);
                    if found > best.0 {
                        best = (found, shift);
                    }
                }
                if best.0 == before {
                    break;
                }
            }
        }
        best
    }
}

/// What speaks against a motion, so that of alike ones the smaller is taken.
fn against(shift: &Shift) -> f64 {
    0.004 * shift.metres() + 0.1 * shift.turn.abs()
}

/// Every n-th of places, at most so many.
fn thinned(places: &[Vector2<f64>], most: usize) -> Vec<Vector2<f64>> {
    places
        .iter()
        .step_by(places.len().div_ceil(most).max(1))
        .copied()
        .collect()
}

/// Places in the ego's frame where points of a collaborator stand on the ground, one for each cell, in the order of cells.
pub fn standing(cloud: &PointCloud, ego_from_sender: &Isometry3<f64>) -> Vec<Vector2<f64>> {
    let mut is_taken = vec![false; SIDE * SIDE];
    for index in 0..cloud.len() {
        let point = Point3::new(cloud.x[index], cloud.y[index], cloud.z[index]).cast::<f64>();
        // Heights count over the ground of whoever measured: its body frame has it at 0.
        if !(STANDS_M[0]..=STANDS_M[1]).contains(&point.z) {
            continue;
        }
        let at = ego_from_sender * point;
        let [x, y] = [at.x, at.y].map(|along| (along / CELL_M + SIDE as f64 / 2.0).floor());
        if x >= 0.0 && y >= 0.0 && x < SIDE as f64 && y < SIDE as f64 {
            is_taken[y as usize * SIDE + x as usize] = true;
        }
    }
    let center = |cell: usize| (cell as f64 + 0.5 - SIDE as f64 / 2.0) * CELL_M;
    let taken = is_taken.iter().enumerate().filter(|(_, taken)| **taken);
    taken
        .map(|(cell, _)| Vector2::new(center(cell % SIDE), center(cell / SIDE)))
        .collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;
    use crate::view::tests::sweep;

    pub(crate) const BLOCKS: [([f64; 2], [f64; 2], f64); 5] = [
        ([15.0, 3.0], [2.25, 0.95], 1.5),
        ([8.0, -9.0], [0.95, 2.25], 1.5),
        ([-12.0, 6.0], [2.25, 0.95], 1.6),
        ([0.0, -25.0], [14.0, 0.5], 4.0),
        ([-20.0, -10.0], [0.5, 6.0], 3.0),
    ];
    const REACH: Reach = Reach {
        metres: 12.0,
        turn: 0.21,
    };

    #[test]
    fn cells_are_laid_over_what_the_ego_sees() {
        let cloud = sweep(1.9, &BLOCKS, true);
        let ground = Ground::of_view(&View::of(&cloud));
        for (x, y, yaw) in [(3.0, -2.0, 0.0), (-5.0, 4.0, 0.05), (1.0, 0.0, -0.08)] {
            let wrong = Isometry3::from_parts(
                Translation3::new(x, y, 0.0),
                UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
            );
            let places = standing(&cloud, &wrong);
            let found = ground
                .lay(&places, Vector2::new(x, y), &REACH)
                .expect("there are places");
            let back = found.shift.isometry() * wrong;
            let off = (back * Point3::new(10.0, 5.0, 0.0) - Point3::new(10.0, 5.0, 0.0)).norm();
            assert!(off < 0.6, "{off} m for {x} {y} {yaw}: {found:?}");
            assert!(found.score > found.stated && found.score > found.runner_up, "{found:?}");
        }
        assert_eq!(ground.lay(&[], Vector2::zeros(), &REACH), None);
    }

    #[test]
    fn cells_stand_between_knee_and_roof() {
        let cloud = PointCloud::new(
            vec![5.0, 5.1, 9.0, 9.0, f32::NAN, 1e9],
            vec![1.0, 1.1, 1.0, 1.0, 0.0, 0.0],
            vec![1.0, 1.2, 0.0, 5.0, 1.0, 1.0],
            vec![0u8; 6],
            vec![0; 6],
            vec![0u16; 6],
        );
        let places = standing(&cloud.expect("columns of one length"), &Isometry3::identity());
        assert_eq!(places, [Vector2::new(5.25, 1.25)]);
    }
}
