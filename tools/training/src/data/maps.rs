//! From a frame to what a fusion learns from: the maps of an ego and of others, brought to the ego's cells as graphs do.

use nalgebra::Isometry3;
use realo_kernels::agents::{Agent, placed};
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::warp::Warp;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::network::{Heads, Network, NetworkError, NetworkOptions};
use realo_methods::tensors::{self, AgentMap, Placed};
use realo_nn::model::Grid;
use realo_nn::weights::Weights;

use super::frame::{AgentSweep, Frame};
use super::sample::{Augmentation, Cast, Kept, Scene};
use crate::TrainError;
use crate::layers::tensor;
use crate::random::Stream;

/// Probability that the others bring their points to the ego's frame before they encode them.
const BY_SENDER: f64 = 0.5;

/// Probability that another agent's map is one of its earlier sweep.
const EARLIER: f64 = 0.4;

/// Who brings the others' features to the ego's frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Project {
    /// The others, by the ego's pose at the stamp of their sweep; what the ego moved since is left to the fusion.
    Sender,
    /// The fusion.
    Receiver,
}

/// An ego, those whose maps it fuses with its own, and how they come to it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Party {
    /// The ego, as index of a frame's agents.
    pub ego: usize,
    /// The others, and whether it is their earlier sweep.
    pub others: Vec<(usize, bool)>,
    /// Who brings features to the ego's frame.
    pub project: Project,
}

/// An agent's map and where it lies.
pub(crate) struct Encoded {
    map: BevMap,
    warp: Warp,
    roadside: bool,
    delay: usize,
}

impl Encoded {
    pub fn agent(&self) -> Agent<'_> {
        Agent {
            confidence: None,
            map: (&self.map).into(),
            warp: self.warp,
            roadside: self.roadside,
            delay: self.delay,
        }
    }

    /// The part of the map that lies on a grid within the ego's, for a fusion on candle's tensors.
    ///
    /// # Errors
    /// Those of candle.
    pub fn on(&self, model: &Model, grid: &Grid) -> candle_core::Result<tensors::Agent> {
        let cell = cell(model);
        let first = [(grid.x[0], model.grid.x[0]), (grid.y[0], model.grid.y[0])];
        let [column, row] = first.map(|(part, whole)| ((part - whole) / cell).round());
        let shift = Warp([[1.0, 0.0, column], [0.0, 1.0, row]]);
        let agent = Agent {
            warp: self.warp.after(&shift),
            ..self.agent()
        };
        let size = [grid.rows(), grid.columns()].map(|cells| cells / model.stride());
        let (map, covered) = placed(&agent, size);
        // What a map of ones would be there.
        let ones = vec![1.0; agent.map.rows * agent.map.columns];
        let ones = BevView {
            channels: 1,
            data: &ones,
            ..agent.map
        };
        let (reach, _) = placed(&Agent { map: ones, ..agent }, size);
        let tensor_of = |data: Vec<f32>, channels: usize| tensor(data, (size[0], size[1], channels));
        let covered = covered.into_iter().map(|covers| f32::from(u8::from(covers)));
        Ok(tensors::Agent {
            map: AgentMap::Placed(Placed {
                map: tensor_of(map.data, map.channels)?,
                reach: tensor_of(reach.data, 1)?,
                covered: tensor_of(covered.collect(), 1)?,
            }),
            roadside: self.roadside,
            delay: self.delay,
        })
    }
}

fn cell(model: &Model) -> f64 {
    model.grid.cell * model.stride() as f64
}

impl Party {
    /// Draws who takes part: at most as many as the model fuses.
    pub fn draw(frame: &Frame, model: &Model, how: &Augmentation, draws: &mut Stream) -> Self {
        let Cast { ego, mut others } = Cast::draw(frame, how, draws);
        while others.len() >= model.arch.agents() {
            others.remove(draws.below(others.len()));
        }
        let others = others.into_iter().map(|other| (other, draws.chance(EARLIER)));
        Party {
            ego,
            others: others.collect(),
            project: match draws.chance(BY_SENDER) {
                true => Project::Sender,
                false => Project::Receiver,
            },
        }
    }

    /// What takes part, the ego first.
    fn parts<'a>(&self, frame: &'a Frame) -> Vec<Part<'a>> {
        let of = |agent: usize, earlier: bool| {
            let then = frame.earlier.as_ref().filter(|_| earlier);
            let (agents, delay) = then.map_or((&frame.agents, 0), |then| (&then.agents, then.delay));
            Part {
                sweep: &agents[agent],
                delay,
                map_from_ego_then: agents[self.ego].map_from_body,
            }
        };
        let others = self.others.iter().map(|(agent, earlier)| of(*agent, *earlier));
        std::iter::once(of(self.ego, false)).chain(others).collect()
    }

    /// The objects around the ego of which those who take part have enough points.
    pub fn objects(&self, frame: &Frame, model: &Model) -> Scene {
        let sweeps: Vec<(&AgentSweep, f64)> = self.parts(frame).iter().map(|part| (part.sweep, 1.0)).collect();
        let mut scene = Scene::default();
        scene.add_objects(frame, &sweeps, model);
        scene
    }
}

/// A sweep that takes part.
struct Part<'a> {
    sweep: &'a AgentSweep,
    /// How old it is beside the ego's, in frames of 0.1 s.
    delay: usize,
    map_from_ego_then: Isometry3<f64>,
}

/// From points to maps, by weights that stay as they are.
pub(crate) struct MapEncoder {
    model: Model,
    pillarer: Pillarer,
    network: Network,
}

impl MapEncoder {
    /// The encoder of a model.
    ///
    /// # Errors
    /// [`NetworkError`] if the weights are not the model's.
    pub fn new(model: &Model, weights: &Weights, threads: usize) -> Result<Self, NetworkError> {
        let options = NetworkOptions {
            threads,
            ..NetworkOptions::default()
        };
        let network = Network::new(model, weights, options)?;
        Ok(MapEncoder {
            model: model.clone(),
            pillarer: Pillarer::beside(&network, model, weights),
            network,
        })
    }

    /// The maps of a party, the ego's first.
    ///
    /// # Errors
    /// [`TrainError::Network`].
    pub fn run(
        &mut self,
        frame: &Frame,
        party: &Party,
        how: &Augmentation,
        draws: &mut Stream,
    ) -> Result<Vec<Encoded>, TrainError> {
        let (grid, cell) = (&self.model.grid, cell(&self.model));
        let origin = [grid.x[0], grid.y[0]];
        let mut maps = Vec::new();
        let map_from_ego = frame.agents[party.ego].map_from_body;
        for (index, part) in party.parts(frame).into_iter().enumerate() {
            let is_ego = index == 0;
            let error = if is_ego {
                Isometry3::identity()
            } else {
                how.pose_error(draws)
            };
            let map_from_sweep = part.sweep.map_from_body * error;
            let map_from_points = match party.project {
                Project::Sender => part.map_from_ego_then,
                Project::Receiver => map_from_sweep,
            };
            let mut scene = Scene::default();
            let points_from_sweep = map_from_points.inverse() * map_from_sweep;
            scene.add_points(part.sweep, &points_from_sweep, &Kept::all(), draws);
            let (canvas, _) = self.pillarer.run(&scene.points());
            let map = self.network.encode(canvas)?;
            let points_from_ego = (map_from_points.inverse() * map_from_ego).to_homogeneous();
            let ground = [0, 1].map(|row| [0, 1, 3].map(|column| points_from_ego[(row, column)]));
            maps.push(Encoded {
                map,
                warp: match is_ego {
                    true => Warp::IDENTITY,
                    false => Warp::of_ground(ground, origin, cell),
                },
                roadside: part.sweep.roadside,
                delay: part.delay,
            });
        }
        Ok(maps)
    }

    /// Fuses and looks for boxes.
    ///
    /// # Errors
    /// [`NetworkError`] of the network.
    pub fn detect(&mut self, maps: &[Encoded]) -> Result<&Heads, NetworkError> {
        let agents: Vec<Agent> = maps.iter().map(Encoded::agent).collect();
        let fused = self.network.fuse(&agents)?;
        self.network.heads(&fused)
    }
}
