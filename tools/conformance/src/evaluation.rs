use std::collections::BTreeMap;

use realo_scoring::{
    Detection, Evaluation, Frame, Outcome, Outline, Protocol, Scene, Scope, Truth, average_precision, match_frame,
    score,
};
use serde::Deserialize;

use crate::Kind;
use crate::reference::{Corners, box_of, box_of_corners};
use crate::vector::{Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["curves"], curves),
    Kind::new(&["det_boxes_hwl_class", "gt_boxes_hwl_class", "result"], single_frame),
    Kind::new(&["in.det_corners", "in.gt_corners", "in.det_per_frame"], frames),
    Kind::new(&["mAP"], results_of_frames),
];

#[derive(Deserialize)]
struct Curves {
    curves: Vec<Curve>,
}

#[derive(Deserialize)]
struct Curve {
    tp: Vec<u8>,
    gt: u64,
    ap: f64,
}

fn curves(vector: &Vector) -> Result<(), String> {
    let t = vector.tolerance()?;
    let curves: Curves = vector.json(None)?;
    for (index, expected) in curves.curves.iter().enumerate() {
        let hits: Vec<bool> = expected.tp.iter().map(|hit| *hit == 1).collect();
        same_value(
            &format!("ap of curve {index}"),
            average_precision(&hits, expected.gt),
            Some(expected.ap),
            t,
        )?;
    }
    Ok(())
}

fn same_value(what: &str, found: Option<f64>, expected: Option<f64>, t: f64) -> Result<(), String> {
    match (found, expected) {
        (None, None) => Ok(()),
        (Some(found), Some(expected)) => compare(what, &[found], &[expected], t),
        (found, expected) => Err(format!("{what}: expected {expected:?}, found {found:?}")),
    }
}

/// Expected values by class and IoU, and means by IoU.
#[derive(Deserialize)]
struct Expected {
    #[serde(rename = "mAP")]
    means: BTreeMap<String, ExpectedMean>,
    #[serde(flatten)]
    classes: BTreeMap<String, BTreeMap<String, ExpectedClass>>,
}

#[derive(Deserialize)]
struct ExpectedMean {
    reference: Option<f64>,
    global_sort: Option<f64>,
}

#[derive(Deserialize)]
struct ExpectedClass {
    ap_reference_frame_order: Option<f64>,
    ap_global_sort: Option<f64>,
    tp: u64,
    fp: u64,
    gt: u64,
    tp_sequence: Vec<u8>,
}

fn check_scores(frames: Vec<Frame>, expected: &Expected, t: f64) -> Result<(), String> {
    let mut protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let ious: Result<Vec<f64>, _> = expected.means.keys().map(|iou| iou.parse::<f64>()).collect();
    protocol.ious = ious.map_err(|error| format!("an IoU of the expected means: {error}"))?;
    let scene = Scene {
        frames,
        ..Scene::default()
    };
    let evaluation = Evaluation {
        protocol,
        scenes: vec![scene],
    };
    let accuracy = score(&evaluation).accuracy;
    for (iou, mean) in &expected.means {
        same_value(
            &format!("mAP@{iou}, v2x-real"),
            accuracy.v2x_real.mean_ap[iou],
            mean.reference,
            t,
        )?;
        same_value(
            &format!("mAP@{iou}, sorted"),
            accuracy.sorted.mean_ap[iou],
            mean.global_sort,
            t,
        )?;
    }
    for (class, per_iou) in &expected.classes {
        let number = evaluation
            .protocol
            .classes
            .iter()
            .position(|known| known.name == *class);
        let number = number.ok_or_else(|| format!("no super-class `{class}`"))? as u8;
        for (iou, expected) in per_iou {
            let what = format!("{class}@{iou}");
            let (by_frame, by_score) = (&accuracy.v2x_real, &accuracy.sorted);
            let found = by_frame.counts[class]
                .get(iou)
                .ok_or_else(|| format!("{what}: no mean of this IoU"))?;
            equal(
                &format!("{what} [true, false, total]"),
                &[found.true_positives, found.false_positives, found.total],
                &[expected.tp, expected.fp, expected.gt],
            )?;
            same_value(
                &format!("{what}, v2x-real"),
                by_frame.ap[class][iou],
                expected.ap_reference_frame_order,
                t,
            )?;
            same_value(
                &format!("{what}, sorted"),
                by_score.ap[class][iou],
                expected.ap_global_sort,
                t,
            )?;
            let threshold = iou.parse::<f64>().map_err(|error| format!("{what}: {error}"))?;
            let sequence = sequence(&evaluation, number, threshold);
            equal(&format!("{what} sequence"), &sequence, &expected.tp_sequence)?;
        }
    }
    Ok(())
}

fn sequence(evaluation: &Evaluation, class: u8, iou: f64) -> Vec<u8> {
    let frames = evaluation.scenes.iter().flat_map(|scene| &scene.frames);
    let outcomes = frames.flat_map(|frame| match_frame(frame, &evaluation.protocol, class, iou, Scope::All));
    outcomes
        .map(|(_, outcome)| u8::from(matches!(outcome, Outcome::True(_))))
        .collect()
}

#[derive(Deserialize)]
struct SingleFrame {
    det_boxes_hwl_class: Vec<[f64; 8]>,
    det_scores: Vec<f32>,
    gt_boxes_hwl_class: Vec<[f64; 8]>,
    result: Expected,
}

/// Classes count from 1.
fn class_number(label: f64) -> Result<u8, String> {
    let number = label as u8;
    if f64::from(number) == label && number > 0 {
        Ok(number - 1)
    } else {
        Err(format!("{label} is no class number"))
    }
}

fn single_frame(vector: &Vector) -> Result<(), String> {
    let case: SingleFrame = vector.json(None)?;
    let part = |[x, y, z, height, width, length, yaw, class]: [f64; 8]| -> Result<(u8, Outline), String> {
        let object = box_of([x, y, z, height, width, length, yaw]);
        Ok((class_number(class)?, Outline::of(&object)))
    };
    let mut frame = Frame {
        key: true,
        processed: true,
        ..Frame::default()
    };
    for (object, score) in case.det_boxes_hwl_class.iter().zip(&case.det_scores) {
        let (class, outline) = part(*object)?;
        frame.detections.push(Detection {
            class,
            score: *score,
            outline,
        });
    }
    for object in &case.gt_boxes_hwl_class {
        let (class, outline) = part(*object)?;
        frame.truths.push(Truth {
            class,
            outline,
            points: None,
        });
    }
    check_scores(vec![frame], &case.result, vector.tolerance()?)
}

/// The expected values are in the file that the configuration names.
fn frames(vector: &Vector) -> Result<(), String> {
    let result = vector.text("result_file")?;
    check_frames(vector, &vector.beside(result))
}

/// The frames are in the vector whose configuration names this file.
fn results_of_frames(vector: &Vector) -> Result<(), String> {
    let of = vector.others("in.det_corners").into_iter().find(|other| {
        let names = other.text("result_file").map(|result| other.beside(result));
        names.is_ok_and(|result| result == vector.entry.file)
    });
    let of = of.ok_or("no vector of the manifest has this as its `result_file`")?;
    check_frames(&of, &vector.entry.file)
}

fn check_frames(vector: &Vector, result: &str) -> Result<(), String> {
    let expected: Expected = vector.json(Some(result))?;
    let tensors = vector.tensors()?;
    let outline = |corners: &Corners| Outline::of(&box_of_corners(corners));
    let outlines =
        |name: &str| -> Result<Vec<Outline>, String> { Ok(tensors.corners(name)?.iter().map(outline).collect()) };
    let classes = |name: &str| {
        tensors
            .numbers(name)?
            .into_iter()
            .map(class_number)
            .collect::<Result<Vec<u8>, String>>()
    };
    let (outlines_found, scores, found) = (
        outlines("in.det_corners")?,
        tensors.singles("in.det_scores")?,
        classes("in.det_labels")?,
    );
    let (outlines_there, there) = (outlines("in.gt_corners")?, classes("in.gt_labels")?);
    let detections = outlines_found.into_iter().zip(scores).zip(found);
    let mut detections = detections.map(|((outline, score), class)| Detection { class, score, outline });
    let truths = outlines_there.into_iter().zip(there);
    let mut truths = truths.map(|(outline, class)| Truth {
        class,
        outline,
        points: None,
    });
    let counts = tensors
        .numbers("in.det_per_frame")?
        .into_iter()
        .zip(tensors.numbers("in.gt_per_frame")?);
    let frame = |(seq, (found, there)): (u64, (f64, f64))| Frame {
        seq,
        key: true,
        processed: true,
        detections: detections.by_ref().take(found as usize).collect(),
        truths: truths.by_ref().take(there as usize).collect(),
        ..Frame::default()
    };
    check_scores(
        (0u64..).zip(counts).map(frame).collect(),
        &expected,
        vector.tolerance()?,
    )
}
