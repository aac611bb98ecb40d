//! `realo-lab bench`: measurements that a README may quote, each with the command that makes it.

mod detector;
mod faults;
mod framework;
mod import;
mod memory;
mod network;
mod nms;
mod paper;
mod peer;
pub(crate) mod radio;
mod registration;
mod report;
mod simulate;
mod train;
mod transmission;
mod view;

use std::path::PathBuf;

use clap::ValueEnum;
use eyre::Result;
use realo_cli::program::beside;
use realo_cli::{Outcome, Progress};
use serde::Serialize;

/// Measures: minima, medians and paired ratios; says on which CPU
#[derive(clap::Args)]
pub struct Args {
    /// What to measure
    #[arg(value_enum)]
    name: Name,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Log seconds that the replays take (framework: of each size; memory: in all; view: of each run; faults: in tens); of a case (radio);
    /// that a player plays (report)
    #[arg(long)]
    seconds: Option<f64>,
    /// Only the cases whose names have this in them (radio, faults)
    #[arg(long)]
    only: Option<String>,
    /// Without namespaces: over a relay on loopback, which loses nothing (radio)
    #[arg(long)]
    loopback: bool,
    /// What the log recorded instead of the network, so that little is computed (faults)
    #[arg(long)]
    recorded_detections: bool,
    /// Interpreter with the packages that detector (numpy, spconv), network (torch, openvino, nncf, onnxruntime), train (torch) and
    /// registration (numpy, small_gicp) are compared with
    #[arg(long)]
    python: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Name {
    /// Rotated NMS against powerboxesrs
    Nms,
    /// Finished points per second and core of the simulator, at every place
    Simulate,
    /// From points to the canvas; the pillar step against spconv
    Detector,
    /// Networks from sweep to boxes, encoders and whole frames; against PyTorch, OpenVINO and ONNX Runtime
    Network,
    /// A training step, against PyTorch
    Train,
    /// From the points of a sweep to its pose on a map, against small_gicp
    Registration,
    /// OPV2V's folders to a log: points per second and core, and a frame of four agents
    Import,
    /// A BEV map into bytes and out again, step by step, in all elements
    Transmission,
    /// From the last point to fused boxes in realtime on dora, 2, 4 and 8 agents
    Framework,
    /// Boxes beside clouds on a slow link, against Zenoh's own way; between two network namespaces where they can be made
    /// (realo-lab emulate), else over a relay on loopback
    Radio,
    /// Late fusion on two machines while links, peers and clocks fail; fails where the ego misses frames, books do not add up or
    /// fused is worse than alone; needs network namespaces (realo-lab emulate)
    Faults,
    /// Growth of resident memory over a looped realtime replay
    Memory,
    /// What `realo run --view` costs a run on dora, and how many pictures a second come; four agents, early fusion
    View,
    /// How long a report takes to be made and to open, and how many pictures a second its player draws in Chromium
    Report,
}

impl Name {
    /// Whether it has the car's program run graphs.
    fn runs_graphs(self) -> bool {
        matches!(
            self,
            Name::Framework | Name::Faults | Name::Memory | Name::View | Name::Report
        )
    }

    /// What the Python that it is compared with needs.
    fn packages(self) -> &'static [&'static str] {
        match self {
            Name::Detector => &["numpy", "cumm", "spconv"],
            Name::Network => &["torch", "openvino", "nncf", "onnxruntime"],
            Name::Train => &["torch"],
            Name::Registration => &["numpy", "small_gicp"],
            _ => &[],
        }
    }
}

/// Runs one bench and prints what it found.
pub fn main(args: &Args) -> Result<Outcome> {
    if let (Some(python), packages @ [_, ..]) = (&args.python, args.name.packages()) {
        peer::Peer::check(python, packages)?;
    }
    // Before a log is made for it.
    if args.name.runs_graphs() {
        beside("realo")?;
    }
    let only = args.only.as_deref().unwrap_or_default();
    let name = args.name.to_possible_value();
    let name = name.map_or(String::new(), |name| name.get_name().to_string());
    let progress = Progress::as_lines(format!("bench {name}"), "", None);
    match args.name {
        Name::Nms => print(&nms::bench(&progress)?, args.json),
        Name::Simulate => print(&simulate::bench(args.seconds.unwrap_or(45.0), &progress)?, args.json),
        Name::Detector => print(&detector::bench(args.python.as_deref(), &progress)?, args.json),
        Name::Network => print(&network::bench(args.python.as_deref(), &progress)?, args.json),
        Name::Train => print(&train::bench(args.python.as_deref(), &progress)?, args.json),
        Name::Registration => print(&registration::bench(args.python.as_deref(), &progress)?, args.json),
        Name::Import => print(&import::bench(&progress)?, args.json),
        Name::Transmission => print(&transmission::bench(&progress)?, args.json),
        Name::Framework => print(&framework::bench(args.seconds.unwrap_or(10.0), &progress)?, args.json),
        Name::Radio => print(
            &radio::bench(args.seconds.unwrap_or(11.0), only, args.loopback, &progress)?,
            args.json,
        ),
        Name::Faults => {
            let found = faults::bench(args.seconds.unwrap_or(20.0), only, args.recorded_detections, &progress)?;
            print(&found, args.json)?;
            Ok(found.check())
        }
        Name::Memory => print(&memory::bench(args.seconds.unwrap_or(600.0), &progress)?, args.json),
        Name::View => print(&view::bench(args.seconds.unwrap_or(20.0), &progress)?, args.json),
        Name::Report => print(&report::bench(args.seconds.unwrap_or(5.0), &progress)?, args.json),
    }
}

fn print<B: Serialize + std::fmt::Display>(bench: &B, json: bool) -> Result<Outcome> {
    if json {
        println!(
            "{}",
            serde_json::to_string_pretty(&Named {
                cpu: realo_cli::cpu(),
                bench
            })?
        );
    } else {
        println!("{bench}\nCPU: {}", realo_cli::cpu());
    }
    Ok(Outcome::Complete)
}

#[derive(Serialize)]
struct Named<'a, B> {
    cpu: String,
    #[serde(flatten)]
    bench: &'a B,
}
