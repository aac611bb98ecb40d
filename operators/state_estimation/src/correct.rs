//! How a measurement corrects a belief, and when it is refused.

use nalgebra::{SMatrix, SVector};

use crate::belief::{Belief, Covariance, STATES};

/// 99.9 % of χ² by degrees of freedom, from 1.
const CHI_SQUARE_999: [f64; 6] = [10.828, 13.816, 16.266, 18.467, 20.515, 22.458];

/// A measurement of `M` numbers against what is believed.
#[derive(Clone, Debug)]
pub(crate) struct Innovation<const M: usize> {
    /// Measured minus expected.
    pub residual: SVector<f64, M>,
    /// What each error of the state adds to the measured numbers.
    pub model: SMatrix<f64, M, STATES>,
    /// Covariance of the measurement's own noise.
    pub noise: SMatrix<f64, M, M>,
}

/// What became of a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// It corrected the belief.
    Used,
    /// It is farther off than chance allows.
    Gated,
    /// Its covariance cannot be inverted.
    Numerical,
}

impl<const M: usize> Innovation<M> {
    /// An innovation whose model is yet to be filled.
    pub fn new(residual: SVector<f64, M>, noise: SMatrix<f64, M, M>) -> Self {
        Innovation {
            residual,
            model: SMatrix::zeros(),
            noise,
        }
    }

    /// Sets the part of the model from a state's row on.
    pub fn with<const K: usize>(mut self, state: usize, block: &SMatrix<f64, M, K>) -> Self {
        self.model.fixed_view_mut::<M, K>(0, state).copy_from(block);
        self
    }
}

impl Belief {
    /// Corrects the belief by a measurement (Kalman, with the covariance in Joseph's form), unless chance would bring one so
    /// far off in less than one of 1,000 cases.
    pub fn correct<const M: usize>(&mut self, innovation: &Innovation<M>) -> Outcome {
        let Innovation { residual, model, noise } = innovation;
        let seen = self.covariance * model.transpose();
        let spread = model * seen + noise;
        let Some(spread) = (0.5 * (spread + spread.transpose())).cholesky() else {
            return Outcome::Numerical;
        };
        let inverse = spread.inverse();
        // NaN is not within.
        let distance = (residual.transpose() * inverse * residual)[0];
        let is_within = distance <= CHI_SQUARE_999[M - 1];
        if !is_within {
            return Outcome::Gated;
        }
        let gain = seen * inverse;
        let rest = Covariance::identity() - gain * model;
        self.covariance = rest * self.covariance * rest.transpose() + gain * noise * gain.transpose();
        self.inject(&(gain * residual));
        Outcome::Used
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Matrix1, Matrix2, UnitQuaternion, Vector1, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::belief::{ATTITUDE, Errors, POSITION, VELOCITY};

    fn belief() -> Belief {
        let mut belief = Belief::at(&Isometry3::identity(), Vector3::zeros());
        belief.covariance.fill_with_identity();
        belief
    }

    fn position(x: f64, variance: f64) -> Innovation<1> {
        let mut innovation = Innovation::new(Vector1::new(x), Matrix1::new(variance));
        innovation.model[POSITION] = 1.0;
        innovation
    }

    #[test]
    fn a_measurement_and_the_belief_meet_by_their_variances() {
        let mut belief = belief();
        assert_eq!(belief.correct(&position(1.0, 3.0)), Outcome::Used);
        assert!((belief.position.x - 0.25).abs() < 1e-12);
        assert!((belief.covariance[(POSITION, POSITION)] - 0.75).abs() < 1e-12);
        assert_eq!(belief.covariance[(VELOCITY, VELOCITY)], 1.0);
    }

    #[test]
    fn what_is_far_off_changes_nothing() {
        let (mut first, second) = (belief(), belief());
        // Variance 1 + 3, so 2 m are one standard deviation; the gate is at 3.29 of them.
        assert_eq!(first.correct(&position(6.59, 3.0)), Outcome::Gated);
        assert_eq!(first.correct(&position(f64::NAN, 3.0)), Outcome::Gated);
        assert_eq!(first.correct(&position(1.0, -2.0)), Outcome::Numerical);
        assert_eq!(first.correct(&position(1.0, f64::NAN)), Outcome::Numerical);
        assert_eq!(first, second);
        assert_eq!(first.correct(&position(6.57, 3.0)), Outcome::Used);
    }

    /// A vehicle that drives straight on with a heading known to 5°, wrong by 8°: positions 2 m apart tell it, each to 0.65 m. Its speed
    /// alone, which no heading changes, tells nothing of it.
    #[test]
    fn speeds_tell_nothing_of_a_heading_that_is_corrected() {
        let sigma = 5f64.to_radians();
        let wrong = UnitQuaternion::from_scaled_axis(Vector3::z() * -8f64.to_radians());
        let mut belief = Belief::at(
            &Isometry3::from_parts(Default::default(), wrong),
            wrong * Vector3::x() * 8.0,
        );
        belief.covariance.fill_diagonal(1e-6);
        let mut heading = Errors::zeros();
        heading[ATTITUDE + 2] = sigma;
        heading
            .fixed_rows_mut::<3>(VELOCITY)
            .copy_from(&(Vector3::z().cross(&belief.velocity) * sigma));
        belief.widen(&heading);
        let heading_sigma = |belief: &Belief| belief.covariance[(ATTITUDE + 2, ATTITUDE + 2)].sqrt();
        // The error of the position grows with that of the velocity.
        let mut drive = Covariance::identity();
        drive.fixed_view_mut::<3, 3>(POSITION, VELOCITY).fill_diagonal(0.25);
        for step in 1..=12 {
            belief.position += belief.velocity * 0.25;
            belief.covariance = drive * belief.covariance * drive.transpose();
            let at = Vector3::x() * (2.0 * f64::from(step));
            let mut fix = Innovation::new((at - belief.position).xy(), Matrix2::identity() * 0.42);
            fix.model.fixed_view_mut::<2, 2>(0, POSITION).fill_with_identity();
            assert_eq!(belief.correct(&fix), Outcome::Used);
            let before = heading_sigma(&belief);
            for _ in 0..12 {
                let forward = belief.map_from_imu.inverse() * belief.velocity;
                let mut speed = Innovation::new(Vector1::new(8.0 - forward.x), Matrix1::new(9e-4));
                let by_velocity = belief.map_from_imu.inverse().to_rotation_matrix().into_inner();
                speed = speed
                    .with(VELOCITY, &by_velocity.row(0).into_owned())
                    .with(ATTITUDE, &forward.cross_matrix().row(0).into_owned());
                assert_eq!(belief.correct(&speed), Outcome::Used);
            }
            assert!(
                heading_sigma(&belief) > 0.98 * before,
                "{step}: {} of {before}",
                heading_sigma(&belief)
            );
        }
        let error = belief.map_from_imu.euler_angles().2;
        assert!(
            error.abs() < 2.0 * heading_sigma(&belief),
            "{error} {}",
            heading_sigma(&belief)
        );
    }

    proptest! {
        /// Whatever is measured, with whatever noise: the covariance has a Cholesky factor afterwards.
        #[test]
        fn covariances_stay_positive(
            columns in prop::collection::vec((0..STATES, -10.0..10.0f64), 1..40),
            rows in prop::collection::vec((0..STATES, 0..STATES, -5.0..5.0f64, -9..=3i32), 1..60),
        ) {
            let mut belief = belief();
            belief.covariance *= 1e-6;
            for (state, size) in columns {
                let mut column = Errors::zeros();
                column[state] = size;
                column[(state + 7) % STATES] = 0.5 * size;
                belief.widen(&column);
            }
            for (first, second, share, exponent) in rows {
                let mut innovation = Innovation::new(Vector1::new(0.0), Matrix1::new(10f64.powi(exponent)));
                innovation.model[first] = 1.0;
                innovation.model[second] += share;
                prop_assert_eq!(belief.correct(&innovation), Outcome::Used);
                prop_assert!(belief.is_sound());
                // By the smallest eigenvalue against the largest: rounding leaves at most so much below 0.
                let values = belief.covariance.symmetric_eigenvalues();
                prop_assert!(values.min() > -1e-12 * values.max(), "{}", values);
            }
        }
    }
}
