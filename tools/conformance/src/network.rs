use std::collections::HashMap;

use realo_nn::canvas::Canvas;
use realo_nn::conv::{Isa, apply};
use realo_nn::model::{Backbone, ClassAnchor, Frame, Grid, Model, PillarSettings, Precision, Shrink};
use realo_nn::network::{BevMap, Network, NetworkOptions, shrink_layers};
use realo_nn::pillar_net::PillarNet;
use realo_nn::pillars::{Pillariser, Points};
use realo_nn::weights::{Tensor, Weights, expected};
use serde_json::{Value, json};

use crate::Check;
use crate::vector::{Tensors, Vector, compare};

pub(crate) fn check(name: &str) -> Option<Check> {
    match name {
        "backbone_1_1_1" | "backbone_3_5_8" => Some(backbone),
        "shrink_k1" | "shrink_k3" => Some(shrink),
        "head" => Some(head),
        "scatter" => Some(scatter),
        _ => None,
    }
}

pub(crate) fn check_model(name: &str) -> Option<Check> {
    match name {
        "single" => Some(single),
        _ => None,
    }
}

const CELL: f64 = 0.4;
const SLOTS: usize = 32;

/// The vectors are f32, so this is too; with the best instructions that the CPU has.
fn options() -> NetworkOptions {
    NetworkOptions {
        precision: Some(Precision::F32),
        ..NetworkOptions::default()
    }
}

/// A model of V2X-Real's heads whose backbone has these settings of a vector.
fn model(grid: Grid, channels: usize, backbone: &Value) -> Result<Model, String> {
    let list = |key: &str| -> Result<Vec<usize>, String> {
        serde_json::from_value(backbone[key].clone()).map_err(|error| format!("config `{key}`: {error}"))
    };
    let class = |name: &str| ClassAnchor {
        name: name.into(),
        length: 1.0,
        width: 1.0,
        height: 1.0,
        z: 0.0,
        matched: 0.6,
        unmatched: 0.45,
    };
    let model = Model {
        name: "vector".into(),
        frame: Frame::Lidar,
        precision: Precision::F32,
        rotations: vec![0.0, 1.57],
        score_threshold: 0.2,
        classes: ["vehicle", "pedestrian", "truck"].map(class).into(),
        grid,
        pillars: PillarSettings {
            channels,
            points: SLOTS,
            pillars: 640_000,
            empty_slots: true,
            intensity: true,
        },
        backbone: Backbone {
            layers: list("layer_nums")?,
            strides: list("layer_strides")?,
            channels: list("num_filters")?,
            up_strides: list("upsample_strides")?,
            up_channels: list("num_upsample_filter")?,
        },
        shrink: Vec::new(),
    };
    model.validate().map_err(|error| error.to_string())?;
    Ok(model)
}

/// A grid of so many cells.
fn grid([rows, columns]: [usize; 2]) -> Grid {
    Grid {
        x: [0.0, columns as f64 * CELL],
        y: [0.0, rows as f64 * CELL],
        z: [-15.0, 15.0],
        cell: CELL,
    }
}

/// The vector's parameters, where `part` of a key names one; ones elsewhere, which no check reads.
fn weights(model: &Model, tensors: &Tensors, part: impl Fn(&str) -> Option<&str>) -> Result<Weights, String> {
    let tensor = |(key, shape): (String, Vec<usize>)| -> Result<(String, Tensor), String> {
        let found = match part(&key) {
            Some(name) => {
                let name = format!("param.{name}");
                Tensor {
                    shape: tensors.shape(&name)?,
                    data: tensors.singles(&name)?,
                }
            }
            None => {
                let data = vec![1.0; shape.iter().product()];
                Tensor { shape, data }
            }
        };
        Ok((key, found))
    };
    let all: HashMap<String, Tensor> = expected(model).into_iter().map(tensor).collect::<Result<_, _>>()?;
    Weights::new(model, all).map_err(|error| error.to_string())
}

fn network(model: &Model, weights: &Weights) -> Result<Network, String> {
    Network::new(model, weights, options()).map_err(|error| error.to_string())
}

fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().copied().map(f64::from).collect()
}

/// Compares `[rows, columns, channels]` of one or more samples with a tensor whose channels come before its rows.
fn compare_map(vector: &Vector, tensors: &Tensors, name: &str, found: &[f32]) -> Result<(), String> {
    let (expected, _) = tensors.channels_last(name)?;
    compare(name, &wide(found), &wide(&expected), vector.tolerance()?)
}

fn backbone(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [samples, channels, rows, columns]) = tensors.channels_last("in.canvas")?;
    let model = model(grid([rows, columns]), channels, &vector.entry.config)?;
    let weights = weights(&model, &tensors, |key| key.strip_prefix("backbone."))?;
    let mut network = network(&model, &weights)?;
    let mut found = Vec::new();
    for cells in cells.chunks_exact(cells.len() / samples.max(1)) {
        let mut canvas = Canvas::new(rows, columns, channels);
        for (index, cell) in cells.chunks_exact(channels).enumerate() {
            canvas.cell_mut(index / columns, index % columns).copy_from_slice(cell);
        }
        found.extend(network.encode(&canvas).map_err(|error| error.to_string())?.data);
    }
    compare_map(vector, &tensors, "out.features", &found)
}

/// A backbone of one block that gives `channels`, for checks of what comes after it.
fn before(rows: usize, columns: usize, channels: usize) -> Result<Model, String> {
    let settings = json!({
        "layer_nums": [0], "layer_strides": [2], "num_filters": [1], "upsample_strides": [1],
        "num_upsample_filter": [channels],
    });
    model(grid([2 * rows, 2 * columns]), 1, &settings)
}

fn shrink(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [samples, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let mut model = before(rows, columns, channels)?;
    for index in [0, 2] {
        let name = format!("param.layers.0.double_conv.{index}.weight");
        let shape = tensors.shape(&name)?;
        let [channels, _, kernel, _] = shape[..] else {
            return Err(format!("`{name}` has shape {shape:?}, not four sizes"));
        };
        model.shrink.push(Shrink { kernel, channels });
    }
    model.validate().map_err(|error| error.to_string())?;
    let weights = weights(&model, &tensors, |key| key.strip_prefix("shrink_conv."))?;
    let layers = shrink_layers(&model, &weights);
    let samples = cells.chunks_exact(cells.len() / samples.max(1));
    let run = |cells| apply(&layers, Isa::detect(), options().threads, [rows, columns], cells);
    compare_map(vector, &tensors, "out.y", &samples.flat_map(run).collect::<Vec<_>>())
}

fn head(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (data, [_, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let model = before(rows, columns, channels)?;
    let weights = weights(&model, &tensors, |key| key.contains("_head.").then_some(key))?;
    let map = BevMap {
        rows,
        columns,
        channels,
        data,
    };
    let heads = network(&model, &weights)?
        .heads(&map)
        .map_err(|error| error.to_string())?;
    compare_map(vector, &tensors, "out.psm", &heads.scores)?;
    compare_map(vector, &tensors, "out.rm", &heads.deltas)
}

fn scatter(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (expected, [samples, channels, rows, columns]) = tensors.channels_last("out.canvas")?;
    let features = tensors.singles("in.pillar_features")?;
    let mut maps = vec![Canvas::new(rows, columns, channels); samples];
    let places = tensors.rows::<4>("in.coords_bzyx")?;
    for (place, features) in places.iter().zip(features.chunks_exact(channels)) {
        let [sample, _, row, column] = place.map(|index| index as usize);
        let map = maps.get_mut(sample).filter(|_| row < rows && column < columns);
        let map = map.ok_or_else(|| format!("pillar {place:?} lies outside the canvas"))?;
        map.cell_mut(row, column).copy_from_slice(features);
    }
    let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
    let found: Vec<f32> = maps
        .iter()
        .flat_map(|map| cells.clone().flat_map(|(row, column)| map.cell(row, column)))
        .copied()
        .collect();
    compare("canvas", &wide(&found), &wide(&expected), vector.tolerance()?)
}

/// The whole network of one agent, from points on.
fn single(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let [x0, y0, z0, x1, y1, z1] = vector.setting("range")?;
    let grid = Grid {
        x: [x0, x1],
        y: [y0, y1],
        z: [z0, z1],
        cell: CELL,
    };
    let channels = tensors.numbers("param.pillar_vfe.pfn_layers.0.norm.bias")?.len();
    let model = model(grid, channels, &vector.entry.config["backbone"])?;
    let weights = weights(&model, &tensors, |key| Some(key))?;
    let points = tensors.rows::<4>("in.points")?;
    let [x, y, z, intensity] = &[0, 1, 2, 3].map(|axis| points.iter().map(|p| p[axis] as f32).collect::<Vec<_>>());
    let mut pillariser = Pillariser::new(&model.grid, model.pillars.points, model.pillars.pillars);
    let intensity = Some(&intensity[..]);
    let pillars = pillariser.run(&Points { x, y, z, intensity });
    let mut canvas = Canvas::new(grid.rows(), grid.columns(), channels);
    PillarNet::of(&model, &weights).run(pillars, &mut canvas);
    let heads = network(&model, &weights)?
        .forward(&canvas)
        .map_err(|error| error.to_string())?;
    compare_map(vector, &tensors, "out.psm", &heads.scores)?;
    compare_map(vector, &tensors, "out.rm", &heads.deltas)
}
