//! Ways from one end of the pavements to another.

use super::Crowd;
use crate::path::{Path, angle_within};
use crate::place::SIDES;
use crate::random::Stream;
use crate::traffic::walking::Over;

/// Nobody walks farther in the place than this, m.
const FARTHEST: f64 = 420.0;

/// So far before the open ends of roads walkers come in, m: behind are the places where vehicles turn round.
const OPEN_END: f64 = 14.0;

/// A way on foot.
pub(super) struct Route {
    pub path: Path,
    pub overs: Vec<Over>,
    /// Whether each crossing is gone over from its arm's left to its right.
    pub rightwards: Vec<bool>,
}

/// The points of a route in the making, and the crossings between some of them.
pub(super) struct Draft {
    pub points: Vec<[f64; 2]>,
    /// Smallest radius of its corners where there is room, m.
    pub radius: f64,
    pub overs: Vec<(usize, usize, bool)>,
}

/// A pavement along an arm: its side seen outwards, and how far from the arm's line one walks.
#[derive(Clone, Copy)]
pub(super) struct Track {
    pub node: usize,
    pub arm: usize,
    pub side: usize,
    pub across: f64,
    /// How far beside it somebody walks, m.
    pub aside: f64,
}

impl Crowd<'_> {
    pub(super) fn track(&self, [node, arm, side]: [usize; 3], aside: f64, draws: &mut Stream) -> Option<Track> {
        let network = self.ways.network;
        let own = &network.nodes[node].arms[arm];
        let section = &network.roads[own.road].section;
        let on_road = if own.at_start { side } else { 1 - side };
        let width = section.pavement[on_road];
        if width <= 0.0 {
            return None;
        }
        let from = section.half() + section.bay_depth(on_road);
        let band = match section.strip(on_road) {
            Some([_, to]) => [to + 0.35, width - 0.6],
            None if width < 2.5 => [0.6, width - 0.4],
            None => [0.9, width - 0.6],
        };
        let [low, high] = [band[0] + aside, band[1] - aside];
        (low < high).then(|| Track {
            node,
            arm,
            side,
            across: from + draws.between(low, high),
            aside,
        })
    }

    /// In along a pavement, then from node to node until the place ends, with room for somebody `aside` to both sides.
    pub(super) fn route(
        &self,
        (node, arm, side): (usize, usize, usize),
        aside: f64,
        draws: &mut Stream,
    ) -> Option<Route> {
        let network = self.ways.network;
        let mut draft = Draft {
            points: Vec::new(),
            radius: 0.7 + 2.0 * aside,
            overs: Vec::new(),
        };
        let mut track = self.track([node, arm, side], aside, draws)?;
        let mut inwards = true;
        let mut length = 0.0;
        loop {
            length += network.nodes[track.node].arms[track.arm].out.length();
            self.along(&mut draft, track, inwards);
            if inwards {
                track = self.turn(&mut draft, track, draws)?;
                inwards = false;
                continue;
            }
            let own = &network.nodes[track.node].arms[track.arm];
            let road = &network.roads[own.road];
            match road.ends[usize::from(own.at_start)] {
                Some((next, _)) if length < FARTHEST => {
                    // The walk has already led to the next node's arm: go on from there.
                    let arms = &network.nodes[next].arms;
                    let arm = arms
                        .iter()
                        .position(|a| a.road == own.road && a.at_start != own.at_start)?;
                    let there = Track {
                        node: next,
                        arm,
                        side: 1 - track.side,
                        ..track
                    };
                    track = self.turn(&mut draft, there, draws)?;
                }
                _ => return rounded(draft),
            }
        }
    }

    /// Points along an arm's pavement, between its far end and where the node begins.
    pub(super) fn along(&self, draft: &mut Draft, track: Track, inwards: bool) {
        const STEP: f64 = 5.0;
        let network = self.ways.network;
        let node = &network.nodes[track.node];
        let arm = &node.arms[track.arm];
        let road = &network.roads[arm.road];
        let far = road.ends[usize::from(arm.at_start)].map_or(OPEN_END, |(_, mouth)| mouth + 3.0);
        let [from, to] = [arm.mouth + 3.0, arm.out.length() - far];
        let count = ((to - from) / STEP).floor().max(1.0);
        let sign = SIDES[track.side];
        let mut points: Vec<[f64; 2]> = (0..=count as usize)
            .map(|k| {
                let pose = node.place(track.arm, from + (to - from) * k as f64 / count, sign * track.across);
                [pose.x, pose.y]
            })
            .collect();
        if inwards {
            points.reverse();
        }
        draft.points.extend(points);
    }
}

/// A path through points with rounded corners; `None` where the points lie so that it would turn back.
fn rounded(draft: Draft) -> Option<Route> {
    let Draft { points, radius, overs } = draft;
    let heading = |i: usize| libm::atan2(points[i + 1][1] - points[i][1], points[i + 1][0] - points[i][0]);
    let distance = |i: usize| {
        let (dx, dy) = (points[i + 1][0] - points[i][0], points[i + 1][1] - points[i][1]);
        (dx * dx + dy * dy).sqrt()
    };
    let last = points.len() - 1;
    if (0..last).any(|i| distance(i) < 0.05) {
        return None;
    }
    // How much each corner takes off the lines beside it.
    let mut cuts = vec![0.0; points.len()];
    for (i, cut) in cuts.iter_mut().enumerate().take(last).skip(1) {
        let turn = angle_within(heading(i) - heading(i - 1)).abs();
        if turn > 2.4 {
            return None;
        }
        let room = 0.45 * distance(i - 1).min(distance(i));
        *cut = (radius * libm::tan(0.5 * turn)).min(room);
    }
    let mut path = Path::from(points[0][0], points[0][1], heading(0));
    let mut at = vec![0.0];
    for i in 0..last {
        path.line(distance(i) - cuts[i] - cuts[i + 1]);
        if i + 1 < last && cuts[i + 1] > 1e-6 {
            let turn = angle_within(heading(i + 1) - heading(i));
            path.arc(cuts[i + 1] / libm::tan(0.5 * turn.abs()), turn);
        }
        at.push(path.length());
    }
    let rightwards = overs.iter().map(|(.., from_left)| *from_left).collect();
    let over = |(point, crossing, _): (usize, usize, bool)| Over {
        crossing,
        wait: at[point],
        far: at[point + 1],
    };
    let overs = overs.into_iter().map(over).collect();
    Some(Route {
        path,
        overs,
        rightwards,
    })
}
