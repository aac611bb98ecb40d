//! The parts of fusions alone: of the transformer, and the gated unit of messages.

use realo_kernels::agents::Agent;
use realo_kernels::bev::BevView;
use realo_methods::network::NetworkOptions;
use realo_methods::v2vnet::{GatedUnit, GatedUnitTensors};
use realo_methods::v2xvit::{Asking, Parts, Settings, Window, initial_delays, numbers_of};

use crate::Kind;
use crate::fusion::{fusing, views};
use crate::network::{before, compare_map, options, weights_of, wide};
use crate::vector::{Tensors, Vector, compare};
use crate::warps::Maps;

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.x_blhwc", "in.dt", "out.y_blhwc", "param.emb.emb.weight"], delays),
    Kind::new(
        &[
            "in.x_blhwc",
            "in.mask_bhw1l",
            "in.prior_blhw3",
            "out.y_blhwc",
            "param.relation_att",
        ],
        over_agents,
    ),
    Kind::new(&["in.x_blhwc", "out.y_blhwc", "param.to_qkv.weight"], within_windows),
    Kind::new(&["in.w0", "out.y", "param.fc2.weight"], split_attention),
    Kind::new(
        &["in.x_blhwc", "out.y_blhwc", "param.pwmsa.0.to_qkv.weight"],
        over_windows,
    ),
    Kind::new(&["in.x", "out.y", "param.fn.net.0.weight"], feed_forward),
    Kind::new(&["in.x", "in.h", "out.h", "param.conv_gates.weight"], gated_unit),
];

const AGENTS: &str = "fusion_net.encoder.layers.0.0.layers.0.0.fn.";
const WINDOWS: &str = "fusion_net.encoder.layers.0.0.layers.0.1.fn.";
const FORWARD: &str = "fusion_net.encoder.layers.0.1.";
const DELAYS: &str = "fusion_net.encoder.rte.";

/// Settings with as little as can be of what a vector is not about.
fn smallest(channels: usize) -> Settings {
    Settings {
        agents: 1,
        compression: 0,
        compress_own: true,
        depth: 1,
        blocks: 1,
        heads: 1,
        head_width: channels,
        windows: vec![LEAST_WINDOW],
        feed_forward: 1,
        delays: 1,
        delay_ratio: 1,
    }
}

const LEAST_WINDOW: Window = Window {
    side: 1,
    heads: 1,
    head_width: 1,
};

/// The parts of a transformer on maps of a size, with the vector's weights where keys begin so.
fn parts(
    tensors: &Tensors,
    prefix: &str,
    settings: Settings,
    [rows, columns, channels]: [usize; 3],
) -> Result<Parts, String> {
    let model = fusing(before(rows, columns, channels)?, settings.clone().into())?;
    let weights = weights_of(&model, tensors, |key| key.strip_prefix(prefix))?;
    let NetworkOptions { isa, threads, .. } = options();
    Ok(Parts::new(&settings, channels, &weights, (isa, threads)))
}

/// A whole number of the case's configuration.
fn count(vector: &Vector, key: &str) -> Result<usize, String> {
    let counts: Vec<usize> = numbers_of(&serde_json::Value::Array(vec![vector.entry.config[key].clone()]))
        .map_err(|error| format!("config `{key}`: {error}"))?;
    Ok(counts[0])
}

/// What delays add to maps; and the table that training begins with.
fn delays(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let maps = Maps::read(&tensors, "in.x_blhwc")?;
    let [samples, agents, rows, columns, channels] = maps.shape;
    let table = tensors.shape("param.emb.emb.weight")?;
    let settings = Settings {
        delays: table.first().copied().unwrap_or_default(),
        delay_ratio: count(vector, "rte_ratio")?,
        ..smallest(channels)
    };
    let delays = tensors.shaped("in.dt", &[samples, agents])?;
    let mut parts = parts(&tensors, DELAYS, settings.clone(), [rows, columns, channels])?;
    let mut found = Vec::new();
    for (map, delay) in maps.views().zip(delays) {
        let agent = Agent {
            delay: delay as usize,
            ..Agent::beside(map)
        };
        found.extend(parts.delayed(&agent, Agent::beside(map)).data);
    }
    maps.compare(vector, &tensors, "out.y_blhwc", &found)?;
    if vector.entry.has("out.initial_table") {
        let expected = tensors.shaped("out.initial_table", &[settings.delays, channels])?;
        let found = wide(&initial_delays(settings.delays, channels));
        compare("out.initial_table", &found, &expected, vector.tolerance()?)?;
    }
    Ok(())
}

/// Attention over agents.
fn over_agents(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let maps = Maps::read(&tensors, "in.x_blhwc")?;
    let [samples, agents, rows, columns, channels] = maps.shape;
    let settings = Settings {
        heads: count(vector, "heads")?,
        head_width: count(vector, "dim_head")?,
        ..smallest(channels)
    };
    let mut parts = parts(&tensors, AGENTS, settings, [rows, columns, channels])?;
    let mask = tensors.shaped("in.mask_bhw1l", &[samples, rows, columns, 1, agents])?;
    let priors = tensors.shaped("in.prior_blhw3", &[samples, agents, rows, columns, 3])?;
    let cells = rows * columns;
    let views: Vec<BevView> = maps.views().collect();
    let mut found = Vec::new();
    for (sample, maps) in views.chunks_exact(agents).enumerate() {
        let covered: Vec<Vec<bool>> = (0..agents)
            .map(|agent| {
                let of_sample = &mask[sample * cells * agents..][..cells * agents];
                of_sample
                    .iter()
                    .skip(agent)
                    .step_by(agents)
                    .map(|one| *one != 0.0)
                    .collect()
            })
            .collect();
        let asking = maps.iter().zip(&covered).enumerate();
        let asking: Vec<Asking> = asking
            .map(|(agent, (map, covered))| Asking {
                map: *map,
                // The first cell says it for all.
                roadside: priors[(sample * agents + agent) * cells * 3 + 2] == 1.0,
                covered,
            })
            .collect();
        found.extend(parts.over_agents(&asking).into_iter().flat_map(|map| map.data));
    }
    maps.compare(vector, &tensors, "out.y_blhwc", &found)
}

/// What a part makes of each map, compared with `out.y_blhwc`.
fn each_map(
    vector: &Vector,
    tensors: &Tensors,
    maps: &Maps,
    mut part: impl FnMut(&BevView) -> Vec<f32>,
) -> Result<(), String> {
    let found: Vec<f32> = maps.views().flat_map(|map| part(&map)).collect();
    maps.compare(vector, tensors, "out.y_blhwc", &found)
}

/// Attention within windows of one size.
fn within_windows(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let maps = Maps::read(&tensors, "in.x_blhwc")?;
    let [_, _, rows, columns, channels] = maps.shape;
    let window = Window {
        side: count(vector, "window")?,
        heads: count(vector, "heads")?,
        head_width: count(vector, "dim_head")?,
    };
    let settings = Settings {
        windows: vec![window],
        ..smallest(channels)
    };
    let prefix = format!("{WINDOWS}pwmsa.0.");
    let mut parts = parts(&tensors, &prefix, settings, [rows, columns, channels])?;
    each_map(vector, &tensors, &maps, |map| parts.within_windows(0, map).data)
}

/// Attention within windows of several sizes, and how much each counts.
fn over_windows(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let maps = Maps::read(&tensors, "in.x_blhwc")?;
    let [_, _, rows, columns, channels] = maps.shape;
    let config = &vector.entry.config;
    let sizes = numbers_of(&config["windows"])?.into_iter();
    let windows = sizes
        .zip(numbers_of(&config["heads"])?)
        .zip(numbers_of(&config["dim_head"])?);
    let windows = windows.map(|((side, heads), head_width)| Window {
        side,
        heads,
        head_width,
    });
    let settings = Settings {
        windows: windows.collect(),
        ..smallest(channels)
    };
    let mut parts = parts(&tensors, WINDOWS, settings, [rows, columns, channels])?;
    each_map(vector, &tensors, &maps, |map| parts.over_windows(map).data)
}

/// How much each of several maps counts.
fn split_attention(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let names = (0..)
        .map(|index| format!("in.w{index}"))
        .take_while(|name| vector.entry.has(name));
    let made: Vec<Maps> = names
        .map(|name| Maps::read(&tensors, &name))
        .collect::<Result<_, _>>()?;
    let shape = made[0].shape;
    if let Some(other) = made.iter().find(|maps| maps.shape != shape) {
        return Err(format!("`in.w0` has shape {shape:?}, another one {:?}", other.shape));
    }
    let [_, _, rows, columns, channels] = shape;
    let settings = Settings {
        windows: vec![LEAST_WINDOW; made.len()],
        ..smallest(channels)
    };
    let prefix = format!("{WINDOWS}split_attn.");
    let mut parts = parts(&tensors, &prefix, settings, [rows, columns, channels])?;
    let made_views: Vec<Vec<BevView>> = made.iter().map(|maps| maps.views().collect()).collect();
    let mut found = Vec::new();
    for index in 0..made_views[0].len() {
        let maps: Vec<BevView> = made_views.iter().map(|views| views[index]).collect();
        found.extend(parts.split_attention(&maps).data);
    }
    made[0].compare(vector, &tensors, "out.y", &found)
}

/// Norm and feed-forward of cells, in whatever shape they lie.
fn feed_forward(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (shape, data) = (tensors.shape("in.x")?, tensors.singles("in.x")?);
    let channels = shape.last().copied().filter(|_| !data.is_empty());
    let channels = channels.ok_or_else(|| format!("`in.x` has shape {shape:?}, not sizes above 0"))?;
    let settings = Settings {
        feed_forward: tensors
            .shape("param.fn.net.0.weight")?
            .first()
            .copied()
            .unwrap_or_default(),
        ..smallest(channels)
    };
    let mut parts = parts(&tensors, FORWARD, settings, [1, 1, channels])?;
    let cells = BevView {
        rows: 1,
        columns: data.len() / channels,
        channels,
        data: &data,
    };
    let found = wide(&parts.feed_forward(&cells).data);
    compare("out.y", &found, &tensors.shaped("out.y", &shape)?, vector.tolerance()?)
}

/// One step of the gated unit, with a state.
fn gated_unit(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let (cells, [samples, inputs, rows, columns]) = tensors.channels_last("in.x")?;
    let (states, [_, channels, ..]) = tensors.channels_last("in.h")?;
    tensors.shaped("in.h", &[samples, channels, rows, columns])?;
    let kernel = tensors.shape("param.conv_gates.weight")?.last().copied();
    let kernel = kernel.filter(|kernel| [1, 3].contains(kernel));
    let kernel = kernel.ok_or("`param.conv_gates.weight`: expected kernels of 1x1 or 3x3")?;
    let layer = |name: &str, outputs: usize| -> Result<[Vec<f32>; 2], String> {
        let weights = format!("param.{name}.weight");
        tensors.shaped(&weights, &[outputs, inputs + channels, kernel, kernel])?;
        let bias = format!("param.{name}.bias");
        tensors.shaped(&bias, &[outputs])?;
        Ok([tensors.singles(&weights)?, tensors.singles(&bias)?])
    };
    let (gates, candidate) = (layer("conv_gates", 2 * channels)?, layer("conv_can", channels)?);
    let unit = GatedUnitTensors {
        inputs,
        channels,
        kernel,
        gates: [&gates[0], &gates[1]],
        candidate: [&candidate[0], &candidate[1]],
    };
    let mut unit = GatedUnit::new(&unit, options().isa, options().threads);
    let inputs = views(&cells, [rows, columns, inputs]);
    let pairs = inputs.into_iter().zip(views(&states, [rows, columns, channels]));
    let found: Vec<f32> = pairs.flat_map(|(input, state)| unit.run(input, state).data).collect();
    compare_map(vector, &tensors, "out.h", &found)
}
