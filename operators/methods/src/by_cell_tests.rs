//! The fusions that look at one cell at a time.

use proptest::prelude::*;

use realo_kernels::agents::{Agent, sample};
use realo_kernels::bev::BevMap;
use realo_kernels::by_cell::{self, fuse, fuse_portably};
use realo_kernels::conv::Pool;
use realo_kernels::warp::{Warp, nearest};

use crate::attfuse::Attention;
use crate::fcooper::Max;
use crate::testing::Numbers;

#[derive(Clone, Copy, Debug)]
enum CellFusion {
    Max,
    Attention { width: usize },
}

impl by_cell::CellFusion for CellFusion {
    #[inline(always)]
    fn cell(&self, own: &[f32], others: &[f32], to: &mut [f32]) {
        match *self {
            CellFusion::Max => Max.cell(own, others, to),
            CellFusion::Attention { width } => Attention { width }.cell(own, others, to),
        }
    }
}

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
    fuse(&fusion, &with(ego, others), &mut Pool::new(threads))
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
            let portable = fuse_portably(&fusion, &with(&ego, &all));
            let channels = size[2];
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
