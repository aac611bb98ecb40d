//! Motion sensors of an agent: `sensor_msgs/msg/Imu`, `sensor_msgs/msg/NavSatFix`, and the speed of its wheels as
//! `geometry_msgs/msg/TwistWithCovarianceStamped`.

use nalgebra::Vector3;
use realo_schemas::{FixQuality, Nanos};

use crate::cdr::{CdrError, CdrReader, CdrWriter};
use crate::geodesy::geodetic_fault;

/// A sample of an inertial unit, along the axes of its frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuReading {
    /// rad/s.
    pub angular_rate: [f64; 3],
    /// Acceleration less gravity, m/s²: at rest 9.8 upwards.
    pub specific_force: [f64; 3],
    /// Variances of white noise, (rad/s)² and (m/s²)², where known.
    pub variance: Option<[f64; 2]>,
}

/// What a satellite receiver says at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FixReading {
    /// How the position was found; `None`: there is none.
    pub quality: Option<FixQuality>,
    /// Latitude and longitude on WGS 84, degrees, and height over the ellipsoid, m; NaN without a position.
    pub geodetic: [f64; 3],
    /// Row-major 3×3 covariance along east, north and up, m², where known.
    pub covariance: Option<[f64; 9]>,
}

/// Speed of the wheels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WheelReading {
    /// Velocity along the axes of its frame, m/s; of wheels x alone is measured.
    pub velocity: [f64; 3],
    /// Variance of the velocity along x, (m/s)², where known.
    pub variance: Option<f64>,
}

/// Appends a sample of an inertial unit as CDR. It knows no orientation, which a first covariance of −1 says.
pub fn encode_imu(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, reading: &ImuReading) {
    let mut out = CdrWriter::new(buffer);
    let [rate, force] = reading.variance.unwrap_or_default();
    out.header(stamp, frame);
    out.f64s(&[0.0, 0.0, 0.0, 1.0]);
    out.f64s(&[-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    out.f64s(&reading.angular_rate);
    out.f64s(&diagonal([rate; 3]));
    out.f64s(&reading.specific_force);
    out.f64s(&diagonal([force; 3]));
}

/// Reads a sample of an inertial unit. Covariances of zeros are unknown; of others the largest variance counts.
///
/// # Errors
/// Bytes that are no such message.
pub fn decode_imu(payload: &[u8]) -> Result<(Nanos, ImuReading), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let (_orientation, _covariance) = (input.f64s::<4>()?, input.f64s::<9>()?);
    let angular_rate = input.f64s()?;
    let rate = largest(&input.f64s()?);
    let specific_force = input.f64s()?;
    let force = largest(&input.f64s()?);
    let reading = ImuReading {
        angular_rate,
        specific_force,
        variance: rate.zip(force).map(|(rate, force)| [rate, force]),
    };
    Ok((stamp, reading))
}

/// The largest variance of a covariance; `None` where it says nothing.
fn largest(covariance: &[f64; 9]) -> Option<f64> {
    let largest = [0, 4, 8].map(|place| covariance[place]).into_iter().fold(0.0, f64::max);
    (largest > 0.0 && largest.is_finite()).then_some(largest)
}

fn diagonal([x, y, z]: [f64; 3]) -> [f64; 9] {
    [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]
}

/// `status` of `NavSatStatus` without a position.
const NO_FIX: i8 = -1;
/// `service` of `NavSatStatus`: GPS.
const GPS: u16 = 1;
/// `position_covariance_type` of an unknown covariance.
const UNKNOWN: u8 = 0;
/// `position_covariance_type` of a known covariance.
const KNOWN: u8 = 3;

/// Appends what a receiver says as CDR.
pub fn encode_fix(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, reading: &FixReading) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.u8(reading.quality.map_or(NO_FIX as u8, FixQuality::code));
    out.u16(GPS);
    out.f64s(&reading.geodetic);
    out.f64s(&reading.covariance.unwrap_or_default());
    out.u8(if reading.covariance.is_some() { KNOWN } else { UNKNOWN });
}

/// Reads what a receiver says. A covariance of unknown type is unknown.
///
/// # Errors
/// Bytes that are no such message; a position that is no place on the Earth.
pub fn decode_fix(payload: &[u8]) -> Result<(Nanos, FixReading), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let quality = FixQuality::of_code((input.u8()? as i8).into());
    input.u16()?;
    let geodetic = input.f64s()?;
    let covariance = input.f64s()?;
    let is_known = input.u8()? != UNKNOWN;
    if quality.is_some()
        && let Some(fault) = geodetic_fault(geodetic)
    {
        return Err(fault);
    }
    let reading = FixReading {
        quality,
        geodetic,
        covariance: is_known.then_some(covariance),
    };
    Ok((stamp, reading))
}

/// Appends the speed of wheels as CDR.
pub fn encode_wheels(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, reading: &WheelReading) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.f64s(&reading.velocity);
    out.f64s(&[0.0; 3]);
    let mut covariance = [0.0; 36];
    covariance[0] = reading.variance.unwrap_or(0.0);
    out.f64s(&covariance);
}

/// Reads the speed of wheels. A variance of 0 or less is unknown.
///
/// # Errors
/// Bytes that are no such message.
pub fn decode_wheels(payload: &[u8]) -> Result<(Nanos, WheelReading), CdrError> {
    let mut input = CdrReader::new(payload)?;
    let (stamp, _) = input.header()?;
    let velocity = input.f64s()?;
    input.f64s::<3>()?;
    let [variance, ..] = input.f64s::<36>()?;
    let reading = WheelReading {
        velocity,
        variance: (variance > 0.0 && variance.is_finite()).then_some(variance),
    };
    Ok((stamp, reading))
}

/// The same numbers along other axes.
pub(crate) fn turned(numbers: [f64; 3], turn: &nalgebra::UnitQuaternion<f64>) -> [f64; 3] {
    (turn * Vector3::from(numbers)).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_survive_bit_for_bit() {
        let imu = |variance| ImuReading {
            angular_rate: [0.1, -0.2, 1e-9],
            specific_force: [0.3, 0.0, 9.81],
            variance,
        };
        for reading in [imu(None), imu(Some([1e-7, 3e-4]))] {
            let mut payload = Vec::new();
            encode_imu(&mut payload, 42, "cav1/imu", &reading);
            assert_eq!(decode_imu(&payload).unwrap(), (42, reading));
        }
        for (quality, covariance) in [
            (FixQuality::Single, None),
            (FixQuality::Differential, Some(diagonal([0.01, 0.02, 0.03]))),
        ] {
            let reading = FixReading {
                quality: Some(quality),
                geodetic: [48.1, 11.6, 519.0],
                covariance,
            };
            let mut payload = Vec::new();
            encode_fix(&mut payload, 43, "cav1/gnss", &reading);
            assert_eq!(decode_fix(&payload).unwrap(), (43, reading));
        }
        for variance in [None, Some(0.01)] {
            let reading = WheelReading {
                velocity: [-3.5, 0.0, 0.0],
                variance,
            };
            let mut payload = Vec::new();
            encode_wheels(&mut payload, 44, "cav1/axle", &reading);
            assert_eq!(decode_wheels(&payload).unwrap(), (44, reading));
        }
    }

    #[test]
    fn a_receiver_without_a_position_says_so_and_one_off_the_earth_is_refused() {
        let reading = |quality, latitude| FixReading {
            quality,
            geodetic: [latitude, 11.6, 519.0],
            covariance: None,
        };
        let decoded = |reading| {
            let mut payload = Vec::new();
            encode_fix(&mut payload, 1, "a/gnss", &reading);
            decode_fix(&payload)
        };
        let (_, none) = decoded(reading(None, f64::NAN)).unwrap();
        assert_eq!(none.quality, None);
        for wrong in [f64::NAN, 480.0] {
            let error = decoded(reading(Some(FixQuality::Single), wrong)).unwrap_err();
            assert!(error.contains("a latitude within"), "{error}");
        }
    }

    #[test]
    fn short_payloads_are_errors() {
        let mut payload = Vec::new();
        encode_imu(
            &mut payload,
            1,
            "a",
            &ImuReading {
                angular_rate: [0.0; 3],
                specific_force: [0.0; 3],
                variance: None,
            },
        );
        for length in 0..payload.len() {
            assert!(decode_imu(&payload[..length]).is_err(), "{length}");
        }
    }
}
