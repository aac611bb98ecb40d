//! Which foliage a ray can meet: for each sweep, the masses by azimuth, nearest first.

use std::f64::consts::{PI, TAU};

use super::table::{Extent, Table};
use super::wedge::{Columns, LANES, Wedge};
use super::{BINS, LEAD, Shot, Span, TURN};
use crate::agents::{Agent, BodyState};
use crate::place::Foliage;

/// The foliage of one sweep.
pub(super) struct Thicket<'a> {
    /// What is in reach, nearest first.
    near: Vec<(&'a Foliage, Extent)>,
    table: Table,
}

impl<'a> Thicket<'a> {
    /// What can be seen of a place in a sweep, for wedges with these bins of azimuth.
    pub fn new(shot: &Shot<'a>, wedges: &[[i16; 2]]) -> Self {
        let eye = Eye::new(shot);
        let mut near: Vec<(&Foliage, Extent)> = Vec::new();
        for foliage in &shot.world.place.foliage {
            eye.see(foliage, |extent| near.push((foliage, extent)));
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

/// The sensor in the course of a sweep.
struct Eye<'a> {
    agent: &'a Agent,
    span: Span,
    /// Its body from the start of the sweep to the end, every `STEP` seconds.
    bodies: Vec<BodyState>,
    /// Bounds of its speed over ground and up, m/s, and of its turn rate, rad/s.
    speed: f64,
    climb: f64,
    turn: f64,
}

/// Time between two known bodies, s.
const STEP: f64 = 0.01;

impl<'a> Eye<'a> {
    fn new(shot: &'a Shot) -> Self {
        let steps = (TURN / STEP).round() as usize;
        let bodies: Vec<BodyState> = (0..=steps)
            .map(|k| shot.start + k as f64 * STEP)
            .map(|t| shot.agent.body(shot.world.place, shot.world.traffic, t))
            .collect();
        let most = |rate: &dyn Fn(&BodyState) -> f64| bodies.iter().map(rate).fold(0.0, f64::max);
        Eye {
            speed: 1.2 * most(&|body| body.velocity[0].abs() + body.velocity[1].abs()),
            climb: most(&|body| body.velocity[2].abs()),
            turn: most(&|body| body.turn_rate.abs()),
            agent: shot.agent,
            span: shot.span,
            bodies,
        }
    }

    /// The body at a time of the sweep, moved on from the nearest known one.
    fn body(&self, t: f64) -> BodyState {
        let nearest = ((t / STEP).round() as usize).min(self.bodies.len() - 1);
        let mut body = self.bodies[nearest];
        let since = t - nearest as f64 * STEP;
        for k in 0..3 {
            body.position[k] += body.velocity[k] * since;
        }
        body.heading += body.turn_rate * since;
        body
    }

    /// Square of the distance over ground of a mass from the sensor, m², and its azimuth clockwise from the first column.
    fn direction(&self, foliage: &Foliage, body: &BodyState) -> (f64, f64) {
        let x = foliage.center[0] - body.position[0];
        let y = foliage.center[1] - body.position[1];
        let azimuth = body.heading - self.span.first + PI - libm::atan2(y, x);
        (x * x + y * y, azimuth)
    }

    /// Where a mass may be met: once or, near the first column, at either end of the sweep; nowhere if it is out of reach.
    fn see(&self, foliage: &Foliage, mut add: impl FnMut(Extent)) {
        let (span, middle) = (self.span, &self.bodies[self.bodies.len() / 2]);
        let radius = foliage.radius();
        let reach = span.farthest.min(foliage.reach()) + radius;
        let (square, azimuth) = self.direction(foliage, middle);
        if square > reach * reach {
            return;
        }
        let distance = square.sqrt();
        let moved = 0.5 * TURN * self.speed + 0.05;
        if distance < 2.0 * (radius + moved) {
            let [low, high] = self.slopes(foliage, middle, distance, [moved, 0.5 * TURN * self.climb + 0.05]);
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
            let body = self.body((azimuth / span.width).clamp(0.0, 1.0) * TURN);
            let (square, then) = self.direction(foliage, &body);
            let distance = square.sqrt();
            let shift = then - azimuth - TAU * ((then - azimuth) / TAU).round();
            let share = radius / distance;
            let time = (1.05 * share + LEAD + shift.abs() + 0.05) / span.width * TURN + 1e-4;
            let (moved, risen) = (self.speed * time + 0.04, self.climb * time + 0.05);
            let [low, high] = self.slopes(foliage, &body, distance, [moved, risen]);
            // asin(s) <= 1.05 s up to one half.
            let aside = 1.05 * (share + moved / distance) + self.turn * (time + 0.5 * STEP) + 5e-4;
            let half = aside + self.tilt_margin(&body, low.abs().max(high.abs()));
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
    fn tilt_margin(&self, body: &BodyState, steepest: f32) -> f64 {
        let ([along, across], mount) = (body.slope, &self.agent.mount);
        // A vehicle's changes in the course of a sweep.
        let change = if self.agent.user.is_some() { 0.02 } else { 0.0 };
        let tilt = along.abs() + across.abs() + mount.pitch.abs() + mount.roll.abs() + change;
        tilt * (1.3 * (f64::from(steepest) + tilt) + 0.02)
    }

    /// Bounds of the slopes of rays that meet a mass from a distance over ground, m, where the sensor's place is known but
    /// for some metres over ground and up.
    fn slopes(&self, foliage: &Foliage, body: &BodyState, distance: f64, [moved, risen]: [f64; 2]) -> [f32; 2] {
        let up = foliage.center[2] - body.position[2] - self.agent.info.sensor_height;
        let radius = foliage.radius();
        let (min, most) = ((distance - radius - moved).max(1e-3), distance + radius + moved);
        let slope = |height: f64, toward: f64| height / if height * toward > 0.0 { min } else { most };
        let corners = [
            slope(up - foliage.rise() - risen, -1.0),
            slope(up + foliage.rise() + risen, 1.0),
        ];
        let [low, high] = foliage.slopes(distance, up, moved.max(risen)).unwrap_or(corners);
        [low as f32 - 1e-5, high as f32 + 1e-5]
    }
}
