//! Whether what a collaborator says is used, and how much it counts.

use crate::boxes::Known;
use crate::objects::Object;

/// Why a message is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// Much of it lies where the ego sees that nothing is.
    Contradicted,
    /// Nothing of it can be confirmed, and the poses of its agent have been wrong.
    Unconfirmed,
    /// Its agent has contradicted the ego often of late.
    Distrusted,
    /// Its agent's boxes lie around the ego's, farther than two detectors differ.
    Scattered,
}

/// Boxes of a message by what the ego knows of them, each by its score.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shares {
    /// The ego has them too.
    pub paired: f64,
    /// Something stands there.
    pub something: f64,
    /// Nothing stands there.
    pub contradicted: f64,
    /// Boxes that the ego can check, and those of them where nothing stands.
    pub checked: [usize; 2],
    /// Boxes of impossible size or place; each counts as one sure box in free space.
    pub impossible: usize,
    /// How far pairs are apart.
    pub apart: Apart,
}

/// How both sides' places of one object are apart across its heading, along which it may have moved since it was seen. Counts, not squares:
/// of an honest detector too some pairs are wrong ones, and far apart.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Apart {
    /// Pairs that are apart by more than one standard deviation of what two detectors differ by.
    pub far: f64,
    /// Pairs of objects that show where they head.
    pub pairs: f64,
}

/// What a box where something stands says for its sender: walls and bushes stand, too.
const SOMETHING: f64 = 0.3;
/// So many boxes of a message speak for its sender at most.
const ENOUGH: f64 = 10.0;
/// So many boxes of impossible size or place are one odd object, which several anchors find.
const ODD: usize = 8;
/// Less than this many sure boxes in free space are mistakes.
const MISTAKES: f64 = 1.5;
/// Trust below which an agent is left out, and from which it counts in full.
const TRUST: [f64; 2] = [0.5, 0.75];
/// Share of an agent's boxes that are far from the ego's: up to the first its boxes count in full, from the second on they gain nobody
/// anything. Of errors that are normal and as large as they are taken to be it is 0.32.
const SCATTERED: [f64; 2] = [0.38, 0.55];
/// Poses that err by more are of no use without the ego's own objects, m.
const WRONG_POSE_M: f64 = 1.2;
/// Standard deviation of a place at which a box is worth less: one of a car's that is off by as much is not found any more, m.
const BLURRED_M: f64 = 0.6;

impl Shares {
    /// The shares of objects of which the ego knows this.
    pub fn of(theirs: &[Object], known: &[Known]) -> Self {
        let mut shares = Shares::default();
        for (object, known) in theirs.iter().zip(known) {
            match known {
                Known::Paired => shares.paired += object.score,
                Known::Something => shares.something += object.score,
                Known::Free => shares.contradicted += object.score,
                Known::Left | Known::Unseen => continue,
            }
            shares.checked[0] += 1;
            shares.checked[1] += usize::from(*known == Known::Free);
        }
        shares
    }

    /// The same with boxes of impossible size or place.
    pub fn with_impossible(self, boxes: usize) -> Self {
        Shares {
            contradicted: self.contradicted + (boxes.saturating_sub(ODD) as f64).min(2.0 * ENOUGH),
            impossible: boxes,
            ..self
        }
    }

    /// What speaks for the sender. It is bounded: saying much that the ego sees itself does not make up for lies.
    pub fn confirmed(&self) -> f64 {
        (self.paired + SOMETHING * self.something).min(ENOUGH)
    }

    /// Why the message is left out, if it is. `is_found`: whether enough pairs say where its sender is; `trust`, `scatter` and `pose_m`: what
    /// is known of the sender, with this message, with it, and before it.
    pub fn reason(&self, is_found: bool, trust: f64, scatter: f64, pose_m: f64) -> Option<Reason> {
        if self.contradicted > MISTAKES && self.contradicted > self.confirmed() {
            Some(Reason::Contradicted)
        } else if trust < TRUST[0] {
            Some(Reason::Distrusted)
        } else if scatter > SCATTERED[1] {
            Some(Reason::Scattered)
        } else if !is_found && pose_m > WRONG_POSE_M {
            Some(Reason::Unconfirmed)
        } else {
            None
        }
    }
}

/// What a score is multiplied by where the ego can confirm nothing, by the trust in its sender.
pub fn weigh_trust(trust: f64) -> f64 {
    let [none, full] = TRUST;
    0.1 + 0.9 * ((trust - none) / (full - none)).clamp(0.0, 1.0)
}

/// What a score is multiplied by, by the share of its agent's boxes that are far from the ego's.
pub fn weigh_scatter(share: f64) -> f64 {
    let [full, none] = SCATTERED;
    0.1 + 0.9 * ((none - share) / (none - full)).clamp(0.0, 1.0)
}

/// What a score is multiplied by, by the standard deviation of the place, m.
pub fn weigh_pose(metres: f64) -> f64 {
    libm::exp(-0.5 * metres * metres / (BLURRED_M * BLURRED_M))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shares(paired: f64, something: f64, contradicted: f64) -> Shares {
        Shares {
            paired,
            something,
            contradicted,
            ..Shares::default()
        }
    }

    #[test]
    fn messages_are_left_out_for_what_contradicts_or_cannot_be_confirmed() {
        let cases = [
            ("all confirmed", shares(8.0, 1.0, 0.5), true, 1.0, 0.2, 3.0, None),
            (
                "ghosts",
                shares(6.0, 1.0, 9.0),
                true,
                1.0,
                0.2,
                0.1,
                Some(Reason::Contradicted),
            ),
            ("one mistake", shares(0.0, 0.0, 0.9), false, 1.0, 0.2, 0.1, None),
            (
                "a liar",
                shares(5.0, 0.0, 1.0),
                true,
                0.4,
                0.2,
                0.1,
                Some(Reason::Distrusted),
            ),
            (
                "a blurred one",
                shares(9.0, 0.0, 0.0),
                true,
                1.0,
                0.6,
                0.1,
                Some(Reason::Scattered),
            ),
            (
                "out of sight, good poses",
                shares(0.0, 0.0, 0.0),
                false,
                1.0,
                0.2,
                0.4,
                None,
            ),
            (
                "out of sight, bad poses",
                shares(0.0, 0.0, 0.0),
                false,
                1.0,
                0.2,
                2.0,
                Some(Reason::Unconfirmed),
            ),
        ];
        for (name, shares, is_found, trust, scatter, pose_m, expected) in cases {
            assert_eq!(shares.reason(is_found, trust, scatter, pose_m), expected, "{name}");
        }
    }

    #[test]
    fn weights_fall_with_trust_and_error() {
        assert_eq!([weigh_trust(1.0), weigh_trust(0.75)], [1.0, 1.0]);
        assert!((weigh_trust(0.5) - 0.1).abs() < 1e-12 && weigh_trust(0.0) > 0.0);
        assert_eq!([weigh_scatter(0.0), weigh_scatter(0.35)], [1.0, 1.0]);
        assert!((weigh_scatter(0.55) - 0.1).abs() < 1e-12 && weigh_scatter(0.5) < 0.5);
        assert_eq!(weigh_pose(0.0), 1.0);
        assert!(weigh_pose(0.2) > 0.9 && weigh_pose(1.2) < 0.2);
    }
}
