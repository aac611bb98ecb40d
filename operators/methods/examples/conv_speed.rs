//! Times the network of a model file with random weights, on every path that this CPU has. GFLOP are those of direct
//! sums, though f32 needs fewer.
//!
//! `cargo run --release -p realo-methods --example conv_speed -- [models/lite.toml] [runs]`

use std::collections::HashMap;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

use realo_kernels::canvas::Canvas;
use realo_kernels::conv::Isa;
use realo_methods::Model;
use realo_methods::network::{Network, NetworkOptions};
use realo_nn::layers::{Layer, Layers, Step};
use realo_nn::model::Precision;
use realo_nn::weights::{Tensor, Weights, expected};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let model = Model::read(Path::new(&arguments.next().unwrap_or("models/lite.toml".into())))?;
    let runs: usize = arguments.next().map_or(Ok(20), |runs| runs.parse())?;
    let mut numbers = Numbers(1);
    let tensors: HashMap<String, Tensor> = expected(&model)
        .into_iter()
        .map(|(key, shape)| {
            let data = (0..shape.iter().product())
                .map(|_| numbers.next(&key, shape.len()))
                .collect();
            (key, Tensor { shape, data })
        })
        .collect();
    let weights = Weights::new(&model, tensors)?;
    let work = operations(&model);
    println!(
        "{}: {:.2} GFLOP a sweep, min and median of {runs} runs",
        model.name,
        work / 1e9
    );
    let mut canvas = Canvas::new(model.grid.rows(), model.grid.columns(), model.pillars.channels);
    for cell in (0..canvas.rows() * canvas.columns()).step_by(10) {
        let (row, column) = (cell / canvas.columns(), cell % canvas.columns());
        canvas.cell_mut(row, column).fill_with(|| numbers.uniform().abs());
    }
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        let both = [Precision::F32, Precision::Bf16];
        for precision in both.into_iter().take(if isa == Isa::Avx512Bf16 { 2 } else { 1 }) {
            for threads in [1, 2] {
                let options = NetworkOptions {
                    isa,
                    precision: Some(precision),
                    threads,
                };
                let mut network = Network::new(&model, &weights, options)?;
                let cpu_before = cpu_seconds();
                let mut times: Vec<f64> = (0..runs.max(1))
                    .map(|_| time(|| network.forward(&canvas).map(drop)))
                    .collect::<Result<_, _>>()?;
                times.sort_by(f64::total_cmp);
                let (min, median) = (times[0], times[times.len() / 2]);
                let rate = work / min / 1e9;
                print!(
                    "{}: {:.1} ms, {:.1} ms, {rate:.0} GFLOP/s",
                    network.choice(),
                    min * 1e3,
                    median * 1e3
                );
                let cpu = cpu_seconds().zip(cpu_before).filter(|_| threads == 1);
                match cpu.map(|(after, before)| (after - before) / times.len() as f64) {
                    Some(cpu) => println!("; {:.1} ms on the CPU, {:.0} GFLOP/s", cpu * 1e3, work / cpu / 1e9),
                    None => println!(),
                }
            }
        }
    }
    Ok(())
}

/// Seconds.
fn time<E>(work: impl FnOnce() -> Result<(), E>) -> Result<f64, E> {
    let start = Instant::now();
    work()?;
    Ok(start.elapsed().as_secs_f64())
}

/// Time that this thread has run, where Linux says so: other processes may share the cores.
fn cpu_seconds() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    let nanos: f64 = text.split_whitespace().next()?.parse().ok()?;
    Some(nanos / 1e9)
}

fn operations(model: &Model) -> f64 {
    let layers = Layers::of(model);
    let of = |step: &Step| match &step.layer {
        Layer::Convolution(layer) => layer.operations(layers.size(step.from[0])),
        _ => 0.0,
    };
    layers.steps().iter().map(of).sum()
}

struct Numbers(u64);

impl Numbers {
    /// From -1 to 1.
    fn uniform(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }

    fn next(&mut self, key: &str, dimensions: usize) -> f32 {
        match dimensions {
            1 if key.ends_with("running_var") => 1.0,
            _ => 0.1 * self.uniform(),
        }
    }
}
