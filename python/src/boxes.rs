//! Geometry of boxes on arrays.

use arrow_array::cast::AsArray;
use arrow_array::types::{ArrowPrimitiveType, Float64Type};
use arrow_array::{Array, Float64Array, PrimitiveArray, UInt32Array, make_array};
use arrow_data::ArrayData;
use arrow_pyarrow::PyArrowType;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use pyo3::prelude::*;
use realo_nms::Settings;
use realo_schemas::geometry::{Footprint, Region, bottom_corners, transform_boxes};
use realo_schemas::{Box3, Boxes, Message, wire};

use crate::{Row, refused, row};

/// Numbers as Python gives them.
pub type Numbers = PyArrowType<ArrayData>;

/// The numbers of an array of one type without nulls.
pub fn numbers<T: ArrowPrimitiveType>(argument: &str, array: Numbers) -> PyResult<PrimitiveArray<T>> {
    let array = make_array(array.0);
    match array.as_primitive_opt::<T>() {
        Some(numbers) if numbers.null_count() == 0 => Ok(numbers.clone()),
        _ => Err(refused(
            argument,
            format!(
                "expected numbers of type {} without nulls, found {}, of which {} are null",
                T::DATA_TYPE,
                array.data_type(),
                array.null_count()
            ),
        )),
    }
}

/// A message of boxes as Python gives it.
pub fn message_of_boxes(argument: &str, array: Row) -> PyResult<(realo_schemas::Header, Vec<Box3>)> {
    let message = wire::from_arrow(&make_array(array.0)).map_err(|error| refused(argument, error))?;
    let (header, Boxes(boxes)) = message
        .into_parts::<Boxes>()
        .map_err(|error| refused(argument, error))?;
    Ok((header, boxes))
}

/// Rectangles on the ground of rows x, y, length, width, yaw.
fn footprints(argument: &str, array: Numbers) -> PyResult<Vec<Footprint>> {
    let numbers = numbers::<Float64Type>(argument, array)?;
    let (rows, rest) = numbers.values().as_chunks::<5>();
    if !rest.is_empty() {
        return Err(refused(
            argument,
            format!("expected rows of 5 numbers, found {}", numbers.len()),
        ));
    }
    let footprint = |[x, y, length, width, yaw]: &[f64; 5]| Footprint::new([*x, *y], *length, *width, *yaw);
    Ok(rows.iter().map(footprint).collect())
}

/// IoU on the ground of each row of `a` with each of `b`, row-major.
#[pyfunction]
pub fn iou(py: Python, a: Numbers, b: Numbers) -> PyResult<Numbers> {
    let (a, b) = (footprints("a", a)?, footprints("b", b)?);
    let found: Vec<f64> = py.detach(|| {
        let pairs = a.iter().flat_map(|one| b.iter().map(move |other| (one, other)));
        pairs
            .map(|(one, other)| realo_schemas::geometry::iou(one, other))
            .collect()
    });
    Ok(PyArrowType(Float64Array::from(found).to_data()))
}

/// (x, y) of the corners of each box: front-left, front-right, rear-right, rear-left.
#[pyfunction]
pub fn corners(boxes: Row) -> PyResult<Numbers> {
    let (_, boxes) = message_of_boxes("boxes", boxes)?;
    let corners = boxes.iter().flat_map(bottom_corners).flatten();
    Ok(PyArrowType(Float64Array::from_iter_values(corners).to_data()))
}

/// How duplicates are suppressed.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Suppression {
    threshold: f64,
    min_score: f32,
    max_boxes: usize,
    per_class: bool,
    vote: f64,
    region: Vec<f64>,
}

/// Suppresses duplicates: the indices of the kept boxes, best score first, and these boxes, after the vote.
#[pyfunction]
pub fn nms(py: Python, boxes: Row, settings: Suppression) -> PyResult<(Numbers, Row)> {
    let (header, boxes) = message_of_boxes("boxes", boxes)?;
    let region = Region::from_list(&settings.region).map_err(|reason| refused("region", reason))?;
    let settings = Settings {
        threshold: settings.threshold,
        min_score: settings.min_score,
        max_boxes: settings.max_boxes,
        per_class: settings.per_class,
        vote: settings.vote,
        ..Settings::default()
    };
    let outcome = py.detach(|| realo_nms::nms(&boxes, &settings, region.as_ref()));
    let kept = UInt32Array::from(outcome.kept);
    Ok((
        PyArrowType(kept.to_data()),
        row(&Message::new(header, Boxes(outcome.boxes))),
    ))
}

/// Boxes in another frame: centre, heading, velocity and covariance; `to_from_from` is a 4×4 matrix, row-major.
#[pyfunction]
pub fn transform(to_from_from: [f64; 16], boxes: Row) -> PyResult<Row> {
    let (header, mut boxes) = message_of_boxes("boxes", boxes)?;
    let transform = isometry(&to_from_from).map_err(|reason| refused("to_from_from", reason))?;
    transform_boxes(&transform, &mut boxes);
    Ok(row(&Message::new(header, Boxes(boxes))))
}

/// The pose of a matrix.
fn isometry(m: &[f64; 16]) -> Result<Isometry3<f64>, String> {
    let turn = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
    let off = (turn * turn.transpose() - Matrix3::identity()).amax();
    if m[12..] != [0.0, 0.0, 0.0, 1.0] || !(off < 1e-6 && turn.determinant() > 0.0) || !m.iter().all(|v| v.is_finite())
    {
        return Err(
            "expected a 4×4 matrix of a rotation and a translation, found scale, mirror or other numbers".into(),
        );
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    let translation = Translation3::from(Vector3::new(m[3], m[7], m[11]));
    Ok(Isometry3::from_parts(translation, rotation))
}
