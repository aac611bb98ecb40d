mod recorded;

use std::path::{Path, PathBuf};

use realo_logs::Log;
use realo_results::{Run, RunResult, read_run, retain_parts, run_folder};
use realo_schemas::report::Crossing;
use realo_schemas::{GroundTruth, Header, Nanos};
use realo_scoring::Protocol;

use crate::{Judged, RenderError};
use recorded::RecordedRun;

/// The recording in the folder of a run of one log and ego.
pub const RECORDING: &str = "recording.mcap";
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
        let recorded = RecordedRun::read(&folder, run, request)?;
        there.push(recorded.describe());
        if request.ego.as_ref().is_some_and(|ego| *ego != recorded.ego) {
            continue;
        }
        let Some(chosen) = recorded.choose(request.frame, &|done, all| watch(&folder, done, all))? else {
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
    single_runs(run)?.into_iter().map(ego).collect()
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
    for folder in single_runs(&request.run)? {
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

/// The folders of single runs, of one log and ego each: this one, or those `<log>/<ego>` below that its result is the sum of.
///
/// # Errors
/// A folder without a complete run.
pub fn single_runs(run: &Path) -> Result<Vec<PathBuf>, RenderError> {
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
    retain_parts(run, &mut found);
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
