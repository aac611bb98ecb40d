//! What stands and grows beside the roads of a place: foliage above all, walls, rails, fences, street furniture, works.

mod growing;
mod kinds;
mod lining;

use super::foliage::{Foliage, Mass};
use super::things::Thing;
use super::{Fixture, Verge, VergeKind};
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::Solid;

/// Rows of trees begin so far from where roads meet, m.
const ROWS_FROM: f64 = 35.0;
/// Rows of trees in the middle of a roadside unit's view begin so far from it, m.
const UNROWED: f64 = 60.0;

/// Beds, steps and terraces lie so near to where roads meet, m.
const AROUND_NODES: f64 = 40.0;
/// Low walls of beds around a node on 100 m².
const LOW_WALLS: f64 = 9.0;
/// From a bed to the next pavement, road or house it is at most so far, m.
const BEDS: f64 = 14.0;

/// What is higher is a tree, m.
const TREE: f64 = 3.0;
/// There are no trees in the middle of a roadside unit's view so near to it, m: these stand where they see.
pub(super) const TREELESS: f64 = 50.0;
/// In the middle of a roadside unit's view, so near to it, m, some of what grows elsewhere is missing: [`BARE_ROW`] and so on.
const TENDED: f64 = 100.0;
/// Share of the first row that is missing there; these shares are fitted to the clusters that a recorded roadside unit has.
const BARE_ROW: f64 = 0.75;
/// Share of the beds' low walls that is missing there.
const BARE_BEDS: f64 = 0.95;
/// Share of what grows behind the first row, but for trees, that is missing there.
const BARE_BEHIND: f64 = 0.94;

/// The ground on which clutter stands.
pub(super) struct Ground<'a> {
    /// Distance of a point from all that is paved and from the houses, m.
    pub open: &'a dyn Fn(f64, f64) -> f64,
    /// Distance of a point from the carriageways, m.
    pub off_road: &'a dyn Fn(f64, f64) -> f64,
    /// Height, m.
    pub height: &'a dyn Fn(f64, f64) -> f64,
    /// Distance from a roadside unit to a point in the middle of its view, m; infinite outside.
    pub watched: &'a dyn Fn(f64, f64) -> f64,
    /// Where roads meet.
    pub nodes: &'a [[f64; 2]],
}

impl Ground<'_> {
    /// Distance of a point from where roads meet, m.
    fn node_distance(&self, Pose2 { x, y, .. }: Pose2) -> f64 {
        let far = self.nodes.iter().map(|node| libm::hypot(node[0] - x, node[1] - y));
        far.fold(f64::INFINITY, f64::min)
    }

    /// Whether a roadside unit looks over here, so that less grows.
    fn tended(&self, Pose2 { x, y, .. }: Pose2) -> bool {
        (self.watched)(x, y) < TENDED
    }
}

/// What stands on the verges of a place.
pub(super) struct Clutter {
    pub fixtures: Vec<Fixture>,
    pub foliage: Vec<Foliage>,
}

/// Everything that stands on the verges of a place.
pub(super) fn clutter(verges: &[Verge], ground: &Ground, number: u64) -> Clutter {
    let mut clutter = Clutter {
        fixtures: Vec::new(),
        foliage: Vec::new(),
    };
    for (index, verge) in verges.iter().enumerate() {
        let mut site = Site {
            ground,
            paved: matches!(verge.kind, VergeKind::Kerb | VergeKind::Median),
            clutter: &mut clutter,
        };
        let mut draws = Stream::new(number, "clutter", index as u64);
        site.line(verge, &mut draws);
        site.grow(verge, &mut draws);
        site.row(verge, &mut Stream::new(number, "rows", index as u64));
    }
    for (index, node) in ground.nodes.iter().enumerate() {
        let mut site = Site {
            ground,
            paved: false,
            clutter: &mut clutter,
        };
        site.beds(*node, &mut Stream::new(number, "beds", index as u64));
    }
    clutter
}

struct Site<'a> {
    ground: &'a Ground<'a>,
    /// Whether things may stand on what is paved, and on what it surrounds.
    paved: bool,
    clutter: &'a mut Clutter,
}

impl Site<'_> {
    /// Stands something up, unless the ground within `clear` of its foot is paved and has to be free.
    fn stand(&mut self, pose: Pose2, clear: f64, thing: impl Into<Thing>) {
        let Pose2 { x, y, heading } = pose;
        if !self.paved && (self.ground.open)(x, y) < clear {
            return;
        }
        let Thing { parts, masses } = thing.into();
        let top = |mass: &Mass| mass.center[2] + mass.half[2];
        if masses.iter().any(|mass| top(mass) > TREE) && (self.ground.watched)(x, y) < TREELESS {
            return;
        }
        // Along its length the ground may fall: no ray slips under it.
        let (sin, cos) = libm::sincos(heading);
        let height = |half: f64| {
            let at = |u: f64| (self.ground.height)(x + u * cos, y + u * sin);
            at(0.0).min(at(half)).min(at(-half)) - 0.03
        };
        for mass in &masses {
            let z = height(if mass.block { mass.half[0] } else { 0.0 });
            self.clutter.foliage.push(Foliage::stand(mass, pose, z));
        }
        if !parts.is_empty() {
            let solid = Solid::new(parts);
            let z = height(solid.high[0].max(-solid.low[0]).min(4.0));
            self.clutter.fixtures.push(Fixture { pose, z, solid });
        }
    }
}

/// Cuts a stretch into pieces of about `size`: middle and length of each, m.
fn pieces([from, to]: [f64; 2], size: f64) -> impl Iterator<Item = [f64; 2]> {
    let count = ((to - from) / size).ceil().max(1.0);
    let length = (to - from) / count;
    (0..count as usize).map(move |k| [from + (k as f64 + 0.5) * length, length])
}

fn turned(pose: Pose2, draws: &mut Stream) -> Pose2 {
    Pose2 {
        heading: pose.heading + draws.between(0.0, std::f64::consts::TAU),
        ..pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::Path;

    /// Ground along a road of 10 m, with pavements of 2 m on both sides; behind them it is open.
    fn along_a_road(verges: &[Verge], nodes: &[[f64; 2]]) -> Clutter {
        let ground = Ground {
            open: &|_, y| y.abs() - 7.0,
            off_road: &|_, y| y.abs() - 5.0,
            height: &|_, _| 0.0,
            watched: &|_, _| f64::INFINITY,
            nodes,
        };
        clutter(verges, &ground, 7)
    }

    #[test]
    fn low_walls_around_a_node_leave_road_and_pavement_free() {
        let walls = along_a_road(&[], &[[0.0, 0.0]]).fixtures;
        assert!(walls.len() > 50, "{} walls", walls.len());
        for wall in walls {
            let (pose, [length, width, _]) = wall.footprint();
            let height = wall.solid.high[2];
            assert!((2.0..=8.0).contains(&length) && height < 0.9, "{length} by {height}");
            for (u, v) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
                let corner = pose.at(u * length, v * width);
                assert!(corner.y.abs() > 7.4, "reaches {corner:?}");
                assert!(
                    libm::hypot(corner.x, corner.y) < AROUND_NODES + 4.1,
                    "far off: {corner:?}"
                );
            }
        }
    }

    #[test]
    fn on_medians_things_stand_between_lanes_and_elsewhere_not() {
        let middle = |kind| {
            let mut line = Path::from(-100.0, 0.0, 0.0);
            line.line(200.0);
            let clutter = along_a_road(&[Verge::new(kind, line, 2.0)], &[]);
            clutter.fixtures.len() + clutter.foliage.len()
        };
        assert!(middle(VergeKind::Median) > 20);
        assert_eq!(middle(VergeKind::Park), 0);
    }

    #[test]
    fn pieces_fill_their_stretch() {
        let cut: Vec<[f64; 2]> = pieces([2.0, 12.0], 4.0).collect();
        assert_eq!(cut.len(), 3);
        assert!((cut[0][0] - cut[0][1] / 2.0 - 2.0).abs() < 1e-9 && (cut[2][0] + cut[2][1] / 2.0 - 12.0).abs() < 1e-9);
    }
}
