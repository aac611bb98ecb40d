//! What it costs to pass a cloud through a plug-in: `cargo run --release -p realo --example hop [PYTHON_FILE]`.
//!
//! Without arguments the program passes clouds on to itself in a process of its own; with one, that program does.

use std::time::Instant;

use realo_host::Program;
use realo_operator::{AnyOperator, Describe, Error, Inputs, Operator, Outputs, PortId, Settings};
use realo_schemas::{Header, Kind, Message, PointCloud};
use serde::{Deserialize, Serialize};

/// Points of a cloud: 3.7 MB at 19 bytes each.
const POINTS: usize = 195_000;
const HOPS: usize = 200;

/// Passes clouds on.
#[derive(Describe)]
#[stage(settings = Nothing)]
struct Pass;

/// Nothing is to be set.
#[derive(Settings, Serialize, Deserialize)]
struct Nothing {}

/// What comes in.
#[derive(Inputs)]
enum Input {
    /// Any clouds.
    Clouds(Header, PointCloud),
}

/// What it sends.
#[derive(Outputs)]
enum Output {
    /// The same.
    Clouds(Header, PointCloud),
}

impl Operator for Pass {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Pass)
    }

    fn on_input(&mut self, Input::Clouds(header, cloud): Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        out.send(Output::Clouds(header, cloud));
        Ok(())
    }
}

fn main() -> std::process::ExitCode {
    if std::env::var_os(realo_operator::pipe::DRIVER_VARIABLE).is_some() {
        return realo_operator::run::<Pass>();
    }
    let own = std::env::current_exe().expect("this program has a path");
    let program = std::env::args()
        .nth(1)
        .unwrap_or_else(|| own.to_string_lossy().into_owned());
    let words = ["program".to_string(), program.clone()];
    let node = realo_graph::FlatNode::alone("pass", &words, &[]);
    let here = std::env::current_dir().expect("there is a folder");
    let plug_in = Program::of(&node, &here).expect("the node names a program");
    let mut plug_in = plug_in.start().unwrap_or_else(|reason| panic!("{reason}"));
    let floats = || vec![1.5f32; POINTS];
    let cloud = PointCloud::new(
        floats(),
        floats(),
        floats(),
        vec![7; POINTS],
        vec![8; POINTS],
        vec![9; POINTS],
    );
    let cloud = cloud.expect("the columns are as long as each other");
    let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Points, 0, 0, 0);
    let message = Message::new(header, cloud);
    for (name, stage) in [("inside", &mut Pass as &mut dyn AnyOperator), (&program, &mut plug_in)] {
        let mut took = Vec::new();
        for _ in 0..HOPS {
            let begun = Instant::now();
            let mut out = Outputs::at(0);
            stage
                .on_input(PortId(0), message.clone(), &mut out)
                .unwrap_or_else(|error| panic!("{error}"));
            took.push(begun.elapsed());
            assert!(out.take_sent() == [(PortId(0), message.clone())], "the cloud came back");
        }
        took.sort_unstable();
        let ms = |share: usize| took[(HOPS - 1) * share / 100].as_secs_f64() * 1e3;
        println!("{name}: p50 {:.2} ms, p95 {:.2} ms", ms(50), ms(95));
    }
    std::process::ExitCode::SUCCESS
}
