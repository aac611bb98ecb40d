//! Each layer against plain loops, and its gradients against differences of its values.

use std::sync::Arc;

use candle_core::{CustomOp2, CustomOp3, Device, Result, Tensor};
use realo_methods::detect::pillars::{Pillariser, Points};
use realo_nn::model::{Grid, PillarSettings};

use super::*;

/// Numbers in [-1, 1) without a pattern.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    fn tensor(&mut self, shape: &[usize]) -> Tensor {
        let data: Vec<f32> = (0..shape.iter().product()).map(|_| self.next()).collect();
        Tensor::from_vec(data, shape, &Device::Cpu).unwrap()
    }

    /// A map with its border.
    fn map(&mut self, map: MapShape) -> Tensor {
        let data: Vec<f32> = plain_map(&map, |_, _, _, _| self.next());
        Tensor::from_vec(data, map.dims(), &Device::Cpu).unwrap()
    }
}

fn plain_map(map: &MapShape, mut value: impl FnMut(usize, usize, usize, usize) -> f32) -> Vec<f32> {
    let mut data = vec![0.0; map.len()];
    for b in 0..map.batch {
        for y in 0..map.rows {
            for x in 0..map.columns {
                for c in 0..map.channels {
                    data[map.at(b, y as isize, x as isize) + c] = value(b, y, x, c);
                }
            }
        }
    }
    data
}

fn conv(stride: usize) -> Conv {
    Conv {
        stride,
        arithmetic: Arithmetic::F32,
    }
}

fn pointwise(order: WeightOrder) -> Pointwise {
    Pointwise {
        order,
        arithmetic: Arithmetic::F32,
    }
}

fn vec(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

fn assert_close(found: &[f32], expected: &[f32], tolerance: f32, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (i, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!(
            (a - b).abs() <= tolerance * (1.0 + b.abs()),
            "{what} at {i}: {a}, expected {b}"
        );
    }
}

/// Gradients of `sum(out * weights)` against central differences along a few directions.
fn check_gradients(
    inputs: &[Tensor],
    inner: &[Option<MapShape>],
    layer: impl Fn(&[Tensor]) -> Result<Tensor>,
    gradients: impl Fn(&[Tensor], &Tensor, &Tensor) -> Vec<Tensor>,
    step: f32,
) {
    let mut noise = Noise(99);
    let out = layer(inputs).unwrap();
    let map = MapShape::of(out.shape()).unwrap();
    let weights = noise.map(map);
    let found = gradients(inputs, &out, &weights);
    for (which, gradient) in found.iter().enumerate() {
        assert_eq!(gradient.dims(), inputs[which].dims());
        for direction in 0..6 {
            let along = match inner[which] {
                Some(map) => noise.map(map),
                None => noise.tensor(inputs[which].dims()),
            };
            let at = |sign: f32| {
                let mut moved = inputs.to_vec();
                moved[which] = (&inputs[which] + along.affine(f64::from(sign * step), 0.0).unwrap()).unwrap();
                dot(&vec(&layer(&moved).unwrap()), &vec(&weights))
            };
            let difference = (at(1.0) - at(-1.0)) / f64::from(2.0 * step);
            let expected = dot(&vec(gradient), &vec(&along));
            let size = f64::from(gradient.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap()).sqrt();
            assert!(
                (difference - expected).abs() < 0.01 * size.max(1.0),
                "input {which}, direction {direction}: differences give {difference}, the gradient {expected} (norm {size})"
            );
        }
    }
}

const SIZES: [(usize, usize, usize, usize, usize); 5] = [
    (1, 1, 1, 1, 1),
    (2, 5, 7, 3, 5),
    (1, 4, 6, 16, 8),
    (2, 6, 5, 8, 32),
    (1, 23, 40, 4, 6),
];

#[test]
fn convolution_is_the_plain_loop() {
    for stride in [1, 2] {
        for (batch, rows, columns, ins, outs) in SIZES {
            let mut noise = Noise(7 + rows as u64);
            let map = MapShape {
                batch,
                rows,
                columns,
                channels: ins,
            };
            let (x, w) = (noise.map(map), noise.tensor(&[outs, ins, 3, 3]));
            let out = x.apply_op2_no_bwd(&w, &conv(stride)).unwrap();
            let (xs, ws) = (vec(&x), vec(&w));
            let to = MapShape {
                batch,
                rows: rows.div_ceil(stride),
                columns: columns.div_ceil(stride),
                channels: outs,
            };
            let expected = plain_map(&to, |b, y, x, o| {
                let mut sum = 0.0;
                for (ky, kx, i) in (0..9 * ins).map(|k| (k / 3 % 3, k % 3, k / 9)) {
                    let (row, column) = ((stride * y + ky) as isize - 1, (stride * x + kx) as isize - 1);
                    // The padded map holds the border, so that no test is needed here; beyond it nothing is read.
                    sum += xs[map.at(b, row, column) + i] * ws[(o * ins + i) * 9 + ky * 3 + kx];
                }
                sum
            });
            assert_eq!(out.shape(), &to.dims());
            assert_close(
                &vec(&out),
                &expected,
                1e-5,
                &format!("stride {stride}, {map:?} to {outs}"),
            );
        }
    }
}

#[test]
fn gradients_of_the_convolution_are_its_slopes() {
    for stride in [1, 2] {
        for (batch, rows, columns, ins, outs) in SIZES {
            let mut noise = Noise(70 + columns as u64);
            let map = MapShape {
                batch,
                rows,
                columns,
                channels: ins,
            };
            let inputs = [noise.map(map), noise.tensor(&[outs, ins, 3, 3])];
            let op = conv(stride);
            check_gradients(
                &inputs,
                &[Some(map), None],
                |i| i[0].apply_op2_no_bwd(&i[1], &op),
                |i, out, grad| {
                    let (dx, dw) = op.bwd(&i[0], &i[1], out, grad).unwrap();
                    assert_border_is_zero(&dx.clone().unwrap());
                    vec![dx.unwrap(), dw.unwrap()]
                },
                0.05,
            );
        }
    }
}

fn assert_border_is_zero(tensor: &Tensor) {
    let map = MapShape::of(tensor.shape()).unwrap();
    let data = vec(tensor);
    let inside = plain_map(&map, |b, y, x, c| data[map.at(b, y as isize, x as isize) + c]);
    assert_eq!(data, inside);
}

#[test]
fn transposed_convolution_is_the_plain_loop_with_its_slopes() {
    for factor in [1, 2, 4] {
        for (batch, rows, columns, ins, outs) in SIZES {
            let mut noise = Noise(17 + factor as u64);
            let map = MapShape {
                batch,
                rows,
                columns,
                channels: ins,
            };
            let inputs = [noise.map(map), noise.tensor(&[ins, outs, factor, factor])];
            let op = pointwise(WeightOrder::Transposed);
            let out = inputs[0].apply_op2_no_bwd(&inputs[1], &op).unwrap();
            let (xs, ws) = (vec(&inputs[0]), vec(&inputs[1]));
            let to = MapShape {
                batch,
                rows: rows * factor,
                columns: columns * factor,
                channels: outs,
            };
            let expected = plain_map(&to, |b, y, x, o| {
                let from = map.at(b, (y / factor) as isize, (x / factor) as isize);
                let square = y % factor * factor + x % factor;
                (0..ins)
                    .map(|i| xs[from + i] * ws[(i * outs + o) * factor * factor + square])
                    .sum()
            });
            assert_close(
                &vec(&out),
                &expected,
                1e-5,
                &format!("factor {factor}, {map:?} to {outs}"),
            );
            check_gradients(
                &inputs,
                &[Some(map), None],
                |i| i[0].apply_op2_no_bwd(&i[1], &op),
                |i, out, grad| {
                    let (dx, dw) = op.bwd(&i[0], &i[1], out, grad).unwrap();
                    vec![dx.unwrap(), dw.unwrap()]
                },
                0.05,
            );
        }
    }
}

#[test]
fn bf16_gives_what_f32_gives_but_for_rounding() {
    if !Arithmetic::Bf16.is_available() {
        return;
    }
    /// Both layers' result and gradients, in both arithmetics.
    fn compare<Op: CustomOp2>([f32, bf16]: [Op; 2], weights: &[usize], what: &str) {
        let mut noise = Noise(41);
        let map = MapShape {
            batch: 2,
            rows: 11,
            columns: 37,
            channels: 48,
        };
        let (x, w) = (noise.map(map), noise.tensor(weights));
        let exact = x.apply_op2_no_bwd(&w, &f32).unwrap();
        let rounded = x.apply_op2_no_bwd(&w, &bf16).unwrap();
        let grad = noise.map(MapShape::of(exact.shape()).unwrap());
        let gradients = |op: &Op, out| {
            let (dx, dw) = op.bwd(&x, &w, out, &grad).unwrap();
            [dx.unwrap(), dw.unwrap()]
        };
        let [dx, dw] = gradients(&f32, &exact);
        let [rounded_dx, rounded_dw] = gradients(&bf16, &rounded);
        for (exact, rounded) in [(exact, rounded), (dx, rounded_dx), (dw, rounded_dw)] {
            let (exact, rounded) = (vec(&exact), vec(&rounded));
            let off: Vec<f32> = exact.iter().zip(&rounded).map(|(a, b)| a - b).collect();
            let share = (dot(&off, &off) / dot(&exact, &exact)).sqrt();
            // Of two factors each is off by 2^-9 at most.
            assert!((1e-5..4e-3).contains(&share), "{what}: off by {share}");
        }
    }
    let both = [Arithmetic::F32, Arithmetic::Bf16];
    for stride in [1, 2] {
        let ops = both.map(|arithmetic| Conv { stride, arithmetic });
        compare(ops, &[70, 48, 3, 3], &format!("3x3, stride {stride}"));
    }
    for (order, weights) in [
        (WeightOrder::Plain, [18, 48, 1, 1]),
        (WeightOrder::Transposed, [48, 20, 2, 2]),
    ] {
        let ops = both.map(|arithmetic| Pointwise { order, arithmetic });
        compare(ops, &weights, &format!("{order:?}"));
    }
}

#[test]
fn a_plain_pointwise_layer_is_the_transposed_one_with_its_weights_turned() {
    let mut noise = Noise(5);
    let map = MapShape {
        batch: 2,
        rows: 3,
        columns: 4,
        channels: 6,
    };
    let (x, w) = (noise.map(map), noise.tensor(&[5, 6, 1, 1]));
    let turned = w.transpose(0, 1).unwrap().contiguous().unwrap();
    let (plain, other) = (pointwise(WeightOrder::Plain), pointwise(WeightOrder::Transposed));
    let out = x.apply_op2_no_bwd(&w, &plain).unwrap();
    assert_eq!(vec(&out), vec(&x.apply_op2_no_bwd(&turned, &other).unwrap()));
    let grad = noise.map(map.with_channels(5));
    let (dx, dw) = plain.bwd(&x, &w, &out, &grad).unwrap();
    let (dx2, dw2) = other.bwd(&x, &turned, &out, &grad).unwrap();
    assert_eq!(vec(&dx.unwrap()), vec(&dx2.unwrap()));
    assert_eq!(
        vec(&dw.unwrap()),
        vec(&dw2.unwrap().transpose(0, 1).unwrap().contiguous().unwrap())
    );
}

#[test]
fn bias_is_added_inside_the_border_with_its_slopes() {
    for relu in [false, true] {
        let mut noise = Noise(31);
        let map = MapShape {
            batch: 2,
            rows: 4,
            columns: 5,
            channels: 3,
        };
        let inputs = [noise.map(map), noise.tensor(&[3])];
        let op = Bias { relu };
        let out = inputs[0].apply_op2_no_bwd(&inputs[1], &op).unwrap();
        let (xs, bs) = (vec(&inputs[0]), vec(&inputs[1]));
        let expected = plain_map(&map, |b, y, x, c| {
            let sum = xs[map.at(b, y as isize, x as isize) + c] + bs[c];
            if relu { sum.max(0.0) } else { sum }
        });
        assert_eq!(vec(&out), expected);
        check_gradients(
            &inputs,
            &[Some(map), None],
            |i| i[0].apply_op2_no_bwd(&i[1], &op),
            |i, out, grad| {
                let (dx, db) = op.bwd(&i[0], &i[1], out, grad).unwrap();
                vec![dx.unwrap(), db.unwrap()]
            },
            1e-3,
        );
    }
}

#[test]
fn batch_norm_is_its_definition_with_its_slopes() {
    let mut noise = Noise(3);
    let map = MapShape {
        batch: 2,
        rows: 6,
        columns: 5,
        channels: 4,
    };
    let inputs = [noise.map(map), noise.tensor(&[4]), noise.tensor(&[4])];
    let statistics = Statistics::batch();
    let out = inputs[0]
        .apply_op3_no_bwd(
            &inputs[1],
            &inputs[2],
            &Norm {
                statistics: statistics.clone(),
            },
        )
        .unwrap();
    let (xs, ws, bs) = (vec(&inputs[0]), vec(&inputs[1]), vec(&inputs[2]));
    let column = |c: usize| -> Vec<f64> {
        let at = |i: usize| map.at(i / 30, (i / 5 % 6) as isize, (i % 5) as isize) + c;
        (0..60).map(|i| f64::from(xs[at(i)])).collect()
    };
    let moments: Vec<(f64, f64)> = (0..4)
        .map(|c| {
            let values = column(c);
            let mean = values.iter().sum::<f64>() / 60.0;
            (mean, values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 60.0)
        })
        .collect();
    let expected = plain_map(&map, |b, y, x, c| {
        let (mean, variance) = moments[c];
        let value = f64::from(xs[map.at(b, y as isize, x as isize) + c]);
        ((value - mean) / (variance + 1e-3).sqrt() * f64::from(ws[c]) + f64::from(bs[c])).max(0.0) as f32
    });
    assert_close(&vec(&out), &expected, 1e-5, "batch norm");
    let found = statistics.moments().unwrap();
    assert_close(
        &found.mean,
        &moments.iter().map(|m| m.0 as f32).collect::<Vec<_>>(),
        1e-6,
        "mean",
    );
    assert_close(
        &found.variance,
        &moments.iter().map(|m| m.1 as f32).collect::<Vec<_>>(),
        1e-6,
        "variance",
    );
    for fixed in [false, true] {
        let new = || match fixed {
            true => Statistics::Running(found.clone()),
            false => Statistics::batch(),
        };
        check_gradients(
            &inputs,
            &[Some(map), None, None],
            |i| i[0].apply_op3_no_bwd(&i[1], &i[2], &Norm { statistics: new() }),
            |i, _, grad| {
                let op = Norm { statistics: new() };
                let out = i[0].apply_op3_no_bwd(&i[1], &i[2], &op).unwrap();
                let (dx, dw, db) = op.bwd(&i[0], &i[1], &i[2], &out, grad).unwrap();
                vec![dx.unwrap(), dw.unwrap(), db.unwrap()]
            },
            1e-3,
        );
    }
}

fn pillars(empty_slots: bool) -> Arc<PillarBatch> {
    let grid = Grid {
        x: [-2.0, 2.0],
        y: [-1.0, 1.0],
        z: [-1.0, 3.0],
        cell: 0.5,
    };
    let settings = PillarSettings {
        channels: 18,
        points: 4,
        pillars: 100,
        empty_slots,
        intensity: true,
    };
    let mut noise = Noise(12);
    let frames = (0..2)
        .map(|_| {
            let mut column = |by: f32| -> Vec<f32> { (0..60).map(|_| by * noise.next()).collect() };
            let (x, y, z, i) = (column(2.0), column(1.0), column(1.0), column(1.0));
            let points = Points {
                x: &x,
                y: &y,
                z: &z,
                intensity: Some(&i),
            };
            let mut pillariser = Pillariser::new(&grid, settings.points, settings.pillars);
            PillarFrame::new(&grid, pillariser.run(&points), &settings)
        })
        .collect();
    Arc::new(PillarBatch::new(&grid, &settings, frames))
}

#[test]
fn the_pillar_net_is_its_definition_with_its_slopes() {
    for empty_slots in [false, true] {
        let batch = pillars(empty_slots);
        let mut noise = Noise(8);
        let inputs = [noise.tensor(&[18, 10]), noise.tensor(&[18]), noise.tensor(&[18])];
        let run = |i: &[Tensor]| {
            let op = PillarLayer::new(batch.clone(), Statistics::batch());
            i[0].apply_op3_no_bwd(&i[1], &i[2], &op)
        };
        let expected = batch.plain(&vec(&inputs[0]), &vec(&inputs[1]), &vec(&inputs[2]));
        assert_close(&vec(&run(&inputs).unwrap()), &expected, 1e-4, "pillar net");
        check_gradients(
            &inputs,
            &[None; 3],
            run,
            |i, _, grad| {
                let op = PillarLayer::new(batch.clone(), Statistics::batch());
                let out = i[0].apply_op3_no_bwd(&i[1], &i[2], &op).unwrap();
                let (dl, dw, db) = op.bwd(&i[0], &i[1], &i[2], &out, grad).unwrap();
                vec![dl.unwrap(), dw.unwrap(), db.unwrap()]
            },
            1e-3,
        );
    }
}

#[test]
fn bits_do_not_depend_on_the_number_of_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut noise = Noise(4);
            let map = MapShape {
                batch: 2,
                rows: 40,
                columns: 64,
                channels: 8,
            };
            let (x, w) = (noise.map(map), noise.tensor(&[8, 8, 3, 3]));
            let op = conv(1);
            let y = x.apply_op2_no_bwd(&w, &op).unwrap();
            let norm = Norm {
                statistics: Statistics::batch(),
            };
            let (a, b) = (noise.tensor(&[8]), noise.tensor(&[8]));
            let z = y.apply_op3_no_bwd(&a, &b, &norm).unwrap();
            let (dy, da, _) = norm.bwd(&y, &a, &b, &z, &x).unwrap();
            let (dx, dw) = op.bwd(&x, &w, &y, &dy.unwrap()).unwrap();
            [z, da.unwrap(), dx.unwrap(), dw.unwrap()].map(|t| vec(&t).iter().map(|v| v.to_bits()).collect::<Vec<_>>())
        })
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(3));
}
