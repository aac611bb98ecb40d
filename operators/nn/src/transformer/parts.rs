//! The parts of a transformer, each by itself: what a check against another implementation asks for.

use super::{Asked, Transformer};
use crate::conv::{Map, Pool};
use crate::fuse::Agent;
use crate::layers::{FuseLayer, Fusion, Layers};
use crate::model::Model;
use crate::network::{BevMap, BevView, NetworkError, NetworkOptions, choose};
use crate::weights::Weights;

/// The parts of a transformer as fusions run them, in f32: those of its first round, and of the first block there.
pub struct Parts {
    transformer: Transformer<f32>,
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
    /// The parts that a model with a transformer has.
    ///
    /// # Errors
    /// [`NetworkError`] if the model has none, the weights are not its, or the CPU lacks the instructions.
    pub fn new(model: &Model, weights: &Weights, options: NetworkOptions) -> Result<Self, NetworkError> {
        let choice = choose(model, &options)?;
        match Layers::of(model).fusion() {
            Some(FuseLayer {
                fusion: Fusion::Transformer(settings),
                channels,
            }) => Ok(Parts {
                transformer: Transformer::new(settings, *channels, weights, choice.isa),
                pool: Pool::new(choice.threads),
            }),
            _ => Err(NetworkError::NoFusion {
                model: model.name.clone(),
            }),
        }
    }

    /// An agent's map in the ego's cells, with what its delay adds.
    pub fn delayed(&mut self, agent: &Agent, ego: Agent) -> BevMap {
        let state = self.transformer.state(agent, ego, &mut self.pool);
        self.taken(&state.map)
    }

    /// What attention over agents gives each of them; without norm and sum.
    pub fn over_agents(&mut self, agents: &[Asking]) -> Vec<BevMap> {
        let maps: Vec<Map<f32>> = agents.iter().map(|agent| self.given(&agent.map)).collect();
        let asked: Vec<Asked> = agents
            .iter()
            .map(|agent| Asked {
                kind: usize::from(agent.roadside),
                covered: agent.covered,
            })
            .collect();
        let attention = &self.transformer.rounds[0].blocks[0].0;
        let asking = 0..agents.len();
        let given: Vec<Map<f32>> = asking
            .map(|asks| attention.ask(&asked, &maps, asks, &mut self.pool))
            .collect();
        given.iter().map(|map| self.taken(map)).collect()
    }

    /// What attention within windows of the size at an index of the settings gives; without norm and sum.
    pub fn within_windows(&mut self, index: usize, map: &BevView) -> BevMap {
        let map = self.given(map);
        let within = &self.transformer.rounds[0].blocks[0].1.windows[index];
        let given = within.run(&map, map.channels, &mut self.pool);
        self.taken(&given)
    }

    /// One map of those that attention within windows of each size gave.
    pub fn split_attention(&mut self, made: &[BevView]) -> BevMap {
        let made: Vec<Map<f32>> = made.iter().map(|map| self.given(map)).collect();
        let mut sum = Map::new(made[0].rows, made[0].columns, made[0].channels);
        let split = &self.transformer.rounds[0].blocks[0].1.split;
        split.add(&made, &mut sum, &mut self.pool);
        self.taken(&sum)
    }

    /// What attention within windows of all sizes gives; without norm and sum.
    pub fn over_windows(&mut self, map: &BevView) -> BevMap {
        let map = self.given(map);
        let mut sum = Map::new(map.rows, map.columns, map.channels);
        let windows = &self.transformer.rounds[0].blocks[0].1;
        windows.add(&map, &mut sum, &mut self.pool);
        self.taken(&sum)
    }

    /// What the feed-forward adds to a map, its norm included.
    pub fn feed_forward(&mut self, map: &BevView) -> BevMap {
        let map = self.given(map);
        let given = self.transformer.rounds[0].forward.given(&map, &mut self.pool);
        self.taken(&given)
    }

    fn given(&mut self, map: &BevView) -> Map<f32> {
        let mut given = Map::new(map.rows, map.columns, map.channels);
        given.fill_with(&mut self.pool, map.data);
        given
    }

    fn taken(&mut self, map: &Map<f32>) -> BevMap {
        BevMap {
            rows: map.rows,
            columns: map.columns,
            channels: map.channels,
            data: map.to_f32(&mut self.pool),
        }
    }
}
