//! The sample of DAIR-V2X-C: what is imported, and the known answer of its labels, computed here from the log alone.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3, Vector3};
use realo_importer::{DairOptions, ImportError, Level, ROADSIDE, RoadsideStamp, VEHICLE, dair, read_pcd};
use realo_logs::{AgentKind, Log, Stream};
use realo_schemas::geometry::{View, yaw_of};
use realo_schemas::{Box3, Boxes, Nanos};
use serde_json::json;

fn sample() -> Option<PathBuf> {
    skipped::shared("data/dair")
}

fn imported(roadside_stamp: RoadsideStamp) -> Option<(tempfile::TempDir, Log)> {
    imported_as(DairOptions {
        roadside_stamp,
        ..DairOptions::default()
    })
}

fn imported_as(options: DairOptions) -> Option<(tempfile::TempDir, Log)> {
    let sample = sample()?;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("dair.mcap");
    let summary = dair(&sample, &path, options).unwrap();
    assert_eq!(
        (summary.pairs, summary.repeated_sweeps, summary.placeholders_dropped),
        (11, 0, 37)
    );
    assert_eq!(summary.truth_boxes, 300);
    Some((dir, Log::open(&path).unwrap()))
}

/// Everything of an agent's sweeps, in order.
#[derive(Clone)]
struct Sweep {
    stamp: Nanos,
    ready: Nanos,
    map_from_body: Isometry3<f64>,
    detections: Vec<Box3>,
    truth: Vec<Box3>,
    truth_views: Vec<View>,
    own: Vec<Box3>,
    own_views: Vec<View>,
}

fn sweeps(log: &Log, agent: &str) -> Vec<Sweep> {
    let streams = [
        Stream::Pose,
        Stream::Detections,
        Stream::DetectionsInfo,
        Stream::GroundTruth,
        Stream::GroundTruthInfo,
        Stream::GroundTruthViews,
        Stream::OwnLabels,
        Stream::OwnLabelsInfo,
        Stream::OwnLabelsViews,
    ];
    let wanted: Vec<(&str, Stream)> = streams
        .into_iter()
        .filter(|stream| log.has(agent, *stream))
        .map(|stream| (agent, stream))
        .collect();
    let mut reader = log.read_all(&wanted).unwrap();
    let mut found: BTreeMap<Nanos, Sweep> = BTreeMap::new();
    while let Some(entry) = reader.next().unwrap() {
        let new = || Sweep {
            stamp: entry.stamp(),
            ready: 0,
            map_from_body: Isometry3::identity(),
            detections: Vec::new(),
            truth: Vec::new(),
            truth_views: Vec::new(),
            own: Vec::new(),
            own_views: Vec::new(),
        };
        let sweep = found.entry(entry.stamp()).or_insert_with(new);
        let complete = |boxes: &mut Vec<Box3>| {
            let mut whole = Boxes(std::mem::take(boxes));
            let info = entry.info(&mut whole).unwrap();
            *boxes = whole.0;
            info
        };
        match entry.stream {
            Stream::Pose => sweep.map_from_body = entry.pose().unwrap().map_from_body,
            Stream::Detections => {
                sweep.detections = entry.boxes().unwrap().0;
                sweep.ready = entry.ready();
            }
            Stream::DetectionsInfo => {
                complete(&mut sweep.detections);
            }
            Stream::GroundTruth => sweep.truth = entry.boxes().unwrap().0,
            Stream::GroundTruthViews => sweep.truth_views = entry.views().unwrap(),
            Stream::OwnLabels => sweep.own = entry.boxes().unwrap().0,
            Stream::OwnLabelsInfo => {
                let info = complete(&mut sweep.own);
                assert!(info.key && info.points.is_none());
            }
            Stream::OwnLabelsViews => sweep.own_views = entry.views().unwrap(),
            _ => {
                let info = complete(&mut sweep.truth);
                assert!(info.key && info.points.is_none());
            }
        }
    }
    found.into_values().collect()
}

type Polygon = Vec<[f64; 2]>;

/// The four bottom corners of a box, moved as points, as the rule says.
fn footprint(to_from_from: &Isometry3<f64>, object: &Box3) -> Polygon {
    let (sin, cos) = object.yaw.sin_cos();
    let corners = [(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)];
    let corner = |(a, b): (f64, f64)| {
        let (u, v) = (a * object.length, b * object.width);
        let offset = Vector3::new(u * cos - v * sin, u * sin + v * cos, -object.height / 2.0);
        let moved = to_from_from * (Point3::from(object.center) + offset);
        [moved.x, moved.y]
    };
    corners.into_iter().map(corner).collect()
}

fn area(polygon: &[[f64; 2]]) -> f64 {
    let next = |i: usize| polygon[(i + 1) % polygon.len()];
    let twice: f64 = polygon
        .iter()
        .enumerate()
        .map(|(i, p)| p[0] * next(i)[1] - next(i)[0] * p[1])
        .sum();
    twice.abs() / 2.0
}

/// Clips a convex polygon by another (Sutherland and Hodgman), both clockwise.
fn clip(subject: &[[f64; 2]], window: &[[f64; 2]]) -> Polygon {
    let mut out = subject.to_vec();
    for i in 0..window.len() {
        let (a, b) = (window[i], window[(i + 1) % window.len()]);
        let side = |p: [f64; 2]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
        let input = std::mem::take(&mut out);
        for j in 0..input.len() {
            let (p, q) = (input[j], input[(j + 1) % input.len()]);
            let (sp, sq) = (side(p), side(q));
            if sp <= 0.0 {
                out.push(p);
            }
            if (sp < 0.0) != (sq < 0.0) && sp != sq {
                let t = sp / (sp - sq);
                out.push([p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])]);
            }
        }
    }
    out
}

fn iou(a: &[[f64; 2]], b: &[[f64; 2]]) -> f64 {
    let common = area(&clip(a, b));
    common / (area(a) + area(b) - common)
}

fn in_region(polygon: &Polygon) -> bool {
    polygon.iter().all(|[x, y]| x.abs() <= 100.0 && y.abs() <= 40.0)
}

fn vehicles(to_from_from: &Isometry3<f64>, boxes: &[Box3]) -> Vec<Polygon> {
    let is_vehicle = |object: &&Box3| ["car", "van", "truck", "bus"].contains(&object.class.to_lowercase().as_str());
    boxes
        .iter()
        .filter(is_vehicle)
        .map(|object| footprint(to_from_from, object))
        .filter(in_region)
        .collect()
}

fn suppress(boxes: Vec<Polygon>) -> Vec<Polygon> {
    let mut kept: Vec<Polygon> = Vec::new();
    for candidate in boxes {
        if kept.iter().all(|known| iou(known, &candidate) <= 0.15) {
            kept.push(candidate);
        }
    }
    kept
}

fn score(detections: &[Polygon], truth: &[Polygon]) -> [usize; 2] {
    let mut free: Vec<&Polygon> = truth.iter().collect();
    let mut counts = [0, 0];
    for detection in detections {
        let best = (0..free.len()).max_by(|a, b| iou(detection, free[*a]).total_cmp(&iou(detection, free[*b])));
        match best.filter(|best| iou(detection, free[*best]) >= 0.5) {
            Some(best) => {
                free.remove(best);
                counts[0] += 1;
            }
            None => counts[1] += 1,
        }
    }
    counts
}

/// Truth; vehicle alone, roadside alone, both, each true and false; roadside positions moved by `shift` times the offset.
fn known_answer(log: &Log, offsets: &[[f64; 2]], shift: f64) -> (usize, [[usize; 2]; 3]) {
    let (ego, other) = (sweeps(log, VEHICLE), sweeps(log, ROADSIDE));
    assert_eq!((ego.len(), other.len(), offsets.len()), (11, 11, 11));
    let mut objects = 0;
    let mut counts = [[0; 2]; 3];
    for ((ego, other), offset) in ego.iter().zip(&other).zip(offsets) {
        assert!((ego.stamp - other.stamp).abs() <= 30_000_000, "pairs stay together");
        let mut map_from_other = other.map_from_body;
        map_from_other.translation.vector += Vector3::new(offset[0], offset[1], 0.0) * shift;
        let truth = vehicles(&Isometry3::identity(), &ego.truth);
        let own = vehicles(&Isometry3::identity(), &ego.detections);
        let theirs = vehicles(&ego.map_from_body.inv_mul(&map_from_other), &other.detections);
        objects += truth.len();
        let both = [own.clone(), theirs.clone()].concat();
        for (sum, boxes) in counts.iter_mut().zip([own, theirs, both]) {
            let [right, wrong] = score(&suppress(boxes), &truth);
            *sum = [sum[0] + right, sum[1] + wrong];
        }
    }
    (objects, counts)
}

/// Recorded offsets in order of the vehicle's stamps.
fn offsets() -> Vec<[f64; 2]> {
    let sample = sample().unwrap();
    let read =
        |path: &str| -> serde_json::Value { serde_json::from_slice(&fs::read(sample.join(path)).unwrap()).unwrap() };
    let (pairs, frames) = (read("cooperative/data_info.json"), read("vehicle-side/data_info.json"));
    let stamp = |cloud: &str| {
        let frame = frames
            .as_array()
            .unwrap()
            .iter()
            .find(|f| cloud.ends_with(f["pointcloud_path"].as_str().unwrap()));
        frame.unwrap()["pointcloud_timestamp"].as_str().unwrap().to_string()
    };
    let mut found: Vec<(String, [f64; 2])> = Vec::new();
    for pair in pairs.as_array().unwrap() {
        let offset = ["delta_x", "delta_y"].map(|key| pair["system_error_offset"][key].as_f64().unwrap());
        found.push((stamp(pair["vehicle_pointcloud_path"].as_str().unwrap()), offset));
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found.into_iter().map(|(_, offset)| offset).collect()
}

/// The commonest height, in steps of 0.1 m, of points up to 40 m ahead.
fn road_height(cloud: &realo_schemas::PointCloud) -> f64 {
    let mut counts = std::collections::BTreeMap::<i32, usize>::new();
    for ((x, y), z) in cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter()) {
        if (3.0..40.0).contains(x) && y.abs() < 10.0 && z.abs() < 2.0 {
            *counts.entry((z / 0.1).floor() as i32).or_default() += 1;
        }
    }
    let (step, _) = counts
        .into_iter()
        .max_by_key(|(_, count)| *count)
        .expect("there are points on the road");
    (f64::from(step) + 0.5) * 0.1
}

#[test]
fn all_labels_of_a_side_are_in_the_view_of_its_camera_and_cooperative_ones_in_one_of_two() {
    for level in [Level::Pose, Level::Ground, Level::None] {
        let Some((_dir, log)) = imported_as(DairOptions {
            level,
            ..DairOptions::default()
        }) else {
            return;
        };
        let shown = |views: &[View], boxes: &[Box3]| {
            let seen = |object: &&Box3| views.iter().any(|view| view.shows(object));
            boxes.iter().filter(seen).count()
        };
        let (mut own, mut labels, mut together, mut truths, mut behind) = (0, 0, 0, 0, 0);
        for agent in [VEHICLE, ROADSIDE] {
            for sweep in sweeps(&log, agent) {
                assert_eq!(sweep.own, sweep.detections);
                assert_eq!((sweep.own_views.len(), sweep.own_views[0].size), (1, [1920, 1080]));
                labels += sweep.own.len();
                own += shown(&sweep.own_views, &sweep.own);
                // Exactly in the image, without the margin, are those of which part is there at the sweep's stamp.
                let exact = [View {
                    margin: 0.0,
                    ..sweep.own_views[0].clone()
                }];
                behind += sweep.own.len() - shown(&exact, &sweep.own);
                if agent == VEHICLE {
                    assert_eq!(sweep.truth_views.len(), 2);
                    truths += sweep.truth.len();
                    together += shown(&sweep.truth_views, &sweep.truth);
                }
            }
        }
        assert_eq!((own, labels, behind), (360, 360, 3), "{level}");
        assert_eq!((together, truths), (300, 300), "{level}");
    }
}

/// Smallest-squares slope of the road near an agent, degrees along x and y, and its height at the agent.
fn road(cloud: &realo_schemas::PointCloud) -> [f64; 3] {
    let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
    let points = points.map(|((x, y), z)| [x, y, z].map(|v| f64::from(*v)));
    let plane = realo_importer::Plane::of_ground(points, 1.0).unwrap();
    let [along, across] = plane.slope.map(|slope| slope.atan().to_degrees());
    [along, across, plane.offset]
}

#[test]
fn bodies_are_level_by_the_pose_or_by_the_ground() {
    for (level, vehicle, roadside) in [
        (Level::Pose, [0.2, 0.99], [0.52, 0.56]),
        (Level::Ground, [0.2, 0.99], [0.15, 0.35]),
        (Level::None, [0.0, 0.0], [0.0, 0.0]),
    ] {
        let Some((_dir, log)) = imported_as(DairOptions {
            level,
            ..DairOptions::default()
        }) else {
            return;
        };
        let levelled = log.levelled().unwrap();
        for (agent, [min, most]) in [(VEHICLE, vehicle), (ROADSIDE, roadside)] {
            let found = &levelled[agent];
            assert_eq!(found.by, level.as_str());
            assert!(
                found.degrees[0] >= min && found.degrees[1] <= most,
                "{level}: {found:?}"
            );
            for sweep in sweeps(&log, agent) {
                let up = sweep.map_from_body.rotation * Vector3::z();
                let tilt = up.x.hypot(up.y).atan2(up.z).to_degrees();
                match level {
                    Level::Pose => assert!(tilt < 1e-6, "{agent}: {tilt}°"),
                    _ => assert!((0.01..1.1).contains(&tilt), "{agent}: {tilt}°"),
                }
            }
        }
        let mut reader = log
            .read_all(&[(VEHICLE, Stream::Points), (ROADSIDE, Stream::Points)])
            .unwrap();
        let mut slopes: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        while let Some(entry) = reader.next().unwrap() {
            let [along, across, height] = road(&entry.cloud().unwrap());
            let agent = if &*entry.agent == VEHICLE { VEHICLE } else { ROADSIDE };
            slopes.entry(agent).or_default().push(along.hypot(across));
            assert!(height.abs() < 0.2, "{agent}: the road lies at {height} m");
        }
        let median = |agent: &str| {
            let mut slopes = slopes[agent].clone();
            slopes.sort_by(f64::total_cmp);
            slopes[slopes.len() / 2]
        };
        // The roadside unit's LiDAR frame lies along the road already; its recorded pose says that the road there is tilted.
        let (of_vehicle, of_roadside) = (median(VEHICLE), median(ROADSIDE));
        let (vehicle, roadside) = match level {
            Level::Pose => (0.0..0.2, 0.6..0.9),
            Level::Ground => (0.0..0.05, 0.0..0.05),
            Level::None => (0.3..0.6, 0.15..0.4),
        };
        assert!(
            vehicle.contains(&of_vehicle) && roadside.contains(&of_roadside),
            "{level}: the road slopes by {of_vehicle}° and {of_roadside}°"
        );
    }
}

#[test]
fn levelling_turns_no_heading_and_moves_no_label_on_the_road() {
    let read = |level| {
        imported_as(DairOptions {
            level,
            ..DairOptions::default()
        })
    };
    let (Some((_a, raw)), Some((_b, level))) = (read(Level::None), read(Level::Pose)) else {
        return;
    };
    let mut most: f64 = 0.0;
    for agent in [VEHICLE, ROADSIDE] {
        for (raw, level) in sweeps(&raw, agent).iter().zip(sweeps(&level, agent)) {
            let turned = yaw_of(&raw.map_from_body.rotation) - yaw_of(&level.map_from_body.rotation);
            assert!(turned.abs() < 1e-9, "{agent}: {turned}");
            for (one, other) in raw.detections.iter().zip(&level.detections) {
                let [one, other] = [(&raw, one), (&&level, other)]
                    .map(|(sweep, object)| sweep.map_from_body * Point3::from(object.center));
                most = most.max((one - other).norm());
            }
        }
    }
    // The body's origin lies below the sensor by gravity, not along its axis, which reports nothing of where labels are.
    assert!(most < 1e-9, "{most} m");
}

#[test]
fn labels_give_the_known_answer_and_a_wrong_sign_does_not() {
    let offsets = sample().map(|_| offsets()).unwrap_or_default();
    for level in [Level::Pose, Level::Ground, Level::None] {
        let Some((_dir, log)) = imported_as(DairOptions {
            level,
            ..DairOptions::default()
        }) else {
            return;
        };
        if level == Level::Ground {
            // One label of the tenth pair ends 4 mm inside the region; by the ground it lies further out.
            assert_eq!(known_answer(&log, &offsets, 0.0), (170, [[92, 0], [88, 7], [169, 0]]));
            continue;
        }
        assert_eq!(
            known_answer(&log, &offsets, 0.0),
            (171, [[92, 0], [89, 7], [170, 0]]),
            "{level}"
        );
        assert_eq!(
            known_answer(&log, &offsets, -1.0),
            (171, [[92, 0], [79, 17], [170, 1]]),
            "offset ignored, {level}"
        );
        let (_, [_, wrong, _]) = known_answer(&log, &offsets, -2.0);
        assert!(
            wrong[0] < 79,
            "with the offset subtracted the roadside unit alone has {wrong:?}, {level}"
        );
    }
}

#[test]
fn clouds_have_the_known_sums() {
    let Some(sample) = sample() else { return };
    let sums = [
        (
            "vehicle-side/velodyne/015404.pcd",
            62128,
            [-40455.40, 208149.51, -40586.12],
        ),
        (
            "infrastructure-side/velodyne/000049.pcd",
            54309,
            [2794648.37, 29284.53, 48524.67],
        ),
        (
            "vehicle-side/velodyne/015442.pcd",
            62853,
            [-50459.75, 329684.78, -41362.23],
        ),
        (
            "infrastructure-side/velodyne/000088.pcd",
            54684,
            [2848681.41, 17584.29, 50242.31],
        ),
    ];
    for (file, points, expected) in sums {
        let cloud = read_pcd(&sample.join(file)).unwrap();
        assert_eq!(cloud.x.len(), points);
        for (column, expected) in [&cloud.x, &cloud.y, &cloud.z].into_iter().zip(expected) {
            let sum: f64 = column.iter().map(|v| f64::from(*v)).sum();
            assert!((sum - expected).abs() < 0.0051, "{file}: {sum} instead of {expected}");
        }
    }
}

#[test]
fn sweeps_have_their_times_and_stand_on_the_ground() {
    let Some((_dir, log)) = imported(RoadsideStamp::Start) else {
        return;
    };
    assert_eq!(log.info().protocol, "dair");
    let kinds: Vec<AgentKind> = log.info().agents.iter().map(|agent| agent.kind).collect();
    assert_eq!(kinds, [AgentKind::Vehicle, AgentKind::Roadside]);
    assert_eq!(log.span(), log.info().start.zip(log.info().end));
    let mut reader = log
        .read_all(&[(VEHICLE, Stream::Points), (ROADSIDE, Stream::Points)])
        .unwrap();
    let mut found = 0;
    while let Some(entry) = reader.next().unwrap() {
        let cloud = entry.cloud().unwrap();
        found += 1;
        let ground = road_height(&cloud);
        assert!(ground.abs() < 0.15, "{}: the road lies at {ground} m", entry.agent);
        let (first, last) = (cloud.time.iter().min().unwrap(), cloud.time.iter().max().unwrap());
        match &*entry.agent {
            VEHICLE => {
                assert!(
                    first.abs() < 1_000 && (97_000_000..101_000_000).contains(last),
                    "{first} {last}"
                );
                assert_eq!(entry.ready() - entry.stamp(), 100_000_000);
            }
            _ => assert_eq!((*first, *last, entry.ready() - entry.stamp()), (0, 0, 96_000_000)),
        }
    }
    assert_eq!(found, 22);
    let Some((_dir, end)) = imported(RoadsideStamp::End) else {
        return;
    };
    for (start, end) in sweeps(&log, ROADSIDE).iter().zip(sweeps(&end, ROADSIDE)) {
        assert_eq!(
            (start.stamp, start.ready - 96_000_000, end.ready),
            (end.stamp, end.stamp, end.stamp)
        );
    }
}

#[test]
fn the_vehicle_has_an_outline_and_no_recorded_label_lies_in_it() {
    let Some((_dir, log)) = imported(RoadsideStamp::Start) else {
        return;
    };
    let footprint = |agent: &str| log.info().agent(agent).unwrap().footprint;
    assert_eq!(
        (footprint(VEHICLE), footprint(ROADSIDE)),
        (Some([-2.3, 2.3, -0.95, 0.95]), None)
    );
    // So the known answers are the same with and without it.
    let mut nearest = f64::INFINITY;
    for (ego, other) in sweeps(&log, VEHICLE).iter().zip(&sweeps(&log, ROADSIDE)) {
        let ego_from_other = ego.map_from_body.inv_mul(&other.map_from_body);
        for object in &other.detections {
            let center = ego_from_other * Point3::from(object.center);
            nearest = nearest.min(center.x.hypot(center.y));
        }
    }
    assert!(
        (nearest - 21.35).abs() < 0.1,
        "the roadside unit's label nearest to the vehicle: {nearest} m"
    );
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy(&entry.path(), &target),
            false => drop(fs::copy(entry.path(), &target).unwrap()),
        }
    }
}

#[test]
fn names_the_file_that_is_missing_or_damaged_and_leaves_no_log() {
    let Some(sample) = sample() else { return };
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    copy(&sample, &data);
    let import = || dair(&data, &out, DairOptions::default()).unwrap_err();

    let label = data.join("vehicle-side/label/lidar/015404.json");
    let kept = fs::read(&label).unwrap();
    fs::remove_file(&label).unwrap();
    let error = import();
    assert!(
        matches!(&error, ImportError::Incomplete { incomplete: 1, pairs: 11, missing, .. }
            if missing == "  1 × no such file\n    vehicle-side/label/lidar/015404.json"),
        "{error}"
    );
    fs::write(&label, "[{\"type\": \"Car\"}]").unwrap();
    let error = import().to_string();
    assert!(
        error.contains("015404.json") && error.contains("3d_dimensions"),
        "{error}"
    );
    fs::write(&label, kept).unwrap();

    let cloud = data.join("infrastructure-side/velodyne/000049.pcd");
    let kept = fs::read(&cloud).unwrap();
    fs::write(&cloud, &kept[..kept.len() / 2]).unwrap();
    let error = import().to_string();
    assert!(
        error.contains("000049.pcd") && error.contains("compressed bytes"),
        "{error}"
    );
    fs::write(&cloud, kept).unwrap();

    let info = data.join("vehicle-side/data_info.json");
    let text = fs::read_to_string(&info).unwrap();
    fs::write(&info, text.replace("1626240241604435", "yesterday")).unwrap();
    let error = import().to_string();
    assert!(
        error.contains("pointcloud_timestamp") && error.contains("yesterday"),
        "{error}"
    );
    fs::write(&info, text).unwrap();

    let place = "vehicle-side/calib/novatel_to_world/015404.json";
    let mounting = "vehicle-side/calib/lidar_to_novatel/015404.json";
    let roadside = "infrastructure-side/calib/virtuallidar_to_world/000049.json";
    let camera = "infrastructure-side/calib/virtuallidar_to_camera/000049.json";
    let own = "vehicle-side/label/lidar/015404.json";
    let together = "cooperative/label_world/015404.json";
    let zeros = json!([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]);
    let mirrored = json!([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]);
    let upside_down = json!([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]);
    let twice = json!([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]);
    let far = json!([[1e300], [0.0], [0.0]]);
    let corner = json!([1e300, 0.0, 0.0]);
    for (file, field, value, named) in [
        (
            place,
            "/rotation",
            &mirrored,
            "rotation: expected an orthonormal matrix",
        ),
        (place, "/rotation", &zeros, "rotation: expected an orthonormal matrix"),
        (place, "/rotation", &twice, "rotation: expected an orthonormal matrix"),
        (
            place,
            "/rotation",
            &upside_down,
            "rotation: expected a LiDAR that tilts by at most",
        ),
        (place, "/translation", &far, "translation: expected metres"),
        (
            mounting,
            "/transform/rotation",
            &zeros,
            "rotation: expected an orthonormal matrix",
        ),
        (
            roadside,
            "/rotation",
            &mirrored,
            "rotation: expected an orthonormal matrix",
        ),
        (camera, "/rotation", &zeros, "rotation: expected an orthonormal matrix"),
        (own, "/0/rotation", &json!("inf"), "label 0 ("),
        (own, "/0/rotation", &json!(1e300), "label 0 ("),
        (own, "/0/3d_location/x", &json!("1e300"), "label 0 ("),
        (own, "/0/3d_dimensions/l", &json!(1e300), "label 0 ("),
        (together, "/0/world_8_points/0", &corner, "label 0 ("),
    ] {
        let path = data.join(file);
        let kept = fs::read(&path).unwrap();
        let mut damaged: serde_json::Value = serde_json::from_slice(&kept).unwrap();
        *damaged.pointer_mut(field).unwrap() = value.clone();
        fs::write(&path, damaged.to_string()).unwrap();
        let error = import().to_string();
        assert!(
            error.contains(file) && error.contains(named),
            "{file}, {field}: {error}"
        );
        fs::write(&path, kept).unwrap();
    }
    assert!(!out.exists());
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    dair(&data, &out, DairOptions::default()).unwrap();
}
