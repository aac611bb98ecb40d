use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::warp::Warp;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::detect::pillars::Points;
use realo_methods::network::Network;
use realo_methods::network::Section;
use realo_methods::{Arch, fcooper, methods};
use realo_nn::layers::Layers;
use realo_nn::model::Sharing;
use realo_nn::model::Shrink;
use realo_nn::weights::Weights;
use serde_json::Value;

use crate::Kind;
use crate::network::{backbone_of, before, compare_map, network, options, weights_of, wide};
use crate::reference::{cell_of, centered, grid_of, model_of, moved};
use crate::vector::{Tensors, Vector, compare};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.x", "in.record_len", "out.y"], of_maps).without(&["in.pairwise"]),
    Kind::new(&["in.x", "mid.encoded", "out.decoded"], compressor),
    Kind::new(&["in.x", "in.record_len", "in.pairwise", "out.y"], messages),
    Kind::new(&["in.points", "mid.fused", "out.psm", "out.rm"], whole),
    Kind::new(
        &["in.x_blhwc3", "in.agent_mask", "in.matrices", "out.y_bhwc"],
        transformer,
    ),
];

/// A model that fuses up to as many agents as a vector has.
pub(crate) fn fusing(model: Model, arch: Arch) -> Result<Model, String> {
    let model = Model { arch, ..model };
    model.validate().map_err(|error| error.to_string())?;
    Ok(model)
}

/// The fusion of maps that lie alike, the first the ego's.
fn fused(network: &mut Network, maps: &[BevView]) -> Result<BevMap, String> {
    let agents: Vec<Agent> = maps.iter().copied().map(Agent::beside).collect();
    network.fuse(&agents).map_err(|error| error.to_string())
}

/// Maps of one size that lie behind each other.
pub(crate) fn views(cells: &[f32], [rows, columns, channels]: [usize; 3]) -> Vec<BevView<'_>> {
    let view = |data| BevView {
        rows,
        columns,
        channels,
        data,
    };
    cells.chunks_exact(rows * columns * channels).map(view).collect()
}

/// How many agents each sample has.
fn agents(tensors: &Tensors, name: &str, all: usize) -> Result<Vec<usize>, String> {
    let counts: Vec<usize> = tensors.numbers(name)?.iter().map(|count| *count as usize).collect();
    match counts.iter().sum::<usize>() == all && !counts.contains(&0) {
        true => Ok(counts),
        false => Err(format!(
            "`{name}`: expected numbers of agents that sum up to {all}, found {counts:?}"
        )),
    }
}

/// Fusions alone: by the maximum, or by attention where the case has the width of features.
fn of_maps(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [maps, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let counts = agents(&tensors, "in.record_len", maps)?;
    let most = counts.iter().copied().max().unwrap_or(1);
    let mut model = before(rows, columns, channels)?;
    if let Some(width) = vector.entry.config.get("feature_dim").and_then(Value::as_u64) {
        model.backbone.channels = vec![width as usize];
    }
    let shared = Sharing {
        agents: most,
        ..Sharing::default()
    };
    let model = fusing(model, arch_of(&vector.entry.config, shared)?)?;
    let mut network = network(
        &model,
        &weights_of(&model, &tensors, |key| key.strip_prefix("fusion_net."))?,
    )?;
    let maps = views(&cells, [rows, columns, channels]);
    let (mut left, mut found) = (&maps[..], Vec::new());
    for count in counts {
        let (sample, rest) = left.split_at(count);
        found.extend(fused(&mut network, sample)?.data);
        left = rest;
    }
    compare_map(vector, &tensors, "out.y", &found)
}

/// The learned compressor: what crosses, and what is had back.
fn compressor(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [_, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let crossing = tensors.shape("mid.encoded")?[1];
    let arch = fcooper::Settings(Sharing {
        agents: 1,
        compression: channels / crossing.max(1),
        ..Sharing::default()
    });
    let model = fusing(before(rows, columns, channels)?, arch.into())?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("naive_compressor."))?;
    let layers = Layers::of(&model);
    let wide = layers.before(layers.features).ok_or("nothing is compressed")?;
    let section = |from, to| Section::new(&model, &weights, options(), [from, to]).map_err(|error| error.to_string());
    let (mut compress, mut restore) = (
        section(wide, layers.features)?,
        section(layers.features, layers.restored)?,
    );
    let (mut crossed, mut restored) = (Vec::new(), Vec::new());
    for map in views(&cells, [rows, columns, channels]) {
        let small = compress.run(map).map_err(|error| error.to_string())?;
        restored.extend(restore.run(&small).map_err(|error| error.to_string())?.data);
        crossed.extend(small.data);
    }
    compare_map(vector, &tensors, "mid.encoded", &crossed)?;
    compare_map(vector, &tensors, "out.decoded", &restored)
}

/// The method that a vector's configuration describes.
fn arch_of(config: &Value, shared: Sharing) -> Result<Arch, String> {
    let known = methods();
    let mut described = known.iter().filter_map(|method| method.of_reference(config, shared));
    match described.next() {
        Some(method) => Ok(method?.into()),
        None => {
            let names: Vec<&str> = known.iter().map(|method| method.name).collect();
            let kind = &config["kind"];
            Err(format!(
                "config `kind`: expected one of {}, found {kind}",
                names.join(", ")
            ))
        }
    }
}

/// Agents whose maps are moved into the ego's, the first one's, by a matrix each.
fn paired<'a>(maps: &[BevView<'a>], matrices: &[f64], most: usize, cell: f64) -> Vec<Agent<'a>> {
    let agent = |(index, map): (usize, &BevView<'a>)| Agent {
        // `[from, to, 4, 4]`.
        warp: moved(&matrices[16 * most * index..][..16], cell).inverse(),
        ..Agent::beside(*map)
    };
    maps.iter().enumerate().map(agent).collect()
}

/// The fusion by messages alone.
fn messages(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [maps, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let counts = agents(&tensors, "in.record_len", maps)?;
    let most = tensors.shape("in.pairwise")?[1];
    let shared = Sharing {
        agents: most,
        ..Sharing::default()
    };
    let arch = arch_of(&vector.entry.config, shared)?;
    let model = fusing(before(rows, columns, channels)?, arch)?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("fusion_net."))?;
    let mut network = network(&model, &weights)?;
    let cell = cell_of(&vector.entry.config)?;
    let matrices = tensors.numbers("in.pairwise")?;
    let maps = views(&cells, [rows, columns, channels]);
    let (mut left, mut found) = (&maps[..], Vec::new());
    for (count, matrices) in counts.into_iter().zip(matrices.chunks_exact(16 * most * most)) {
        let (sample, rest) = left.split_at(count);
        left = rest;
        let agents = paired(sample, matrices, most, cell);
        found.extend(network.fuse(&agents).map_err(|error| error.to_string())?.data);
    }
    compare_map(vector, &tensors, "out.y", &found)
}

/// Agents with what their prior says (velocity, delay, roadside) and how their maps are corrected; the ego's is not.
fn agents_of<'a>(maps: &[BevView<'a>], priors: &[[f64; 3]], matrices: &[f64], cell: f64) -> Vec<Agent<'a>> {
    let agent = |(index, map): (usize, &BevView<'a>)| {
        let [_, delay, roadside] = priors[index];
        let matrix = &matrices[16 * index..][..16];
        Agent {
            confidence: None,
            map: *map,
            warp: match index {
                0 => Warp::IDENTITY,
                _ => centered(matrix, cell, [map.rows, map.columns]).inverse(),
            },
            roadside: roadside == 1.0,
            delay: delay as usize,
        }
    };
    maps.iter().enumerate().map(agent).collect()
}

/// The transformer alone, on samples whose maps carry their priors as channels.
fn transformer(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let shape = tensors.shape("in.x_blhwc3")?;
    let [_, most, rows, columns, all] = shape[..] else {
        return Err(format!("`in.x_blhwc3` has shape {shape:?}, not five sizes"));
    };
    let channels = all - 3;
    let shared = Sharing {
        agents: most,
        ..Sharing::default()
    };
    let arch = arch_of(&vector.entry.config, shared)?;
    let model = fusing(before(rows, columns, channels)?, arch)?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("fusion_net."))?;
    let mut network = network(&model, &weights)?;
    let (cells, matrices) = (tensors.singles("in.x_blhwc3")?, tensors.numbers("in.matrices")?);
    let mask = tensors.numbers("in.agent_mask")?;
    let mut found = Vec::new();
    let samples = cells
        .chunks_exact(most * rows * columns * all)
        .zip(matrices.chunks_exact(most * 16));
    for ((cells, matrices), mask) in samples.zip(mask.chunks_exact(most)) {
        let there = mask.iter().take_while(|there| **there == 1.0).count();
        let maps: Vec<&[f32]> = cells.chunks_exact(rows * columns * all).take(there).collect();
        let prior = |map: &&[f32]| [0, 1, 2].map(|k| f64::from(map[channels + k]));
        let priors: Vec<[f64; 3]> = maps.iter().map(prior).collect();
        let features = |map: &&[f32]| BevMap {
            rows,
            columns,
            channels,
            data: map
                .chunks_exact(all)
                .flat_map(|cell| &cell[..channels])
                .copied()
                .collect(),
        };
        let maps: Vec<BevMap> = maps.iter().map(features).collect();
        let views: Vec<BevView> = maps.iter().map(BevView::from).collect();
        let agents = agents_of(&views, &priors, matrices, cell_of(&vector.entry.config["sttf"])?);
        found.extend(network.fuse(&agents).map_err(|error| error.to_string())?.data);
    }
    let expected = tensors.numbers("out.y_bhwc")?;
    compare("out.y_bhwc", &wide(&found), &expected, vector.tolerance()?)
}

/// The model and weights of a whole network's case.
fn model(vector: &Vector, tensors: &Tensors) -> Result<(Model, Weights), String> {
    let config = &vector.entry.config;
    let channels = tensors.numbers("param.pillar_vfe.pfn_layers.0.norm.bias")?.len();
    let mut model = model_of(
        grid_of(vector.setting("range")?),
        channels,
        backbone_of(&config["backbone"])?,
    )?;
    let mut names = tensors.names("param.shrink_conv.layers.0.double_conv.")?;
    names.retain(|name| name.ends_with(".weight"));
    for name in names {
        let [channels, _, kernel, _] = tensors.shape(&name)?[..] else {
            return Err(format!("`{name}` has not four sizes"));
        };
        model.shrink.push(Shrink { kernel, channels });
    }
    let agents = tensors.numbers("in.points_per_agent")?.len();
    let compression = vector.number("compression")? as usize;
    let sharing = Sharing {
        agents,
        compression,
        ..Sharing::default()
    };
    let arch = arch_of(config, sharing)?;
    let model = fusing(model, arch)?;
    let weights = weights_of(&model, tensors, |key| Some(key))?;
    Ok((model, weights))
}

/// A whole network, from the points of several agents on.
fn whole(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (model, weights) = model(vector, &tensors)?;
    let mut network = network(&model, &weights)?;
    let mut pillarer = Pillarer::new(&model, &weights);
    let points = tensors.rows::<4>("in.points")?;
    let mut left = &points[..];
    let mut maps = Vec::new();
    for count in agents(&tensors, "in.points_per_agent", points.len())? {
        let (own, rest) = left.split_at(count);
        left = rest;
        let [x, y, z, intensity] = &[0, 1, 2, 3].map(|axis| own.iter().map(|p| p[axis] as f32).collect::<Vec<_>>());
        let intensity = Some(&intensity[..]);
        let (canvas, _) = pillarer.run(&Points { x, y, z, intensity });
        maps.push(network.encode(canvas).map_err(|error| error.to_string())?);
    }
    if vector.entry.has("mid.encoded") {
        let crossed: Vec<f32> = maps.iter().flat_map(|map| map.data.iter().copied()).collect();
        compare_map(vector, &tensors, "mid.encoded", &crossed)?;
    }
    let views: Vec<BevView> = maps.iter().map(BevView::from).collect();
    let config = &vector.entry.config;
    let fusing = if vector.entry.has("in.prior_encoding") {
        let matrices = tensors.numbers("in.spatial_correction_matrix")?;
        let priors = tensors.numbers("in.prior_encoding")?;
        let cell = cell_of(&config["transformer"]["sttf"])?;
        agents_of(&views, priors.as_chunks::<3>().0, &matrices, cell)
    } else if vector.entry.has("in.pairwise_t_matrix") {
        let most = tensors.shape("in.pairwise_t_matrix")?[1];
        let matrices = tensors.numbers("in.pairwise_t_matrix")?;
        paired(&views, &matrices, most, cell_of(&config["v2vfusion"])?)
    } else {
        views.iter().copied().map(Agent::beside).collect()
    };
    let fused = network.fuse(&fusing).map_err(|error| error.to_string())?;
    // The transformer's has its channels last.
    match vector.entry.has("in.prior_encoding") {
        false => compare_map(vector, &tensors, "mid.fused", &fused.data)?,
        true => {
            let expected = tensors.numbers("mid.fused")?;
            compare("mid.fused", &wide(&fused.data), &expected, vector.tolerance()?)?;
        }
    }
    let heads = network.heads(&fused).map_err(|error| error.to_string())?;
    compare_map(vector, &tensors, "out.psm", &heads.scores)?;
    compare_map(vector, &tensors, "out.rm", &heads.deltas)
}
