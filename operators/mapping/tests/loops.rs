//! Drives round a block, mapped by their own sensors.

mod block;

use block::{Block, Plan, drive, drive_with, sweeps, true_pose};
use realo_mapping::{Drive, Errors, Mapped, MappedDrive, errors, solve};
use realo_schemas::geometry::PoseTrack;

/// Errors of a drive's poses at its sweeps.
fn off(plan: &Plan, track: &PoseTrack) -> Errors {
    let posed = sweeps(plan).filter_map(|stamp| Some([track.at(stamp)?, true_pose(plan, stamp)]));
    errors(&posed.collect::<Vec<_>>()).expect("poses")
}

fn with(change: impl Fn(&mut Plan)) -> Plan {
    let mut plan = Plan::LAPS;
    change(&mut plan);
    plan
}

fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(work)
}

/// The bits of all poses of a drive.
fn bits(mapped: &MappedDrive, plan: &Plan) -> Vec<u64> {
    let poses = sweeps(plan).filter_map(|stamp| mapped.track.at(stamp));
    poses
        .flat_map(|pose| {
            [
                pose.translation.x,
                pose.translation.y,
                pose.translation.z,
                pose.rotation.k,
            ]
            .map(f64::to_bits)
        })
        .collect()
}

#[test]
fn laps_close_and_the_map_is_off_by_what_gnss_is_off() {
    let (block, plan) = (Block::new(5), Plan::LAPS);
    let mapped = [1, 3].map(|threads| on_threads(threads, || solve(&[drive(&block, &plan)], 1.0).expect("poses")));
    let [one, three] = &mapped;
    assert!(
        bits(&one.drives[0], &plan) == bits(&three.drives[0], &plan),
        "threads change bits"
    );
    assert_eq!(one.summary, three.summary);

    let (summary, found) = (&one.summary, &one.drives[0]);
    assert_eq!(found.lean, None, "its sensor is level");
    assert!(
        summary.is_anchored && summary.converged && summary.loops >= 5,
        "{summary:?}"
    );
    let [[before, _], [after, _]] = summary.residuals;
    assert!(after < 0.05 && after <= before, "{summary:?}");
    let errors = off(&plan, &found.track);
    assert!(errors.poses > 180, "{errors:?}");
    assert!(
        errors.aligned[0].p95 < 0.08 && errors.aligned[2].p95 < 0.15,
        "{errors:?}"
    );
    // The whole is where GNSS says, and knows that this is not sure.
    assert!(errors.absolute[0].mean < 1.6, "{errors:?}");
    assert!(found.sigmas[0] > 0.3 && found.sigmas[0] < 4.0, "{:?}", found.sigmas);
    let [anchors, doubtful] = found.anchors;
    assert!(doubtful > 0 && 3 * doubtful < anchors, "{anchors} {doubtful}");
}

/// Follows a drive until its sensor is level: the slope that was found, and what was mapped.
fn levelled(block: &Block, plan: &Plan) -> (f64, Mapped) {
    let mut slope = 0.0;
    for _ in 0..6 {
        let mapped = solve(&[drive_with(block, plan, slope)], 1.0).expect("poses");
        match mapped.drives[0].lean {
            None => return (slope, mapped),
            Some(lean) => slope += lean.slope,
        }
    }
    panic!("it still leans beyond {slope}");
}

#[test]
fn loops_tell_how_a_sensor_leans_and_heights_do_not_drift() {
    let block = Block::new(5);
    let slope = -0.008;
    let plan = with(|plan| plan.slope = slope);
    let climbed = drive(&block, &plan).pieces[0].track.last().expect("poses").1;
    assert!(climbed.translation.z < -0.8, "{climbed}");
    let (found, mapped) = levelled(&block, &plan);
    assert!((found - slope).abs() < 8e-4, "{found}");
    let errors = off(&plan, &mapped.drives[0].before);
    assert!(errors.aligned[1].max < 0.15, "{errors:?}");
    let errors = off(&plan, &mapped.drives[0].track);
    assert!(errors.aligned[1].max < 0.1, "{errors:?}");
}

#[test]
fn two_days_become_one_map_and_drives_that_never_meet_are_told() {
    let block = Block::new(6);
    let other_day = with(|plan| (plan.seed, plan.bias, plan.seconds) = (2, [-1.0, 0.9], 30));
    let first = with(|plan| plan.seconds = 20);
    let elsewhere = with(|plan| (plan.seed, plan.away, plan.seconds) = (3, 400.0, 15));
    let plans = [first, other_day, elsewhere];
    let drives = plans.map(|plan| drive(&block, &plan));
    let mapped = solve(&drives, 1.0).expect("poses");
    let groups: Vec<usize> = mapped.drives.iter().map(|of| of.group).collect();
    assert_eq!(groups, [0, 0, 2]);
    assert_eq!(mapped.drives[2].loops, 0);
    // Days that GNSS has 2 m apart agree to centimetres.
    let posed = plans[..2].iter().zip(&mapped.drives).flat_map(|(plan, of)| {
        sweeps(plan)
            .filter_map(|stamp| Some([of.track.at(stamp)?, true_pose(plan, stamp)]))
            .collect::<Vec<_>>()
    });
    let errors = errors(&posed.collect::<Vec<_>>()).expect("poses");
    assert!(errors.aligned[0].p95 < 0.12, "{errors:?}");
}

#[test]
fn without_gnss_the_map_begins_where_the_drive_does() {
    let plan = with(|plan| plan.has_fixes = false);
    let mapped = solve(&[drive(&Block::new(5), &plan)], 1.0).expect("poses");
    assert!(
        !mapped.summary.is_anchored && mapped.summary.loops >= 5,
        "{:?}",
        mapped.summary
    );
    let errors = off(&plan, &mapped.drives[0].track);
    assert!(errors.aligned[0].p95 < 0.08, "{errors:?}");
    // Beside a drive with GNSS it has no place.
    let both = [
        drive(&Block::new(5), &plan),
        drive(&Block::new(5), &with(|plan| plan.seconds = 8)),
    ];
    let mapped = solve(&both, 1.0).expect("poses");
    assert_eq!([mapped.drives[0].keyframes, mapped.drives[0].pieces[1]], [0, 1]);
    assert!(mapped.drives[1].keyframes > 0 && mapped.drives[1].loops == 0);
}

#[test]
fn gnss_that_jumps_all_the_time_is_told_and_bends_nothing() {
    let plan = with(|plan| plan.jumps = true);
    let mapped = solve(&[drive(&Block::new(5), &plan)], 1.0).expect("poses");
    let of = &mapped.drives[0];
    let errors = off(&plan, &of.track);
    assert!(errors.aligned[0].p95 < 0.1, "{errors:?}");
    assert!(2 * of.anchors[1] > of.anchors[0], "{:?}", of.anchors);
}

#[test]
fn a_sweep_of_a_wrong_time_is_counted_and_ends_no_piece() {
    let plan = with(|plan| (plan.seconds, plan.misdated) = (8, Some(20)));
    let found = drive(&Block::new(5), &plan);
    assert_eq!(
        (found.pieces.len(), found.counts.misdated),
        (1, 1),
        "{:?}",
        found.counts
    );
    assert!(found.counts.registered > 30, "{:?}", found.counts);
}

#[test]
fn sweeps_of_few_points_are_counted_and_only_such_are_refused() {
    for points in [0, 50] {
        let plan = with(|plan| (plan.points, plan.seconds) = (points, 6));
        let found: Drive = drive(&Block::new(5), &plan);
        let counts = found.counts;
        assert_eq!(counts.few_points + counts.waiting, counts.sweeps, "{counts:?}");
        assert!(counts.few_points > 20, "{counts:?}");
        let error = solve(&[found], 1.0).expect_err("no keyframes").to_string();
        assert!(error.contains("100 points"), "{error}");
    }
}
