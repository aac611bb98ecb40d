//! From a frame to what a network that fuses sees: the points of an ego and of others, each in the frame of its own map.

use nalgebra::Matrix4;
use realo_kernels::agents::Agent;
use realo_kernels::bev::BevMap;
use realo_kernels::warp::Warp;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::network::{Heads, Network, NetworkError, NetworkOptions};
use realo_nn::model::Grid;
use realo_nn::weights::Weights;

use super::frame::Frame;
use super::sample::{Augmentation, Cast, Change, PlacedSweep, Scene};
use crate::TrainError;
use crate::random::Stream;

/// Probability that another agent's map is one of its earlier sweep.
const EARLIER: f64 = 0.4;

/// Probability that of a party whose maps are all in the ego's frame one other's map is looked at alone: what only one agent sees
/// has to be found in its map.
const APART: f64 = 0.15;

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
    /// Whether the ego's own points are left out.
    pub blind: bool,
}

/// An agent of a sample, and how its map lies to the ego's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Member {
    /// From the ego's cells to the map's.
    pub warp: Warp,
    /// Whether it is a roadside unit, not a vehicle.
    pub roadside: bool,
    /// How old its map is beside the ego's, in frames of 0.1 s.
    pub delay: usize,
    /// Whether the map is of the fusion's agent itself.
    pub own: bool,
}

impl Member {
    /// An ego, of which nothing else is known.
    pub const EGO: Member = Member {
        warp: Warp::IDENTITY,
        roadside: false,
        delay: 0,
        own: true,
    };
}

/// The points that an agent's map is made of.
pub(crate) struct Look {
    /// Points, in the frame of its map.
    pub scene: Scene,
    /// How its map lies.
    pub member: Member,
}

/// An agent's map and where it lies.
pub(crate) struct Encoded {
    map: BevMap,
    member: Member,
}

impl Encoded {
    fn agent(&self) -> Agent<'_> {
        let Member {
            warp, roadside, delay, ..
        } = self.member;
        Agent {
            confidence: None,
            map: (&self.map).into(),
            warp,
            roadside,
            delay,
        }
    }
}

impl Party {
    /// Draws who takes part: at most as many as the model fuses.
    pub fn draw(frame: &Frame, model: &Model, project: Project, how: &Augmentation, draws: &mut Stream) -> Self {
        let Cast { ego, mut others } = Cast::draw(frame, how, draws);
        while others.len() >= model.arch.agents() {
            others.remove(draws.below(others.len()));
        }
        let mut others: Vec<_> = others.into_iter().map(|other| (other, draws.chance(EARLIER))).collect();
        let blind = project == Project::Sender && !others.is_empty() && draws.chance(APART);
        if blind {
            let (other, _) = others[draws.below(others.len())];
            others = vec![(other, false)];
        }
        Party {
            ego,
            others,
            project,
            blind,
        }
    }

    /// What those who take part see, in the frame of the ego, and how their maps will lie.
    pub fn view(&self, frame: &Frame, model: &Model, how: &Augmentation, draws: &mut Stream) -> View {
        let ego = &frame.agents[self.ego];
        let unseeing = self.blind.then(|| ego.unseeing());
        let own = unseeing.as_ref().unwrap_or(ego);
        let (mut parts, mut places) = (vec![PlacedSweep::exact(own)], vec![Place::default()]);
        for (agent, earlier) in &self.others {
            let then = frame.earlier.as_ref().filter(|_| *earlier);
            let (agents, delay) = then.map_or((&frame.agents, 0), |then| (&then.agents, then.delay));
            let part = PlacedSweep::exact(&agents[*agent]).astray(how, draws);
            let map_from_points = match self.project {
                Project::Sender => agents[self.ego].map_from_body,
                Project::Receiver => part.map_from_sweep,
            };
            parts.push(part);
            places.push(Place {
                points_from_ego: (map_from_points.inverse() * ego.map_from_body).to_homogeneous(),
                roadside: part.sweep.roadside,
                delay,
            });
        }
        places[0].roadside = ego.roadside;
        View {
            scene: Scene::new(frame, &parts, model, how, draws),
            places,
            blind: self.blind,
        }
    }
}

/// How the points of a map lie to the ego.
#[derive(Clone, Debug)]
struct Place {
    points_from_ego: Matrix4<f64>,
    roadside: bool,
    delay: usize,
}

impl Default for Place {
    fn default() -> Self {
        Place {
            points_from_ego: Matrix4::identity(),
            roadside: false,
            delay: 0,
        }
    }
}

/// What the agents of a sample see together.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// All points and objects, in the frame of the ego.
    pub scene: Scene,
    places: Vec<Place>,
    blind: bool,
}

impl View {
    /// Changes all that is seen, for everybody alike.
    pub fn change(&mut self, change: &Change) {
        self.scene.change(change);
        for place in &mut self.places[1..] {
            place.points_from_ego = change.of_motion(&place.points_from_ego);
        }
    }

    /// Whether all sweeps are of one instant.
    pub fn is_of_now(&self) -> bool {
        self.places.iter().all(|place| place.delay == 0)
    }

    /// What each agent's map is made of, the ego's first if it sees, on the grid of a model.
    pub fn looks(&self, model: &Model) -> Vec<Look> {
        let Grid { x, y, .. } = model.grid;
        let cell = model.grid.cell * model.stride() as f64;
        let look = |(number, place): (usize, &Place)| {
            let motion = &place.points_from_ego;
            let ground = [0, 1].map(|row| [0, 1, 3].map(|column| motion[(row, column)]));
            Look {
                scene: self.scene.part(number as u8, motion),
                member: Member {
                    warp: match number {
                        0 => Warp::IDENTITY,
                        _ if self.blind => Warp::IDENTITY,
                        _ => Warp::of_ground(ground, [x[0], y[0]], cell),
                    },
                    roadside: place.roadside,
                    delay: place.delay,
                    own: number == 0,
                },
            }
        };
        let looks = self.places.iter().enumerate().skip(usize::from(self.blind));
        looks.map(look).collect()
    }
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
        Ok(MapEncoder::of(model, weights, Network::new(model, weights, options)?))
    }

    /// That of a network that is there.
    pub fn of(model: &Model, weights: &Weights, network: Network) -> Self {
        MapEncoder {
            model: model.clone(),
            pillarer: Pillarer::beside(&network, model, weights),
            network,
        }
    }

    /// The maps of a sample's agents, the ego's first.
    ///
    /// # Errors
    /// [`TrainError::Network`].
    pub fn run(&mut self, view: &View) -> Result<Vec<Encoded>, TrainError> {
        let looks = view.looks(&self.model).into_iter();
        looks.map(|look| self.encode(&look)).collect()
    }

    fn encode(&mut self, look: &Look) -> Result<Encoded, TrainError> {
        let (canvas, _) = self.pillarer.run(&look.scene.points());
        Ok(Encoded {
            map: match look.member.own {
                true => self.network.encode_own(canvas)?,
                false => self.network.encode(canvas)?,
            },
            member: look.member,
        })
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
