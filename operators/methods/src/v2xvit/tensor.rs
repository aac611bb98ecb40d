//! The transformer on tensors, as the kernel says it: of operations that gradients lead back through.

use candle_core::{Result, Tensor, bail};

use super::keys::{agents_key, forward_key, windows_key};
use super::settings::Settings;
use super::tensor_parts::{State, Transformer};
use crate::tensors::{Agent, Tensors};

/// The fused map, `[rows, columns, channels]`, of agents' maps of this size; the first agent is the ego.
///
/// # Errors
/// If there is no agent, a tensor of the model is not there, or a map does not fit.
pub fn fuse(settings: &Settings, tensors: &Tensors, agents: &[Agent]) -> Result<Tensor> {
    let Some(ego) = agents.first() else {
        bail!("a fusion of no maps: expected the ego's at least");
    };
    let (rows, columns, channels) = ego.placed()?.map.dims3()?;
    let transformer = Transformer {
        settings,
        tensors,
        size: [rows, columns],
    };
    let states: Result<Vec<State>> = agents.iter().map(|agent| transformer.state(agent)).collect();
    transformer.run(states?)?.reshape((rows, columns, channels))
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
}
