//! A network on a device between maps on the host: what operators run. Every step is named and timed.
//!
//! | step | what |
//! |---|---|
//! | `to_device` | the copy of canvas or maps |
//! | `launch` | telling the device what to compute: as long as computing takes without synchronisation |
//! | `synchronisation` | waiting until the device is done: with `launch`, as long as computing takes |
//! | `masking` | of the maps that agents share: masking and quantisation on the device, the mask's copy among them |
//! | `to_host` | the copy of what the device has made, and putting the map together |

use candle_core::{DType, Device, Tensor};
use realo_nn::canvas::Canvas;
use realo_nn::fuse::Agent;
use realo_nn::model::Model;
use realo_nn::network::{BevMap, BevView, Heads};
use realo_nn::weights::Weights;
use realo_operator::Steps;
use realo_schemas::Elements;

use crate::copier::Copier;
use crate::network::{Error, Network};

/// A network on a device.
pub struct Engine {
    network: Network,
    elements: Elements,
    /// Made with the first map.
    copier: Option<Copier>,
    heads: Heads,
}

impl Engine {
    /// The network of a model; `elements`: what maps that agents share leave the device as. Fused maps and heads leave it as
    /// they are.
    ///
    /// # Errors
    /// Those of [`Network::new`].
    ///
    /// # Panics
    /// If the weights are those of another model.
    pub fn new(
        model: &Model,
        weights: &Weights,
        device: &Device,
        products: DType,
        elements: Elements,
    ) -> Result<Self, Error> {
        Ok(Engine {
            network: Network::new(model, weights, device, products)?,
            elements,
            copier: None,
            heads: Heads {
                rows: 0,
                columns: 0,
                scores: Vec::new(),
                deltas: Vec::new(),
            },
        })
    }

    /// From the canvas to the BEV map that agents share.
    ///
    /// # Errors
    /// Those of [`Network::put_canvas`] and [`Network::encode`].
    pub fn encode(&mut self, canvas: &Canvas, steps: &mut Steps) -> Result<BevMap, Error> {
        let network = &self.network;
        let copier = match &mut self.copier {
            Some(copier) => copier,
            none => {
                let empty = Canvas::new(canvas.rows(), canvas.columns(), canvas.channels());
                let empty = network.encode(&network.put_canvas(&empty)?)?;
                none.insert(Copier::new(self.elements, &empty)?)
            }
        };
        let canvas = steps.time("to_device", || network.put_canvas(canvas))?;
        let map = computed(network, steps, || network.encode(&canvas))?;
        let taken = steps.time("masking", || copier.take(&map))?;
        Ok(steps.time("to_host", || copier.copy(&taken))?.map)
    }

    /// As [`realo_nn::network::Network::confidence`].
    ///
    /// # Errors
    /// Those of [`Network::put_shared`] and [`Network::confidence`].
    pub fn confidence(&mut self, map: BevView, steps: &mut Steps) -> Result<Vec<f32>, Error> {
        let network = &self.network;
        let map = steps.time("to_device", || network.put_shared(map))?;
        let confidence = computed(network, steps, || network.confidence(&map))?;
        Ok(steps.time("to_host", || numbers(&confidence))?)
    }

    /// From the maps that agents share, the ego's first, to the one that the heads read.
    ///
    /// # Errors
    /// Those of [`Network::put_agents`] and [`Network::fuse`].
    pub fn fuse(&mut self, agents: &[Agent], steps: &mut Steps) -> Result<BevMap, Error> {
        let network = &self.network;
        let agents = steps.time("to_device", || network.put_agents(agents))?;
        let map = computed(network, steps, || network.fuse(&agents))?;
        let (rows, columns, channels) = map.dims3()?;
        let data = steps.time("to_host", || numbers(&map))?;
        Ok(BevMap {
            rows,
            columns,
            channels,
            data,
        })
    }

    /// From a BEV map to the heads, which stay until the next one.
    ///
    /// # Errors
    /// Those of [`Network::put_fused`] and [`Network::heads`].
    pub fn heads(&mut self, map: BevView, steps: &mut Steps) -> Result<&Heads, Error> {
        let network = &self.network;
        let map = steps.time("to_device", || network.put_fused(map))?;
        let made = computed(network, steps, || network.heads(&map))?;
        let (rows, columns, outputs) = made.dims3()?;
        let scores = network.scores();
        let part = |first: usize, count: usize| numbers(&made.narrow(2, first, count)?);
        let parts = steps.time("to_host", || {
            candle_core::Result::Ok((part(0, scores)?, part(scores, outputs - scores)?))
        });
        let (scores, deltas) = parts?;
        self.heads = Heads {
            rows,
            columns,
            scores,
            deltas,
        };
        Ok(&self.heads)
    }
}

/// Tells the device what to compute, and waits for it.
fn computed(
    network: &Network,
    steps: &mut Steps,
    compute: impl FnOnce() -> Result<Tensor, Error>,
) -> Result<Tensor, Error> {
    let made = steps.time("launch", compute)?;
    steps.time("synchronisation", || network.synchronise())?;
    Ok(made)
}

fn numbers(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}
