//! Where a collaborator may be: votes of pairs of objects for motions.

use nalgebra::Vector2;
use realo_assignment::AssignmentError;

use crate::fit::{Fit, Noise, Scene, Stated, fit};
use crate::shift::{Shift, turned};

/// How far a search reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Largest shift along an axis, m.
    pub metres: f64,
    /// Largest turn to either side, rad.
    pub turn: f64,
}

/// Side of a cell in which votes for shifts meet, m.
const CELL_M: f64 = 1.0;
/// Step of the turns that are tried, rad.
const TURN_STEP: f64 = 0.026;
/// Motions that are refined.
const CANDIDATES: usize = 32;
/// A motion that is less than this away from another is the same, m at the mean object.
const SAME_M: f64 = 1.0;

/// The best motion of a search, and how good the best other one is.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// The best.
    pub fit: Fit,
    /// Support of the best motion that moves objects elsewhere.
    pub runner_up: f64,
}

/// The motion that explains both sides best, of all that a search reaches; `penalty` is what speaks against one, in units of
/// [`Scene::support`].
///
/// Each pair of alike objects votes, at each turn, for the shift that brings one to the other (Hough). What has most votes is refined by
/// least squares, and compared once more.
///
/// # Errors
/// [`AssignmentError`] for more objects than an assignment takes.
pub fn search(
    scene: &Scene,
    pivot: Vector2<f64>,
    reach: &Reach,
    noise: &Noise,
    stated: Option<&Stated>,
    penalty: impl Fn(&Shift) -> f64,
) -> Result<Found, AssignmentError> {
    let starts = std::iter::once(Shift::none(pivot)).chain(candidates(scene, pivot, reach));
    let refined = starts.map(|start| {
        let (shift, pairs) = scene.refine(start, noise);
        (scene.support(&shift, &pairs) - penalty(&shift), shift)
    });
    let is_in_reach = |shift: &Shift| shift.metres() <= 1.5 * reach.metres && shift.turn.abs() <= 1.5 * reach.turn;
    let mut refined: Vec<(f64, Shift)> = refined.filter(|(_, shift)| is_in_reach(shift)).collect();
    refined.sort_by(|a, b| b.0.total_cmp(&a.0));
    let best = refined.first().map_or(Shift::none(pivot), |(_, shift)| *shift);
    let middle = scene.middle().unwrap_or(pivot);
    let elsewhere = |shift: &Shift| (shift.place(&middle) - best.place(&middle)).norm() > SAME_M;
    let runner_up = refined
        .iter()
        .find(|(_, shift)| elsewhere(shift))
        .map_or(0.0, |(support, _)| *support);
    Ok(Found {
        fit: fit(scene, &best, noise, stated)?,
        runner_up: runner_up.max(0.0),
    })
}

/// The motions with most votes, best first.
fn candidates(scene: &Scene, pivot: Vector2<f64>, reach: &Reach) -> Vec<Shift> {
    let side = 2 * libm::ceil(reach.metres / CELL_M) as usize + 1;
    let steps = libm::floor(reach.turn / TURN_STEP) as i32;
    let mut found: Vec<(f64, i32, usize)> = Vec::new();
    let mut votes = vec![0.0; side * side];
    for step in -steps..=steps {
        votes.fill(0.0);
        vote(scene, pivot, f64::from(step) * TURN_STEP, side, &mut votes);
        peaks(&votes, side, |votes, cell| found.push((votes, step, cell)));
    }
    // More votes first; at equal ones the smaller turn.
    found.sort_by(|a, b| {
        b.0.total_cmp(&a.0)
            .then(a.1.abs().cmp(&b.1.abs()))
            .then((a.1, a.2).cmp(&(b.1, b.2)))
    });
    let middle = (side / 2) as f64;
    let shift = |(_, step, cell): (f64, i32, usize)| Shift {
        pivot,
        by: Vector2::new((cell % side) as f64 - middle, (cell / side) as f64 - middle) * CELL_M,
        turn: f64::from(step) * TURN_STEP,
    };
    found.into_iter().take(CANDIDATES).map(shift).collect()
}

/// Adds the votes of all pairs at one turn, `[side, side]` by y and x of the shift.
fn vote(scene: &Scene, pivot: Vector2<f64>, turn: f64, side: usize, votes: &mut [f64]) {
    let middle = (side / 2) as f64;
    for (other, object) in scene.theirs.iter().enumerate() {
        let at = pivot + turned(&(object.center - pivot), turn);
        for (own, ego) in scene.ego.iter().enumerate() {
            let [x, y] = [ego.center.x - at.x, ego.center.y - at.y].map(|by| (by / CELL_M + middle).round());
            let is_inside = |cell: f64| cell >= 0.0 && cell < side as f64;
            if is_inside(x) && is_inside(y) && scene.is_alike(own, other) {
                votes[y as usize * side + x as usize] += scene.weight(own, other);
            }
        }
    }
}

/// Cells whose votes, with those of the eight around them, are no fewer than of any of these cells, and the votes.
fn peaks(votes: &[f64], side: usize, mut found: impl FnMut(f64, usize)) {
    let near = |at: usize| at.saturating_sub(1)..(at + 2).min(side);
    let sums: Vec<f64> = (0..side * side)
        .map(|cell| {
            let rows = near(cell / side);
            rows.map(|row| near(cell % side).map(|column| votes[row * side + column]).sum::<f64>())
                .sum()
        })
        .collect();
    for (cell, sum) in sums.iter().enumerate() {
        // A cell without a vote of its own is near one that has some.
        let is_peak = || near(cell / side).all(|row| near(cell % side).all(|column| sums[row * side + column] <= *sum));
        if votes[cell] > 0.0 && is_peak() {
            found(*sum, cell);
        }
    }
}
