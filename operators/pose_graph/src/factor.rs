//! What is known between poses and of them, and how far they are from it.

use nalgebra::{Isometry3, Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};

use crate::rotation::{between, left_inverse};

/// A pose as seen from another: an odometry edge or a loop edge.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Number of the pose that sees.
    pub from: usize,
    /// Number of the pose that is seen.
    pub to: usize,
    /// The second in the frame of the first.
    pub from_from_to: Isometry3<f64>,
    /// Information over shifts and turns of the second along and about the axes of the first, 1/m² and 1/rad².
    pub information: Matrix6<f64>,
    /// Width of the Geman-McClure kernel, standard deviations; `None`: trusted.
    pub kernel: Option<f64>,
}

/// A position of GNSS.
#[derive(Clone, Debug, PartialEq)]
pub struct Anchor {
    /// Number of the pose.
    pub node: usize,
    /// Where the antenna is in the frame of the pose, m.
    pub antenna: Vector3<f64>,
    /// Where it was measured to be, m.
    pub position: Vector3<f64>,
    /// Inverse variances along the axes of `map`, 1/m²; 0: not measured.
    pub information: Vector3<f64>,
    /// Width of the Geman-McClure kernel, standard deviations; `None`: trusted.
    pub kernel: Option<f64>,
}

/// A frame whose z points up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Number of the pose.
    pub node: usize,
    /// Standard deviation of roll and pitch, rad.
    pub sigma: f64,
}

/// A pose that is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Prior {
    /// Number of the pose.
    pub node: usize,
    /// What it is.
    pub map_from_body: Isometry3<f64>,
    /// Inverse variances over shifts and turns along and about the axes of `map`.
    pub information: Vector6<f64>,
}

/// A factor at some poses: how far they are from it, and how small changes of them change that.
pub(crate) struct Linear {
    pub residual: Vector6<f64>,
    pub information: Matrix6<f64>,
    /// Of one pose or two: its number and the Jacobian.
    pub first: (usize, Matrix6<f64>),
    pub second: Option<(usize, Matrix6<f64>)>,
    pub kernel: Option<f64>,
}

impl Linear {
    /// χ² without a kernel.
    pub fn square(&self) -> f64 {
        self.residual.dot(&(self.information * self.residual))
    }
}

fn rotation_of(pose: &Isometry3<f64>) -> Matrix3<f64> {
    pose.rotation.to_rotation_matrix().into_inner()
}

fn stacked(shift: &Vector3<f64>, turn: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
}

/// A 6×6 matrix of its four blocks.
fn blocks(parts: [[Matrix3<f64>; 2]; 2]) -> Matrix6<f64> {
    Matrix6::from_fn(|row, column| parts[row / 3][column / 3][(row % 3, column % 3)])
}

impl Edge {
    pub(crate) fn linear(&self, nodes: &[Isometry3<f64>]) -> Linear {
        let (from, to) = (&nodes[self.from], &nodes[self.to]);
        let inverse = rotation_of(from).transpose();
        let way = to.translation.vector - from.translation.vector;
        let found = from.rotation.inverse() * to.rotation;
        let turn = between(&self.from_from_to.rotation, &found);
        let shift = inverse * way - self.from_from_to.translation.vector;
        let turning = left_inverse(&turn) * inverse;
        let zero = Matrix3::zeros();
        Linear {
            residual: stacked(&shift, &turn),
            information: self.information,
            first: (
                self.from,
                blocks([[-inverse, inverse * way.cross_matrix()], [zero, -turning]]),
            ),
            second: Some((self.to, blocks([[inverse, zero], [zero, turning]]))),
            kernel: self.kernel,
        }
    }
}

impl Anchor {
    pub(crate) fn linear(&self, nodes: &[Isometry3<f64>]) -> Linear {
        let pose = &nodes[self.node];
        let arm = pose.rotation * self.antenna;
        let off = pose.translation.vector + arm - self.position;
        let [x, y, z] = self.information.into();
        let zero = Matrix3::zeros();
        Linear {
            residual: stacked(&off, &Vector3::zeros()),
            information: Matrix6::from_diagonal(&Vector6::new(x, y, z, 0.0, 0.0, 0.0)),
            first: (
                self.node,
                blocks([[Matrix3::identity(), -arm.cross_matrix()], [zero, zero]]),
            ),
            second: None,
            kernel: self.kernel,
        }
    }
}

impl Level {
    pub(crate) fn linear(&self, nodes: &[Isometry3<f64>]) -> Linear {
        let up = nodes[self.node].rotation * Vector3::z();
        let certain = 1.0 / (self.sigma * self.sigma);
        let zero = Matrix3::zeros();
        let mut leaning = -up.cross_matrix();
        leaning.row_mut(2).fill(0.0);
        Linear {
            // How far z leans along x and y.
            residual: Vector6::new(0.0, 0.0, 0.0, up.x, up.y, 0.0),
            information: Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, certain, certain, 0.0)),
            first: (self.node, blocks([[zero, zero], [zero, leaning]])),
            second: None,
            kernel: None,
        }
    }
}

impl Prior {
    pub(crate) fn linear(&self, nodes: &[Isometry3<f64>]) -> Linear {
        let pose = &nodes[self.node];
        let shift = pose.translation.vector - self.map_from_body.translation.vector;
        let turn = between(&self.map_from_body.rotation, &pose.rotation);
        let zero = Matrix3::zeros();
        Linear {
            residual: stacked(&shift, &turn),
            information: Matrix6::from_diagonal(&self.information),
            first: (
                self.node,
                blocks([[Matrix3::identity(), zero], [zero, left_inverse(&turn)]]),
            ),
            second: None,
            kernel: None,
        }
    }
}

/// Whether a pose is one.
pub(crate) fn is_pose(pose: &Isometry3<f64>) -> bool {
    let is_rotation = |rotation: &UnitQuaternion<f64>| (rotation.quaternion().norm() - 1.0).abs() < 1e-6;
    pose.translation.vector.iter().all(|part| part.is_finite()) && is_rotation(&pose.rotation)
}
