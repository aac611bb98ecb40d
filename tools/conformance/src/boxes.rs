use std::collections::BTreeMap;

use nalgebra::Isometry3;
use realo_methods::detect::pillars::Pillariser;
use realo_nn::anchors::{Anchors, Cells, decode, encode};
use realo_nn::model::Grid;
use realo_schemas::geometry::{Footprint, Region, bottom_corners, is_valid, relative, transform_box, yaw_of};
use realo_schemas::{Box3, PointCloud};
use realo_scoring::Protocol;
use realo_sync::{OwnBody, clean};
use serde::Deserialize;

use crate::Kind;
use crate::pillars::{points, points_of};
use crate::reference::{Corners, anchors_of, box_of, box_of_corners, grid_of, pose_of, range_of, row_of, transform_of};
use crate::vector::{Vector, compare, equal, flat};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["in.pose1", "in.pose2", "out.pose1_to_pose2"], pose_matrices),
    Kind::new(&["in.boxes_hwl", "in.matrix", "out.corners_f32"], corners),
    Kind::new(&["objects", "lidar_pose", "kept"], world_objects),
    Kind::new(&["out.anchors_chwr7"], anchors_by_class),
    Kind::new(&["in.deltas", "out.boxes_hwl"], decode_deltas),
    Kind::new(&["in.anchors", "in.boxes_hwl", "out.deltas"], encode_boxes),
    Kind::new(
        &["in.points", "out.after_self_mask", "out.after_range_mask"],
        point_masks,
    ),
];

fn pose_matrices(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let row_major = |pose: &Isometry3<f64>| pose.to_homogeneous().transpose().as_slice().to_vec();
    let poses = |name: &str| -> Result<Vec<Isometry3<f64>>, String> {
        Ok(tensors.rows::<6>(name)?.into_iter().map(pose_of).collect())
    };
    let (first, second) = (poses("in.pose1")?, poses("in.pose2")?);
    let to_world: Vec<f64> = first.iter().flat_map(row_major).collect();
    compare("pose1_to_world", &to_world, &tensors.numbers("out.pose1_to_world")?, t)?;
    let pairs = first.iter().zip(&second);
    let relative: Vec<f64> = pairs.flat_map(|(a, b)| row_major(&relative(b, a))).collect();
    compare("pose1_to_pose2", &relative, &tensors.numbers("out.pose1_to_pose2")?, t)
}

/// The corners of a box, as the graphs' region and suppression see them.
pub(crate) fn corners_of(object: &Box3) -> Corners {
    let [front_left, front_right, rear_right, rear_left] = bottom_corners(object);
    let ground = [front_right, front_left, rear_left, rear_right];
    std::array::from_fn(|i| {
        let half = object.height / 2.0;
        let z = object.center[2] + if i < 4 { -half } else { half };
        [ground[i % 4][0], ground[i % 4][1], z]
    })
}

/// Compares boxes with eight corners each: as boxes, since the graphs keep boxes upright where corners tilt.
pub(crate) fn compare_boxes(what: &str, found: &[Box3], expected: &[Corners], t: f64) -> Result<(), String> {
    let expected: Vec<Box3> = expected.iter().map(box_of_corners).collect();
    let pairs = found.iter().zip(&expected);
    let rows: Vec<[f64; 7]> = pairs.map(|(found, expected)| row_of(found, expected.yaw)).collect();
    let expected: Vec<[f64; 7]> = expected.iter().map(|object| row_of(object, object.yaw)).collect();
    compare(what, &flat(&rows), &flat(&expected), t)
}

/// The ends of x min, y min, z min, x max, y max, z max on the ground.
fn region([x0, y0, _, x1, y1, _]: [f64; 6]) -> Region {
    Region {
        x: [x0, x1],
        y: [y0, y1],
    }
}

/// Filters on a box's height and on two of its corners are no part of any graph.
fn corners(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let boxes: Vec<Box3> = tensors.rows::<7>("in.boxes_hwl")?.into_iter().map(box_of).collect();
    let found: Vec<Corners> = boxes.iter().map(corners_of).collect();
    let expected = tensors.numbers("out.corners_f32")?;
    compare("corners", &flat(found.as_flattened()), &expected, t)?;

    let projection = transform_of(&tensors.numbers("in.matrix")?)?;
    let expected = tensors.corners("out.projected_corners_f32")?;
    // What has no extent has no heading either.
    let sized = boxes.iter().zip(expected).filter(|(object, _)| is_valid(object));
    let (projected, expected): (Vec<Box3>, Vec<Corners>) = sized
        .map(|(object, corners)| (transform_box(&projection, object), corners))
        .unzip();
    compare_boxes("projected boxes", &projected, &expected, t)?;

    let hulls: Vec<[f64; 4]> = boxes
        .iter()
        .map(|object| {
            let Footprint { center, hull, .. } = Footprint::of(object);
            let ends = |sign: f64| [0, 1].map(|axis| center[axis] + sign * hull[axis]);
            let ([x0, y0], [x1, y1]) = (ends(-1.0), ends(1.0));
            [x0, y0, x1, y1]
        })
        .collect();
    compare("standup_xyxy", &flat(&hulls), &tensors.numbers("out.standup_xyxy")?, t)?;

    let mask = |what: &str, found: Vec<bool>| {
        let bits = tensors.numbers(&format!("out.{what}"))?;
        equal(
            what,
            &found,
            &bits.into_iter().map(|bit| bit == 1.0).collect::<Vec<_>>(),
        )
    };
    let region = region(vector.setting("eval_range")?);
    let inside = boxes.iter().map(|object| region.contains_box(object)).collect();
    mask("mask_eval_range_all_corners", inside)?;
    // The reference's filter of sizes: here a box must have an extent, and its largest size is nobody's business.
    mask("mask_not_large", boxes.iter().map(is_valid).collect())
}

#[derive(Deserialize)]
struct World {
    lidar_pose: [f64; 6],
    objects: BTreeMap<String, WorldObject>,
    kept: BTreeMap<String, [f64; 8]>,
    dropped_by_class: Vec<String>,
    dropped_by_range: Vec<String>,
}

#[derive(Deserialize)]
struct WorldObject {
    location: [f64; 3],
    center: [f64; 3],
    extent: [f64; 3],
    angle: [f64; 3],
    obj_type: String,
}

/// Classes, places and the region of evaluation. The reference drops objects with fewer than two corners in range before;
/// those must lie outside the region here.
fn world_objects(vector: &Vector) -> Result<(), String> {
    let (world, t): (World, f64) = (vector.json(None)?, vector.tolerance()?);
    let protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let lidar_from_map = relative(&pose_of(world.lidar_pose), &Isometry3::identity());
    let (mut by_class, mut placed) = (Vec::new(), 0);
    for (id, object) in &world.objects {
        let Some(class) = protocol.class_of(&object.obj_type) else {
            by_class.push(id.clone());
            continue;
        };
        let [x, y, z] = [0, 1, 2].map(|axis| object.location[axis] + object.center[axis]);
        let [roll, yaw, pitch] = object.angle;
        let yaw = yaw_of(&pose_of([x, y, z, roll, yaw, pitch]).rotation);
        let [length, width, height] = object.extent.map(|half| 2.0 * half);
        let in_lidar = transform_box(&lidar_from_map, &box_of([x, y, z, height, width, length, yaw]));
        match world.kept.get(id) {
            Some(expected) => {
                let mut row = row_of(&in_lidar, expected[6]).to_vec();
                row.push(f64::from(class) + 1.0);
                compare(&format!("object {id}"), &row, expected, t)?;
                placed += 1;
            }
            None if !world.dropped_by_range.contains(id) => return Err(format!("object {id} is in none of the lists")),
            None if protocol.takes_in(&in_lidar) => return Err(format!("object {id}: expected outside, found inside")),
            None => (),
        }
    }
    equal("dropped_by_class", &by_class, &world.dropped_by_class)?;
    equal("number of kept objects", &[placed], &[world.kept.len()])
}

/// Anchors in the order (class, row, column, heading).
fn by_class(anchors: &Anchors) -> impl Iterator<Item = [f64; 7]> + '_ {
    let Cells { rows, columns, .. } = anchors.cells;
    let places = move || (0..rows).flat_map(move |row| (0..columns).map(move |column| (row, column)));
    let at = move |class, (row, column)| [0, 1].map(|heading| anchors.at(row, column, class, heading));
    (0..anchors.classes.len()).flat_map(move |class| places().flat_map(move |place| at(class, place)))
}

fn anchors_by_class(vector: &Vector) -> Result<(), String> {
    let anchors = anchors_of(vector.setting("range")?)?;
    let found: Vec<[f64; 7]> = by_class(&anchors).collect();
    let expected = vector.tensors()?.numbers("out.anchors_chwr7")?;
    compare("anchors", &flat(&found), &expected, vector.tolerance()?)
}

#[derive(Deserialize)]
struct Samples {
    shape: [usize; 5],
    sum_per_column: [f64; 7],
    samples: Vec<Sample>,
}

#[derive(Deserialize)]
struct Sample {
    index: [usize; 4],
    anchor: [f64; 7],
}

/// Whether a document holds samples of anchors, by name of the network.
pub(crate) fn holds_samples(vector: &Vector) -> bool {
    let document = vector.json::<BTreeMap<String, Samples>>(None);
    document.is_ok_and(|networks| !networks.is_empty())
}

pub(crate) fn anchor_samples(vector: &Vector) -> Result<(), String> {
    let (networks, t): (BTreeMap<String, Samples>, f64) = (vector.json(None)?, vector.tolerance()?);
    for (network, expected) in &networks {
        let [_, rows, columns, ..] = expected.shape;
        let anchors = anchors_of(range_of([rows, columns]))?;
        let Cells { rows, columns, .. } = anchors.cells;
        let shape = [anchors.classes.len(), rows, columns, anchors.rotations.len(), 7];
        equal(&format!("{network} shape"), &shape, &expected.shape)?;
        for sample in &expected.samples {
            let [class, row, column, heading] = sample.index;
            let in_shape = sample.index.iter().zip(&shape).all(|(index, size)| index < size);
            if !in_shape {
                return Err(format!("{network}: sample {:?} lies outside its shape", sample.index));
            }
            let found = anchors.at(row, column, class, heading);
            compare(
                &format!("{network} anchor {:?}", sample.index),
                &found,
                &sample.anchor,
                t,
            )?;
        }
        let mut sums = [0.0; 7];
        let mut count = 0.0;
        for anchor in by_class(&anchors) {
            sums.iter_mut().zip(anchor).for_each(|(sum, value)| *sum += value);
            count += 1.0;
        }
        // The tolerance is that of one anchor.
        let mean = |sums: &[f64; 7]| sums.map(|sum| sum / count);
        compare(
            &format!("{network} mean"),
            &mean(&sums),
            &mean(&expected.sum_per_column),
            t,
        )?;
    }
    Ok(())
}

/// The anchors are those of the vector of anchors that has as many.
fn decode_deltas(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let deltas = tensors.rows::<7>("in.deltas")?;
    let mut others = vector.others("out.anchors_chwr7").into_iter();
    let anchors = others
        .find_map(|other| {
            let anchors = anchors_of(other.setting("range").ok()?).ok()?;
            (anchors.count() == deltas.len()).then_some(anchors)
        })
        .ok_or_else(|| format!("the manifest has no anchors for {} deltas", deltas.len()))?;
    let single = |row: &[f64; 7]| row.map(|value| value as f32);
    let pairs = deltas.iter().zip(anchors.iter());
    let decoded: Vec<[f64; 7]> = pairs
        .map(|(deltas, anchor)| decode(&single(deltas), &single(&anchor)).map(f64::from))
        .collect();
    compare("boxes", &flat(&decoded), &tensors.numbers("out.boxes_hwl")?, t)
}

fn encode_boxes(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let (anchors, boxes) = (tensors.rows::<7>("in.anchors")?, tensors.rows::<7>("in.boxes_hwl")?);
    let pairs = boxes.iter().zip(&anchors);
    let deltas: Vec<[f64; 7]> = pairs.map(|(object, anchor)| encode(object, anchor)).collect();
    compare("deltas", &flat(&deltas), &tensors.numbers("out.deltas")?, t)?;
    let single = |row: &[f64; 7]| row.map(|value| value as f32);
    let pairs = deltas.iter().zip(&anchors);
    let back: Vec<[f64; 7]> = pairs
        .map(|(deltas, anchor)| decode(&single(deltas), &single(anchor)).map(f64::from))
        .collect();
    compare(
        "decoded_again",
        &flat(&back),
        &tensors.numbers("out.decoded_again_f32")?,
        t,
    )
}

/// A cloud whose times are the indices of its points.
pub(crate) fn cloud_of(points: &[[f32; 4]]) -> Result<PointCloud, String> {
    let axis = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
    let n = points.len();
    let index = (0..n as i32).collect::<Vec<i32>>();
    let cloud = PointCloud::new(axis(0), axis(1), axis(2), vec![0; n], index, vec![0; n]);
    cloud.ok_or_else(|| "columns of different lengths".into())
}

/// What of the points is left, without those on the agent's own body: x min, y min, x max, y max.
pub(crate) fn without_own_body(points: &[[f32; 4]], [x0, y0, x1, y1]: [f32; 4]) -> Result<PointCloud, String> {
    let body = OwnBody {
        x: [x0, x1],
        y: [y0, y1],
    };
    Ok(clean(&cloud_of(points)?, Some(body), None).cloud)
}

/// The own body, as `sync` leaves it out, and the range, as pillars do.
fn point_masks(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let given = points(&tensors, "in.points")?;
    let body = vector.setting::<4>("self_box")?.map(|value| value as f32);
    let cleaned = without_own_body(&given, body)?;
    let left: Vec<[f32; 4]> = cleaned.time.iter().map(|index| given[*index as usize]).collect();
    equal("after_self_mask", &left, &points(&tensors, "out.after_self_mask")?)?;

    let grid = square_cells(vector.setting("range")?)?;
    let mut pillariser = Pillariser::new(&grid, given.len(), grid.rows() * grid.columns());
    let taken = points_of(&mut pillariser, &given).points;
    equal(
        "after_range_mask",
        &sorted(taken),
        &sorted(points(&tensors, "out.after_range_mask")?),
    )
}

/// A grid over a range with pillars as wide as they can be.
fn square_cells(range: [f64; 6]) -> Result<Grid, String> {
    let grid = grid_of(range);
    let [width, height] = [grid.x, grid.y].map(|[from, to]| to - from);
    let cells = (1..=1000).map(|columns| width / f64::from(columns));
    let cell = cells.into_iter().find(|cell| (height / cell).fract() == 0.0);
    let cell = cell.ok_or_else(|| format!("config `range`: no square pillars cover {range:?}"))?;
    Ok(Grid { cell, ..grid })
}

/// Points by their numbers: pillars bring them into another order.
fn sorted(mut points: Vec<[f32; 4]>) -> Vec<[f32; 4]> {
    points.sort_by(|a, b| {
        let pairs = a.iter().zip(b).map(|(a, b)| a.total_cmp(b));
        pairs.fold(std::cmp::Ordering::Equal, |sum, next| sum.then(next))
    });
    points
}
