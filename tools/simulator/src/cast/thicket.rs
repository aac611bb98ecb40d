//! Which foliage a ray can meet: for each sweep, the masses by azimuth, nearest first.

use std::f64::consts::{PI, TAU};

use super::instances::{LEAD, Span, TURN, tilt_margin};
use super::table::{Bounds, Table, TableOf};
use crate::agents::{Agent, BodyState};
use crate::place::Foliage;
use crate::solid::Hit;

const BINS: usize = 1600;

/// The foliage of one sweep, by azimuth.
pub(super) struct Thicket {
    /// What is in reach, nearest first.
    near: Vec<Foliage>,
    table: Table,
    bins_per_radian: f64,
}

impl Thicket {
    /// What an agent can see; `sensor` is its body in the middle of the sweep.
    pub fn new(all: &[Foliage], agent: &Agent, sensor: &BodyState) -> Self {
        let span = Span::of(agent);
        let bin = span.all / BINS as f64;
        let mut found: Vec<(Bounds, [usize; 2], usize)> = Vec::new();
        for (index, foliage) in all.iter().enumerate() {
            let Some((bounds, azimuth, half)) = seen(foliage, agent, sensor, span) else {
                continue;
            };
            for turn in [-TAU, 0.0, TAU] {
                let low = (azimuth + turn - half + LEAD) / bin;
                let high = (azimuth + turn + half + LEAD) / bin;
                if high >= 0.0 && low < BINS as f64 {
                    found.push((bounds, [low.max(0.0) as usize, (high as usize).min(BINS - 1)], index));
                }
            }
        }
        // Stable: at equal distance the order of the place decides.
        found.sort_by(|a, b| a.0.near.total_cmp(&b.0.near));
        let mut table = TableOf::new(BINS, found.iter().map(|(_, bins, _)| *bins));
        for (index, (bounds, bins, _)) in found.iter().enumerate() {
            table.add(*bins, *bounds, index as u32);
        }
        Thicket {
            near: found.iter().map(|(_, _, index)| all[*index].clone()).collect(),
            table: table.finish(),
            bins_per_radian: 1.0 / bin,
        }
    }

    /// Where a ray returns from foliage before `limit`; `azimuth` is clockwise from the first column, `level` the ray's
    /// length over ground.
    #[inline]
    pub fn cast(
        &self,
        azimuth: f64,
        level: f64,
        origin: &[f64; 3],
        ray: &[f64; 3],
        limit: f64,
        chance: u64,
    ) -> Option<Hit> {
        let bin = ((azimuth + LEAD) * self.bins_per_radian) as i32 as usize;
        let slope = (ray[2] / level) as f32;
        let mut best = None;
        self.table.each(bin, slope, limit, level, |index, limit| {
            let hit = self.near[index as usize].cast(origin, ray, limit, chance)?;
            best = Some(hit);
            Some(hit.t)
        });
        best
    }
}

/// Bounds, middle azimuth and half width of a mass; `None` if it is out of reach.
fn seen(foliage: &Foliage, agent: &Agent, sensor: &BodyState, span: Span) -> Option<(Bounds, f64, f64)> {
    let (x, y) = (
        foliage.center[0] - sensor.position[0],
        foliage.center[1] - sensor.position[1],
    );
    let (square, radius) = (x * x + y * y, foliage.radius());
    let reach = span.farthest.min(foliage.reach()) + radius;
    if square > reach * reach {
        return None;
    }
    let distance = square.sqrt();
    let [vx, vy, vz] = sensor.velocity;
    // How far the sensor gets from the middle of its sweep, and a little for what else it does.
    let moved = 0.5 * TURN * (vx.abs() + vy.abs()) * 1.2 + 0.05;
    let close = distance < 2.0 * (radius + moved);
    let turn = (sensor.heading - span.first + PI - libm::atan2(y, x)) / TAU;
    let azimuth = (turn - turn.floor()) * TAU;
    // Where it is while the sensor looks its way, to first order.
    let until = ((azimuth - 0.5 * span.width) / span.width).clamp(-0.6, 0.6) * TURN;
    let drift = (x * vy - y * vx) / square.max(1e-6) + sensor.turn_rate;
    let shifted = drift * until;
    // Near the first column it may be seen at either end of the sweep.
    let ends = if azimuth.min(TAU - azimuth) < 0.35 {
        drift.abs() * TURN
    } else {
        0.0
    };
    let (share, stray) = (radius / distance, moved / distance);
    let half = match close {
        true => PI,
        // asin(s) <= 1.05 s up to one half.
        false => {
            let aside = 1.05 * share + stray * stray + 0.12 * stray;
            aside + sensor.turn_rate.abs() * 0.002 + tilt_margin(agent, sensor) + ends
        }
    };
    let eye = sensor.position[2] + agent.info.sensor_height;
    let rise = 0.5 * TURN * vz.abs() + 0.05;
    let foot = foliage.center[2] - foliage.rise() - eye - rise;
    let top = foliage.center[2] + foliage.rise() - eye + rise;
    let (least, most) = ((distance - radius - moved).max(1e-3), distance + radius + moved);
    let slope = |height: f64, toward: f64| (height / if height * toward > 0.0 { least } else { most }) as f32;
    let up = foliage.center[2] - eye;
    let slopes = foliage.slopes(distance, up, moved.max(rise));
    let [low, high] = slopes.map_or([slope(foot, -1.0), slope(top, 1.0)], |slopes| slopes.map(|s| s as f32));
    let bounds = Bounds {
        near: ((distance - radius - moved).max(0.0) * 0.999_99) as f32,
        low: low - 1e-5,
        high: high + 1e-5,
    };
    Some((bounds, azimuth + shifted, half))
}
