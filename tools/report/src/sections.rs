//! What a table shows, section by section.

mod clocks;
mod localization;
mod objects;
mod scores;
mod times;
mod tracking;
mod traffic;

use std::collections::BTreeSet;

use realo_results::{Cooperation, FinalBoxes, Run, Spread};
use realo_schemas::Kind;
use realo_scoring::Table;

use crate::cells::{alarm, count, spread, values};
use crate::columns::{OFFLINE, STATE, unscored_boxes};
use crate::foot::V2X_REAL;
use crate::settings::{ISA, MODEL, POSE_SOURCE, PRECOMPUTED, PROGRAMS, PROJECT, RATE, SEED, SET, Setting, is_given};
use crate::text::one_line;
pub use clocks::said as said_of_clocks;
use clocks::{clocks, has_clocks};
use objects::{detections, recall};
use scores::{accuracy, in_the_order_of_v2x_real, intervals, mean_accuracy, seen};
use times::{ages, latency, steps};
use tracking::{changes, identities, velocities};
use traffic::{accounting, are_states_used, kinds, peers, volume};

/// Rows under a title.
pub struct Section {
    pub title: String,
    pub rows: Vec<Row>,
}

/// A label and a cell for each run; a row without any cell is not shown.
pub struct Row {
    pub label: String,
    pub cells: Vec<Option<String>>,
}

/// Rows of one section, filled run by run.
struct Rows<'a> {
    runs: &'a [&'a Run],
    rows: Vec<Row>,
}

impl Rows<'_> {
    fn add(&mut self, label: impl Into<String>, cell: impl Fn(&Run) -> Option<String>) {
        self.rows.push(Row {
            label: label.into(),
            cells: self.runs.iter().map(|run| cell(run)).collect(),
        });
    }

    /// Rows that matter only where some run has more than none.
    fn add_counts(&mut self, label: &str, get: impl Fn(&Run) -> Option<u64>) {
        if self.runs.iter().any(|run| get(run).is_some_and(|n| n > 0)) {
            self.add(label, |run| get(run).map(count));
        }
    }

    /// The same of what makes the other values of a run doubtful: `!` goes before the number of a run that has some.
    fn add_alarms(&mut self, label: &str, get: impl Fn(&Run) -> Option<u64>) {
        if self.runs.iter().any(|run| get(run).is_some_and(|n| n > 0)) {
            self.add(label, |run| get(run).map(alarm));
        }
    }
}

/// The IoUs of all runs.
pub fn ious(runs: &[&Run]) -> Vec<String> {
    names(
        runs.iter()
            .filter_map(|run| run.result.accuracy.as_ref())
            .flat_map(|accuracy| accuracy.sorted.mean_ap.keys()),
    )
}

/// All sections, headline first; or the main ones.
pub fn sections(runs: &[&Run], full: bool) -> Vec<Section> {
    let contents = Contents { runs, full };
    let last = vec![contents.other_order()];
    let all = [contents.scores(), contents.times(), contents.messages(), last];
    all.into_iter().flatten().collect()
}

/// Runs side by side, in whole or in short.
struct Contents<'a> {
    runs: &'a [&'a Run],
    full: bool,
}

impl Contents<'_> {
    fn section(&self, title: impl Into<String>, fill: impl Fn(&mut Rows)) -> Section {
        let mut rows = Rows {
            runs: self.runs,
            rows: Vec::new(),
        };
        fill(&mut rows);
        Section {
            title: title.into(),
            rows: rows.rows,
        }
    }

    /// A title with the IoUs of its rows.
    fn at(&self, name: &str) -> String {
        format!("{name}, IoU {}", ious(self.runs).join(" / "))
    }

    fn scores(&self) -> Vec<Section> {
        let ious = ious(self.runs);
        let strict = ious.last().cloned().unwrap_or_default();
        let skipping = self.runs.iter().any(|run| run.result.frames.key_skipped > 0);
        let mut sections = vec![
            self.section("run", |rows| settings(rows, self.full)),
            self.section(self.at("AP"), |rows| {
                accuracy(rows, &ious, |result| Some(&result.accuracy.as_ref()?.sorted));
                intervals(rows, &ious);
                disturbances(rows);
            }),
            self.section(self.at("AP, objects that the ego itself sees"), |rows| {
                accuracy(rows, &ious, |result| seen(result.accuracy_seen.as_ref()?));
            }),
        ];
        if skipping {
            sections.push(self.section(self.at("AP, processed frames only"), |rows| {
                accuracy(rows, &ious, |result| Some(&result.accuracy_processed.as_ref()?.sorted));
            }));
        }
        if self.runs.iter().any(|run| run.result.tracking.is_some()) {
            sections.extend([
                self.section("identities: HOTA / DetA / AssA", identities),
                self.section("changes of identity: all / tracks that swap", changes),
                self.section("velocity error, m/s: all / moving", velocities),
            ]);
        }
        if self.runs.iter().any(|run| run.result.localization.is_some()) {
            sections.extend([
                self.section(
                    "position error on the ground, m: mean / 95 % / max",
                    localization::positions,
                ),
                self.section("height error, m: mean / 95 % / max", localization::heights),
                self.section("heading error, degrees: mean / 95 % / max", localization::headings),
                self.section(
                    "localization, % of sweeps: tracking / dead reckoning / init / lost / NEES inside its 95 % band",
                    localization::statuses,
                ),
            ]);
        }
        if self.full {
            sections.extend([
                self.section(format!("recall / precision, IoU {strict}"), |rows| {
                    recall(rows, &strict)
                }),
                self.section(format!("true / false / objects, IoU {strict}"), |rows| {
                    detections(rows, &strict)
                }),
            ]);
        }
        sections
    }

    fn times(&self) -> Vec<Section> {
        let mut sections = vec![
            self.section("frames", |rows| frames(rows, self.full)),
            self.section("latency, ms: p50 / p95 / p99", |rows| latency(rows, self.full)),
        ];
        if self.full {
            sections.push(self.section("steps of stages, ms: p50 / p95 / p99", steps));
        }
        sections.extend([
            self.section("age of the data that were fused, ms: p50 / p95 / p99", ages),
            self.section(
                "stamps apart of the data that were fused, ms: p50 / p95 / p99",
                distances,
            ),
        ]);
        sections
    }

    fn messages(&self) -> Vec<Section> {
        let mut sections = vec![self.section("sent for each frame of the ego: messages / KB", volume)];
        if self.runs.iter().any(|run| !run.result.peers.is_empty()) {
            let title = "peers: their clock minus the ego's ± uncertainty, round trip, ms; Mbit/s";
            sections.push(self.section(title, peers));
        }
        if has_clocks(self.runs, self.full) {
            let title = "clocks: to be added to stamps ± bound, ms";
            sections.push(self.section(title, |rows| clocks(rows, self.full)));
        }
        let with_states = self.full || are_states_used(self.runs);
        for kind in kinds(self.runs).into_iter().filter(|kind| with_states || kind != STATE) {
            sections.push(self.section(format!("messages over links: {kind}"), |rows| accounting(rows, &kind)));
        }
        sections
    }

    /// The reference's order beside the standard one.
    fn other_order(&self) -> Section {
        let ious = ious(self.runs);
        // Without objects of every class there is no mean.
        let has_mean = self.runs.iter().any(|run| {
            let order = in_the_order_of_v2x_real(&run.result);
            order.is_some_and(|order| order.mean_ap.values().any(Option::is_some))
        });
        self.section(self.at(&format!("AP {V2X_REAL}")), |rows| {
            match self.full || !has_mean {
                true => accuracy(rows, &ious, in_the_order_of_v2x_real),
                false => mean_accuracy(rows, &ious, in_the_order_of_v2x_real),
            }
        })
    }
}

fn names<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    names.cloned().collect::<BTreeSet<_>>().into_iter().collect()
}

/// Settings that are shown if a run has them.
const RARE: [Setting; 6] = [PROJECT, POSE_SOURCE, PRECOMPUTED, SET, PROGRAMS, RATE];
/// Settings that nearly every run has; among the main rows only if they differ, or if somebody chose them.
const USUAL: [Setting; 3] = [SEED, MODEL, ISA];

fn settings(rows: &mut Rows, full: bool) {
    let text = |text: &String| (!text.is_empty()).then(|| text.clone());
    rows.add("mode", |run| text(&run.result.settings.mode));
    rows.add("ego", |run| text(&run.result.settings.ego));
    rows.add("coop", |run| {
        let in_vain = run.result.cooperation.as_ref().is_some_and(Cooperation::added_nothing);
        let who = &run.result.settings.coop;
        match in_vain {
            true => Some(format!("{who} (added nothing)").trim_start().to_string()),
            false => text(who),
        }
    });
    // Offline a link does nothing.
    rows.add("link", |run| {
        text(&run.result.settings.link).filter(|_| full || !is_offline(run))
    });
    rows.add("compute", |run| text(&run.result.settings.compute));
    let usual = USUAL
        .iter()
        .filter(|setting| full || is_notable(rows.runs, setting))
        .collect::<Vec<_>>();
    for (name, value) in RARE.iter().chain(usual) {
        if rows.runs.iter().any(|run| !value(&run.result.settings).is_empty()) {
            rows.add(*name, |run| text(value(&run.result.settings)));
        }
    }
    rows.add("log", |run| match &run.result.logs[..] {
        [] => None,
        [log] => Some(log.clone()),
        logs => Some(format!("{} logs", logs.len())),
    });
    rows.add("protocol", |run| run.result.protocol.clone());
    if rows.runs.iter().any(|run| run.result.runs > 1) {
        rows.add("pooled runs / logs", |run| {
            Some(format!("{} / {}", run.result.runs, run.result.logs.len()))
        });
    }
}

/// Whether somebody chose a setting, or runs have different values of it.
fn is_notable(runs: &[&Run], (name, value): &Setting) -> bool {
    let values: BTreeSet<&String> = runs.iter().map(|run| value(&run.result.settings)).collect();
    let known = values.iter().filter(|value| !value.is_empty());
    known.count() > 1 || runs.iter().any(|run| is_given(run, name))
}

fn is_offline(run: &Run) -> bool {
    run.result.settings.mode == OFFLINE
}

/// The classes of all runs: those that everybody looks for first.
pub fn classes<'a, T: 'a>(tables: impl Iterator<Item = &'a Table<T>>) -> Vec<String> {
    classes_of(tables.flat_map(|table| table.keys()))
}

/// The same of names.
fn classes_of<'a>(all: impl Iterator<Item = &'a String>) -> Vec<String> {
    let mut classes = names(all);
    let place = |class: &String| {
        ["vehicle", "pedestrian", "truck"]
            .iter()
            .position(|known| known == class)
    };
    classes.sort_by_key(|class| (place(class).unwrap_or(usize::MAX), class.clone()));
    classes
}

/// What makes a score that of a disturbed run stands beside it.
fn disturbances(rows: &mut Rows) {
    rows.add_alarms("messages that dora lost", |run| Some(run.result.transport.total_lost));
    rows.add_alarms("frames without others' truth", |run| {
        Some(run.result.counter("truth_not_joined"))
    });
    rows.add_alarms("frames that were skipped", |run| Some(run.result.frames.key_skipped));
}

/// Classes of boxes that have a row: a stage of one's own may name each box otherwise.
const CLASSES_SHOWN: usize = 20;

fn frames(rows: &mut Rows, full: bool) {
    rows.add("sweeps of the ego", |run| Some(count(run.result.frames.total)));
    rows.add("scored", |run| Some(count(run.result.frames.key)));
    rows.add("without boxes", |run| Some(count(run.result.frames.skipped)));
    found(rows, full);
    rows.add("rate, Hz of log time", |run| {
        let rate = run.timing.rate_hz.filter(|_| full || !is_offline(run))?;
        Some(format!("{rate:.2}"))
    });
}

/// How many boxes were found: the main result of runs that are not scored.
fn found(rows: &mut Rows, full: bool) {
    let of = |run: &Run| match full {
        true => run.result.boxes.clone(),
        false => unscored_boxes(run).cloned(),
    };
    rows.add("boxes: all / for each frame", |run| {
        let boxes = of(run)?;
        Some(values([count(boxes.total), format!("{:.1}", boxes.per_frame)]))
    });
    let all: Vec<FinalBoxes> = rows.runs.iter().filter_map(|run| of(run)).collect();
    let classes = classes_of(all.iter().flat_map(|boxes| boxes.by_class.keys()));
    for class in classes.iter().take(CLASSES_SHOWN) {
        rows.add(format!("  {}", one_line(class)), |run| {
            Some(count(*of(run)?.by_class.get(class)?))
        });
    }
}

/// Offline the data whose stamp is nearest are fused, younger ones too: how far apart stamps are counts, not an age.
fn distances(rows: &mut Rows) {
    let kinds: BTreeSet<Kind> = rows
        .runs
        .iter()
        .flat_map(|run| run.samples.ages_ns.keys())
        .copied()
        .collect();
    for kind in kinds {
        rows.add(kind.to_string(), |run| {
            let ages = run.samples.ages_ns.get(&kind).filter(|_| is_offline(run))?;
            spread(Some(&Spread::of_ages(&ages.distances())))
        });
    }
}
