//! A winding road over open land.

use std::f64::consts::{FRAC_PI_2, PI};

use super::lines::{degrees, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX};
use crate::place::network::{Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// A winding road over open land, without kerbs.
pub(super) fn rural(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let node = builder.node([0.0; 2], Control::Priority, draws.between(4.0, 7.0), false);
    let slant = FRAC_PI_2 + sign(draws) * degrees(draws, 10.0, 34.0);
    let crosses = draws.chance(0.5);
    let bases = [0.0, PI, slant, PI + slant];
    for (k, base) in bases.into_iter().enumerate().take(if crosses { 4 } else { 3 }) {
        let main = k < 2;
        let mut section = Section::street(
            if main { 3.3 } else { 2.75 },
            if main { 70.0 * KMH } else { 45.0 * KMH },
        );
        section.pavement = [0.0; 2];
        section.shoulder = if main { 0.6 } else { 0.2 };
        section.beside = [(VergeKind::Field, draws.between(20.0, 36.0)); 2];
        let angle = sign(draws) * degrees(draws, 20.0, 45.0);
        let heading = base + degrees(draws, -9.0, 9.0);
        let line = outwards([0.0; 2], heading, draws.between(60.0, 110.0), angle, REACH);
        builder.road(line, section, [Some(node), None], main, usize::from(!main));
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.kerbs = false;
    draft.mix.gap = [75.0, 30.0];
    draft.mix.walkers = [0, 0];
    draft.mix.long = 0.14;
    draft.mix.riders = 0.12;
    draft.mix.tricycles = [0.0, 0.04];
    draft.grade = [0.012, 0.03];
    draft.mix.near = 75.0;
    draft
}
