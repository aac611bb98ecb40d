//! Positions of GNSS: which can be used, and what they say of keyframes.
//!
//! What wanders in a receiver's error, and what multipath adds, is alike for long. All positions of such a time count as one: their variance
//! is larger by as many as there are. The kernel takes the error itself, so that jumps let go whatever they weigh.

use nalgebra::Vector3;
use realo_pose_graph::Anchor;
use realo_schemas::geometry::PoseTrack;
use realo_schemas::{Nanos, to_seconds};
use realo_state_estimation::{MapFix, UnitNoise, unit_of};

use crate::keyframe::Keyframe;

/// Positions farther from the origin of `map` are in another zone, m.
const FAR_M: f64 = 100_000.0;
/// An error so many times as large as the receiver says has a quarter of the weight.
const WIDTH: f64 = 3.0;
/// Positions are apart by this at least, s, as seen by what wanders.
const SHORTEST_S: f64 = 0.05;

/// A position of GNSS that can be used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fix {
    /// When.
    pub stamp: Nanos,
    /// Where the antenna was in `map`, m.
    pub position: Vector3<f64>,
    /// Whether the height is known.
    pub has_height: bool,
    /// Variances along the axes of `map`, m².
    pub variance: Vector3<f64>,
    /// Where the antenna is in the body frame, m.
    pub antenna: Vector3<f64>,
    noise: UnitNoise,
}

/// Positions of GNSS that were not used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FixFaults {
    /// Not finite, or with variances that are not above 0.
    pub not_finite: u64,
    /// More than 100 km from the origin of `map`.
    pub elsewhere: u64,
    /// The same as the one before, to the last digit.
    pub frozen: u64,
    /// Heights of exactly 0, which say nothing; the rest of the position is used.
    pub no_height: u64,
}

/// Gathers the positions of a drive.
#[derive(Clone, Debug, Default)]
pub(crate) struct Fixes {
    taken: Vec<Fix>,
    last: Option<Vector3<f64>>,
    faults: FixFaults,
}

impl Fixes {
    /// Takes a position. `imu_variance` says which unit it is, where the receiver says no variance.
    pub fn add(&mut self, fix: &MapFix, antenna: &Vector3<f64>, imu_variance: Option<[f64; 2]>) {
        let noise = unit_of(imu_variance).noise();
        let variance = Vector3::from(fix.variance.unwrap_or(noise.gnss.map(|sigma| sigma * sigma)));
        let is_variance = variance.iter().all(|variance| *variance > 0.0 && variance.is_finite());
        if !(is_variance && fix.position.iter().all(|part| part.is_finite())) {
            self.faults.not_finite += 1;
        } else if fix.position.xy().norm() > FAR_M {
            self.faults.elsewhere += 1;
        } else if self.last.replace(fix.position) == Some(fix.position) {
            self.faults.frozen += 1;
        } else {
            self.faults.no_height += u64::from(!fix.has_height);
            self.taken.push(Fix {
                stamp: fix.stamp,
                position: fix.position,
                has_height: fix.has_height,
                variance,
                antenna: *antenna,
                noise,
            });
        }
    }

    pub fn faults(&self) -> FixFaults {
        self.faults
    }

    /// All that can be used, by time.
    pub fn taken(mut self) -> Vec<Fix> {
        self.taken.sort_by_key(|fix| fix.stamp);
        self.taken
    }
}

/// The positions of one keyframe.
#[derive(Clone, Debug)]
pub(crate) struct Anchored {
    /// Number of the keyframe in its piece.
    pub keyframe: usize,
    /// The mean of the antenna's places in the keyframe's frame, m.
    pub antenna: Vector3<f64>,
    /// The mean of the positions, m.
    pub position: Vector3<f64>,
    /// Whether all heights are known.
    pub has_height: bool,
    /// Variances of the mean with what is alike counted once, m².
    pub variance: Vector3<f64>,
    /// Largest variances that the receiver says of one, m².
    pub said: Vector3<f64>,
}

impl Anchored {
    /// The factor of a graph in which the keyframe has this number.
    pub fn factor(&self, node: usize) -> Anchor {
        let information = Vector3::from_fn(|axis, _| match axis == 2 && !self.has_height {
            true => 0.0,
            false => 1.0 / self.variance[axis],
        });
        Anchor {
            node,
            antenna: self.antenna,
            position: self.position,
            information,
            kernel: Some(WIDTH * (self.said.x / self.variance.x).sqrt()),
        }
    }
}

/// The positions of each keyframe of a piece, where `track` is its odometry.
pub(crate) fn anchored(keyframes: &[Keyframe], track: &PoseTrack, fixes: &[Fix]) -> Vec<Anchored> {
    let mut groups: Vec<Vec<(&Fix, Vector3<f64>)>> = vec![Vec::new(); keyframes.len()];
    for fix in fixes {
        let Some(odom_from_body) = track.at(fix.stamp) else {
            continue;
        };
        let after = keyframes.partition_point(|keyframe| keyframe.stamp < fix.stamp);
        let apart = |at: usize| (keyframes[at].stamp - fix.stamp).saturating_abs();
        let nearest = [after.checked_sub(1), (after < keyframes.len()).then_some(after)];
        let Some(nearest) = nearest.into_iter().flatten().min_by_key(|at| apart(*at)) else {
            continue;
        };
        let body_from_then = keyframes[nearest].odom_from_body.inv_mul(&odom_from_body);
        let antenna = body_from_then * nalgebra::Point3::from(fix.antenna);
        groups[nearest].push((fix, antenna.coords));
    }
    let period = period(groups.iter().flatten().map(|(fix, _)| fix.stamp));
    let with_fixes = groups.iter().enumerate().filter(|(_, group)| !group.is_empty());
    with_fixes
        .map(|(keyframe, group)| mean(keyframe, group, period.max(SHORTEST_S)))
        .collect()
}

/// The median time from one position to the next, s: neither outages nor wrong stamps change it.
fn period(stamps: impl Iterator<Item = Nanos>) -> f64 {
    let mut stamps: Vec<Nanos> = stamps.collect();
    stamps.sort_unstable();
    let mut gaps: Vec<Nanos> = stamps.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2).map_or(0.0, |gap| to_seconds(*gap))
}

fn mean(keyframe: usize, group: &[(&Fix, Vector3<f64>)], period: f64) -> Anchored {
    let count = group.len() as f64;
    let antennas: Vector3<f64> = group.iter().map(|(_, antenna)| antenna).sum();
    let positions: Vector3<f64> = group.iter().map(|(fix, _)| fix.position).sum();
    let seconds = count * period;
    let mut variance = Vector3::zeros();
    for (fix, _) in group {
        let noise = &fix.noise;
        let unit = Vector3::from(noise.gnss);
        let sky = fix.variance.zip_map(&unit, |said, unit| said.min(unit * unit));
        let alike = |lasts: f64| (2.0 * lasts / seconds).max(1.0);
        let share = noise.gnss_wander_share;
        variance += sky * (share * alike(noise.gnss_wander_s) + (1.0 - share) / count)
            + (fix.variance - sky) * alike(noise.gnss_multipath_s);
    }
    Anchored {
        keyframe,
        antenna: antennas / count,
        position: positions / count,
        has_height: group.iter().all(|(fix, _)| fix.has_height),
        variance: variance / count,
        said: group
            .iter()
            .fold(Vector3::zeros(), |most, (fix, _)| most.sup(&fix.variance)),
    }
}
