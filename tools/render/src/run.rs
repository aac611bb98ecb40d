use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use realo_logs::{Log, LogError};
use realo_recorder::{boxes_of, truth_of};
use realo_results::{Run, RunResult, read_run, run_folder};
use realo_schemas::report::Crossing;
use realo_schemas::{Boxes, GroundTruth, Header, Message, Nanos};
use realo_scoring::{Collector, Evaluation, Frame, Protocol};

use crate::fused::{fused, fused_sweeps};
use crate::{Judged, RenderError};

const RECORDING: &str = "recording.mcap";
/// Where a complete run is kept that an interrupted one came after.
const KEPT: &str = "complete-run-before";

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
    /// Smallest IoU at which a detection is true here: the smallest of the protocol.
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
    choose_with(request, &|_, _, _| ())
}

/// Hears of a run's folder how many of its sweeps were looked at, and how many are to be.
pub type Watch<'a> = dyn Fn(&Path, usize, usize) + 'a;

/// As [`choose`]; `watch` hears how far it is.
pub(crate) fn choose_with(request: &Request, watch: &Watch) -> Result<Chosen, RenderError> {
    let mut best: Option<Chosen> = None;
    let mut there = Vec::new();
    for (folder, run) in runs(request)? {
        let cell = Cell::read(&folder, run, request)?;
        there.push(cell.describe());
        if request.ego.as_ref().is_some_and(|ego| *ego != cell.ego) {
            continue;
        }
        let Some(chosen) = cell.choose(request.frame, &|done, all| watch(&folder, done, all))? else {
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

/// The egos of a run.
///
/// # Errors
/// A folder without a complete run.
pub(crate) fn egos(run: &Path) -> Result<Vec<String>, RenderError> {
    let ego = |folder: PathBuf| Ok(read_run(&folder)?.result.settings.ego);
    folders(run)?.into_iter().map(ego).collect()
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
    // The sum of runs that are kept lies beside them.
    let (above, kept) = match (run.parent(), run.ends_with(KEPT)) {
        (Some(above), true) => (above, KEPT),
        _ => (run, ""),
    };
    let mut found: Vec<PathBuf> = below(above)
        .iter()
        .flat_map(|log| below(log))
        .map(|folder| folder.join(kept))
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

/// A run of one log and ego, as it was recorded: which sweeps it has. What is in them is read when it is looked at.
struct Cell {
    result: RunResult,
    log: Log,
    protocol: Protocol,
    ego: String,
    recording: PathBuf,
    /// Sweeps with truth, and whether they are scored.
    truth: BTreeMap<u64, bool>,
    /// Sweeps with boxes.
    boxes: BTreeSet<u64>,
    /// Sweeps for which something was fused.
    fused: BTreeSet<u64>,
}

/// What was recorded of a sweep.
#[derive(Default)]
struct Sweep {
    truth: Option<(Header, GroundTruth)>,
    boxes: Option<(Header, Boxes)>,
}

/// The candidate that shows most so far.
struct Best {
    seq: u64,
    sweep: Sweep,
    frame: Frame,
    judged: Judged,
}

impl Cell {
    fn read(folder: &Path, run: Run, request: &Request) -> Result<Self, RenderError> {
        let recording = folder.join(RECORDING);
        if !recording.exists() {
            let mend = match folder.ends_with(KEPT) {
                true => "name the folder of a run that has one: these results are kept without a recording",
                false => "give the graph a node `recorder` and run it again",
            };
            return Err(RenderError::NoRecording { file: recording, mend });
        }
        let log = open_log(&run, request)?;
        let mut boxes = BTreeSet::new();
        for message in boxes_of(&recording)? {
            boxes.insert(message?.header.seq);
        }
        let ego = run.result.settings.ego.clone();
        let mut truth = BTreeMap::new();
        for message in truth_of(&recording)? {
            let (header, content) = message?.into_parts::<GroundTruth>()?;
            truth.insert(header.seq, content.key);
        }
        let protocol = match run.samples.evaluation {
            Some(Evaluation { protocol, .. }) => protocol,
            None => Protocol::load(&log.info().protocol)?,
        };
        Ok(Cell {
            result: run.result,
            log,
            protocol,
            fused: fused_sweeps(&recording, &ego)?,
            ego,
            recording,
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
        let mut sweeps: Vec<u64> = self.truth.keys().chain(&self.boxes).copied().collect();
        sweeps.sort_unstable();
        sweeps.dedup();
        sweeps.into_iter()
    }

    fn keys(&self) -> impl Iterator<Item = u64> {
        self.truth.iter().filter(|(_, key)| **key).map(|(seq, _)| *seq)
    }

    /// The sweep of this number, or the key frame (without any: the sweep) that shows most.
    fn choose(self, seq: Option<u64>, watch: &dyn Fn(usize, usize)) -> Result<Option<Chosen>, RenderError> {
        let candidates: BTreeSet<u64> = match seq {
            Some(seq) => self.sweeps().filter(|known| *known == seq).collect(),
            None if self.keys().next().is_some() => self.keys().collect(),
            None => self.sweeps().collect(),
        };
        let mut best: Option<Best> = None;
        // Of equal ones the first: they may come in another order.
        let gain = |judged: &Judged, seq: u64| (judged.added(), judged.hits(), Reverse(seq));
        let mut looked_at = 0;
        self.each(&candidates, |seq, sweep| {
            looked_at += 1;
            watch(looked_at, candidates.len());
            let frame = self.frame(&sweep)?;
            let judged = Judged::of(&frame, &self.protocol, self.protocol.ious[0], self.fused.contains(&seq));
            if best
                .as_ref()
                .is_none_or(|best| gain(&judged, seq) > gain(&best.judged, best.seq))
            {
                best = Some(Best {
                    seq,
                    sweep,
                    frame,
                    judged,
                });
            }
            Ok(())
        })?;
        best.map(|best| self.chosen(best)).transpose()
    }

    /// Gives each of these sweeps once, as soon as all that was recorded of it is read; the most that waits for its other
    /// half is what the graph had in work at a time.
    fn each(
        &self,
        wanted: &BTreeSet<u64>,
        mut give: impl FnMut(u64, Sweep) -> Result<(), RenderError>,
    ) -> Result<(), RenderError> {
        let footprint = self.log.info().agent(&self.ego).and_then(|agent| agent.footprint);
        let ready = |message: &Result<Message, LogError>| message.as_ref().map_or(Nanos::MIN, |one| one.header.ready);
        let (mut truth, mut boxes) = (
            truth_of(&self.recording)?.peekable(),
            boxes_of(&self.recording)?.peekable(),
        );
        let mut waiting: BTreeMap<u64, Sweep> = BTreeMap::new();
        loop {
            let truth_first = match (truth.peek(), boxes.peek()) {
                (None, None) => return Ok(()),
                (Some(truth), Some(boxes)) => ready(truth) <= ready(boxes),
                (truth, _) => truth.is_some(),
            };
            let next = if truth_first { truth.next() } else { boxes.next() };
            let Some(message) = next.transpose()? else { continue };
            let seq = message.header.seq;
            if !wanted.contains(&seq) {
                continue;
            }
            let sweep = waiting.entry(seq).or_default();
            if truth_first {
                let mut part = message.into_parts::<GroundTruth>()?;
                // A recording leaves the footprint out; detections in it are the ego itself.
                part.1.ego_footprint = footprint;
                sweep.truth = Some(part);
            } else {
                sweep.boxes = Some(message.into_parts::<Boxes>()?);
            }
            let complete = sweep.truth.is_some() == self.truth.contains_key(&seq)
                && sweep.boxes.is_some() == self.boxes.contains(&seq);
            if complete {
                give(seq, waiting.remove(&seq).unwrap_or_default())?;
            }
        }
    }

    fn chosen(self, best: Best) -> Result<Chosen, RenderError> {
        let Best {
            seq,
            sweep: Sweep { truth, boxes },
            frame,
            judged,
        } = best;
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
        Ok(Chosen {
            fused: fused(&self.recording, &self.ego, seq)?,
            iou: self.protocol.ious[0],
            result: self.result,
            log: self.log,
            ego: self.ego,
            agents,
            protocol: self.protocol,
            seq,
            stamp: header.stamp,
            key,
            processed: frame.processed,
            has_truth,
            header,
            truth,
            judged,
        })
    }

    /// A sweep as the evaluator sees it, as if it were scored.
    fn frame(&self, sweep: &Sweep) -> Result<Frame, RenderError> {
        let mut collector = Collector::new(self.protocol.clone());
        match (&sweep.truth, &sweep.boxes) {
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
        if let Some((header, boxes)) = &sweep.boxes {
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
