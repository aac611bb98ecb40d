//! Bags of ROS behind the trait of all kinds.

use std::path::Path;

use super::{Imported, Importer, Job, Kind};
use crate::bag::Bags;
use crate::{ImportError, Options};

/// Bags of ROS 1 and ROS 2.
pub struct RosBag;

static KIND: Kind = Kind {
    name: "bag",
    title: "Bags of ROS 1 and ROS 2, MCAP files of others, captures of packets",
    needs: "clouds (sensor_msgs/PointCloud2, or packets of Ouster and RoboSense) and poses: Odometry, PoseStamped, TF, or NavSatFix and Imu",
    unit: "messages",
    paths: Some("Bags (`.bag`, folders of ROS 2, `.db3`, `.mcap`, `.pcap`) that become one log, as of one agent each"),
    is_exact: true,
    options: &[("map", ""), ("agents", "")],
};

impl Importer for RosBag {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, path: &Path) -> Result<String, String> {
        realo_bags::recognise(path).map(String::from)
    }

    fn prepare(&self, path: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        let paths = std::iter::once(path.to_path_buf()).chain(options.more.clone());
        let bags = Bags::new(paths.collect(), output, options);
        Ok(Job::new(vec![output.into()], move |report| {
            let summary = bags.run(report)?;
            Ok(Imported::Bags(Box::new(summary)))
        }))
    }
}
