//! Narrow streets between gardens.

use std::f64::consts::PI;

use super::lines::{degrees, link, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX};
use crate::path::Pose2;
use crate::place::network::{Bays, Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// Narrow streets between gardens, with parked cars on both sides.
pub(super) fn residential(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let apart = draws.between(72.0, 95.0);
    let ends = [[-0.5 * apart, 0.0], [0.5 * apart, draws.between(-14.0, 14.0)]];
    let nodes = ends.map(|at| builder.node(at, Control::Uncontrolled, 2.5, true));
    let street = |draws: &mut Stream| {
        let mut section = Section::street(2.85, 30.0 * KMH);
        section.pavement = [2.0; 2];
        for side in 0..2 {
            section.bays[side] = Some(match draws.unit() {
                u if u < 0.4 => Bays::PARALLEL,
                u if u < 0.65 => Bays::slanted(45.0),
                u if u < 0.9 => Bays::slanted(60.0),
                _ => Bays::SQUARE,
            });
            section.beside[side] = (VergeKind::Garden, draws.between(8.0, 15.0));
        }
        section
    };
    let (first, second) = (degrees(draws, -16.0, 16.0), degrees(draws, -16.0, 16.0));
    let from = Pose2 {
        x: ends[0][0],
        y: ends[0][1],
        heading: first,
    };
    let to = Pose2 {
        x: ends[1][0],
        y: ends[1][1],
        heading: second,
    };
    builder.road(link(from, to, 18.0), street(draws), nodes.map(Some), true, 0);
    for (k, ahead) in [first + PI, second].into_iter().enumerate() {
        let section = street(draws);
        let angle = sign(draws) * degrees(draws, 12.0, 35.0);
        let heading = ahead + degrees(draws, -6.0, 6.0);
        let line = outwards(ends[k], heading, draws.between(50.0, 110.0), angle, REACH - 40.0);
        builder.road(line, section, [Some(nodes[k]), None], true, 0);
        let up = if k == 0 { 1.0 } else { -1.0 };
        let both = draws.chance(0.4);
        for side in [up, -up].into_iter().take(if both { 2 } else { 1 }) {
            let section = street(draws);
            let heading = [first, second][k] + side * degrees(draws, 72.0, 108.0);
            let angle = sign(draws) * degrees(draws, 10.0, 28.0);
            let line = outwards(ends[k], heading, draws.between(50.0, 110.0), angle, REACH - 60.0);
            builder.road(line, section, [Some(nodes[k]), None], false, 1);
        }
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.gap = [85.0, 45.0];
    draft.mix.walkers = [14, 30];
    draft.mix.prams = 0.12;
    draft.mix.tricycles = [0.04, 0.06];
    draft.mix.parked = [0.5, 0.8];
    draft.mix.long = 0.02;
    draft.mix.riders = 0.25;
    draft.mix.near = 75.0;
    draft
}
