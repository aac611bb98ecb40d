//! The messages on tensors, as the kernel says them.

use candle_core::{DType, Result, Tensor, bail};

use super::keys::{NET, UNIT};
use crate::tensors::ops::sigmoid;
use crate::tensors::planes::{cells, planes};
use crate::tensors::{Agent, OwnMap, Placed, Tensors};

/// The fused map, `[rows, columns, channels]`, of agents' maps, the ego's first.
pub fn fuse(rounds: usize, tensors: &Tensors, agents: &[Agent]) -> Result<Tensor> {
    if agents.is_empty() {
        bail!("a fusion of no maps: expected the ego's at least");
    }
    let messages = Messages { tensors };
    let mut agents = agents
        .iter()
        .map(|agent| agent.own().cloned())
        .collect::<Result<Vec<OwnMap>>>()?;
    for round in 0..rounds {
        // Nobody reads what others than the ego make of the last messages.
        let listening = if round + 1 == rounds { 1 } else { agents.len() };
        let heard = (0..listening).map(|index| messages.listen(&agents, index));
        let heard = heard.collect::<Result<Vec<Tensor>>>()?;
        agents
            .iter_mut()
            .zip(heard)
            .for_each(|(agent, heard)| agent.map = heard);
    }
    let ego = &agents[0].map;
    let made = tensors.linear(&format!("{NET}.mlp"), &ego.flatten_to(1)?)?;
    made.reshape(ego.shape())
}

struct Messages<'a> {
    tensors: &'a Tensors,
}

impl Messages<'_> {
    /// An agent's map after the messages of all, its own among them.
    fn listen(&self, agents: &[OwnMap], index: usize) -> Result<Tensor> {
        let OwnMap { map: own, warp, .. } = &agents[index];
        let to_ego = warp.inverse();
        let mut sum = own.zeros_like()?;
        for agent in agents {
            let warp = agent.warp.after(&to_ego);
            let Placed { map, covered, .. } = Placed::new(&agent.map, &warp, agent.confidence.as_deref())?;
            let both = Tensor::cat(&[&map, own], 2)?;
            let message = cells(&self.convolution(&format!("{NET}.msg_cnn"), &planes(&both)?, None)?)?;
            sum = (sum + message.broadcast_mul(&covered)?)?;
        }
        let mean = (sum / agents.len() as f64)?;
        self.unit(&Tensor::cat(&[own, &mean], 2)?)
    }

    /// The gated unit, which forgets everything between rounds: `sigmoid(update) * tanh(candidate)`.
    fn unit(&self, inputs: &Tensor) -> Result<Tensor> {
        let inputs = planes(inputs)?;
        let channels = inputs.dim(1)? / 2;
        // The gates are those of the reset, then those of the update.
        let update = self.convolution(&format!("{UNIT}.conv_gates"), &inputs, Some((channels, channels)))?;
        let candidate = self.convolution(&format!("{UNIT}.conv_can"), &inputs, None)?;
        cells(&(sigmoid(&update)? * candidate.tanh()?)?)
    }

    /// A 3x3 convolution with its biases, of all outputs or of so many from the first one given on. Inputs that the kernel
    /// has beyond those of the map are a state of zeros.
    fn convolution(&self, key: &str, map: &Tensor, outputs: Option<(usize, usize)>) -> Result<Tensor> {
        let part = |name: &str| {
            let tensor = self.tensors.get(&format!("{key}.{name}"))?;
            match outputs {
                Some((first, count)) => tensor.narrow(0, first, count),
                None => Ok(tensor.clone()),
            }
        };
        let weight = part("weight")?.narrow(1, 0, map.dim(1)?)?.contiguous()?;
        let products = self.tensors.products();
        let made = map
            .to_dtype(products)?
            .conv2d(&weight.to_dtype(products)?, 1, 1, 1, 1)?;
        made.to_dtype(DType::F32)?
            .broadcast_add(&part("bias")?.reshape((1, (), 1, 1))?)
    }
}
