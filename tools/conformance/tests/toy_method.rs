//! A method of one's own is a folder and a line: it is read from a model file, runs, agrees with its operation on tensors, is
//! trained, and goes through the harness of vectors.

mod common;
mod toy;

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use candle_core::{DType, Device, Tensor, Var};
use common::{Made, noise, not_passed};
use realo_kernels::agents::Agent;
use realo_kernels::bev::BevMap;
use realo_kernels::warp::Warp;
use realo_methods::network::{Network, NetworkOptions};
use realo_methods::tensors::{self, AgentMap, OwnMap, Tensors};
use realo_methods::{Entry, Model, candle};
use realo_nn::filler::{Numbers, weights};
use realo_nn::layers::Layers;
use realo_training::data::Augmentation;
use realo_training::optimizer::OptimizerSettings;
use realo_training::{Data, TrainOptions, train};
use serde_json::json;

/// The small detector of the tests of training.
const DETECTOR: &str = include_str!("../../training/tests/small.toml");

const FUSING: &str = "extends = \"small.toml\"\nname = \"fusing\"\n[arch]\nkind = \"toy\"\nagents = 3\n";

/// The line that makes the method known.
fn known() {
    realo_methods::add(Entry::of::<toy::Settings>());
}

/// The models in a folder, the fusing one's file last.
fn model(folder: &Path) -> Model {
    known();
    fs::write(folder.join("small.toml"), DETECTOR).unwrap();
    fs::write(folder.join("fusing.toml"), FUSING).unwrap();
    Model::read(&folder.join("fusing.toml")).unwrap()
}

fn maps(model: &Model) -> Vec<BevMap> {
    let layers = Layers::of(model);
    let [rows, columns, channels] = layers.size(layers.features);
    let map = |seed| BevMap {
        rows,
        columns,
        channels,
        data: Numbers::new(seed).list(rows * columns * channels),
    };
    (1..=3).map(map).collect()
}

fn agents(maps: &[BevMap]) -> Vec<Agent<'_>> {
    let warps = [
        Warp::IDENTITY,
        Warp([[0.9, 0.2, 1.3], [-0.2, 0.9, -0.4]]),
        Warp([[1.0, 0.0, 40.0], [0.0, 1.0, 2.5]]),
    ];
    let agent = |(map, warp)| Agent {
        warp,
        ..Agent::beside(map)
    };
    maps.iter().zip(warps).map(agent).collect()
}

#[test]
fn a_model_file_names_it_and_its_settings_are_checked() {
    let folder = tempfile::tempdir().unwrap();
    let model = model(folder.path());
    let settings = model.arch.settings::<toy::Settings>().unwrap();
    assert_eq!((settings.agents, model.arch.name()), (3, "toy"));
    let keys = realo_nn::weights::expected(&model);
    assert!(keys.contains(&("fusion_net.share".into(), vec![12])));
    fs::write(folder.path().join("fusing.toml"), format!("{FUSING}width = 3\n")).unwrap();
    let refused = Model::read(&folder.path().join("fusing.toml")).unwrap_err().to_string();
    assert!(refused.contains("unknown field `width`"), "{refused}");
}

#[test]
fn its_kernel_and_its_operation_agree() {
    let folder = tempfile::tempdir().unwrap();
    let model = model(folder.path());
    let weights = weights(&model, 7);
    let mut kernels = Network::new(&model, &weights, NetworkOptions::default()).unwrap();
    let network = candle::Network::new(&model, &weights, &Device::Cpu, DType::F32).unwrap();
    let maps = maps(&model);
    for count in 1..=3 {
        let agents = agents(&maps[..count]);
        let expected = kernels.fuse(&agents).unwrap().data;
        let found = network.fuse(&network.put_agents(&agents).unwrap()).unwrap();
        let found = found.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(
            found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5),
            "{count}"
        );
        assert_eq!(expected != maps[0].data, count > 1);
    }
}

#[test]
fn gradients_lead_to_its_numbers() -> candle_core::Result<()> {
    let folder = tempfile::tempdir().unwrap();
    let model = model(folder.path());
    let layers = Layers::of(&model);
    let (method, layer) = (model.arch.method().unwrap(), layers.fusion().unwrap());
    let variable = Var::from_slice(&Numbers::new(3).list(12), 12, &Device::Cpu)?;
    let maps = maps(&model);
    let agents = agents(&maps).into_iter().map(|agent| {
        let size = (agent.map.rows, agent.map.columns, agent.map.channels);
        let own = OwnMap {
            map: Tensor::from_slice(agent.map.data, size, &Device::Cpu)?,
            confidence: None,
            warp: agent.warp,
        };
        Ok(tensors::Agent {
            map: AgentMap::Own(own),
            roadside: agent.roadside,
            delay: agent.delay,
        })
    });
    let agents = agents.collect::<candle_core::Result<Vec<_>>>()?;
    let loss = || {
        let tensors = HashMap::from([("fusion_net.share".to_string(), variable.as_tensor().clone())]);
        method
            .operation(layer, &Tensors::new(tensors), &agents)?
            .sqr()?
            .sum_all()
    };
    let gradients = loss()?.backward()?;
    let gradient = gradients.get(&variable).unwrap().to_vec1::<f32>()?;
    let before = variable.as_tensor().to_vec1::<f32>()?;
    for channel in 0..12 {
        let at = |step: f32| -> candle_core::Result<f64> {
            let mut moved = before.clone();
            moved[channel] += step;
            variable.set(&Tensor::from_slice(&moved, 12, &Device::Cpu)?)?;
            Ok(f64::from(loss()?.to_scalar::<f32>()?))
        };
        let slope = (at(0.1)? - at(-0.1)?) / 0.2;
        let found = f64::from(gradient[channel]);
        assert!(
            (slope - found).abs() < 0.02 * found.abs() + 0.1,
            "{channel}: {slope} {found}"
        );
    }
    Ok(())
}

#[test]
fn it_is_trained_and_the_trained_model_is_loaded() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    model(folder.path());
    let detector = TrainOptions {
        model: path("small.toml"),
        from: None,
        teacher: None,
        output: path("detector"),
        resume: false,
        data: Data::Simulated {
            cache: path("cache"),
            seeds: 0..2,
            per_seed: 1,
        },
        steps: 6,
        minutes: None,
        fit_steps: false,
        seed: 3,
        batch: 2,
        freeze: Vec::new(),
        frozen_norms: false,
        parts: 0.5,
        checkpoint_minutes: 1.0,
        validate_every: None,
        compare: false,
        validation: None,
        optimizer: OptimizerSettings {
            rate: 2e-3,
            ..OptimizerSettings::default()
        },
        augmentation: Augmentation::default(),
        threads: Some(2),
        arithmetic: None,
    };
    assert!(train(&detector, |_| ()).unwrap().complete);
    let fusing = TrainOptions {
        model: path("fusing.toml"),
        from: Some(path("detector/small.toml")),
        output: path("fusing"),
        augmentation: Augmentation::of_fusion(),
        steps: 40,
        ..detector
    };
    let mut losses = Vec::new();
    assert!(
        train(&fusing, |progress| losses.push(progress.point.loss()))
            .unwrap()
            .complete
    );
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (before, after) = (mean(&losses[..10]), mean(&losses[30..]));
    assert!(after < 0.9 * before, "from {before} to {after}");
    let loaded = realo_methods::load(&path("fusing/fusing.toml"), realo_methods::Kernels::auto(1)).unwrap();
    let share = loaded.weights.tensor("fusion_net.share");
    assert!(share.iter().any(|share| *share != 0.0), "{share:?}");
}

#[test]
fn its_vectors_pass_and_wrong_ones_fail() {
    known();
    let (rows, columns, channels) = (4, 6, 2);
    let count = rows * columns;
    let maps = noise(5, 3 * channels * count);
    let logits = [0.5, -1.0];
    // A sample of two agents, then one of a single agent.
    let fused = (0..2 * channels * count).map(|index| {
        let (sample, channel) = (index / (channels * count), index / count % channels);
        let share = 1.0 / (1.0 + libm::exp(-logits[channel]));
        let at = |map: usize| maps[map * channels * count + index % (channels * count)];
        match sample {
            0 => (at(0) + share * at(1)) / (1.0 + share),
            _ => at(2),
        }
    });
    let fused: Vec<f64> = fused.collect();
    let run = |wrong: bool| {
        let mut made = Made {
            wrong,
            ..Made::default()
        };
        made.tensors(
            "toy.safetensors",
            1e-5,
            json!({"kind": "toy"}),
            &[
                ("in.x", vec![3, channels, rows, columns], maps.clone()),
                ("in.record_len", vec![2], vec![2.0, 1.0]),
                ("param.share", vec![channels], logits.to_vec()),
                ("out.y", vec![2, channels, rows, columns], fused.clone()),
            ],
        );
        not_passed(&made.run())
    };
    assert_eq!(run(false), Vec::<String>::new());
    assert_eq!(run(true).len(), 1);
}
