//! Drives with known truth, and what sensors with the errors of a unit report of them.

use nalgebra::{Isometry3, Matrix6, Quaternion, UnitQuaternion, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use realo_geodesy::{Geodetic, LocalFrame};
use realo_schemas::{Nanos, from_seconds};
use realo_state_estimation::{
    Earth, Estimator, GnssFix, ImuSample, Mounting, Sample, ScanNoise, ScanPose, Settings, Unit, UnitNoise, WheelSpeed,
};

/// Steps of the truth, a second.
const RATE: usize = 1_000;
/// Delay of a scan's pose, s.
const SCAN_DELAY: f64 = 0.3;
/// Standard deviations of a scan's pose: of its own, m and rad.
const SCAN: [f64; 2] = [0.03, 0.0017];

/// A part of a drive: seconds, speed that is aimed at, m/s, and curvature, 1/m.
pub type Part = (f64, f64, f64);

/// Round two blocks with a stop.
pub const LOOP: [Part; 10] = [
    (8.0, 10.0, 0.0),
    (5.0, 6.0, 0.05),
    (8.0, 12.0, 0.0),
    (6.0, 0.0, 0.0),
    (5.0, 0.0, 0.0),
    (6.0, 8.0, 0.0),
    (5.0, 6.0, -0.06),
    (10.0, 13.0, 0.002),
    (4.0, 7.0, 0.05),
    (8.0, 10.0, -0.003),
];

pub struct Truth {
    poses: Vec<Isometry3<f64>>,
    velocities: Vec<Vector3<f64>>,
    speeds: Vec<f64>,
}

impl Truth {
    /// Accelerations are limited to 2 m/s², changes of curvature to 0.05 1/m a second; the road goes up and down by 3 %.
    pub fn of(parts: &[Part]) -> Self {
        let dt = 1.0 / RATE as f64;
        let (mut speed, mut curvature, mut yaw, mut way) = (parts[0].1, 0.0f64, 0.7f64, 0.0f64);
        let mut position = Vector3::new(12.0, -40.0, 3.0);
        let mut truth = Truth {
            poses: Vec::new(),
            velocities: Vec::new(),
            speeds: Vec::new(),
        };
        for (seconds, to_speed, to_curvature) in parts {
            for _ in 0..(seconds * RATE as f64) as usize {
                let before = speed;
                speed += (to_speed - speed).clamp(-2.0 * dt, 2.0 * dt);
                curvature += (to_curvature - curvature).clamp(-0.05 * dt, 0.05 * dt);
                yaw += 0.5 * (before + speed) * curvature * dt;
                way += 0.5 * (before + speed) * dt;
                let pitch = -0.03 * (way / 40.0).sin();
                let rotation = turn(Vector3::z() * yaw) * turn(Vector3::y() * pitch);
                let velocity = rotation * Vector3::new(speed, 0.0, 0.0);
                let last = truth.velocities.last().copied().unwrap_or(velocity);
                position += 0.5 * (last + velocity) * dt;
                truth.poses.push(Isometry3::from_parts(position.into(), rotation));
                truth.velocities.push(velocity);
                truth.speeds.push(speed);
            }
        }
        truth
    }

    pub fn pose(&self, stamp: Nanos) -> &Isometry3<f64> {
        &self.poses[(stamp - START) as usize / (1_000_000_000 / RATE)]
    }

    pub fn velocity(&self, stamp: Nanos) -> &Vector3<f64> {
        &self.velocities[(stamp - START) as usize / (1_000_000_000 / RATE)]
    }
}

/// The stamp of a drive's beginning.
pub const START: Nanos = 1_700_000_000_000_000_000;

fn turn(vector: Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * vector;
    let (sin, cos) = half.norm().sin_cos();
    let share = if half.norm() > 0.0 { sin / half.norm() } else { 0.0 };
    UnitQuaternion::new_normalize(Quaternion::from_parts(cos, half * share))
}

/// Which sensors report.
#[derive(Clone, Copy)]
pub struct Plan {
    pub unit: Unit,
    pub seed: u64,
    pub scans: bool,
    pub wheels: bool,
    /// Whether scans do not show east and west, as along a street of smooth walls: they are off by 5 m there.
    pub street: bool,
    /// Seconds without GNSS.
    pub outage: [f64; 2],
    /// Seconds without scans.
    pub blind: [f64; 2],
}

impl Plan {
    pub fn new(unit: Unit, seed: u64) -> Self {
        Plan {
            unit,
            seed,
            scans: true,
            wheels: true,
            street: false,
            outage: [0.0; 2],
            blind: [0.0; 2],
        }
    }
}

pub fn mounting() -> Mounting {
    Mounting {
        body_from_imu: Isometry3::from_parts(
            Vector3::new(0.4, -0.2, 0.9).into(),
            turn(Vector3::new(0.0, 0.0, std::f64::consts::FRAC_PI_2)),
        ),
        antenna_in_body: Vector3::new(-0.3, 0.1, 1.6),
        axle_in_body: Vector3::zeros(),
    }
}

pub fn settings(unit: Unit) -> Settings {
    let origin = Geodetic {
        latitude_deg: 48.137,
        longitude_deg: 11.575,
        height_m: 519.0,
    };
    Settings {
        mounting: mounting(),
        scan: ScanNoise {
            position_m: 0.02,
            turn_rad: 0.001,
            factor: 1.0,
            tilt: false,
        },
        ..Settings::new(unit, LocalFrame::new(origin).unwrap())
    }
}

pub struct Draws(ChaCha8Rng);

impl Draws {
    pub fn new(seed: u64) -> Self {
        Draws(ChaCha8Rng::seed_from_u64(seed))
    }

    fn uniform(&mut self) -> f64 {
        ((self.0.next_u64() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }

    pub fn normal(&mut self) -> f64 {
        (-2.0 * self.uniform().ln()).sqrt() * (std::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn vector(&mut self) -> Vector3<f64> {
        Vector3::from([(); 3].map(|()| self.normal()))
    }
}

/// Errors that wander: stationary, with a time constant.
struct Wander {
    value: Vector3<f64>,
    keep: f64,
}

impl Wander {
    fn new(draws: &mut Draws, dt: f64, tau: f64) -> Self {
        Wander {
            value: draws.vector(),
            keep: (-dt / tau).exp(),
        }
    }

    fn next(&mut self, draws: &mut Draws) -> Vector3<f64> {
        self.value = self.value * self.keep + draws.vector() * (1.0 - self.keep * self.keep).sqrt();
        self.value
    }
}

/// What comes, in the order in which it comes.
pub fn samples(truth: &Truth, plan: &Plan) -> Vec<Sample> {
    let noise = plan.unit.noise();
    let mut coming: Vec<(Nanos, Sample)> = imu(truth, &noise, &mut Draws::new(plan.seed));
    if plan.wheels {
        coming.extend(wheels(truth, &noise, &mut Draws::new(plan.seed + 1_000)));
    }
    coming.extend(gnss(truth, plan, &noise, &mut Draws::new(plan.seed + 2_000)));
    if plan.scans {
        coming.extend(scans(truth, plan, &mut Draws::new(plan.seed + 3_000)));
    }
    coming.sort_by_key(|(at, _)| *at);
    coming.into_iter().map(|(_, sample)| sample).collect()
}

fn stamp_of(step: usize) -> Nanos {
    START + step as Nanos * (1_000_000_000 / RATE as Nanos)
}

fn imu(truth: &Truth, noise: &UnitNoise, draws: &mut Draws) -> Vec<(Nanos, Sample)> {
    let dt = 0.01f64;
    let starts = [
        draws.vector() * noise.gyro_bias_start,
        draws.vector() * noise.accel_bias_start,
    ];
    let mut walks = [(); 2].map(|()| Wander::new(draws, dt, 100.0));
    let imu_from_body = mounting().body_from_imu.rotation.inverse();
    let lever = mounting().body_from_imu.translation.vector;
    let point = |step: usize| truth.poses[step].translation.vector + truth.poses[step].rotation * lever;
    (10..truth.poses.len() - 10)
        .step_by(10)
        .map(|step| {
            let rotation = truth.poses[step].rotation;
            let h = 1.0 / RATE as f64;
            let between = truth.poses[step - 1].rotation.inverse() * truth.poses[step + 1].rotation;
            let rate = between.scaled_axis() / (2.0 * h);
            // The mean acceleration of the last and next milliseconds, of the IMU's own point.
            let acceleration = (point(step + 1) - 2.0 * point(step) + point(step - 1)) / (h * h);
            let force = rotation.inverse() * (acceleration + Vector3::z() * Earth::SIMULATED.gravity);
            let gyro = starts[0] + walks[0].next(draws) * noise.gyro_bias_in_run;
            let accel = starts[1] + walks[1].next(draws) * noise.accel_bias_in_run;
            let sample = ImuSample {
                stamp: stamp_of(step),
                angular_rate: imu_from_body * rate + gyro + draws.vector() * (noise.gyro_noise / dt.sqrt()),
                specific_force: imu_from_body * force + accel + draws.vector() * (noise.accel_noise / dt.sqrt()),
            };
            (sample.stamp, Sample::Imu(sample))
        })
        .collect()
}

fn wheels(truth: &Truth, noise: &UnitNoise, draws: &mut Draws) -> Vec<(Nanos, Sample)> {
    let scale = 1.0 + draws.normal() * noise.wheel_scale;
    (17..truth.poses.len() - 10)
        .step_by(20)
        .map(|step| {
            let error = draws.normal() * noise.wheel;
            let speed = truth.speeds[step];
            let speed = if speed == 0.0 { 0.0 } else { speed * scale + error };
            let stamp = stamp_of(step);
            (stamp, Sample::Wheel(WheelSpeed { stamp, speed }))
        })
        .collect()
}

fn gnss(truth: &Truth, plan: &Plan, noise: &UnitNoise, draws: &mut Draws) -> Vec<(Nanos, Sample)> {
    let frame = settings(plan.unit).frame;
    let sigma = Vector3::from(noise.gnss);
    let share = noise.gnss_wander_share;
    let mut wander = Wander::new(draws, 0.1, noise.gnss_wander_s);
    (53..truth.poses.len() - 10)
        .step_by(100)
        .filter_map(|step| {
            let error = wander.next(draws) * share.sqrt() + draws.vector() * (1.0 - share).sqrt();
            let antenna = truth.poses[step] * nalgebra::Point3::from(mounting().antenna_in_body);
            let place = frame.place_of(&(antenna.coords + sigma.component_mul(&error))).unwrap();
            let fix = GnssFix {
                stamp: stamp_of(step),
                place,
                variance: None,
            };
            let at = step as f64 / RATE as f64;
            let out = plan.outage[0] <= at && at < plan.outage[1];
            (!out).then_some((fix.stamp + 20_000_000, Sample::Gnss(fix)))
        })
        .collect()
}

fn scans(truth: &Truth, plan: &Plan, draws: &mut Draws) -> Vec<(Nanos, Sample)> {
    let added = settings(plan.unit).scan;
    let sigmas = [SCAN[0].hypot(added.position_m), SCAN[1].hypot(added.turn_rad)];
    let mut information = Matrix6::identity() / (SCAN[0] * SCAN[0]);
    for axis in 3..6 {
        information[(axis, axis)] = 1.0 / (SCAN[1] * SCAN[1]);
    }
    if plan.street {
        information[(0, 0)] = 0.0;
    }
    (100..truth.poses.len() - 400)
        .step_by(100)
        .filter_map(|step| {
            let mut shift = draws.vector() * sigmas[0];
            if plan.street {
                shift.x = 5.0 * draws.normal();
            }
            let turned = turn(draws.vector() * sigmas[1]);
            let pose = &truth.poses[step];
            let stamp = stamp_of(step);
            let scan = ScanPose {
                stamp,
                map_from_body: Isometry3::from_parts((pose.translation.vector + shift).into(), turned * pose.rotation),
                information,
            };
            let at = step as f64 / RATE as f64;
            let blind = plan.blind[0] <= at && at < plan.blind[1];
            (!blind).then_some((stamp + from_seconds(SCAN_DELAY), Sample::Scan(Box::new(scan))))
        })
        .collect()
}

pub fn estimator(unit: Unit) -> Estimator {
    Estimator::new(settings(unit)).unwrap()
}
