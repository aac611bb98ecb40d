//! The layers of a transformer from its weights.

use std::sync::Mutex;

use realo_kernels::cells::{Linear, packed};
use realo_kernels::conv::{Isa, Kernel, Packed};
use realo_kernels::math::product;
use realo_kernels::number::Number;
use realo_nn::weights::Weights;

use super::agents::OverAgents;
use super::blocks::Block;
use super::forward::Forward;
use super::kernel::{Delays, Round, Transformer};
use super::keys::{ENCODER, KINDS, agents_key, forward_key, windows_key};
use super::norm::Norm;
use super::settings::{Settings, Window};
use super::windows::{OverWindows, Split, Within};

impl<E: Number> Transformer<E> {
    /// `channels`: of the maps that are fused.
    pub fn new(settings: &Settings, channels: usize, weights: &Weights, isa: Isa) -> Self {
        let load = Load { weights, isa };
        let round = |depth: usize| {
            let block = |block: usize| Block {
                agents: load.agents(&agents_key(depth, block), settings, channels),
                windows: load.windows(&windows_key(depth, block), settings, channels),
            };
            let key = forward_key(depth);
            Round {
                blocks: (0..settings.blocks).map(block).collect(),
                forward: Forward {
                    norm: load.norm(&format!("{key}.norm")),
                    wide: load.linear(&format!("{key}.fn.net.0"), channels),
                    back: load.linear(&format!("{key}.fn.net.3"), settings.feed_forward),
                },
            }
        };
        Transformer {
            channels,
            windows: settings.windows.clone(),
            delays: load.delays(settings, channels),
            rounds: (0..settings.depth).map(round).collect(),
            room: Mutex::default(),
        }
    }
}

/// Reads layers from weights.
pub struct Load<'a> {
    pub weights: &'a Weights,
    pub isa: Isa,
}

impl Load<'_> {
    pub fn tensor(&self, key: &str) -> Vec<f32> {
        self.weights.tensor(key).to_vec()
    }

    fn norm(&self, key: &str) -> Norm {
        Norm {
            weight: self.tensor(&format!("{key}.weight")),
            bias: self.tensor(&format!("{key}.bias")),
        }
    }

    /// A layer of `[outputs, inputs]` and, if it has some, biases.
    pub fn numbers(&self, key: &str, inputs: usize) -> (Vec<f32>, Vec<f32>) {
        let weights = self.tensor(&format!("{key}.weight"));
        let bias = self.weights.find(&format!("{key}.bias"));
        let none = || vec![0.0; weights.len() / inputs];
        let bias = bias.map_or_else(none, <[f32]>::to_vec);
        (weights, bias)
    }

    fn packed<E: Kernel<f32>>(&self, (weights, bias): (Vec<f32>, Vec<f32>), inputs: usize) -> Linear<E> {
        packed(weights, bias, [inputs, 1], self.isa)
    }

    /// A layer that writes the numbers it reads.
    fn own<E: Kernel<E>>(&self, key: &str, inputs: usize) -> Packed<E> {
        let (weights, bias) = self.numbers(key, inputs);
        packed(weights, bias, [inputs, 1], self.isa)
    }

    fn linear<E: Kernel<f32>>(&self, key: &str, inputs: usize) -> Linear<E> {
        self.packed(self.numbers(key, inputs), inputs)
    }

    fn delays(&self, settings: &Settings, channels: usize) -> Delays {
        let key = format!("{ENCODER}.rte.emb");
        let table = self.tensor(&format!("{key}.emb.weight"));
        let (weights, bias) = self.numbers(&format!("{key}.lin"), channels);
        let row = |row: &[f32]| {
            let outputs = weights.chunks_exact(channels).zip(&bias);
            outputs.map(|(weights, bias)| product(weights, row) + bias).collect()
        };
        Delays {
            ratio: settings.delay_ratio,
            table: table.chunks_exact(channels).map(row).collect(),
        }
    }

    /// The layer for keys and values of a kind that is asked, as its relation to the kind that asks changes them.
    pub fn answers(
        &self,
        key: &str,
        settings: &Settings,
        channels: usize,
        [asks, asked]: [usize; 2],
    ) -> (Vec<f32>, Vec<f32>) {
        let (heads, width) = (settings.heads, settings.head_width);
        let size = heads * width * width;
        let answer = |part: &str, relation: &str, from_left: bool| {
            let layer = self.numbers(&format!("{key}.fn.{part}_linears.{asked}"), channels);
            let matrices = self.weights.tensor(&format!("{key}.fn.{relation}"));
            let matrices = &matrices[(asks * KINDS + asked) * size..][..size];
            related(&layer, matrices, [heads, width], from_left)
        };
        // q · (A k), and v M: a row of numbers times a matrix.
        let (mut weights, mut bias) = answer("k", "relation_att", false);
        let (of_values, bias_of_values) = answer("v", "relation_msg", true);
        weights.extend(of_values);
        bias.extend(bias_of_values);
        (weights, bias)
    }

    fn agents<E: Kernel<f32>>(&self, key: &str, settings: &Settings, channels: usize) -> OverAgents<E> {
        let linear = |part: &str, kind: usize| self.numbers(&format!("{key}.fn.{part}_linears.{kind}"), channels);
        let all = |part: &str| {
            (0..KINDS)
                .map(|kind| self.packed(linear(part, kind), channels))
                .collect()
        };
        let answer = |relation| self.packed(self.answers(key, settings, channels, relation), channels);
        let answers = |asks| (0..KINDS).map(|asked| answer([asks, asked])).collect();
        OverAgents {
            norm: self.norm(&format!("{key}.norm")),
            heads: settings.heads,
            queries: all("q"),
            answers: (0..KINDS).map(answers).collect(),
            outputs: all("a"),
        }
    }

    fn windows<E: Number>(&self, key: &str, settings: &Settings, channels: usize) -> OverWindows<E> {
        let within = |(index, window): (usize, &Window)| {
            let key = format!("{key}.fn.pwmsa.{index}");
            Within::new(
                *window,
                &self.tensor(&format!("{key}.pos_embedding")),
                self.linear(&format!("{key}.to_qkv"), channels),
                self.own(&format!("{key}.to_out.0"), window.width()),
            )
        };
        let split = format!("{key}.fn.split_attn");
        OverWindows {
            norm: self.norm(&format!("{key}.norm")),
            windows: settings.windows.iter().enumerate().map(within).collect(),
            split: Split {
                first: self.tensor(&format!("{split}.fc1.weight")),
                norm: self.norm(&format!("{split}.bn1")),
                second: self.tensor(&format!("{split}.fc2.weight")),
            },
        }
    }
}

/// A linear layer with a matrix for each head behind it: `matrix * out`, or `out * matrix` if `from_left`.
fn related(
    (weights, bias): &(Vec<f32>, Vec<f32>),
    matrices: &[f32],
    [heads, width]: [usize; 2],
    from_left: bool,
) -> (Vec<f32>, Vec<f32>) {
    let inputs = weights.len() / bias.len();
    let (mut made, mut made_bias) = (Vec::with_capacity(weights.len()), Vec::with_capacity(bias.len()));
    for head in 0..heads {
        let matrix = &matrices[head * width * width..][..width * width];
        for to in 0..width {
            let factor = |from: usize| match from_left {
                true => matrix[from * width + to],
                false => matrix[to * width + from],
            };
            let rows = || (0..width).map(|from| (head * width + from, f64::from(factor(from))));
            for input in 0..inputs {
                let terms = rows().map(|(row, factor)| f64::from(weights[row * inputs + input]) * factor);
                made.push(terms.sum::<f64>() as f32);
            }
            let terms = rows().map(|(row, factor)| f64::from(bias[row]) * factor);
            made_bias.push(terms.sum::<f64>() as f32);
        }
    }
    (made, made_bias)
}
