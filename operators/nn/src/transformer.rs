//! The transformer of V2X-ViT: attention over agents, each cell by itself; attention within windows of the map; feed-forward.
//!
//! The result is the ego's map. What nobody reads for it is not computed: in the last attention over agents only the ego asks,
//! and what follows is the ego's alone. An agent that is not there, or whose map does not reach a cell, is not asked.
//!
//! Workers take tiles of the map through one layer after the other. All of them wait only where a mean over the whole map
//! decides how much each size of windows counts.

mod agents;
mod parts;
mod tiles;
mod weights;
mod windows;

use std::ops::Range;
use std::sync::Mutex;

use agents::OverAgents;
pub use parts::{Asking, Parts};
use tiles::{Tile, Tiles, Worker};
pub use weights::initial_delays;
pub(crate) use weights::tensors;
use windows::{OverWindows, add_counted, sum_up};

use crate::arch::Window;
use crate::cells::{Linear, line, line_mut};
use crate::conv::{Map, Pool, split};
use crate::fuse::{Agent, place};
use crate::load::lock;
use crate::math::{erf, product, sum};
use crate::part::Number;
use crate::simd::dispatch;

/// Kinds of agents: vehicles, and roadside units.
const KINDS: usize = 2;
/// Added to the variance by every layer norm.
const LAYER_NORM_EPS: f32 = 1e-5;

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

struct Block<E> {
    agents: OverAgents<E>,
    windows: OverWindows<E>,
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
        let [rows, columns] = [agents[0].map.rows, agents[0].map.columns];
        states.resize_with(states.len().max(agents.len()), State::default);
        workers.resize_with(pool.threads(), Worker::new);
        let states = &mut states[..agents.len()];
        for (state, agent) in states.iter_mut().zip(agents) {
            self.take(agent, [rows, columns], state, pool);
        }
        let cut = Cut {
            tiles: Tiles::new(&self.windows, columns),
            rows,
            columns,
        };
        let last = self.rounds.len() - 1;
        let mut asking = agents.len();
        for (depth, round) in self.rounds.iter().enumerate() {
            for (index, block) in round.blocks.iter().enumerate() {
                let ends = index == round.blocks.len() - 1;
                if ends && depth == last {
                    asking = 1;
                }
                made.resize_with(made.len().max(asking), Vec::new);
                let made = &mut made[..asking];
                let means = block.attend(&cut, states, made, workers, pool);
                let counts: Vec<Vec<f32>> = means.iter().map(|mean| block.windows.split.counts(mean)).collect();
                let forward = ends.then_some(&round.forward);
                cut.conclude(&mut states[..asking], made, &counts, forward, workers, pool);
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

/// How maps are cut for workers.
struct Cut {
    tiles: Tiles,
    rows: usize,
    columns: usize,
}

/// One worker's rows of several maps.
struct Share<'a, T> {
    rows: Range<usize>,
    maps: Vec<&'a mut [T]>,
}

/// Rows of so many numbers of maps, for each worker; `scale` rows stay together.
fn shares<'a, T>(
    maps: impl Iterator<Item = &'a mut Vec<T>>,
    [rows, length]: [usize; 2],
    workers: usize,
    scale: usize,
) -> Vec<Share<'a, T>> {
    let share = |_| Share {
        rows: 0..0,
        maps: Vec::new(),
    };
    let mut shares: Vec<Share<T>> = (0..workers).map(share).collect();
    for map in maps {
        for (share, part) in shares.iter_mut().zip(split(map, length, rows, workers, scale)) {
            share.rows = part.range;
            share.maps.push(part.data);
        }
    }
    shares
}

impl Cut {
    /// Whole tiles' rows of maps with so many numbers in a cell, for each worker.
    fn shares<'a, T>(
        &self,
        maps: impl Iterator<Item = &'a mut Vec<T>>,
        numbers: usize,
        workers: usize,
    ) -> Vec<Share<'a, T>> {
        shares(maps, [self.rows, self.columns * numbers], workers, self.tiles.rows)
    }

    /// Where rows of a tile's height lie that begin at a row of a share.
    fn band(&self, from: usize, numbers: usize) -> Range<usize> {
        let length = self.columns * numbers;
        from * length..(from + self.tiles.rows) * length
    }

    /// Adds what windows gave, each by how much it counts, and what the feed-forward makes of that, if one follows.
    fn conclude<E: Number>(
        &self,
        states: &mut [State],
        made: &[Vec<Vec<E>>],
        counts: &[Vec<f32>],
        forward: Option<&Forward<E>>,
        workers: &mut [Worker<E>],
        pool: &mut Pool,
    ) {
        let cells = self.rows * self.columns;
        let channels = states[0].map.len() / cells;
        let shares = self.shares(states.iter_mut().map(|state| &mut state.map), channels, workers.len());
        pool.each(shares.into_iter().zip(workers).collect(), |(mut share, worker)| {
            for row in share.rows.clone().step_by(self.tiles.rows) {
                let own = self.band(row - share.rows.start, channels);
                for (map, (made, counts)) in share.maps.iter_mut().zip(made.iter().zip(counts)) {
                    let map = &mut map[own.clone()];
                    for tile in self.tiles.across() {
                        for (made, counts) in made.iter().zip(counts.chunks_exact(channels)) {
                            let stored = made.len() / cells;
                            let made = tile.lines(&made[self.band(row, stored)], stored);
                            for (made, to) in made.zip(tile.lines_mut(map, channels)) {
                                add_counted(made, stored, counts, to);
                            }
                        }
                        if let Some(forward) = forward {
                            let given = forward.run(tile, map, worker);
                            tile.add(line(&given), channels, map);
                            worker.keep_single([given]);
                        }
                    }
                }
            }
        });
    }
}

impl<E: Number> Block<E> {
    /// Attention over agents, added to the maps of those who ask, and within windows, to `made`. Returns the mean over all
    /// cells of what was made for each of them.
    fn attend(
        &self,
        cut: &Cut,
        states: &mut [State],
        made: &mut [Vec<Vec<E>>],
        workers: &mut [Worker<E>],
        pool: &mut Pool,
    ) -> Vec<Vec<f32>> {
        let (cells, asking) = (cut.rows * cut.columns, made.len());
        let (channels, sizes) = (states[0].map.len() / cells, self.windows.windows.len());
        let stored = channels.next_multiple_of(E::PER_UNIT);
        for made in made.iter_mut() {
            made.resize_with(sizes, Vec::new);
            made.iter_mut()
                .for_each(|made| made.resize(cells * stored, E::default()));
        }
        let bands = cut.rows / cut.tiles.rows;
        // A sum for each tile's height of rows, so that threads change no order.
        let mut sums = vec![vec![0.0f32; bands * channels]; asking];
        let (asks, others) = states.split_at_mut(asking);
        let kinds: Vec<usize> = asks.iter().chain(&*others).map(|state| state.kind).collect();
        let mut covers = Vec::new();
        let mut maps = Vec::new();
        for state in asks {
            covers.push(&state.covered);
            maps.push(&mut state.map);
        }
        covers.extend(others.iter().map(|state| &state.covered));
        let others: Vec<&[f32]> = others.iter().map(|state| &state.map[..]).collect();
        let threads = workers.len();
        let shares = cut.shares(maps.into_iter(), channels, threads).into_iter();
        let shares = shares.zip(cut.shares(made.iter_mut().flatten(), stored, threads));
        let of_sums = self::shares(sums.iter_mut(), [bands, channels], threads, 1);
        pool.each(
            shares.zip(of_sums).zip(workers).collect(),
            |(((mut maps, mut made), mut sums), worker)| {
                for (index, row) in maps.rows.clone().step_by(cut.tiles.rows).enumerate() {
                    let start = row - maps.rows.start;
                    let (own, all) = (cut.band(start, channels), cut.band(row, channels));
                    for tile in cut.tiles.across() {
                        let mut bands: Vec<&mut [f32]> =
                            maps.maps.iter_mut().map(|map| &mut map[own.clone()]).collect();
                        let others: Vec<&[f32]> = others.iter().map(|map| &map[all.clone()]).collect();
                        let covers = covers
                            .iter()
                            .map(|covered| tile.lines(&covered[cut.band(row, 1)], 1).flatten().copied().collect());
                        let covers: Vec<Vec<bool>> = covers.collect();
                        let asked = kinds
                            .iter()
                            .zip(&covers)
                            .map(|(kind, covered)| Asked { kind: *kind, covered });
                        let asked: Vec<Asked> = asked.collect();
                        self.over_agents(tile, &mut bands, &others, &asked, worker);
                        let made = made.maps.chunks_exact_mut(sizes).zip(&mut sums.maps);
                        for (band, (made, sums)) in bands.iter().zip(made) {
                            let given = self.windows.run(tile, band, worker);
                            for (given, to) in given.iter().zip(made) {
                                let to = tile.lines_mut(&mut to[cut.band(start, stored)], stored);
                                for (given, to) in line(given).chunks_exact(tile.columns * stored).zip(to) {
                                    to.copy_from_slice(given);
                                }
                                sum_up(line(given), stored, &mut sums[index * channels..][..channels]);
                            }
                            worker.keep_own(given);
                        }
                    }
                }
            },
        );
        sums.iter().map(|sums| mean(sums, channels, cells)).collect()
    }

    /// Attention over agents in a tile, added to those who ask; `others` do not.
    fn over_agents(
        &self,
        tile: Tile,
        asking: &mut [&mut [f32]],
        others: &[&[f32]],
        asked: &[Asked],
        worker: &mut Worker<E>,
    ) {
        let attention = &self.agents;
        let all = asking.iter().map(|rows| &**rows).chain(others.iter().copied());
        let normed: Vec<Map<E>> = all.map(|rows| attention.norm.run(tile, rows, worker)).collect();
        for (asks, rows) in asking.iter_mut().enumerate() {
            let given = attention.ask(asked, &normed, asks, worker);
            tile.add(line(&given), given.channels, rows);
            worker.keep_single([given]);
        }
        worker.keep_own(normed);
    }
}

/// The mean over cells, from sums over some of them each.
fn mean(sums: &[f32], channels: usize, cells: usize) -> Vec<f32> {
    let mut mean = vec![0.0f32; channels];
    for sums in sums.chunks_exact(channels) {
        mean.iter_mut().zip(sums).for_each(|(mean, sum)| *mean += sum);
    }
    mean.iter_mut().for_each(|mean| *mean /= cells as f32);
    mean
}

impl Tile {
    /// Adds its cells to rows of a map.
    fn add(self, cells: &[f32], channels: usize, rows: &mut [f32]) {
        let lines = cells.chunks_exact(self.columns * channels);
        for (from, to) in lines.zip(self.lines_mut(rows, channels)) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
        }
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
