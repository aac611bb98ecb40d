//! What GNSS, wheels and scans say of a state: one innovation each.

use nalgebra::{Matrix1, Matrix2, Matrix3, Matrix6, RowVector3, SMatrix, Vector1, Vector2, Vector3, Vector6};

use realo_schemas::{Nanos, to_seconds};

use crate::belief::{ATTITUDE, Belief, GYRO_BIAS, POSITION, SCALE, VELOCITY, WANDER, vector_of};
use crate::correct::Innovation;
use crate::rules::Rules;

/// Velocity across and up at the axle when wheels roll without slip, m/s.
const SKID: Vector2<f64> = Vector2::new(0.03, 0.05);
/// What lateral acceleration adds to it, m/s for each m/s².
const SKID_BY_ACCELERATION: f64 = 0.01;
/// Velocity at a standstill, m/s.
const STANDING: f64 = 0.01;
/// Angular rate at a standstill, rad/s: of a body with a running engine.
const STANDING_RATE: f64 = 5e-4;
/// The same where no gyro says it, rad/s.
const STANDING_TURN: f64 = 0.01;
/// Variance that takes roll and pitch of a scan out of the measurement, rad².
const UNUSED_TILT: f64 = 100.0;

/// A GNSS position in `map`, with the variance that the receiver reports or the unit has, m².
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LocalFix {
    pub position: Vector3<f64>,
    pub variance: Vector3<f64>,
    pub has_height: bool,
    /// Time since the fix before, s; `None` for the first.
    pub since_s: Option<f64>,
}

/// A scan's pose with its covariance, in the order of its information.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LocalScan {
    pub map_from_body: nalgebra::Isometry3<f64>,
    pub covariance: Matrix6<f64>,
}

impl LocalFix {
    /// The fix after one that was measured `before`.
    pub fn after(&self, before: Option<Nanos>, stamp: Nanos) -> Self {
        let since = before.map(|before| to_seconds(stamp.saturating_sub(before)));
        LocalFix {
            since_s: since.filter(|since| *since > 0.0),
            ..*self
        }
    }

    /// Standard deviations of what wanders, and variances of the rest.
    ///
    /// Variance above the unit's own comes from multipath. Errors of one multipath period are alike, so all its fixes together count as one.
    pub fn split(&self, rules: &Rules) -> [Vector3<f64>; 2] {
        let noise = &rules.noise;
        let sky = self
            .variance
            .zip_map(&Vector3::from(noise.gnss), |v, unit| v.min(unit * unit));
        let alike = self
            .since_s
            .map_or(1.0, |since| (2.0 * noise.gnss_multipath_s / since).max(1.0));
        let share = noise.gnss_wander_share;
        [
            sky.map(|v| (share * v).sqrt()),
            sky * (1.0 - share) + (self.variance - sky) * alike,
        ]
    }

    /// East and north against a belief.
    pub fn horizontal(&self, belief: &Belief, rules: &Rules) -> Innovation<2> {
        let [wander, white] = self.split(rules);
        let rotation = belief.map_from_imu.to_rotation_matrix().into_inner();
        let lean = -(rotation * rules.antenna_in_imu.cross_matrix());
        let residual = self.residual(belief, rules, &wander);
        let noise = Matrix2::from_diagonal(&white.xy());
        Innovation::new(residual.xy(), noise)
            .with(POSITION, &SMatrix::<f64, 2, 3>::identity())
            .with(ATTITUDE, &lean.fixed_rows::<2>(0).into_owned())
            .with(WANDER, &Matrix2::from_diagonal(&wander.xy()))
    }

    /// The height against a belief.
    pub fn vertical(&self, belief: &Belief, rules: &Rules) -> Innovation<1> {
        let [wander, white] = self.split(rules);
        let rotation = belief.map_from_imu.to_rotation_matrix().into_inner();
        let lean = -(rotation * rules.antenna_in_imu.cross_matrix());
        let residual = self.residual(belief, rules, &wander);
        Innovation::new(Vector1::new(residual.z), Matrix1::new(white.z))
            .with(POSITION + 2, &Matrix1::new(1.0))
            .with(ATTITUDE, &lean.fixed_rows::<1>(2).into_owned())
            .with(WANDER + 2, &Matrix1::new(wander.z))
    }

    fn residual(&self, belief: &Belief, rules: &Rules, wander: &Vector3<f64>) -> Vector3<f64> {
        let antenna = belief.position + belief.map_from_imu * rules.antenna_in_imu;
        self.position - antenna - wander.component_mul(&belief.wander)
    }
}

/// The velocity at the axle in the body frame, m/s, and how errors of velocity, attitude and gyro bias change it.
fn axle(belief: &Belief, rules: &Rules, rate: Option<&Vector3<f64>>) -> (Vector3<f64>, [Matrix3<f64>; 3]) {
    let body_from_imu = rules.body_from_imu.rotation.to_rotation_matrix().into_inner();
    let imu_from_map = belief.map_from_imu.inverse().to_rotation_matrix().into_inner();
    let velocity = imu_from_map * belief.velocity;
    // Without a rate the lever is not seen.
    let lever = rate.map_or_else(Vector3::zeros, |_| rules.axle_in_imu);
    let rate = rate.map_or_else(Vector3::zeros, |rate| rate - belief.gyro_bias);
    let by_velocity = body_from_imu * imu_from_map;
    let by_attitude = body_from_imu * velocity.cross_matrix();
    let by_bias = body_from_imu * lever.cross_matrix();
    (
        body_from_imu * (velocity + rate.cross(&lever)),
        [by_velocity, by_attitude, by_bias],
    )
}

/// The wheels' speed. `rate`: of the gyro as measured, where it is known.
pub(crate) fn wheel_speed(belief: &Belief, rules: &Rules, speed: f64, rate: Option<&Vector3<f64>>) -> Innovation<1> {
    let (axle, blocks) = axle(belief, rules, rate);
    let factor = 1.0 + belief.scale;
    let [velocity, attitude, bias] = blocks.map(|block| -> RowVector3<f64> { block.row(0) * factor });
    let noise = rules.noise.wheel;
    Innovation::new(Vector1::new(speed - factor * axle.x), Matrix1::new(noise * noise))
        .with(VELOCITY, &velocity)
        .with(ATTITUDE, &attitude)
        .with(GYRO_BIAS, &bias)
        .with(SCALE, &Matrix1::new(axle.x))
}

/// How fast the vehicle goes ahead, m/s.
pub(crate) fn forward_speed(belief: &Belief, rules: &Rules, rate: Option<&Vector3<f64>>) -> f64 {
    axle(belief, rules, rate).0.x
}

/// Wheels roll along, not across and not up (non-holonomic constraint).
pub(crate) fn no_skid(belief: &Belief, rules: &Rules, rate: Option<&Vector3<f64>>) -> Innovation<2> {
    let (axle, blocks) = axle(belief, rules, rate);
    let [velocity, attitude, bias] = blocks.map(|block| block.fixed_rows::<2>(1).into_owned());
    let turning = rate.map_or(0.0, |rate| (rules.body_from_imu.rotation * rate).z);
    let mut skid = SKID;
    skid.x += SKID_BY_ACCELERATION * (turning * axle.x).abs();
    Innovation::new(-axle.yz(), Matrix2::from_diagonal(&skid.component_mul(&skid)))
        .with(VELOCITY, &velocity)
        .with(ATTITUDE, &attitude)
        .with(GYRO_BIAS, &bias)
}

/// The vehicle stands (zero-velocity update).
pub(crate) fn standstill(belief: &Belief) -> Innovation<3> {
    Innovation::new(-belief.velocity, Matrix3::identity() * (STANDING * STANDING)).with(VELOCITY, &Matrix3::identity())
}

/// The gyro of a vehicle that stands measures its bias, and the turning of the Earth.
///
/// `period`: between samples, s.
pub(crate) fn resting_gyro(belief: &Belief, rules: &Rules, rate: &Vector3<f64>, period: f64) -> Innovation<3> {
    let turning = belief.map_from_imu.inverse() * rules.earth.rate;
    let white = rules.noise.gyro_noise * rules.noise.gyro_noise / period;
    let noise = Matrix3::identity() * (white + STANDING_RATE * STANDING_RATE);
    Innovation::new(rate - turning - belief.gyro_bias, noise).with(GYRO_BIAS, &Matrix3::identity())
}

/// A vehicle that stands does not turn; without a gyro its turn rate is in the states of the gyro bias.
pub(crate) fn standing_turn(belief: &Belief) -> Innovation<3> {
    let noise = Matrix3::identity() * (STANDING_TURN * STANDING_TURN);
    Innovation::new(-belief.gyro_bias, noise).with(GYRO_BIAS, &Matrix3::identity())
}

/// A scan's pose against a belief: six numbers, in the order of its covariance.
pub(crate) fn scan_pose(belief: &Belief, rules: &Rules, scan: &LocalScan) -> Innovation<6> {
    let rotation = belief.map_from_imu.to_rotation_matrix().into_inner();
    let body_in_imu = rules.imu_from_body.translation.vector;
    let origin = belief.position + belief.map_from_imu * body_in_imu;
    let map_from_body = belief.map_from_imu * rules.imu_from_body.rotation;
    let turn = vector_of(&(scan.map_from_body.rotation * map_from_body.inverse()));
    let mut residual = Vector6::zeros();
    residual
        .fixed_rows_mut::<3>(0)
        .copy_from(&(scan.map_from_body.translation.vector - origin));
    residual.fixed_rows_mut::<3>(3).copy_from(&turn);
    let mut noise = scan.covariance;
    if !rules.scan.tilt {
        residual[3] = 0.0;
        residual[4] = 0.0;
        noise[(3, 3)] += UNUSED_TILT;
        noise[(4, 4)] += UNUSED_TILT;
    }
    let mut attitude = SMatrix::<f64, 6, 3>::zeros();
    attitude
        .fixed_rows_mut::<3>(0)
        .copy_from(&-(rotation * body_in_imu.cross_matrix()));
    attitude.fixed_rows_mut::<3>(3).copy_from(&rotation);
    Innovation::new(residual, noise)
        .with(POSITION, &SMatrix::<f64, 6, 3>::identity())
        .with(ATTITUDE, &attitude)
}

#[cfg(test)]
mod tests {
    use realo_geodesy::{Geodetic, LocalFrame};

    use super::*;
    use crate::{Settings, Unit};

    #[test]
    fn what_a_receiver_reports_beyond_its_unit_counts_once_in_a_multipath_period() {
        let rules = Rules::new(Settings::new(
            Unit::Consumer,
            LocalFrame::new(Geodetic::default()).unwrap(),
        ));
        let own = rules.noise.gnss[0] * rules.noise.gnss[0];
        let share = rules.noise.gnss_wander_share;
        let lasts = 2.0 * rules.noise.gnss_multipath_s;
        // Reported variance beside the unit's, interval of fixes; wandering variance, and the rest.
        for (times, since, wanders, rest) in [
            (1.0, Some(0.1), share, 1.0 - share),
            (0.25, Some(0.1), 0.25 * share, 0.25 * (1.0 - share)),
            (4.0, Some(0.1), share, 1.0 - share + 3.0 * lasts / 0.1),
            (4.0, Some(1.0), share, 1.0 - share + 3.0 * lasts),
            (4.0, Some(60.0), share, 1.0 - share + 3.0),
            (4.0, None, share, 1.0 - share + 3.0),
        ] {
            let fix = LocalFix {
                position: Vector3::zeros(),
                variance: Vector3::from(rules.noise.gnss.map(|sigma| times * sigma * sigma)),
                has_height: true,
                since_s: since,
            };
            let [wander, white] = fix.split(&rules);
            let found = [wander.x * wander.x / own, white.x / own];
            let off = (found[0] - wanders).abs().max((found[1] - rest).abs());
            assert!(off < 1e-9 * rest.max(1.0), "{times} {since:?}: {found:?}");
        }
    }
}
