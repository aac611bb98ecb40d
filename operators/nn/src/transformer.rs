//! The transformer of V2X-ViT: attention over agents, each cell by itself; attention within windows of the map; feed-forward.
//!
//! The result is the ego's map. What nobody reads for it is not computed: in the last attention over agents only the ego asks,
//! and what follows is the ego's alone. An agent that is not there, or whose map does not reach a cell, is not asked.
//!
//! Workers take tiles of the map through one layer after the other. All of them wait only where a mean over the whole map
//! decides how much each size of windows counts.

mod agents;
mod blocks;
mod parts;
mod tiles;
mod weights;
mod windows;

use std::sync::Mutex;

use blocks::Block;
pub use parts::{Asking, Parts};
use tiles::{Tile, Tiles, Worker};
pub(crate) use weights::tensors;
pub use weights::{ENCODER, agents_key, forward_key, initial_delays, windows_key};

use crate::arch::Window;
use crate::cells::{Linear, line, line_mut};
use crate::conv::{Map, Pool};
use crate::fuse::{Agent, place};
use crate::load::lock;
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
    windows: Vec<Window>,
    delays: Delays,
    rounds: Vec<Round<E>>,
    room: Mutex<Room<E>>,
}

struct Round<E> {
    blocks: Vec<Block<E>>,
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

/// Maps that are kept from frame to frame.
struct Room<E> {
    states: Vec<State>,
    /// By agent that asks, then by size of windows: what attention gave it, `[rows, columns, stored]`.
    made: Vec<Vec<Vec<E>>>,
    workers: Vec<Worker<E>>,
}

impl<E> Default for Room<E> {
    fn default() -> Self {
        Room {
            states: Vec::new(),
            made: Vec::new(),
            workers: Vec::new(),
        }
    }
}

/// An agent on its way through the transformer.
#[derive(Default)]
struct State {
    kind: usize,
    /// `[rows, columns, channels]`.
    map: Vec<f32>,
    /// `[rows, columns]`: whether the agent can be asked there.
    covered: Vec<bool>,
}

/// What must be known of an agent to ask it.
#[derive(Clone, Copy)]
struct Asked<'a> {
    kind: usize,
    /// By cell of a tile.
    covered: &'a [bool],
}

impl<E: Number> Transformer<E> {
    /// The fused map, `[rows, columns, channels]`. The first agent is the ego.
    pub fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
        let mut room = lock(&self.room);
        let Room { states, made, workers } = &mut *room;
        let size = [agents[0].map.rows, agents[0].map.columns];
        states.resize_with(states.len().max(agents.len()), State::default);
        workers.resize_with(pool.threads(), Worker::new);
        let states = &mut states[..agents.len()];
        for (state, agent) in states.iter_mut().zip(agents) {
            self.take(agent, size, state, pool);
        }
        let tiles = Tiles::new(&self.windows, size);
        let stored = self.channels.next_multiple_of(E::PER_UNIT);
        let last = self.rounds.len() - 1;
        for (depth, round) in self.rounds.iter().enumerate() {
            for (index, block) in round.blocks.iter().enumerate() {
                let ends = index == round.blocks.len() - 1;
                let asking = if ends && depth == last { 1 } else { agents.len() };
                made.resize_with(made.len().max(asking), || vec![Vec::new(); self.windows.len()]);
                let made = &mut made[..asking];
                let maps = made.iter_mut().flatten();
                maps.for_each(|map| map.resize(tiles.cells() * stored, E::default()));
                block.run(tiles, states, made, ends.then_some(&round.forward), workers, pool);
            }
        }
        std::mem::take(&mut states[0].map)
    }

    /// Takes an agent's map in the ego's cells, with what its delay adds.
    fn take(&self, agent: &Agent, size: [usize; 2], state: &mut State, pool: &mut Pool) {
        state.kind = usize::from(agent.roadside);
        let added = Some(self.delays.of(agent.delay));
        place(agent, size, added, &mut state.map, &mut state.covered, pool);
    }
}

impl Delays {
    /// What a delay of so many frames adds; longer ones than the table knows are the longest.
    fn of(&self, frames: usize) -> &[f32] {
        let row = frames.saturating_mul(self.ratio).min(self.table.len() - 1);
        &self.table[row]
    }
}

impl Norm {
    /// Of the cells of a tile; `rows` are its rows of the map.
    fn run<E: Number>(&self, tile: Tile, rows: &[f32], worker: &mut Worker<E>) -> Map<E> {
        let channels = self.weight.len();
        let mut to = worker.own(tile.cells(), channels);
        let stored = to.stored;
        let cells = line_mut(&mut to).chunks_exact_mut(tile.columns * stored);
        for (from, to) in tile.lines(rows, channels).zip(cells) {
            normalize(from, [&self.weight, &self.bias], stored, to);
        }
        to
    }
}

dispatch! {
    /// A layer norm of each cell, with its weights and biases; `to` has `stored` numbers for each cell.
    fn normalize<E: Number>(cells: &[f32], norm: [&[f32]; 2], stored: usize, to: &mut [E]) {
        let [weight, bias] = norm;
        let mut centered = vec![0.0; weight.len()];
        for (cell, to) in cells.chunks_exact(weight.len()).zip(to.chunks_exact_mut(stored)) {
            let mean = sum(cell) / cell.len() as f32;
            centered.iter_mut().zip(cell).for_each(|(to, from)| *to = from - mean);
            let factor = 1.0 / (product(&centered, &centered) / cell.len() as f32 + LAYER_NORM_EPS).sqrt();
            for (((to, from), weight), bias) in to.iter_mut().zip(&centered).zip(weight).zip(bias) {
                *to = E::from_f32(from * factor * weight + bias);
            }
        }
    }
}

impl<E: Number> Forward<E> {
    /// What is added to the cells of a tile; `rows` are its rows of the map.
    fn run(&self, tile: Tile, rows: &[f32], worker: &mut Worker<E>) -> Map<f32> {
        let normed = self.norm.run(tile, rows, worker);
        let made = worker.run(&self.wide, &normed);
        let mut active = worker.own(tile.cells(), made.channels);
        let stored = active.stored;
        gelu(line(&made), made.channels, stored, line_mut(&mut active));
        let given = worker.run(&self.back, &active);
        worker.keep_single([made]);
        worker.keep_own([normed, active]);
        given
    }
}

dispatch! {
    /// `to` has `stored` numbers for each cell of `channels`.
    fn gelu<E: Number>(from: &[f32], channels: usize, stored: usize, to: &mut [E]) {
        for (from, to) in from.chunks_exact(channels).zip(to.chunks_exact_mut(stored)) {
            for (from, to) in from.iter().zip(to) {
                *to = E::from_f32(0.5 * from * (1.0 + erf(from * std::f32::consts::FRAC_1_SQRT_2)));
            }
        }
    }
}
