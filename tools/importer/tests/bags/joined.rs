//! Several bags become one log, and their clocks are compared; two LiDARs of an agent become one.

use realo_schemas::Nanos;

use super::wire::{Recorded, recorded, transform};
use super::world::{BASE, MOUNTED, MS, Names, SWEEPS, T0, recording, sweep};
use super::writers::ros1;
use super::{import, played};

const OTHER: Names = Names {
    points: "/velodyne_points",
    odom: "/odom",
    truth: None,
};

/// Messages of a third station that both recorded.
fn heard(late: Nanos) -> impl Iterator<Item = Recorded> {
    (0..8u32).map(move |k| {
        let time = T0 + i64::from(k) * 300 * MS + (i64::from(k) % 3) * MS - late;
        recorded("/v2x/cam", "etsi_msgs/CAM", time, move |out| out.u32(1000 + k))
    })
}

/// Messages of a receiver that say how far its reference is ahead.
fn references(late: Nanos, ahead: Nanos) -> impl Iterator<Item = Recorded> {
    (0..5).map(move |k| {
        let time = T0 + k * 200 * MS - late;
        recorded("/time_reference", "sensor_msgs/TimeReference", time, move |out| {
            out.header(time, "");
            out.time(time + ahead);
            out.text("gps");
        })
    })
}

fn two(late: Nanos, is_heard: bool, offset: &str) -> Result<(Vec<Nanos>, String), String> {
    let ([a, b], said) = referenced(late, is_heard, offset, [None, None])?;
    assert_eq!(a[0], T0);
    Ok((b, said))
}

/// `ahead`: how far the reference of each bag is ahead, if it has one.
fn referenced(
    late: Nanos,
    is_heard: bool,
    offset: &str,
    ahead: [Option<Nanos>; 2],
) -> Result<([Vec<Nanos>; 2], String), String> {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a.bag", "b.bag"].map(|name| dir.path().join(name));
    for (path, start, late, ahead) in [(&a, 0.0, 0, ahead[0]), (&b, 20.0, late, ahead[1])] {
        let mut messages = recording(OTHER, start, late);
        if is_heard {
            messages.extend(heard(late));
        }
        messages.extend(ahead.into_iter().flat_map(|ahead| references(late, ahead)));
        messages.sort_by_key(|message| message.log_time);
        ros1(path, &messages, "none");
    }
    let agent = |name: &str, more: &str| {
        format!(
            "  {name}:\n    bag: {name}.bag\n    clouds: /velodyne_points\n    frame: base_link\n    height: {BASE}\n    pose: /odom\n{more}"
        )
    };
    let map = format!("agents:\n{}{}", agent("a", ""), agent("b", offset));
    let log = dir.path().join("log.mcap");
    let summary = import(&[a, b], Some(&map), &log).map_err(|error| error.to_string())?;
    let stamps = |agent: &str| {
        played(&log, agent)
            .clouds
            .iter()
            .map(|(stamp, ..)| *stamp)
            .collect::<Vec<_>>()
    };
    Ok((["a", "b"].map(stamps), summary.to_string()))
}

#[test]
fn joined_bags_end_on_the_clock_of_a_reference() {
    for ahead in [[Some(500 * MS), None], [None, Some(537 * MS)]] {
        let ([a, b], said) = referenced(37 * MS, true, "", ahead).unwrap();
        assert_eq!([a[0], b[0]], [T0 + 500 * MS; 2], "{said}");
        assert!(
            said.contains("by 5 time references (`/time_reference` of `gps`)"),
            "{said}"
        );
    }
    let ([a, b], said) = referenced(37 * MS, false, "", [Some(500 * MS), None]).unwrap();
    assert_eq!([a[0], b[0]], [T0 + 500 * MS, T0 - 37 * MS]);
    assert!(said.contains("nothing says how far it is from the reference"), "{said}");
}

#[test]
fn bags_without_a_word_of_their_clocks_are_taken_as_one() {
    let (stamps, said) = two(0, false, "").unwrap();
    assert_eq!((stamps.len() as i64, stamps[0]), (SWEEPS, T0));
    assert!(said.contains("taken as one by header time"), "{said}");
    assert!(said.contains("overlap of `"), "{said}");
}

#[test]
fn what_both_recorded_says_how_their_clocks_differ() {
    let (stamps, said) = two(37 * MS, true, "").unwrap();
    assert_eq!(stamps[0], T0);
    assert!(
        said.contains("+37.000 ms") && said.contains("by 8 messages that it and"),
        "{said}"
    );
}

#[test]
fn the_map_file_says_it_above_all() {
    let (stamps, said) = two(37 * MS, true, "    offset: 0.037\n").unwrap();
    assert_eq!(stamps[0], T0);
    assert!(said.contains("+0.0370 s by the map file"), "{said}");
    let (stamps, _) = two(37 * MS, true, "    offset: 0\n").unwrap();
    assert_eq!(stamps[0], T0 - 37 * MS);
}

#[test]
fn agents_without_a_time_in_common_are_refused() {
    let error = two(3_600_000 * MS, false, "").unwrap_err();
    for part in ["a time in common", "`a` has sweeps from", "give `offset`"] {
        assert!(error.contains(part), "{error}");
    }
    let (stamps, _) = two(3_600_000 * MS, false, "    offset: 3600\n").unwrap();
    assert_eq!(stamps[0], T0);
}

#[test]
fn agents_of_one_bag_are_drafted_by_their_names() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("both.bag");
    let mut messages = Vec::new();
    for (names, start) in [
        (
            Names {
                points: "/cav1/points",
                odom: "/cav1/odom",
                truth: None,
            },
            0.0,
        ),
        (
            Names {
                points: "/rsu/points",
                odom: "/rsu/odom",
                truth: None,
            },
            30.0,
        ),
    ] {
        messages.extend(recording(names, start, 0));
    }
    // One transform for both: a frame has one parent.
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "bz2");
    let log = dir.path().join("log.mcap");
    let summary = import(&[bag], None, &log).unwrap();
    let names: Vec<&str> = summary.agents.iter().map(|agent| agent.name.as_str()).collect();
    assert_eq!(names, ["cav1", "rsu"]);
    assert!(summary.draft.unwrap().contains("kind: roadside"));
    assert_eq!(played(&log, "rsu").clouds.len() as i64, SWEEPS);
}

#[test]
fn two_lidars_of_an_agent_are_one_sweep() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("two.bag");
    let mut messages = recording(OTHER, 0.0, 0);
    messages.push(transform(
        "/tf_static",
        T0,
        T0,
        ["base_link", "rear"],
        [-2.0, 0.0, MOUNTED, 0.0],
    ));
    for k in 0..SWEEPS {
        let stamp = T0 + k * 100 * MS + 20 * MS;
        messages.push(sweep("/rear_points", stamp + 95 * MS, stamp, "rear"));
    }
    messages.sort_by_key(|message| message.log_time);
    ros1(&bag, &messages, "none");
    let map = format!(
        "agents:\n  car:\n    clouds: [/velodyne_points, /rear_points]\n    frame: base_link\n    height: {BASE}\n    pose: /odom\n"
    );
    let log = dir.path().join("log.mcap");
    import(&[bag], Some(&map), &log).unwrap();
    let clouds = played(&log, "car").clouds;
    assert_eq!(clouds.len() as i64, SWEEPS);
    let points = super::world::points().len();
    for (stamp, ready, cloud) in &clouds {
        assert_eq!(cloud.len(), 2 * points);
        assert_eq!(*ready, stamp + 115 * MS);
        assert!(
            (cloud.x[points] - cloud.x[0] + 3.0).abs() < 1e-5 && (cloud.time[points] - 20 * MS as i32).abs() < 1000
        );
    }
}
