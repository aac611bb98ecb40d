//! How the reference writes boxes, poses and anchors, brought to how the graphs have them. Nothing here is under test.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use realo_kernels::warp::Warp;
use realo_methods::Model;
use realo_nn::anchors::Anchors;
use realo_nn::model::{Backbone, ClassAnchor, Frame, Grid, Matching, PillarSettings, Precision};
use realo_schemas::Box3;
use serde_json::Value;

/// The eight corners of a box: front-right, front-left, rear-left, rear-right of the bottom, then of the top.
pub type Corners = [[f64; 3]; 8];

/// Side of a pillar, m.
pub const CELL: f64 = 0.4;

/// Points that a pillar takes.
pub const SLOTS: usize = 32;

/// Pillars along each side of a cell of the anchors' map.
const STRIDE: usize = 2;

/// A box of x, y, z, height, width, length, yaw.
pub fn box_of([x, y, z, height, width, length, yaw]: [f64; 7]) -> Box3 {
    Box3 {
        center: [x, y, z],
        length,
        width,
        height,
        yaw,
        velocity: None,
        class: "vehicle".into(),
        score: 1.0,
        track: None,
        covariance: None,
    }
}

/// x, y, z, height, width, length and heading of a box; the heading in the turn that was expected.
pub fn row_of(object: &Box3, expected_yaw: f64) -> [f64; 7] {
    use std::f64::consts::TAU;
    let [x, y, z] = object.center;
    let yaw = object.yaw + TAU * ((expected_yaw - object.yaw) / TAU).round();
    [x, y, z, object.height, object.width, object.length, yaw]
}

/// The gravity-aligned box of eight corners, which may be tilted or rounded: centre of the corners, mean lengths of the
/// edges, mean direction of the lengthwise edges on the ground plane.
pub fn box_of_corners(corners: &Corners) -> Box3 {
    let mean = |axis: usize| corners.iter().map(|corner| corner[axis]).sum::<f64>() / 8.0;
    let edges =
        |pairs: [[usize; 2]; 4]| pairs.map(|[from, to]| [0, 1, 2].map(|axis| corners[to][axis] - corners[from][axis]));
    let lengthwise = edges([[3, 0], [2, 1], [7, 4], [6, 5]]);
    let across = edges([[0, 1], [3, 2], [4, 5], [7, 6]]);
    let upright = edges([[0, 4], [1, 5], [2, 6], [3, 7]]);
    let size = |edge: &[f64; 3]| (edge[0] * edge[0] + edge[1] * edge[1] + edge[2] * edge[2]).sqrt();
    let length = |edges: &[[f64; 3]; 4]| edges.iter().map(size).sum::<f64>() / 4.0;
    let [ahead, left] = [0, 1].map(|axis| lengthwise.iter().map(|edge| edge[axis]).sum::<f64>());
    let [x, y, z] = [0, 1, 2].map(mean);
    box_of([
        x,
        y,
        z,
        length(&upright),
        length(&across),
        length(&lengthwise),
        libm::atan2(left, ahead),
    ])
}

/// Eight corners of four on the ground.
pub fn upright(corners: &[[f64; 2]; 4]) -> Corners {
    std::array::from_fn(|i| [corners[i % 4][0], corners[i % 4][1], if i < 4 { 0.0 } else { 1.0 }])
}

/// `map_from_frame` of a pose vector: x, y, z in metres, then roll, yaw, pitch in degrees, where a positive pitch lifts
/// the nose and a positive roll lowers the right side.
pub fn pose_of([x, y, z, roll, yaw, pitch]: [f64; 6]) -> Isometry3<f64> {
    let [(sr, cr), (sp, cp), (sy, cy)] =
        [roll, pitch, yaw].map(|degrees| (libm::sin(degrees.to_radians()), libm::cos(degrees.to_radians())));
    isometry([
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
        [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
        [sp, -cp * sr, cp * cr, z],
    ])
}

fn isometry([[a, b, c, x], [d, e, f, y], [g, h, i, z]]: [[f64; 4]; 3]) -> Isometry3<f64> {
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::new(a, b, c, d, e, f, g, h, i));
    Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// The transform of a 4x4 matrix, row-major.
pub fn transform_of(matrix: &[f64]) -> Result<Isometry3<f64>, String> {
    match matrix.as_chunks::<4>() {
        ([a, b, c, _], []) => Ok(isometry([*a, *b, *c])),
        _ => Err(format!("a matrix has {} numbers, not 16", matrix.len())),
    }
}

/// How a 4x4 matrix of metres moves the cells of a map, about its first cell: `cell` m to each.
pub fn moved(matrix: &[f64], cell: f64) -> Warp {
    Warp([0, 1].map(|row| [matrix[4 * row], matrix[4 * row + 1], matrix[4 * row + 3] / cell]))
}

/// Metres to a cell of the reference's warps: those of a pillar, times a rate.
pub fn cell_of(settings: &Value) -> Result<f64, String> {
    let number = |value: &Value| value.as_f64().ok_or("config of a warp: expected numbers");
    let side = match settings.get("discrete_ratio") {
        Some(ratio) => ratio,
        None => &settings["voxel_size"][0],
    };
    Ok(number(side)? * number(&settings["downsample_rate"])?)
}

/// How a 4x4 matrix of metres moves the cells of a map about a middle that lies half a cell off.
pub fn centered(matrix: &[f64], cell: f64, [rows, columns]: [usize; 2]) -> Warp {
    let middle = [columns as f64 / 2.0, rows as f64 / 2.0];
    let shift = |sign: f64| Warp([[1.0, 0.0, sign * middle[0]], [0.0, 1.0, sign * middle[1]]]);
    shift(1.0).after(&moved(matrix, cell)).after(&shift(-1.0))
}

/// Classes with their anchors, in the order of the heads. The second heading is 1.57, not π/2; weights depend on it.
fn classes() -> Vec<ClassAnchor> {
    let class = |name: &str, [length, width, height]: [f64; 3], z, [unmatched, matched]: [f64; 2]| ClassAnchor {
        name: name.into(),
        length,
        width,
        height,
        z,
        matched,
        unmatched,
    };
    vec![
        class("vehicle", [3.9, 1.6, 1.56], -1.78, [0.45, 0.6]),
        class("pedestrian", [0.8, 0.6, 1.73], -0.6, [0.35, 0.5]),
        class("truck", [8.0, 3.0, 3.0], -1.78, [0.45, 0.6]),
    ]
}

/// The grid of x min, y min, z min, x max, y max, z max.
pub fn grid_of([x0, y0, z0, x1, y1, z1]: [f64; 6]) -> Grid {
    Grid {
        x: [x0, x1],
        y: [y0, y1],
        z: [z0, z1],
        cell: CELL,
    }
}

/// A model with the reference's classes, pillars of so many channels and a backbone.
pub fn model_of(grid: Grid, channels: usize, backbone: Backbone) -> Result<Model, String> {
    let model = Model {
        name: "vector".into(),
        weights: None,
        encoder: None,
        compressor: None,
        sha256: Default::default(),
        frame: Frame::Lidar,
        lidar_height: None,
        precision: Precision::F32,
        rotations: vec![0.0, 1.57],
        matching: Matching::Hull,
        score_threshold: 0.2,
        arch: Default::default(),
        classes: classes(),
        grid,
        pillars: PillarSettings {
            channels,
            points: SLOTS,
            pillars: 640_000,
            empty_slots: true,
            intensity: true,
        },
        backbone,
        shrink: Vec::new(),
        refine: Vec::new(),
        activations: BTreeMap::new(),
    };
    model.validate().map_err(|error| error.to_string())?;
    Ok(model)
}

/// A backbone of one block that gives so many channels, for what does not look at the backbone.
pub fn any_backbone(channels: usize) -> Backbone {
    Backbone {
        layers: vec![0],
        strides: vec![STRIDE],
        channels: vec![1],
        up_strides: vec![1],
        up_channels: vec![channels],
    }
}

/// The anchors over a range, x min, y min, z min, x max, y max, z max.
pub fn anchors_of(range: [f64; 6]) -> Result<Anchors, String> {
    Ok(Anchors::of(&model_of(grid_of(range), 1, any_backbone(1))?))
}

/// The range around the origin that a map of anchors of so many rows and columns covers.
pub fn range_of([rows, columns]: [usize; 2]) -> [f64; 6] {
    let [y, x] = [rows, columns].map(|cells| (cells * STRIDE) as f64 * CELL / 2.0);
    [-x, -y, -15.0, x, y, 15.0]
}
