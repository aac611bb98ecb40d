//! The heading by aligning dead reckoning with GNSS: a least-squares fit of one track on the other.

use nalgebra::{Vector2, Vector3};
use realo_schemas::{Nanos, to_seconds};

use crate::models::LocalFix;
use crate::rules::Rules;

/// Longest time over which fixes are aligned, s: then what wanders is no longer constant.
const LONGEST_S: f64 = 20.0;
/// Distances of two fixes and of dead reckoning may differ by so many standard deviations.
const JUMP: f64 = 5.0;
/// Fixes before anything is said.
const ENOUGH: f64 = 10.0;

/// Sums over fixes and the places where dead reckoning says that they are.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Alignment {
    first: Option<(Nanos, Vector2<f64>, Vector2<f64>)>,
    last: Option<(Vector2<f64>, LocalFix)>,
    count: f64,
    height: f64,
    heights: f64,
    /// Of reckoned places, of fixes, both from the first ones.
    reckoned: Vector2<f64>,
    fixed: Vector2<f64>,
    along: f64,
    across: f64,
    square: f64,
}

/// How dead reckoning lies in `map`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Aligned {
    /// Turn from dead reckoning to `map`, rad, and its variance.
    pub turn: f64,
    pub turn_variance: f64,
    /// How much longer the track is by GNSS.
    pub scale: f64,
    /// Where the antenna is at the last fix, m.
    pub antenna: Vector3<f64>,
    /// Whether a fix had a height.
    pub has_height: bool,
    /// From the middle of the track to there, m in `map`.
    pub lever: Vector2<f64>,
    /// Number of fixes.
    pub count: f64,
    /// Time of the track, s.
    pub seconds: f64,
}

impl Alignment {
    /// Whether the track has become too long.
    pub fn is_over(&self, stamp: Nanos) -> bool {
        self.first
            .is_some_and(|(first, ..)| to_seconds(stamp - first) > LONGEST_S)
    }

    /// Whether a fix is as far from the last one as dead reckoning says; `moves`: whether its scale is known.
    pub fn follows(&self, reckoned: &Vector2<f64>, fix: &LocalFix, moves: bool) -> bool {
        let Some((before, last)) = &self.last else {
            return true;
        };
        let way = (fix.position - last.position).xy().norm();
        let expected = (reckoned - before).norm();
        let sigma = (2.0 * (fix.variance.x + fix.variance.y)).sqrt();
        let slack = JUMP * sigma + 0.1 * expected + 0.5;
        if moves {
            (way - expected).abs() < slack
        } else {
            way < slack + 10.0
        }
    }

    /// Takes a fix, and where its antenna is by dead reckoning.
    pub fn add(&mut self, stamp: Nanos, reckoned: Vector2<f64>, fix: &LocalFix) {
        let (_, from, zero) = *self.first.get_or_insert((stamp, reckoned, fix.position.xy()));
        self.last = Some((reckoned, *fix));
        let (d, z) = (reckoned - from, fix.position.xy() - zero);
        self.count += 1.0;
        if fix.has_height {
            self.height += fix.position.z;
            self.heights += 1.0;
        }
        self.reckoned += d;
        self.fixed += z;
        self.along += d.dot(&z);
        self.across += d.perp(&z);
        self.square += d.norm_squared();
    }

    /// The alignment, once there are enough fixes at different places.
    pub fn aligned(&self, stamp: Nanos, rules: &Rules) -> Option<Aligned> {
        let ((first, from, zero), (reckoned, fix)) = (self.first?, self.last.as_ref()?);
        if self.count < ENOUGH {
            return None;
        }
        let (d, z) = (self.reckoned / self.count, self.fixed / self.count);
        let along = self.along - self.count * d.dot(&z);
        let across = self.across - self.count * d.perp(&z);
        let square = self.square - self.count * d.norm_squared();
        if square.is_nan() || square <= 1e-6 {
            return None;
        }
        let turn = libm::atan2(across, along);
        let scale = libm::hypot(across, along) / square;
        let (sin, cos) = libm::sincos(turn);
        let off = reckoned - from - d;
        let lever = Vector2::new(cos * off.x - sin * off.y, sin * off.x + cos * off.y) * scale;
        let place = zero + z + lever;
        let seconds = to_seconds(stamp - first);
        let [wander, white] = fix.split(rules);
        // What is white averages over the track; what wanders tilts it as a whole.
        let size = square * scale * scale;
        let drift = wander.x * wander.x * 2.0 * seconds / rules.noise.gnss_wander_s;
        let turn_variance = white.x.max(white.y) / size + 1.2 * drift / (12.0 * size / self.count);
        Some(Aligned {
            turn,
            turn_variance,
            scale,
            antenna: Vector3::new(place.x, place.y, self.height / self.heights.max(1.0)),
            has_height: self.heights > 0.0,
            lever,
            count: self.count,
            seconds,
        })
    }
}

#[cfg(test)]
mod tests {
    use realo_geodesy::{Geodetic, LocalFrame};
    use realo_schemas::from_seconds;

    use super::*;
    use crate::{Settings, Unit};

    #[test]
    fn a_track_is_turned_onto_another() {
        let rules = Rules::new(Settings::new(Unit::Rtk, LocalFrame::new(Geodetic::default()).unwrap()));
        let mut alignment = Alignment::default();
        let (sin, cos) = 2.1f64.sin_cos();
        let mut expected = Vector2::zeros();
        for step in 0..20 {
            let s = f64::from(step);
            let reckoned = Vector2::new(3.0 + s, 0.02 * s * s);
            expected = Vector2::new(
                100.0 + cos * reckoned.x - sin * reckoned.y,
                -50.0 + sin * reckoned.x + cos * reckoned.y,
            );
            let fix = LocalFix {
                position: Vector3::new(expected.x, expected.y, 7.0),
                variance: Vector3::new(2e-4, 2e-4, 1e-3),
                has_height: true,
                since_s: None,
            };
            assert!(alignment.follows(&reckoned, &fix, true));
            let jumped = LocalFix {
                position: fix.position + Vector3::new(0.0, 10.0, 0.0),
                ..fix
            };
            assert_eq!(alignment.follows(&reckoned, &jumped, true), step == 0);
            alignment.add(from_seconds(0.1 * s), reckoned, &fix);
            assert_eq!(alignment.aligned(from_seconds(0.1 * s), &rules).is_some(), step >= 9);
        }
        let aligned = alignment.aligned(from_seconds(1.9), &rules).unwrap();
        assert!((aligned.turn - 2.1).abs() < 1e-9 && (aligned.scale - 1.0).abs() < 1e-9);
        assert!((aligned.antenna - Vector3::new(expected.x, expected.y, 7.0)).norm() < 1e-9);
        assert!(aligned.turn_variance.sqrt() < 0.01, "{aligned:?}");
    }
}
