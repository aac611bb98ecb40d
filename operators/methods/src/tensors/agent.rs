//! An agent's part of a fusion, on a device.

use candle_core::{Result, Tensor, bail};
use realo_kernels::warp::Warp;

use super::placed::Placed;

/// An agent's part of a fusion, on a device.
#[derive(Clone, Debug)]
pub struct Agent {
    /// Its map.
    pub map: AgentMap,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// How old its map is beside the ego's, in frames of 0.1 s.
    pub delay: usize,
}

/// An agent's map, where it was made or in the ego's cells.
#[derive(Clone, Debug)]
pub enum AgentMap {
    /// In the agent's own cells.
    Own(OwnMap),
    /// In the ego's cells.
    Placed(Placed),
}

/// A map in the cells of the agent that made it; fields as in [`realo_kernels::agents::Agent`].
#[derive(Clone, Debug)]
pub struct OwnMap {
    /// `[rows, columns, channels]`.
    pub map: Tensor,
    /// On the host.
    pub confidence: Option<Vec<f32>>,
    /// From the ego's cells to the map's.
    pub warp: Warp,
}

impl Agent {
    /// Its map in the ego's cells.
    ///
    /// # Errors
    /// Those of candle.
    pub fn placed(&self) -> Result<Placed> {
        match &self.map {
            AgentMap::Own(own) => Placed::new(&own.map, &own.warp, own.confidence.as_deref()),
            AgentMap::Placed(placed) => Ok(placed.clone()),
        }
    }

    /// Its map in its own cells.
    ///
    /// # Errors
    /// If the map is known in the ego's cells only.
    pub fn own(&self) -> Result<&OwnMap> {
        match &self.map {
            AgentMap::Own(own) => Ok(own),
            AgentMap::Placed(_) => bail!("expected a map in its maker's cells, found one in the ego's"),
        }
    }
}

/// The maps of agents in the ego's cells.
///
/// # Errors
/// Those of candle, and if there is no agent.
pub fn placed(agents: &[Agent]) -> Result<Vec<Placed>> {
    if agents.is_empty() {
        bail!("a fusion of no maps: expected the ego's at least");
    }
    agents.iter().map(Agent::placed).collect()
}
