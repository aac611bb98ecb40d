//! Boxes into a CPM.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_PI_2;

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::{
    Altitude, AltitudeConfidence, AltitudeValue, CardinalNumber1B, CartesianPosition3dWithConfidence, ConfidenceLevel,
    DeltaTimeMilliSecondSigned, EulerAnglesWithConfidence, HeadingValue, Identifier2B, ItsPduHeader, Latitude,
    Longitude, MessageId, ObjectClassDescription, ObjectClassWithConfidence, OrdinalNumber1B, PerceivedObject,
    PosConfidenceEllipse, ReferencePosition, SemiAxisLength, StationId, TimestampIts, Velocity3dWithConfidence,
    VelocityCartesian, Wgs84Angle, Wgs84AngleConfidence, Wgs84AngleValue,
};
use c_its_parser::standards::cpm_2_1_1::cpm_originating_station_containers::{
    OriginatingRsuContainer, OriginatingVehicleContainer,
};
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions::{
    CollectivePerceptionMessage, ConstraintWrappedCpmContainers, CpmContainerId, CpmPayload, ManagementContainer,
    ORIGINATING_RSU_CONTAINER, ORIGINATING_VEHICLE_CONTAINER, PERCEIVED_OBJECT_CONTAINER, WrappedCpmContainer,
    WrappedCpmContainers,
};
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::{PerceivedObjectContainer, PerceivedObjects};
use nalgebra::Isometry3;
use rasn::types::Any;
use realo_schemas::geometry::{is_valid, transform_box, yaw_of};
use realo_schemas::{Box3, Boxes, Header, Name, body_frame};

use super::station::{id_of, station_of};
use super::units::{CENTI, PLACE_DEG, angle, coordinate, dimension, tenths_of_degree, velocity};
use super::{FAR_M, Geodetic, MESSAGE, OBJECTS, VERSION, classes, clock};
use crate::bytes::is_unit;
use crate::{Dropped, EncodeError, EncoderSettings};

const UNAVAILABLE_AXIS: u16 = 4_095;
const UNAVAILABLE_ANGLE: u16 = 3_601;
const UNAVAILABLE_CONFIDENCE: u8 = 127;
/// Longitudes of -180 degrees are reported as 180.
const WEST: i32 = -1_800_000_000;
/// Heights that have a number, cm.
const HEIGHTS: std::ops::RangeInclusive<f64> = -99_999.0..=799_999.0;

/// Puts boxes into CPMs.
pub(crate) struct Writer {
    origin: Geodetic,
    roadside: Vec<Name>,
    max_objects: usize,
}

impl Writer {
    pub fn new(config: &EncoderSettings) -> Self {
        let names = config.roadside.split(',').map(str::trim);
        Writer {
            origin: config.origin,
            roadside: names.filter(|name| !name.is_empty()).map(Name::from).collect(),
            max_objects: config.max_objects,
        }
    }

    /// The boxes of an agent as one CPM, and what was left out of it.
    pub fn write(&self, header: &Header, boxes: &Boxes) -> Result<(Vec<u8>, Dropped), EncodeError> {
        let time = clock::timestamp_of(header.stamp).ok_or(EncodeError::Stamp(header.stamp))?;
        let map_from_frame = map_from_frame(header)?;
        let (position, reference) = reference_position(&self.origin, &map_from_frame)?;
        let reference_from_frame = self.origin.other_from_here(&reference) * map_from_frame;

        let (objects, dropped) = self.objects(header.seq, &reference_from_frame, boxes);
        let known = objects.len() as u64 + dropped.surplus;
        let number = CardinalNumber1B(u8::try_from(known).unwrap_or(u8::MAX));
        let mut containers = Vec::with_capacity(2);
        containers.extend(self.originating(header, &reference_from_frame)?);
        containers.push(wrapped(
            PERCEIVED_OBJECT_CONTAINER,
            &PerceivedObjectContainer::new(number, PerceivedObjects(objects)),
        )?);

        let station = StationId(station_of(&header.agent));
        let cpm = CollectivePerceptionMessage::new(
            ItsPduHeader::new(OrdinalNumber1B(VERSION), MessageId(MESSAGE), station),
            CpmPayload::new(
                ManagementContainer::new(TimestampIts(time), position, None, None),
                ConstraintWrappedCpmContainers(WrappedCpmContainers(containers)),
            ),
        );
        let bytes = rasn::uper::encode(&cpm).map_err(|error| EncodeError::Uper(error.to_string()))?;
        Ok((bytes, dropped))
    }

    /// Of a roadside unit that it is one, of a vehicle its heading; of boxes in the frame of somebody else nothing.
    fn originating(
        &self,
        header: &Header,
        reference_from_frame: &Isometry3<f64>,
    ) -> Result<Option<WrappedCpmContainer>, EncodeError> {
        if self.roadside.contains(&header.agent) {
            let container = OriginatingRsuContainer::new(None);
            return wrapped(ORIGINATING_RSU_CONTAINER, &container).map(Some);
        }
        if header.frame != body_frame(&header.agent) {
            return Ok(None);
        }
        // Clockwise from north, while a yaw counts from east to north.
        let heading = FRAC_PI_2 - yaw_of(&reference_from_frame.rotation);
        let orientation = Wgs84Angle::new(
            Wgs84AngleValue(tenths_of_degree(heading)),
            Wgs84AngleConfidence(UNAVAILABLE_CONFIDENCE),
        );
        let container = OriginatingVehicleContainer::new(orientation, None, None, None);
        wrapped(ORIGINATING_VEHICLE_CONTAINER, &container).map(Some)
    }

    fn objects(
        &self,
        seq: u64,
        reference_from_frame: &Isometry3<f64>,
        boxes: &Boxes,
    ) -> (Vec<PerceivedObject>, Dropped) {
        let mut dropped = Dropped::default();
        let mut objects: Vec<(f32, Option<u64>, PerceivedObject)> = Vec::new();
        for object in &boxes.0 {
            if !is_sound(object) {
                dropped.boxes += 1;
                continue;
            }
            match perceived(&transform_box(reference_from_frame, object)) {
                Some(perceived) => objects.push((object.score, object.track, perceived)),
                None => dropped.out_of_range += 1,
            }
        }
        if objects.len() > self.max_objects {
            let mut surest: Vec<usize> = (0..objects.len()).collect();
            surest.sort_by(|a, b| objects[*b].0.total_cmp(&objects[*a].0));
            let kept: BTreeSet<usize> = surest.into_iter().take(self.max_objects).collect();
            dropped.surplus = (objects.len() - kept.len()) as u64;
            let all = objects.into_iter().enumerate();
            objects = all
                .filter(|(index, _)| kept.contains(index))
                .map(|(_, object)| object)
                .collect();
        }
        let (objects, untracked) = identified(seq, objects);
        dropped.tracks = untracked;
        (objects, dropped)
    }
}

/// Objects with an id each, and how many have lost their track.
///
/// The id is that of the track. Where there is no track, or its id stands for another object of the message, it is one that means
/// nothing, which an age of 0 says. Tracks that fit 16 bits go before those whose id is a hash.
fn identified(seq: u64, objects: Vec<(f32, Option<u64>, PerceivedObject)>) -> (Vec<PerceivedObject>, u64) {
    let mut owners: BTreeMap<u16, usize> = BTreeMap::new();
    let is_hashed = |track: u64| track > u64::from(u16::MAX);
    for hashed in [false, true] {
        for (index, (_, track, _)) in objects.iter().enumerate() {
            if let Some(track) = track.filter(|track| is_hashed(*track) == hashed) {
                owners.entry(id_of(track)).or_insert(index);
            }
        }
    }
    let mut taken: BTreeSet<u16> = owners.keys().copied().collect();
    // Ids that mean nothing do not come again for as long as there are others.
    let mut next = (seq as u16).wrapping_mul(OBJECTS as u16 + 1);
    let mut untracked = 0;
    let objects = objects.into_iter().enumerate().map(|(index, (_, track, mut object))| {
        let id = track.map(id_of).filter(|id| owners.get(id) == Some(&index));
        untracked += u64::from(track.is_some() && id.is_none());
        object.object_age = id.is_none().then_some(DeltaTimeMilliSecondSigned(0));
        let id = id.unwrap_or_else(|| {
            while !taken.insert(next) {
                next = next.wrapping_add(1);
            }
            next
        });
        object.object_id = Some(Identifier2B(id));
        object
    });
    (objects.collect(), untracked)
}

/// Where the frame of the boxes lies.
fn map_from_frame(header: &Header) -> Result<Isometry3<f64>, EncodeError> {
    let Some(pose) = &header.pose else {
        return match &*header.frame {
            "map" => Ok(Isometry3::identity()),
            _ => Err(EncodeError::Nowhere(header.frame.clone())),
        };
    };
    let pose = pose.map_from_frame;
    if !is_unit(pose.rotation.quaternion()) || !pose.translation.vector.iter().all(|v| v.is_finite()) {
        return Err(EncodeError::NotFinite("pose"));
    }
    Ok(pose)
}

/// The place of the sender as a CPM reports it, and the place that this is to the last digit: boxes are relative to it.
fn reference_position(
    origin: &Geodetic,
    map_from_frame: &Isometry3<f64>,
) -> Result<(ReferencePosition, Geodetic), EncodeError> {
    let away = map_from_frame.translation.vector.norm();
    if away > FAR_M {
        return Err(EncodeError::Place {
            field: "distance from the map's origin, m,",
            expected: "100,000 at most",
            found: away,
        });
    }
    let place = origin.place_of(&map_from_frame.translation.vector);
    let number = |degrees: f64| (degrees / PLACE_DEG).round() as i32;
    let (latitude, longitude) = (number(place.latitude_deg), number(place.longitude_deg));
    let longitude = if longitude == WEST { -WEST } else { longitude };
    let height = (place.height_m / CENTI).round();
    if !HEIGHTS.contains(&height) {
        return Err(EncodeError::Place {
            field: "height over the ellipsoid, m,",
            expected: "-1,000 to 8,000",
            found: place.height_m,
        });
    }
    let height = height as i32;
    let position = ReferencePosition::new(
        Latitude(latitude),
        Longitude(longitude),
        PosConfidenceEllipse::new(
            SemiAxisLength(UNAVAILABLE_AXIS),
            SemiAxisLength(UNAVAILABLE_AXIS),
            HeadingValue(UNAVAILABLE_ANGLE),
        ),
        Altitude::new(AltitudeValue(height), AltitudeConfidence::unavailable),
    );
    let reference = Geodetic {
        latitude_deg: f64::from(latitude) * PLACE_DEG,
        longitude_deg: f64::from(longitude) * PLACE_DEG,
        height_m: f64::from(height) * CENTI,
    };
    Ok((position, reference))
}

fn is_sound(object: &Box3) -> bool {
    let velocity = object.velocity.iter().flatten();
    let mut motion = velocity.chain(object.covariance.iter().flatten());
    is_valid(object) && motion.all(|number| number.is_finite())
}

/// A box from the reference position, east and north of it; `None` beyond the numbers that there are.
fn perceived(object: &Box3) -> Option<PerceivedObject> {
    let variance = |index: usize| object.covariance.map(|covariance| covariance[index]);
    let [x, y, z] = object.center;
    let position = CartesianPosition3dWithConfidence::new(coordinate(x, variance(0))?, coordinate(y, variance(4))?, {
        Some(coordinate(z, None)?)
    });
    let velocity = object.velocity.map(|[x, y, z]| {
        let [x, y, z] = [x, y, z].map(velocity);
        Velocity3dWithConfidence::cartesianVelocity(VelocityCartesian::new(x, y, Some(z)))
    });
    let angles = EulerAnglesWithConfidence::new(angle(object.yaw, variance(8)), None, None);
    let percent = (100.0 * object.score).round().clamp(1.0, 100.0) as u8;
    let class = ObjectClassWithConfidence::new(classes::class_of(&object.class), ConfidenceLevel(percent));
    Some(PerceivedObject::new(
        None,
        DeltaTimeMilliSecondSigned(0),
        position,
        velocity,
        None,
        Some(angles),
        None,
        None,
        Some(dimension(object.height)?),
        Some(dimension(object.width)?),
        Some(dimension(object.length)?),
        None,
        None,
        None,
        Some(ObjectClassDescription(vec![class])),
        None,
    ))
}

fn wrapped<T: rasn::Encode>(id: CpmContainerId, container: &T) -> Result<WrappedCpmContainer, EncodeError> {
    let bytes = rasn::uper::encode(container).map_err(|error| EncodeError::Uper(error.to_string()))?;
    Ok(WrappedCpmContainer::new(id, Any::new(bytes)))
}
