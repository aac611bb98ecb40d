//! Which foliage a ray can meet: for each sweep, the masses by azimuth, nearest first.

use std::f64::consts::{PI, TAU};

use super::instances::{LEAD, Span, TURN, tilt_margin};
use crate::agents::{Agent, BodyState};
use crate::place::Foliage;
use crate::solid::Hit;

const BINS: usize = 1600;

/// The foliage of one sweep, by azimuth.
pub(super) struct Thicket<'a> {
    near: Vec<Near<'a>>,
    /// `entries[starts[bin]..starts[bin + 1]]`: what is in a bin, nearest first.
    starts: Vec<u32>,
    entries: Vec<Entry>,
    bins_per_radian: f64,
}

struct Near<'a> {
    foliage: &'a Foliage,
    bins: [u32; 2],
    entry: Entry,
}

/// What decides whether a mass of a bin is looked at, rounded outwards: least distance over ground, m, and bounds of
/// the slope of rays that can meet it.
#[derive(Clone, Copy, Default)]
struct Entry {
    near: f32,
    low: f32,
    high: f32,
    index: u32,
}

impl<'a> Thicket<'a> {
    /// What an agent can see; `sensor` is its body in the middle of the sweep.
    pub fn new(all: &'a [Foliage], agent: &Agent, sensor: &BodyState) -> Self {
        let span = Span::of(agent);
        let bin = span.all / BINS as f64;
        let mut near: Vec<Near> = Vec::new();
        for foliage in all {
            let Some((mut entry, azimuth, half)) = seen(foliage, agent, sensor, span) else {
                continue;
            };
            for turn in [-TAU, 0.0, TAU] {
                let low = (azimuth + turn - half + LEAD) / bin;
                let high = (azimuth + turn + half + LEAD) / bin;
                if high < 0.0 || low >= BINS as f64 {
                    continue;
                }
                entry.index = near.len() as u32;
                let bins = [low.max(0.0) as u32, (high as u32).min(BINS as u32 - 1)];
                near.push(Near { foliage, bins, entry });
            }
        }
        // Stable: at equal distance the order of the place decides.
        let mut order: Vec<u32> = (0..near.len() as u32).collect();
        order.sort_by(|a, b| near[*a as usize].entry.near.total_cmp(&near[*b as usize].entry.near));
        let mut starts = vec![0u32; BINS + 1];
        for Near { bins: [from, to], .. } in &near {
            for count in &mut starts[*from as usize + 1..=*to as usize + 1] {
                *count += 1;
            }
        }
        for bin in 0..BINS {
            starts[bin + 1] += starts[bin];
        }
        let mut fill = starts.clone();
        let mut entries = vec![Entry::default(); starts[BINS] as usize];
        for index in order {
            let Near {
                bins: [from, to],
                entry,
                ..
            } = near[index as usize];
            for next in &mut fill[from as usize..=to as usize] {
                entries[*next as usize] = entry;
                *next += 1;
            }
        }
        Thicket {
            near,
            starts,
            entries,
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
        for entry in &self.entries[self.starts[bin] as usize..self.starts[bin + 1] as usize] {
            if entry.near > reach {
                break;
            }
            if slope < entry.low || slope > entry.high {
                continue;
            }
            let foliage = self.near[entry.index as usize].foliage;
            if let Some(hit) = foliage.cast(origin, ray, limit, chance) {
                limit = hit.t;
                reach = (limit * level) as f32;
                best = Some(hit);
            }
        }
        best
    }
}

/// Bounds, middle azimuth and half width of a mass; `None` if it is out of reach.
fn seen(foliage: &Foliage, agent: &Agent, sensor: &BodyState, span: Span) -> Option<(Entry, f64, f64)> {
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
    let foot = foliage.center[2] - foliage.half[2] - eye - rise;
    let top = foliage.center[2] + foliage.half[2] - eye + rise;
    let (least, most) = ((distance - radius - moved).max(1e-3), distance + radius + moved);
    let slope = |height: f64, toward: f64| (height / if height * toward > 0.0 { least } else { most }) as f32;
    let entry = Entry {
        near: ((distance - radius - moved).max(0.0) * 0.999_99) as f32,
        low: slope(foot, -1.0) - 1e-5,
        high: slope(top, 1.0) + 1e-5,
        index: 0,
    };
    Some((entry, azimuth + shifted, half))
}
