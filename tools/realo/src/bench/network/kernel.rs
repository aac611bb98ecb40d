//! The best rate that convolutions reach here: what other rates are a share of.

use eyre::{OptionExt, Result};
use realo_nn::arch::Arch;
use realo_nn::filler::{self, Numbers};
use realo_nn::layers::{Layer, Layers};
use realo_nn::model::{Backbone, Grid, Model, Precision};
use realo_nn::network::{BevMap, NetworkOptions, Section};
use realo_nn::pillars::Points;

use super::{ROUNDS, calibrated, operations, spread, timed};

/// Convolutions one after the other, so that taking the first map and giving the last one cost nothing.
const LAYERS: usize = 64;
/// Channels of them.
const CHANNELS: usize = 64;
/// Cells of the map along x and y: it stays in the caches nearest to the cores.
const CELLS: [usize; 2] = [36, 16];

/// Multiplications and additions a second, in 10⁹, of 3x3 convolutions on a small map, by precision.
pub type Best = Vec<(Precision, f64)>;

/// The best rates in the best instructions; `like` is a model of pillars with as many channels.
pub fn best(like: &Model, points: &Points, threads: usize) -> Result<Best> {
    let mut model = like.clone();
    let half = CELLS.map(|cells| cells as f64 * model.grid.cell / 2.0);
    model.arch = Arch::PointPillars {};
    model.grid = Grid {
        x: [-half[0], half[0]],
        y: [-half[1], half[1]],
        ..model.grid
    };
    model.shrink.clear();
    model.backbone = Backbone {
        layers: vec![LAYERS],
        strides: vec![1],
        channels: vec![CHANNELS],
        up_strides: vec![1],
        up_channels: vec![CHANNELS],
    };
    let weights = filler::weights(&model, 1);
    let model = calibrated(model, &weights, points)?;
    let layers = Layers::of(&model);
    let convolutions = layers
        .steps()
        .iter()
        .filter(|step| matches!(step.layer, Layer::Convolution(_)));
    let last = convolutions
        .take(LAYERS)
        .last()
        .ok_or_eyre("a network without convolutions")?;
    let ends = [layers.canvas, last.to];
    let [rows, columns, channels] = layers.size(ends[0]);
    let map = BevMap {
        rows,
        columns,
        channels,
        data: Numbers::new(7).list(rows * columns * channels),
    };
    let rate = |precision| {
        let options = NetworkOptions {
            precision: Some(precision),
            threads,
            ..NetworkOptions::default()
        };
        let mut section = Section::new(&model, &weights, options, ends)?;
        let times = timed(ROUNDS, || {
            section.run(&map)?;
            Ok(())
        })?;
        Ok((precision, operations(&layers, ends) / spread(&times).0 * 1e-9))
    };
    Precision::ALL.into_iter().map(rate).collect()
}
