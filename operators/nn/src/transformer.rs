//! The transformer of V2X-ViT: attention over agents, each cell by itself; attention within windows of the map; feed-forward.
//!
//! The result is the ego's map. What nobody reads for it is not computed: in the last attention over agents only the ego asks,
//! and what follows is the ego's alone. An agent that is not there, or whose map does not reach a cell, is not asked.

use crate::arch::{Transformer as Settings, Window};
use crate::cells::{Linear, Specs, cells, each_cell, packed, run};
use crate::conv::{Isa, Kernel, Map, Pool, Rows, View};
use crate::fuse::{Agent, sample};
use crate::layers::TensorSpec;
use crate::math::{erf, exp, product, sum};
use crate::part::Number;
use crate::simd::dispatch;
use crate::weights::Weights;

/// Kinds of agents: vehicles, and roadside units.
const KINDS: usize = 2;
/// Added to the variance by every layer norm.
const LAYER_NORM_EPS: f32 = 1e-5;
const ENCODER: &str = "fusion_net.encoder";

fn agents_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.0")
}

fn windows_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.1")
}

fn forward_key(depth: usize) -> String {
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
    all.weight(&format!("{key}.emb.weight"), vec![settings.delays, channels], channels);
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

/// A transformer that is ready to run; maps are computed in `E`, what is added up in f32.
pub(crate) struct Transformer<E> {
    channels: usize,
    delays: Delays,
    rounds: Vec<Round<E>>,
}

struct Round<E> {
    blocks: Vec<(OverAgents<E>, OverWindows<E>)>,
    forward: Forward<E>,
}

/// What the delay of an agent's map adds to it.
struct Delays {
    ratio: usize,
    /// `[delays, channels]`, with the linear layer behind the table.
    table: Vec<Vec<f32>>,
}

struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

struct OverAgents<E> {
    norm: Norm,
    heads: usize,
    /// By kind of who asks.
    queries: Vec<Linear<E>>,
    /// By kind of who asks, then of who is asked: keys and values, as the relation of both changes them.
    answers: Vec<Vec<Linear<E>>>,
    /// By kind of who asks.
    outputs: Vec<Linear<E>>,
}

struct OverWindows<E> {
    norm: Norm,
    windows: Vec<Within<E>>,
    split: Split,
}

struct Within<E> {
    window: Window,
    /// `[2 side - 1, 2 side - 1]`, by the offset from who asks to who is asked.
    positions: Vec<f32>,
    all: Linear<E>,
    output: Linear<E>,
}

/// How much each attention over windows counts, by channel.
struct Split {
    first: Vec<f32>,
    norm: Norm,
    second: Vec<f32>,
}

struct Forward<E> {
    norm: Norm,
    wide: Linear<E>,
    back: Linear<E>,
}

impl<E: Number> Transformer<E> {
    pub fn new(settings: &Settings, channels: usize, weights: &Weights, isa: Isa) -> Self {
        let load = Load { weights, isa };
        let round = |depth: usize| {
            let block = |block: usize| {
                let agents = load.agents(&agents_key(depth, block), settings, channels);
                let windows = load.windows(&windows_key(depth, block), settings, channels);
                (agents, windows)
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
            delays: load.delays(settings, channels),
            rounds: (0..settings.depth).map(round).collect(),
        }
    }

    /// The fused map, `[rows, columns, channels]`. The first agent is the ego.
    pub fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
        let mut states: Vec<State> = agents.iter().map(|agent| self.state(agent, agents[0], pool)).collect();
        let last = self.rounds.len() - 1;
        for (depth, round) in self.rounds.iter().enumerate() {
            for (block, (agents, windows)) in round.blocks.iter().enumerate() {
                if depth == last && block == round.blocks.len() - 1 {
                    agents.run(&mut states, 1, pool);
                    states.truncate(1);
                } else {
                    let all = states.len();
                    agents.run(&mut states, all, pool);
                }
                states.iter_mut().for_each(|state| windows.run(&mut state.map, pool));
            }
            states
                .iter_mut()
                .for_each(|state| round.forward.run(&mut state.map, pool));
        }
        states[0].map.to_f32(pool)
    }

    /// An agent's map in the ego's cells, with what its delay adds.
    fn state(&self, agent: &Agent, ego: Agent, pool: &mut Pool) -> State {
        let (rows, columns) = (ego.map.rows, ego.map.columns);
        let added = self.delays.of(agent.delay);
        let mut map = Map::new(rows, columns, self.channels);
        let mut covered = vec![false; rows * columns];
        let covers = crate::conv::split(&mut covered, columns, rows, pool.threads(), 1);
        let shares = map.shares(pool.threads(), 1).into_iter().zip(covers);
        let length = (columns + 2) * self.channels;
        pool.each(shares.collect(), |(Rows { range, data }, covers)| {
            let rows = range
                .zip(data.chunks_exact_mut(length))
                .zip(covers.data.chunks_exact_mut(columns));
            for ((row, to), covered) in rows {
                let cells = to[self.channels..].chunks_exact_mut(self.channels);
                for (column, (to, covered)) in cells.zip(covered).enumerate() {
                    *covered = sample(agent, column, row, Some(added), to);
                }
            }
        });
        State {
            kind: usize::from(agent.roadside),
            map,
            covered,
        }
    }
}

/// An agent on its way through the transformer.
struct State {
    kind: usize,
    map: Map<f32>,
    /// By cell: whether the agent can be asked there.
    covered: Vec<bool>,
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

    fn windows<E: Kernel<f32>>(&self, key: &str, settings: &Settings, channels: usize) -> OverWindows<E> {
        let within = |(index, window): (usize, &Window)| {
            let key = format!("{key}.fn.pwmsa.{index}");
            Within {
                window: *window,
                positions: self.tensor(&format!("{key}.pos_embedding")),
                all: self.linear(&format!("{key}.to_qkv"), channels),
                output: self.linear(&format!("{key}.to_out.0"), window.width()),
            }
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

impl Delays {
    /// What a delay of so many frames adds; longer ones than the table knows are the longest.
    fn of(&self, frames: usize) -> &[f32] {
        let row = frames.saturating_mul(self.ratio).min(self.table.len() - 1);
        &self.table[row]
    }
}

/// Adds a map to another.
fn add(to: &mut Map<f32>, from: &Map<f32>, pool: &mut Pool) {
    let from = from.view();
    each_cell(to, 1, pool, |row, to| {
        to.iter_mut().zip(cells(&from, row)).for_each(|(to, from)| *to += from);
    });
}

impl Norm {
    fn run<E: Number>(&self, from: &Map<f32>, pool: &mut Pool) -> Map<E> {
        let mut to: Map<E> = Map::new(from.rows, from.columns, from.channels);
        let (view, channels, stored) = (from.view(), from.channels, to.stored);
        each_cell(&mut to, 1, pool, |row, to| {
            let mut normed = vec![0.0; channels];
            let from = cells(&view, row).chunks_exact(channels);
            for (from, to) in from.zip(to.chunks_exact_mut(stored)) {
                normalized(from, &self.weight, &self.bias, &mut normed);
                normed.iter().zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
            }
        });
        to
    }
}

dispatch! {
    fn normalized(from: &[f32], weight: &[f32], bias: &[f32], to: &mut [f32]) {
        let mean = sum(from) / from.len() as f32;
        to.iter_mut().zip(from).for_each(|(to, from)| *to = from - mean);
        let factor = 1.0 / (product(to, to) / from.len() as f32 + LAYER_NORM_EPS).sqrt();
        for ((to, weight), bias) in to.iter_mut().zip(weight).zip(bias) {
            *to = *to * factor * weight + bias;
        }
    }
}

impl<E: Number> OverAgents<E> {
    /// Attention of the first `asking` agents; what it gives is added to their maps.
    fn run(&self, states: &mut [State], asking: usize, pool: &mut Pool) {
        let normed: Vec<Map<E>> = states.iter().map(|state| self.norm.run(&state.map, pool)).collect();
        let given: Vec<Map<f32>> = (0..asking).map(|asks| self.ask(states, &normed, asks, pool)).collect();
        for (state, given) in states.iter_mut().zip(&given) {
            add(&mut state.map, given, pool);
        }
    }

    fn ask(&self, states: &[State], normed: &[Map<E>], asks: usize, pool: &mut Pool) -> Map<f32> {
        let own = &normed[asks];
        let (kind, channels, columns) = (states[asks].kind, own.channels, own.columns);
        let queries = run(&self.queries[kind], own, channels, pool);
        let mut sums: Map<f32> = Map::new(own.rows, columns, channels);
        // For each head the greatest score so far, and the sum of weights.
        let mut weighed: Map<f32> = Map::new(own.rows, columns, 2 * self.heads);
        each_cell(&mut weighed, 1, pool, |_, cells| {
            cells
                .as_chunks_mut::<2>()
                .0
                .iter_mut()
                .for_each(|head| *head = [f32::NEG_INFINITY, 0.0]);
        });
        for (state, normed) in states.iter().zip(normed) {
            let answers = run(&self.answers[kind][state.kind], normed, 2 * channels, pool);
            let (queries, answers) = (queries.view(), answers.view());
            let shares = sums
                .shares(pool.threads(), 1)
                .into_iter()
                .zip(weighed.shares(pool.threads(), 1));
            let (length, weighed_length) = ((columns + 2) * channels, (columns + 2) * 2 * self.heads);
            pool.each(shares.collect(), |(sums, weighed)| {
                let rows = sums
                    .data
                    .chunks_exact_mut(length)
                    .zip(weighed.data.chunks_exact_mut(weighed_length));
                for (row, (sums, weighed)) in sums.range.zip(rows) {
                    let covered = &state.covered[row * columns..][..columns];
                    let asked = (cells(&queries, row), cells(&answers, row));
                    let sums = &mut sums[channels..(columns + 1) * channels];
                    let weighed = &mut weighed[2 * self.heads..(columns + 1) * 2 * self.heads];
                    weigh(asked, covered, self.heads, sums, weighed);
                }
            });
        }
        let mut mean: Map<E> = Map::new(own.rows, columns, channels);
        let (sums, weighed, stored, width) = (sums.view(), weighed.view(), mean.stored, channels / self.heads);
        each_cell(&mut mean, 1, pool, |row, to| {
            let from = cells(&sums, row).chunks_exact(channels);
            let weighed = cells(&weighed, row).chunks_exact(2 * self.heads);
            for ((from, weighed), to) in from.zip(weighed).zip(to.chunks_exact_mut(stored)) {
                for (index, (from, to)) in from.iter().zip(to).enumerate() {
                    *to = E::from_f32(from / weighed[index / width * 2 + 1]);
                }
            }
        });
        run(&self.outputs[kind], &mean, channels, pool)
    }
}

dispatch! {
    /// Takes one agent's answers to the queries of a row into the sums; `weighed` has two numbers for each head.
    fn weigh(asked: (&[f32], &[f32]), covered: &[bool], heads: usize, sums: &mut [f32], weighed: &mut [f32]) {
        let channels = sums.len() / covered.len();
        let width = channels / heads;
        let scale = 1.0 / (width as f32).sqrt();
        let cells = asked.0.chunks_exact(channels).zip(asked.1.chunks_exact(2 * channels)).zip(covered);
        let to = sums.chunks_exact_mut(channels).zip(weighed.chunks_exact_mut(2 * heads));
        for (((query, answer), covered), (sums, weighed)) in cells.zip(to) {
            if !covered {
                continue;
            }
            let (keys, values) = answer.split_at(channels);
            let of_heads = query.chunks_exact(width).zip(keys.chunks_exact(width)).zip(values.chunks_exact(width));
            let to = sums.chunks_exact_mut(width).zip(weighed.as_chunks_mut::<2>().0);
            for (((query, key), value), (sums, [greatest, sum])) in of_heads.zip(to) {
                let score = product(query, key) * scale;
                // What was summed before a greater score came is made smaller.
                let (before, now) = match score > *greatest {
                    true => (exp(*greatest - score), 1.0),
                    false => (1.0, exp(score - *greatest)),
                };
                *greatest = greatest.max(score);
                *sum = *sum * before + now;
                for (sum, value) in sums.iter_mut().zip(value) {
                    *sum = *sum * before + value * now;
                }
            }
        }
    }
}

impl<E: Number> OverWindows<E> {
    fn run(&self, map: &mut Map<f32>, pool: &mut Pool) {
        let normed: Map<E> = self.norm.run(map, pool);
        let made: Vec<Map<f32>> = self
            .windows
            .iter()
            .map(|within| within.run(&normed, map.channels, pool))
            .collect();
        let counts = self.split.counts(&made, pool);
        let views: Vec<View<f32>> = made.iter().map(Map::view).collect();
        let channels = map.channels;
        each_cell(map, 1, pool, |row, to| {
            for (view, counts) in views.iter().zip(counts.chunks_exact(channels)) {
                let from = cells(view, row).chunks_exact(channels);
                for (from, to) in from.zip(to.chunks_exact_mut(channels)) {
                    let numbers = to.iter_mut().zip(from).zip(counts);
                    numbers.for_each(|((to, from), count)| *to += from * count);
                }
            }
        });
    }
}

impl<E: Number> Within<E> {
    fn run(&self, normed: &Map<E>, channels: usize, pool: &mut Pool) -> Map<f32> {
        let (side, width) = (self.window.side, self.window.width());
        let all = run(&self.all, normed, 3 * width, pool);
        let view = all.view();
        let mut attended: Map<E> = Map::new(normed.rows, normed.columns, width);
        let (length, stored, columns) = (attended.row_length(), attended.stored, attended.columns);
        pool.each(attended.shares(pool.threads(), side), |Rows { range, data }| {
            let mut made = vec![0.0; side * columns * width];
            for (band, to) in range.step_by(side).zip(data.chunks_exact_mut(side * length)) {
                let start = (band + view.border) * view.line();
                let rows = &view.data[start..start + side * view.line()];
                attend(self.window, rows, &self.positions, columns, &mut made);
                for (from, to) in made.chunks_exact(columns * width).zip(to.chunks_exact_mut(length)) {
                    let to = to[stored..].chunks_exact_mut(stored);
                    for (from, to) in from.chunks_exact(width).zip(to) {
                        from.iter().zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
                    }
                }
            }
        });
        run(&self.output, &attended, channels, pool)
    }
}

dispatch! {
    /// Attention within the windows of a band of rows: `rows` has queries, keys and values of each cell, with a border of one
    /// cell; `to` is `[side, columns, width]`.
    fn attend(window: Window, rows: &[f32], positions: &[f32], columns: usize, to: &mut [f32]) {
        let Window { side, heads, head_width } = window;
        let width = heads * head_width;
        let scale = 1.0 / (head_width as f32).sqrt();
        let cell = |row: usize, column: usize| ((row * (columns + 2)) + column + 1) * 3 * width;
        let mut scores = vec![0.0f32; side * side];
        for (first, head) in (0..columns).step_by(side).flat_map(|first| (0..heads).map(move |head| (first, head))) {
            let head_at = head * head_width;
            for asks in 0..side * side {
                let (row, column) = (asks / side, asks % side);
                let query = &rows[cell(row, first + column) + head_at..][..head_width];
                let mut greatest = f32::NEG_INFINITY;
                for (asked, score) in scores.iter_mut().enumerate() {
                    let (to_row, to_column) = (asked / side, asked % side);
                    let key = &rows[cell(to_row, first + to_column) + width + head_at..][..head_width];
                    let position = (to_row + side - 1 - row) * (2 * side - 1) + to_column + side - 1 - column;
                    *score = product(query, key) * scale + positions[position];
                    greatest = greatest.max(*score);
                }
                scores.iter_mut().for_each(|score| *score = exp(*score - greatest));
                let factor = 1.0 / sum(&scores);
                let to = &mut to[(row * columns + first + column) * width + head_at..][..head_width];
                to.fill(0.0);
                for (asked, score) in scores.iter().enumerate() {
                    let (from_row, from_column) = (asked / side, asked % side);
                    let value = &rows[cell(from_row, first + from_column) + 2 * width + head_at..][..head_width];
                    let weight = score * factor;
                    to.iter_mut().zip(value).for_each(|(to, value)| *to += value * weight);
                }
            }
        }
    }
}

impl Split {
    /// `[attentions, channels]`: how much of each attention is taken.
    fn counts(&self, made: &[Map<f32>], pool: &mut Pool) -> Vec<f32> {
        let (rows, columns, channels) = (made[0].rows, made[0].columns, made[0].channels);
        let views: Vec<View<f32>> = made.iter().map(Map::view).collect();
        // A sum for each row, so that threads change no order.
        let mut sums = vec![0.0f32; rows * channels];
        pool.each(
            crate::conv::split(&mut sums, channels, rows, pool.threads(), 1),
            |share| {
                for (row, to) in share.range.zip(share.data.chunks_exact_mut(channels)) {
                    for from in views.iter().flat_map(|view| cells(view, row).chunks_exact(channels)) {
                        to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
                    }
                }
            },
        );
        let mut mean = vec![0.0f32; channels];
        for row in sums.chunks_exact(channels) {
            mean.iter_mut().zip(row).for_each(|(mean, row)| *mean += row);
        }
        mean.iter_mut().for_each(|mean| *mean /= (rows * columns) as f32);
        let linear = |weights: &[f32], from: &[f32]| -> Vec<f32> {
            weights
                .chunks_exact(from.len())
                .map(|weights| product(weights, from))
                .collect()
        };
        let first = linear(&self.first, &mean);
        let mut hidden = vec![0.0; channels];
        normalized(&first, &self.norm.weight, &self.norm.bias, &mut hidden);
        hidden.iter_mut().for_each(|value| *value = value.max(0.0));
        let mut counts = linear(&self.second, &hidden);
        for channel in 0..channels {
            let of = || (channel..made.len() * channels).step_by(channels);
            let greatest = of().fold(f32::NEG_INFINITY, |greatest, at| greatest.max(counts[at]));
            of().for_each(|at| counts[at] = exp(counts[at] - greatest));
            let all: f32 = of().map(|at| counts[at]).sum();
            of().for_each(|at| counts[at] /= all);
        }
        counts
    }
}

impl<E: Number> Forward<E> {
    fn run(&self, map: &mut Map<f32>, pool: &mut Pool) {
        let normed: Map<E> = self.norm.run(map, pool);
        let wide = self.wide.outputs();
        let made = run(&self.wide, &normed, wide, pool);
        let view = made.view();
        let mut active: Map<E> = Map::new(map.rows, map.columns, wide);
        let stored = active.stored;
        each_cell(&mut active, 1, pool, |row, to| {
            let mut values = vec![0.0; wide];
            for (from, to) in cells(&view, row).chunks_exact(wide).zip(to.chunks_exact_mut(stored)) {
                gelu(from, &mut values);
                values.iter().zip(to).for_each(|(from, to)| *to = E::from_f32(*from));
            }
        });
        let given = run(&self.back, &active, map.channels, pool);
        add(map, &given, pool);
    }
}

dispatch! {
    fn gelu(from: &[f32], to: &mut [f32]) {
        for (from, to) in from.iter().zip(to) {
            *to = 0.5 * from * (1.0 + erf(from * std::f32::consts::FRAC_1_SQRT_2));
        }
    }
}
