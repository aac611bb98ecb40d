//! KITTI's layout: points, poses, boxes and times of one agent come back.

use realo_logs::Log;

use crate::reading::{assert_same_boxes, assert_same_clouds, assert_same_poses, import, sweeps, try_export};
use crate::world::{SWEEPS, simulated};

#[test]
fn each_agent_of_a_simulated_log_comes_back_to_the_digit_of_a_float32() {
    let dir = tempfile::tempdir().unwrap();
    let path = simulated(dir.path());
    let log = Log::open(&path).unwrap();
    for agent in ["cav2", "rsu1"] {
        let (out, back) = (dir.path().join(agent), dir.path().join(format!("{agent}.mcap")));
        let exported = try_export("kitti", &path, &out, &[("agent", agent)], false).unwrap();
        import(&exported, &back);
        let back = Log::open(&back).unwrap();
        let height = log.info().agent(agent).unwrap().sensor_position.unwrap()[2];
        let (before, after) = (sweeps(&log, agent), sweeps(&back, "cav_1"));
        assert_eq!((before.len(), after.len()), (SWEEPS, SWEEPS));
        let [first, first_after] = [&before[0], &after[0]];
        for (before, after) in before.iter().zip(&after) {
            assert_eq!(before.stamp - first.stamp, after.stamp - first_after.stamp);
            let moved = |first: &nalgebra::Isometry3<f64>, pose| first.inv_mul(pose);
            assert_same_poses(
                &moved(&first.map_from_body, &before.map_from_body),
                &moved(&first_after.map_from_body, &after.map_from_body),
            );
            assert_same_clouds(&before.cloud, &after.cloud, height);
            assert_same_boxes(&before.truth, &after.truth);
        }
        let said = exported.to_string();
        assert!(said.contains("tracks and velocities of boxes"), "{said}");
        assert!(said.contains(&format!("the name of the agent: {agent}")), "{said}");
    }
}

#[test]
fn one_of_several_agents_has_to_be_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = simulated(dir.path());
    let error = try_export("kitti", &path, &dir.path().join("out"), &[], false).unwrap_err();
    assert!(
        error.contains("--agent: expected one agent, found cav1, cav2, rsu1; name one"),
        "{error}"
    );
}
