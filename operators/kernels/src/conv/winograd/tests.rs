use proptest::prelude::*;

use super::places::{MOST_LANES, PLACES, POINTS, SIDE};
use crate::conv::tests::{Case, UNTOUCHED, cells, layer, plain, written};
use crate::conv::{Bf16, Convolution, Isa, Kernel, Packed, Steps, U8};

const FINITE: usize = POINTS - 1;

fn point(index: usize) -> f64 {
    [0.0, 0.5f64.sqrt(), -0.5f64.sqrt(), 2f64.sqrt(), -2f64.sqrt()][index]
}

/// `G` of Toom and Cook.
fn of_weights(at: usize, tap: usize) -> f64 {
    if at == FINITE {
        return if tap == 2 { 1.0 } else { 0.0 };
    }
    let others = (0..FINITE).filter(|other| *other != at);
    point(at).powi(tap as i32) / others.map(|other| point(at) - point(other)).product::<f64>()
}

/// `Bᵀ`: the coefficients of the polynomial that vanishes at all finite points but one.
fn of_inputs(at: usize, power: usize) -> f64 {
    let mut coefficients = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    for zero in (0..FINITE).filter(|other| *other != at).map(point) {
        for power in (0..POINTS).rev() {
            let lower = if power > 0 { coefficients[power - 1] } else { 0.0 };
            coefficients[power] = lower - zero * coefficients[power];
        }
    }
    coefficients[power]
}

/// `Aᵀ`.
fn of_outputs(power: usize, at: usize) -> f64 {
    match at {
        FINITE => f64::from(u8::from(power == SIDE - 1)),
        _ => point(at).powi(power as i32),
    }
}

fn matrix<const R: usize, const C: usize>(of: fn(usize, usize) -> f64) -> [[f64; C]; R] {
    std::array::from_fn(|row| std::array::from_fn(|column| of(row, column)))
}

/// `|matrix| |numbers| |matrix|ᵀ` at a row and column.
fn size_at<const R: usize, const C: usize>(
    matrix: &[[f64; C]; R],
    numbers: impl Fn(usize, usize) -> f64,
    [row, column]: [usize; 2],
) -> f64 {
    let terms = (0..C * C).map(|index| {
        let (y, x) = (index / C, index % C);
        (matrix[row][y] * numbers(y, x) * matrix[column][x]).abs()
    });
    terms.sum()
}

/// The sums that lead to each output with all signs dropped, `[rows, columns, outputs]`.
fn sizes(layer: &Convolution, case: &Case, cells: &[f32]) -> Vec<f64> {
    let both = |index: usize, size: usize| [index / size, index % size];
    let of_weights: [[f64; 3]; POINTS] = matrix(of_weights);
    let of_inputs: [[f64; POINTS]; POINTS] = matrix(of_inputs);
    let of_outputs: [[f64; POINTS]; SIDE] = matrix(of_outputs);
    let weights: Vec<[f64; PLACES]> = (0..layer.outputs * layer.inputs)
        .map(|index| {
            let window = |y, x| f64::from(layer.weights[index * 9 + y * 3 + x]);
            std::array::from_fn(|place| size_at(&of_weights, window, both(place, POINTS)))
        })
        .collect();
    let mut sizes = vec![0.0; case.rows * case.columns * layer.outputs];
    for (top, left) in (0..case.rows)
        .step_by(SIDE)
        .flat_map(|top| (0..case.columns).step_by(SIDE).map(move |left| (top, left)))
    {
        let inputs: Vec<[f64; PLACES]> = (0..layer.inputs)
            .map(|input| {
                let cell = |y: usize, x: usize| match ((top + y).checked_sub(1), (left + x).checked_sub(1)) {
                    (Some(row), Some(column)) if row < case.rows && column < case.columns => {
                        f64::from(cells[(row * case.columns + column) * layer.inputs + input])
                    }
                    _ => 0.0,
                };
                std::array::from_fn(|place| size_at(&of_inputs, cell, both(place, POINTS)))
            })
            .collect();
        for output in 0..layer.outputs {
            let weights = &weights[output * layer.inputs..][..layer.inputs];
            let products: [f64; PLACES] =
                std::array::from_fn(|place| weights.iter().zip(&inputs).map(|(w, d)| w[place] * d[place]).sum());
            let product = |y: usize, x: usize| products[y * POINTS + x];
            for [y, x] in (0..SIDE * SIDE).map(|index| both(index, SIDE)) {
                let (row, column) = (top + y, left + x);
                if row < case.rows && column < case.columns {
                    sizes[(row * case.columns + column) * layer.outputs + output] =
                        size_at(&of_outputs, product, [y, x]) + f64::from(layer.bias[output].abs());
                }
            }
        }
    }
    sizes
}

fn isas() -> impl Iterator<Item = Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.is_available())
}

/// With AMX, bf16 is computed directly.
fn isas_of<E: Kernel<E>>() -> impl Iterator<Item = Isa> {
    isas().filter(|isa| E::winograd(*isa, MOST_LANES).is_some())
}

fn tiled<E: Kernel<E>>(layer: &Convolution, case: &Case, cells: &[f32], isa: Isa, threads: usize) -> Vec<f32> {
    let packed = Packed::<E>::with(layer, isa, Steps::ONE, true);
    assert_eq!(packed.side, SIDE);
    written(&packed, layer, case, cells, threads, Steps::ONE)
}

fn verify(case: &Case) {
    verify_maps::<f32>(case, f64::from(f32::EPSILON) / 2.0);
    verify_maps::<Bf16>(case, 2f64.powi(-8));
}

/// Compares with the plain loop, one number of threads with others, and what lies beside the outputs with what was there.
/// `unit`: what a number of a map loses at most when it is rounded.
fn verify_maps<E: Kernel<E>>(case: &Case, unit: f64) {
    let layer = layer(case);
    // Cells of very different size side by side: a tile's large ones decide how exact all of its outputs are.
    let columns = (0..case.rows * case.columns).flat_map(|cell| vec![cell % case.columns; case.inputs]);
    let cells: Vec<f32> = cells(case)
        .iter()
        .zip(columns)
        .map(|(number, column)| number * [1.0, 1.0, 1e3, 1.0, 1e-3, 1.0, 1.0][column % 7])
        .map(|number| E::from_f32(number).to_f32())
        .collect();
    let sizes = sizes(&layer, case, &cells);
    let exact: Vec<f64> = cells.iter().map(|cell| f64::from(*cell)).collect();
    // Roundings on the way of a number: of its weight, 2 x 4 before the sum over channels, that sum's, 2 x 5 behind it, and
    // of the bias.
    let roundings = (layer.inputs + 20) as f64;
    for isa in isas_of::<E>() {
        let found = tiled::<E>(&layer, case, &cells, isa, 1);
        for threads in [2, 3] {
            let again = tiled::<E>(&layer, case, &cells, isa, threads);
            let same = found.iter().zip(&again).all(|(a, b)| a.to_bits() == b.to_bits());
            assert!(same, "{isa}: bits of {threads} threads differ: {case:?}");
        }
        let channels = case.beside.0 + layer.outputs + case.beside.1;
        for (index, found) in found.into_iter().enumerate() {
            let (cell, channel) = (index / channels, index % channels);
            let output = channel
                .checked_sub(case.beside.0)
                .filter(|output| *output < layer.outputs);
            let (expected, size) = match output {
                Some(output) => (
                    plain(&layer, case, &exact, [cell / case.columns, cell % case.columns, output]),
                    sizes[cell * layer.outputs + output],
                ),
                None => (f64::from(UNTOUCHED), 0.0),
            };
            let lost = roundings * size * f64::from(f32::EPSILON) / 2.0;
            let (difference, bound) = (
                (f64::from(found) - expected).abs(),
                lost + (expected.abs() + lost) * unit,
            );
            assert!(
                difference <= bound,
                "{isa} cell {cell} channel {channel}: {expected}, found {found}, {difference} > {bound}: {case:?}"
            );
        }
    }
}

fn case([rows, columns]: [usize; 2], [inputs, outputs]: [usize; 2]) -> Case {
    Case {
        rows,
        columns,
        inputs,
        outputs,
        shape: (3, 1, false),
        relu: false,
        beside: (0, 0),
        seed: 17,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    #[cfg_attr(miri, ignore = "millions of terms; `nan_is_not_hidden` runs all that is unsafe")]
    fn tiles_agree_with_a_plain_loop(
        size in [1usize..11, 1usize..13],
        registers in [1usize..4, 1usize..4],
        relu in any::<bool>(),
        beside in (0usize..4, 0usize..4),
        seed in any::<u64>(),
    ) {
        let case = case(size, registers.map(|registers| registers * MOST_LANES));
        verify(&Case { relu, beside, seed, ..case });
    }
}

#[test]
fn tiles_agree_with_a_plain_loop_at_the_edges() {
    // Every remainder of a tile, fewer rows than threads, several blocks of tiles and of outputs.
    let mut all: Vec<_> = (1..=5).map(|side| case([side, 6 - side], [16, 16])).collect();
    all.extend([
        case([1, 130], [16, 32]),
        case([26, 17], [32, 16]),
        case([5, 7], [16, 144]),
    ]);
    all.iter().for_each(verify);
}

#[test]
#[cfg_attr(miri, ignore = "millions of terms")]
fn tiles_lose_little_more_than_direct_sums() {
    let case = case([24, 24], [64, 64]);
    let (layer, cells) = (layer(&case), cells(&case));
    let exact: Vec<f64> = cells.iter().map(|cell| f64::from(*cell)).collect();
    let root_mean_square = |found: Vec<f32>| {
        let squares = found.iter().enumerate().map(|(index, found)| {
            let (cell, output) = (index / layer.outputs, index % layer.outputs);
            let at = [cell / case.columns, cell % case.columns, output];
            (f64::from(*found) - plain(&layer, &case, &exact, at)).powi(2)
        });
        (squares.sum::<f64>() / found.len() as f64).sqrt()
    };
    for isa in isas() {
        let direct = Packed::<f32>::with(&layer, isa, Steps::ONE, false);
        let direct = root_mean_square(written(&direct, &layer, &case, &cells, 2, Steps::ONE));
        let tiled = root_mean_square(tiled::<f32>(&layer, &case, &cells, isa, 2));
        assert!(tiled < 3.0 * direct, "{isa}: {tiled}, directly {direct}");
    }
}

#[test]
fn nan_is_not_hidden() {
    let case = Case {
        relu: true,
        ..case([9, 9], [16, 16])
    };
    let (layer, mut cells) = (layer(&case), cells(&case));
    let (row, column) = (4, 3);
    cells[(row * 9 + column) * 16 + 5] = f32::NAN;
    let of_halves = isas_of::<Bf16>().map(|isa| (isa, tiled::<Bf16>(&layer, &case, &cells, isa, 2)));
    for (isa, found) in isas()
        .map(|isa| (isa, tiled::<f32>(&layer, &case, &cells, isa, 2)))
        .chain(of_halves)
    {
        for (y, x) in (row - 1..=row + 1).flat_map(|y| (column - 1..=column + 1).map(move |x| (y, x))) {
            assert!(
                found[(y * 9 + x) * 16..][..16].iter().all(|output| output.is_nan()),
                "{isa}"
            );
        }
        // Cells of tiles that do not read it.
        assert!(found[8 * 16..9 * 16].iter().all(|output| output.is_finite()), "{isa}");
    }
}

#[test]
fn tiles_are_for_windows_of_3x3_side_by_side() {
    let of = |shape, inputs, outputs| {
        layer(&Case {
            shape,
            ..case([1, 1], [inputs, outputs])
        })
    };
    let side = |layer: &Convolution| Packed::<f32>::new(layer, Isa::Portable, Steps::ONE).side;
    assert_eq!(side(&of((3, 1, false), 48, 16)), SIDE);
    for direct in [
        of((3, 2, false), 16, 16),
        of((1, 1, false), 16, 16),
        of((3, 3, true), 16, 16),
        of((3, 1, false), 24, 16),
        of((3, 1, false), 16, 8),
    ] {
        assert_eq!(side(&direct), 1);
    }
    let bytes = Packed::<U8>::new(&of((3, 1, false), 16, 16), Isa::Portable, Steps::ONE);
    assert_eq!(bytes.side, 1);
}
