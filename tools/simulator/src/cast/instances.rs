//! The bodies that rays can meet in a sweep, by azimuth.

mod view;

use std::f64::consts::{PI, TAU};

use super::table::{Extent, Table};
use super::wedge::{Columns, LANES, Lanes, Row, Wedge};
use super::{BINS, LEAD, Span, TURN, World};
use crate::agents::{Agent, BodyState};
use crate::solid::Solid;
use crate::traffic::Footing;
use view::{Candidate, Stance, View, away, tilt_margin};

/// The sweep is cut into sectors, in each of which everybody moves straight.
const SECTORS: usize = 40;
const BINS_PER_SECTOR: usize = BINS / SECTORS;
/// Where a place is overgrown, what is lower than this is looked for up to `LOW_REACH`, m.
const LOW: f64 = 2.2;
const LOW_REACH: f64 = 120.0;

/// A body as it is while the sensor looks its way.
pub(super) struct Instance<'a> {
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
    /// A ray in the body's frame; `t` is the ray's time.
    #[inline(always)]
    fn local<const FIXED: bool>(&self, origin: [f64; 3], ray: [f64; 3], t: f64) -> [[f64; 3]; 2] {
        let [mut cos, mut sin] = self.cos_sin;
        let (mut x, mut y) = (origin[0] - self.position[0], origin[1] - self.position[1]);
        let (mut w, mut dw) = (origin[2] - self.position[2], ray[2]);
        if !FIXED {
            let dt = t - self.t;
            let turn = self.turn_rate * dt;
            (cos, sin) = (cos - sin * turn, sin + cos * turn);
            x -= self.velocity[0] * dt;
            y -= self.velocity[1] * dt;
        }
        let (u, v) = (cos * x + sin * y, cos * y - sin * x);
        let (du, dv) = (cos * ray[0] + sin * ray[1], cos * ray[1] - sin * ray[0]);
        if !FIXED {
            w -= self.lean[0] * u + self.lean[1] * v;
            dw -= self.lean[0] * du + self.lean[1] * dv;
        }
        [[u, v, w], [du, dv, dw]]
    }

    /// Which rays of a group meet the box around the body before what they have met: those with 0 or more.
    #[inline(always)]
    fn room<const FIXED: bool>(&self, columns: &Columns, row: &Row, group: usize) -> Lanes {
        let origins = columns.origins(row, group);
        let ([x, y, z], [dx, dy, dz]) = (&origins, row.rays(group));
        let (limits, times) = (row.limits(group), columns.times(row, group));
        let mut room = [0.0; LANES];
        for k in 0..LANES {
            let (origin, ray) = ([x[k], y[k], z[k]], [dx[k], dy[k], dz[k]]);
            let [origin, ray] = self.local::<FIXED>(origin, ray, times[k] + row.fires);
            let (mut enter, mut leave) = (f64::NEG_INFINITY, limits[k]);
            for axis in 0..3 {
                let inverse = 1.0 / ray[axis];
                let a = (self.solid.low[axis] - origin[axis]) * inverse;
                let b = (self.solid.high[axis] - origin[axis]) * inverse;
                let (near, far) = if a < b { (a, b) } else { (b, a) };
                enter = if near > enter { near } else { enter };
                leave = if far < leave { far } else { leave };
            }
            let within = leave - enter;
            room[k] = if leave < within { leave } else { within };
        }
        room
    }

    /// Casts the rays of a group that look into the body's bins; its number goes into their hashes.
    #[inline(always)]
    fn cast<const FIXED: bool>(&self, columns: &Columns, row: &mut Row, group: usize, (number, bins): (u64, [i16; 2])) {
        let room = self.room::<FIXED>(columns, row, group);
        for (k, room) in room.iter().enumerate() {
            let ray = group * LANES + k;
            if *room < 0.0 || !row.looks_into(ray, bins) {
                continue;
            }
            let t = columns.time(row, ray) + row.fires;
            let [from, step] = self.local::<FIXED>(columns.origin(row, ray), row.ray(ray), t);
            let chance = row.hash(ray) ^ number.wrapping_mul(0xd6e8_feb8_6659_fd93);
            if let Some(hit) = self.solid.cast(from, step, row.limit(ray), chance, self.stride) {
                row.meet(ray, hit, self.user);
            }
        }
    }
}

/// The bodies of one sweep.
pub(super) struct Instances<'a> {
    /// Nearest first.
    all: Vec<(Instance<'a>, Extent)>,
    table: Table,
}

impl<'a> Instances<'a> {
    /// Everything that `agent` can see in the turn that begins at `start` seconds, for wedges with these bins of azimuth.
    pub fn new(world: &World<'a>, agent: &Agent, start: f64, wedges: &[[i16; 2]]) -> Self {
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
        // Stable: at equal distance the order of fixtures and road users decides.
        found.sort_by(|a, b| a.1.near.total_cmp(&b.1.near));
        let table = Table::new(wedges, found.iter().map(|(_, extent)| extent.bins));
        Instances { all: found, table }
    }

    /// Casts the rays of a wedge.
    pub fn cast(&self, columns: &Columns, number: usize, wedge: &mut Wedge) {
        for index in self.table.of(number) {
            let (instance, extent) = &self.all[index];
            let place = (index as u64, extent.bins);
            if instance.fixed {
                wedge.each(extent, |row, group| instance.cast::<true>(columns, row, group, place));
            } else {
                wedge.each(extent, |row, group| instance.cast::<false>(columns, row, group, place));
            }
        }
    }
}

/// Adds a candidate's instances: one for each sector in whose azimuths it is while the sensor looks there.
fn add<'a>(
    found: &mut Vec<(Instance<'a>, Extent)>,
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
                let bins = bins.map(|bin| bin.clamp(own[0], own[1]) as i16);
                found.push((view.instance(&candidate, &stance, *t), view.extent(bins)));
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
