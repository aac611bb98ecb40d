use std::collections::VecDeque;

use nalgebra::{Isometry3, UnitQuaternion};

use crate::{Nanos, is_same_stamp, to_seconds};

/// The pose at `share` of the way from `a` to `b`: straight in translation, shortest arc in rotation.
/// A share outside [0, 1] extrapolates.
pub fn interpolate(a: &Isometry3<f64>, b: &Isometry3<f64>, share: f64) -> Isometry3<f64> {
    let translation = a.translation.vector.lerp(&b.translation.vector, share);
    let turn = (a.rotation.inverse() * b.rotation).scaled_axis();
    Isometry3::from_parts(
        translation.into(),
        a.rotation * UnitQuaternion::from_scaled_axis(turn * share),
    )
}

/// The recent poses of a moving frame, in order of time.
#[derive(Clone, Debug)]
pub struct PoseTrack {
    poses: VecDeque<(Nanos, Isometry3<f64>)>,
    keep: Nanos,
    max_gap: Nanos,
}

impl PoseTrack {
    /// Keeps poses for `keep` ns behind the newest one and bridges gaps of at most `max_gap` ns.
    pub fn new(keep: Nanos, max_gap: Nanos) -> Self {
        PoseTrack {
            poses: VecDeque::new(),
            keep,
            max_gap,
        }
    }

    /// Adds a pose; one of a known stamp replaces it, one older than what is kept is ignored.
    pub fn insert(&mut self, stamp: Nanos, map_from_frame: Isometry3<f64>) {
        let at = self.poses.partition_point(|(t, _)| *t < stamp);
        match self.poses.get_mut(at) {
            Some(known) if known.0 == stamp => known.1 = map_from_frame,
            _ => self.poses.insert(at, (stamp, map_from_frame)),
        }
        let newest = self.poses.back().map_or(stamp, |(t, _)| *t);
        while self
            .poses
            .front()
            .is_some_and(|(t, _)| newest.saturating_sub(*t) > self.keep)
        {
            self.poses.pop_front();
        }
    }

    /// Stamp of the newest pose.
    pub fn newest(&self) -> Option<Nanos> {
        self.poses.back().map(|(t, _)| *t)
    }

    /// The pose at `stamp`: recorded, interpolated between neighbours, or carried on by the motion of the last two
    /// poses; `None` where that bridges more than the largest gap. A pose whose stamp is the same but for rounding is at `stamp`.
    pub fn at(&self, stamp: Nanos) -> Option<Isometry3<f64>> {
        self.between(stamp).or_else(|| {
            let after = self.poses.partition_point(|(t, _)| *t < stamp);
            let mut around = self
                .poses
                .range(after.saturating_sub(1)..self.poses.len().min(after + 1));
            around.find(|(t, _)| is_same_stamp(*t, stamp)).map(|(_, pose)| *pose)
        })
    }

    fn between(&self, stamp: Nanos) -> Option<Isometry3<f64>> {
        let after = self.poses.partition_point(|(t, _)| *t < stamp);
        if let Some((t, pose)) = self.poses.get(after)
            && *t == stamp
        {
            return Some(*pose);
        }
        let last = self.poses.len();
        let (from, to) = match after {
            0 => return None,
            _ if after < last => (after - 1, after),
            _ if last >= 2 => (last - 2, last - 1),
            _ => return None,
        };
        let ((t0, a), (t1, b)) = (&self.poses[from], &self.poses[to]);
        let reach = (t1 - t0).max(stamp - t1);
        (reach <= self.max_gap).then(|| interpolate(a, b, to_seconds(stamp - t0) / to_seconds(t1 - t0)))
    }

    /// The recorded pose whose stamp is nearest, the earlier of two.
    pub fn nearest(&self, stamp: Nanos) -> Option<Isometry3<f64>> {
        let after = self.poses.partition_point(|(t, _)| *t < stamp);
        let neighbours = self
            .poses
            .range(after.saturating_sub(1)..self.poses.len().min(after + 1));
        let nearest = neighbours.min_by_key(|(t, _)| (stamp.saturating_sub(*t)).saturating_abs());
        nearest.map(|(_, pose)| *pose)
    }

    /// Velocity in `map` (m/s) and angular rate in the frame (rad/s) around `stamp`, from neighbouring poses.
    pub fn motion_at(&self, stamp: Nanos) -> Option<(nalgebra::Vector3<f64>, nalgebra::Vector3<f64>)> {
        let after = self
            .poses
            .partition_point(|(t, _)| *t < stamp)
            .clamp(1, self.poses.len().checked_sub(1)?.max(1));
        let ((t0, a), (t1, b)) = (self.poses.get(after - 1)?, self.poses.get(after)?);
        let dt = to_seconds(t1 - t0);
        (t1 - t0 <= self.max_gap).then(|| {
            let velocity = (b.translation.vector - a.translation.vector) / dt;
            let rate = (a.rotation.inverse() * b.rotation).scaled_axis() / dt;
            (velocity, rate)
        })
    }
}
