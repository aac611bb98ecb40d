//! The way back through the transformer: gradients of the agents' maps and of all weights.
//!
//! The way there keeps the maps between attention over agents, windows and feed-forward. What lies between these is computed
//! again, tile by tile, so that it stays in a core's cache. Sums of weights' gradients are made by band of the map, then added
//! in order: threads change no bit.

mod agents;
mod blocks;
mod forward;
mod layer;
mod load;
mod rows;
mod split;
mod sums;
mod windows;

use std::sync::Arc;

use realo_kernels::agents::{Agent, lead_back};
use realo_kernels::conv::{Isa, Pool};
use realo_nn::weights::Weights;

use self::blocks::{BlockBack, KeptBlock, Step};
use self::forward::ForwardBack;
use self::load::LoadBack;
use self::sums::Sums;
use super::kernel::Transformer;
use super::load::Load;
use super::settings::Settings;
use super::state::State;
use super::tiles::{Crew, Tiles, Worker};
use super::windows::sum_up;
use crate::method::{Back, Descent, Gradients};

/// A transformer in training.
pub struct Learner(Arc<BothWays>);

/// The layers of a transformer, and the ways back through them.
struct BothWays {
    settings: Settings,
    weights: Weights,
    isa: Isa,
    there: Transformer<f32>,
    /// As [`Transformer::rounds`].
    back: Vec<RoundBack>,
}

/// As [`Round`](super::kernel::Round).
struct RoundBack {
    blocks: Vec<BlockBack>,
    forward: ForwardBack,
}

/// What the way there keeps.
struct Kept {
    /// By agent.
    kinds: Vec<usize>,
    covered: Vec<Vec<bool>>,
    blocks: Vec<KeptBlock>,
}

impl Learner {
    /// `channels`: of the maps that are fused.
    pub fn new(settings: &Settings, channels: usize, weights: &Weights, isa: Isa) -> Self {
        let mut both = BothWays {
            settings: settings.clone(),
            weights: weights.clone(),
            isa,
            there: Transformer::new(settings, channels, weights, isa),
            back: Vec::new(),
        };
        let load = both.load();
        both.back = (0..settings.depth).map(|depth| load.round(depth)).collect();
        Learner(Arc::new(both))
    }
}

impl Descent for Learner {
    fn run(&self, agents: &[Agent], pool: &mut Pool) -> (Vec<f32>, Back) {
        let (fused, kept) = self.0.run(agents, pool);
        let both = Arc::clone(&self.0);
        let back = move |agents: &[Agent], gradient: &[f32], pool: &mut Pool| both.back(&kept, agents, gradient, pool);
        (fused, Box::new(back))
    }
}

impl BothWays {
    fn load(&self) -> LoadBack<'_> {
        LoadBack {
            load: Load {
                weights: &self.weights,
                isa: self.isa,
            },
            settings: &self.settings,
            channels: self.there.channels,
        }
    }

    fn run(&self, agents: &[Agent], pool: &mut Pool) -> (Vec<f32>, Kept) {
        let size = [agents[0].map.rows, agents[0].map.columns];
        let tiles = Tiles::new(&self.there.windows, size);
        let mut states: Vec<State> = agents.iter().map(|_| State::default()).collect();
        for (state, agent) in states.iter_mut().zip(agents) {
            self.there.take(agent, size, state, pool);
        }
        let mut workers = workers(pool);
        let mut crew = Crew {
            workers: &mut workers,
            pool,
        };
        let maps = |states: &[State]| states.iter().map(|state| state.map.clone()).collect();
        let (last, mut blocks) = (self.there.rounds.len() - 1, Vec::new());
        for (depth, round) in self.there.rounds.iter().enumerate() {
            for (index, block) in round.blocks.iter().enumerate() {
                let ends = index == round.blocks.len() - 1;
                let asking = if ends && depth == last { 1 } else { agents.len() };
                let before = maps(&states);
                let of_sizes = vec![vec![0.0; tiles.cells() * self.there.channels]; self.there.windows.len()];
                let mut made = vec![of_sizes; asking];
                let means = block.attend(tiles, &mut states, &mut made, &mut crew);
                let between = maps(&states[..asking]);
                let counts: Vec<Vec<f32>> = means.iter().map(|mean| block.windows.split.counts(mean)).collect();
                let rest = (&counts[..], ends.then_some(&round.forward));
                block.conclude(tiles, &mut states, &mut made, rest, &mut crew);
                blocks.push(KeptBlock {
                    before,
                    between,
                    made,
                    means,
                    counts,
                });
            }
        }
        let fused = std::mem::take(&mut states[0].map);
        let of_agents = states.into_iter().map(|state| (state.kind, state.covered));
        let (kinds, covered) = of_agents.unzip();
        (fused, Kept { kinds, covered, blocks })
    }

    fn back(&self, kept: &Kept, agents: &[Agent], gradient: &[f32], pool: &mut Pool) -> Gradients {
        let [rows, columns, channels] = [agents[0].map.rows, agents[0].map.columns, self.there.channels];
        let mut gradients = vec![vec![0.0; gradient.len()]; agents.len()];
        gradients[0].copy_from_slice(gradient);
        let (mut sums, mut workers) = (Sums::default(), workers(pool));
        let mut crew = Crew {
            workers: &mut workers,
            pool,
        };
        let rounds = self.there.rounds.iter().zip(&self.back);
        let blocks = rounds.flat_map(|(round, back)| {
            let last = round.blocks.len() - 1;
            let forward = move |index| (index == last).then_some((&round.forward, &back.forward));
            let blocks = round.blocks.iter().zip(&back.blocks).enumerate();
            blocks.map(move |(index, block)| (block, forward(index)))
        });
        let blocks: Vec<_> = blocks.zip(&kept.blocks).collect();
        for ((block, forward), of_block) in blocks.into_iter().rev() {
            let step = Step {
                tiles: Tiles::new(&self.there.windows, [rows, columns]),
                channels,
                kinds: &kept.kinds,
                covered: &kept.covered,
                kept: of_block,
                block,
                forward,
            };
            step.run(&mut gradients, &mut sums, &mut crew);
        }
        let maps = own_gradients(agents, columns, &gradients, &mut crew);
        let load = self.load();
        for (agent, map) in agents.iter().zip(&maps) {
            // What a delay adds is added to each of the map's own cells.
            load.lead_to_delays(agent.delay, &sum_of_cells(map, channels, columns), &mut sums);
        }
        load.conclude(&mut sums);
        Gradients { maps, tensors: sums.0 }
    }
}

fn workers(pool: &Pool) -> Vec<Worker<f32>> {
    (0..pool.threads()).map(|_| Worker::new()).collect()
}

/// The gradients of maps in their own cells, from those in the ego's.
fn own_gradients(agents: &[Agent], columns: usize, gradients: &[Vec<f32>], crew: &mut Crew<f32>) -> Vec<Vec<f32>> {
    let mut maps: Vec<(usize, Vec<f32>)> = agents
        .iter()
        .map(|agent| vec![0.0; agent.map.data.len()])
        .enumerate()
        .collect();
    crew.each(&mut maps, |(index, map), _| {
        lead_back(&agents[*index], columns, &gradients[*index], map)
    });
    maps.into_iter().map(|(_, map)| map).collect()
}

/// The sum of a map's cells; rows first, so that little is lost in rounding.
fn sum_of_cells(map: &[f32], channels: usize, columns: usize) -> Vec<f32> {
    let mut sum = vec![0.0; channels];
    for row in map.chunks_exact(columns * channels) {
        let mut of_row = vec![0.0; channels];
        sum_up(row, channels, &mut of_row);
        sum.iter_mut().zip(&of_row).for_each(|(sum, row)| *sum += row);
    }
    sum
}
