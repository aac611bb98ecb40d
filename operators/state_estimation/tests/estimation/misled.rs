//! Estimates that a sensor leads astray by what nobody sees in one sample: they are right, or say that they are not.

use crate::world::{LOOP, Plan, START, Truth, estimator, samples};
use nalgebra::Vector3;
use realo_schemas::{from_seconds, to_seconds};
use realo_state_estimation::{Estimator, Fault, ImuSample, Sample, Status, Stuck, Unit};

/// An estimate against the truth.
struct Look {
    at: f64,
    /// m and degrees.
    off: [f64; 2],
    sigma: [f64; 2],
    status: Status,
}

impl Look {
    fn is_relied_on(&self) -> bool {
        matches!(self.status, Status::Tracking | Status::DeadReckoning)
    }
}

/// Feeds a drive with samples as `change` makes them; looks every tenth of a second.
fn drive(plan: Plan, mut change: impl FnMut(f64, Sample) -> Sample) -> (Estimator, Vec<Look>) {
    let truth = Truth::of(&LOOP);
    let mut estimator = estimator(plan.unit);
    let mut looks = Vec::new();
    let mut next = START + from_seconds(0.1);
    for sample in samples(&truth, &plan) {
        let stamp = sample.stamp();
        let is_imu = matches!(sample, Sample::Imu(_));
        estimator.take(&change(to_seconds(stamp - START), sample));
        if is_imu && stamp >= next {
            looks.extend(estimator.estimate_at(next).map(|estimate| {
                let error = estimate.error(truth.pose(next));
                Look {
                    at: to_seconds(next - START),
                    off: [error.xy().norm(), error[5].abs().to_degrees()],
                    sigma: [estimate.position_sigma(), estimate.heading_sigma().to_degrees()],
                    status: estimate.status,
                }
            }));
            next += from_seconds(0.1);
        }
    }
    (estimator, looks)
}

fn plan(scans: bool, seed: u64) -> Plan {
    Plan {
        scans,
        ..Plan::new(Unit::Tactical, seed)
    }
}

/// Where an estimate counts as usable, it is as good as it says.
fn honest(looks: &[Look], name: &str) {
    for Look { at, off, sigma, status } in looks.iter().filter(|look| look.is_relied_on()) {
        let [place, heading] = [0.15, 1.0];
        assert!(
            off[0] < 4.0 * sigma[0] + place && off[1] < 4.0 * sigma[1] + heading,
            "{name}: {} at {at:.1} s, off by {off:.2?} m and degrees with {sigma:.2?}",
            status.name()
        );
    }
}

/// The largest error of usable estimates from a time on.
fn worst(looks: &[Look], from: f64, part: usize) -> f64 {
    let usable = looks.iter().filter(|look| look.at >= from && look.is_relied_on());
    usable.fold(0.0, |worst: f64, look| worst.max(look.off[part]))
}

/// Makes samples of the IMU hold one part of what it said when it got stuck.
fn stuck(from: f64, part: Stuck) -> impl FnMut(f64, Sample) -> Sample {
    let mut held: Option<ImuSample> = None;
    move |at, sample| match sample {
        Sample::Imu(mut imu) if at >= from => {
            let held = held.get_or_insert(imu);
            if part != Stuck::Accelerometers {
                imu.angular_rate = held.angular_rate;
            }
            if part != Stuck::Gyroscopes {
                imu.specific_force = held.specific_force;
            }
            Sample::Imu(imu)
        }
        other => other,
    }
}

#[test]
fn a_gyro_or_an_accelerometer_that_stands_still_alone_is_named_and_not_used() {
    // On a straight, in a curve, and where the vehicle stands.
    for (from, scans) in [(4.0, true), (10.0, true), (10.0, false), (30.0, true), (30.0, false)] {
        for part in [Stuck::Gyroscopes, Stuck::Accelerometers, Stuck::Whole] {
            let name = format!("{part:?} from {from} s, scans {scans}");
            let (estimator, looks) = drive(plan(scans, 4), stuck(from, part));
            let faults = estimator.faults();
            assert!(faults.count(Fault::ImuStuck) > 2_000, "{name}: {faults:?}");
            assert_eq!(estimator.stuck(), Some(part), "{name}");
            honest(&looks, &name);
            if scans {
                assert!(worst(&looks, 2.0, 0) < 0.5 && worst(&looks, 2.0, 1) < 16.0, "{name}");
                assert_eq!(estimator.status(), Status::Tracking, "{name}");
            }
        }
    }
}

/// Moves fixes from one time to another by 10 m to the north.
fn jumping(from: f64, to: f64) -> impl FnMut(f64, Sample) -> Sample {
    move |at, sample| match sample {
        Sample::Gnss(mut fix) if (from..to).contains(&at) => {
            fix.place.latitude_deg += 10.0 / 111_195.0;
            Sample::Gnss(fix)
        }
        other => other,
    }
}

#[test]
fn fixes_that_were_off_at_the_start_are_outvoted_by_those_that_follow() {
    let mut count = 0;
    for seed in 1..7 {
        for until in [3.0, 5.0, 8.0] {
            let name = format!("off until {until} s, seed {seed}");
            let (estimator, looks) = drive(plan(false, seed), jumping(0.0, until));
            // Nothing shows that they are off, until others come.
            let after: Vec<Look> = looks.into_iter().filter(|look| look.at > until + 0.5).collect();
            honest(&after, &name);
            assert!(worst(&after, 2.2 * until + 0.5, 0) < 4.0, "{name}");
            let given_up = estimator.faults().count(Fault::GnssConflict);
            assert!(given_up <= 1, "{name}");
            count += given_up;
            assert!(
                after.iter().filter(|look| look.at > 20.0).all(Look::is_relied_on),
                "{name}"
            );
        }
    }
    assert!(count > 12, "{count} of 18");
}

#[test]
fn a_jump_after_a_good_time_is_refused_and_one_that_is_shorter_than_the_start_changes_nothing() {
    for seed in 1..13 {
        for (from, to) in [(5.0, 8.0), (16.0, 26.0), (40.0, 50.0)] {
            let name = format!("off from {from} to {to} s, seed {seed}");
            let (estimator, looks) = drive(plan(false, seed), jumping(from, to));
            let faults = estimator.faults();
            assert_eq!(
                [Fault::GnssConflict, Fault::GnssTrack].map(|fault| faults.count(fault)),
                [0, 0],
                "{name}"
            );
            let during: Vec<Look> = looks.into_iter().filter(|look| look.at > from).collect();
            honest(&during, &name);
            assert!(worst(&during, 0.0, 0) < 4.0, "{name}");
            let is_long = from > 12.0;
            assert!(!is_long || during.iter().all(Look::is_relied_on), "{name}");
        }
    }
}

/// What no sample shows: rates with noise about one value that is not true.
#[test]
fn scans_show_a_gyro_that_turns_otherwise_than_they_do() {
    for (from, rate) in [(9.0, 0.0), (4.0, 0.3), (14.0, -0.15)] {
        for seed in 1..4 {
            let name = format!("{rate} rad/s from {from} s, seed {seed}");
            let (estimator, looks) = drive(plan(true, seed), |at, sample| match sample {
                Sample::Imu(mut imu) if at >= from => {
                    imu.angular_rate = Vector3::new(0.0, 0.0, rate) + 1e-2 * (imu.angular_rate - Vector3::z() * rate);
                    Sample::Imu(imu)
                }
                other => other,
            });
            assert!(estimator.faults().count(Fault::ImuTrack) > 0, "{name}");
            let usable = looks.iter().filter(|look| look.at > 2.0 && look.is_relied_on());
            assert!(usable.count() > 610, "{name}");
            assert!(worst(&looks, 2.0, 0) < 0.5 && worst(&looks, 2.0, 1) < 16.0, "{name}");
        }
    }
}

/// Samples without rates for some seconds, in bends and before them: by GNSS alone, the estimate comes back right, or says that it is not.
#[test]
fn seconds_without_an_imu_in_a_bend_end_right_or_are_lost() {
    let mut ratios = Vec::new();
    for (from, to) in [(8.5, 12.5), (10.0, 14.0), (43.0, 47.0), (7.0, 9.0), (55.0, 58.0)] {
        for seed in 1..9 {
            let name = format!("from {from} to {to} s, seed {seed}");
            let (_, looks) = drive(plan(false, seed), |at, sample| match sample {
                Sample::Imu(mut imu) if (from..to).contains(&at) => {
                    imu.angular_rate *= f64::NAN;
                    Sample::Imu(imu)
                }
                other => other,
            });
            let after: Vec<Look> = looks.into_iter().filter(|look| look.at > from).collect();
            honest(&after, &name);
            assert!(worst(&after, from, 0) < 4.5, "{name}");
            assert!(worst(&after, to + 2.0, 1) < 5.0, "{name}");
            assert!(
                after.iter().filter(|look| look.at > to + 1.0).all(Look::is_relied_on),
                "{name}"
            );
            let within = after.iter().filter(|look| (from..to).contains(&look.at));
            ratios.extend(within.map(|look| look.off[1] / look.sigma[1]));
        }
    }
    // A normal error is within two of its deviations in 95 of 100 cases.
    let inside = ratios.iter().filter(|ratio| **ratio < 2.0).count() as f64 / ratios.len() as f64;
    assert!(inside > 0.9, "{inside}");
}
