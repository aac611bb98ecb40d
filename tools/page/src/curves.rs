//! Curves of precision and recall, and distributions as quantiles.

use std::collections::BTreeMap;

use realo_operator::Durations;
use realo_results::Ages;
use realo_scoring::{Evaluation, Outcome, Protocol, Scope, match_frame};

/// Points of a curve, at most.
const MOST_POINTS: usize = 160;

/// By class and IoU: `[recall, precision, score]` after each detection, best first, all detections of all scored frames in
/// the usual order by score.
pub type PrecisionRecall = BTreeMap<String, BTreeMap<String, Vec<[f64; 3]>>>;

/// The curves of an evaluation. A class without objects has none.
pub fn precision_recall(evaluation: &Evaluation) -> PrecisionRecall {
    let protocol = &evaluation.protocol;
    let mut all = PrecisionRecall::new();
    for (number, class) in protocol.classes.iter().enumerate() {
        for iou in &protocol.ious {
            let (hits, total) = hits(evaluation, number as u8, *iou);
            if total > 0 {
                let curves = all.entry(class.name.clone()).or_default();
                curves.insert(Protocol::iou_key(*iou), curve(&hits, total));
            }
        }
    }
    all
}

/// Whether each detection is true, with its score, best first; and the objects.
fn hits(evaluation: &Evaluation, class: u8, iou: f64) -> (Vec<(f32, bool)>, u64) {
    let protocol = &evaluation.protocol;
    let (mut hits, mut total) = (Vec::new(), 0);
    for frame in evaluation.scenes.iter().flat_map(|scene| &scene.frames) {
        if !frame.key {
            continue;
        }
        let counted = |index: usize| frame.in_no_view.truths.binary_search(&index).is_err();
        let objects = frame.truths.iter().enumerate();
        total += objects
            .filter(|(index, truth)| truth.class == class && counted(*index))
            .count() as u64;
        for (detection, outcome) in match_frame(frame, protocol, class, iou, Scope::All) {
            if outcome != Outcome::Ignored {
                hits.push((frame.detections[detection].score, matches!(outcome, Outcome::True(_))));
            }
        }
    }
    hits.sort_by(|(a, _), (b, _)| b.total_cmp(a));
    (hits, total)
}

fn curve(hits: &[(f32, bool)], total: u64) -> Vec<[f64; 3]> {
    let mut found = 0;
    let whole: Vec<[f64; 3]> = hits
        .iter()
        .enumerate()
        .map(|(index, (score, hit))| {
            found += u64::from(*hit);
            let shares = [found as f64 / total as f64, found as f64 / (index + 1) as f64];
            [rounded(shares[0]), rounded(shares[1]), rounded(f64::from(*score))]
        })
        .collect();
    thinned(whole)
}

fn thinned(points: Vec<[f64; 3]>) -> Vec<[f64; 3]> {
    let last = points.len().saturating_sub(1);
    if points.len() <= MOST_POINTS {
        return points;
    }
    (0..MOST_POINTS)
        .map(|step| points[step * last / (MOST_POINTS - 1)])
        .collect()
}

fn rounded(share: f64) -> f64 {
    (share * 1e4).round() / 1e4
}

/// The 0, 1 … 100 % quantiles of durations, ms; nothing of none.
pub fn quantiles(durations: &Durations) -> Vec<f64> {
    steps(durations.count(), |share| durations.quantile(share))
}

/// The same of ages, which may be negative.
pub fn age_quantiles(ages: &Ages) -> Vec<f64> {
    steps(ages.count(), |share| ages.quantile(share))
}

fn steps(count: u64, quantile: impl Fn(f64) -> Option<i64>) -> Vec<f64> {
    match count {
        0 => Vec::new(),
        _ => (0..=100)
            .filter_map(|percent| quantile(f64::from(percent) / 100.0))
            .map(|nanos| (nanos as f64 / 1e4).round() / 100.0)
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use realo_scoring::{Detection, Frame, Outline, Scene, Truth, average_precision, score};

    use super::*;

    fn evaluation() -> Evaluation {
        let at = |x: f64| Outline::new([x, 0.0], 4.0, 2.0, 0.0);
        let truth = |x: f64| Truth {
            class: 0,
            outline: at(x),
            points: None,
        };
        let detection = |x: f64, score: f32| Detection {
            class: 0,
            score,
            outline: at(x),
        };
        let frame = |seq: u64| Frame {
            seq,
            key: true,
            processed: true,
            truths: vec![truth(0.0), truth(10.0), truth(20.0)],
            detections: vec![
                detection(0.2, 0.9 - 0.01 * seq as f32),
                detection(11.0, 0.5 + 0.03 * seq as f32),
                detection(40.0, 0.6),
            ],
            ..Frame::default()
        };
        let scene = Scene {
            name: "log".into(),
            ego: "cav1".into(),
            frames: (0..7).map(frame).collect(),
            ..Scene::default()
        };
        Evaluation {
            protocol: Protocol::load("default").unwrap(),
            scenes: vec![scene],
        }
    }

    #[test]
    fn the_area_under_a_curve_is_the_average_precision_of_the_table() {
        let evaluation = evaluation();
        let scores = score(&evaluation);
        for iou in [0.3, 0.5] {
            let (hits, total) = hits(&evaluation, 0, iou);
            let hits: Vec<bool> = hits.into_iter().map(|(_, hit)| hit).collect();
            let key = Protocol::iou_key(iou);
            let class = &evaluation.protocol.classes[0].name;
            assert_eq!(average_precision(&hits, total), scores.accuracy.sorted.ap[class][&key]);
        }
    }

    #[test]
    fn a_curve_is_short_and_keeps_its_ends() {
        let hits: Vec<(f32, bool)> = (0..5000).map(|i| (1.0 - i as f32 / 5000.0, i % 3 > 0)).collect();
        let curve = curve(&hits, 4000);
        assert_eq!(curve.len(), MOST_POINTS);
        assert_eq!(curve[0], [0.0, 0.0, 1.0]);
        assert_eq!(curve[MOST_POINTS - 1][0], 0.8333, "3,333 of 4,000 were found");
        assert!(
            precision_recall(&evaluation()).len() == 1,
            "classes without objects have no curve"
        );
    }

    #[test]
    fn quantiles_rise_from_the_least_to_the_largest() {
        let mut ages = Ages::default();
        [-20_000_000, 0, 30_000_000, 100_000_000]
            .iter()
            .for_each(|age| ages.record(*age));
        let quantiles = age_quantiles(&ages);
        assert_eq!(quantiles.len(), 101);
        assert!(quantiles.is_sorted() && (quantiles[0] + 20.0).abs() < 0.1 && (quantiles[100] - 100.0).abs() < 0.2);
        assert!(age_quantiles(&Ages::default()).is_empty());
    }
}
