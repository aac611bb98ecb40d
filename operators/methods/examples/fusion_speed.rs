//! Times the fusion of two agents' maps by a shipped model, on every path that this CPU has.
//!
//! `cargo run --release -p realo-methods --example fusion_speed -- [models/lite-v2xvit.toml] [runs] [isa] [threads]`

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use realo_kernels::agents::Agent;
use realo_kernels::bev::BevMap;
use realo_kernels::conv::Isa;
use realo_kernels::warp::Warp;
use realo_methods::network::{Kernels, load};
use realo_nn::filler::Numbers;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let model = arguments.first().map_or("models/lite-v2xvit.toml", String::as_str);
    let runs: usize = arguments.get(1).map_or(Ok(20), |runs| runs.parse())?;
    let isas = Isa::ALL
        .into_iter()
        .filter(|isa| isa.is_available())
        .map(|isa| isa.to_string());
    let isas: Vec<String> = isas
        .filter(|isa| arguments.get(2).is_none_or(|only| only == isa))
        .collect();
    let threads: Vec<usize> = arguments
        .get(3)
        .map_or(Ok(vec![1, 2]), |only| only.parse().map(|only| vec![only]))?;
    for isa in isas {
        for threads in &threads {
            let kernels = Kernels {
                isa: &isa,
                precision: "auto",
                threads: *threads,
            };
            let loaded = load(Path::new(model), kernels)?;
            let mut network = loaded.network;
            let [rows, columns] = loaded.model.map_size();
            let channels = loaded.model.map_channels();
            let mut numbers = Numbers::new(7);
            // As layers with a ReLU make them.
            let maps = [(); 2].map(|()| BevMap {
                rows,
                columns,
                channels,
                data: numbers
                    .list(rows * columns * channels)
                    .iter()
                    .map(|number| number.max(0.0))
                    .collect(),
            });
            let turned = Warp([[0.995, -0.0998, 12.3], [0.0998, 0.995, -7.7]]);
            let agents = [
                Agent::beside(&maps[0]),
                Agent {
                    warp: turned,
                    ..Agent::beside(&maps[1])
                },
            ];
            let mut times = Vec::new();
            for _ in 0..runs.max(1) {
                let start = Instant::now();
                network.fuse(&agents)?;
                times.push(start.elapsed().as_secs_f64());
            }
            times.sort_by(f64::total_cmp);
            println!(
                "{isa}, {threads} threads: {rows}x{columns}x{channels}, {:.1} ms, {:.1} ms (min, median)",
                times[0] * 1e3,
                times[times.len() / 2] * 1e3
            );
        }
    }
    Ok(())
}
