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

mod builder;
mod section;

use std::f64::consts::PI;

use super::surface::Surface;
use super::verge::VergeKind;
use crate::inertial::Sky;
use crate::path::{Path, Pose2, angle_within};
use crate::random::Stream;
pub(crate) use builder::Builder;
pub(crate) use section::{Bays, SIDES, Section, Strip};

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
    /// Stretches of roads over which too little of the sky is free for a satellite receiver, m along their lines.
    pub hidden: Vec<(usize, [f64; 2])>,
    /// Roads that lead round a block, each on to the next; some of the traffic never leaves them.
    pub ring: Vec<usize>,
}

impl Network {
    /// Whether a vehicle of a traffic, by number, never leaves the ring; nobody where there is none.
    pub fn keeps_to_ring(&self, seed: u64, number: u64) -> bool {
        !self.ring.is_empty() && Stream::new(seed, "keeps", number).chance(0.5)
    }

    /// The sky over a point: that of the nearest road.
    pub fn sky(&self, x: f64, y: f64) -> Sky {
        const STEP: f64 = 2.0;
        let mut nearest = (f64::INFINITY, 0, 0.0);
        for (index, road) in self.roads.iter().enumerate() {
            for k in 0..=(road.line.length() / STEP) as usize {
                let s = k as f64 * STEP;
                let at = road.line.at(s).0;
                let square = (at.x - x) * (at.x - x) + (at.y - y) * (at.y - y);
                if square < nearest.0 {
                    nearest = (square, index, s);
                }
            }
        }
        let (_, road, s) = nearest;
        if self
            .hidden
            .iter()
            .any(|(hidden, [from, to])| *hidden == road && (*from..=*to).contains(&s))
        {
            return Sky::Hidden;
        }
        let beside = self.roads[road].section.beside;
        match beside.iter().all(|(kind, _)| *kind == VergeKind::Street) {
            true => Sky::Narrow,
            false => Sky::Open,
        }
    }

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
