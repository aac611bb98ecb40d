//! How one object moves.

use nalgebra::{Matrix2, Matrix2x5, Matrix5, RowVector5, Vector2, Vector5};

/// How sure the filter is of what it is told, and of how objects move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Standard deviation of a box's centre along x and y, m.
    pub position_m: f64,
    /// Standard deviation of a box's heading, rad.
    pub heading_rad: f64,
    /// Standard deviation along x and y of a velocity that a box brings, m/s.
    pub velocity_mps: f64,
    /// Standard deviation of an object's speed along its heading before anything is known of it, m/s.
    pub speed_mps: f64,
    /// Standard deviation of what a velocity changes within 1 s, m/s.
    pub acceleration_mps: f64,
    /// Standard deviation of what a turn rate changes within 1 s, rad/s.
    pub turn_rps: f64,
}

/// An object that keeps its speed and turn rate, on the ground plane of `map`: x, y (m), velocity along x and y (m/s), turn
/// rate (rad/s), and the covariance of the five.
///
/// The coordinated turn with Cartesian velocity (Bar-Shalom, Li and Kirubarajan 2001, 11.7.1) in an extended Kalman filter.
/// A long box moves along its heading, forwards or backwards, so its heading is a measurement of the velocity across it.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    state: Vector5<f64>,
    covariance: Matrix5<f64>,
}

/// A box, as the filter takes it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Centre in `map`, m.
    pub center: Vector2<f64>,
    /// Covariance of the centre, m².
    pub covariance: Matrix2<f64>,
    /// Heading in `map`, rad, of a box that moves along it.
    pub heading: Option<f64>,
    /// Velocity in `map`, m/s, where the box brings one.
    pub velocity: Option<Vector2<f64>>,
}

/// Below this turn rate the way is straight, rad/s.
const STRAIGHT: f64 = 1e-4;
/// A turn rate is forgotten within about this time, s.
const TURN_MEMORY_S: f64 = 3.0;
/// Standard deviation of the velocity across a box's heading while it stands, m/s.
const ACROSS_MPS: f64 = 0.2;
/// Standard deviation of a turn rate of which nothing is known, rad/s.
const TURN_RPS: f64 = 0.3;
/// A turn rate that no object has, rad/s.
const MAX_TURN_RPS: f64 = 1.5;
/// A heading or a velocity that contradicts what is known by more standard deviations is a mistake of the detector.
const WRONG: f64 = 3.0;

impl Motion {
    /// An object that was seen once.
    pub fn of(seen: &Seen, noise: &Noise) -> Self {
        let (velocity, speed) = match seen.velocity {
            Some(velocity) => (velocity, noise.velocity_mps),
            None => (Vector2::zeros(), noise.speed_mps),
        };
        let state = Vector5::new(seen.center.x, seen.center.y, velocity.x, velocity.y, 0.0);
        let [velocity, turn] = [speed * speed, TURN_RPS * TURN_RPS];
        let mut covariance = Matrix5::from_diagonal(&Vector5::new(0.0, 0.0, velocity, velocity, turn));
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&seen.covariance);
        let mut motion = Motion { state, covariance };
        motion.follow_heading(seen, noise);
        motion
    }

    /// Where it is, m.
    pub fn position(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(0).into_owned()
    }

    /// Its velocity, m/s.
    pub fn velocity(&self) -> Vector2<f64> {
        self.state.fixed_rows::<2>(2).into_owned()
    }

    /// Its turn rate, rad/s from x to y.
    pub fn turn_rate(&self) -> f64 {
        self.state[4]
    }

    /// Standard deviation of the velocity where it is least known, m/s.
    pub fn velocity_deviation(&self) -> f64 {
        let [a, b, c] = [
            self.covariance[(2, 2)],
            self.covariance[(2, 3)],
            self.covariance[(3, 3)],
        ];
        let (mean, half) = (0.5 * (a + c), 0.5 * (a - c));
        (mean + libm::hypot(half, b)).max(0.0).sqrt()
    }

    /// Moves on by a time, s, ≥ 0.
    pub fn predict(&mut self, dt: f64, noise: &Noise) {
        let turn = self.turn_rate();
        let (moved, mut jacobian) = turned(&self.state, turn, dt);
        let memory = libm::exp(-dt / TURN_MEMORY_S);
        self.state = moved;
        (self.state[4], jacobian[(4, 4)]) = (turn * memory, memory);
        let mut covariance = jacobian * self.covariance * jacobian.transpose();
        let drift = noise.acceleration_mps * noise.acceleration_mps;
        for axis in 0..2 {
            covariance[(axis, axis)] += drift * dt * dt * dt / 3.0;
            covariance[(axis, axis + 2)] += drift * dt * dt / 2.0;
            covariance[(axis + 2, axis)] += drift * dt * dt / 2.0;
            covariance[(axis + 2, axis + 2)] += drift * dt;
        }
        covariance[(4, 4)] += noise.turn_rps * noise.turn_rps * dt;
        self.covariance = symmetric(&covariance);
    }

    /// Distance of a box's centre from where it should be: on the ground, m, and in standard deviations (Mahalanobis).
    pub fn distance(&self, seen: &Seen) -> [f64; 2] {
        let off = seen.center - self.position();
        let spread = self.covariance.fixed_view::<2, 2>(0, 0) + seen.covariance;
        [libm::hypot(off.x, off.y), deviations(&off, &spread)]
    }

    /// Corrects it by a box.
    pub fn correct(&mut self, seen: &Seen, noise: &Noise) {
        self.measure(0, &seen.center, &seen.covariance);
        self.follow_heading(seen, noise);
        if let Some(velocity) = seen.velocity {
            let covariance = Matrix2::identity() * (noise.velocity_mps * noise.velocity_mps);
            let spread = self.covariance.fixed_view::<2, 2>(2, 2) + covariance;
            if deviations(&(velocity - self.velocity()), &spread) <= WRONG {
                self.measure(2, &velocity, &covariance);
            }
        }
        self.state[4] = self.state[4].clamp(-MAX_TURN_RPS, MAX_TURN_RPS);
    }

    /// Corrects it by a measurement of the state's two numbers from `at` on.
    fn measure(&mut self, at: usize, found: &Vector2<f64>, noise: &Matrix2<f64>) {
        let mut measures = Matrix2x5::zeros();
        (measures[(0, at)], measures[(1, at + 1)]) = (1.0, 1.0);
        let spread = measures * self.covariance * measures.transpose() + noise;
        // A sum of a covariance and one that is positive has an inverse.
        let Some(inverse) = spread.try_inverse() else { return };
        let gain = self.covariance * measures.transpose() * inverse;
        self.state += gain * (found - measures * self.state);
        let rest = Matrix5::identity() - gain * measures;
        // Joseph's form stays positive where rounding would not.
        let covariance = rest * self.covariance * rest.transpose() + gain * noise * gain.transpose();
        self.covariance = symmetric(&covariance);
    }

    /// Takes it that the object does not move across its heading.
    fn follow_heading(&mut self, seen: &Seen, noise: &Noise) {
        let Some(heading) = seen.heading else { return };
        let (sin, cos) = libm::sincos(heading);
        let across = RowVector5::new(0.0, 0.0, -sin, cos, 0.0);
        let velocity = self.velocity();
        let by_heading = noise.heading_rad * libm::hypot(velocity.x, velocity.y);
        let variance = ACROSS_MPS * ACROSS_MPS + by_heading * by_heading;
        let spread = (across * self.covariance * across.transpose())[0] + variance;
        let found = (across * self.state)[0];
        if found * found > WRONG * WRONG * spread {
            return;
        }
        let gain = self.covariance * across.transpose() / spread;
        self.state -= gain * found;
        let rest = Matrix5::identity() - gain * across;
        let covariance = rest * self.covariance * rest.transpose() + gain * gain.transpose() * variance;
        self.covariance = symmetric(&covariance);
    }
}

/// Size of a vector in standard deviations of a covariance (Mahalanobis).
fn deviations(off: &Vector2<f64>, spread: &Matrix2<f64>) -> f64 {
    let [a, b, c] = [spread[(0, 0)], spread[(0, 1)], spread[(1, 1)]];
    let square = (c * off.x * off.x - 2.0 * b * off.x * off.y + a * off.y * off.y) / (a * c - b * b);
    square.max(0.0).sqrt()
}

/// The state after a time of constant speed and turn rate, and its derivative by the state before.
fn turned(state: &Vector5<f64>, turn: f64, dt: f64) -> (Vector5<f64>, Matrix5<f64>) {
    let (sin, cos) = libm::sincos(turn * dt);
    let [vx, vy] = [state[2], state[3]];
    // Of a velocity along x: how far it goes along x and y, and both by the turn rate.
    let [ahead, aside, ahead_by, aside_by] = match turn.abs() < STRAIGHT {
        true => [dt, 0.5 * turn * dt * dt, -turn * dt * dt * dt / 3.0, 0.5 * dt * dt],
        false => {
            let [ahead, aside] = [sin / turn, (1.0 - cos) / turn];
            [ahead, aside, (dt * cos - ahead) / turn, (dt * sin - aside) / turn]
        }
    };
    let velocity = [cos * vx - sin * vy, sin * vx + cos * vy];
    let moved = Vector5::new(
        state[0] + ahead * vx - aside * vy,
        state[1] + aside * vx + ahead * vy,
        velocity[0],
        velocity[1],
        turn,
    );
    #[rustfmt::skip]
    let jacobian = Matrix5::new(
        1.0, 0.0, ahead, -aside, ahead_by * vx - aside_by * vy,
        0.0, 1.0, aside, ahead, aside_by * vx + ahead_by * vy,
        0.0, 0.0, cos, -sin, -dt * velocity[1],
        0.0, 0.0, sin, cos, dt * velocity[0],
        0.0, 0.0, 0.0, 0.0, 1.0,
    );
    (moved, jacobian)
}

fn symmetric(covariance: &Matrix5<f64>) -> Matrix5<f64> {
    0.5 * (covariance + covariance.transpose())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const NOISE: Noise = Noise {
        position_m: 0.2,
        heading_rad: 0.05,
        velocity_mps: 1.0,
        speed_mps: 8.0,
        acceleration_mps: 2.0,
        turn_rps: 0.3,
    };

    fn seen(x: f64, y: f64, heading: Option<f64>) -> Seen {
        Seen {
            center: Vector2::new(x, y),
            covariance: Matrix2::identity() * 0.04,
            heading,
            velocity: None,
        }
    }

    /// Follows a way for some sweeps of 100 ms; what the filter knows at the last.
    fn follow(sweeps: usize, at: impl Fn(f64) -> ([f64; 2], Option<f64>)) -> Motion {
        let of = |index: usize| {
            let ([x, y], heading) = at(0.1 * index as f64);
            seen(x, y, heading)
        };
        let mut motion = Motion::of(&of(0), &NOISE);
        for index in 1..sweeps {
            motion.predict(0.1, &NOISE);
            motion.correct(&of(index), &NOISE);
        }
        motion
    }

    #[test]
    fn a_straight_way_has_the_velocity_that_made_it_whatever_way_the_box_faces() {
        for heading in [0.3, 0.3 + std::f64::consts::PI] {
            let (sin, cos) = libm::sincos(0.3);
            let motion = follow(15, |t| ([1e5 + 12.0 * t * cos, -1e5 + 12.0 * t * sin], Some(heading)));
            let velocity = motion.velocity();
            assert!((velocity - 12.0 * Vector2::new(cos, sin)).norm() < 0.3, "{velocity}");
            assert!(motion.velocity_deviation() < 1.5 && motion.turn_rate().abs() < 0.05);
        }
        let walking = follow(20, |t| ([1.2 * t, 0.0], None));
        assert!((walking.velocity() - Vector2::new(1.2, 0.0)).norm() < 0.1);
    }

    #[test]
    fn a_circle_has_the_turn_rate_that_made_it_and_goes_on_around_it() {
        let (speed, turn) = (8.0, 0.4);
        let on = |t: f64| {
            let (sin, cos) = libm::sincos(turn * t);
            ([speed / turn * sin, speed / turn * (1.0 - cos)], Some(turn * t))
        };
        let mut motion = follow(30, on);
        assert!((motion.turn_rate() - turn).abs() < 0.12, "{}", motion.turn_rate());
        motion.predict(0.5, &NOISE);
        let [x, y] = on(2.9 + 0.5).0;
        let off = (motion.position() - Vector2::new(x, y)).norm();
        assert!(off < 0.35, "{off}");
    }

    #[test]
    fn what_stands_has_no_velocity() {
        // Centres that jitter by 0.2 m.
        let jitter = |t: f64| 0.2 * libm::sin(37.0 * t);
        let motion = follow(30, |t| ([5.0 + jitter(t), jitter(t + 3.0)], Some(0.0)));
        assert!(motion.velocity().norm() < 0.5, "{}", motion.velocity());
    }

    #[test]
    fn a_heading_across_the_way_is_not_believed() {
        let right = |t: f64| ([10.0 * t, 0.0], Some(0.0));
        let wrong = |t: f64| ([10.0 * t, 0.0], Some(if t > 1.45 { 1.5 } else { 0.0 }));
        let [right, wrong] = [follow(16, right), follow(16, wrong)].map(|motion| motion.velocity());
        assert!((right - wrong).norm() < 0.1, "{right} and {wrong}");
    }

    #[test]
    fn distances_are_in_metres_and_in_deviations() {
        let motion = Motion::of(&seen(0.0, 0.0, None), &NOISE);
        let [metres, deviations] = motion.distance(&seen(0.3, -0.4, None));
        assert!((metres - 0.5).abs() < 1e-12 && (deviations - 0.5 / 0.08f64.sqrt()).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn the_derivative_is_that_of_the_motion(
            vx in -20.0..20.0f64, vy in -20.0..20.0f64, turn in prop_oneof![Just(0.0), -1.0..1.0f64], dt in 0.01..0.6f64,
        ) {
            let state = Vector5::new(3.0, -4.0, vx, vy, turn);
            let (_, jacobian) = turned(&state, turn, dt);
            for axis in 0..5 {
                let step = 1e-5;
                let moved = |by: f64| {
                    let mut state = state;
                    state[axis] += by;
                    turned(&state, state[4], dt).0
                };
                let difference = (moved(step) - moved(-step)) / (2.0 * step);
                let expected = jacobian.column(axis);
                prop_assert!((difference - expected).norm() < 2e-3 * (1.0 + expected.norm()), "{} {} {}", axis, difference, expected);
            }
        }

        #[test]
        fn numbers_stay_finite_and_covariances_positive(
            steps in proptest::collection::vec((0.0..0.7f64, -300.0..300.0f64, -300.0..300.0f64, -4.0..4.0f64), 1..60),
        ) {
            let mut motion = Motion::of(&seen(0.0, 0.0, Some(0.0)), &NOISE);
            for (dt, x, y, heading) in steps {
                motion.predict(dt, &NOISE);
                motion.correct(&seen(x, y, Some(heading)), &NOISE);
                prop_assert!(motion.state.iter().chain(motion.covariance.iter()).all(|v| v.is_finite()));
                prop_assert!(motion.covariance.cholesky().is_some(), "{}", motion.covariance);
            }
        }
    }
}
