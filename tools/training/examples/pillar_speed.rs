//! Times the pillar step and the pillar net on one core: `cargo run --release -p realo-training --example pillar_speed`.
//!
//! The cloud has the density of a spinning LiDAR: rings of points on flat ground and on walls, nearer ones denser.

#![allow(clippy::disallowed_methods)]

use std::path::Path;
use std::time::{Duration, Instant};

use realo_kernels::canvas::Canvas;
use realo_methods::Model;
use realo_methods::detect::pillar_net::PillarNet;
use realo_methods::detect::pillars::{Pillariser, Pillars, Points};
use realo_nn::anchors::Anchors;
use realo_nn::decode::candidates;
use realo_nn::model::Grid;
use realo_training::loss::{HeadMaps, LossWeights, loss};
use realo_training::targets::{Object, assign};

const GRID: Grid = Grid {
    x: [-102.4, 102.4],
    y: [-40.0, 40.0],
    z: [-3.0, 5.0],
    cell: 0.4,
};
const CHANNELS: usize = 32;
const RUNS: usize = 101;

fn main() -> Result<(), realo_nn::model::ModelError> {
    let [x, y, z] = cloud(100_000);
    let points = Points {
        x: &x,
        y: &y,
        z: &z,
        intensity: None,
    };
    let mut pillariser = Pillariser::new(&GRID, 32, 40_000);
    report("pillar step, 100,000 points", || {
        pillariser.run(&points);
    });
    let pillars = pillariser.run(&points);
    println!(
        "  {} pillars, {} points, {:?}",
        pillars.len(),
        pillars.points.len(),
        pillars.dropped
    );

    let linear: Vec<f32> = (0..CHANNELS * 10).map(|i| noise(9, i)).collect();
    let net = PillarNet::new(&GRID, &linear, &[[1.0, 0.1]; CHANNELS], None, false);
    let mut canvas = Canvas::new(GRID.rows(), GRID.columns(), CHANNELS);
    report("pillar net on these pillars", || net.run(pillars, &mut canvas));
    let even = even_pillars(10_000, 7);
    report("pillar net, 10,000 pillars of 7 points", || net.run(&even, &mut canvas));

    let model = Model::read(Path::new("models/lite.toml"))?;
    let anchors = Anchors::of(&model);
    let objects: Vec<Object> = (0..100).map(|i| object(&anchors, i)).collect();
    report("targets, 153,600 anchors, 100 objects", || {
        assign(&anchors, &objects);
    });
    let targets = assign(&anchors, &objects);
    let scores: Vec<f32> = (0..anchors.count() * 3).map(|i| 4.0 * noise(11, i) - 5.37).collect();
    let deltas: Vec<f32> = (0..anchors.count() * 7).map(|i| noise(12, i)).collect();
    let (mut by_scores, mut by_deltas) = (vec![0.0; scores.len()], vec![0.0; deltas.len()]);
    report("loss and gradient, 153,600 anchors", || {
        let maps = HeadMaps {
            scores: &scores[..],
            deltas: &deltas[..],
        };
        let mut gradient = HeadMaps {
            scores: &mut by_scores[..],
            deltas: &mut by_deltas[..],
        };
        loss(&maps, &targets, &LossWeights::default(), 1, &mut gradient);
    });
    report("candidates, 153,600 anchors", || {
        candidates(&anchors, &scores, &deltas, 0.2, 1000);
    });
    println!(
        "  {} candidates",
        candidates(&anchors, &scores, &deltas, 0.2, 1000).detections.len()
    );
    Ok(())
}

fn report(what: &str, mut step: impl FnMut()) {
    step();
    let mut times: Vec<Duration> = (0..RUNS)
        .map(|_| {
            let start = Instant::now();
            step();
            start.elapsed()
        })
        .collect();
    times.sort();
    let [min, median] = [times[0], times[RUNS / 2]].map(|time| time.as_secs_f64() * 1e3);
    println!("{what}: {min:.2} ms at least, {median:.2} ms median");
}

/// Numbers in [-1, 1) without a pattern.
fn noise(seed: u32, i: usize) -> f32 {
    let hash = (i as u32)
        .wrapping_mul(2_654_435_761)
        .wrapping_add(seed)
        .wrapping_mul(0x85eb_ca6b);
    ((hash ^ (hash >> 13)).wrapping_mul(0xc2b2_ae35) >> 8) as f32 / (1 << 23) as f32 - 1.0
}

/// Points of 50 beams in scan order: each azimuth has all beams, and a beam that misses a wall meets the ground.
fn cloud(points: usize) -> [Vec<f32>; 3] {
    const BEAMS: usize = 50;
    let mut columns = [(); 3].map(|()| Vec::with_capacity(points));
    for i in 0..points {
        let azimuth = (i / BEAMS) as f32 / (points / BEAMS) as f32 * std::f32::consts::TAU;
        let (sin, cos) = azimuth.sin_cos();
        let slope = 0.02 + 0.4 * ((i % BEAMS) as f32 / BEAMS as f32).powi(2);
        let wall = 18.0 + 12.0 * (5.0 * azimuth).sin().abs() + 60.0 * cos * cos;
        let range = (1.8 / slope).min(wall) * (1.0 + 0.005 * noise(3, i));
        let values = [range * cos, range * sin, 1.8 - range * slope];
        columns
            .iter_mut()
            .zip(values)
            .for_each(|(column, value)| column.push(value));
    }
    columns
}

/// Pillars at cells without a pattern.
fn even_pillars(count: usize, points: usize) -> Pillars {
    let mut pillars = Pillars::empty();
    for pillar in 0..count {
        let cell = pillar * 7919 % (GRID.rows() * GRID.columns());
        let (row, column) = (cell / GRID.columns(), cell % GRID.columns());
        pillars.cells.push(cell as u32);
        pillars.points.extend((0..points).map(|i| {
            let [a, b, c] = [1, 2, 3].map(|seed| 0.5 + 0.5 * noise(seed, pillar * points + i));
            [
                (column as f32 + a) * 0.4 - 102.4,
                (row as f32 + b) * 0.4 - 40.0,
                3.0 * c,
                0.0,
            ]
        }));
        pillars.starts.push(pillars.points.len() as u32);
    }
    pillars
}

fn object(anchors: &Anchors, i: usize) -> Object {
    let class = i % 3;
    let [.., height, width, length, _] = anchors.at(0, 0, class, 0);
    let [x, y, yaw] = [(1, 100.0), (2, 38.0), (3, 3.0)].map(|(seed, reach)| f64::from(reach * noise(seed, i)));
    Object {
        class,
        hwl: [x, y, -1.0, height, 1.1 * width, 0.9 * length, yaw],
    }
}
