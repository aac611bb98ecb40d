//! Settings as the filter uses them.

use nalgebra::{Isometry3, Matrix6, SymmetricEigen, Vector3};
use realo_geodesy::{FAR_M, LocalFrame};
use realo_schemas::Nanos;

use crate::fault::Fault;
use crate::models::{LocalFix, LocalScan};
use crate::{Earth, GnssFix, ImuSample, Limits, MapFix, Sample, ScanNoise, ScanPose, Settings, UnitNoise};

/// Stamps lie within plus and minus so much, ns: until 2116.
const LATEST: Nanos = Nanos::MAX / 2;
/// Largest speed of wheels, m/s.
const FASTEST: f64 = 100.0;
/// Standard deviation in directions that a scan does not show, m; for turns the same at [`REACH`].
const UNSEEN: f64 = 10.0;
/// Distance at which a turn shifts points as much as a shift, m: what makes metres and radians comparable.
const REACH: f64 = 10.0;
/// Largest information, 1/m²: more is a mistake of units.
const LARGEST: f64 = 1e18;
/// Rounds in which eigenvalues are found.
const ROUNDS: usize = 200;

/// A receiver may be off by so many of its standard deviations, and by so much at most, m.
const BIAS: (f64, f64) = (10.0, 15.0);

/// What holds for a whole run.
#[derive(Clone, Debug)]
pub(crate) struct Rules {
    pub noise: UnitNoise,
    pub earth: Earth,
    pub limits: Limits,
    pub scan: ScanNoise,
    pub scans_to_begin: u32,
    pub body_from_imu: Isometry3<f64>,
    pub imu_from_body: Isometry3<f64>,
    pub antenna_in_imu: Vector3<f64>,
    pub axle_in_imu: Vector3<f64>,
    frame: LocalFrame,
}

/// A sample whose numbers were looked at.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Checked {
    Imu(ImuSample),
    Wheel(f64),
    Gnss(LocalFix),
    Scan(Box<LocalScan>),
}

impl Rules {
    pub fn new(settings: Settings) -> Self {
        let imu_from_body = settings.mounting.body_from_imu.inverse();
        let in_imu = |point: Vector3<f64>| (imu_from_body * nalgebra::Point3::from(point)).coords;
        Rules {
            antenna_in_imu: in_imu(settings.mounting.antenna_in_body),
            axle_in_imu: in_imu(settings.mounting.axle_in_body),
            body_from_imu: settings.mounting.body_from_imu,
            imu_from_body,
            noise: settings.noise,
            earth: settings.earth,
            limits: settings.limits,
            scan: settings.scan,
            scans_to_begin: settings.scans_to_begin,
            frame: settings.frame,
        }
    }

    /// Takes over where the antenna and the wheels' axle are, which do not change what was believed before.
    pub fn remount(&mut self, antenna_in_body: &Vector3<f64>, axle_in_body: &Vector3<f64>) {
        let in_imu = |point: &Vector3<f64>| (self.imu_from_body * nalgebra::Point3::from(*point)).coords;
        (self.antenna_in_imu, self.axle_in_imu) = (in_imu(antenna_in_body), in_imu(axle_in_body));
    }

    /// How far a receiver may be off for minutes, m: one without corrections by many of its standard deviations.
    pub fn gnss_bias(&self) -> f64 {
        let [east, north, _] = self.noise.gnss;
        (BIAS.0 * libm::hypot(east, north)).min(BIAS.1)
    }

    /// Looks at a sample by itself.
    ///
    /// # Errors
    /// What is wrong with it, whatever came before.
    pub fn check(&self, sample: &Sample) -> Result<Checked, Fault> {
        // So that differences of any two fit.
        if sample.stamp().unsigned_abs() > LATEST.unsigned_abs() {
            return Err(Fault::StampAhead);
        }
        match sample {
            Sample::Imu(imu) => self.check_imu(imu).map(Checked::Imu),
            // NaN is not within.
            Sample::Wheel(wheel) if wheel.speed.abs() <= FASTEST => Ok(Checked::Wheel(wheel.speed)),
            Sample::Wheel(_) => Err(Fault::WheelNotFinite),
            Sample::Gnss(fix) => self.check_fix(fix).map(Checked::Gnss),
            Sample::Fix(fix) => self.check_map_fix(fix).map(Checked::Gnss),
            Sample::Scan(scan) => self.check_scan(scan).map(|scan| Checked::Scan(Box::new(scan))),
        }
    }

    fn check_imu(&self, imu: &ImuSample) -> Result<ImuSample, Fault> {
        let largest = |vector: &Vector3<f64>| {
            vector.iter().fold(0.0f64, |most, part| {
                if part.is_finite() {
                    most.max(part.abs())
                } else {
                    f64::INFINITY
                }
            })
        };
        let (rate, force) = (largest(&imu.angular_rate), largest(&imu.specific_force));
        if rate == f64::INFINITY || force == f64::INFINITY {
            return Err(Fault::ImuNotFinite);
        }
        // What a sheet gives as a range is clipped a little below it by some units.
        if rate >= 0.999 * self.noise.gyro_range || force >= 0.999 * self.noise.accel_range {
            return Err(Fault::ImuSaturated);
        }
        Ok(*imu)
    }

    fn check_fix(&self, fix: &GnssFix) -> Result<LocalFix, Fault> {
        let place = &fix.place;
        let numbers = [place.latitude_deg, place.longitude_deg, place.height_m];
        if !numbers.iter().all(|number| number.is_finite()) {
            return Err(Fault::GnssNotFinite);
        }
        let position = self.frame.local_of(place).map_err(|_| Fault::GnssElsewhere)?;
        Ok(LocalFix {
            position,
            variance: self.gnss_variance(fix.variance)?,
            has_height: place.height_m != 0.0,
            since_s: None,
        })
    }

    fn check_map_fix(&self, fix: &MapFix) -> Result<LocalFix, Fault> {
        let position = fix.position;
        if !position.iter().all(|number| number.is_finite()) {
            return Err(Fault::GnssNotFinite);
        }
        // In another zone; a height that is not known says nothing.
        if position.xy().norm() > FAR_M {
            return Err(Fault::GnssElsewhere);
        }
        Ok(LocalFix {
            position,
            variance: self.gnss_variance(fix.variance)?,
            has_height: fix.has_height,
            since_s: None,
        })
    }

    /// The variance of a fix, m²: what the receiver reports, else that of the unit.
    fn gnss_variance(&self, reported: Option<[f64; 3]>) -> Result<Vector3<f64>, Fault> {
        let squared = self.noise.gnss.map(|sigma| sigma * sigma);
        let variance = Vector3::from(reported.unwrap_or(squared));
        let is_variance = |v: &f64| *v > 0.0 && v.is_finite();
        match variance.iter().all(is_variance) {
            true => Ok(variance),
            false => Err(Fault::GnssNotFinite),
        }
    }

    fn check_scan(&self, scan: &ScanPose) -> Result<LocalScan, Fault> {
        let position = &scan.map_from_body.translation.vector;
        let length = scan.map_from_body.rotation.quaternion().norm();
        let finite = position
            .iter()
            .chain(scan.information.iter())
            .all(|part| part.is_finite());
        let is_rotation = (length - 1.0).abs() < 1e-6;
        if !finite || !is_rotation {
            return Err(Fault::ScanNotFinite);
        }
        let covariance = self.scan_covariance(&scan.information).ok_or(Fault::ScanInformation)?;
        Ok(LocalScan {
            map_from_body: scan.map_from_body,
            covariance,
        })
    }

    /// The covariance of a scan's pose: the inverse of its information, as large as [`UNSEEN`] where there is none, with what
    /// the map's errors add.
    fn scan_covariance(&self, information: &Matrix6<f64>) -> Option<Matrix6<f64>> {
        let size = information.abs().max();
        let uneven = (information - information.transpose()).abs().max();
        if size == 0.0 || size > LARGEST || uneven > 1e-6 * size {
            return None;
        }
        let mut scale = Matrix6::identity();
        for turn in 3..6 {
            scale[(turn, turn)] = 1.0 / REACH;
        }
        let scaled = scale * (0.5 * (information + information.transpose())) * scale;
        let eigen = SymmetricEigen::try_new(scaled, f64::EPSILON, ROUNDS)?;
        if eigen.eigenvalues.min() < -1e-6 * eigen.eigenvalues.max() {
            return None;
        }
        let variances = eigen.eigenvalues.map(|value| 1.0 / value.max(1.0 / (UNSEEN * UNSEEN)));
        let spread = eigen.eigenvectors * Matrix6::from_diagonal(&variances) * eigen.eigenvectors.transpose();
        let mut covariance = scale * spread * scale * self.scan.factor;
        for axis in 0..6 {
            let floor = if axis < 3 {
                self.scan.position_m
            } else {
                self.scan.turn_rad
            };
            covariance[(axis, axis)] += floor * floor;
        }
        Some(0.5 * (covariance + covariance.transpose()))
    }
}

impl Sample {
    /// When it was measured.
    pub fn stamp(&self) -> Nanos {
        match self {
            Sample::Imu(imu) => imu.stamp,
            Sample::Wheel(wheel) => wheel.stamp,
            Sample::Gnss(fix) => fix.stamp,
            Sample::Fix(fix) => fix.stamp,
            Sample::Scan(scan) => scan.stamp,
        }
    }
}

impl Checked {
    /// In which order samples of one stamp are taken.
    pub fn rank(&self) -> u8 {
        match self {
            Checked::Imu(_) => 0,
            Checked::Wheel(_) => 1,
            Checked::Gnss(_) => 2,
            Checked::Scan(_) => 3,
        }
    }
}
