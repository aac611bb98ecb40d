//! Poses of what does not move.

use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector3, Vector6};
use realo_schemas::{Nanos, from_seconds};

use crate::belief::{quaternion_of, vector_of};
use crate::fault::{Fault, Faults};
use crate::models::{LocalFix, LocalScan};
use crate::rules::{Checked, Rules};
use crate::settings::{Settings, SettingsError};
use crate::{Estimate, Sample, Status, Verdict};

/// 99.9 % of χ² with six degrees of freedom.
const GATE: f64 = 22.458;

/// How a roadside unit is localised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HoldSettings {
    /// The pose is known once so many scans agree with each other.
    pub first: u32,
    /// It gets better until so many are averaged, and is held from then on.
    pub scans: u32,
    /// Scans that contradict the held pose for so long mean that the unit was moved, ns.
    pub moved: Nanos,
    /// How the unit is turned in `map`, where a survey says so: then the mean of fixes is enough, without scans.
    pub surveyed: Option<UnitQuaternion<f64>>,
    /// So many fixes are averaged for it.
    pub fixes: u32,
}

/// Standard deviation of each turn of a surveyed attitude, rad.
const SURVEYED_TURN: f64 = 1e-3;

impl Default for HoldSettings {
    fn default() -> Self {
        HoldSettings {
            first: 3,
            scans: 10,
            moved: from_seconds(5.0),
            surveyed: None,
            fixes: 40,
        }
    }
}

/// Estimates the pose of a roadside unit: the mean of its first scans that agree, held from then on. Scans that disagree with them
/// are left out, unless there are more of those.
///
/// Scans are compared with GNSS where there is a fix. Later scans are compared with the held pose; when they contradict it for
/// [`HoldSettings::moved`], the pose is given up and found anew. IMU and wheels say nothing here.
#[derive(Clone, Debug)]
pub struct HoldEstimator {
    rules: Rules,
    settings: HoldSettings,
    fixes: FixMean,
    scans: Option<ScanMean>,
    held: Option<(Isometry3<f64>, Matrix6<f64>)>,
    contradicted: Option<Nanos>,
    after_loss: bool,
    faults: Faults,
}

/// Mean of fixes.
#[derive(Clone, Debug, Default)]
struct FixMean {
    count: f64,
    position: Vector3<f64>,
    last: Option<LocalFix>,
    /// When that was measured.
    stamp: Option<Nanos>,
}

/// Mean of scans: a first one, and how far the others are from it.
#[derive(Clone, Debug)]
struct ScanMean {
    first: LocalScan,
    count: u32,
    /// Scans that disagree.
    against: u32,
    sum: Vector6<f64>,
    covariance: Matrix6<f64>,
}

impl ScanMean {
    fn of(first: &LocalScan) -> Self {
        ScanMean {
            first: first.clone(),
            count: 1,
            against: 0,
            sum: Vector6::zeros(),
            covariance: first.covariance,
        }
    }

    /// Adds a scan if it agrees with the others.
    fn add(&mut self, scan: &LocalScan) -> bool {
        let way = difference(&self.first.map_from_body, &scan.map_from_body);
        let count = f64::from(self.count);
        let mean = self.sum / count;
        let agreed = agrees(&(way - mean), &(self.covariance / count + scan.covariance));
        if agreed {
            self.count += 1;
            self.sum += way;
            self.covariance += scan.covariance;
        } else {
            self.against += 1;
        }
        agreed
    }
}

impl HoldEstimator {
    /// An estimator that knows nothing yet.
    ///
    /// # Errors
    /// [`SettingsError`] for a setting that is none, by name.
    pub fn new(settings: Settings, hold: HoldSettings) -> Result<Self, SettingsError> {
        Ok(HoldEstimator {
            rules: Rules::new(settings.checked()?),
            settings: hold,
            fixes: FixMean::default(),
            scans: None,
            held: None,
            contradicted: None,
            after_loss: false,
            faults: Faults::default(),
        })
    }

    /// Takes a sample. What is wrong with it is the verdict, and counted in [`Self::faults`].
    pub fn take(&mut self, sample: &Sample) -> Verdict {
        let stamp = sample.stamp();
        let taken = self.rules.check(sample).and_then(|checked| match checked {
            Checked::Gnss(fix) => self.take_fix(stamp, &fix),
            Checked::Scan(scan) => self.take_scan(stamp, &scan),
            Checked::Imu(_) | Checked::Wheel(_) => Ok(()),
        });
        match taken {
            Err(fault) => {
                self.faults.note(fault, stamp);
                Verdict::Refused(fault)
            }
            Ok(()) if self.held.is_some() => Verdict::Used,
            Ok(()) => Verdict::Waiting,
        }
    }

    fn take_fix(&mut self, stamp: Nanos, fix: &LocalFix) -> Result<(), Fault> {
        if !fix.has_height {
            self.faults.note(Fault::GnssHeightZero, stamp);
        }
        let fix = &fix.after(self.fixes.stamp.replace(stamp), stamp);
        let last = self.fixes.last.replace(*fix);
        if last.is_some_and(|last| last.position == fix.position) {
            return Err(Fault::GnssFrozen);
        }
        if self.fixes.count > 0.0 && !self.is_near(&self.fixes.position, fix) {
            return Err(Fault::GnssGate);
        }
        self.fixes.count += 1.0;
        self.fixes.position += (fix.position - self.fixes.position) / self.fixes.count;
        if let Some(attitude) = self.settings.surveyed
            && self.held.is_none()
            && self.fixes.count >= f64::from(self.settings.fixes.max(1))
        {
            self.held = Some(self.mean_of_fixes(fix, attitude));
        }
        Ok(())
    }

    /// The pose by the mean of fixes and a surveyed attitude; what wanders does not average in so short a time.
    fn mean_of_fixes(&self, fix: &LocalFix, attitude: UnitQuaternion<f64>) -> (Isometry3<f64>, Matrix6<f64>) {
        let [wander, white] = fix.split(&self.rules);
        let position = wander.component_mul(&wander) + white / self.fixes.count;
        let turn = SURVEYED_TURN * SURVEYED_TURN;
        let diagonal = Vector6::new(position.x, position.y, position.z, turn, turn, turn);
        let antenna = self.rules.body_from_imu * nalgebra::Point3::from(self.rules.antenna_in_imu);
        let origin = self.fixes.position - attitude * antenna.coords;
        (
            Isometry3::from_parts(origin.into(), attitude),
            Matrix6::from_diagonal(&diagonal),
        )
    }

    /// Says where the antenna is in the body frame, m, once its first fix says it.
    pub fn remount(&mut self, antenna_in_body: &Vector3<f64>) {
        self.rules.remount(antenna_in_body, &Vector3::zeros());
    }

    /// The place of the antenna by the mean of fixes, m in `map`, and the number of fixes; `None` before the first.
    pub fn antenna(&self) -> Option<(Vector3<f64>, f64)> {
        (self.fixes.count > 0.0).then_some((self.fixes.position, self.fixes.count))
    }

    /// Whether a place can be that of a fix, east and north.
    fn is_near(&self, antenna: &Vector3<f64>, fix: &LocalFix) -> bool {
        let way = (antenna - fix.position).xy().norm();
        way <= 3.7 * (fix.variance.x + fix.variance.y).sqrt() + 0.5
    }

    fn take_scan(&mut self, stamp: Nanos, scan: &LocalScan) -> Result<(), Fault> {
        let is_over = self.scans.as_ref().is_none_or(|mean| mean.count >= self.settings.scans);
        if let Some((pose, covariance)) = self.held.as_ref().filter(|_| is_over) {
            if agrees(&difference(pose, &scan.map_from_body), &(covariance + scan.covariance)) {
                self.contradicted = None;
                return Ok(());
            }
            let since = *self.contradicted.get_or_insert(stamp);
            if stamp - since < self.settings.moved {
                return Err(Fault::ScanGate);
            }
            self.held = None;
            self.contradicted = None;
            self.after_loss = true;
            self.fixes = FixMean::default();
            self.scans = None;
            return Err(Fault::ScanConflict);
        }
        let antenna = scan.map_from_body * self.rules.body_from_imu * nalgebra::Point3::from(self.rules.antenna_in_imu);
        let last = self.fixes.last.filter(|_| self.fixes.count > 0.0);
        if last.is_some_and(|fix| !self.is_near(&antenna.coords, &fix)) {
            return Err(Fault::ScanGate);
        }
        self.gather(scan)
    }

    fn gather(&mut self, scan: &LocalScan) -> Result<(), Fault> {
        let agreed = match &mut self.scans {
            Some(mean) => mean.add(scan),
            None => {
                self.scans = Some(ScanMean::of(scan));
                true
            }
        };
        if self.scans.as_ref().is_some_and(|mean| mean.against > mean.count) {
            self.after_loss |= self.held.take().is_some();
            self.scans = Some(ScanMean::of(scan));
        }
        if let Some(mean) = self.scans.as_ref().filter(|mean| mean.count >= self.settings.first) {
            self.held = Some(self.mean_of(mean));
        }
        if agreed { Ok(()) } else { Err(Fault::ScanGate) }
    }

    /// Mean pose and its covariance; what all scans have in common, as the map's errors, is not in it.
    fn mean_of(&self, mean: &ScanMean) -> (Isometry3<f64>, Matrix6<f64>) {
        let count = f64::from(mean.count);
        let way = mean.sum / count;
        let first = &mean.first.map_from_body;
        let turn = UnitQuaternion::new_normalize(quaternion_of(&way.fixed_rows::<3>(3).into_owned()));
        let position = first.translation.vector + way.fixed_rows::<3>(0);
        let pose = Isometry3::from_parts(position.into(), turn * first.rotation);
        (pose, mean.covariance / (count * count))
    }

    /// The pose, which does not depend on time; `None` before any position is known.
    pub fn estimate_at(&self, stamp: Nanos) -> Option<Estimate> {
        let (map_from_body, covariance, status) = match &self.held {
            Some((pose, covariance)) => (*pose, *covariance, Status::Tracking),
            None => {
                let fix = self.fixes.last.filter(|_| self.fixes.count > 0.0)?;
                let [wander, white] = fix.split(&self.rules);
                let position = wander.component_mul(&wander) + white / self.fixes.count;
                let turn = Vector3::new(2.5e-3, 2.5e-3, std::f64::consts::PI * std::f64::consts::PI / 3.0);
                let diagonal = Vector6::new(position.x, position.y, position.z, turn.x, turn.y, turn.z);
                let pose = Isometry3::from_parts(self.fixes.position.into(), UnitQuaternion::identity());
                (pose, Matrix6::from_diagonal(&diagonal), self.without())
            }
        };
        Some(Estimate {
            stamp,
            map_from_body,
            covariance,
            velocity: Vector3::zeros(),
            angular_rate: Some(Vector3::zeros()),
            status,
        })
    }

    fn without(&self) -> Status {
        if self.after_loss { Status::Lost } else { Status::Init }
    }

    /// Whether the unit's pose can be relied on.
    pub fn status(&self) -> Status {
        if self.held.is_some() {
            Status::Tracking
        } else {
            self.without()
        }
    }

    /// What was wrong with the samples so far.
    pub fn faults(&self) -> Faults {
        self.faults
    }
}

/// The way from one pose to another: of the origin, m, and the turn about the axes of `map`, rad.
fn difference(from: &Isometry3<f64>, to: &Isometry3<f64>) -> Vector6<f64> {
    let shift = to.translation.vector - from.translation.vector;
    let turn = vector_of(&(to.rotation * from.rotation.inverse()));
    Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
}

/// Whether chance explains a difference.
fn agrees(way: &Vector6<f64>, covariance: &Matrix6<f64>) -> bool {
    covariance
        .cholesky()
        .is_some_and(|factor| way.dot(&factor.solve(way)) <= GATE)
}
