//! What messages say, in the serialisation of ROS 1 or ROS 2. Positions in m, angles in rad, times in ns.

mod boxes;

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};
use realo_logs::cdr::{CdrError, CdrReader};
use realo_logs::motion::{ImuReading, WheelReading};
use realo_logs::pose::isometry;
use realo_schemas::{FixQuality, Nanos};

pub use self::boxes::{Object, Objects, TEXT, detections, markers};

/// Types that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `sensor_msgs/PointCloud2`.
    PointCloud2,
    /// `tf2_msgs/TFMessage`, of ROS 1 `tf/tfMessage` too.
    Transforms,
    /// `nav_msgs/Odometry`.
    Odometry,
    /// `geometry_msgs/PoseStamped`.
    PoseStamped,
    /// `geometry_msgs/PoseWithCovarianceStamped`.
    PoseWithCovarianceStamped,
    /// `sensor_msgs/NavSatFix`.
    NavSatFix,
    /// `sensor_msgs/Imu`.
    Imu,
    /// `geometry_msgs/TwistStamped`.
    TwistStamped,
    /// `geometry_msgs/TwistWithCovarianceStamped`.
    TwistWithCovarianceStamped,
    /// `sensor_msgs/TimeReference`.
    TimeReference,
    /// `vision_msgs/Detection3DArray`.
    Detection3DArray,
    /// `visualization_msgs/MarkerArray`.
    MarkerArray,
}

impl Kind {
    const ALL: [(Kind, &str); 13] = [
        (Kind::PointCloud2, "sensor_msgs/PointCloud2"),
        (Kind::Transforms, "tf2_msgs/TFMessage"),
        (Kind::Transforms, "tf/tfMessage"),
        (Kind::Odometry, "nav_msgs/Odometry"),
        (Kind::PoseStamped, "geometry_msgs/PoseStamped"),
        (
            Kind::PoseWithCovarianceStamped,
            "geometry_msgs/PoseWithCovarianceStamped",
        ),
        (Kind::NavSatFix, "sensor_msgs/NavSatFix"),
        (Kind::Imu, "sensor_msgs/Imu"),
        (Kind::TwistStamped, "geometry_msgs/TwistStamped"),
        (
            Kind::TwistWithCovarianceStamped,
            "geometry_msgs/TwistWithCovarianceStamped",
        ),
        (Kind::TimeReference, "sensor_msgs/TimeReference"),
        (Kind::Detection3DArray, "vision_msgs/Detection3DArray"),
        (Kind::MarkerArray, "visualization_msgs/MarkerArray"),
    ];

    /// The type of a name as [`crate::Connection`] has it, if it is read.
    pub fn named(name: &str) -> Option<Self> {
        let found = Kind::ALL.iter().find(|(_, known)| *known == name);
        found.map(|(kind, _)| *kind)
    }

    /// Whether messages say where something is.
    pub fn is_pose(self) -> bool {
        matches!(
            self,
            Kind::Odometry | Kind::PoseStamped | Kind::PoseWithCovarianceStamped | Kind::NavSatFix
        )
    }

    /// Whether messages say how fast something is.
    pub fn is_speed(self) -> bool {
        matches!(
            self,
            Kind::Odometry | Kind::TwistStamped | Kind::TwistWithCovarianceStamped
        )
    }

    /// Whether messages list objects.
    pub fn is_objects(self) -> bool {
        matches!(self, Kind::Detection3DArray | Kind::MarkerArray)
    }
}

/// How a frame lies in another.
#[derive(Clone, Debug, PartialEq)]
pub struct Transform {
    /// When.
    pub stamp: Nanos,
    /// The frame that it is given in.
    pub parent: String,
    /// The frame that is placed.
    pub child: String,
    /// Brings what lies in the child into the parent.
    pub parent_from_child: Isometry3<f64>,
}

/// A pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Pose {
    /// When.
    pub stamp: Nanos,
    /// The frame that it is given in.
    pub frame: String,
    /// The frame that is placed, where the message names it.
    pub child: Option<String>,
    /// Brings what lies in the child into the frame.
    pub frame_from_child: Isometry3<f64>,
    /// Row-major over x, y, z and rotations about them, where known.
    pub covariance: Option<Box<[f64; 36]>>,
}

/// What a satellite receiver says.
#[derive(Clone, Debug, PartialEq)]
pub struct Fix {
    /// When.
    pub stamp: Nanos,
    /// The frame of the antenna.
    pub frame: String,
    /// Latitude and longitude on WGS 84, degrees, and height over the ellipsoid, m; `None` without a position.
    pub geodetic: Option<[f64; 3]>,
    /// How the position was found.
    pub quality: Option<FixQuality>,
    /// Row-major 3×3 covariance along east, north and up, m², where known.
    pub covariance: Option<[f64; 9]>,
}

/// What a motion sensor measured.
#[derive(Clone, Debug, PartialEq)]
pub struct Measured<T> {
    /// When.
    pub stamp: Nanos,
    /// The frame of the sensor.
    pub frame: String,
    /// What it says.
    pub reading: T,
}

/// What an inertial unit says of its attitude.
#[derive(Clone, Debug, PartialEq)]
pub struct Attitude {
    /// When.
    pub stamp: Nanos,
    /// The frame of the unit.
    pub frame: String,
    /// East-north-up from the unit; `None` where it does not know.
    pub world_from_unit: Option<UnitQuaternion<f64>>,
}

/// Stamp and frame of a message that begins with a header; of transforms, of the first one.
///
/// # Errors
/// Bytes that are no such message.
pub fn header(kind: Kind, input: &mut CdrReader) -> Result<Option<(Nanos, String)>, CdrError> {
    if matches!(kind, Kind::Transforms | Kind::MarkerArray) && input.length(13)? == 0 {
        return Ok(None);
    }
    let (stamp, frame) = input.header()?;
    Ok(Some((stamp, frame.into())))
}

/// Reads a `TFMessage`. Transforms that are none are left out and counted.
///
/// # Errors
/// Bytes that are no such message.
pub fn transforms(input: &mut CdrReader) -> Result<(Vec<Transform>, usize), CdrError> {
    let (mut transforms, mut wrong) = (Vec::new(), 0);
    for _ in 0..input.length(70)? {
        let (stamp, parent) = input.header()?;
        let child = input.string()?;
        match isometry(&input.f64s()?) {
            Ok(parent_from_child) => transforms.push(Transform {
                stamp,
                parent: parent.into(),
                child: child.into(),
                parent_from_child,
            }),
            Err(_) => wrong += 1,
        }
    }
    Ok((transforms, wrong))
}

/// Reads an `Odometry`, a `PoseStamped` or a `PoseWithCovarianceStamped`.
///
/// # Errors
/// Bytes that are no such message; numbers that are no pose.
pub fn pose(kind: Kind, input: &mut CdrReader) -> Result<Pose, CdrError> {
    let (stamp, frame) = input.header()?;
    let child = match kind {
        Kind::Odometry => Some(input.string()?).filter(|child| !child.is_empty()),
        _ => None,
    };
    let frame_from_child = isometry(&input.f64s()?)?;
    let covariance = match kind {
        Kind::PoseStamped => None,
        _ => Some(Box::new(input.f64s()?)),
    };
    Ok(Pose {
        stamp,
        frame: frame.into(),
        child: child.map(String::from),
        frame_from_child,
        covariance: covariance
            .filter(|numbers| numbers.iter().all(|v| v.is_finite()) && numbers.iter().any(|v| *v != 0.0)),
    })
}

/// Reads a `NavSatFix`.
///
/// # Errors
/// Bytes that are no such message; a position that is no place on the Earth.
pub fn fix(input: &mut CdrReader) -> Result<Fix, CdrError> {
    let (stamp, frame) = input.header()?;
    let status = input.u8()? as i8;
    input.u16()?;
    let geodetic = input.f64s::<3>()?;
    let covariance = input.f64s::<9>()?;
    let is_known = input.u8()? != 0 && covariance.iter().all(|v| v.is_finite());
    let is_there = status >= 0 && geodetic.iter().all(|v| v.is_finite());
    if is_there {
        realo_logs::MapOrigin::new(geodetic)?;
    }
    Ok(Fix {
        stamp,
        frame: frame.into(),
        geodetic: is_there.then_some(geodetic),
        quality: FixQuality::of_code(status.into()).filter(|_| is_there),
        covariance: is_known.then_some(covariance),
    })
}

/// Reads the attitude of an `Imu`.
///
/// # Errors
/// Bytes that are no such message.
pub fn attitude(input: &mut CdrReader) -> Result<Attitude, CdrError> {
    let (stamp, frame) = input.header()?;
    let [x, y, z, w] = input.f64s()?;
    let covariance = input.f64s::<9>()?;
    let quaternion = Quaternion::new(w, x, y, z);
    // A first covariance of -1 says that there is no attitude; many drivers leave the quaternion at 0.
    let is_known = covariance[0] != -1.0 && (quaternion.norm() - 1.0).abs() < 0.01;
    Ok(Attitude {
        stamp,
        frame: frame.into(),
        world_from_unit: is_known.then(|| UnitQuaternion::from_quaternion(quaternion)),
    })
}

/// Reads the motion of an `Imu`: rates and forces along the axes of its frame. `None` of a unit that gives its attitude alone: a
/// first covariance of −1 says so, and so do zeros, since gravity is never 0.
///
/// # Errors
/// Bytes that are no such message; numbers that are not finite.
pub fn inertial(input: &mut CdrReader) -> Result<Option<Measured<ImuReading>>, CdrError> {
    let (stamp, frame) = input.header()?;
    let (_attitude, _covariance) = (input.f64s::<4>()?, input.f64s::<9>()?);
    let angular_rate: [f64; 3] = input.f64s()?;
    let of_rate = input.f64s::<9>()?;
    let specific_force: [f64; 3] = input.f64s()?;
    let of_force = input.f64s::<9>()?;
    if of_rate[0] == -1.0 || of_force[0] == -1.0 || specific_force == [0.0; 3] {
        return Ok(None);
    }
    if !angular_rate.iter().chain(&specific_force).all(|v| v.is_finite()) {
        return Err(format!(
            "expected finite rates and accelerations, found {angular_rate:?} and {specific_force:?}"
        ));
    }
    let largest = |covariance: [f64; 9]| {
        let most = [0, 4, 8].map(|place| covariance[place]).into_iter().fold(0.0, f64::max);
        (most > 0.0 && most.is_finite()).then_some(most)
    };
    Ok(Some(Measured {
        stamp,
        frame: frame.into(),
        reading: ImuReading {
            angular_rate,
            specific_force,
            variance: largest(of_rate)
                .zip(largest(of_force))
                .map(|(rate, force)| [rate, force]),
        },
    }))
}

/// Reads the speed in a `TwistStamped`, a `TwistWithCovarianceStamped` or an `Odometry`, which is that of its child.
///
/// # Errors
/// Bytes that are no such message; numbers that are not finite.
pub fn speed(kind: Kind, input: &mut CdrReader) -> Result<Measured<WheelReading>, CdrError> {
    let (stamp, frame) = input.header()?;
    let frame = match kind {
        Kind::Odometry => {
            let child = input.string()?;
            let (_pose, _covariance) = (input.f64s::<7>()?, input.f64s::<36>()?);
            child
        }
        _ => frame,
    };
    let velocity = input.f64s::<3>()?;
    let _turning = input.f64s::<3>()?;
    let variance = match kind {
        Kind::TwistStamped => None,
        _ => Some(input.f64s::<36>()?[0]).filter(|variance| *variance > 0.0 && variance.is_finite()),
    };
    match velocity.iter().all(|v| v.is_finite()) {
        true => Ok(Measured {
            stamp,
            frame: frame.into(),
            reading: WheelReading { velocity, variance },
        }),
        false => Err(format!("expected a finite velocity, found {velocity:?}")),
    }
}

/// Reads a `TimeReference`: a time of the sender's clock, the same of the reference (ns), and the name of the reference.
///
/// # Errors
/// Bytes that are no such message.
pub fn time_reference(input: &mut CdrReader) -> Result<([Nanos; 2], String), CdrError> {
    let (stamp, _) = input.header()?;
    let reference = input.time()?;
    Ok(([stamp, reference], input.string()?.to_string()))
}
