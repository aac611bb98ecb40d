//! What can be wrong with the inputs of an estimator, by name and number.

use realo_schemas::Nanos;

macro_rules! faults {
    ($($(#[$doc:meta])* $name:ident $text:literal,)*) => {
        /// Something that is wrong with what an estimator is fed, or with the estimator.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Fault {
            $($(#[$doc])* $name,)*
        }

        impl Fault {
            /// All of them, in the order of their numbers.
            pub const ALL: [Fault; [$($text),*].len()] = [$(Fault::$name),*];

            /// Its name in tables and messages.
            pub fn name(self) -> &'static str {
                match self {
                    $(Fault::$name => $text,)*
                }
            }
        }
    };
}

faults! {
    /// An IMU sample with NaN or infinity.
    ImuNotFinite "imu_not_finite",
    /// An IMU sample at the end of the unit's range.
    ImuSaturated "imu_saturated",
    /// IMU samples whose rates, forces, both, or one axis of either do not change at all.
    ImuStuck "imu_stuck",
    /// The mean specific force does not point up with the length of gravity: the IMU is upside down, turned against its
    /// mounting, or reports in other units.
    ImuGravity "imu_gravity",
    /// Rates at a standstill that are beyond any bias of the unit.
    GyroAtRest "gyro_at_rest",
    /// No usable IMU sample for longer than is bridged: the motion is not known there.
    ImuGap "imu_gap",
    /// A fix with no usable IMU sample in the second before it.
    ImuSilent "imu_silent",
    /// The turns or accelerations of the IMU contradict the track of GNSS or scans, and the wheels.
    ImuTrack "imu_track",
    /// An IMU sample that is not used, because scans contradicted the gyro not long ago.
    ImuExcluded "imu_excluded",
    /// A GNSS fix with NaN or infinity, or a variance that is not above 0.
    GnssNotFinite "gnss_not_finite",
    /// A GNSS fix that is not on Earth, or farther from the map's origin than a map reaches.
    GnssElsewhere "gnss_elsewhere",
    /// GNSS fixes that do not change at all.
    GnssFrozen "gnss_frozen",
    /// A GNSS fix with a height of exactly 0; its height is not used.
    GnssHeightZero "gnss_height_zero",
    /// A GNSS fix farther from the estimate than chance allows, such as after a jump.
    GnssGate "gnss_gate",
    /// A GNSS height farther from the estimate than chance allows.
    GnssHeightGate "gnss_height_gate",
    /// GNSS contradicted the estimate for so long that the estimate was given up, or its place, if it rested on few fixes.
    GnssConflict "gnss_conflict",
    /// GNSS fixes that agree with each other left the estimate behind, which was given up at once.
    GnssTrack "gnss_track",
    /// A GNSS fix that scans contradict for some time by as much as a receiver without corrections may be off; they are believed.
    GnssOffset "gnss_offset",
    /// A wheel speed that is NaN, infinite or beyond any vehicle's.
    WheelNotFinite "wheel_not_finite",
    /// A wheel speed farther from the estimate than chance allows: slip, or a stuck sensor.
    WheelGate "wheel_gate",
    /// Motion across the wheels that chance does not explain, such as a skid.
    WheelSkid "wheel_skid",
    /// The wheels contradict the track of GNSS or scans, turn against the IMU's accelerations, or report a speed backwards that no vehicle
    /// keeps up.
    WheelTrack "wheel_track",
    /// A wheel speed that is not used, because the wheels were found wrong not long ago.
    WheelExcluded "wheel_excluded",
    /// A scan's pose with NaN or infinity.
    ScanNotFinite "scan_not_finite",
    /// A scan's information that is not symmetric, or has negative eigenvalues.
    ScanInformation "scan_information",
    /// A scan's pose farther from the estimate than chance allows.
    ScanGate "scan_gate",
    /// Scans contradicted the estimate for so long that the estimate was given up.
    ScanConflict "scan_conflict",
    /// A sample older than what is kept.
    TooLate "too_late",
    /// A second sample of a sensor with the same stamp.
    Repeated "repeated",
    /// A stamp far ahead of all others.
    StampAhead "stamp_ahead",
    /// A gap in time, after which the estimator starts anew.
    StampGap "stamp_gap",
    /// A covariance that is none any more; the estimator starts anew.
    Numerical "numerical",
}

const COUNT: usize = Fault::ALL.len();

/// How often each fault was seen, and when last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Faults {
    seen: [(u64, Nanos); COUNT],
}

impl Default for Faults {
    fn default() -> Self {
        Faults {
            seen: [(0, Nanos::MIN); COUNT],
        }
    }
}

impl Faults {
    /// Notes a fault at a stamp.
    pub(crate) fn note(&mut self, fault: Fault, stamp: Nanos) {
        let (count, last) = &mut self.seen[fault as usize];
        *count = count.saturating_add(1);
        *last = stamp.max(*last);
    }

    /// How often a fault was seen.
    pub fn count(&self, fault: Fault) -> u64 {
        self.seen[fault as usize].0
    }

    /// The faults that were seen, how often, and the stamp of the last time.
    pub fn seen(&self) -> impl Iterator<Item = (Fault, u64, Nanos)> {
        let all = Fault::ALL.into_iter().zip(self.seen);
        all.filter(|(_, (count, _))| *count > 0)
            .map(|(fault, (count, last))| (fault, count, last))
    }

    /// The faults that were seen at or after a stamp.
    pub fn since(&self, stamp: Nanos) -> impl Iterator<Item = Fault> {
        self.seen().filter(move |seen| seen.2 >= stamp).map(|seen| seen.0)
    }

    /// These and others together.
    pub(crate) fn with(mut self, others: &Faults) -> Self {
        for (mine, other) in self.seen.iter_mut().zip(others.seen) {
            *mine = (mine.0.saturating_add(other.0), mine.1.max(other.1));
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_counted_under_their_names() {
        let mut faults = Faults::default();
        faults.note(Fault::GnssGate, 5);
        faults.note(Fault::GnssGate, 3);
        faults.note(Fault::Numerical, 9);
        let seen: Vec<_> = faults
            .seen()
            .map(|(fault, count, last)| (fault.name(), count, last))
            .collect();
        assert_eq!(seen, [("gnss_gate", 2, 5), ("numerical", 1, 9)]);
        assert_eq!(faults.since(6).collect::<Vec<_>>(), [Fault::Numerical]);
        assert_eq!(faults.with(&faults).count(Fault::GnssGate), 4);
        for (number, fault) in Fault::ALL.into_iter().enumerate() {
            assert_eq!(fault as usize, number);
        }
    }
}
