//! A model's list of layers, computed on a device.

use std::collections::HashMap;

use candle_core::{DType, Device, Tensor};
use realo_kernels::agents;
use realo_kernels::bev::BevView;
use realo_kernels::canvas::Canvas;
use realo_nn::layers::{FuseLayer, Layer, Layers, MapId};
use realo_nn::weights::Weights;

use super::convolution::Convolution;

use crate::arch::{AnyMethod, Arch, Model};
use crate::network::{NetworkError, check_agents, check_confidence, check_map, check_size};
use crate::tensors::ops::sigmoid;
use crate::tensors::planes::{cells, planes};
use crate::tensors::{Agent, AgentMap, OwnMap, Tensors};

/// Why a network computes nothing.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// What it was given does not fit.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// The device.
    #[error("candle: {0}")]
    Candle(#[from] candle_core::Error),
}

/// A network on a device; what it gives lies there, in f32.
pub struct Network {
    name: String,
    arch: Arch,
    layers: Layers,
    tensors: Tensors,
    /// By the map that each makes.
    convolutions: HashMap<MapId, Convolution>,
    device: Device,
}

impl Network {
    /// The network of a model; `products`: number type of convolutions and linear layers, all else is computed in f32.
    ///
    /// # Errors
    /// [`NetworkError::Model`], and those of the device.
    ///
    /// # Panics
    /// If the weights are those of another model.
    pub fn new(model: &Model, weights: &Weights, device: &Device, products: DType) -> Result<Self, Error> {
        model.validate().map_err(NetworkError::from)?;
        let layers = Layers::of(model);
        let tensors = Tensors::of(&layers, weights, device)?.with_products(products);
        let mut convolutions = HashMap::new();
        for step in layers.steps() {
            if let Layer::Convolution(layer) = &step.layer {
                convolutions.insert(step.to, Convolution::new(layer, &tensors, weights)?);
            }
        }
        Ok(Network {
            name: model.name.clone(),
            arch: model.arch.clone(),
            layers,
            tensors,
            convolutions,
            device: device.clone(),
        })
    }

    /// Waits until the device has computed everything that it was asked for.
    ///
    /// # Errors
    /// Those of the device.
    pub fn synchronise(&self) -> Result<(), Error> {
        Ok(self.device.synchronize()?)
    }

    /// A canvas on the device, `[rows, columns, channels]`: only the cells that were written are copied.
    ///
    /// # Errors
    /// [`NetworkError::Shape`], and those of the device.
    pub fn put_canvas(&self, canvas: &Canvas) -> Result<Tensor, Error> {
        let (rows, columns, channels) = (canvas.rows(), canvas.columns(), canvas.channels());
        let size = [rows, columns, channels];
        check_size("the canvas", &self.name, size, self.layers.size(self.layers.canvas))?;
        let mut written: Vec<[usize; 2]> = canvas.written_cells().collect();
        written.sort_unstable();
        written.dedup();
        let empty = Tensor::zeros((rows * columns, channels), DType::F32, &self.device)?;
        let filled = match written.len() {
            0 => empty,
            count => {
                let features = written.iter().flat_map(|[row, column]| canvas.cell(*row, *column));
                let features = Tensor::from_iter(features.copied(), &self.device)?.reshape((count, channels))?;
                let places = written.iter().map(|[row, column]| (row * columns + column) as u32);
                empty.index_add(&Tensor::from_iter(places, &self.device)?, &features, 0)?
            }
        };
        Ok(filled.reshape(size.to_vec())?)
    }

    /// A map that the agents share, or keep, on the device, `[rows, columns, channels]`.
    ///
    /// # Errors
    /// As [`crate::network::Network::fuse`], and those of the device.
    pub fn put_shared(&self, map: BevView) -> Result<Tensor, Error> {
        self.put(map, self.of_agents(map.channels))
    }

    /// A map that the heads read on the device, `[rows, columns, channels]`.
    ///
    /// # Errors
    /// As [`crate::network::Network::heads`], and those of the device.
    pub fn put_fused(&self, map: BevView) -> Result<Tensor, Error> {
        self.put(map, self.layers.fused)
    }

    fn put(&self, map: BevView, id: MapId) -> Result<Tensor, Error> {
        check_map(&self.name, map, self.layers.size(id))?;
        let size = (map.rows, map.columns, map.channels);
        Ok(Tensor::from_slice(map.data, size, &self.device)?)
    }

    /// The agents of a fusion on the device.
    ///
    /// # Errors
    /// As [`crate::network::Network::fuse`], and those of the device.
    pub fn put_agents(&self, agents: &[agents::Agent]) -> Result<Vec<Agent>, Error> {
        self.fusion(agents.len())?;
        let put = |agent: &agents::Agent| {
            check_confidence(agent)?;
            Ok(Agent {
                map: AgentMap::Own(OwnMap {
                    map: self.put_shared(agent.map)?,
                    confidence: agent.confidence.map(Vec::from),
                    warp: agent.warp,
                }),
                roadside: agent.roadside,
                delay: agent.delay,
            })
        };
        agents.iter().map(put).collect()
    }

    /// The map of the network that an agent's map of so many channels is.
    fn of_agents(&self, channels: usize) -> MapId {
        let Layers { kept, features, .. } = self.layers;
        if channels == self.layers.size(kept)[2] {
            kept
        } else {
            features
        }
    }

    /// From the canvas to the map that agents share, both `[rows, columns, channels]`.
    ///
    /// # Errors
    /// Those of the device.
    pub fn encode(&self, canvas: &Tensor) -> Result<Tensor, Error> {
        self.between(canvas, self.layers.canvas, self.layers.features)
    }

    /// From the canvas to the map that an agent keeps for its own fusion, both `[rows, columns, channels]`.
    ///
    /// # Errors
    /// Those of the device.
    pub fn encode_own(&self, canvas: &Tensor) -> Result<Tensor, Error> {
        self.between(canvas, self.layers.canvas, self.layers.kept)
    }

    /// Whether the map that an agent keeps is not the one that agents share.
    pub fn shares_another(&self) -> bool {
        self.layers.kept != self.layers.features
    }

    /// From the map that an agent keeps to the one that agents share, both `[rows, columns, channels]`.
    ///
    /// # Errors
    /// Those of the device.
    pub fn share(&self, kept: &Tensor) -> Result<Tensor, Error> {
        self.between(kept, self.layers.kept, self.layers.features)
    }

    /// An agent's map as it is fused.
    fn restored(&self, map: &Tensor) -> Result<Tensor, Error> {
        let from = self.of_agents(map.dims3()?.2);
        // What an agent has kept whole is fused as it is.
        match from == self.layers.features {
            true => self.between(map, from, self.layers.restored),
            false => Ok(map.clone()),
        }
    }

    /// From the maps that agents share, or keep, the ego's first, to the one that the heads read.
    ///
    /// # Errors
    /// [`NetworkError::NoFusion`], [`NetworkError::Agents`], and those of the device.
    pub fn fuse(&self, agents: &[Agent]) -> Result<Tensor, Error> {
        let (method, layer) = self.fusion(agents.len())?;
        let restored = |agent: &Agent| {
            let own = agent.own()?;
            let map = self.restored(&own.map)?;
            Ok(Agent {
                map: AgentMap::Own(OwnMap { map, ..own.clone() }),
                ..agent.clone()
            })
        };
        let agents = agents.iter().map(restored).collect::<Result<Vec<Agent>, Error>>()?;
        Ok(method.operation(layer, &self.tensors, &agents)?)
    }

    /// From the map that the heads read to `[rows, columns, scores and deltas]`.
    ///
    /// # Errors
    /// Those of the device.
    pub fn heads(&self, map: &Tensor) -> Result<Tensor, Error> {
        self.between(map, self.layers.fused, self.layers.heads)
    }

    /// As [`crate::network::Network::confidence`], of a map that agents share; `[rows, columns]`.
    ///
    /// # Errors
    /// Those of the device.
    pub fn confidence(&self, map: &Tensor) -> Result<Tensor, Error> {
        let scores = self.heads_alone(map)?.narrow(2, 0, self.scores())?;
        Ok(sigmoid(&scores.max(2)?)?)
    }

    /// As [`Network::heads`], of a map that agents share, by this map alone.
    ///
    /// # Errors
    /// Those of the device.
    pub fn heads_alone(&self, map: &Tensor) -> Result<Tensor, Error> {
        self.heads(&self.restored(map)?)
    }

    /// Numbers of scores in a cell of what [`Network::heads`] gives; deltas follow.
    pub fn scores(&self) -> usize {
        self.layers.size(self.layers.scores)[2]
    }

    /// How so many agents are fused.
    fn fusion(&self, agents: usize) -> Result<(&dyn AnyMethod, &FuseLayer), NetworkError> {
        let fusion = self.arch.method().zip(self.layers.fusion());
        let fusion = fusion.ok_or_else(|| NetworkError::NoFusion {
            model: self.name.clone(),
        })?;
        check_agents(&self.name, agents, self.arch.agents())?;
        Ok(fusion)
    }

    /// The map that convolutions make of another.
    fn between(&self, map: &Tensor, from: MapId, to: MapId) -> Result<Tensor, Error> {
        if from == to {
            return Ok(map.clone());
        }
        let given = planes(map)?.to_dtype(self.tensors.products())?;
        let mut maps = HashMap::from([(from, given)]);
        for step in self.layers.between(&[from], &[to]) {
            let made = match &step.layer {
                Layer::Convolution(_) => self.convolutions[&step.to].run(&maps[&step.from[0]])?,
                Layer::Join => {
                    let parts: Vec<&Tensor> = step.from.iter().map(|map| &maps[map]).collect();
                    Tensor::cat(&parts, 1)?
                }
                Layer::Points(_) | Layer::Fuse(_) => unreachable!("convolutions alone lead from map to map"),
            };
            maps.insert(step.to, made);
        }
        Ok(cells(&maps[&to].to_dtype(DType::F32)?)?)
    }
}
