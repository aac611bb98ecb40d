//! Clouds in other frames.

use nalgebra::Isometry3;

use crate::PointCloud;

/// A transform of points, `rotation * p + translation`, by rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Affine(pub [[f32; 4]; 3]);

impl Affine {
    pub fn new(transform: &Isometry3<f64>) -> Self {
        let rotation = transform.rotation.to_rotation_matrix();
        let (r, t) = (rotation.matrix(), &transform.translation.vector);
        Affine(std::array::from_fn(|i| {
            [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]].map(|v| v as f32)
        }))
    }
}

/// A cloud in another frame: `to_from_from * point` for each of its points, f32. The other columns are shared.
pub fn transform_cloud(to_from_from: &Isometry3<f64>, cloud: &PointCloud) -> PointCloud {
    let rows = Affine::new(to_from_from).0;
    let axis = |[a, b, c, d]: [f32; 4]| -> Vec<f32> {
        let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
        points.map(|((x, y), z)| a * x + b * y + c * z + d).collect()
    };
    PointCloud {
        x: axis(rows[0]).into(),
        y: axis(rows[1]).into(),
        z: axis(rows[2]).into(),
        ..cloud.clone()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn points_move_as_the_transform_says() {
        let to_from_from = Isometry3::from_parts(
            Vector3::new(60.0, -30.0, 2.0).into(),
            UnitQuaternion::from_euler_angles(0.02, -0.01, 2.5),
        );
        let points = [[1.0, 2.0, 3.0], [-80.0, 35.5, 0.25]];
        let column = |axis: usize| points.iter().map(|p: &[f32; 3]| p[axis]).collect::<Vec<f32>>();
        let cloud = PointCloud::new(column(0), column(1), column(2), vec![7u8, 8], vec![1, 2], vec![3u16, 4]).unwrap();
        let moved = transform_cloud(&to_from_from, &cloud);
        assert_eq!(moved.intensity.to_vec(), [7, 8]);
        for (i, point) in points.iter().enumerate() {
            let expected = to_from_from * Point3::from(point.map(f64::from));
            let found = Point3::new(moved.x[i], moved.y[i], moved.z[i]).cast::<f64>();
            assert!((found - expected).norm() < 2e-5, "{found} for {expected}");
        }
    }
}
