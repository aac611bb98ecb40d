//! A block of houses for tests, and a vehicle that measures while it drives round it.

use damage::Draw;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_mapping::{Drive, Odometry, OdometrySettings, levelled};
use realo_schemas::motion::Taken;
use realo_schemas::{FixQuality, GnssFix, ImuSample, Motion, Nanos, PointCloud, WheelSpeed};

const MS: Nanos = 1_000_000;
const START: Nanos = 1_700_000_000_000_000_000;
const GRAVITY: f64 = 9.806_65;
const ANTENNA: Vector3<f64> = Vector3::new(-0.4, 0.0, 1.5);
/// The way is a circle of this radius, m, at this speed, m/s.
const RADIUS: f64 = 25.0;
const SPEED: f64 = 6.0;

/// A house: middle, half of length and width, height, heading.
struct House([f64; 2], [f64; 2], f64, f64);

impl House {
    /// Where a ray from a place comes in, as a multiple of its direction.
    fn enters(&self, from: &Vector3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let House(place, half, height, yaw) = self;
        let (sin, cos) = libm::sincos(*yaw);
        let turn = |x: f64, y: f64| [cos * x + sin * y, cos * y - sin * x];
        let [x, y] = turn(from.x - place[0], from.y - place[1]);
        let [dx, dy] = turn(direction.x, direction.y);
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for (at, along, [low, high]) in [
            (x, dx, [-half[0], half[0]]),
            (y, dy, [-half[1], half[1]]),
            (from.z, direction.z, [0.0, *height]),
        ] {
            let [a, b] = [(low - at) / along, (high - at) / along];
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        (enter < leave && enter > 0.0).then_some(enter)
    }
}

/// What stands around the way, from a seed.
pub struct Block(Vec<House>);

impl Block {
    pub fn new(seed: u64) -> Self {
        let mut draw = Draw::new(seed);
        let mut number = |low: f64, high: f64| low + (high - low) * draw.below(1_000_000) as f64 * 1e-6;
        let mut houses = vec![House([0.0, 0.0], [11.0, 9.0], 8.0, 0.3)];
        for at in 0..22 {
            let angle = std::f64::consts::TAU * f64::from(at) / 22.0 + number(-0.1, 0.1);
            let far = number(37.0, 44.0);
            let (sin, cos) = libm::sincos(angle);
            let half = [number(2.0, 5.0), number(2.0, 4.0)];
            houses.push(House(
                [far * cos, far * sin],
                half,
                number(3.0, 9.0),
                angle + number(-0.4, 0.4),
            ));
        }
        for _ in 0..14 {
            let angle = number(0.0, 6.2);
            let far = if number(0.0, 1.0) < 0.5 {
                number(17.0, 20.0)
            } else {
                number(30.0, 32.0)
            };
            let (sin, cos) = libm::sincos(angle);
            houses.push(House([far * cos, far * sin], [0.2, 0.2], 5.0, 0.4));
        }
        Block(houses)
    }

    /// A sweep of 16 beams from a pose.
    fn sweep(&self, pose: &Isometry3<f64>, draw: &mut Draw) -> PointCloud {
        let from = (pose * nalgebra::Point3::new(0.0, 0.0, 1.9)).coords;
        let [mut x, mut y, mut z] = [Vec::new(), Vec::new(), Vec::new()];
        for beam in 0..16 {
            let slope = libm::tan((f64::from(beam) * 1.6 - 16.0).to_radians());
            for step in 0..300 {
                let (sin, cos) = libm::sincos(std::f64::consts::TAU * f64::from(step) / 300.0);
                let ray = Vector3::new(cos, sin, slope);
                let direction = pose.rotation * ray;
                let ground = if slope < 0.0 { -from.z / slope } else { f64::INFINITY };
                let hit = self
                    .0
                    .iter()
                    .filter_map(|house| house.enters(&from, &direction))
                    .fold(ground, f64::min);
                if hit < 70.0 {
                    let noise = 1.0 + (draw.below(1000) as f64 * 1e-3 - 0.5) * 0.06 / hit;
                    let point = ray * (hit * noise) + Vector3::new(0.0, 0.0, 1.9);
                    x.push(point.x as f32);
                    y.push(point.y as f32);
                    z.push(point.z as f32);
                }
            }
        }
        let n = x.len();
        PointCloud::new(x, y, z, vec![0; n], vec![0; n], vec![0; n]).unwrap()
    }
}

/// How a drive goes, and what is wrong with it.
#[derive(Clone, Copy)]
pub struct Plan {
    pub seed: u64,
    pub seconds: i64,
    /// What GNSS is off all the time, m.
    pub bias: [f64; 2],
    /// Whether there is GNSS, and whether it jumps by metres all the time.
    pub has_fixes: bool,
    pub jumps: bool,
    /// Points of each sweep at most.
    pub points: usize,
    /// From the way round the block, m.
    pub away: f64,
    /// The sweep of which the stamp is 50 s too early.
    pub misdated: Option<i64>,
    /// What a metre ahead looks too high by, for the sensor leans, m.
    pub slope: f64,
}

impl Plan {
    pub const LAPS: Plan = Plan {
        seed: 1,
        seconds: 40,
        bias: [0.7, -0.5],
        has_fixes: true,
        jumps: false,
        points: usize::MAX,
        away: 0.0,
        misdated: None,
        slope: 0.0,
    };
}

/// Where the vehicle is so many seconds after the start.
fn truth(plan: &Plan, seconds: f64) -> Isometry3<f64> {
    let angle = SPEED / RADIUS * seconds;
    let (sin, cos) = libm::sincos(angle);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle + std::f64::consts::FRAC_PI_2);
    Isometry3::from_parts(Translation3::new(RADIUS * cos + plan.away, RADIUS * sin, 0.0), turn)
}

/// Where the vehicle truly was at a stamp.
pub fn true_pose(plan: &Plan, stamp: Nanos) -> Isometry3<f64> {
    truth(plan, (stamp - START) as f64 * 1e-9)
}

/// Stamps of the sweeps of a drive.
pub fn sweeps(plan: &Plan) -> impl Iterator<Item = Nanos> {
    (0..plan.seconds * 5).map(|at| START + at * 200 * MS)
}

/// A drive, followed.
pub fn drive(block: &Block, plan: &Plan) -> Drive {
    drive_with(block, plan, 0.0)
}

/// A drive, followed by a sensor of which it is known how it leans.
pub fn drive_with(block: &Block, plan: &Plan, slope: f64) -> Drive {
    let mut odometry = Odometry::new(OdometrySettings {
        slope,
        ..OdometrySettings::default()
    })
    .unwrap();
    let mut draw = Draw::new(plan.seed);
    for at in 0..plan.seconds * 100 {
        let stamp = START + at * 10 * MS;
        let mut motion = measured(plan, at, &mut draw);
        let imu = motion.imu.clone();
        let set = |taken: &mut Taken| taken.stamp = stamp;
        motion.imu.iter_mut().for_each(|sample| set(&mut sample.taken));
        motion.fixes.iter_mut().for_each(|fix| set(&mut fix.taken));
        motion.wheels.iter_mut().for_each(|wheel| set(&mut wheel.taken));
        assert_eq!(imu.len(), 1);
        odometry.measure(&motion).unwrap();
        if at % 20 == 0 {
            let pose = Isometry3::translation(-plan.away, 0.0, 0.0) * true_pose(plan, stamp);
            let cloud = levelled(&block.sweep(&pose, &mut draw), -plan.slope);
            let early = plan.misdated == Some(at / 20);
            let stamp = stamp - if early { 50_000 * MS } else { 0 };
            odometry.sweep(stamp, &first(&cloud, plan.points)).unwrap();
        }
    }
    odometry.finish()
}

/// So many points, evenly taken.
fn first(cloud: &PointCloud, most: usize) -> PointCloud {
    let every = cloud.len().div_ceil(most.max(1)).max(1);
    let of = |axis: &[f32]| axis.iter().step_by(every).take(most).copied().collect::<Vec<f32>>();
    let [x, y, z] = [&cloud.x, &cloud.y, &cloud.z].map(|axis| of(axis));
    let n = x.len();
    PointCloud::new(x, y, z, vec![0; n], vec![0; n], vec![0; n]).unwrap()
}

/// What the sensors measure in the 10 ms up to a time.
fn measured(plan: &Plan, at: i64, draw: &mut Draw) -> Motion {
    let mut noise = || draw.below(2_000_001) as f64 * 1e-6 - 1.0;
    let rate = SPEED / RADIUS;
    let mut motion = Motion {
        imu_variance: Some([4e-8, 2.5e-5]),
        antenna: ANTENNA.into(),
        ..Motion::default()
    };
    motion.imu.push(ImuSample {
        taken: Taken::default(),
        angular_rate: [3e-4 * noise(), 3e-4 * noise(), rate + 2e-5 + 3e-4 * noise()],
        specific_force: [0.01 * noise(), SPEED * rate + 0.01 * noise(), GRAVITY + 0.01 * noise()],
    });
    if at % 2 == 0 {
        motion.wheels.push(WheelSpeed {
            taken: Taken::default(),
            speed: SPEED * 1.004 + 0.03 * noise(),
            variance: None,
        });
    }
    if at % 10 == 0 && plan.has_fixes {
        let pose = true_pose(plan, START + at * 10 * MS);
        let mut position = (pose * nalgebra::Point3::from(ANTENNA)).coords;
        position += Vector3::new(plan.bias[0], plan.bias[1], 0.4) + Vector3::new(noise(), noise(), noise()) * 0.8;
        // Between houses, for two seconds of nine; or always.
        if plan.jumps || (at / 100) % 9 > 6 {
            let by = if plan.jumps { 40.0 } else { 7.0 };
            position += Vector3::new(by * noise(), by, 0.0);
        }
        motion.fixes.push(GnssFix {
            taken: Taken::default(),
            position: position.into(),
            has_height: true,
            covariance: Some([1.44, 0.0, 0.0, 0.0, 1.44, 0.0, 0.0, 0.0, 6.25]),
            quality: FixQuality::Single,
        });
    }
    motion
}
