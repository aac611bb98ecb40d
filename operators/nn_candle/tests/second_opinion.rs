//! Candle's networks and the kernels of `realo_nn` agree: every model that ships, on a small map.

use std::path::Path;

use candle_core::{Device, Result, Tensor};
use realo_nn::arch::{Arch, Transformer, Window};
use realo_nn::filler::{Numbers, weights};
use realo_nn::fuse::{Agent, Warp};
use realo_nn::layers::{Fusion, Layers};
use realo_nn::model::{Model, Precision};
use realo_nn::network::{BevMap, Network, NetworkOptions};
use realo_nn_candle::{Placed, Tensors, transformer};

/// Numbers of a result that sums in another order, of some dozen layers, may give: f32 is exact to 6e-8.
const TOLERANCE: f32 = 1e-5;

/// The models that ship, on maps of 16 x 32 cells.
fn models() -> Vec<Model> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = files
        .filter(|path| path.extension().is_some_and(|end| end == "toml"))
        .collect();
    files.sort();
    let small = |path: &std::path::PathBuf| {
        let mut model = Model::read(path).unwrap();
        (model.grid.x, model.grid.y) = ([0.0, 25.6], [0.0, 12.8]);
        model.validate().unwrap();
        model
    };
    files.iter().map(small).collect()
}

/// A transformer of several rounds and blocks, with sizes that are no powers of two.
fn deep() -> Model {
    let mut model = models().into_iter().find(|model| model.name == "lite-v2xvit").unwrap();
    model.shrink[0].channels = 12;
    let window = |side, heads, head_width| Window {
        side,
        heads,
        head_width,
    };
    model.arch = Arch::V2XViT(Box::new(Transformer {
        depth: 2,
        blocks: 2,
        heads: 3,
        head_width: 4,
        windows: vec![window(2, 2, 3), window(4, 1, 5)],
        feed_forward: 7,
        delays: 20,
        ..Transformer::default()
    }));
    model.validate().unwrap();
    model
}

fn kernels(model: &Model) -> Network {
    let options = NetworkOptions {
        precision: Some(Precision::F32),
        ..NetworkOptions::default()
    };
    Network::new(model, &weights(model, 7), options).unwrap()
}

fn map(seed: u64, [rows, columns, channels]: [usize; 3]) -> BevMap {
    let data = Numbers::new(seed).list(rows * columns * channels);
    BevMap {
        rows,
        columns,
        channels,
        data,
    }
}

/// An ego and others, turned, moved and late; the last one's map covers nothing.
fn crowd(maps: &[BevMap]) -> Vec<Agent<'_>> {
    let moved = |x, y| Warp([[0.9, 0.2, x], [-0.2, 0.9, y]]);
    let places = [
        (Warp::IDENTITY, true, 0),
        (moved(1.3, -0.4), false, 2),
        (moved(-7.0, 3.25), true, 1),
        (moved(500.0, 0.0), false, 99),
    ];
    let agent = |(map, (warp, roadside, delay))| Agent {
        warp,
        roadside,
        delay,
        ..Agent::beside(map)
    };
    maps.iter().zip(places).map(agent).collect()
}

fn assert_near(found: &[f32], expected: &[f32], what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let size = expected.iter().fold(0.0f32, |size, value| size.max(value.abs()));
    let apart = found
        .iter()
        .zip(expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f32::max);
    assert!(
        size > 0.01 && apart <= TOLERANCE * size,
        "{what}: {apart} apart of {size}"
    );
}

fn numbers(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().and_then(|all| all.to_vec1()).unwrap()
}

#[test]
fn transformers_agree() -> Result<()> {
    let transformers = models()
        .into_iter()
        .filter(|model| matches!(model.arch, Arch::V2XViT(_)));
    for model in transformers.chain([deep()]) {
        let layers = Layers::of(&model);
        let Some(Fusion::Transformer(settings)) = layers.fusion().map(|layer| &layer.fusion) else {
            unreachable!("a transformer fuses");
        };
        let tensors = Tensors::of(&layers, &weights(&model, 7), &Device::Cpu)?;
        let maps = [1, 2, 3, 4].map(|seed| map(seed, layers.size(layers.restored)));
        for count in 1..=4 {
            let agents = crowd(&maps[..count]);
            let given = |agent: &Agent| {
                let size = (agent.map.rows, agent.map.columns, agent.map.channels);
                let map = Tensor::from_slice(agent.map.data, size, &Device::Cpu)?;
                let (roadside, delay) = (agent.roadside, agent.delay);
                let placed = Placed::new(&map, &agent.warp)?;
                Ok(transformer::Agent {
                    placed,
                    roadside,
                    delay,
                })
            };
            let given = agents.iter().map(given).collect::<Result<Vec<_>>>()?;
            let found = numbers(&transformer::fuse(settings, &tensors, &given)?);
            let expected = kernels(&model).fuse(&agents).unwrap();
            assert_near(&found, &expected.data, &format!("{} of {count}", model.name));
        }
    }
    Ok(())
}
