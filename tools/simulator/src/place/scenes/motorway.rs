//! A motorway with an entry.

use std::f64::consts::PI;

use super::lines::{bend, degrees, sign};
use super::stand::Stand;
use super::{Draft, KMH, USUAL_MIX};
use crate::path::{Path, Pose2};
use crate::place::network::{Builder, Merge, Section, TrafficMix};
use crate::place::verge::VergeKind;
use crate::random::Stream;

/// Three lanes each way with hard shoulders.
const CARRIAGEWAY: Section = Section {
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

/// One lane that comes in.
const RAMP: Section = Section {
    lanes: [1, 0],
    width: 3.6,
    median: 0.0,
    cycle: 0.0,
    shoulder: 0.8,
    bays: [None; 2],
    pavement: [0.0; 2],
    limit: 80.0 * KMH,
    beside: [(VergeKind::Embankment, 20.0); 2],
};

/// Many trucks, nobody on foot.
const MIX: TrafficMix = TrafficMix {
    gap: [85.0, 42.0],
    walkers: [0, 0],
    vans: [0.14, 0.14],
    long: 0.4,
    trailers: 0.75,
    riders: 0.03,
    near: 110.0,
    ..USUAL_MIX
};

/// Length of the carriageway, and of its straight begin, m.
const LENGTH: f64 = 980.0;
const STRAIGHT: f64 = 320.0;
/// Radius of both bends, m, and their angles, degrees.
const RADIUS: [f64; 2] = [280.0, 400.0];
const FIRST_BEND: [f64; 2] = [40.0, 60.0];
const SECOND_BEND: [f64; 2] = [14.0, 30.0];
/// How far before and behind the middle one can merge, m.
const MERGE_BEFORE: [f64; 2] = [70.0, 110.0];
const MERGE_BEHIND: [f64; 2] = [110.0, 150.0];
/// The ramp, backwards from where it has come to the carriageway: a wide bend, a straight, a narrow bend.
const WIDE_RADIUS: [f64; 2] = [110.0, 170.0];
const WIDE_BEND: [f64; 2] = [14.0, 26.0];
const RAMP_STRAIGHT: [f64; 2] = [60.0, 110.0];
const NARROW_RADIUS: f64 = 90.0;
const NARROW_BEND: [f64; 2] = [20.0, 50.0];
/// How far behind the carriageway's middle the roadside units stand, and from its edge; the first a little farther, m.
const UNITS_ALONG: [f64; 2] = [10.0, 70.0];
const UNITS_ASIDE: f64 = 3.0;
const FARTHER: f64 = 2.0;
/// Slopes of the place, and metres between the nodes of its terrain.
const GRADE: [f64; 2] = [0.003, 0.02];
const CELL: f64 = 4.0;

/// Three lanes each way and an entry.
pub(super) fn motorway(draws: &mut Stream) -> Draft {
    let mut builder = Builder::new();
    let line = carriageway(draws);
    let centre = 0.5 * line.length();
    let (ramp, stretch) = ramp(&line, draws);
    builder.road(line, CARRIAGEWAY, [None; 2], true, 0);
    builder.road(ramp, RAMP, [None; 2], false, 0);
    let merge = Merge {
        road: 1,
        onto: 0,
        stretch,
    };
    let aside = CARRIAGEWAY.half() + UNITS_ASIDE;
    let unit = |along: f64, across: f64| Stand::Beside {
        road: 0,
        along: centre + along,
        across,
    };
    Draft {
        kerbs: false,
        roadside: [unit(UNITS_ALONG[0], -aside - FARTHER), unit(UNITS_ALONG[1], aside)],
        grade: GRADE,
        cell: CELL,
        merges: vec![merge],
        ..Draft::new(builder, MIX)
    }
}

fn carriageway(draws: &mut Stream) -> Path {
    let turn = sign(draws);
    let radius = draws.between(RADIUS[0], RADIUS[1]);
    let first = turn * degrees(draws, FIRST_BEND[0], FIRST_BEND[1]);
    let second = sign(draws) * degrees(draws, SECOND_BEND[0], SECOND_BEND[1]);
    let curve = |[x, y]: [f64; 2]| {
        let mut path = Path::from(x, y, 0.0);
        // The middle of the place lies in the first bend.
        path.line(STRAIGHT);
        bend(&mut path, radius, first);
        path.line(40.0);
        bend(&mut path, radius, second);
        let left = LENGTH - path.length();
        path.line(left.max(60.0));
        path
    };
    let trial = curve([0.0; 2]);
    let Pose2 { x, y, .. } = trial.at(0.5 * trial.length()).0;
    curve([-x, -y])
}

/// The entry's line, and from where to where on it one merges.
fn ramp(line: &Path, draws: &mut Stream) -> (Path, [f64; 2]) {
    let offset = -(CARRIAGEWAY.half() - CARRIAGEWAY.shoulder + 0.5 * RAMP.width);
    let centre = 0.5 * line.length();
    let from = centre - draws.between(MERGE_BEFORE[0], MERGE_BEFORE[1]);
    let to = centre + draws.between(MERGE_BEHIND[0], MERGE_BEHIND[1]);
    let beside = line.parallel(offset);
    let along = |s: f64| {
        let pose = line.at(s).0.aside(offset);
        beside.project(pose.x, pose.y, s).0
    };
    let begin = line.at(from).0.aside(offset);
    let mut back = Path::from(begin.x, begin.y, begin.heading + PI);
    back.line(5.0);
    let radius = draws.between(WIDE_RADIUS[0], WIDE_RADIUS[1]);
    bend(&mut back, radius, degrees(draws, WIDE_BEND[0], WIDE_BEND[1]));
    back.line(draws.between(RAMP_STRAIGHT[0], RAMP_STRAIGHT[1]));
    let angle = degrees(draws, NARROW_BEND[0], NARROW_BEND[1]);
    bend(&mut back, NARROW_RADIUS, angle);
    back.line(60.0);
    let mut ramp = back.reversed();
    ramp.append(&beside.part(along(from), along(to)));
    let stretch = [ramp.length() - (along(to) - along(from)), ramp.length()];
    (ramp, stretch)
}
