//! Which foliage a ray can meet: for each sweep, the masses by azimuth, nearest first.

use std::f64::consts::{PI, TAU};

use super::table::{Extent, Table};
use super::wedge::{Columns, LANES, Wedge};
use super::{BINS, LEAD, Span, TURN};
use crate::agents::{Agent, BodyState};
use crate::place::Foliage;

/// The foliage of one sweep.
pub(super) struct Thicket<'a> {
    /// What is in reach, nearest first.
    near: Vec<(&'a Foliage, Extent)>,
    table: Table,
}

impl<'a> Thicket<'a> {
    /// What an agent can see, for wedges with these bins of azimuth; `sensor` is its body in the middle of the sweep.
    pub fn new(all: &'a [Foliage], agent: &Agent, sensor: &BodyState, wedges: &[[i16; 2]]) -> Self {
        let span = Span::of(agent);
        let mut near: Vec<(&Foliage, Extent)> = Vec::new();
        for foliage in all {
            seen(foliage, agent, sensor, span, |extent| near.push((foliage, extent)));
        }
        // Stable: at equal distance the order of the place decides.
        near.sort_by(|a, b| a.1.near.total_cmp(&b.1.near));
        let table = Table::new(wedges, near.iter().map(|(_, extent)| extent.bins));
        Thicket { near, table }
    }

    /// Casts the rays of a wedge.
    pub fn cast(&self, columns: &Columns, number: usize, wedge: &mut Wedge) {
        for index in self.table.of(number) {
            let (foliage, extent) = &self.near[index];
            wedge.each(extent, |row, group| {
                let origins = columns.origins(row, group);
                let [enters, leaves] = foliage.crossing(&origins, row.rays(group), row.limits(group));
                for k in 0..LANES {
                    if enters[k] >= leaves[k] {
                        continue;
                    }
                    let ray = group * LANES + k;
                    let origin = [origins[0][k], origins[1][k], origins[2][k]];
                    if let Some(hit) = foliage.within(&origin, &row.ray(ray), [enters[k], leaves[k]], row.hash(ray)) {
                        row.meet(ray, hit, None);
                    }
                }
            });
        }
    }
}

/// Where a mass may be met: once or, near the first column, at either end of the sweep; nowhere if it is out of reach.
fn seen(foliage: &Foliage, agent: &Agent, sensor: &BodyState, span: Span, mut add: impl FnMut(Extent)) {
    let [vx, vy, vz] = sensor.velocity;
    let speed = 1.2 * (vx.abs() + vy.abs());
    let from = |until: f64| {
        let x = foliage.center[0] - sensor.position[0] - vx * until;
        let y = foliage.center[1] - sensor.position[1] - vy * until;
        let azimuth = sensor.heading + sensor.turn_rate * until - span.first + PI - libm::atan2(y, x);
        (x * x + y * y, azimuth)
    };
    let radius = foliage.radius();
    let reach = span.farthest.min(foliage.reach()) + radius;
    let (square, azimuth) = from(0.0);
    if square > reach * reach {
        return;
    }
    let distance = square.sqrt();
    let moved = 0.5 * TURN * speed + 0.05;
    if distance < 2.0 * (radius + moved) {
        let [low, high] = slopes(
            foliage,
            agent,
            sensor,
            (distance, 0.0),
            [moved, 0.5 * TURN * vz.abs() + 0.05],
        );
        add(Extent {
            bins: [0, BINS as i16 - 1],
            low,
            high,
            near: (distance - radius - moved).max(0.0) * 0.999_99,
        });
        return;
    }
    let azimuth = azimuth - TAU * (azimuth / TAU).floor();
    for azimuth in [azimuth - TAU, azimuth, azimuth + TAU] {
        if !(-0.7..span.width + 0.7).contains(&azimuth) {
            continue;
        }
        // Where it is while the sensor looks its way, and how far off that may be: beams look ahead of their columns.
        let until = (azimuth / span.width - 0.5).clamp(-0.6, 0.6) * TURN;
        let (square, then) = from(until);
        let distance = square.sqrt();
        let shift = then - azimuth - TAU * ((then - azimuth) / TAU).round();
        let share = radius / distance;
        let time = (1.05 * share + LEAD + shift.abs() + 0.05) / span.width * TURN + 1e-4;
        let (moved, risen) = (speed * time + 0.04, vz.abs() * time + 0.05);
        let [low, high] = slopes(foliage, agent, sensor, (distance, until), [moved, risen]);
        // asin(s) <= 1.05 s up to one half.
        let aside = 1.05 * (share + moved / distance) + sensor.turn_rate.abs() * 0.002 + 5e-4;
        let half = aside + tilt_margin(agent, sensor, low.abs().max(high.abs()));
        let bin = |azimuth: f64| (azimuth + LEAD) / span.bin;
        let (from, to) = (bin(azimuth + shift - half), bin(azimuth + shift + half));
        if to >= 0.0 && from < BINS as f64 {
            add(Extent {
                bins: [from as i16, (to as i16).min(BINS as i16 - 1)],
                low,
                high,
                near: (distance - radius - moved).max(0.0) * 0.999_99,
            });
        }
    }
}

/// How far the sensor's tilt moves the azimuths of rays of slopes up to one, rad.
fn tilt_margin(agent: &Agent, sensor: &BodyState, steepest: f32) -> f64 {
    let [along, across] = sensor.slope;
    // A vehicle's changes in the course of a sweep.
    let change = if agent.user.is_some() { 0.02 } else { 0.0 };
    let tilt = along.abs() + across.abs() + agent.mount.pitch.abs() + agent.mount.roll.abs() + change;
    tilt * (1.3 * (f64::from(steepest) + tilt) + 0.02)
}

/// Bounds of the slopes of rays that meet a mass from a distance over ground, m, and a time after the middle of the sweep,
/// s, which are known but for some metres over ground and up.
fn slopes(
    foliage: &Foliage,
    agent: &Agent,
    sensor: &BodyState,
    (distance, until): (f64, f64),
    [moved, risen]: [f64; 2],
) -> [f32; 2] {
    let eye = sensor.position[2] + sensor.velocity[2] * until + agent.info.sensor_height;
    let up = foliage.center[2] - eye;
    let radius = foliage.radius();
    let (least, most) = ((distance - radius - moved).max(1e-3), distance + radius + moved);
    let slope = |height: f64, toward: f64| height / if height * toward > 0.0 { least } else { most };
    let corners = [
        slope(up - foliage.rise() - risen, -1.0),
        slope(up + foliage.rise() + risen, 1.0),
    ];
    let [low, high] = foliage.slopes(distance, up, moved.max(risen)).unwrap_or(corners);
    [low as f32 - 1e-5, high as f32 + 1e-5]
}
