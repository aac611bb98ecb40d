//! The filter: what it believes after samples in the order of their stamps. Its state is a function of that order alone.

use nalgebra::{Matrix2, Vector3};
use realo_schemas::Nanos;

use crate::agreement::Agreement;
use crate::belief::Belief;
use crate::correct::Outcome;
use crate::fault::{Fault, Faults};
use crate::imu::{ImuMonitor, Stuck, between, held};
use crate::models::{self, LocalFix, LocalScan};
use crate::rolling::{Rolling, in_a_row};
use crate::rules::{Checked, Rules};
use crate::source::{Source, conflict};
use crate::start::Start;
use crate::track::{Leaving, Track};
use crate::witness::Witness;
use crate::{ImuSample, Verdict};

/// An IMU sample holds so long, ns; after that the motion is not known.
const HOLD: Nanos = 50_000_000;
/// Longest step without an IMU, ns.
const COAST_STEP: Nanos = 50_000_000;
/// A longer time without any sample ends an estimate, ns.
const GAP: Nanos = 10_000_000_000;
/// Wheels that stand for so long stand, ns.
const REST: Nanos = 300_000_000;

/// Fixes that scans contradict for so long are off, ns.
const OFFSET: Nanos = 2_000_000_000;
/// Scans that were used so recently are believed, ns.
const RECENT: Nanos = 1_000_000_000;

/// An IMU without a usable sample for so long is silent, ns.
const SILENT: Nanos = 1_000_000_000;
/// A gyro, or wheels, that scans contradict are not used for so long, ns.
const MISLED: Nanos = 20_000_000_000;
/// Where the gyro was wrong, the estimate is taken for so much more than the scan's distance from it: m, and rad of tilt and heading.
const LED: [f64; 3] = [0.5, 0.03, 0.1];
/// Wheels that report so much backwards, m/s, for so long, ns, count backwards.
const BACKWARDS: (f64, Nanos) = (6.0, 300_000_000);
/// Scans that are turned against the estimate, rad, so many in a row.
const TURNED: (f64, u32) = (0.05, 3);
/// Scans that are so far from the estimate, m, that many in a row; so many before follow each other.
const AWAY: f64 = 1.0;
const FOLLOWING: u32 = 5;
/// The last of them no longer ago, ns.
const TURNED_SINCE: Nanos = 500_000_000;

/// An estimate that fixes left is not believed again for so long while a sensor contradicts them, ns.
const DISTRUST: Nanos = 20_000_000_000;

/// The filter after some samples.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Filter {
    pub time: Option<Nanos>,
    pub belief: Option<Belief>,
    pub start: Start,
    pub faults: Faults,
    pub scans: Source,
    pub fixes: Source,
    /// How far GNSS is off, by the map, m.
    pub gnss_offset: Option<f64>,
    agreement: Agreement,
    track: Track,
    leaving: Option<Leaving>,
    witness: Witness,
    /// When fixes left the estimate.
    left: Option<Nanos>,
    /// The stamp of the first sample.
    first: Option<Nanos>,
    monitor: ImuMonitor,
    /// The last sample that was used, and its time since the one before, s.
    imu: Option<(ImuSample, f64)>,
    /// The stamp of the last usable one.
    heard: Option<Nanos>,
    /// When scans last contradicted the gyro.
    misled: Option<Nanos>,
    rolling: Rolling,
    /// Since when wheels report more than [`BACKWARDS`].
    backwards: Option<Nanos>,
    /// When scans last contradicted the wheels.
    slipped: Option<Nanos>,
    /// Scans in a row that were refused for their heading, and the last of them.
    turned: (u32, Nanos),
    /// The same for their place.
    away: (u32, Nanos),
    last_fix: Option<(Nanos, Vector3<f64>)>,
    /// Since when the wheels stand.
    resting: Option<Nanos>,
    /// The IMU sample whose rest was used last.
    rested: Option<Nanos>,
}

impl Filter {
    /// The filter before any sample, after another one that had an estimate or not.
    pub fn after(after_loss: bool) -> Self {
        Filter {
            start: Start::after(after_loss),
            ..Filter::new()
        }
    }

    /// The filter before any sample.
    pub fn new() -> Self {
        Filter {
            time: None,
            belief: None,
            start: Start::default(),
            faults: Faults::default(),
            scans: Source::default(),
            fixes: Source::default(),
            gnss_offset: None,
            agreement: Agreement::default(),
            track: Track::default(),
            leaving: None,
            witness: Witness::default(),
            left: None,
            first: None,
            monitor: ImuMonitor::default(),
            imu: None,
            heard: None,
            misled: None,
            rolling: Rolling::default(),
            backwards: None,
            slipped: None,
            turned: (0, 0),
            away: (0, 0),
            last_fix: None,
            resting: None,
            rested: None,
        }
    }

    /// Takes the next sample.
    pub fn take(&mut self, stamp: Nanos, sample: &Checked, rules: &Rules) -> Verdict {
        if self.time.is_some_and(|time| stamp - time > GAP) {
            self.restart(Fault::StampGap, stamp);
        }
        self.first.get_or_insert(stamp);
        let taken = match sample {
            Checked::Imu(imu) => self.take_imu(imu, rules),
            Checked::Wheel(speed) => self.take_wheel(stamp, *speed, rules),
            Checked::Gnss(fix) => self.take_fix(stamp, fix, rules),
            Checked::Scan(scan) => self.take_scan(stamp, scan, rules),
        };
        if let Err(fault) = taken {
            self.faults.note(fault, stamp);
        }
        if self.belief.as_ref().is_some_and(|belief| !belief.is_sound()) {
            self.restart(Fault::Numerical, stamp);
        } else if let Some(fault) = conflict(&self.fixes, &self.scans, stamp, rules) {
            self.restart(fault, stamp);
        }
        match taken {
            Err(fault) => Verdict::Refused(fault),
            Ok(()) if self.belief.is_some() => Verdict::Used,
            Ok(()) => Verdict::Waiting,
        }
    }

    /// Moves on to a stamp; `next`: the IMU sample of that stamp, where there is one.
    pub fn advance(&mut self, to: Nanos, next: Option<&ImuSample>, rules: &Rules) {
        let Some(mut time) = self.time.replace(to) else {
            return;
        };
        let is_misled = self.is_misled(to);
        let Some(belief) = &mut self.belief else {
            return;
        };
        if let Some((last, _)) = &self.imu {
            let edge = last.stamp.saturating_add(HOLD);
            let until = to.min(edge);
            if until > time {
                let increment = match next.filter(|next| next.stamp <= edge) {
                    Some(next) => between(last, next, seconds(next.stamp - last.stamp), seconds(time - last.stamp)),
                    None => held(last, seconds(until - time)),
                };
                belief.strapdown(&increment, seconds(until - time), &rules.noise, &rules.earth);
                time = until;
            }
        }
        let known = self.imu.as_ref().filter(|_| !is_misled);
        let rate = known.map(|(sample, _)| sample.angular_rate);
        while time < to {
            let step = (to - time).min(COAST_STEP);
            belief.coast(seconds(step), rate, &rules.imu_from_body.rotation, &rules.noise);
            time += step;
        }
    }

    /// The rate of the gyro, while its last sample holds, rad/s.
    pub fn rate(&self, stamp: Nanos) -> Option<Vector3<f64>> {
        let (sample, _) = self.imu.as_ref()?;
        (stamp - sample.stamp <= HOLD).then_some(sample.angular_rate)
    }

    fn take_imu(&mut self, sample: &ImuSample, rules: &Rules) -> Result<(), Fault> {
        let rolling = self.rolling.speed(sample.stamp);
        let rolls = rolling.is_some_and(|speed| speed != 0.0);
        let believed = self.agreement.odometer.speed.and(rolling);
        self.monitor.look(sample, believed, rolls, rules)?;
        let is_misled = self.is_misled(sample.stamp);
        self.advance(sample.stamp, Some(sample).filter(|_| !is_misled), rules);
        let period = self.heard.replace(sample.stamp).map(|last| sample.stamp - last);
        let gap = period.is_some_and(|period| period > HOLD);
        let period = period.map_or(0.01, |period| seconds(period.min(HOLD)));
        self.agreement.imu(sample, period, rules);
        self.track.imu(sample, period, rules);
        if self.belief.is_none() {
            self.start.imu(sample, period, rules);
        }
        if is_misled {
            return Err(Fault::ImuExcluded);
        }
        if let Some(belief) = &mut self.belief {
            belief.hear();
        }
        self.imu = Some((*sample, period));
        if gap {
            self.faults.note(Fault::ImuGap, sample.stamp);
        }
        Ok(())
    }

    fn take_wheel(&mut self, stamp: Nanos, speed: f64, rules: &Rules) -> Result<(), Fault> {
        self.advance(stamp, None, rules);
        self.track.wheel(stamp, speed);
        self.rolling.wheel(stamp, speed);
        if self.note_backwards(stamp, speed) && !self.track.agrees_with_wheels() {
            if !self.is_without_wheels(stamp) {
                self.faults.note(Fault::WheelTrack, stamp);
            }
            // An estimate that goes backwards as well was begun by these wheels: it is turned by 180°, which fixes support.
            let rate = self.rate(stamp);
            let follows = |belief: &Belief| models::forward_speed(belief, rules, rate.as_ref()) < 0.5 * speed;
            let is_supported = self.scans.is_used(stamp, RECENT) || !self.belief.as_ref().is_some_and(follows);
            self.give_wheels_up(stamp, is_supported, None);
        }
        if self.is_without_wheels(stamp) {
            return Err(Fault::WheelExcluded);
        }
        self.agreement.wheel(stamp, speed);
        let rate = self.rate(stamp);
        let Some(belief) = &mut self.belief else {
            self.start.wheel(stamp, speed);
            return Ok(());
        };
        if speed == 0.0 {
            let since = *self.resting.get_or_insert(stamp);
            used(belief.correct(&models::standstill(belief)), Fault::WheelGate)?;
            return if stamp - since >= REST {
                self.rest(stamp, rules)
            } else {
                Ok(())
            };
        }
        self.resting = None;
        let innovation = models::wheel_speed(belief, rules, speed, rate.as_ref());
        used(belief.correct(&innovation), Fault::WheelGate)?;
        let innovation = models::no_skid(belief, rules, rate.as_ref());
        used(belief.correct(&innovation), Fault::WheelSkid)
    }

    /// Takes a speed; whether wheels have reported more than [`BACKWARDS`] for its whole time.
    fn note_backwards(&mut self, stamp: Nanos, speed: f64) -> bool {
        let (fastest, long) = BACKWARDS;
        self.backwards = (speed < -fastest).then(|| self.backwards.unwrap_or(stamp));
        self.backwards.is_some_and(|since| stamp - since >= long)
    }

    /// Takes the last IMU sample as the gyro's bias, once.
    fn rest(&mut self, stamp: Nanos, rules: &Rules) -> Result<(), Fault> {
        let rate = self.rate(stamp);
        if let Some(belief) = self.belief.as_mut().filter(|belief| belief.coasting.is_some()) {
            return used(belief.correct(&models::standing_turn(belief)), Fault::GyroAtRest);
        }
        let (Some(belief), Some(rate), Some((sample, period))) = (&mut self.belief, rate, &self.imu) else {
            return Ok(());
        };
        if self.rested.replace(sample.stamp) == Some(sample.stamp) {
            return Ok(());
        }
        let innovation = models::resting_gyro(belief, rules, &rate, period.max(1e-3));
        used(belief.correct(&innovation), Fault::GyroAtRest)
    }

    fn take_fix(&mut self, stamp: Nanos, fix: &LocalFix, rules: &Rules) -> Result<(), Fault> {
        self.advance(stamp, None, rules);
        let before = self.last_fix.replace((stamp, fix.position));
        if before.is_some_and(|(_, position)| position == fix.position) {
            return Err(Fault::GnssFrozen);
        }
        let fix = &fix.after(before.map(|(before, _)| before), stamp);
        if !fix.has_height {
            self.faults.note(Fault::GnssHeightZero, stamp);
        }
        self.watch(stamp, fix, rules);
        let Some(belief) = &mut self.belief else {
            let begun = self.start.take_fix(stamp, fix, rules)?;
            self.begin(begun, stamp, |filter| &mut filter.fixes);
            return Ok(());
        };
        let innovation = fix.horizontal(belief, rules);
        let residual = Vector3::new(innovation.residual.x, innovation.residual.y, 0.0);
        let mut outcome = belief.correct(&innovation);
        let unit = libm::hypot(rules.noise.gnss[0], rules.noise.gnss[1]);
        match outcome {
            Outcome::Gated => self.witness.contradict(stamp, residual.xy(), unit),
            Outcome::Used => self.witness.support(stamp),
            Outcome::Numerical => {}
        }
        let is_alone = !self.scans.is_used(stamp, rules.limits.gnss_conflict);
        if is_alone && self.witness.is_outvoted() {
            // The place alone is given up: fixes that are all off by the same vector say nothing against the heading.
            self.faults.note(Fault::GnssConflict, stamp);
            belief.doubt(&Vector3::repeat(residual.norm()), &Vector3::zeros());
            outcome = belief.correct(&fix.horizontal(belief, rules));
            self.witness = Witness::default();
        }
        self.fixes.note(outcome, stamp, residual);
        let spread = belief.covariance[(0, 0)] + belief.covariance[(1, 1)] + fix.variance.x + fix.variance.y;
        if outcome == Outcome::Gated {
            self.refused(stamp, fix, residual.xy(), (0.5 * spread).sqrt(), rules);
            return Err(Fault::GnssGate);
        }
        self.leaving = None;
        used(outcome, Fault::GnssGate)?;
        if fix.has_height {
            used(belief.correct(&fix.vertical(belief, rules)), Fault::GnssHeightGate)?;
        }
        Ok(())
    }

    /// Looks what a fix says of the other sensors.
    fn watch(&mut self, stamp: Nanos, fix: &LocalFix, rules: &Rules) {
        let last = self.imu.as_ref().map(|(last, _)| last.stamp).or(self.first);
        if last.is_some_and(|last| stamp - last > SILENT) {
            self.faults.note(Fault::ImuSilent, stamp);
        }
        self.agreement.odometer.advance(stamp);
        if let Some(fault) = self.track.fix(stamp, fix, &self.agreement.odometer, rules) {
            self.faults.note(fault, stamp);
            if fault == Fault::WheelTrack {
                let is_supported = self.fixes.supports(stamp, RECENT);
                self.give_wheels_up(stamp, is_supported, Some(Fault::GnssConflict));
            }
        }
    }

    /// What follows from a fix that was refused: GNSS is off by the map, or the estimate is wrong.
    fn refused(&mut self, stamp: Nanos, fix: &LocalFix, residual: nalgebra::Vector2<f64>, sigma: f64, rules: &Rules) {
        if self.scans.is_used(stamp, RECENT) {
            self.leaving = None;
            let off = self.fixes.off(stamp, OFFSET).filter(|off| *off <= rules.gnss_bias());
            if off.is_some() {
                self.gnss_offset = off;
                self.faults.note(Fault::GnssOffset, stamp);
            }
            return;
        }
        let leaving = Leaving::with(self.leaving.take(), stamp, fix, residual);
        let is_gone = leaving.is_gone(stamp, residual, sigma);
        self.leaving = Some(leaving);
        if is_gone {
            self.restart(Fault::GnssTrack, stamp);
            self.left = Some(stamp);
        }
    }

    /// Whether an estimate is wrong, or is again soon: a sensor that led one astray still contradicts GNSS and no scans are there, or scans
    /// contradict the heading.
    pub fn is_astray(&self, stamp: Nanos) -> bool {
        let left = self.left.is_some_and(|left| stamp - left <= DISTRUST);
        let is_left = left && self.track.is_contradicted(stamp) && !self.scans.is_used(stamp, RECENT);
        is_left || self.is_turned(stamp) || self.is_away(stamp)
    }

    /// Whether scans that follow each other as the gyro turns contradict the place, and no fix supports it.
    fn is_away(&self, stamp: Nanos) -> bool {
        let (count, last) = self.away;
        !self.fixes.supports(stamp, RECENT)
            && count >= TURNED.1
            && stamp - last <= TURNED_SINCE
            && self.rolling.scans() >= FOLLOWING
    }

    /// Whether scans that follow each other as the wheels roll contradict the heading.
    fn is_turned(&self, stamp: Nanos) -> bool {
        let (count, last) = self.turned;
        count >= TURNED.1 && stamp - last <= TURNED_SINCE && self.agreement.course.is_proven()
    }

    /// What fixes that contradict an estimate of few others add to the covariance of its place, m².
    pub fn doubt(&self, stamp: Nanos, rules: &Rules) -> Matrix2<f64> {
        match self.scans.is_used(stamp, rules.limits.gnss_conflict) {
            true => Matrix2::zeros(),
            false => self.witness.doubt(),
        }
    }

    /// What of the IMU was stuck last.
    pub fn stuck(&self) -> Option<Stuck> {
        self.monitor.stuck
    }

    fn take_scan(&mut self, stamp: Nanos, scan: &LocalScan, rules: &Rules) -> Result<(), Fault> {
        self.advance(stamp, None, rules);
        self.agreement.odometer.advance(stamp);
        if self.rolling.scan(stamp, scan, self.agreement.odometer.heading, rules) {
            self.faults.note(Fault::WheelTrack, stamp);
            let is_supported = self.scans.is_used(stamp, RECENT);
            self.give_wheels_up(stamp, is_supported, Some(Fault::ScanConflict));
        } else if self.rolling.is_right() {
            self.slipped = None;
        }
        self.agreement.scan(stamp, scan, rules);
        if self.agreement.course.is_gyro_wrong() {
            self.faults.note(Fault::ImuTrack, stamp);
            self.misled = Some(stamp);
            self.doubt_misled(scan, rules);
        }
        match self.correct_by_scan(stamp, scan, rules) {
            Err(Fault::ScanGate) if self.is_overruled(stamp, scan, rules) => {
                let begun = Start::at_scan(&self.agreement.odometer, scan, rules);
                self.fixes = Source::default();
                self.begin(Some(begun), stamp, |filter| &mut filter.scans);
                Ok(())
            }
            taken => taken,
        }
    }

    /// Goes on without wheels. An estimate that what contradicts them does not support begins anew, by this fault where it is one of others.
    fn give_wheels_up(&mut self, stamp: Nanos, is_supported: bool, fault: Option<Fault>) {
        let was_without = self.is_without_wheels(stamp);
        self.slipped = Some(stamp);
        if was_without {
            return;
        }
        self.agreement.odometer.speed = None;
        self.resting = None;
        match (&self.belief, is_supported) {
            (None, _) => self.start = Start::after(self.start.after_loss),
            (Some(_), false) => match fault {
                Some(fault) => self.restart(fault, stamp),
                None => self.begin_anew(stamp),
            },
            (Some(_), true) => {}
        }
    }

    /// Whether wheels were found wrong not long ago.
    fn is_without_wheels(&self, stamp: Nanos) -> bool {
        self.slipped.is_some_and(|at| stamp - at <= MISLED)
    }

    /// Whether scans contradicted the gyro not long ago.
    fn is_misled(&self, stamp: Nanos) -> bool {
        self.misled.is_some_and(|at| stamp - at <= MISLED)
    }

    fn correct_by_scan(&mut self, stamp: Nanos, scan: &LocalScan, rules: &Rules) -> Result<(), Fault> {
        let Some(belief) = &mut self.belief else {
            let begun = self.start.take_scan(stamp, scan, rules)?;
            self.begin(begun, stamp, |filter| &mut filter.scans);
            return Ok(());
        };
        let innovation = models::scan_pose(belief, rules, scan);
        let residual = innovation.residual.fixed_rows::<3>(0).into_owned();
        let turned = innovation.residual[5].abs();
        let outcome = belief.correct(&innovation);
        self.scans.note(outcome, stamp, residual);
        let is_gated = outcome == Outcome::Gated;
        self.turned = (in_a_row(self.turned.0, is_gated && turned > TURNED.0), stamp);
        self.away = (in_a_row(self.away.0, is_gated && residual.xy().norm() > AWAY), stamp);
        used(outcome, Fault::ScanGate)
    }

    /// Widens an estimate that a wrong gyro led astray so far that a scan would be refused, unless it is farther off than GNSS may be.
    fn doubt_misled(&mut self, scan: &LocalScan, rules: &Rules) {
        let Some(belief) = &mut self.belief else { return };
        let innovation = models::scan_pose(belief, rules, scan);
        let off = innovation.residual.xy().norm();
        if off > rules.gnss_bias() || belief.clone().correct(&innovation) != Outcome::Gated {
            return;
        }
        let [place, tilt, heading] = LED;
        let doubt = Vector3::new(tilt, tilt, heading + innovation.residual[5].abs());
        belief.doubt(&Vector3::new(off + place, off + place, place), &doubt);
    }

    /// Whether scans are to be believed rather than what GNSS says: they agree with wheels and gyro, and GNSS is no farther off than it
    /// may be for minutes.
    fn is_overruled(&self, stamp: Nanos, scan: &LocalScan, rules: &Rules) -> bool {
        if self.scans.is_used(stamp, RECENT) || !self.agreement.is_proven() {
            return false;
        }
        let at = match (&self.belief, self.start.fix()) {
            (Some(belief), _) => belief.position,
            (None, Some(fix)) => fix.position,
            (None, None) => return false,
        };
        (scan.map_from_body.translation.vector - at).xy().norm() <= rules.gnss_bias()
    }

    fn begin(&mut self, belief: Option<Belief>, stamp: Nanos, source: impl Fn(&mut Filter) -> &mut Source) {
        if let Some(belief) = belief {
            self.belief = Some(belief);
            (self.turned, self.away) = ((0, stamp), (0, stamp));
            self.start = Start::default();
            source(self).note(Outcome::Used, stamp, Vector3::zeros());
        }
    }

    /// Gives the estimate up, and begins anew.
    fn restart(&mut self, fault: Fault, stamp: Nanos) {
        self.faults.note(fault, stamp);
        self.begin_anew(stamp);
    }

    fn begin_anew(&mut self, stamp: Nanos) {
        self.start = Start::after(self.belief.is_some() || self.start.after_loss);
        self.belief = None;
        self.scans = Source::default();
        self.fixes = Source::default();
        self.resting = None;
        self.leaving = None;
        self.witness = Witness::default();
        self.backwards = None;
        (self.turned, self.away) = ((0, stamp), (0, stamp));
    }
}

fn used(outcome: Outcome, gated: Fault) -> Result<(), Fault> {
    match outcome {
        Outcome::Used => Ok(()),
        Outcome::Gated => Err(gated),
        Outcome::Numerical => Err(Fault::Numerical),
    }
}

fn seconds(nanos: Nanos) -> f64 {
    nanos as f64 * 1e-9
}
