use realo_kernels::agents::Agent;
use realo_kernels::bev::BevMap;
use realo_kernels::canvas::Canvas;
use realo_kernels::conv::Isa;
use realo_kernels::warp::Warp;
use realo_nn::model::{Precision, Sharing, Shrink};
use realo_nn::weights::Weights;

use super::*;
use crate::arch::Model;
use crate::testing::{Numbers, random_tensors, small};
use crate::v2xvit::Window;
use crate::{attfuse, fcooper, v2vnet, v2xvit};

/// Networks that fuse, on maps of 8 x 16 cells.
fn fusing() -> Vec<Model> {
    let model = |arch| {
        let mut model = small(16, 32, false);
        (model.backbone.channels, model.backbone.up_channels) = (vec![8, 12], vec![8, 8]);
        model.shrink = vec![Shrink {
            kernel: 1,
            channels: 12,
        }];
        model.arch = arch;
        model.validate().unwrap();
        model
    };
    let window = |side, heads, head_width| Window {
        side,
        heads,
        head_width,
    };
    let transformer = |depth, blocks, compression| v2xvit::Settings {
        compression,
        depth,
        blocks,
        heads: 3,
        head_width: 4,
        windows: vec![window(2, 2, 3), window(4, 1, 5)],
        feed_forward: 7,
        delays: 20,
        ..v2xvit::Settings::default()
    };
    let messages = |compression| v2vnet::Settings {
        compression,
        ..v2vnet::Settings::default()
    };
    vec![
        model(fcooper::Settings::default().into()),
        model(
            attfuse::Settings(Sharing {
                agents: 4,
                compression: 4,
                ..Sharing::default()
            })
            .into(),
        ),
        model(transformer(1, 1, 0).into()),
        model(transformer(2, 2, 3).into()),
        model(messages(0).into()),
        model(messages(2).into()),
    ]
}

#[test]
fn an_agents_own_map_stays_whole_where_its_model_says_so() {
    let mut model = fusing().remove(0);
    model.arch = fcooper::Settings(Sharing {
        compression: 4,
        compress_own: false,
        ..Sharing::default()
    })
    .into();
    let weights = Weights::new(&model, random_tensors(&model, 7)).unwrap();
    let mut network = Network::new(&model, &weights, NetworkOptions::default()).unwrap();
    let mut canvas = Canvas::new(16, 32, model.pillars.channels);
    for cell in (0..40).map(|cell| 11 * cell) {
        canvas.cell_mut(cell / 32, cell % 32).fill(0.01 * cell as f32);
    }
    let own = network.encode_own(&canvas).unwrap();
    let shared = network.share(&own).unwrap().expect("another map");
    assert_eq!([own.channels, shared.channels], [12, 3]);
    assert_eq!(network.encode(&canvas).unwrap(), shared);
    assert!(own.data.iter().any(|value| *value > 0.0));
    let far = Warp([[1.0, 0.0, 500.0], [0.0, 1.0, 0.0]]);
    let out_of_reach = Agent {
        warp: far,
        ..Agent::beside(&shared)
    };
    let agents = [Agent::beside(&own), out_of_reach];
    assert_eq!(network.fuse(&agents).unwrap(), own);
    assert_ne!(network.fuse(&[Agent::beside(&shared)]).unwrap(), own);
    let alone = network.heads_alone(&own).unwrap().clone();
    assert_eq!(&alone, network.heads(&own).unwrap());
    let other = BevMap { channels: 5, ..own };
    assert!(matches!(
        network.fuse(&[Agent::beside(&other)]),
        Err(NetworkError::Shape { .. })
    ));
}

/// A map, where the ego's cells lie in it, whether a roadside unit made it, and its delay in frames.
type Taking = (BevMap, Warp, bool, usize);

fn fused(model: &Model, options: NetworkOptions, agents: &[Taking]) -> Vec<f32> {
    let weights = Weights::new(model, random_tensors(model, 7)).unwrap();
    let mut network = Network::new(model, &weights, options).unwrap();
    let agents: Vec<Agent> = agents
        .iter()
        .map(|(map, warp, roadside, delay)| Agent {
            warp: *warp,
            roadside: *roadside,
            delay: *delay,
            ..Agent::beside(map)
        })
        .collect();
    network.fuse(&agents).unwrap().data
}

/// Sharing maps of an ego and others; the last one's covers nothing.
fn crowd(model: &Model) -> Vec<Taking> {
    let [rows, columns] = model.map_size();
    let channels = model.map_channels();
    let map = |seed| BevMap {
        rows,
        columns,
        channels,
        data: Numbers::new(seed).list(rows * columns * channels),
    };
    let moved = |x, y| Warp([[1.0, 0.1, x], [-0.1, 1.0, y]]);
    vec![
        (map(1), Warp::IDENTITY, true, 0),
        (map(2), moved(1.3, -0.4), false, 2),
        (map(3), moved(-2.0, 1.0), true, 1),
        (map(4), moved(500.0, 0.0), false, 0),
    ]
}

fn far(a: &[f32], b: &[f32]) -> f32 {
    let apart = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    assert_eq!(a.len(), b.len());
    apart.fold(0.0, f32::max)
}

#[test]
fn fusions_give_the_same_with_any_threads_and_nearly_the_same_with_any_instructions_and_numbers() {
    for model in fusing() {
        let agents = crowd(&model);
        let run = |isa, precision, threads| {
            let options = NetworkOptions {
                isa,
                precision: Some(precision),
                threads,
            };
            fused(&model, options, &agents)
        };
        let portable = run(Isa::Portable, Precision::F32, 1);
        let size = portable.iter().fold(0.0f32, |size, value| size.max(value.abs()));
        assert!(
            size > 0.01 && portable.iter().all(|value| value.is_finite()),
            "{}",
            model.arch
        );
        assert_eq!(portable, run(Isa::Portable, Precision::F32, 3), "{}", model.arch);
        assert!(
            far(&portable, &run(Isa::detect(), Precision::F32, 2)) < 1e-4 * size.max(1.0),
            "{}",
            model.arch
        );
        let half = far(&portable, &run(Isa::Portable, Precision::Bf16, 2));
        assert!(half < 0.1 * size.max(1.0), "{}: {half} of {size}", model.arch);
    }
}

#[test]
fn an_agent_whose_map_reaches_nowhere_does_not_count_and_the_others_have_no_order() {
    for model in fusing() {
        let options = NetworkOptions {
            precision: Some(Precision::F32),
            ..NetworkOptions::default()
        };
        let all = crowd(&model);
        let of = |order: &[usize]| {
            let agents: Vec<_> = order.iter().map(|index| all[*index].clone()).collect();
            fused(&model, options, &agents)
        };
        let three = of(&[0, 1, 2]);
        assert!(far(&three, &of(&[0, 2, 1])) < 1e-4, "{}", model.arch);
        // Messages are a mean over all agents.
        if model.arch.settings::<v2vnet::Settings>().is_none() {
            assert!(far(&three, &of(&[0, 1, 2, 3])) < 1e-5, "{}", model.arch);
        }
        assert!(far(&three, &of(&[0, 1])) > 1e-4, "{}", model.arch);
        assert!(far(&three, &of(&[0])) > 1e-4, "{}", model.arch);
    }
}

#[test]
fn kind_and_delay_of_an_agent_matter_to_the_transformer_alone() {
    for model in fusing() {
        let all = crowd(&model);
        let options = NetworkOptions {
            precision: Some(Precision::F32),
            ..NetworkOptions::default()
        };
        let with = |roadside: bool, delay: usize| {
            let mut agents = all[..2].to_vec();
            (agents[1].2, agents[1].3) = (roadside, delay);
            fused(&model, options, &agents)
        };
        let matters = model.arch.settings::<v2xvit::Settings>().is_some();
        let (before, kind, delay) = (with(false, 0), with(true, 0), with(false, 1));
        assert_eq!((before != kind, before != delay), (matters, matters), "{}", model.arch);
        assert_eq!(
            with(false, 10),
            with(false, usize::MAX),
            "the table of delays has an end"
        );
    }
}

#[test]
fn fusions_of_nobody_of_too_many_and_of_maps_that_do_not_fit_are_refused() {
    for model in fusing() {
        let weights = Weights::new(&model, random_tensors(&model, 7)).unwrap();
        let mut network = Network::new(&model, &weights, NetworkOptions::default()).unwrap();
        let all = crowd(&model);
        let own = Agent::beside(&all[0].0);
        let error = |network: &mut Network, agents: &[Agent]| network.fuse(agents).unwrap_err().to_string();
        assert!(error(&mut network, &[]).contains("1 to 4 agents, the ego among them, found 0"));
        assert!(error(&mut network, &[own; 5]).contains("found 5"));
        let narrow = BevMap {
            channels: 1,
            ..all[1].0.clone()
        };
        assert!(error(&mut network, &[own, Agent::beside(&narrow)]).contains("x 1 channels"));
        let mut cut = all[1].0.clone();
        cut.data.pop();
        assert!(error(&mut network, &[own, Agent::beside(&cut)]).contains("its size wants"));
        let unsure = Agent {
            confidence: Some(&[0.5; 3]),
            ..own
        };
        assert!(error(&mut network, &[own, unsure]).contains("the confidence of a BEV map has 3 numbers"));
    }
    let single = small(16, 32, false);
    let weights = Weights::new(&single, random_tensors(&single, 7)).unwrap();
    let mut network = Network::new(&single, &weights, NetworkOptions::default()).unwrap();
    let map = &crowd(&single)[0].0;
    let error = network.fuse(&[Agent::beside(map)]).unwrap_err().to_string();
    assert!(error.contains("fuses nothing"), "{error}");
}
