//! Rows of objects: how many there are, and how many are found.

use realo_results::Run;
use realo_scoring::{Counts, PointsBin, RangeBin};

use super::{Rows, classes};
use crate::cells::{count, share, values};

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

pub(super) fn recall(rows: &mut Rows, iou: &str) {
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

pub(super) fn detections(rows: &mut Rows, iou: &str) {
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
