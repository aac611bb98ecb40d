//! The points of a sweep: what the runs of each came to, and what they are compared with.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::rc::Rc;

use eyre::{Result, WrapErr};
use realo_cli::campaign::{self, Campaign};
use realo_report::Run;
use realo_results::scoring;
use serde_json::Value;

use super::Args;
use super::vary::Vary;

/// The graph of the ego alone.
pub const ALONE: &str = "no_fusion";
/// The overlap at which curves and margins are drawn, where the protocol has it.
const IOU: &str = "0.5";
/// Blocks of scored frames of one log.
const BLOCKS: usize = 20;

/// A graph with a value of each setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Number of the graph.
    pub graph: usize,
    /// Its name.
    pub strategy: String,
    /// A value of each setting.
    pub values: Vec<String>,
    /// Its runs, by their places in the plan.
    runs: Vec<usize>,
}

impl Point {
    /// A point whose runs have no place yet.
    pub fn new(graph: usize, values: Vec<String>, runs: Vec<usize>) -> Self {
        Point {
            graph,
            strategy: String::new(),
            values,
            runs,
        }
    }

    /// Puts the places of its runs in the place of their numbers.
    pub fn place(&mut self, places: &[usize]) {
        self.runs.iter_mut().for_each(|run| *run = places[*run]);
    }

    /// The same with the name of its graph.
    pub fn named(mut self, names: &[String]) -> Self {
        self.strategy.clone_from(&names[self.graph]);
        self
    }
}

/// What a point came to.
pub struct Row {
    pub point: Point,
    /// All its runs as one; `None` where some are missing.
    pub run: Option<Rc<Run>>,
}

/// All points.
pub struct Sweep {
    pub vary: Vec<Vary>,
    /// Graph by graph, the ego alone first.
    pub rows: Vec<Row>,
    /// Runs that are not done.
    missing: BTreeSet<usize>,
    /// What intervals are over: `logs`, or `blocks` of the scored frames of one log.
    pub over: &'static str,
}

impl Sweep {
    /// Reads what is done, and pools it point by point.
    ///
    /// # Errors
    /// Results that cannot be read or pooled.
    pub fn read(args: &Args, campaign: &Campaign, points: Vec<Point>) -> Result<Self> {
        let folders: Vec<Option<PathBuf>> = campaign
            .results::<Value>()?
            .into_iter()
            .map(|done| done.map(|(folder, _)| folder))
            .collect();
        let mut pooled: BTreeMap<Vec<usize>, Rc<Run>> = BTreeMap::new();
        let (mut rows, mut missing) = (Vec::new(), BTreeSet::new());
        let mut over = "logs";
        for point in points {
            let known: Option<Vec<&PathBuf>> = point.runs.iter().map(|run| folders[*run].as_ref()).collect();
            let run = match known.filter(|known| !known.is_empty()) {
                None => {
                    missing.extend(point.runs.iter().filter(|run| folders[**run].is_none()));
                    None
                }
                Some(known) => Some(match pooled.get(&point.runs) {
                    Some(run) => run.clone(),
                    None => {
                        let run = pool(&known).wrap_err_with(|| point.strategy.clone())?;
                        let run = Rc::new(run);
                        pooled.insert(point.runs.clone(), run.clone());
                        run
                    }
                }),
            };
            if run.as_ref().is_some_and(|run| run.result.logs.len() < 2) {
                over = "blocks";
            }
            rows.push(Row { point, run });
        }
        Ok(Sweep {
            vary: args.vary.clone(),
            rows,
            missing,
            over,
        })
    }

    /// How many runs are not done.
    pub fn missing(&self) -> usize {
        self.missing.len()
    }

    /// Whether no point has all its runs.
    pub fn is_empty(&self) -> bool {
        self.rows.iter().all(|row| row.run.is_none())
    }

    /// The overlap of curves and margins.
    pub fn iou(&self) -> String {
        let ious = self.ious();
        match ious.contains(IOU) {
            true => IOU.into(),
            false => ious.into_iter().next().unwrap_or_default(),
        }
    }

    /// All overlaps.
    pub fn ious(&self) -> BTreeSet<String> {
        let runs = self.rows.iter().filter_map(|row| row.run.as_ref());
        let accuracies = runs.filter_map(|run| run.result.accuracy.as_ref());
        accuracies
            .flat_map(|accuracy| accuracy.sorted.mean_ap.keys().cloned())
            .collect()
    }

    /// The row of a graph at these values.
    pub fn row(&self, strategy: &str, values: &[String]) -> Option<&Row> {
        let is_it = |row: &&Row| row.point.strategy == strategy && row.point.values == values;
        self.rows.iter().find(is_it)
    }

    /// mAP of a row minus that of the ego alone at the same values.
    pub fn margin(&self, row: &Row, iou: &str) -> Option<f64> {
        let alone = self.row(ALONE, &row.point.values)?;
        Some(row.mean_ap(iou)? - alone.mean_ap(iou)?)
    }
}

impl Row {
    /// The AP of the classes of which there are objects, all detections sorted by score.
    fn known(&self, iou: &str) -> Vec<(&str, f64)> {
        let accuracy = self.run.as_ref().and_then(|run| run.result.accuracy.as_ref());
        let classes = accuracy.into_iter().flat_map(|accuracy| &accuracy.sorted.ap);
        let known = classes.filter_map(|(class, ap)| Some((class.as_str(), ap.get(iou).copied().flatten()?)));
        known.collect()
    }

    /// Classes of which there are no objects.
    pub fn unknown(&self, iou: &str) -> Vec<String> {
        let accuracy = self.run.as_ref().and_then(|run| run.result.accuracy.as_ref());
        let classes = accuracy.into_iter().flat_map(|accuracy| accuracy.sorted.ap.keys());
        let known = self.known(iou);
        let is_unknown = |class: &&String| !known.iter().any(|(known, _)| known == class);
        classes.filter(is_unknown).cloned().collect()
    }

    /// mAP; where classes have no objects, the mean of the others.
    pub fn mean_ap(&self, iou: &str) -> Option<f64> {
        let known = self.known(iou);
        let sum: f64 = known.iter().map(|(_, ap)| ap).sum();
        let all = self.run.as_ref()?.result.accuracy.as_ref()?;
        let whole = all.sorted.mean_ap.get(iou).copied().flatten();
        whole.or_else(|| (!known.is_empty()).then(|| sum / known.len() as f64))
    }

    /// Its 95 % interval; not known where the mean is of several classes, but not of all.
    pub fn interval(&self, iou: &str) -> Option<[f64; 2]> {
        let intervals = self.run.as_ref()?.result.intervals.as_ref()?;
        let sorted = &intervals.accuracy.sorted;
        let only = match self.known(iou).as_slice() {
            [(class, _)] => sorted.ap.get(*class).and_then(|ap| ap.get(iou).copied().flatten()),
            _ => None,
        };
        sorted.mean_ap.get(iou).copied().flatten().or(only)
    }
}

/// Runs as one, with intervals over logs, or over blocks of scored frames where there is one log.
fn pool(folders: &[&PathBuf]) -> Result<Run> {
    let read = |folder: &&PathBuf| realo_report::read_run(folder).wrap_err_with(|| campaign::remedy(folder));
    let runs: Vec<Run> = folders.iter().map(read).collect::<Result<_>>()?;
    let mut run = realo_report::pool(&runs)?;
    if run.result.intervals.is_none()
        && let Some(evaluation) = &run.samples.evaluation
    {
        run.result.intervals = scoring::score(&evaluation.blocks(BLOCKS)).intervals;
    }
    Ok(run)
}
