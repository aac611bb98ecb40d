//! What lies between encoders and heads, by itself: compressor, warp, fusion.

use eyre::{OptionExt, Result, ensure};
use realo_kernels::agents::{Agent, Placer};
use realo_kernels::bev::BevMap;
use realo_kernels::warp::Warp;
use realo_methods::Model;
use realo_methods::detect::pillars::Points;
use realo_methods::network::{Network, NetworkOptions, Section};
use realo_nn::filler::{self, Numbers};
use realo_nn::layers::Layers;

use super::{ROUNDS, ROUNDS_OF_FULL, Row, calibrated, operations, precisions, row, timed};

/// Channels cross at a 32nd, as in the paper.
const COMPRESSION: usize = 32;
/// How a map lies that is turned and moved.
const TURNED: Warp = Warp([[0.995, -0.0998, 12.3], [0.0998, 0.995, -7.7]]);

/// The learned compressor of a model, on either side of the link: from f32 to f32.
pub fn compressor(model: &Model, points: &Points, threads: usize, rows: &mut Vec<Row>) -> Result<()> {
    let mut model = model.clone();
    ensure!(model.arch.fuses(), "a model that shares no maps has no compressor");
    model.arch.set_compression(COMPRESSION);
    model.activations.clear();
    let weights = filler::weights(&model, 1);
    let model = calibrated(model, &weights, points)?;
    let layers = Layers::of(&model);
    let last = layers.steps().iter().find(|step| step.to == layers.features);
    let whole = last.ok_or_eyre("no layer makes the shared map")?.from[0];
    for precision in precisions(realo_kernels::conv::Isa::detect()) {
        let options = NetworkOptions {
            precision: Some(precision),
            threads,
            ..NetworkOptions::default()
        };
        for (what, ends) in [
            ("compressed", [whole, layers.features]),
            ("restored", [layers.features, layers.restored]),
        ] {
            let map = map(layers.size(ends[0]), &mut Numbers::new(7));
            let mut section = Section::new(&model, &weights, options, ends)?;
            let times = timed(ROUNDS, || {
                section.run(&map)?;
                Ok(())
            })?;
            let what = format!("map of {} {what} 1:{COMPRESSION}, {precision}", model.name);
            rows.push(row(what, &times, Some(operations(&layers, ends))));
        }
    }
    Ok(())
}

/// The warp alone, of a turned map.
pub fn warp(model: &Model, threads: usize, rows: &mut Vec<Row>) -> Result<()> {
    let ([map_rows, columns], channels) = (model.map_size(), model.map_channels());
    let map = map([map_rows, columns, channels], &mut Numbers::new(7));
    let agent = Agent {
        warp: TURNED,
        ..Agent::beside(&map)
    };
    let mut placer = Placer::new(threads);
    let times = timed(ROUNDS, || {
        placer.place(&agent, [map_rows, columns]);
        Ok(())
    })?;
    rows.push(row(
        format!("warp of a turned map, {map_rows}x{columns}x{channels}"),
        &times,
        None,
    ));
    Ok(())
}

/// The fusion of three agents' maps.
pub fn fusion(model: &Model, network: &mut Network, rows: &mut Vec<Row>) -> Result<()> {
    let ([map_rows, columns], channels) = (model.map_size(), model.map_channels());
    let mut numbers = Numbers::new(7);
    let maps = [(); 3].map(|()| map([map_rows, columns, channels], &mut numbers));
    for (how, warp) in [("lying alike", Warp::IDENTITY), ("turned", TURNED)] {
        let agents: Vec<Agent> = maps
            .iter()
            .enumerate()
            .map(|(i, map)| Agent {
                warp: if i == 0 { Warp::IDENTITY } else { warp },
                ..Agent::beside(map)
            })
            .collect();
        let times = timed(ROUNDS_OF_FULL, || {
            network.fuse(&agents)?;
            Ok(())
        })?;
        let what = format!(
            "fusion of {}, 3 agents {how}, {map_rows}x{columns}x{channels}",
            model.name
        );
        rows.push(row(what, &times, None));
    }
    Ok(())
}

/// A map of numbers that are not negative, as layers with a ReLU make them.
fn map([rows, columns, channels]: [usize; 3], numbers: &mut Numbers) -> BevMap {
    let numbers = numbers.list(rows * columns * channels);
    BevMap {
        rows,
        columns,
        channels,
        data: numbers.iter().map(|number| number.abs()).collect(),
    }
}
