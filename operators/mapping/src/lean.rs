//! Sensors that lean ahead or back by an angle that nobody knows.
//!
//! Poses are level, so such a sensor shows level ground as a slope, and odometry drives up or down it for ever: by the whole slope where
//! the way is straight, by less in bends. One drive alone cannot tell that from a real slope. Loops can: the same place has one height.
//! Sweeps are then levelled and followed anew; what is left of the slope is found by the next loops.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use realo_pose_graph::Edge;
use realo_schemas::PointCloud;
use realo_schemas::geometry::transform_cloud;

use crate::drive::Piece;
use crate::keyframe::Keyframe;

/// Fewer loops say nothing.
const MIN_LOOPS: usize = 3;
/// A lean is believed from so many of its standard deviations on, and between these slopes: what leans more is a mount that everybody sees,
/// or loops that are wrong.
const SURE: f64 = 3.0;
const MIN_SLOPE: f64 = 5e-4;
const MAX_SLOPE: f64 = 0.05;

/// How a vehicle's sensor leans.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lean {
    /// How much too high what is a metre ahead looks, m; below 0 it looks too low.
    pub slope: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// The points of a sweep in a level frame; `slope` as in [`Lean`].
pub fn levelled(cloud: &PointCloud, slope: f64) -> PointCloud {
    let (sin, cos) = libm::sincos(0.5 * libm::atan(slope));
    let turn = UnitQuaternion::new_unchecked(Quaternion::new(cos, 0.0, sin, 0.0));
    transform_cloud(&Isometry3::from_parts(Translation3::identity(), turn), cloud)
}

/// How far a piece's poses are ahead of its first, m, forwards less backwards.
fn ways(piece: &Piece) -> Vec<f64> {
    let mut way = 0.0;
    let mut last: Option<&Isometry3<f64>> = None;
    let ahead = piece.track.iter().map(|(_, pose)| {
        way += last.map_or(0.0, |last| last.inv_mul(pose).translation.x);
        last = Some(pose);
        way
    });
    ahead.collect()
}

/// Of a keyframe, the place of its pose in the track.
fn place_of(piece: &Piece, keyframe: &Keyframe) -> usize {
    piece.track.partition_point(|(stamp, _)| *stamp < keyframe.stamp)
}

/// How the sensor of a drive leans, by closed loops: pieces, each with the loops within it by numbers of its keyframes. `None` where they
/// do not tell, or tell that it is level.
pub(crate) fn lean<'a>(pieces: impl Iterator<Item = (&'a Piece, Vec<(usize, usize, &'a Edge)>)>) -> Option<Lean> {
    let mut pairs = Vec::new();
    for (piece, loops) in pieces {
        let ways = ways(piece);
        let at = |number: usize| {
            let keyframe = &piece.keyframes[number];
            let way = ways.get(place_of(piece, keyframe))?;
            Some((*way, keyframe.odom_from_body.translation.z))
        };
        let driven = loops.iter().filter_map(|(from, to, edge)| {
            let seen = edge.from_from_to.translation;
            let ((from, low), (to, high)) = (at(*from)?, at(*to)?);
            Some((to - from - seen.x, high - low - seen.z))
        });
        pairs.extend(driven);
    }
    let count = pairs.len() as f64;
    let squares: f64 = pairs.iter().map(|(way, _)| way * way).sum();
    if pairs.len() < MIN_LOOPS || squares <= 0.0 {
        return None;
    }
    let slope = pairs.iter().map(|(way, off)| way * off).sum::<f64>() / squares;
    let rest: f64 = pairs.iter().map(|(way, off)| (off - slope * way).powi(2)).sum();
    // Loops of one lap err alike: all of them say no more than one.
    let sigma = (rest / count).sqrt() / (squares / count).sqrt();
    let is_sure = slope.abs() >= MIN_SLOPE.max(SURE * sigma) && slope.abs() <= MAX_SLOPE;
    is_sure.then_some(Lean { slope, sigma })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(points: &[[f32; 3]]) -> PointCloud {
        let column = |axis: usize| points.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let n = points.len();
        PointCloud::new(column(0), column(1), column(2), vec![0; n], vec![0; n], vec![0; n]).unwrap()
    }

    #[test]
    fn what_looks_like_a_slope_becomes_level() {
        let slope = -0.0075f32;
        let tilted = cloud(&[[40.0, 3.0, 40.0 * slope], [-20.0, 0.0, -20.0 * slope], [0.0, 5.0, 0.0]]);
        let level = levelled(&tilted, f64::from(slope));
        assert!(level.z.iter().all(|z| z.abs() < 1e-5), "{:?}", level.z);
        assert!((level.x[0] - 40.0).abs() < 2e-3 && level.y[..] == [3.0, 0.0, 5.0]);
    }
}
