//! The network from the canvas of pillars to the heads: backbone, shrink layers, heads, batch norm folded in.
//!
//! `encode` and `heads` split it at the BEV map, where agents share features; between them `fuse` makes one map of those of
//! several agents. `forward` runs a single agent's.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;
use std::sync::{Arc, Mutex};

use crate::canvas::Canvas;
use crate::conv::{Bf16, Isa, Pool, U8, View, split};
use crate::decode::score;
use crate::fuse::{Agent, CellFusion, fuse};
use crate::layers::{FuseLayer, Fusion, Layers, MapId, MapSize};
use crate::load::lock;
use crate::messages::Messages;
use crate::model::{Model, Precision};
use crate::part::{Made, Outcome, Part, Runner, Running};
use crate::transformer::Transformer;
use crate::weights::{Weights, WeightsError};

/// How a network computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkOptions {
    /// Instructions.
    pub isa: Isa,
    /// Number type. `None`: the model's, or f32 instead of bf16 where the instructions have no products of it. `Some(Bf16)`
    /// computes in bf16 everywhere, slowly where the CPU lacks it.
    pub precision: Option<Precision>,
    /// Threads, the caller's included; 0 counts as 1.
    pub threads: usize,
}

impl Default for NetworkOptions {
    /// The best instructions and all cores of this machine, in the model's precision.
    fn default() -> Self {
        NetworkOptions {
            isa: Isa::detect(),
            precision: None,
            threads: std::thread::available_parallelism().map_or(1, |cores| cores.get()),
        }
    }
}

/// A map of features seen from above: `rows` along y, `columns` along x.
#[derive(Clone, Debug, PartialEq)]
pub struct BevMap {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Features of a cell.
    pub channels: usize,
    /// `[rows, columns, channels]`.
    pub data: Vec<f32>,
}

/// A [`BevMap`] to read, wherever its numbers lie.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BevView<'a> {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Features of a cell.
    pub channels: usize,
    /// `[rows, columns, channels]`.
    pub data: &'a [f32],
}

impl<'a> From<&'a BevMap> for BevView<'a> {
    fn from(map: &'a BevMap) -> Self {
        BevView {
            rows: map.rows,
            columns: map.columns,
            channels: map.channels,
            data: &map.data,
        }
    }
}

/// What the detection head says at every anchor; anchors run by (class, rotation).
#[derive(Clone, Debug, PartialEq)]
pub struct Heads {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// Scores before the sigmoid, `[rows, columns, anchors, classes]`.
    pub scores: Vec<f32>,
    /// Boxes as deltas to their anchors, `[rows, columns, anchors, 7]`.
    pub deltas: Vec<f32>,
}

impl Heads {
    /// The score of the surest class and anchor of each cell, 0 to 1, `[rows, columns]`.
    pub fn confidence(&self) -> Vec<f32> {
        let cells = self.scores.chunks_exact(self.scores.len() / (self.rows * self.columns));
        let max = cells.map(|scores| scores.iter().copied().fold(f32::NEG_INFINITY, f32::max));
        max.map(score).collect()
    }
}

/// Why a network cannot be built, or cannot take its input.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// The weights are not those of the model.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The model does not fit together.
    #[error(transparent)]
    Model(#[from] crate::model::ModelError),
    /// The CPU lacks the instructions that were asked for.
    #[error("this CPU has no {asked}; the best that it has is {best}")]
    Isa {
        /// What was asked for.
        asked: Isa,
        /// What could be asked for.
        best: Isa,
    },
    /// A map is not of the model's size.
    #[error(
        "{what} has {} rows x {} columns x {} channels, model `{model}` wants {} x {} x {}",
        found[0], found[1], found[2], expected[0], expected[1], expected[2]
    )]
    Shape {
        /// Which map.
        what: &'static str,
        /// The model's name.
        model: String,
        /// Rows, columns, channels.
        expected: [usize; 3],
        /// Rows, columns, channels.
        found: [usize; 3],
    },
    /// The model is one of a single agent.
    #[error("model `{model}` fuses nothing: expected one whose `arch` does, such as attfuse")]
    NoFusion {
        /// The model's name.
        model: String,
    },
    /// A layer gives numbers that are none.
    #[error("layer `{layer}` gives NaN or infinity: nothing can stand for its results")]
    NotFinite {
        /// Its key.
        layer: String,
    },
    /// The model does not say what bytes stand for.
    #[error("model `{model}` has no `activations`, which int8 needs: `realo quantize` makes a model file that has")]
    NoActivations {
        /// The model's name.
        model: String,
    },
    /// There is no agent, or more than the model takes.
    #[error("model `{model}` fuses 1 to {most} agents, the ego among them, found {found}")]
    Agents {
        /// The model's name.
        model: String,
        /// As many as it takes.
        most: usize,
        /// As many as there are.
        found: usize,
    },
    /// A map has more or fewer numbers than its size says.
    #[error("{what} has {found} numbers, its size wants {expected}")]
    Length {
        /// Which map.
        what: &'static str,
        /// Numbers of its size.
        expected: usize,
        /// Numbers that it has.
        found: usize,
    },
}

/// What a network was found to compute with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Choice {
    /// Instructions.
    pub isa: Isa,
    /// Number type of weights and maps.
    pub precision: Precision,
    /// Number type that the model asks for.
    pub wanted: Precision,
    /// Threads.
    pub threads: usize,
}

impl Choice {
    /// Number type of what is not computed in bytes.
    fn float(self) -> Precision {
        match self.precision {
            Precision::Int8 if self.isa.has_bf16() => Precision::Bf16,
            Precision::Int8 => Precision::F32,
            precision => precision,
        }
    }
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} on {}", self.precision, self.isa)?;
        if self.wanted != self.precision {
            write!(f, " (the model asks for {})", self.wanted)?;
        }
        write!(
            f,
            ", {} thread{}",
            self.threads,
            if self.threads == 1 { "" } else { "s" }
        )
    }
}

/// A part that is ready to run, without its maps.
enum Engine {
    Single(Arc<Part<f32>>),
    Half(Arc<Part<Bf16>>),
    Bytes(Arc<Part<U8>>),
}

/// What parts are made of.
struct Parts<'a> {
    layers: &'a Layers,
    weights: &'a Weights,
    isa: Isa,
    activations: &'a BTreeMap<String, f32>,
}

impl Parts<'_> {
    fn engine(&self, precision: Precision, ends: [MapId; 2], outcome: Outcome) -> Engine {
        let Parts {
            layers, weights, isa, ..
        } = *self;
        let one = |_| 1.0;
        match precision {
            Precision::F32 => Engine::Single(Arc::new(Part::new(layers, weights, isa, ends, outcome, one))),
            Precision::Bf16 => Engine::Half(Arc::new(Part::new(layers, weights, isa, ends, outcome, one))),
            Precision::Int8 => {
                let step_of = |map| self.byte_step(map);
                // The last map leaves as f32, which loses nothing more.
                Engine::Bytes(Arc::new(Part::new(
                    layers,
                    weights,
                    isa,
                    ends,
                    Outcome::Single,
                    step_of,
                )))
            }
        }
    }

    /// What 1 stands for where a map is kept in bytes.
    fn byte_step(&self, map: MapId) -> f32 {
        let members = self.layers.members(map).into_iter();
        let max = members.filter_map(|map| self.activations.get(&self.layers.key(map)));
        max.fold(0.0, |a, b| f32::max(a, *b)) / 255.0
    }
}

impl Engine {
    fn running(&self) -> Box<dyn Runner> {
        match self {
            Engine::Single(part) => Box::new(Running::new(Arc::clone(part))),
            Engine::Half(part) => Box::new(Running::new(Arc::clone(part))),
            Engine::Bytes(part) => Box::new(Running::new(Arc::clone(part))),
        }
    }
}

/// What makes one map of those of several agents.
enum Fuser {
    Cells(CellFusion),
    Single(Transformer<f32>),
    Half(Transformer<Bf16>),
    SingleMessages(Messages<f32>),
    HalfMessages(Messages<Bf16>),
}

impl Fuser {
    fn new(FuseLayer { fusion, channels }: &FuseLayer, weights: &Weights, choice: Choice) -> Self {
        let (channels, isa) = (*channels, choice.isa);
        let half = choice.float() == Precision::Bf16;
        match fusion {
            Fusion::Max => Fuser::Cells(CellFusion::Max),
            Fusion::Attention { width } => Fuser::Cells(CellFusion::Attention { width: *width }),
            Fusion::Transformer(settings) if half => Fuser::Half(Transformer::new(settings, channels, weights, isa)),
            Fusion::Transformer(settings) => Fuser::Single(Transformer::new(settings, channels, weights, isa)),
            Fusion::Messages { rounds } if half => Fuser::HalfMessages(Messages::new(*rounds, channels, weights, isa)),
            Fusion::Messages { rounds } => Fuser::SingleMessages(Messages::new(*rounds, channels, weights, isa)),
        }
    }

    fn run(&self, agents: &[Agent], pool: &mut Pool) -> Vec<f32> {
        match self {
            Fuser::Cells(fusion) => fuse(*fusion, agents, pool),
            Fuser::Single(transformer) => transformer.run(agents, pool),
            Fuser::Half(transformer) => transformer.run(agents, pool),
            Fuser::SingleMessages(messages) => messages.run(agents, pool),
            Fuser::HalfMessages(messages) => messages.run(agents, pool),
        }
    }
}

/// What all networks of a model share: everything but threads and maps.
pub(crate) struct Core {
    name: String,
    choice: Choice,
    encode: Engine,
    /// From the shared map to the restored one, unless they are the same.
    restore: Option<Engine>,
    heads: Engine,
    /// How the network fuses, and how many agents.
    fusion: Option<(Fuser, usize)>,
    canvas: MapSize,
    features: MapSize,
    fused: MapSize,
    /// Numbers of a cell: scores and deltas.
    outputs: [usize; 2],
    result: MapSize,
}

impl Core {
    /// `weights` are those of `model`, which has been checked.
    pub fn new(model: &Model, weights: &Weights, options: &NetworkOptions) -> Result<Self, NetworkError> {
        Core::of(&Layers::of(model), weights, model, options)
    }

    /// As [`Core::new`], of layers that need not be the model's.
    fn of(layers: &Layers, weights: &Weights, model: &Model, options: &NetworkOptions) -> Result<Self, NetworkError> {
        let choice = choose(model, options)?;
        let Layers {
            canvas,
            features,
            restored,
            fused,
            heads,
            ..
        } = *layers;
        let parts = Parts {
            layers,
            weights,
            isa: choice.isa,
            activations: &model.activations,
        };
        let engine = |ends, outcome| parts.engine(choice.precision, ends, outcome);
        Ok(Core {
            name: model.name.clone(),
            choice,
            encode: engine([canvas, features], Outcome::Own),
            restore: (restored != features).then(|| engine([features, restored], Outcome::Single)),
            heads: parts.engine(choice.float(), [fused, heads], Outcome::Single),
            fusion: layers
                .fusion()
                .map(|layer| (Fuser::new(layer, weights, choice), model.arch.agents())),
            canvas: layers.size(canvas),
            features: layers.size(features),
            fused: layers.size(fused),
            outputs: [layers.scores, layers.deltas].map(|map| layers.size(map)[2]),
            result: layers.size(heads),
        })
    }
}

impl Core {
    /// Heads of zeros.
    fn result(&self) -> Heads {
        let [rows, columns, _] = self.result;
        let [scores, deltas] = self.outputs.map(|outputs| vec![0.0; rows * columns * outputs]);
        Heads {
            rows,
            columns,
            scores,
            deltas,
        }
    }
}

pub(crate) fn choose(model: &Model, options: &NetworkOptions) -> Result<Choice, NetworkError> {
    if !options.isa.is_available() {
        return Err(NetworkError::Isa {
            asked: options.isa,
            best: Isa::detect(),
        });
    }
    let usual = match model.precision {
        Precision::Bf16 if !options.isa.has_bf16() => Precision::F32,
        precision => precision,
    };
    let precision = options.precision.unwrap_or(usual);
    if precision == Precision::Int8 && model.activations.is_empty() {
        return Err(NetworkError::NoActivations {
            model: model.name.clone(),
        });
    }
    Ok(Choice {
        isa: options.isa,
        precision,
        wanted: model.precision,
        threads: options.threads.max(1),
    })
}

/// The layers from one map of a network to another, by themselves.
pub struct Section {
    name: String,
    from: MapSize,
    to: MapSize,
    running: Box<dyn Runner>,
    pool: Arc<Mutex<Pool>>,
}

impl Section {
    /// The layers between two maps of a model.
    ///
    /// # Errors
    /// As [`Network::new`].
    ///
    /// # Panics
    /// If the second map does not follow from the first by convolutions.
    pub fn new(
        model: &Model,
        weights: &Weights,
        options: NetworkOptions,
        ends: [MapId; 2],
    ) -> Result<Self, NetworkError> {
        let pool = Arc::new(Mutex::new(Pool::new(options.threads)));
        Section::on(pool, model, weights, options, ends)
    }

    /// As [`Section::new`], on threads that others use too.
    pub(crate) fn on(
        pool: Arc<Mutex<Pool>>,
        model: &Model,
        weights: &Weights,
        options: NetworkOptions,
        ends: [MapId; 2],
    ) -> Result<Self, NetworkError> {
        model.validate()?;
        let (layers, choice) = (Layers::of(model), choose(model, &options)?);
        let parts = Parts {
            layers: &layers,
            weights,
            isa: choice.isa,
            activations: &model.activations,
        };
        Ok(Section {
            name: model.name.clone(),
            from: layers.size(ends[0]),
            to: layers.size(ends[1]),
            running: parts.engine(choice.precision, ends, Outcome::Single).running(),
            pool,
        })
    }

    /// The map that follows from another.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the map is not of the model's size, [`NetworkError::Length`] if it is not of its own.
    pub fn run<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<BevMap, NetworkError> {
        let view = plain(&self.name, map.into(), self.from)?;
        let mut pool = lock(&self.pool);
        let data = self.running.run(&mut pool, view).to_f32(&mut pool);
        Ok(map_of(self.to, data))
    }
}

/// A network that is ready to run; its maps are kept from one sweep to the next.
pub struct Network {
    core: Arc<Core>,
    pool: Arc<Mutex<Pool>>,
    encode: Box<dyn Runner>,
    restore: Option<Box<dyn Runner>>,
    heads: Box<dyn Runner>,
    result: Heads,
}

impl Network {
    /// Reads the weights of a model and builds its network.
    ///
    /// # Errors
    /// [`NetworkError::Weights`], and those of [`Network::new`].
    pub fn load(model: &Model, weights: &[impl AsRef<Path>], options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        Network::new(model, &Weights::read(weights, model)?, options)
    }

    /// Builds a network; `weights` are those of `model`.
    ///
    /// # Errors
    /// [`NetworkError::Model`], and [`NetworkError::Isa`] if the CPU lacks what the options ask for.
    pub fn new(model: &Model, weights: &Weights, options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        let core = Core::new(model, weights, &options)?;
        let pool = Pool::new(options.threads);
        Ok(Network::sharing(Arc::new(core), Arc::new(Mutex::new(pool))))
    }

    /// A network with maps of its own, and layers and threads that others use too.
    pub(crate) fn sharing(core: Arc<Core>, pool: Arc<Mutex<Pool>>) -> Network {
        Network {
            encode: core.encode.running(),
            restore: core.restore.as_ref().map(Engine::running),
            heads: core.heads.running(),
            result: core.result(),
            core,
            pool,
        }
    }

    #[cfg(test)]
    pub(crate) fn shares_layers_with(&self, other: &Network) -> bool {
        Arc::ptr_eq(&self.core, &other.core)
    }

    #[cfg(test)]
    pub(crate) fn shares_threads_with(&self, other: &Network) -> bool {
        Arc::ptr_eq(&self.pool, &other.pool)
    }

    /// Its threads.
    pub(crate) fn pool(&self) -> Arc<Mutex<Pool>> {
        Arc::clone(&self.pool)
    }

    /// What it computes with.
    pub fn choice(&self) -> Choice {
        Choice {
            threads: lock(&self.pool).threads(),
            ..self.core.choice
        }
    }

    /// From the canvas to the heads.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn forward(&mut self, canvas: &Canvas) -> Result<Heads, NetworkError> {
        let map = self.encode(canvas)?;
        self.heads(&map).cloned()
    }

    /// From the canvas to the BEV map that agents share.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn encode(&mut self, canvas: &Canvas) -> Result<BevMap, NetworkError> {
        let size = [canvas.rows(), canvas.columns(), canvas.channels()];
        check_size("the canvas", &self.core.name, size, self.core.canvas)?;
        let view = View {
            rows: canvas.rows(),
            columns: canvas.columns(),
            stored: canvas.channels(),
            border: 1,
            data: canvas.data(),
            written: Some(&canvas.written),
        };
        let mut pool = lock(&self.pool);
        let data = self.encode.run(&mut pool, view).to_f32(&mut pool);
        Ok(map_of(self.core.features, data))
    }

    /// From the maps that agents share, the ego's first, to the one that the heads read; an agent takes no part where its map
    /// does not reach.
    ///
    /// # Errors
    /// [`NetworkError::NoFusion`], [`NetworkError::Agents`]; [`NetworkError::Shape`] and [`NetworkError::Length`] for a map
    /// that does not fit.
    pub fn fuse(&mut self, agents: &[Agent]) -> Result<BevMap, NetworkError> {
        let core = &*self.core;
        let (fuser, most) = core.fusion.as_ref().ok_or_else(|| NetworkError::NoFusion {
            model: core.name.clone(),
        })?;
        check_agents(&core.name, agents.len(), *most)?;
        let mut pool = lock(&self.pool);
        let mut restored = Vec::new();
        for agent in agents {
            let view = plain(&core.name, agent.map, core.features)?;
            check_confidence(agent)?;
            if let Some(restore) = &mut self.restore {
                let data = restore.run(&mut pool, view).to_f32(&mut pool);
                restored.push(map_of(core.fused, data));
            }
        }
        let agents: Vec<Agent> = match restored.is_empty() {
            true => agents.to_vec(),
            false => agents
                .iter()
                .zip(&restored)
                .map(|(agent, map)| agent.with(map))
                .collect(),
        };
        Ok(map_of(core.fused, fuser.run(&agents, &mut pool)))
    }

    /// How sure the heads are that each cell of a map that agents share holds an object, 0 to 1, `[rows, columns]`, by this map
    /// alone: a fusion, which changes nothing in a single map that tells one cell from another, is left out.
    ///
    /// # Errors
    /// Those of [`Network::heads`].
    pub fn confidence<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<Vec<f32>, NetworkError> {
        let core = &*self.core;
        let Some(restore) = &mut self.restore else {
            return Ok(self.heads(map)?.confidence());
        };
        let view = plain(&core.name, map.into(), core.features)?;
        let mut pool = lock(&self.pool);
        let data = restore.run(&mut pool, view).to_f32(&mut pool);
        drop(pool);
        let restored = map_of(core.fused, data);
        Ok(self.heads(&restored)?.confidence())
    }

    /// From a BEV map to the heads, which stay until the next one. The map is read where it lies, unless the network computes
    /// in other numbers.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the map is not of the model's size, [`NetworkError::Length`] if it is not of its own.
    pub fn heads<'a>(&mut self, map: impl Into<BevView<'a>>) -> Result<&Heads, NetworkError> {
        let core = &*self.core;
        let view = plain(&core.name, map.into(), core.fused)?;
        let mut pool = lock(&self.pool);
        let Made::Single(numbers) = self.heads.run(&mut pool, view) else {
            unreachable!("heads are made in f32");
        };
        let heads = &mut self.result;
        let [scores, deltas] = core.outputs.map(|outputs| outputs * heads.columns);
        let shares = split(&mut heads.scores, scores, heads.rows, pool.threads(), 1).into_iter();
        let shares = shares.zip(split(&mut heads.deltas, deltas, heads.rows, pool.threads(), 1));
        pool.each(shares.collect(), |(of_scores, of_deltas)| {
            let rows = of_scores
                .data
                .chunks_exact_mut(scores)
                .zip(of_deltas.data.chunks_exact_mut(deltas));
            for (row, (to_scores, to_deltas)) in of_scores.range.zip(rows) {
                let [scores, deltas] = core.outputs;
                let cells = to_scores
                    .chunks_exact_mut(scores)
                    .zip(to_deltas.chunks_exact_mut(deltas));
                for (cell, (to_scores, to_deltas)) in numbers.row(row).zip(cells) {
                    to_scores.copy_from_slice(&cell[..scores]);
                    to_deltas.copy_from_slice(&cell[scores..]);
                }
            }
        });
        Ok(heads)
    }
}

fn map_of([rows, columns, channels]: MapSize, data: Vec<f32>) -> BevMap {
    BevMap {
        rows,
        columns,
        channels,
        data,
    }
}

/// A map without a border, if it is of the expected size and has as many numbers.
fn plain<'a>(model: &str, map: BevView<'a>, expected: MapSize) -> Result<View<'a, f32>, NetworkError> {
    check_map(model, map, expected)?;
    Ok(View {
        rows: map.rows,
        columns: map.columns,
        stored: map.channels,
        border: 0,
        data: map.data,
        written: None,
    })
}

/// Whether a model of this name, which fuses `most` agents, fuses so many.
///
/// # Errors
/// [`NetworkError::Agents`] if it does not.
pub fn check_agents(model: &str, found: usize, most: usize) -> Result<(), NetworkError> {
    match (1..=most).contains(&found) {
        true => Ok(()),
        false => Err(NetworkError::Agents {
            model: model.into(),
            most,
            found,
        }),
    }
}

/// Whether a BEV map is of the size that a model of this name expects, and has as many numbers.
///
/// # Errors
/// [`NetworkError::Shape`] and [`NetworkError::Length`].
pub fn check_map(model: &str, map: BevView, expected: MapSize) -> Result<(), NetworkError> {
    check_size("the BEV map", model, [map.rows, map.columns, map.channels], expected)?;
    let numbers = expected.iter().product();
    match numbers == map.data.len() {
        true => Ok(()),
        false => Err(NetworkError::Length {
            what: "the BEV map",
            expected: numbers,
            found: map.data.len(),
        }),
    }
}

/// Whether an agent reports its confidence of as many cells as its map has, if it does.
///
/// # Errors
/// [`NetworkError::Length`] if it does not.
pub fn check_confidence(agent: &Agent) -> Result<(), NetworkError> {
    let cells = agent.map.rows * agent.map.columns;
    match agent.confidence {
        Some(confidence) if confidence.len() != cells => Err(NetworkError::Length {
            what: "the confidence of a BEV map",
            expected: cells,
            found: confidence.len(),
        }),
        _ => Ok(()),
    }
}

/// Whether a map is of the size that a model of this name expects.
///
/// # Errors
/// [`NetworkError::Shape`] if it is not.
pub fn check_size(what: &'static str, model: &str, found: MapSize, expected: MapSize) -> Result<(), NetworkError> {
    if found == expected {
        return Ok(());
    }
    Err(NetworkError::Shape {
        what,
        model: model.into(),
        expected,
        found,
    })
}

#[cfg(test)]
mod byte_tests;
#[cfg(test)]
mod fusion_tests;
#[cfg(test)]
mod tests;
