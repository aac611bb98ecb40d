//! How a belief moves on in time: strapdown integration of the IMU, or nothing but inertia.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use crate::belief::turned;
use crate::belief::{
    ACCEL_BIAS, ATTITUDE, Belief, Covariance, GYRO_BIAS, HeldBias, POSITION, SCALE, VELOCITY, WANDER, quaternion_of,
};
use crate::{Earth, UnitNoise};

/// Accelerations of a vehicle whose IMU is silent, as white noise, m/s²/√Hz.
const COAST_ACCELERATION: f64 = 3.0;
/// Angular rates of such a vehicle about its axes, rad/s, and how long it turns the same way, s: bends of a quarter in 4 s are usual.
const COAST_RATE: [f64; 3] = [0.05, 0.05, 0.4];
const COAST_TURNING_S: f64 = 4.0;
/// What is not of one bend, as white noise, rad/s/√Hz.
const COAST_SWAY: f64 = 0.02;
/// Time over which a vehicle turns the same way, s: so long an error of the gyro's scale adds up.
const TURNING_S: f64 = 4.0;
/// How the wheels' scale walks, 1/√s.
const SCALE_WALK: f64 = 2e-5;

/// What the IMU integrated over a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Increment {
    /// Angular rate, rad.
    pub turn: Vector3<f64>,
    /// Specific force, m/s.
    pub push: Vector3<f64>,
    /// Variances of the turn and the push, rad² and m²/s²: of what happens between two samples, about the IMU's axes.
    pub spread: [Vector3<f64>; 2],
}

impl Belief {
    /// Moves on by `dt` seconds with what the IMU integrated over them.
    pub fn strapdown(&mut self, increment: &Increment, dt: f64, noise: &UnitNoise, earth: &Earth) {
        self.hear();
        let imu_from_map = self.map_from_imu.inverse();
        let turn = increment.turn - self.gyro_bias * dt - imu_from_map * (earth.rate * dt);
        let push = increment.push - self.accel_bias * dt;
        // In the attitude of the middle of the time.
        let middle = turned(&self.map_from_imu, &(0.5 * turn));
        let rotation = middle.to_rotation_matrix().into_inner();
        let gravity = Vector3::new(0.0, 0.0, -earth.gravity) - 2.0 * earth.rate.cross(&self.velocity);
        let gain = rotation * push + gravity * dt;
        self.position += self.velocity * dt + gain * (0.5 * dt);
        self.velocity += gain;
        self.map_from_imu = turned(&self.map_from_imu, &turn);

        let mut step = self.still(dt);
        // What a wrong attitude at the start does to the velocity.
        let start = imu_from_map.inverse().to_rotation_matrix().into_inner();
        let lean = -(start * (imu_from_map * (rotation * push)).cross_matrix());
        set(&mut step, VELOCITY, ATTITUDE, &lean);
        set(&mut step, POSITION, ATTITUDE, &(lean * (0.5 * dt)));
        set(&mut step, VELOCITY, GYRO_BIAS, &(lean * (-0.5 * dt)));
        set(&mut step, VELOCITY, ACCEL_BIAS, &(rotation * -dt));
        set(&mut step, POSITION, ACCEL_BIAS, &(rotation * (-0.5 * dt * dt)));
        let back = turned(&nalgebra::UnitQuaternion::identity(), &-turn);
        set(&mut step, ATTITUDE, ATTITUDE, &back.to_rotation_matrix().into_inner());
        set(&mut step, ATTITUDE, GYRO_BIAS, &(Matrix3::identity() * -dt));
        self.carry(&step, dt, [noise.accel_noise, noise.gyro_noise], noise);
        let [mut turning, pushing] = increment.spread;
        if dt > 0.0 {
            turning += turn.map(|turn| noise.gyro_scale * noise.gyro_scale * turn * turn * TURNING_S / dt);
        }
        let pushing = rotation * Matrix3::from_diagonal(&pushing) * rotation.transpose();
        for (state, spread) in [(ATTITUDE, Matrix3::from_diagonal(&turning)), (VELOCITY, pushing)] {
            let mut block = self.covariance.fixed_view_mut::<3, 3>(state, state);
            block += 0.5 * (spread + spread.transpose());
        }
    }

    /// Moves on by `dt` seconds without an IMU: as fast as before, and round a bend that nobody measures. Its rate takes the states of the
    /// gyro's bias as a process of first order (their negative is the rate), so that positions and wheels show it, and it turns heading and
    /// velocity alike. `rate`: the last one that the IMU measured, rad/s.
    pub fn coast(
        &mut self,
        dt: f64,
        rate: Option<Vector3<f64>>,
        imu_from_body: &UnitQuaternion<f64>,
        noise: &UnitNoise,
    ) {
        let axes = imu_from_body.to_rotation_matrix().into_inner();
        let rates =
            axes * Matrix3::from_diagonal(&Vector3::from(COAST_RATE).map(|rate| rate * rate)) * axes.transpose();
        if self.coasting.is_none() {
            let bias = self.gyro_bias;
            let covariance = self.replace(GYRO_BIAS, &rates);
            self.coasting = Some(HeldBias { bias, covariance });
            self.gyro_bias = rate.map_or_else(Vector3::zeros, |rate| bias - rate);
        }
        let turn = -self.gyro_bias * dt;
        let rotation = self.map_from_imu.to_rotation_matrix().into_inner();
        let bend = UnitQuaternion::new_normalize(quaternion_of(&(rotation * turn)));
        let (before, after) = (self.velocity, bend * self.velocity);
        self.position += (before + after) * (0.5 * dt);
        self.velocity = after;
        self.map_from_imu = turned(&self.map_from_imu, &turn);

        let keep = libm::exp(-dt / COAST_TURNING_S);
        self.gyro_bias *= keep;
        let mut step = self.still(dt);
        let by_rate = before.cross_matrix() * rotation * dt;
        set(&mut step, VELOCITY, VELOCITY, bend.to_rotation_matrix().matrix());
        set(&mut step, VELOCITY, GYRO_BIAS, &by_rate);
        set(&mut step, POSITION, GYRO_BIAS, &(by_rate * (0.5 * dt)));
        let back = UnitQuaternion::new_normalize(quaternion_of(&-turn));
        set(&mut step, ATTITUDE, ATTITUDE, back.to_rotation_matrix().matrix());
        set(&mut step, ATTITUDE, GYRO_BIAS, &(Matrix3::identity() * -dt));
        set(&mut step, GYRO_BIAS, GYRO_BIAS, &(Matrix3::identity() * keep));
        self.carry(&step, dt, [COAST_ACCELERATION, COAST_SWAY], noise);
        let mut block = self.covariance.fixed_view_mut::<3, 3>(GYRO_BIAS, GYRO_BIAS);
        block += rates * (1.0 - keep * keep);
        if let Some(held) = &mut self.coasting {
            let walked = noise.gyro_bias_in_run * noise.gyro_bias_in_run * 2.0 / noise.bias_s * dt;
            held.covariance += Matrix3::identity() * walked;
        }
    }

    /// The IMU measures again: the states of the gyro's bias are its own.
    pub fn hear(&mut self) {
        if let Some(HeldBias { bias, covariance }) = self.coasting.take() {
            self.gyro_bias = bias;
            self.replace(GYRO_BIAS, &covariance);
        }
    }

    /// How errors grow by the velocity alone.
    fn still(&self, dt: f64) -> Covariance {
        let mut step = Covariance::identity();
        set(&mut step, POSITION, VELOCITY, &(Matrix3::identity() * dt));
        step
    }

    /// Carries the covariance by a step's Jacobian, and what wanders, walks and is noise.
    fn carry(&mut self, step: &Covariance, dt: f64, [force, rate]: [f64; 2], noise: &UnitNoise) {
        let mut step = *step;
        let decay = libm::exp(-dt / noise.gnss_wander_s);
        set(&mut step, WANDER, WANDER, &(Matrix3::identity() * decay));
        self.wander *= decay;
        self.covariance = step * self.covariance * step.transpose();
        let bias = |in_run: f64| in_run * in_run * 2.0 / noise.bias_s * dt;
        for axis in 0..3 {
            let mut add = |row: usize, variance: f64| self.covariance[(row + axis, row + axis)] += variance;
            add(VELOCITY, force * force * dt);
            add(POSITION, force * force * dt * dt * dt / 3.0);
            add(ATTITUDE, rate * rate * dt);
            add(GYRO_BIAS, bias(noise.gyro_bias_in_run));
            add(ACCEL_BIAS, bias(noise.accel_bias_in_run));
            add(WANDER, 1.0 - decay * decay);
            let cross = 0.5 * force * force * dt * dt;
            self.covariance[(POSITION + axis, VELOCITY + axis)] += cross;
            self.covariance[(VELOCITY + axis, POSITION + axis)] += cross;
        }
        self.covariance[(SCALE, SCALE)] += SCALE_WALK * SCALE_WALK * dt;
        self.symmetrize();
    }
}

fn set(step: &mut Covariance, row: usize, column: usize, block: &Matrix3<f64>) {
    step.fixed_view_mut::<3, 3>(row, column).copy_from(block);
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;
    use crate::Unit;
    use crate::belief::{Errors, quaternion_of, vector_of};

    fn belief() -> Belief {
        let mut belief = Belief::at(&Isometry3::translation(5.0, -3.0, 1.0), Vector3::new(8.0, 0.0, 0.0));
        belief.covariance.fill_with_identity();
        belief.covariance *= 1e-4;
        belief
    }

    /// Round a circle of 40 m at 8 m/s: after 2π·40/8 s the vehicle is where it was.
    #[test]
    fn a_circle_closes() {
        let (noise, earth) = (Unit::Tactical.noise(), Earth::SIMULATED);
        let mut moving = belief();
        let steps = 3_142;
        let dt = std::f64::consts::TAU * 40.0 / 8.0 / f64::from(steps);
        let increment = Increment {
            turn: Vector3::new(0.0, 0.0, 0.2) * dt,
            push: Vector3::new(0.0, 1.6, earth.gravity) * dt,
            spread: [Vector3::zeros(); 2],
        };
        for _ in 0..steps {
            moving.strapdown(&increment, dt, &noise, &earth);
        }
        assert!(
            (moving.position - belief().position).norm() < 1e-3,
            "{}",
            moving.position
        );
        assert!((moving.velocity - belief().velocity).norm() < 1e-6);
        assert!(moving.is_sound() && moving.covariance.cholesky().is_some());
    }

    /// The Jacobian by differences: a state that is a little off before the step is off by the Jacobian's product after it.
    #[test]
    fn errors_grow_as_the_jacobian_says() {
        let (noise, earth) = (Unit::Tactical.noise(), Earth::SIMULATED);
        let dt = 0.01;
        let increment = Increment {
            turn: Vector3::new(0.02, -0.01, 0.05),
            push: Vector3::new(0.03, 0.02, 0.1),
            spread: [Vector3::zeros(); 2],
        };
        let after = |errors: &Errors| {
            let mut moved = belief();
            moved.inject(errors);
            moved.strapdown(&increment, dt, &noise, &earth);
            moved
        };
        let plain = after(&Errors::zeros());
        for state in 0..WANDER {
            let size = 1e-5;
            let mut errors = Errors::zeros();
            errors[state] = size;
            let off = after(&errors);
            let mut column = Errors::zeros();
            let turn = vector_of(&(plain.map_from_imu.inverse() * off.map_from_imu));
            let parts = [
                (POSITION, off.position - plain.position),
                (VELOCITY, off.velocity - plain.velocity),
                (ATTITUDE, turn),
                (GYRO_BIAS, off.gyro_bias - plain.gyro_bias),
                (ACCEL_BIAS, off.accel_bias - plain.accel_bias),
            ];
            for (row, part) in parts {
                column.fixed_rows_mut::<3>(row).copy_from(&(part / size));
            }
            // A covariance of one state alone shows its column of the Jacobian.
            let mut only = belief();
            only.covariance.fill(0.0);
            only.covariance[(state, state)] = 1.0;
            only.strapdown(&increment, dt, &noiseless(&noise), &earth);
            for row in 0..WANDER {
                let found = only.covariance[(row, row)].sqrt();
                assert!(
                    (found - column[row].abs()).abs() < 3e-4,
                    "state {state}, row {row}: {found}, by differences {}",
                    column[row]
                );
            }
        }
    }

    fn noiseless(noise: &UnitNoise) -> UnitNoise {
        UnitNoise {
            gyro_noise: 0.0,
            accel_noise: 0.0,
            gyro_bias_in_run: 0.0,
            accel_bias_in_run: 0.0,
            gyro_scale: 0.0,
            ..*noise
        }
    }

    /// Without an IMU through a bend at one rate: heading, velocity and place are off by what the covariance says, all of the same bend.
    #[test]
    fn a_bend_that_nobody_measures_is_within_what_is_said() {
        let noise = Unit::Tactical.noise();
        let (rate, speed) = (0.39, 8.0);
        for seconds in [0.5, 1.0, 2.0, 4.0] {
            let mut moving = belief();
            for _ in 0..(seconds / 0.05) as u32 {
                moving.coast(0.05, None, &UnitQuaternion::identity(), &noise);
            }
            let turn: f64 = rate * seconds;
            let deviation = |state: usize| moving.covariance[(state, state)].sqrt();
            assert!(
                turn < 1.2 * deviation(ATTITUDE + 2),
                "{seconds} s: {}",
                deviation(ATTITUDE + 2)
            );
            assert!(speed * turn.sin() < 1.3 * deviation(VELOCITY + 1), "{seconds} s");
            let aside = speed / rate * (1.0 - turn.cos());
            assert!(aside < 1.3 * deviation(POSITION + 1), "{seconds} s: {aside}");
            // A heading that is off goes with a velocity that is turned as far.
            let both =
                moving.covariance[(ATTITUDE + 2, VELOCITY + 1)] / deviation(ATTITUDE + 2) / deviation(VELOCITY + 1);
            assert!(both > if seconds < 1.0 { 0.3 } else { 0.6 }, "{seconds} s: {both}");
        }
    }

    /// The last rate is the best guess of the next; then the bias is what it was.
    #[test]
    fn the_last_rate_goes_on_and_the_bias_comes_back() {
        let noise = Unit::Tactical.noise();
        let mut moving = belief();
        moving.gyro_bias = Vector3::new(0.0, 0.0, 0.01);
        let before = moving.clone();
        for _ in 0..4 {
            moving.coast(0.05, Some(Vector3::z() * 0.31), &UnitQuaternion::identity(), &noise);
        }
        let heading = vector_of(&moving.map_from_imu).z;
        assert!((0.055..0.06).contains(&heading), "{heading}");
        assert!((moving.velocity.y / moving.velocity.x - heading.tan()).abs() < 1e-9);
        moving.hear();
        assert_eq!((moving.gyro_bias, moving.coasting.is_none()), (before.gyro_bias, true));
        let variance = |belief: &Belief| belief.covariance[(GYRO_BIAS + 2, GYRO_BIAS + 2)];
        assert!((variance(&moving) / variance(&before) - 1.0).abs() < 1e-3);
        assert!(moving.is_sound() && moving.covariance.cholesky().is_some());
    }

    #[test]
    fn quaternions_of_small_turns_are_whole() {
        for size in [0.0, 1e-12, 1e-5, 1e-4, 2e-4, 1.0] {
            let q = quaternion_of(&Vector3::new(size, 0.0, 0.0));
            assert!((q.norm() - 1.0).abs() < 1e-15, "{size}: {q}");
        }
    }
}
