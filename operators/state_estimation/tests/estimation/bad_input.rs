//! Sensors that fail: each failure has its name, and the status tells the truth.

use crate::world::{Draws, LOOP, Plan, START, Truth, estimator, samples};
use nalgebra::Vector3;
use proptest::prelude::*;
use realo_geodesy::Geodetic;
use realo_schemas::{from_seconds, to_seconds};
use realo_state_estimation::{
    Estimator, Fault, GnssFix, ImuSample, Sample, ScanPose, Status, Unit, Verdict, WheelSpeed,
};

/// Feeds a drive with samples as `change` makes them (`None` leaves one out); looks at position errors, m, and statuses every
/// tenth of a second.
fn drive(plan: Plan, change: impl Fn(f64, Sample) -> Option<Sample>) -> (Estimator, Vec<(f64, f64, f64, Status)>) {
    let truth = Truth::of(&LOOP);
    let mut estimator = estimator(plan.unit);
    let mut found = Vec::new();
    let mut next = START + from_seconds(0.1);
    for sample in samples(&truth, &plan) {
        let stamp = sample.stamp();
        let is_imu = matches!(sample, Sample::Imu(_));
        if let Some(sample) = change(to_seconds(stamp - START), sample) {
            estimator.take(&sample);
        }
        if is_imu && stamp >= next {
            if let Some(estimate) = estimator.estimate_at(next) {
                let error = estimate.error(truth.pose(next)).xy().norm();
                found.push((
                    to_seconds(next - START),
                    error,
                    estimate.position_sigma(),
                    estimate.status,
                ));
            }
            next += from_seconds(0.1);
        }
    }
    (estimator, found)
}

fn plan() -> Plan {
    Plan::new(Unit::Tactical, 4)
}

/// Never a silent wrong pose: where it counts as tracked or reckoned, it is as good as it says.
fn honest(found: &[(f64, f64, f64, Status)], name: &str) {
    for (at, error, sigma, status) in found {
        let relied_on = matches!(status, Status::Tracking | Status::DeadReckoning);
        assert!(
            !relied_on || *error < 4.0 * sigma + 0.15,
            "{name}: {} at {at:.1} s, off by {error:.2} m with {sigma:.2} m",
            status.name()
        );
    }
}

fn worst(found: &[(f64, f64, f64, Status)], from: f64, to: f64) -> f64 {
    let within = found.iter().filter(|(at, ..)| (from..to).contains(at));
    within.fold(0.0, |worst: f64, (_, error, ..)| worst.max(*error))
}

fn backwards(_: f64, sample: Sample) -> Option<Sample> {
    Some(match sample {
        Sample::Wheel(wheel) => Sample::Wheel(WheelSpeed {
            speed: -wheel.speed,
            ..wheel
        }),
        other => other,
    })
}

fn imu(change: impl Fn(f64, ImuSample) -> ImuSample) -> impl Fn(f64, Sample) -> Option<Sample> {
    move |at, sample| match sample {
        Sample::Imu(imu) => Some(Sample::Imu(change(at, imu))),
        other => Some(other),
    }
}

fn gnss(change: impl Fn(f64, GnssFix) -> GnssFix) -> impl Fn(f64, Sample) -> Option<Sample> {
    move |at, sample| match sample {
        Sample::Gnss(fix) => Some(Sample::Gnss(change(at, fix))),
        other => Some(other),
    }
}

#[test]
fn imu_faults_are_named_and_the_rest_carries_on() {
    let stuck = ImuSample {
        stamp: 0,
        angular_rate: Vector3::new(0.1, 0.0, 0.2),
        specific_force: Vector3::new(0.3, 0.2, 9.7),
    };
    type Change = fn(f64, ImuSample, &ImuSample) -> ImuSample;
    let cases: [(&str, Fault, Change); 5] = [
        ("NaN", Fault::ImuNotFinite, |_, imu, _| ImuSample {
            angular_rate: imu.angular_rate * f64::NAN,
            ..imu
        }),
        ("saturated", Fault::ImuSaturated, |_, imu, _| ImuSample {
            angular_rate: Vector3::new(6.545, 0.0, 0.0),
            ..imu
        }),
        ("stuck", Fault::ImuStuck, |_, imu, stuck| ImuSample {
            stamp: imu.stamp,
            ..*stuck
        }),
        ("upside down", Fault::ImuGravity, |_, imu, _| ImuSample {
            specific_force: -imu.specific_force,
            ..imu
        }),
        ("in gravities", Fault::ImuGravity, |_, imu, _| ImuSample {
            specific_force: imu.specific_force / 9.80665,
            ..imu
        }),
    ];
    for (name, fault, change) in cases {
        let failing = |at: f64| (20.0..25.0).contains(&at);
        let (estimator, found) = drive(
            plan(),
            imu(|at, sample| {
                if failing(at) {
                    change(at, sample, &stuck)
                } else {
                    sample
                }
            }),
        );
        assert!(
            estimator.faults().count(fault) > 300,
            "{name}: {:?}",
            estimator.faults()
        );
        honest(&found, name);
        // Scans, wheels and GNSS go on.
        println!(
            "{name}: {:.2} m during, {:.2} m after",
            worst(&found, 20.0, 26.0),
            worst(&found, 27.0, 60.0)
        );
        assert!(worst(&found, 27.0, 60.0) < 0.4, "{name}");
        assert_eq!(estimator.status(), Status::Tracking, "{name}");
    }
}

#[test]
fn an_imu_that_is_upside_down_from_the_start_is_not_used() {
    let (estimator, found) = drive(
        plan(),
        imu(|_, imu| ImuSample {
            specific_force: -imu.specific_force,
            angular_rate: -imu.angular_rate,
            ..imu
        }),
    );
    assert!(estimator.faults().count(Fault::ImuGravity) > 5_000);
    honest(&found, "upside down");
}

#[test]
fn gnss_that_jumps_is_refused_and_named() {
    let jump = |fix: GnssFix, degrees: f64| GnssFix {
        place: Geodetic {
            latitude_deg: fix.place.latitude_deg + degrees,
            ..fix.place
        },
        ..fix
    };
    // 10 m north for 10 s, with scans and without.
    for scans in [true, false] {
        let plan = Plan { scans, ..plan() };
        let jumping = |at: f64| (20.0..30.0).contains(&at);
        let (estimator, found) = drive(plan, gnss(|at, fix| if jumping(at) { jump(fix, 9e-5) } else { fix }));
        assert!(estimator.faults().count(Fault::GnssGate) >= 95, "scans {scans}");
        honest(&found, "jump");
        assert!(worst(&found, 20.0, 30.0) < if scans { 0.3 } else { 4.0 });
    }
    // For good: without scans GNSS is right in the end, and until then the estimate is no more than it says.
    let plan = Plan { scans: false, ..plan() };
    let (estimator, found) = drive(plan, gnss(|at, fix| if at > 20.0 { jump(fix, 9e-5) } else { fix }));
    assert_eq!(estimator.faults().count(Fault::GnssConflict), 1);
    assert!(found.iter().any(|(_, _, _, status)| *status == Status::Lost));
}

#[test]
fn gnss_frozen_elsewhere_at_height_zero_or_nan_is_named() {
    let frozen = gnss(|at, fix| GnssFix {
        place: if at > 20.0 {
            Geodetic {
                latitude_deg: 48.137,
                longitude_deg: 11.575,
                height_m: 520.0,
            }
        } else {
            fix.place
        },
        ..fix
    });
    let (estimator, found) = drive(plan(), frozen);
    assert!(estimator.faults().count(Fault::GnssFrozen) > 400);
    honest(&found, "frozen");
    assert!(worst(&found, 10.0, 60.0) < 0.4);

    let elsewhere = gnss(|_, fix| GnssFix {
        place: Geodetic {
            longitude_deg: fix.place.longitude_deg + 6.0,
            ..fix.place
        },
        ..fix
    });
    let (estimator, found) = drive(Plan { scans: false, ..plan() }, elsewhere);
    assert!(estimator.faults().count(Fault::GnssElsewhere) > 500);
    assert!(found.is_empty() && estimator.status() == Status::Init);

    let flat = gnss(|_, fix| GnssFix {
        place: Geodetic {
            height_m: 0.0,
            ..fix.place
        },
        ..fix
    });
    let (estimator, found) = drive(plan(), flat);
    assert!(estimator.faults().count(Fault::GnssHeightZero) > 500);
    honest(&found, "height zero");
    assert!(worst(&found, 10.0, 60.0) < 0.4);

    let nan = gnss(|at, fix| GnssFix {
        place: if at > 20.0 {
            Geodetic {
                latitude_deg: f64::NAN,
                ..fix.place
            }
        } else {
            fix.place
        },
        ..fix
    });
    let (estimator, found) = drive(plan(), nan);
    assert!(estimator.faults().count(Fault::GnssNotFinite) > 400);
    honest(&found, "NaN");
}

#[test]
fn a_receiver_that_is_off_by_metres_yields_to_scans_that_agree_with_the_motion() {
    for metres in [5.0, 10.0] {
        let degrees = metres / 111_195.0;
        let off = gnss(|_, fix| GnssFix {
            place: Geodetic {
                latitude_deg: fix.place.latitude_deg + degrees,
                ..fix.place
            },
            ..fix
        });
        let (estimator, found) = drive(plan(), off);
        assert!(
            worst(&found, 6.0, 60.0) < 0.3,
            "{metres} m: {:.2}",
            worst(&found, 6.0, 60.0)
        );
        // What wanders explains five metres, not ten.
        if metres > 6.0 {
            let count = estimator.faults().count(Fault::GnssOffset);
            assert!(count > 100, "{:?}", estimator.faults());
            let said = estimator.gnss_offset().unwrap();
            assert!((said - metres).abs() < 4.0, "{said} of {metres} m");
        }
        let lost = found
            .iter()
            .filter(|(at, .., status)| *at > 6.0 && *status != Status::Tracking);
        assert_eq!(lost.count(), 0, "{metres} m");
    }
}

#[test]
fn a_sensor_that_leads_astray_is_named_and_the_estimate_is_lost_at_once() {
    let plan = Plan { scans: false, ..plan() };
    type Change = fn(f64, Sample) -> Option<Sample>;
    let wrong: [(&str, Fault, Change); 3] = [
        ("gyro's sign", Fault::ImuTrack, |_, sample| match sample {
            Sample::Imu(mut imu) => {
                imu.angular_rate.z = -imu.angular_rate.z;
                Some(Sample::Imu(imu))
            }
            other => Some(other),
        }),
        ("axes swapped", Fault::ImuTrack, |_, sample| match sample {
            Sample::Imu(mut imu) => {
                imu.angular_rate.swap_rows(0, 1);
                imu.specific_force.swap_rows(0, 1);
                Some(Sample::Imu(imu))
            }
            other => Some(other),
        }),
        ("wheels backwards", Fault::WheelTrack, backwards),
    ];
    for (name, fault, change) in wrong {
        let (estimator, found) = drive(plan, change);
        assert!(estimator.faults().count(fault) > 0, "{name}: {:?}", estimator.faults());
        for (at, error, _, status) in &found {
            let relied_on = matches!(status, Status::Tracking | Status::DeadReckoning);
            assert!(!relied_on || *error < 40.0, "{name}: off by {error:.1} m at {at:.1} s");
        }
        let other = if fault == Fault::ImuTrack {
            Fault::WheelTrack
        } else {
            Fault::ImuTrack
        };
        assert!(
            estimator.faults().count(fault) > estimator.faults().count(other),
            "{name}"
        );
    }
    // Sensors that are right are never named.
    for seed in 1..8 {
        let (estimator, _) = drive(Plan { seed, ..plan }, |_, sample| Some(sample));
        let faults = estimator.faults();
        for fault in [Fault::ImuTrack, Fault::WheelTrack, Fault::GnssTrack, Fault::ImuSilent] {
            assert_eq!(faults.count(fault), 0, "seed {seed}: {faults:?}");
        }
    }
}

#[test]
fn wheels_that_count_backwards_are_left_out_with_gnss_alone() {
    let plan = Plan { scans: false, ..plan() };
    for from in [0.0, 20.0] {
        let (estimator, found) = drive(plan, |at, sample| match sample {
            sample if at < from => Some(sample),
            sample => backwards(at, sample),
        });
        let faults = estimator.faults();
        let [found_wrong, left_out] = [Fault::WheelTrack, Fault::WheelExcluded].map(|fault| faults.count(fault));
        assert!((1..100).contains(&found_wrong) && left_out > 1000, "{faults:?}");
        honest(&found, "backwards");
        assert!(worst(&found, 15.0, 60.0) < 3.0, "{}", worst(&found, 15.0, 60.0));
        let late: Vec<_> = found.iter().filter(|(at, ..)| *at > 15.0).collect();
        let usable = late
            .iter()
            .filter(|(.., status)| matches!(status, Status::Tracking | Status::DeadReckoning));
        assert!(usable.count() == late.len() && late.len() > 300, "from {from} s on");
    }
}

#[test]
fn wheels_in_other_units_and_an_imu_that_dies_are_named() {
    let plan = Plan { scans: false, ..plan() };
    let (estimator, _) = drive(plan, |_, sample| match sample {
        Sample::Wheel(wheel) => Some(Sample::Wheel(WheelSpeed {
            speed: 3.6 * wheel.speed,
            ..wheel
        })),
        other => Some(other),
    });
    assert!(
        estimator.faults().count(Fault::WheelTrack) > 0,
        "{:?}",
        estimator.faults()
    );
    let (estimator, _) = drive(plan, |at, sample| {
        (at < 4.0 || !matches!(sample, Sample::Imu(_))).then_some(sample)
    });
    assert!(
        estimator.faults().count(Fault::ImuSilent) > 400,
        "{:?}",
        estimator.faults()
    );
}

#[test]
fn wheels_that_slip_or_stick_are_named() {
    let wheel = |from: f64, to: f64, speed: f64| {
        move |at: f64, sample: Sample| match sample {
            Sample::Wheel(wheel) if (from..to).contains(&at) => Some(Sample::Wheel(WheelSpeed { speed, ..wheel })),
            other => Some(other),
        }
    };
    for (name, speed, fault) in [
        ("stuck at 0", 0.0, Fault::WheelGate),
        ("spinning", 20.0, Fault::WheelGate),
        ("NaN", f64::NAN, Fault::WheelNotFinite),
    ] {
        let (estimator, found) = drive(plan(), wheel(14.0, 18.0, speed));
        // Scans show wheels that go on so, which are then left out.
        let [gated, excluded] = [fault, Fault::WheelExcluded].map(|fault| estimator.faults().count(fault));
        assert!(gated > 50 && gated + excluded > 150, "{name}: {:?}", estimator.faults());
        honest(&found, name);
        assert!(worst(&found, 10.0, 60.0) < 0.4, "{name}");
    }
}

#[test]
fn scans_of_another_place_are_refused_and_named() {
    let elsewhere = |at: f64, sample: Sample| match sample {
        Sample::Scan(mut scan) if at > 20.0 => {
            scan.map_from_body.translation.vector.x += 30.0;
            Some(Sample::Scan(scan))
        }
        other => Some(other),
    };
    let (estimator, found) = drive(plan(), elsewhere);
    assert!(estimator.faults().count(Fault::ScanGate) > 300);
    honest(&found, "map of another place");
    assert_eq!(estimator.status(), Status::Tracking);

    // From the start they never begin an estimate that GNSS contradicts.
    let (estimator, found) = drive(plan(), |_, sample| elsewhere(21.0, sample));
    assert!(estimator.faults().count(Fault::ScanGate) > 300);
    honest(&found, "map of another place from the start");
}

#[test]
fn a_clock_that_steps_is_a_gap_with_a_name() {
    let step = |at: f64, mut sample: Sample| {
        if at > 20.0 {
            let stamp = match &mut sample {
                Sample::Imu(imu) => &mut imu.stamp,
                Sample::Wheel(wheel) => &mut wheel.stamp,
                Sample::Gnss(fix) => &mut fix.stamp,
                Sample::Fix(fix) => &mut fix.stamp,
                Sample::Scan(scan) => &mut scan.stamp,
            };
            *stamp += from_seconds(60.0);
        }
        Some(sample)
    };
    let (estimator, _) = drive(plan(), step);
    assert!(estimator.faults().count(Fault::StampAhead) >= 1);
    assert_eq!(estimator.faults().count(Fault::StampGap), 1);
    assert_eq!(estimator.status(), Status::Tracking);
}

#[test]
fn one_stamp_far_ahead_changes_nothing() {
    let mut count = 0;
    let mut estimator = estimator(Unit::Tactical);
    let truth = Truth::of(&LOOP[..2]);
    for sample in samples(&truth, &plan()) {
        if let Sample::Imu(imu) = &sample {
            count += 1;
            if count % 100 == 0 {
                let ahead = ImuSample {
                    stamp: imu.stamp + from_seconds(3_600.0),
                    ..*imu
                };
                assert_eq!(estimator.take(&Sample::Imu(ahead)), Verdict::Refused(Fault::StampAhead));
            }
        }
        estimator.take(&sample);
    }
    assert_eq!(estimator.status(), Status::Tracking);
    assert_eq!(estimator.faults().count(Fault::StampGap), 0);
}

#[test]
fn an_outage_of_everything_is_lost_and_found_again() {
    let silent = |at: f64, sample: Sample| (!(20.0..35.0).contains(&at)).then_some(sample);
    let (estimator, found) = drive(plan(), silent);
    assert_eq!(estimator.faults().count(Fault::StampGap), 1);
    honest(&found, "silence");
    assert_eq!(estimator.status(), Status::Tracking);
    assert!(worst(&found, 45.0, 60.0) < 0.4);
}

/// Any numbers at all, in a running filter: no panic, and covariances stay covariances.
fn junk() -> impl Strategy<Value = Sample> {
    let number = prop_oneof![any::<f64>(), -1e3..1e3f64, Just(f64::NAN), Just(0.0)];
    let numbers = prop::collection::vec(number, 36);
    let stamp = prop_oneof![0..8_000_000_000i64, any::<i64>()];
    (numbers, stamp, 0..4usize).prop_map(|(n, stamp, kind)| {
        let stamp = START.saturating_add(stamp);
        let vector = |from: usize| Vector3::new(n[from], n[from + 1], n[from + 2]);
        match kind {
            0 => Sample::Imu(ImuSample {
                stamp,
                angular_rate: vector(0),
                specific_force: vector(3),
            }),
            1 => Sample::Wheel(WheelSpeed { stamp, speed: n[0] }),
            2 => Sample::Gnss(GnssFix {
                stamp,
                place: Geodetic {
                    latitude_deg: 48.137 + n[0] * 1e-6,
                    longitude_deg: 11.575 + n[1] * 1e-6,
                    height_m: n[2],
                },
                variance: Some([n[3], n[4], n[5]]),
            }),
            _ => {
                let root = nalgebra::Matrix6::from_iterator(n.iter().copied());
                Sample::Scan(Box::new(ScanPose {
                    stamp,
                    map_from_body: nalgebra::Isometry3::new(vector(0), vector(3)),
                    information: root * root.transpose(),
                }))
            }
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    #[test]
    fn junk_never_panics_and_covariances_stay_positive(junk in prop::collection::vec(junk(), 1..60), seed in 0..1000u64) {
        let mut estimator = estimator(Unit::Consumer);
        let mut draws = Draws::new(seed);
        let truth = Truth::of(&LOOP[..1]);
        let mut junk = junk.into_iter();
        for sample in samples(&truth, &Plan::new(Unit::Consumer, seed)) {
            if draws.normal() > 1.7 && let Some(bad) = junk.next() {
                estimator.take(&bad);
            }
            estimator.take(&sample);
            if let Some(estimate) = estimator.estimate() {
                prop_assert!(estimate.covariance.cholesky().is_some(), "{}", estimate.covariance);
                prop_assert!(estimate.map_from_body.translation.vector.iter().all(|part| part.is_finite()));
            }
        }
    }
}
