//! The places with roads at any angle, each drawn anew for every number.

use std::f64::consts::{FRAC_PI_2, PI};

use super::network::{Bays, Builder, Control, Merge, Network, Node, OPPOSITE, SIDES, Section, TrafficMix};
use super::surface::Surface;
use super::verge::VergeKind;
use crate::Scenario;
use crate::path::{Path, Pose2, angle_within};
use crate::random::Stream;

/// How far roads reach from the place's middle, m.
const REACH: f64 = 195.0;
/// Straight at a node, m.
const LEAD: f64 = 22.0;

const KMH: f64 = 1.0 / 3.6;

/// A plan and what else the place needs to know.
pub(crate) struct Scene {
    pub network: Network,
    /// Slope of the whole place along x and y.
    pub grade: [f64; 2],
    /// Metres between the nodes of its terrain.
    pub cell: f64,
}

/// Draws the plan of a place.
pub(crate) fn scene(scenario: Scenario, number: u64) -> Scene {
    let mut draws = Stream::new(number, "network", scenario as u64);
    let draft = match scenario {
        Scenario::Tee => tee(&mut draws),
        Scenario::Roundabout => roundabout(&mut draws),
        Scenario::Curve => curve(&mut draws),
        Scenario::Residential => residential(&mut draws),
        Scenario::Motorway => motorway(&mut draws),
        Scenario::CarPark => car_park(&mut draws),
        Scenario::Avenue => avenue(&mut draws),
        Scenario::Rural => rural(&mut draws),
        Scenario::Market => market(&mut draws),
        _ => junction(&mut draws),
    };
    let Draft {
        mut builder,
        mix,
        kerbs,
        roadside,
        grade,
        cell,
        merges,
        mut islands,
    } = draft;
    if kerbs {
        park_along(&mut builder, &mut Stream::new(number, "kerbside", 0));
    }
    builder.settle();
    let roadside = roadside.map(|place| place.pose(&builder));
    for node in &builder.nodes {
        if let Control::Roundabout { radius, width } = node.control {
            let half = 0.5 * (radius - 0.5 * width);
            let mut line = Path::from(node.at[0] + half, node.at[1], FRAC_PI_2);
            line.arc(half, 2.0 * PI);
            islands.push((line, 0.8 * half));
        }
    }
    let Builder { roads, nodes } = builder;
    let surface = Surface::new(&roads, &nodes, kerbs);
    let (sin, cos) = libm::sincos(draws.between(0.0, std::f64::consts::TAU));
    // Level places are many.
    let slope = grade[0] + (grade[1] - grade[0]) * draws.unit() * draws.unit();
    Scene {
        network: Network {
            roads,
            nodes,
            merges,
            mix,
            kerbs,
            islands,
            roadside,
            surface,
        },
        grade: [slope * cos, slope * sin],
        cell,
    }
}

/// Gives streets bays along the kerbs where they have none.
fn park_along(builder: &mut Builder, draws: &mut Stream) {
    for road in &mut builder.roads {
        let section = &mut road.section;
        for side in 0..SIDES.len() {
            let is_street = section.pavement[side] > 0.0 && section.lanes[1] > 0;
            if is_street && section.bays[side].is_none() && draws.chance(0.6) {
                section.bays[side] = Some(Bays::PARALLEL);
            }
        }
    }
}

/// Where a roadside unit stands.
enum Stand {
    /// Behind the kerb between an arm of a node and the next one.
    Corner { node: usize, arm: usize },
    /// Beside a road: distance along it, and from its line.
    Beside { road: usize, along: f64, across: f64 },
}

impl Stand {
    fn pose(&self, builder: &Builder) -> Pose2 {
        match *self {
            Stand::Corner { node, arm } => {
                let node = &builder.nodes[node];
                let arm = arm % node.arms.len();
                let pose = corner(builder, node, arm, 1.3);
                let ahead = across(node, pose);
                Pose2 {
                    heading: libm::atan2(ahead[1] - pose.y, ahead[0] - pose.x),
                    ..pose
                }
            }
            Stand::Beside { road, along, across } => {
                const INWARDS: f64 = 0.4;
                let pose = builder.roads[road].line.at(along).0.aside(across);
                Pose2 {
                    heading: pose.heading - INWARDS.copysign(across),
                    ..pose
                }
            }
        }
    }
}

/// Where a unit at a corner of a node looks: over the node and out along the arm most nearly ahead.
fn across(node: &Node, from: Pose2) -> [f64; 2] {
    const OUT: f64 = 35.0;
    let over = libm::atan2(node.at[1] - from.y, node.at[0] - from.x);
    let off = |arm: &&super::network::Arm| angle_within(arm.heading - over).abs();
    let nearest = node.arms.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
    nearest.map_or(node.at, |arm| {
        let end = arm.out.at(OUT).0;
        [end.x, end.y]
    })
}

/// The point `behind` the kerbs between an arm and the next one counter-clockwise, heading along the arm.
fn corner(builder: &Builder, node: &Node, arm: usize, behind: f64) -> Pose2 {
    let half = |k: usize| builder.roads[node.arms[k].road].section.half() + behind;
    let next = (arm + 1) % node.arms.len();
    let (own, other) = (node.arms[arm].heading, node.arms[next].heading);
    let between = (other - own).rem_euclid(2.0 * PI);
    if let Some(ring) = node.ring_edge() {
        let (sin, cos) = libm::sincos(own + 0.5 * between);
        let out = ring + behind + 1.0;
        return Pose2 {
            x: node.at[0] + out * cos,
            y: node.at[1] + out * sin,
            heading: own,
        };
    }
    if between > OPPOSITE {
        return node.place(arm, 2.0, half(arm));
    }
    let (sin, cos) = libm::sincos(between);
    // A little farther out than the corner itself, because kerbs are rounded there.
    let along = (half(next) + half(arm) * cos) / sin;
    let slide = 0.3 * node.corner;
    let pose = node.place(arm, along, half(arm));
    let (s, c) = libm::sincos(own + 0.5 * between);
    Pose2 {
        x: pose.x + slide * c,
        y: pose.y + slide * s,
        ..pose
    }
}

struct Draft {
    builder: Builder,
    mix: TrafficMix,
    kerbs: bool,
    roadside: [Stand; 2],
    /// Min and max slope of the place.
    grade: [f64; 2],
    cell: f64,
    merges: Vec<Merge>,
    islands: Vec<(Path, f64)>,
}

impl Draft {
    fn new(builder: Builder, mix: TrafficMix) -> Self {
        let second = builder.nodes.len().saturating_sub(1).min(1);
        let roadside = [
            Stand::Corner { node: 0, arm: 0 },
            Stand::Corner { node: second, arm: 2 },
        ];
        Draft {
            builder,
            mix,
            kerbs: true,
            roadside,
            grade: [0.002, 0.022],
            cell: 2.0,
            merges: Vec::new(),
            islands: Vec::new(),
        }
    }
}

fn usual_mix() -> TrafficMix {
    TrafficMix {
        gap: [62.0, 28.0],
        walkers: [16, 46],
        groups: 0.15,
        standing: [2, 4],
        prams: 0.06,
        between: 0.08,
        parked: [0.35, 0.65],
        vans: [0.14, 0.10],
        long: 0.1,
        trailers: 0.3,
        tricycles: [0.02, 0.02],
        riders: 0.08,
        near: 65.0,
    }
}

/// Adds a curve that tightens and widens in steps.
fn bend(path: &mut Path, radius: f64, angle: f64) {
    for (share, times) in [(0.1, 3.0), (0.15, 1.6), (0.5, 1.0), (0.15, 1.6), (0.1, 3.0)] {
        path.arc(radius * times, angle * share);
    }
}

fn sign(draws: &mut Stream) -> f64 {
    if draws.chance(0.5) { 1.0 } else { -1.0 }
}

/// A line from a point outwards, straight at first, then bent one way and most of that back, up to a length.
fn outwards(at: [f64; 2], heading: f64, radius: f64, angle: f64, length: f64) -> Path {
    let mut path = Path::from(at[0], at[1], heading);
    path.line(LEAD);
    bend(&mut path, radius, angle);
    path.line(14.0);
    bend(&mut path, 1.3 * radius, -0.8 * angle);
    let left = length - path.length();
    path.line(left);
    path
}

/// A line from one node to another.
fn link(from: Pose2, to: Pose2, lead: f64) -> Path {
    let mut path = Path::from_pose(from);
    path.line(lead);
    path.append(&Path::between(from.at(lead, 0.0), to.at(-lead, 0.0)));
    path.line(lead);
    path
}

fn degrees(draws: &mut Stream, low: f64, high: f64) -> f64 {
    draws.between(low, high).to_radians()
}

fn beside(draws: &mut Stream) -> [(VergeKind, f64); 2] {
    [(); 2].map(|()| match draws.unit() {
        u if u < 0.45 => (VergeKind::Park, draws.between(18.0, 36.0)),
        u if u < 0.8 => (VergeKind::Garden, draws.between(9.0, 18.0)),
        _ => (VergeKind::Street, draws.between(2.5, 6.0)),
    })
}

/// Two roads that cross at a slant, without walls around them.
fn junction(draws: &mut Stream) -> Draft {
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
    Draft::new(builder, usual_mix())
}

/// A road that ends at another.
fn tee(draws: &mut Stream) -> Draft {
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
    Draft::new(builder, usual_mix())
}

/// Three or four roads that meet in a ring.
fn roundabout(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
    draft.mix.near = 70.0;
    draft
}

/// A road that winds, with two entries from its outer side.
fn curve(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
    draft.mix.near = 70.0;
    draft
}

/// Narrow streets between gardens, with parked cars on both sides.
fn residential(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
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

/// Three lanes each way and an entry.
fn motorway(draws: &mut Stream) -> Draft {
    const LENGTH: f64 = 980.0;
    let mut builder = Builder::new();
    let turn = sign(draws);
    let curve = |start: Pose2, first: f64, second: f64, radius: f64| {
        let mut path = Path::from_pose(start);
        // The middle of the place lies in the first bend.
        path.line(320.0);
        bend(&mut path, radius, first);
        path.line(40.0);
        bend(&mut path, radius, second);
        let left = LENGTH - path.length();
        path.line(left.max(60.0));
        path
    };
    let radius = draws.between(280.0, 400.0);
    let (first, second) = (
        turn * degrees(draws, 40.0, 60.0),
        sign(draws) * degrees(draws, 14.0, 30.0),
    );
    let origin = Pose2 {
        x: 0.0,
        y: 0.0,
        heading: 0.0,
    };
    let trial = curve(origin, first, second, radius);
    let middle = trial.at(0.5 * trial.length()).0;
    let start = Pose2 {
        x: -middle.x,
        y: -middle.y,
        heading: 0.0,
    };
    let line = curve(start, first, second, radius);
    let section = Section {
        lanes: [3, 3],
        width: 3.65,
        median: 4.0,
        cycle: 0.0,
        shoulder: 2.8,
        bays: [None; 2],
        pavement: [0.0; 2],
        limit: 100.0 * KMH,
        beside: [(VergeKind::Embankment, 25.0); 2],
    };
    let ramp_width = 3.6;
    let offset = -(section.half() - section.shoulder + 0.5 * ramp_width);
    let centre = 0.5 * line.length();
    let [from, to] = [
        centre - draws.between(70.0, 110.0),
        centre + draws.between(110.0, 150.0),
    ];
    let beside = line.parallel(offset);
    let along = |s: f64| {
        let pose = line.at(s).0.aside(offset);
        beside.project(pose.x, pose.y, s).0
    };
    let begin = line.at(from).0.aside(offset);
    let mut back = Path::from(begin.x, begin.y, begin.heading + PI);
    back.line(5.0);
    bend(&mut back, draws.between(110.0, 170.0), degrees(draws, 14.0, 26.0));
    back.line(draws.between(60.0, 110.0));
    bend(&mut back, 90.0, degrees(draws, 20.0, 50.0));
    back.line(60.0);
    let mut ramp = back.reversed();
    ramp.append(&beside.part(along(from), along(to)));
    let stretch = [ramp.length() - (along(to) - along(from)), ramp.length()];
    let height = section.half() + 3.0;
    builder.road(line, section, [None; 2], true, 0);
    let entry = Section {
        lanes: [1, 0],
        width: ramp_width,
        median: 0.0,
        cycle: 0.0,
        shoulder: 0.8,
        bays: [None; 2],
        pavement: [0.0; 2],
        limit: 80.0 * KMH,
        beside: [(VergeKind::Embankment, 20.0); 2],
    };
    builder.road(ramp, entry, [None; 2], false, 0);
    let merge = Merge {
        road: 1,
        onto: 0,
        stretch,
    };
    Draft {
        builder,
        mix: TrafficMix {
            gap: [85.0, 42.0],
            walkers: [0, 0],
            vans: [0.14, 0.14],
            long: 0.4,
            trailers: 0.75,
            riders: 0.03,
            near: 110.0,
            ..usual_mix()
        },
        kerbs: false,
        roadside: [
            Stand::Beside {
                road: 0,
                along: centre + 10.0,
                across: -height - 2.0,
            },
            Stand::Beside {
                road: 0,
                along: centre + 70.0,
                across: height,
            },
        ],
        grade: [0.003, 0.02],
        cell: 4.0,
        merges: vec![merge],
        islands: Vec::new(),
    }
}

/// A car park beside a street: aisles with bays between two ways that join them.
fn car_park(draws: &mut Stream) -> Draft {
    const CORNER: f64 = 2.5;
    let mut builder = Builder::new();
    let count = 3 + draws.below(2);
    let rows: Vec<Bays> = (0..count)
        .map(|_| match draws.unit() {
            u if u < 0.2 => Bays::SQUARE,
            u if u < 0.6 => Bays::slanted(60.0),
            _ => Bays::slanted(45.0),
        })
        .collect();
    let turn = degrees(draws, -24.0, 24.0);
    let (sin, cos) = libm::sincos(turn);
    let place = |x: f64, y: f64| [x * cos - y * sin, x * sin + y * cos];
    let way = |limit: f64| {
        let mut section = Section::street(2.9, limit);
        section.pavement = [0.0; 2];
        section.beside = [(VergeKind::CarPark, 14.0); 2];
        section
    };
    let half = way(5.0).half();
    let strip = draws.between(2.0, 3.0);
    // Where the aisles lie.
    let mut at = vec![0.0];
    for pair in rows.windows(2) {
        at.push(at[at.len() - 1] + 2.0 * half + pair[0].depth + pair[1].depth + strip);
    }
    let shift = 0.5 * at[at.len() - 1];
    let (low, high) = (-26.0, draws.between(28.0, 36.0));
    let nodes: Vec<[usize; 2]> = at
        .iter()
        .map(|x| [low, high].map(|y| builder.node(place(x - shift, y), Control::Uncontrolled, CORNER, false)))
        .collect();
    let straight = |builder: &Builder, from: usize, to: usize| {
        let (a, b) = (builder.nodes[from].at, builder.nodes[to].at);
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let mut path = Path::from(a[0], a[1], libm::atan2(dy, dx));
        path.line((dx * dx + dy * dy).sqrt());
        path
    };
    for (k, [below, above]) in nodes.iter().enumerate() {
        let mut aisle = way(15.0 * KMH);
        aisle.bays = [Some(rows[k]); 2];
        let line = straight(&builder, *below, *above);
        builder.road(line, aisle, [Some(*below), Some(*above)], false, 0);
        if k > 0 {
            for (from, to) in nodes[k - 1].into_iter().zip(nodes[k]) {
                let line = straight(&builder, from, to);
                builder.road(line, way(20.0 * KMH), [Some(from), Some(to)], true, 0);
            }
        }
    }
    // Raised strips lie between the rows of neighbouring aisles.
    let islands = (1..count).map(|k| {
        let x = at[k - 1] + half + rows[k - 1].depth + 0.5 * strip - shift;
        let [from, to] = [place(x, low + half + 3.0), place(x, high - half - 3.0)];
        let mut line = Path::from(from[0], from[1], turn + FRAC_PI_2);
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        line.line((dx * dx + dy * dy).sqrt());
        (line, 0.5 * strip - 0.4)
    });
    let islands: Vec<_> = islands.collect();
    // The street runs below; its way in comes up to one of the inner nodes.
    let entry = nodes[1][0];
    let from = builder.nodes[entry].at;
    let down = turn - FRAC_PI_2;
    let street_heading = degrees(draws, -14.0, 14.0);
    let (s, c) = libm::sincos(down);
    let depth = draws.between(46.0, 56.0);
    let meet = [from[0] + depth * c, from[1] + depth * s];
    let street_node = builder.node(meet, Control::Priority, CORNER, true);
    let up = Pose2 {
        x: meet[0],
        y: meet[1],
        heading: street_heading + FRAC_PI_2 + degrees(draws, -12.0, 12.0),
    };
    let into = Pose2 {
        x: from[0],
        y: from[1],
        heading: turn + FRAC_PI_2,
    };
    let mut access = way(20.0 * KMH);
    access.pavement = [2.0; 2];
    builder.road(link(up, into, 15.0), access, [Some(street_node), Some(entry)], false, 1);
    for heading in [street_heading, street_heading + PI] {
        let mut section = Section::street(3.2, 45.0 * KMH);
        section.beside = beside(draws);
        let angle = sign(draws) * degrees(draws, 10.0, 22.0);
        let line = outwards(meet, heading, draws.between(90.0, 160.0), angle, REACH - 45.0);
        builder.road(line, section, [Some(street_node), None], true, 0);
    }
    let mut draft = Draft::new(builder, usual_mix());
    draft.roadside = [
        Stand::Corner { node: entry, arm: 0 },
        Stand::Corner {
            node: nodes[count - 1][1],
            arm: 0,
        },
    ];
    draft.mix.gap = [42.0, 25.0];
    draft.mix.parked = [0.5, 0.85];
    draft.mix.between = 0.12;
    draft.mix.long = 0.03;
    draft.mix.near = 75.0;
    draft.grade = [0.003, 0.014];
    draft.islands = islands;
    draft
}

/// A boulevard with a planted median, between houses.
fn avenue(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
    draft.mix.gap = [70.0, 34.0];
    draft.mix.walkers = [20, 52];
    draft.grade = [0.002, 0.015];
    draft.mix.near = 75.0;
    draft
}

/// A winding road over open land, without kerbs.
fn rural(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
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

/// A shopping street: walkers on wide pavements and over two crossings, vans at the kerb.
fn market(draws: &mut Stream) -> Draft {
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
    let mut draft = Draft::new(builder, usual_mix());
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
