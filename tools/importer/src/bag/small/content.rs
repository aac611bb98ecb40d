//! What a message says, alike in each serialisation.

use realo_bags::Connection;
use realo_bags::messages::{self, Kind};

/// What a message says with its stamp, as text; `None` of types that are not read, and of messages that cannot be read.
///
/// Fields that only one version of ROS has are left out, so the text is equal where the same message was recorded by both.
pub fn said(connection: &Connection, data: &[u8]) -> Option<String> {
    let kind = Kind::named(&connection.kind)?;
    of_kind(kind, connection, data).ok()
}

fn of_kind(kind: Kind, connection: &Connection, data: &[u8]) -> Result<String, String> {
    let begin = || connection.reader(data);
    let mut input = begin()?;
    Ok(match kind {
        Kind::PointCloud2 => return Err("clouds are not compared".into()),
        Kind::Transforms => format!("{:?}", messages::transforms(&mut input)?),
        Kind::Odometry | Kind::PoseStamped | Kind::PoseWithCovarianceStamped => {
            format!("{:?}", messages::pose(kind, &mut input)?)
        }
        Kind::NavSatFix => format!("{:?}", messages::fix(&mut input)?),
        Kind::Imu => format!(
            "{:?} {:?}",
            messages::attitude(&mut input)?,
            messages::inertial(&mut begin()?)?
        ),
        Kind::TwistStamped | Kind::TwistWithCovarianceStamped => {
            format!("{:?}", messages::speed(kind, &mut input)?)
        }
        Kind::TimeReference => format!("{:?}", messages::time_reference(&mut input)?),
        Kind::Detection3DArray => format!("{:?}", messages::detections(begin)?),
        Kind::MarkerArray => format!("{:?}", messages::markers(begin)?),
    })
}
