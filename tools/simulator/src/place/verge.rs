//! The ground beside the roads, where hedges, walls, posts and trees may stand.

use super::{Network, PAVEMENT, REACH, Roads, SIDES};
use crate::path::{Path, Pose2};

/// What lies beside a road.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum VergeKind {
    /// Front gardens and yards behind a pavement.
    Garden,
    /// A row of shops or houses: what is free between pavement and walls is a strip.
    Street,
    /// Green behind a pavement: a park, a field within the town.
    Park,
    /// Open land beside a road without a pavement.
    Field,
    /// The embankment of a motorway, from the hard shoulder on.
    Embankment,
    /// The raised strip between the two directions of a road; its line runs along its middle.
    Median,
    /// The edge of a car park.
    CarPark,
    /// The strip of a pavement behind the kerb, on which nobody walks.
    Kerb,
}

/// Pavements as wide as this have a strip behind the kerb, and its width, m.
const WALKED: f64 = 2.5;
const STRIP: f64 = 0.6;

/// An edge along which things stand: from it, free ground reaches outwards, without roads, pavements and the walls of
/// buildings.
#[derive(Clone, Debug)]
pub(crate) struct Verge {
    pub kind: VergeKind,
    /// The edge, with the free ground to its left.
    line: Path,
    /// How far the free ground reaches from the edge, m.
    depth: f64,
}

impl Verge {
    /// The verge to the left of a line.
    pub fn new(kind: VergeKind, line: Path, depth: f64) -> Self {
        Verge { kind, line, depth }
    }

    /// Length of the edge, m.
    pub fn length(&self) -> f64 {
        self.line.length()
    }

    /// How far the free ground reaches from the edge, m; a median's half width.
    pub fn depth(&self) -> f64 {
        self.depth
    }

    /// The pose `along_m` metres along the edge and `across_m` away from the road; its heading is that of the edge.
    pub fn pose(&self, along_m: f64, across_m: f64) -> Pose2 {
        self.line.at(along_m).0.aside(across_m)
    }

    /// The verges of a network: along both sides of every road, as far as no other road is in the way, and along its
    /// medians.
    pub fn of_network(network: &Network) -> Vec<Verge> {
        let mut verges = Vec::new();
        for road in &network.roads {
            let [from, to] = road.span();
            for (side, sign) in SIDES.into_iter().enumerate() {
                let (kind, depth) = road.section.beside[side];
                let edge = sign * (road.section.outer(side) + 0.2);
                let free = |s: f64| {
                    let pose = road.line.at(s).0.aside(edge + sign * 0.8);
                    network.surface.open_ground(pose.x, pose.y) > 0.3
                };
                for [begin, end] in runs(from, to, free) {
                    let mut points = Vec::new();
                    let count = ((end - begin) / 2.0).ceil() as usize;
                    for k in 0..=count {
                        let s = begin + (end - begin) * k as f64 / count as f64;
                        points.push(road.line.at(s).0.aside(edge));
                    }
                    let line = Path::through(&points);
                    let line = if side == 1 { line } else { line.reversed() };
                    verges.push(Verge::new(kind, line, depth));
                }
            }
            for (side, sign) in SIDES.into_iter().enumerate() {
                if !network.kerbs || road.section.pavement[side] < WALKED {
                    continue;
                }
                let kerb = road.section.half() + road.section.bay_depth(side) + 0.1;
                let free = |s: f64| {
                    let pose = road.line.at(s).0.aside(sign * (kerb + 0.5 * STRIP));
                    network.surface.off_road(pose.x, pose.y) > 0.5 * STRIP
                };
                for [begin, end] in runs(from + 1.0, to - 1.0, free) {
                    let line = road.line.part(begin, end).parallel(sign * kerb);
                    let line = if side == 1 { line } else { line.reversed() };
                    verges.push(Verge::new(VergeKind::Kerb, line, STRIP));
                }
            }
            if road.section.median > 1.0 {
                let middle = road.section.middle();
                let line = road.line.part(from + 1.0, to - 1.0).parallel(middle);
                verges.push(Verge::new(VergeKind::Median, line, 0.5 * road.section.median));
            }
        }
        for (line, half) in &network.islands {
            verges.push(Verge::new(VergeKind::Median, line.clone(), *half));
        }
        verges
    }

    /// The verges of the roads on a grid: on both sides of each arm, the strip between the walking band and the row of
    /// buildings.
    pub fn of_grid(roads: &Roads) -> Vec<Verge> {
        const FREE: f64 = 0.5;
        let mut verges = Vec::new();
        for arm in roads.arms() {
            let axis = arm % 2;
            let from = roads.half[1 - axis] + PAVEMENT + 2.0;
            let across = roads.half[axis] + PAVEMENT - FREE + 0.1;
            let centre = Pose2 {
                x: 0.0,
                y: 0.0,
                heading: *arm as f64 * std::f64::consts::FRAC_PI_2,
            };
            let mut left = Path::from_pose(centre.at(from, across));
            left.line(REACH - from);
            let mut right = Path::from_pose(centre.at(from, -across));
            right.line(REACH - from);
            // The free ground lies to the left of the line: the right-hand edge runs towards the centre.
            for line in [left, right.reversed()] {
                verges.push(Verge::new(VergeKind::Street, line, FREE));
            }
        }
        verges
    }
}

/// The stretches of at least 4 m between two distances along which something holds.
fn runs(from: f64, to: f64, holds: impl Fn(f64) -> bool) -> Vec<[f64; 2]> {
    let mut runs = Vec::new();
    let mut begin = None;
    let mut s = from;
    while s < to + 1.0 {
        let at = s.min(to);
        match begin {
            None if holds(at) => begin = Some(at),
            Some(start) if !holds(at) || at == to => {
                if at - start > 4.0 {
                    runs.push([start, at - 1.0]);
                }
                begin = None;
            }
            _ => {}
        }
        s += 1.0;
    }
    runs
}
