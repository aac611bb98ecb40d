//! The tensors of a transformer: their names and shapes, and the layers that are made of them.

use std::sync::Mutex;

use super::agents::OverAgents;
use super::blocks::Block;
use super::windows::{OverWindows, Split, Within};
use super::{Delays, Forward, KINDS, Norm, Round, Transformer};
use crate::arch::{Transformer as Settings, Window};
use crate::cells::{Linear, Specs, packed};
use crate::conv::{Isa, Kernel, Packed};
use crate::layers::{Role, TensorSpec};
use crate::math::product;
use crate::part::Number;
use crate::weights::Weights;

/// Key of the whole transformer.
pub const ENCODER: &str = "fusion_net.encoder";
/// The slowest sine of the first table of delays has this many times the period of the fastest.
const PERIODS: f64 = 1e4;

/// The table of delays that training begins with, `[delays, channels]`: sines and cosines in turn, slower from pair to pair.
pub fn initial_delays(delays: usize, channels: usize) -> Vec<f32> {
    let of = |delay: usize, channel: usize| {
        let pair = (channel - channel % 2) as f64;
        let angle = delay as f64 * libm::exp(-pair * libm::log(PERIODS) / channels as f64);
        let wave = if channel.is_multiple_of(2) {
            libm::sin(angle)
        } else {
            libm::cos(angle)
        };
        (wave / (channels as f64).sqrt()) as f32
    };
    let all = (0..delays).flat_map(|delay| (0..channels).map(move |channel| (delay, channel)));
    all.map(|(delay, channel)| of(delay, channel)).collect()
}

/// Key of an attention over agents: its norm, and under `fn` its layers.
pub fn agents_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.0")
}

/// Key of an attention within windows: its norm, and under `fn` its layers.
pub fn windows_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.1")
}

/// Key of a feed-forward: its norm, and under `fn` its layers.
pub fn forward_key(depth: usize) -> String {
    format!("{ENCODER}.layers.{depth}.1")
}

/// The tensors of a transformer on maps of so many channels, in the order of the state dict.
pub(crate) fn tensors(settings: &Settings, channels: usize) -> Vec<TensorSpec> {
    let mut all = Specs(Vec::new());
    // Stored by the reference, and never used.
    all.linear(&format!("{ENCODER}.prior_feed"), channels + 3, channels, true);
    for depth in 0..settings.depth {
        for block in 0..settings.blocks {
            all.agents(&agents_key(depth, block), settings, channels);
            all.windows(&windows_key(depth, block), settings, channels);
        }
        let key = forward_key(depth);
        all.norm(&format!("{key}.norm"), channels);
        all.linear(&format!("{key}.fn.net.0"), channels, settings.feed_forward, true);
        all.linear(&format!("{key}.fn.net.3"), settings.feed_forward, channels, true);
    }
    let key = format!("{ENCODER}.rte.emb");
    all.push(
        format!("{key}.emb.weight"),
        vec![settings.delays, channels],
        Role::Delays,
    );
    all.linear(&format!("{key}.lin"), channels, channels, true);
    all.0
}

impl Specs {
    fn agents(&mut self, key: &str, settings: &Settings, channels: usize) {
        self.norm(&format!("{key}.norm"), channels);
        let (heads, width) = (settings.heads, settings.head_width);
        for relation in ["relation_att", "relation_msg"] {
            let shape = vec![KINDS * KINDS, heads, width, width];
            self.weight(&format!("{key}.fn.{relation}"), shape, width);
        }
        for part in ["k", "q", "v", "a"] {
            for kind in 0..KINDS {
                self.linear(&format!("{key}.fn.{part}_linears.{kind}"), channels, channels, true);
            }
        }
    }

    fn windows(&mut self, key: &str, settings: &Settings, channels: usize) {
        self.norm(&format!("{key}.norm"), channels);
        for (index, window) in settings.windows.iter().enumerate() {
            let key = format!("{key}.fn.pwmsa.{index}");
            let side = 2 * window.side - 1;
            self.weight(&format!("{key}.pos_embedding"), vec![side, side], 1);
            self.linear(&format!("{key}.to_qkv"), channels, 3 * window.width(), false);
            self.linear(&format!("{key}.to_out.0"), window.width(), channels, true);
        }
        let key = format!("{key}.fn.split_attn");
        self.linear(&format!("{key}.fc1"), channels, channels, false);
        self.norm(&format!("{key}.bn1"), channels);
        self.linear(
            &format!("{key}.fc2"),
            channels,
            settings.windows.len() * channels,
            false,
        );
    }
}

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
struct Load<'a> {
    weights: &'a Weights,
    isa: Isa,
}

impl Load<'_> {
    fn tensor(&self, key: &str) -> Vec<f32> {
        self.weights.tensor(key).to_vec()
    }

    fn norm(&self, key: &str) -> Norm {
        Norm {
            weight: self.tensor(&format!("{key}.weight")),
            bias: self.tensor(&format!("{key}.bias")),
        }
    }

    /// A layer of `[outputs, inputs]` and, if it has some, biases.
    fn numbers(&self, key: &str, inputs: usize) -> (Vec<f32>, Vec<f32>) {
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

    fn agents<E: Kernel<f32>>(&self, key: &str, settings: &Settings, channels: usize) -> OverAgents<E> {
        let linear = |part: &str, kind: usize| self.numbers(&format!("{key}.fn.{part}_linears.{kind}"), channels);
        let all = |part: &str| {
            (0..KINDS)
                .map(|kind| self.packed(linear(part, kind), channels))
                .collect()
        };
        let (heads, width) = (settings.heads, settings.head_width);
        let [keys, values] = ["relation_att", "relation_msg"].map(|name| self.tensor(&format!("{key}.fn.{name}")));
        let answers = |asks: usize| {
            let answer = |asked: usize| {
                let relation = asks * KINDS + asked;
                let of = |tensor: &[f32]| tensor[relation * heads * width * width..][..heads * width * width].to_vec();
                // q · (A k), and v M: a row of numbers times a matrix.
                let (mut weights, mut bias) = related(&linear("k", asked), &of(&keys), [heads, width], false);
                let (of_values, bias_of_values) = related(&linear("v", asked), &of(&values), [heads, width], true);
                weights.extend(of_values);
                bias.extend(bias_of_values);
                self.packed((weights, bias), channels)
            };
            (0..KINDS).map(answer).collect()
        };
        OverAgents {
            norm: self.norm(&format!("{key}.norm")),
            heads,
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
