use realo_nms::{Config, Index, Ties, keep, order};
use realo_schemas::geometry::{Corners, Footprint, iou};

use crate::Check;
use crate::vector::{Tensors, Vector, compare, equal};

pub(crate) fn check(name: &str) -> Option<Check> {
    match name {
        "random_30" | "random_80" | "degenerate" => Some(pairs_and_keep),
        "zero_size" => Some(zero_size),
        "ties" => Some(ties),
        "top1000" => Some(top_1000),
        _ => None,
    }
}

pub(crate) fn footprints(corners: &[Corners]) -> Vec<Footprint> {
    corners
        .iter()
        .map(|corners| Footprint::from_corners([0, 1, 2, 3].map(|i| [corners[i][0], corners[i][1]])))
        .collect()
}

fn matrix(footprints: &[Footprint]) -> Vec<f64> {
    footprints
        .iter()
        .flat_map(|a| footprints.iter().map(move |b| iou(a, b)))
        .collect()
}

fn pairs_and_keep(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let footprints = footprints(&tensors.corners("in.corners")?);
    compare(
        "iou",
        &matrix(&footprints),
        &tensors.numbers("out.iou")?,
        vector.tolerance()?,
    )?;
    check_keep(&tensors, &footprints, Ties::First)
}

/// Every list `out.keep_<threshold>`, by each index.
fn check_keep(tensors: &Tensors, footprints: &[Footprint], ties: Ties) -> Result<(), String> {
    let scores = tensors.singles("in.scores")?;
    let lists = tensors.names("out.keep_")?;
    if lists.is_empty() {
        return Err("the vector has no list `out.keep_…`".into());
    }
    for name in lists {
        let threshold = name.trim_start_matches("out.keep_");
        let threshold = threshold.parse().map_err(|_| format!("`{name}` names no threshold"))?;
        let expected: Vec<u32> = tensors.numbers(&name)?.into_iter().map(|index| index as u32).collect();
        for index in [Index::Grid, Index::Rtree, Index::Brute] {
            let config = Config {
                threshold,
                ties,
                index,
                ..Config::default()
            };
            equal(
                &format!("{name} ({index:?})"),
                &keep(footprints, &scores, &config),
                &expected,
            )?;
        }
    }
    Ok(())
}

/// The reference divides by zero where the vector has NaN; here such boxes overlap nothing.
fn zero_size(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let footprints = footprints(&tensors.corners("in.corners")?);
    let expected = tensors.numbers("out.iou_nan_where_reference_fails")?;
    let expected: Vec<f64> = expected
        .into_iter()
        .map(|iou| if iou.is_nan() { 0.0 } else { iou })
        .collect();
    compare("iou", &matrix(&footprints), &expected, vector.tolerance()?)
}

fn ties(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let expected: Vec<u32> = tensors
        .numbers("mid.order")?
        .into_iter()
        .map(|index| index as u32)
        .collect();
    equal("order", &order(&tensors.singles("in.scores")?, Ties::Last), &expected)?;
    check_keep(&tensors, &footprints(&tensors.corners("in.corners")?), Ties::Last)
}

fn top_1000(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let rows = tensors.rows::<8>("in.corners_bev")?;
    let footprint = |row: &[f64; 8]| Footprint::from_corners([0, 1, 2, 3].map(|i| [row[2 * i], row[2 * i + 1]]));
    check_keep(&tensors, &rows.iter().map(footprint).collect::<Vec<_>>(), Ties::First)
}
