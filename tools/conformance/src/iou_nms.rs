use realo_nms::{Index, Settings, Ties, nms, order};
use realo_schemas::Box3;
use realo_schemas::geometry::{Footprint, iou};

use crate::Kind;
use crate::reference::{box_of_corners, upright};
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.corners", "in.scores", "out.iou"], pairs_and_keep),
    Kind::new(&["in.corners", "out.iou_nan_where_reference_fails"], zero_size),
    Kind::new(&["in.corners", "in.scores", "mid.order"], ties),
    Kind::new(&["in.corners_bev", "in.scores"], many),
];

fn boxes(tensors: &Tensors) -> Result<Vec<Box3>, String> {
    Ok(tensors.corners("in.corners")?.iter().map(box_of_corners).collect())
}

fn matrix(boxes: &[Box3]) -> Vec<f64> {
    let footprints: Vec<Footprint> = boxes.iter().map(Footprint::of).collect();
    let pairs = footprints.iter().flat_map(|a| footprints.iter().map(move |b| (a, b)));
    pairs.map(|(a, b)| iou(a, b)).collect()
}

fn pairs_and_keep(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let boxes = boxes(&tensors)?;
    compare(
        "iou",
        &matrix(&boxes),
        &tensors.numbers("out.iou")?,
        vector.tolerance()?,
    )?;
    check_keep(&tensors, boxes, Ties::First)
}

/// Every list `out.keep_<threshold>`, by each index.
fn check_keep(tensors: &Tensors, mut boxes: Vec<Box3>, ties: Ties) -> Result<(), String> {
    let scores = tensors.singles("in.scores")?;
    if scores.len() != boxes.len() {
        return Err(format!("expected {} scores, found {}", boxes.len(), scores.len()));
    }
    boxes
        .iter_mut()
        .zip(scores)
        .for_each(|(object, score)| object.score = score);
    let lists = tensors.names("out.keep_")?;
    if lists.is_empty() {
        return Err("the vector has no list `out.keep_…`".into());
    }
    for name in lists {
        let threshold = name.trim_start_matches("out.keep_");
        let threshold = threshold.parse().map_err(|_| format!("`{name}` names no threshold"))?;
        let expected: Vec<u32> = tensors.numbers(&name)?.into_iter().map(|index| index as u32).collect();
        for index in [Index::Grid, Index::Rtree, Index::Brute] {
            let config = Settings {
                threshold,
                ties,
                index,
                ..Settings::default()
            };
            equal(
                &format!("{name} ({index:?})"),
                &nms(&boxes, &config, None).kept,
                &expected,
            )?;
        }
    }
    Ok(())
}

/// The reference divides by zero where the vector has NaN; here such boxes overlap nothing.
fn zero_size(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let expected = tensors.numbers("out.iou_nan_where_reference_fails")?;
    let expected: Vec<f64> = expected
        .into_iter()
        .map(|iou| if iou.is_nan() { 0.0 } else { iou })
        .collect();
    compare("iou", &matrix(&boxes(&tensors)?), &expected, vector.tolerance()?)
}

fn ties(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let expected: Vec<u32> = tensors
        .numbers("mid.order")?
        .into_iter()
        .map(|index| index as u32)
        .collect();
    equal("order", &order(&tensors.singles("in.scores")?, Ties::Last), &expected)?;
    check_keep(&tensors, boxes(&tensors)?, Ties::Last)
}

fn many(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let rows = tensors.rows::<8>("in.corners_bev")?;
    let ground = rows
        .iter()
        .map(|row| [0, 1, 2, 3].map(|i| [row[2 * i], row[2 * i + 1]]));
    check_keep(
        &tensors,
        ground.map(|corners| box_of_corners(&upright(&corners))).collect(),
        Ties::First,
    )
}
