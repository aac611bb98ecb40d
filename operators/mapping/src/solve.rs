//! From drives to poses in one frame: alignment, loops, pose graph.

use std::borrow::Borrow;

use nalgebra::{Isometry3, Vector6};
use realo_pose_graph::{Edge, GraphError, Level, PoseGraph, Prior, Solution, SolverSettings};
use realo_registration::{Search, SettingError};
use realo_schemas::geometry::PoseTrack;

use crate::align::{Pair, Planar, align};
use crate::anchors::{Anchored, anchored};
use crate::drive::{Drive, Piece};
use crate::join::Joined;
use crate::keyframe::Keyframe;
use crate::lean::{Lean, lean};
use crate::loops::{Found, LoopSearch, Nodes};
use crate::track::{add_corrected, empty, odometry};

/// Roll and pitch of level frames, rad.
const LEVEL: f64 = 3e-3;
/// What nobody says of a pose, as information: it keeps the equations solvable, and says nothing.
const NOTHING: f64 = 1e-8;
/// The place where a map without GNSS begins, as information.
const BEGINNING: f64 = 1e8;
/// A factor with less weight contradicts the others.
const AGREES: f64 = 0.25;
/// Poses of a drive whose covariance is computed.
const PROBES: usize = 12;
/// Loops are first looked for so far around, with wide searches, and then near, by tracking.
const FIRST: LoopSearch = LoopSearch {
    radius_m: 8.0,
    apart_m: 20.0,
    search: Search::Wide,
    is_level_tried: true,
    voxel_m: 1.0,
};
const SECOND: LoopSearch = LoopSearch {
    radius_m: 5.0,
    apart_m: 4.0,
    search: Search::Track,
    is_level_tried: false,
    voxel_m: 1.0,
};

/// Why drives have no poses.
#[derive(Debug, thiserror::Error)]
pub enum MappingError {
    /// No odometry.
    #[error(
        "no sweep could be followed by odometry: expected IMU samples and sweeps of 100 points or more of a vehicle; `realo info` says what \
         the logs have"
    )]
    NoKeyframes,
    /// A setting out of its range.
    #[error(transparent)]
    Setting(#[from] SettingError),
    /// A graph that cannot be solved.
    #[error("the pose graph: {0}")]
    Graph(#[from] GraphError),
}

/// The poses of all drives.
#[derive(Debug)]
pub struct Mapped {
    /// By drive, as they were given.
    pub drives: Vec<MappedDrive>,
    /// What became of all.
    pub summary: Summary,
}

/// The poses of a drive.
#[derive(Debug)]
pub struct MappedDrive {
    /// In `map`.
    pub track: PoseTrack,
    /// The same before loops were closed: by odometry and GNSS.
    pub before: PoseTrack,
    /// Standard deviations in the mean: on the ground along each axis, up, m, and of the heading, rad.
    pub sigmas: [f64; 3],
    /// Keyframes that have a pose.
    pub keyframes: usize,
    /// Keyframes with positions of GNSS, and those of them that contradict the others and weigh little.
    pub anchors: [usize; 2],
    /// Pieces, and those of them that have no place.
    pub pieces: [usize; 2],
    /// Loops that were closed within it or with others.
    pub loops: usize,
    /// Drives of one number are joined by loops.
    pub group: usize,
    /// Whether its way is long enough for GNSS to tell its heading.
    pub has_heading: bool,
    /// How its sensor leans beyond [`OdometrySettings::slope`](crate::OdometrySettings::slope), where loops tell.
    pub lean: Option<Lean>,
}

/// What became of all drives together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary {
    /// Keyframes in the graph.
    pub keyframes: usize,
    /// Whether GNSS says where they are; else the map begins where the first drive does.
    pub is_anchored: bool,
    /// Pairs of keyframes of two passes that were near each other.
    pub candidates: usize,
    /// Loops that were closed.
    pub loops: usize,
    /// Loop edges that fit their sweeps and contradict the rest of the graph.
    pub refused: usize,
    /// Root mean square of what closed loops are off, before and after: m, rad.
    pub residuals: [[f64; 2]; 2],
    /// Whether the last step was short enough.
    pub converged: bool,
}

/// A piece that is in the graph.
struct Placed<'a> {
    drive: usize,
    piece: &'a Piece,
    anchored: Vec<Anchored>,
    has_heading: bool,
    /// Number of its first keyframe.
    first: usize,
}

/// Finds the poses of drives.
///
/// # Errors
/// [`MappingError`]: nothing to place, or a graph without a solution.
pub fn solve(drives: &[impl Borrow<Drive>], voxel_m: f64) -> Result<Mapped, MappingError> {
    let drives: Vec<&Drive> = drives.iter().map(Borrow::borrow).collect();
    let drives = &drives[..];
    let (placed, mut nodes, is_anchored) = placed(drives)?;
    let mut graph = graph_of(&placed, &nodes, is_anchored);
    graph.solve(&SolverSettings::default())?;
    nodes.poses.clone_from(&graph.nodes);
    let before = nodes.poses.clone();
    let odometry_edges = graph.edges.len();
    let (mut loops, mut candidates): (Vec<Edge>, usize) = (Vec::new(), 0);
    let mut solution = None;
    for how in [FIRST, SECOND] {
        let Found {
            candidates: found,
            edges,
        } = nodes.loops(&LoopSearch { voxel_m, ..how })?;
        candidates = candidates.max(found);
        // A pair that is found anew is known better now.
        loops.retain(|old| !edges.iter().any(|new| (new.from, new.to) == (old.from, old.to)));
        loops.extend(edges);
        graph.nodes.clone_from(&before);
        graph.edges.truncate(odometry_edges);
        graph.edges.extend(loops.iter().cloned());
        solution = Some(graph.solve(&SolverSettings::default())?);
        nodes.poses.clone_from(&graph.nodes);
    }
    let Some(solution) = solution else {
        return Err(MappingError::NoKeyframes);
    };
    let closed: Vec<&Edge> = loops
        .iter()
        .zip(&solution.edge_weights[odometry_edges..])
        .filter_map(|(edge, weight)| (*weight >= AGREES).then_some(edge))
        .collect();
    let summary = Summary {
        keyframes: nodes.poses.len(),
        is_anchored,
        candidates,
        loops: closed.len(),
        refused: loops.len() - closed.len(),
        residuals: [residual(&closed, &before), residual(&closed, &nodes.poses)],
        converged: solution.converged,
    };
    let all = Parts {
        placed: &placed,
        nodes: &nodes,
        before: &before,
        closed: &closed,
        solution: &solution,
    };
    let drives = (0..drives.len())
        .map(|drive| all.drive(drives, drive, &graph))
        .collect::<Result<_, _>>()?;
    Ok(Mapped { drives, summary })
}

/// The pieces that can be placed, by GNSS; where there is none at all, the longest alone.
fn placed<'a>(drives: &[&'a Drive]) -> Result<(Vec<Placed<'a>>, Nodes<'a>, bool), MappingError> {
    let mut pieces = Vec::new();
    for (drive, of) in drives.iter().enumerate() {
        for piece in of.pieces.iter().filter(|piece| !piece.keyframes.is_empty()) {
            let anchored = anchored(&piece.keyframes, &odometry(piece), &of.fixes);
            pieces.push((drive, piece, planar(piece, &anchored), anchored));
        }
    }
    let is_anchored = pieces.iter().any(|(_, _, planar, _)| planar.is_some());
    if !is_anchored {
        let longest = pieces.iter().max_by_key(|(_, piece, ..)| piece.keyframes.len());
        let longest = longest.map(|(drive, piece, ..)| (*drive, piece.keyframes[0].stamp));
        pieces.retain(|(drive, piece, ..)| longest == Some((*drive, piece.keyframes[0].stamp)));
    }
    let mut nodes = Nodes {
        keyframes: Vec::new(),
        pieces: Vec::new(),
        poses: Vec::new(),
    };
    let mut placed = Vec::new();
    for (drive, piece, planar, anchored) in pieces {
        if planar.is_none() && is_anchored {
            continue;
        }
        let map_from_odom = planar.map_or_else(Isometry3::identity, |planar| planar.to_from_from);
        let first = nodes.poses.len();
        for keyframe in &piece.keyframes {
            nodes.keyframes.push(keyframe);
            nodes.pieces.push(placed.len());
            nodes.poses.push(map_from_odom * keyframe.odom_from_body);
        }
        placed.push(Placed {
            drive,
            piece,
            anchored,
            has_heading: planar.is_some_and(|planar| planar.has_heading()),
            first,
        });
    }
    match placed.is_empty() {
        true => Err(MappingError::NoKeyframes),
        false => Ok((placed, nodes, is_anchored)),
    }
}

/// Where a piece is by GNSS; `None` without any.
fn planar(piece: &Piece, anchored: &[Anchored]) -> Option<Planar> {
    let pairs: Vec<Pair> = anchored
        .iter()
        .map(|anchor| {
            let keyframe: &Keyframe = &piece.keyframes[anchor.keyframe];
            let up = if anchor.has_height { 1.0 / anchor.said.z } else { 0.0 };
            Pair {
                from: (keyframe.odom_from_body * nalgebra::Point3::from(anchor.antenna)).coords,
                to: anchor.position,
                weights: [1.0 / anchor.said.x, up],
                width: 3.0 * anchor.said.x.max(anchor.said.y).sqrt(),
            }
        })
        .collect();
    align(&pairs)
}

/// The graph without loops.
fn graph_of(placed: &[Placed], nodes: &Nodes, is_anchored: bool) -> PoseGraph {
    let mut graph = PoseGraph {
        nodes: nodes.poses.clone(),
        ..PoseGraph::default()
    };
    for (number, part) in placed.iter().enumerate() {
        let keyframes = &part.piece.keyframes;
        for (at, pair) in keyframes.windows(2).enumerate() {
            graph.edges.push(Edge {
                from: part.first + at,
                to: part.first + at + 1,
                from_from_to: pair[0].odom_from_body.inv_mul(&pair[1].odom_from_body),
                information: pair[1].information,
                kernel: None,
            });
        }
        let levels = (part.first..part.first + keyframes.len()).map(|node| Level { node, sigma: LEVEL });
        graph.levels.extend(levels);
        let anchors = part
            .anchored
            .iter()
            .map(|anchor| anchor.factor(part.first + anchor.keyframe));
        graph.anchors.extend(anchors);
        let known = if number == 0 && !is_anchored {
            BEGINNING
        } else {
            NOTHING
        };
        graph.priors.push(Prior {
            node: part.first,
            map_from_body: nodes.poses[part.first],
            information: Vector6::repeat(known),
        });
    }
    graph
}

/// Root mean square of what loops are off, m and rad.
fn residual(loops: &[&Edge], poses: &[Isometry3<f64>]) -> [f64; 2] {
    let mut squares = [0.0; 2];
    for edge in loops {
        let found = poses[edge.from].inv_mul(&poses[edge.to]);
        let off = edge.from_from_to.inv_mul(&found);
        squares[0] += off.translation.vector.norm_squared();
        squares[1] += off.rotation.angle() * off.rotation.angle();
    }
    squares.map(|sum| (sum / loops.len().max(1) as f64).sqrt())
}

/// All that the poses of a drive are made of.
struct Parts<'a> {
    placed: &'a [Placed<'a>],
    nodes: &'a Nodes<'a>,
    before: &'a [Isometry3<f64>],
    closed: &'a [&'a Edge],
    solution: &'a Solution,
}

impl Parts<'_> {
    fn drive(&self, drives: &[&Drive], drive: usize, graph: &PoseGraph) -> Result<MappedDrive, GraphError> {
        let (mut track, mut before) = (empty(), empty());
        let mut numbers = Vec::new();
        let (mut parts, mut has_heading) = (0, false);
        for part in self.placed.iter().filter(|part| part.drive == drive) {
            let range = part.first..part.first + part.piece.keyframes.len();
            add_corrected(&mut track, part.piece, &self.nodes.poses[range.clone()]);
            add_corrected(&mut before, part.piece, &self.before[range.clone()]);
            numbers.extend(range);
            parts += 1;
            has_heading |= part.has_heading;
        }
        let is_of = |node: usize| self.placed[self.nodes.pieces[node]].drive == drive;
        let loops = self
            .closed
            .iter()
            .filter(|edge| is_of(edge.from) || is_of(edge.to))
            .count();
        let pieces = drives[drive].pieces.len();
        Ok(MappedDrive {
            track,
            before,
            sigmas: sigmas(graph, &numbers)?,
            keyframes: numbers.len(),
            anchors: self.anchors(graph, &is_of),
            pieces: [pieces, pieces - parts],
            loops,
            group: self.group(drives.len(), drive),
            has_heading,
            lean: self.lean(drive),
        })
    }

    fn lean(&self, drive: usize) -> Option<Lean> {
        let pieces = self.placed.iter().filter(|part| part.drive == drive).map(|part| {
            let number = |node: usize| {
                let number = node.checked_sub(part.first)?;
                (number < part.piece.keyframes.len()).then_some(number)
            };
            let within = self.closed.iter();
            let within = within.filter_map(|edge| Some((number(edge.from)?, number(edge.to)?, *edge)));
            (part.piece, within.collect())
        });
        lean(pieces)
    }

    /// Anchors of a drive, and those that contradict the others.
    fn anchors(&self, graph: &PoseGraph, is_of: &dyn Fn(usize) -> bool) -> [usize; 2] {
        let mut count = [0; 2];
        for (anchor, weight) in graph.anchors.iter().zip(&self.solution.anchor_weights) {
            if is_of(anchor.node) {
                count[0] += 1;
                count[1] += usize::from(*weight < AGREES);
            }
        }
        count
    }

    /// The smallest number of a drive that loops join with this one.
    fn group(&self, drives: usize, drive: usize) -> usize {
        let mut joined = Joined::new(drives);
        for edge in self.closed {
            let [a, b] = [edge.from, edge.to].map(|node| self.placed[self.nodes.pieces[node]].drive);
            joined.join(a, b);
        }
        joined.first(drive)
    }
}

/// How well some poses are known in the mean, as [`MappedDrive::sigmas`].
fn sigmas(graph: &PoseGraph, nodes: &[usize]) -> Result<[f64; 3], GraphError> {
    let every = nodes.len().div_ceil(PROBES).max(1);
    let probes: Vec<usize> = nodes.iter().copied().step_by(every).collect();
    let mut sums = [0.0; 3];
    for covariance in graph.covariances(&probes)? {
        sums[0] += 0.5 * (covariance[(0, 0)] + covariance[(1, 1)]);
        sums[1] += covariance[(2, 2)];
        sums[2] += covariance[(5, 5)];
    }
    Ok(sums.map(|sum| (sum / probes.len().max(1) as f64).sqrt()))
}
