use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use realo_logs::Log;
use realo_recorder::{read_boxes, read_truth};
use realo_results::{Run, RunResult, read_run, run_folder};
use realo_schemas::report::Crossing;
use realo_schemas::{Boxes, GroundTruth, Header, Nanos};
use realo_scoring::{Collector, Evaluation, Frame, Protocol};

use crate::fused::{Fused, fused};
use crate::{Judged, RenderError};

const RECORDING: &str = "recording.mcap";

/// Which frame of which run.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// A folder that `realo run` wrote: of all its logs and egos, or of one of them.
    pub run: PathBuf,
    /// Number of the ego's sweep; `None`: the key frame where cooperation added most true boxes.
    pub frame: Option<u64>,
    /// The ego; `None`: any.
    pub ego: Option<String>,
    /// The log that was played; `None`: looked for where the run says that it was, then by its name in `log_folders`.
    pub log: Option<PathBuf>,
    /// Where logs usually are.
    pub log_folders: Vec<PathBuf>,
}

/// A frame of a run, judged.
#[derive(Debug)]
pub struct Chosen {
    /// The run of one log and ego.
    pub result: RunResult,
    /// The log that was played.
    pub log: Log,
    /// The ego.
    pub ego: String,
    /// The agents of the mode, ego first.
    pub agents: Vec<String>,
    /// What counts.
    pub protocol: Protocol,
    /// Least IoU at which a detection is true here: the least of the protocol.
    pub iou: f64,
    /// Number of the ego's sweep.
    pub seq: u64,
    /// Its reference time, ns.
    pub stamp: Nanos,
    /// Whether the frame is scored in the run's results.
    pub key: bool,
    /// Whether boxes came for it.
    pub processed: bool,
    /// Whether the log says what is there; without that nothing is true or false.
    pub has_truth: bool,
    /// Header of its boxes, or of its truth where no boxes came.
    pub header: Header,
    /// What is there, as it was recorded.
    pub truth: Option<GroundTruth>,
    /// Messages that were fused, and their ages, ns from their stamps to when the ego asked.
    pub fused: Vec<(Crossing, Nanos)>,
    /// What was detected and what is there.
    pub judged: Judged,
}

/// Finds the frame that is asked for. Of several runs that have it, the one where cooperation added most; then the one
/// with most true boxes; then the first.
///
/// # Errors
/// A folder without a complete run or without a recording; a frame or ego that there is not (the error says which there
/// are); a log that is gone, or of another run.
pub fn choose(request: &Request) -> Result<Chosen, RenderError> {
    let mut best: Option<Chosen> = None;
    let mut there = Vec::new();
    for (folder, run) in runs(request)? {
        let cell = Cell::read(&folder, run, request)?;
        there.push(cell.describe());
        if request.ego.as_ref().is_some_and(|ego| *ego != cell.ego) {
            continue;
        }
        let Some(chosen) = cell.choose(request.frame)? else {
            continue;
        };
        let gain = |chosen: &Chosen| (chosen.judged.added(), chosen.judged.hits());
        if best.as_ref().is_none_or(|best| gain(&chosen) > gain(best)) {
            best = Some(chosen);
        }
    }
    best.ok_or_else(|| RenderError::NoFrame {
        run: request.run.clone(),
        asked: asked(request),
        there: there.join("; "),
    })
}

fn asked(request: &Request) -> String {
    let frame = request.frame.map(|frame| format!("sweep {frame}"));
    let ego = request.ego.as_ref().map(|ego| format!("ego `{ego}`"));
    match (frame, ego) {
        (Some(frame), Some(ego)) => format!("{frame} of {ego}"),
        (frame, ego) => frame.or(ego).unwrap_or_else(|| "sweep with boxes or truth".into()),
    }
}

/// The single runs that are meant: of the log that was given, where its name tells them apart.
fn runs(request: &Request) -> Result<Vec<(PathBuf, Run)>, RenderError> {
    let mut runs = Vec::new();
    for folder in folders(&request.run)? {
        let run = read_run(&folder)?;
        runs.push((folder, run));
    }
    let stem = request.log.as_ref().and_then(|log| log.file_stem());
    let of_log = |run: &Run| stem.is_some_and(|stem| run.result.logs.iter().any(|log| *log == *stem.to_string_lossy()));
    if runs.iter().any(|(_, run)| of_log(run)) {
        runs.retain(|(_, run)| of_log(run));
    }
    Ok(runs)
}

/// The folders of single runs: this one, or `<log>/<ego>` below.
fn folders(run: &Path) -> Result<Vec<PathBuf>, RenderError> {
    let run = &*run_folder(run);
    if run.join(RECORDING).exists() {
        return Ok(vec![run.into()]);
    }
    let mut found: Vec<PathBuf> = below(run)
        .iter()
        .flat_map(|log| below(log))
        .filter(|folder| folder.join(RECORDING).exists() || folder.join("result.json").exists())
        .collect();
    found.sort();
    if found.is_empty() {
        read_run(run)?;
        found.push(run.into());
    }
    Ok(found)
}

fn below(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
}

/// A run of one log and ego, as it was recorded.
struct Cell {
    result: RunResult,
    log: Log,
    protocol: Protocol,
    ego: String,
    boxes: BTreeMap<u64, (Header, Boxes)>,
    truth: BTreeMap<u64, (Header, GroundTruth)>,
    fused: BTreeMap<u64, Fused>,
}

impl Cell {
    fn read(folder: &Path, run: Run, request: &Request) -> Result<Self, RenderError> {
        let recording = folder.join(RECORDING);
        if !recording.exists() {
            return Err(RenderError::NoRecording { file: recording });
        }
        let log = open_log(&run, request)?;
        let by_seq = |header: &Header| header.seq;
        let mut boxes = BTreeMap::new();
        for message in read_boxes(&recording)? {
            let part = message.into_parts::<Boxes>()?;
            boxes.insert(by_seq(&part.0), part);
        }
        let ego = run.result.settings.ego.clone();
        let mut truth = BTreeMap::new();
        for message in read_truth(&recording)? {
            let mut part = message.into_parts::<GroundTruth>()?;
            // A recording leaves the footprint out; detections in it are the ego itself.
            part.1.ego_footprint = log.info().agent(&ego).and_then(|agent| agent.footprint);
            truth.insert(by_seq(&part.0), part);
        }
        let protocol = match run.samples.evaluation {
            Some(Evaluation { protocol, .. }) => protocol,
            None => Protocol::load(&log.info().protocol)?,
        };
        Ok(Cell {
            result: run.result,
            log,
            protocol,
            fused: fused(&recording, &ego)?,
            ego,
            boxes,
            truth,
        })
    }

    fn describe(&self) -> String {
        let sweeps: Vec<u64> = self.sweeps().collect();
        let keys: Vec<String> = self.keys().map(|seq| seq.to_string()).collect();
        let (first, last) = (sweeps.first().unwrap_or(&0), sweeps.last().unwrap_or(&0));
        let log = self.result.logs.join(", ");
        let sweeps = match sweeps.is_empty() {
            true => "no sweeps".into(),
            false => format!("sweeps {first} to {last}"),
        };
        let keys = match keys.is_empty() {
            true => "none is scored".into(),
            false => format!("scored: {}", keys.join(" ")),
        };
        format!("{log}, ego {}: {sweeps}, {keys}", self.ego)
    }

    fn sweeps(&self) -> impl Iterator<Item = u64> {
        let alone = self.boxes.keys().filter(|seq| !self.truth.contains_key(seq));
        let mut sweeps: Vec<u64> = self.truth.keys().chain(alone).copied().collect();
        sweeps.sort_unstable();
        sweeps.into_iter()
    }

    fn keys(&self) -> impl Iterator<Item = u64> {
        self.truth
            .iter()
            .filter(|(_, (_, truth))| truth.key)
            .map(|(seq, _)| *seq)
    }

    /// The sweep of this number, or the key frame (without any: the sweep) that shows most.
    fn choose(self, seq: Option<u64>) -> Result<Option<Chosen>, RenderError> {
        let candidates: Vec<u64> = match seq {
            Some(seq) => self.sweeps().filter(|known| *known == seq).collect(),
            None if self.keys().next().is_some() => self.keys().collect(),
            None => self.sweeps().collect(),
        };
        let iou = self.protocol.ious[0];
        let mut best: Option<(u64, Frame, Judged)> = None;
        for seq in candidates {
            let frame = self.frame(seq)?;
            let cooperated = self.fused.get(&seq).is_some_and(|fused| !fused.is_empty());
            let judged = Judged::of(&frame, &self.protocol, iou, cooperated);
            let gain = |judged: &Judged| (judged.added(), judged.hits());
            if best.as_ref().is_none_or(|(_, _, best)| gain(&judged) > gain(best)) {
                best = Some((seq, frame, judged));
            }
        }
        Ok(best.map(|(seq, frame, judged)| self.chosen(seq, iou, frame, judged)))
    }

    fn chosen(mut self, seq: u64, iou: f64, frame: Frame, judged: Judged) -> Chosen {
        let (truth, boxes) = (self.truth.remove(&seq), self.boxes.remove(&seq));
        let key = truth.as_ref().is_some_and(|(_, truth)| truth.key);
        let has_truth = key || truth.as_ref().is_some_and(|(_, truth)| !truth.boxes.is_empty());
        let mut agents: Vec<String> = match &truth {
            Some((_, truth)) => truth.agents.iter().map(|agent| agent.to_string()).collect(),
            None => self.result.agents.clone(),
        };
        if agents.is_empty() {
            agents.push(self.ego.clone());
        }
        let (of_truth, truth) = truth.unzip();
        let header = boxes.map(|(header, _)| header).or(of_truth);
        let header = header.expect("a chosen sweep has boxes or truth");
        Chosen {
            result: self.result,
            log: self.log,
            ego: self.ego,
            agents,
            protocol: self.protocol,
            iou,
            seq,
            stamp: header.stamp,
            key,
            processed: frame.processed,
            has_truth,
            header,
            truth,
            fused: self.fused.remove(&seq).unwrap_or_default(),
            judged,
        }
    }

    /// A sweep as the evaluator sees it, as if it were scored.
    fn frame(&self, seq: u64) -> Result<Frame, RenderError> {
        let mut collector = Collector::new(self.protocol.clone());
        let boxes = self.boxes.get(&seq);
        match (self.truth.get(&seq), boxes) {
            (Some((header, truth)), _) => {
                let mut truth = truth.clone();
                truth.key = true;
                if let Some(own) = &mut truth.own {
                    own.key = true;
                }
                collector.add_truth(header, &truth)?;
            }
            (None, Some((header, _))) => {
                let nothing_known = GroundTruth {
                    key: true,
                    ..GroundTruth::default()
                };
                collector.add_truth(header, &nothing_known)?;
            }
            (None, None) => {}
        }
        if let Some((header, boxes)) = boxes {
            collector.add_boxes(header, boxes.clone())?;
        }
        let scenes = collector.finish().scenes;
        Ok(scenes
            .into_iter()
            .flat_map(|scene| scene.frames)
            .next()
            .unwrap_or_default())
    }
}

fn open_log(run: &Run, request: &Request) -> Result<Log, RenderError> {
    let result = &run.result;
    let path = match &request.log {
        Some(path) => path.clone(),
        None => find_log(run, &request.log_folders)?,
    };
    let log = Log::open(&path)?;
    let ego = &result.settings.ego;
    if log.info().agent(ego).is_none() {
        let has: Vec<&str> = log.info().agents.iter().map(|agent| &*agent.name).collect();
        return Err(RenderError::OtherLog {
            log: path,
            name: name_of_log(run),
            reason: format!("it has no agent `{ego}` (it has: {})", has.join(", ")),
        });
    }
    Ok(log)
}

fn name_of_log(run: &Run) -> String {
    run.result.logs.first().cloned().unwrap_or_default()
}

fn find_log(run: &Run, folders: &[PathBuf]) -> Result<PathBuf, RenderError> {
    let candidates = run.log_candidates(folders);
    let found = candidates.iter().find(|path| path.exists()).cloned();
    found.ok_or_else(|| {
        let tried: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
        RenderError::NoLog {
            name: name_of_log(run),
            tried: match tried.is_empty() {
                true => "nothing: the run does not name it".into(),
                false => tried.join(", "),
            },
        }
    })
}
