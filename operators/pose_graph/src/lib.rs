//! Poses that agree best with what is known between and of them: a pose graph.
//!
//! A [`PoseGraph`] has poses of keyframes, and factors: [`Edge`]s between two of them (odometry edges, loop edges), [`Anchor`]s of GNSS,
//! [`Level`]s and [`Prior`]s. [`PoseGraph::solve`] finds the poses with the smallest cost by Levenberg's method on SE(3); edges and anchors
//! may have a Geman-McClure kernel, which begins wide and narrows (graduated non-convexity), so that true loops pull far and wrong ones let go.
//!
//! # Frames and numbers
//! A small change of a pose is a shift of the body's origin along the axes of `map`, m, and then a turn about them through it, rad. The
//! covariances of [`PoseGraph::covariances`] are over that. One thread computes, so the same graph gives the same bits.
//!
//! # Sources
//! Grisetti et al. 2010 (graph-based SLAM); Geman and McClure 1985; Yang et al. 2020 (graduated non-convexity); Markowitz 1957 and Rose 1970
//! (minimum degree).

mod factor;
mod graph;
mod kernel;
mod rotation;
mod sparse;
#[cfg(test)]
mod tests;

pub use factor::{Anchor, Edge, Level, Prior};
pub use graph::{GraphError, PoseGraph, Solution, SolverSettings};
