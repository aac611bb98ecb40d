//! Houses, lamps, trees and signs along the verges of a network.

use super::network::{Control, Network};
use super::terrain::Terrain;
use super::things::{street_sign, street_tree};
use super::verge::{Verge, VergeKind};
use super::{Fixture, SIDES};
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::{Part, Shape, Solid};
use crate::traffic::touch;

/// From the edge of the walked ground back to the row of lamps, m.
const ROW: f64 = 0.6;

/// How houses stand along a kind of verge: fronts, depths, heights and gaps, each from and to, and the share of
/// stretches that are built on.
struct Rows {
    front: [f64; 2],
    depth: [f64; 2],
    height: [f64; 2],
    gap: [f64; 2],
    share: f64,
}

fn rows(kind: VergeKind) -> Option<Rows> {
    match kind {
        VergeKind::Garden => Some(Rows {
            front: [8.0, 15.0],
            depth: [8.0, 12.0],
            height: [5.0, 10.0],
            gap: [3.0, 9.0],
            share: 0.8,
        }),
        VergeKind::Street => Some(Rows {
            front: [9.0, 24.0],
            depth: [9.0, 16.0],
            height: [7.0, 22.0],
            gap: [0.0, 3.0],
            share: 0.9,
        }),
        VergeKind::Park | VergeKind::Field => Some(Rows {
            front: [10.0, 24.0],
            depth: [9.0, 16.0],
            height: [5.0, 12.0],
            gap: [25.0, 90.0],
            share: 0.35,
        }),
        VergeKind::Embankment | VergeKind::Median | VergeKind::CarPark | VergeKind::Kerb => None,
    }
}

/// Everything that stands there, and where the houses do with their extents along and across.
pub(super) fn build(
    network: &Network,
    verges: &[Verge],
    terrain: &Terrain,
    number: u64,
) -> (Vec<Fixture>, Vec<(Pose2, [f64; 2])>) {
    let mut site = Site {
        network,
        terrain,
        fixtures: Vec::new(),
        built: Vec::new(),
    };
    for (index, verge) in verges.iter().enumerate() {
        if let Some(rows) = rows(verge.kind) {
            site.houses(verge, &rows, &mut Stream::new(number, "houses", index as u64));
        }
    }
    for (index, verge) in verges.iter().enumerate() {
        site.row(verge, &mut Stream::new(number, "lamps", index as u64));
    }
    site.posts();
    (site.fixtures, site.built)
}

struct Site<'a> {
    network: &'a Network,
    terrain: &'a Terrain,
    fixtures: Vec<Fixture>,
    /// The houses, with their extents along and across.
    built: Vec<(Pose2, [f64; 2])>,
}

impl Site<'_> {
    fn add(&mut self, pose: Pose2, parts: Vec<Part>) {
        // Feet go a little into the ground, so that no ray slips under them.
        let z = self.terrain.height(pose.x, pose.y) - 0.1;
        self.fixtures.push(Fixture {
            pose,
            z,
            solid: Solid::new(parts),
        });
    }

    fn houses(&mut self, verge: &Verge, rows: &Rows, draws: &mut Stream) {
        let mut along = draws.between(0.0, rows.gap[1]);
        while along < verge.length() {
            let mut draw = |range: [f64; 2]| draws.between(range[0], range[1]);
            let (front, depth, height, gap) = (draw(rows.front), draw(rows.depth), draw(rows.height), draw(rows.gap));
            let setback = verge.depth() + draw([0.0, 1.5]);
            let rho = draw([0.15, 0.6]);
            let middle = along + 0.5 * front;
            along += front + gap;
            if !draws.chance(rows.share) || middle + 0.5 * front > verge.length() + 4.0 {
                continue;
            }
            let pose = verge.pose(middle.min(verge.length()), setback + 0.5 * depth);
            if !self.free(pose, front, depth) {
                continue;
            }
            let shape = Shape::Facade {
                low: [-0.5 * front, -0.5 * depth, -1.0],
                high: [0.5 * front, 0.5 * depth, height],
            };
            self.built.push((pose, [front, depth]));
            self.add(pose, vec![Part::solid(shape, rho)]);
        }
    }

    /// Whether a house of this size keeps off what is paved, and does not run through another.
    fn free(&self, pose: Pose2, front: f64, depth: f64) -> bool {
        let off = |u: f64, v: f64| {
            let corner = pose.at(0.5 * u * front, 0.5 * v * depth);
            self.network.surface.open_ground(corner.x, corner.y) > 0.3
        };
        let steps = [-1.0, -0.5, 0.0, 0.5, 1.0];
        let clear = steps.iter().all(|u| steps.iter().all(|v| off(*u, *v)));
        let apart =
            |(house, size): &(Pose2, [f64; 2])| !touch(pose, [front, depth, 0.0], *house, [size[0], size[1], 0.0]);
        clear && self.built.iter().all(apart)
    }

    /// Lamps and trees by turns, with a sign here and there.
    fn row(&mut self, verge: &Verge, draws: &mut Stream) {
        let (trees, lamps) = match verge.kind {
            VergeKind::Garden => (0.15, 0.55),
            VergeKind::Street => (0.1, 0.7),
            VergeKind::Park => (0.55, 0.85),
            VergeKind::Field => (0.5, 0.5),
            VergeKind::Median => (0.7, 0.95),
            VergeKind::CarPark => (0.4, 0.9),
            VergeKind::Embankment => (0.0, 0.0),
            VergeKind::Kerb => return,
        };
        let apart = match verge.kind {
            VergeKind::Garden | VergeKind::Field => [18.0, 40.0],
            VergeKind::Embankment => [40.0, 70.0],
            _ => [10.0, 20.0],
        };
        let mut along = draws.between(3.0, 12.0);
        while along < verge.length() - 2.0 {
            let across = match verge.kind {
                VergeKind::Median => 0.0,
                VergeKind::Field | VergeKind::Embankment => draws.between(1.5, 4.0),
                VergeKind::Park | VergeKind::Garden if draws.chance(0.5) => draws.between(1.0, verge.depth().max(1.1)),
                _ => ROW.min(0.5 * verge.depth()),
            };
            let pose = verge.pose(along, across);
            let kind = draws.unit();
            if verge.kind == VergeKind::Median || self.network.surface.open_ground(pose.x, pose.y) > 0.25 {
                if kind < trees && self.network.watched(pose.x, pose.y) < super::clutter::TREELESS {
                    // A roadside unit looks over here.
                } else if kind < trees {
                    self.add(pose, street_tree([1.3, 2.6], [3.6, 4.6], [1.2, 2.6], draws));
                } else if kind < lamps {
                    let lamp = Part::post([0.0, 0.0], 0.09, [0.0, draws.between(5.5, 8.5)], 0.4);
                    self.add(pose, vec![lamp]);
                } else {
                    self.add(pose, street_sign(draws));
                }
            }
            along += draws.between(apart[0], apart[1]);
        }
    }

    /// Posts beside the arms of nodes: signals where there are some, else signs.
    fn posts(&mut self) {
        let network = self.network;
        for node in &network.nodes {
            for (k, arm) in node.arms.iter().enumerate() {
                let half = network.roads[arm.road].section.half();
                let signals = node.control == Control::Signals;
                let (radius, top) = if signals { (0.07, 3.4) } else { (0.04, 2.6) };
                for side in SIDES {
                    let pose = node.place(k, arm.mouth + 0.4, side * (half + 0.5));
                    let off = network.surface.off_road(pose.x, pose.y);
                    // One sign stands on the right of those who come in, a signal on both sides.
                    if off < 0.3 || !signals && side < 0.0 || !network.kerbs {
                        continue;
                    }
                    let rho = if signals { 0.1 } else { 2.5 };
                    let head = Part::block([-0.12, -0.18, 2.4], [0.12, 0.18, top - 0.1], rho);
                    self.add(pose, vec![Part::post([0.0, 0.0], radius, [0.0, top], 0.4), head]);
                }
            }
        }
    }
}
