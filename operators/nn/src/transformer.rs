//! The transformer of V2X-ViT: attention over agents, each cell by itself; attention within windows of the map; feed-forward.
//!
//! The result is the ego's map. What nobody reads for it is not computed: in the last attention over agents only the ego asks,
//! and what follows is the ego's alone. An agent that is not there, or whose map does not reach a cell, is not asked.

mod agents;
mod parts;
mod weights;
mod windows;

use agents::OverAgents;
pub use parts::{Asking, Parts};
pub(crate) use weights::tensors;
pub use weights::{ENCODER, agents_key, forward_key, initial_delays, windows_key};
use windows::OverWindows;

use crate::cells::{Linear, add, cells, each_cell, run};
use crate::conv::{Map, Pool, Rows, split};
use crate::fuse::{Agent, sample};
use crate::math::{erf, product, sum};
use crate::part::Number;
use crate::simd::dispatch;

/// Kinds of agents: vehicles, and roadside units.
pub const KINDS: usize = 2;
/// Added to the variance by every layer norm.
pub const LAYER_NORM_EPS: f32 = 1e-5;

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

struct Forward<E> {
    norm: Norm,
    wide: Linear<E>,
    back: Linear<E>,
}

impl<E: Number> Transformer<E> {
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
        let covers = split(&mut covered, columns, rows, pool.threads(), 1);
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

impl State {
    fn asked(&self) -> Asked<'_> {
        Asked {
            kind: self.kind,
            covered: &self.covered,
        }
    }
}

/// What must be known of an agent to ask it.
#[derive(Clone, Copy)]
struct Asked<'a> {
    kind: usize,
    covered: &'a [bool],
}

impl Delays {
    /// What a delay of so many frames adds; longer ones than the table knows are the longest.
    fn of(&self, frames: usize) -> &[f32] {
        let row = frames.saturating_mul(self.ratio).min(self.table.len() - 1);
        &self.table[row]
    }
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

impl<E: Number> Forward<E> {
    fn run(&self, map: &mut Map<f32>, pool: &mut Pool) {
        let given = self.given(map, pool);
        add(map, &given, pool);
    }

    /// What is added to a map.
    fn given(&self, map: &Map<f32>, pool: &mut Pool) -> Map<f32> {
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
        run(&self.back, &active, map.channels, pool)
    }
}

dispatch! {
    fn gelu(from: &[f32], to: &mut [f32]) {
        for (from, to) in from.iter().zip(to) {
            *to = 0.5 * from * (1.0 + erf(from * std::f32::consts::FRAC_1_SQRT_2));
        }
    }
}
