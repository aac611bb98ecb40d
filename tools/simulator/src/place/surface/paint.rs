//! What is painted on the asphalt.

use super::field::Field;
use crate::path::Path;
use crate::place::network::{CROSSING_HALF, Node, Road};

/// Side of the cells that list paint, m.
const PAINT_CELL: f64 = 2.0;

/// A strip of paint: along its direction solid, or with dashes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Paint {
    pub x: f32,
    pub y: f32,
    pub cos: f32,
    pub sin: f32,
    pub length: f32,
    pub half: f32,
    /// Distance of the dashes, their share, and where along them the strip begins; a period of 0 for solid strips.
    period: f32,
    pub share: f32,
    begin: f32,
}

impl Paint {
    #[inline]
    pub(super) fn covers(&self, x: f64, y: f64) -> bool {
        let (dx, dy) = (x as f32 - self.x, y as f32 - self.y);
        let (along, across) = (dx * self.cos + dy * self.sin, dy * self.cos - dx * self.sin);
        if across.abs() > self.half || along < 0.0 || along > self.length {
            return false;
        }
        if self.period == 0.0 {
            return true;
        }
        let at = (along + self.begin) / self.period;
        at - at.floor() < self.share
    }
}

const LINE: f64 = 0.07;

/// Adds the strips of a line beside a road.
fn line_along(all: &mut Vec<Paint>, line: &Path, [from, to]: [f64; 2], offset: f64, half: f64, dashes: [f64; 2]) {
    const STEP: f64 = 2.0;
    let count = ((to - from) / STEP).ceil().max(0.0) as usize;
    let mut begin = 0.0;
    for k in 0..count {
        let s = from + k as f64 * STEP;
        let end = (s + STEP).min(to);
        let (a, b) = (line.at(s).0.aside(offset), line.at(end).0.aside(offset));
        let (dx, dy) = (b.x - a.x, b.y - a.y);
        let length = (dx * dx + dy * dy).sqrt();
        if length < 1e-3 {
            continue;
        }
        all.push(Paint {
            x: a.x as f32,
            y: a.y as f32,
            cos: (dx / length) as f32,
            sin: (dy / length) as f32,
            length: length as f32,
            half: half as f32,
            period: dashes[0] as f32,
            share: dashes[1] as f32,
            begin: begin as f32,
        });
        begin += length;
    }
}

/// All paint of a place.
pub(super) fn strips(roads: &[Road], nodes: &[Node]) -> Vec<Paint> {
    const SOLID: [f64; 2] = [0.0, 1.0];
    const DASHED: [f64; 2] = [9.0, 1.0 / 3.0];
    let mut all = Vec::new();
    for road in roads {
        let section = &road.section;
        let span = road.span();
        let strips = section.strips();
        for strip in strips.iter().filter(|strip| strip.index.is_some()) {
            let outward = if strip.forward { -1.0 } else { 1.0 };
            let lanes = section.lanes[usize::from(!strip.forward)];
            let outer = strip.index == Some(lanes - 1);
            let edge = strip.offset + outward * 0.5 * strip.width;
            let kind = match () {
                () if !outer => Some(DASHED),
                () if section.cycle > 0.0 || section.shoulder > 0.4 => Some(SOLID),
                () => None,
            };
            if let Some(dashes) = kind {
                line_along(&mut all, &road.line, span, edge, LINE, dashes);
            }
            if strip.index == Some(0) && section.median > 1.0 {
                let inner = strip.offset - outward * 0.5 * strip.width;
                line_along(&mut all, &road.line, span, inner, LINE, SOLID);
            }
        }
        if section.lanes[1] > 0 && section.median <= 1.0 && section.width > 2.9 {
            let dashes = if section.lanes[0] > 1 { SOLID } else { DASHED };
            line_along(&mut all, &road.line, span, section.middle(), LINE, dashes);
        }
        bay_lines(&mut all, road);
    }
    for node in nodes {
        for (k, arm) in node.arms.iter().enumerate() {
            let section = &roads[arm.road].section;
            let half = section.half();
            if let Some(middle) = arm.crossing {
                // Bars along the road, one after the other across it.
                let from = node.place(k, middle, half);
                let mut across = Path::from(from.x, from.y, from.heading - std::f64::consts::FRAC_PI_2);
                across.line(2.0 * half);
                line_along(&mut all, &across, [0.0, 2.0 * half], 0.0, CROSSING_HALF, [1.0, 0.5]);
            }
            // A stop line lies across the lanes that come in.
            let inward: Vec<_> = section
                .strips()
                .into_iter()
                .filter(|s| s.forward != arm.at_start)
                .collect();
            let sign = if arm.at_start { 1.0 } else { -1.0 };
            for strip in inward.iter().filter(|strip| strip.index.is_some()) {
                let left = node.place(k, arm.mouth + 0.3, sign * strip.offset + 0.5 * strip.width);
                let mut across = Path::from(left.x, left.y, left.heading - std::f64::consts::FRAC_PI_2);
                across.line(strip.width);
                line_along(&mut all, &across, [0.0, strip.width], 0.0, 0.15, SOLID);
            }
        }
    }
    all
}

/// Lines between bays at an angle.
fn bay_lines(all: &mut Vec<Paint>, road: &Road) {
    for (pose, angle) in road.stands() {
        if angle == 0.0 {
            continue;
        }
        let depth = 2.4;
        for side in [-1.0, 1.0] {
            let from = pose.at(-depth, side * 1.27);
            let mut line = Path::from(from.x, from.y, from.heading);
            line.line(2.0 * depth);
            line_along(all, &line, [0.0, 2.0 * depth], 0.0, 0.05, [0.0, 1.0]);
        }
    }
}

/// Lists paint for the cells that it touches.
pub(super) fn listed(all: Vec<Paint>, bounds: [f64; 4]) -> (Field<u32>, Vec<Paint>) {
    let mut starts = Field::new(bounds, PAINT_CELL, 0u32);
    let mut pairs: Vec<(usize, usize)> = Vec::new();
    for (k, paint) in all.iter().enumerate() {
        let [length, half, cos, sin] = [paint.length, paint.half, paint.cos, paint.sin].map(f64::from);
        let ends = [(0.0, half), (0.0, -half), (length, half), (length, -half)].map(|(u, v)| {
            (
                f64::from(paint.x) + u * cos - v * sin,
                f64::from(paint.y) + u * sin + v * cos,
            )
        });
        let low = |f: fn(&(f64, f64)) -> f64| ends.iter().map(f).fold(f64::MAX, f64::min);
        let high = |f: fn(&(f64, f64)) -> f64| ends.iter().map(f).fold(f64::MIN, f64::max);
        let index = |v: f64, from: f64, count: usize| ((v - from) / PAINT_CELL).clamp(0.0, (count - 1) as f64) as usize;
        for row in index(low(|e| e.1), starts.y, starts.rows)..=index(high(|e| e.1), starts.y, starts.rows) {
            for column in index(low(|e| e.0), starts.x, starts.columns)..=index(high(|e| e.0), starts.x, starts.columns)
            {
                pairs.push((row * starts.columns + column, k));
            }
        }
    }
    pairs.sort_unstable();
    let mut next = 0;
    for cell in 0..starts.values.len() {
        starts.values[cell] = next as u32;
        while next < pairs.len() && pairs[next].0 == cell {
            next += 1;
        }
    }
    let paint = pairs.into_iter().map(|(_, k)| all[k]).collect();
    (starts, paint)
}
