use proptest::prelude::*;

use super::*;
use crate::town::{Block, SENSOR, Town, pose};

const SECOND: Nanos = 1_000_000_000;

/// Builds from sweeps at `(second, x)` of the town that is there then.
fn build(drive: impl IntoIterator<Item = (f64, f64)>, town: impl Fn(f64) -> Town, settings: MapSettings) -> VoxelMap {
    let mut builder = MapBuilder::new(settings, "map").unwrap();
    for (second, x) in drive {
        let map_from_body = pose(x, 0.0, 0.0);
        let cloud = town(second).sweep(&map_from_body, 48, 600, second.to_bits());
        let sweep = PosedSweep {
            agent: "cav1",
            stamp: (second * SECOND as f64) as Nanos,
            cloud: &cloud,
            map_from_body: &map_from_body,
            sensor: SENSOR,
            sigmas: [0.0; 3],
        };
        builder.add(&sweep).unwrap();
    }
    builder.finish(|_, _| ()).unwrap()
}

/// Five sweeps a second along 10 m of street in 6 s.
fn drive() -> impl Iterator<Item = (f64, f64)> {
    (0..30).map(|i| (f64::from(i) * 0.2, f64::from(i) / 3.0))
}

/// Voxels whose means lie in a part of the ground plane, higher than 0.6 m.
fn standing(map: &VoxelMap, [x0, x1]: [f64; 2], [y0, y1]: [f64; 2]) -> usize {
    let inside = |voxel: &crate::Voxel| {
        let mean = voxel.mean;
        mean.x > x0 && mean.x < x1 && mean.y > y0 && mean.y < y1 && mean.z > 0.6
    };
    map.voxels().filter(inside).count()
}

#[test]
fn what_stands_is_in_the_map_where_it_stands() {
    let town = Town(vec![Block::new([5.0, 12.0], [40.0, 2.0], 6.0, 0.0)]);
    let map = build(drive(), |_| town.clone(), MapSettings::default());
    let mut walls = 0;
    for voxel in map.voxels() {
        let on_wall = voxel.mean.z > 0.6 && voxel.mean.y > 10.9 && voxel.mean.y < 11.1;
        let on_ground = voxel.mean.z.abs() < 0.6;
        assert!(on_wall || on_ground, "{voxel:?}");
        if on_wall && voxel.is_planar {
            assert!(
                voxel.normal.y.abs() > 0.99 && (voxel.mean.y - 11.0).abs() < 0.02,
                "{voxel:?}"
            );
            walls += 1;
        }
    }
    assert!(walls > 100, "{walls}");
    let info = map.info();
    assert_eq!(
        (info.sweeps, info.span, info.frame.as_str()),
        (30, [0, 29 * SECOND / 5], "map")
    );
}

#[test]
fn what_drives_waits_and_leaves_or_follows_another_is_left_out_and_what_is_parked_stays() {
    let street = Town::street(1, -40.0, 60.0);
    let parked = Block::car([12.0, -6.3]);
    let town = |second: f64| {
        let oncoming = Block::car([60.0 - 12.0 * second, 3.0]);
        let behind_it = Block::car([90.0 - 12.0 * second, 3.0]);
        let waits = Block::car([
            if second < 2.5 {
                14.0
            } else {
                14.0 + 25.0 * (second - 2.5)
            },
            -3.0,
        ]);
        [oncoming, behind_it, waits, parked]
            .iter()
            .fold(street.clone(), |town, block| town.with(*block))
    };
    let map = build(drive(), town, MapSettings::default());
    let (lane, place) = ([2.0, 4.0], [-4.0, -2.0]);
    assert_eq!(standing(&map, [0.0, 25.0], lane), 0, "the oncoming lane");
    assert_eq!(standing(&map, [10.0, 17.0], place), 0, "where one waited");
    assert!(standing(&map, [9.0, 15.0], [-7.5, -5.0]) >= 4, "the parked car");
    // Whoever only asks how often a cell was hit keeps some of them.
    let all = MapSettings {
        empty_share: 1.0,
        ..MapSettings::default()
    };
    let map = build(drive(), town, all);
    assert!(standing(&map, [10.0, 17.0], place) > 0);
}

#[test]
fn half_a_kilometre_of_street_takes_less_than_three_megabytes() {
    let town = Town::street(2, -60.0, 560.0);
    let map = build(
        (0..120).map(|i| (f64::from(i) * 0.5, f64::from(i) * 500.0 / 120.0)),
        |_| town.clone(),
        MapSettings::default(),
    );
    assert!(map.len() > 10_000, "{}", map.len());
    assert!(map.as_bytes().len() < 3_000_000, "{} bytes", map.as_bytes().len());
}

#[test]
fn sweeps_that_are_nowhere_are_refused_and_leave_the_map_as_it_was() {
    let town = Town::street(3, -40.0, 60.0);
    let cloud = town.sweep(&pose(0.0, 0.0, 0.0), 48, 600, 1);
    let mut builder = MapBuilder::new(MapSettings::default(), "map").unwrap();
    let mut add = |x: f64, stamp: Nanos| {
        let sweep = PosedSweep {
            agent: "cav1",
            stamp,
            cloud: &cloud,
            map_from_body: &pose(x, 0.0, 0.0),
            sensor: SENSOR,
            sigmas: [0.0; 3],
        };
        builder.add(&sweep)
    };
    add(1e6, 0).unwrap();
    for x in [f64::NAN, f64::INFINITY, 1e9] {
        assert!(matches!(add(x, 1), Err(BuildError::Pose { stamp: 1, .. })), "{x}");
    }
    let far = add(0.0, 2).unwrap_err().to_string();
    assert!(far.contains("`cav1`") && far.contains("1000000 m away"), "{far}");
    assert_eq!(builder.sweeps(), 1);
    let error = builder.finish(|_, _| ()).unwrap_err().to_string();
    assert!(error.contains("in 1 sweeps, expected each in 3 sweeps"), "{error}");
}

#[test]
fn settings_out_of_range_are_named() {
    let of = |settings: MapSettings| settings.check().unwrap_err().to_string();
    let wrong = MapSettings {
        voxel_m: f64::NAN,
        ..MapSettings::default()
    };
    assert_eq!(of(wrong), "setting `voxel_m`: expected 0.05 to 10, found NaN");
    let wrong = MapSettings {
        range_m: [50.0, 20.0],
        ..MapSettings::default()
    };
    assert!(of(wrong).contains("`range_m, far`"));
    assert_eq!(MapSettings::default().check(), Ok(()));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20))]
    /// Points on a plane through anything are found again, wherever the first sweep was.
    #[test]
    fn means_do_not_depend_on_how_far_the_origin_is(x in -1e7f64..1e7, y in -1e7f64..1e7, z in -1e3f64..1e3) {
        let points: Vec<[f32; 3]> = (0..2000).map(|i| [6.0 + (i % 50) as f32 * 0.1, (i / 50) as f32 * 0.1, 0.0]).collect();
        let column = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let n = points.len();
        let cloud = PointCloud::new(column(0), column(1), column(2), vec![0; n], vec![0; n], vec![0; n]).unwrap();
        let settings = MapSettings { min_sweeps: 1, apart_s: 0.0, ..MapSettings::default() };
        let mut builder = MapBuilder::new(settings, "map").unwrap();
        let map_from_body = Isometry3::translation(x, y, z);
        builder.add(&PosedSweep { agent: "a", stamp: 0, cloud: &cloud, map_from_body: &map_from_body, sensor: SENSOR, sigmas: [0.0; 3] }).unwrap();
        let map = builder.finish(|_, _| ()).unwrap();
        for voxel in map.voxels().filter(|voxel| voxel.points > 50) {
            prop_assert!((voxel.mean.z - z).abs() < 1e-4, "{voxel:?}");
            prop_assert!(voxel.is_planar && voxel.normal.z > 0.9999);
        }
    }
}
