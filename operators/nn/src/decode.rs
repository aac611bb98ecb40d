//! From what the heads give to scored boxes, up to the suppression of duplicates (V2X-Real).

use crate::anchors::{Anchors, Hwl, decode};

/// A box with its class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Detection {
    /// Index of the class in the model.
    pub class: usize,
    /// Score, 0 to 1.
    pub score: f32,
    /// The box, in the anchors' frame.
    pub hwl: Hwl<f32>,
}

/// The boxes of one frame before suppression.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Candidates {
    /// Boxes, best score first, at equal scores in the anchors' order.
    pub detections: Vec<Detection>,
    /// Boxes above the threshold that were left out because there were better ones.
    pub over_limit: u64,
}

/// The `most` best boxes that score more than `threshold`.
///
/// `scores`: logits `[rows, columns, anchors * classes]`; `deltas`: `[rows, columns, anchors * 7]`. An anchor gives at
/// most one box, of the class with the highest score, which need not be its own. A NaN score is no candidate; deltas that
/// are not finite give a box that is not.
///
/// # Panics
/// If the maps' sizes are not those of the anchors.
pub fn candidates(anchors: &Anchors, scores: &[f32], deltas: &[f32], threshold: f32, most: usize) -> Candidates {
    let (count, classes) = (anchors.count(), anchors.classes.len());
    assert_eq!(
        scores.len(),
        count * classes,
        "scores of {count} anchors and {classes} classes"
    );
    assert_eq!(deltas.len(), count * 7, "deltas of {count} anchors");

    let mut best = above(scores, classes, threshold);
    best.sort_by(|a, b| b.score.total_cmp(&a.score));
    let over_limit = best.len().saturating_sub(most) as u64;
    best.truncate(most);
    let deltas = deltas.as_chunks::<7>().0;
    let detections = best.into_iter().map(|Best { anchor, class, score }| Detection {
        class,
        score,
        hwl: decode(&deltas[anchor], &anchors.get(anchor).map(|number| number as f32)),
    });
    Candidates {
        detections: detections.collect(),
        over_limit,
    }
}

/// An anchor's best class.
struct Best {
    anchor: usize,
    class: usize,
    score: f32,
}

fn above(scores: &[f32], classes: usize, threshold: f32) -> Vec<Best> {
    let min = lowest_logit(threshold);
    let mut found = Vec::new();
    for (block, logits) in scores.chunks(BLOCK * classes).enumerate() {
        // Nearly all blocks end here; without a branch inside, this runs on vectors.
        if logits.iter().fold(false, |any, logit| any | (*logit >= min)) {
            let best = (block * BLOCK..)
                .zip(logits.chunks_exact(classes))
                .map(|(anchor, logits)| best(anchor, logits));
            found.extend(best.filter(|best| best.score > threshold));
        }
    }
    found
}

/// Anchors that are looked at together.
const BLOCK: usize = 16;

fn best(anchor: usize, logits: &[f32]) -> Best {
    let (mut class, mut logit) = (0, f32::NEG_INFINITY);
    for (index, value) in logits.iter().enumerate() {
        if *value > logit {
            (class, logit) = (index, *value);
        }
    }
    Best {
        anchor,
        class,
        score: score(logit),
    }
}

/// The score of a logit, 0 to 1.
pub fn score(logit: f32) -> f32 {
    1.0 / (1.0 + libm::expf(-logit))
}

/// A logit below which no score exceeds the threshold, rounding included.
fn lowest_logit(threshold: f32) -> f32 {
    let logit = libm::logf(threshold / (1.0 - threshold));
    logit - 1e-3 * (1.0 + logit.abs())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anchors::Cells;
    use crate::vectors::{Vector, nhwc};

    fn anchors() -> Anchors {
        Anchors::v2x_real(Cells::new([-12.8, 12.8], [-6.4, 6.4], 0.4, 2))
    }

    fn corners(detection: &Detection) -> [[f32; 3]; 8] {
        let [x, y, z, h, w, l, yaw] = detection.hwl;
        let (sin, cos) = yaw.sin_cos();
        let corner = |[a, b, c]: [f32; 3]| {
            let (along, across) = (a * l / 2.0, b * w / 2.0);
            [
                x + along * cos - across * sin,
                y + along * sin + across * cos,
                z + c * h / 2.0,
            ]
        };
        let bottom = [[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]];
        std::array::from_fn(|i| corner([bottom[i % 4][0], bottom[i % 4][1], if i < 4 { -1.0 } else { 1.0 }]))
    }

    fn of_vector(vector: &Vector, suffix: &str) -> Candidates {
        let map = |name: &str| nhwc(&vector.f32(name), vector.shape(name).try_into().unwrap());
        let threshold = vector.number("score_threshold") as f32;
        let (scores, deltas) = (map(&format!("in.psm{suffix}")), map(&format!("in.rm{suffix}")));
        candidates(&anchors(), &scores, &deltas, threshold, 1000)
    }

    /// Suppression is not done here: the number of candidates, and that all boxes that it leaves are among them.
    #[test]
    fn candidates_of_the_reference_are_found() {
        for case in ["single_agent", "single_agent_dense"] {
            let vector = Vector::open(&format!("postprocess/{case}.safetensors"));
            let found = of_vector(&vector, "");
            assert_eq!(
                (found.detections.len(), found.over_limit),
                (vector.number("candidates") as usize, 0)
            );
            assert!(found.detections.is_sorted_by(|a, b| a.score >= b.score));
            let (scores, labels) = (vector.f32("out.scores"), vector.f64("out.labels"));
            for (kept, expected) in vector.rows::<24>("out.corners").iter().enumerate() {
                let matches = |detection: &&Detection| {
                    let near = |(a, b): (&f32, &f32)| (a - b).abs() <= 1e-4 + 1e-4 * b.abs();
                    near((&detection.score, &scores[kept]))
                        && detection.class == labels[kept] as usize - 1
                        && corners(detection).as_flattened().iter().zip(expected).all(near)
                };
                assert!(
                    found.detections.iter().any(|detection| matches(&detection)),
                    "{case}: box {kept}"
                );
            }
        }
    }

    fn maps(logit: f32) -> (Vec<f32>, Vec<f32>) {
        (vec![logit; anchors().count() * 3], vec![0.0; anchors().count() * 7])
    }

    #[test]
    fn low_and_nan_scores_are_no_candidates() {
        for logit in [-9.0, f32::NAN, f32::NEG_INFINITY] {
            let (scores, deltas) = maps(logit);
            assert_eq!(
                candidates(&anchors(), &scores, &deltas, 0.2, 1000),
                Candidates::default()
            );
        }
    }

    #[test]
    fn the_threshold_itself_is_not_exceeded() {
        let (mut scores, deltas) = maps(-9.0);
        scores[7 * 3 + 1] = 0.0;
        let found = |threshold: f32| candidates(&anchors(), &scores, &deltas, threshold, 10).detections;
        assert_eq!(found(0.5), []);
        let just_below = found(0.499_999_97);
        assert_eq!(
            (just_below.len(), just_below[0].class, just_below[0].score),
            (1, 1, 0.5)
        );
        assert_eq!(just_below[0].hwl, anchors().get(7).map(|number| number as f32));
        assert_eq!((found(1.0).len(), found(0.0).len()), (0, 10));
    }

    #[test]
    fn the_best_stay_and_the_others_are_counted() {
        let (mut scores, deltas) = maps(-9.0);
        for anchor in 0..50 {
            scores[anchor * 30] = (anchor * 17 % 50 / 2) as f32 * 0.1;
        }
        let found = candidates(&anchors(), &scores, &deltas, 0.2, 20);
        assert_eq!((found.detections.len(), found.over_limit), (20, 30));
        let all = candidates(&anchors(), &scores, &deltas, 0.2, 50).detections;
        assert_eq!(found.detections, all[..20]);
        // Two anchors have each score: the one that comes first is first.
        let at = |d: &Detection| (d.hwl[1], d.hwl[0]);
        assert!(
            all.chunks(2)
                .all(|pair| pair[0].score == pair[1].score && at(&pair[0]) < at(&pair[1]))
        );
    }
}
