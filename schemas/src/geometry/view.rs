use nalgebra::{Isometry3, Point3, Vector3};

use crate::{Box3, Pose};

/// What a camera has in its image. Where labels were drawn in images, they can only be there.
///
/// The camera is a pinhole without distortion; its frame has x to the right of the image, y down and z ahead.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Where the camera lies in the frame that its user names.
    pub frame_from_camera: Isometry3<f64>,
    /// Focal lengths in x and y, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels.
    pub center: [f64; 2],
    /// Width and height of the image, pixels.
    pub size: [u32; 2],
    /// How far what is in the image may lie beside it at the stamp, m: what moves between sweep and picture.
    pub margin: f64,
}

impl View {
    /// How many numbers [`View::numbers`] gives.
    pub const NUMBERS: usize = 14;

    /// The view, if it is one.
    ///
    /// # Errors
    /// Names the field, what was expected and what it is.
    pub fn checked(self) -> Result<Self, String> {
        if let Some(bad) = self.numbers()[..7].iter().find(|number| !number.is_finite()) {
            return Err(format!("`pose`: expected a position and a rotation, found {bad}"));
        }
        if !self.focal.iter().all(|focal| focal.is_finite() && *focal > 0.0) {
            return Err(format!(
                "`focal`: expected two lengths above 0 in pixels, found {:?}",
                self.focal
            ));
        }
        if !self.center.iter().all(|center| center.is_finite()) {
            return Err(format!(
                "`center`: expected the principal point in pixels, found {:?}",
                self.center
            ));
        }
        if self.size.contains(&0) {
            return Err(format!(
                "`size`: expected width and height of the image in pixels, found {:?}",
                self.size
            ));
        }
        if !(self.margin.is_finite() && self.margin >= 0.0) {
            return Err(format!("`margin`: expected metres, 0 or more, found {}", self.margin));
        }
        Ok(self)
    }

    /// Whether a box, in the view's frame, is in the image: the rectangle around its corners, each moved aside by at most
    /// the margin, has a point in common with the image. Corners behind the camera are in no image.
    pub fn shows(&self, object: &Box3) -> bool {
        let camera_from_frame = self.frame_from_camera.inverse();
        let mut min = [f64::INFINITY; 2];
        let mut most = [f64::NEG_INFINITY; 2];
        for corner in corners(object) {
            let point = camera_from_frame * corner;
            if point.z <= 0.0 {
                continue;
            }
            for (axis, aside) in [point.x, point.y].into_iter().enumerate() {
                let at = |metres: f64| self.center[axis] + self.focal[axis] * metres / point.z;
                min[axis] = min[axis].min(at(aside - self.margin));
                most[axis] = most[axis].max(at(aside + self.margin));
            }
        }
        (0..2).all(|axis| min[axis] <= f64::from(self.size[axis]) && most[axis] >= 0.0)
    }

    /// The same view in another frame.
    pub fn moved(&self, to_from_frame: &Isometry3<f64>) -> Self {
        View {
            frame_from_camera: to_from_frame * self.frame_from_camera,
            ..self.clone()
        }
    }

    /// Position, rotation (x y z w), focal lengths, principal point, size and margin.
    pub fn numbers(&self) -> [f64; Self::NUMBERS] {
        let (t, q) = Pose::exact(self.frame_from_camera).to_parts();
        let [[fx, fy], [cx, cy], [w, h]] = [self.focal, self.center, self.size.map(f64::from)];
        [
            t[0],
            t[1],
            t[2],
            q[0],
            q[1],
            q[2],
            q[3],
            fx,
            fy,
            cx,
            cy,
            w,
            h,
            self.margin,
        ]
    }

    /// The view of its [`View::numbers`].
    ///
    /// # Errors
    /// As [`View::checked`].
    pub fn from_numbers(numbers: &[f64; Self::NUMBERS]) -> Result<Self, String> {
        let [x, y, z, i, j, k, r, fx, fy, cx, cy, w, h, margin] = *numbers;
        let pose = Pose::from_parts([x, y, z], [i, j, k, r])
            .ok_or_else(|| format!("`pose`: expected a position and a rotation, found {:?}", &numbers[..7]))?;
        let pixels = |length: f64| match length >= 0.0 && length <= f64::from(u32::MAX) && length.fract() == 0.0 {
            true => Ok(length as u32),
            false => Err(format!(
                "`size`: expected width and height of the image in whole pixels, found {length}"
            )),
        };
        View {
            frame_from_camera: pose.map_from_frame,
            focal: [fx, fy],
            center: [cx, cy],
            size: [pixels(w)?, pixels(h)?],
            margin,
        }
        .checked()
    }
}

fn corners(object: &Box3) -> [Point3<f64>; 8] {
    let (sin, cos) = libm::sincos(object.yaw);
    let half = [object.length, object.width, object.height].map(|extent| extent / 2.0);
    std::array::from_fn(|i| {
        let [u, v, w] = std::array::from_fn(|axis| if i >> axis & 1 == 0 { half[axis] } else { -half[axis] });
        Point3::from(object.center) + Vector3::new(u * cos - v * sin, u * sin + v * cos, w)
    })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use nalgebra::{Translation3, UnitQuaternion};

    use super::*;

    /// 90° wide, 1.5 m above the ground, looking along x.
    fn ahead() -> View {
        let axes = nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
        View {
            frame_from_camera: Isometry3::from_parts(
                Translation3::new(0.0, 0.0, 1.5),
                UnitQuaternion::from_matrix(&axes),
            ),
            focal: [500.0, 500.0],
            center: [500.0, 300.0],
            size: [1000, 600],
            margin: 0.0,
        }
    }

    fn car(x: f64, y: f64) -> Box3 {
        Box3 {
            center: [x, y, 0.8],
            length: 4.0,
            width: 2.0,
            height: 1.6,
            yaw: 0.0,
            velocity: None,
            class: "car".into(),
            score: 1.0,
            track: None,
            covariance: None,
        }
    }

    #[test]
    fn shows_what_reaches_into_the_image() {
        let view = ahead();
        assert!(view.shows(&car(20.0, 0.0)) && view.shows(&car(20.0, -19.0)));
        // The corner nearest to the axis lies at (22, ±21.9), just inside 45°, then at (22, ±22.1).
        assert!(view.shows(&car(20.0, 22.9)) && !view.shows(&car(20.0, 23.1)));
        assert!(view.shows(&car(20.0, -22.9)) && !view.shows(&car(20.0, -23.1)));
        assert!(!view.shows(&car(-20.0, 0.0)), "behind the camera");
        let high = Box3 {
            center: [20.0, 0.0, 20.0],
            ..car(0.0, 0.0)
        };
        assert!(!view.shows(&high), "above the image");
        // So near that no corner is in the image, but its side is.
        let wall = Box3 {
            length: 0.1,
            width: 40.0,
            height: 20.0,
            ..car(3.0, 0.0)
        };
        assert!(view.shows(&wall));
    }

    #[test]
    fn a_margin_is_in_metres_at_any_distance() {
        let view = View { margin: 1.0, ..ahead() };
        for x in [10.0, 20.0, 60.0] {
            let edge = x + 2.0 + 1.0 + view.margin;
            assert!(
                view.shows(&car(x, edge - 0.01)) && !view.shows(&car(x, edge + 0.01)),
                "{x}"
            );
        }
    }

    #[test]
    fn turns_with_its_frame_and_survives_as_numbers() {
        let turned = ahead().moved(&Isometry3::new(Vector3::new(5.0, 0.0, 0.0), Vector3::z() * FRAC_PI_2));
        assert!(turned.shows(&car(5.0, 20.0)) && !turned.shows(&car(20.0, 0.0)));
        let back = View::from_numbers(&turned.numbers()).unwrap();
        assert!((back.frame_from_camera.to_homogeneous() - turned.frame_from_camera.to_homogeneous()).norm() < 1e-12);
        assert_eq!(
            (back.focal, back.center, back.size, back.margin),
            (turned.focal, turned.center, turned.size, 0.0)
        );
    }

    #[test]
    fn what_is_no_view_is_named() {
        let cases = [
            (0, f64::NAN, "`pose`"),
            (7, 0.0, "`focal`"),
            (8, f64::NAN, "`focal`"),
            (9, f64::INFINITY, "`center`"),
            (11, 0.0, "`size`"),
            (12, 1.5, "`size`"),
            (12, -1.0, "`size`"),
            (13, -0.1, "`margin`"),
            (13, f64::NAN, "`margin`"),
        ];
        for (at, value, named) in cases {
            let mut numbers = ahead().numbers();
            numbers[at] = value;
            let error = View::from_numbers(&numbers).unwrap_err();
            assert!(error.contains(named), "{at}: {error}");
        }
        let mut numbers = ahead().numbers();
        numbers[3..7].fill(0.0);
        assert!(View::from_numbers(&numbers).unwrap_err().contains("`pose`"));
    }
}
