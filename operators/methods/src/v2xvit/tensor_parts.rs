//! What all of the transformer on tensors needs: its settings and weights, agents on their way, norms and feed-forwards.
//!
//! Within it maps are `[cells, channels]`.

use candle_core::{Result, Tensor};

use super::keys::ENCODER;
use super::norm::LAYER_NORM_EPS;
use super::settings::Settings;
use crate::tensors::ops::layer_norm;
use crate::tensors::{Agent, Placed, Tensors};

/// A transformer on tensors.
pub struct Transformer<'a> {
    pub settings: &'a Settings,
    pub tensors: &'a Tensors,
    /// Rows and columns.
    pub size: [usize; 2],
}

/// An agent on its way through the transformer.
pub struct State {
    pub kind: usize,
    pub map: Tensor,
    /// `[cells, 1]`: 0 where the agent can be asked, see [`Placed::absence`].
    pub absence: Tensor,
}

impl Transformer<'_> {
    /// An agent's map with what its delay adds.
    pub fn state(&self, agent: &Agent) -> Result<State> {
        let [rows, columns] = self.size;
        let cells = |tensor: &Tensor| tensor.reshape((rows * columns, ()));
        let key = format!("{ENCODER}.rte.emb");
        let table = self.tensors.get(&format!("{key}.emb.weight"))?;
        let row = agent.delay.saturating_mul(self.settings.delay_ratio);
        let row = table.narrow(0, row.min(table.dim(0)? - 1), 1)?;
        let added = self.tensors.linear(&format!("{key}.lin"), &row)?;
        let placed = agent.placed()?;
        let Placed { map, reach, .. } = &placed;
        Ok(State {
            kind: usize::from(agent.roadside),
            map: (cells(map)? + cells(reach)?.broadcast_mul(&added)?)?,
            absence: cells(&placed.absence()?)?,
        })
    }

    pub fn norm(&self, key: &str, from: &Tensor) -> Result<Tensor> {
        let part = |name: &str| self.tensors.get(&format!("{key}.{name}"));
        layer_norm(from, part("weight")?, part("bias")?, f64::from(LAYER_NORM_EPS))
    }

    pub fn forward(&self, key: &str, map: &Tensor) -> Result<Tensor> {
        let normed = self.norm(&format!("{key}.norm"), map)?;
        let wide = self.tensors.linear(&format!("{key}.fn.net.0"), &normed)?;
        self.tensors.linear(&format!("{key}.fn.net.3"), &wide.gelu_erf()?)
    }
}
