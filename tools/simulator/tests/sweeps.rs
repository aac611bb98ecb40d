//! What comes out of the simulation: same bits, true geometry, times, poses.

use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, from_seconds};
use realo_simulator::{
    EPOCH, Error, Options, POSE_PERIOD, Phase, PoseNoise, SWEEP_PERIOD, Scenario, Sensor, Simulation, Sweep, fleet,
};

fn simulate(change: impl FnOnce(&mut Options)) -> Simulation {
    let mut options = Options {
        seconds: 0.2,
        column_stride: 4,
        labels: true,
        seed: 903,
        ..Options::default()
    };
    change(&mut options);
    Simulation::new(&options).unwrap()
}

fn digest(sweeps: &[Sweep]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut eat = |bytes: &[u8]| {
        for byte in bytes {
            hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    };
    for sweep in sweeps {
        eat(sweep.agent.as_bytes());
        eat(&sweep.stamp.to_le_bytes());
        for column in [&sweep.cloud.x, &sweep.cloud.y, &sweep.cloud.z] {
            column.iter().for_each(|v| eat(&v.to_bits().to_le_bytes()));
        }
        sweep.cloud.time.iter().for_each(|t| eat(&t.to_le_bytes()));
        eat(&sweep.cloud.intensity);
        for object in sweep.truth.iter().chain(&sweep.detections.0) {
            let Box3 {
                center: [x, y, z],
                length,
                width,
                height,
                yaw,
                ..
            } = *object;
            [x, y, z, length, width, height, yaw]
                .iter()
                .for_each(|v| eat(&v.to_bits().to_le_bytes()));
            eat(object.class.as_bytes());
            eat(&object.score.to_bits().to_le_bytes());
        }
        sweep.points.iter().for_each(|n| eat(&n.to_le_bytes()));
    }
    hash
}

#[test]
fn same_bits_on_any_number_of_threads() {
    let all = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| simulate(|_| ()).sweeps().collect::<Vec<_>>())
    };
    let [one, two, five] = [1, 2, 5].map(all);
    assert_eq!(one.len(), 8);
    assert_eq!(one, two);
    assert_eq!(one, five);
}

#[test]
fn same_bits_on_every_machine() {
    let sweeps: Vec<_> = simulate(|options| options.column_stride = 40).sweeps().collect();
    assert_eq!(
        format!("{:016x}", digest(&sweeps)),
        "ecb02fa62ff3347e",
        "the world has changed: raise WORLD and say so in the change log"
    );
}

#[test]
fn counts_do_not_depend_on_whether_clouds_are_kept() {
    let with: Vec<_> = simulate(|_| ()).sweeps().collect();
    let without: Vec<_> = simulate(|options| options.clouds = false).sweeps().collect();
    for (with, without) in with.iter().zip(&without) {
        assert_eq!(
            (&with.truth, &with.points, &with.detections),
            (&without.truth, &without.points, &without.detections)
        );
        assert!(without.cloud.is_empty() && with.cloud.len() > 5000);
        assert!(with.points.iter().sum::<u32>() > 200);
    }
}

#[test]
fn seed_changes_traffic_and_place_changes_roads() {
    let boxes = |seed, place| {
        let simulation = simulate(|o| (o.seed, o.place, o.column_stride) = (seed, place, 100));
        simulation.sweeps().next().unwrap()
    };
    assert_ne!(boxes(1, Some(5)).truth, boxes(2, Some(5)).truth);
    assert_eq!(boxes(5, None), boxes(5, Some(5)));
    let pose = |place| {
        simulate(|o| o.place = Some(place)).poses("rsu1").unwrap()[0]
            .truth
            .map_from_body
    };
    assert_eq!(pose(5), pose(5));
    assert_ne!(pose(5), pose(6));
}

/// Points of each object against its box, moved to the points' times.
#[test]
fn points_lie_in_their_boxes_at_their_own_times() {
    for scenario in [Scenario::Intersection, Scenario::Corridor] {
        let simulation = simulate(|o| (o.scenario, o.dense, o.column_stride, o.seconds) = (scenario, true, 2, 0.1));
        let (mut checked, mut moving, mut blurred) = (0, 0, 0.0f64);
        for sweep in simulation.sweeps() {
            let poses = simulation.poses(&sweep.agent).unwrap();
            let track: Vec<_> = poses.iter().map(|p| (p.stamp, p.truth.clone())).collect();
            let at = |stamp: i64| {
                let near = track.iter().min_by_key(|(t, _)| (t - stamp).abs()).unwrap();
                near.1.extrapolated(stamp - near.0)
            };
            let map_from_body = at(sweep.stamp);
            for (point, label) in sweep.labels.iter().enumerate() {
                let Some(object) = label.checked_sub(1).map(|i| &sweep.truth[i as usize]) else {
                    continue;
                };
                let time = i64::from(sweep.cloud.time[point]);
                let seconds = time as f64 * 1e-9;
                let [vx, vy, _] = object.velocity.unwrap();
                let mut moved = object.clone();
                moved.center[0] += vx * seconds;
                moved.center[1] += vy * seconds;
                let to_then = at(sweep.stamp + time).inverse() * map_from_body;
                let cloud = &sweep.cloud;
                let measured = [cloud.x[point], cloud.y[point], cloud.z[point]].map(f64::from);
                let out = distance_outside(&transform_box(&to_then, &moved), measured);
                // Range noise (at most 3.5 times 0.1 m), turning and braking within half a sweep, slopes.
                assert!(
                    out < 0.45,
                    "{} on {}: {out} m outside at {measured:?}",
                    sweep.agent,
                    object.class
                );
                checked += 1;
                if vx * vx + vy * vy > 36.0 && time.abs() > 20_000_000 {
                    moving += 1;
                    blurred += distance_outside(&transform_box(&to_then, object), measured) - out;
                }
            }
        }
        assert!(
            checked > 20_000 && moving > 200,
            "{checked} points, {moving} on moving objects"
        );
        assert!(
            blurred / f64::from(moving) > 0.02,
            "boxes that stay behind must fit worse: {blurred} over {moving}"
        );
    }
}

#[test]
fn most_points_are_close_to_their_boxes() {
    let simulation = simulate(|o| (o.seconds, o.column_stride, o.dense) = (0.1, 2, true));
    let (mut inside, mut all) = (0, 0);
    for sweep in simulation.sweeps() {
        for (point, label) in sweep.labels.iter().enumerate() {
            let Some(object) = label.checked_sub(1).map(|i| &sweep.truth[i as usize]) else {
                continue;
            };
            if object.velocity.is_some_and(|[x, y, _]| x * x + y * y < 0.01) {
                let cloud = &sweep.cloud;
                let measured = [cloud.x[point], cloud.y[point], cloud.z[point]].map(f64::from);
                all += 1;
                inside += usize::from(distance_outside(object, measured) < 0.2);
            }
        }
    }
    assert!(all > 2_000 && inside * 100 > all * 95, "{inside} of {all}");
}

/// How far a point lies outside of a box, m; 0 inside.
fn distance_outside(object: &Box3, [x, y, z]: [f64; 3]) -> f64 {
    let (sin, cos) = object.yaw.sin_cos();
    let (x, y) = (x - object.center[0], y - object.center[1]);
    let over = |v: f64, extent: f64| (v.abs() - extent / 2.0).max(0.0);
    let (u, v) = (
        over(x * cos + y * sin, object.length),
        over(y * cos - x * sin, object.width),
    );
    let w = over(z - object.center[2], object.height);
    (u * u + v * v + w * w).sqrt()
}

#[test]
fn nothing_is_seen_through_the_body_of_a_car() {
    let simulation = simulate(|o| (o.seconds, o.column_stride, o.dense) = (0.1, 4, true));
    let (mut over, mut through) = (0, 0);
    for sweep in simulation.sweeps().filter(|sweep| sweep.agent.starts_with("rsu")) {
        let standing = |b: &&Box3| b.velocity.is_some_and(|[x, y, _]| x == 0.0 && y == 0.0);
        let cars: Vec<&Box3> = sweep
            .truth
            .iter()
            .filter(standing)
            .filter(|b| &*b.class == "Car")
            .collect();
        for i in 0..sweep.cloud.len() {
            let point = [sweep.cloud.x[i], sweep.cloud.y[i], sweep.cloud.z[i]].map(f64::from);
            for car in &cars {
                let (passes, enters) = crosses_core(car, point);
                over += usize::from(passes);
                through += usize::from(enters);
            }
        }
    }
    assert!(over > 750, "only {over} rays passed over or under a car");
    assert_eq!(through, 0);
}

/// Whether the ray of a roadside sensor to a point crosses the middle of a car, seen from above, and whether it goes
/// through the metal there: below the windows, above the wheels' axles.
fn crosses_core(car: &Box3, point: [f64; 3]) -> (bool, bool) {
    let (sin, cos) = car.yaw.sin_cos();
    let local = |[x, y, z]: [f64; 3]| {
        let (x, y) = (x - car.center[0], y - car.center[1]);
        [
            x * cos + y * sin,
            y * cos - x * sin,
            z - car.center[2] + car.height / 2.0,
        ]
    };
    let (from, to) = (local([0.0, 0.0, 5.0]), local(point));
    let core = [
        [-0.3 * car.length, 0.3 * car.length],
        [-0.4 * car.width, 0.4 * car.width],
        [0.36 * car.height, 0.48 * car.height],
    ];
    // From the sensor to 0.3 m before the point: range noise must not count.
    let length = (0..3)
        .map(|k| (to[k] - from[k]) * (to[k] - from[k]))
        .sum::<f64>()
        .sqrt();
    let (mut enter, mut leave) = (0.0, 1.0 - 0.3 / length);
    let mut passes = false;
    for (k, [low, high]) in core.into_iter().enumerate() {
        let step = to[k] - from[k];
        let (a, b) = ((low - from[k]) / step, (high - from[k]) / step);
        (enter, leave) = (f64::max(enter, a.min(b)), f64::min(leave, a.max(b)));
        if k == 1 {
            passes = enter < leave;
        }
    }
    (passes, enter < leave)
}

#[test]
fn sweeps_come_in_order_with_their_times() {
    for phase in [Phase::Locked, Phase::Spread] {
        let simulation =
            simulate(|o| (o.phase, o.seconds, o.column_stride, o.key_hz, o.clouds) = (phase, 1.0, 1000, 5.0, false));
        let sweeps: Vec<_> = simulation.sweeps().collect();
        assert_eq!(sweeps.len(), 40);
        assert!(
            sweeps
                .windows(2)
                .all(|s| (s[0].ready, &s[0].agent) < (s[1].ready, &s[1].agent))
        );
        let starts: Vec<i64> = ["cav1", "cav2", "rsu1", "rsu2"]
            .iter()
            .map(|agent| {
                let own: Vec<_> = sweeps.iter().filter(|sweep| &*sweep.agent == *agent).collect();
                assert!(own.iter().enumerate().all(|(i, sweep)| sweep.seq == i as u64));
                assert!(
                    own.iter()
                        .all(|s| s.ready - s.stamp == SWEEP_PERIOD / 2 && s.key == (s.seq % 2 == 1))
                );
                assert!(own.windows(2).all(|s| s[1].stamp - s[0].stamp == SWEEP_PERIOD));
                own[0].ready - SWEEP_PERIOD - EPOCH
            })
            .collect();
        for (i, a) in starts.iter().enumerate() {
            assert!((0..SWEEP_PERIOD).contains(a));
            for b in &starts[..i] {
                let apart = (a - b).rem_euclid(SWEEP_PERIOD).min((b - a).rem_euclid(SWEEP_PERIOD));
                let fits = if phase == Phase::Locked {
                    apart < 1_000_000
                } else {
                    apart >= 15_000_000
                };
                assert!(fits, "{phase:?}: {apart} ns apart");
            }
        }
    }
}

#[test]
fn points_carry_the_times_of_their_firings() {
    let simulation = simulate(|o| (o.seconds, o.column_stride) = (0.1, 1));
    for sweep in simulation.sweeps() {
        let time = &sweep.cloud.time;
        assert!(
            time.windows(2).all(|t| t[0] <= t[1]),
            "points are in the order of their firing"
        );
        assert!(time.iter().all(|t| i64::from(t.abs()) <= SWEEP_PERIOD / 2 + 100_000));
        assert!(time[0] < -45_000_000 && time[time.len() - 1] > 45_000_000);
        let exact = |v: &f32| (v * 1024.0).fract() == 0.0;
        assert!(sweep.cloud.x.iter().all(exact) && sweep.cloud.z.iter().all(exact));
        // The sensor turns clockwise from the rear: it looks ahead half-way.
        let ahead = (0..time.len()).filter(|i| time[*i].abs() < 2_000_000);
        for i in ahead {
            let (x, y) = (sweep.cloud.x[i], sweep.cloud.y[i]);
            assert!(x > 0.0 && y.abs() < 0.27 * x + 0.1, "{} at {x} {y}", sweep.agent);
        }
        let rings = if &*sweep.agent == "rsu2" { 64 } else { 128 };
        assert!(sweep.cloud.ring.iter().all(|ring| *ring < rings));
    }
}

#[test]
fn poses_fall_on_starts_middles_and_ends() {
    let simulation = simulate(|o| (o.phase, o.seconds) = (Phase::Spread, 0.3));
    for agent in ["cav1", "cav2", "rsu1", "rsu2"] {
        let poses = simulation.poses(agent).unwrap();
        assert!(poses.windows(2).all(|p| p[1].stamp - p[0].stamp == POSE_PERIOD));
        let sweeps: Vec<_> = simulation.sweeps().filter(|sweep| &*sweep.agent == agent).collect();
        for sweep in &sweeps {
            for stamp in [sweep.stamp - SWEEP_PERIOD / 2, sweep.stamp, sweep.ready] {
                assert!(poses.iter().any(|pose| pose.stamp == stamp));
            }
        }
        assert_eq!(poses[0].stamp, sweeps[0].stamp - SWEEP_PERIOD / 2 - SWEEP_PERIOD);
        assert!(poses[poses.len() - 1].stamp > sweeps[sweeps.len() - 1].ready);
        for pair in poses.windows(2) {
            let [a, b] = [&pair[0].truth, &pair[1].truth];
            let predicted = a.extrapolated(POSE_PERIOD);
            let off = (predicted.translation.vector - b.map_from_body.translation.vector).norm();
            assert!(off < 0.002, "{agent}: {off} m off after 10 ms");
        }
    }
    assert!(simulation.poses("cav3").is_none());
}

#[test]
fn agents_believe_what_their_receivers_tell_them() {
    let simulation = simulate(|o| (o.seconds, o.column_stride) = (10.0, 1000));
    for agent in ["cav1", "rsu1"] {
        let poses = simulation.poses(agent).unwrap();
        let errors: Vec<f64> = poses
            .iter()
            .map(|p| (p.believed.map_from_body.translation.vector - p.truth.map_from_body.translation.vector).norm())
            .collect();
        assert!(errors.iter().all(|e| *e < 0.2) && errors.iter().sum::<f64>() > 0.0);
        let covariance = poses[0].believed.covariance.as_ref().unwrap();
        assert!((0..6).all(|k| covariance[7 * k] > 0.0) && covariance[1] == 0.0);
        assert_eq!(
            errors.windows(2).all(|e| e[0] == e[1]),
            agent == "rsu1",
            "a survey errs once"
        );
    }
    let exact = simulate(|o| (o.pose_noise, o.seconds) = (PoseNoise::none(), 0.1));
    for pose in exact.poses("cav1").unwrap() {
        let off = pose.believed.map_from_body.inverse() * pose.truth.map_from_body;
        assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-7);
    }
}

#[test]
fn map_offset_moves_poses_and_nothing_else() {
    let near = simulate(|_| ());
    let far = simulate(|o| o.map_offset_m = [100_000.0, -70_000.0]);
    let [a, b] = [&near, &far].map(|simulation| simulation.sweeps().next().unwrap());
    assert_eq!(a, b);
    let [a, b] = [&near, &far].map(|simulation| simulation.poses("cav2").unwrap()[3].truth.map_from_body);
    let moved = b.translation.vector - a.translation.vector;
    assert!((moved.x - 100_000.0).abs() < 1e-6 && (moved.y + 70_000.0).abs() < 1e-6 && moved.z == 0.0);
    assert_eq!(a.rotation, b.rotation);
}

#[test]
fn truths_of_two_agents_agree_in_map() {
    let simulation = simulate(|o| (o.seconds, o.column_stride, o.map_offset_m) = (0.1, 50, [100_000.0, 0.0]));
    let sweeps: Vec<_> = simulation.sweeps().collect();
    let in_map = |sweep: &Sweep| -> Vec<Box3> {
        let pose = simulation
            .poses(&sweep.agent)
            .unwrap()
            .into_iter()
            .find(|p| p.stamp == sweep.stamp)
            .unwrap();
        sweep
            .truth
            .iter()
            .map(|object| transform_box(&pose.truth.map_from_body, object))
            .collect()
    };
    let all: Vec<Vec<Box3>> = sweeps.iter().map(in_map).collect();
    let own = |agent: &str| simulation.agents().find(|a| &*a.name == agent).unwrap().track;
    for (i, sweep) in sweeps.iter().enumerate() {
        assert!(
            all[i]
                .iter()
                .all(|object| object.track != own(&sweep.agent) || object.track.is_none())
        );
        for object in &all[i] {
            for other in all.iter().flatten().filter(|other| other.track == object.track) {
                let apart = |k: usize| (object.center[k] - other.center[k]).abs();
                assert!(apart(0) < 0.02 && apart(1) < 0.02 && apart(2) < 0.01);
                assert!((object.yaw - other.yaw).sin().abs() < 0.01 && object.class == other.class);
            }
        }
    }
    let cav2 = own("cav2");
    assert!(
        all.iter()
            .filter(|boxes| boxes.iter().any(|object| object.track == cav2))
            .count()
            == 3
    );
}

#[test]
fn noise_free_detections_are_the_truth_with_enough_points() {
    let simulation = simulate(|o| (o.noise_free_detections, o.column_stride) = (true, 1));
    for sweep in simulation.sweeps() {
        let seen = sweep.truth.iter().zip(&sweep.points).filter(|(_, n)| **n >= 5);
        let expected: Vec<Box3> = seen
            .map(|(object, _)| Box3 {
                track: None,
                ..object.clone()
            })
            .collect();
        assert!(!expected.is_empty() && sweep.detections.0 == expected);
    }
}

#[test]
fn noisy_detections_are_near_what_was_seen() {
    let simulation = simulate(|o| (o.column_stride, o.seconds) = (1, 0.3));
    let (mut near, mut far, mut seen) = (0, 0, 0);
    for sweep in simulation.sweeps() {
        seen += sweep.points.iter().filter(|n| **n >= 5).count();
        for found in &sweep.detections.0 {
            assert!((0.0..=1.0).contains(&found.score) && realo_schemas::geometry::is_valid(found));
            let close = |object: &&Box3| {
                (object.center[0] - found.center[0]).hypot(object.center[1] - found.center[1]) < 1.5
                    && object.class == found.class
            };
            if sweep.truth.iter().any(|object| close(&object)) {
                near += 1
            } else {
                far += 1
            }
        }
    }
    assert!(
        near > seen / 2 && near <= seen + far,
        "{near} near, {far} far, {seen} seen"
    );
    assert!(far > 2 && far < near / 3, "{near} near, {far} far");
}

#[test]
fn own_car_is_in_its_cloud_and_within_the_usual_cut() {
    let simulation = simulate(|o| (o.seconds, o.column_stride) = (0.1, 1));
    for agent in simulation.agents() {
        let Some([x0, x1, y0, y1]) = agent.footprint else {
            continue;
        };
        assert!(x0 >= -1.95 && x1 <= 2.95 && y0 >= -1.1 && y1 <= 1.1);
        let sweep = simulation.sweeps().find(|sweep| sweep.agent == agent.name).unwrap();
        let own = (0..sweep.cloud.len())
            .filter(|i| {
                let (x, y) = (f64::from(sweep.cloud.x[*i]), f64::from(sweep.cloud.y[*i]));
                (x0..x1).contains(&x) && (y0..y1).contains(&y)
            })
            .count();
        // A low roof is under the lowest beams only.
        assert!(own > 20, "{own} points on the own roof");
    }
}

#[test]
fn agents_that_do_not_record_are_still_there() {
    let simulation = simulate(|o| (o.agents, o.column_stride) = (vec!["rsu1".into(), "cav1".into()], 40));
    assert_eq!(
        simulation.agents().map(|a| a.name.to_string()).collect::<Vec<_>>(),
        ["cav1", "rsu1"]
    );
    let all: Vec<_> = simulate(|o| o.column_stride = 40)
        .sweeps()
        .filter(|s| &*s.agent == "cav1")
        .collect();
    let few: Vec<_> = simulation.sweeps().filter(|s| &*s.agent == "cav1").collect();
    assert_eq!(all, few);
    let error = Simulation::new(&Options {
        agents: vec!["car3".into()],
        ..Options::default()
    })
    .err();
    assert_eq!(error, Some(Error::UnknownAgent { found: "car3".into() }));
}

#[test]
fn length_is_what_was_asked_for() {
    let simulation = simulate(|o| (o.seconds, o.column_stride) = (0.7, 1000));
    assert_eq!(simulation.sweep_count(), 28);
    let last = simulation.sweeps().map(|sweep| sweep.ready).max().unwrap();
    assert!((last - EPOCH - from_seconds(0.7)).abs() < 1_000_000);
}

#[test]
fn scored_sweeps_alone_are_those_of_the_whole_log() {
    let log = |only| {
        simulate(|options| {
            (options.seconds, options.key_sweeps_only) = (2.0, only);
            options.agents.truncate(2);
            options.column_stride = 40;
        })
    };
    let whole: Vec<_> = log(false).sweeps().collect();
    let few = log(true);
    let wanted = |sweep: &&Sweep| sweep.key || sweep.seq == 0;
    let expected: Vec<_> = whole.iter().filter(wanted).cloned().collect();
    assert_eq!(few.sweep_count(), 6);
    assert_eq!(few.sweeps().collect::<Vec<_>>(), expected);
    assert_eq!(
        few.poses("cav1").map(|poses| poses.len()),
        log(false).poses("cav1").map(|poses| poses.len())
    );
}

/// The two places on a grid are what older results were made of: what they give must never change.
#[test]
fn old_places_keep_their_bits() {
    let cases = [
        (Scenario::Intersection, false, 7),
        (Scenario::Intersection, true, 900),
        (Scenario::Intersection, false, 903),
        (Scenario::Corridor, false, 12),
        (Scenario::Corridor, true, 901),
        (Scenario::Corridor, true, 905),
    ];
    let found = cases.map(|(scenario, dense, seed)| {
        let simulation = simulate(|o| {
            (o.scenario, o.dense, o.seed, o.column_stride, o.seconds) = (scenario, dense, seed, 20, 0.1);
        });
        let sweeps: Vec<_> = simulation.sweeps().collect();
        let agents = ["cav1", "cav2", "rsu1", "rsu2"].iter();
        let poses = agents.flat_map(|agent| simulation.poses(agent).unwrap());
        let numbers = poses.flat_map(|pose| {
            let at = pose.believed.map_from_body.translation.vector;
            [at.x, at.y, at.z]
        });
        let hash = numbers.fold(digest(&sweeps), |hash, v| {
            (hash ^ v.to_bits()).wrapping_mul(0x0000_0100_0000_01b3)
        });
        format!("{hash:016x}")
    });
    let expected = [
        "21d25cdaaefeb4a6",
        "d6a86202f4415527",
        "168a98a8414762f7",
        "7029b208d2b130b5",
        "960c933989b0ab67",
        "35d8f99e74aa6434",
    ];
    assert_eq!(found, expected);
}

#[test]
fn every_place_is_the_same_on_any_number_of_threads() {
    for scenario in Scenario::NETWORKS {
        let all = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let change = |o: &mut Options| (o.scenario, o.seconds, o.column_stride) = (scenario, 0.1, 20);
            pool.install(|| simulate(change).sweeps().collect::<Vec<_>>())
        };
        let [one, three] = [1, 3].map(all);
        assert_eq!(one.len(), 4);
        assert!(one.iter().all(|sweep| sweep.cloud.len() > 500), "{}", scenario.name());
        assert_eq!(one, three, "{}", scenario.name());
    }
}

/// Who is where in the places with roads at any angle, whatever else there is to be seen.
#[test]
fn traffic_of_every_place_is_the_same_on_every_machine() {
    let found = Scenario::NETWORKS.map(|scenario| {
        let simulation = simulate(|o| {
            (o.scenario, o.seconds, o.column_stride, o.clouds) = (scenario, 0.1, 1000, false);
            o.agents.truncate(1);
        });
        let sweeps: Vec<_> = simulation.sweeps().collect();
        let numbers = sweeps[0].truth.iter().flat_map(|object| {
            let [x, y, z] = object.center;
            [x, y, z, object.length, object.yaw]
        });
        let hash = numbers.fold(0xcbf2_9ce4_8422_2325u64, |hash, v| {
            (hash ^ v.to_bits()).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
        });
        format!("{hash:016x}")
    });
    let expected = [
        "419a606988651e94",
        "b345065d598a732b",
        "c852a90c80cfdb8a",
        "b4505e6c5d50f284",
        "4f6e9978cacaf02c",
        "2df5664bef6ba62b",
        "f233f098b77ed0a6",
        "2daf6a2064ba803c",
        "e0b7f7d3619e709a",
        "2750f2f63be5aec6",
    ];
    assert_eq!(found, expected);
}

#[test]
fn mixed_is_one_of_all_places_as_its_number_says() {
    let drawn: Vec<Scenario> = (0..200).map(|place| Scenario::Mixed.resolve(place)).collect();
    assert!(Scenario::PLACES.iter().all(|place| drawn.contains(place)) && !drawn.contains(&Scenario::Mixed));
    let of =
        |scenario, place| simulate(|o| (o.scenario, o.place, o.seconds, o.column_stride) = (scenario, place, 0.1, 100));
    let number = (0..).find(|number| drawn[*number] == Scenario::Tee).unwrap() as u64;
    let [mixed, own] = [Scenario::Mixed, Scenario::Tee].map(|scenario| of(scenario, Some(number)));
    assert_eq!(mixed.scenario(), Scenario::Tee);
    assert_eq!(mixed.sweeps().next(), own.sweeps().next());
    let error = Scenario::from_name("airport").unwrap_err().to_string();
    assert!(error.contains("airport") && error.contains("roundabout"), "{error}");
    for scenario in Scenario::PLACES.into_iter().chain([Scenario::Mixed]) {
        assert_eq!(Scenario::from_name(scenario.name()), Ok(scenario));
    }
}

/// The world of newer places: foliage, rounded bodies, sensors with mounts and errors.
fn overgrown(change: impl FnOnce(&mut Options)) -> Simulation {
    simulate(|options| {
        options.scenario = Scenario::Junction;
        options.vehicle_sensors = vec![
            Sensor::named("pandar40p").unwrap(),
            Sensor::named("spinning-16").unwrap(),
        ];
        options.roadside_sensors = vec![Sensor::named("forward-scan").unwrap()];
        options.weather.rain_mm_h = 5.0;
        change(options);
    })
}

#[test]
fn sensors_and_weather_give_the_same_bits_everywhere() {
    let all = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| overgrown(|o| o.column_stride = 10).sweeps().collect::<Vec<_>>())
    };
    let [one, three] = [1, 3].map(all);
    assert_eq!(one, three);
    assert_eq!(format!("{:016x}", digest(&one)), "bfc7f29490486392");
}

#[test]
fn a_fleet_has_sixteen_agents_of_all_sensors() {
    let sensors: Vec<_> = Sensor::names().map(|name| Sensor::named(name).unwrap()).collect();
    let simulation = simulate(|o| {
        (o.dense, o.seconds, o.column_stride) = (true, 0.1, 20);
        o.agents = fleet(10, 6).unwrap();
        (o.vehicle_sensors, o.roadside_sensors) = (sensors.clone(), sensors.clone());
    });
    let sweeps: Vec<_> = simulation.sweeps().collect();
    let names: Vec<&str> = simulation.agents().map(|agent| &*agent.name).collect();
    assert_eq!(
        (names.len(), names[0], names[9], names[10], names[15]),
        (16, "cav1", "cav10", "rsu1", "rsu6")
    );
    for (agent, info) in simulation.agents().enumerate() {
        let sweep = sweeps.iter().find(|sweep| sweep.agent == info.name).unwrap();
        assert!(sweep.cloud.len() > 200, "{}: {} points", info.name, sweep.cloud.len());
        let pose = &simulation.poses(&info.name).unwrap()[0]
            .truth
            .map_from_body
            .translation
            .vector;
        for other in simulation.agents().take(agent) {
            let there = &simulation.poses(&other.name).unwrap()[0]
                .truth
                .map_from_body
                .translation
                .vector;
            assert!((pose - there).norm() > 2.5, "{} stands in {}", info.name, other.name);
        }
    }
    let four: Vec<_> = simulate(|o| (o.dense, o.seconds, o.column_stride) = (true, 0.1, 20))
        .sweeps()
        .collect();
    let more = simulate(|o| {
        (o.dense, o.seconds, o.column_stride) = (true, 0.1, 20);
        o.agents = fleet(3, 3).unwrap();
    });
    let same: Vec<_> = more
        .sweeps()
        .filter(|sweep| four.iter().any(|s| s.agent == sweep.agent))
        .collect();
    assert_eq!(same, four, "the first four do not mind the others");
    let error = Simulation::new(&Options {
        seconds: 600.0,
        agents: fleet(16, 0).unwrap(),
        scenario: Scenario::Corridor,
        seed: 903,
        ..Options::default()
    });
    if let Err(error) = error {
        assert!(error.to_string().contains("no car for `cav"), "{error}");
    }
}

#[test]
fn fog_takes_what_is_far() {
    let count = |visibility_m| {
        let simulation = overgrown(|o| {
            (o.seconds, o.column_stride) = (0.1, 10);
            o.weather.visibility_m = visibility_m;
        });
        let sweeps: Vec<_> = simulation.sweeps().collect();
        let far = |sweep: &Sweep| {
            let beyond = |i: &usize| sweep.cloud.x[*i].hypot(sweep.cloud.y[*i]) > 60.0;
            (0..sweep.cloud.len()).filter(beyond).count()
        };
        sweeps.iter().map(far).sum::<usize>()
    };
    let (clear, fog) = (count(None), count(Some(60.0)));
    assert!(
        clear > 100 && fog * 4 < clear,
        "{clear} points beyond 60 m in clear air, {fog} in fog"
    );
}
