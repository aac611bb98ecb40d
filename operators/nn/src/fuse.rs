//! Fusion of BEV maps: other agents' maps, warped into the ego's, become one with it.

use crate::conv::{Pool, split};
use crate::layers::Fusion;
use crate::network::BevView;
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

    fn at(&self, column: usize, row: usize) -> [f64; 2] {
        let (column, row) = (column as f64, row as f64);
        self.0.map(|[a, b, c]| a * column + b * row + c)
    }
}

/// Another agent's map, and where the ego's cells lie in it.
#[derive(Clone, Copy, Debug)]
pub struct Placed<'a> {
    /// The map.
    pub map: BevView<'a>,
    /// From the ego's cells to the map's.
    pub warp: Warp,
}

/// How far outside the centres of a map's outermost cells a place still counts as on them, in cells: more than rounding
/// moves it.
const ON_THE_EDGE: f64 = 1e-6;

/// Fuses maps of one size; an agent takes no part in cells that its map does not cover.
pub(crate) fn fuse(fusion: Fusion, ego: BevView, others: &[Placed], pool: &mut Pool) -> Vec<f32> {
    let length = ego.columns * ego.channels;
    let mut fused = vec![0.0; ego.rows * length];
    let shares = split(&mut fused, length, ego.rows, pool.threads(), 1);
    pool.each(shares, |share| {
        let mut scratch = vec![0.0; others.len() * ego.channels];
        for (row, to) in share.range.zip(share.data.chunks_exact_mut(length)) {
            fuse_row(fusion, ego, others, row, &mut scratch, to);
        }
    });
    fused
}

dispatch! {
    fn fuse_row(fusion: Fusion, ego: BevView, others: &[Placed], row: usize, scratch: &mut [f32], to: &mut [f32]) {
        let channels = ego.channels;
        let own = ego.data[row * ego.columns * channels..].chunks_exact(channels);
        for (column, (own, to)) in own.zip(to.chunks_exact_mut(channels)).enumerate() {
            let mut covering = 0;
            for other in others {
                let cell = &mut scratch[covering * channels..(covering + 1) * channels];
                covering += usize::from(sample(other, column, row, cell));
            }
            let sampled = &scratch[..covering * channels];
            match fusion {
                Fusion::Max => greatest(own, sampled, to),
                Fusion::Attention { width } => attention(own, sampled, width, to),
            }
        }
    }
}

/// The features of another map at a cell of the ego's, if it covers it: bilinear between the four cells around.
#[inline(always)]
fn sample(Placed { map, warp }: &Placed, column: usize, row: usize, to: &mut [f32]) -> bool {
    let channels = to.len();
    let last = [map.columns - 1, map.rows - 1];
    let place = warp.at(column, row);
    let covers = |axis: usize| (-ON_THE_EDGE..=last[axis] as f64 + ON_THE_EDGE).contains(&place[axis]);
    if !(covers(0) && covers(1)) {
        return false;
    }
    let place = [0, 1].map(|axis| place[axis].clamp(0.0, last[axis] as f64));
    let first = place.map(|place| place as usize);
    let next = [0, 1].map(|axis| (first[axis] + 1).min(last[axis]));
    let part = [0, 1].map(|axis| (place[axis] - first[axis] as f64) as f32);
    let cell = |column: usize, row: usize| &map.data[(row * map.columns + column) * channels..][..channels];
    let corners = [
        (cell(first[0], first[1]), (1.0 - part[0]) * (1.0 - part[1])),
        (cell(next[0], first[1]), part[0] * (1.0 - part[1])),
        (cell(first[0], next[1]), (1.0 - part[0]) * part[1]),
        (cell(next[0], next[1]), part[0] * part[1]),
    ];
    let [(a, wa), (b, wb), (c, wc), (d, wd)] = corners;
    for ((((to, a), b), c), d) in to.iter_mut().zip(a).zip(b).zip(c).zip(d) {
        *to = a * wa + b * wb + c * wc + d * wd;
    }
    true
}

#[inline(always)]
fn greatest(own: &[f32], others: &[f32], to: &mut [f32]) {
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
    let (mut greatest, mut sum) = (own_score, 1.0);
    to.copy_from_slice(own);
    for other in others.chunks_exact(own.len()) {
        let score = product(own, other) * scale;
        let (before, now) = match score > greatest {
            true => (libm::expf(greatest - score), 1.0),
            false => (1.0, libm::expf(score - greatest)),
        };
        greatest = greatest.max(score);
        sum = sum * before + now;
        for (to, other) in to.iter_mut().zip(other) {
            *to = *to * before + other * now;
        }
    }
    let factor = 1.0 / sum;
    to.iter_mut().for_each(|to| *to *= factor);
}

/// Sums that run side by side, so that every width of a vector adds in the same order.
const LANES: usize = 16;

#[inline(always)]
fn product(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (a_lanes, a_rest) = a.as_chunks::<LANES>();
    let (b_lanes, b_rest) = b.as_chunks::<LANES>();
    for (a, b) in a_lanes.iter().zip(b_lanes) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            sums[lane] += sums[lane + half];
        }
        half /= 2;
    }
    a_rest.iter().zip(b_rest).fold(sums[0], |sum, (a, b)| sum + a * b)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::network::BevMap;
    use crate::testing::Numbers;

    fn map(seed: u64, [rows, columns, channels]: [usize; 3]) -> BevMap {
        BevMap {
            rows,
            columns,
            channels,
            data: Numbers::new(seed).list(rows * columns * channels),
        }
    }

    fn placed(map: &BevMap, warp: Warp) -> Placed<'_> {
        Placed { map: map.into(), warp }
    }

    fn fused(fusion: Fusion, ego: &BevMap, others: &[Placed], threads: usize) -> Vec<f32> {
        fuse(fusion, ego.into(), others, &mut Pool::new(threads))
    }

    const BOTH: [Fusion; 2] = [Fusion::Max, Fusion::Attention { width: 20 }];

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
        let found = fused(Fusion::Max, &ego, &[placed(&other, warp)], 1);
        let expected = plane([8, 12], |x, y| value([x, y]));
        let mut covered = 0;
        for (found, expected) in found.iter().zip(&expected.data).filter(|(found, _)| **found > 0.0) {
            assert!((found - expected).abs() < 1e-4, "{found} {expected}");
            covered += 1;
        }
        assert!((50..96).contains(&covered), "{covered} cells lie in both maps");
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
        let found = fused(Fusion::Max, &ego, &[placed(&other, edge)], 1);
        let changed = found.chunks(20).zip(ego.data.chunks(20)).enumerate();
        let changed: Vec<usize> = changed.filter(|(_, (a, b))| a != b).map(|(i, _)| i).collect();
        assert_eq!(changed, [0, 7, 14, 21, 28], "the first column lies on the other's last");
    }

    #[test]
    fn attention_alone_or_of_maps_that_are_the_same_is_the_map() {
        let ego = map(3, [4, 6, 37]);
        let attention = Fusion::Attention { width: 37 };
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
        assert_eq!(fused(Fusion::Attention { width: 3 }, &ego, &others, 1), same.data);
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
            let all: Vec<Placed> = others.iter().map(|map| placed(map, Warp::IDENTITY)).collect();
            for fusion in BOTH {
                let found = fused(fusion, &ego, &all, threads);
                prop_assert_eq!(&found, &fused(fusion, &ego, &all, 1));
                let mut portable = vec![0.0; found.len()];
                let (row, channels) = (size[1] * size[2], size[2]);
                for (index, to) in portable.chunks_exact_mut(row).enumerate() {
                    fuse_row::portable(fusion, (&ego).into(), &all, index, &mut vec![0.0; count * channels], to);
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

    fn naive(fusion: Fusion, agents: &[Vec<f32>], channel: usize) -> f64 {
        let value = |agent: &Vec<f32>| f64::from(agent[channel]);
        match fusion {
            Fusion::Max => agents.iter().map(value).fold(f64::NEG_INFINITY, f64::max),
            Fusion::Attention { width } => {
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
