//! A boulevard with a planted median.

use std::f64::consts::{FRAC_PI_2, PI};

use super::lines::{degrees, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX};
use crate::place::network::{Bays, Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// A boulevard with a planted median, between houses.
pub(super) fn avenue(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let node = builder.node([0.0; 2], Control::Signals, draws.between(4.0, 6.0), true);
    let slant = FRAC_PI_2 + sign(draws) * degrees(draws, 12.0, 34.0);
    let median = draws.between(3.5, 8.0);
    let bays = draws.chance(0.6);
    for k in 0..4 {
        let main = k % 2 == 0;
        let mut section = Section::street(3.25, if main { 50.0 * KMH } else { 30.0 * KMH });
        if main {
            section.lanes = [2, 2];
            section.median = median;
            section.cycle = 1.7;
            section.pavement = [5.0; 2];
            section.bays = [bays.then_some(Bays::PARALLEL); 2];
        } else {
            section.pavement = [4.0; 2];
            let slanted = [45.0, 60.0, 90.0][draws.below(3)];
            section.bays[draws.below(2)] = Some(Bays::slanted(slanted));
        }
        section.beside = [(VergeKind::Street, draws.between(5.0, 10.0)); 2];
        let base = if k < 2 { 0.0 } else { PI } + if main { 0.0 } else { slant };
        let heading = base + degrees(draws, -7.0, 7.0);
        let angle = sign(draws) * degrees(draws, 14.0, 32.0);
        let line = outwards([0.0; 2], heading, draws.between(80.0, 160.0), angle, REACH);
        builder.road(line, section, [Some(node), None], main, k % 2);
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.gap = [70.0, 34.0];
    draft.mix.walkers = [20, 52];
    draft.grade = [0.002, 0.015];
    draft.mix.near = 75.0;
    draft
}
