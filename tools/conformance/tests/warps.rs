//! Vectors of warps and of pose noise in other sizes than the reference's, made here from the definitions in double precision.

mod common;

use common::{Made, noise, not_passed};
use realo_conformance::{Status, exit_code};
use serde_json::json;

/// A 4x4 matrix that turns by an angle and shifts.
fn matrix(angle: f64, [x, y]: [f64; 2]) -> Vec<f64> {
    let (sin, cos) = libm::sincos(angle);
    [
        [cos, -sin, 0.0, x],
        [sin, cos, 0.0, y],
        [0.0, 0.0, 1.0, 0.3],
        [0.0, 0.0, 0.0, 1.0],
    ]
    .concat()
}

/// Where a cell of the ego's is in the map that a matrix moves, about `middle`, with cells of 1 m.
fn source(matrix: &[f64], middle: [f64; 2], [column, row]: [usize; 2]) -> [f64; 2] {
    let [x, y] = [
        column as f64 - middle[0] - matrix[3],
        row as f64 - middle[1] - matrix[7],
    ];
    // A turn's inverse is its transpose.
    [
        matrix[0] * x + matrix[4] * y + middle[0],
        matrix[1] * x + matrix[5] * y + middle[1],
    ]
}

const CELL: [(&str, f64); 2] = [("discrete_ratio", 0.5), ("downsample_rate", 2.0)];
const ROWS: usize = 5;
const COLUMNS: usize = 9;
const MIDDLE: [f64; 2] = [COLUMNS as f64 / 2.0, ROWS as f64 / 2.0];

fn moves() -> [Vec<f64>; 3] {
    [
        matrix(0.0, [0.0, 0.0]),
        matrix(0.3, [1.23, -0.71]),
        matrix(-1.1, [-2.3, 0.37]),
    ]
}

/// `at(column, row)` of a map, moved: bilinear, zeros outside.
fn moved(matrix: &[f64], middle: [f64; 2], at: impl Fn(usize, usize) -> f64) -> Vec<f64> {
    let value = |index: usize| {
        let [x, y] = source(matrix, middle, [index % COLUMNS, index / COLUMNS]);
        let mut sum = 0.0;
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let weight = |distance: f64| (1.0 - distance.abs()).max(0.0);
                sum += weight(x - column as f64) * weight(y - row as f64) * at(column, row);
            }
        }
        sum
    };
    (0..ROWS * COLUMNS).map(value).collect()
}

fn nearest(matrix: &[f64], index: usize) -> Option<[usize; 2]> {
    let at = source(matrix, MIDDLE, [index % COLUMNS, index / COLUMNS]).map(f64::round);
    let inside = (0.0..COLUMNS as f64).contains(&at[0]) && (0.0..ROWS as f64).contains(&at[1]);
    inside.then(|| at.map(|index| index as usize))
}

fn warps(made: &mut Made) {
    let (cells, channels) = (ROWS * COLUMNS, 2);
    let x = noise(1, 3 * channels * cells);
    let plane = |map: usize, channel: usize| &x[(map * channels + channel) * cells..][..cells];
    let planes = || (0..3).flat_map(|map| (0..channels).map(move |channel| (map, channel)));
    let bilinear = |middle: [f64; 2]| -> Vec<f64> {
        let of = |(map, channel): (usize, usize)| {
            moved(moves()[map].as_slice(), middle, |column, row| {
                plane(map, channel)[row * COLUMNS + column]
            })
        };
        planes().flat_map(of).collect()
    };
    let near = planes().flat_map(|(map, channel): (usize, usize)| {
        let value = move |index| {
            nearest(moves()[map].as_slice(), index).map_or(0.0, |[c, r]| plane(map, channel)[r * COLUMNS + c])
        };
        (0..cells).map(value)
    });
    let region = (0..3)
        .flat_map(|map| (0..cells).map(move |index| f64::from(nearest(moves()[map].as_slice(), index).is_some())));
    let shape = vec![3, channels, ROWS, COLUMNS];
    let tensors = [
        ("in.matrices", vec![1, 3, 4, 4], moves().concat()),
        ("in.x", shape.clone(), x.clone()),
        ("out.warp_bilinear", shape.clone(), bilinear(MIDDLE)),
        ("out.warp_bilinear_uncentered", shape.clone(), bilinear([0.0; 2])),
        ("out.warp_nearest", shape, near.collect()),
        ("out.roi_mask", vec![1, 3, 1, ROWS, COLUMNS], region.collect()),
    ];
    made.tensors(
        "w.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
}

fn regions(made: &mut Made) {
    let there = [1.0, 1.0, 0.0, 1.0, 0.0, 1.0];
    let cells = (0..2).flat_map(|sample| (0..ROWS * COLUMNS).map(move |cell| (sample, cell)));
    let mask = cells.flat_map(|(sample, cell)| {
        [0, 1, 2].map(|agent| there[3 * sample + agent] * f64::from(nearest(moves()[agent].as_slice(), cell).is_some()))
    });
    let tensors = [
        ("in.agent_mask", vec![2, 3], there.to_vec()),
        (
            "in.matrices",
            vec![2, 3, 4, 4],
            [moves().concat(), moves().concat()].concat(),
        ),
        ("out.mask_bhw1l", vec![2, ROWS, COLUMNS, 1, 3], mask.collect()),
    ];
    made.tensors(
        "r.safetensors",
        0.0,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
}

fn corrected(made: &mut Made) {
    let (cells, channels) = (ROWS * COLUMNS, 3);
    let x = noise(2, 3 * cells * channels);
    let mut y = x.clone();
    for agent in 1..3 {
        for channel in 0..channels {
            let at = |column, row| x[(agent * cells + row * COLUMNS + column) * channels + channel];
            let found = moved(moves()[agent].as_slice(), MIDDLE, at);
            found
                .iter()
                .enumerate()
                .for_each(|(cell, value)| y[(agent * cells + cell) * channels + channel] = *value);
        }
    }
    let shape = vec![1, 3, ROWS, COLUMNS, channels];
    // The first matrix is not the identity: the ego's map stays all the same.
    let matrices = [matrix(0.5, [1.0, 1.0]), moves()[1].clone(), moves()[2].clone()].concat();
    let tensors = [
        ("in.x_blhwc", shape.clone(), x),
        ("in.matrices", vec![1, 3, 4, 4], matrices),
        ("out.y_blhwc", shape, y),
    ];
    made.tensors(
        "c.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &tensors,
    );
}

/// By `numpy.random.seed(0)` and six of `numpy.random.standard_normal`; with a delay of 2.5 frames.
fn pose_noise(made: &mut Made) {
    let draws = [
        1.764052345967664,
        0.4001572083672233,
        0.9787379841057392,
        2.240893199201458,
        1.8675579901499675,
        -0.977277879876411,
    ];
    let [a, b, c, roll, yaw, pitch] = draws.map(|draw| draw * 0.3);
    let noisy = [
        -4.0 + a,
        2.0 + b,
        c,
        1.0,
        170.0 + yaw + if made.wrong { 0.01 } else { 0.0 },
        3.0,
    ];
    let case = json!({"seed": 0, "xyz_std": 0.3, "ryp_std": 0.3, "pose": [-4.0, 2.0, 0.0, 1.0, 170.0, 3.0],
        "noisy_pose": noisy, "xyz_draw": [a, b, c], "ryp_draw": [roll, yaw, pitch]});
    let delay = json!({"overhead_ms": 250, "delay_frames": 2, "ego": 0});
    let document = json!({"localisation": [case], "delay_sim": [delay]});
    made.contents.insert("n.json".into(), document.to_string().into_bytes());
    let keys = ["delay_sim", "localisation"];
    made.files
        .push(json!({"file": "n.json", "tolerance": 1e-12, "config": {}, "keys": keys}));
}

fn all(wrong: bool) -> Made {
    let mut made = Made {
        wrong,
        ..Made::default()
    };
    let makers = [warps, regions, corrected, pose_noise];
    makers.iter().for_each(|make| make(&mut made));
    made
}

#[test]
fn other_sizes_pass() {
    let results = all(false).run();
    assert_eq!(results.len(), 4);
    assert_eq!(exit_code(&results), 0, "{}", not_passed(&results).join("\n"));
}

#[test]
fn a_wrong_number_fails_every_one() {
    for result in all(true).run() {
        assert!(matches!(result.status, Status::Failed(_)), "{result}");
    }
}

/// Vectors whose shapes do not fit each other are failures with the tensor's name.
#[test]
fn shapes_that_do_not_fit_fail_by_name() {
    let mut made = Made::default();
    let x = ("in.x_blhwc", vec![1, 2, 4, 4, 3], noise(1, 96));
    let y = ("out.y_blhwc", vec![1, 2, 4, 4, 3], noise(1, 96));
    let few = ("in.matrices", vec![1, 1, 4, 4], moves()[0].clone());
    made.tensors(
        "few.safetensors",
        1e-6,
        json!(std::collections::BTreeMap::from(CELL)),
        &[x.clone(), y.clone(), few],
    );
    let flat = ("in.x_blhwc", vec![1, 2, 0, 4, 3], vec![]);
    let matrices = ("in.matrices", vec![1, 2, 4, 4], moves()[..2].concat());
    made.tensors(
        "none.safetensors",
        1e-6,
        json!({"discrete_ratio": 1, "downsample_rate": 1}),
        &[flat, y.clone(), matrices],
    );
    let mask = ("in.mask_bhw1l", vec![1, 4, 4, 1, 1], vec![1.0; 16]);
    let prior = ("in.prior_blhw3", vec![1, 2, 4, 4, 3], vec![0.0; 96]);
    let att = ("param.relation_att", vec![4, 1, 3, 3], noise(1, 36));
    made.tensors(
        "mask.safetensors",
        1e-6,
        json!({"heads": 1, "dim_head": 3}),
        &[x, y, mask, prior, att],
    );
    let results = made.run();
    for (result, named) in results.iter().zip(["`in.matrices`", "`in.x_blhwc`", "param."]) {
        let Status::Failed(reason) = &result.status else {
            panic!("{result}");
        };
        assert!(reason.contains(named), "{result}");
    }
}
