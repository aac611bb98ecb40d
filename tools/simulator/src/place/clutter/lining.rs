//! What stands in a line along a road.

use super::growing::Trees;
use super::kinds::{Lining, linings};
use super::{BARE_ROW, Site, pieces, turned};
use crate::path::Pose2;
use crate::place::things;
use crate::place::{Verge, VergeKind};
use crate::random::Stream;
use crate::solid::Part;

impl Site<'_> {
    /// The first row, in stretches.
    pub(super) fn line(&mut self, verge: &Verge, draws: &mut Stream) {
        let choices = linings(verge.kind);
        let total: f64 = choices.iter().map(|(_, weight)| weight).sum();
        let mut along = draws.between(0.0, 5.0);
        while along < verge.length() {
            let mut pick = draws.between(0.0, total);
            let lining = choices.iter().find(|(_, weight)| {
                pick -= weight;
                pick < 0.0
            });
            let lining = lining.map_or(Lining::Bare, |(lining, _)| *lining);
            let length = match lining {
                Lining::Shelter | Lining::Bicycles => draws.between(4.0, 9.0),
                Lining::Rail => draws.between(20.0, 70.0),
                Lining::Hedge | Lining::WalledHedge | Lining::Wall => 3.0 + 17.0 * draws.unit() * draws.unit(),
                _ => draws.between(5.0, 20.0),
            };
            let end = (along + length).min(verge.length());
            let tended = self.ground.tended(verge.pose(0.5 * (along + end), 0.0));
            if !(tended && draws.chance(BARE_ROW)) {
                self.stretch(verge, lining, [along, end], draws);
            }
            along = end + draws.between(0.6, 2.0);
        }
    }

    pub(super) fn stretch(&mut self, verge: &Verge, lining: Lining, [from, to]: [f64; 2], draws: &mut Stream) {
        let across = match verge.kind {
            VergeKind::Median => 0.0,
            VergeKind::Kerb => 0.5 * verge.depth(),
            _ => draws.between(0.3, 1.2).min(0.5 * verge.depth()),
        };
        match lining {
            Lining::Hedge => self.hedge(verge, across, [from, to], draws),
            Lining::WalledHedge => {
                let height = draws.between(0.4, 0.7);
                self.build(verge, across, [from, to], |length| things::wall(length, 0.24, height));
                self.hedge(verge, across + draws.between(0.5, 1.0), [from, to], draws);
            }
            Lining::Wall => {
                let height = draws.between(0.35, 1.1);
                self.build(verge, across, [from, to], |length| things::wall(length, 0.24, height));
            }
            Lining::Rail => self.build(verge, across, [from, to], things::rail),
            Lining::Fence => {
                let (height, pass) = (draws.between(0.8, 2.0), draws.between(0.6, 0.9));
                self.build(verge, across, [from, to], |length| things::fence(length, height, pass));
            }
            Lining::Shrubs => self.shrubs(verge, across, [from, to], draws),
            Lining::Trees => {
                let trees = Trees::drawn([1.5, 3.0], [4.0, 9.0], [4.0, 8.0], 0.3, draws);
                self.trees(&trees, verge, across + 0.4, [from, to], |_, _| true, draws);
            }
            Lining::Grass => self.grass(verge, across, [from, to], draws),
            Lining::Furniture => self.furniture(verge, across, [from, to], draws),
            Lining::Bicycles => self.bicycles(verge, across, [from, to], draws),
            Lining::Shelter => {
                self.stand(verge.pose(0.5 * (from + to), across + 0.6), 0.0, things::shelter(draws));
            }
            Lining::Works => self.works(verge, across, [from, to.min(from + 15.0)], draws),
            Lining::Bare => {}
        }
    }

    pub(super) fn shrubs(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        let (height, gap) = (draws.between(0.5, 2.0), draws.between(0.8, 3.5));
        self.spots(
            stretch,
            gap,
            |site, along, draws| {
                let aside = across + draws.between(0.0, 1.5).min(0.5 * verge.depth());
                let height = height * draws.between(0.5, 1.2);
                let pose = turned(verge.pose(along, aside), draws);
                site.stand(pose, 0.2, things::bush(height, draws));
            },
            draws,
        );
    }

    fn grass(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        for [middle, length] in pieces(stretch, 3.0) {
            let width = draws.between(0.8, 2.5).min(verge.depth());
            let pose = verge.pose(middle, across + 0.5 * width);
            self.stand(pose, 0.1, things::grass(length, width, draws.between(0.2, 0.6), draws));
        }
    }

    fn furniture(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        let gap = draws.between(1.8, 4.0);
        self.spots(
            stretch,
            gap,
            |site, along, draws| {
                let thing = match draws.below(6) {
                    0 | 1 => things::bollard(draws),
                    2 => things::sign(draws),
                    3 => things::lamp(draws),
                    4 => things::bin(draws),
                    _ => things::cabinet(draws),
                };
                site.stand(verge.pose(along, across), 0.0, thing);
            },
            draws,
        );
    }

    /// Behind a kerb lengthwise, one behind the other, elsewhere in stands square to the verge.
    fn bicycles(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        let at_kerb = verge.kind == VergeKind::Kerb;
        self.spots(
            stretch,
            if at_kerb { 2.2 } else { 4.2 },
            |site, along, draws| {
                let (pose, count) = match at_kerb {
                    true => {
                        let pose = verge.pose(along, across);
                        let heading = pose.heading + std::f64::consts::FRAC_PI_2;
                        (Pose2 { heading, ..pose }, 1)
                    }
                    false => (verge.pose(along, across + 0.6), 2 + draws.below(5)),
                };
                site.stand(pose, 0.0, things::bicycles(count, draws));
            },
            draws,
        );
    }

    fn works(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        let gap = draws.between(1.2, 3.0);
        let cones = draws.chance(0.5);
        self.spots(
            stretch,
            gap,
            |site, along, draws| {
                let thing = if cones { things::cone() } else { things::barrier(draws) };
                site.stand(verge.pose(along, across + draws.between(-0.2, 0.2)), 0.0, thing);
            },
            draws,
        );
    }

    fn hedge(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
        let tallest = if verge.kind == VergeKind::Kerb { 1.0 } else { 1.4 };
        let height = draws.between(0.4, tallest);
        let width = draws.between(0.5, 1.4);
        let (width, middle_across) = match verge.kind {
            VergeKind::Median => (width.min(2.0 * verge.depth()), 0.0),
            VergeKind::Kerb => (width.min(verge.depth()), across),
            _ => (width, across + width / 2.0),
        };
        let depth = draws.between(0.05, 0.3);
        // Most have gaps, and are so seen in pieces.
        let broken = if draws.chance(0.8) { 0.7 } else { 0.0 };
        for [middle, length] in pieces(stretch, 3.0) {
            let height = height * draws.between(0.88, 1.1);
            let gap = if draws.chance(broken) {
                draws.between(0.25, 0.5)
            } else {
                0.0
            };
            let hedge = things::hedge(length * (1.0 - gap), width, height, depth, draws);
            self.stand(verge.pose(middle, middle_across), 0.1, hedge);
        }
    }

    /// Builds a wall, rail or fence along a stretch, in pieces that follow its bend.
    fn build(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], piece: impl Fn(f64) -> Vec<Part>) {
        for [middle, length] in pieces(stretch, 4.0) {
            self.stand(verge.pose(middle, across), 0.1, piece(length));
        }
    }
}
