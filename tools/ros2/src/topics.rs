//! `realo-ros2 topics`: what is published.

use std::time::{Duration, Instant};

use realo_operator::{Settings, config};
use serde::{Deserialize, Serialize};

use crate::ros::{self, Ros};

/// Between two looks.
const LOOK: Duration = Duration::from_millis(100);

/// Settings of the command.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Domain of ROS, 0 to 232; null: what ROS_DOMAIN_ID says, or 0.
    pub domain: Option<u16>,
    /// Whether only programs on this machine are heard.
    pub localhost: bool,
    /// How long announcements are awaited, s.
    #[setting(default = 3.0, range = 0.1..=3600.0)]
    pub seconds: f64,
}

/// Prints every topic with its type and how it is published.
///
/// # Errors
/// Settings that are none; what keeps it from the network.
pub fn main(args: &[String]) -> Result<(), String> {
    let settings: Settings = config::parse(args).map_err(|error| error.to_string())?;
    let domain = ros::domain(settings.domain)?;
    let mut ros = Ros::join(domain, settings.localhost, "realo_topics").map_err(|error| error.to_string())?;
    let began = Instant::now();
    while began.elapsed().as_secs_f64() < settings.seconds {
        std::thread::sleep(LOOK);
        ros.announce().map_err(|error| error.to_string())?;
    }
    let found = ros.found();
    for publisher in &found {
        let delivery = if publisher.is_reliable {
            "reliable"
        } else {
            "best effort"
        };
        println!("{:40} {:45} {delivery}", publisher.topic, publisher.kind);
    }
    match found.is_empty() {
        false => Ok(()),
        true => Err(format!(
            "no publisher in domain {domain} within {} s: look at ROS_DOMAIN_ID, and whether this network carries multicast",
            settings.seconds
        )),
    }
}
