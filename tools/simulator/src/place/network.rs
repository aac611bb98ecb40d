//! Roads at any angle: the plan of every place that is not on a grid.
//!
//! A *road* is a smooth centre line and a cross-section that holds from end to end: lanes in each direction, cycle
//! lanes, a median, bays, kerbs, pavements. A *node* is where roads meet; each road that ends there is one of its
//! *arms*, whose line begins in the node's middle. Between the middle and an arm's *mouth*, nothing belongs to one road
//! alone: there lanes are joined by turns, and walkers cross. Traffic keeps to the right. An arm or a road has a right
//! and a left side (0 and 1) as one looks along its line; offsets from a line are positive to the left.
//!
//! Kerbs, paint and what is paved are looked up in a [`Surface`], made once from all roads. Heights are the terrain's:
//! a slope of the whole place, long waves, and the crowns of the roads, which fade towards the nodes.

use std::f64::consts::{PI, TAU};

use super::surface::Surface;
use super::verge::VergeKind;
use crate::path::{Path, Pose2, angle_within};

/// Right and left of a line.
pub(crate) const SIDES: [f64; 2] = [-1.0, 1.0];

/// How cars stand in a row of bays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Bays {
    /// Between the kerb and a car's axis, rad: 0 for cars behind each other, a right angle for cars side by side.
    pub angle: f64,
    /// From the lane's edge to the kerb, m.
    pub depth: f64,
    /// From one bay to the next, m.
    pub pitch: f64,
}

impl Bays {
    pub const PARALLEL: Bays = Bays {
        angle: 0.0,
        depth: 2.3,
        pitch: 6.0,
    };

    pub const SQUARE: Bays = Bays {
        angle: PI / 2.0,
        depth: 5.3,
        pitch: 2.65,
    };

    /// Bays at a slant.
    pub fn slanted(degrees: f64) -> Bays {
        let angle = degrees.to_radians();
        let (sin, cos) = libm::sincos(angle);
        Bays {
            angle,
            depth: 5.0 * sin + 2.2 * cos,
            pitch: 2.65 / sin,
        }
    }
}

/// A road's cross-section.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Section {
    /// Driving lanes along the line and against it.
    pub lanes: [usize; 2],
    /// Width of a driving lane, m.
    pub width: f64,
    /// Between the two directions, m; raised where it is wider than 1 m and the place has kerbs.
    pub median: f64,
    /// Width of the cycle lanes on both sides, m; 0 for none.
    pub cycle: f64,
    /// What is paved beyond the outermost lanes, m.
    pub shoulder: f64,
    /// Bays beyond the right and the left kerb line.
    pub bays: [Option<Bays>; 2],
    /// Widths of the pavements, m; 0 for none.
    pub pavement: [f64; 2],
    /// Speed limit, m/s.
    pub limit: f64,
    /// What lies beside it, and how deep it is free, m.
    pub beside: [(VergeKind, f64); 2],
}

/// A lane of a cross-section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Strip {
    /// Of its middle, m.
    pub offset: f64,
    pub width: f64,
    /// Along the road's line.
    pub forward: bool,
    /// Number among the driving lanes of its direction, from the middle of the road; `None` for cycle lanes.
    pub index: Option<usize>,
}

impl Section {
    /// A street of one lane in each direction with pavements.
    pub fn street(width: f64, limit: f64) -> Section {
        Section {
            lanes: [1, 1],
            width,
            median: 0.0,
            cycle: 0.0,
            shoulder: 0.25,
            bays: [None; 2],
            pavement: [3.5; 2],
            limit,
            beside: [(VergeKind::Park, 12.0); 2],
        }
    }

    /// Half the width between the kerb lines, without bays, m.
    pub fn half(&self) -> f64 {
        let lanes = (self.lanes[0] + self.lanes[1]) as f64 * self.width;
        0.5 * (lanes + self.median) + self.cycle + self.shoulder
    }

    /// Depth of the bays on a side, m.
    pub fn bay_depth(&self, side: usize) -> f64 {
        self.bays[side].map_or(0.0, |bays| bays.depth)
    }

    /// From the line to the far edge of the pavement, m.
    pub fn outer(&self, side: usize) -> f64 {
        self.half() + self.bay_depth(side) + self.pavement[side]
    }

    /// The strip of a wide pavement on which things stand and nobody walks, from and to, m behind the kerb; vehicles reach
    /// over the kerb where they turn and park.
    pub fn strip(&self, side: usize) -> Option<[f64; 2]> {
        (self.pavement[side] >= 3.3).then_some([0.55, 1.35])
    }

    /// Offset of the median's middle, m.
    pub fn middle(&self) -> f64 {
        let [forward, backward] = self.lanes.map(|n| n as f64 * self.width);
        0.5 * (forward - backward)
    }

    /// All lanes.
    pub fn strips(&self) -> Vec<Strip> {
        let middle = self.middle();
        let mut strips = Vec::new();
        for (direction, sign) in [(0, -1.0), (1, 1.0)] {
            let forward = direction == 0;
            for index in 0..self.lanes[direction] {
                strips.push(Strip {
                    offset: middle + sign * (0.5 * self.median + (index as f64 + 0.5) * self.width),
                    width: self.width,
                    forward,
                    index: Some(index),
                });
            }
            if self.cycle > 0.0 && self.lanes[direction] > 0 {
                strips.push(Strip {
                    offset: sign * (self.half() - self.shoulder - 0.5 * self.cycle),
                    width: self.cycle,
                    forward,
                    index: None,
                });
            }
        }
        strips
    }
}

/// A road.
#[derive(Clone, Debug)]
pub(crate) struct Road {
    pub line: Path,
    pub section: Section,
    /// The nodes at its begin and its end, with their mouths' distances from the ends, m.
    pub ends: [Option<(usize, f64)>; 2],
    /// From where to where bays may lie, m along the line.
    pub bays: [f64; 2],
    /// How far from its ends its carriageway ends, m: less than 0 where it goes on around a corner.
    pub caps: [f64; 2],
}

impl Road {
    /// Distances along the line between which the road is itself: between its mouths.
    pub fn span(&self) -> [f64; 2] {
        let mouth = |end: usize| self.ends[end].map_or(0.0, |(_, mouth)| mouth);
        [mouth(0), self.line.length() - mouth(1)]
    }

    /// Half the width between the kerbs at a distance along the line, bays included, m.
    pub fn half_at(&self, side: usize, s: f64) -> f64 {
        let bays = self.section.bays[side].filter(|_| (self.bays[0]..=self.bays[1]).contains(&s));
        self.section.half() + bays.map_or(0.0, |bays| bays.depth)
    }

    /// Where cars can stand: the middle of each bay, the heading of a car that was driven in forwards, and the bay's
    /// angle.
    pub fn stands(&self) -> Vec<(Pose2, f64)> {
        let mut stands = Vec::new();
        for (side, sign) in SIDES.into_iter().enumerate() {
            let Some(bays) = self.section.bays[side] else { continue };
            // A car at a slant reaches beyond its bay's own share of the kerb.
            let (sin, cos) = libm::sincos(bays.angle);
            let spare = if bays.angle == 0.0 {
                0.5
            } else {
                0.5 + 0.5 * (5.0 * cos + 2.3 * sin - bays.pitch).max(0.0)
            };
            let room = self.bays[1] - self.bays[0] - 2.0 * spare;
            let count = (room / bays.pitch).floor().max(0.0) as usize;
            for k in 0..count {
                let s = self.bays[0] + spare + (k as f64 + 0.5) * bays.pitch;
                let pose = self.line.at(s).0.aside(sign * (self.section.half() + 0.5 * bays.depth));
                // One drives in forwards from the lane beside the bays, which a one-way road has on its left as well.
                let turn = match (side, self.section.lanes[1]) {
                    (0, _) => -bays.angle,
                    (_, 0) => bays.angle,
                    _ => PI - bays.angle,
                };
                let heading = pose.heading + turn;
                stands.push((Pose2 { heading, ..pose }, bays.angle));
            }
        }
        stands
    }
}

/// Who goes first where roads meet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Control {
    /// Lights; arms of a phase have green together.
    Signals,
    /// Major arms go before the others.
    Priority,
    /// Who comes from the right goes first.
    Uncontrolled,
    /// Who is on the ring goes first; the ring's lane has this radius and width.
    Roundabout { radius: f64, width: f64 },
}

/// A road's end at a node.
#[derive(Clone, Debug)]
pub(crate) struct Arm {
    pub road: usize,
    /// Whether the road's line begins here.
    pub at_start: bool,
    /// The road's line, away from the node.
    pub out: Path,
    /// Its heading in the node's middle.
    pub heading: f64,
    /// Distance from the middle to the mouth, m.
    pub mouth: f64,
    /// Goes first at nodes with priority.
    pub major: bool,
    /// Phase of its lights.
    pub phase: usize,
    /// Distance of the middle of its pedestrian crossing, m.
    pub crossing: Option<f64>,
}

/// Half the width of a pedestrian crossing along the road, m.
pub(crate) const CROSSING_HALF: f64 = 1.5;
/// Arms whose headings differ by more face each other: who comes in by one goes straight on by the other, rad.
pub(super) const OPPOSITE: f64 = 2.4;

/// Where roads meet.
#[derive(Clone, Debug)]
pub(crate) struct Node {
    pub at: [f64; 2],
    pub control: Control,
    /// Radius of the kerbs at its corners, m.
    pub corner: f64,
    /// Its arms, counter-clockwise.
    pub arms: Vec<Arm>,
    /// Whether walkers cross its arms.
    pub crossings: bool,
}

impl Node {
    /// Outer radius of a roundabout's ring, m.
    pub fn ring_edge(&self) -> Option<f64> {
        match self.control {
            Control::Roundabout { radius, width } => Some(radius + 0.5 * width),
            _ => None,
        }
    }

    /// The pose `along` an arm and `across` to its left, heading outwards.
    pub fn place(&self, arm: usize, along: f64, across: f64) -> Pose2 {
        self.arms[arm].out.at(along).0.aside(across)
    }
}

/// What a place's traffic is made of; pairs of which nothing else is said are for usual and for dense traffic.
#[derive(Clone, Debug)]
pub(crate) struct TrafficMix {
    /// Mean distance from one vehicle to the next in a lane, m.
    pub gap: [f64; 2],
    /// Walkers at the begin.
    pub walkers: [usize; 2],
    /// Share of those who come on foot that are groups of two to six.
    pub groups: f64,
    /// Groups of two to six who stand together on pavements.
    pub standing: [usize; 2],
    /// Share of grown-up walkers who push a pram.
    pub prams: f64,
    /// How often somebody stands at a taken bay, between cars.
    pub between: f64,
    /// Share of the bays that are taken.
    pub parked: [f64; 2],
    /// Shares of vans among parked cars and among those that drive.
    pub vans: [f64; 2],
    /// Shares of trucks and buses among those that drive.
    pub long: f64,
    /// Share of trucks that have a trailer where the roads are straight enough.
    pub trailers: f64,
    /// Shares of tricycles among those parked and among those that drive.
    pub tricycles: [f64; 2],
    /// Share of riders among those that drive where there are no cycle lanes.
    pub riders: f64,
    /// Within this distance of `rsu1` cav1 and cav2 are near it, m.
    pub near: f64,
}

/// A lane of a road's own that runs beside another road and ends there: who is on it has to change over.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Merge {
    pub road: usize,
    /// The road whose outermost forward lane is to the left.
    pub onto: usize,
    /// From where to where one may change over, m along `road`.
    pub stretch: [f64; 2],
}

/// The plan of a place.
pub(crate) struct Network {
    pub roads: Vec<Road>,
    pub nodes: Vec<Node>,
    pub merges: Vec<Merge>,
    pub mix: TrafficMix,
    /// Whether there are kerbs.
    pub kerbs: bool,
    /// Lines along the middles of raised strips between carriageways, and half the strips' widths, m.
    pub islands: Vec<(Path, f64)>,
    /// Where rsu1 and rsu2 stand.
    pub roadside: [Pose2; 2],
    pub surface: Surface,
}

impl Network {
    /// Distance from a roadside unit to a point in the middle of its view, m; infinite outside.
    pub fn watched(&self, x: f64, y: f64) -> f64 {
        const HALF_ANGLE: f64 = 0.45;
        let seen = self.roadside.iter().filter_map(|unit| {
            let (dx, dy) = (x - unit.x, y - unit.y);
            let off = angle_within(libm::atan2(dy, dx) - unit.heading).abs();
            (off < HALF_ANGLE).then(|| (dx * dx + dy * dy).sqrt())
        });
        seen.fold(f64::INFINITY, f64::min)
    }
}

/// A network in the making.
pub(crate) struct Builder {
    pub roads: Vec<Road>,
    pub nodes: Vec<Node>,
}

impl Builder {
    pub fn new() -> Self {
        Builder {
            roads: Vec::new(),
            nodes: Vec::new(),
        }
    }

    pub fn node(&mut self, at: [f64; 2], control: Control, corner: f64, crossings: bool) -> usize {
        self.nodes.push(Node {
            at,
            control,
            corner,
            arms: Vec::new(),
            crossings,
        });
        self.nodes.len() - 1
    }

    /// A road that no other meets, or whose ends lie at nodes; `major` and `phase` hold at both.
    pub fn road(
        &mut self,
        line: Path,
        section: Section,
        nodes: [Option<usize>; 2],
        major: bool,
        phase: usize,
    ) -> usize {
        let road = self.roads.len();
        for (end, node) in nodes.into_iter().enumerate() {
            let Some(node) = node else { continue };
            let out = if end == 0 { line.clone() } else { line.reversed() };
            self.nodes[node].arms.push(Arm {
                road,
                at_start: end == 0,
                heading: out.at(0.0).0.heading,
                out,
                mouth: 0.0,
                major,
                phase,
                crossing: None,
            });
        }
        let bays = [0.0, line.length()];
        self.roads.push(Road {
            line,
            section,
            ends: nodes.map(|node| node.map(|node| (node, 0.0))),
            bays,
            caps: [0.0; 2],
        });
        road
    }

    /// Settles mouths, crossings and bays.
    pub fn settle(&mut self) {
        for node in &mut self.nodes {
            node.arms
                .sort_by(|a, b| a.heading.rem_euclid(TAU).total_cmp(&b.heading.rem_euclid(TAU)));
        }
        for n in 0..self.nodes.len() {
            for a in 0..self.nodes[n].arms.len() {
                let (mouth, crossing) = self.mouth(n, a);
                let cap = self.cap(n, a);
                let arm = &mut self.nodes[n].arms[a];
                (arm.mouth, arm.crossing) = (mouth, crossing);
                let end = usize::from(!arm.at_start);
                self.roads[arm.road].ends[end] = Some((n, mouth));
                self.roads[arm.road].caps[end] = cap;
            }
        }
        for road in &mut self.roads {
            let [from, to] = road.span();
            let free = |end: usize| if road.ends[end].is_some() { 4.0 } else { 20.0 };
            road.bays = [from + free(0), to - free(1)];
        }
    }

    /// Where the carriageway of an arm ends, seen from the node's middle.
    fn cap(&self, n: usize, a: usize) -> f64 {
        let node = &self.nodes[n];
        if let Control::Roundabout { radius, .. } = node.control {
            return radius;
        }
        let half = |arm: &Arm| self.roads[arm.road].section.half();
        let own = &node.arms[a];
        let opposite = |other: &Arm| angle_within(other.heading - own.heading).abs() > OPPOSITE;
        match node.arms.len() {
            _ if node.arms.iter().any(opposite) => 0.0,
            1 | 2 => -half(own),
            // A road that ends at another must not bulge over its far kerb.
            _ => {
                let min = node.arms.iter().map(half).fold(f64::INFINITY, f64::min);
                (node.corner - min + 0.5).clamp(0.0, min - 1.0)
            }
        }
    }

    /// Distances of an arm's mouth and of the middle of its crossing.
    fn mouth(&self, n: usize, a: usize) -> (f64, Option<f64>) {
        let node = &self.nodes[n];
        let half = |arm: &Arm| self.roads[arm.road].section.half();
        let own = &node.arms[a];
        let mut edge = 0.0f64;
        for (_, other) in node.arms.iter().enumerate().filter(|(k, _)| *k != a) {
            let between = angle_within(other.heading - own.heading).abs();
            if between > 2.6 {
                continue;
            }
            let (sin, cos) = libm::sincos(between);
            let corner = (half(other) + half(own) * cos) / sin;
            edge = edge.max(corner + 0.6 * node.corner / libm::tan(0.5 * between));
        }
        if let Some(ring) = node.ring_edge() {
            edge = edge.max(ring + 2.0);
        }
        let walked = self.roads[own.road].section.pavement.iter().all(|width| *width > 0.0);
        if node.crossings && walked {
            let middle = edge + 0.8 + CROSSING_HALF;
            (middle + CROSSING_HALF + 1.6, Some(middle))
        } else {
            (edge + 1.0, None)
        }
    }
}
