//! Samples that come late: the same bits as if they had come in time.

use crate::world::{LOOP, Plan, START, Truth, estimator, samples};
use proptest::prelude::*;
use realo_schemas::{Nanos, from_seconds};
use realo_state_estimation::{Estimate, Estimator, Fault, Sample, Unit, Verdict};

/// All bits of an estimate.
fn bits(estimate: &Estimate) -> Vec<u64> {
    let pose = &estimate.map_from_body;
    let numbers = pose
        .translation
        .vector
        .iter()
        .chain(pose.rotation.coords.iter())
        .chain(estimate.covariance.iter())
        .chain(estimate.velocity.iter())
        .chain(estimate.angular_rate.iter().flat_map(|rate| rate.iter()));
    numbers.map(|number| number.to_bits()).collect()
}

fn drive(seconds: f64) -> Vec<Sample> {
    let truth = Truth::of(&LOOP[..2]);
    let until = START + from_seconds(seconds);
    let mut samples = samples(&truth, &Plan::new(Unit::Tactical, 11));
    samples.retain(|sample| sample.stamp() <= until);
    samples
}

fn fed(samples: &[Sample]) -> Estimator {
    let mut estimator = estimator(Unit::Tactical);
    for sample in samples {
        estimator.take(sample);
    }
    estimator
}

#[test]
fn a_late_scan_gives_the_bits_of_one_in_time() {
    let mut samples = drive(6.0);
    let late = fed(&samples);
    assert_eq!(late.faults().count(Fault::TooLate), 0);
    let rank = |sample: &Sample| match sample {
        Sample::Imu(_) => 0,
        Sample::Wheel(_) => 1,
        Sample::Gnss(_) | Sample::Fix(_) => 2,
        Sample::Scan(_) => 3,
    };
    samples.sort_by_key(|sample| (sample.stamp(), rank(sample)));
    let in_time = fed(&samples);
    for back in [0.0, 0.013, 0.1, 0.47, 0.8] {
        let stamp = START + from_seconds(6.0 - back);
        let [late, in_time] = [&late, &in_time].map(|estimator| estimator.estimate_at(stamp).unwrap());
        assert_eq!(bits(&late), bits(&in_time), "{back} s ago");
    }
    // And a scan does change what is estimated.
    let without: Vec<Sample> = samples.iter().filter(|sample| rank(sample) < 3).cloned().collect();
    let [with, without] = [fed(&samples), fed(&without)].map(|estimator| estimator.estimate().unwrap());
    assert!(with.covariance[(0, 0)] < 0.1 * without.covariance[(0, 0)]);
}

#[test]
fn what_is_older_than_the_ring_is_counted_and_changes_nothing() {
    let samples = drive(4.0);
    let mut estimator = fed(&samples);
    let before = bits(&estimator.estimate().unwrap());
    let newest = estimator.newest().unwrap();
    let old = samples
        .iter()
        .find(|sample| sample.stamp() < newest - from_seconds(1.5))
        .unwrap();
    assert_eq!(estimator.take(old), Verdict::Refused(Fault::TooLate));
    let double = samples
        .iter()
        .rfind(|sample| matches!(sample, Sample::Gnss(_)))
        .unwrap();
    assert_eq!(estimator.take(double), Verdict::Refused(Fault::Repeated));
    assert_eq!(bits(&estimator.estimate().unwrap()), before);
    assert!(estimator.estimate_at(newest - from_seconds(1.5)).is_none());
    assert!(estimator.estimate_at(newest + from_seconds(1.5)).is_none());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// However samples overtake each other within half a second.
    #[test]
    fn any_order_gives_the_same_bits(delays in prop::collection::vec(0..500_000_000i64, 64)) {
        let mut samples = drive(3.0);
        let mut shuffled: Vec<(Nanos, usize)> = samples
            .iter()
            .enumerate()
            .map(|(number, sample)| (sample.stamp() + delays[number % delays.len()], number))
            .collect();
        shuffled.sort_unstable();
        let shuffled: Vec<Sample> = shuffled.into_iter().map(|(_, number)| samples[number].clone()).collect();
        samples.sort_by_key(Sample::stamp);
        let (ordered, other) = (fed(&samples), fed(&shuffled));
        prop_assert_eq!(other.faults().count(Fault::TooLate), 0);
        prop_assert_eq!(bits(&ordered.estimate().unwrap()), bits(&other.estimate().unwrap()));
        prop_assert_eq!(ordered.faults(), other.faults());
    }
}
