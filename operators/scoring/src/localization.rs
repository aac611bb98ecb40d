//! How well agents know where they are: their estimates against true poses.

use std::collections::BTreeMap;

use realo_schemas::geometry::{normalize_yaw, yaw_of};
use realo_schemas::{AgentState, PoseStatus};
use serde::{Deserialize, Serialize};

/// 95 % of χ² with four degrees of freedom, between 2.5 % and 97.5 %.
pub const NEES_BAND: [f64; 2] = [0.484_4, 11.143_3];

/// One estimate, and what is wrong with it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalizationFrame {
    /// What the estimate says of itself.
    pub status: PoseStatus,
    /// Its error, where the estimate is usable and the truth is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<PoseDifference>,
}

/// How far an estimated pose is from the true one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseDifference {
    /// On the ground, m.
    pub position_m: f64,
    /// Up or down, m.
    #[serde(default)]
    pub height_m: f64,
    /// Of the heading, degrees, 0 to 180.
    pub heading_deg: f64,
    /// Normalised error squared over x, y, z and the heading: χ² with four degrees of freedom where the covariance is right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nees: Option<f64>,
}

/// Mean, 95 % and max of an error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorSpread {
    /// Mean.
    pub mean: f64,
    /// 95 % are no larger.
    pub p95: f64,
    /// The largest.
    pub max: f64,
}

/// How well an agent knew where it was.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LocalizationScores {
    /// Sweeps.
    pub frames: u64,
    /// Those of them with a usable pose: `tracking` or `dead_reckoning`, of all.
    pub availability: f64,
    /// Sweeps by status.
    pub by_status: BTreeMap<PoseStatus, u64>,
    /// Usable poses whose truth is known.
    pub compared: u64,
    /// On the ground, m; `None` where no truth is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_m: Option<ErrorSpread>,
    /// Up or down, m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_m: Option<ErrorSpread>,
    /// Of the heading, degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heading_deg: Option<ErrorSpread>,
    /// Share of NEES inside [`NEES_BAND`]: 0.95 where covariances are right.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nees_inside: Option<f64>,
    /// Mean NEES: 4 where covariances are right, more where they are too small.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub nees_mean: Option<f64>,
}

impl PoseDifference {
    /// The error of an estimate.
    pub fn of(estimate: &AgentState, map_from_body: &nalgebra::Isometry3<f64>) -> Self {
        let shift = map_from_body.translation.vector - estimate.map_from_body.translation.vector;
        let turn = normalize_yaw(yaw_of(&map_from_body.rotation) - yaw_of(&estimate.map_from_body.rotation));
        let error = nalgebra::Vector4::new(shift.x, shift.y, shift.z, turn);
        let nees = estimate.covariance.as_ref().and_then(|covariance| {
            let kept = [0, 1, 2, 5];
            let covariance = nalgebra::Matrix4::from_fn(|row, column| covariance[6 * kept[row] + kept[column]]);
            Some(error.dot(&covariance.cholesky()?.solve(&error)))
        });
        PoseDifference {
            position_m: libm::hypot(shift.x, shift.y),
            height_m: shift.z.abs(),
            heading_deg: turn.to_degrees().abs(),
            nees: nees.filter(|nees| nees.is_finite()),
        }
    }
}

impl LocalizationScores {
    /// The scores of an agent's estimates; `None` without any.
    pub fn of(frames: &[LocalizationFrame]) -> Option<Self> {
        let mut by_status: BTreeMap<PoseStatus, u64> = BTreeMap::new();
        for frame in frames {
            *by_status.entry(frame.status).or_default() += 1;
        }
        let usable: u64 = by_status
            .iter()
            .filter(|(status, _)| status.is_usable())
            .map(|(_, count)| count)
            .sum();
        let errors: Vec<PoseDifference> = frames.iter().filter_map(|frame| frame.error).collect();
        let nees: Vec<f64> = errors.iter().filter_map(|error| error.nees).collect();
        let inside = nees
            .iter()
            .filter(|nees| (NEES_BAND[0]..=NEES_BAND[1]).contains(*nees))
            .count();
        let all = frames.len() as u64;
        (all > 0).then(|| LocalizationScores {
            frames: all,
            availability: usable as f64 / all as f64,
            by_status,
            compared: errors.len() as u64,
            position_m: ErrorSpread::of(errors.iter().map(|error| error.position_m)),
            height_m: ErrorSpread::of(errors.iter().map(|error| error.height_m)),
            heading_deg: ErrorSpread::of(errors.iter().map(|error| error.heading_deg)),
            nees_inside: (!nees.is_empty()).then(|| inside as f64 / nees.len() as f64),
            nees_mean: (!nees.is_empty()).then(|| nees.iter().sum::<f64>() / nees.len() as f64),
        })
    }
}

impl ErrorSpread {
    /// Of errors, whatever their order; `None` without any.
    fn of(errors: impl Iterator<Item = f64>) -> Option<Self> {
        let mut errors: Vec<f64> = errors.collect();
        errors.sort_by(f64::total_cmp);
        let max = *errors.last()?;
        // The smallest that at least 95 % do not exceed.
        let at = (errors.len() * 95).div_ceil(100).max(1) - 1;
        Some(ErrorSpread {
            mean: errors.iter().sum::<f64>() / errors.len() as f64,
            p95: errors[at],
            max,
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;

    fn state(x: f64, yaw: f64) -> AgentState {
        let mut covariance = Box::new([0.0; 36]);
        for axis in 0..6 {
            covariance[7 * axis] = 0.25;
        }
        AgentState {
            map_from_body: Isometry3::new(nalgebra::Vector3::new(x, 0.0, 0.0), nalgebra::Vector3::z() * yaw),
            covariance: Some(covariance),
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Tracking,
        }
    }

    #[test]
    fn an_error_is_that_of_place_and_heading_over_its_deviation() {
        let found = PoseDifference::of(&state(3.0, 3.1), &state(3.4, -3.1).map_from_body);
        assert!((found.position_m - 0.4).abs() < 1e-12);
        let turn = std::f64::consts::TAU - 6.2;
        assert!((found.heading_deg - turn.to_degrees()).abs() < 1e-9);
        let nees = (0.16 + turn * turn) / 0.25;
        assert!(found.nees.is_some_and(|found| (found - nees).abs() < 1e-9));
        let mut above = state(3.0, 0.0);
        above.map_from_body.translation.z = -47.0;
        let found = PoseDifference::of(&above, &state(3.0, 0.0).map_from_body);
        assert_eq!((found.position_m, found.height_m), (0.0, 47.0));
        let mut unsure = state(3.0, 0.0);
        unsure.covariance = Some(Box::new([0.0; 36]));
        assert_eq!(PoseDifference::of(&unsure, &Isometry3::identity()).nees, None);
    }

    #[test]
    fn scores_are_of_usable_poses_and_availability_of_all() {
        let frame = |status, error: Option<f64>| LocalizationFrame {
            status,
            error: error.map(|position_m| PoseDifference {
                position_m,
                height_m: 0.0,
                heading_deg: 1.0,
                nees: Some(10.0 * position_m),
            }),
        };
        let mut frames: Vec<_> = (1..=18)
            .map(|n| frame(PoseStatus::Tracking, Some(0.1 * f64::from(n))))
            .collect();
        frames.extend([
            frame(PoseStatus::DeadReckoning, Some(1.9)),
            frame(PoseStatus::Lost, None),
        ]);
        let scores = LocalizationScores::of(&frames).unwrap();
        assert_eq!((scores.frames, scores.compared, scores.availability), (20, 19, 0.95));
        let spread = scores.position_m.unwrap();
        assert!((spread.mean - 1.0).abs() < 1e-12 && spread.max == 1.9);
        assert!((spread.p95 - 1.9).abs() < 1e-12, "{spread:?}");
        // 1 to 11 of 19.
        assert!((scores.nees_inside.unwrap() - 11.0 / 19.0).abs() < 1e-12);
        assert_eq!(scores.by_status[&PoseStatus::Lost], 1);
        assert_eq!(LocalizationScores::of(&[]), None);
    }
}
