//! Loops: keyframes where an earlier pass was, and how they see it.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix6};
use realo_pose_graph::Edge;
use realo_registration::{Alignment, Registrar, Search, SettingError};
use realo_schemas::from_seconds;

use crate::keyframe::Keyframe;
use crate::local_map::{map_of, registrar};

/// Passes of one piece are apart by this, s and m.
const APART_S: f64 = 10.0;
const APART_M: f64 = 40.0;
/// A submap reaches so far along the earlier pass, m.
const SUBMAP_M: f64 = 30.0;
/// Share of a sweep's points off the ground that must be near surfaces of the submap.
const MIN_SHARE: f64 = 0.35;
/// Registration to an earlier pass is not better than this, m.
const REGISTRATION_M: f64 = 0.02;
/// An error so many times as large as a loop edge says has a quarter of the weight.
const WIDTH: f64 = 3.0;
/// Fewer directions than these say nothing worth an edge.
const MIN_DIRECTIONS: usize = 4;

/// All keyframes, with their poses in `map` as they are known now.
pub(crate) struct Nodes<'a> {
    pub keyframes: Vec<&'a Keyframe>,
    /// Number of each one's piece.
    pub pieces: Vec<usize>,
    pub poses: Vec<Isometry3<f64>>,
}

/// How loops are looked for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LoopSearch {
    /// Poses of two passes are so near each other, m.
    pub radius_m: f64,
    /// From one candidate to the next along a drive, m.
    pub apart_m: f64,
    /// How far registration looks around.
    pub search: Search,
    /// Whether it begins at the earlier pass's height, and at the later one's own only if nothing fits there.
    pub is_level_tried: bool,
    pub voxel_m: f64,
}

/// What came of looking.
#[derive(Clone, Debug, Default)]
pub(crate) struct Found {
    /// Pairs that were near each other.
    pub candidates: usize,
    /// Those that were verified.
    pub edges: Vec<Edge>,
}

impl Nodes<'_> {
    /// Loop edges between keyframes that are near each other.
    ///
    /// # Errors
    /// A voxel's side that is none.
    pub fn loops(&self, how: &LoopSearch) -> Result<Found, SettingError> {
        let mut registrar = Registrar::new(registrar())?;
        let candidates = self.candidates(how);
        let mut found = Found {
            candidates: candidates.len(),
            edges: Vec::new(),
        };
        for (earlier, later) in candidates {
            found.edges.extend(self.verified(earlier, later, how, &mut registrar)?);
        }
        Ok(found)
    }

    /// Pairs of an earlier and a later keyframe: of each later one the nearest of every other pass.
    fn candidates(&self, how: &LoopSearch) -> Vec<(usize, usize)> {
        let cell = |at: usize| {
            let place = self.poses[at].translation.vector;
            [place.x, place.y].map(|part| (part / how.radius_m).floor().clamp(-1e9, 1e9) as i64)
        };
        let mut cells: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
        let mut pairs = Vec::new();
        let mut last: Option<(usize, f64)> = None;
        for later in 0..self.poses.len() {
            let here = (self.pieces[later], self.keyframes[later].travelled);
            let is_due = last.is_none_or(|last| last.0 != here.0 || here.1 - last.1 >= how.apart_m);
            let [x, y] = cell(later);
            if is_due {
                let around = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| [x, y]));
                let near = around.filter_map(|cell| cells.get(&cell)).flatten();
                let mut nearest: BTreeMap<usize, (f64, usize)> = BTreeMap::new();
                for earlier in near.filter(|earlier| self.is_other_pass(**earlier, later)) {
                    let way = self.poses[*earlier].translation.vector - self.poses[later].translation.vector;
                    let way = way.xy().norm();
                    let best = nearest
                        .entry(self.pieces[*earlier])
                        .or_insert((f64::INFINITY, *earlier));
                    if way <= how.radius_m && way < best.0 {
                        *best = (way, *earlier);
                    }
                }
                let within = nearest.into_values().filter(|(way, _)| way.is_finite());
                let before = pairs.len();
                pairs.extend(within.map(|(_, earlier)| (earlier, later)));
                last = if pairs.len() > before { Some(here) } else { last };
            }
            cells.entry([x, y]).or_default().push(later);
        }
        pairs
    }

    /// Whether two keyframes are of passes that are apart.
    fn is_other_pass(&self, a: usize, b: usize) -> bool {
        let (one, other) = (&self.keyframes[a], &self.keyframes[b]);
        self.pieces[a] != self.pieces[b]
            || ((one.stamp - other.stamp).saturating_abs() >= from_seconds(APART_S)
                && (one.travelled - other.travelled).abs() >= APART_M)
    }

    /// The edge of a candidate, if the later sweep fits the earlier pass.
    fn verified(
        &self,
        earlier: usize,
        later: usize,
        how: &LoopSearch,
        registrar: &mut Registrar,
    ) -> Result<Option<Edge>, SettingError> {
        let earlier_from_map = self.poses[earlier].inverse();
        let around = (0..self.keyframes.len()).filter(|at| {
            self.pieces[*at] == self.pieces[earlier]
                && (self.keyframes[*at].travelled - self.keyframes[earlier].travelled).abs() <= SUBMAP_M
                && (self.pieces[*at] != self.pieces[later] || self.is_other_pass(*at, later))
        });
        let posed = around.map(|at| (self.keyframes[at], earlier_from_map * self.poses[at]));
        let Some(submap) = map_of(posed, how.voxel_m)? else {
            return Ok(None);
        };
        let guess = earlier_from_map * self.poses[later];
        // Heights of odometry drift by metres in a lap, but a street has one height where two passes meet.
        let mut level = guess;
        level.translation.z = 0.0;
        let guesses = if how.is_level_tried {
            [Some(level), Some(guess)]
        } else {
            [Some(guess), None]
        };
        let aligned = guesses.into_iter().flatten().find_map(|guess| {
            let aligned = registrar.align(&submap, &self.keyframes[later].cloud, &guess, how.search);
            // A sweep of too few points closes no loop.
            aligned.ok().filter(fits)
        });
        Ok(aligned.map(|found| Edge {
            from: earlier,
            to: later,
            from_from_to: found.map_from_body,
            information: symmetric(&found.weighed(REGISTRATION_M)),
            kernel: Some(WIDTH),
        }))
    }
}

/// Whether a sweep was taken where it fits.
fn fits(found: &Alignment) -> bool {
    let told = found
        .directions
        .iter()
        .filter(|direction| !direction.is_degenerate)
        .count();
    found.is_settled() && found.structure_share >= MIN_SHARE && told >= MIN_DIRECTIONS
}

fn symmetric(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    0.5 * (matrix + matrix.transpose())
}
