//! Lanes into the junction and the ways through it.

use std::f64::consts::{FRAC_PI_2, PI};

use super::zones::Zone;
use crate::path::Path;
use crate::place::{CYCLE_LANE, LANE, REACH, Roads};

/// A lane that comes in from the end of an arm.
#[derive(Clone, Debug)]
pub(crate) struct RoadLane {
    pub arm: usize,
    /// To the right of the road's middle, m.
    pub offset: f64,
    pub cycles: bool,
    /// Indices into [`Network::ways`].
    pub ways: Vec<usize>,
    /// Distance along the ways at which the stop line lies.
    pub stop: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    Straight,
    Left,
    Right,
}

/// A way from the end of one arm to the end of another.
#[derive(Clone, Debug)]
pub(crate) struct Way {
    pub lane: usize,
    pub turn: Turn,
    /// The lane that it leaves by: ways with equal exits merge.
    pub exit: usize,
    /// The arm that it leaves by, and how far to the right of its middle.
    pub exit_arm: usize,
    pub exit_offset: f64,
    pub path: Path,
    /// Distance along the path behind which junction and crossings lie behind.
    pub clear: f64,
    /// What it takes up of the junction.
    pub zone: Zone,
}

/// All lanes and ways.
pub(crate) struct Network {
    pub lanes: Vec<RoadLane>,
    pub ways: Vec<Way>,
}

impl Network {
    pub fn new(roads: &Roads) -> Self {
        let mut network = Network {
            lanes: Vec::new(),
            ways: Vec::new(),
        };
        for arm in roads.arms() {
            let axis = arm % 2;
            for index in 0..roads.lanes[axis] {
                network.lane(roads, *arm, Some(index));
            }
            network.lane(roads, *arm, None);
        }
        network
    }

    /// Adds a driving lane, counted from the road's middle, or the cycle lane.
    fn lane(&mut self, roads: &Roads, arm: usize, index: Option<usize>) {
        let axis = arm % 2;
        let offset = index.map_or(roads.half[axis] - 0.5 * CYCLE_LANE, |i| (i as f64 + 0.5) * LANE);
        let lane = self.lanes.len();
        let stop = REACH - roads.stop(axis);
        self.lanes.push(RoadLane {
            arm,
            offset,
            cycles: index.is_none(),
            ways: Vec::new(),
            stop,
        });
        let mut turns = vec![Turn::Straight];
        if let Some(index) = index.filter(|_| roads.lanes[1] > 0) {
            if index == 0 {
                turns.push(Turn::Left);
            }
            if index + 1 == roads.lanes[axis] {
                turns.push(Turn::Right);
            }
        }
        for turn in turns {
            self.lanes[lane].ways.push(self.ways.len());
            self.ways.push(way(roads, lane, arm, index, offset, turn));
        }
    }
}

/// Exits are numbered by arm and, within it, by lane; the cycle lane is the ninth.
fn exit_number(arm: usize, index: Option<usize>) -> usize {
    arm * 10 + index.unwrap_or(9)
}

fn way(roads: &Roads, lane: usize, arm: usize, index: Option<usize>, offset: f64, turn: Turn) -> Way {
    let (axis, cross) = (arm % 2, 1 - arm % 2);
    let outer = roads.lanes[cross].saturating_sub(1);
    let (quarter, exit_index) = match turn {
        Turn::Straight => (2, index),
        Turn::Left => (3, Some(0)),
        Turn::Right => (1, Some(outer)),
    };
    let exit_arm = (arm + quarter) % 4;
    let exit_offset = match turn {
        Turn::Straight => offset,
        _ => (exit_index.unwrap_or(0) as f64 + 0.5) * LANE,
    };
    // In the frame of somebody who comes in: x ahead, the centre at the origin.
    let inward = arm as f64 * FRAC_PI_2 + PI;
    let (sin, cos) = libm::sincos(inward);
    let (x, y) = (-REACH, -offset);
    let mut path = Path::from(x * cos - y * sin, x * sin + y * cos, inward);
    match turn {
        Turn::Straight => path.line(2.0 * REACH),
        Turn::Right => {
            let radius = (roads.half[cross] + 5.5 - exit_offset).clamp(4.0, 8.0);
            path.line(REACH - exit_offset - radius)
                .arc(radius, -FRAC_PI_2)
                .line(REACH - offset - radius)
        }
        Turn::Left => {
            let room = (roads.half[cross] + 4.0 + exit_offset).min(roads.half[axis] + 4.0 + offset);
            let radius = room.clamp(8.0, 13.0);
            path.line(REACH + exit_offset - radius)
                .arc(radius, FRAC_PI_2)
                .line(REACH + offset - radius)
        }
    };
    let exit_axis = exit_arm % 2;
    let clear = path.length() - REACH + roads.clear(exit_axis);
    let reach = if index.is_none() { 0.5 } else { 1.45 };
    let from = REACH - roads.stop(axis);
    let zone = Zone::along(&path, from, clear, reach);
    Way {
        lane,
        turn,
        exit: exit_number(exit_arm, exit_index),
        exit_arm,
        exit_offset,
        path,
        clear,
        zone,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::place::Grid;

    #[test]
    fn ways_end_in_their_exit_lanes() {
        for place in 0..6 {
            let roads = Roads::new(Grid::Intersection, place);
            let network = Network::new(&roads);
            for way in &network.ways {
                let (end, curvature) = way.path.at(way.path.length());
                let outward = way.exit_arm as f64 * FRAC_PI_2;
                let (sin, cos) = libm::sincos(outward);
                let (along, across) = (end.x * cos + end.y * sin, -end.x * sin + end.y * cos);
                assert!(
                    (along - REACH).abs() < 1e-9 && (across + way.exit_offset).abs() < 1e-9,
                    "{along} {across}"
                );
                assert!(curvature == 0.0 && libm::cos(end.heading - outward) > 0.999_999);
            }
        }
    }

    #[test]
    fn only_ways_that_cross_or_merge_conflict() {
        let roads = Roads::new(Grid::Intersection, 1);
        let network = Network::new(&roads);
        let (lanes, ways) = (&network.lanes, &network.ways);
        let find = |arm: usize, turn| {
            ways.iter()
                .filter(move |way| lanes[way.lane].arm == arm && way.turn == turn)
        };
        for a in find(0, Turn::Straight) {
            for b in find(2, Turn::Straight) {
                assert!(!a.zone.meets(&b.zone), "opposite lanes share the junction");
            }
            for b in find(1, Turn::Straight) {
                assert!(a.zone.meets(&b.zone), "crossing lanes must not share the junction");
            }
            for b in find(0, Turn::Straight).filter(|b| b.lane != a.lane) {
                assert!(!a.zone.meets(&b.zone), "lanes side by side are apart");
            }
        }
        let left = find(0, Turn::Left).next().unwrap();
        assert!(
            find(2, Turn::Straight).any(|b| left.zone.meets(&b.zone)),
            "a left turn crosses oncoming traffic"
        );
    }
}
