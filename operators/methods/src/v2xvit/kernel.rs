//! The transformer of V2X-ViT: attention over agents, each cell by itself; attention within windows of the map; feed-forward.
//!
//! The result is the ego's map. What nobody reads for it is not computed: in the last attention over agents only the ego asks,
//! and what follows is the ego's alone. An agent that is not there, or whose map does not reach a cell, is not asked.
//!
//! Workers take tiles of the map through one layer after the other. All of them wait only where a mean over the whole map
//! decides how much each size of windows counts.

use std::sync::Mutex;

use realo_kernels::agents::{Agent, place};
use realo_kernels::conv::{Pool, lock};
use realo_kernels::number::Number;

use super::blocks::Block;
use super::forward::Forward;
use super::settings::Window;
use super::state::State;
use super::tiles::{Crew, Tiles, Worker};
use crate::method::Fuse;

/// A transformer that is ready to run; maps are computed in `E`, what is added up in f32.
pub struct Transformer<E> {
    pub channels: usize,
    pub windows: Vec<Window>,
    pub delays: Delays,
    pub rounds: Vec<Round<E>>,
    pub room: Mutex<Room<E>>,
}

pub struct Round<E> {
    pub blocks: Vec<Block<E>>,
    pub forward: Forward<E>,
}

/// What the delay of an agent's map adds to it.
pub struct Delays {
    pub ratio: usize,
    /// `[delays, channels]`, with the linear layer behind the table.
    pub table: Vec<Vec<f32>>,
}

/// Maps that are kept from frame to frame.
pub struct Room<E> {
    pub states: Vec<State>,
    /// By agent that asks, then by size of windows: what attention gave it, `[rows, columns, stored]`.
    pub made: Vec<Vec<Vec<E>>>,
    pub workers: Vec<Worker<E>>,
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

impl<E: Number> Fuse for Transformer<E> {
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
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
                block.run(
                    tiles,
                    states,
                    made,
                    ends.then_some(&round.forward),
                    &mut Crew { workers, pool },
                );
            }
        }
        std::mem::take(&mut states[0].map)
    }
}

impl<E: Number> Transformer<E> {
    /// Takes an agent's map in the ego's cells, with what its delay adds.
    pub fn take(&self, agent: &Agent, size: [usize; 2], state: &mut State, pool: &mut Pool) {
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
