//! How an estimate begins: from GNSS and motion, or from a scan's pose.

use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion, Vector2, Vector3};
use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{Nanos, from_seconds, to_seconds};

use crate::ImuSample;
use crate::align::{Aligned, Alignment};
use crate::belief::{ACCEL_BIAS, ATTITUDE, Belief, Errors, GYRO_BIAS, POSITION, SCALE, VELOCITY, WANDER};
use crate::fault::Fault;
use crate::models::{LocalFix, LocalScan};
use crate::reckoning::{Reckoning, Tilt};
use crate::rules::Rules;

/// The heading is good enough to begin with, rad.
const HEADING: f64 = 0.1;
/// And later, where a vehicle is slow: so long after the first fix, s, with so much, rad; with more it would be lost at once.
const PATIENCE: (f64, f64) = (4.0, 0.17);
/// Speed and heading of dead reckoning and GNSS may differ so much, as a share.
const STRETCH: f64 = 0.3;
/// Standard deviation of a velocity's components that nothing shows, m/s.
const DRIFT: f64 = 0.1;
/// Standard deviation of a height that is not known, m.
const HEIGHT: f64 = 10.0;
/// A scan is compared with fixes that are no older, ns.
const FRESH: Nanos = 2_000_000_000;

/// What is gathered before there is an estimate.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Start {
    /// Whether an estimate was lost before.
    pub after_loss: bool,
    reckoning: Reckoning,
    alignment: Alignment,
    last_fix: Option<(Nanos, LocalFix)>,
    scans: Option<ScanRun>,
}

/// Scans that agree with each other.
#[derive(Clone, Debug, PartialEq)]
struct ScanRun {
    count: u32,
    stamp: Nanos,
    place: Vector2<f64>,
    yaw: f64,
    reckoned: Vector2<f64>,
    heading: f64,
}

impl Start {
    /// The beginning of an estimate, after another one was lost or not.
    pub fn after(after_loss: bool) -> Self {
        Start {
            after_loss,
            ..Start::default()
        }
    }

    /// The estimate that begins with a scan's pose, and the motion by an odometer.
    pub fn at_scan(odometer: &Reckoning, scan: &LocalScan, rules: &Rules) -> Belief {
        let start = Start {
            reckoning: odometer.clone(),
            ..Start::default()
        };
        start.begin_at_scan(scan, rules)
    }

    /// Takes a usable IMU sample; `period`: since the one before, s.
    pub fn imu(&mut self, sample: &ImuSample, period: f64, rules: &Rules) {
        self.reckoning.imu(sample, period, rules);
    }

    /// Takes a speed of the wheels.
    pub fn wheel(&mut self, stamp: Nanos, speed: f64) {
        self.reckoning.wheel(stamp, speed);
    }

    /// The last fix, for what knows no more than that.
    pub fn fix(&self) -> Option<&LocalFix> {
        self.last_fix.as_ref().map(|(_, fix)| fix)
    }

    /// Takes a GNSS fix; gives the estimate that begins with it.
    ///
    /// # Errors
    /// [`Fault::GnssGate`] for a fix that does not follow from the last one; all begins anew with it.
    pub fn take_fix(&mut self, stamp: Nanos, fix: &LocalFix, rules: &Rules) -> Result<Option<Belief>, Fault> {
        self.reckoning.advance(stamp);
        self.last_fix = Some((stamp, *fix));
        let antenna = self.reckoned(&(rules.body_from_imu.rotation * rules.antenna_in_imu));
        let has_speed = self.reckoning.speed.is_some();
        let follows = self.alignment.follows(&antenna, fix, has_speed);
        if !follows || self.alignment.is_over(stamp) {
            self.alignment = Alignment::default();
            self.reckoning.restart();
        }
        self.alignment.add(stamp, antenna, fix);
        if !follows {
            return Err(Fault::GnssGate);
        }
        let Some(aligned) = self.alignment.aligned(stamp, rules) else {
            return Ok(None);
        };
        let limit = if aligned.seconds < PATIENCE.0 {
            HEADING
        } else {
            PATIENCE.1
        };
        if aligned.turn_variance > limit * limit {
            return Ok(None);
        }
        // A track that GNSS stretches or shrinks is not the same track.
        if has_speed && (aligned.scale - 1.0).abs() > STRETCH {
            return Ok(None);
        }
        Ok(Some(self.begin_at_fix(&aligned, fix, rules)))
    }

    /// Takes a scan's pose; gives the estimate that begins with it.
    ///
    /// # Errors
    /// [`Fault::ScanGate`] for one that is not where GNSS, or the scans before, say.
    pub fn take_scan(&mut self, stamp: Nanos, scan: &LocalScan, rules: &Rules) -> Result<Option<Belief>, Fault> {
        self.reckoning.advance(stamp);
        let fresh = self.last_fix.as_ref().filter(|(at, _)| stamp - at <= FRESH);
        if let Some((at, fix)) = fresh {
            let antenna = scan.map_from_body * rules.body_from_imu * nalgebra::Point3::from(rules.antenna_in_imu);
            let way = (antenna.coords - fix.position).xy().norm();
            let moved = self.reckoning.speed.unwrap_or(30.0).abs() * to_seconds(stamp - at);
            if way > 3.7 * (fix.variance.x + fix.variance.y).sqrt() + moved + 0.5 {
                return Err(Fault::ScanGate);
            }
            return Ok(Some(self.begin_at_scan(scan, rules)));
        }
        let run = self.run_of(stamp, scan);
        let count = run.count;
        self.scans = Some(run);
        Ok((count >= rules.scans_to_begin).then(|| self.begin_at_scan(scan, rules)))
    }

    /// A run of scans with one more, or one that begins with it.
    fn run_of(&self, stamp: Nanos, scan: &LocalScan) -> ScanRun {
        let (reckoned, heading) = (self.reckoning.place, self.reckoning.heading);
        let place = scan.map_from_body.translation.vector.xy();
        let yaw = yaw_of(&scan.map_from_body.rotation);
        let count = self.scans.as_ref().map_or(1, |run| {
            let turned = normalize_yaw(yaw - run.yaw - (heading - run.heading)).abs();
            let (sin, cos) = libm::sincos(run.yaw - run.heading);
            let way = reckoned - run.reckoned;
            let expected = run.place + Vector2::new(cos * way.x - sin * way.y, sin * way.x + cos * way.y);
            let off = (place - expected).norm();
            let slack = if self.reckoning.speed.is_some() { 0.5 } else { 4.0 };
            let soon = stamp - run.stamp <= from_seconds(1.0);
            if soon && turned < 0.05 && off < slack {
                run.count + 1
            } else {
                1
            }
        });
        ScanRun {
            count,
            stamp,
            place,
            yaw,
            reckoned,
            heading,
        }
    }

    /// A point of the body in dead reckoning; `lever`: from the IMU, in the body's axes.
    fn reckoned(&self, lever: &Vector3<f64>) -> Vector2<f64> {
        let (sin, cos) = libm::sincos(self.reckoning.heading);
        self.reckoning.place + Vector2::new(cos * lever.x - sin * lever.y, sin * lever.x + cos * lever.y)
    }

    fn begin_at_fix(&self, aligned: &Aligned, fix: &LocalFix, rules: &Rules) -> Belief {
        let tilt = self.reckoning.tilt(rules);
        let yaw = aligned.turn + self.reckoning.heading;
        let map_from_imu = attitude(tilt.roll, tilt.pitch, yaw) * rules.body_from_imu.rotation;
        let position = aligned.antenna - map_from_imu * rules.antenna_in_imu;
        let pose = Isometry3::from_parts(Translation3::from(position), map_from_imu);
        let speed = self.reckoning.speed.map_or((aligned.scale, 1.0), |speed| (speed, 0.0));
        let mut sources: Vec<Errors> = turns(&pose, tilt.sigma, aligned.turn_variance.sqrt()).into();
        // A wrong heading also turns the track about its middle.
        let [_, _, heading] = &mut sources[..] else {
            return Belief::at(&pose, Vector3::zeros());
        };
        let swing = Vector3::new(-aligned.lever.y, aligned.lever.x, 0.0) * aligned.turn_variance.sqrt();
        heading.fixed_rows_mut::<3>(POSITION).copy_from(&swing);
        let [wander, white] = fix.split(rules);
        for axis in 0..3 {
            let mut noise = Errors::zeros();
            noise[POSITION + axis] = (white[axis] / aligned.count).sqrt();
            let mut wandering = Errors::zeros();
            wandering[POSITION + axis] = -wander[axis];
            wandering[WANDER + axis] = 1.0;
            if axis == 2 && !aligned.has_height {
                noise[POSITION + axis] = HEIGHT;
                wandering[POSITION + axis] = 0.0;
            }
            sources.extend([noise, wandering]);
        }
        self.begin(&pose, speed, sources, rules)
    }

    fn begin_at_scan(&self, scan: &LocalScan, rules: &Rules) -> Belief {
        let mut map_from_body = scan.map_from_body;
        let mut covariance = scan.covariance;
        if !rules.scan.tilt {
            let Tilt { roll, pitch, sigma } = self.reckoning.tilt(rules);
            map_from_body.rotation = attitude(roll, pitch, yaw_of(&scan.map_from_body.rotation));
            for axis in [3, 4] {
                covariance.row_mut(axis).fill(0.0);
                covariance.column_mut(axis).fill(0.0);
                covariance[(axis, axis)] = sigma * sigma;
            }
        }
        let pose = map_from_body * rules.body_from_imu;
        let map_from_imu = pose.rotation.to_rotation_matrix().into_inner();
        let lever = map_from_imu * rules.imu_from_body.translation.vector.cross_matrix();
        let columns = covariance.cholesky().map_or(Matrix6::identity(), |factor| factor.l());
        let mut sources: Vec<Errors> = Vec::with_capacity(24);
        for column in columns.column_iter() {
            let mut source = Errors::zeros();
            let turn: Vector3<f64> = map_from_imu.transpose() * column.fixed_rows::<3>(3);
            source.fixed_rows_mut::<3>(ATTITUDE).copy_from(&turn);
            source
                .fixed_rows_mut::<3>(POSITION)
                .copy_from(&(column.fixed_rows::<3>(0) + lever * turn));
            sources.push(source);
        }
        for axis in 0..3 {
            let mut wandering = Errors::zeros();
            wandering[WANDER + axis] = 1.0;
            sources.push(wandering);
        }
        let speed = self.reckoning.speed.map_or((0.0, 15.0), |speed| (speed, 0.0));
        self.begin(&pose, speed, sources, rules)
    }

    /// The belief at an IMU's pose with a forward speed and its standard deviation beyond the wheels', m/s, and sources of error
    /// of position and attitude.
    fn begin(
        &self,
        pose: &Isometry3<f64>,
        (speed, unknown): (f64, f64),
        sources: Vec<Errors>,
        rules: &Rules,
    ) -> Belief {
        let imu_from_body = rules.imu_from_body.rotation;
        let forward = imu_from_body * Vector3::x();
        let rate = imu_from_body * Vector3::new(0.0, 0.0, self.reckoning.rate);
        let velocity_in_imu = forward * speed - rate.cross(&rules.axle_in_imu);
        let mut belief = Belief::at(pose, pose.rotation * velocity_in_imu);
        let lean = -(pose.rotation.to_rotation_matrix().into_inner() * velocity_in_imu.cross_matrix());
        for mut source in sources {
            let turn = source.fixed_rows::<3>(ATTITUDE).into_owned();
            source.fixed_rows_mut::<3>(VELOCITY).copy_from(&(lean * turn));
            belief.widen(&source);
        }
        let noise = &rules.noise;
        let mut along = Errors::zeros();
        let sigma = libm::hypot(noise.wheel, unknown);
        along
            .fixed_rows_mut::<3>(VELOCITY)
            .copy_from(&(pose.rotation * forward * sigma));
        let mut scale = Errors::zeros();
        scale[SCALE] = noise.wheel_scale;
        let shrink = pose.rotation * forward * (-speed * noise.wheel_scale);
        scale.fixed_rows_mut::<3>(VELOCITY).copy_from(&shrink);
        belief.widen(&along);
        belief.widen(&scale);
        for axis in 0..3 {
            for (row, sigma) in [
                (VELOCITY, DRIFT),
                (GYRO_BIAS, noise.gyro_bias_start),
                (ACCEL_BIAS, noise.accel_bias_start),
            ] {
                let mut source = Errors::zeros();
                source[row + axis] = sigma;
                belief.widen(&source);
            }
        }
        belief.symmetrize();
        belief
    }
}

/// Roll about x, then pitch about y, then yaw about z.
fn attitude(roll: f64, pitch: f64, yaw: f64) -> UnitQuaternion<f64> {
    let half = |angle: f64| libm::sincos(0.5 * angle);
    let ((sin_r, cos_r), (sin_p, cos_p), (sin_y, cos_y)) = (half(roll), half(pitch), half(yaw));
    let about_x = Quaternion::new(cos_r, sin_r, 0.0, 0.0);
    let about_y = Quaternion::new(cos_p, 0.0, sin_p, 0.0);
    let about_z = Quaternion::new(cos_y, 0.0, 0.0, sin_y);
    UnitQuaternion::new_normalize(about_z * about_y * about_x)
}

/// Sources of error of an attitude, about the three axes of `map`: tilt, tilt and heading, rad.
fn turns(pose: &Isometry3<f64>, tilt: f64, heading: f64) -> [Errors; 3] {
    [Vector3::x() * tilt, Vector3::y() * tilt, Vector3::z() * heading].map(|turn| {
        let mut source = Errors::zeros();
        source
            .fixed_rows_mut::<3>(ATTITUDE)
            .copy_from(&(pose.rotation.inverse() * turn));
        source
    })
}
