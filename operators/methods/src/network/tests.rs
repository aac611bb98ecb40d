use std::collections::HashMap;

use std::sync::{Arc, Mutex};

use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_kernels::conv::{Convolution, Isa, Pool};
use realo_nn::anchors::Anchors;
use realo_nn::decode::candidates;
use realo_nn::layers::{Builder, ConvLayer, Layer, Layers, MapId, PointLayer};
use realo_nn::model::{Backbone, Frame, Grid, Precision, Shrink, heads};
use realo_nn::weights::{Tensor, Weights, WeightsError};

use super::core::Core;
use super::part::numbers;
use super::*;
use crate::arch::Model;
use crate::detect::pillars::Points;
use crate::testing::{Numbers, lite, random_tensors, random_tensors_of, small};
use crate::vectors::{Vector, assert_near, nhwc};

fn options(isa: Isa, precision: Option<Precision>, threads: usize) -> NetworkOptions {
    NetworkOptions {
        isa,
        precision,
        threads,
    }
}

fn weights(model: &Model, seed: u64) -> Weights {
    Weights::new(model, random_tensors(model, seed)).unwrap()
}

fn canvas(model: &Model, cells: &[f32]) -> Canvas {
    let (rows, columns, channels) = (model.grid.rows(), model.grid.columns(), model.pillars.channels);
    let mut canvas = Canvas::new(rows, columns, channels);
    for (index, cell) in cells.chunks_exact(channels).enumerate() {
        canvas.cell_mut(index / columns, index % columns).copy_from_slice(cell);
    }
    canvas
}

fn random_canvas(model: &Model, seed: u64) -> Canvas {
    let count = model.grid.rows() * model.grid.columns() * model.pillars.channels;
    canvas(model, &Numbers::new(seed).list(count))
}

/// The whole network by the definition of its layers, in f64: scores and deltas side by side.
fn plain(layers: &Layers, weights: &Weights, canvas: &Canvas) -> Vec<f64> {
    let size = [canvas.rows(), canvas.columns()];
    let cells = (0..size[0]).flat_map(|row| (0..size[1]).map(move |column| (row, column)));
    let cells = cells
        .flat_map(|(row, column)| canvas.cell(row, column))
        .map(|value| f64::from(*value))
        .collect();
    let mut maps = HashMap::from([(layers.canvas, (size, cells))]);
    for step in layers.steps() {
        let made = match &step.layer {
            Layer::Points(_) => continue,
            Layer::Convolution(layer) => plain_layer(&numbers(layer, weights), &maps[&step.from[0]]),
            Layer::Join => {
                let (size, _) = maps[&step.from[0]];
                let cell = |map: &MapId, index: usize| {
                    let channels = layers.size(*map)[2];
                    maps[map].1[index * channels..][..channels].to_vec()
                };
                let cells =
                    (0..size[0] * size[1]).flat_map(|index| step.from.iter().flat_map(move |map| cell(map, index)));
                (size, cells.collect())
            }
            Layer::Fuse(_) => maps[&step.from[0]].clone(),
        };
        maps.insert(step.to, made);
    }
    maps.remove(&layers.heads).unwrap().1
}

type PlainMap = ([usize; 2], Vec<f64>);

fn plain_layer(layer: &Convolution, ([rows, columns], cells): &PlainMap) -> PlainMap {
    let size = [layer.size(*rows), layer.size(*columns)];
    let mut out: Vec<f64> = (0..size[0] * size[1])
        .flat_map(|_| layer.bias.iter().map(|b| f64::from(*b)))
        .collect();
    let (windows, pad) = match layer.transposed {
        true => ([*rows, *columns], 0),
        false => (size, layer.kernel / 2),
    };
    for row in 0..windows[0] {
        for column in 0..windows[1] {
            for tap in 0..layer.kernel * layer.kernel {
                let (y, x) = (tap / layer.kernel, tap % layer.kernel);
                let moved = (row * layer.stride + y, column * layer.stride + x);
                let (to, from) = match layer.transposed {
                    true => (moved, Some((row, column))),
                    false => ((row, column), moved.0.checked_sub(pad).zip(moved.1.checked_sub(pad))),
                };
                let Some((from_row, from_column)) = from.filter(|at| at.0 < *rows && at.1 < *columns) else {
                    continue;
                };
                let cell = &cells[(from_row * columns + from_column) * layer.inputs..][..layer.inputs];
                let out = &mut out[(to.0 * size[1] + to.1) * layer.outputs..][..layer.outputs];
                for (output, out) in out.iter_mut().enumerate() {
                    for (input, value) in cell.iter().enumerate() {
                        *out += value * f64::from(layer.weight(output, input, y, x));
                    }
                }
            }
        }
    }
    if layer.relu {
        out.iter_mut().for_each(|value| *value = value.max(0.0));
    }
    (size, out)
}

fn available() -> impl Iterator<Item = Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.is_available())
}

#[test]
fn networks_agree_with_the_definition_of_their_layers() {
    for (rows, columns, odd) in [(8, 12, false), (20, 4, true), (4, 52, true)] {
        let model = small(rows, columns, odd);
        let (weights, canvas) = (weights(&model, 7), random_canvas(&model, 8));
        let expected = plain(&Layers::of(&model), &weights, &canvas);
        let size = expected.iter().fold(0f64, |most, value| most.max(value.abs()));
        for isa in available() {
            for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::Bf16, 0.03)] {
                let mut network = Network::new(&model, &weights, options(isa, Some(precision), 2)).unwrap();
                let heads = network.forward(&canvas).unwrap();
                assert_eq!([heads.rows, heads.columns], model.map_size());
                let cells = heads.scores.chunks_exact(18).zip(heads.deltas.chunks_exact(42));
                let found: Vec<f32> = cells.flat_map(|(scores, deltas)| [scores, deltas].concat()).collect();
                assert_eq!(found.len(), expected.len());
                for (found, expected) in found.iter().zip(&expected) {
                    let difference = (f64::from(*found) - expected).abs();
                    assert!(
                        difference < tolerance * size,
                        "{isa} {precision:?}: {found}, {expected} of {size}"
                    );
                }
            }
        }
    }
}

/// Layers that PointPillars has not: a bottleneck of convolutions with bias and batch norm, whose encoded map is what
/// agents share. Weights, checks and inference need no more than the list.
#[test]
fn another_list_of_layers_is_another_network() {
    let mut builder = Builder::default();
    let points = PointLayer {
        key: "points".into(),
        norm: "points_norm".into(),
        channels: 9,
    };
    let canvas = builder.points(points, [10, 14]);
    let (mut map, mut made) = (canvas, Vec::new());
    for (index, outputs) in [2, 9, 9].into_iter().enumerate() {
        let layer = ConvLayer {
            key: format!("bottleneck.{index}"),
            inputs: builder.size(map)[2],
            outputs,
            kernel: 3,
            stride: 1,
            transposed: false,
            bias: true,
            norm: Some(format!("bottleneck_norm.{index}")),
            relu: true,
        };
        map = builder.convolution(layer, map);
        made.push(map);
    }
    let outputs = heads(&mut builder, &lite(), map);
    let layers = builder.finish(canvas, made[0], outputs);
    assert_eq!(layers.size(layers.features), [10, 14, 2]);

    let mut tensors = random_tensors_of(&layers, 3);
    let weights = Weights::of_layers(&layers, "other", tensors.clone()).unwrap();
    let mut cells = Canvas::new(10, 14, 9);
    for (index, values) in Numbers::new(4).list(10 * 14 * 9).chunks(9).enumerate() {
        cells.cell_mut(index / 14, index % 14).copy_from_slice(values);
    }
    let expected = plain(&layers, &weights, &cells);
    let size = expected.iter().fold(0f64, |most, value| most.max(value.abs()));
    for isa in available() {
        let mut core = Core::of(&layers, &weights, &lite(), &options(isa, Some(Precision::F32), 2)).unwrap();
        core.name = "other".into();
        let mut network = Network::sharing(Arc::new(core), Arc::new(Mutex::new(Pool::new(2))));
        let found = network.forward(&cells).unwrap();
        let found = found.scores.chunks_exact(18).zip(found.deltas.chunks_exact(42));
        let found = found.flat_map(|(scores, deltas)| [scores, deltas].concat());
        assert!(
            found
                .zip(&expected)
                .all(|(found, expected)| (f64::from(found) - expected).abs() < 1e-5 * size)
        );
    }
    tensors.remove("bottleneck_norm.1.running_var");
    let error = Weights::of_layers(&layers, "other", tensors).unwrap_err().to_string();
    assert!(
        error.contains("model `other`: `bottleneck_norm.1.running_var` [9] is missing"),
        "{error}"
    );
}

/// The arithmetic of the shipped model, on every processor and system.
#[test]
fn portable_bits_are_the_same_everywhere() {
    let model = lite();
    let weights = Weights::read(&[SHIPPED], &model).unwrap();
    let mut numbers = Numbers::new(11);
    let column = |numbers: &mut Numbers, reach: f32| -> Vec<f32> {
        (0..4000).map(|_| reach * numbers.draw() * numbers.draw()).collect()
    };
    let [x, y, z] = [90.0, 35.0, 2.5].map(|reach| column(&mut numbers, reach));
    let points = Points {
        x: &x,
        y: &y,
        z: &z,
        intensity: None,
    };
    let mut pillarer = Pillarer::new(&model, &weights);
    let (canvas, _) = pillarer.run(&points);
    let sum = |values: &[f32]| {
        let bits = values.iter().map(|value| u64::from(value.to_bits()));
        bits.fold(0xcbf2_9ce4_8422_2325u64, |sum, bits| {
            (sum ^ bits).wrapping_mul(0x100_0000_01b3)
        })
    };
    let mut found = vec![sum(canvas.data())];
    for precision in [Precision::F32, Precision::Bf16] {
        let mut network = Network::new(&model, &weights, options(Isa::Portable, Some(precision), 2)).unwrap();
        let heads = network.forward(canvas).unwrap();
        found.extend([sum(&heads.scores), sum(&heads.deltas)]);
        let boxes = candidates(&Anchors::of(&model), &heads.scores, &heads.deltas, 0.05, 1000).detections;
        assert!(boxes.len() > 10);
        let numbers = boxes
            .iter()
            .flat_map(|found| found.hwl.into_iter().chain([found.score]));
        found.push(sum(&numbers.collect::<Vec<f32>>()));
    }
    assert_eq!(found, EXPECTED, "{found:#x?}");
}

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/lite.safetensors");
/// Of the canvas; then of scores, deltas and boxes in f32, and in bf16.
const EXPECTED: [u64; 7] = [
    0x8e8f_6143_2887_c8ff,
    0x8ff7_e778_5bef_e09e,
    0x2694_8fb5_46ac_ee6d,
    0xedbc_f96c_3512_9eba,
    0x8c62_7159_1826_bcb7,
    0x10d7_2ad5_59ff_b07b,
    0xc330_e8de_ebe4_6aae,
];

#[test]
fn bits_do_not_depend_on_threads_on_what_came_before_or_on_the_split() {
    let model = small(20, 28, true);
    let (weights, canvas) = (weights(&model, 1), random_canvas(&model, 2));
    for isa in available() {
        for precision in [Precision::F32, Precision::Bf16] {
            let network = |threads| Network::new(&model, &weights, options(isa, Some(precision), threads)).unwrap();
            let mut first = network(1);
            let expected = first.forward(&canvas).unwrap();
            let other = first.forward(&random_canvas(&model, 3)).unwrap();
            assert_ne!(other, expected);
            assert_eq!(first.forward(&canvas).unwrap(), expected);
            for threads in [2, 3, 40] {
                assert_eq!(
                    network(threads).forward(&canvas).unwrap(),
                    expected,
                    "{threads} threads"
                );
            }
            let map = first.encode(&canvas).unwrap();
            assert_eq!([map.rows, map.columns], model.map_size());
            first.forward(&random_canvas(&model, 4)).unwrap();
            assert_eq!(*first.heads(&map).unwrap(), expected);
        }
    }
}

#[test]
fn an_empty_canvas_gives_finite_heads() {
    let model = small(8, 8, false);
    let mut network = Network::new(&model, &weights(&model, 1), NetworkOptions::default()).unwrap();
    let heads = network.forward(&random_canvas(&model, 2)).unwrap();
    let empty = network.forward(&Canvas::new(8, 8, 6)).unwrap();
    assert!(empty.scores.iter().chain(&empty.deltas).all(|value| value.is_finite()));
    assert_ne!(empty, heads);
}

#[test]
fn maps_of_another_size_are_refused() {
    let model = small(8, 12, false);
    let mut network = Network::new(&model, &weights(&model, 1), NetworkOptions::default()).unwrap();
    let error = network.forward(&Canvas::new(8, 13, 6)).unwrap_err().to_string();
    assert_eq!(
        error,
        "the canvas has 8 rows x 13 columns x 6 channels, model `lite` wants 8 x 12 x 6"
    );
    assert!(network.encode(&Canvas::new(8, 12, 7)).is_err());
    let mut map = network.encode(&Canvas::new(8, 12, 6)).unwrap();
    map.data.pop();
    let error = network.heads(&map).unwrap_err().to_string();
    assert_eq!(error, "the BEV map has 815 numbers, its size wants 816");
    map.rows = 5;
    assert!(
        network
            .heads(&map)
            .unwrap_err()
            .to_string()
            .contains("wants 4 x 6 x 34")
    );
}

#[test]
fn names_what_it_computes_with() {
    let choice = |isa, precision| {
        Network::new(&lite(), &weights(&lite(), 1), options(isa, precision, 1))
            .map(|network| network.choice().to_string())
    };
    assert_eq!(
        choice(Isa::Portable, None).unwrap(),
        "f32 on portable (the model asks for bf16), 1 thread"
    );
    assert_eq!(
        choice(Isa::Portable, Some(Precision::Bf16)).unwrap(),
        "bf16 on portable, 1 thread"
    );
    for isa in Isa::ALL {
        match choice(isa, None) {
            Ok(name) => assert!(isa.is_available() && name.contains(&isa.to_string())),
            Err(error) => assert!(!isa.is_available() && error.to_string().contains(&format!("no {isa}"))),
        }
    }
}

#[test]
fn weights_that_do_not_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("lite.safetensors");
    assert!(matches!(
        Network::load(&lite(), &[&path], NetworkOptions::default()),
        Err(NetworkError::Weights(WeightsError::Read { .. }))
    ));
    let mut model = lite();
    model.shrink[0].kernel = 2;
    assert!(matches!(
        Network::load(&model, &[&path], NetworkOptions::default()),
        Err(NetworkError::Model(_))
    ));
}

// Vectors of the reference implementation.

/// A model with the backbone that a vector describes.
fn model_of(backbone: &serde_json::Value, size: [usize; 2], channels: usize) -> Model {
    let list = |key: &str| serde_json::from_value::<Vec<usize>>(backbone[key].clone()).unwrap();
    let mut model = lite();
    model.precision = Precision::F32;
    model.frame = Frame::Lidar;
    model.grid = Grid {
        x: [0.0, size[1] as f64],
        y: [0.0, size[0] as f64],
        z: [-15.0, 15.0],
        cell: 1.0,
    };
    model.pillars.channels = channels;
    model.backbone = Backbone {
        layers: list("layer_nums"),
        strides: list("layer_strides"),
        channels: list("num_filters"),
        up_strides: list("upsample_strides"),
        up_channels: list("num_upsample_filter"),
    };
    model.shrink.clear();
    model
}

/// A vector's parameters as weights of the model, where `parameter` makes a key theirs; the others are random.
fn weights_of(vector: &Vector, model: &Model, parameter: impl Fn(&str) -> Option<&str>) -> Weights {
    let mut tensors = random_tensors(model, 1);
    let mut found = 0;
    for (key, tensor) in &mut tensors {
        if let Some(rest) = parameter(key) {
            let name = format!("param.{rest}");
            *tensor = Tensor {
                shape: vector.shape(&name),
                data: vector.f32(&name),
            };
            found += 1;
        }
    }
    assert!(found > 0, "no parameter");
    Weights::new(model, tensors).unwrap()
}

fn shape4(vector: &Vector, name: &str) -> [usize; 4] {
    vector.shape(name).try_into().unwrap()
}

#[test]
fn the_backbone_matches_the_reference() {
    for file in [
        "network/backbone_1_1_1.safetensors",
        "network/backbone_3_5_8.safetensors",
    ] {
        let vector = Vector::open(file);
        let shape = shape4(&vector, "in.canvas");
        let model = model_of(&vector.config, [shape[2], shape[3]], shape[1]);
        let weights = weights_of(&vector, &model, |key| key.strip_prefix("backbone."));
        let inputs = nhwc(&vector.f32("in.canvas"), shape);
        let expected = nhwc(&vector.f32("out.features"), shape4(&vector, "out.features"));
        for isa in available() {
            let mut network = Network::new(&model, &weights, options(isa, None, 2)).unwrap();
            let samples = inputs.chunks_exact(inputs.len() / shape[0]);
            let found: Vec<f32> = samples
                .flat_map(|cells| network.encode(&canvas(&model, cells)).unwrap().data)
                .collect();
            assert_near(&format!("{file} {isa}"), &found, &expected, 1e-4);
        }
    }
}

#[test]
fn the_shrink_layers_match_the_reference() {
    for (file, kernel) in [
        ("network/shrink_k1.safetensors", 1),
        ("network/shrink_k3.safetensors", 3),
    ] {
        let vector = Vector::open(file);
        let shape = shape4(&vector, "in.x");
        let mut model = small(2 * shape[2], 2 * shape[3], false);
        model.backbone = Backbone {
            layers: vec![0; 3],
            strides: vec![2, 1, 1],
            channels: vec![2; 3],
            up_strides: vec![1; 3],
            up_channels: vec![8; 3],
        };
        model.shrink = vec![
            Shrink { kernel, channels: 16 },
            Shrink {
                kernel: 3,
                channels: 16,
            },
        ];
        let weights = weights_of(&vector, &model, |key| key.strip_prefix("shrink_conv."));
        let inputs = nhwc(&vector.f32("in.x"), shape);
        let expected = nhwc(&vector.f32("out.y"), shape4(&vector, "out.y"));
        for isa in available() {
            let samples = inputs.chunks_exact(inputs.len() / shape[0]);
            let layers = Layers::of(&model);
            let joined = layers.steps().iter().find(|step| step.layer == Layer::Join).unwrap().to;
            let ends = [joined, layers.features];
            let mut section = Section::new(&model, &weights, options(isa, None, 2), ends).unwrap();
            let run = |data| {
                let map = BevView {
                    rows: shape[2],
                    columns: shape[3],
                    channels: shape[1],
                    data,
                };
                section.run(map).unwrap().data
            };
            let found: Vec<f32> = samples.flat_map(run).collect();
            assert_near(&format!("{file} {isa}"), &found, &expected, 1e-4);
        }
    }
}

#[test]
fn the_heads_match_the_reference() {
    let vector = Vector::open("network/head.safetensors");
    let shape = shape4(&vector, "in.x");
    let [_, channels, rows, columns] = shape;
    let mut model = small(2 * rows, 2 * columns, false);
    model.backbone = Backbone {
        layers: vec![0],
        strides: vec![2],
        channels: vec![2],
        up_strides: vec![1],
        up_channels: vec![channels],
    };
    model.shrink.clear();
    let map = BevMap {
        rows,
        columns,
        channels,
        data: nhwc(&vector.f32("in.x"), shape),
    };
    let weights = weights_of(&vector, &model, |key| key.contains("_head.").then_some(key));
    for isa in available() {
        let mut network = Network::new(&model, &weights, options(isa, None, 2)).unwrap();
        let heads = network.heads(&map).unwrap();
        let expected = |name: &str| nhwc(&vector.f32(name), shape4(&vector, name));
        assert_near(&format!("scores {isa}"), &heads.scores, &expected("out.psm"), 1e-4);
        assert_near(&format!("deltas {isa}"), &heads.deltas, &expected("out.rm"), 1e-4);
    }
}

#[test]
fn scattered_pillars_match_the_reference() {
    let vector = Vector::open("network/scatter.safetensors");
    let shape = shape4(&vector, "out.canvas");
    let [samples, channels, rows, columns] = shape;
    let mut found = Vec::new();
    for sample in 0..samples {
        let mut canvas = Canvas::new(rows, columns, channels);
        let features = vector.f32("in.pillar_features");
        for (cell, features) in vector
            .rows::<4>("in.coords_bzyx")
            .iter()
            .zip(features.chunks_exact(channels))
        {
            let [of, _, row, column] = cell.map(|index| index as usize);
            if of == sample {
                canvas.cell_mut(row, column).copy_from_slice(features);
            }
        }
        found.extend((0..rows * columns).flat_map(|cell| canvas.cell(cell / columns, cell % columns).to_vec()));
    }
    assert_eq!(found, nhwc(&vector.f32("out.canvas"), shape));
}

#[test]
fn the_single_agent_model_matches_the_reference_from_points_on() {
    let vector = Vector::open("model/single.safetensors");
    let grid = crate::testing::grid_of(&vector);
    let mut model = model_of(&vector.config["backbone"], [grid.rows(), grid.columns()], 64);
    model.grid = grid;
    model.pillars.empty_slots = true;
    model.pillars.intensity = true;
    let weights = weights_of(&vector, &model, |key| Some(key));
    let points = vector.rows::<4>("in.points");
    let column = |axis: usize| -> Vec<f32> { points.iter().map(|point| point[axis]).collect() };
    let (x, y, z, i) = (column(0), column(1), column(2), column(3));
    let points = Points {
        x: &x,
        y: &y,
        z: &z,
        intensity: Some(&i),
    };
    let mut pillarer = Pillarer::new(&model, &weights);
    let (canvas, _) = pillarer.run(&points);
    let expected = |name: &str| nhwc(&vector.f32(name), shape4(&vector, name));
    for isa in available() {
        let mut network = Network::new(&model, &weights, options(isa, None, 2)).unwrap();
        let heads = network.forward(canvas).unwrap();
        assert_near(&format!("scores {isa}"), &heads.scores, &expected("out.psm"), 5e-4);
        assert_near(&format!("deltas {isa}"), &heads.deltas, &expected("out.rm"), 5e-4);
    }
}
