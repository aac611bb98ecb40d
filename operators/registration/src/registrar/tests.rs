use std::sync::OnceLock;

use damage::Draw;
use nalgebra::Point3;

use super::*;
use crate::town::{SENSOR, Town, pose};
use crate::{MapBuilder, MapSettings, PosedSweep};

/// A map of a town, from 20 sweeps along 20 m of it.
fn map_of(town: &Town) -> VoxelMap {
    let settings = MapSettings {
        apart_s: 0.0,
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, "map").unwrap();
    for i in 0..20 {
        let map_from_body = pose(f64::from(i) - 10.0, 0.3 * f64::from(i % 3), 0.02 * f64::from(i % 5));
        let cloud = town.sweep(&map_from_body, 64, 900, i as u64);
        let sweep = PosedSweep {
            agent: "cav1",
            stamp: i64::from(i) * 100_000_000,
            cloud: &cloud,
            map_from_body: &map_from_body,
            sensor: SENSOR,
            sigmas: [0.0; 3],
        };
        builder.add(&sweep).unwrap();
    }
    builder.finish(|_, _| ()).unwrap()
}

fn street() -> &'static (Town, VoxelMap) {
    static STREET: OnceLock<(Town, VoxelMap)> = OnceLock::new();
    STREET.get_or_init(|| {
        let town = Town::street(10, -100.0, 100.0);
        let map = map_of(&town);
        (town, map)
    })
}

fn registrar() -> Registrar {
    Registrar::new(RegistrarSettings::default()).unwrap()
}

/// How far a pose is off: m, degrees.
fn off(found: &Isometry3<f64>, truth: &Isometry3<f64>) -> [f64; 2] {
    let shift = (found.translation.vector - truth.translation.vector).norm();
    [shift, found.rotation.angle_to(&truth.rotation).to_degrees()]
}

/// A sweep of the street and its pose, by a seed.
fn taken(seed: u64) -> (PointCloud, Isometry3<f64>) {
    let mut draw = Draw::new(seed);
    let mut number = |most: f64| most * (draw.below(2_000_001) as f64 * 1e-6 - 1.0);
    let truth = pose(number(9.0), number(1.5), number(0.1));
    (street().0.sweep(&truth, 64, 900, seed), truth)
}

/// A guess that is `shift` m and `turn_deg` degrees off, in directions of the seed.
fn guess(truth: &Isometry3<f64>, seed: u64, shift: f64, turn_deg: f64) -> Isometry3<f64> {
    let mut draw = Draw::new(seed + 1_000_000);
    let angle = std::f64::consts::TAU * draw.below(1_000_000) as f64 * 1e-6;
    let turn = turn_deg.to_radians() * if draw.chance(2) { 1.0 } else { -1.0 };
    pose(
        truth.translation.x + shift * libm::cos(angle),
        truth.translation.y + shift * libm::sin(angle),
        truth.rotation.euler_angles().2 + turn,
    )
}

/// A sweep of the street, its pose, and a guess that is off.
fn case(seed: u64, shift: f64, turn_deg: f64) -> (PointCloud, Isometry3<f64>, Isometry3<f64>) {
    let (cloud, truth) = taken(seed);
    let guess = guess(&truth, seed, shift, turn_deg);
    (cloud, truth, guess)
}

/// How many of ten guesses end within 5 cm; those that do not must not look as if they did.
fn found(sweeps: &[(PointCloud, Isometry3<f64>)], search: Search, shift: f64, turn_deg: f64) -> usize {
    let ends = |(seed, (cloud, truth)): (u64, &(PointCloud, Isometry3<f64>))| {
        let guess = guess(truth, seed, shift, turn_deg);
        let alignment = registrar().align(&street().1, cloud, &guess, search).unwrap();
        let [shift, turn] = off(&alignment.map_from_body, truth);
        let is_found = shift < 0.05 && turn < 0.1;
        assert_eq!(
            is_found,
            alignment.structure_share > 0.6,
            "{shift} m, {turn}°: {alignment:?}"
        );
        is_found
    };
    (100..).zip(sweeps).filter(|case| ends(*case)).count()
}

#[test]
fn tracking_is_right_to_a_centimetre_and_says_so() {
    for seed in 0..10 {
        let (cloud, truth, guess) = case(seed, 0.35, 0.6);
        let alignment = registrar().align(&street().1, &cloud, &guess, Search::Track).unwrap();
        let [shift, turn] = off(&alignment.map_from_body, &truth);
        assert!(shift < 0.01 && turn < 0.03, "{seed}: {shift} m, {turn}°, {alignment:?}");
        assert!(alignment.converged && alignment.iterations <= 12, "{alignment:?}");
        assert!(
            alignment.inlier_share > 0.8 && alignment.structure_share > 0.6,
            "{alignment:?}"
        );
        assert!(
            !alignment.is_degenerate() && alignment.mean_distance_m < 0.05,
            "{alignment:?}"
        );
    }
}

#[test]
fn the_basin_is_as_wide_as_measured() {
    let sweeps: Vec<_> = (100..110).map(taken).collect();
    for (search, shift, turn_deg, expected) in [
        (Search::Track, 0.5, 1.0, 10),
        (Search::Track, 1.0, 2.0, 8),
        (Search::Wide, 1.9, 3.5, 10),
        (Search::Wide, 3.2, 6.0, 10),
        (Search::Wide, 5.1, 9.0, 9),
    ] {
        let found = found(&sweeps, search, shift, turn_deg);
        assert!(
            found >= expected,
            "{search:?} from {shift} m and {turn_deg}° off: {found} of 10"
        );
    }
}

#[test]
fn a_sweep_is_found_in_any_direction_from_twelve_metres_away() {
    for seed in 200..206 {
        let (cloud, truth) = taken(seed);
        let around = Around {
            guess: guess(&truth, seed, 12.0, 50.0 * (seed - 199) as f64),
            radius_m: 15.0,
            turn_rad: std::f64::consts::PI,
        };
        let found = registrar().find(&street().1, &cloud, &around).unwrap();
        let [shift, turn] = off(&found.best.map_from_body, &truth);
        assert!(
            shift < 0.05 && turn < 0.1,
            "{seed}: {shift} m, {turn}°, {:.2} ahead",
            found.ahead
        );
        assert!(found.ahead > 0.08, "{seed}: {:.2} ahead", found.ahead);
    }
}

#[test]
fn between_walls_the_guess_is_kept_along_them() {
    let town = Town::walls();
    let map = map_of(&town);
    let (truth, guess) = (pose(0.0, 0.0, 0.0), pose(0.7, 0.2, 0.01));
    let alignment = registrar()
        .align(&map, &town.sweep(&truth, 64, 900, 1), &guess, Search::Track)
        .unwrap();
    assert!(alignment.is_degenerate());
    let [worst, others @ ..] = alignment.directions;
    assert!(worst.is_degenerate && worst.vector[0].abs() > 0.99, "{worst:?}");
    assert!(others.iter().all(|direction| !direction.is_degenerate), "{others:?}");
    let place = alignment.map_from_body.translation.vector;
    assert!(
        (place.x - 0.7).abs() < 0.03 && place.y.abs() < 0.01 && place.z.abs() < 0.01,
        "{place}"
    );
    let [_, turn] = off(&alignment.map_from_body, &truth);
    assert!(turn < 0.03, "{turn}°");
    // Who uses the information must see it too: a metre along the street is far less unlikely than a metre across.
    let information = alignment.information;
    assert!(information[(0, 0)] < 0.02 * information[(1, 1)], "{information}");
}

#[test]
fn threads_do_not_change_a_bit() {
    let (cloud, _, guess) = case(7, 1.5, 3.0);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            [Search::Track, Search::Wide].map(|search| registrar().align(&street().1, &cloud, &guess, search).unwrap())
        })
    };
    let one = on(1);
    assert!([2, 3, 7].into_iter().all(|threads| on(threads) == one));
}

#[test]
fn the_map_of_another_place_has_few_inliers() {
    let other = map_of(&Town::street(77, -100.0, 100.0));
    for (seed, search) in [
        (1, Search::Track),
        (2, Search::Track),
        (3, Search::Wide),
        (4, Search::Wide),
    ] {
        let (cloud, _, guess) = case(seed, 0.0, 0.0);
        let right = registrar().align(&street().1, &cloud, &guess, search).unwrap();
        let wrong = registrar().align(&other, &cloud, &guess, search).unwrap();
        let shares = [right.structure_share, wrong.structure_share];
        assert!(shares[0] > 0.6 && shares[1] < 0.3, "{shares:?}");
        let met = [right.met_share, wrong.met_share];
        assert!(met[0] > 0.9 && met[1] < 0.85, "{met:?}");
    }
}

#[test]
fn sweeps_of_too_few_points_are_refused() {
    let (cloud, _, guess) = case(1, 0.0, 0.0);
    let few = |n: usize| {
        let column = |column: &[f32]| column.iter().step_by(1000).take(n).copied().collect::<Vec<f32>>();
        let [x, y, z] = [&cloud.x, &cloud.y, &cloud.z].map(|axis| column(axis));
        PointCloud::new(x, y, z, vec![0; n], vec![0; n], vec![0; n]).unwrap()
    };
    for n in [0, 1, 50] {
        let error = registrar()
            .align(&street().1, &few(n), &guess, Search::Wide)
            .unwrap_err();
        assert!(
            matches!(error, AlignError::FewPoints { expected: 100, found, .. } if found <= n),
            "{error}"
        );
    }
    let words = registrar()
        .align(&street().1, &few(0), &guess, Search::Wide)
        .unwrap_err()
        .to_string();
    assert_eq!(words, "expected a sweep of 100 points or more in 2 to 100 m, found 0");
    let few_settings = RegistrarSettings {
        min_points: 10,
        ..RegistrarSettings::default()
    };
    let alignment = Registrar::new(few_settings)
        .unwrap()
        .align(&street().1, &few(50), &guess, Search::Track)
        .unwrap();
    assert!(
        alignment.points <= 50
            && alignment
                .map_from_body
                .translation
                .vector
                .iter()
                .all(|part| part.is_finite())
    );
}

#[test]
fn guesses_off_the_map_are_refused_and_where_nothing_is_the_guess_comes_back() {
    let (cloud, _, _) = case(1, 0.0, 0.0);
    let align = |x: f64| registrar().align(&street().1, &cloud, &pose(x, 0.0, 0.0), Search::Wide);
    assert!(matches!(align(f64::NAN), Err(AlignError::Guess(_))));
    assert!(matches!(align(1e7), Err(AlignError::OffMap { .. })));
    let away = align(5000.0).unwrap();
    assert_eq!(
        (away.inlier_share, away.structure_share, away.converged),
        (0.0, 0.0, false)
    );
    assert_eq!(away.map_from_body, pose(5000.0, 0.0, 0.0));
    assert!(away.is_degenerate() && away.information.iter().all(|value| *value == 0.0));
}

#[test]
fn steps_are_rigid_and_turn_about_the_body() {
    let start = pose(3.0, -2.0, 0.5);
    let end = stepped(&start, &[0.1, 0.2, -0.3, 0.02, -0.01, 0.03]);
    let moved = end * Point3::origin() - start * Point3::origin();
    assert!((moved - Vector3::new(0.1, 0.2, -0.3)).norm() < 1e-12);
    let turn = (end.rotation * start.rotation.inverse()).scaled_axis();
    assert!((turn - Vector3::new(0.02, -0.01, 0.03)).norm() < 1e-12, "{turn}");
    assert_eq!(stepped(&start, &[0.0; 6]).translation, start.translation);
}

#[test]
fn settings_out_of_range_are_named() {
    let wrong = RegistrarSettings {
        max_iterations: 0,
        ..RegistrarSettings::default()
    };
    let error = Registrar::new(wrong).unwrap_err().to_string();
    assert_eq!(error, "setting `max_iterations`: expected 1 to 1000, found 0");
}
