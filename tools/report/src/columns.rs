//! The columns of a table with a row for each run.

use std::collections::BTreeMap;

use realo_results::{END_TO_END, FinalBoxes, Run, RunResult, Settings};
use realo_scoring::{Accuracy, Orders};

use crate::cells::{NONE, age, count, fraction, kilobytes};
use crate::sections::{classes, ious};
use crate::settings::{self, Setting};

/// Offline nothing is late, and computing takes no time.
pub const OFFLINE: &str = "offline";
/// The kind of what agents say of where they are.
pub const STATE: &str = "agent_state";

/// A value of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// There is none.
    None,
    /// A number as it is, and as a reader sees it.
    Number(f64, String),
    /// Words.
    Text(String),
}

impl Cell {
    fn number(value: Option<f64>, written: impl Fn(f64) -> String) -> Self {
        value.map_or(Cell::None, |value| Cell::Number(value, written(value)))
    }

    fn count(value: u64) -> Self {
        Cell::Number(value as f64, count(value))
    }

    fn text(value: &str) -> Self {
        match value.is_empty() {
            true => Cell::None,
            false => Cell::Text(value.into()),
        }
    }

    /// For a reader.
    pub fn shown(&self) -> &str {
        match self {
            Cell::None => NONE,
            Cell::Number(_, shown) => shown,
            Cell::Text(text) => text,
        }
    }

    /// For a program: a number with all its digits, nothing where there is no value.
    pub fn exact(&self) -> String {
        match self {
            Cell::None => String::new(),
            Cell::Number(value, _) => value.to_string(),
            Cell::Text(text) => text.clone(),
        }
    }
}

/// A value of all runs.
pub struct Column {
    /// What it is, shared by neighbours that are alike: `mAP`, `KB per`.
    pub head: String,
    /// Which of them, or the unit: `0.5`, `frame`.
    pub part: String,
    /// Its name for a program.
    pub field: String,
    /// The values, run by run.
    pub cells: Vec<Cell>,
}

/// Columns that are filled run by run.
struct Columns<'a> {
    runs: &'a [&'a Run],
    all: Vec<Column>,
}

impl Columns<'_> {
    fn add(&mut self, [head, part, field]: [&str; 3], cell: impl Fn(&Run) -> Cell) {
        self.all.push(Column {
            head: head.into(),
            part: part.into(),
            field: field.into(),
            cells: self.runs.iter().map(|run| cell(run)).collect(),
        });
    }

    /// A column that is left out where no run has a value.
    fn add_known(&mut self, names: [&str; 3], cell: impl Fn(&Run) -> Cell) {
        self.add(names, cell);
        if self
            .all
            .last()
            .is_some_and(|column| column.cells.iter().all(|cell| *cell == Cell::None))
        {
            self.all.pop();
        }
    }

    fn accuracy(&mut self, ious: &[String]) {
        for iou in ious {
            self.add(["mAP", iou, &format!("mAP_{iou}")], |run| {
                mean_ap(run, iou, |orders| &orders.sorted)
            });
        }
    }

    /// Every class; where only the `known` ones are wanted, those of which some run has objects.
    fn classes(&mut self, ious: &[String], known: bool) {
        let accuracies = self.runs.iter().filter_map(|run| run.result.accuracy.as_ref());
        for class in classes(accuracies.map(|accuracy| &accuracy.sorted.ap)) {
            for iou in ious {
                let ap = |run: &Run| {
                    let accuracy = run.result.accuracy.as_ref();
                    let per_iou = accuracy.and_then(|accuracy| accuracy.sorted.ap.get(&class));
                    Cell::number(per_iou.and_then(|ap| ap.get(iou).copied().flatten()), |ap| {
                        fraction(Some(ap))
                    })
                };
                let names = [&*class, iou, &format!("AP_{class}_{iou}")];
                match known {
                    true => self.add_known(names, ap),
                    false => self.add(names, ap),
                }
            }
        }
    }
}

fn mean_ap(run: &Run, iou: &str, order: impl Fn(&Orders<Accuracy>) -> &Accuracy) -> Cell {
    let accuracy = run.result.accuracy.as_ref().map(order);
    let mean = accuracy.and_then(|accuracy| accuracy.mean_ap.get(iou).copied().flatten());
    Cell::number(mean, |ap| fraction(Some(ap)))
}

/// mAP of a run at each IoU, as a reader sees it; nothing of a run without scores.
pub fn mean_aps(run: &Run) -> Vec<String> {
    let ious = ious(&[run]);
    let cells = ious.iter().map(|iou| mean_ap(run, iou, |orders| &orders.sorted));
    let cells: Vec<String> = cells.map(|cell| cell.shown().to_string()).collect();
    match cells.iter().all(|cell| cell == NONE) {
        true => Vec::new(),
        false => cells,
    }
}

/// AP at each IoU over the classes that have objects, with these classes, where a run lacks objects of others, so that it has no mAP.
pub fn known_aps(run: &Run) -> Option<(Vec<&str>, Vec<String>)> {
    let accuracy = &run.result.accuracy.as_ref()?.sorted;
    let ious = ious(&[run]);
    let ap = |class: &str, iou: &String| accuracy.ap.get(class)?.get(iou).copied().flatten();
    let classes = accuracy.ap.keys().map(String::as_str);
    let classes: Vec<&str> = classes
        .filter(|class| ious.iter().all(|iou| ap(class, iou).is_some()))
        .collect();
    let mean = |iou: &String| {
        let sum: f64 = classes.iter().filter_map(|class| ap(class, iou)).sum();
        fraction(Some(sum / classes.len() as f64))
    };
    let means = ious.iter().map(mean).collect();
    (!classes.is_empty() && classes.len() < accuracy.ap.len() && !ious.is_empty()).then_some((classes, means))
}

/// What is known of boxes that have no score: without truth an evaluator gives no class an AP.
pub fn unscored_boxes(run: &Run) -> Option<&FinalBoxes> {
    let accuracy = run.result.accuracy.iter();
    let mut aps = accuracy.flat_map(|accuracy| accuracy.sorted.ap.values().flat_map(BTreeMap::values));
    let is_scored = aps.any(Option::is_some);
    run.result.boxes.as_ref().filter(|_| !is_scored)
}

/// The interval of mAP over logs; `None` with fewer than two.
pub fn interval(run: &Run, iou: &str) -> Option<[f64; 2]> {
    let intervals = run.result.intervals.as_ref()?;
    intervals.accuracy.sorted.mean_ap.get(iou).copied().flatten()
}

/// KB of payload that crossed the links for each sweep of the ego; states, which everybody sends, are not part of it.
pub fn payload(result: &RunResult) -> Option<f64> {
    let bytes: u64 = result
        .channels()
        .filter(|(_, kind, _)| *kind != STATE)
        .map(|(.., books)| books.bytes)
        .sum();
    (result.frames.total > 0 && !result.settings.mode.is_empty())
        .then(|| bytes as f64 / 1000.0 / result.frames.total as f64)
}

/// Median age of what was fused, ms; of an offline run how far stamps lie apart.
pub fn median_age(run: &Run) -> Option<f64> {
    let mut ages = realo_results::Ages::default();
    let kinds = run.samples.ages_ns.iter();
    let kinds = kinds.filter(|(kind, _)| kind.to_string() != STATE);
    kinds.for_each(|(_, of_kind)| ages.merge(of_kind));
    if run.result.settings.mode == OFFLINE {
        ages = ages.distances();
    }
    realo_results::Spread::of_ages(&ages).p50
}

/// Whether stages took time in a run, so that its latency says something.
pub fn has_latency(run: &Run) -> bool {
    let Settings { mode, compute, .. } = &run.result.settings;
    mode != OFFLINE && (mode == "realtime" || !compute.is_empty())
}

/// The main columns.
pub fn main(runs: &[&Run]) -> Vec<Column> {
    let ious = ious(runs);
    let mut columns = Columns { runs, all: Vec::new() };
    columns.accuracy(&ious);
    for iou in &ious {
        columns.add_known(["95 % interval", iou, ""], |run| {
            let interval = interval(run, iou);
            interval.map_or(Cell::None, |[low, high]| Cell::Text(format!("{low:.3}–{high:.3}")))
        });
    }
    columns.add_known(["boxes", "per frame", "boxes_per_frame"], |run| {
        let mean = unscored_boxes(run).map(|boxes| boxes.per_frame);
        Cell::number(mean, |mean| format!("{mean:.1}"))
    });
    traffic(&mut columns);
    columns.classes(&ious, true);
    columns.all
}

fn traffic(columns: &mut Columns) {
    columns.add_known(["KB per", "frame", "KB_per_frame"], |run| {
        Cell::number(payload(&run.result), kilobytes)
    });
    columns.add_known(["age", "ms", "age_ms"], |run| Cell::number(median_age(run), age));
    columns.add_known(["end to", "end, ms", "end_to_end_ms"], |run| {
        let latency = run.timing.latency_ms.get(END_TO_END).filter(|_| has_latency(run));
        Cell::number(latency.and_then(|latency| latency.p50), age)
    });
}

const SETTINGS: [Setting; 16] = [
    ("graph", |settings| &settings.graph),
    ("mode", |settings| &settings.mode),
    ("coop", |settings| &settings.coop),
    ("ego", |settings| &settings.ego),
    settings::LINK,
    settings::COMPUTE,
    settings::SEED,
    settings::PROJECT,
    settings::POSE_SOURCE,
    settings::PRECOMPUTED,
    settings::MODEL,
    settings::ISA,
    settings::SET,
    settings::PROGRAMS,
    settings::RATE,
    settings::GRAPH_HASH,
];

/// The columns for a program: all settings, then all numbers of the main columns.
pub fn exact(runs: &[&Run]) -> Vec<Column> {
    let ious = ious(runs);
    let mut columns = Columns { runs, all: Vec::new() };
    for (name, get) in SETTINGS {
        columns.add([name, "", name], |run| Cell::text(get(&run.result.settings)));
    }
    columns.add(["agents", "", "agents"], |run| Cell::text(&run.result.agents.join(" ")));
    columns.add(["protocol", "", "protocol"], |run| {
        Cell::text(run.result.protocol.as_deref().unwrap_or_default())
    });
    columns.add(["logs", "", "logs"], |run| Cell::count(run.result.logs.len() as u64));
    columns.add(["logs cut", "", "logs_cut"], |run| {
        Cell::text(&run.result.logs_cut.join(" "))
    });
    columns.add(["ended by", "", "ended_by"], |run| {
        Cell::text(run.result.ended_by.as_deref().unwrap_or_default())
    });
    columns.add(["scored frames", "", "scored_frames"], |run| {
        Cell::count(run.result.frames.key)
    });
    columns.accuracy(&ious);
    for iou in &ious {
        for (end, name) in ["low", "high"].into_iter().enumerate() {
            columns.add(["", "", &format!("mAP_{iou}_{name}")], |run| {
                Cell::number(interval(run, iou).map(|bounds| bounds[end]), |ap| fraction(Some(ap)))
            });
        }
    }
    columns.classes(&ious, false);
    for iou in &ious {
        columns.add(["", "", &format!("mAP_v2x_real_order_{iou}")], |run| {
            mean_ap(run, iou, |orders| &orders.v2x_real)
        });
    }
    traffic(&mut columns);
    columns.add(["boxes", "", "boxes"], |run| {
        let boxes = run.result.boxes.as_ref();
        boxes.map_or(Cell::None, |boxes| Cell::count(boxes.total))
    });
    columns.add(["", "", "boxes_per_frame"], |run| {
        let boxes = run.result.boxes.as_ref();
        Cell::number(boxes.map(|boxes| boxes.per_frame), |mean| format!("{mean:.1}"))
    });
    columns.add(["", "", "messages_lost_by_dora"], |run| {
        Cell::count(run.result.transport.total_lost)
    });
    columns.add(["", "", "scored_frames_skipped"], |run| {
        Cell::count(run.result.frames.key_skipped)
    });
    columns.all
}
