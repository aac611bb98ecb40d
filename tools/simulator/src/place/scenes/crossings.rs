//! Roads that meet at a slant: crossings, tees and roundabouts.

use std::f64::consts::{FRAC_PI_2, PI};

use super::lines::{bend, degrees, outwards, sign};
use super::{Draft, KMH, REACH, USUAL_MIX, beside};
use crate::path::Path;
use crate::place::network::{Bays, Builder, Control, Section};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// Two roads that cross at a slant, without walls around them.
pub(super) fn junction(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let lanes = if draws.chance(0.5) { 2 } else { 1 };
    let cycle = if draws.chance(0.5) { 1.6 } else { 0.0 };
    let control = if lanes == 2 || draws.chance(0.35) {
        Control::Signals
    } else {
        Control::Priority
    };
    let node = builder.node([0.0; 2], control, draws.between(3.5, 6.0), true);
    let slant = FRAC_PI_2 + sign(draws) * degrees(draws, 12.0, 35.0);
    for k in 0..4 {
        let main = k % 2 == 0;
        let mut section = Section::street(3.3, if main { 50.0 * KMH } else { 40.0 * KMH });
        section.lanes = if main { [lanes; 2] } else { [1, 1] };
        section.cycle = cycle;
        section.beside = [(VergeKind::Park, draws.between(18.0, 36.0)); 2];
        let base = if k < 2 { 0.0 } else { PI } + if main { 0.0 } else { slant };
        let heading = base + degrees(draws, -9.0, 9.0);
        let angle = sign(draws) * degrees(draws, 16.0, 36.0);
        let line = outwards([0.0; 2], heading, draws.between(50.0, 120.0), angle, REACH);
        builder.road(line, section, [Some(node), None], main, k % 2);
    }
    Draft::new(builder, USUAL_MIX)
}

/// A road that ends at another.
pub(super) fn tee(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let control = if draws.chance(0.3) {
        Control::Signals
    } else {
        Control::Priority
    };
    let node = builder.node([0.0; 2], control, draws.between(3.0, 5.0), true);
    let stem = sign(draws) * (FRAC_PI_2 + sign(draws) * degrees(draws, 10.0, 40.0));
    let lanes = if draws.chance(0.3) { 2 } else { 1 };
    for (k, base) in [0.0, PI, stem].into_iter().enumerate() {
        let main = k < 2;
        let mut section = Section::street(3.25, if main { 50.0 * KMH } else { 30.0 * KMH });
        section.lanes = if main { [lanes; 2] } else { [1, 1] };
        section.beside = beside(draws);
        if !main && draws.chance(0.6) {
            section.bays[0] = Some(Bays::slanted(if draws.chance(0.5) { 45.0 } else { 60.0 }));
        }
        let angle = sign(draws) * degrees(draws, 15.0, 36.0);
        let heading = base + if main { degrees(draws, -8.0, 8.0) } else { 0.0 };
        let line = outwards([0.0; 2], heading, draws.between(50.0, 120.0), angle, REACH);
        builder.road(line, section, [Some(node), None], main, usize::from(!main));
    }
    Draft::new(builder, USUAL_MIX)
}

/// Three or four roads that meet in a ring.
pub(super) fn roundabout(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let (radius, width) = (draws.between(13.5, 17.5), draws.between(4.6, 5.4));
    let node = builder.node([0.0; 2], Control::Roundabout { radius, width }, 4.0, true);
    let count = if draws.chance(0.3) { 3 } else { 4 };
    for k in 0..count {
        let mut section = Section::street(3.4, 50.0 * KMH);
        section.median = 0.8;
        section.beside = beside(draws);
        let jitter = if count == 4 { 7.0 } else { 18.0 };
        let heading = 2.0 * PI * f64::from(k) / f64::from(count) + degrees(draws, -jitter, jitter);
        let angle = sign(draws) * degrees(draws, 14.0, 32.0);
        let mut line = Path::from(0.0, 0.0, heading);
        line.line(40.0);
        bend(&mut line, draws.between(60.0, 130.0), angle);
        let left = REACH - line.length();
        line.line(left);
        builder.road(line, section, [Some(node), None], true, 0);
    }
    let mut draft = Draft::new(builder, USUAL_MIX);
    draft.mix.near = 70.0;
    draft
}
