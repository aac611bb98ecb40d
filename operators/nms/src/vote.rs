use std::f64::consts::{FRAC_PI_4, PI};

use realo_schemas::Box3;
use realo_schemas::geometry::{Footprint, iou_exceeds, is_valid, normalize_yaw};

/// What candidates make of a kept box (box voting, Gidaris and Komodakis 2015): the mean of its centre, extents and heading and those of
/// all candidates of its class that overlap it by an IoU above `threshold`, each by its score. Score, class and all else stay its own.
///
/// Headings count up to half a turn, as detectors mistake front and rear; who stands across has no vote.
pub(crate) fn vote<'a>(
    kept: (&Box3, &Footprint),
    candidates: impl Iterator<Item = (&'a Box3, &'a Footprint)>,
    threshold: f64,
) -> Box3 {
    let (own, footprint) = kept;
    let (mut sum, mut weights) = ([0.0; 7], 0.0);
    for (other, candidate) in candidates {
        // Most are far away, which their hulls tell.
        if !iou_exceeds(footprint, candidate, threshold) || other.class != own.class {
            continue;
        }
        let turn = (other.yaw - own.yaw) - PI * ((other.yaw - own.yaw) / PI).round();
        if turn.abs() > FRAC_PI_4 {
            continue;
        }
        // Relative to the kept box, so that what all agree on stays as it is.
        let off = [
            other.center[0] - own.center[0],
            other.center[1] - own.center[1],
            other.center[2] - own.center[2],
            other.length - own.length,
            other.width - own.width,
            other.height - own.height,
            turn,
        ];
        let weight = f64::from(other.score);
        weights += weight;
        for (sum, off) in sum.iter_mut().zip(off) {
            *sum += weight * off;
        }
    }
    // Without scores nobody has a say.
    let [x, y, z, length, width, height, turn] = sum.map(|sum| if weights > 0.0 { sum / weights } else { 0.0 });
    let voted = Box3 {
        center: [own.center[0] + x, own.center[1] + y, own.center[2] + z],
        length: own.length + length,
        width: own.width + width,
        height: own.height + height,
        yaw: if turn == 0.0 {
            own.yaw
        } else {
            normalize_yaw(own.yaw + turn)
        },
        ..own.clone()
    };
    // Heights may be as far apart as numbers go.
    if is_valid(&voted) { voted } else { own.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car(x: f64, yaw: f64, score: f32) -> Box3 {
        Box3 {
            center: [x, 0.0, 0.8],
            length: 4.5,
            width: 1.9,
            height: 1.6,
            yaw,
            velocity: None,
            class: "Car".into(),
            score,
            track: None,
            covariance: None,
        }
    }

    fn voted(own: &Box3, others: &[Box3]) -> Box3 {
        let all: Vec<Box3> = std::iter::once(own).chain(others).cloned().collect();
        let footprints: Vec<Footprint> = all.iter().map(Footprint::of).collect();
        vote((own, &footprints[0]), all.iter().zip(&footprints), 0.3)
    }

    #[test]
    fn a_vote_weighs_as_much_as_its_score() {
        let own = car(0.0, 0.1, 0.9);
        let longer = Box3 {
            length: 4.9,
            ..car(0.8, 0.1 + PI + 0.2, 0.3)
        };
        let found = voted(&own, &[longer]);
        let expected = [0.2, 4.6, 0.15];
        for (found, expected) in [found.center[0], found.length, found.yaw].into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found}, not {expected}");
        }
        assert_eq!((found.score, found.width), (0.9, 1.9));
    }

    #[test]
    fn who_is_far_or_across_or_of_another_class_has_no_vote() {
        let own = car(0.0, 0.1, 0.9);
        let van = Box3 {
            class: "Van".into(),
            ..car(0.5, 0.1, 0.9)
        };
        let others = [car(3.0, 0.1, 0.8), car(0.2, 0.1 + FRAC_PI_4 + 0.01, 0.8), van];
        assert_eq!(voted(&own, &others), own);
        assert_eq!(voted(&own, &[]), own);
        let [high, deep] = [1.7e308, -1.7e308].map(|z| Box3 {
            center: [0.0, 0.0, z],
            ..own.clone()
        });
        assert_eq!(voted(&high, &[deep]), high);
        let unsure = car(0.0, 0.1, 0.0);
        assert_eq!(voted(&unsure, &[]), unsure);
    }
}
