use std::collections::HashMap;

use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::detect::pillars::Points;
use realo_methods::network::{Network, NetworkOptions, Section};
use realo_nn::layers::{Layer, Layers};
use realo_nn::model::{Backbone, Grid, Precision, Shrink};
use realo_nn::weights::{Tensor, Weights, expected};
use serde_json::Value;

use crate::Kind;
use crate::reference::{CELL, any_backbone, grid_of, model_of};
use crate::vector::{Tensors, Vector, compare};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.canvas", "out.features", "param.blocks.0.1.weight"], backbone),
    Kind::new(&["in.x", "out.y", "param.layers.0.double_conv.0.weight"], shrink),
    Kind::new(&["in.x", "out.psm", "out.rm", "param.cls_head.weight"], head),
    Kind::new(&["in.pillar_features", "in.coords_bzyx", "out.canvas"], scatter),
    Kind::new(&["in.points", "out.psm", "out.rm", "param.cls_head.weight"], single).without(&["mid.fused"]),
];

/// The vectors are f32, so this is too; with the best instructions that the CPU has.
pub(crate) fn options() -> NetworkOptions {
    NetworkOptions {
        precision: Some(Precision::F32),
        ..NetworkOptions::default()
    }
}

pub(crate) fn backbone_of(config: &Value) -> Result<Backbone, String> {
    let list = |key: &str| -> Result<Vec<usize>, String> {
        serde_json::from_value(config[key].clone()).map_err(|error| format!("config `{key}`: {error}"))
    };
    Ok(Backbone {
        layers: list("layer_nums")?,
        strides: list("layer_strides")?,
        channels: list("num_filters")?,
        up_strides: list("upsample_strides")?,
        up_channels: list("num_upsample_filter")?,
    })
}

/// A grid of so many cells.
fn grid([rows, columns]: [usize; 2]) -> Grid {
    let (x, y) = (columns as f64 * CELL, rows as f64 * CELL);
    grid_of([0.0, 0.0, -15.0, x, y, 15.0])
}

/// The vector's parameters, where `part` of a key names one; ones elsewhere, which no check reads.
pub(crate) fn weights_of(
    model: &Model,
    tensors: &Tensors,
    part: impl Fn(&str) -> Option<&str>,
) -> Result<Weights, String> {
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

pub(crate) fn network(model: &Model, weights: &Weights) -> Result<Network, String> {
    Network::new(model, weights, options()).map_err(|error| error.to_string())
}

pub(crate) fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().copied().map(f64::from).collect()
}

/// Compares `[rows, columns, channels]` of one or more samples with a tensor whose channels come before its rows.
pub(crate) fn compare_map(vector: &Vector, tensors: &Tensors, name: &str, found: &[f32]) -> Result<(), String> {
    let (expected, _) = tensors.channels_last(name)?;
    compare(name, &wide(found), &wide(&expected), vector.tolerance()?)
}

fn backbone(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [samples, channels, rows, columns]) = tensors.channels_last("in.canvas")?;
    let model = model_of(grid([rows, columns]), channels, backbone_of(&vector.entry.config)?)?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("backbone."))?;
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

/// A model whose backbone gives `channels`, for checks of what comes after it.
pub(crate) fn before(rows: usize, columns: usize, channels: usize) -> Result<Model, String> {
    model_of(grid([2 * rows, 2 * columns]), 1, any_backbone(channels))
}

fn shrink(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [samples, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let mut model = before(rows, columns, channels)?;
    let mut names = tensors.names("param.layers.0.double_conv.")?;
    names.retain(|name| name.ends_with(".weight"));
    for name in names {
        let shape = tensors.shape(&name)?;
        let [channels, _, kernel, _] = shape[..] else {
            return Err(format!("`{name}` has shape {shape:?}, not four sizes"));
        };
        model.shrink.push(Shrink { kernel, channels });
    }
    model.validate().map_err(|error| error.to_string())?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("shrink_conv."))?;
    let layers = Layers::of(&model);
    let mut steps = layers.steps().iter();
    let joined = steps
        .find(|step| step.layer == Layer::Join)
        .ok_or("the backbone joins nothing")?;
    let section = Section::new(&model, &weights, options(), [joined.to, layers.features]);
    let mut section = section.map_err(|error| error.to_string())?;
    let mut found = Vec::new();
    for data in cells.chunks_exact(cells.len() / samples.max(1)) {
        let map = BevView {
            rows,
            columns,
            channels,
            data,
        };
        found.extend(section.run(map).map_err(|error| error.to_string())?.data);
    }
    compare_map(vector, &tensors, "out.y", &found)
}

fn head(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (data, [_, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let model = before(rows, columns, channels)?;
    let weights = weights_of(&model, &tensors, |key| key.contains("_head.").then_some(key))?;
    let map = BevMap {
        rows,
        columns,
        channels,
        data,
    };
    let mut network = network(&model, &weights)?;
    let heads = network.heads(&map).map_err(|error| error.to_string())?;
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
    let grid = grid_of(vector.setting("range")?);
    let channels = tensors.numbers("param.pillar_vfe.pfn_layers.0.norm.bias")?.len();
    let model = model_of(grid, channels, backbone_of(&vector.entry.config["backbone"])?)?;
    let weights = weights_of(&model, &tensors, |key| Some(key))?;
    let points = tensors.rows::<4>("in.points")?;
    let [x, y, z, intensity] = &[0, 1, 2, 3].map(|axis| points.iter().map(|p| p[axis] as f32).collect::<Vec<_>>());
    let intensity = Some(&intensity[..]);
    let mut pillarer = Pillarer::new(&model, &weights);
    let (canvas, _) = pillarer.run(&Points { x, y, z, intensity });
    let heads = network(&model, &weights)?
        .forward(canvas)
        .map_err(|error| error.to_string())?;
    compare_map(vector, &tensors, "out.psm", &heads.scores)?;
    compare_map(vector, &tensors, "out.rm", &heads.deltas)
}
