//! Roadside units: localised once, held, and missed when they are moved.

use crate::world::{Draws, START, settings};
use nalgebra::{Isometry3, Matrix6, Vector3};
use realo_geodesy::LocalFrame;
use realo_schemas::from_seconds;
use realo_state_estimation::{Fault, GnssFix, HoldEstimator, HoldSettings, Sample, ScanPose, Status, Unit, Verdict};

fn pose() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(35.0, 12.0, 5.0), Vector3::new(0.0, 0.0, 1.2))
}

fn scan(number: u32, truth: &Isometry3<f64>, draws: &mut Draws) -> Sample {
    let sigmas = [0.05, 0.002];
    let mut information = Matrix6::identity() / (sigmas[0] * sigmas[0]);
    for axis in 3..6 {
        information[(axis, axis)] = 1.0 / (sigmas[1] * sigmas[1]);
    }
    let turn = Isometry3::rotation(draws.vector() * sigmas[1]).rotation;
    let position = truth.translation.vector + draws.vector() * sigmas[0];
    Sample::Scan(Box::new(ScanPose {
        stamp: START + from_seconds(0.1 * f64::from(number)),
        map_from_body: Isometry3::from_parts(position.into(), turn * truth.rotation),
        information,
    }))
}

fn fix(number: u32, frame: &LocalFrame, place: Vector3<f64>, draws: &mut Draws) -> Sample {
    Sample::Gnss(GnssFix {
        stamp: START + from_seconds(0.1 * f64::from(number)),
        place: frame.place_of(&(place + draws.vector())).unwrap(),
        variance: None,
    })
}

fn estimator() -> HoldEstimator {
    HoldEstimator::new(settings(Unit::Tactical), HoldSettings::default()).unwrap()
}

#[test]
fn a_unit_is_localised_by_the_mean_of_scans_and_held() {
    let mut draws = Draws::new(9);
    let (mut held, frame) = (estimator(), settings(Unit::Tactical).frame);
    assert!(held.estimate_at(START).is_none());
    held.take(&fix(0, &frame, pose().translation.vector, &mut draws));
    assert_eq!(held.status(), Status::Init);
    for number in 0..10 {
        held.take(&scan(number, &pose(), &mut draws));
    }
    assert_eq!(held.status(), Status::Tracking);
    let estimate = held.estimate_at(START + from_seconds(1e6)).unwrap();
    let error = estimate.error(&pose());
    assert!(
        error.fixed_rows::<3>(0).norm() < 0.1 && error[5].abs() < 0.005,
        "{error}"
    );
    assert!(estimate.nees(&pose()).unwrap() < 11.143);
    for number in 10..200 {
        held.take(&scan(number, &pose(), &mut draws));
    }
    assert_eq!(held.estimate_at(estimate.stamp).unwrap(), estimate);
}

#[test]
fn a_unit_is_known_after_three_scans_and_one_that_disagrees_is_left_out() {
    let mut draws = Draws::new(12);
    let mut held = estimator();
    let elsewhere = Isometry3::translation(2.0, 0.0, 0.0) * pose();
    let mut verdicts = Vec::new();
    for (number, place) in [pose(), pose(), elsewhere, pose()].iter().enumerate() {
        verdicts.push(held.take(&scan(number as u32, place, &mut draws)));
    }
    let expected = [
        Verdict::Waiting,
        Verdict::Waiting,
        Verdict::Refused(Fault::ScanGate),
        Verdict::Used,
    ];
    assert_eq!(verdicts, expected);
    let estimate = held.estimate_at(START).unwrap();
    assert!(estimate.error(&pose()).fixed_rows::<3>(0).norm() < 0.2);
}

#[test]
fn a_first_scan_that_others_disagree_with_makes_room_for_them() {
    let mut draws = Draws::new(13);
    let mut held = estimator();
    held.take(&scan(0, &(Isometry3::translation(2.0, 0.0, 0.0) * pose()), &mut draws));
    for number in 1..8 {
        held.take(&scan(number, &pose(), &mut draws));
    }
    assert_eq!(held.status(), Status::Tracking);
    let estimate = held.estimate_at(START).unwrap();
    assert!(estimate.error(&pose()).fixed_rows::<3>(0).norm() < 0.2);
}

#[test]
fn a_unit_that_was_moved_is_lost_and_found() {
    let mut draws = Draws::new(10);
    let mut held = estimator();
    for number in 0..10 {
        held.take(&scan(number, &pose(), &mut draws));
    }
    let moved = Isometry3::translation(0.6, 0.0, 0.0) * pose();
    let mut lost = false;
    for number in 10..80 {
        held.take(&scan(number, &moved, &mut draws));
        lost |= held.status() == Status::Lost;
    }
    assert!(lost && held.status() == Status::Tracking);
    assert_eq!(held.faults().count(Fault::ScanConflict), 1);
    assert!(held.estimate_at(START).unwrap().error(&moved).norm() < 0.1);
}

#[test]
fn scans_that_gnss_contradicts_are_refused() {
    let mut draws = Draws::new(11);
    let (mut held, frame) = (estimator(), settings(Unit::Tactical).frame);
    held.take(&fix(0, &frame, pose().translation.vector, &mut draws));
    let elsewhere = Isometry3::translation(40.0, 0.0, 0.0) * pose();
    for number in 0..50 {
        let verdict = held.take(&scan(number, &elsewhere, &mut draws));
        assert_eq!(verdict, Verdict::Refused(Fault::ScanGate));
    }
    assert_eq!(held.status(), Status::Init);
    let estimate = held.estimate_at(START).unwrap();
    assert!(estimate.heading_sigma() > 1.5 && estimate.position_sigma() > 1.0);
}
