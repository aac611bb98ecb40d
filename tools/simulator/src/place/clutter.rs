//! What stands and grows beside the roads of a place: foliage above all, walls, rails, fences, street furniture, works.

use super::foliage::{Foliage, Mass};
use super::things::{self, Thing};
use super::{Fixture, Verge, VergeKind};
use crate::path::Pose2;
use crate::random::Stream;
use crate::solid::{Part, Solid};

/// What a stretch of a verge is lined with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lining {
    Hedge,
    /// A low wall with a hedge behind it.
    WalledHedge,
    Shrubs,
    Trees,
    /// High grass with a shrub here and there.
    Grass,
    Wall,
    Rail,
    Fence,
    /// Bollards, signs, lamps, bins, cabinets.
    Furniture,
    Bicycles,
    Shelter,
    Works,
    Bare,
}

/// How often stretches have what lining, by the kind of the verge; weights.
fn linings(kind: VergeKind) -> &'static [(Lining, f64)] {
    use Lining::*;
    match kind {
        VergeKind::Garden => &[
            (Hedge, 5.0),
            (WalledHedge, 3.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Wall, 3.0),
            (Fence, 1.5),
            (Furniture, 1.5),
            (Works, 0.3),
            (Bare, 1.0),
        ],
        VergeKind::Street => &[
            (Furniture, 3.0),
            (Bicycles, 3.0),
            (Shelter, 0.5),
            (Hedge, 3.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Wall, 1.0),
            (Fence, 0.7),
            (Works, 0.6),
            (Bare, 1.0),
        ],
        VergeKind::Park => &[
            (Hedge, 3.0),
            (WalledHedge, 1.5),
            (Shrubs, 5.0),
            (Trees, 4.0),
            (Grass, 2.0),
            (Wall, 2.5),
            (Fence, 1.0),
            (Furniture, 1.5),
            (Bicycles, 0.5),
            (Shelter, 0.3),
            (Works, 0.3),
            (Bare, 1.0),
        ],
        VergeKind::Field => &[
            (Grass, 5.0),
            (Shrubs, 3.0),
            (Trees, 2.0),
            (Hedge, 1.0),
            (Rail, 1.0),
            (Fence, 1.0),
            (Furniture, 1.0),
            (Bare, 2.0),
        ],
        VergeKind::Embankment => &[
            (Rail, 5.0),
            (Shrubs, 4.0),
            (Grass, 2.0),
            (Fence, 1.0),
            (Trees, 1.0),
            (Furniture, 0.7),
            (Works, 0.4),
        ],
        VergeKind::Median => &[
            (Hedge, 4.0),
            (Rail, 2.0),
            (Fence, 2.0),
            (Shrubs, 1.5),
            (Trees, 0.7),
            (Works, 0.3),
            (Bare, 1.5),
        ],
        VergeKind::CarPark => &[
            (Hedge, 3.0),
            (Shrubs, 2.0),
            (Furniture, 2.0),
            (Wall, 1.0),
            (Fence, 1.0),
            (Bicycles, 1.0),
            (Trees, 1.0),
            (Bare, 2.0),
        ],
        VergeKind::Kerb => &[
            (Hedge, 6.0),
            (Bicycles, 3.0),
            (Furniture, 3.0),
            (Fence, 0.3),
            (Bare, 0.3),
        ],
    }
}

/// What there is behind the first row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Growth {
    /// With a stone here and there.
    Weed,
    Shrub,
    LowWall,
    Tree,
}

/// How much of each there is on 100 m² of free ground, by the kind of the verge.
fn growth(kind: VergeKind) -> [(Growth, f64); 4] {
    let [weeds, shrubs, low_walls, trees] = match kind {
        VergeKind::Garden => [50.0, 20.0, 5.0, 3.6],
        VergeKind::Street => [60.0, 33.0, 7.0, 4.0],
        VergeKind::Park => [42.0, 14.5, 6.0, 3.2],
        VergeKind::Field => [22.0, 5.5, 6.0, 1.2],
        VergeKind::Embankment => [14.0, 5.0, 3.0, 1.0],
        VergeKind::CarPark => [38.0, 19.0, 1.5, 1.8],
        VergeKind::Median | VergeKind::Kerb => [0.0; 4],
    };
    [
        (Growth::Weed, weeds),
        (Growth::Shrub, shrubs),
        (Growth::LowWall, low_walls),
        (Growth::Tree, trees),
    ]
}

/// How often a verge has a row of trees over whatever lines it, by its kind.
fn tree_lined(kind: VergeKind) -> f64 {
    match kind {
        VergeKind::Garden => 0.55,
        VergeKind::Street => 0.3,
        VergeKind::Park => 0.7,
        VergeKind::Field => 0.65,
        VergeKind::Embankment => 0.5,
        VergeKind::Median => 0.5,
        VergeKind::CarPark => 0.5,
        VergeKind::Kerb => 0.75,
    }
}

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

/// How trees stand in a row.
struct Trees {
    /// Where their crowns begin, m.
    under: f64,
    /// How high they are, m.
    height: f64,
    /// From one to the next, m.
    gap: f64,
    /// How often there is a shrub between two of them.
    shrubs: f64,
}

impl Trees {
    /// Trees alike, each figure of them drawn from a range.
    fn drawn(under: [f64; 2], height: [f64; 2], gap: [f64; 2], shrubs: f64, draws: &mut Stream) -> Self {
        let [under, height, gap] = [under, height, gap].map(|[from, to]| draws.between(from, to));
        Trees {
            under,
            height,
            gap,
            shrubs,
        }
    }
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

    /// The first row, in stretches.
    fn line(&mut self, verge: &Verge, draws: &mut Stream) {
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

    fn stretch(&mut self, verge: &Verge, lining: Lining, [from, to]: [f64; 2], draws: &mut Stream) {
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

    fn shrubs(&mut self, verge: &Verge, across: f64, stretch: [f64; 2], draws: &mut Stream) {
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

    /// Edges of beds, steps and terraces on the free ground around a node.
    fn beds(&mut self, [x, y]: [f64; 2], draws: &mut Stream) {
        let area = std::f64::consts::PI * AROUND_NODES * AROUND_NODES;
        for _ in 0..(LOW_WALLS * area / 100.0) as usize {
            let heading = draws.between(0.0, std::f64::consts::TAU);
            let pose = Pose2 { x, y, heading }.at(AROUND_NODES * draws.unit().sqrt(), 0.0);
            let tended = self.ground.tended(pose);
            if !(tended && draws.chance(BARE_BEDS)) && (self.ground.open)(pose.x, pose.y) < BEDS {
                self.low_wall(turned(pose, draws), draws);
            }
        }
    }

    /// The edge of a bed, a step or a terrace, where nobody drives or walks.
    fn low_wall(&mut self, pose: Pose2, draws: &mut Stream) {
        const CLEAR: f64 = 0.6;
        let length = 2.0 + 6.0 * draws.unit() * draws.unit();
        let wall = things::wall(length, 0.24, draws.between(0.4, 0.85));
        let free = |share: f64| {
            let Pose2 { x, y, .. } = pose.at(share * length, 0.0);
            (self.ground.open)(x, y) > CLEAR && (self.ground.off_road)(x, y) > CLEAR
        };
        if [-0.5, -0.25, 0.0, 0.25, 0.5].into_iter().all(free) {
            self.stand(pose, 0.0, wall);
        }
    }

    /// Goes along a stretch in uneven steps of about `gap`.
    fn spots(
        &mut self,
        [from, to]: [f64; 2],
        gap: f64,
        mut put: impl FnMut(&mut Self, f64, &mut Stream),
        draws: &mut Stream,
    ) {
        let mut along = from + 0.5 * gap * draws.unit();
        while along < to {
            put(self, along, draws);
            along += gap * draws.between(0.6, 1.4);
        }
    }

    /// A row of trees whose crowns hang over what lines the verge, over what is parked before it and the outer lane, with
    /// shrubs below.
    fn row(&mut self, verge: &Verge, draws: &mut Stream) {
        if !draws.chance(tree_lined(verge.kind)) {
            return;
        }
        let (across, shrubs) = match verge.kind {
            VergeKind::Median => (0.0, 0.2),
            VergeKind::Kerb => (0.5 * verge.depth(), 0.35),
            _ => (draws.between(0.5, 1.6).min(0.5 * verge.depth()), 0.5),
        };
        let trees = Trees::drawn([1.2, 2.4], [4.5, 9.0], [3.5, 7.0], shrubs, draws);
        let rowed = |ground: &Ground, pose: Pose2| {
            ground.node_distance(pose) >= ROWS_FROM && (ground.watched)(pose.x, pose.y) >= UNROWED
        };
        self.trees(&trees, verge, across, [0.0, verge.length()], rowed, draws);
    }

    /// Trees along a stretch, and shrubs between them, where they may be.
    fn trees(
        &mut self,
        trees: &Trees,
        verge: &Verge,
        across: f64,
        stretch: [f64; 2],
        may: impl Fn(&Ground, Pose2) -> bool,
        draws: &mut Stream,
    ) {
        self.spots(
            stretch,
            trees.gap,
            |site, along, draws| {
                let mut put = |along: f64, clear: f64, thing: Thing, draws: &mut Stream| {
                    let pose = turned(verge.pose(along, across), draws);
                    if may(site.ground, pose) {
                        site.stand(pose, clear, thing);
                    }
                };
                let [under, height] = [trees.under, trees.height].map(|middle| middle * draws.between(0.8, 1.2));
                put(along, 0.3, things::tree(under, height, draws), draws);
                if draws.chance(trees.shrubs) {
                    let along = along + trees.gap * draws.between(0.2, 0.8);
                    put(along, 0.2, things::bush(draws.between(0.4, 1.3), draws), draws);
                }
            },
            draws,
        );
    }

    /// What grows behind the first row, over all of the free ground.
    fn grow(&mut self, verge: &Verge, draws: &mut Stream) {
        const FIRST_ROW: f64 = 2.0;
        let deep = verge.depth() - FIRST_ROW;
        if deep <= 0.0 {
            return;
        }
        let area = deep * verge.length() / 100.0;
        for (what, density) in growth(verge.kind) {
            let count = (area * density * draws.between(0.5, 1.5)) as usize;
            for _ in 0..count {
                let pose = verge.pose(draws.between(0.0, verge.length()), FIRST_ROW + deep * draws.unit());
                let pose = turned(pose, draws);
                // Small ones are many.
                let share = draws.unit() * draws.unit();
                let tended = what != Growth::Tree && self.ground.tended(pose);
                if tended && draws.chance(BARE_BEHIND) {
                    continue;
                }
                let thing: Thing = match what {
                    Growth::Weed if draws.chance(0.5) => things::stone(0.4 + 0.6 * share, draws),
                    Growth::Weed => things::bush(0.35 + 0.6 * share, draws),
                    Growth::Shrub => things::bush(draws.between(0.6, 2.4), draws),
                    Growth::LowWall => {
                        self.low_wall(pose, draws);
                        continue;
                    }
                    Growth::Tree => things::tree(draws.between(1.5, 3.0), draws.between(3.5, 12.0), draws),
                };
                self.stand(pose, 0.5, thing);
            }
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
