use std::collections::BTreeMap;
use std::f64::consts::TAU;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use realo_evaluator::Protocol;
use realo_nn::anchors::{Anchors, Cells, decode, encode};
use realo_nn::points::{in_range, on_own_body};
use realo_schemas::Box3;
use realo_schemas::geometry::{
    Cuboid, Region, corner_hull, corners_inside, is_valid, pose_from_carla, relative, transform_corners,
};
use serde::Deserialize;

use crate::Check;
use crate::vector::{Vector, compare, equal};

pub(crate) fn check(name: &str) -> Option<Check> {
    match name {
        "pose_matrices" => Some(pose_matrices),
        "corners" => Some(corners),
        "world_objects" => Some(world_objects),
        "anchors_small" => Some(anchors_small),
        "anchors_full_size" => Some(anchors_full_size),
        "decode" => Some(decode_deltas),
        "encode" => Some(encode_boxes),
        "point_masks" => Some(point_masks),
        _ => None,
    }
}

pub(crate) fn flat<const N: usize>(rows: &[[f64; N]]) -> Vec<f64> {
    rows.iter().flatten().copied().collect()
}

/// The same heading, in the turn that was expected.
fn turned_to(expected: f64, yaw: f64) -> f64 {
    yaw + TAU * ((expected - yaw) / TAU).round()
}

fn pose_matrices(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let row_major = |pose: &Isometry3<f64>| pose.to_homogeneous().transpose().as_slice().to_vec();
    let poses = |name: &str| -> Result<Vec<Isometry3<f64>>, String> {
        Ok(tensors.rows::<6>(name)?.into_iter().map(pose_from_carla).collect())
    };
    let (first, second) = (poses("in.pose1")?, poses("in.pose2")?);
    let to_world: Vec<f64> = first.iter().flat_map(row_major).collect();
    compare("pose1_to_world", &to_world, &tensors.numbers("out.pose1_to_world")?, t)?;
    let relative: Vec<f64> = first
        .iter()
        .zip(&second)
        .flat_map(|(a, b)| row_major(&relative(b, a)))
        .collect();
    compare("pose1_to_pose2", &relative, &tensors.numbers("out.pose1_to_pose2")?, t)
}

pub(crate) fn cuboid([x, y, z, height, width, length, yaw]: &[f64; 7]) -> Cuboid {
    Cuboid {
        center: [*x, *y, *z],
        extent: [*length, *width, *height],
        yaw: *yaw,
    }
}

fn object(cuboid: &Cuboid) -> Box3 {
    let [length, width, height] = cuboid.extent;
    Box3 {
        center: cuboid.center,
        length,
        width,
        height,
        yaw: cuboid.yaw,
        velocity: None,
        class: "vehicle".into(),
        score: 1.0,
        track: None,
        covariance: None,
    }
}

fn hwl(cuboid: &Cuboid, expected_yaw: f64) -> [f64; 7] {
    let ([x, y, z], [length, width, height]) = (cuboid.center, cuboid.extent);
    [x, y, z, height, width, length, turned_to(expected_yaw, cuboid.yaw)]
}

pub(crate) fn isometry(matrix: &[f64]) -> Result<Isometry3<f64>, String> {
    let [a, b, c, x, d, e, f, y, g, h, i, z, ..] = *matrix else {
        return Err("a matrix is not 4×4".into());
    };
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::new(a, b, c, d, e, f, g, h, i));
    Ok(Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

/// Split [x, y, z, x, y, z] into its two ends.
fn ends([x0, y0, z0, x1, y1, z1]: [f64; 6]) -> ([f64; 3], [f64; 3]) {
    ([x0, y0, z0], [x1, y1, z1])
}

fn corners(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let cuboids: Vec<Cuboid> = tensors.rows::<7>("in.boxes_hwl")?.iter().map(cuboid).collect();
    let corners: Vec<_> = cuboids.iter().map(Cuboid::corners).collect();
    compare(
        "corners",
        &flat(corners.as_flattened()),
        &tensors.numbers("out.corners_f32")?,
        t,
    )?;

    let projection = isometry(&tensors.numbers("in.matrix")?)?;
    let projected: Vec<_> = corners
        .iter()
        .map(|corners| transform_corners(&projection, corners))
        .collect();
    compare(
        "projected_corners",
        &flat(projected.as_flattened()),
        &tensors.numbers("out.projected_corners_f32")?,
        t,
    )?;

    let expected = tensors.rows::<7>("out.center_from_corners_rows_except_2")?;
    let given = tensors
        .corners("out.corners_f32")?
        .into_iter()
        .enumerate()
        .filter(|(row, _)| *row != 2);
    let back = given
        .zip(&expected)
        .map(|((_, corners), row)| hwl(&Cuboid::from_corners(&corners), row[6]));
    compare(
        "center_from_corners",
        &flat(&back.collect::<Vec<_>>()),
        &flat(&expected),
        t,
    )?;

    let hulls: Vec<[[f64; 3]; 2]> = corners.iter().map(corner_hull).collect();
    let standup: Vec<[f64; 4]> = hulls
        .iter()
        .map(|[least, most]| [least[0], least[1], most[0], most[1]])
        .collect();
    compare(
        "standup_xyxy",
        &flat(&standup),
        &tensors.numbers("out.standup_xyxy")?,
        t,
    )?;

    let mask = |what: &str, found: Vec<bool>| {
        let expected: Vec<bool> = tensors
            .numbers(&format!("out.{what}"))?
            .into_iter()
            .map(|bit| bit == 1.0)
            .collect();
        equal(what, &found, &expected)
    };
    let (least, most) = ends(vector.setting("eval_range")?);
    let region = Region {
        x: [least[0], most[0]],
        y: [least[1], most[1]],
    };
    mask(
        "mask_eval_range_all_corners",
        cuboids
            .iter()
            .map(|cuboid| region.contains_box(&object(cuboid)))
            .collect(),
    )?;
    // The reference's filter of sizes: here a box must have an extent, and its greatest size is nobody's business.
    mask(
        "mask_not_large",
        cuboids.iter().map(|cuboid| is_valid(&object(cuboid))).collect(),
    )?;
    // The reference tests y by mistake; meant is the height.
    mask(
        "mask_z_ok",
        hulls
            .iter()
            .map(|[low, high]| low[2] >= least[2] && high[2] <= most[2])
            .collect(),
    )?;
    let (least, most) = ends(vector.setting("range_for_2_corner_mask")?);
    let two = |corners| corners_inside(corners, least, most) >= 2;
    mask("mask_2_corners_in_range", corners.iter().map(two).collect())
}

#[derive(Deserialize)]
struct World {
    lidar_pose: [f64; 6],
    range: [f64; 6],
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

fn world_objects(vector: &Vector) -> Result<(), String> {
    let (world, t): (World, f64) = (vector.json(None)?, vector.tolerance()?);
    let protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let (least, most) = ends(world.range);
    let map_from_lidar = pose_from_carla(world.lidar_pose);
    let (mut by_class, mut by_range, mut kept) = (Vec::new(), Vec::new(), Vec::new());
    for (id, object) in &world.objects {
        let Some(class) = protocol.class_of(&object.obj_type) else {
            by_class.push(id.clone());
            continue;
        };
        let [x, y, z] = [0, 1, 2].map(|axis| object.location[axis] + object.center[axis]);
        let [roll, yaw, pitch] = object.angle;
        let lidar_from_object = relative(&map_from_lidar, &pose_from_carla([x, y, z, roll, yaw, pitch]));
        let at_origin = Cuboid {
            center: [0.0; 3],
            extent: object.extent.map(|half| 2.0 * half),
            yaw: 0.0,
        };
        let corners = transform_corners(&lidar_from_object, &at_origin.corners());
        if corners_inside(&corners, least, most) < 2 {
            by_range.push(id.clone());
            continue;
        }
        let expected = world
            .kept
            .get(id)
            .ok_or_else(|| format!("object {id}: expected dropped, found kept"))?;
        let [x, y, z, height, width, length, yaw] = hwl(&Cuboid::from_corners(&corners), expected[6]);
        let row = [x, y, z, height, width, length, yaw, f64::from(class) + 1.0];
        compare(&format!("object {id}"), &row, expected, t)?;
        kept.push(id.clone());
    }
    equal("dropped_by_class", &by_class, &world.dropped_by_class)?;
    equal("dropped_by_range", &by_range, &world.dropped_by_range)?;
    equal("kept", &kept, &world.kept.keys().cloned().collect::<Vec<_>>())
}

const VOXEL: f64 = 0.4;
const STRIDE: usize = 2;

pub(crate) fn cells_of(range: [f64; 6]) -> Cells {
    Cells::new([range[0], range[3]], [range[1], range[4]], VOXEL, STRIDE)
}

/// Anchors in the order (class, row, column, heading).
fn by_class(anchors: &Anchors) -> impl Iterator<Item = [f64; 7]> + '_ {
    let Cells { rows, columns, .. } = anchors.cells;
    let places = move || (0..rows).flat_map(move |row| (0..columns).map(move |column| (row, column)));
    let at = move |class, (row, column)| [0, 1].map(|heading| anchors.at(row, column, class, heading));
    (0..anchors.classes.len()).flat_map(move |class| places().flat_map(move |place| at(class, place)))
}

fn anchors_small(vector: &Vector) -> Result<(), String> {
    let anchors = Anchors::v2x_real(cells_of(vector.setting("range")?));
    let found: Vec<[f64; 7]> = by_class(&anchors).collect();
    let expected = vector.tensors()?.numbers("out.anchors_chwr7")?;
    compare("anchors", &flat(&found), &expected, vector.tolerance()?)
}

#[derive(Deserialize)]
struct FullSize {
    shape: [usize; 5],
    sum_per_column: [f64; 7],
    samples: Vec<Sample>,
}

#[derive(Deserialize)]
struct Sample {
    index: [usize; 4],
    anchor: [f64; 7],
}

fn anchors_full_size(vector: &Vector) -> Result<(), String> {
    let (networks, t): (BTreeMap<String, FullSize>, f64) = (vector.json(None)?, vector.tolerance()?);
    for (network, expected) in &networks {
        let (x, y) = match network.as_str() {
            "point_pillar_late_fusion" => (70.4, 40.0),
            "point_pillar_v2xvit" => (102.4, 38.4),
            _ => (102.4, 40.0),
        };
        let anchors = Anchors::v2x_real(cells_of([-x, -y, -15.0, x, y, 15.0]));
        let Cells { rows, columns, .. } = anchors.cells;
        equal(
            &format!("{network} shape"),
            &[anchors.classes.len(), rows, columns, 2, 7],
            &expected.shape,
        )?;
        for sample in &expected.samples {
            let [class, row, column, heading] = sample.index;
            let in_shape = sample
                .index
                .iter()
                .zip(&expected.shape)
                .all(|(index, size)| index < size);
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

fn decode_deltas(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let cells = cells_of([-12.8, -6.4, -15.0, 12.8, 6.4, 15.0]);
    let anchors: Vec<[f64; 7]> = Anchors::v2x_real(cells).iter().collect();
    let deltas = tensors.rows::<7>("in.deltas")?;
    if deltas.len() != anchors.len() {
        return Err(format!(
            "expected deltas for {} anchors, found {}",
            anchors.len(),
            deltas.len()
        ));
    }
    let single = |row: &[f64; 7]| row.map(|value| value as f32);
    let decoded = deltas
        .iter()
        .zip(&anchors)
        .map(|(deltas, anchor)| decode(&single(deltas), &single(anchor)));
    let decoded: Vec<[f64; 7]> = decoded.map(|row| row.map(f64::from)).collect();
    compare(
        "boxes",
        &flat(&decoded),
        &tensors.numbers("out.boxes_hwl")?,
        vector.tolerance()?,
    )
}

fn encode_boxes(vector: &Vector) -> Result<(), String> {
    let (tensors, t) = (vector.tensors()?, vector.tolerance()?);
    let (anchors, boxes) = (tensors.rows::<7>("in.anchors")?, tensors.rows::<7>("in.boxes_hwl")?);
    let deltas: Vec<[f64; 7]> = boxes
        .iter()
        .zip(&anchors)
        .map(|(object, anchor)| encode(object, anchor))
        .collect();
    compare("deltas", &flat(&deltas), &tensors.numbers("out.deltas")?, t)?;
    let single = |row: &[f64; 7]| row.map(|value| value as f32);
    let back = deltas
        .iter()
        .zip(&anchors)
        .map(|(deltas, anchor)| decode(&single(deltas), &single(anchor)).map(f64::from));
    compare(
        "decoded_again",
        &flat(&back.collect::<Vec<_>>()),
        &tensors.numbers("out.decoded_again_f32")?,
        t,
    )
}

fn point_masks(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let single = |row: [f64; 4]| row.map(|value| value as f32);
    let points: Vec<[f32; 4]> = tensors.rows::<4>("in.points")?.into_iter().map(single).collect();
    let body = vector.setting::<4>("self_box")?.map(|value| value as f32);
    let range = vector.setting::<6>("range")?.map(|value| value as f32);
    let left =
        |keep: &dyn Fn(&[f32; 4]) -> bool| -> Vec<[f32; 4]> { points.iter().copied().filter(|p| keep(p)).collect() };
    let expected = |name: &str| -> Result<Vec<[f32; 4]>, String> {
        Ok(tensors.rows::<4>(name)?.into_iter().map(single).collect())
    };
    equal(
        "after_self_mask",
        &left(&|point| !on_own_body(*point, body)),
        &expected("out.after_self_mask")?,
    )?;
    equal(
        "after_range_mask",
        &left(&|point| in_range(*point, range)),
        &expected("out.after_range_mask")?,
    )
}
