//! Boxes out of a CPM, of ours or of another stack.

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::{
    ObjectClass, PerceivedObject, ReferencePosition, Velocity3dWithConfidence,
};
use c_its_parser::standards::cpm_2_1_1::cpm_originating_station_containers::{
    OriginatingRsuContainer, OriginatingVehicleContainer,
};
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions::{
    CollectivePerceptionMessage, ORIGINATING_RSU_CONTAINER, ORIGINATING_VEHICLE_CONTAINER, PERCEIVED_OBJECT_CONTAINER,
};
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::PerceivedObjectContainer;
use nalgebra::{Isometry3, Vector3};
use realo_schemas::geometry::transform_box;
use realo_schemas::{Box3, Boxes, Header, Kind, Message, Nanos, Pose};

use super::station::station_of;
use super::units::{
    CENTI, PLACE_DEG, extent, metres, metres_per_second, radians, variance_of_angle, variance_of_coordinate,
};
use super::{FAR_M, Geodetic, classes, clock, pdu, whole};
use crate::DecodeError;
use crate::codec::same;

/// What "unavailable" is of a latitude, a longitude, a confidence; the numbers of heights that are none.
const LATITUDES: i32 = 900_000_000;
const LONGITUDES: i32 = 1_800_000_000;
const NO_CONFIDENCE: u8 = 101;
const HEIGHTS: std::ops::RangeInclusive<i32> = -99_999..=799_999;
const SPEEDS: u16 = 16_381;
/// Times of measurements that say how long ago, ms.
const DELTAS: std::ops::RangeInclusive<i16> = -2_047..=2_046;

/// Stamps and `referenceTime` of one message may differ by as much, ns: the one is exact, the other a whole millisecond.
const APART: Nanos = 1_000_000;
/// An object whose angle is not given and that is faster than this faces where it goes, m/s.
const MOVES: f64 = 1.0;
/// Score of an object without any confidence.
const SCORE: f32 = 0.5;

/// What of a CPM did not become boxes, or not without an assumption.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unused {
    /// Objects without a position, length, width or angle, or measured at an unknown time.
    pub objects: u64,
    /// Boxes whose height over ground, height, angle, class or score was assumed.
    pub assumed: u64,
    /// Containers that are not read.
    pub containers: u64,
    /// Messages that are one of several segments.
    pub segments: u64,
}

/// Gets boxes out of CPMs.
#[derive(Default)]
pub(crate) struct Parser {
    pub origin: Geodetic,
}

impl Parser {
    /// The message that a packet with these bytes is: agent, seq and stamp of the packet's header, boxes in `map`.
    ///
    /// `moved`: how far the header's stamp was moved onto another time line, ns.
    pub fn read(&self, header: Header, bytes: &[u8], moved: Nanos) -> Result<(Message, Unused), DecodeError> {
        let cpm = pdu(bytes)?;
        same("kind", &header.kind, &Kind::Boxes)?;
        same("station id", &station_of(&header.agent), &cpm.header.station_id.0)?;
        let stamp = stamp_of(&cpm)?.saturating_add(moved);
        let apart = header.stamp.checked_sub(stamp);
        if apart.is_none_or(|apart| !(-APART..=APART).contains(&apart)) {
            same("stamp", &header.stamp, &stamp)?;
        }
        let (boxes, unused) = self.boxes(&cpm)?;
        let header = Header {
            frame: "map".into(),
            pose: Some(Pose::exact(Isometry3::identity())),
            ..header
        };
        Ok((Message::new(header, boxes), unused))
    }

    /// The boxes of a CPM, in `map`.
    fn boxes(&self, cpm: &CollectivePerceptionMessage) -> Result<(Boxes, Unused), DecodeError> {
        let management = &cpm.payload.management_container;
        let reference = self.place_of(&management.reference_position)?;
        let map_from_reference = reference.other_from_here(&self.origin);
        let away = map_from_reference.translation.vector.norm();
        if away > FAR_M {
            return Err(DecodeError::Elsewhere {
                far_km: away / 1000.0,
                limit_km: FAR_M / 1000.0,
            });
        }
        let mut unused = Unused::default();
        let segmentation = management.segmentation_info.as_ref();
        unused.segments = u64::from(segmentation.is_some_and(|info| info.total_msg_no.0 > 1));
        let mut objects: Option<Vec<PerceivedObject>> = None;
        for container in &cpm.payload.cpm_containers.0.0 {
            let bytes = container.container_data.as_bytes();
            if container.container_id == PERCEIVED_OBJECT_CONTAINER && objects.is_none() {
                objects = Some(perceived_objects(bytes)?);
            } else if container.container_id == ORIGINATING_VEHICLE_CONTAINER {
                whole::<OriginatingVehicleContainer>(bytes, "originatingVehicleContainer")?;
            } else if container.container_id == ORIGINATING_RSU_CONTAINER {
                whole::<OriginatingRsuContainer>(bytes, "originatingRsuContainer")?;
            } else {
                unused.containers += 1;
            }
        }
        let mut boxes = Vec::new();
        for object in objects.iter().flatten() {
            match box_of(object) {
                Some((found, assumed)) => {
                    unused.assumed += u64::from(assumed);
                    boxes.push(transform_box(&map_from_reference, &found));
                }
                None => unused.objects += 1,
            }
        }
        Ok((Boxes(boxes), unused))
    }

    /// A height that is not known is that of the map's origin.
    fn place_of(&self, position: &ReferencePosition) -> Result<Geodetic, DecodeError> {
        let (latitude, longitude) = (position.latitude.0, position.longitude.0);
        if latitude > LATITUDES || longitude > LONGITUDES {
            return Err(DecodeError::Cpm {
                part: "referencePosition",
                found: "no latitude or no longitude".into(),
            });
        }
        let height = position.altitude.altitude_value.0;
        Ok(Geodetic {
            latitude_deg: f64::from(latitude) * PLACE_DEG,
            longitude_deg: f64::from(longitude) * PLACE_DEG,
            height_m: match HEIGHTS.contains(&height) {
                true => f64::from(height) * CENTI,
                false => self.origin.height_m,
            },
        })
    }
}

/// The stamp of a CPM's reference time, ns since 1970.
pub(super) fn stamp_of(cpm: &CollectivePerceptionMessage) -> Result<Nanos, DecodeError> {
    let time = cpm.payload.management_container.reference_time.0;
    clock::stamp_of(time).ok_or_else(|| DecodeError::Cpm {
        part: "referenceTime",
        found: time.to_string(),
    })
}

fn perceived_objects(bytes: &[u8]) -> Result<Vec<PerceivedObject>, DecodeError> {
    // Behind the container's extension bit and the number of objects: the list's, which is set for more than 255. Looked at
    // first, since a length that somebody made up reserves memory for as many.
    if bytes.get(1).is_some_and(|byte| byte & 0x40 != 0) {
        return Err(DecodeError::Cpm {
            part: "perceivedObjects",
            found: "more than 255 objects".into(),
        });
    }
    let container: PerceivedObjectContainer = whole(bytes, "perceivedObjectContainer")?;
    Ok(container.perceived_objects.0)
}

/// An object as a box about the reference position, and whether something of it was assumed; `None` if what is known of it makes
/// no box.
fn box_of(object: &PerceivedObject) -> Option<(Box3, bool)> {
    let delta = object.measurement_delta_time.0;
    if !DELTAS.contains(&delta) {
        return None;
    }
    let position = &object.position;
    let (x, y) = (metres(&position.x_coordinate)?, metres(&position.y_coordinate)?);
    let length = extent(&object.object_dimension_x)?;
    let width = extent(&object.object_dimension_y)?;
    let known_height = extent(&object.object_dimension_z);
    let class = class_of(object);
    let walks = class.is_some_and(|(class, _)| classes::walks(class));
    let name = class.map_or(classes::UNKNOWN, |(class, _)| classes::name_of(class));
    let height = known_height.unwrap_or_else(|| usual_height(name, walks));
    let known_z = position.z_coordinate.as_ref().and_then(metres);
    let velocity = object.velocity.as_ref().and_then(velocity_of);

    let reported = object.angles.as_ref();
    let known_yaw = reported.and_then(|angles| radians(&angles.z_angle));
    let moving = velocity.filter(|velocity| velocity.xy().norm() > MOVES);
    let course = moving.map(|velocity| libm::atan2(velocity.y, velocity.x));
    let yaw = known_yaw.or(course).or(walks.then_some(0.0))?;

    let known_score = score_of(object, class.and_then(|(_, percent)| percent));

    // Where it was, or will be, at the reference time.
    let moved = velocity.unwrap_or_default() * (-f64::from(delta) / 1000.0);
    let center = Vector3::new(x, y, known_z.unwrap_or(height / 2.0)) + moved;
    let variances = [
        variance_of_coordinate(&position.x_coordinate),
        variance_of_coordinate(&position.y_coordinate),
        reported
            .filter(|_| known_yaw.is_some())
            .and_then(|angles| variance_of_angle(&angles.z_angle)),
    ];
    // An age of 0 says that the id has not meant anything before.
    let is_new = object.object_age.as_ref().is_some_and(|age| age.0 == 0);
    let id = object.object_id.as_ref().filter(|_| !is_new);
    let found = Box3 {
        center: center.into(),
        length,
        width,
        height,
        yaw,
        velocity: velocity.map(Into::into),
        class: name.into(),
        score: known_score.unwrap_or(SCORE),
        track: id.map(|id| id.0.into()),
        covariance: diagonal(variances),
    };
    let knows_all =
        known_height.is_some() && known_z.is_some() && known_yaw.is_some() && class.is_some() && known_score.is_some();
    Some((found, !knows_all))
}

/// Height of an object of which none is said, m.
fn usual_height(class: &str, walks: bool) -> f64 {
    match class {
        "truck" | "Bus" | "Tram" => 3.0,
        _ if walks => 1.7,
        _ => 1.5,
    }
}

/// How sure the sender is of an object: of its class, else of its being there.
fn score_of(object: &PerceivedObject, class_percent: Option<u8>) -> Option<f32> {
    let of_class = class_percent.map(|percent| f32::from(percent) / 100.0);
    let quality = object.object_perception_quality.as_ref().map(|quality| quality.0);
    // 0: there is none, or it could not be computed.
    let quality = quality.filter(|quality| *quality > 0);
    of_class.or(quality.map(|quality| f32::from(quality) / 15.0))
}

/// The surest class, the first of equals, and its confidence in per cent where it is known.
fn class_of(object: &PerceivedObject) -> Option<(&ObjectClass, Option<u8>)> {
    let classes = object.classification.as_ref()?.0.iter().map(|class| {
        let confidence = class.confidence.0;
        (&class.object_class, (confidence != NO_CONFIDENCE).then_some(confidence))
    });
    classes.reduce(|best, next| if next.1 > best.1 { next } else { best })
}

/// m/s east, north and up; upwards 0 where that is not given.
fn velocity_of(velocity: &Velocity3dWithConfidence) -> Option<Vector3<f64>> {
    let (x, y, up) = match velocity {
        Velocity3dWithConfidence::cartesianVelocity(velocity) => (
            metres_per_second(&velocity.x_velocity)?,
            metres_per_second(&velocity.y_velocity)?,
            &velocity.z_velocity,
        ),
        Velocity3dWithConfidence::polarVelocity(velocity) => {
            let speed = velocity.velocity_magnitude.speed_value.0;
            let speed = (speed <= SPEEDS).then_some(f64::from(speed) * CENTI)?;
            let (sin, cos) = libm::sincos(radians(&velocity.velocity_direction)?);
            (speed * cos, speed * sin, &velocity.z_velocity)
        }
    };
    Some(Vector3::new(
        x,
        y,
        up.as_ref().and_then(metres_per_second).unwrap_or(0.0),
    ))
}

fn diagonal(variances: [Option<f64>; 3]) -> Option<[f64; 9]> {
    let [x, y, yaw] = variances;
    let mut covariance = [0.0; 9];
    (covariance[0], covariance[4], covariance[8]) = (x?, y?, yaw?);
    Some(covariance)
}
