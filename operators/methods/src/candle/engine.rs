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
use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::canvas::Canvas;
use realo_nn::weights::Weights;

use super::copier::{Copier, Elements};
use super::network::{Error, Network};
use crate::arch::Model;
use crate::network::Heads;

/// Watches the steps of a call: hears when each begins, and when it is done.
pub trait Watch {
    /// Does a step of a name.
    fn step(&mut self, name: &'static str, work: &mut dyn FnMut());
}

/// What a step makes.
fn timed<T>(steps: &mut dyn Watch, name: &'static str, work: impl FnOnce() -> T) -> T {
    let (mut work, mut made) = (Some(work), None);
    steps.step(name, &mut || made = work.take().map(|work| work()));
    made.expect("a watch does each step once")
}

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

    /// From the canvas to the BEV map that an agent keeps for its own fusion.
    ///
    /// # Errors
    /// Those of [`Network::put_canvas`] and [`Network::encode_own`].
    pub fn encode_own(&mut self, canvas: &Canvas, steps: &mut dyn Watch) -> Result<BevMap, Error> {
        let network = &self.network;
        let copier = match &mut self.copier {
            Some(copier) => copier,
            none => {
                let empty = Canvas::new(canvas.rows(), canvas.columns(), canvas.channels());
                let empty = network.encode_own(&network.put_canvas(&empty)?)?;
                none.insert(Copier::new(self.elements, &empty)?)
            }
        };
        let canvas = timed(steps, "to_device", || network.put_canvas(canvas))?;
        let map = computed(network, steps, || network.encode_own(&canvas))?;
        let taken = timed(steps, "masking", || copier.take(&map))?;
        Ok(timed(steps, "to_host", || copier.copy(&taken))?.map)
    }

    /// From the map that an agent keeps to the one that agents share; `None` if they are the same.
    ///
    /// # Errors
    /// Those of [`Network::put_shared`] and [`Network::share`].
    pub fn share(&mut self, kept: BevView, steps: &mut dyn Watch) -> Result<Option<BevMap>, Error> {
        let network = &self.network;
        if !network.shares_another() {
            return Ok(None);
        }
        let kept = timed(steps, "to_device", || network.put_shared(kept))?;
        let map = computed(network, steps, || network.share(&kept))?;
        Ok(Some(timed(steps, "to_host", || on_host(&map))?))
    }

    /// As [`crate::network::Network::confidence`].
    ///
    /// # Errors
    /// Those of [`Network::put_shared`] and [`Network::confidence`].
    pub fn confidence(&mut self, map: BevView, steps: &mut dyn Watch) -> Result<Vec<f32>, Error> {
        let network = &self.network;
        let map = timed(steps, "to_device", || network.put_shared(map))?;
        let confidence = computed(network, steps, || network.confidence(&map))?;
        Ok(timed(steps, "to_host", || numbers(&confidence))?)
    }

    /// From the maps that agents share, the ego's first, to the one that the heads read.
    ///
    /// # Errors
    /// Those of [`Network::put_agents`] and [`Network::fuse`].
    pub fn fuse(&mut self, agents: &[Agent], steps: &mut dyn Watch) -> Result<BevMap, Error> {
        let network = &self.network;
        let agents = timed(steps, "to_device", || network.put_agents(agents))?;
        let map = computed(network, steps, || network.fuse(&agents))?;
        Ok(timed(steps, "to_host", || on_host(&map))?)
    }

    /// From a BEV map to the heads, which stay until the next one.
    ///
    /// # Errors
    /// Those of [`Network::put_fused`] and [`Network::heads`].
    pub fn heads(&mut self, map: BevView, steps: &mut dyn Watch) -> Result<&Heads, Error> {
        let network = &self.network;
        let map = timed(steps, "to_device", || network.put_fused(map))?;
        let made = computed(network, steps, || network.heads(&map))?;
        self.keep(&made, steps)
    }

    /// As [`Engine::heads`], of a map that agents share, by this map alone.
    ///
    /// # Errors
    /// Those of [`Network::put_shared`] and [`Network::heads_alone`].
    pub fn heads_alone(&mut self, map: BevView, steps: &mut dyn Watch) -> Result<&Heads, Error> {
        let network = &self.network;
        let map = timed(steps, "to_device", || network.put_shared(map))?;
        let made = computed(network, steps, || network.heads_alone(&map))?;
        self.keep(&made, steps)
    }

    /// Takes what the heads made to the host, where it stays until the next one.
    fn keep(&mut self, made: &Tensor, steps: &mut dyn Watch) -> Result<&Heads, Error> {
        let (rows, columns, outputs) = made.dims3()?;
        let scores = self.network.scores();
        let part = |first: usize, count: usize| numbers(&made.narrow(2, first, count)?);
        let parts = timed(steps, "to_host", || {
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
    steps: &mut dyn Watch,
    compute: impl FnOnce() -> Result<Tensor, Error>,
) -> Result<Tensor, Error> {
    let made = timed(steps, "launch", compute)?;
    timed(steps, "synchronisation", || network.synchronise())?;
    Ok(made)
}

fn on_host(map: &Tensor) -> candle_core::Result<BevMap> {
    let (rows, columns, channels) = map.dims3()?;
    Ok(BevMap {
        rows,
        columns,
        channels,
        data: numbers(map)?,
    })
}

fn numbers(tensor: &Tensor) -> candle_core::Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}
