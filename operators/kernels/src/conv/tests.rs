//! Every path that this CPU has, against a plain loop in f64; [`winograd`] has tests of its own.

use proptest::prelude::*;

use super::*;
use realo_nn::filler::Numbers;

#[derive(Clone, Debug)]
pub(super) struct Case {
    pub rows: usize,
    pub columns: usize,
    pub inputs: usize,
    pub outputs: usize,
    /// (kernel, stride, transposed).
    pub shape: (usize, usize, bool),
    pub relu: bool,
    /// Channels of the output map before and after those written.
    pub beside: (usize, usize),
    pub seed: u64,
}

fn cases() -> impl Strategy<Value = Case> {
    let shapes = [
        (3, 1, false),
        (3, 2, false),
        (1, 1, false),
        (1, 2, false),
        (1, 1, true),
        (2, 2, true),
        (3, 3, true),
        (4, 4, true),
    ];
    (
        (1usize..11, 1usize..30),
        (1usize..20, 1usize..131),
        prop::sample::select(shapes.to_vec()),
        any::<bool>(),
        (0usize..4, 0usize..4),
        any::<u64>(),
    )
        .prop_map(|((rows, columns), (inputs, outputs), shape, relu, beside, seed)| Case {
            rows,
            columns,
            inputs,
            outputs,
            shape,
            relu,
            beside,
            seed,
        })
}

pub(super) fn layer(case: &Case) -> Convolution {
    let mut numbers = Numbers::new(case.seed);
    let (kernel, stride, transposed) = case.shape;
    Convolution {
        inputs: case.inputs,
        outputs: case.outputs,
        kernel,
        stride,
        transposed,
        relu: case.relu,
        weights: numbers.list(case.inputs * case.outputs * kernel * kernel),
        bias: numbers.list(case.outputs),
    }
}

pub(super) fn cells(case: &Case) -> Vec<f32> {
    Numbers::new(!case.seed).list(case.rows * case.columns * case.inputs)
}

/// One output by the definition.
pub(super) fn plain(layer: &Convolution, case: &Case, cells: &[f64], at: [usize; 3]) -> f64 {
    let [row, column, output] = at;
    let mut sum = f64::from(layer.bias[output]);
    for tap in 0..layer.kernel * layer.kernel {
        let (y, x) = (tap / layer.kernel, tap % layer.kernel);
        let (from_row, from_column) = if layer.transposed {
            if row % layer.stride != y || column % layer.stride != x {
                continue;
            }
            (row / layer.stride, column / layer.stride)
        } else {
            let pad = layer.kernel / 2;
            let (Some(row), Some(column)) = (
                (row * layer.stride + y).checked_sub(pad),
                (column * layer.stride + x).checked_sub(pad),
            ) else {
                continue;
            };
            (row, column)
        };
        if from_row >= case.rows || from_column >= case.columns {
            continue;
        }
        for input in 0..layer.inputs {
            let cell = cells[(from_row * case.columns + from_column) * layer.inputs + input];
            sum += cell * f64::from(layer.weight(output, input, y, x));
        }
    }
    if layer.relu { sum.max(0.0) } else { sum }
}

pub(super) const UNTOUCHED: f32 = 7.25;

fn run<E: Kernel<O>, O: Element>(layer: &Convolution, case: &Case, isa: Isa, threads: usize) -> Vec<f32> {
    run_in_steps::<E, O>(layer, case, isa, threads, Steps::ONE)
}

fn run_in_steps<E: Kernel<O>, O: Element>(
    layer: &Convolution,
    case: &Case,
    isa: Isa,
    threads: usize,
    steps: Steps,
) -> Vec<f32> {
    let packed = Packed::<E, O>::with(layer, isa, steps, false);
    written(&packed, layer, case, &cells(case), threads, steps)
}

/// What a layer makes of cells, the channels beside its own included.
pub(super) fn written<E: Kernel<O>, O: Element>(
    packed: &Packed<E, O>,
    layer: &Convolution,
    case: &Case,
    cells: &[f32],
    threads: usize,
    steps: Steps,
) -> Vec<f32> {
    let mut input = Map::<E>::with_step([case.rows, case.columns, layer.inputs], steps.input);
    input.fill_from(cells);
    let channels = case.beside.0 + layer.outputs + case.beside.1;
    let size = [layer.size(case.rows), layer.size(case.columns), channels];
    let mut output = Map::<O>::with_step(size, steps.output);
    output.fill_from(&vec![UNTOUCHED; output.rows * output.columns * channels]);
    packed.run(&mut Pool::new(threads), input.view(), &mut output, case.beside.0);
    let border = output
        .view()
        .data
        .iter()
        .map(|value| value.to_f32())
        .filter(|value| *value != 0.0)
        .count();
    let written = output.to_f32(&mut Pool::new(1));
    assert_eq!(
        border,
        written.iter().filter(|value| **value != 0.0).count(),
        "the border is written"
    );
    written
}

/// Compares with the plain loop on numbers rounded as the kernel's are, and one number of threads with others.
fn verify<E: Kernel<O>, O: Element>(case: &Case, isa: Isa, tolerance: f64) {
    let mut layer = layer(case);
    let found = run::<E, O>(&layer, case, isa, 1);
    for threads in [2, 3] {
        let again = run::<E, O>(&layer, case, isa, threads);
        let same = found.iter().zip(&again).all(|(a, b)| a.to_bits() == b.to_bits());
        assert!(same, "{isa}: bits of {threads} threads differ: {case:?}");
    }
    let rounded: Vec<f64> = cells(case)
        .into_iter()
        .map(|value| f64::from(E::from_f32(value).to_f32()))
        .collect();
    layer
        .weights
        .iter_mut()
        .for_each(|value| *value = E::from_f32(*value).to_f32());
    let (columns, channels) = (layer.size(case.columns), case.beside.0 + layer.outputs + case.beside.1);
    for (index, found) in found.into_iter().enumerate() {
        let (cell, channel) = (index / channels, index % channels);
        let expected = match channel
            .checked_sub(case.beside.0)
            .filter(|output| *output < layer.outputs)
        {
            Some(output) => plain(&layer, case, &rounded, [cell / columns, cell % columns, output]),
            None => f64::from(UNTOUCHED),
        };
        let difference = (f64::from(found) - expected).abs();
        // Roundings of a sum of so many products add up as a walk does.
        let terms = (layer.inputs * layer.kernel * layer.kernel) as f64;
        let bound = tolerance * (expected.abs() + (terms / 200.0).sqrt().max(1.0));
        assert!(
            difference <= bound,
            "{isa} cell {cell} channel {channel}: expected {expected}, found {found}: {case:?}"
        );
    }
}

/// Compares bytes with sums of whole numbers, and all instructions with each other bit by bit.
fn verify_bytes(case: &Case) {
    let layer = layer(case);
    // Numbers of a test lie within ±1: negative ones become 0, as those of a map after ReLU are.
    let steps = Steps {
        input: 1.0 / 200.0,
        output: 0.01 * (case.inputs as f32).sqrt(),
    };
    let whole = |value: f32| f64::from((value * (1.0 / steps.input)).round_ties_even().clamp(0.0, 255.0));
    let rounded: Vec<f64> = cells(case).into_iter().map(whole).collect();
    let mut in_steps = layer.clone();
    in_steps.relu = false;
    in_steps.bias.fill(0.0);
    let weight_steps: Vec<f32> = layer.max_weights().map(U8::weight_step).collect();
    let taps = layer.kernel * layer.kernel;
    let output_of = |index: usize| match layer.transposed {
        true => index / taps % layer.outputs,
        false => index / (taps * layer.inputs),
    };
    for (index, weight) in in_steps.weights.iter_mut().enumerate() {
        *weight = (*weight / weight_steps[output_of(index)]).round_ties_even();
    }
    let portable = run_in_steps::<U8, f32>(&layer, case, Isa::Portable, 1, Steps { output: 1.0, ..steps });
    let (columns, channels) = (layer.size(case.columns), case.beside.0 + layer.outputs + case.beside.1);
    for (index, found) in portable.iter().enumerate() {
        let (cell, channel) = (index / channels, index % channels);
        let output = channel
            .checked_sub(case.beside.0)
            .filter(|output| *output < layer.outputs);
        let expected = output.map_or(UNTOUCHED, |output| {
            let sum = plain(&in_steps, case, &rounded, [cell / columns, cell % columns, output]) as f32;
            let value = sum * (weight_steps[output] * steps.input) + layer.bias[output];
            if layer.relu { value.max(0.0) } else { value }
        });
        assert_eq!(*found, expected, "cell {cell} channel {channel}: {case:?}");
    }
    let bytes = run_in_steps::<U8, U8>(&layer, case, Isa::Portable, 1, steps);
    for (byte, single) in bytes.iter().zip(&portable) {
        let within = single.clamp(0.0, 255.0 * steps.output);
        assert!(
            (byte - within).abs() <= 0.51 * steps.output,
            "{byte} {single}: {case:?}"
        );
    }
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        for threads in [1, 3] {
            let single = run_in_steps::<U8, f32>(&layer, case, isa, threads, Steps { output: 1.0, ..steps });
            assert!(single == portable, "{isa}, {threads} threads: {case:?}");
            assert!(
                run_in_steps::<U8, U8>(&layer, case, isa, threads, steps) == bytes,
                "{isa}, {threads} threads, to bytes: {case:?}"
            );
        }
    }
}

fn verify_all(case: &Case) {
    verify_bytes(case);
    for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
        verify::<f32, f32>(case, isa, 1e-5);
        verify::<Bf16, f32>(case, isa, 1e-5);
        // Half a step of bf16 at the result.
        verify::<Bf16, Bf16>(case, isa, 0.004);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn kernels_agree_with_a_plain_loop(case in cases()) {
        verify_all(&case);
    }
}

#[test]
fn kernels_agree_with_a_plain_loop_at_the_edges() {
    let edge = |rows, columns, inputs, outputs, shape| Case {
        rows,
        columns,
        inputs,
        outputs,
        shape,
        relu: true,
        beside: (1, 1),
        seed: 11,
    };
    let mut all = vec![
        edge(1, 1, 1, 1, (3, 2, false)),
        edge(5, 1, 3, 60, (1, 1, false)),
        edge(1, 37, 2, 64, (3, 1, false)),
        edge(9, 12, 33, 33, (3, 2, false)),
        edge(2, 13, 128, 7, (4, 4, true)),
        edge(3, 2, 5, 129, (3, 1, false)),
    ];
    // Whole rows of tiles, and every remainder of a row in tiles of 16 and 32 windows.
    all.extend([15, 16, 17, 31, 32, 33, 48, 50, 79].map(|columns| edge(2, columns, 64, 33, (3, 1, false))));
    all.extend([(1, 1, false), (3, 2, false), (2, 2, true), (4, 4, true)].map(|shape| edge(3, 40, 128, 65, shape)));
    all.extend([32, 96, 192].map(|inputs| edge(3, 35, inputs, 32, (3, 1, false))));
    // Every remainder of a row in tiles of 4, 6 and 12.
    all.extend((1..=25).map(|columns| edge(2, columns, 3, 17, (3, 1, false))));
    all.iter().for_each(verify_all);
}

#[test]
fn nan_is_not_hidden() {
    let mut case = Case {
        rows: 1,
        columns: 3,
        inputs: 2,
        outputs: 20,
        shape: (1, 1, false),
        relu: true,
        beside: (0, 0),
        seed: 5,
    };
    for relu in [false, true] {
        case.relu = relu;
        let mut layer = layer(&case);
        layer.bias[19] = f32::NAN;
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            for found in [
                run::<f32, f32>(&layer, &case, isa, 1),
                run::<Bf16, Bf16>(&layer, &case, isa, 1),
            ] {
                let nan: Vec<usize> = (0..found.len()).filter(|i| found[*i].is_nan()).collect();
                assert_eq!(nan, [19, 39, 59], "{isa}");
            }
        }
    }
}

#[test]
fn layers_follow_each_other() {
    let case = Case {
        rows: 6,
        columns: 9,
        inputs: 3,
        outputs: 5,
        shape: (3, 2, false),
        relu: true,
        beside: (0, 0),
        seed: 8,
    };
    let (first, cells) = (layer(&case), cells(&case));
    let second = Convolution {
        inputs: 5,
        outputs: 5,
        kernel: 1,
        stride: 1,
        transposed: false,
        relu: false,
        weights: (0..25).map(|i| if i % 6 == 0 { 2.0 } else { 0.0 }).collect(),
        bias: vec![1.0; 5],
    };
    let one = apply(std::slice::from_ref(&first), Isa::detect(), 2, [6, 9], &cells);
    let both = apply(&[first, second], Isa::detect(), 2, [6, 9], &cells);
    assert_eq!(one.len(), 3 * 5 * 5);
    assert_eq!(both, one.iter().map(|value| 2.0 * value + 1.0).collect::<Vec<_>>());
}

#[test]
#[should_panic(expected = "size of an output map")]
fn a_map_of_another_size_is_refused() {
    let case = Case {
        rows: 4,
        columns: 4,
        inputs: 2,
        outputs: 2,
        shape: (3, 2, false),
        relu: true,
        beside: (0, 0),
        seed: 1,
    };
    let input = Map::<f32>::new(4, 4, 2);
    let packed = Packed::<f32>::new(&layer(&case), Isa::Portable, Steps::ONE);
    packed.run(&mut Pool::new(1), input.view(), &mut Map::new(4, 4, 2), 0);
}
