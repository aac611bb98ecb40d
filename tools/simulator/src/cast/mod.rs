//! A sweep: rays against the moving world as the sensor turns, and what comes back of them.

mod instances;
mod table;
mod thicket;

use std::f64::consts::PI;

use crate::agents::{Agent, since_epoch};
use crate::place::Scenery;
use crate::random::{mix, normal_of, unit_of};
use crate::sensor::Optics;
use crate::solid::Hit;
use crate::traffic::Traffic;
use instances::Instances;
use realo_schemas::{Nanos, PointCloud};
use thicket::Thicket;

/// Coordinates are multiples of this, m, so that they compress; finer than any range step.
const GRID: f64 = 1.0 / 1024.0;

/// Rays that fall less than this are likely to meet foliage before the ground.
const FLAT: f64 = 0.06;

/// What there is to be seen.
#[derive(Clone, Copy)]
pub(crate) struct World<'a> {
    pub place: &'a Scenery,
    pub traffic: &'a Traffic,
}

/// How a sweep is cast.
#[derive(Clone, Copy)]
pub(crate) struct Casting {
    /// Key of the sweep's noise.
    pub key: u64,
    /// Time at which the sweep starts, and its reference time.
    pub start: Nanos,
    pub stamp: Nanos,
    pub clouds: bool,
    pub labels: bool,
    pub column_stride: usize,
    /// What the air takes of the light, 1/m.
    pub extinction: f64,
}

/// What a sweep gives.
pub(crate) struct Cast {
    pub cloud: PointCloud,
    /// Points on each road user.
    pub points: Vec<u32>,
    /// For each point, the road user's index plus one; 0 for everything else.
    pub labels: Vec<u32>,
    /// Finished points, whether or not they are kept.
    pub finished: usize,
}

#[derive(Default)]
struct Columns {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    intensity: Vec<u8>,
    time: Vec<i32>,
    ring: Vec<u16>,
    labels: Vec<u32>,
}

/// A rotation, by rows.
type Rotation = [[f64; 3]; 3];

#[inline(always)]
fn rotate(m: &Rotation, v: &[f64; 3]) -> [f64; 3] {
    let row = |r: &[f64; 3]| r[0] * v[0] + r[1] * v[1] + r[2] * v[2];
    [row(&m[0]), row(&m[1]), row(&m[2])]
}

fn times(a: &Rotation, b: &Rotation) -> Rotation {
    [0, 1, 2].map(|r| [0, 1, 2].map(|c| a[r][0] * b[0][c] + a[r][1] * b[1][c] + a[r][2] * b[2][c]))
}

fn about_z(angle: f64) -> Rotation {
    let (sin, cos) = libm::sincos(angle);
    [[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]
}

/// From the carrier's leaning frame to the gravity-aligned one, for slopes along and across.
fn tilt([along, across]: [f64; 2]) -> Rotation {
    let length = (1.0 + along * along + across * across).sqrt();
    let up = [-along / length, -across / length, 1.0 / length];
    let level = (1.0 + along * along).sqrt();
    let ahead = [1.0 / level, 0.0, along / level];
    let left = [
        up[1] * ahead[2] - up[2] * ahead[1],
        up[2] * ahead[0] - up[0] * ahead[2],
        up[0] * ahead[1] - up[1] * ahead[0],
    ];
    [0, 1, 2].map(|r| [ahead[r], left[r], up[r]])
}

/// How a sensor stands on its carrier, unless it stands straight.
struct Mounted {
    body_from_sensor: Rotation,
    /// From the body frame to what it is taken for.
    told_from_body: Rotation,
}

impl Mounted {
    fn of(agent: &Agent) -> Option<Self> {
        agent.sensor.mount?;
        let mount = agent.mount;
        Some(Mounted {
            body_from_sensor: turned(mount.roll, mount.pitch, mount.yaw),
            told_from_body: turned(agent.misalignment[0], agent.misalignment[1], 0.0),
        })
    }
}

/// The rotation by yaw, then pitch, then roll, rad.
fn turned(roll: f64, pitch: f64, yaw: f64) -> Rotation {
    let ((sin_p, cos_p), (sin_r, cos_r)) = (libm::sincos(pitch), libm::sincos(roll));
    let about_y = [[cos_p, 0.0, sin_p], [0.0, 1.0, 0.0], [-sin_p, 0.0, cos_p]];
    let about_x = [[1.0, 0.0, 0.0], [0.0, cos_r, -sin_r], [0.0, sin_r, cos_r]];
    times(&times(&about_z(yaw), &about_y), &about_x)
}

/// Casts one sweep of an agent. Points are in the agent's body frame of the instant at which each was measured.
pub(crate) fn cast(world: &World, agent: &Agent, casting: &Casting) -> Cast {
    let sensor = &*agent.sensor;
    let optics = Optics {
        extinction: casting.extinction,
        ..sensor.optics
    };
    let mounted = Mounted::of(agent);
    let start = since_epoch(casting.start);
    let instances = Instances::new(world, agent, start);
    let middle = agent.body(world.place, world.traffic, start + 0.05);
    let thicket = (!world.place.foliage.is_empty()).then(|| Thicket::new(&world.place.foliage, agent, &middle));
    let mut points = vec![0; world.traffic.users.len()];
    let mut columns = Columns::with_capacity(if casting.clouds {
        sensor.columns * sensor.beams.len()
    } else {
        0
    });
    let per_column = sensor.beams.len().max(256);
    let mut finished = 0;
    let period = 0.1 / sensor.columns as f64;
    let to_start = (casting.start - casting.stamp) as f64;
    for column in (0..sensor.columns).step_by(casting.column_stride) {
        let azimuth = sensor.scan.width * column as f64 / sensor.columns as f64;
        let fires = column as f64 * period;
        let body = agent.body(world.place, world.traffic, start + fires + 0.5 * period);
        let column_turn = about_z(PI - (sensor.scan.first + azimuth));
        let body_from_sensor = match &mounted {
            None => times(&tilt(body.slope), &column_turn),
            Some(mounted) => times(&times(&tilt(body.slope), &mounted.body_from_sensor), &column_turn),
        };
        let place_from_sensor = times(&about_z(body.heading), &body_from_sensor);
        // What nobody knows of the mounting stays in the points.
        let told_from_sensor = match &mounted {
            None => body_from_sensor,
            Some(mounted) => times(&mounted.told_from_body, &body_from_sensor),
        };
        for (number, beam) in sensor.beams.iter().enumerate() {
            if beam.every > 1 && column % beam.every != 0 {
                continue;
            }
            let ray = rotate(&place_from_sensor, &beam.direction);
            // The body's position holds for the middle of the column.
            let aside = beam.fires - 0.5 * period;
            let origin = [
                body.position[0] + body.velocity[0] * aside,
                body.position[1] + body.velocity[1] * aside,
                body.position[2] + body.velocity[2] * aside + agent.info.sensor_height,
            ];
            let hash = mix(casting
                .key
                .wrapping_add(((column * per_column + number) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
            let level = (ray[0] * ray[0] + ray[1] * ray[1]).sqrt();
            let t = start + fires + beam.fires;
            let limit = optics.farthest;
            let met = instances.cast(azimuth + beam.azimuth, level, &origin, &ray, t, limit, hash);
            let limit = met.map_or(limit, |(hit, _)| hit.t);
            // The nearest counts, whatever is looked for first: what is likely to be near, so that less is left to search.
            let flat = ray[2] > -FLAT * level;
            let leaves = |limit| {
                let thicket = thicket.as_ref()?;
                thicket.cast(azimuth + beam.azimuth, level, &origin, &ray, limit, hash)
            };
            let early = if flat { leaves(limit) } else { None };
            let met = early.map(|hit| (hit, None)).or(met);
            let limit = met.map_or(limit, |(hit, _)| hit.t);
            let ground = world.place.cast_ground(origin, ray, limit);
            let met = ground.map(|hit| (hit, None)).or(met);
            let late = if flat {
                None
            } else {
                leaves(met.map_or(limit, |(hit, _)| hit.t))
            };
            let Some((hit, user)) = late.map(|hit| (hit, None)).or(met) else {
                continue;
            };
            let Some((range, intensity)) = receive(&optics, &hit, hash) else {
                continue;
            };
            finished += 1;
            let label = user.map_or(0, |user| user + 1);
            if let Some(user) = user {
                points[user as usize] += 1;
            }
            if casting.clouds {
                let d = rotate(&told_from_sensor, &beam.direction);
                let time = to_start + (fires + beam.fires) * 1e9;
                columns.push([d[0] * range, d[1] * range, d[2] * range + agent.info.sensor_height]);
                columns.intensity.push(intensity);
                columns.time.push(round(time) as i32);
                columns.ring.push(beam.ring);
                if casting.labels {
                    columns.labels.push(label);
                }
            }
        }
    }
    let (cloud, labels) = columns.finish();
    Cast {
        cloud,
        points,
        labels,
        finished,
    }
}

/// To the nearest integer, ties to even, for magnitudes below 2⁵¹: the sum has no room for a fraction. Without a call
/// to the C library.
#[inline(always)]
fn round(v: f64) -> f64 {
    const ROOM: f64 = 6_755_399_441_055_744.0;
    (v + ROOM) - ROOM
}

impl Columns {
    fn with_capacity(points: usize) -> Self {
        Columns {
            x: Vec::with_capacity(points),
            y: Vec::with_capacity(points),
            z: Vec::with_capacity(points),
            intensity: Vec::with_capacity(points),
            time: Vec::with_capacity(points),
            ring: Vec::with_capacity(points),
            labels: Vec::new(),
        }
    }

    #[inline]
    fn push(&mut self, [x, y, z]: [f64; 3]) {
        let snap = |v: f64| (round(v * (1.0 / GRID)) * GRID) as f32;
        self.x.push(snap(x));
        self.y.push(snap(y));
        self.z.push(snap(z));
    }

    fn finish(mut self) -> (PointCloud, Vec<u32>) {
        self.x.shrink_to_fit();
        self.y.shrink_to_fit();
        self.z.shrink_to_fit();
        let cloud = PointCloud::new(self.x, self.y, self.z, self.intensity, self.time, self.ring);
        (cloud.expect("every column got every point"), self.labels)
    }
}

/// Range and intensity of what comes back; `None` if nothing is seen.
#[inline]
fn receive(optics: &Optics, hit: &Hit, hash: u64) -> Option<(f64, u8)> {
    let ratio = optics.reference_range / hit.t;
    let mut q = optics.strength * hit.rho * hit.cos * ratio * ratio;
    if optics.extinction > 0.0 {
        q *= libm::exp(-2.0 * optics.extinction * hit.t);
    }
    let q4 = q * q * q * q;
    if unit_of(hash) * (q4 + 1.0) >= q4 * (1.0 - optics.unanswered) {
        return None;
    }
    let scatter = (optics.noise_floor + optics.noise_slope / q.sqrt()).min(optics.noise_ceiling);
    let range = hit.t + scatter * normal_of(mix(hash));
    let range = round(range * optics.steps_per_metre) * optics.step;
    if range < optics.nearest || range > optics.farthest {
        return None;
    }
    // Calibrated for range: 100 stands for a white wall met squarely, more for retro-reflectors.
    let shimmer = (hash & 0x3ff) as f64 * (0.06 / 1024.0);
    Some((range, (100.0 * hit.rho * hit.cos * (0.97 + shimmer)).min(255.0) as u8))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;
    use crate::{Options, Sensor};

    /// What the tables leave out can be met by no ray.
    #[test]
    fn foliage_is_found_wherever_it_stands() {
        let place = Scenery::new(crate::Scenario::Junction, 4);
        let demand = crate::traffic::Demand {
            place: &place,
            seed: 4,
            dense: false,
            seconds: 1.0,
        };
        let traffic = Traffic::new(&demand).unwrap();
        let sensors = ["pandar40p", "forward-scan", "spinning-32"].map(|name| Sensor::named(name).unwrap());
        let mut met = 0;
        for sensor in sensors {
            let options = Options {
                vehicle_sensors: vec![sensor.clone()],
                roadside_sensors: vec![sensor.clone()],
                ..Options::default()
            };
            for agent in Agent::all(&options, &place, &traffic).unwrap() {
                let start = 0.35;
                let middle = agent.body(&place, &traffic, start + 0.05);
                let thicket = Thicket::new(&place.foliage, &agent, &middle);
                let mut draws = Stream::new(1, "rays", agent.number);
                for _ in 0..400 {
                    let column = draws.below(sensor.columns);
                    let beam = &sensor.beams[draws.below(sensor.beams.len())];
                    let azimuth = sensor.scan.width * column as f64 / sensor.columns as f64;
                    let t = start + 0.1 * column as f64 / sensor.columns as f64;
                    let body = agent.body(&place, &traffic, t);
                    let turn = about_z(PI - (sensor.scan.first + azimuth));
                    let mount = turned(agent.mount.roll, agent.mount.pitch, agent.mount.yaw);
                    let body_from_sensor = times(&times(&tilt(body.slope), &mount), &turn);
                    let ray = rotate(&times(&about_z(body.heading), &body_from_sensor), &beam.direction);
                    let [x, y, z] = body.position;
                    let origin = [x, y, z + agent.info.sensor_height];
                    let (level, chance) = ((ray[0] * ray[0] + ray[1] * ray[1]).sqrt(), draws.bits());
                    let limit = 95.0;
                    let found = thicket.cast(azimuth + beam.azimuth, level, &origin, &ray, limit, chance);
                    let all = place
                        .foliage
                        .iter()
                        .filter_map(|mass| mass.cast(&origin, &ray, limit, chance));
                    let nearest = all.map(|hit| hit.t).fold(limit, f64::min);
                    assert_eq!(
                        found.map_or(limit, |hit| hit.t),
                        nearest,
                        "{} {column}",
                        agent.info.name
                    );
                    met += usize::from(nearest < limit);
                }
            }
        }
        assert!(met > 1000, "only {met} rays met foliage");
    }
}
