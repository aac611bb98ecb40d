//! Cells of the ground that are taken, compared where no boxes are: points, and features of BEV maps.

use nalgebra::{Isometry3, Point3, Vector2};
use realo_schemas::{FeatureMap, PointCloud};

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
/// Share of a map's cells that count as taken: those with the largest features.
const TAKEN: f64 = 0.03;

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

    /// What a map's features show: the cells with the largest ones are taken.
    ///
    /// `None` for a map whose numbers cannot be read.
    pub fn of_map(map: &FeatureMap) -> Option<Self> {
        let (energy, limit) = energy(map)?;
        let [rows, columns, _] = map.size();
        Some(Ground::of(|place| {
            let [x, y] = [place.x - map.origin[0], place.y - map.origin[1]].map(|along| (along / map.cell).floor());
            let is_inside = x >= 0.0 && y >= 0.0 && x < columns as f64 && y < rows as f64;
            match is_inside.then(|| energy[y as usize * columns + x as usize]) {
                None => 0.0,
                Some(value) if value >= limit => 1.0,
                Some(_) => FREE,
            }
        }))
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
        for half in 1..=4 {
            let size = 0.5f64.powi(half);
            for _ in 0..2 {
                let center = best.1;
                for (x, y, turn) in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)] {
                    let by = center.by + Vector2::new(f64::from(x), f64::from(y)) * (STEP_M * size);
                    let turn = center.turn + f64::from(turn) * STEP_RAD * size;
                    let shift = Shift { by, turn, ..center };
                    let found = value(&shift);
                    if found > best.0 {
                        best = (found, shift);
                    }
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

/// Places in the ego's frame of the taken cells of a collaborator's map.
///
/// `None` for a map whose numbers cannot be read.
pub fn taken(map: &FeatureMap, ego_from_sender: &Isometry3<f64>) -> Option<Vec<Vector2<f64>>> {
    let (energy, limit) = energy(map)?;
    let columns = map.size()[1];
    let place = |cell: usize| {
        let [x, y] = [(cell % columns, 0), (cell / columns, 1)]
            .map(|(cell, axis)| (cell as f64 + 0.5) * map.cell + map.origin[axis]);
        let at = ego_from_sender * Point3::new(x, y, 0.0);
        Vector2::new(at.x, at.y)
    };
    Some(
        (0..energy.len())
            .filter(|cell| energy[*cell] >= limit)
            .map(place)
            .collect(),
    )
}

/// How large the features of each cell are, and from which size on a cell is taken.
fn energy(map: &FeatureMap) -> Option<(Vec<f32>, f32)> {
    let numbers = map.numbers().ok()?;
    let channels = map.channels.max(1) as usize;
    let energy: Vec<f32> = numbers
        .chunks_exact(channels)
        .map(|cell| cell.iter().map(|value| value * value).sum())
        .collect();
    if energy.iter().any(|value| !value.is_finite()) {
        return None;
    }
    let mut sorted = energy.clone();
    sorted.sort_by(|a, b| b.total_cmp(a));
    let limit = *sorted.get((TAKEN * sorted.len() as f64) as usize)?;
    Some((energy, limit.max(f32::MIN_POSITIVE)))
}
