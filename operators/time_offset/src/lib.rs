//! How the clock of a sensor differs from the one by which its messages arrive, with a bound on the error.
//!
//! - [`StampWatch`]: looks at stamps one by one. It names those that repeat, run backwards, stand still or jump, and clocks that
//!   count from boot, by TAI or GPS instead of UTC, or some 1,024 weeks off; [`Handling`] says what becomes of them.
//! - [`ArrivalOffset`]: offset and drift from arrivals. No message comes before it is measured, so the quickest ones show the clock:
//!   the lower envelope of arrival minus stamp (Moon, Skelly and Towsley 1999).
//! - [`motion_offset`]: offset of an IMU against a scanner. Both see the same turning; the shift at which the integrated yaw rate
//!   fits the headings of registration is the offset.
//! - [`SensorClock`]: the first two of one sensor, with the third where it is known.
//!
//! An *offset* is what is to be added to a sensor's stamp to have the time by the reference clock.

mod arrival;
mod clock;
mod epoch;
mod line;
mod middles;
mod motion;
mod turning;
mod watch;

pub use arrival::ArrivalOffset;
pub use clock::{Judged, Sensor, SensorClock};
pub use epoch::{Epoch, epoch_of};
pub use middles::Middles;
pub use motion::{MotionLimits, NoMotionOffset, motion_offset};
pub use turning::{Heading, YawRate};
pub use watch::{Handling, StampFault, StampFaults, StampRule, StampWatch, Watched};

use realo_schemas::Nanos;

/// An estimated offset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Offset {
    /// What is to be added to stamps, ns.
    pub offset: Nanos,
    /// The truth is within so much of it in at least 95 % of cases, ns.
    pub bound: Nanos,
    /// How fast the offset changes, ns a second; 0 where that is not estimated.
    pub drift: f64,
    /// The stamp for which it holds.
    pub at: Nanos,
}

impl Offset {
    /// The offset for another stamp, by the drift.
    pub fn at(&self, stamp: Nanos) -> Nanos {
        let seconds = realo_schemas::to_seconds(stamp.saturating_sub(self.at));
        self.offset.saturating_add((self.drift * seconds).round() as Nanos)
    }

    /// Whether two estimates can both be right.
    pub fn agrees(&self, other: &Offset) -> bool {
        let apart = self.at(other.at).abs_diff(other.offset);
        apart <= self.bound.saturating_add(other.bound).unsigned_abs()
    }
}
