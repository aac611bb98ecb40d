//! Runs as one page for a browser: what was run, the verdict in words, a player of what was found, and charts.
//!
//! The page is one file that asks no network for anything. [`page`] reads the folders of runs, their recordings and, where
//! points are wanted, the log that was played. The numbers are those of the runs' files and of the evaluator's own matching.
//!
//! | module | what it gives |
//! |---|---|
//! | `document` | the JSON document that the page holds |
//! | `recorded`, `judged` | what a run's recording holds of each sweep, matched with the truth |
//! | `scenes` | the sweeps of one log and ego in all runs, on one clock |
//! | `own` | whether a recording is that of the run beside it |
//! | `alone` | which run of the ego alone a run is compared with |
//! | `curves` | precision and recall, distributions |
//! | `verdict` | three sentences on what came out |
//! | `localized` | what estimated poses cost |
//! | `points` | sweeps of agents, in few bytes |
//! | `html` | the page around the document |
//! | `live` | the sweeps of a run that goes on |

mod alone;
mod beside;
mod curves;
mod document;
mod error;
mod html;
mod judged;
mod live;
mod localized;
mod own;
mod points;
mod recorded;
mod scenes;
mod verdict;

use std::path::{Path, PathBuf};

use realo_report::differences;
use realo_results::{Run, read_run};

pub use beside::beside;
pub use error::{DifferentProtocols, OtherRecording, PageError};
pub use html::html;
pub use live::{Live, Watched, live_page};
pub use localized::localization_cost;
pub use verdict::sentences as verdict;

use alone::{Against, against};
use document::{Document, RunPart};
use points::Points;
use scenes::{Names, Scenes};

/// Runs that the player holds at most; the tables and charts have all.
const MOST_RECORDINGS: usize = 12;
/// Runs whose graphs are drawn.
const MOST_GRAPHS: usize = 12;
/// Sweeps that are read of all recordings together, at most.
const MOST_SWEEPS: usize = 16_384;

/// Which runs become a page, and what is on it.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// Folders that `realo run` wrote, each with its name on the page.
    pub runs: Vec<(String, PathBuf)>,
    /// The log that was played; `None`: looked for where the runs say that it was, then by its name in `log_folders`.
    pub log: Option<PathBuf>,
    /// Where logs usually are.
    pub log_folders: Vec<PathBuf>,
    /// Whether the page holds the points of the agents, for which it reads the log.
    pub points: bool,
    /// Largest size of the page without points, bytes.
    pub most_bytes: usize,
    /// Largest size of the points and what says whose they are, bytes.
    pub most_point_bytes: usize,
}

/// A page, and what is not on it.
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    /// The file.
    pub html: String,
    /// What was left out, why, and what to try; the page says it too.
    pub left_out: Vec<String>,
    /// How many of that are runs, or parts of them, that are damaged or gone.
    pub failed: usize,
    /// Runs on the page.
    pub runs: usize,
    /// Sweeps that the player has, of all recordings together.
    pub sweeps: usize,
    /// Points on the page.
    pub points: usize,
}

/// Hears what is read and how far that is: words, done, all.
pub type Watch<'a> = dyn Fn(&str, usize, usize) + 'a;

/// Draws the graph of a run, out of its folder, as an SVG document; `None` where the run does not say its graph.
pub type Draw<'a> = dyn Fn(&Path, &Run) -> Option<String> + 'a;

/// A run with its name and folder.
type Named<'a> = (&'a str, &'a Path, Run);

/// Runs that could be read, with their places in the request.
struct Readable<'a> {
    runs: Vec<Named<'a>>,
    /// What is said of the others.
    failed: Vec<String>,
}

impl<'a> Readable<'a> {
    /// # Errors
    /// No run can be read.
    fn of(request: &'a Request, watch: &Watch) -> Result<Self, PageError> {
        let (mut runs, mut failed) = (Vec::new(), Vec::new());
        for (number, (name, folder)) in request.runs.iter().enumerate() {
            watch(&format!("reading {name}"), number, request.runs.len());
            match read_run(folder) {
                Ok(run) => runs.push((name.as_str(), folder.as_path(), run)),
                Err(error) if request.runs.len() == 1 => return Err(error.into()),
                Err(error) => failed.push(format!("{name}: not on this page: {error}")),
            }
        }
        match runs.is_empty() {
            true => Err(PageError::NoRun(failed)),
            false => Ok(Readable { runs, failed }),
        }
    }
}

/// The places of the runs that the player holds, ascending: those of the highest scores, and the ego alone beside the best.
fn in_player(runs: &[(&str, &Run)], against: &[Against]) -> Vec<usize> {
    let order = verdict::by_score(runs);
    let mut chosen: Vec<usize> = order.iter().copied().take(MOST_RECORDINGS).collect();
    let alone = order.iter().find_map(|at| against[*at].against);
    if let Some(alone) = alone.filter(|alone| !chosen.contains(alone)) {
        chosen.pop();
        chosen.push(alone);
    }
    chosen.sort_unstable();
    chosen
}

/// Reads the recordings of the runs that the player holds. Returns how many runs, or parts of them, are damaged or gone.
fn read_scenes(
    scenes: &mut Scenes,
    runs: &[Named],
    against: &[Against],
    request: &Request,
    names: &mut Names,
    left_out: &mut Vec<String>,
    watch: &Watch,
) -> Result<usize, PageError> {
    let borrowed: Vec<(&str, &Run)> = runs.iter().map(|(name, _, run)| (*name, run)).collect();
    let player = in_player(&borrowed, against);
    if player.len() < runs.len() {
        left_out.push(format!(
            "the player holds the {} best of {} runs; name fewer runs to see others",
            player.len(),
            runs.len()
        ));
    }
    let most_sweeps = (MOST_SWEEPS / player.len().max(1)).max(64);
    for (done, number) in player.iter().copied().enumerate() {
        let (name, folder, _) = &runs[number];
        watch(&format!("reading the recording of {name}"), done, player.len());
        scenes.read(number, name, folder, request, most_sweeps, names, left_out)?;
    }
    let damaged = std::mem::take(&mut scenes.failed);
    let count = damaged.len();
    for (name, error) in damaged {
        match request.runs.len() == 1 && scenes.parts.is_empty() {
            true => return Err(error),
            false => left_out.push(format!("{name}: not in the player: {error}")),
        }
    }
    Ok(count)
}

/// Makes the page of some runs, with graphs as `draw` draws them. Of several runs those that cannot be read are left out.
///
/// # Errors
/// No folder with a complete run; a file of another version or a damaged recording of the only run; a log that was named and is
/// of another run; with points, a log that is gone.
pub fn page(request: &Request, draw: &Draw, watch: &Watch) -> Result<Page, PageError> {
    let Readable { runs, failed } = Readable::of(request, watch)?;
    let borrowed: Vec<(&str, &Run)> = runs.iter().map(|(name, _, run)| (*name, run)).collect();
    let against = against(&borrowed);
    let mut names = Names::default();
    let mut count = failed.len();
    let mut left_out = failed;
    let mut scenes = Scenes::default();
    count += read_scenes(&mut scenes, &runs, &against, request, &mut names, &mut left_out, watch)?;
    scenes.check_given(request)?;
    scenes.share_truth();
    let mut document = Document {
        version: 1,
        program: realo_logs::program(),
        verdict: verdict::sentences(&borrowed),
        iou: verdict::overlap(&borrowed),
        differences: differences(&borrowed),
        runs: borrowed
            .iter()
            .zip(against)
            .map(|((name, run), against)| RunPart::of(name, run, against))
            .collect(),
        classes: names.classes,
        scenes: std::mem::take(&mut scenes.parts),
        points: Vec::new(),
        left_out,
    };
    for (number, program) in std::mem::take(&mut scenes.programs) {
        document.runs[number].program = Some(program);
    }
    for (part, (_, folder, run)) in document.runs.iter_mut().zip(&runs).take(MOST_GRAPHS) {
        part.picture = draw(folder, run);
    }
    if runs.len() > MOST_GRAPHS {
        document.left_out.push(format!(
            "the graphs of the first {MOST_GRAPHS} of {} runs are drawn; `realo graph RUN` draws any",
            runs.len()
        ));
    }
    let title = document.title();
    let around = html(&title, "", "").len();
    let mut json = document.fitted(request.most_bytes.saturating_sub(around))?;
    let mut points = Points::default();
    if request.points {
        // Of the sweeps that are left.
        scenes.parts = std::mem::take(&mut document.scenes);
        points = Points::read(&scenes, request, &mut document.left_out, watch)?;
        document.scenes = scenes.parts;
        document.points = std::mem::take(&mut points.index);
        json = document.json()?;
    }
    Ok(Page {
        sweeps: document.sweeps(),
        points: points.count,
        html: html(&title, &json, &points.text),
        left_out: document.left_out,
        failed: count,
        runs: document.runs.len(),
    })
}
