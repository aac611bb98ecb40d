//! Streets around a block.

use std::f64::consts::{FRAC_PI_2, PI};

use super::lines::{bend, degrees, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX};
use crate::path::Path;
use crate::place::network::{Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// Streets around a block, with a side street on three of its sides: lights at one of them, and on the fourth side a
/// canyon between tall houses, where receivers have no position for more than 20 s at its limit.
pub(super) fn block(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let (length, width) = (draws.between(244.0, 256.0), draws.between(104.0, 120.0));
    let radius = draws.between(15.0, 19.0);
    let corner = Corner::new(radius);
    let at = [[0.0, -0.5 * width], [0.5 * length, 0.0], [-0.5 * length, 0.0]];
    let controls = [Control::Signals, Control::Priority, Control::Priority];
    let nodes = [0, 1, 2].map(|k| builder.node(at[k], controls[k], 4.0, true));
    let street = |draws: &mut Stream, kinds: [VergeKind; 2]| {
        let mut section = Section::street(3.25, 40.0 * KMH);
        section.beside = kinds.map(|kind| match kind {
            VergeKind::Street => (kind, draws.between(2.5, 4.0)),
            _ => (kind, draws.between(9.0, 16.0)),
        });
        section
    };
    // Round it goes counter-clockwise: east, north, west, south.
    let mut ring = Vec::new();
    let line = corner.way(at[0], 0.0, &[0.5 * length, 0.5 * width]);
    let section = street(draws, [VergeKind::Garden, VergeKind::Park]);
    ring.push(builder.road(line, section, [Some(nodes[0]), Some(nodes[1])], true, 0));
    let line = corner.way(at[1], FRAC_PI_2, &[0.5 * width, length, 0.5 * width]);
    let mut section = street(draws, [VergeKind::Street, VergeKind::Street]);
    section.limit = 30.0 * KMH;
    // The straight between its two curves.
    let first = 0.5 * width - corner.reach + corner.length;
    let hidden = [first, first + length - 2.0 * corner.reach];
    ring.push(builder.road(line, section, [Some(nodes[1]), Some(nodes[2])], true, 0));
    let line = corner.way(at[2], -FRAC_PI_2, &[0.5 * width, 0.5 * length]);
    let section = street(draws, [VergeKind::Garden, VergeKind::Garden]);
    ring.push(builder.road(line, section, [Some(nodes[2]), Some(nodes[0])], true, 0));
    for (k, heading) in [-FRAC_PI_2, 0.0, PI].into_iter().enumerate() {
        let section = street(draws, [VergeKind::Garden, VergeKind::Park]);
        let angle = sign(draws) * degrees(draws, 8.0, 20.0);
        let line = outwards(at[k], heading, draws.between(60.0, 110.0), angle, REACH - 100.0);
        builder.road(line, section, [Some(nodes[k]), None], false, 1);
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.gap = [85.0, 45.0];
    draft.mix.near = 400.0;
    draft.grade = [0.002, 0.012];
    draft.hidden = vec![(ring[1], hidden)];
    draft.ring = ring;
    draft
}

/// A quarter of a turn to the left.
struct Corner {
    radius: f64,
    /// From its begin to where the lines before and behind it meet, m.
    reach: f64,
    /// Along it, m.
    length: f64,
}

impl Corner {
    fn new(radius: f64) -> Self {
        let mut path = Path::from(0.0, 0.0, 0.0);
        bend(&mut path, radius, FRAC_PI_2);
        Corner {
            radius,
            reach: path.at(path.length()).0.x,
            length: path.length(),
        }
    }

    /// A way along sides of these lengths, with a corner from each to the next.
    fn way(&self, [x, y]: [f64; 2], heading: f64, sides: &[f64]) -> Path {
        let mut path = Path::from(x, y, heading);
        for (k, side) in sides.iter().enumerate() {
            let corners = f64::from(u8::from(k > 0) + u8::from(k + 1 < sides.len()));
            path.line(side - corners * self.reach);
            if k + 1 < sides.len() {
                bend(&mut path, self.radius, FRAC_PI_2);
            }
        }
        path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_streets_close_around_the_block_and_the_canyon_takes_twenty_seconds() {
        for number in 0..20 {
            let draft = block(&mut Stream::new(number, "network", 0));
            let Draft {
                builder, hidden, ring, ..
            } = draft;
            for (k, road) in ring.iter().enumerate() {
                let line = &builder.roads[*road].line;
                let (end, next) = (
                    line.at(line.length()).0,
                    builder.roads[ring[(k + 1) % 3]].line.at(0.0).0,
                );
                assert!(
                    (end.x - next.x).hypot(end.y - next.y) < 1e-6,
                    "{number}: road {k} ends at {end:?}, not {next:?}"
                );
            }
            let [(road, [from, to])] = hidden[..] else { panic!() };
            // Nobody drives faster than 1.08 times the limit.
            assert!(
                (to - from) / (1.08 * builder.roads[road].section.limit) > 20.0,
                "{from} to {to} m"
            );
        }
    }
}
