//! A sweep: rays against the moving world as the sensor turns, and what comes back of them.

mod instances;
mod table;
mod thicket;
mod wedge;

use std::f64::consts::PI;

use crate::agents::{Agent, since_epoch};
use crate::place::Scenery;
use crate::sensor::Optics;
use crate::traffic::Traffic;
use instances::Instances;
use realo_schemas::{Nanos, PointCloud};
use thicket::Thicket;
use wedge::{Column, Return, Wedge};

/// Coordinates are multiples of this, m, so that they compress; finer than any range step.
const GRID: f64 = 1.0 / 1024.0;

/// Duration of a sweep, s.
const TURN: f64 = 0.1;
/// Azimuth that beams may look ahead of their column or behind it, rad; a little over 6°.
const LEAD: f64 = 0.11;
/// Parts of a sweep's azimuths by which is known what stands where.
const BINS: usize = 1600;
/// Sensors of the first places see no farther, m.
const FARTHEST: f64 = 255.0;

/// The azimuths of a sweep: clockwise from that of its first column, level, `LEAD` more on both sides.
#[derive(Clone, Copy)]
struct Span {
    /// Azimuth of the first column, clockwise from the carrier's rear, rad.
    first: f64,
    /// What the columns cover, and that with the lead, rad.
    width: f64,
    all: f64,
    /// Width of a bin, rad.
    bin: f64,
    bins_per_radian: f64,
    /// Bodies beyond this are not seen, m.
    farthest: f64,
}

impl Span {
    fn of(agent: &Agent) -> Self {
        let scan = agent.sensor.scan;
        let all = scan.width + 2.0 * LEAD;
        let bin = all / BINS as f64;
        Span {
            first: scan.first - agent.mount.yaw,
            width: scan.width,
            all,
            bin,
            bins_per_radian: 1.0 / bin,
            farthest: agent
                .sensor
                .mount
                .map_or(FARTHEST, |_| agent.sensor.optics.farthest + 5.0),
        }
    }

    /// The bin of a ray's azimuth, clockwise from the first column.
    #[inline(always)]
    fn bin_of(&self, azimuth: f64) -> i16 {
        (((azimuth + LEAD) * self.bins_per_radian) as i32).clamp(0, BINS as i32 - 1) as i16
    }
}

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

/// The points of a cloud.
#[derive(Default)]
struct Kept {
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
    reported_from_body: Rotation,
}

impl Mounted {
    fn of(agent: &Agent) -> Option<Self> {
        agent.sensor.mount?;
        let mount = agent.mount;
        Some(Mounted {
            body_from_sensor: turned(mount.roll, mount.pitch, mount.yaw),
            reported_from_body: turned(agent.misalignment[0], agent.misalignment[1], 0.0),
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

/// A sweep that is being cast.
struct Shot<'a> {
    world: &'a World<'a>,
    agent: &'a Agent,
    mounted: Option<Mounted>,
    span: Span,
    /// Key of the rays' hashes.
    key: u64,
    /// Start of the sweep, s.
    start: f64,
}

impl<'a> Shot<'a> {
    fn new(world: &'a World<'a>, agent: &'a Agent, key: u64, start: f64) -> Self {
        Shot {
            world,
            agent,
            mounted: Mounted::of(agent),
            span: Span::of(agent),
            key,
            start,
        }
    }

    /// Clockwise azimuth of a column from the first, rad.
    fn azimuth(&self, column: usize) -> f64 {
        let sensor = &*self.agent.sensor;
        sensor.scan.width * column as f64 / sensor.columns as f64
    }

    /// Every `stride`-th column.
    fn columns(&self, stride: usize) -> wedge::Columns {
        let sensor = &*self.agent.sensor;
        let all = (0..sensor.columns).step_by(stride).map(|number| self.column(number));
        wedge::Columns::new(self, all.collect(), self.azimuth(stride))
    }

    fn column(&self, number: usize) -> Column {
        let (agent, sensor) = (self.agent, &*self.agent.sensor);
        let period = TURN / sensor.columns as f64;
        let azimuth = self.azimuth(number);
        let fires = number as f64 * period;
        let body = agent.body(self.world.place, self.world.traffic, self.start + fires + 0.5 * period);
        let column_turn = about_z(PI - (sensor.scan.first + azimuth));
        let body_from_sensor = match &self.mounted {
            None => times(&tilt(body.slope), &column_turn),
            Some(mounted) => times(&times(&tilt(body.slope), &mounted.body_from_sensor), &column_turn),
        };
        Column {
            number,
            azimuth,
            fires,
            position: body.position,
            velocity: body.velocity,
            place_from_sensor: times(&about_z(body.heading), &body_from_sensor),
            // What nobody knows of the mounting stays in the points.
            reported_from_sensor: match &self.mounted {
                None => body_from_sensor,
                Some(mounted) => times(&mounted.reported_from_body, &body_from_sensor),
            },
        }
    }
}

/// Casts one sweep of an agent. Points are in the agent's body frame of the instant at which each was measured.
pub(crate) fn cast(world: &World, agent: &Agent, casting: &Casting) -> Cast {
    let sensor = &*agent.sensor;
    let optics = Optics {
        extinction: casting.extinction,
        ..sensor.optics
    };
    let start = since_epoch(casting.start);
    let shot = Shot::new(world, agent, casting.key, start);
    let columns = shot.columns(casting.column_stride);
    let wedges = columns.bins(&shot);
    let instances = Instances::new(world, agent, start, &wedges);
    let thicket = Thicket::new(&shot, &wedges);
    let mut returns = vec![Return::NONE; columns.all.len() * sensor.beams.len()];
    let mut wedge = Wedge::new(sensor);
    for number in 0..columns.wedges() {
        wedge.fire(&shot, &columns, number);
        instances.cast(&columns, number, &mut wedge);
        // The nearest counts, whatever is looked for first: what is likely to be near, so that less is left to search.
        wedge.ground(&columns, world.place, false);
        thicket.cast(&columns, number, &mut wedge);
        wedge.ground(&columns, world.place, true);
        wedge.receive(&columns, &optics, &mut returns);
    }
    let mut points = vec![0; world.traffic.users.len()];
    let mut kept = Kept::with_capacity(if casting.clouds { returns.len() } else { 0 });
    let mut finished = 0;
    let to_start = (casting.start - casting.stamp) as f64;
    for (column, returns) in columns.all.iter().zip(returns.chunks(sensor.beams.len())) {
        for (found, beam) in returns.iter().zip(&sensor.beams) {
            if found.range < 0.0 {
                continue;
            }
            finished += 1;
            let user = found.user();
            if let Some(user) = user {
                points[user as usize] += 1;
            }
            if casting.clouds {
                let d = rotate(&column.reported_from_sensor, &beam.direction).map(|axis| axis * found.range);
                let time = to_start + (column.fires + beam.fires) * 1e9;
                kept.push([d[0], d[1], d[2] + agent.info.sensor_height]);
                kept.intensity.push(found.intensity);
                kept.time.push(round(time) as i32);
                kept.ring.push(beam.ring);
                if casting.labels {
                    kept.labels.push(user.map_or(0, |user| user + 1));
                }
            }
        }
    }
    let (cloud, labels) = kept.finish();
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

impl Kept {
    fn with_capacity(points: usize) -> Self {
        Kept {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Options, Sensor};

    /// What the tables leave out can be met by no ray: on sensors that tilt and sway, and on a vehicle that comes out of a
    /// bend while its sensor turns.
    #[test]
    fn foliage_is_found_wherever_it_stands() {
        let named = |name: &&str| Sensor::named(name).unwrap();
        for (scenario, number, start, sensors) in [
            (
                crate::Scenario::Junction,
                4,
                0.35,
                &["pandar40p", "forward-scan", "spinning-32"][..],
            ),
            (crate::Scenario::CarPark, 1, 0.7, &["ruby-plus-128"]),
        ] {
            let place = Scenery::new(scenario, number);
            let demand = crate::traffic::Demand {
                place: &place,
                seed: number,
                dense: false,
                seconds: 3.0,
                rounded_bodies: false,
            };
            let traffic = Traffic::new(&demand).unwrap();
            let world = World {
                place: &place,
                traffic: &traffic,
            };
            for sensor in sensors.iter().map(named) {
                let options = Options {
                    vehicle_sensors: vec![sensor.clone()],
                    roadside_sensors: vec![sensor.clone()],
                    ..Options::default()
                };
                for agent in Agent::all(&options, &place, &traffic).unwrap() {
                    let met = compared(&Shot::new(&world, &agent, agent.number, start));
                    assert!(met > 100, "only {met} rays of {} met foliage", agent.info.name);
                }
            }
        }
    }

    /// Casts some rays of a sweep against the tables and against all foliage; gives the number of those that met some.
    fn compared(shot: &Shot) -> usize {
        // Low foliage is looked for up to 100 m.
        let limit = 95.0;
        let columns = shot.columns(3);
        let thicket = Thicket::new(shot, &columns.bins(shot));
        let mut wedge = Wedge::new(&shot.agent.sensor);
        let mut met = 0;
        for number in (0..columns.wedges()).step_by(2) {
            wedge.fire(shot, &columns, number);
            thicket.cast(&columns, number, &mut wedge);
            for (row, ray) in wedge.rays(&columns).step_by(13) {
                let (origin, along, hash) = (columns.origin(row, ray), row.ray(ray), row.hash(ray));
                let all = shot.world.place.foliage.iter();
                let hits = all.filter_map(|mass| mass.cast(&origin, &along, limit, hash));
                let nearest = hits.map(|hit| hit.t).fold(limit, f64::min);
                let found = row.met(ray).map_or(limit, |hit| hit.t.min(limit));
                assert_eq!(found, nearest, "{} {number}", shot.agent.info.name);
                met += usize::from(nearest < limit);
            }
        }
        met
    }
}
