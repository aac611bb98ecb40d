use realo_objective::loss::{HeadMaps, Loss, LossWeights, loss};
use realo_objective::targets::{Positive, Targets};

use crate::Kind;
use crate::vector::{Vector, compare};

pub(crate) const KINDS: &[Kind] = &[Kind::new(
    &["in.psm", "in.labels_byxa", "out.grad_psm"],
    value_and_gradient,
)];

const CLASSES: usize = 3;

fn settings(vector: &Vector) -> Result<LossWeights, String> {
    let number = |key: &str| vector.number(key).map(|number| number as f32);
    if number("gamma")? != 2.0 {
        return Err("the focal loss is there with exponent 2 only".into());
    }
    Ok(LossWeights {
        alpha: number("alpha")?,
        beta: number("beta")?,
        class_weight: number("cls_weight")?,
        box_weight: number("reg_weight")?,
    })
}

fn targets(labels: &[f64], deltas: &[[f64; 7]]) -> Targets {
    let labels: Vec<i8> = labels.iter().map(|label| *label as i8).collect();
    let positive = |(anchor, _): (usize, &i8)| Positive {
        anchor: anchor as u32,
        object: 0,
        deltas: deltas[anchor].map(|delta| delta as f32),
    };
    let positives = labels.iter().enumerate().filter(|(_, label)| **label > 0);
    let positives = positives.map(positive).collect();
    Targets { labels, positives }
}

fn value_and_gradient(vector: &Vector) -> Result<(), String> {
    let (tensors, settings, t) = (vector.tensors()?, settings(vector)?, vector.tolerance()?);
    let (scores, [batch, ..]) = tensors.channels_last("in.psm")?;
    let (deltas, _) = tensors.channels_last("in.rm")?;
    let (labels, boxes) = (
        tensors.numbers("in.labels_byxa")?,
        tensors.rows::<7>("in.targets_byxa7")?,
    );
    let anchors = labels.len();
    if [scores.len(), deltas.len(), boxes.len()] != [anchors * CLASSES, anchors * 7, anchors] || batch == 0 {
        return Err("the tensors' sizes do not fit together".into());
    }
    if labels.iter().any(|label| *label > CLASSES as f64) {
        return Err(format!("a label names a class beyond {CLASSES}"));
    }
    let (mut by_scores, mut by_deltas) = (vec![0.0; scores.len()], vec![0.0; deltas.len()]);
    let mut sum = Loss::default();
    for sample in 0..batch {
        let part = |len: usize| sample * len / batch..(sample + 1) * len / batch;
        let (of_scores, of_deltas, of_labels) = (part(scores.len()), part(deltas.len()), part(labels.len()));
        let maps = HeadMaps {
            scores: &scores[of_scores.clone()],
            deltas: &deltas[of_deltas.clone()],
        };
        let mut gradient = HeadMaps {
            scores: &mut by_scores[of_scores],
            deltas: &mut by_deltas[of_deltas],
        };
        let targets = targets(&labels[of_labels.clone()], &boxes[of_labels]);
        let share = loss(&maps, &targets, &settings, batch, &mut gradient);
        sum.class += share.class;
        sum.regression += share.regression;
    }
    compare("total", &[sum.total()], &tensors.numbers("out.total")?, t)?;
    compare("cls", &[sum.class], &tensors.numbers("out.cls")?, t)?;
    compare("reg", &[sum.regression], &tensors.numbers("out.reg")?, t)?;
    let wide = |numbers: &[f32]| -> Vec<f64> { numbers.iter().copied().map(f64::from).collect() };
    let expected = |name: &str| tensors.channels_last(name).map(|(numbers, _)| wide(&numbers));
    compare("grad_psm", &wide(&by_scores), &expected("out.grad_psm")?, t)?;
    compare("grad_rm", &wide(&by_deltas), &expected("out.grad_rm")?, t)
}
