//! The transformer of V2X-ViT, as `realo_nn::transformer` says it: of operations that gradients lead back through.
//!
//! Within it maps are `[cells, channels]`.

mod agents;
mod windows;

use candle_core::{Result, Tensor, bail};
use realo_nn::arch::Transformer as Settings;
use realo_nn::transformer::{ENCODER, LAYER_NORM_EPS, agents_key, forward_key, windows_key};

use crate::ops::layer_norm;
use crate::tensors::Tensors;
use crate::warp::Placed;

/// An agent's part of the fusion.
#[derive(Clone, Debug)]
pub struct Agent {
    /// Its map in the ego's cells.
    pub placed: Placed,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// How old its map is beside the ego's, in frames of 0.1 s.
    pub delay: usize,
}

/// The fused map, `[rows, columns, channels]`, of agents' maps of this size; the first agent is the ego.
///
/// # Errors
/// If there is no agent, a tensor of the model is not there, or a map does not fit.
pub fn fuse(settings: &Settings, tensors: &Tensors, agents: &[Agent]) -> Result<Tensor> {
    let Some(ego) = agents.first() else {
        bail!("a fusion of no maps: expected the ego's at least");
    };
    let (rows, columns, channels) = ego.placed.map.dims3()?;
    let transformer = Transformer {
        settings,
        tensors,
        size: [rows, columns],
    };
    let states: Result<Vec<State>> = agents.iter().map(|agent| transformer.state(agent)).collect();
    transformer.run(states?)?.reshape((rows, columns, channels))
}

struct Transformer<'a> {
    settings: &'a Settings,
    tensors: &'a Tensors,
    /// Rows and columns.
    size: [usize; 2],
}

/// An agent on its way through the transformer.
struct State {
    kind: usize,
    map: Tensor,
    /// `[cells, 1]`: 0 where the agent can be asked, see [`Placed::absence`].
    absence: Tensor,
}

impl Transformer<'_> {
    fn run(&self, mut states: Vec<State>) -> Result<Tensor> {
        let Settings { depth, blocks, .. } = *self.settings;
        for round in 0..depth {
            for block in 0..blocks {
                // Only the ego's map is read after the last attention over agents.
                let is_last = round + 1 == depth && block + 1 == blocks;
                let asking = if is_last { 1 } else { states.len() };
                let given = self.over_agents(&agents_key(round, block), &states, asking)?;
                states.truncate(asking);
                for (state, given) in states.iter_mut().zip(given) {
                    state.map = (&state.map + given)?;
                    let given = self.over_windows(&windows_key(round, block), &state.map)?;
                    state.map = (&state.map + given)?;
                }
            }
            for state in &mut states {
                let given = self.forward(&forward_key(round), &state.map)?;
                state.map = (&state.map + given)?;
            }
        }
        Ok(states.swap_remove(0).map)
    }

    /// An agent's map with what its delay adds.
    fn state(&self, agent: &Agent) -> Result<State> {
        let [rows, columns] = self.size;
        let cells = |tensor: &Tensor| tensor.reshape((rows * columns, ()));
        let key = format!("{ENCODER}.rte.emb");
        let table = self.tensors.get(&format!("{key}.emb.weight"))?;
        let row = agent.delay.saturating_mul(self.settings.delay_ratio);
        let row = table.narrow(0, row.min(table.dim(0)? - 1), 1)?;
        let added = self.tensors.linear(&format!("{key}.lin"), &row)?;
        let Placed { map, reach, .. } = &agent.placed;
        Ok(State {
            kind: usize::from(agent.roadside),
            map: (cells(map)? + cells(reach)?.broadcast_mul(&added)?)?,
            absence: cells(&agent.placed.absence()?)?,
        })
    }

    fn norm(&self, key: &str, from: &Tensor) -> Result<Tensor> {
        let part = |name: &str| self.tensors.get(&format!("{key}.{name}"));
        layer_norm(from, part("weight")?, part("bias")?, f64::from(LAYER_NORM_EPS))
    }

    fn forward(&self, key: &str, map: &Tensor) -> Result<Tensor> {
        let normed = self.norm(&format!("{key}.norm"), map)?;
        let wide = self.tensors.linear(&format!("{key}.fn.net.0"), &normed)?;
        self.tensors.linear(&format!("{key}.fn.net.3"), &wide.gelu_erf()?)
    }
}
