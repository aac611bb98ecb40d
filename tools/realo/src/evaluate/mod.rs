//! `realo evaluate`: a recording scored after the fact, with the code that scores in the graph.

mod played;

use std::path::PathBuf;

use eyre::{Result, WrapErr, bail, eyre};
use realo_evaluator::{Evaluation, Protocol, frame_scores};
use realo_operator::Source;
use realo_player::{Coop, Player};
use realo_results::{Run, Settings};
use realo_schemas::{Boxes, GroundTruth, Kind};

use crate::Outcome;
use played::{Sweep, Sweeps};

/// Scores a recording's boxes against a log's ground truth: the table of the run, without model or graph
#[derive(clap::Args)]
pub struct Args {
    /// The log that was played
    log: PathBuf,
    /// The recording of the run
    #[arg(long)]
    detections: PathBuf,
    /// Protocol: a name or a file [default: the log's]
    #[arg(long)]
    protocol: Option<String>,
    /// Agents of the run, whose points make truth [default: those of the recorded run]
    #[arg(long, value_delimiter = ',')]
    agents: Vec<String>,
    /// A line for each scored frame and class: true, false and all objects at each IoU
    #[arg(long, conflicts_with = "json")]
    frames: bool,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Prints the table.
pub fn main(args: &Args) -> Result<Outcome> {
    let log = realo_logs::Log::open(&args.log)?;
    let protocol = Protocol::load(args.protocol.as_deref().unwrap_or(&log.info().protocol))?;
    let recorded = realo_recorder::read_boxes(&args.detections)?;
    let Some(first) = recorded.first() else {
        bail!(
            "{}: no final boxes in this recording: was it of a graph with a recorder on its last boxes?",
            args.detections.display()
        );
    };
    let ego = first.header.agent.to_string();
    let played = recorded_truth(args)?;
    let agents = match args.agents.is_empty() {
        true => played[0].1.agents.iter().map(|agent| agent.to_string()).collect(),
        false => args.agents.clone(),
    };
    let per_pass = realo_player::sweeps_per_pass(&log, &ego);
    let truths = Sweeps::new(truths(args, &ego, &agents)?, per_pass)
        .played(&played)
        .wrap_err_with(|| not_of_log(args))?;
    let boxes = recorded
        .into_iter()
        .map(|message| message.into_parts::<Boxes>())
        .collect::<Result<Vec<_>, _>>()?;
    let mut evaluation = realo_evaluator::evaluate(truths, boxes, &protocol)?;
    for scene in &mut evaluation.scenes {
        scene.name = args.log.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    }
    if args.frames {
        print!("{}", frames_table(&evaluation));
        return Ok(Outcome::Complete);
    }
    let settings = Settings {
        graph: "recording".into(),
        ego,
        ..Settings::default()
    };
    let run = Run::of_evaluation(settings, evaluation);
    let named = [("recording", &run)];
    if args.json {
        println!("{}", realo_report::json(&named));
    } else {
        print!("{}", realo_report::table(&named));
    }
    Ok(Outcome::Complete)
}

/// A line for each scored frame and class.
fn frames_table(evaluation: &Evaluation) -> String {
    let ious: Vec<String> = evaluation
        .protocol
        .ious
        .iter()
        .map(|iou| Protocol::iou_key(*iou))
        .collect();
    let mut table = format!("{:>8} {:>20}  {:<12}", "sweep", "stamp ns", "class");
    let heads = ious.iter().map(|iou| format!("  true / false / objects, IoU {iou}"));
    table.extend(heads);
    table.push('\n');
    for frame in frame_scores(evaluation) {
        for (class, counts) in &frame.counts {
            table.push_str(&format!("{:>8} {:>20}  {class:<12}", frame.seq, frame.stamp));
            for iou in &ious {
                let counts = &counts[iou];
                table.push_str(&format!(
                    "  {:>10} / {:>5} / {:>13}",
                    counts.hits, counts.misses, counts.total
                ));
            }
            table.push('\n');
        }
    }
    table
}

/// The truth in the recording: which sweeps were played, and who took part.
fn recorded_truth(args: &Args) -> Result<Vec<Sweep>> {
    let truth = realo_recorder::read_truth(&args.detections)?;
    if truth.is_empty() {
        bail!(
            "{}: no ground truth in this recording, expected one for each sweep that was played: wire `player/truth` to \
             the recorder's input `truth`",
            args.detections.display()
        );
    }
    let parts = truth.into_iter().map(|message| message.into_parts::<GroundTruth>());
    Ok(parts.collect::<Result<_, _>>()?)
}

fn not_of_log(args: &Args) -> String {
    format!(
        "{} is a recording of another log than {}; give the log that was played",
        args.detections.display(),
        args.log.display()
    )
}

/// What the player tells the evaluator of a run of these agents.
fn truths(args: &Args, ego: &str, agents: &[String]) -> Result<Vec<Sweep>> {
    let config = realo_player::Config {
        log: args.log.clone(),
        ego: ego.into(),
        agents: agents.to_vec(),
        coop: Coop::All,
        points: false,
        ..realo_player::Config::default()
    };
    let mut player = Player::new(config).map_err(|error| eyre!(error))?;
    let mut truths = Vec::new();
    while let Some((_, _, message)) = Source::next(&mut player).map_err(|error| eyre!(error))? {
        if message.header.kind == Kind::Truth {
            truths.push(message.into_parts::<GroundTruth>()?);
        }
    }
    Ok(truths)
}
