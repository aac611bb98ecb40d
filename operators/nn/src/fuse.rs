//! Fusion of BEV maps: other agents' maps, warped into the ego's, become one with it.

use crate::conv::{Pool, split};
use crate::math::{exp, product};
use crate::network::{BevMap, BevView};
use crate::simd::dispatch;

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

/// An agent's part of a fusion.
#[derive(Clone, Copy, Debug)]
pub struct Agent<'a> {
    /// Its map.
    pub map: BevView<'a>,
    /// How sure it is of each cell, `[rows, columns]`: it takes no part where it is 0. `None`: all cells are there.
    pub confidence: Option<&'a [f32]>,
    /// From the ego's cells to the map's.
    pub warp: Warp,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// How old its map is beside the ego's, in frames of 0.1 s.
    pub delay: usize,
}

impl<'a> Agent<'a> {
    /// A vehicle whose map lies as the ego's does, of the same time.
    pub fn beside(map: impl Into<BevView<'a>>) -> Self {
        Agent {
            map: map.into(),
            confidence: None,
            warp: Warp::IDENTITY,
            roadside: false,
            delay: 0,
        }
    }

    /// The same agent with another map.
    pub(crate) fn with<'b>(&self, map: &'b BevMap) -> Agent<'b>
    where
        'a: 'b,
    {
        Agent {
            map: map.into(),
            ..*self
        }
    }

    /// Column and row of its map's cell that is nearest to a cell of the ego's: the one that says whether the map covers it.
    pub fn nearest(&self, column: usize, row: usize) -> Option<[usize; 2]> {
        nearest(self.warp.at(column, row), [self.map.columns, self.map.rows])
    }
}

/// An agent's map in the ego's cells, `[rows, columns]` of them, as every fusion takes it; and which of them it covers.
pub fn placed(agent: &Agent, size: [usize; 2]) -> (BevMap, Vec<bool>) {
    let mut placer = Placer::new(1);
    placer.place(agent, size);
    (placer.map, placer.covered)
}

/// One agent's map after the other in the ego's cells, in the same memory.
pub struct Placer {
    pool: Pool,
    map: BevMap,
    covered: Vec<bool>,
}

impl Placer {
    /// With so many threads, the caller's included.
    pub fn new(threads: usize) -> Self {
        Placer {
            pool: Pool::new(threads),
            map: BevMap {
                rows: 0,
                columns: 0,
                channels: 0,
                data: Vec::new(),
            },
            covered: Vec::new(),
        }
    }

    /// An agent's map in `[rows, columns]` cells of the ego, and which of them it covers.
    pub fn place(&mut self, agent: &Agent, size: [usize; 2]) -> (&BevMap, &[bool]) {
        let map = &mut self.map;
        ([map.rows, map.columns], map.channels) = (size, agent.map.channels);
        place(agent, size, None, &mut map.data, &mut self.covered, &mut self.pool);
        (&self.map, &self.covered)
    }
}

/// Takes an agent's map in `[rows, columns]` cells of the ego; `added` is added to each of the map's own cells.
pub(crate) fn place(
    agent: &Agent,
    [rows, columns]: [usize; 2],
    added: Option<&[f32]>,
    map: &mut Vec<f32>,
    covered: &mut Vec<bool>,
    pool: &mut Pool,
) {
    let length = columns * agent.map.channels;
    map.resize(rows * length, 0.0);
    covered.resize(rows * columns, false);
    let maps = split(map, length, rows, pool.threads(), 1);
    let covers = split(covered, columns, rows, pool.threads(), 1);
    pool.each(maps.into_iter().zip(covers).collect(), |(map, covers)| {
        let rows = map
            .data
            .chunks_exact_mut(length)
            .zip(covers.data.chunks_exact_mut(columns));
        for (row, (to, covered)) in map.range.zip(rows) {
            place_row(agent, row, added, to, covered);
        }
    });
}

dispatch! {
    fn place_row(agent: &Agent, row: usize, added: Option<&[f32]>, to: &mut [f32], covered: &mut [bool]) {
        let cells = to.chunks_exact_mut(agent.map.channels).zip(covered);
        for (column, (to, covered)) in cells.enumerate() {
            *covered = sample(agent, column, row, added, to);
        }
    }
}

/// Fuses maps of one size cell by cell, the ego's first; an agent takes no part in cells that its map does not cover.
pub(crate) fn fuse(fusion: CellFusion, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
    let ego = agents[0].map;
    let length = ego.columns * ego.channels;
    let mut fused = vec![0.0; ego.rows * length];
    let shares = split(&mut fused, length, ego.rows, pool.threads(), 1);
    pool.each(shares, |share| {
        let mut scratch = vec![0.0; agents.len() * ego.channels];
        for (row, to) in share.range.zip(share.data.chunks_exact_mut(length)) {
            fuse_row(fusion, agents, row, &mut scratch, to);
        }
    });
    fused
}

/// A fusion that looks at one cell at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum CellFusion {
    /// The largest of each feature.
    Max,
    /// Attention of the ego, with products scaled for so many channels.
    Attention {
        /// The channels.
        width: usize,
    },
}

dispatch! {
    fn fuse_row(fusion: CellFusion, agents: &[Agent], row: usize, scratch: &mut [f32], to: &mut [f32]) {
        let ego = agents[0].map;
        let channels = ego.channels;
        let own = ego.data[row * ego.columns * channels..].chunks_exact(channels);
        for (column, (own, to)) in own.zip(to.chunks_exact_mut(channels)).enumerate() {
            let mut covering = 0;
            for other in &agents[1..] {
                let cell = &mut scratch[covering * channels..(covering + 1) * channels];
                covering += usize::from(sample(other, column, row, None, cell));
            }
            let sampled = &scratch[..covering * channels];
            match fusion {
                CellFusion::Max => max(own, sampled, to),
                CellFusion::Attention { width } => attention(own, sampled, width, to),
            }
        }
    }
}

/// The features of an agent's map at a cell of the ego's, bilinear between the four cells around, zeros outside the map;
/// `added` is added to each of the map's cells. Whether the map covers the cell: the nearest of its own is one. Of a map that
/// has not all of its cells those that are there are weighed, and there are zeros where it does not cover.
#[inline(always)]
pub(crate) fn sample(agent: &Agent, column: usize, row: usize, added: Option<&[f32]>, to: &mut [f32]) -> bool {
    let (map, channels) = (agent.map, to.len());
    let place = agent.warp.at(column, row);
    let size = [map.columns, map.rows];
    let is_there = |column: usize, row: usize| {
        let confidence = agent.confidence;
        confidence.is_none_or(|confidence| confidence[row * map.columns + column] > 0.0)
    };
    let near = |axis: usize| (-1.0..size[axis] as f64).contains(&place[axis]);
    let covered = nearest(place, size).is_some_and(|[column, row]| is_there(column, row));
    if !(near(0) && near(1)) || (agent.confidence.is_some() && !covered) {
        to.fill(0.0);
        return false;
    }
    let first = place.map(f64::floor);
    let part = [0, 1].map(|axis| (place[axis] - first[axis]) as f32);
    let corners = CORNERS.map(|corner| {
        let weight = |axis: usize| {
            if corner[axis] == 1 {
                part[axis]
            } else {
                1.0 - part[axis]
            }
        };
        let cell = [0, 1].map(|axis| first[axis] as isize + corner[axis]);
        let inside = |axis: usize| usize::try_from(cell[axis]).ok().filter(|cell| *cell < size[axis]);
        let (column, row) = (inside(0)?, inside(1)?);
        let weight = weight(0) * weight(1);
        (weight != 0.0 && is_there(column, row))
            .then(|| (&map.data[(row * map.columns + column) * channels..][..channels], weight))
    });
    match (corners, added) {
        ([Some(a), Some(b), Some(c), Some(d)], None) => {
            let numbers = a.0.iter().zip(b.0).zip(c.0).zip(d.0);
            for ((((from_a, from_b), from_c), from_d), to) in numbers.zip(to) {
                *to = from_a * a.1 + from_b * b.1 + from_c * c.1 + from_d * d.1;
            }
        }
        ([Some(a), Some(b), Some(c), Some(d)], Some(added)) => {
            let numbers = a.0.iter().zip(b.0).zip(c.0).zip(d.0).zip(added);
            for (((((from_a, from_b), from_c), from_d), added), to) in numbers.zip(to) {
                let [from_a, from_b, from_c, from_d] = [from_a, from_b, from_c, from_d].map(|from| from + added);
                *to = from_a * a.1 + from_b * b.1 + from_c * c.1 + from_d * d.1;
            }
        }
        (corners, added) => {
            to.fill(0.0);
            for (from, weight) in corners.into_iter().flatten() {
                match added {
                    Some(added) => {
                        let numbers = to.iter_mut().zip(from).zip(added);
                        numbers.for_each(|((to, from), added)| *to += (from + added) * weight);
                    }
                    None => to.iter_mut().zip(from).for_each(|(to, from)| *to += from * weight),
                }
            }
            if agent.confidence.is_some() {
                let there: f32 = corners.iter().flatten().map(|(_, weight)| weight).sum();
                to.iter_mut().for_each(|to| *to *= 1.0 / there);
            }
        }
    }
    covered
}

/// The cells around a place, as columns and rows from the first.
const CORNERS: [[isize; 2]; 4] = [[0, 0], [1, 0], [0, 1], [1, 1]];

/// Column and row of the cell that is nearest to a place, if the map has it.
#[inline(always)]
fn nearest(place: [f64; 2], size: [usize; 2]) -> Option<[usize; 2]> {
    let cell = place.map(f64::round_ties_even);
    let inside = |axis: usize| cell[axis] >= 0.0 && cell[axis] < size[axis] as f64;
    (inside(0) && inside(1)).then(|| cell.map(|index| index as usize))
}

#[inline(always)]
fn max(own: &[f32], others: &[f32], to: &mut [f32]) {
    to.copy_from_slice(own);
    for other in others.chunks_exact(own.len()) {
        for (to, other) in to.iter_mut().zip(other) {
            *to = if *other > *to { *other } else { *to };
        }
    }
}

#[inline(always)]
fn attention(own: &[f32], others: &[f32], width: usize, to: &mut [f32]) {
    let scale = 1.0 / (width as f32).sqrt();
    let own_score = product(own, own) * scale;
    // With one pass over the agents: what was summed before a greater score came is made smaller.
    let (mut max, mut sum) = (own_score, 1.0);
    to.copy_from_slice(own);
    for other in others.chunks_exact(own.len()) {
        let score = product(own, other) * scale;
        let (before, now) = match score > max {
            true => (exp(max - score), 1.0),
            false => (1.0, exp(score - max)),
        };
        max = max.max(score);
        sum = sum * before + now;
        for (to, other) in to.iter_mut().zip(other) {
            *to = *to * before + other * now;
        }
    }
    let factor = 1.0 / sum;
    to.iter_mut().for_each(|to| *to *= factor);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::Numbers;

    fn map(seed: u64, [rows, columns, channels]: [usize; 3]) -> BevMap {
        BevMap {
            rows,
            columns,
            channels,
            data: Numbers::new(seed).list(rows * columns * channels),
        }
    }

    fn placed(map: &BevMap, warp: Warp) -> Agent<'_> {
        Agent {
            warp,
            ..Agent::beside(map)
        }
    }

    fn fused(fusion: CellFusion, ego: &BevMap, others: &[Agent], threads: usize) -> Vec<f32> {
        fuse(fusion, &with(ego, others), &mut Pool::new(threads))
    }

    fn with<'a>(ego: &'a BevMap, others: &[Agent<'a>]) -> Vec<Agent<'a>> {
        [&[Agent::beside(ego)], others].concat()
    }

    const BOTH: [CellFusion; 2] = [CellFusion::Max, CellFusion::Attention { width: 20 }];

    /// A map whose features are linear in the place of the cell, in metres.
    fn plane([rows, columns]: [usize; 2], of: impl Fn(f64, f64) -> f64) -> BevMap {
        let at = |index: usize, from: f64| from + (index as f64 + 0.5) * 0.5;
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        let data = cells.map(|(row, column)| of(at(column, -3.0), at(row, -2.0)) as f32);
        BevMap {
            rows,
            columns,
            channels: 1,
            data: data.collect(),
        }
    }

    #[test]
    fn a_warp_brings_what_lies_on_the_ground_to_its_place() {
        // The other agent stands at (0.7, -0.4) of the ego's frame, turned by 20 degrees.
        let (sin, cos) = 20f64.to_radians().sin_cos();
        let from_other = |x: f64, y: f64| [cos * x - sin * y + 0.7, sin * x + cos * y - 0.4];
        let value = |[x, y]: [f64; 2]| 100.0 + 3.0 * x - 2.0 * y;
        let other = plane([8, 12], |x, y| value(from_other(x, y)));
        let ego = plane([8, 12], |_, _| 0.0);
        let ground = [
            [cos, sin, -(cos * 0.7 + sin * -0.4)],
            [-sin, cos, -(-sin * 0.7 + cos * -0.4)],
        ];
        let warp = Warp::of_ground(ground, [-3.0, -2.0], 0.5);
        let found = fused(CellFusion::Max, &ego, &[placed(&other, warp)], 1);
        let expected = plane([8, 12], |x, y| value([x, y]));
        let mut covered = 0;
        for (index, (found, expected)) in found.iter().zip(&expected.data).enumerate() {
            let [column, row] = warp.at(index % 12, index / 12);
            if (0.0..=11.0).contains(&column) && (0.0..=7.0).contains(&row) {
                assert!((found - expected).abs() < 1e-4, "{found} {expected}");
                covered += 1;
            }
        }
        assert!((50..96).contains(&covered), "{covered} cells lie in both maps");
    }

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

    #[test]
    fn a_map_that_covers_nothing_changes_nothing_and_places_that_are_no_numbers_are_nowhere() {
        let size = [5, 7, 20];
        let (ego, other) = (map(1, size), map(2, size));
        let away = Warp([[1.0, 0.0, 7.0], [0.0, 1.0, 0.0]]);
        let nowhere = Warp([[f64::NAN; 3]; 2]);
        for fusion in BOTH {
            for warp in [away, nowhere] {
                assert_eq!(fused(fusion, &ego, &[placed(&other, warp)], 2), ego.data, "{fusion:?}");
            }
        }
        let edge = Warp([[1.0, 0.0, 6.0], [0.0, 1.0, 0.0]]);
        let found = fused(CellFusion::Max, &ego, &[placed(&other, edge)], 1);
        let changed = found.chunks(20).zip(ego.data.chunks(20)).enumerate();
        let changed: Vec<usize> = changed.filter(|(_, (a, b))| a != b).map(|(i, _)| i).collect();
        assert_eq!(changed, [0, 7, 14, 21, 28], "the first column lies on the other's last");
    }

    #[test]
    fn between_the_outermost_cells_and_nowhere_a_map_fades_and_half_a_cell_further_it_does_not_count() {
        let ones = BevMap {
            data: vec![1.0; 12],
            ..map(1, [3, 4, 1])
        };
        let at = |shift: f64| {
            let agent = placed(&ones, Warp([[1.0, 0.0, shift], [0.0, 1.0, 0.0]]));
            let mut to = [9.0];
            (sample(&agent, 0, 1, Some(&[1.0]), &mut to), to[0])
        };
        assert_eq!([at(0.0), at(3.0), at(1.5)], [(true, 2.0); 3]);
        assert_eq!([at(-0.25), at(3.25)], [(true, 1.5); 2]);
        assert_eq!([at(-0.75), at(3.75)], [(false, 0.5); 2]);
        assert_eq!([at(-1.5), at(4.0), at(f64::NAN)], [(false, 0.0); 3]);
    }

    #[test]
    fn cells_that_are_not_there_say_nothing_and_do_not_fade_those_beside_them() {
        let ego = map(1, [6, 9, 20]);
        let sevens = BevMap {
            data: vec![7.0; 6 * 9 * 20],
            ..map(2, [6, 9, 20])
        };
        let there = |row: usize, column: usize| (2..5).contains(&row) && (3..6).contains(&column);
        let confidence: Vec<f32> = (0..54)
            .map(|cell| if there(cell / 9, cell % 9) { 0.1 } else { 0.0 })
            .collect();
        for (x, y) in [(0.0, 0.0), (0.4, -0.3), (-1.25, 0.5)] {
            let agent = Agent {
                confidence: Some(&confidence),
                ..placed(&sevens, Warp([[1.0, 0.0, x], [0.0, 1.0, y]]))
            };
            let (mut covered, found) = (0, fused(CellFusion::Max, &ego, &[agent], 2));
            let cells = found.chunks(20).zip(ego.data.chunks(20));
            for (cell, (found, own)) in cells.enumerate() {
                let place = agent.warp.at(cell % 9, cell / 9);
                let said = nearest(place, [9, 6]).is_some_and(|[column, row]| there(row, column));
                covered += usize::from(said);
                let expected = |own: &f32| if said { 7.0 } else { *own };
                let near = found
                    .iter()
                    .zip(own)
                    .all(|(found, own)| (found - expected(own)).abs() < 1e-5);
                assert!(near, "{cell} {said}: {found:?} {own:?}");
            }
            assert!(covered >= 9, "{covered}");
        }
        let all = vec![f32::MIN_POSITIVE; 54];
        let other = map(3, [6, 9, 20]);
        let dense = placed(&other, Warp([[0.9, 0.1, 0.5], [-0.1, 0.9, 1.0]]));
        let sparse = Agent {
            confidence: Some(&all),
            ..dense
        };
        for (cell, (row, column)) in (0..54).map(|cell| (cell, (cell / 9, cell % 9))) {
            let [x, y] = dense.warp.at(column, row);
            let of = |agent: &Agent| {
                let mut to = [0.0; 20];
                (sample(agent, column, row, None, &mut to), to)
            };
            if (0.0..8.0).contains(&x) && (0.0..5.0).contains(&y) {
                assert_eq!(of(&dense), of(&sparse), "{cell}: between cells that are all there");
            }
        }
    }

    #[test]
    fn attention_alone_or_of_maps_that_are_the_same_is_the_map() {
        let ego = map(3, [4, 6, 37]);
        let attention = CellFusion::Attention { width: 37 };
        assert_eq!(fused(attention, &ego, &[], 1), ego.data);
        let twins = [placed(&ego, Warp::IDENTITY), placed(&ego, Warp::IDENTITY)];
        for (found, own) in fused(attention, &ego, &twins, 3).iter().zip(&ego.data) {
            assert!((found - own).abs() < 1e-6);
        }
    }

    #[test]
    fn great_scores_do_not_overflow() {
        let great = |sign: f32| BevMap {
            rows: 1,
            columns: 1,
            channels: 3,
            data: vec![sign * 1e15; 3],
        };
        let (ego, same, against) = (great(1.0), great(2.0), great(-1.0));
        let others = [placed(&same, Warp::IDENTITY), placed(&against, Warp::IDENTITY)];
        assert_eq!(fused(CellFusion::Attention { width: 3 }, &ego, &others, 1), same.data);
    }

    proptest! {
        #[test]
        fn is_what_its_formula_says_with_any_threads_and_instructions(
            seed in any::<u64>(),
            size in [1usize..6, 1usize..9, 1usize..40],
            count in 0usize..4,
            threads in 1usize..4,
        ) {
            let ego = map(seed, size);
            let others: Vec<BevMap> = (0..count as u64).map(|k| map(seed ^ (k + 1), size)).collect();
            let all: Vec<Agent> = others.iter().map(|map| placed(map, Warp::IDENTITY)).collect();
            for fusion in BOTH {
                let found = fused(fusion, &ego, &all, threads);
                prop_assert_eq!(&found, &fused(fusion, &ego, &all, 1));
                let mut portable = vec![0.0; found.len()];
                let (row, channels) = (size[1] * size[2], size[2]);
                for (index, to) in portable.chunks_exact_mut(row).enumerate() {
                    fuse_row::portable(fusion, &with(&ego, &all), index, &mut vec![0.0; (count + 1) * channels], to);
                }
                prop_assert_eq!(&found, &portable);
                for cell in 0..size[0] * size[1] {
                    let of = |map: &BevMap| map.data[cell * channels..][..channels].to_vec();
                    let agents: Vec<Vec<f32>> = std::iter::once(&ego).chain(&others).map(of).collect();
                    for (index, found) in found[cell * channels..][..channels].iter().enumerate() {
                        let expected = naive(fusion, &agents, index);
                        prop_assert!((f64::from(*found) - expected).abs() < 1e-5, "{} {}", found, expected);
                    }
                }
            }
        }
    }

    fn naive(fusion: CellFusion, agents: &[Vec<f32>], channel: usize) -> f64 {
        let value = |agent: &Vec<f32>| f64::from(agent[channel]);
        match fusion {
            CellFusion::Max => agents.iter().map(value).fold(f64::NEG_INFINITY, f64::max),
            CellFusion::Attention { width } => {
                let score = |agent: &Vec<f32>| -> f64 {
                    let products = agent.iter().zip(&agents[0]).map(|(a, b)| f64::from(*a) * f64::from(*b));
                    (products.sum::<f64>() / (width as f64).sqrt()).exp()
                };
                let sum: f64 = agents.iter().map(score).sum();
                agents.iter().map(|agent| score(agent) / sum * value(agent)).sum()
            }
        }
    }
}
