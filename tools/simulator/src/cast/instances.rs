//! Which objects a ray can meet: for each sweep, the bodies by azimuth, nearest first.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::World;
use super::table::{Bounds, Table, TableOf};
use crate::agents::{Agent, BodyState};
use crate::path::Pose2;
use crate::solid::{Hit, Solid};
use crate::traffic::Footing;

/// Azimuth that beams may look ahead of their column or behind it, rad; a little over 6°.
pub(super) const LEAD: f64 = 0.11;
/// The sweep is cut into sectors, in each of which everybody moves straight.
const SECTORS: usize = 40;
const BINS_PER_SECTOR: usize = 40;
/// Sensors of the first places see no farther, m.
const FARTHEST: f64 = 255.0;
/// Where a place is overgrown, what is lower than this is looked for up to `LOW_REACH`, m.
const LOW: f64 = 2.2;
const LOW_REACH: f64 = 120.0;
/// Duration of a sweep, s.
pub(super) const TURN: f64 = 0.1;

/// The azimuths of a sweep: clockwise from that of its first column, level, `LEAD` more on both sides.
#[derive(Clone, Copy)]
pub(super) struct Span {
    /// Azimuth of the first column, clockwise from the carrier's rear, rad.
    pub first: f64,
    /// What the columns cover, and that with the lead, rad.
    pub width: f64,
    pub all: f64,
    /// Width of a bin, rad.
    bin: f64,
    /// Bodies beyond this are not seen, m.
    pub farthest: f64,
}

impl Span {
    pub fn of(agent: &Agent) -> Self {
        let scan = agent.sensor.scan;
        let all = scan.width + 2.0 * LEAD;
        Span {
            first: scan.first - agent.mount.yaw,
            width: scan.width,
            all,
            bin: all / (SECTORS * BINS_PER_SECTOR) as f64,
            farthest: agent
                .sensor
                .mount
                .map_or(FARTHEST, |_| agent.sensor.optics.farthest + 5.0),
        }
    }
}

/// A body as it is while the sensor looks its way.
pub(super) struct Instance<'a> {
    /// Least distance over ground, m, and bounds of the slope of rays that can meet it.
    near: f64,
    slopes: [f64; 2],
    solid: &'a Solid,
    /// Index of the road user.
    pub user: Option<u32>,
    /// Time at which the following holds, s.
    t: f64,
    position: [f64; 3],
    velocity: [f64; 2],
    cos_sin: [f64; 2],
    turn_rate: f64,
    /// The ground's slope under it.
    lean: [f64; 2],
    stride: f64,
    fixed: bool,
}

impl Instance<'_> {
    /// Where a ray meets the body before `limit`; `t` is the ray's time.
    #[inline(always)]
    fn cast(&self, origin: &[f64; 3], ray: &[f64; 3], t: f64, limit: f64, chance: u64) -> Option<Hit> {
        let [mut cos, mut sin] = self.cos_sin;
        let (mut x, mut y) = (origin[0] - self.position[0], origin[1] - self.position[1]);
        let (mut w, mut dw) = (origin[2] - self.position[2], ray[2]);
        if !self.fixed {
            let dt = t - self.t;
            let turn = self.turn_rate * dt;
            (cos, sin) = (cos - sin * turn, sin + cos * turn);
            x -= self.velocity[0] * dt;
            y -= self.velocity[1] * dt;
        }
        let (u, v) = (cos * x + sin * y, cos * y - sin * x);
        let (du, dv) = (cos * ray[0] + sin * ray[1], cos * ray[1] - sin * ray[0]);
        if !self.fixed {
            w -= self.lean[0] * u + self.lean[1] * v;
            dw -= self.lean[0] * du + self.lean[1] * dv;
        }
        self.solid.cast([u, v, w], [du, dv, dw], limit, chance, self.stride)
    }
}

/// The bodies of one sweep, by azimuth.
pub(super) struct Instances<'a> {
    all: Vec<Instance<'a>>,
    table: Table,
    bins_per_radian: f64,
}

/// A body and where it may be found in time.
struct Candidate<'a> {
    solid: &'a Solid,
    user: Option<u32>,
    own: bool,
}

/// Where a candidate is at some time.
struct Stance {
    pose: Pose2,
    footing: Footing,
    velocity: [f64; 2],
    turn_rate: f64,
    stride: f64,
}

impl<'a> Instances<'a> {
    /// Everything that `agent` can see in the turn that begins at `start` seconds.
    pub fn new(world: &World<'a>, agent: &Agent, start: f64) -> Self {
        let span = Span::of(agent);
        let sectors: Vec<(f64, BodyState)> = (0..SECTORS)
            .map(|k| start + (((k as f64 + 0.5) * span.all / SECTORS as f64) - LEAD) / span.width * TURN)
            .map(|t| (t, agent.body(world.place, world.traffic, t)))
            .collect();
        let mut found = Vec::new();
        let [eye_x, eye_y, _] = sectors[SECTORS / 2].1.position;
        let overgrown = !world.place.foliage.is_empty();
        for fixture in &world.place.fixtures {
            let (dx, dy) = (fixture.pose.x - eye_x, fixture.pose.y - eye_y);
            let low = fixture.solid.high[2] - fixture.solid.low[2] < LOW;
            if overgrown && low && dx * dx + dy * dy > LOW_REACH * LOW_REACH {
                continue;
            }
            let footing = Footing {
                z: fixture.z,
                slope: [0.0; 2],
            };
            let candidate = Candidate {
                solid: &fixture.solid,
                user: None,
                own: false,
            };
            add(&mut found, &sectors, (agent, span), candidate, |_| {
                Some(Stance {
                    pose: fixture.pose,
                    footing,
                    velocity: [0.0; 2],
                    turn_rate: 0.0,
                    stride: 0.0,
                })
            });
        }
        for (index, user) in world.traffic.users.iter().enumerate() {
            let own = agent.user == Some(index);
            let candidate = Candidate {
                solid: &user.solid,
                user: Some(index as u32),
                own,
            };
            add(&mut found, &sectors, (agent, span), candidate, |t| {
                let state = user.course.at(t)?;
                let (sin, cos) = libm::sincos(state.pose.heading);
                Some(Stance {
                    pose: state.pose,
                    footing: user.footing(world.place, &state),
                    velocity: [state.speed * cos, state.speed * sin],
                    turn_rate: state.turn_rate,
                    stride: if user.class.walks() {
                        libm::sin(state.gone * 4.2)
                    } else {
                        0.3
                    },
                })
            });
        }
        Instances::sorted(found, span)
    }

    fn sorted(mut found: Vec<(Instance<'a>, [usize; 2])>, span: Span) -> Self {
        // Stable: at equal distance the order of fixtures and road users decides.
        found.sort_by(|a, b| a.0.near.total_cmp(&b.0.near));
        let mut table = TableOf::new(SECTORS * BINS_PER_SECTOR, found.iter().map(|(_, bins)| *bins));
        for (index, (instance, bins)) in found.iter().enumerate() {
            let [low, high] = instance.slopes.map(|slope| slope as f32);
            let margin = |slope: f32| 1e-6 + 1e-6 * slope.abs();
            let bounds = Bounds {
                near: instance.near as f32 * 0.999_999,
                low: low - margin(low),
                high: high + margin(high),
            };
            table.add(*bins, bounds, index as u32);
        }
        Instances {
            all: found.into_iter().map(|(instance, _)| instance).collect(),
            table: table.finish(),
            bins_per_radian: 1.0 / span.bin,
        }
    }

    /// The first body that a ray meets before `limit`. `azimuth` is clockwise from the first column; `level` the
    /// ray's length over ground.
    #[inline]
    #[allow(clippy::too_many_arguments)] // a ray in its parts; one place calls it, once for each ray
    pub fn cast(
        &self,
        azimuth: f64,
        level: f64,
        origin: &[f64; 3],
        ray: &[f64; 3],
        t: f64,
        limit: f64,
        chance: u64,
    ) -> Option<(Hit, Option<u32>)> {
        let bin = ((azimuth + LEAD) * self.bins_per_radian) as i32 as usize;
        let mut best = None;
        let slope = (ray[2] / level) as f32;
        self.table.each(bin, slope, limit, level, |index, limit| {
            let instance = &self.all[index as usize];
            let own_hash = chance ^ u64::from(index).wrapping_mul(0xd6e8_feb8_6659_fd93);
            let hit = instance.cast(origin, ray, t, limit, own_hash)?;
            best = Some((hit, instance.user));
            Some(hit.t)
        });
        best
    }
}

/// Adds a candidate's instances: one for each sector in whose azimuths it is while the sensor looks there.
fn add<'a>(
    found: &mut Vec<(Instance<'a>, [usize; 2])>,
    sectors: &[(f64, BodyState)],
    (agent, span): (&Agent, Span),
    candidate: Candidate<'a>,
    stance_at: impl Fn(f64) -> Option<Stance>,
) {
    let half = 0.5 * span.all / SECTORS as f64;
    let (t, sensor) = &sectors[SECTORS / 2];
    let Some(reach) = stance_at(*t).and_then(|stance| rough((agent, span), sensor, &candidate, &stance)) else {
        return;
    };
    for (k, (t, sensor)) in sectors.iter().enumerate() {
        let middle = (k as f64 + 0.5) * 2.0 * half - LEAD;
        if away(middle - reach[0]) > half + reach[1] {
            continue;
        }
        let Some(stance) = stance_at(*t) else { continue };
        let view = View::new(agent, sensor, &candidate, &stance);
        let Some([from, to]) = view.azimuths(sensor, span) else {
            continue;
        };
        let margin = view.margin((agent, span), sensor, &stance, half);
        // Azimuths repeat after a turn; the sectors overlap the turn at both ends.
        let shift = TAU * ((middle - 0.5 * (from + to)) / TAU).round();
        for shift in [shift - TAU, shift, shift + TAU] {
            let (from, to) = (from + shift - margin, to + shift + margin);
            let (low, high) = (from.max(middle - half), to.min(middle + half));
            if low <= high {
                let bins = [low, high].map(|azimuth| ((azimuth + LEAD) / span.bin) as usize);
                let own = [k * BINS_PER_SECTOR, (k + 1) * BINS_PER_SECTOR - 1];
                let bins = bins.map(|bin| bin.clamp(own[0], own[1]));
                found.push((view.instance(&candidate, &stance, *t), bins));
                break;
            }
        }
    }
}

/// Middle and half width of the azimuths in which a body can be at any time of the turn; `None` if out of reach.
fn rough(
    (agent, span): (&Agent, Span),
    sensor: &BodyState,
    candidate: &Candidate,
    stance: &Stance,
) -> Option<[f64; 2]> {
    let (x, y) = (stance.pose.x - sensor.position[0], stance.pose.y - sensor.position[1]);
    let distance = (x * x + y * y).sqrt();
    let Solid { low, high, .. } = candidate.solid;
    let (u, v) = (high[0].max(-low[0]), high[1].max(-low[1]));
    let (dx, dy) = (
        sensor.velocity[0] - stance.velocity[0],
        sensor.velocity[1] - stance.velocity[1],
    );
    let radius = (u * u + v * v).sqrt() + 0.07 * (dx.abs() + dy.abs()) + 0.3;
    if distance - radius > span.farthest {
        return None;
    }
    let azimuth = sensor.heading - span.first + PI - libm::atan2(y, x);
    if candidate.own || distance <= radius + 0.5 {
        return Some([azimuth, PI]);
    }
    Some([
        azimuth,
        libm::asin(radius / distance) + 0.07 * sensor.turn_rate.abs() + tilt_margin(agent, sensor),
    ])
}

/// The least turn that makes an angle, either way, rad.
fn away(angle: f64) -> f64 {
    (angle - TAU * (angle / TAU).round()).abs()
}

/// How far the sensor's tilt moves azimuths, rad.
pub(super) fn tilt_margin(agent: &Agent, sensor: &BodyState) -> f64 {
    let mount = agent.mount.pitch.abs() + agent.mount.roll.abs();
    (sensor.slope[0].abs() + sensor.slope[1].abs()) * agent.sensor.steepest * 1.3 + 2e-4 + mount * agent.sensor.slant
}

/// A candidate as seen from the sensor.
struct View {
    /// Corners of the footprint relative to the sensor, m.
    corners: [[f64; 2]; 4],
    near: f64,
    far: f64,
    /// Bottom and top relative to the sensor, m.
    heights: [f64; 2],
    own: bool,
}

impl View {
    fn new(agent: &Agent, sensor: &BodyState, candidate: &Candidate, stance: &Stance) -> View {
        let Solid { low, high, .. } = candidate.solid;
        let (sin, cos) = libm::sincos(stance.pose.heading);
        let (x, y) = (stance.pose.x - sensor.position[0], stance.pose.y - sensor.position[1]);
        let corner = |u: f64, v: f64| [x + u * cos - v * sin, y + u * sin + v * cos];
        let corners = [
            corner(low[0], low[1]),
            corner(high[0], low[1]),
            corner(high[0], high[1]),
            corner(low[0], high[1]),
        ];
        // The sensor in the body's frame: the nearest point of the footprint follows by clamping.
        let (u, v) = (-(x * cos + y * sin), -(y * cos - x * sin));
        let (du, dv) = (u - u.clamp(low[0], high[0]), v - v.clamp(low[1], high[1]));
        let near = (du * du + dv * dv).sqrt();
        let far = corners
            .iter()
            .map(|c| (c[0] * c[0] + c[1] * c[1]).sqrt())
            .fold(0.0, f64::max);
        let eye = sensor.position[2] + agent.info.sensor_height;
        let lean =
            stance.footing.slope[0].abs() * high[0].max(-low[0]) + stance.footing.slope[1].abs() * high[1].max(-low[1]);
        let foot = stance.footing.z - eye;
        View {
            corners,
            near,
            far,
            heights: [foot + low[2] - lean - 0.02, foot + high[2] + lean + 0.02],
            own: candidate.own,
        }
    }

    /// Clockwise azimuths from the sensor's rear that the footprint takes up; `None` if it is far out of reach.
    fn azimuths(&self, sensor: &BodyState, span: Span) -> Option<[f64; 2]> {
        if self.near > span.farthest {
            return None;
        }
        if self.own || self.near < 0.5 {
            return Some([-TAU, 2.0 * TAU]);
        }
        let clockwise = |c: &[f64; 2]| sensor.heading - span.first + PI - libm::atan2(c[1], c[0]);
        let first = clockwise(&self.corners[0]);
        let (mut low, mut high) = (first, first);
        for corner in &self.corners[1..] {
            // A convex footprint without the sensor in it spans less than half a turn.
            let azimuth = clockwise(corner);
            let azimuth = azimuth - TAU * ((azimuth - first) / TAU).round();
            low = low.min(azimuth);
            high = high.max(azimuth);
        }
        Some([low, high])
    }

    /// How far the azimuths may be off: motion within the sector, and the tilt of the sensor.
    fn margin(&self, (agent, span): (&Agent, Span), sensor: &BodyState, stance: &Stance, half_sector: f64) -> f64 {
        let time = half_sector / span.width * TURN + 1e-4;
        let (dx, dy) = (
            sensor.velocity[0] - stance.velocity[0],
            sensor.velocity[1] - stance.velocity[1],
        );
        let radius = 0.5 * (self.far - self.near);
        let moved = (dx.abs() + dy.abs() + stance.turn_rate.abs() * radius) * time;
        (moved / self.near.max(0.5)).min(FRAC_PI_2) + sensor.turn_rate.abs() * time + tilt_margin(agent, sensor)
    }

    fn instance<'a>(&self, candidate: &Candidate<'a>, stance: &Stance, t: f64) -> Instance<'a> {
        let [foot, top] = self.heights;
        let (near, far) = ((self.near - 0.2).max(1e-3), self.far + 0.2);
        let slope = |height: f64, toward: f64| height / if height * toward > 0.0 { near } else { far };
        let (sin, cos) = libm::sincos(stance.pose.heading);
        Instance {
            near: (self.near - 0.2).max(0.0),
            slopes: [slope(foot, -1.0), slope(top, 1.0)],
            solid: candidate.solid,
            user: candidate.user,
            t,
            position: [stance.pose.x, stance.pose.y, stance.footing.z],
            velocity: stance.velocity,
            cos_sin: [cos, sin],
            turn_rate: stance.turn_rate,
            lean: stance.footing.slope,
            stride: stance.stride,
            fixed: candidate.user.is_none(),
        }
    }
}
