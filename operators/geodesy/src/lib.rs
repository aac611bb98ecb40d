//! Places on Earth, and local frames at them, on the ellipsoid of WGS-84.
//!
//! [`Geodetic`] is a place by latitude, longitude and height over the ellipsoid. [`LocalFrame`] is the tangent frame of a place,
//! x east, y north and z up, such as `map`; it takes what a receiver reports to metres and back. What comes from outside is
//! checked there: a place that is not on Earth, or too far from the origin, is an error with its numbers.

mod earth;
mod geodetic;
mod local;

pub use earth::{earth_rate, normal_gravity};
pub use geodetic::{Geodetic, NoOrigin};
pub use local::{FAR_M, GeodesyError, LocalFrame};
