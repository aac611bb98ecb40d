//! A winding road with two entries.

use std::f64::consts::PI;

use super::lines::{LEAD, bend, degrees, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX, beside};
use crate::path::{Path, Pose2};
use crate::place::network::{Bays, Builder, Control, Section};
use crate::random::Stream;

/// A road that winds, with two entries from its outer side.
pub(super) fn curve(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let turn = sign(draws);
    let angle = turn * degrees(draws, 55.0, 95.0);
    let radius = draws.between(38.0, 65.0);
    let wind = |start: Pose2| {
        let mut path = Path::from_pose(start);
        path.line(LEAD);
        bend(&mut path, radius, angle);
        path.line(LEAD);
        path
    };
    let origin = Pose2 {
        x: 0.0,
        y: 0.0,
        heading: 0.0,
    };
    let trial = wind(origin);
    let middle = trial.at(0.5 * trial.length()).0;
    let start = Pose2 {
        x: -middle.x,
        y: -middle.y,
        heading: 0.0,
    };
    let between = wind(start);
    let end = between.at(between.length()).0;
    let ends = [[start.x, start.y], [end.x, end.y]];
    let nodes = ends.map(|at| builder.node(at, Control::Priority, 3.5, true));
    let mut section = Section::street(3.3, 45.0 * KMH);
    section.cycle = if draws.chance(0.4) { 1.5 } else { 0.0 };
    section.beside = beside(draws);
    builder.road(between, section.clone(), nodes.map(Some), true, 0);
    for (k, heading) in [PI, end.heading].into_iter().enumerate() {
        let swing = sign(draws) * degrees(draws, 22.0, 45.0);
        section.beside = beside(draws);
        let line = outwards(ends[k], heading, draws.between(40.0, 90.0), swing, REACH - 40.0);
        builder.road(line, section.clone(), [Some(nodes[k]), None], true, 0);
        let mut entry = Section::street(3.0, 30.0 * KMH);
        entry.beside = beside(draws);
        entry.bays[1] = draws.chance(0.6).then_some(Bays::slanted([45.0, 60.0][draws.below(2)]));
        let ahead = if k == 0 { 0.0 } else { end.heading };
        let side = ahead - turn * degrees(draws, 70.0, 115.0);
        let line = outwards(
            ends[k],
            side,
            60.0,
            sign(draws) * degrees(draws, 14.0, 30.0),
            REACH - 50.0,
        );
        builder.road(line, entry, [Some(nodes[k]), None], false, 1);
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.near = 70.0;
    draft
}
