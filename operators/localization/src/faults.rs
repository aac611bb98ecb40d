//! What was wrong with the measurements of an agent, as counters of the stage.

use realo_operator::{Counter, Outputs, StageOutputs};
use realo_state_estimation::{Fault, Faults, Stuck};

use crate::motion::{GNSS_FIXES, IMU_SAMPLES, MOTION_BACKWARDS, WHEEL_SPEEDS};

pub(crate) const TRACKING: Counter = Counter::plain(
    "tracking",
    "sweeps of agents that absolute positions correct (`source=gnss|map`)",
);
pub(crate) const DEAD_RECKONING: Counter = Counter::plain(
    "dead_reckoning",
    "sweeps of agents that IMU and wheels alone carry on (`source=gnss|map`)",
);
pub(crate) const INIT: Counter = Counter::loss(
    "init",
    "sweeps of agents that did not know yet where they are: without a pose, so that nothing is sent of them (`source=gnss|map`)",
    "sweeps went on without a pose and are not sent, because the agent did not know yet where it is",
    "a vehicle finds its heading when it drives some metres with GNSS, or by a map; `realo info` says what its sensors measured",
)
.quiet_up_to(20);
pub(crate) const LOST: Counter = Counter::loss(
    "lost",
    "sweeps of agents that did not know any more where they are: without a pose, so that nothing is sent of them (`source=gnss|map`)",
    "sweeps went on without a pose and are not sent, because the agent did not know any more where it is",
    "look at the other notes of {node} for what its sensors or the map lack",
);
pub(crate) const NO_MOTION: Counter = Counter::loss(
    "no_motion",
    "sweeps of agents of whose motion sensors nothing came (`source=gnss|map`)",
    "sweeps have no place, because nothing came of the agent's motion sensors",
    "the log needs `imu`, `fix` and `wheels` of a vehicle and `fix` of a roadside unit (docs/reference/log-format.md), or take \
     `--set {node}.source=recorded`",
);
pub(crate) const SCANS: Counter = Counter::plain("scans", "sweeps whose pose on the map was found (`source=map`)");
pub(crate) const SEARCHES: Counter = Counter::plain(
    "searches",
    "sweeps that were looked for in all directions around a position (`source=map`)",
);
pub(crate) const SCAN_UNFIT: Counter = Counter::loss(
    "scan_unfit",
    "sweeps that do not fit the map where they should be (`source=map`, `min_share`)",
    "sweeps do not fit the map where they should be",
    "is it the map of this place? `realo map info` says where it is; if much has changed there, build it anew or lower `--set {node}.min_share=…`",
)
.quiet_up_to(5);
pub(crate) const SCAN_FEW_POINTS: Counter = Counter::loss(
    "scan_few_points",
    "sweeps with too few points for the map (`source=map`)",
    "sweeps have too few points to be found on the map",
    "look at the sensor, and at a picture of the sweep by `realo render`",
);
pub(crate) const SCAN_OFF_MAP: Counter = Counter::loss(
    "scan_off_map",
    "sweeps of agents that are not on the map (`source=map`)",
    "sweeps were not looked for, because the agent is not on the map",
    "`realo map info` says where the map is: take the one of this place, or one that reaches as far",
);

pub(crate) const CLOCK_SET: Counter = Counter::loss(
    "clock_set",
    "times the clock of a vehicle's motion sensors was set back or ahead by 0.2 s or more (`source=gnss|map`)",
    "times the clock of the motion sensors was set back or ahead, so the estimate was given up and began anew",
    "set the clock before the run, and slowly during it; `--stamps rebase` gives stamps as if it had not been set",
);
pub(crate) const CLOCKS_APART: Counter = Counter::loss(
    "clocks_apart",
    "sweeps of vehicles whose clock is another one than that of their motion sensors: without a pose, as `lost` (`source=gnss|map`)",
    "sweeps have no pose, because their clock and that of the motion sensors are more than 0.3 s apart",
    "have one clock for all sensors of an agent, or correct its stamps when the log is written; `--stamps rebase` takes a step of one back",
);

/// A fault of an estimator, for [`FAULTS`].
const fn fault(name: &'static str, about: &'static str, note: &'static str, remedy: &'static str) -> Counter {
    // One of 1,000 is gated by chance.
    Counter::loss(name, about, note, remedy).quiet_up_to(1)
}

/// A fault that is no chance, however seldom it is counted.
const fn certain(name: &'static str, about: &'static str, note: &'static str, remedy: &'static str) -> Counter {
    Counter::loss(name, about, note, remedy)
}

const SENSORS: &str = "`realo info` says what is wrong with which topic";
const LOG: &str = "look at the log: stamps of motion sensors must rise and be of one clock";

/// By number of [`Fault`].
const FAULTS: [Counter; Fault::ALL.len()] = [
    fault(
        "imu_not_finite",
        "IMU samples with NaN or infinity",
        "samples of the IMU were not used, because they are not finite",
        SENSORS,
    ),
    fault(
        "imu_saturated",
        "IMU samples at the end of the unit's range",
        "samples of the IMU were not used, because they are at the end of its range",
        "`--set {node}.unit=…` names the unit, if it has a larger range",
    ),
    fault(
        "imu_stuck",
        "IMU samples whose angular rates, specific forces, both, or one axis of either do not change at all",
        "samples of the IMU were not used, because they do not change at all",
        SENSORS,
    ),
    fault(
        "imu_gravity",
        "IMU samples whose specific force does not point up with the length of gravity",
        "samples of the IMU were not used, because gravity does not point up in them, 9.8 m/s² long",
        "it is upside down, turned against its mounting, or reports in other units: correct its frame in `/tf_static`, or its units",
    ),
    fault(
        "gyro_at_rest",
        "standstills whose angular rates are beyond any bias of the unit",
        "angular rates at a standstill are larger than any bias of the unit",
        "`--set {node}.unit=consumer` expects more of them; rates are rad/s",
    ),
    fault(
        "imu_gap",
        "gaps between IMU samples that are longer than 50 ms",
        "gaps between samples of the IMU were bridged without it",
        SENSORS,
    ),
    certain(
        "imu_silent",
        "GNSS fixes without a usable IMU sample in the second before",
        "positions of GNSS came without any usable sample of the IMU in the second before",
        SENSORS,
    ),
    certain(
        "imu_track",
        "times in which turns or accelerations of the IMU contradict the track of GNSS or of sweeps on the map, and the wheels",
        "times were found in which turns or accelerations of the IMU contradict the track of GNSS or of sweeps on the map, and the wheels",
        "correct the signs and axes of the IMU's rates and forces, or its frame in `/tf_static`",
    ),
    certain(
        "imu_excluded",
        "IMU samples that were not used, because sweeps on the map contradicted the gyroscopes not long ago",
        "samples of the IMU were not used, because sweeps on the map contradicted the gyroscopes",
        "correct the signs and axes of the IMU's rates, or its frame in `/tf_static`",
    ),
    fault(
        "gnss_not_finite",
        "GNSS fixes with NaN, infinity or a variance of 0",
        "positions of GNSS were not used, because they or their variances are no numbers above 0",
        SENSORS,
    ),
    fault(
        "gnss_elsewhere",
        "GNSS fixes more than 100 km from the map's origin",
        "positions of GNSS were not used, because they are more than 100 km from the map's origin",
        "is `map_origin` in the log's record that of this place, and the receiver in the same zone?",
    ),
    fault(
        "gnss_frozen",
        "GNSS fixes that do not change at all",
        "positions of GNSS were not used, because they do not change at all",
        SENSORS,
    ),
    fault(
        "gnss_height_zero",
        "GNSS fixes with a height of exactly 0, which is not used",
        "heights of GNSS were not used, because they are exactly 0",
        "have the receiver report heights over the ellipsoid",
    ),
    fault(
        "gnss_gate",
        "GNSS fixes farther from the estimate than chance allows",
        "positions of GNSS were not used, because they are farther off than chance allows, as after a jump",
        "if it happens in the open too, its covariances are too small, or `map_origin` is off",
    ),
    fault(
        "gnss_height_gate",
        "GNSS heights farther from the estimate than chance allows",
        "heights of GNSS were not used, because they are farther off than chance allows",
        "are they over the ellipsoid, as `map_origin` is?",
    ),
    certain(
        "gnss_conflict",
        "estimates that were given up, because GNSS contradicted them for long, or for as long as it had supported them",
        "estimates were given up, because GNSS contradicted them for long, or for as long as it had supported them",
        "{node} began anew, or went to the new place; is it the map of this place? Was the receiver between buildings at the start?",
    ),
    certain(
        "gnss_track",
        "estimates that were given up at once, because GNSS fixes that agree with each other left them behind",
        "estimates were given up, because positions of GNSS agreed with each other and left them behind",
        "IMU or wheels are wrong: the other notes of {node} and `realo info` say which",
    ),
    fault(
        "gnss_offset",
        "GNSS fixes that are off by metres for seconds, by sweeps on the map, which are believed (`source=map`)",
        "positions of GNSS contradict the map, which was believed, because sweeps on it agree with wheels and IMU",
        "a receiver without corrections is off by metres for minutes; if it has corrections, is the map in the frame of `map_origin`?",
    ),
    fault(
        "wheel_not_finite",
        "wheel speeds that are NaN, infinite or beyond any vehicle's",
        "speeds of the wheels were not used, because no vehicle has them",
        SENSORS,
    ),
    fault(
        "wheel_gate",
        "wheel speeds farther from the estimate than chance allows",
        "speeds of the wheels were not used, because they are farther off than chance allows: slip, or a stuck sensor",
        SENSORS,
    ),
    fault(
        "wheel_skid",
        "motion across the wheels that chance does not explain",
        "times were found in which the vehicle moved across its wheels",
        "after a skid all is well again; otherwise correct the frame of the wheels in `/tf_static`",
    ),
    certain(
        "wheel_track",
        "times in which the wheels contradict the track of GNSS or of sweeps on the map, turn against the IMU's accelerations, or report more than 6 m/s backwards",
        "times were found in which the wheels contradict the track of GNSS or of sweeps on the map, turn against the IMU's accelerations, or report more than 6 m/s backwards",
        "speeds are m/s, and positive forwards",
    ),
    certain(
        "wheel_excluded",
        "speeds of the wheels that were not used, because the wheels were found wrong not long ago",
        "speeds of the wheels were not used, because the wheels were found wrong not long ago",
        "speeds are m/s, and positive forwards",
    ),
    fault(
        "scan_not_finite",
        "poses of scans with NaN or infinity",
        "poses of scans were not used, because they are not finite",
        "this is a mistake of the program: please report it",
    ),
    fault(
        "scan_information",
        "poses of scans whose information is none",
        "poses of scans were not used, because their information is none",
        "this is a mistake of the program: please report it",
    ),
    fault(
        "scan_gate",
        "poses of scans farther from the estimate or GNSS than chance allows",
        "poses of scans were not used, because they are farther from the estimate or GNSS than chance allows",
        "is it the map of this place, in the frame of this log's map?",
    ),
    fault(
        "scan_conflict",
        "estimates that were given up, because scans contradicted them for long",
        "estimates were given up, because scans contradicted them for long",
        "{node} began anew",
    ),
    fault(
        "too_late",
        "measurements older than what is kept",
        "measurements of motion sensors were not used, because they came more than a second late",
        LOG,
    ),
    fault(
        "repeated",
        "second measurements of a sensor with the same stamp",
        "measurements of motion sensors were not used, because they have the stamp of another one",
        LOG,
    ),
    fault(
        "stamp_ahead",
        "measurements whose stamp is far ahead of all others",
        "measurements of motion sensors were not used, because their stamps are more than a second ahead",
        LOG,
    ),
    fault(
        "stamp_gap",
        "gaps of more than 10 s, after which the estimate began anew",
        "estimates began anew, because nothing came of any sensor for more than 10 s",
        LOG,
    ),
    fault(
        "numerical",
        "estimates that began anew, because their covariance was none any more",
        "estimates began anew, because their covariance was none any more",
        "this is a mistake of the program: please report it",
    ),
];

/// All that the stage counts.
pub(crate) const COUNTERS: &[Counter] = &{
    const OWN: &[Counter] = &[
        IMU_SAMPLES,
        GNSS_FIXES,
        WHEEL_SPEEDS,
        MOTION_BACKWARDS,
        TRACKING,
        DEAD_RECKONING,
        INIT,
        LOST,
        NO_MOTION,
        SCANS,
        SEARCHES,
        SCAN_UNFIT,
        SCAN_FEW_POINTS,
        SCAN_OFF_MAP,
        CLOCK_SET,
        CLOCKS_APART,
    ];
    let mut all = [IMU_SAMPLES; OWN.len() + FAULTS.len()];
    let mut at = 0;
    while at < all.len() {
        all[at] = if at < OWN.len() {
            OWN[at]
        } else {
            FAULTS[at - OWN.len()]
        };
        at += 1;
    }
    all
};

/// The counter of a fault.
fn counter(fault: Fault) -> &'static Counter {
    &COUNTERS[COUNTERS.len() - FAULTS.len() + fault as usize]
}

/// Measurements of an agent so far: of IMU, receiver, wheels and scans.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Taken {
    pub imu: u64,
    pub fixes: u64,
    pub wheels: u64,
    pub scans: u64,
}

impl Taken {
    /// Of which there are so many that may have a fault.
    fn of(&self, fault: Fault) -> u64 {
        if fault == Fault::ImuSilent {
            return self.fixes;
        }
        match fault.name().split('_').next() {
            Some("imu" | "gyro") => self.imu,
            Some("gnss") => self.fixes,
            Some("wheel") => self.wheels,
            Some("scan") => self.scans,
            _ => self.imu + self.fixes + self.wheels + self.scans,
        }
    }
}

/// What was said of an agent's faults so far.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    counts: [u64; Fault::ALL.len()],
    of: [u64; Fault::ALL.len()],
}

impl Default for Reported {
    fn default() -> Self {
        let none = [0; Fault::ALL.len()];
        Reported { counts: none, of: none }
    }
}

impl Reported {
    /// Counts what is new; faults that never happened are not mentioned.
    ///
    /// `gnss_offset`: by how much GNSS and map disagree, m. `stuck`: what of the IMU is.
    pub fn count<O: StageOutputs>(
        &mut self,
        agent: &str,
        faults: &Faults,
        taken: &Taken,
        (gnss_offset, stuck): (Option<f64>, Option<Stuck>),
        out: &mut Outputs<O>,
    ) {
        for fault in Fault::ALL {
            let (known, of) = (&mut self.counts[fault as usize], &mut self.of[fault as usize]);
            // Samples that come late change what was wrong with later ones.
            let new = faults.count(fault).saturating_sub(*known);
            *known += new;
            if *known > 0 {
                let all = taken.of(fault).max(*known);
                out.count_of(counter(fault), agent, new, all.saturating_sub(*of));
                *of = all;
            }
        }
        if let Some(off) = gnss_offset {
            let words = || format!("GNSS and map disagree by {off:.1} m");
            out.found(counter(Fault::GnssOffset), agent, words);
        }
        let part = match stuck {
            Some(Stuck::Gyroscopes) => "the angular rates of its gyroscopes, all or one axis",
            Some(Stuck::Accelerometers) => "the forces of its accelerometers, all or one axis",
            Some(Stuck::Whole) | None => return,
        };
        out.found(counter(Fault::ImuStuck), agent, || part.into());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_fault_has_the_counter_of_its_name() {
        for fault in Fault::ALL {
            assert_eq!(counter(fault).name, fault.name());
        }
        let mut names: Vec<&str> = COUNTERS.iter().map(|counter| counter.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), COUNTERS.len());
    }
}
