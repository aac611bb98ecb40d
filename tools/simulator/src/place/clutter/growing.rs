//! What grows behind the line: trees, beds and low walls.

use super::kinds::{Growth, growth, tree_lined};
use super::{AROUND_NODES, BARE_BEDS, BARE_BEHIND, BEDS, Ground, LOW_WALLS, ROWS_FROM, Site, UNROWED, turned};
use crate::path::Pose2;
use crate::place::things::{self, Thing};
use crate::place::{Verge, VergeKind};
use crate::random::Stream;

/// How trees stand in a row.
pub(super) struct Trees {
    /// Where their crowns begin, m.
    under: f64,
    /// How high they are, m.
    pub height: f64,
    /// From one to the next, m.
    pub gap: f64,
    /// How often there is a shrub between two of them.
    pub shrubs: f64,
}

impl Trees {
    /// Trees alike, each figure of them drawn from a range.
    pub(super) fn drawn(under: [f64; 2], height: [f64; 2], gap: [f64; 2], shrubs: f64, draws: &mut Stream) -> Self {
        let [under, height, gap] = [under, height, gap].map(|[from, to]| draws.between(from, to));
        Trees {
            under,
            height,
            gap,
            shrubs,
        }
    }
}

impl Site<'_> {
    /// Edges of beds, steps and terraces on the free ground around a node.
    pub(super) fn beds(&mut self, [x, y]: [f64; 2], draws: &mut Stream) {
        let area = std::f64::consts::PI * AROUND_NODES * AROUND_NODES;
        for _ in 0..(LOW_WALLS * area / 100.0) as usize {
            let heading = draws.between(0.0, std::f64::consts::TAU);
            let pose = Pose2 { x, y, heading }.at(AROUND_NODES * draws.unit().sqrt(), 0.0);
            let tended = self.ground.tended(pose);
            if !(tended && draws.chance(BARE_BEDS)) && (self.ground.open)(pose.x, pose.y) < BEDS {
                self.low_wall(turned(pose, draws), draws);
            }
        }
    }

    /// The edge of a bed, a step or a terrace, where nobody drives or walks.
    fn low_wall(&mut self, pose: Pose2, draws: &mut Stream) {
        const CLEAR: f64 = 0.6;
        let length = 2.0 + 6.0 * draws.unit() * draws.unit();
        let wall = things::wall(length, 0.24, draws.between(0.4, 0.85));
        let free = |share: f64| {
            let Pose2 { x, y, .. } = pose.at(share * length, 0.0);
            (self.ground.open)(x, y) > CLEAR && (self.ground.off_road)(x, y) > CLEAR
        };
        if [-0.5, -0.25, 0.0, 0.25, 0.5].into_iter().all(free) {
            self.stand(pose, 0.0, wall);
        }
    }

    /// Goes along a stretch in uneven steps of about `gap`.
    pub(super) fn spots(
        &mut self,
        [from, to]: [f64; 2],
        gap: f64,
        mut put: impl FnMut(&mut Self, f64, &mut Stream),
        draws: &mut Stream,
    ) {
        let mut along = from + 0.5 * gap * draws.unit();
        while along < to {
            put(self, along, draws);
            along += gap * draws.between(0.6, 1.4);
        }
    }

    /// A row of trees whose crowns hang over what lines the verge, over what is parked before it and the outer lane, with
    /// shrubs below.
    pub(super) fn row(&mut self, verge: &Verge, draws: &mut Stream) {
        if !draws.chance(tree_lined(verge.kind)) {
            return;
        }
        let (across, shrubs) = match verge.kind {
            VergeKind::Median => (0.0, 0.2),
            VergeKind::Kerb => (0.5 * verge.depth(), 0.35),
            _ => (draws.between(0.5, 1.6).min(0.5 * verge.depth()), 0.5),
        };
        let trees = Trees::drawn([1.2, 2.4], [4.5, 9.0], [3.5, 7.0], shrubs, draws);
        let rowed = |ground: &Ground, pose: Pose2| {
            ground.node_distance(pose) >= ROWS_FROM && (ground.watched)(pose.x, pose.y) >= UNROWED
        };
        self.trees(&trees, verge, across, [0.0, verge.length()], rowed, draws);
    }

    /// Trees along a stretch, and shrubs between them, where they may be.
    pub(super) fn trees(
        &mut self,
        trees: &Trees,
        verge: &Verge,
        across: f64,
        stretch: [f64; 2],
        may: impl Fn(&Ground, Pose2) -> bool,
        draws: &mut Stream,
    ) {
        self.spots(
            stretch,
            trees.gap,
            |site, along, draws| {
                let mut put = |along: f64, clear: f64, thing: Thing, draws: &mut Stream| {
                    let pose = turned(verge.pose(along, across), draws);
                    if may(site.ground, pose) {
                        site.stand(pose, clear, thing);
                    }
                };
                let [under, height] = [trees.under, trees.height].map(|middle| middle * draws.between(0.8, 1.2));
                put(along, 0.3, things::tree(under, height, draws), draws);
                if draws.chance(trees.shrubs) {
                    let along = along + trees.gap * draws.between(0.2, 0.8);
                    put(along, 0.2, things::bush(draws.between(0.4, 1.3), draws), draws);
                }
            },
            draws,
        );
    }

    /// What grows behind the first row, over all of the free ground.
    pub(super) fn grow(&mut self, verge: &Verge, draws: &mut Stream) {
        const FIRST_ROW: f64 = 2.0;
        let deep = verge.depth() - FIRST_ROW;
        if deep <= 0.0 {
            return;
        }
        let area = deep * verge.length() / 100.0;
        for (what, density) in growth(verge.kind) {
            let count = (area * density * draws.between(0.5, 1.5)) as usize;
            for _ in 0..count {
                let pose = verge.pose(draws.between(0.0, verge.length()), FIRST_ROW + deep * draws.unit());
                let pose = turned(pose, draws);
                // Small ones are many.
                let share = draws.unit() * draws.unit();
                let tended = what != Growth::Tree && self.ground.tended(pose);
                if tended && draws.chance(BARE_BEHIND) {
                    continue;
                }
                let thing: Thing = match what {
                    Growth::Weed if draws.chance(0.5) => things::stone(0.4 + 0.6 * share, draws),
                    Growth::Weed => things::bush(0.35 + 0.6 * share, draws),
                    Growth::Shrub => things::bush(draws.between(0.6, 2.4), draws),
                    Growth::LowWall => {
                        self.low_wall(pose, draws);
                        continue;
                    }
                    Growth::Tree => things::tree(draws.between(1.5, 3.0), draws.between(3.5, 12.0), draws),
                };
                self.stand(pose, 0.5, thing);
            }
        }
    }
}
