//! Poses, points, boxes, stamps and counts of each layout come back as they were in the world.

use std::path::Path;

use nalgebra::Point3;
use realo_importer::look_at;
use realo_logs::{AgentKind, Log};
use realo_schemas::geometry::{tilt_degrees, yaw_of};

use crate::AGENTS;
use crate::layouts::{COOPERSCENE, OPV2V, Style, V2V4REAL, V2X_REAL};
use crate::reading::{Read, import, read};
use crate::world::{Agent, CARS, ON_A_CAR};

const SCENE: &str = "2021_08_18_19_48_05";
const START: i64 = 1_629_316_085_000_000_000;
const PERIOD: i64 = 100_000_000;

/// Compares an agent at a frame with the world.
pub fn compare(read: &Read, agent: &Agent, number: usize, frame: u64) {
    let [x, y, _, _, yaw, _] = agent.at(frame);
    let at = read.map_from_body.translation.vector;
    assert!(
        (at.x - x).abs() < 0.12 && (at.y - y).abs() < 0.12 && at.z.abs() < 0.05,
        "{at}"
    );
    let turned = (yaw_of(&read.map_from_body.rotation).to_degrees() - yaw + 540.0).rem_euclid(360.0) - 180.0;
    assert!(turned.abs() < 0.05, "{turned}°");
    assert!(tilt_degrees(&read.map_from_body.rotation) < 0.05);
    let (found, expected) = (read.in_map(), agent.sees(frame, number));
    assert_eq!(found.len(), expected.len());
    let apart = found
        .iter()
        .zip(&expected)
        .map(|(a, b)| (a - b).norm())
        .fold(0.0, f64::max);
    assert!(apart < 1e-4, "points are {apart} m apart");
    for boxes in [&read.truth, &read.own] {
        for (center, heading, found) in read.boxes_in_map(boxes) {
            let car = CARS.iter().find(|car| Some(car.id) == found.track);
            let Some(car) = car else { continue };
            let apart = (Point3::from(center) - Point3::from(car.center)).norm();
            let turned = (heading - car.yaw + 540.0).rem_euclid(360.0) - 180.0;
            assert!(apart < 1e-6 && turned.abs() < 0.05, "{}: {apart} m, {turned}°", car.id);
            assert_eq!([found.length, found.width, found.height], car.size);
        }
    }
}

/// Imports a scene of these agents, and compares all of it.
fn round_trip(kind: &str, style: &Style, agents: &[Agent], names: &[&str]) -> (tempfile::TempDir, Log) {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    style.write(&data.join("test").join(SCENE), agents);
    let summary = &import(kind, &data, &out, &[]).unwrap()[0];
    let said = summary.to_string();
    assert_eq!(
        (summary.frames, summary.incomplete_frames),
        (style.frames as usize, 0),
        "{said}"
    );
    // Clouds of two agents fit each other, whatever hand the data set has.
    assert_eq!(summary.residuals.len(), agents.len() * (agents.len() - 1) / 2, "{said}");
    assert!(
        summary.residuals.iter().all(|residual| residual.metres.unwrap() < 0.1),
        "{said}"
    );
    let (log, found) = read(&out);
    assert_eq!(found.len(), agents.len() * style.frames as usize);
    for (number, (agent, name)) in agents.iter().zip(names).enumerate() {
        for frame in 0..style.frames {
            let stamp = START + frame as i64 * PERIOD;
            let read = &found[&(name.to_string(), stamp)];
            compare(read, agent, number, frame);
            assert_eq!(read.ready, stamp + PERIOD);
            let cloud = read.cloud.as_ref().unwrap();
            assert_eq!((cloud.intensity[0], cloud.intensity[cloud.len() - 1]), (128, 255));
            let tracks: Vec<u64> = read.own.iter().filter_map(|object| object.track).collect();
            assert!(tracks.starts_with(agent.labels), "{tracks:?}");
            for (index, object) in read.truth.iter().enumerate() {
                let is_car = CARS.iter().any(|car| Some(car.id) == object.track);
                let expected = if is_car { ON_A_CAR } else { 0 };
                assert_eq!(read.truth_points[index], expected, "{name}: {:?}", object.track);
            }
            assert_eq!(read.own_points[..], read.truth_points[..read.own.len()]);
            let cars = read
                .truth
                .iter()
                .filter(|object| CARS.iter().any(|car| Some(car.id) == object.track));
            let labelled: std::collections::BTreeSet<u64> =
                agents.iter().flat_map(|agent| agent.labels).copied().collect();
            assert_eq!(cars.count(), labelled.len(), "the labels of all agents together");
        }
    }
    (dir, log)
}

#[test]
fn a_left_handed_scene_of_carla_comes_back_right_handed() {
    let (dir, log) = round_trip("opv2v", &OPV2V, &AGENTS, &["cav_641", "cav_650", "rsu_1"]);
    let agents = &log.info().agents;
    assert_eq!(
        (agents[0].kind, agents[2].kind),
        (AgentKind::Vehicle, AgentKind::Roadside)
    );
    assert_eq!(agents[0].footprint, Some([-1.95, 2.95, -1.1, 1.1]));
    let height = agents[2].sensor_position.unwrap()[2];
    assert!((height - 4.5).abs() < 0.02, "{height}");
    assert_eq!(log.levelled().unwrap()["cav_641"].by, "pose");
    let (_, found) = read(&dir.path().join("out.mcap"));
    let first = &found[&("cav_641".to_string(), START)];
    let tracks: Vec<u64> = first.truth.iter().filter_map(|object| object.track).collect();
    assert_eq!(
        tracks,
        [11, 12, 13, 650, 1, 14],
        "the agent itself is not among its objects"
    );
    let [vx, vy, vz] = first.truth[0].velocity.unwrap();
    assert!((vx.hypot(vy) - 10.0).abs() < 1e-9 && vz == 0.0);
    assert_eq!(&*first.truth[0].class, "Car");
}

#[test]
fn v2x_real_has_rows_integer_ids_and_lidars_that_lean() {
    let leans = |agent: Agent, folder| {
        let [x, y, z, _, yaw, _] = agent.six;
        Agent {
            folder,
            six: [x, y, z, 4.0, yaw, -3.0],
            ..agent
        }
    };
    let agents = [leans(AGENTS[0], "1"), leans(AGENTS[1], "2"), AGENTS[2]];
    let (dir, log) = round_trip("v2x-real", &V2X_REAL, &agents, &["cav_1", "cav_2", "rsu_1"]);
    assert_eq!(log.levelled().unwrap()["rsu_1"].by, "ground");
    let (_, found) = read(&dir.path().join("out.mcap"));
    let first = &found[&("cav_1".to_string(), START)];
    assert_eq!((&*first.truth[0].class, first.truth[0].velocity), ("Van", None));
}

#[test]
fn v2v4real_has_matrices_and_boxes_in_the_frame_of_each_lidar() {
    let level = |agent: Agent, folder| {
        let [x, y, z, _, yaw, _] = agent.six;
        Agent {
            folder,
            six: [x, y, z, 0.0, yaw, 0.0],
            ..agent
        }
    };
    let agents = [level(AGENTS[0], "0"), level(AGENTS[1], "1")];
    let (dir, _) = round_trip("v2v4real", &V2V4REAL, &agents, &["cav_0", "cav_1"]);
    // Objects that were not joined are one agent's own.
    let (data, out) = (dir.path().join("data"), dir.path().join("alone.mcap"));
    edit(&data.join("test").join(SCENE).join("1/000000.yaml"), |text| {
        text.replace("ass_id: 12", "ass_id: -1")
    });
    import("v2v4real", &data, &out, &[]).unwrap();
    let (_, found) = read(&out);
    let tracks: Vec<Option<u64>> = found[&("cav_0".to_string(), START)]
        .truth
        .iter()
        .map(|object| object.track)
        .collect();
    assert_eq!(tracks.len(), 5, "{tracks:?}");
    assert!(tracks[3].unwrap() > 1 << 63, "its identity is a text: {tracks:?}");
}

#[test]
fn cooperscene_has_a_roadside_unit_in_the_first_folder_and_files_of_its_own_beside_labels() {
    let named = |agent: Agent, folder| Agent { folder, ..agent };
    let agents = [named(AGENTS[0], "1"), named(AGENTS[1], "2"), named(AGENTS[2], "0")];
    let (dir, log) = round_trip("cooperscene", &COOPERSCENE, &agents, &["cav_1", "cav_2", "rsu_0"]);
    assert_eq!(log.info().agents[2].kind, AgentKind::Roadside);
    let data = dir.path().join("data");
    for folder in ["0", "1", "2"].map(|folder| data.join("test").join(SCENE).join(folder)) {
        for name in ["00012_additional.yaml", "00012_separate.yaml", "data_protocol.yaml"] {
            std::fs::write(folder.join(name), "vehicles: {}\n").unwrap();
        }
    }
    let seen = look_at(&data);
    let fits: Vec<&str> = seen.fits.iter().map(|(importer, _)| importer.kind().name).collect();
    assert_eq!(fits, ["cooperscene"], "{seen}");
    let summary = &import("cooperscene", &data, &dir.path().join("again.mcap"), &[]).unwrap()[0];
    assert_eq!(summary.frames, COOPERSCENE.frames as usize);
    assert!(
        summary
            .to_string()
            .contains("the measured radio in `mcap/` is not imported"),
        "{summary}"
    );
}

/// Changes a file.
pub fn edit(path: &Path, change: impl FnOnce(String) -> String) {
    let text = std::fs::read_to_string(path).unwrap();
    let changed = change(text.clone());
    assert_ne!(changed, text, "nothing was changed");
    std::fs::write(path, changed).unwrap();
}
