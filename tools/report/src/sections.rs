//! What a table shows, section by section.

use std::collections::{BTreeMap, BTreeSet};

use realo_results::{Cooperation, END_TO_END, FRAMEWORK, Fates, LinkBooks, Run, RunResult, Spread};
use realo_schemas::Kind;
use realo_schemas::report::ClockBy;
use realo_scoring::{Accuracy, Counts, Orders, PointsBin, RangeBin, Table};

use crate::cells::{NONE, count, fraction, share, spread, values};
use crate::columns::{OFFLINE, STATE, interval};
use crate::foot::V2X_REAL;
use crate::settings::{ISA, MODEL, PRECOMPUTED, PROGRAMS, PROJECT, RATE, SEED, SET, Setting};

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
    let ious = ious(runs);
    let strict = ious.last().cloned().unwrap_or_default();
    let section = |title: String, fill: &dyn Fn(&mut Rows)| {
        let mut rows = Rows { runs, rows: Vec::new() };
        fill(&mut rows);
        let rows = rows.rows;
        Section { title, rows }
    };
    let at = |name: &str| format!("{name}, IoU {}", ious.join(" / "));
    // Without objects of every class there is no mean.
    let has_mean = runs.iter().any(|run| {
        let order = in_the_order_of_v2x_real(&run.result);
        order.is_some_and(|order| order.mean_ap.values().any(Option::is_some))
    });
    let skipping = runs.iter().any(|run| run.result.frames.key_skipped > 0);
    let mut sections = vec![
        section("run".into(), &|rows| settings(rows, full)),
        section(at("AP"), &|rows| {
            accuracy(rows, &ious, |result| Some(&result.accuracy.as_ref()?.sorted));
            intervals(rows, &ious);
            disturbances(rows);
        }),
        section(at("AP, objects that the ego itself sees"), &|rows| {
            accuracy(rows, &ious, |result| seen(result.accuracy_seen.as_ref()?));
        }),
    ];
    if skipping {
        sections.push(section(at("AP, processed frames only"), &|rows| {
            accuracy(rows, &ious, |result| Some(&result.accuracy_processed.as_ref()?.sorted));
        }));
    }
    if full {
        sections.extend([
            section(format!("recall / precision, IoU {strict}"), &|rows| {
                recall(rows, &strict)
            }),
            section(format!("true / false / objects, IoU {strict}"), &|rows| {
                detections(rows, &strict)
            }),
        ]);
    }
    sections.extend([
        section("frames".into(), &|rows| frames(rows, full)),
        section("latency, ms: p50 / p95 / p99".into(), &|rows| latency(rows, full)),
    ]);
    if full {
        sections.push(section("steps of stages, ms: p50 / p95 / p99".into(), &steps));
    }
    sections.extend([
        section("age of the data that were fused, ms: p50 / p95 / p99".into(), &ages),
        section(
            "stamps apart of the data that were fused, ms: p50 / p95 / p99".into(),
            &distances,
        ),
        section("sent for each frame of the ego: messages / KB".into(), &volume),
    ]);
    if runs.iter().any(|run| !run.result.peers.is_empty()) {
        let title = "peers: their clock minus the ego's ± uncertainty, round trip, ms; Mbit/s";
        sections.push(section(title.into(), &peers));
    }
    for kind in kinds(runs) {
        sections.push(section(format!("messages over links: {kind}"), &|rows| {
            accounting(rows, &kind)
        }));
    }
    sections.push(section(
        at(&format!("AP {V2X_REAL}")),
        &|rows| match full || !has_mean {
            true => accuracy(rows, &ious, in_the_order_of_v2x_real),
            false => mean_accuracy(rows, &ious, in_the_order_of_v2x_real),
        },
    ));
    sections
}

fn names<'a>(names: impl Iterator<Item = &'a String>) -> Vec<String> {
    names.cloned().collect::<BTreeSet<_>>().into_iter().collect()
}

/// Settings that are shown if a run has them.
const RARE: [Setting; 8] = [PROJECT, PRECOMPUTED, SET, PROGRAMS, RATE, SEED, MODEL, ISA];
/// So many of them are main ones.
const MAIN: usize = 5;

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
    for (name, value) in &RARE[..if full { RARE.len() } else { MAIN }] {
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

fn is_offline(run: &Run) -> bool {
    run.result.settings.mode == OFFLINE
}

/// The classes of all runs: those that everybody looks for first.
pub fn classes<'a, T: 'a>(tables: impl Iterator<Item = &'a Table<T>>) -> Vec<String> {
    let mut classes = names(tables.flat_map(|table| table.keys()));
    let place = |class: &String| {
        ["vehicle", "pedestrian", "truck"]
            .iter()
            .position(|known| known == class)
    };
    classes.sort_by_key(|class| (place(class).unwrap_or(usize::MAX), class.clone()));
    classes
}

/// Nothing where no object counts, e.g. because the log does not say what the ego sees.
fn seen(accuracy: &Orders<Accuracy>) -> Option<&Accuracy> {
    let sorted = &accuracy.sorted;
    let known = sorted
        .ap
        .values()
        .flat_map(|per_iou| per_iou.values())
        .any(Option::is_some);
    known.then_some(sorted)
}

fn in_the_order_of_v2x_real(result: &RunResult) -> Option<&Accuracy> {
    Some(&result.accuracy.as_ref()?.v2x_real)
}

fn accuracy(rows: &mut Rows, ious: &[String], get: impl Fn(&RunResult) -> Option<&Accuracy>) {
    let classes = classes(
        rows.runs
            .iter()
            .filter_map(|run| get(&run.result))
            .map(|accuracy| &accuracy.ap),
    );
    for class in classes {
        rows.add(class.clone(), |run| fractions(ious, get(&run.result)?.ap.get(&class)?));
    }
    mean_accuracy(rows, ious, get);
}

fn mean_accuracy(rows: &mut Rows, ious: &[String], get: impl Fn(&RunResult) -> Option<&Accuracy>) {
    rows.add("mAP", |run| fractions(ious, &get(&run.result)?.mean_ap));
    // mAP is of all classes of the protocol; where some have no truth, the mean of the others stands in its place.
    rows.add("mean of the AP above", |run| {
        let accuracy = get(&run.result)?;
        let known = accuracy.ap.values().filter(|ap| ap.values().any(Option::is_some));
        let known: Vec<_> = known.collect();
        let is_partial = known.len() > 1 && known.len() < accuracy.ap.len();
        let mean = |iou: &String| {
            let values: Option<Vec<f64>> = known.iter().map(|ap| ap.get(iou).copied().flatten()).collect();
            let values = values?;
            Some(values.iter().sum::<f64>() / values.len() as f64)
        };
        is_partial.then(|| values(ious.iter().map(|iou| fraction(mean(iou)))))
    });
}

/// A value for each IoU; nothing where none is known.
fn fractions(ious: &[String], known: &BTreeMap<String, Option<f64>>) -> Option<String> {
    let all: Vec<Option<f64>> = ious.iter().map(|iou| known.get(iou).copied().flatten()).collect();
    let is_known = all.iter().any(Option::is_some);
    is_known.then(|| values(all.into_iter().map(fraction)))
}

fn intervals(rows: &mut Rows, ious: &[String]) {
    let bound = |bounds: Option<[f64; 2]>| bounds.map_or(NONE.into(), |[low, high]| format!("{low:.3}–{high:.3}"));
    rows.add("mAP, 95 % interval over logs", |run| {
        run.result.intervals.as_ref()?;
        Some(values(ious.iter().map(|iou| bound(interval(run, iou)))))
    });
}

/// What makes a score that of a disturbed run stands beside it.
fn disturbances(rows: &mut Rows) {
    rows.add_counts("! messages that dora lost", |run| Some(run.result.transport.total_lost));
    rows.add_counts("! frames without others' truth", |run| {
        Some(run.result.counter("truth_not_joined"))
    });
    rows.add_counts("! frames that were skipped", |run| Some(run.result.frames.key_skipped));
}

fn counts<'a>(run: &'a Run, class: &str, iou: &str) -> Option<&'a Counts> {
    run.result.accuracy.as_ref()?.sorted.counts.get(class)?.get(iou)
}

fn count_classes(rows: &Rows) -> Vec<String> {
    classes(
        rows.runs
            .iter()
            .filter_map(|run| Some(&run.result.accuracy.as_ref()?.sorted.counts)),
    )
}

fn recall(rows: &mut Rows, iou: &str) {
    let both = |c: &Counts| {
        values([
            share(c.true_positives, c.total),
            share(c.true_positives, c.true_positives + c.false_positives),
        ])
    };
    for class in count_classes(rows) {
        rows.add(class.clone(), |run| counts(run, &class, iou).map(both));
        let bins = |run: &Run| -> Option<Vec<RangeBin>> {
            let by_range = run.result.precision_recall_by_range.as_ref()?;
            by_range.get(&class)?.get(iou).cloned()
        };
        let mut edges: Vec<(f64, Option<f64>)> = Vec::new();
        for bin in rows.runs.iter().filter_map(|run| bins(run)).flatten() {
            if !edges.contains(&(bin.from, bin.to)) {
                edges.push((bin.from, bin.to));
            }
        }
        for (from, to) in edges {
            let label = to.map_or(format!("  from {from} m"), |to| format!("  {from} to {to} m"));
            rows.add(label, |run| {
                let bins = bins(run)?;
                let bin = bins.iter().find(|bin| (bin.from, bin.to) == (from, to))?;
                (bin.counts != Counts::default()).then(|| both(&bin.counts))
            });
        }
        recall_by_points(rows, &class, iou);
    }
}

fn recall_by_points(rows: &mut Rows, class: &str, iou: &str) {
    let bins = |run: &Run| -> Option<Vec<PointsBin>> {
        let by_points = run.result.recall_by_points.as_ref()?;
        by_points.get(class)?.get(iou).cloned()
    };
    let mut edges: Vec<(u64, Option<u64>)> = Vec::new();
    for bin in rows.runs.iter().filter_map(|run| bins(run)).flatten() {
        if !edges.contains(&(bin.from, bin.to)) {
            edges.push((bin.from, bin.to));
        }
    }
    for (from, to) in edges {
        let label = to.map_or(format!("  from {from} own points, recall"), |to| {
            format!("  {from} to {} own points, recall", to - 1)
        });
        rows.add(label, |run| {
            let bins = bins(run)?;
            let bin = bins.iter().find(|bin| (bin.from, bin.to) == (from, to))?;
            (bin.total > 0).then(|| share(bin.true_positives, bin.total))
        });
    }
}

fn detections(rows: &mut Rows, iou: &str) {
    for class in count_classes(rows) {
        rows.add(class.clone(), |run| {
            let found = counts(run, &class, iou)?;
            Some(values(
                [found.true_positives, found.false_positives, found.total].map(count),
            ))
        });
    }
    if rows.runs.iter().any(|run| run.result.in_no_view.is_some()) {
        rows.add("in no view, ignored: detections / objects", |run| {
            let ignored = run.result.in_no_view?;
            Some(values([ignored.detections, ignored.objects].map(count)))
        });
    }
}

fn frames(rows: &mut Rows, full: bool) {
    rows.add("sweeps of the ego", |run| Some(count(run.result.frames.total)));
    rows.add("scored", |run| Some(count(run.result.frames.key)));
    rows.add("without boxes", |run| Some(count(run.result.frames.skipped)));
    rows.add("rate, Hz of log time", |run| {
        let rate = run.timing.rate_hz.filter(|_| full || !is_offline(run))?;
        Some(format!("{rate:.2}"))
    });
}

/// Offline nothing takes time: what stamps say of it is no latency.
fn latency(rows: &mut Rows, full: bool) {
    let of = |run: &Run, stage: &str| -> Option<Spread> {
        (!is_offline(run)).then(|| run.timing.latency_ms.get(stage).copied())?
    };
    rows.add("end to end", |run| {
        spread(of(run, END_TO_END).filter(|spread| spread.max > Some(0.0)).as_ref())
    });
    rows.add("without modelled link delay", |run| {
        spread(
            of(run, FRAMEWORK)
                .filter(|framework| Some(*framework) != of(run, END_TO_END))
                .as_ref(),
        )
    });
    if !full {
        return;
    }
    let stages = names(rows.runs.iter().flat_map(|run| run.timing.latency_ms.keys()));
    for stage in stages
        .iter()
        .filter(|stage| ![END_TO_END, FRAMEWORK].contains(&stage.as_str()))
    {
        rows.add(stage.clone(), |run| {
            spread(of(run, stage).filter(|spread| spread.max > Some(0.0)).as_ref())
        });
    }
    let sources = names(rows.runs.iter().flat_map(|run| run.timing.late_ms.keys()));
    for source in sources {
        rows.add(format!("{source}, late by"), |run| {
            spread(run.timing.late_ms.get(&source).filter(|_| !is_offline(run)))
        });
    }
}

fn steps(rows: &mut Rows) {
    let stages = rows.runs.iter().flat_map(|run| &run.timing.steps_ms);
    let all: BTreeSet<(String, String)> = stages
        .flat_map(|(stage, steps)| steps.keys().map(|step| (stage.clone(), step.clone())))
        .collect();
    for (stage, step) in all {
        rows.add(format!("{stage}, {step}"), |run| {
            spread(run.timing.steps_ms.get(&stage)?.get(&step))
        });
    }
}

fn ages(rows: &mut Rows) {
    let kinds = names(rows.runs.iter().flat_map(|run| run.result.age_ms.by_kind.keys()));
    for kind in kinds {
        rows.add(kind.clone(), |run| {
            spread(run.result.age_ms.by_kind.get(&kind).filter(|_| !is_offline(run)))
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

/// Kinds of messages over links, in alphabetical order but for the states of agents, which come last.
fn kinds(runs: &[&Run]) -> Vec<String> {
    let mut kinds = names(
        runs.iter()
            .flat_map(|run| run.result.links.values())
            .flat_map(|kinds| kinds.keys()),
    );
    kinds.sort_by_key(|kind| kind == STATE);
    kinds
}

/// What all channels of a kind carried together; `None` without any.
fn sum<'a>(channels: impl Iterator<Item = &'a LinkBooks>) -> Option<LinkBooks> {
    channels.cloned().reduce(|mut sum, books| {
        sum.add(&books);
        sum
    })
}

/// Agents on other machines.
fn peers(rows: &mut Rows) {
    let all = rows.runs.iter().flat_map(|run| &run.result.peers);
    for name in names(all.map(|peer| &peer.name)) {
        rows.add(name.clone(), |run| {
            let peer = run.result.peers.iter().find(|peer| peer.name == name)?;
            let number =
                |value: Option<f64>, places: usize| value.map_or(NONE.into(), |value| format!("{value:.places$}"));
            let by = match (peer.clock_by, peer.clock_contradiction_ms) {
                (_, Some(differs)) => format!(" (machines say otherwise, by {differs:.2}: one is wrong)"),
                (Some(ClockBy::Machines), None) => " (synchronised)".into(),
                _ => String::new(),
            };
            let clock = format!(
                "{} ± {}{by}",
                number(peer.clock_ms, 2),
                number(peer.clock_uncertainty_ms, 2)
            );
            let rate = number(peer.bits_per_second.map(|rate| rate * 1e-6), 1);
            let refused = peer.refused.iter().map(|(why, count)| format!(", {count} {why}"));
            let refused: String = refused.collect();
            Some(format!("{clock}, {}; {rate}{refused}", number(peer.round_trip_ms, 1)))
        });
    }
}

fn volume(rows: &mut Rows) {
    for kind in kinds(rows.runs) {
        rows.add(kind.clone(), |run| {
            let books = sum(run
                .result
                .channels()
                .filter(|(_, k, _)| *k == kind)
                .map(|(.., books)| books))?;
            let frames = run.result.frames.total;
            let per_frame = |n: f64| (frames > 0).then(|| n / frames as f64);
            let places = |value: Option<f64>| value.map_or(NONE.into(), |value| format!("{value:.2}"));
            Some(values([
                places(per_frame(books.sent as f64)),
                places(per_frame(books.bytes as f64 / 1000.0)),
            ]))
        });
    }
}

fn accounting(rows: &mut Rows, kind: &str) {
    let books = |run: &Run| {
        let channels = run
            .result
            .channels()
            .filter(|(_, k, _)| *k == kind)
            .map(|(.., books)| books);
        sum(channels.filter(|books| books.accounted.is_some()))
    };
    let fate = |get: fn(&Fates) -> u64| move |run: &Run| books(run)?.accounted.map(|accounted| get(&accounted.fates));
    if !rows.runs.iter().any(|run| books(run).is_some()) {
        return;
    }
    // What stands below `sent` adds up to it; what was not sent stands apart, as do copies.
    rows.add_counts("not sent: out of range", |run| Some(books(run)?.out_of_range));
    rows.add_counts("copies made on the way", |run| Some(books(run)?.duplicated));
    rows.add("sent", |run| Some(count(books(run)?.sent)));
    rows.add("  used", |run| fate(|fates| fates.used)(run).map(count));
    rows.add_counts("  skipped", fate(|fates| fates.skipped));
    rows.add_counts("  over limit", fate(|fates| fates.over_limit));
    rows.add_counts("  stale", fate(|fates| fates.stale));
    let superseded = match kind == STATE {
        true => "  replaced by the next state (normal)",
        false => "  superseded",
    };
    rows.add_counts(superseded, fate(|fates| fates.superseded));
    rows.add_counts("  lost", |run| Some(books(run)?.lost));
    rows.add_counts("  rejected", fate(|fates| fates.rejected));
    rows.add_counts("  in flight", fate(|fates| fates.in_flight));
    if rows
        .runs
        .iter()
        .filter_map(|run| books(run)?.accounted)
        .any(|accounted| accounted.unaccounted != 0)
    {
        rows.add("  ! unaccounted", |run| {
            Some(books(run)?.accounted?.unaccounted.to_string())
        });
    }
}
