//! What stands beside roads, as parts: x along the road, y away from it, z = 0 on the ground.

mod street;

use super::foliage::Mass;
use crate::random::Stream;
use crate::solid::{Part, Shape};
pub(super) use street::{barrier, bicycles, bin, bollard, cabinet, cone, lamp, shelter, sign, street_sign};

/// Reflectivity of concrete, painted metal, and retro-reflecting sheets.
const CONCRETE: f64 = 0.35;
const METAL: f64 = 0.4;
const SHEET: f64 = 2.5;

/// A block of which a share of the rays meets nothing.
fn sieve(low: [f64; 3], high: [f64; 3], rho: f64, pass: f64) -> Part {
    Part {
        shape: Shape::Block { low, high },
        rho,
        pass,
    }
}

/// How deep a ray gets into wood and stone, m.
const WOOD: f64 = 0.005;

/// What stands somewhere: solid parts, and foliage.
#[derive(Default)]
pub(super) struct Thing {
    pub parts: Vec<Part>,
    pub masses: Vec<Mass>,
}

impl From<Vec<Part>> for Thing {
    fn from(parts: Vec<Part>) -> Self {
        Thing {
            parts,
            masses: Vec::new(),
        }
    }
}

fn ball(center: [f64; 3], [wide, high]: [f64; 2], depth: f64, draws: &mut Stream) -> Mass {
    Mass {
        center,
        half: [wide, wide, high],
        block: false,
        depth,
        seed: draws.bits(),
    }
}

/// A clipped hedge along the road.
pub(super) fn hedge(length: f64, width: f64, height: f64, depth: f64, draws: &mut Stream) -> Thing {
    let mass = Mass {
        center: [0.0, 0.0, height / 2.0],
        half: [length / 2.0, width / 2.0, height / 2.0],
        block: true,
        depth,
        seed: draws.bits(),
    };
    Thing {
        masses: vec![mass],
        ..Thing::default()
    }
}

/// A shrub of one or two round masses.
pub(super) fn bush(height: f64, draws: &mut Stream) -> Thing {
    let spread = 0.2 + height * draws.between(0.3, 0.6);
    let depth = draws.between(0.15, 0.6);
    let masses = (0..1 + draws.below(3) / 2).map(|_| {
        let top = height * draws.between(0.75, 1.0);
        let aside = [(); 2].map(|()| draws.between(-0.6, 0.6) * spread);
        let center = [aside[0], aside[1], 0.48 * top];
        ball(center, [spread * draws.between(0.6, 1.0), 0.52 * top], depth, draws)
    });
    Thing {
        masses: masses.collect(),
        ..Thing::default()
    }
}

/// A boulder, a planter, a block of concrete: low and smooth.
pub(super) fn stone(height: f64, draws: &mut Stream) -> Thing {
    let half = [draws.between(0.2, 0.9), draws.between(0.15, 0.4), height / 2.0];
    let mass = Mass {
        center: [0.0, 0.0, height / 2.0],
        half,
        block: draws.chance(0.7),
        depth: WOOD,
        seed: draws.bits(),
    };
    Thing {
        masses: vec![mass],
        ..Thing::default()
    }
}

/// A tree: its trunk is a long ball of wood; the crown begins `under` above ground.
pub(super) fn tree(under: f64, height: f64, draws: &mut Stream) -> Thing {
    let radius = (0.28 * height * draws.between(0.7, 1.3)).min(4.0);
    let depth = draws.between(0.6, 2.0);
    let middle = 0.5 * (under + height);
    let trunk = ball(
        [0.0, 0.0, 0.5 * middle],
        [draws.between(0.08, 0.22), 0.55 * middle],
        WOOD,
        draws,
    );
    let crown = (0..1 + draws.below(2)).map(|_| {
        let up = (height - under) * draws.between(0.3, 0.5);
        let aside = [(); 2].map(|()| draws.between(-0.5, 0.5) * radius);
        let center = [aside[0], aside[1], draws.between(under + up, height - up)];
        ball(center, [radius * draws.between(0.7, 1.1), up], depth, draws)
    });
    let masses = std::iter::once(trunk).chain(crown.collect::<Vec<_>>()).collect();
    Thing {
        masses,
        ..Thing::default()
    }
}

/// High grass and weeds: most rays go through.
pub(super) fn grass(length: f64, width: f64, height: f64, draws: &mut Stream) -> Thing {
    hedge(length, width, height, draws.between(0.8, 2.5), draws)
}

pub(super) fn wall(length: f64, width: f64, height: f64) -> Vec<Part> {
    let (l, w) = (length / 2.0, width / 2.0);
    vec![Part::block([-l, -w, 0.0], [l, w, height], CONCRETE)]
}

/// A guard rail: a beam on posts.
pub(super) fn rail(length: f64) -> Vec<Part> {
    let l = length / 2.0;
    let mut parts = vec![Part::block([-l, -0.04, 0.43], [l, 0.04, 0.75], METAL)];
    for x in [-0.5 * l, 0.5 * l] {
        parts.push(Part::block([x - 0.05, 0.05, 0.0], [x + 0.05, 0.15, 0.7], METAL));
    }
    parts
}

/// A fence of mesh or bars between posts.
pub(super) fn fence(length: f64, height: f64, pass: f64) -> Vec<Part> {
    let l = length / 2.0;
    vec![
        sieve([-l, -0.02, 0.05], [l, 0.02, height], METAL, pass),
        Part::block([-l, -0.03, height - 0.05], [l, 0.03, height], METAL),
        Part::post([-l, 0.0], 0.04, [0.0, height], METAL),
        Part::post([0.0, 0.0], 0.04, [0.0, height], METAL),
    ]
}

/// A tree beside a street: its crown, a body that rays do not enter far, on a trunk; ranges of the crown's radius, of its foot's
/// height and of half its height, m.
pub(super) fn street_tree(radius: [f64; 2], foot: [f64; 2], up: [f64; 2], draws: &mut Stream) -> Vec<Part> {
    let [radius, foot, up] = [radius, foot, up].map(|[min, most]| draws.between(min, most));
    let crown = Shape::Crown {
        center: [0.0, 0.0, foot + up],
        radii: [radius, radius, up],
        depth: 0.9,
    };
    let trunk = Part::post([0.0, 0.0], draws.between(0.1, 0.24), [0.0, foot + 0.5], 0.25);
    vec![trunk, Part::solid(crown, 0.45)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solid::Solid;

    #[test]
    fn things_stand_on_the_ground_and_are_of_their_size() {
        let mut draws = Stream::new(1, "things", 0);
        for _ in 0..200 {
            let all: [(Thing, f64, f64); 12] = [
                (hedge(3.0, 0.8, 1.1, 0.3, &mut draws), 1.1, 1.1),
                (bush(1.5, &mut draws), 1.1, 1.6),
                (tree(1.5, 7.0, &mut draws), 3.0, 7.1),
                (wall(4.0, 0.2, 0.6).into(), 0.6, 0.6),
                (rail(4.0).into(), 0.75, 0.75),
                (fence(4.0, 1.6, 0.7).into(), 1.6, 1.6),
                (bollard(&mut draws).into(), 0.6, 1.1),
                (sign(&mut draws).into(), 2.1, 3.4),
                (bicycles(4, &mut draws).into(), 1.0, 1.1),
                (shelter(&mut draws).into(), 2.4, 2.75),
                (cone().into(), 0.75, 0.75),
                (barrier(&mut draws).into(), 0.85, 1.0),
            ];
            for (index, (thing, low, high)) in all.into_iter().enumerate() {
                let spans = thing
                    .masses
                    .iter()
                    .map(|mass| [-1.0, 1.0].map(|side| mass.center[2] + side * mass.half[2]));
                let body = (!thing.parts.is_empty()).then(|| Solid::new(thing.parts));
                let spans = spans.chain(body.map(|body| [body.low[2], body.high[2]]));
                let [foot, top] = spans.fold([f64::MAX, f64::MIN], |all, span| {
                    [all[0].min(span[0]), all[1].max(span[1])]
                });
                assert!(foot.abs() < 0.3, "thing {index} begins at {foot}");
                assert!(
                    (low - 1e-9..=high + 1e-9).contains(&top),
                    "thing {index} is {top} m high"
                );
            }
        }
    }
}
