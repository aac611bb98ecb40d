//! Lanes: points that follow one another in a lane lie close together, where neighbours in the order of the sweep do not.
//!
//! A spinning LiDAR fires its beams in turn, so that the point before is one of another beam, metres away, and the one
//! beside it is the last of its own beam. A sensor that draws line after line needs no lanes.

use std::ops::Range;

use realo_schemas::PointCloud;

/// Largest number of lanes.
pub(super) const LANES: usize = 256;

/// Side of a bin of the tangent of elevation: a third of a degree, the distance of the beams of many sensors, and less
/// than that of their sparser ones.
const BIN: f32 = 0.006;
/// Heights of a sensor over the origin of its cloud that are tried, m: none in its own frame, that of a roof in the frame of
/// a vehicle's body.
const HEIGHTS: [f32; 6] = [0.0, 1.5, 1.75, 2.0, 2.25, 2.5];
/// Added to a number below 2²², it leaves the nearest whole one in the low bits.
const ROUND: f32 = 12_582_912.0;
/// What a cloud is judged by: so many runs of so many points.
const RUNS: usize = 4;
const RUN: usize = 512;

/// Bin of elevation of a point as seen from the sensor; those beyond ±37° share the last ones.
fn bin([x, y, z]: [f32; 3], height: f32) -> u8 {
    // At least the smallest positive number, so that the quotient is one.
    let distance = (x * x + y * y).sqrt().max(f32::MIN_POSITIVE);
    let bin = ((z - height) / distance * (1.0 / BIN)).clamp(-127.0, 127.0) + 128.0;
    (bin + ROUND).to_bits() as u8
}

/// Chooses the lane of each point, if lanes are worth it: its beam, or its bin of elevation where the cloud reports no beams.
/// `places` are the quantised coordinates of the same points.
pub(super) fn choose(cloud: &PointCloud, places: [&[i32]; 3], lanes: &mut Vec<u8>) -> bool {
    if cloud.len() < RUNS {
        return false;
    }
    let alone = sampled(places, |_| 0);
    lanes.clear();
    let most = cloud.ring.iter().fold(0, |all, ring| all | *ring);
    if (1..LANES).contains(&most.into()) {
        lanes.extend(cloud.ring.iter().map(|ring| *ring as u8));
        return sampled(places, |i| lanes[i]) < alone;
    }
    let by_elevation = |height: f32| sampled(places, |i| bin([cloud.x[i], cloud.y[i], cloud.z[i]], height));
    let tried = HEIGHTS.map(|height| (by_elevation(height), height));
    let Some((min, height)) = tried.into_iter().min_by_key(|(bits, _)| *bits) else {
        return false;
    };
    if min >= alone {
        return false;
    }
    let points = cloud.x.iter().zip(&*cloud.y).zip(&*cloud.z);
    lanes.extend(points.map(|((x, y), z)| bin([*x, *y, *z], height)));
    true
}

/// Bits of the differences in the runs that a cloud is judged by.
fn sampled(places: [&[i32]; 3], lane: impl Fn(usize) -> u8) -> u64 {
    runs(places[0].len()).map(|run| bits(places, run, &lane)).sum()
}

fn runs(count: usize) -> impl Iterator<Item = Range<usize>> {
    let run = RUN.min(count / RUNS);
    (0..RUNS).map(move |k| k * (count / RUNS)..k * (count / RUNS) + run)
}

/// Bits of the differences in a run of points: of their coordinates in their lanes, where the first one of a lane differs
/// from the point before, and of the lanes, which cross as well.
fn bits(places: [&[i32]; 3], run: Range<usize>, lane: impl Fn(usize) -> u8) -> u64 {
    let mut last = [None; LANES];
    let (mut before, mut lane_before) = (places.map(|column| column[run.start]), lane(run.start));
    let mut bits = 0;
    for i in run {
        let (point, lane) = (places.map(|column| column[i]), lane(i));
        let from = last[usize::from(lane)].replace(point).unwrap_or(before);
        let differences = point.iter().zip(&from).map(|(a, b)| a.abs_diff(*b));
        let differences = differences.chain([u32::from(lane.abs_diff(lane_before))]);
        bits += differences
            .map(|d| u64::from(u32::BITS - d.leading_zeros()))
            .sum::<u64>();
        (before, lane_before) = (point, lane);
    }
    bits
}
