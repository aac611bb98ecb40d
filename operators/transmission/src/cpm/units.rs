//! Numbers of a CPM and what they stand for. A number is the nearest whole number of its unit: the common data dictionary
//! (ETSI TS 102 894-2) words most of them as the next greater one, which would shift everything by half a unit on average.

use std::f64::consts::{PI, TAU};

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::{
    AngleConfidence, CartesianAngle, CartesianAngleValue, CartesianCoordinateLarge, CartesianCoordinateWithConfidence,
    CoordinateConfidence, ObjectDimension, ObjectDimensionConfidence, ObjectDimensionValue, SpeedConfidence,
    VelocityComponent, VelocityComponentValue,
};

/// Degrees of latitude and longitude.
pub(crate) const PLACE_DEG: f64 = 1e-7;
/// Metres of heights, positions and their confidences; m/s of velocities.
pub(crate) const CENTI: f64 = 0.01;
/// Degrees of angles, metres of dimensions.
const DECI: f64 = 0.1;
/// Half the width of the interval that holds 95 % of a normal distribution, in standard deviations.
const SIGMAS_95: f64 = 1.959_963_985;

/// The largest numbers that mean what they say; beyond are "out of range" and "unavailable".
const COORDINATES: f64 = 131_070.0;
const VELOCITIES: std::ops::RangeInclusive<f64> = -16_382.0..=16_381.0;
const DIMENSIONS: f64 = 254.0;
const ANGLES: u16 = 3_600;
const UNAVAILABLE_ANGLE: u16 = 3_601;
const OUT_OF_RANGE_COORDINATE: u16 = 4_095;
const UNAVAILABLE_COORDINATE: u16 = 4_096;
const OUT_OF_RANGE_CONFIDENCE: u8 = 126;
const UNAVAILABLE_CONFIDENCE: u8 = 127;
const UNAVAILABLE_DIMENSION: u8 = 32;

/// A coordinate in metres with its variance; `None` beyond ±1,310.7 m.
pub(crate) fn coordinate(metres: f64, variance: Option<f64>) -> Option<CartesianCoordinateWithConfidence> {
    let number = (metres / CENTI).round();
    let confidence = known(variance).map_or(UNAVAILABLE_COORDINATE, |variance| {
        bound_95(variance, CENTI, OUT_OF_RANGE_COORDINATE)
    });
    (number.abs() <= COORDINATES).then(|| {
        CartesianCoordinateWithConfidence::new(
            CartesianCoordinateLarge(number as i32),
            CoordinateConfidence(confidence),
        )
    })
}

/// Metres; `None` if the sender says that they are out of range.
pub(crate) fn metres(coordinate: &CartesianCoordinateWithConfidence) -> Option<f64> {
    let number = f64::from(coordinate.value.0);
    (number.abs() <= COORDINATES).then_some(number * CENTI)
}

pub(crate) fn variance_of_coordinate(coordinate: &CartesianCoordinateWithConfidence) -> Option<f64> {
    let number = coordinate.confidence.0;
    (number < OUT_OF_RANGE_COORDINATE).then(|| variance(f64::from(number) * CENTI))
}

/// A component of a velocity, m/s; what is faster than 163.8 m/s says so.
pub(crate) fn velocity(metres_per_second: f64) -> VelocityComponent {
    let number = (metres_per_second / CENTI).round();
    let number = number.clamp(*VELOCITIES.start() - 1.0, *VELOCITIES.end() + 1.0) as i16;
    VelocityComponent::new(VelocityComponentValue(number), SpeedConfidence(UNAVAILABLE_CONFIDENCE))
}

/// m/s, where they are known.
pub(crate) fn metres_per_second(component: &VelocityComponent) -> Option<f64> {
    let number = f64::from(component.value.0);
    // The dictionary says of a speed whose confidence is out of range that it "is not valid and cannot be trusted".
    let is_valid = VELOCITIES.contains(&number) && component.confidence.0 != OUT_OF_RANGE_CONFIDENCE;
    is_valid.then_some(number * CENTI)
}

/// An angle in radians with its variance.
pub(crate) fn angle(radians: f64, variance: Option<f64>) -> CartesianAngle {
    let confidence = known(variance).map_or(UNAVAILABLE_CONFIDENCE, |variance| {
        let unit = DECI * PI / 180.0;
        bound_95(variance, unit, OUT_OF_RANGE_CONFIDENCE.into()) as u8
    });
    CartesianAngle::new(
        CartesianAngleValue(tenths_of_degree(radians)),
        AngleConfidence(confidence),
    )
}

/// Tenths of a degree in [0, 3600).
pub(crate) fn tenths_of_degree(radians: f64) -> u16 {
    let tenths = (radians * (180.0 / PI) / DECI).round();
    tenths.rem_euclid(f64::from(ANGLES)) as u16
}

/// Radians in (-π, π], where the angle is known.
pub(crate) fn radians(angle: &CartesianAngle) -> Option<f64> {
    // 3600 "shall not be used" and still says what it means.
    let is_known = angle.value.0 != UNAVAILABLE_ANGLE;
    let turn = f64::from(angle.value.0 % ANGLES) / f64::from(ANGLES);
    is_known.then_some(if turn > 0.5 { turn - 1.0 } else { turn } * TAU)
}

pub(crate) fn variance_of_angle(angle: &CartesianAngle) -> Option<f64> {
    let number = angle.confidence.0;
    (number < OUT_OF_RANGE_CONFIDENCE).then(|| variance(f64::from(number) * DECI * PI / 180.0))
}

/// A dimension in metres, at least 0.1 m; `None` above 25.4 m.
pub(crate) fn dimension(metres: f64) -> Option<ObjectDimension> {
    let number = (metres / DECI).round().max(1.0);
    (number <= DIMENSIONS).then(|| {
        ObjectDimension::new(
            ObjectDimensionValue(number as u16),
            ObjectDimensionConfidence(UNAVAILABLE_DIMENSION),
        )
    })
}

/// Metres, where the dimension is known and in range.
pub(crate) fn extent(dimension: &Option<ObjectDimension>) -> Option<f64> {
    let number = f64::from(dimension.as_ref()?.value.0);
    (number <= DIMENSIONS).then_some(number * DECI)
}

/// A variance that can be one.
fn known(variance: Option<f64>) -> Option<f64> {
    variance.filter(|variance| *variance >= 0.0)
}

/// What 95 % of the errors are below, in whole units, rounded up; `beyond` where it is as great as that.
fn bound_95(variance: f64, unit: f64, beyond: u16) -> u16 {
    let number = (SIGMAS_95 * variance.sqrt() / unit).ceil().max(1.0);
    if number < f64::from(beyond) {
        number as u16
    } else {
        beyond
    }
}

fn variance(bound: f64) -> f64 {
    (bound / SIGMAS_95) * (bound / SIGMAS_95)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_at_the_edges_are_reported_as_they_should_be() {
        let cases = [
            (0.0, 0),
            (-0.04, 0),
            (-0.06, 3_599),
            (359.94, 3_599),
            (359.96, 0),
            (360.0, 0),
            (180.0, 1_800),
            (-180.0, 1_800),
            (-90.0, 2_700),
            (725.0, 50),
        ];
        for (degrees, expected) in cases {
            assert_eq!(tenths_of_degree(degrees * PI / 180.0), expected, "{degrees}");
        }
        let read = |number| radians(&CartesianAngle::new(CartesianAngleValue(number), AngleConfidence(127)));
        assert_eq!(read(0), Some(0.0));
        assert_eq!(read(3_600), Some(0.0));
        assert_eq!(read(1_800), Some(PI));
        let turned = read(1_801).unwrap() + 1_799.0 / 1_800.0 * PI;
        assert!(turned.abs() < 1e-12, "{turned}");
        assert_eq!(read(3_601), None);
    }

    #[test]
    fn numbers_at_the_edges_of_their_ranges_are_reported_or_left_out() {
        let number = |metres| coordinate(metres, None).map(|coordinate| coordinate.value.0);
        assert_eq!(number(-0.004), Some(0));
        assert_eq!(number(1_310.704), Some(131_070));
        assert_eq!(number(-1_310.704), Some(-131_070));
        assert_eq!(number(1_310.706), None);
        assert_eq!(number(f64::NAN), None);
        assert_eq!(number(f64::NEG_INFINITY), None);
        let number = |metres| dimension(metres).map(|dimension| dimension.value.0);
        assert_eq!(
            [number(0.001), number(0.16), number(25.44)],
            [Some(1), Some(2), Some(254)]
        );
        assert_eq!(number(25.46), None);
        let speeds = [-163.82, -163.83, -1e9, 163.81, 163.82, 1e9];
        let numbers = speeds.map(|speed| velocity(speed).value.0);
        assert_eq!(numbers, [-16_382, -16_383, -16_383, 16_381, 16_382, 16_382]);
        assert_eq!(metres_per_second(&velocity(-163.82)), Some(-16_382.0 * CENTI));
        assert_eq!(metres_per_second(&velocity(163.83)), None);
        assert_eq!(metres_per_second(&velocity(-163.84)), None);
    }

    #[test]
    fn variances_are_bounds_of_95_per_cent() {
        // A deviation of 0.25 m: 0.49 m.
        let reported = coordinate(0.0, Some(0.0625)).unwrap();
        assert_eq!(reported.confidence.0, 49);
        let back = variance_of_coordinate(&reported).unwrap();
        assert!((back.sqrt() - 0.25).abs() < CENTI / SIGMAS_95, "{back}");
        assert_eq!(
            coordinate(0.0, Some(1e9)).unwrap().confidence.0,
            OUT_OF_RANGE_COORDINATE
        );
        assert_eq!(coordinate(0.0, Some(0.0)).unwrap().confidence.0, 1);
        for unknown in [f64::NAN, -0.25] {
            let reported = coordinate(0.0, Some(unknown)).unwrap();
            assert_eq!(reported.confidence.0, UNAVAILABLE_COORDINATE);
        }
        assert_eq!(variance_of_coordinate(&coordinate(0.0, None).unwrap()), None);
        // A deviation of 2 degrees: 3.92 degrees; one of 7 is beyond.
        let degree = (PI / 180.0) * (PI / 180.0);
        assert_eq!(angle(0.0, Some(4.0 * degree)).confidence.0, 40);
        assert_eq!(angle(0.0, Some(49.0 * degree)).confidence.0, OUT_OF_RANGE_CONFIDENCE);
        assert_eq!(variance_of_angle(&angle(0.0, Some(49.0 * degree))), None);
    }
}
