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
//! | `curves` | precision and recall, distributions |
//! | `verdict` | three sentences on what came out |
//! | `points` | sweeps of agents, in few bytes |
//! | `html` | the page around the document |
//! | `live` | the sweeps of a run that goes on |

mod curves;
mod document;
mod error;
mod html;
mod judged;
mod live;
mod points;
mod recorded;
mod scenes;
mod verdict;

use std::path::PathBuf;

use realo_report::differences;
use realo_results::{Run, read_run};

pub use error::{DifferentProtocols, PageError};
pub use html::html;
pub use live::{Live, Watched, live_page};
pub use verdict::sentences as verdict;

use document::{Document, RunPart};
use points::Points;
use scenes::{Names, Scenes};

/// Runs that the player holds at most; the tables and charts have all.
const MOST_RECORDINGS: usize = 12;
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
    /// Sweeps that the player has, of all recordings together.
    pub sweeps: usize,
    /// Points on the page.
    pub points: usize,
}

/// Hears what is read and how far that is: words, done, all.
pub type Watch<'a> = dyn Fn(&str, usize, usize) + 'a;

/// Makes the page of some runs.
///
/// # Errors
/// A folder without a complete run; a file of another version; a damaged recording; with points, a log that is gone or of
/// another run.
pub fn page(request: &Request, watch: &Watch) -> Result<Page, PageError> {
    let mut runs: Vec<(&str, Run)> = Vec::new();
    for (name, folder) in &request.runs {
        watch(&format!("reading {name}"), runs.len(), request.runs.len());
        runs.push((name, read_run(folder)?));
    }
    let borrowed: Vec<(&str, &Run)> = runs.iter().map(|(name, run)| (*name, run)).collect();
    let mut names = Names::default();
    let mut left_out = Vec::new();
    let mut scenes = Scenes::default();
    let with_player = request.runs.len().min(MOST_RECORDINGS);
    if with_player < request.runs.len() {
        left_out.push(format!(
            "the player holds the first {with_player} of {} runs; name fewer runs to see others",
            request.runs.len()
        ));
    }
    let most_sweeps = (MOST_SWEEPS / with_player.max(1)).max(64);
    for (number, (name, folder)) in request.runs.iter().take(with_player).enumerate() {
        watch(&format!("reading the recording of {name}"), number, with_player);
        scenes.read(number, name, folder, request, most_sweeps, &mut names, &mut left_out)?;
    }
    scenes.check_given(request)?;
    scenes.share_truth();
    let mut document = Document {
        version: 1,
        program: realo_logs::program(),
        verdict: verdict::sentences(&borrowed),
        iou: verdict::overlap(&borrowed),
        differences: differences(&borrowed),
        runs: borrowed.iter().map(|(name, run)| RunPart::of(name, run)).collect(),
        classes: names.classes,
        scenes: std::mem::take(&mut scenes.parts),
        points: Vec::new(),
        left_out,
    };
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
    })
}
