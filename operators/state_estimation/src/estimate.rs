use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3, Vector6};
use realo_schemas::Nanos;

use crate::belief::{ATTITUDE, Belief, POSITION, vector_of};
use crate::rules::Rules;

/// Whether an estimate can be relied on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// Not known yet; the position may be, the heading is not.
    Init,
    /// Absolute positions correct it.
    Tracking,
    /// Carried on by IMU and wheels alone.
    DeadReckoning,
    /// Not known any more, or too uncertain to be used.
    Lost,
}

impl Status {
    /// Its name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Status::Init => "init",
            Status::Tracking => "tracking",
            Status::DeadReckoning => "dead_reckoning",
            Status::Lost => "lost",
        }
    }
}

/// Where an agent is and how it moves.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// When.
    pub stamp: Nanos,
    /// The body's pose, roll and pitch included.
    pub map_from_body: Isometry3<f64>,
    /// Covariance over x, y, z of the body's origin (m²) and small turns about the axes of `map` through it (rad²).
    pub covariance: Matrix6<f64>,
    /// Velocity of the body's origin in `map`, m/s.
    pub velocity: Vector3<f64>,
    /// Angular rate in the body frame, rad/s, where a gyro says it.
    pub angular_rate: Option<Vector3<f64>>,
    /// Whether it can be relied on.
    pub status: Status,
}

impl Estimate {
    /// The estimate of a belief; `rate`: of the gyro as measured, rad/s.
    pub(crate) fn of(belief: &Belief, rate: Option<Vector3<f64>>, stamp: Nanos, status: Status, rules: &Rules) -> Self {
        let rotation = belief.map_from_imu.to_rotation_matrix().into_inner();
        let lever = rules.imu_from_body.translation.vector;
        let map_from_imu = Isometry3::from_parts(belief.position.into(), belief.map_from_imu);
        let rate = rate.map(|rate| rate - belief.gyro_bias - belief.map_from_imu.inverse() * rules.earth.rate);
        let turning = rate.unwrap_or_else(Vector3::zeros);
        Estimate {
            stamp,
            map_from_body: map_from_imu * rules.imu_from_body,
            covariance: pose_covariance(belief, &rotation, &lever),
            velocity: belief.velocity + rotation * turning.cross(&lever),
            angular_rate: rate.map(|rate| rules.body_from_imu.rotation * rate),
            status,
        }
    }

    /// Horizontal standard deviation, m: the root of the sum of both variances.
    pub fn position_sigma(&self) -> f64 {
        (self.covariance[(0, 0)] + self.covariance[(1, 1)]).sqrt()
    }

    /// Standard deviation of the heading, rad.
    pub fn heading_sigma(&self) -> f64 {
        self.covariance[(5, 5)].sqrt()
    }

    /// What is wrong with it where the truth is known: what has to be added to the position, m, and the turn about the axes of
    /// `map`, rad.
    pub fn error(&self, truth: &Isometry3<f64>) -> Vector6<f64> {
        let shift = truth.translation.vector - self.map_from_body.translation.vector;
        let turn = vector_of(&(truth.rotation * self.map_from_body.rotation.inverse()));
        Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
    }

    /// Normalised error squared (NEES) over x, y, z and the heading: χ² with four degrees of freedom where the covariance is
    /// right. Roll and pitch are left out, because a levelled truth does not have them.
    ///
    /// `None` for a covariance that cannot be inverted.
    pub fn nees(&self, truth: &Isometry3<f64>) -> Option<f64> {
        let kept = [0, 1, 2, 5];
        let error = self.error(truth);
        let error = nalgebra::Vector4::from(kept.map(|row| error[row]));
        let covariance = nalgebra::Matrix4::from_fn(|row, column| self.covariance[(kept[row], kept[column])]);
        let factor = covariance.cholesky()?;
        Some(error.dot(&factor.solve(&error)))
    }
}

/// The covariance of the pose of a point that is `lever` from the IMU, in the order of [`Estimate::covariance`].
fn pose_covariance(belief: &Belief, rotation: &Matrix3<f64>, lever: &Vector3<f64>) -> Matrix6<f64> {
    let block = |row, column| belief.covariance.fixed_view::<3, 3>(row, column).into_owned();
    let mut inner = Matrix6::zeros();
    for (to_row, row) in [(0, POSITION), (3, ATTITUDE)] {
        for (to_column, column) in [(0, POSITION), (3, ATTITUDE)] {
            inner
                .fixed_view_mut::<3, 3>(to_row, to_column)
                .copy_from(&block(row, column));
        }
    }
    let mut change = Matrix6::identity();
    change
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-(rotation * lever.cross_matrix()));
    change.fixed_view_mut::<3, 3>(3, 3).copy_from(rotation);
    let outer = change * inner * change.transpose();
    0.5 * (outer + outer.transpose())
}
