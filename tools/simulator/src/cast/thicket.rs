//! Which foliage a ray can meet: for each sweep, the masses by azimuth, nearest first.

use std::f64::consts::{PI, TAU};

use super::instances::{LEAD, Span, TURN, tilt_margin};
use crate::agents::{Agent, BodyState};
use crate::place::Foliage;
use crate::solid::Hit;

const BINS: usize = 1600;

/// Entries that are looked at together.
const TOGETHER: usize = 8;

/// The foliage of one sweep, by azimuth.
pub(super) struct Thicket {
    /// What is in reach, nearest first.
    near: Vec<Foliage>,
    /// `blocks[starts[bin]..starts[bin + 1]]`: what is in a bin, nearest first.
    starts: Vec<u32>,
    blocks: Vec<Block>,
    bins_per_radian: f64,
}

/// What decides whether a mass of a bin is looked at, rounded outwards: least distance over ground, m, and bounds of
/// the slope of rays that can meet it.
#[derive(Clone, Copy)]
struct Bounds {
    near: f32,
    low: f32,
    high: f32,
}

/// Bounds of some masses of a bin; what is left over can never be met.
#[derive(Clone, Copy)]
struct Block {
    near: [f32; TOGETHER],
    low: [f32; TOGETHER],
    high: [f32; TOGETHER],
    index: [u32; TOGETHER],
}

const EMPTY: Block = Block {
    near: [f32::INFINITY; TOGETHER],
    low: [f32::INFINITY; TOGETHER],
    high: [f32::NEG_INFINITY; TOGETHER],
    index: [0; TOGETHER],
};

impl Thicket {
    /// What an agent can see; `sensor` is its body in the middle of the sweep.
    pub fn new(all: &[Foliage], agent: &Agent, sensor: &BodyState) -> Self {
        let span = Span::of(agent);
        let bin = span.all / BINS as f64;
        let mut found: Vec<(Bounds, [u16; 2], u32)> = Vec::new();
        for (index, foliage) in all.iter().enumerate() {
            let Some((bounds, azimuth, half)) = seen(foliage, agent, sensor, span) else {
                continue;
            };
            for turn in [-TAU, 0.0, TAU] {
                let low = (azimuth + turn - half + LEAD) / bin;
                let high = (azimuth + turn + half + LEAD) / bin;
                if high >= 0.0 && low < BINS as f64 {
                    let bins = [low.max(0.0) as u16, (high as u16).min(BINS as u16 - 1)];
                    found.push((bounds, bins, index as u32));
                }
            }
        }
        // Stable: at equal distance the order of the place decides.
        found.sort_by(|a, b| a.0.near.total_cmp(&b.0.near));
        let mut counts = [0u32; BINS];
        for (_, [from, to], _) in &found {
            counts[usize::from(*from)..=usize::from(*to)]
                .iter_mut()
                .for_each(|count| *count += 1);
        }
        let mut starts = Vec::with_capacity(BINS + 1);
        starts.push(0);
        for count in &counts {
            starts.push(starts[starts.len() - 1] + count.div_ceil(TOGETHER as u32));
        }
        let mut blocks = vec![EMPTY; starts[BINS] as usize];
        let mut fill = [0usize; BINS];
        for (index, (bounds, [from, to], _)) in found.iter().enumerate() {
            for bin in usize::from(*from)..=usize::from(*to) {
                let block = &mut blocks[starts[bin] as usize + fill[bin] / TOGETHER];
                let place = fill[bin] % TOGETHER;
                block.near[place] = bounds.near;
                block.low[place] = bounds.low;
                block.high[place] = bounds.high;
                block.index[place] = index as u32;
                fill[bin] += 1;
            }
        }
        Thicket {
            near: found.iter().map(|(_, _, index)| all[*index as usize].clone()).collect(),
            starts,
            blocks,
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
        let bin = (((azimuth + LEAD) * self.bins_per_radian) as i32 as usize).min(BINS - 1);
        let slope = (ray[2] / level) as f32;
        let mut limit = limit;
        let mut reach = (limit * level) as f32;
        let mut best = None;
        for block in &self.blocks[self.starts[bin] as usize..self.starts[bin + 1] as usize] {
            if block.near[0] > reach {
                break;
            }
            let mut mask = 0u32;
            for k in 0..TOGETHER {
                let meets = (block.near[k] <= reach) & (block.low[k] <= slope) & (block.high[k] >= slope);
                mask |= u32::from(meets) << k;
            }
            while mask != 0 {
                let k = mask.trailing_zeros() as usize;
                mask &= mask - 1;
                let foliage = &self.near[block.index[k] as usize];
                if block.near[k] <= reach
                    && let Some(hit) = foliage.cast(origin, ray, limit, chance)
                {
                    limit = hit.t;
                    reach = (limit * level) as f32;
                    best = Some(hit);
                }
            }
        }
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
    let shifted = (x * vy - y * vx) * until / square.max(1e-6) + sensor.turn_rate * until;
    let (share, stray) = (radius / distance, moved / distance);
    let half = match close {
        true => PI,
        // asin(s) <= 1.05 s up to one half.
        false => {
            1.05 * share + stray * stray + 0.12 * stray + sensor.turn_rate.abs() * 0.002 + tilt_margin(agent, sensor)
        }
    };
    let eye = sensor.position[2] + agent.info.sensor_height;
    let rise = 0.5 * TURN * vz.abs() + 0.05;
    let foot = foliage.center[2] - foliage.rise() - eye - rise;
    let top = foliage.center[2] + foliage.rise() - eye + rise;
    let (least, most) = ((distance - radius - moved).max(1e-3), distance + radius + moved);
    let slope = |height: f64, toward: f64| (height / if height * toward > 0.0 { least } else { most }) as f32;
    let bounds = Bounds {
        near: ((distance - radius - moved).max(0.0) * 0.999_99) as f32,
        low: slope(foot, -1.0) - 1e-5,
        high: slope(top, 1.0) + 1e-5,
    };
    Some((bounds, azimuth + shifted, half))
}
