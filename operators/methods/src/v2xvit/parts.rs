//! The parts of a transformer, each by itself: what a check against another implementation asks for.

use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::cells::{line, line_mut};
use realo_kernels::conv::{Isa, Map, Pool};
use realo_nn::weights::Weights;

use super::blocks::mean;
use super::kernel::Transformer;
use super::settings::Settings;
use super::state::{Asked, State};
use super::tiles::{Tile, Worker};
use super::windows::{add_counted, sum_up};

/// The parts of a transformer as fusions run them, in f32: those of its first round, and of the first block there.
pub struct Parts {
    transformer: Transformer<f32>,
    worker: Worker<f32>,
    pool: Pool,
}

/// An agent in the attention over agents.
#[derive(Clone, Copy, Debug)]
pub struct Asking<'a> {
    /// Its map in the ego's cells.
    pub map: BevView<'a>,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// `[rows, columns]`: where it can be asked.
    pub covered: &'a [bool],
}

impl Parts {
    /// The parts of a transformer on maps of so many channels; the instructions must be there.
    ///
    /// # Panics
    /// If the weights are those of another model.
    pub fn new(settings: &Settings, channels: usize, weights: &Weights, (isa, threads): (Isa, usize)) -> Self {
        Parts {
            transformer: Transformer::new(settings, channels, weights, isa),
            worker: Worker::new(),
            pool: Pool::new(threads),
        }
    }

    /// An agent's map in the ego's cells, with what its delay adds.
    pub fn delayed(&mut self, agent: &Agent, ego: Agent) -> BevMap {
        let mut state = State::default();
        let size = [ego.map.rows, ego.map.columns];
        self.transformer.take(agent, size, &mut state, &mut self.pool);
        BevMap {
            rows: size[0],
            columns: size[1],
            channels: self.transformer.channels,
            data: state.map,
        }
    }

    /// What attention over agents gives each of them; without norm and sum.
    pub fn over_agents(&mut self, agents: &[Asking]) -> Vec<BevMap> {
        let maps: Vec<Map<f32>> = agents.iter().map(|agent| taken(&agent.map)).collect();
        let asked: Vec<Asked> = agents
            .iter()
            .map(|agent| Asked {
                kind: usize::from(agent.roadside),
                covered: agent.covered,
            })
            .collect();
        let attention = &self.transformer.rounds[0].blocks[0].agents;
        let given = |(asks, agent): (usize, &Asking)| {
            let given = attention.ask(&asked, &maps, asks, &mut self.worker);
            made(&given, &agent.map)
        };
        agents.iter().enumerate().map(given).collect()
    }

    /// What attention within windows of the size at an index of the settings gives; without norm and sum.
    pub fn within_windows(&mut self, index: usize, map: &BevView) -> BevMap {
        let within = &self.transformer.rounds[0].blocks[0].windows.windows[index];
        made(&within.run(whole(map), &taken(map), &mut self.worker), map)
    }

    /// One map of those that attention within windows of each size gave.
    pub fn split_attention(&mut self, made: &[BevView]) -> BevMap {
        let channels = made[0].channels;
        let mut sums = vec![0.0; channels];
        made.iter().for_each(|map| sum_up(map.data, channels, &mut sums));
        let mean = mean(&[&sums], made[0].rows * made[0].columns);
        let counts = self.transformer.rounds[0].blocks[0].windows.split.counts(&mean);
        let mut data = vec![0.0; made[0].data.len()];
        for (map, counts) in made.iter().zip(counts.chunks_exact(channels)) {
            add_counted(map.data, channels, counts, &mut data);
        }
        BevMap {
            rows: made[0].rows,
            columns: made[0].columns,
            channels,
            data,
        }
    }

    /// What attention within windows of all sizes gives; without norm and sum.
    pub fn over_windows(&mut self, map: &BevView) -> BevMap {
        let sizes = 0..self.transformer.windows.len();
        let made: Vec<BevMap> = sizes.map(|index| self.within_windows(index, map)).collect();
        self.split_attention(&made.iter().map(BevView::from).collect::<Vec<_>>())
    }

    /// What the feed-forward adds to a map, its norm included.
    pub fn feed_forward(&mut self, map: &BevView) -> BevMap {
        let forward = &self.transformer.rounds[0].forward;
        made(&forward.run(whole(map), map.data, &mut self.worker), map)
    }
}

fn whole(map: &BevView) -> Tile {
    Tile::whole([map.rows, map.columns])
}

/// The cells of a map, as a tile.
fn taken(map: &BevView) -> Map<f32> {
    let mut taken = Map::new(1, map.rows * map.columns, map.channels);
    line_mut(&mut taken).copy_from_slice(map.data);
    taken
}

/// The map that a tile became which was another.
fn made(tile: &Map<f32>, from: &BevView) -> BevMap {
    BevMap {
        rows: from.rows,
        columns: from.columns,
        channels: tile.channels,
        data: line(tile).to_vec(),
    }
}
