use super::lanes::Kind;
use super::*;
use crate::Scenario;
use crate::bodies::Class;
use crate::path::State;
use crate::path::TICK;
use crate::path::angle_within;
use crate::place::Scenery;
use crate::traffic::touch;
use crate::traffic::{Traffic, User, overlaps};

/// Length of the shared simulations, s.
const SECONDS: f64 = 14.0;

struct Sample {
    place: Scenery,
    traffic: Traffic,
    /// Pairs that would have touched, of which one moves.
    met: usize,
    /// Pairs that stand in each other.
    jammed: usize,
    seed: u64,
    dense: bool,
}

impl Sample {
    fn name(&self) -> String {
        format!(
            "{} {}{}",
            self.place.scenario.name(),
            self.seed,
            if self.dense { ", dense" } else { "" }
        )
    }
}

/// Places and traffic that all tests look at, made once.
fn samples() -> &'static [Sample] {
    static SAMPLES: std::sync::OnceLock<Vec<Sample>> = std::sync::OnceLock::new();
    SAMPLES.get_or_init(|| {
        let seeds = std::env::var("SEEDS").map_or(2, |n| n.parse().unwrap());
        let all = Scenario::NETWORKS
            .into_iter()
            .flat_map(|scenario| (0..seeds).map(move |seed| (scenario, seed)));
        all.map(|(scenario, seed)| {
            let (place, dense) = (Scenery::new(scenario, seed), seed % 2 == 1);
            let demand = Demand {
                place: &place,
                seed,
                dense,
                seconds: SECONDS,
                rounded_bodies: false,
            };
            let crowd = crowd(&demand, place.network(), SECONDS + 0.5).unwrap();
            let stands = |i: usize| matches!(crowd[i].3, Course::Fixed(_));
            let (jammed, met): (Vec<_>, Vec<_>) = (overlaps(&crowd, SECONDS).into_iter())
                .inspect(|(i, j)| println!("{scenario:?} {seed}: {:?} and {:?}", crowd[*i].1, crowd[*j].1))
                .partition(|(i, j)| stands(*i) && stands(*j));
            Sample {
                met: met.len(),
                jammed: jammed.len(),
                traffic: Traffic::assemble(crowd, &demand, SECONDS + 0.5),
                place,
                seed,
                dense,
            }
        })
        .collect()
    })
}

fn there(traffic: &Traffic, t: f64) -> Vec<(usize, State)> {
    let at = |(i, user): (usize, &User)| user.course.at(t).map(|state| (i, state));
    traffic.users.iter().enumerate().filter_map(at).collect()
}

#[test]
fn no_two_bodies_overlap() {
    for sample in samples() {
        let users = &sample.traffic.users;
        for k in 0..=70 {
            let there = there(&sample.traffic, f64::from(k) * 0.2 - 0.2);
            for (n, (i, a)) in there.iter().enumerate() {
                for (j, b) in &there[n + 1..] {
                    let overlap = touch(a.pose, users[*i].size, b.pose, users[*j].size);
                    assert!(
                        !overlap,
                        "{}: {:?} and {:?}",
                        sample.name(),
                        users[*i].class,
                        users[*j].class
                    );
                }
            }
        }
    }
}

#[test]
fn nobody_stands_in_another_or_in_a_parked_vehicle() {
    for sample in samples() {
        assert_eq!(sample.jammed, 0, "{}", sample.name());
    }
}

/// How many of a class are in the samples of a place.
fn count(scenario: Scenario, class: Class) -> usize {
    let of_place = samples().iter().filter(|sample| sample.place.scenario == scenario);
    let of_class = |sample: &Sample| sample.traffic.users.iter().filter(|user| user.class == class).count();
    of_place.map(of_class).sum()
}

#[test]
fn places_have_the_road_users_that_belong_there() {
    use Scenario::*;
    let cases: [(Class, &[Scenario]); 3] = [
        (Class::Articulated, &[Motorway]),
        (Class::Tricycle, &[Residential, Market]),
        (Class::Pram, &[Residential, Market, Avenue]),
    ];
    for (class, places) in cases {
        for place in places {
            assert!(count(*place, class) > 0, "no {class:?} in {}", place.name());
        }
    }
}

/// Places of those who walk or stand, at some time.
fn on_foot(sample: &Sample, t: f64, standing: bool) -> Vec<Pose2> {
    let on_foot = |(i, state): (usize, State)| {
        let user = &sample.traffic.users[i];
        let stands = matches!(user.course, Course::Fixed(_));
        (user.class.walks() && stands == standing).then_some(state.pose)
    };
    there(&sample.traffic, t).into_iter().filter_map(on_foot).collect()
}

#[test]
fn people_go_and_stand_in_groups_and_between_parked_cars() {
    use Scenario::*;
    for scenario in Scenario::NETWORKS {
        let (mut walking, mut standing, mut hidden) = (0, 0, 0);
        for sample in samples().iter().filter(|sample| sample.place.scenario == scenario) {
            let surface = &sample.place.network().surface;
            // Closer than strangers come to each other.
            let close = |all: &[Pose2], reach: f64| {
                let near = |a: &Pose2, b: &Pose2| (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y) < reach * reach;
                let company = |a: &&Pose2| all.iter().filter(|b| near(a, b)).count() > 1;
                all.iter().filter(company).count()
            };
            walking += close(&on_foot(sample, 5.0, false), 0.94);
            let (in_bays, aside): (Vec<Pose2>, Vec<Pose2>) =
                (on_foot(sample, 5.0, true).into_iter()).partition(|pose| surface.off_road(pose.x, pose.y) <= 0.0);
            standing += close(&aside, 2.4);
            hidden += in_bays.len();
        }
        println!(
            "{}: {} prams, {} tricycles, {} trailers; {walking} in company, {standing} stand, {hidden} between cars",
            scenario.name(),
            count(scenario, Class::Pram),
            count(scenario, Class::Tricycle),
            count(scenario, Class::Articulated),
        );
        let wanted = |places: &[Scenario]| places.contains(&scenario);
        assert!(
            walking > 3 || !wanted(&[Market, Residential, Avenue, Junction]),
            "{}",
            scenario.name()
        );
        assert!(
            standing > 3 || !wanted(&[Market, Avenue, Junction]),
            "{}",
            scenario.name()
        );
        assert!(
            hidden > 1 || !wanted(&[Market, Residential, CarPark]),
            "{}",
            scenario.name()
        );
    }
}

#[test]
fn hardly_anybody_has_to_be_left_out_for_that() {
    let (mut pairs, mut all) = (0, 0);
    for sample in samples() {
        assert!(sample.met <= 3, "{}: {} pairs touch", sample.name(), sample.met);
        pairs += sample.met;
        all += sample.traffic.users.len();
    }
    assert!(pairs * 200 < all, "{pairs} of {all} touch");
}

#[test]
fn nobody_touches_what_stands_beside_the_road() {
    for sample in samples() {
        for k in 0..6 {
            for (i, state) in there(&sample.traffic, f64::from(k) * 2.0) {
                let user = &sample.traffic.users[i];
                for fixture in &sample.place.fixtures {
                    let (pose, size) = fixture.footprint();
                    let touches = touch(state.pose, user.size, pose, size);
                    assert!(
                        !touches,
                        "{}: {:?} of {:?} at {:?} touches {pose:?}",
                        sample.name(),
                        user.class,
                        user.size,
                        state.pose
                    );
                }
            }
        }
    }
}

#[test]
fn vehicles_keep_to_the_road() {
    for sample in samples() {
        let surface = &sample.place.network().surface;
        for k in 0..70 {
            for (i, state) in there(&sample.traffic, f64::from(k) * 0.2) {
                let user = &sample.traffic.users[i];
                if user.class.walks() {
                    continue;
                }
                let [length, width, _] = user.size;
                for (u, v) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
                    let corner = state.pose.at(u * length, v * width);
                    let off = surface.off_road(corner.x, corner.y);
                    // Long vehicles swing out in curves.
                    let most = if user.class.long() { 1.0 } else { 0.45 };
                    assert!(
                        off < most,
                        "{}: {:?} {off} m off the road at {:?}, {:.1} m/s",
                        sample.name(),
                        user.class,
                        state.pose,
                        state.speed
                    );
                }
            }
        }
    }
}

#[test]
fn walkers_keep_to_pavements_and_crossings() {
    let mut crossing = 0;
    for sample in samples() {
        let network = sample.place.network();
        for k in 0..70 {
            for (i, state) in there(&sample.traffic, f64::from(k) * 0.2) {
                let Pose2 { x, y, .. } = state.pose;
                if !sample.traffic.users[i].class.walks() || network.surface.off_road(x, y) > 0.0 {
                    continue;
                }
                if matches!(sample.traffic.users[i].course, Course::Fixed(_)) {
                    let bays = network.roads.iter().flat_map(|road| road.stands());
                    let nearest = bays
                        .map(|(bay, _)| (bay.x - x) * (bay.x - x) + (bay.y - y) * (bay.y - y))
                        .fold(f64::INFINITY, f64::min);
                    assert!(
                        nearest < 3.6 * 3.6,
                        "{}: somebody stands on the road at {x} {y}",
                        sample.name()
                    );
                    continue;
                }
                crossing += 1;
                let on = network.nodes.iter().any(|node| {
                    node.arms.iter().enumerate().any(|(a, arm)| {
                        let Some(middle) = arm.crossing else { return false };
                        let frame = node.place(a, middle, 0.0);
                        let (sin, cos) = libm::sincos(frame.heading);
                        let (dx, dy) = (x - frame.x, y - frame.y);
                        let half = network.roads[arm.road].section.half();
                        (dx * cos + dy * sin).abs() < 1.8 && (dy * cos - dx * sin).abs() < half + 0.6
                    })
                });
                assert!(on, "{}: a walker on the road at {x} {y}", sample.name());
            }
        }
    }
    assert!(crossing > 100, "only {crossing} steps on a crossing");
}

#[test]
fn vehicles_move_as_vehicles_do() {
    for sample in samples() {
        let network = sample.place.network();
        let fastest = network.roads.iter().map(|road| road.section.limit).fold(0.0, f64::max);
        for user in sample.traffic.users.iter().filter(|user| !user.class.walks()) {
            let Course::Moving(motion) = &user.course else { continue };
            let name = sample.name();
            for pair in motion.ticks.windows(2) {
                let acceleration = (pair[1].1 - pair[0].1) / TICK;
                assert!((-8.5..=2.5).contains(&acceleration), "{name}: {acceleration} m/s²");
                assert!(pair[1].0 >= pair[0].0, "{name}: backwards");
                assert!(pair[0].1 < 1.15 * fastest, "{name}: {} m/s", pair[0].1);
            }
            for k in 0..140 {
                let t = f64::from(k) * 0.1;
                let (Some(now), Some(then)) = (user.course.at(t), user.course.at(t + 0.05)) else {
                    continue;
                };
                let aside = now.speed * now.turn_rate;
                assert!(
                    aside.abs() < 5.0,
                    "{name}: {aside} m/s² aside at {:?} of {:?}",
                    now.pose,
                    user.class
                );
                let (dx, dy) = (then.pose.x - now.pose.x, then.pose.y - now.pose.y);
                let moved = (dx * dx + dy * dy).sqrt();
                assert!(
                    (moved - now.speed * 0.05).abs() < 0.05,
                    "{name}: jumps {moved} m at {} m/s",
                    now.speed
                );
                let turned = angle_within(then.pose.heading - now.pose.heading).abs();
                assert!(
                    turned < 0.3 * moved + 1e-3,
                    "{name}: {:?} turns {turned} in {moved} m at {:?}",
                    user.class,
                    now
                );
            }
        }
    }
}

#[test]
fn lanes_join_smoothly() {
    for sample in samples() {
        let lanes = Lanes::new(sample.place.network());
        for lane in &lanes.lanes {
            let end = lane.path.at(lane.path.length()).0;
            for (next, _) in &lane.next {
                let begin = lanes.lanes[*next].path.at(0.0).0;
                let off = (end.x - begin.x).abs() + (end.y - begin.y).abs();
                let turn = angle_within(end.heading - begin.heading).abs();
                assert!(off < 1e-6 && turn < 1e-6, "{}: {off} m, {turn} rad", sample.name());
            }
            let min = if lane.kind == Kind::Cycle { 2.0 } else { 3.2 };
            assert!(
                lane.tightest > min,
                "{}: {:?} with {} m",
                sample.name(),
                lane.kind,
                lane.tightest
            );
            assert!(!lane.next.is_empty() || lane.exit.is_some() || lane.beside[0].is_some());
        }
    }
}

#[test]
fn vehicles_obey_red_lights() {
    let mut passed = 0;
    for sample in samples() {
        let network = sample.place.network();
        let lights = flow::signals(network, sample.seed);
        for (n, node) in network.nodes.iter().enumerate() {
            let Some(lights) = &lights[n] else { continue };
            for (a, arm) in node.arms.iter().enumerate() {
                let frame = node.place(a, arm.mouth, 0.0);
                let half = network.roads[arm.road].section.half();
                // How far the front is before the stop line, for those who come in by this arm.
                let before = |user: &User, t: f64| {
                    let front = user.course.at(t)?.pose.at(0.5 * user.size[0], 0.0);
                    let (sin, cos) = libm::sincos(frame.heading);
                    let (dx, dy) = (front.x - frame.x, front.y - frame.y);
                    let inwards = libm::cos(front.heading - frame.heading) < -0.7;
                    (inwards && (dy * cos - dx * sin).abs() < half).then_some(dx * cos + dy * sin)
                };
                for user in sample.traffic.users.iter().filter(|user| !user.class.walks()) {
                    for k in 0..280 {
                        let t = f64::from(k) * 0.05;
                        let (Some(from), Some(to)) = (before(user, t), before(user, t + 0.05)) else {
                            continue;
                        };
                        if from > 0.0 && to <= 0.0 && from < 3.0 {
                            passed += 1;
                            let fine = lights.green_or_yellow(arm.phase, t);
                            assert!(fine, "{}: {:?} passes a red light at {t} s", sample.name(), user.class);
                        }
                    }
                }
            }
        }
    }
    assert!(passed > 10, "only {passed} vehicles passed a light");
}

#[test]
fn cavs_come_by_two_lanes_and_stay_near_each_other() {
    for sample in samples() {
        let [a, b] = sample.traffic.cavs.map(|i| &sample.traffic.users[i]);
        let (rsu, _) = sample.place.roadside(false);
        let near = sample.place.network().mix.near + 5.0;
        let within =
            |p: Pose2, q: Pose2, reach: f64| (p.x - q.x) * (p.x - q.x) + (p.y - q.y) * (p.y - q.y) < reach * reach;
        let together = (0..=20)
            .map(|k| [a, b].map(|user| user.course.at(f64::from(k) * 0.5).unwrap().pose))
            .filter(|[p, q]| within(*p, *q, 70.0) && within(*p, rsu, near) && within(*q, rsu, near))
            .count();
        let min = if sample.place.scenario == Scenario::Motorway {
            7
        } else {
            12
        };
        println!("{}: together for {together} of 21", sample.name());
        assert!(
            together >= min,
            "{}: together for {together} of 21 looks",
            sample.name()
        );
    }
}

#[test]
fn traffic_flows_and_is_as_heavy_as_asked_for() {
    for sample in samples() {
        let count = there(&sample.traffic, 5.0).len();
        let moved = |user: &&User| {
            let (Some(a), Some(b)) = (user.course.at(0.0), user.course.at(SECONDS)) else {
                return false;
            };
            (a.pose.x - b.pose.x).abs() + (a.pose.y - b.pose.y).abs() > 5.0
        };
        let drives = |user: &&User| matches!(user.course, Course::Moving(_)) && !user.class.walks();
        let driving: Vec<&User> = sample.traffic.users.iter().filter(drives).collect();
        let stays: Vec<&User> = driving
            .iter()
            .copied()
            .filter(|u| u.course.at(0.0).is_some() && u.course.at(SECONDS).is_some())
            .collect();
        let going = stays.iter().copied().filter(|user| moved(user)).count();
        let speeds: Vec<f64> = driving
            .iter()
            .filter_map(|u| u.course.at(10.0))
            .map(|state| state.speed)
            .collect();
        let mean = speeds.iter().sum::<f64>() / speeds.len() as f64;
        println!(
            "{}: {count} road users, {} driving, {going} of {} get on, {mean:.1} m/s",
            sample.name(),
            speeds.len(),
            stays.len()
        );
        assert!(
            count >= if sample.dense { 40 } else { 12 },
            "{}: {count} road users",
            sample.name()
        );
        assert!(
            going * 4 >= stays.len(),
            "{}: {going} of {} get on",
            sample.name(),
            stays.len()
        );
    }
}

#[test]
fn cavs_turn_round_and_stay_for_minutes() {
    // The places where one comes back soonest.
    for scenario in [
        Scenario::Tee,
        Scenario::Residential,
        Scenario::Motorway,
        Scenario::Market,
    ] {
        let place = Scenery::new(scenario, 5);
        let demand = Demand {
            place: &place,
            seed: 5,
            dense: false,
            seconds: 80.0,
            rounded_bodies: false,
        };
        let traffic = Traffic::new(&demand).unwrap();
        for cav in traffic.cavs {
            let user = &traffic.users[cav];
            let mut gone = 0.0;
            for k in -2..800 {
                let state = user.course.at(f64::from(k) * 0.1).expect("a cav stays in the place");
                gone = state.gone;
            }
            println!("{}: {gone:.0} m", scenario.name());
            assert!(gone > 60.0, "{}: a cav got only {gone} m far in 80 s", scenario.name());
        }
    }
}

/// Shares of vehicles whose headings are over 5° and 20° off a cav's axes, from the cavs and over time.
#[test]
fn headings_are_spread() {
    let (mut over_5, mut over_20, mut all) = (0, 0, 0);
    for scenario in Scenario::NETWORKS {
        let mut own = [0; 3];
        for sample in samples().iter().filter(|sample| sample.place.scenario == scenario) {
            for k in 0..5 {
                let t = f64::from(k) * 2.0;
                for cav in sample.traffic.cavs {
                    let ego = sample.traffic.users[cav].course.at(t).unwrap().pose;
                    for (i, state) in there(&sample.traffic, t) {
                        let (dx, dy) = (state.pose.x - ego.x, state.pose.y - ego.y);
                        let user = &sample.traffic.users[i];
                        if i == cav || user.class.walks() || dx * dx + dy * dy > 70.0 * 70.0 {
                            continue;
                        }
                        let quarter = std::f64::consts::FRAC_PI_2;
                        let off = (state.pose.heading - ego.heading).rem_euclid(quarter);
                        let off = off.min(quarter - off).to_degrees();
                        own[0] += 1;
                        own[1] += usize::from(off > 5.0);
                        own[2] += usize::from(off > 20.0);
                    }
                }
            }
        }
        let share = |k: usize| 100 * own[k] / own[0];
        println!("{}: {} % over 5°, {} % over 20°", scenario.name(), share(1), share(2));
        over_5 += own[1];
        over_20 += own[2];
        all += own[0];
    }
    println!(
        "all: {} % over 5°, {} % over 20°",
        100 * over_5 / all,
        100 * over_20 / all
    );
    assert!(over_5 * 100 > 70 * all && over_20 * 100 > 40 * all);
}
