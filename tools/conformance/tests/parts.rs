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

/// A 4x4 matrix that turns by an angle and shifts.
fn matrix(angle: f64, [x, y]: [f64; 2]) -> Vec<f64> {
    let (sin, cos) = libm::sincos(angle);
    [
        [cos, -sin, 0.0, x],
        [sin, cos, 0.0, y],
        [0.0, 0.0, 1.0, 0.3],
        [0.0, 0.0, 0.0, 1.0],
    ]
    .concat()
}

/// Where a cell of the ego's is in the map that a matrix moves, about `middle`, with cells of 1 m.
fn source(matrix: &[f64], middle: [f64; 2], [column, row]: [usize; 2]) -> [f64; 2] {
    let [x, y] = [
        column as f64 - middle[0] - matrix[3],
        row as f64 - middle[1] - matrix[7],
    ];
    // A turn's inverse is its transpose.
    [
        matrix[0] * x + matrix[4] * y + middle[0],
        matrix[1] * x + matrix[5] * y + middle[1],
    ]
}

const CELL: [(&str, f64); 2] = [("discrete_ratio", 0.5), ("downsample_rate", 2.0)];
const ROWS: usize = 5;
const COLUMNS: usize = 9;
const MIDDLE: [f64; 2] = [COLUMNS as f64 / 2.0, ROWS as f64 / 2.0];

fn moves() -> [Vec<f64>; 3] {
    [
        matrix(0.0, [0.0, 0.0]),
        matrix(0.3, [1.23, -0.71]),
        matrix(-1.1, [-2.3, 0.37]),
    ]
}

/// `at(column, row)` of a map, moved: bilinear, zeros outside.
fn moved(matrix: &[f64], middle: [f64; 2], at: impl Fn(usize, usize) -> f64) -> Vec<f64> {
    let value = |index: usize| {
        let [x, y] = source(matrix, middle, [index % COLUMNS, index / COLUMNS]);
        let mut sum = 0.0;
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let weight = |distance: f64| (1.0 - distance.abs()).max(0.0);
                sum += weight(x - column as f64) * weight(y - row as f64) * at(column, row);
            }
        }
        sum
    };
    (0..ROWS * COLUMNS).map(value).collect()
}

fn nearest(matrix: &[f64], index: usize) -> Option<[usize; 2]> {
    let at = source(matrix, MIDDLE, [index % COLUMNS, index / COLUMNS]).map(f64::round);
    let inside = (0.0..COLUMNS as f64).contains(&at[0]) && (0.0..ROWS as f64).contains(&at[1]);
    inside.then(|| at.map(|index| index as usize))
}

fn warps(made: &mut Made) {
    let (cells, channels) = (ROWS * COLUMNS, 2);
    let x = noise(1, 3 * channels * cells);
    let plane = |map: usize, channel: usize| &x[(map * channels + channel) * cells..][..cells];
    let planes = || (0..3).flat_map(|map| (0..channels).map(move |channel| (map, channel)));
    let bilinear = |middle: [f64; 2]| -> Vec<f64> {
        let of = |(map, channel): (usize, usize)| {
            moved(moves()[map].as_slice(), middle, |column, row| {
                plane(map, channel)[row * COLUMNS + column]
            })
        };
        planes().flat_map(of).collect()
    };
    let near = planes().flat_map(|(map, channel): (usize, usize)| {
        let value = move |index| {
            nearest(moves()[map].as_slice(), index).map_or(0.0, |[c, r]| plane(map, channel)[r * COLUMNS + c])
        };
        (0..cells).map(value)
    });
    let region = (0..3)
        .flat_map(|map| (0..cells).map(move |index| f64::from(nearest(moves()[map].as_slice(), index).is_some())));
    let shape = vec![3, channels, ROWS, COLUMNS];
    let tensors = [
        ("in.matrices", vec![1, 3, 4, 4], moves().concat()),
        ("in.x", shape.clone(), x.clone()),
        ("out.warp_bilinear", shape.clone(), bilinear(MIDDLE)),
        ("out.warp_bilinear_uncentered", shape.clone(), bilinear([0.0; 2])),
        ("out.warp_nearest", shape, near.collect()),
        ("out.roi_mask", vec![1, 3, 1, ROWS, COLUMNS], region.collect()),
    ];
    made.tensors(
        "w.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
}

fn regions(made: &mut Made) {
    let there = [1.0, 1.0, 0.0, 1.0, 0.0, 1.0];
    let cells = (0..2).flat_map(|sample| (0..ROWS * COLUMNS).map(move |cell| (sample, cell)));
    let mask = cells.flat_map(|(sample, cell)| {
        [0, 1, 2].map(|agent| there[3 * sample + agent] * f64::from(nearest(moves()[agent].as_slice(), cell).is_some()))
    });
    let tensors = [
        ("in.agent_mask", vec![2, 3], there.to_vec()),
        (
            "in.matrices",
            vec![2, 3, 4, 4],
            [moves().concat(), moves().concat()].concat(),
        ),
        ("out.mask_bhw1l", vec![2, ROWS, COLUMNS, 1, 3], mask.collect()),
    ];
    made.tensors(
        "r.safetensors",
        0.0,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
}

fn corrected(made: &mut Made) {
    let (cells, channels) = (ROWS * COLUMNS, 3);
    let x = noise(2, 3 * cells * channels);
    let mut y = x.clone();
    for agent in 1..3 {
        for channel in 0..channels {
            let at = |column, row| x[(agent * cells + row * COLUMNS + column) * channels + channel];
            let found = moved(moves()[agent].as_slice(), MIDDLE, at);
            found
                .iter()
                .enumerate()
                .for_each(|(cell, value)| y[(agent * cells + cell) * channels + channel] = *value);
        }
    }
    let shape = vec![1, 3, ROWS, COLUMNS, channels];
    // The first matrix is not the identity: the ego's map stays all the same.
    let matrices = [matrix(0.5, [1.0, 1.0]), moves()[1].clone(), moves()[2].clone()].concat();
    let tensors = [
        ("in.x_blhwc", shape.clone(), x),
        ("in.matrices", vec![1, 3, 4, 4], matrices),
        ("out.y_blhwc", shape, y),
    ];
    made.tensors(
        "c.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
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

/// By `numpy.random.seed(0)` and six of `numpy.random.standard_normal`; with a delay of 2.5 frames.
fn pose_noise(made: &mut Made) {
    let draws = [
        1.764052345967664,
        0.4001572083672233,
        0.9787379841057392,
        2.240893199201458,
        1.8675579901499675,
        -0.977277879876411,
    ];
    let [a, b, c, roll, yaw, pitch] = draws.map(|draw| draw * 0.3);
    let noisy = [
        -4.0 + a,
        2.0 + b,
        c,
        1.0,
        170.0 + yaw + if made.wrong { 0.01 } else { 0.0 },
        3.0,
    ];
    let case = json!({"seed": 0, "xyz_std": 0.3, "ryp_std": 0.3, "pose": [-4.0, 2.0, 0.0, 1.0, 170.0, 3.0],
        "noisy_pose": noisy, "xyz_draw": [a, b, c], "ryp_draw": [roll, yaw, pitch]});
    let delay = json!({"overhead_ms": 250, "delay_frames": 2, "ego": 0});
    let document = json!({"localisation": [case], "delay_sim": [delay]});
    made.contents.insert("n.json".into(), document.to_string().into_bytes());
    let keys = ["delay_sim", "localisation"];
    made.files
        .push(json!({"file": "n.json", "tolerance": 1e-12, "config": {}, "keys": keys}));
}

fn all(wrong: bool) -> Made {
    let mut made = Made {
        wrong,
        ..Made::default()
    };
    let makers = [
        warps,
        regions,
        corrected,
        delays,
        over_agents,
        windows,
        feed_forward,
        gated_unit,
        pose_noise,
    ];
    makers.iter().for_each(|make| make(&mut made));
    made
}

#[test]
fn other_sizes_pass() {
    let results = all(false).run();
    assert_eq!(results.len(), 11);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

#[test]
fn a_wrong_number_fails_every_one() {
    for result in all(true).run() {
        assert!(matches!(result.status, Status::Failed(_)), "{result}");
    }
}

/// Vectors whose shapes do not fit each other are failures with the tensor's name.
#[test]
fn shapes_that_do_not_fit_fail_by_name() {
    let mut made = Made::default();
    let x = ("in.x_blhwc", vec![1, 2, 4, 4, 3], noise(1, 96));
    let y = ("out.y_blhwc", vec![1, 2, 4, 4, 3], noise(1, 96));
    let few = ("in.matrices", vec![1, 1, 4, 4], moves()[0].clone());
    made.tensors(
        "few.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &[x.clone(), y.clone(), few],
    );
    let flat = ("in.x_blhwc", vec![1, 2, 0, 4, 3], vec![]);
    let matrices = ("in.matrices", vec![1, 2, 4, 4], moves()[..2].concat());
    made.tensors(
        "none.safetensors",
        1e-6,
        json!({"discrete_ratio": 1, "downsample_rate": 1}),
        &[flat, y.clone(), matrices],
    );
    let mask = ("in.mask_bhw1l", vec![1, 4, 4, 1, 1], vec![1.0; 16]);
    let prior = ("in.prior_blhw3", vec![1, 2, 4, 4, 3], vec![0.0; 96]);
    let att = ("param.relation_att", vec![4, 1, 3, 3], noise(1, 36));
    made.tensors(
        "mask.safetensors",
        1e-6,
        json!({"heads": 1, "dim_head": 3}),
        &[x, y, mask, prior, att],
    );
    let results = made.run();
    for (result, named) in results.iter().zip(["`in.matrices`", "`in.x_blhwc`", "param."]) {
        let Status::Failed(reason) = &result.status else {
            panic!("{result}");
        };
        assert!(reason.contains(named), "{result}");
    }
}
