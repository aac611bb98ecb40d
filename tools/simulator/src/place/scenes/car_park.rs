//! A car park beside a street.

use std::f64::consts::{FRAC_PI_2, PI};

use super::lines::{degrees, link, outwards, sign};
use super::stand::Stand;
use super::{Draft, KMH, REACH, USUAL_MIX, beside};
use crate::path::{Path, Pose2};
use crate::place::network::{Bays, Builder, Control, Section, TrafficMix};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// Where two ways meet, radius of the kerb, m.
const CORNER: f64 = 2.5;
/// Share of aisles with square bays, and with those or bays at 60°; the others have bays at 45°.
const SQUARE: f64 = 0.2;
const SIXTY: f64 = 0.6;
/// Width of a lane, m, of ways on the car park, and their limits, m/s.
const WIDTH: f64 = 2.9;
const AISLE_LIMIT: f64 = 15.0 * KMH;
const WAY_LIMIT: f64 = 20.0 * KMH;
/// Width of the raised strips between rows, m.
const STRIP: [f64; 2] = [2.0, 3.0];
/// Where the aisles begin and end across the car park, m.
const LOW: f64 = -26.0;
const HIGH: [f64; 2] = [28.0, 36.0];
/// How the car park is turned, degrees, the street beside it, and the way in where it comes to the street.
const TURN: f64 = 24.0;
const STREET_TURN: f64 = 14.0;
const ENTRY_TURN: f64 = 12.0;
/// How far the street is from the car park, m.
const DEPTH: [f64; 2] = [46.0, 56.0];
/// Radius, m, and angle, degrees, of the street's bends.
const STREET_RADIUS: [f64; 2] = [90.0, 160.0];
const STREET_BEND: [f64; 2] = [10.0, 22.0];
/// Slow traffic between many parked cars.
const MIX: TrafficMix = TrafficMix {
    gap: [42.0, 25.0],
    parked: [0.5, 0.85],
    between: 0.12,
    long: 0.03,
    near: 75.0,
    ..USUAL_MIX
};
const GRADE: [f64; 2] = [0.003, 0.014];

/// A car park beside a street: aisles with bays between two ways that join them.
pub(super) fn car_park(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let plan = Plan::drawn(draws);
    let nodes = plan.pave(&mut builder);
    let entry = nodes[1][0];
    add_street(&mut builder, entry, plan.turn, draws);
    let last = nodes[nodes.len() - 1][1];
    Draft {
        roadside: [entry, last].map(|node| Stand::Corner { node, arm: 0 }),
        grade: GRADE,
        islands: plan.islands(),
        ..Draft::new(builder, MIX)
    }
}

/// A way on the car park.
fn way(limit: f64) -> Section {
    let mut section = Section::street(WIDTH, limit);
    section.pavement = [0.0; 2];
    section.beside = [(VergeKind::CarPark, 14.0); 2];
    section
}

/// What the car park is like.
struct Plan {
    /// Bays on both sides of each aisle, and where it is from the first one, m.
    aisles: Vec<(Bays, f64)>,
    /// Where the place's middle is from the first aisle, m.
    middle: f64,
    /// Width of the strips between rows, m.
    strip: f64,
    /// Where aisles end, m.
    high: f64,
    /// How all of it is turned, radians.
    turn: f64,
}

impl Plan {
    fn drawn(draws: &mut Stream) -> Plan {
        let count = 3 + draws.below(2);
        let rows: Vec<Bays> = (0..count).map(|_| row(draws.unit())).collect();
        let turn = degrees(draws, -TURN, TURN);
        let half = way(5.0).half();
        let strip = draws.between(STRIP[0], STRIP[1]);
        let mut at = vec![0.0];
        for pair in rows.windows(2) {
            at.push(at[at.len() - 1] + 2.0 * half + pair[0].depth + pair[1].depth + strip);
        }
        Plan {
            middle: 0.5 * at[at.len() - 1],
            aisles: rows.into_iter().zip(at).collect(),
            strip,
            high: draws.between(HIGH[0], HIGH[1]),
            turn,
        }
    }

    fn place(&self, x: f64, y: f64) -> [f64; 2] {
        let (sin, cos) = libm::sincos(self.turn);
        [x * cos - y * sin, x * sin + y * cos]
    }

    /// Adds aisles and the two ways that join them; returns the nodes at the ends of each aisle.
    fn pave(&self, builder: &mut Builder) -> Vec<[usize; 2]> {
        let ends = |(_, x): &(Bays, f64)| {
            [LOW, self.high].map(|y| builder.node(self.place(x - self.middle, y), Control::Uncontrolled, CORNER, false))
        };
        let nodes: Vec<[usize; 2]> = self.aisles.iter().map(ends).collect();
        for (k, [below, above]) in nodes.iter().enumerate() {
            let mut aisle = way(AISLE_LIMIT);
            aisle.bays = [Some(self.aisles[k].0); 2];
            let line = straight(builder, *below, *above);
            builder.road(line, aisle, [Some(*below), Some(*above)], false, 0);
            if k > 0 {
                for (from, to) in nodes[k - 1].into_iter().zip(nodes[k]) {
                    let line = straight(builder, from, to);
                    builder.road(line, way(WAY_LIMIT), [Some(from), Some(to)], true, 0);
                }
            }
        }
        nodes
    }

    /// Raised strips between the rows of neighbouring aisles.
    fn islands(&self) -> Vec<(Path, f64)> {
        let half = way(5.0).half();
        let island = |(row, x): &(Bays, f64)| {
            let x = x + half + row.depth + 0.5 * self.strip - self.middle;
            let [from, to] = [self.place(x, LOW + half + 3.0), self.place(x, self.high - half - 3.0)];
            let mut line = Path::from(from[0], from[1], self.turn + FRAC_PI_2);
            let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
            line.line((dx * dx + dy * dy).sqrt());
            (line, 0.5 * self.strip - 0.4)
        };
        self.aisles[..self.aisles.len() - 1].iter().map(island).collect()
    }
}

/// The bays of an aisle by a number within [0, 1).
fn row(number: f64) -> Bays {
    match number {
        u if u < SQUARE => Bays::SQUARE,
        u if u < SIXTY => Bays::slanted(60.0),
        _ => Bays::slanted(45.0),
    }
}

fn straight(builder: &Builder, from: usize, to: usize) -> Path {
    let (a, b) = (builder.nodes[from].at, builder.nodes[to].at);
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let mut path = Path::from(a[0], a[1], libm::atan2(dy, dx));
    path.line((dx * dx + dy * dy).sqrt());
    path
}

/// Adds the street, which runs below, and its way in, which comes up to an inner node.
fn add_street(builder: &mut Builder, entry: usize, turn: f64, draws: &mut Stream) {
    let from = builder.nodes[entry].at;
    let heading = degrees(draws, -STREET_TURN, STREET_TURN);
    let (s, c) = libm::sincos(turn - FRAC_PI_2);
    let depth = draws.between(DEPTH[0], DEPTH[1]);
    let meet = [from[0] + depth * c, from[1] + depth * s];
    let node = builder.node(meet, Control::Priority, CORNER, true);
    let up = Pose2 {
        x: meet[0],
        y: meet[1],
        heading: heading + FRAC_PI_2 + degrees(draws, -ENTRY_TURN, ENTRY_TURN),
    };
    let into = Pose2 {
        x: from[0],
        y: from[1],
        heading: turn + FRAC_PI_2,
    };
    let mut access = way(WAY_LIMIT);
    access.pavement = [2.0; 2];
    builder.road(link(up, into, 15.0), access, [Some(node), Some(entry)], false, 1);
    for heading in [heading, heading + PI] {
        let mut section = Section::street(3.2, 45.0 * KMH);
        section.beside = beside(draws);
        let angle = sign(draws) * degrees(draws, STREET_BEND[0], STREET_BEND[1]);
        let radius = draws.between(STREET_RADIUS[0], STREET_RADIUS[1]);
        let line = outwards(meet, heading, radius, angle, REACH - 45.0);
        builder.road(line, section, [Some(node), None], true, 0);
    }
}
