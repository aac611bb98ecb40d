//! A network that is ready to run.

use std::path::Path;
use std::sync::{Arc, Mutex};

use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_kernels::conv::{Pool, lock, split};
use realo_nn::weights::Weights;

use super::checks::{check_agents, check_confidence, check_size, map_of, plain};
use super::core::Core;
use super::engine::Engine;
use super::error::NetworkError;
use super::heads::Heads;
use super::options::{Choice, NetworkOptions};
use super::part::{Made, Runner};
use crate::arch::Model;

/// A network that is ready to run; its maps are kept from one sweep to the next.
pub struct Network {
    core: Arc<Core>,
    pool: Arc<Mutex<Pool>>,
    encode: Box<dyn Runner>,
    compress: Option<Box<dyn Runner>>,
    restore: Option<Box<dyn Runner>>,
    heads: Box<dyn Runner>,
    result: Heads,
}

impl Network {
    /// Reads the weights of a model and builds its network.
    ///
    /// # Errors
    /// [`NetworkError::Weights`], and those of [`Network::new`].
    pub fn load(model: &Model, weights: &[impl AsRef<Path>], options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        Network::new(model, &Weights::read(weights, model)?, options)
    }

    /// Builds a network; `weights` are those of `model`.
    ///
    /// # Errors
    /// [`NetworkError::Model`], and [`NetworkError::Isa`] if the CPU lacks what the options ask for.
    pub fn new(model: &Model, weights: &Weights, options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        let core = Core::new(model, weights, &options)?;
        let pool = Pool::new(options.threads);
        Ok(Network::sharing(Arc::new(core), Arc::new(Mutex::new(pool))))
    }

    /// A network with maps of its own, and layers and threads that others use too.
    pub(crate) fn sharing(core: Arc<Core>, pool: Arc<Mutex<Pool>>) -> Network {
        Network {
            encode: core.encode.running(),
            compress: core.compress.as_ref().map(Engine::running),
            restore: core.restore.as_ref().map(Engine::running),
            heads: core.heads.running(),
            result: core.result(),
            core,
            pool,
        }
    }

    #[cfg(test)]
    pub(crate) fn shares_layers_with(&self, other: &Network) -> bool {
        Arc::ptr_eq(&self.core, &other.core)
    }

    #[cfg(test)]
    pub(crate) fn shares_threads_with(&self, other: &Network) -> bool {
        Arc::ptr_eq(&self.pool, &other.pool)
    }

    /// Its threads.
    pub(crate) fn pool(&self) -> Arc<Mutex<Pool>> {
        Arc::clone(&self.pool)
    }

    /// What it computes with.
    pub fn choice(&self) -> Choice {
        Choice {
            threads: lock(&self.pool).threads(),
            ..self.core.choice
        }
    }

    /// From the canvas to the heads.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn forward(&mut self, canvas: &Canvas) -> Result<Heads, NetworkError> {
        let map = self.encode(canvas)?;
        self.heads(&map).cloned()
    }

    /// From the canvas to the BEV map that agents share.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn encode(&mut self, canvas: &Canvas) -> Result<BevMap, NetworkError> {
        let kept = self.encode_own(canvas)?;
        Ok(self.share(&kept)?.unwrap_or(kept))
    }

    /// From the canvas to the BEV map that an agent keeps for its own fusion.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn encode_own(&mut self, canvas: &Canvas) -> Result<BevMap, NetworkError> {
        let size = [canvas.rows(), canvas.columns(), canvas.channels()];
        check_size("the canvas", &self.core.name, size, self.core.canvas)?;
        let mut pool = lock(&self.pool);
        let data = self.encode.run(&mut pool, canvas.view()).to_f32(&mut pool);
        Ok(map_of(self.core.kept, data))
    }

    /// From the map that an agent keeps to the one that agents share; `None` if they are the same.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] and [`NetworkError::Length`] for a map that does not fit.
    pub fn share<'a>(&mut self, kept: impl Into<BevView<'a>>) -> Result<Option<BevMap>, NetworkError> {
        let Some(compress) = &mut self.compress else {
            return Ok(None);
        };
        let view = plain(&self.core.name, kept.into(), self.core.kept)?;
        let mut pool = lock(&self.pool);
        let data = compress.run(&mut pool, view).to_f32(&mut pool);
        Ok(Some(map_of(self.core.features, data)))
    }

    /// From the maps that agents share, or keep, the ego's first, to the one that the heads read; an agent takes no part where its
    /// map does not reach.
    ///
    /// # Errors
    /// [`NetworkError::NoFusion`], [`NetworkError::Agents`]; [`NetworkError::Shape`] and [`NetworkError::Length`] for a map
    /// that does not fit.
    pub fn fuse(&mut self, agents: &[Agent]) -> Result<BevMap, NetworkError> {
        let core = &*self.core;
        let (fuser, most) = core.fusion.as_ref().ok_or_else(|| NetworkError::NoFusion {
            model: core.name.clone(),
        })?;
        check_agents(&core.name, agents.len(), *most)?;
        let mut pool = lock(&self.pool);
        let mut restored = Vec::new();
        for agent in agents {
            check_confidence(agent)?;
            restored.push(restore(core, self.restore.as_deref_mut(), agent.map, &mut pool)?);
        }
        let agents: Vec<Agent> = agents
            .iter()
            .zip(&restored)
            .map(|(agent, map)| match map {
                Some(map) => agent.with(map),
                None => *agent,
            })
            .collect();
        Ok(map_of(core.fused, fuser.run(&agents, &mut pool)))
    }

    /// How sure the heads are that each cell of a map that agents share or keep holds an object, 0 to 1, `[rows, columns]`, by this map
    /// alone: a fusion, which changes nothing in a single map that tells one cell from another, is left out.
    ///
    /// # Errors
    /// Those of [`Network::heads`].
    pub fn confidence<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<Vec<f32>, NetworkError> {
        Ok(self.heads_alone(map)?.confidence())
    }

    /// Scores and deltas of one shared or kept map without fusion. They stay until the next call.
    ///
    /// # Errors
    /// Those of [`Network::heads`].
    pub fn heads_alone<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<&Heads, NetworkError> {
        let map = map.into();
        let mut pool = lock(&self.pool);
        let restored = restore(&self.core, self.restore.as_deref_mut(), map, &mut pool)?;
        drop(pool);
        match restored {
            Some(restored) => self.heads(&restored),
            None => self.heads(map),
        }
    }

    /// From a BEV map to the heads, which stay until the next one. The map is read where it lies, unless the network computes
    /// in other numbers.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the map is not of the model's size, [`NetworkError::Length`] if it is not of its own.
    pub fn heads<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<&Heads, NetworkError> {
        let core = &*self.core;
        let view = plain(&core.name, map.into(), core.fused)?;
        let mut pool = lock(&self.pool);
        let Made::Single(numbers) = self.heads.run(&mut pool, view) else {
            unreachable!("heads are made in f32");
        };
        let heads = &mut self.result;
        let [scores, deltas] = core.outputs.map(|outputs| outputs * heads.columns);
        let shares = split(&mut heads.scores, scores, heads.rows, pool.threads(), 1).into_iter();
        let shares = shares.zip(split(&mut heads.deltas, deltas, heads.rows, pool.threads(), 1));
        pool.each(shares.collect(), |(of_scores, of_deltas)| {
            let rows = of_scores
                .data
                .chunks_exact_mut(scores)
                .zip(of_deltas.data.chunks_exact_mut(deltas));
            for (row, (to_scores, to_deltas)) in of_scores.range.zip(rows) {
                let [scores, deltas] = core.outputs;
                let cells = to_scores
                    .chunks_exact_mut(scores)
                    .zip(to_deltas.chunks_exact_mut(deltas));
                for (cell, (to_scores, to_deltas)) in numbers.row(row).zip(cells) {
                    to_scores.copy_from_slice(&cell[..scores]);
                    to_deltas.copy_from_slice(&cell[scores..]);
                }
            }
        });
        Ok(heads)
    }
}

/// A map that agents share as it is fused; `None` if it is already: where nothing is compressed, and where an agent has kept it whole.
fn restore(
    core: &Core,
    restore: Option<&mut (dyn Runner + 'static)>,
    map: BevView,
    pool: &mut Pool,
) -> Result<Option<BevMap>, NetworkError> {
    let is_whole = core.compress.is_some() && map.channels == core.kept[2];
    let expected = if is_whole { core.kept } else { core.features };
    let view = plain(&core.name, map, expected)?;
    let restore = restore.filter(|_| !is_whole);
    Ok(restore.map(|restore| map_of(core.fused, restore.run(pool, view).to_f32(pool))))
}
