use serde::{Deserialize, Serialize};

use crate::Box3;
use crate::geometry::bottom_corners;

/// An axis-aligned rectangle on the ground plane, edges included; metres in the frame that its user names.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// Min and max x.
    pub x: [f64; 2],
    /// Min and max y.
    pub y: [f64; 2],
}

impl Region {
    /// The region of an argument: `[]` is none, else `[x min, x max, y min, y max]`.
    ///
    /// # Errors
    /// Says what the list should be.
    pub fn from_list(list: &[f64]) -> Result<Option<Self>, String> {
        match *list {
            [] => Ok(None),
            [x0, x1, y0, y1] => Region {
                x: [x0, x1],
                y: [y0, y1],
            }
            .checked()
            .map(Some),
            _ => Err(format!(
                "a region is [] or [x min, x max, y min, y max] in metres, found {} numbers",
                list.len()
            )),
        }
    }

    /// The region, if both of its ranges are.
    ///
    /// # Errors
    /// Names the range whose ends are not two finite numbers in order.
    pub fn checked(self) -> Result<Self, String> {
        for (axis, [from, to]) in [("x", self.x), ("y", self.y)] {
            if !(from.is_finite() && to.is_finite() && from < to) {
                return Err(format!(
                    "the region's {axis} runs from {from} to {to}; it must run upwards, in metres"
                ));
            }
        }
        Ok(self)
    }

    /// Whether a point lies in it.
    pub fn contains(&self, [x, y]: [f64; 2]) -> bool {
        (self.x[0]..=self.x[1]).contains(&x) && (self.y[0]..=self.y[1]).contains(&y)
    }

    /// Whether all four bottom corners of a box lie in it.
    pub fn contains_box(&self, object: &Box3) -> bool {
        bottom_corners(object).into_iter().all(|corner| self.contains(corner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_in_a_box_up_to_its_edge() {
        let region = Region::from_list(&[-10.0, 10.0, -5.0, 5.0]).unwrap().unwrap();
        let at = |x: f64, yaw: f64| Box3 {
            center: [x, 0.0, 9.0],
            length: 4.0,
            width: 2.0,
            height: 1.5,
            yaw,
            velocity: None,
            class: "car".into(),
            score: 1.0,
            track: None,
            covariance: None,
        };
        assert!(region.contains_box(&at(8.0, 0.0)));
        assert!(!region.contains_box(&at(8.001, 0.0)));
        assert!(!region.contains_box(&at(8.0, 0.3)));
        assert!(!region.contains_box(&at(f64::NAN, 0.0)));
    }

    #[test]
    fn refuses_what_is_no_region() {
        assert_eq!(Region::from_list(&[]), Ok(None));
        assert!(Region::from_list(&[1.0, 2.0]).unwrap_err().contains("2 numbers"));
        assert!(
            Region::from_list(&[1.0, -1.0, 0.0, 1.0])
                .unwrap_err()
                .contains("region's x runs from 1 to -1")
        );
        assert!(
            Region::from_list(&[0.0, 1.0, f64::NAN, 1.0])
                .unwrap_err()
                .contains("region's y")
        );
    }
}
