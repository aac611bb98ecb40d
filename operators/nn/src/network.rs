//! The network from the canvas of pillars to the heads: backbone, shrink layers, heads, batch norm folded in.
//!
//! `encode` and `heads` split it at the BEV map, where agents share features; `forward` runs both.

use std::fmt;
use std::path::Path;

use crate::canvas::Canvas;
use crate::conv::{Bf16, Convolution, Isa, Kernel, Map, Packed, Pool, View};
use crate::model::{Model, Precision};
use crate::weights::{Weights, WeightsError, block_keys, deblock_keys, shrink_key};

/// How a network computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkOptions {
    /// Instructions.
    pub isa: Isa,
    /// Number type. `None`: the model's, or f32 where the instructions have no products of bf16. `Some(Bf16)` computes in
    /// bf16 everywhere, slowly where the CPU lacks it.
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

/// A network that is ready to run; its maps are kept from one sweep to the next.
pub struct Network {
    name: String,
    choice: Choice,
    pool: Pool,
    engine: Engine,
    /// Rows, columns, channels of the canvas.
    canvas: [usize; 3],
    /// Rows, columns, channels of the BEV map.
    map: [usize; 3],
    /// Numbers of a cell: scores and deltas.
    outputs: [usize; 2],
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

enum Engine {
    Single(Box<Plan<f32>>),
    Half(Box<Plan<Bf16>>),
}

impl Network {
    /// Reads the weights of a model and builds its network.
    ///
    /// # Errors
    /// [`NetworkError::Weights`], and those of [`Network::new`].
    pub fn load(model: &Model, weights: &Path, options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        Network::new(model, &Weights::read(weights, model)?, options)
    }

    /// Builds a network; `weights` are those of `model`.
    ///
    /// # Errors
    /// [`NetworkError::Model`], and [`NetworkError::Isa`] if the CPU lacks what the options ask for.
    pub fn new(model: &Model, weights: &Weights, options: NetworkOptions) -> Result<Network, NetworkError> {
        model.validate()?;
        if !options.isa.is_available() {
            return Err(NetworkError::Isa {
                asked: options.isa,
                best: Isa::detect(),
            });
        }
        let has_half = options.isa == Isa::Avx512Bf16;
        let usual = if has_half { model.precision } else { Precision::F32 };
        let precision = options.precision.unwrap_or(usual);
        let engine = match precision {
            Precision::F32 => Engine::Single(Box::new(Plan::new(model, weights, options.isa))),
            Precision::Bf16 => Engine::Half(Box::new(Plan::new(model, weights, options.isa))),
        };
        let [rows, columns] = model.map_size();
        let pool = Pool::new(options.threads);
        Ok(Network {
            name: model.name.clone(),
            choice: Choice {
                isa: options.isa,
                precision,
                wanted: model.precision,
                threads: pool.threads(),
            },
            pool,
            engine,
            canvas: [model.grid.rows(), model.grid.columns(), model.pillars.channels],
            map: [rows, columns, model.map_channels()],
            outputs: [model.anchors() * model.classes.len(), model.anchors() * 7],
        })
    }

    /// What it computes with.
    pub fn choice(&self) -> Choice {
        self.choice
    }

    /// From the canvas to the heads.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn forward(&mut self, canvas: &Canvas) -> Result<Heads, NetworkError> {
        self.check_canvas(canvas)?;
        match &mut self.engine {
            Engine::Single(plan) => plan.encode(&mut self.pool, canvas),
            Engine::Half(plan) => plan.encode(&mut self.pool, canvas),
        }
        Ok(self.run_heads())
    }

    /// From the canvas to the BEV map that agents share.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the canvas is not of the model's size.
    pub fn encode(&mut self, canvas: &Canvas) -> Result<BevMap, NetworkError> {
        self.check_canvas(canvas)?;
        let data = match &mut self.engine {
            Engine::Single(plan) => {
                plan.encode(&mut self.pool, canvas);
                plan.features().to_f32()
            }
            Engine::Half(plan) => {
                plan.encode(&mut self.pool, canvas);
                plan.features().to_f32()
            }
        };
        let [rows, columns, channels] = self.map;
        Ok(BevMap {
            rows,
            columns,
            channels,
            data,
        })
    }

    /// From a BEV map to the heads.
    ///
    /// # Errors
    /// [`NetworkError::Shape`] if the map is not of the model's size, [`NetworkError::Length`] if it is not of its own.
    pub fn heads(&mut self, map: &BevMap) -> Result<Heads, NetworkError> {
        self.check("the BEV map", [map.rows, map.columns, map.channels], self.map)?;
        let expected = self.map.iter().product();
        if map.data.len() != expected {
            return Err(NetworkError::Length {
                what: "the BEV map",
                expected,
                found: map.data.len(),
            });
        }
        match &mut self.engine {
            Engine::Single(plan) => plan.features_mut().fill_with(&mut self.pool, &map.data),
            Engine::Half(plan) => plan.features_mut().fill_with(&mut self.pool, &map.data),
        }
        Ok(self.run_heads())
    }

    fn run_heads(&mut self) -> Heads {
        let numbers = match &mut self.engine {
            Engine::Single(plan) => plan.heads(&mut self.pool),
            Engine::Half(plan) => plan.heads(&mut self.pool),
        };
        let [rows, columns, _] = self.map;
        let [scores, deltas] = self.outputs;
        let cells = rows * columns;
        let mut heads = Heads {
            rows,
            columns,
            scores: Vec::with_capacity(cells * scores),
            deltas: Vec::with_capacity(cells * deltas),
        };
        for cell in (0..rows).flat_map(|row| numbers.row(row)) {
            heads.scores.extend_from_slice(&cell[..scores]);
            heads.deltas.extend_from_slice(&cell[scores..]);
        }
        heads
    }

    fn check_canvas(&self, canvas: &Canvas) -> Result<(), NetworkError> {
        self.check(
            "the canvas",
            [canvas.rows(), canvas.columns(), canvas.channels()],
            self.canvas,
        )
    }

    fn check(&self, what: &'static str, found: [usize; 3], expected: [usize; 3]) -> Result<(), NetworkError> {
        if found == expected {
            return Ok(());
        }
        Err(NetworkError::Shape {
            what,
            model: self.name.clone(),
            expected,
            found,
        })
    }
}

/// How a number type takes the canvas.
trait Input: Kernel<Self> + Kernel<f32> {
    fn take<'a>(canvas: &'a Canvas, copy: &'a mut Option<Map<Self>>, pool: &mut Pool) -> View<'a, Self>;
}

fn view(canvas: &Canvas) -> View<'_, f32> {
    View {
        rows: canvas.rows(),
        columns: canvas.columns(),
        stored: canvas.channels(),
        data: canvas.data(),
    }
}

impl Input for f32 {
    /// As it lies.
    fn take<'a>(canvas: &'a Canvas, _: &'a mut Option<Map<f32>>, _: &mut Pool) -> View<'a, f32> {
        view(canvas)
    }
}

impl Input for Bf16 {
    /// Rounded into a map of its own.
    fn take<'a>(canvas: &'a Canvas, copy: &'a mut Option<Map<Bf16>>, pool: &mut Pool) -> View<'a, Bf16> {
        let map = copy.get_or_insert_with(|| Map::new(canvas.rows(), canvas.columns(), canvas.channels()));
        map.fill_from_view(pool, view(canvas));
        map.view()
    }
}

/// Layers with the maps between them.
struct Plan<E> {
    copy: Option<Map<E>>,
    maps: Vec<Map<E>>,
    steps: Vec<Step<E>>,
    /// Index of the map that the heads read.
    features: usize,
    head: Packed<E, f32>,
    outputs: Map<f32>,
}

struct Step<E> {
    layer: Packed<E>,
    /// Index of the map that is read; the canvas if `None`.
    from: Option<usize>,
    to: usize,
    /// First channel written.
    first: usize,
}

impl<E: Input> Plan<E> {
    fn new(model: &Model, weights: &Weights, isa: Isa) -> Self {
        let [rows, columns] = model.map_size();
        let mut maker = Maker {
            isa,
            maps: Vec::new(),
            steps: Vec::new(),
        };
        let joined = maker.map(rows, columns, model.backbone.up_channels.iter().sum());
        let mut size = [model.grid.rows(), model.grid.columns()];
        let (mut from, mut first) = (None, 0);
        for (block, deblock) in blocks(model, weights).iter().zip(deblocks(model, weights)) {
            size = size.map(|cells| block[0].size(cells));
            let maps = [(); 2].map(|()| maker.map(size[0], size[1], block[0].outputs));
            for (index, layer) in block.iter().enumerate() {
                let to = maps[index % 2];
                maker.step(layer, from, to, 0);
                from = Some(to);
            }
            maker.step(&deblock, from, joined, first);
            first += deblock.outputs;
        }
        let mut features = joined;
        for layer in shrink_layers(model, weights) {
            let to = maker.map(rows, columns, layer.outputs);
            maker.step(&layer, Some(features), to, 0);
            features = to;
        }
        let head = head_layer(model, weights);
        Plan {
            copy: None,
            maps: maker.maps,
            steps: maker.steps,
            features,
            outputs: Map::new(rows, columns, head.outputs),
            head: Packed::new(&head, isa),
        }
    }

    fn encode(&mut self, pool: &mut Pool, canvas: &Canvas) {
        for step in &self.steps {
            let (from, to) = match step.from {
                None => (E::take(canvas, &mut self.copy, pool), &mut self.maps[step.to]),
                Some(from) => {
                    let (from, to) = two(&mut self.maps, from, step.to);
                    (from.view(), to)
                }
            };
            step.layer.run(pool, from, to, step.first);
        }
    }

    fn heads(&mut self, pool: &mut Pool) -> &Map<f32> {
        let features = self.maps[self.features].view();
        self.head.run(pool, features, &mut self.outputs, 0);
        &self.outputs
    }

    fn features(&self) -> &Map<E> {
        &self.maps[self.features]
    }

    fn features_mut(&mut self) -> &mut Map<E> {
        &mut self.maps[self.features]
    }
}

/// Two different elements, the second to be written.
fn two<T>(list: &mut [T], read: usize, write: usize) -> (&T, &mut T) {
    let [read, write] = list
        .get_disjoint_mut([read, write])
        .expect("a layer reads one map and writes another");
    (read, write)
}

struct Maker<E> {
    isa: Isa,
    maps: Vec<Map<E>>,
    steps: Vec<Step<E>>,
}

impl<E: Input> Maker<E> {
    fn map(&mut self, rows: usize, columns: usize, channels: usize) -> usize {
        self.maps.push(Map::new(rows, columns, channels));
        self.maps.len() - 1
    }

    fn step(&mut self, layer: &Convolution, from: Option<usize>, to: usize, first: usize) {
        let layer = Packed::new(layer, self.isa);
        self.steps.push(Step { layer, from, to, first });
    }
}

/// The convolutions of each block, batch norm folded in.
pub fn blocks(model: &Model, weights: &Weights) -> Vec<Vec<Convolution>> {
    let backbone = &model.backbone;
    let mut inputs = model.pillars.channels;
    let mut block = |index: usize| {
        let layer = |layer: usize| {
            let (key, norm) = block_keys(index, layer);
            let outputs = backbone.channels[index];
            let convolution = Convolution {
                inputs: std::mem::replace(&mut inputs, outputs),
                outputs,
                kernel: 3,
                stride: if layer == 0 { backbone.strides[index] } else { 1 },
                transposed: false,
                relu: true,
                weights: weights.tensor(&format!("{key}.weight")).to_vec(),
                bias: vec![0.0; outputs],
            };
            folded(convolution, &weights.batch_norm(&norm))
        };
        (0..=backbone.layers[index]).map(layer).collect()
    };
    (0..backbone.layers.len()).map(&mut block).collect()
}

/// The transposed convolution of each block, batch norm folded in.
pub fn deblocks(model: &Model, weights: &Weights) -> Vec<Convolution> {
    let backbone = &model.backbone;
    let deblock = |index: usize| {
        let (key, norm) = deblock_keys(index);
        let convolution = Convolution {
            inputs: backbone.channels[index],
            outputs: backbone.up_channels[index],
            kernel: backbone.up_strides[index],
            stride: backbone.up_strides[index],
            transposed: true,
            relu: true,
            weights: weights.tensor(&format!("{key}.weight")).to_vec(),
            bias: vec![0.0; backbone.up_channels[index]],
        };
        folded(convolution, &weights.batch_norm(&norm))
    };
    (0..backbone.layers.len()).map(deblock).collect()
}

/// The convolutions after the backbone.
pub fn shrink_layers(model: &Model, weights: &Weights) -> Vec<Convolution> {
    let mut inputs = model.backbone.up_channels.iter().sum();
    let layer = |(index, shrink): (usize, &crate::model::Shrink)| {
        let key = shrink_key(index);
        Convolution {
            inputs: std::mem::replace(&mut inputs, shrink.channels),
            outputs: shrink.channels,
            kernel: shrink.kernel,
            stride: 1,
            transposed: false,
            relu: true,
            weights: weights.tensor(&format!("{key}.weight")).to_vec(),
            bias: weights.tensor(&format!("{key}.bias")).to_vec(),
        }
    };
    model.shrink.iter().enumerate().map(layer).collect()
}

/// Both heads as one layer: scores, then deltas.
pub fn head_layer(model: &Model, weights: &Weights) -> Convolution {
    let both = |part: &str| {
        let heads = ["cls_head", "reg_head"].map(|head| weights.tensor(&format!("{head}.{part}")));
        heads.concat()
    };
    let bias = both("bias");
    Convolution {
        inputs: model.map_channels(),
        outputs: bias.len(),
        kernel: 1,
        stride: 1,
        transposed: false,
        relu: false,
        weights: both("weight"),
        bias,
    }
}

/// The convolution with its batch norm as weights and bias; computed in f64.
fn folded(mut layer: Convolution, norm: &[[f64; 2]]) -> Convolution {
    let taps = layer.kernel * layer.kernel;
    // Weights of one output lie together, or of one input and output if transposed.
    let (run, outputs) = match layer.transposed {
        true => (taps, layer.outputs),
        false => (taps * layer.inputs, layer.outputs),
    };
    for (index, weights) in layer.weights.chunks_exact_mut(run).enumerate() {
        let [factor, _] = norm[index % outputs];
        weights
            .iter_mut()
            .for_each(|weight| *weight = (f64::from(*weight) * factor) as f32);
    }
    for (bias, [factor, summand]) in layer.bias.iter_mut().zip(norm) {
        *bias = (f64::from(*bias) * factor + summand) as f32;
    }
    layer
}

#[cfg(test)]
mod tests;
