//! Networks of bytes.

use realo_kernels::bev::BevMap;
use realo_kernels::conv::Isa;
use realo_nn::layers::Layers;
use realo_nn::model::{ModelError, Precision};
use realo_nn::weights::Weights;

use super::calibration::Calibration;
use super::*;
use crate::arch::Model;
use crate::detect::pillars::Points;
use crate::testing::{Numbers, lite, random_tensors, small};

/// Points over a grid.
fn columns(model: &Model, seed: u64) -> [Vec<f32>; 3] {
    let mut numbers = Numbers::new(seed);
    let mut column = |[from, to]: [f64; 2]| -> Vec<f32> {
        let (middle, half) = ((from + to) as f32 / 2.0, (to - from) as f32 / 2.0);
        (0..4000).map(|_| middle + 0.99 * half * numbers.draw()).collect()
    };
    [column(model.grid.x), column(model.grid.y), column([-2.0, 2.0])]
}

fn points([x, y, z]: &[Vec<f32>; 3]) -> Points<'_> {
    Points {
        x,
        y,
        z,
        intensity: None,
    }
}

fn calibrated(mut model: Model, weights: &Weights) -> Model {
    let mut calibration = Calibration::new(&model, weights).unwrap();
    for seed in 1..4 {
        calibration.observe(&points(&columns(&model, seed))).unwrap();
    }
    model.activations = calibration.activations();
    model
}

fn weights(model: &Model) -> Weights {
    Weights::new(model, random_tensors(model, 5)).unwrap()
}

fn map(model: &Model, weights: &Weights, isa: Isa, precision: Precision, threads: usize) -> BevMap {
    let options = NetworkOptions {
        isa,
        precision: Some(precision),
        threads,
    };
    let mut network = Network::new(model, weights, options).unwrap();
    let mut pillarer = Pillarer::beside(&network, model, weights);
    network.encode(pillarer.run(&points(&columns(model, 9))).0).unwrap()
}

#[test]
fn maps_of_bytes_are_near_those_of_f32_and_the_same_on_all_instructions() {
    for odd in [false, true] {
        let model = small(24, 40, odd);
        let weights = weights(&model);
        let model = calibrated(model, &weights);
        let single = map(&model, &weights, Isa::Portable, Precision::F32, 1);
        let bytes = map(&model, &weights, Isa::Portable, Precision::Int8, 1);
        let energy = |values: &mut dyn Iterator<Item = f32>| values.map(|v| f64::from(v).powi(2)).sum::<f64>();
        let lost = energy(&mut single.data.iter().zip(&bytes.data).map(|(a, b)| a - b));
        let all = energy(&mut single.data.iter().copied());
        assert!(all > 0.0 && lost < 2e-3 * all, "{lost} of {all} is lost");
        assert_ne!(single, bytes);
        for isa in Isa::ALL.into_iter().filter(|isa| isa.is_available()) {
            for threads in [1, 3] {
                let other = map(&model, &weights, isa, Precision::Int8, threads);
                assert!(other == bytes, "{isa}, {threads} threads");
            }
        }
    }
}

#[test]
fn a_model_that_does_not_say_what_bytes_stand_for_is_refused() {
    let model = small(8, 8, false);
    let weights = weights(&model);
    let options = NetworkOptions {
        precision: Some(Precision::Int8),
        ..NetworkOptions::default()
    };
    let error = Network::new(&model, &weights, options)
        .err()
        .expect("refused")
        .to_string();
    assert!(
        error.contains("`activations`") && error.contains("realo quantize"),
        "{error}"
    );
}

#[test]
fn limits_must_be_those_of_the_layers_that_are_read() {
    let problem = |change: &dyn Fn(&mut Model)| {
        let mut model = lite();
        let keys = Layers::of(&model).read_in_bytes();
        model.activations = keys.into_iter().map(|(key, _)| (key, 2.0)).collect();
        model.precision = Precision::Int8;
        assert!(model.validate().is_ok());
        change(&mut model);
        match model.validate() {
            Err(ModelError::Invalid { problems, .. }) => problems.join("; "),
            other => panic!("{other:?}"),
        }
    };
    let missing = problem(&|model| {
        model.activations.remove("backbone.blocks.0.1");
    });
    assert!(missing.contains("layer `backbone.blocks.0.1`"), "{missing}");
    let foreign = problem(&|model| {
        model.activations.insert("cls_head".into(), 1.0);
    });
    assert!(foreign.contains("`cls_head` is no layer"), "{foreign}");
    for number in [0.0, -1.0, 1e-30, 1e30, f32::NAN, f32::INFINITY] {
        let wrong = problem(&|model| {
            model.activations.insert("backbone.blocks.0.1".into(), number);
        });
        assert!(wrong.contains("expected 0.000001 to 1000000, found"), "{wrong}");
    }
}
