//! A scene of OPV2V: points, poses, boxes and tracks come back.

use std::fs;

use nalgebra::Point3;
use realo_logs::{AgentKind, Log, Stream};

use crate::reading::{
    assert_same, assert_same_boxes, assert_same_clouds, assert_same_poses, import, sweeps, try_export,
};
use crate::world::{
    AGENTS, MOVING_SWEEPS, MadeUp, ON_ITSELF, POINTS, SWEEPS, UNSCORED, moving, simulated, standing, write_moving,
};

const SCENE: &str = "2026_01_01_00_00_00";

#[test]
fn a_simulated_log_comes_back_to_the_digit_of_a_float32() {
    let dir = tempfile::tempdir().unwrap();
    let log = simulated(dir.path());
    let (out, back) = (dir.path().join(SCENE), dir.path().join("back.mcap"));
    let exported = try_export("opv2v", &log, &out, &[("motion", "kept")], false).unwrap();
    assert!(exported.left_out.is_empty(), "{exported}");
    import(&exported, &back);
    let (log, back) = (Log::open(&log).unwrap(), Log::open(&back).unwrap());
    assert_eq!(back.info().agents.len(), AGENTS.len());
    for name in AGENTS {
        let (before, after) = (log.info().agent(name).unwrap(), back.info().agent(name).unwrap());
        assert_eq!((before.kind, before.footprint), (after.kind, after.footprint));
        let height = before.sensor_position.unwrap()[2];
        assert_same(height, after.sensor_position.unwrap()[2], "height");
        let (before, after) = (sweeps(&log, name), sweeps(&back, &after.name));
        assert_eq!((before.len(), after.len()), (SWEEPS, SWEEPS));
        for (before, after) in before.iter().zip(&after) {
            assert_eq!((after.stamp, after.is_scored), (before.stamp, before.is_scored));
            assert_same_poses(&before.map_from_body, &after.map_from_body);
            assert_same_clouds(&before.cloud, &after.cloud, height);
            assert_eq!(before.cloud.time, after.cloud.time);
            assert_same_boxes(&before.truth, &after.truth);
            for (before, after) in before.truth.iter().zip(&after.truth) {
                assert_eq!(before.track, after.track);
                let along = |object: &realo_schemas::Box3| {
                    let [x, y, _] = object.velocity.unwrap();
                    x * object.yaw.cos() + y * object.yaw.sin()
                };
                assert_same(along(before), along(after), "speed");
            }
        }
    }
    let agents = |log: &Log| {
        log.info()
            .agents
            .iter()
            .map(|agent| agent.name.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(agents(&log), agents(&back), "in the same order");
    for (name, stream) in AGENTS
        .iter()
        .flat_map(|name| [Stream::Pose, Stream::PoseTruth].map(|stream| (*name, stream)))
    {
        let poses = |log: &Log| {
            let mut reader = log.read_all(&[(name, stream)]).unwrap();
            let mut found = Vec::new();
            while let Some(entry) = reader.next().unwrap() {
                let pose = entry.pose().unwrap().map_from_body;
                found.push((entry.stamp(), entry.ready(), pose.translation, pose.rotation));
            }
            found
        };
        let (before, after) = (poses(&log), poses(&back));
        assert!(before.len() > 3 * SWEEPS, "{}", before.len());
        assert_eq!(before, after, "{name}, {stream:?}: to the bit");
    }
    let said = exported.to_string();
    for line in [
        "recorded detections",
        "poses that agents believed",
        "times and rings of points",
        "names of agents: cav1 is `",
        "rsu1 is `-1`",
        "stamps: frame 0 is at ",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    let agents: Vec<AgentKind> = back.info().agents.iter().map(|agent| agent.kind).collect();
    assert_eq!(agents, [AgentKind::Vehicle, AgentKind::Vehicle, AgentKind::Roadside]);
}

#[test]
fn vehicles_have_the_tracks_that_others_know_them_by() {
    let dir = tempfile::tempdir().unwrap();
    let log = simulated(dir.path());
    let out = dir.path().join(SCENE);
    let exported = try_export("opv2v", &log, &out, &[], false).unwrap();
    let of_cav2 = exported.agents[1]
        .place
        .trim_start_matches("folder `")
        .trim_end_matches('`');
    let labels = fs::read_to_string(out.join("-1/000000.yaml")).unwrap();
    assert!(
        labels.contains(&format!("\n  {of_cav2}:\n")),
        "{of_cav2} is not in\n{labels}"
    );
    assert!(labels.contains("RSU: true"), "{labels}");
    let own = fs::read_to_string(out.join(of_cav2).join("000000.yaml")).unwrap();
    assert!(
        !own.contains(&format!("\n  {of_cav2}:\n")),
        "a vehicle is not among its own objects"
    );
}

#[test]
fn agents_and_classes_can_be_chosen() {
    let dir = tempfile::tempdir().unwrap();
    let log = simulated(dir.path());
    let out = dir.path().join(SCENE);
    let exported = try_export(
        "opv2v",
        &log,
        &out,
        &[("agents", "rsu1,cav2"), ("classes", "car")],
        false,
    )
    .unwrap();
    let names: Vec<&str> = exported.agents.iter().map(|agent| agent.name.as_str()).collect();
    assert_eq!(names, ["cav2", "rsu1"]);
    let labels = fs::read_to_string(out.join("-1/000000.yaml")).unwrap();
    let classes = labels.lines().filter(|line| line.contains("obj_type"));
    assert!(
        classes.clone().count() > 0 && classes.clone().all(|line| line.ends_with("\"Car\"")),
        "{labels}"
    );
}

#[test]
fn classes_of_which_no_box_is_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let log = simulated(dir.path());
    let error = try_export("opv2v", &log, &dir.path().join(SCENE), &[("classes", "Unicorn")], false).unwrap_err();
    let error = error.to_string();
    assert!(
        error.contains("is of the class unicorn; there are ") && error.contains("Car"),
        "{error}"
    );
    assert!(!dir.path().join(SCENE).exists());
}

#[test]
fn a_tilted_log_without_a_height_comes_back_as_the_export_says() {
    let dir = tempfile::tempdir().unwrap();
    let log = MadeUp {
        tilt_rad: 0.05,
        ..MadeUp::default()
    }
    .write(dir.path());
    let (out, back) = (dir.path().join(SCENE), dir.path().join("back.mcap"));
    let exported = try_export("opv2v", &log, &out, &[], false).unwrap();
    assert!(exported.read_back.ends_with("--level none"), "{exported}");
    let said = exported.to_string();
    for line in [
        "the LiDAR of car is 1.8 m over the ground, for the log does not say it (--height)",
        "2 boxes have no track",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
    import(&exported, &back);
    let (log, back) = (Log::open(&log).unwrap(), Log::open(&back).unwrap());
    let (before, after) = (sweeps(&log, "car"), sweeps(&back, &back.info().agents[0].name));
    for (before, after) in before.iter().zip(&after) {
        assert_same_poses(&before.map_from_body, &after.map_from_body);
        assert_same_clouds(&before.cloud, &after.cloud, 1.8);
        assert_same_boxes(&before.truth, &after.truth);
    }
}

#[test]
fn an_imported_scene_comes_back_whole_by_its_own_labels() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let first = try_export(
        "opv2v",
        &simulated(dir.path()),
        &at(SCENE),
        &[("agents", "cav1,rsu1")],
        false,
    )
    .unwrap();
    import(&first, &at("first.mcap"));
    let scene = dir.path().join("again").join(SCENE);
    let again = try_export("opv2v", &at("first.mcap"), &scene, &[("labels", "own")], false).unwrap();
    import(&again, &at("again.mcap"));
    let (before, after) = (
        Log::open(at("first.mcap")).unwrap(),
        Log::open(at("again.mcap")).unwrap(),
    );
    let names = |log: &Log| {
        log.info()
            .agents
            .iter()
            .map(|agent| agent.name.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(names(&before), names(&after));
    for agent in &before.info().agents {
        let messages = |log: &Log| Stream::ALL.map(|stream| log.count(&agent.name, stream));
        assert_eq!(messages(&before), messages(&after));
        for (before, after) in sweeps(&before, &agent.name).iter().zip(&sweeps(&after, &agent.name)) {
            assert_eq!(before.stamp, after.stamp);
            assert_same_poses(&before.map_from_body, &after.map_from_body);
            assert_same_clouds(&before.cloud, &after.cloud, agent.sensor_position.unwrap()[2]);
            assert_same_boxes(&before.truth, &after.truth);
        }
    }
}

#[test]
fn points_of_a_moving_agent_come_back_as_at_the_stamp_with_counts_and_what_is_scored() {
    let dir = tempfile::tempdir().unwrap();
    let log = write_moving(dir.path());
    for (motion, is_removed) in [("removed", true), ("kept", false)] {
        let out = dir.path().join(motion).join(SCENE);
        let back = dir.path().join(format!("{motion}.mcap"));
        let set: &[(&str, &str)] = if is_removed { &[] } else { &[("motion", "kept")] };
        let exported = try_export("opv2v", &log, &out, set, false).unwrap();
        assert!(!exported.to_string().contains("as they were measured"), "{exported}");
        import(&exported, &back);
        let back = Log::open(&back).unwrap();
        let read = sweeps(&back, &back.info().agents[0].name);
        assert_eq!(read.len(), MOVING_SWEEPS);
        for (number, sweep) in read.iter().enumerate() {
            let cloud = &sweep.cloud;
            for (index, (place, time)) in standing().iter().enumerate() {
                let seen_at = sweep.stamp + if is_removed { 0 } else { i64::from(*time) };
                let expected = moving(seen_at).inverse() * place;
                let found = Point3::new(cloud.x[index], cloud.y[index], cloud.z[index]).cast::<f64>();
                let off = (found - expected).norm();
                assert!(
                    off < 1e-3,
                    "--motion {motion}, sweep {number}, point {index}: {off} m off"
                );
            }
            // What moves with the agent is where it was on it.
            assert_same(f64::from(ON_ITSELF[0]), f64::from(cloud.x[4]), "own point");
            assert_same(f64::from(ON_ITSELF[1]), f64::from(cloud.y[4]), "own point");
            assert_eq!(sweep.is_scored, number != UNSCORED, "sweep {number}");
            assert_eq!(sweep.points.as_deref(), Some(&POINTS[..]), "sweep {number}");
        }
    }
}
