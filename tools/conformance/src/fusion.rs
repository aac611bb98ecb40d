use realo_nn::arch::{Arch, Shared};
use realo_nn::fuse::{Placed, Warp};
use realo_nn::layers::Layers;
use realo_nn::model::{Model, Shrink};
use realo_nn::network::{BevMap, BevView, Section};
use realo_nn::pillars::Points;
use realo_nn::weights::Weights;
use realo_nn::{Pillarer, network::Network};
use serde_json::Value;

use crate::Kind;
use crate::network::{backbone_of, before, compare_map, network, options, weights_of};
use crate::reference::{grid_of, model_of};
use crate::vector::{Tensors, Vector};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.x", "in.record_len", "out.y"], of_maps).without(&["in.pairwise"]),
    Kind::new(&["in.x", "mid.encoded", "out.decoded"], compressor),
    Kind::new(&["in.points", "mid.fused", "out.psm", "out.rm"], whole)
        .without(&["in.prior_encoding", "in.pairwise_t_matrix"]),
];

/// A model that fuses up to as many agents as a vector has.
fn fusing(model: Model, arch: fn(Shared) -> Arch, agents: usize, compression: usize) -> Result<Model, String> {
    let arch = arch(Shared { agents, compression });
    let model = Model { arch, ..model };
    model.validate().map_err(|error| error.to_string())?;
    Ok(model)
}

/// The fusion of maps that lie alike, the first the ego's.
fn fused(network: &mut Network, maps: &[BevView]) -> Result<BevMap, String> {
    let others = maps[1..].iter().map(|map| Placed {
        map: *map,
        warp: Warp::IDENTITY,
    });
    let others: Vec<Placed> = others.collect();
    network.fuse(maps[0], &others).map_err(|error| error.to_string())
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

/// Fusions alone: by the maximum, or by attention where the case tells the width of features.
fn of_maps(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [maps, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let counts = agents(&tensors, "in.record_len", maps)?;
    let most = counts.iter().copied().max().unwrap_or(1);
    let mut model = before(rows, columns, channels)?;
    let arch: fn(Shared) -> Arch = match vector.entry.config.get("feature_dim").and_then(Value::as_u64) {
        Some(width) => {
            model.backbone.channels = vec![width as usize];
            Arch::AttFuse
        }
        None => Arch::FCooper,
    };
    let model = fusing(model, arch, most, 0)?;
    let mut network = network(&model, &weights_of(&model, &tensors, |_| None)?)?;
    let view = |data| BevView {
        rows,
        columns,
        channels,
        data,
    };
    let maps: Vec<BevView> = cells.chunks_exact(rows * columns * channels).map(view).collect();
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
    let (cells, [samples, channels, rows, columns]) = tensors.channels_last("in.x")?;
    let crossing = tensors.shape("mid.encoded")?[1];
    let model = fusing(
        before(rows, columns, channels)?,
        Arch::FCooper,
        1,
        channels / crossing.max(1),
    )?;
    let weights = weights_of(&model, &tensors, |key| key.strip_prefix("naive_compressor."))?;
    let layers = Layers::of(&model);
    let wide = layers.before(layers.features).ok_or("nothing is compressed")?;
    let section = |from, to| Section::new(&model, &weights, options(), [from, to]).map_err(|error| error.to_string());
    let (mut compress, mut restore) = (
        section(wide, layers.features)?,
        section(layers.features, layers.restored)?,
    );
    let (mut crossed, mut restored) = (Vec::new(), Vec::new());
    for data in cells.chunks_exact(cells.len() / samples.max(1)) {
        let map = BevView {
            rows,
            columns,
            channels,
            data,
        };
        let small = compress.run(map).map_err(|error| error.to_string())?;
        restored.extend(restore.run(&small).map_err(|error| error.to_string())?.data);
        crossed.extend(small.data);
    }
    compare_map(vector, &tensors, "mid.encoded", &crossed)?;
    compare_map(vector, &tensors, "out.decoded", &restored)
}

fn arch_of(config: &Value) -> Result<fn(Shared) -> Arch, String> {
    let kind = config["kind"].as_str().unwrap_or_default();
    match kind.split('_').next() {
        Some("fcooper") => Ok(Arch::FCooper),
        Some("attfuse") => Ok(Arch::AttFuse),
        _ => Err(format!("config `kind`: expected fcooper or attfuse, found `{kind}`")),
    }
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
    let model = fusing(model, arch_of(config)?, agents, compression)?;
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
    let fused = fused(&mut network, &views)?;
    compare_map(vector, &tensors, "mid.fused", &fused.data)?;
    let heads = network.heads(&fused).map_err(|error| error.to_string())?;
    compare_map(vector, &tensors, "out.psm", &heads.scores)?;
    compare_map(vector, &tensors, "out.rm", &heads.deltas)
}
