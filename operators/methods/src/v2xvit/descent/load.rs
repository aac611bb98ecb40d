//! The ways back through a transformer's layers, and from layers that were made of several tensors to these.

use realo_kernels::math::product;

use super::super::keys::{ENCODER, KINDS, agents_key, forward_key, windows_key};
use super::super::load::Load;
use super::super::settings::{Settings, Window};
use super::super::windows::LANES;
use super::RoundBack;
use super::agents::AgentsBack;
use super::blocks::BlockBack;
use super::forward::ForwardBack;
use super::layer::{LinearBack, NormBack};
use super::split::SplitBack;
use super::sums::Sums;
use super::windows::{WindowsBack, WithinBack};

/// Reads ways back from weights; `channels`: of the maps that are fused.
pub struct LoadBack<'a> {
    pub load: Load<'a>,
    pub settings: &'a Settings,
    pub channels: usize,
}

impl LoadBack<'_> {
    pub fn round(&self, depth: usize) -> RoundBack {
        let block = |block: usize| BlockBack {
            agents: self.agents(&agents_key(depth, block)),
            windows: self.windows(&windows_key(depth, block)),
        };
        let key = forward_key(depth);
        RoundBack {
            blocks: (0..self.settings.blocks).map(block).collect(),
            forward: ForwardBack {
                norm: NormBack::new(&format!("{key}.norm")),
                wide: self.linear(&format!("{key}.fn.net.0"), self.channels),
                back: self.linear(&format!("{key}.fn.net.3"), self.settings.feed_forward),
            },
        }
    }

    fn linear(&self, key: &str, inputs: usize) -> LinearBack {
        let Load { weights, isa } = self.load;
        let has_bias = weights.find(&format!("{key}.bias")).is_some();
        LinearBack::new(key, &self.load.numbers(key, inputs), has_bias, isa)
    }

    fn agents(&self, key: &str) -> AgentsBack {
        let of_kinds = |part: &str| {
            let linear = |kind| self.linear(&format!("{key}.fn.{part}_linears.{kind}"), self.channels);
            (0..KINDS).map(linear).collect()
        };
        let answer = |relation: [usize; 2]| {
            let layer = self.load.answers(key, self.settings, self.channels, relation);
            LinearBack::new(&answers_key(key, relation), &layer, true, self.load.isa)
        };
        let answers = |asks| (0..KINDS).map(|asked| answer([asks, asked])).collect();
        AgentsBack {
            norm: NormBack::new(&format!("{key}.norm")),
            queries: of_kinds("q"),
            answers: (0..KINDS).map(answers).collect(),
            outputs: of_kinds("a"),
        }
    }

    fn windows(&self, key: &str) -> WindowsBack {
        let within = |(index, window): (usize, &Window)| {
            let key = format!("{key}.fn.pwmsa.{index}");
            WithinBack {
                positions: pairs_key(&key),
                all: self.linear(&format!("{key}.to_qkv"), self.channels),
                output: self.linear(&format!("{key}.to_out.0"), window.width()),
            }
        };
        let split = format!("{key}.fn.split_attn");
        WindowsBack {
            norm: NormBack::new(&format!("{key}.norm")),
            windows: self.settings.windows.iter().enumerate().map(within).collect(),
            split: SplitBack {
                first: format!("{split}.fc1"),
                norm: NormBack::new(&format!("{split}.bn1")),
                second: format!("{split}.fc2"),
            },
        }
    }

    /// Leads sums of layers on to the tensors that they were made of.
    pub fn conclude(&self, sums: &mut Sums) {
        let blocks =
            (0..self.settings.depth).flat_map(|depth| (0..self.settings.blocks).map(move |block| (depth, block)));
        for (depth, block) in blocks {
            let key = agents_key(depth, block);
            let kinds = (0..KINDS).flat_map(|asks| (0..KINDS).map(move |asked| [asks, asked]));
            kinds.for_each(|relation| self.lead_to_relation(&key, relation, sums));
            for (index, window) in self.settings.windows.iter().enumerate() {
                let key = format!("{}.fn.pwmsa.{index}", windows_key(depth, block));
                lead_to_positions(&key, *window, sums);
            }
        }
    }

    fn lead_to_relation(&self, key: &str, [asks, asked]: [usize; 2], sums: &mut Sums) {
        let layer = answers_key(key, [asks, asked]);
        let mut take = |part: &str| sums.0.remove(&format!("{layer}.{part}"));
        let (Some(of_weights), Some(of_bias)) = (take("weight"), take("bias")) else {
            return;
        };
        let (heads, width) = (self.settings.heads, self.settings.head_width);
        let size = heads * width * width;
        let halves = of_weights
            .chunks_exact(of_weights.len() / 2)
            .zip(of_bias.chunks_exact(of_bias.len() / 2));
        let parts = [("k", "relation_att", false), ("v", "relation_msg", true)];
        for ((part, relation, from_left), made) in parts.into_iter().zip(halves) {
            let linear = format!("{key}.fn.{part}_linears.{asked}");
            let relation = format!("{key}.fn.{relation}");
            let matrices = self.load.weights.tensor(&relation);
            let first = (asks * KINDS + asked) * size;
            let layer = self.load.numbers(&linear, self.channels);
            let found = Related::back(made, &layer, (&matrices[first..][..size], width, from_left));
            sums.add(&format!("{linear}.weight"), &found.weights);
            sums.add(&format!("{linear}.bias"), &found.bias);
            let of_matrices = sums.of(&relation, matrices.len())[first..].iter_mut();
            of_matrices
                .zip(&found.matrices)
                .for_each(|(sum, number)| *sum += number);
        }
    }

    /// The gradients of the table of delays and the layer behind it, from that of what a delay added.
    pub fn lead_to_delays(&self, delay: usize, gradient: &[f32], sums: &mut Sums) {
        let (table, linear) = (
            format!("{ENCODER}.rte.emb.emb.weight"),
            format!("{ENCODER}.rte.emb.lin"),
        );
        let numbers = self.load.weights.tensor(&table);
        let row = delay.saturating_mul(self.settings.delay_ratio);
        let first = row.min(numbers.len() / self.channels - 1) * self.channels;
        let (weights, _) = self.load.numbers(&linear, self.channels);
        sums.add(&format!("{linear}.bias"), gradient);
        let of_weights = sums.of(&format!("{linear}.weight"), weights.len());
        for (of_row, gradient) in of_weights.chunks_exact_mut(self.channels).zip(gradient) {
            let delay = numbers[first..].iter();
            of_row
                .iter_mut()
                .zip(delay)
                .for_each(|(sum, delay)| *sum += gradient * delay);
        }
        let of_delay = &mut sums.of(&table, numbers.len())[first..][..self.channels];
        for (row, gradient) in weights.chunks_exact(self.channels).zip(gradient) {
            of_delay
                .iter_mut()
                .zip(row)
                .for_each(|(sum, weight)| *sum += gradient * weight);
        }
    }
}

/// Key of gradients of the layer that a relation makes of keys and values.
fn answers_key(key: &str, [asks, asked]: [usize; 2]) -> String {
    format!("{key}.fn.answers.{asks}.{asked}")
}

/// Key of gradients of what positions add, by blocks of those who ask and who is asked.
fn pairs_key(key: &str) -> String {
    format!("{key}.pairs")
}

fn lead_to_positions(key: &str, window: Window, sums: &mut Sums) {
    let Some(pairs) = sums.0.remove(&pairs_key(key)) else {
        return;
    };
    let (side, cells) = (2 * window.side - 1, window.side * window.side);
    let table = sums.of(&format!("{key}.pos_embedding"), side * side);
    for (at, lanes) in pairs.chunks_exact(LANES).enumerate() {
        let asking = (at / cells * LANES..cells).zip(lanes);
        asking.for_each(|(asks, gradient)| table[window.offset(asks, at % cells)] += gradient);
    }
}

/// Gradients of a linear layer and of the matrix for each head behind it.
struct Related {
    weights: Vec<f32>,
    bias: Vec<f32>,
    matrices: Vec<f32>,
}

impl Related {
    /// From those of the layer that both become.
    fn back(
        (of_weights, of_bias): (&[f32], &[f32]),
        (weights, bias): &(Vec<f32>, Vec<f32>),
        (matrices, width, from_left): (&[f32], usize, bool),
    ) -> Self {
        let inputs = weights.len() / bias.len();
        let mut found = Related {
            weights: vec![0.0; weights.len()],
            bias: vec![0.0; bias.len()],
            matrices: vec![0.0; matrices.len()],
        };
        for (at, factor) in matrices.iter().enumerate() {
            let head = at / (width * width) * width;
            let [row, column] = [head + at / width % width, head + at % width];
            let [to, from] = if from_left { [column, row] } else { [row, column] };
            let [gradient, own] = [
                &of_weights[to * inputs..][..inputs],
                &weights[from * inputs..][..inputs],
            ];
            found.matrices[at] = product(gradient, own) + of_bias[to] * bias[from];
            found.bias[from] += factor * of_bias[to];
            let of_row = found.weights[from * inputs..].iter_mut().zip(gradient);
            of_row.for_each(|(sum, gradient)| *sum += factor * gradient);
        }
        found
    }
}
