//! What is said of topics on which nothing comes.

use realo_bags::map_file::AgentMap;
use realo_bags::messages::Kind;

use crate::ros::Found;

/// Topics that are listed at most.
const LISTED: usize = 12;

/// Types of poses that are read, with their names.
const POSE_TYPES: [(Kind, &str); 3] = [
    (Kind::Odometry, "nav_msgs/Odometry"),
    (Kind::PoseStamped, "geometry_msgs/PoseStamped"),
    (
        Kind::PoseWithCovarianceStamped,
        "geometry_msgs/PoseWithCovarianceStamped",
    ),
];

/// The type of poses of a name, if it is one.
pub fn pose_type(name: &str) -> Option<(Kind, &'static str)> {
    POSE_TYPES.into_iter().find(|(_, known)| *known == name)
}

/// Fields of a map file that mean something in recordings alone.
pub fn unused(map: &AgentMap) -> Vec<&'static str> {
    let fields = [
        ("bag", !map.bag.is_empty()),
        ("imu", map.imu.is_some()),
        ("truth", map.truth.is_some()),
        ("detections", map.detections.is_some()),
    ];
    let given = fields.into_iter().filter(|(_, is_given)| *is_given);
    given.map(|(field, _)| field).collect()
}

/// Why nothing comes on a topic, as far as publishers show it.
pub fn silent(topic: &str, kind: &str, seconds: f64, found: &[Found]) -> String {
    let known = format!("{topic}: no {kind} for {seconds} s");
    let mut own = found.iter().filter(|found| found.topic == topic);
    match own.clone().find(|found| found.kind == kind) {
        Some(found) if found.is_reliable => format!("{known}: its publisher is there and silent"),
        Some(_) => format!(
            "{known}: its best-effort publisher is there and silent, or `reliability=reliable` does not hear it"
        ),
        None => match own.next() {
            Some(other) => format!(
                "{known}: its publisher sends {}; name another topic in the map file",
                other.kind
            ),
            None => format!("{known}: nobody publishes it; {}", listed(&[kind], found)),
        },
    }
}

/// Why a topic of poses is not read yet; `types`: what its publishers send.
pub fn no_poses(topic: &str, types: &[&str], found: &[Found]) -> String {
    let expected = POSE_TYPES.map(|(_, name)| name);
    match types {
        [] => format!(
            "{topic}: nobody publishes it; {}; or write `pose: tf`",
            listed(&expected, found)
        ),
        types => format!(
            "{topic}: expected poses ({}), found {}; name another topic as `pose` in the map file, or write `pose: tf`",
            expected.join(", "),
            types.join(" and ")
        ),
    }
}

/// The topics of some types, in words.
fn listed(kinds: &[&str], found: &[Found]) -> String {
    let mut topics: Vec<&str> = found
        .iter()
        .filter(|found| kinds.contains(&found.kind.as_str()))
        .map(|found| found.topic.as_str())
        .collect();
    topics.dedup();
    let more = if topics.len() > LISTED { ", …" } else { "" };
    topics.truncate(LISTED);
    match (topics.is_empty(), found.is_empty()) {
        (false, _) => format!("of its type there are {}{more}", topics.join(", ")),
        (true, false) => "nothing of its type is published".into(),
        (true, true) => {
            "no publisher is known at all: are `domain` (ROS_DOMAIN_ID) and `localhost` as those of the others?".into()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(topic: &str, kind: &str, is_reliable: bool) -> Found {
        Found {
            topic: topic.into(),
            kind: kind.into(),
            is_reliable,
        }
    }

    #[test]
    fn what_is_wrong_with_a_silent_topic_is_said() {
        const CLOUD: &str = "sensor_msgs/PointCloud2";
        let all = [
            found("/scan", "sensor_msgs/LaserScan", true),
            found("/other", CLOUD, true),
            found("/points", CLOUD, false),
        ];
        for (topic, expected) in [
            ("/points", "its best-effort publisher is there and silent"),
            ("/other", "its publisher is there and silent"),
            ("/scan", "its publisher sends sensor_msgs/LaserScan"),
            ("/nothing", "nobody publishes it; of its type there are /other, /points"),
        ] {
            let words = silent(topic, CLOUD, 5.0, &all);
            assert!(words.contains(expected), "{words}");
        }
        assert!(silent("/points", CLOUD, 5.0, &all[..1]).contains("nothing of its type is published"));
        assert!(silent("/points", CLOUD, 5.0, &[]).contains("ROS_DOMAIN_ID"));
    }

    #[test]
    fn a_topic_that_has_no_poses_is_named() {
        let all = [
            found("/odom", "nav_msgs/Odometry", true),
            found("/fix", "sensor_msgs/NavSatFix", true),
        ];
        let words = no_poses("/fix", &["sensor_msgs/NavSatFix"], &all);
        assert!(words.contains("found sensor_msgs/NavSatFix"), "{words}");
        let words = no_poses("/pose", &[], &all);
        assert!(words.contains("there are /odom; or write `pose: tf`"), "{words}");
        assert_eq!(
            pose_type("nav_msgs/Odometry").map(|(kind, _)| kind),
            Some(Kind::Odometry)
        );
        assert!(pose_type("sensor_msgs/NavSatFix").is_none());
    }
}
