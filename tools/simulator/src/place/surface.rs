//! What a point of the ground is, looked up: on which side of a kerb, paved or not, painted or not.
//!
//! The signed distance from the kerbs lies in the nodes of a grid and is bilinear between them: kerbs are where it is
//! zero, which for straight ones is exact. Paint is kept as strips, listed for each cell that they touch.

use super::network::{CROSSING_HALF, Control, Node, OPPOSITE, Road};
use crate::path::{Path, angle_within};
use crate::random::{mix, unit_of};

/// Spacing of the nodes that hold distances, m.
const CELL: f64 = 0.5;
/// Side of the cells that list paint, m.
const PAINT_CELL: f64 = 2.0;
/// Spacing of the nodes that tell open ground, m.
const OPEN_CELL: f64 = 2.0;
/// How far beyond its pavements a road is felt, m.
const BESIDE: f64 = 1.5;
/// Distances are kept up to this, m.
const FARTHEST: f64 = 30.0;

/// What the ground is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Ground {
    Asphalt,
    Paving,
    Green,
}

/// A strip of paint: along its direction solid, or with dashes.
#[derive(Clone, Copy, Debug)]
struct Paint {
    x: f32,
    y: f32,
    cos: f32,
    sin: f32,
    length: f32,
    half: f32,
    /// Distance of the dashes, their share, and where along them the strip begins; a period of 0 for solid strips.
    period: f32,
    share: f32,
    begin: f32,
}

/// A grid of values.
struct Field<T> {
    x: f64,
    y: f64,
    cell: f64,
    columns: usize,
    rows: usize,
    values: Vec<T>,
}

impl<T: Copy> Field<T> {
    fn new([x0, y0, x1, y1]: [f64; 4], cell: f64, value: T) -> Self {
        let count = |from: f64, to: f64| ((to - from) / cell).ceil() as usize + 2;
        let (columns, rows) = (count(x0, x1), count(y0, y1));
        Field {
            x: x0,
            y: y0,
            cell,
            columns,
            rows,
            values: vec![value; columns * rows],
        }
    }

    fn node(&self, i: usize) -> (f64, f64) {
        let (column, row) = (i % self.columns, i / self.columns);
        (self.x + column as f64 * self.cell, self.y + row as f64 * self.cell)
    }

    /// Columns and rows whose nodes lie within `reach` of a point.
    fn around(&self, x: f64, y: f64, reach: f64) -> [usize; 4] {
        let index = |v: f64, limit: usize| (v / self.cell).clamp(0.0, limit as f64) as usize;
        [
            index((x - reach - self.x).ceil(), self.columns),
            index(x + reach - self.x + self.cell, self.columns),
            index((y - reach - self.y).ceil(), self.rows),
            index(y + reach - self.y + self.cell, self.rows),
        ]
    }

    /// The cell of a point, and the point's place in it.
    #[inline(always)]
    fn find(&self, x: f64, y: f64) -> Option<(usize, f64, f64)> {
        let (u, v) = ((x - self.x) * (1.0 / self.cell), (y - self.y) * (1.0 / self.cell));
        if !(u >= 0.0 && v >= 0.0 && u < (self.columns - 1) as f64 && v < (self.rows - 1) as f64) {
            return None;
        }
        let (i, j) = (u as usize, v as usize);
        Some((j * self.columns + i, u - i as f64, v - j as f64))
    }
}

impl Field<f32> {
    #[inline(always)]
    fn at(&self, x: f64, y: f64) -> Option<f64> {
        let (i, u, v) = self.find(x, y)?;
        let [a, b] = [self.values[i], self.values[i + 1]].map(f64::from);
        let [c, d] = [self.values[i + self.columns], self.values[i + self.columns + 1]].map(f64::from);
        let (low, high) = (a + (b - a) * u, c + (d - c) * u);
        Some(low + (high - low) * v)
    }
}

/// Where a point lies along a road: square of its distance from the line, distance along it, offset.
#[derive(Clone, Copy)]
struct Beside {
    square: f32,
    along: f32,
    across: f32,
}

const AWAY: Beside = Beside {
    square: f32::INFINITY,
    along: 0.0,
    across: 0.0,
};

/// The places along a line of the nodes around it: a part of a greater grid.
struct Ribbon {
    field: Field<Beside>,
    /// First column and row of the part.
    first: [usize; 2],
}

impl Ribbon {
    /// The nodes that are near the line: their numbers in the greater grid, and their places.
    fn found<'a, T: Copy>(&'a self, grid: &Field<T>) -> impl Iterator<Item = (usize, Beside)> + use<'a, T> {
        let (columns, [c0, r0]) = (grid.columns, self.first);
        self.field.values.iter().enumerate().filter_map(move |(i, place)| {
            let (column, row) = (i % self.field.columns + c0, i / self.field.columns + r0);
            place.square.is_finite().then_some((row * columns + column, *place))
        })
    }
}

/// The places of the nodes of a grid along a line, as far as `reach` beside it.
fn beside(line: &Path, bounds: [f64; 4], cell: f64, reach: f64) -> Ribbon {
    const STEP: f64 = 2.0;
    let count = (line.length() / STEP).ceil() as usize;
    let samples: Vec<_> = (0..=count)
        .map(|k| (k as f64 * STEP).min(line.length()))
        .map(|s| (s, line.at(s)))
        .collect();
    let mut own = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
    for (_, (pose, _)) in &samples {
        own = [
            own[0].min(pose.x - reach),
            own[1].min(pose.y - reach),
            own[2].max(pose.x + reach),
            own[3].max(pose.y + reach),
        ];
    }
    // Nodes of the part are nodes of the whole.
    let first = [0, 1].map(|k| ((own[k] - bounds[k]) / cell).floor().max(0.0) as usize);
    for k in 0..2 {
        own[k] = bounds[k] + first[k] as f64 * cell;
        own[k + 2] = own[k + 2].min(bounds[k + 2] - 2.0 * cell);
    }
    let mut field = Field::new(own, cell, AWAY);
    for (s, (pose, curvature)) in samples {
        let (sin, cos) = libm::sincos(pose.heading);
        let [c0, c1, r0, r1] = field.around(pose.x, pose.y, reach);
        for row in r0..r1 {
            for column in c0..c1 {
                let i = row * field.columns + column;
                let (x, y) = field.node(i);
                let (dx, dy) = (x - pose.x, y - pose.y);
                let square = (dx * dx + dy * dy) as f32;
                if square < field.values[i].square {
                    let (ahead, aside) = (dx * cos + dy * sin, dy * cos - dx * sin);
                    // The line bends away from the tangent by so much.
                    let scale = 1.0 - curvature * aside;
                    let bent = 0.5 * curvature * ahead * ahead / scale.max(0.3);
                    field.values[i] = Beside {
                        square,
                        along: (s + ahead / scale.max(0.3)) as f32,
                        across: (aside - bent) as f32,
                    };
                }
            }
        }
    }
    Ribbon { field, first }
}

/// How the ground's kinds and heights lie over a place with a network of roads.
pub(crate) struct Surface {
    /// Signed distance from the kerb, positive on the raised side, m; empty where there are no kerbs.
    kerb: Field<f32>,
    kerbs: bool,
    ground: Field<Ground>,
    /// What holds for whole cells of 1 m, so that most looks need nothing else.
    digest: Field<u8>,
    /// Distance from what is paved, m.
    open: Field<f32>,
    /// Paint by cells: `paint[starts[cell]..starts[cell + 1]]`.
    starts: Field<u32>,
    paint: Vec<Paint>,
}

/// Bits of a cell's digest: on which side of the kerb all of it lies, what all of it is made of, whether there is paint.
const RAISED: u8 = 1;
const RAISED_MIXED: u8 = 3;
const ASPHALT: u8 = 0;
const PAVING: u8 = 4;
const GREEN: u8 = 8;
const GROUND_MIXED: u8 = 12;
const PAINTED: u8 = 16;

/// The digests of the cells that four cells of `kerb` and `ground` make up.
fn digest(kerb: &Field<f32>, ground: &Field<Ground>, starts: &Field<u32>) -> Field<u8> {
    const TIMES: usize = (1.0 / CELL) as usize;
    let mut digest = Field {
        x: kerb.x,
        y: kerb.y,
        cell: 1.0,
        columns: (kerb.columns - 1) / TIMES,
        rows: (kerb.rows - 1) / TIMES,
        values: Vec::new(),
    };
    for cell in 0..digest.columns * digest.rows {
        let (column, row) = (cell % digest.columns * TIMES, cell / digest.columns * TIMES);
        let nodes = (row..=row + TIMES).flat_map(|r| (column..=column + TIMES).map(move |c| r * kerb.columns + c));
        let (mut sides, mut kinds) = ([false; 2], [false; 3]);
        for node in nodes {
            sides[usize::from(kerb.values[node] > 0.0)] = true;
            kinds[ground.values[node] as usize] = true;
        }
        let side = match sides {
            [true, true] => RAISED_MIXED,
            [_, raised] => u8::from(raised),
        };
        let kind = match kinds {
            [true, false, false] => ASPHALT,
            [false, true, false] => PAVING,
            [false, false, true] => GREEN,
            _ => GROUND_MIXED,
        };
        let (x, y) = digest.node(cell);
        let paint = starts
            .find(x + 0.5, y + 0.5)
            .is_some_and(|(i, ..)| starts.values[i] < starts.values[i + 1]);
        digest.values.push(side | kind | if paint { PAINTED } else { 0 });
    }
    digest
}

/// Distance outside of the union of two grounds whose distances are given, with corners rounded.
fn round_union(a: f64, b: f64, radius: f64) -> f64 {
    let (u, v) = ((radius - a).max(0.0), (radius - b).max(0.0));
    radius.max(a.min(b)) - (u * u + v * v).sqrt()
}

impl Surface {
    /// Looks the plan over once.
    pub fn new(roads: &[Road], nodes: &[Node], kerbs: bool) -> Self {
        let bounds = bounds(roads);
        let corner = nodes.iter().map(|node| node.corner).fold(2.0, f64::max);
        let (kerb, ground) = Self::kerbs(roads, nodes, bounds, corner);
        let open = Self::open(roads, nodes, bounds);
        let (starts, paint) = listed(strips(roads, nodes), bounds);
        Surface {
            digest: digest(&kerb, &ground, &starts),
            kerb,
            kerbs,
            ground,
            open,
            starts,
            paint,
        }
    }

    fn kerbs(roads: &[Road], nodes: &[Node], bounds: [f64; 4], corner: f64) -> (Field<f32>, Field<Ground>) {
        let mut kerb = Field::new(bounds, CELL, FARTHEST as f32);
        let mut ground = Field::new(bounds, CELL, Ground::Green);
        let mut nearest = vec![f64::INFINITY; kerb.values.len()];
        let mut islands = Vec::new();
        let mut strand_kerb = vec![f64::INFINITY; kerb.values.len()];
        for strand in strands(roads, nodes) {
            let mut touched = Vec::new();
            for road in strand.into_iter().map(|road| &roads[road]) {
                let section = &road.section;
                let bays = section.bay_depth(0).max(section.bay_depth(1));
                let widest = section
                    .outer(0)
                    .max(section.outer(1))
                    .max(section.half() + bays + corner);
                let at = beside(&road.line, bounds, CELL, widest + BESIDE);
                let length = road.line.length();
                let [from, to] = road.span();
                for (i, place) in at.found(&kerb) {
                    let (s, across) = (f64::from(place.along), f64::from(place.across));
                    let side = usize::from(across > 0.0);
                    let ends = (road.caps[0] - s).max(s - (length - road.caps[1]));
                    let out = (across.abs() - road.half_at(side, s)).max(ends);
                    if strand_kerb[i] == f64::INFINITY {
                        touched.push(i);
                    }
                    strand_kerb[i] = strand_kerb[i].min(out);
                    if section.median > 1.0 && (from..=to).contains(&s) {
                        islands.push((i, 0.5 * section.median - (across - section.middle()).abs()));
                    }
                    if out < nearest[i] {
                        nearest[i] = out;
                        let paved = across.abs() < section.outer(side) + 0.01 && ends <= 0.0;
                        ground.values[i] = if paved { Ground::Paving } else { Ground::Green };
                    }
                }
            }
            for i in touched {
                kerb.values[i] = round_union(f64::from(kerb.values[i]), strand_kerb[i], corner) as f32;
                strand_kerb[i] = f64::INFINITY;
            }
        }
        for (i, island) in islands {
            kerb.values[i] = f64::from(kerb.values[i]).max(island) as f32;
            if island > 0.0 {
                ground.values[i] = Ground::Green;
            }
        }
        for (x, y, radius) in turning_places(roads) {
            let [c0, c1, r0, r1] = kerb.around(x, y, radius + corner);
            for (row, column) in (r0..r1).flat_map(|row| (c0..c1).map(move |column| (row, column))) {
                let i = row * kerb.columns + column;
                let (dx, dy) = (kerb.node(i).0 - x, kerb.node(i).1 - y);
                let outside = (dx * dx + dy * dy).sqrt() - radius;
                kerb.values[i] = round_union(f64::from(kerb.values[i]), outside, corner) as f32;
            }
        }
        for node in nodes {
            let Control::Roundabout { radius, width } = node.control else {
                continue;
            };
            let reach = radius + 0.5 * width + corner + BESIDE;
            let [c0, c1, r0, r1] = kerb.around(node.at[0], node.at[1], reach);
            for (row, column) in (r0..r1).flat_map(|row| (c0..c1).map(move |column| (row, column))) {
                let i = row * kerb.columns + column;
                let (x, y) = kerb.node(i);
                let (dx, dy) = (x - node.at[0], y - node.at[1]);
                let distance = (dx * dx + dy * dy).sqrt();
                let outside = distance - radius - 0.5 * width;
                let island = radius - 0.5 * width - distance;
                let out = round_union(f64::from(kerb.values[i]), outside, corner).max(island);
                kerb.values[i] = out as f32;
                if outside < 3.5 {
                    ground.values[i] = if outside < 0.0 { Ground::Green } else { Ground::Paving };
                }
            }
        }
        // Corners of the pavements at nodes belong to it, whichever road is the nearest.
        for (i, out) in kerb.values.iter().enumerate() {
            if *out <= 0.0 {
                ground.values[i] = Ground::Asphalt;
            }
        }
        (kerb, ground)
    }

    fn open(roads: &[Road], nodes: &[Node], bounds: [f64; 4]) -> Field<f32> {
        let mut open = Field::new(bounds, OPEN_CELL, FARTHEST as f32);
        for road in roads {
            let widest = road.section.outer(0).max(road.section.outer(1));
            let at = beside(&road.line, bounds, OPEN_CELL, widest + FARTHEST);
            let length = road.line.length();
            for (i, place) in at.found(&open) {
                let across = f64::from(place.across);
                let s = f64::from(place.along);
                let beyond = (-s).max(s - length).max(0.0);
                let aside = across.abs() - road.section.outer(usize::from(across > 0.0));
                let out = if beyond > 0.0 && aside > 0.0 {
                    (aside * aside + beyond * beyond).sqrt()
                } else {
                    aside.max(if beyond > 0.0 { beyond } else { -FARTHEST })
                };
                open.values[i] = open.values[i].min(out as f32);
            }
        }
        for node in nodes {
            let Some(ring) = node.ring_edge() else { continue };
            for i in 0..open.values.len() {
                let (x, y) = open.node(i);
                let (dx, dy) = (x - node.at[0], y - node.at[1]);
                let out = (dx * dx + dy * dy).sqrt() - ring - 5.0;
                open.values[i] = open.values[i].min(out as f32);
            }
        }
        open
    }

    /// Whether there are kerbs at all.
    #[inline(always)]
    pub fn has_kerbs(&self) -> bool {
        self.kerbs
    }

    /// Whether a point lies on the raised side of a kerb.
    #[inline]
    pub fn raised(&self, x: f64, y: f64) -> bool {
        if !self.kerbs {
            return false;
        }
        match self
            .digest
            .find(x, y)
            .map(|(i, ..)| self.digest.values[i] & RAISED_MIXED)
        {
            Some(RAISED_MIXED) => self.inside_kerb(x, y) > 0.0,
            Some(state) => state == RAISED,
            None => true,
        }
    }

    /// Distance from the kerb, positive on the raised side, m; at most 30 m. Ground far from every road is raised.
    #[inline]
    pub fn inside_kerb(&self, x: f64, y: f64) -> f64 {
        if !self.kerbs {
            return -FARTHEST;
        }
        self.kerb.at(x, y).unwrap_or(FARTHEST)
    }

    /// Distance from the edge of the carriageways, negative upon them, with kerbs or without, m.
    pub fn off_road(&self, x: f64, y: f64) -> f64 {
        self.kerb.at(x, y).unwrap_or(FARTHEST)
    }

    /// Distance of a point from roads and pavements, negative upon them, m; at most 30 m.
    pub fn open_ground(&self, x: f64, y: f64) -> f64 {
        self.open.at(x, y).unwrap_or(FARTHEST)
    }

    /// Reflectivity of the ground at a point, with a speckle of 0.2 m.
    #[inline]
    pub fn reflectivity(&self, x: f64, y: f64) -> f64 {
        let cell = |v: f64| (v * 5.0 + 8192.0) as i32 as u64;
        let hash = mix(cell(x).wrapping_mul(0x9e37_79b9).wrapping_add(cell(y) << 32));
        let speckle = 0.8 + 0.4 * unit_of(hash);
        let green = 0.3 * (2.0 * speckle - 1.0);
        let Some((i, ..)) = self.digest.find(x, y) else {
            return green;
        };
        let digest = self.digest.values[i];
        let ground = match digest & GROUND_MIXED {
            ASPHALT => Ground::Asphalt,
            PAVING => Ground::Paving,
            GREEN => Ground::Green,
            _ => self.nearest_ground(x, y),
        };
        let base = match ground {
            Ground::Asphalt if digest & PAINTED != 0 && self.painted(x, y) => 0.75,
            Ground::Asphalt => 0.14,
            Ground::Paving => 0.28,
            // Grass scatters more than anything that is laid.
            Ground::Green => return green,
        };
        base * speckle
    }

    fn nearest_ground(&self, x: f64, y: f64) -> Ground {
        let Some((i, u, v)) = self.ground.find(x, y) else {
            return Ground::Green;
        };
        self.ground.values[i + usize::from(u > 0.5) + if v > 0.5 { self.ground.columns } else { 0 }]
    }

    #[inline]
    fn painted(&self, x: f64, y: f64) -> bool {
        let Some((cell, ..)) = self.starts.find(x, y) else {
            return false;
        };
        let [from, to] = [self.starts.values[cell], self.starts.values[cell + 1]];
        self.paint[from as usize..to as usize]
            .iter()
            .any(|paint| paint.covers(x, y))
    }
}

impl Paint {
    #[inline]
    fn covers(&self, x: f64, y: f64) -> bool {
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

/// Roads that go on in each other across nodes, as strands: between them corners are not rounded.
fn strands(roads: &[Road], nodes: &[Node]) -> Vec<Vec<usize>> {
    let mut strand: Vec<usize> = (0..roads.len()).collect();
    for node in nodes {
        for (k, a) in node.arms.iter().enumerate() {
            for b in &node.arms[..k] {
                if angle_within(a.heading - b.heading).abs() > OPPOSITE {
                    let (keep, drop) = (strand[a.road], strand[b.road]);
                    strand.iter_mut().filter(|s| **s == drop).for_each(|s| *s = keep);
                }
            }
        }
    }
    let of = |number: usize| (0..roads.len()).filter(|road| strand[*road] == number).collect();
    (0..roads.len())
        .map(of)
        .filter(|roads: &Vec<usize>| !roads.is_empty())
        .collect()
}

/// Where roads of two directions end, there is room to turn round: middles and radii.
fn turning_places(roads: &[Road]) -> Vec<(f64, f64, f64)> {
    let mut places = Vec::new();
    for road in roads.iter().filter(|road| !road.section.lanes.contains(&0)) {
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            if road.ends[end].is_none() {
                let s = if end == 0 { 0.0 } else { road.line.length() };
                let middle = road.line.at(s).0.at(sign * 8.0, 0.0);
                places.push((middle.x, middle.y, 13.0f64.max(road.section.half() + 3.0)));
            }
        }
    }
    places
}

/// [x min, y min, x max, y max] of all roads and what lies beside them.
fn bounds(roads: &[Road]) -> [f64; 4] {
    let mut bounds = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
    for road in roads {
        let reach = road.section.outer(0).max(road.section.outer(1)) + FARTHEST;
        let mut s = 0.0;
        while s <= road.line.length() {
            let pose = road.line.at(s).0;
            bounds[0] = bounds[0].min(pose.x - reach);
            bounds[1] = bounds[1].min(pose.y - reach);
            bounds[2] = bounds[2].max(pose.x + reach);
            bounds[3] = bounds[3].max(pose.y + reach);
            s += 4.0;
        }
    }
    bounds
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
fn strips(roads: &[Road], nodes: &[Node]) -> Vec<Paint> {
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
fn listed(all: Vec<Paint>, bounds: [f64; 4]) -> (Field<u32>, Vec<Paint>) {
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

/// How much lower than its roads' middles the ground is at a point, m: roads are crowned by 2 %, less near nodes.
pub(crate) struct Crowns {
    fields: Vec<Field<f32>>,
}

impl Crowns {
    pub fn new(roads: &[Road], cell: f64) -> Self {
        let bounds = bounds(roads);
        let fields = roads.iter().map(|road| {
            let half = road.section.half();
            let at = beside(&road.line, bounds, cell, half + 16.0);
            let mut field = Field::new(bounds, cell, 0f32);
            let [from, to] = road.span();
            let length = road.line.length();
            for (i, place) in at.found(&field) {
                let (s, across) = (f64::from(place.along), f64::from(place.across).abs());
                let ramp = |v: f64| (v / 12.0).clamp(0.0, 1.0);
                let near = [(0, s - from), (1, to - s)];
                let share = near.iter().fold(1.0f64, |share, (end, beyond)| {
                    let end = if road.ends[*end].is_some() { ramp(*beyond) } else { 1.0 };
                    share.min(end)
                });
                let beside = 1.0 - ((across - half) / 15.0).clamp(0.0, 1.0);
                if (0.0..=length).contains(&s) {
                    field.values[i] = (-0.02 * across.min(half) * share * beside) as f32;
                }
            }
            field
        });
        Crowns {
            fields: fields.collect(),
        }
    }

    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.fields.iter().filter_map(|field| field.at(x, y)).sum()
    }
}
