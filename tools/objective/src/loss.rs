//! The loss of the heads and its gradient (V2X-Real: focal loss with sigmoid, Lin et al. 2017; smooth-L1 on box deltas,
//! with the sine of the headings' difference, as in SECOND, Yan et al. 2018).

mod focal;

use crate::targets::{Positive, Targets};

/// How the parts of the loss are weighted. The exponent of the focal loss is 2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Weight of scores that should be 1; those that should be 0 have 1 - alpha.
    pub alpha: f32,
    /// Difference of deltas at which the loss goes from quadratic to linear.
    pub beta: f32,
    /// Weight of the scores' part.
    pub class_weight: f32,
    /// Weight of the deltas' part.
    pub box_weight: f32,
}

impl Default for LossWeights {
    /// V2X-Real's.
    fn default() -> Self {
        LossWeights {
            alpha: 0.25,
            beta: 1.0 / 9.0,
            class_weight: 1.0,
            box_weight: 2.0,
        }
    }
}

impl LossWeights {
    /// Those of fusions. Half of a pedestrian's box is lost with an error of 0.2 m, which V2X-Real's loss hardly sees: its deltas are
    /// in shares of a box's diagonal, and 0.1 of one is where the loss becomes linear.
    pub fn of_fusion() -> Self {
        LossWeights {
            beta: 1.0 / 27.0,
            ..LossWeights::default()
        }
    }
}

/// A sample's share of the loss; a batch's loss is the sum over its samples.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Loss {
    /// Weighted part of the scores.
    pub class: f64,
    /// Weighted part of the deltas.
    pub regression: f64,
}

impl Loss {
    /// Both parts.
    pub fn total(&self) -> f64 {
        self.class + self.regression
    }
}

/// What a head gave for one sample, or the gradient of the loss with respect to it.
#[derive(Debug)]
pub struct HeadMaps<T> {
    /// Logits, `[rows, columns, anchors * classes]`.
    pub scores: T,
    /// Deltas, `[rows, columns, anchors * 7]`.
    pub deltas: T,
}

/// The share of one sample in the loss of a batch of `batch` samples; `gradient` is overwritten with its derivative.
///
/// Both parts are divided by the sample's number of positives (at least 1) and by `batch`. Anchors that are ignored and
/// target deltas that are NaN do not count. A NaN in `maps` at an anchor that counts gives a NaN loss.
///
/// # Panics
/// If the maps' sizes do not belong to the targets' number of anchors, or those of `gradient` not to `maps`, or a label
/// names a class that has no score.
pub fn loss(
    maps: &HeadMaps<&[f32]>,
    targets: &Targets,
    settings: &LossWeights,
    batch: usize,
    gradient: &mut HeadMaps<&mut [f32]>,
) -> Loss {
    let anchors = targets.labels.len();
    assert_eq!(maps.deltas.len(), anchors * 7, "deltas of {anchors} anchors");
    assert!(
        maps.scores.len().checked_rem(anchors).unwrap_or(0) == 0,
        "{} scores of {anchors} anchors",
        maps.scores.len()
    );
    assert_eq!(gradient.scores.len(), maps.scores.len(), "gradient of the scores");
    assert_eq!(gradient.deltas.len(), maps.deltas.len(), "gradient of the deltas");

    let share = 1.0 / (targets.positives.len().max(1) * batch) as f32;
    let [alpha, background] =
        [settings.alpha, 1.0 - settings.alpha].map(|weight| weight * settings.class_weight * share);
    let class = focal::focal(maps.scores, &targets.labels, [alpha, background], gradient.scores);
    gradient.deltas.fill(0.0);
    let weight = settings.box_weight * share;
    let mut regression = 0.0;
    for positive in &targets.positives {
        let at = positive.anchor as usize * 7..positive.anchor as usize * 7 + 7;
        let part = smooth_l1(
            &maps.deltas[at.clone()],
            positive,
            settings.beta,
            weight,
            &mut gradient.deltas[at],
        );
        regression += f64::from(part);
    }
    Loss { class, regression }
}

/// Weighted smooth-L1 of one anchor's deltas.
fn smooth_l1(deltas: &[f32], positive: &Positive, beta: f32, weight: f32, gradient: &mut [f32]) -> f32 {
    let mut sum = 0.0;
    for (j, ((delta, target), gradient)) in deltas.iter().zip(positive.deltas).zip(gradient).enumerate() {
        if target.is_nan() {
            continue;
        }
        // Headings count by the sine of their difference, so that half a turn is no error.
        let (difference, slope) = if j == YAW {
            (libm::sinf(delta - target), libm::cosf(delta - target))
        } else {
            (delta - target, 1.0)
        };
        let size = difference.abs();
        if size < beta {
            sum += 0.5 * size * size / beta;
            *gradient = weight * slope * difference / beta;
        } else {
            sum += size - 0.5 * beta;
            *gradient = weight * slope * difference.signum();
        }
    }
    weight * sum
}

const YAW: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectors::{Vector, assert_near, nhwc};

    struct Heads {
        scores: Vec<f32>,
        deltas: Vec<f32>,
    }

    fn run(heads: &Heads, targets: &Targets, batch: usize) -> (Loss, Heads) {
        let mut gradient = Heads {
            scores: vec![9.0; heads.scores.len()],
            deltas: vec![9.0; heads.deltas.len()],
        };
        let (scores, deltas) = (&heads.scores[..], &heads.deltas[..]);
        let mut out = HeadMaps {
            scores: &mut gradient.scores[..],
            deltas: &mut gradient.deltas[..],
        };
        let loss = loss(
            &HeadMaps { scores, deltas },
            targets,
            &LossWeights::default(),
            batch,
            &mut out,
        );
        (loss, gradient)
    }

    fn targets(labels: &[f64], deltas: &[[f64; 7]]) -> Targets {
        let labels: Vec<i8> = labels.iter().map(|label| *label as i8).collect();
        let positive = |(anchor, _): (usize, &i8)| Positive {
            anchor: anchor as u32,
            object: 0,
            deltas: deltas[anchor].map(|delta| delta as f32),
        };
        let positives = labels
            .iter()
            .enumerate()
            .filter(|(_, label)| **label > 0)
            .map(positive)
            .collect();
        Targets { labels, positives }
    }

    #[test]
    fn reference_vectors_are_met() {
        for case in 0..2 {
            let vector = Vector::open(&format!("loss/point_pillar_loss_{case}.safetensors"));
            let channels_last = |name: &str| nhwc(&vector.f32(name), vector.shape(name).try_into().unwrap());
            let (scores, deltas) = (channels_last("in.psm"), channels_last("in.rm"));
            let (labels, boxes) = (vector.f64("in.labels_byxa"), vector.rows_f64::<7>("in.targets_byxa7"));
            let batch = vector.shape("in.psm")[0];
            let (mut sum, mut gradients) = (Loss::default(), [Vec::new(), Vec::new()]);
            for sample in 0..batch {
                let part = |values: &[f32]| values[sample * values.len() / batch..][..values.len() / batch].to_vec();
                let heads = Heads {
                    scores: part(&scores),
                    deltas: part(&deltas),
                };
                let anchors = labels.len() / batch;
                let own = sample * anchors..(sample + 1) * anchors;
                let (loss, gradient) = run(&heads, &targets(&labels[own.clone()], &boxes[own]), batch);
                sum.class += loss.class;
                sum.regression += loss.regression;
                gradients[0].extend(gradient.scores);
                gradients[1].extend(gradient.deltas);
            }
            let near = |what: &str, found: f64| {
                let expected = vector.f64(what)[0];
                assert!(
                    (found - expected).abs() <= 1e-5 * expected.abs().max(1e-5),
                    "{case} {what}: {found} {expected}"
                );
            };
            near("out.total", sum.total());
            near("out.cls", sum.class);
            near("out.reg", sum.regression);
            assert_near("grad_psm", &gradients[0], &channels_last("out.grad_psm"), 1e-5);
            assert_near("grad_rm", &gradients[1], &channels_last("out.grad_rm"), 1e-5);
        }
    }

    /// Numbers in [-1, 1) without a pattern.
    fn noise(seed: u32, i: usize) -> f32 {
        let hash = (i as u32)
            .wrapping_mul(2_654_435_761)
            .wrapping_add(seed)
            .wrapping_mul(0x85eb_ca6b);
        ((hash ^ (hash >> 13)).wrapping_mul(0xc2b2_ae35) >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    fn sample() -> (Heads, Targets) {
        let anchors = 4 * 5 * 6;
        let heads = Heads {
            scores: (0..anchors * 3).map(|i| 4.0 * noise(1, i)).collect(),
            deltas: (0..anchors * 7).map(|i| noise(2, i)).collect(),
        };
        let label = |i: usize| [0.0, 0.0, 2.0, -1.0, 0.0, 1.0, 3.0][i % 7];
        let boxes: Vec<[f64; 7]> = (0..anchors)
            .map(|a| std::array::from_fn(|j| f64::from(noise(3, a * 7 + j))))
            .collect();
        (heads, targets(&(0..anchors).map(label).collect::<Vec<_>>(), &boxes))
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences() {
        let (mut heads, targets) = sample();
        let (_, gradient) = run(&heads, &targets, 2);
        let step = 1e-2;
        let mut checked = [0; 2];
        for i in 0..heads.scores.len() {
            let at = heads.scores[i];
            let mut value = |x: f32| {
                heads.scores[i] = x;
                run(&heads, &targets, 2).0.total()
            };
            let slope = (value(at + step) - value(at - step)) / f64::from((at + step) - (at - step));
            heads.scores[i] = at;
            assert!(
                (slope - f64::from(gradient.scores[i])).abs() < 2e-5,
                "score {i}: {slope} {}",
                gradient.scores[i]
            );
            checked[0] += usize::from(slope.abs() > 1e-3);
        }
        let step = 1e-3;
        for i in 0..heads.deltas.len() {
            let at = heads.deltas[i];
            let mut value = |x: f32| {
                heads.deltas[i] = x;
                run(&heads, &targets, 2).0.total()
            };
            let slope = (value(at + step) - value(at - step)) / f64::from((at + step) - (at - step));
            heads.deltas[i] = at;
            assert!(
                (slope - f64::from(gradient.deltas[i])).abs() < 3e-4,
                "delta {i}: {slope} {}",
                gradient.deltas[i]
            );
            checked[1] += usize::from(slope.abs() > 1e-3);
        }
        assert!(checked[0] > 50 && checked[1] > 200, "{checked:?}");
    }

    #[test]
    fn what_does_not_count_changes_nothing_and_a_nan_elsewhere_is_seen() {
        let (mut heads, mut targets) = sample();
        let (plain, _) = run(&heads, &targets, 1);
        assert!(plain.class > 0.0 && plain.regression > 0.0);
        // Anchor 3 is ignored, anchor 0 is background.
        heads.scores[3 * 3..4 * 3].fill(f32::NAN);
        heads.deltas[0] = f32::NAN;
        let (loss, gradient) = run(&heads, &targets, 1);
        assert_eq!(loss, plain);
        assert_eq!((&gradient.scores[9..12], gradient.deltas[0]), (&[0.0; 3][..], 0.0));
        targets.positives[0].deltas[2] = f32::NAN;
        assert!(run(&heads, &targets, 1).0.regression < plain.regression);
        heads.scores[0] = f32::NAN;
        assert!(run(&heads, &targets, 1).0.class.is_nan());
    }

    #[test]
    fn half_a_turn_is_no_error_and_no_positive_no_regression() {
        let pi = std::f64::consts::PI;
        let heads = Heads {
            scores: vec![0.0],
            deltas: vec![0.0; 7],
        };
        let turned = targets(&[1.0], &[[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, pi]]);
        let (loss, _) = run(&heads, &turned, 1);
        assert!(loss.regression < 1e-12);
        // A score of one half that should be 1: 0.25 · 0.5² · ln 2.
        assert!((loss.class - 0.0625 * 2f64.ln()).abs() < 1e-8, "{}", loss.class);
        let (loss, gradient) = run(&heads, &targets(&[0.0], &[[1.0; 7]]), 1);
        assert_eq!((loss.regression, gradient.deltas), (0.0, vec![0.0; 7]));
        assert_eq!(
            run(
                &Heads {
                    scores: vec![],
                    deltas: vec![]
                },
                &targets(&[], &[]),
                1
            )
            .0,
            Loss::default()
        );
    }
}
