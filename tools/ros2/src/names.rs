//! Names of topics and types, in ROS and in DDS.

/// A topic's name with the slash before it.
///
/// # Errors
/// What is no name of a topic.
pub fn topic(name: &str) -> Result<String, String> {
    let bare = name.strip_prefix('/').unwrap_or(name);
    let is_part = |part: &str| {
        part.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
            && part
                .chars()
                .all(|letter| letter.is_ascii_alphanumeric() || letter == '_')
    };
    match bare.split('/').all(is_part) {
        true => Ok(format!("/{bare}")),
        false => Err(format!(
            "expected a topic such as /lidar/points (letters, digits, `_` and `/`), found `{}`",
            name.escape_debug()
        )),
    }
}

/// What DDS calls a topic of ROS.
pub fn dds_topic(topic: &str) -> String {
    format!("rt{topic}")
}

/// The topic of ROS that a topic of DDS is, if it is one.
pub fn ros_topic(topic: &str) -> Option<&str> {
    topic.strip_prefix("rt").filter(|rest| rest.starts_with('/'))
}

/// What DDS calls a type of ROS, as `sensor_msgs/PointCloud2`.
pub fn dds_type(kind: &str) -> String {
    let (package, name) = kind.split_once('/').unwrap_or(("", kind));
    format!("{package}::msg::dds_::{name}_")
}

/// The type of ROS that a type of DDS is, if it is one.
pub fn ros_type(kind: &str) -> Option<String> {
    let (package, name) = kind.split_once("::msg::dds_::")?;
    Some(format!("{package}/{}", name.strip_suffix('_')?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_come_back() {
        assert_eq!(topic("lidar/points").as_deref(), Ok("/lidar/points"));
        assert_eq!(ros_topic(&dds_topic("/lidar/points")), Some("/lidar/points"));
        assert_eq!(ros_topic("rtsomething"), None);
        let kind = "sensor_msgs/PointCloud2";
        assert_eq!(dds_type(kind), "sensor_msgs::msg::dds_::PointCloud2_");
        assert_eq!(ros_type(&dds_type(kind)).as_deref(), Some(kind));
        for wrong in ["", "/", "a//b", "/a/", "1a", "a b", "/points\u{1b}[2J"] {
            assert!(topic(wrong).unwrap_err().contains("expected a topic"), "{wrong:?}");
        }
    }
}
