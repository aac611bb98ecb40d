//! Rows of scores.

use std::collections::BTreeMap;

use realo_results::RunResult;
use realo_scoring::{Accuracy, Orders};

use super::{Rows, classes};
use crate::cells::{NONE, fraction, values};
use crate::columns::interval;

/// Nothing where no object counts, e.g. because the log does not say what the ego sees.
pub(super) fn seen(accuracy: &Orders<Accuracy>) -> Option<&Accuracy> {
    let sorted = &accuracy.sorted;
    let known = sorted
        .ap
        .values()
        .flat_map(|per_iou| per_iou.values())
        .any(Option::is_some);
    known.then_some(sorted)
}

pub(super) fn in_the_order_of_v2x_real(result: &RunResult) -> Option<&Accuracy> {
    Some(&result.accuracy.as_ref()?.v2x_real)
}

pub(super) fn accuracy(rows: &mut Rows, ious: &[String], get: impl Fn(&RunResult) -> Option<&Accuracy>) {
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

pub(super) fn mean_accuracy(rows: &mut Rows, ious: &[String], get: impl Fn(&RunResult) -> Option<&Accuracy>) {
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

pub(super) fn intervals(rows: &mut Rows, ious: &[String]) {
    let bound = |bounds: Option<[f64; 2]>| bounds.map_or(NONE.into(), |[low, high]| format!("{low:.3}–{high:.3}"));
    rows.add("mAP, 95 % interval over logs", |run| {
        run.result.intervals.as_ref()?;
        Some(values(ious.iter().map(|iou| bound(interval(run, iou)))))
    });
}
