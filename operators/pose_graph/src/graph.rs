//! The graph, and the poses of the smallest cost.

use nalgebra::{Isometry3, Matrix6, Translation3, Vector6};

use crate::factor::{Anchor, Edge, Level, Linear, Prior, is_pose};
use crate::kernel::{cost, weight};
use crate::rotation::turned;
use crate::sparse::{BlockCholesky, BlockMatrix};

/// Kernels narrow by this factor, as squares, from one stage to the next.
const NARROWING: f64 = 1.6;
/// They begin so wide at most, as a multiple of their own width, squared.
const WIDEST: f64 = 1e6;
/// Steps of a stage but the last.
const STAGE_STEPS: u32 = 4;
/// Damping at the beginning, its factors after a good and a bad step, and where it ends.
const DAMPING: f64 = 1e-6;
const RELAX: f64 = 0.2;
const STIFFEN: f64 = 10.0;
const STIFFEST: f64 = 1e8;

/// When a solution is good enough.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolverSettings {
    /// Steps at most, of all stages together.
    pub max_steps: u32,
    /// A step that moves no pose farther than this, m or rad, is the last of its stage.
    pub stop: f64,
}

impl Default for SolverSettings {
    fn default() -> Self {
        SolverSettings {
            max_steps: 300,
            stop: 1e-5,
        }
    }
}

/// Why there is no solution.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GraphError {
    /// A factor of a pose that is not in the graph.
    #[error("a factor is of pose {found}, the graph has {nodes}")]
    Node {
        /// Its number.
        found: usize,
        /// How many there are.
        nodes: usize,
    },
    /// A pose or factor with numbers that are none.
    #[error("{what} {at}: expected finite numbers, information that is not negative, and a quaternion of length 1")]
    NotFinite {
        /// What it is.
        what: &'static str,
        /// Its number among its like.
        at: usize,
    },
    /// Nothing says where some pose is.
    #[error("nothing says where some poses are: expected a prior or an anchor for each part of the graph")]
    Undetermined,
}

/// Poses, and what is known of them.
#[derive(Clone, Debug, Default)]
pub struct PoseGraph {
    /// The poses of keyframes in `map`; by solving they become the best ones.
    pub nodes: Vec<Isometry3<f64>>,
    /// Odometry edges and loop edges.
    pub edges: Vec<Edge>,
    /// Positions of GNSS.
    pub anchors: Vec<Anchor>,
    /// Frames that are level.
    pub levels: Vec<Level>,
    /// Poses that are known.
    pub priors: Vec<Prior>,
}

/// How a graph was solved.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// Cost of the poses before and after, with kernels at their own width.
    pub cost: [f64; 2],
    /// Steps that were made.
    pub steps: u32,
    /// Whether the last step was short enough.
    pub converged: bool,
    /// Weight of each edge by its kernel at the end, 0 to 1.
    pub edge_weights: Vec<f64>,
    /// The same of each anchor.
    pub anchor_weights: Vec<f64>,
}

impl PoseGraph {
    /// Finds the poses of the smallest cost.
    ///
    /// # Errors
    /// [`GraphError`]: what is wrong with the graph.
    pub fn solve(&mut self, settings: &SolverSettings) -> Result<Solution, GraphError> {
        self.check()?;
        let before = self.cost(1.0);
        let mut widening = self.widening();
        let order = self.normal(1.0).0.order();
        let mut steps = 0;
        // All stages but the last only lead there.
        while widening > 1.0 {
            let most = settings.max_steps.saturating_sub(steps).min(STAGE_STEPS);
            steps += self.descend(widening, &order, most, settings.stop)?.0;
            widening /= NARROWING;
        }
        let (last, converged) = self.descend(1.0, &order, settings.max_steps.saturating_sub(steps), settings.stop)?;
        steps += last;
        let weigh = |linear: Linear| weight(linear.square(), linear.kernel);
        Ok(Solution {
            cost: [before, self.cost(1.0)],
            steps,
            converged,
            edge_weights: self.edges.iter().map(|edge| weigh(edge.linear(&self.nodes))).collect(),
            anchor_weights: self
                .anchors
                .iter()
                .map(|anchor| weigh(anchor.linear(&self.nodes)))
                .collect(),
        })
    }

    /// Covariances of some poses as they are: of shifts along the axes of `map`, m², and turns about them, rad².
    ///
    /// # Errors
    /// [`GraphError`]: what is wrong with the graph.
    pub fn covariances(&self, nodes: &[usize]) -> Result<Vec<Matrix6<f64>>, GraphError> {
        self.check()?;
        let (matrix, _) = self.normal(1.0);
        let factor = BlockCholesky::new(&matrix, &matrix.order()).ok_or(GraphError::Undetermined)?;
        let mut found = Vec::with_capacity(nodes.len());
        for node in nodes {
            if *node >= self.nodes.len() {
                return Err(self.no_node(*node));
            }
            let mut covariance = Matrix6::zeros();
            for axis in 0..6 {
                let mut right = vec![Vector6::zeros(); self.nodes.len()];
                right[*node][axis] = 1.0;
                let column = factor.solve(&right).ok_or(GraphError::Undetermined)?[*node];
                covariance.set_column(axis, &column);
            }
            found.push(0.5 * (covariance + covariance.transpose()));
        }
        Ok(found)
    }

    /// Steps with kernels that are wider by a factor, squared; how many, and whether the last one was short enough.
    fn descend(&mut self, widening: f64, order: &[usize], most: u32, stop: f64) -> Result<(u32, bool), GraphError> {
        let (mut damping, mut now, mut made) = (DAMPING, self.cost(widening), 0);
        while made < most {
            made += 1;
            let (matrix, gradient) = self.normal(widening);
            loop {
                let mut damped = matrix.clone();
                damped.damp(damping);
                let solved = BlockCholesky::new(&damped, order).and_then(|factor| factor.solve(&gradient));
                let step = solved.filter(|step| step.iter().all(|part| part.iter().all(|part| part.is_finite())));
                if let Some(step) = step {
                    let longest = step.iter().map(Vector6::amax).fold(0.0, f64::max);
                    let old = self.nodes.clone();
                    self.nodes
                        .iter_mut()
                        .zip(&step)
                        .for_each(|(node, step)| *node = stepped(node, step));
                    let cost = self.cost(widening);
                    if cost <= now {
                        (now, damping) = (cost, (damping * RELAX).max(1e-12));
                        if longest < stop {
                            return Ok((made, true));
                        }
                        break;
                    }
                    self.nodes = old;
                    if longest < stop {
                        // Rounding is all that is left.
                        return Ok((made, true));
                    }
                }
                damping *= STIFFEN;
                if damping > STIFFEST {
                    return match solved_at_all(&matrix, order) {
                        true => Ok((made, false)),
                        false => Err(GraphError::Undetermined),
                    };
                }
            }
        }
        Ok((made, false))
    }

    /// How much wider kernels begin, squared: so that all factors count.
    fn widening(&self) -> f64 {
        let ratio = |linear: Linear| linear.kernel.map_or(0.0, |width| linear.square() / (width * width));
        let largest = self.robust().map(ratio).fold(0.0, f64::max);
        (2.0 * largest).clamp(1.0, WIDEST)
    }

    /// Factors that may have a kernel.
    fn robust(&self) -> impl Iterator<Item = Linear> {
        let edges = self.edges.iter().map(|edge| edge.linear(&self.nodes));
        edges.chain(self.anchors.iter().map(|anchor| anchor.linear(&self.nodes)))
    }

    fn factors(&self) -> impl Iterator<Item = Linear> {
        let levels = self.levels.iter().map(|level| level.linear(&self.nodes));
        let priors = self.priors.iter().map(|prior| prior.linear(&self.nodes));
        self.robust().chain(levels).chain(priors)
    }

    fn cost(&self, widening: f64) -> f64 {
        let of = |linear: Linear| cost(linear.square(), linear.kernel.map(|width| width * widening.sqrt()));
        self.factors().map(of).sum()
    }

    /// The normal equations at the poses: the matrix, and what it is to be solved for.
    fn normal(&self, widening: f64) -> (BlockMatrix, Vec<Vector6<f64>>) {
        let mut matrix = BlockMatrix::zeros(self.nodes.len());
        let mut right = vec![Vector6::zeros(); self.nodes.len()];
        for linear in self.factors() {
            let width = linear.kernel.map(|width| width * widening.sqrt());
            let information = linear.information * weight(linear.square(), width);
            let (first, by_first) = linear.first;
            let weighed = by_first.transpose() * information;
            matrix.add(first, first, &(weighed * by_first));
            right[first] -= weighed * linear.residual;
            if let Some((second, by_second)) = linear.second {
                matrix.add(first, second, &(weighed * by_second));
                let weighed = by_second.transpose() * information;
                matrix.add(second, second, &(weighed * by_second));
                right[second] -= weighed * linear.residual;
            }
        }
        (matrix, right)
    }

    /// Refuses factors of no pose, and numbers that are none.
    fn check(&self) -> Result<(), GraphError> {
        let named = self.edges.iter().flat_map(|edge| [edge.from, edge.to]);
        let named = named.chain(self.anchors.iter().map(|anchor| anchor.node));
        let named = named.chain(self.levels.iter().map(|level| level.node));
        let mut named = named.chain(self.priors.iter().map(|prior| prior.node));
        if let Some(found) = named.find(|node| *node >= self.nodes.len()) {
            return Err(self.no_node(found));
        }
        if let Some(edge) = self.edges.iter().find(|edge| edge.from == edge.to) {
            return Err(self.no_node(edge.to));
        }
        let is_width = |width: Option<f64>| width.is_none_or(|width| width > 0.0 && width.is_finite());
        let is_weight = |value: &f64| *value >= 0.0 && value.is_finite();
        let edge = |edge: &Edge| {
            is_pose(&edge.from_from_to) && edge.information.iter().all(|part| part.is_finite()) && is_width(edge.kernel)
        };
        let anchor = |anchor: &Anchor| {
            let numbers = anchor.antenna.iter().chain(anchor.position.iter());
            numbers.into_iter().all(|part| part.is_finite())
                && anchor.information.iter().all(is_weight)
                && is_width(anchor.kernel)
        };
        let level = |level: &Level| level.sigma > 0.0 && level.sigma.is_finite();
        let prior = |prior: &Prior| is_pose(&prior.map_from_body) && prior.information.iter().all(is_weight);
        let wrong = [
            ("pose", self.nodes.iter().position(|node| !is_pose(node))),
            ("edge", self.edges.iter().position(|found| !edge(found))),
            ("anchor", self.anchors.iter().position(|found| !anchor(found))),
            ("level", self.levels.iter().position(|found| !level(found))),
            ("prior", self.priors.iter().position(|found| !prior(found))),
        ];
        match wrong.into_iter().find_map(|(what, at)| Some((what, at?))) {
            Some((what, at)) => Err(GraphError::NotFinite { what, at }),
            None => Ok(()),
        }
    }

    fn no_node(&self, found: usize) -> GraphError {
        GraphError::Node {
            found,
            nodes: self.nodes.len(),
        }
    }
}

/// Whether a matrix can be solved without damping.
fn solved_at_all(matrix: &BlockMatrix, order: &[usize]) -> bool {
    BlockCholesky::new(matrix, order).is_some()
}

/// A pose after a small change.
fn stepped(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let shift = step.fixed_rows::<3>(0).into_owned();
    let turn = step.fixed_rows::<3>(3).into_owned();
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        turned(&pose.rotation, &turn),
    )
}
