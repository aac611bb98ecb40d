//! Vectors of parts of fusions in other sizes than the reference's, made here from the definitions in double precision, one
//! number at a time.

mod common;

use common::{Made, noise, not_passed};
use realo_conformance::{Status, exit_code};
use serde_json::json;

/// `[outputs]` of weights `[outputs, inputs]` and, where there are some, biases.
fn linear(weights: &[f64], bias: &[f64], from: &[f64]) -> Vec<f64> {
    let outputs = weights.chunks(from.len()).enumerate();
    let sum = |weights: &[f64]| weights.iter().zip(from).map(|(a, b)| a * b).sum::<f64>();
    outputs
        .map(|(index, weights)| sum(weights) + bias.get(index).unwrap_or(&0.0))
        .collect()
}

fn softmax(scores: &[f64]) -> Vec<f64> {
    let sum: f64 = scores.iter().map(|score| libm::exp(*score)).sum();
    scores.iter().map(|score| libm::exp(*score) / sum).collect()
}

fn normed(from: &[f64], weight: &[f64], bias: &[f64]) -> Vec<f64> {
    let count = from.len() as f64;
    let mean = from.iter().sum::<f64>() / count;
    let variance = from.iter().map(|value| (value - mean) * (value - mean)).sum::<f64>() / count;
    let scaled = from.iter().map(|value| (value - mean) / (variance + 1e-5).sqrt());
    scaled
        .zip(weight.iter().zip(bias))
        .map(|(value, (weight, bias))| value * weight + bias)
        .collect()
}

fn sigmoid(value: f64) -> f64 {
    1.0 / (1.0 + libm::exp(-value))
}

fn delays(made: &mut Made) {
    let (cells, channels, rows) = (6, 4, 7);
    let (x, table) = (noise(3, 2 * cells * channels), noise(4, rows * channels));
    let (weights, bias) = (noise(5, channels * channels), noise(6, channels));
    let frames = [2, 1];
    let added = |agent: usize| linear(&weights, &bias, &table[3 * frames[agent] * channels..][..channels]);
    let y = x
        .iter()
        .enumerate()
        .map(|(index, x)| x + added(index / (cells * channels))[index % channels]);
    let shape = vec![1, 2, 2, 3, channels];
    let sine = |row: usize, k: usize| {
        let angle = row as f64 / if k < 2 { 1.0 } else { 100.0 };
        (if k.is_multiple_of(2) {
            libm::sin(angle)
        } else {
            libm::cos(angle)
        }) / 2.0
    };
    let initial = (0..rows).flat_map(|row| (0..channels).map(move |k| sine(row, k)));
    let tensors = [
        ("in.dt", vec![1, 2], frames.map(|frame| frame as f64).to_vec()),
        ("out.y_blhwc", shape.clone(), y.collect()),
        ("in.x_blhwc", shape, x.clone()),
        ("out.initial_table", vec![rows, channels], initial.collect()),
        ("param.emb.emb.weight", vec![rows, channels], table.clone()),
        ("param.emb.lin.weight", vec![channels, channels], weights.clone()),
        ("param.emb.lin.bias", vec![channels], bias.clone()),
    ];
    made.tensors(
        "t.safetensors",
        1e-5,
        json!({"rte_ratio": 3, "max_len": rows}),
        &tensors,
    );
}

fn over_agents(made: &mut Made) {
    let (agents, cells, heads, width) = (3, 4, 2, 3);
    let channels = heads * width;
    let kinds = [1, 0, 1];
    let x = noise(7, agents * cells * channels);
    let layers: Vec<(Vec<f64>, Vec<f64>)> = (0..8)
        .map(|layer| (noise(10 + layer, channels * channels), noise(20 + layer, channels)))
        .collect();
    // Keys, queries, values, outputs; by kind.
    let layer = |part: usize, kind: usize, from: &[f64]| {
        let (weights, bias) = &layers[2 * part + kind];
        linear(weights, bias, from)
    };
    let [att, msg] = [30, 31].map(|seed| noise(seed, 4 * heads * width * width));
    // Agent 1 cannot be asked in cell 2, agent 2 nowhere.
    let asked = |agent: usize, cell: usize| agent == 0 || (agent == 1 && cell != 2);
    let mut y = Vec::new();
    for asks in 0..agents {
        for cell in 0..cells {
            let at = |agent: usize| &x[(agent * cells + cell) * channels..][..channels];
            let query = layer(1, kinds[asks], at(asks));
            let mut sums = Vec::new();
            for head in 0..heads {
                let part = |all: &[f64]| all[head * width..][..width].to_vec();
                let relation = |agent: usize| ((kinds[asks] * 2 + kinds[agent]) * heads + head) * width * width;
                let there: Vec<usize> = (0..agents).filter(|agent| asked(*agent, cell)).collect();
                let score = |agent: &usize| -> f64 {
                    let key = linear(
                        &att[relation(*agent)..][..width * width],
                        &[],
                        &part(&layer(0, kinds[*agent], at(*agent))),
                    );
                    part(&query).iter().zip(key).map(|(a, b)| a * b).sum::<f64>() / (width as f64).sqrt()
                };
                let weights = softmax(&there.iter().map(score).collect::<Vec<_>>());
                sums.extend((0..width).map(|to| {
                    let value = |agent: usize| -> f64 {
                        let value = part(&layer(2, kinds[agent], at(agent)));
                        (0..width)
                            .map(|from| value[from] * msg[relation(agent) + from * width + to])
                            .sum()
                    };
                    there
                        .iter()
                        .zip(&weights)
                        .map(|(agent, weight)| weight * value(*agent))
                        .sum::<f64>()
                }));
            }
            y.extend(layer(3, kinds[asks], &sums));
        }
    }
    let mask = (0..cells)
        .flat_map(|cell| [0, 1, 2].map(|agent| f64::from(asked(agent, cell))))
        .collect();
    let prior = kinds
        .iter()
        .flat_map(|kind| [0.1, 2.0, *kind as f64].repeat(cells))
        .collect();
    let shape = vec![1, agents, 2, 2, channels];
    let mut tensors = vec![
        ("in.x_blhwc".to_string(), shape.clone(), x),
        ("in.mask_bhw1l".into(), vec![1, 2, 2, 1, agents], mask),
        ("in.prior_blhw3".into(), vec![1, agents, 2, 2, 3], prior),
        ("out.y_blhwc".into(), shape, y),
        ("param.relation_att".into(), vec![4, heads, width, width], att),
        ("param.relation_msg".into(), vec![4, heads, width, width], msg),
    ];
    for (index, (weights, bias)) in layers.into_iter().enumerate() {
        let key = format!("param.{}_linears.{}", ["k", "q", "v", "a"][index / 2], index % 2);
        tensors.push((format!("{key}.weight"), vec![channels, channels], weights));
        tensors.push((format!("{key}.bias"), vec![channels], bias));
    }
    let tensors: Vec<_> = tensors
        .iter()
        .map(|(name, shape, data)| (name.as_str(), shape.clone(), data.clone()))
        .collect();
    let config = json!({"dim": channels, "heads": heads, "dim_head": width, "types": 2});
    made.tensors("h.safetensors", 1e-5, config, &tensors);
}

/// Rows and columns of the maps under attention within windows, and their channels.
const MAP: [usize; 3] = [6, 3, 5];

/// The weights of attention within windows of a side, by heads of a width, and what it makes of a map.
struct Within {
    size: [usize; 3],
    weights: [Vec<f64>; 4],
}

impl Within {
    fn new(seed: u64, [side, heads, width]: [usize; 3]) -> Self {
        let (inner, channels) = (heads * width, MAP[2]);
        let counts = [
            (2 * side - 1) * (2 * side - 1),
            3 * inner * channels,
            channels * inner,
            channels,
        ];
        let weights = [0, 1, 2, 3].map(|k| noise(seed + k as u64, counts[k]));
        let size = [side, heads, width];
        Within { size, weights }
    }

    fn run(&self, map: &[f64]) -> Vec<f64> {
        let [side, heads, width] = self.size;
        let [positions, qkv, out, out_bias] = &self.weights;
        let [rows, columns, channels] = MAP;
        let all = |row: usize, column: usize| linear(qkv, &[], &map[(row * columns + column) * channels..][..channels]);
        let mut y = Vec::new();
        for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
            let [top, left] = [row, column].map(|at| at / side * side);
            let window: Vec<(usize, usize)> = (top..top + side)
                .flat_map(|r| (left..left + side).map(move |c| (r, c)))
                .collect();
            let query = all(row, column);
            let mut sums = Vec::new();
            for head in 0..heads {
                let part = |all: &[f64], which: usize| all[which * heads * width + head * width..][..width].to_vec();
                let score = |(r, c): &(usize, usize)| -> f64 {
                    let products = part(&query, 0)
                        .iter()
                        .zip(part(&all(*r, *c), 1))
                        .map(|(a, b)| a * b)
                        .sum::<f64>();
                    products / (width as f64).sqrt()
                        + positions[(r + side - 1 - row) * (2 * side - 1) + c + side - 1 - column]
                };
                let weights = softmax(&window.iter().map(score).collect::<Vec<_>>());
                sums.extend((0..width).map(|k| {
                    let value = |(r, c): &(usize, usize)| part(&all(*r, *c), 2)[k];
                    window
                        .iter()
                        .zip(&weights)
                        .map(|(at, weight)| weight * value(at))
                        .sum::<f64>()
                }));
            }
            y.extend(linear(out, out_bias, &sums));
        }
        y
    }

    fn tensors(&self, prefix: &str) -> Vec<(String, Vec<usize>, Vec<f64>)> {
        let [side, heads, width] = self.size;
        let (inner, channels, around) = (heads * width, MAP[2], 2 * side - 1);
        let shapes = [
            vec![around, around],
            vec![3 * inner, channels],
            vec![channels, inner],
            vec![channels],
        ];
        let names = ["pos_embedding", "to_qkv.weight", "to_out.0.weight", "to_out.0.bias"];
        let all = names.into_iter().zip(shapes).zip(self.weights.clone());
        all.map(|((name, shape), data)| (format!("param.{prefix}{name}"), shape, data))
            .collect()
    }
}

/// How much each of several maps counts: the weights, and the map that is made.
struct Split([Vec<f64>; 4]);

impl Split {
    fn new(seed: u64, maps: usize) -> Self {
        let channels = MAP[2];
        let counts = [channels * channels, channels, channels, maps * channels * channels];
        Split([0, 1, 2, 3].map(|k| noise(seed + k as u64, counts[k])))
    }

    fn run(&self, maps: &[Vec<f64>]) -> Vec<f64> {
        let [first, weight, bias, second] = &self.0;
        let channels = MAP[2];
        let cells = maps[0].len() / channels;
        let sum = |channel: usize| {
            maps.iter()
                .flat_map(|map| map.iter().skip(channel).step_by(channels))
                .sum::<f64>()
        };
        let mean: Vec<f64> = (0..channels).map(|channel| sum(channel) / cells as f64).collect();
        let hidden: Vec<f64> = normed(&linear(first, &[], &mean), weight, bias)
            .iter()
            .map(|v| v.max(0.0))
            .collect();
        let scores = linear(second, &[], &hidden);
        let counts = |channel: usize| {
            softmax(
                &scores
                    .iter()
                    .skip(channel)
                    .step_by(channels)
                    .copied()
                    .collect::<Vec<_>>(),
            )
        };
        let value = |index: usize| {
            let counts = counts(index % channels);
            maps.iter()
                .zip(counts)
                .map(|(map, count)| map[index] * count)
                .sum::<f64>()
        };
        (0..maps[0].len()).map(value).collect()
    }

    fn tensors(&self, prefix: &str) -> Vec<(String, Vec<usize>, Vec<f64>)> {
        let channels = MAP[2];
        let shapes = [
            vec![channels, channels],
            vec![channels],
            vec![channels],
            vec![self.0[3].len() / channels, channels],
        ];
        let names = ["fc1.weight", "bn1.weight", "bn1.bias", "fc2.weight"];
        let all = names.into_iter().zip(shapes).zip(self.0.clone());
        all.map(|((name, shape), data)| (format!("param.{prefix}{name}"), shape, data))
            .collect()
    }
}

fn windows(made: &mut Made) {
    let [rows, columns, channels] = MAP;
    let shape = || vec![1, 2, rows, columns, channels];
    let x = noise(40, 2 * rows * columns * channels);
    let maps: Vec<&[f64]> = x.chunks(rows * columns * channels).collect();
    let mut add = |file: &str, config, inputs: &[(&str, Vec<f64>)], output: (&str, Vec<f64>), params: Vec<_>| {
        let maps = inputs.iter().cloned().chain([output]);
        let maps = maps.map(|(name, data)| (name.to_string(), shape(), data));
        let tensors: Vec<(String, Vec<usize>, Vec<f64>)> = maps.chain(params).collect();
        let tensors: Vec<_> = tensors
            .iter()
            .map(|(name, shape, data)| (name.as_str(), shape.clone(), data.clone()))
            .collect();
        made.tensors(file, 1e-5, config, &tensors);
    };
    let within = [Within::new(50, [3, 2, 4]), Within::new(60, [1, 1, 2])];
    let split = Split::new(70, 2);
    let one: Vec<f64> = maps.iter().flat_map(|map| within[0].run(map)).collect();
    let config = json!({"dim": channels, "heads": 2, "dim_head": 4, "window": 3});
    add(
        "a.safetensors",
        config,
        &[("in.x_blhwc", x.clone())],
        ("out.y_blhwc", one),
        within[0].tensors(""),
    );
    let both = maps
        .iter()
        .flat_map(|map| split.run(&[within[0].run(map), within[1].run(map)]))
        .collect();
    let params = [
        within[0].tensors("pwmsa.0."),
        within[1].tensors("pwmsa.1."),
        split.tensors("split_attn."),
    ]
    .concat();
    let config = json!({"dim": channels, "heads": [2, 1], "dim_head": [4, 2], "windows": [3, 1]});
    add(
        "p.safetensors",
        config,
        &[("in.x_blhwc", x.clone())],
        ("out.y_blhwc", both),
        params,
    );
    let other = noise(41, x.len());
    let pairs = x.chunks(x.len() / 2).zip(other.chunks(x.len() / 2));
    let y = pairs.flat_map(|(a, b)| split.run(&[a.to_vec(), b.to_vec()])).collect();
    let inputs = [("in.w0", x.clone()), ("in.w1", other.clone())];
    add(
        "s.safetensors",
        json!({"dim": channels}),
        &inputs,
        ("out.y", y),
        split.tensors(""),
    );
}

fn feed_forward(made: &mut Made) {
    let (cells, channels, wide) = (7, 3, 11);
    let x = noise(80, cells * channels);
    let (weight, bias) = (noise(81, channels), noise(82, channels));
    let (first, first_bias) = (noise(83, wide * channels), noise(84, wide));
    let (second, second_bias) = (noise(85, channels * wide), noise(86, channels));
    let gelu = |value: f64| 0.5 * value * (1.0 + libm::erf(value / 2f64.sqrt()));
    let y = x.chunks(channels).flat_map(|cell| {
        let hidden = linear(&first, &first_bias, &normed(cell, &weight, &bias));
        linear(&second, &second_bias, &hidden.into_iter().map(gelu).collect::<Vec<_>>())
    });
    let tensors = [
        ("out.y", vec![cells, channels], y.collect()),
        ("in.x", vec![cells, channels], x.clone()),
        ("param.norm.weight", vec![channels], weight.clone()),
        ("param.norm.bias", vec![channels], bias.clone()),
        ("param.fn.net.0.weight", vec![wide, channels], first.clone()),
        ("param.fn.net.0.bias", vec![wide], first_bias.clone()),
        ("param.fn.net.3.weight", vec![channels, wide], second.clone()),
        ("param.fn.net.3.bias", vec![channels], second_bias.clone()),
    ];
    made.tensors("f.safetensors", 1e-5, json!({}), &tensors);
}

/// A convolution of 3x3 on `[channels, rows, columns]`, with zeros around.
fn convolved(weights: &[f64], bias: &[f64], map: &[f64], [rows, columns]: [usize; 2]) -> Vec<f64> {
    let (cells, inputs) = (rows * columns, map.len() / (rows * columns));
    let value = |output: usize, cell: usize| {
        let mut sum = bias[output];
        for (input, tap) in (0..inputs).flat_map(|input| (0..9).map(move |tap| (input, tap))) {
            let (row, column) = (cell / columns + tap / 3, cell % columns + tap % 3);
            if (1..=rows).contains(&row) && (1..=columns).contains(&column) {
                sum += weights[(output * inputs + input) * 9 + tap]
                    * map[input * cells + (row - 1) * columns + column - 1];
            }
        }
        sum
    };
    let all = (0..bias.len()).flat_map(|output| (0..cells).map(move |cell| (output, cell)));
    all.map(|(output, cell)| value(output, cell)).collect()
}

fn gated_unit(made: &mut Made) {
    let (samples, inputs, channels, size) = (2, 3, 2, [4, 3]);
    let cells = size[0] * size[1];
    let (x, h) = (
        noise(90, samples * inputs * cells),
        noise(91, samples * channels * cells),
    );
    let all = inputs + channels;
    let (gates, gates_bias) = (noise(92, 2 * channels * all * 9), noise(93, 2 * channels));
    let (can, can_bias) = (noise(94, channels * all * 9), noise(95, channels));
    let next = x
        .chunks(inputs * cells)
        .zip(h.chunks(channels * cells))
        .flat_map(|(x, h)| {
            let found = convolved(&gates, &gates_bias, &[x, h].concat(), size);
            let (reset, update) = found.split_at(channels * cells);
            let kept: Vec<f64> = reset.iter().zip(h).map(|(reset, h)| sigmoid(*reset) * h).collect();
            let candidate = convolved(&can, &can_bias, &[x, &kept].concat(), size);
            let of = |((update, candidate), h): ((&f64, f64), &f64)| {
                (1.0 - sigmoid(*update)) * h + sigmoid(*update) * libm::tanh(candidate)
            };
            update.iter().zip(candidate).zip(h).map(of).collect::<Vec<_>>()
        });
    let shape = |channels: usize| vec![samples, channels, size[0], size[1]];
    let tensors = [
        ("out.h", shape(channels), next.collect()),
        ("in.x", shape(inputs), x.clone()),
        ("in.h", shape(channels), h.clone()),
        ("param.conv_gates.weight", vec![2 * channels, all, 3, 3], gates.clone()),
        ("param.conv_gates.bias", vec![2 * channels], gates_bias.clone()),
        ("param.conv_can.weight", vec![channels, all, 3, 3], can.clone()),
        ("param.conv_can.bias", vec![channels], can_bias.clone()),
    ];
    made.tensors("g.safetensors", 1e-5, json!({}), &tensors);
}

fn all(wrong: bool) -> Made {
    let mut made = Made {
        wrong,
        ..Made::default()
    };
    let makers = [delays, over_agents, windows, feed_forward, gated_unit];
    makers.iter().for_each(|make| make(&mut made));
    made
}

#[test]
fn other_sizes_pass() {
    let results = all(false).run();
    assert_eq!(results.len(), 7);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

#[test]
fn a_wrong_number_fails_every_one() {
    for result in all(true).run() {
        assert!(matches!(result.status, Status::Failed(_)), "{result}");
    }
}
