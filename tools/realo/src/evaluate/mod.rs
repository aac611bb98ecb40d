//! `realo evaluate`: a recording scored after the fact, with the code that scores in the graph.

mod played;

use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail, eyre};
use realo_cli::{Outcome, Progress};
use realo_logs::{Log, McapFile};
use realo_results::scoring::{Collector, Evaluation, Protocol, frame_scores};
use realo_results::{FilesError, Run, Settings};
use realo_schemas::{Boxes, GroundTruth};

use crate::fit::protocol_fits;
use crate::render::log_folders;
use crate::run::log_content;
use crate::tables::Show;
use crate::truth_reader::TruthReader;
use played::{Misfit, Sweeps};

/// Scores a recording's boxes against a log's ground truth: the table of the run, without model or graph
#[derive(clap::Args)]
pub struct Args {
    /// The log that was played [default: where the run beside the recording says that it was, else by its name here or in
    /// target/realo]
    log: Option<PathBuf>,
    /// The recording of the run: `recording.mcap` in the folder of a log and an ego
    #[arg(long)]
    detections: PathBuf,
    /// Protocol: a name or a file [default: the log's]
    #[arg(long)]
    protocol: Option<String>,
    /// Agents of the run, whose points make truth [default: those of the recorded run]
    #[arg(long, value_delimiter = ',')]
    agents: Vec<String>,
    /// A line for each scored frame and class: true, false and all objects at each IoU
    #[arg(long, conflicts_with_all = ["json", "format", "full"])]
    frames: bool,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    show: Show,
}

/// Prints the table.
pub fn main(args: &Args) -> Result<Outcome> {
    let log = Log::open(log_path(args)?)?;
    let protocol = Protocol::load(args.protocol.as_deref().unwrap_or(&log.info().protocol))?;
    let recording = McapFile::open(&args.detections)?;
    let recorded = Recorded::look(args, &recording)?;
    protocol_fits(&protocol, &log, &recorded.ego)?;
    let agents = match args.agents.is_empty() {
        true => recorded.agents.clone(),
        false => args.agents.clone(),
    };
    let again = || TruthReader::open(log.path(), &recorded.ego, &agents);
    let mut sweeps = Sweeps::new(again, realo_player::sweeps_per_pass(&log, &recorded.ego))?;
    // Of a sweep the collector keeps what scores need, in whole numbers; nothing else is kept.
    let mut collector = Collector::new(protocol);
    let mut scored = 0;
    let progress = Progress::new("scoring", "sweeps", None);
    for message in realo_recorder::truth_of(&args.detections)? {
        let played = message?.into_parts::<GroundTruth>()?;
        // Truth reaches further than the boxes that came of its sweeps: that those are missing says nothing.
        if recorded.last.is_some_and(|last| played.0.seq > last) {
            continue;
        }
        let (header, truth) = sweeps.find(&played).map_err(|misfit| not_of_log(args, &log, misfit))?;
        collector.add_truth(&header, &truth)?;
        scored += 1;
        progress.add(1.0);
    }
    for message in realo_recorder::boxes_of(&args.detections)? {
        let (header, boxes) = message?.into_parts::<Boxes>()?;
        collector.add_boxes(&header, boxes)?;
    }
    progress.finish();
    let in_log = if recording.truncation().is_some() {
        sweeps.count()?
    } else {
        0
    };
    let mut notes = notes_of_cuts(&log, &recording, scored, &recorded.ego, in_log);
    notes.extend(note_of_another_log(args, &log)?);
    let mut evaluation = collector.finish();
    for scene in &mut evaluation.scenes {
        scene.name = log
            .path()
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
    }
    let table = args.frames.then(|| frames_table(&evaluation));
    let settings = Settings {
        graph: "recording".into(),
        ego: recorded.ego.clone(),
        ..Settings::default()
    };
    let run = Run::of_evaluation(settings, evaluation, [sweeps.into_reader()?.losses()]);
    let has_faults = run.result.log_faults() > 0;
    print(args, run, table, &notes);
    Ok(match notes.is_empty() && !has_faults {
        true => Outcome::Complete,
        false => Outcome::Partial,
    })
}

/// Prints the table of the run, or that of its frames, and on standard error what a reader must know.
fn print(args: &Args, mut run: Run, frames: Option<String>, notes: &[String]) {
    match frames {
        Some(table) => {
            print!("{table}");
            run.result.notes.iter().for_each(|note| eprintln!("realo: {note}"));
        }
        None => {
            run.result.notes.extend_from_slice(notes);
            args.show.print(&[("recording", &run)]);
        }
    }
    notes.iter().for_each(|note| eprintln!("realo: {note}"));
}

/// The log that was given, or that of the run in whose folder the recording lies.
fn log_path(args: &Args) -> Result<PathBuf> {
    if let Some(log) = &args.log {
        return Ok(log.clone());
    }
    let shown = args.detections.display();
    let give = "give the log that was played: realo evaluate LOG --detections …";
    // A recording that is not there is the first thing to say.
    McapFile::open(&args.detections)?;
    let run = run_beside(&args.detections)
        .wrap_err_with(|| format!("{shown}: no finished run beside it says which log was played; {give}"))?;
    let candidates = run.log_candidates(&log_folders());
    let tried: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
    let found = candidates.into_iter().find(|path| path.exists());
    found.ok_or_else(|| match tried.is_empty() {
        true => eyre!("{shown}: the run beside it does not say which log was played; {give}"),
        false => eyre!(
            "{shown}: its log is not where it was (looked for {}); {give}",
            tried.join(", ")
        ),
    })
}

/// What a reader must know where the log or the recording ends early.
fn notes_of_cuts(log: &Log, recording: &McapFile, scored: usize, ego: &str, sweeps: usize) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(cut) = recording.truncation() {
        notes.push(format!(
            "{}: {cut}; what lies before the cut was scored: {scored} sweeps, of {sweeps} of {ego} in the log",
            recording.path().display()
        ));
    }
    if let Some(cut) = log.truncation() {
        notes.push(format!(
            "{}: {cut}; what lies before the cut was scored",
            log.path().display()
        ));
    }
    notes
}

/// What a reader must know where the log holds something else than the one that the run beside the recording played.
fn note_of_another_log(args: &Args, log: &Log) -> Result<Option<String>> {
    // Without the argument it is that of the run.
    if args.log.is_none() {
        return Ok(None);
    }
    let Ok(run) = run_beside(&args.detections) else {
        return Ok(None);
    };
    let hash = log_content(log.path())?;
    let other = run.samples.logs.iter().find(|(_, known)| **known != hash);
    Ok(other.map(|(name, _)| {
        format!(
            "{}: its content differs from log `{name}`, which the run beside the recording played; scores may be wrong: give the log \
             that was played",
            log.path().display()
        )
    }))
}

/// The run in whose folder a recording lies.
fn run_beside(recording: &Path) -> Result<Run, FilesError> {
    let folder = recording.parent().filter(|folder| !folder.as_os_str().is_empty());
    realo_results::read_run(folder.unwrap_or(Path::new(".")))
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
                    counts.true_positives, counts.false_positives, counts.total
                ));
            }
            table.push('\n');
        }
    }
    table
}

/// What a recording is of, by its first messages.
struct Recorded {
    ego: String,
    /// Who took part.
    agents: Vec<String>,
    /// Of a recording that was cut the last sweep of which boxes are there.
    last: Option<u64>,
}

impl Recorded {
    /// Looks at what stands first in a recording; of one that was cut, at all boxes.
    fn look(args: &Args, recording: &McapFile) -> Result<Self> {
        let shown = args.detections.display();
        let mut boxes = realo_recorder::boxes_of(&args.detections)?;
        let Some(first) = boxes.next().transpose()? else {
            match recording.truncation() {
                Some(cut) => bail!("{shown}: {cut}: no final boxes are left in this recording; run again"),
                None => {
                    bail!(
                        "{shown}: no final boxes in this recording: was it of a graph with a recorder on its last boxes?"
                    )
                }
            }
        };
        let mut last = None;
        if recording.truncation().is_some() {
            last = Some(first.header.seq);
            for message in boxes {
                last = last.max(Some(message?.header.seq));
            }
        }
        let Some(truth) = realo_recorder::truth_of(&args.detections)?.next().transpose()? else {
            bail!(
                "{shown}: no ground truth in this recording, expected one for each sweep that was played: wire \
                 `player/truth` to the recorder's input `truth`"
            );
        };
        let (_, truth) = truth.into_parts::<GroundTruth>()?;
        Ok(Recorded {
            ego: first.header.agent.to_string(),
            agents: truth.agents.iter().map(|agent| agent.to_string()).collect(),
            last,
        })
    }
}

fn not_of_log(args: &Args, log: &Log, misfit: Misfit) -> eyre::Report {
    let (recording, path) = (args.detections.display(), log.path().display());
    // Of a log that was cut the beginning fits, or nothing is left to tell by.
    let cut = log.truncation().filter(|_| misfit.fitted > 0 || misfit.beyond);
    let what = match cut {
        Some(cut) => format!("{path} is {cut}: {recording} goes on after the cut; give the whole log that was played"),
        None => format!("{recording} is a recording of another log than {path}; give the log that was played"),
    };
    misfit.reason.wrap_err(what)
}
