//! A shopping street.

use std::f64::consts::PI;

use super::lines::{degrees, link, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX};
use crate::path::Pose2;
use crate::place::network::{Bays, Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// A shopping street: walkers on wide pavements and over two crossings, vans at the kerb.
pub(super) fn market(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let apart = draws.between(48.0, 64.0);
    let ends = [[-0.4 * apart, 0.0], [0.6 * apart, draws.between(-8.0, 8.0)]];
    let nodes = ends.map(|at| builder.node(at, Control::Priority, 3.0, true));
    let street = |draws: &mut Stream| {
        let mut section = Section::street(3.0, 25.0 * KMH);
        section.pavement = [draws.between(5.0, 7.0), draws.between(5.0, 7.0)];
        let slanted = Bays::slanted([45.0, 60.0][draws.below(2)]);
        let other = if draws.chance(0.5) { slanted } else { Bays::PARALLEL };
        section.bays = [Some(other), Some(slanted)];
        section.beside = [(VergeKind::Street, draws.between(4.0, 8.0)); 2];
        section
    };
    let headings = [degrees(draws, -14.0, 14.0), degrees(draws, -14.0, 14.0)];
    let pose = |k: usize| Pose2 {
        x: ends[k][0],
        y: ends[k][1],
        heading: headings[k],
    };
    builder.road(link(pose(0), pose(1), 16.0), street(draws), nodes.map(Some), true, 0);
    for (k, heading) in [headings[0] + PI, headings[1]].into_iter().enumerate() {
        let angle = sign(draws) * degrees(draws, 12.0, 26.0);
        let line = outwards(ends[k], heading, draws.between(70.0, 130.0), angle, REACH - 35.0);
        builder.road(line, street(draws), [Some(nodes[k]), None], true, 0);
    }
    // One of the crossings lies at a side street, the other in the middle of the block.
    let mut section = Section::street(3.0, 25.0 * KMH);
    section.pavement = [4.0; 2];
    section.bays[0] = Some(Bays::PARALLEL);
    section.beside = [(VergeKind::Street, 5.0); 2];
    let heading = headings[0] + sign(draws) * degrees(draws, 68.0, 112.0);
    let angle = sign(draws) * degrees(draws, 10.0, 25.0);
    let line = outwards(ends[0], heading, draws.between(70.0, 130.0), angle, REACH - 40.0);
    builder.road(line, section, [Some(nodes[0]), None], false, 1);
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.gap = [60.0, 34.0];
    draft.mix.walkers = [46, 84];
    draft.mix.groups = 0.25;
    draft.mix.standing = [5, 9];
    draft.mix.prams = 0.08;
    draft.mix.between = 0.15;
    draft.mix.tricycles = [0.08, 0.08];
    draft.mix.parked = [0.4, 0.7];
    draft.mix.vans = [0.45, 0.2];
    draft.mix.long = 0.03;
    draft.mix.riders = 0.2;
    draft.grade = [0.002, 0.018];
    draft.mix.near = 75.0;
    draft
}
