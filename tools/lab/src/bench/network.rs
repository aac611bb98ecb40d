mod boxes;
mod parts;

use std::fmt;
use std::path::Path;
use std::time::Instant;

use eyre::Result;
use realo_cli::Progress;
use realo_kernels::agents::Agent;
use realo_kernels::canvas::Canvas;
use realo_kernels::conv::Isa;
use realo_methods::Model;
use realo_methods::Pillarer;
use realo_methods::detect::pillars::Points;
use realo_methods::network::calibration::Calibration;
use realo_methods::network::{Network, NetworkOptions};
use realo_nn::anchors::Anchors;
use realo_nn::decode::candidates;
use realo_nn::filler;
use realo_nn::layers::{Layer, Layers, MapId};
use realo_nn::model::Precision;
use realo_nn::weights::Weights;
use serde::Serialize;
use serde_json::{Value, json};

use super::detector::{cloud, points, spread};
use super::peer::Peer;

use boxes::{Agreement, Trained, agreement};

const LITE: &str = "models/lite.toml";
const FULL: &str = "models/full-attfuse.toml";
/// Models whose whole frame of two agents is measured.
const FRAMES: [&str; 3] = ["models/full-fcooper.toml", FULL, "models/full-v2xvit.toml"];
const ROUNDS: usize = 21;
const ROUNDS_OF_FULL: usize = 7;
/// Most boxes that are decoded, as in the graphs.
const MOST: usize = 1000;

/// The networks' times.
#[derive(Serialize)]
pub struct Networks {
    points: usize,
    rows: Vec<Row>,
    /// Whether int8 finds the boxes of f32.
    boxes: Vec<Agreement>,
}

#[derive(Serialize)]
struct Row {
    what: String,
    minimum_ms: f64,
    median_ms: f64,
    /// Multiplications and additions of its convolutions a second, where they are most of it; as many as direct sums take,
    /// though f32 runs by tiles that need fewer.
    gigaoperations: Option<f64>,
    peer: Option<Compared>,
}

#[derive(Serialize)]
struct Compared {
    name: String,
    minimum_ms: f64,
    median_ms: f64,
    /// Median over the rounds of our time over its time in the same round.
    ratio: f64,
}

/// Times networks from sweep to boxes, encoders and whole frames; with an interpreter, others' engines beside them.
pub fn bench(python: Option<&Path>, progress: &Progress) -> Result<Networks> {
    let all = std::thread::available_parallelism().map_or(1, |n| n.get());
    progress.count("networks", planned(python.is_some(), all) as f64);
    let cloud = cloud()?;
    let points = points(&cloud);
    let mut rows = Vec::new();
    let mut boxes = vec![lite(&points, all, &mut rows, progress)?];
    encoders(&points, python, all, &mut rows, progress)?;
    for file in FRAMES {
        boxes.push(frame(file, &points, python, all, &mut rows, progress)?);
    }
    Ok(Networks {
        points: points.x.len(),
        rows,
        boxes,
    })
}

/// Instruction sets that are measured.
fn isas() -> impl Iterator<Item = Isa> {
    Isa::ALL
        .into_iter()
        .filter(|isa| isa.is_available() && *isa != Isa::Portable)
}

/// Numbers of threads that are measured.
fn thread_counts(all: usize) -> Vec<usize> {
    if all > 1 { vec![1, all] } else { vec![1] }
}

/// Measurements in all.
fn planned(compared: bool, all: usize) -> usize {
    let of_lite = isas().map(|isa| precisions(isa).len()).sum::<usize>() * thread_counts(all).len();
    let of_encoders = if compared { 4 } else { 3 };
    of_lite + of_encoders + FRAMES.len() * precisions(Isa::detect()).len()
}

/// From a sweep to boxes with the detector that ships, in all that this processor has; and whether int8 finds them.
fn lite(points: &Points, all: usize, rows: &mut Vec<Row>, progress: &Progress) -> Result<Agreement> {
    let loaded = realo_methods::load(Path::new(LITE), realo_methods::Kernels::auto(1))?;
    let weights = loaded.weights;
    let model = calibrated((*loaded.model).clone(), &weights, points)?;
    let anchors = Anchors::of(&model);
    for isa in isas() {
        for precision in precisions(isa) {
            for threads in thread_counts(all) {
                let options = NetworkOptions {
                    isa,
                    precision: Some(precision),
                    threads,
                };
                let mut network = Network::new(&model, &weights, options)?;
                let mut pillarer = Pillarer::beside(&network, &model, &weights);
                let times = timed(ROUNDS, || {
                    let (canvas, _) = pillarer.run(points);
                    let map = network.encode(canvas)?;
                    let heads = network.heads(&map)?;
                    candidates(&anchors, &heads.scores, &heads.deltas, model.score_threshold, MOST);
                    Ok(())
                })?;
                let what = format!("lite, sweep to boxes, {}", network.choice());
                rows.push(row(what, &times, None));
                progress.add(1.0);
            }
        }
    }
    agreement(&model, &weights, Trained::Yes, &canvas(&model, &weights, points), all)
}

fn precisions(isa: Isa) -> Vec<Precision> {
    match isa.has_bf16() {
        true => vec![Precision::Bf16, Precision::Int8],
        false => vec![Precision::F32, Precision::Int8],
    }
}

fn calibrated(mut model: Model, weights: &Weights, points: &Points) -> Result<Model> {
    let mut calibration = Calibration::new(&model, weights)?;
    calibration.observe(points)?;
    model.activations = calibration.activations();
    Ok(model)
}

/// A network without training, ready for int8.
fn untrained(file: &str, points: &Points) -> Result<(Model, Weights)> {
    let model = Model::read(Path::new(file))?;
    let weights = filler::weights(&model, 1);
    Ok((calibrated(model, &weights, points)?, weights))
}

fn canvas(model: &Model, weights: &Weights, points: &Points) -> Canvas {
    Pillarer::new(model, weights).run(points).0.clone()
}

/// The encoder of V2X-Real's full size from the canvas, against other engines in the same precision.
fn encoders(
    points: &Points,
    python: Option<&Path>,
    threads: usize,
    rows: &mut Vec<Row>,
    progress: &Progress,
) -> Result<()> {
    let (model, weights) = untrained(FULL, points)?;
    let canvas = canvas(&model, &weights, points);
    let layers = Layers::of(&model);
    let operations = operations(&layers, [layers.canvas, layers.features]);
    let reported = reported(&model, threads, 1, 0);
    let in_openvino = |precision: &str| ("openvino", with(&reported, "precision", precision));
    let each = [
        (
            Precision::F32,
            vec![("onnxruntime", reported.clone()), ("pytorch", reported.clone())],
        ),
        (Precision::Bf16, vec![in_openvino("bf16")]),
        (Precision::Int8, vec![in_openvino("int8")]),
    ];
    for (precision, peers) in each {
        let options = NetworkOptions {
            precision: Some(precision),
            threads,
            ..NetworkOptions::default()
        };
        let mut network = Network::new(&model, &weights, options)?;
        let what = format!("encoder of {}, {}", model.name, network.choice());
        let peers = if python.is_some() { peers } else { Vec::new() };
        let peers: Vec<Option<(&str, Value)>> = match peers.is_empty() {
            true => vec![None],
            false => peers.into_iter().map(Some).collect(),
        };
        for peer in peers {
            let peer = python
                .zip(peer)
                .map(|(python, (name, reported))| Peer::start(python, name, &reported));
            let measured = against(peer.transpose()?, || {
                network.encode(&canvas)?;
                Ok(())
            })?;
            rows.push(measured.row(what.clone(), Some(operations)));
            progress.add(1.0);
        }
    }
    Ok(())
}

/// A whole frame of an ego and a collaborator at full size: both encoders, fusion, heads, boxes.
fn frame(
    file: &str,
    points: &Points,
    python: Option<&Path>,
    threads: usize,
    rows: &mut Vec<Row>,
    progress: &Progress,
) -> Result<Agreement> {
    let (model, weights) = untrained(file, points)?;
    let canvas = canvas(&model, &weights, points);
    let anchors = Anchors::of(&model);
    for precision in precisions(Isa::detect()) {
        let options = NetworkOptions {
            precision: Some(precision),
            threads,
            ..NetworkOptions::default()
        };
        let mut network = Network::new(&model, &weights, options)?;
        let outputs = anchors.classes.len() * model.rotations.len() * (anchors.classes.len() + 7);
        let reported = reported(&model, threads, 2, outputs);
        let peer = python.map(|python| Peer::start(python, &model.arch.to_string(), &reported));
        let measured = against(peer.transpose()?, || {
            let [ego, other] = [network.encode(&canvas)?, network.encode(&canvas)?];
            let fused = network.fuse(&[Agent::beside(&ego), Agent::beside(&other)])?;
            let heads = network.heads(&fused)?;
            candidates(&anchors, &heads.scores, &heads.deltas, model.score_threshold, MOST);
            Ok(())
        })?;
        rows.push(measured.row(format!("frame of {}, 2 agents, {}", model.name, network.choice()), None));
        if precision == Precision::Int8 {
            parts::fusion(&model, &mut network, rows)?;
        }
        progress.add(1.0);
    }
    let agreement = agreement(&model, &weights, Trained::No, &canvas, threads)?;
    if file == FULL {
        parts::warp(&model, threads, rows)?;
        parts::compressor(&model, points, threads, rows)?;
    }
    Ok(agreement)
}

/// Multiplications and additions of the convolutions between two maps.
fn operations(layers: &Layers, [from, to]: [MapId; 2]) -> f64 {
    let steps = layers.between(&[from], &[to]).into_iter();
    steps
        .filter_map(|step| match &step.layer {
            Layer::Convolution(layer) => Some(layer.operations(layers.size(step.from[0]))),
            _ => None,
        })
        .sum()
}

/// What a peer needs to know to make the same network.
pub(super) fn reported(model: &Model, threads: usize, batch: usize, outputs: usize) -> Value {
    json!({
        "threads": threads,
        "batch": batch,
        "rows": model.grid.rows(),
        "columns": model.grid.columns(),
        "channels": model.pillars.channels,
        "backbone": model.backbone,
        "shrink": model.shrink,
        "refine": model.refine,
        "arch": model.arch,
        "outputs": outputs,
    })
}

fn with(reported: &Value, key: &str, value: &str) -> Value {
    let mut reported = reported.clone();
    reported[key] = value.into();
    reported
}

/// Our times and a peer's, in turns.
struct Measured {
    ours: Vec<f64>,
    theirs: Option<(String, Vec<f64>)>,
}

fn against(mut peer: Option<Peer>, mut run: impl FnMut() -> Result<()>) -> Result<Measured> {
    run()?;
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS_OF_FULL {
        ours.extend(timed(1, &mut run)?);
        if let Some(peer) = &mut peer {
            theirs.push(peer.run()?);
        }
    }
    Ok(Measured {
        ours,
        theirs: peer.map(|peer| (peer.name.clone(), theirs)),
    })
}

impl Measured {
    fn row(self, what: String, operations: Option<f64>) -> Row {
        let mut row = row(what, &self.ours, operations);
        row.peer = self.theirs.map(|(name, theirs)| {
            let ratios: Vec<f64> = self
                .ours
                .iter()
                .zip(&theirs)
                .map(|(ours, theirs)| ours / theirs)
                .collect();
            let (minimum, median) = spread(&theirs);
            Compared {
                name,
                minimum_ms: minimum * 1e3,
                median_ms: median * 1e3,
                ratio: spread(&ratios).1,
            }
        });
        row
    }
}

fn row(what: String, seconds: &[f64], operations: Option<f64>) -> Row {
    let (minimum, median) = spread(seconds);
    Row {
        what,
        minimum_ms: minimum * 1e3,
        median_ms: median * 1e3,
        gigaoperations: operations.map(|operations| operations / minimum * 1e-9),
        peer: None,
    }
}

/// Seconds of each of so many runs.
fn timed(rounds: usize, mut run: impl FnMut() -> Result<()>) -> Result<Vec<f64>> {
    let mut times = Vec::with_capacity(rounds);
    for _ in 0..rounds {
        let start = Instant::now();
        run()?;
        times.push(start.elapsed().as_secs_f64());
    }
    Ok(times)
}

impl fmt::Display for Networks {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{} points of a simulated sweep; min and median, ms", self.points)?;
        for row in &self.rows {
            write!(f, "{:<78} {:>8.2} {:>8.2}", row.what, row.minimum_ms, row.median_ms)?;
            if let Some(gigaoperations) = row.gigaoperations {
                write!(f, "  {gigaoperations:.0} Gop/s")?;
            }
            if let Some(peer) = &row.peer {
                let Compared {
                    name,
                    minimum_ms,
                    median_ms,
                    ratio,
                } = peer;
                write!(f, "  {name}: {minimum_ms:.2} {median_ms:.2}, ours is {ratio:.2} of it")?;
            }
            writeln!(f)?;
        }
        for boxes in &self.boxes {
            writeln!(f, "{boxes}")?;
        }
        write!(
            f,
            "Gop/s: of direct sums, though f32 needs fewer; ratios: medians of rounds in turns; \
             --python PYTHON, one with torch, openvino, nncf and onnxruntime, compares"
        )
    }
}
