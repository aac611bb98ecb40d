//! One change of a whole scene.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::augmentation::Augmentation;
use crate::random::Stream;

/// How a scene is changed: mirrored left and right and front and rear, turned, tilted, scaled and lifted, in this order.
#[derive(Clone, Debug)]
pub(crate) struct Change {
    pub(super) matrix: Matrix3<f64>,
    pub(super) lift: f64,
    pub(super) mirror: [f64; 2],
    pub(super) turn: f64,
    pub(super) scale: f64,
}

impl Change {
    /// `rotation`: the largest, rad.
    pub fn draw(how: &Augmentation, rotation: f64, draws: &mut Stream) -> Self {
        let mirror = [(); 2].map(|()| if draws.chance(how.mirror) { -1.0 } else { 1.0 });
        let turn = draws.between(-rotation, rotation);
        let scale = draws.between(how.scale[0], how.scale[1]);
        let [tilt, lift] = if draws.chance(how.level) {
            [0.0; 2]
        } else {
            [how.tilt, how.lift]
        };
        let [roll, pitch] = [(); 2].map(|()| draws.between(-tilt, tilt));
        let tilted = UnitQuaternion::from_euler_angles(roll, pitch, 0.0);
        let turned = tilted * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
        let mirrored = Matrix3::from_diagonal(&Vector3::new(mirror[0], mirror[1], 1.0));
        Change {
            matrix: scale * turned.to_rotation_matrix().matrix() * mirrored,
            lift: draws.between(-lift, lift),
            mirror,
            turn,
            scale,
        }
    }

    /// Where a point comes to.
    pub fn point(&self, point: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = (self.matrix * Vector3::from(point)).into();
        [x, y, z + self.lift]
    }

    /// A box as `x, y, z, h, w, l, yaw`; it stays upright.
    pub(super) fn hwl(&self, [x, y, z, h, w, l, yaw]: [f64; 7]) -> [f64; 7] {
        let [x, y, z] = self.point([x, y, z]);
        let [h, w, l] = [h, w, l].map(|side| side * self.scale);
        let mirrored = (yaw.sin() * self.mirror[1]).atan2(yaw.cos() * self.mirror[0]);
        [
            x,
            y,
            z,
            h,
            w,
            l,
            realo_schemas::geometry::normalize_yaw(mirrored + self.turn),
        ]
    }
}
