//! Points on boxes.

use realo_schemas::geometry::bottom_corners;
use realo_schemas::{Box3, PointCloud};

/// Width of the strips along x in which boxes are looked for, m.
const STRIP: f64 = 1.0;
/// Strips reach from minus to plus so many metres.
const REACH: f64 = 500.0;
const STRIPS: usize = (2.0 * REACH / STRIP) as usize;

/// A box in its own axes.
struct Inside {
    center: [f32; 3],
    axis: [f32; 2],
    half: [f32; 3],
}

impl Inside {
    fn new(object: &Box3) -> Self {
        let (sin, cos) = libm::sincos(object.yaw);
        Inside {
            center: object.center.map(|metres| metres as f32),
            axis: [cos as f32, sin as f32],
            half: [object.length, object.width, object.height].map(|metres| metres as f32 / 2.0),
        }
    }

    fn has(&self, [x, y, z]: [f32; 3]) -> bool {
        let ([cos, sin], [dx, dy]) = (self.axis, [x - self.center[0], y - self.center[1]]);
        let [length, width, height] = self.half;
        (z - self.center[2]).abs() <= height
            && (dx * cos + dy * sin).abs() <= length
            && (dy * cos - dx * sin).abs() <= width
    }
}

/// How many points of a cloud are in each box, both in one frame. Boxes farther away than 500 m along x have none.
pub fn points_in_boxes(cloud: &PointCloud, boxes: &[Box3]) -> Vec<u32> {
    let inside: Vec<Inside> = boxes.iter().map(Inside::new).collect();
    let mut strips: Vec<Vec<u16>> = vec![Vec::new(); STRIPS];
    for (index, object) in boxes.iter().enumerate().take(usize::from(u16::MAX)) {
        let corners = bottom_corners(object).map(|[x, _]| x);
        let min = corners.into_iter().fold(f64::INFINITY, f64::min);
        let max = corners.into_iter().fold(f64::NEG_INFINITY, f64::max);
        let first = ((min + REACH) / STRIP).floor().max(0.0) as usize;
        let last = ((max + REACH) / STRIP).floor();
        if last >= 0.0 {
            let all = strips.iter_mut().take(last as usize + 1).skip(first);
            all.for_each(|strip| strip.push(index as u16));
        }
    }
    let mut counts = vec![0; boxes.len()];
    for ((x, y), z) in cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter()) {
        // A NaN is in strip 0, and in no box.
        let strip = ((x + REACH as f32) / STRIP as f32) as usize;
        for index in strips.get(strip).into_iter().flatten() {
            let index = usize::from(*index);
            counts[index] += u32::from(inside[index].has([*x, *y, *z]));
        }
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_counts_for_each_box_that_it_is_in() {
        let at = |x: f64, yaw: f64| Box3::new("car", [x, 3.0, 1.0], [4.0, 2.0, 2.0], yaw);
        let boxes = [at(10.0, 0.0), at(10.0, 1.0), at(-100.0, 0.5), at(600.0, 0.0)];
        let (x, y, z) = (
            vec![10.0, 11.9, 10.0, -100.0, f32::NAN, 600.0],
            vec![3.0, 3.0, 3.0, 3.1, 3.0, 3.0],
            vec![1.0, 1.0, 2.1, 0.5, 1.0, 1.0],
        );
        let cloud = PointCloud::new(x, y, z, vec![0u8; 6], vec![0i32; 6], vec![0u16; 6]).unwrap();
        assert_eq!(points_in_boxes(&cloud, &boxes), [2, 1, 1, 0]);
    }
}
