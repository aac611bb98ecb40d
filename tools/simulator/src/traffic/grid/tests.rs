use super::lights::Light;
use super::*;
use crate::path::State;
use crate::traffic::{Traffic, User, overlaps, touch};

const GRIDS: [Grid; 2] = [Grid::Intersection, Grid::Corridor];

/// Length of the shared simulations, s.
const SECONDS: f64 = 20.0;

struct Sample {
    place: Scenery,
    traffic: Traffic,
    seed: u64,
    dense: bool,
}

/// Places and traffic that all tests look at, made once.
fn samples() -> &'static [Sample] {
    static SAMPLES: std::sync::OnceLock<Vec<Sample>> = std::sync::OnceLock::new();
    SAMPLES.get_or_init(|| {
        let mut all = Vec::new();
        for grid in GRIDS {
            for seed in 0..4 {
                let (place, dense) = (Scenery::on_grid(grid, seed), seed % 2 == 0);
                let traffic = Traffic::new(&Demand {
                    place: &place,
                    seed,
                    dense,
                    seconds: SECONDS,
                    rounded_bodies: false,
                })
                .unwrap();
                all.push(Sample {
                    place,
                    traffic,
                    seed,
                    dense,
                });
            }
        }
        all
    })
}

fn for_each_traffic(check: impl Fn(&Scenery, &Traffic, u64)) {
    samples()
        .iter()
        .for_each(|sample| check(&sample.place, &sample.traffic, sample.seed));
}

fn there(traffic: &Traffic, t: f64) -> Vec<(usize, State)> {
    let at = |(i, user): (usize, &User)| user.course.at(t).map(|state| (i, state));
    traffic.users.iter().enumerate().filter_map(at).collect()
}

#[test]
fn no_two_bodies_overlap() {
    for_each_traffic(|_, traffic, seed| {
        for k in 0..=100 {
            let users = there(traffic, f64::from(k) * 0.2 - 0.2);
            for (n, (i, a)) in users.iter().enumerate() {
                for (j, b) in &users[n + 1..] {
                    let overlap = touch(a.pose, traffic.users[*i].size, b.pose, traffic.users[*j].size);
                    assert!(
                        !overlap,
                        "seed {seed}: {:?} and {:?}",
                        traffic.users[*i].class, traffic.users[*j].class
                    );
                }
            }
        }
    });
}

#[test]
fn hardly_anybody_has_to_be_left_out_for_that() {
    for Sample { place, seed, dense, .. } in samples() {
        let (seed, dense) = (*seed, *dense);
        let lights = Lights::new(place.grid().grid, seed);
        let network = network::Network::new(place.grid());
        let (walkers, crossings) = walkers::walk(place.grid(), &lights, seed, dense, 10.5);
        let plan = TrafficPlan {
            network: &network,
            lights: &lights,
            crossings: &crossings,
            seed: Stream::new(seed, "traffic", 0).bits(),
            gap: gap(place.grid().grid, dense),
            until: 10.5,
            stay: &[],
        };
        let mut crowd: Vec<Arrival> = drive(&plan)
            .into_iter()
            .map(|v| (None, v.class, v.size, Course::Moving(v.motion)))
            .collect();
        crowd.extend(walkers.into_iter().map(|w| (None, w.class, w.size, w.course)));
        let pairs = overlaps(&crowd, 10.5);
        assert!(
            pairs.len() <= 2,
            "seed {seed}: {} of {} touch",
            pairs.len(),
            crowd.len()
        );
    }
}

#[test]
fn nobody_touches_what_stands_beside_the_road() {
    for_each_traffic(|place, traffic, seed| {
        for k in 0..6 {
            for (i, state) in there(traffic, f64::from(k)) {
                let user = &traffic.users[i];
                for fixture in &place.fixtures {
                    // Crowns and plates are above everybody's head: compare what stands within 1.8 m of the ground.
                    let (pose, size) = fixture.footprint();
                    let touches = touch(state.pose, user.size, pose, size);
                    assert!(
                        !touches,
                        "seed {seed}: {:?} at {:?} touches {:?}",
                        user.class, state.pose, pose
                    );
                }
            }
        }
    });
}

/// Front of a vehicle as (arm, distance from the centre) while it comes in.
fn coming_in(place: &Scenery, user: &User, state: &State) -> Option<(usize, f64)> {
    let Pose2 { x, y, heading } = state.pose;
    let (sin, cos) = libm::sincos(heading);
    let (x, y) = (x + 0.5 * user.size[0] * cos, y + 0.5 * user.size[0] * sin);
    let arm = match () {
        () if cos < -0.99 => 0,
        () if sin < -0.99 => 1,
        () if cos > 0.99 => 2,
        () if sin > 0.99 => 3,
        () => return None,
    };
    let along = [x, y, -x, -y][arm];
    let across = if arm % 2 == 0 { y.abs() } else { x.abs() };
    (along > -2.0 && across < place.grid().half[arm % 2]).then_some((arm, along))
}

#[test]
fn vehicles_obey_red_lights() {
    let passed = std::cell::Cell::new(0);
    for_each_traffic(|place, traffic, seed| {
        let lights = Lights::new(place.grid().grid, seed);
        for user in traffic.users.iter().filter(|user| !user.class.walks()) {
            for k in 0..400 {
                let t = f64::from(k) * 0.05;
                let (Some(before), Some(after)) = (user.course.at(t), user.course.at(t + 0.05)) else {
                    continue;
                };
                let fronts = (coming_in(place, user, &before), coming_in(place, user, &after));
                let (Some((arm, from)), Some((_, to))) = fronts else {
                    continue;
                };
                let stop = place.grid().stop(arm % 2);
                if from > stop && to <= stop {
                    passed.set(passed.get() + 1);
                    let turned = user
                        .course
                        .at(t + 7.0)
                        .map(|later| libm::sin(later.pose.heading - after.pose.heading));
                    let left = lights.arrow_or_its_yellow(arm % 2, t) && turned.is_none_or(|sin| sin > 0.1);
                    let fine = lights.show(arm % 2, t) != Light::Red || left;
                    assert!(fine, "seed {seed}: {:?} passes a red light at {t} s", user.class);
                }
            }
        }
    });
    assert!(passed.get() > 100, "only {} vehicles passed a light", passed.get());
}

#[test]
fn walkers_keep_to_pavements_and_crossings() {
    let crossing = std::cell::Cell::new(0);
    for_each_traffic(|place, traffic, seed| {
        for k in 0..100 {
            for (i, state) in there(traffic, f64::from(k) * 0.2) {
                let Pose2 { x, y, .. } = state.pose;
                if !traffic.users[i].class.walks() || place.grid().raised(x, y) {
                    continue;
                }
                crossing.set(crossing.get() + 1);
                assert!(
                    place.grid().on_crossing(x, y, 0.3),
                    "seed {seed}: a walker on the road at {x} {y}"
                );
            }
        }
    });
    assert!(crossing.get() > 100, "only {} steps on a crossing", crossing.get());
}

#[test]
fn walkers_set_out_only_when_they_may() {
    for_each_traffic(|place, traffic, seed| {
        let lights = Lights::new(place.grid().grid, seed);
        for (k, user) in (0..190).flat_map(|k| traffic.users.iter().map(move |user| (k, user))) {
            let t = f64::from(k) * 0.1;
            let (Some(a), Some(b)) = (user.course.at(t), user.course.at(t + 0.1)) else {
                continue;
            };
            let on_road = |s: &State| place.grid().inside_kerb(s.pose.x, s.pose.y) < 0.0;
            if user.class.walks() && !on_road(&a) && on_road(&b) {
                let axis = if libm::sin(b.pose.heading).abs() > 0.7 { 0 } else { 1 };
                let crosses = place.grid().half[axis] - [b.pose.y.abs(), b.pose.x.abs()][axis] < 1.0;
                assert!(
                    crosses && lights.show(axis, t) == Light::Red,
                    "seed {seed}: a walker steps out at {t} s"
                );
            }
        }
    });
}

#[test]
fn dense_traffic_has_at_least_120_road_users_at_all_times() {
    for Sample {
        place,
        traffic,
        seed,
        dense,
    } in samples()
    {
        for k in 0..=20 {
            let count = there(traffic, f64::from(k)).len();
            let min = if *dense { 120 } else { 35 };
            assert!(count >= min, "seed {seed} {:?}: {count} road users", place.grid().grid);
        }
    }
}

#[test]
fn cavs_come_by_two_arms_and_stay_near_each_other() {
    for_each_traffic(|place, traffic, seed| {
        let [a, b] = traffic.cavs.map(|i| &traffic.users[i]);
        let (rsu, _) = place.roadside(false);
        let near = |p: Pose2, q: Pose2| (p.x - q.x) * (p.x - q.x) + (p.y - q.y) * (p.y - q.y) < 70.0 * 70.0;
        let together = (0..=20)
            .map(|k| [a, b].map(|user| user.course.at(f64::from(k) * 0.5).unwrap().pose))
            .filter(|[p, q]| near(*p, *q) && near(*p, rsu) && near(*q, rsu))
            .count();
        let scenario = place.grid().grid;
        assert!(
            together >= 13,
            "seed {seed} {scenario:?}: together for {together} of 21 looks"
        );
        let [p, q] = [a, b].map(|user| user.course.at(0.0).unwrap().pose.heading);
        assert!(libm::cos(p - q) < 0.5, "seed {seed}: both come by the same arm");
    });
}

#[test]
fn cavs_turn_round_and_stay_for_minutes() {
    let place = Scenery::on_grid(Grid::Intersection, 5);
    let traffic = Traffic::new(&Demand {
        place: &place,
        seed: 5,
        dense: true,
        seconds: 150.0,
        rounded_bodies: false,
    })
    .unwrap();
    for cav in traffic.cavs {
        let user = &traffic.users[cav];
        let mut gone = 0.0;
        for k in -2..1500 {
            let state = user.course.at(f64::from(k) * 0.1).expect("a cav stays in the place");
            assert!(state.pose.x.abs() < 205.0 && state.pose.y.abs() < 205.0);
            assert!(state.speed > -1e-6 && state.speed < 15.0);
            gone = state.gone;
        }
        assert!(gone > 300.0, "a cav got only {gone} m far in 150 s");
    }
}
