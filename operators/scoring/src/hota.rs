//! Higher order tracking accuracy (HOTA, Luiten et al. 2021) of one class of one sequence, as TrackEval's `metrics/hota.py` counts
//! it.

use realo_assignment::{Costs, MAX_SIDE, assign};

/// Thresholds of overlap: 0.05, 0.10, … 0.95.
pub const THRESHOLDS: usize = 19;

/// What rounding may take from an overlap that is as large as a threshold.
const ROUNDING: f64 = f64::EPSILON;

/// The threshold of an index.
fn threshold(index: usize) -> f64 {
    0.05 + 0.05 * index as f64
}

/// One frame of a class.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrackedFrame {
    /// Number of the identity of each object, from 0, none twice in a frame.
    pub truths: Vec<usize>,
    /// Number of the identity of each detection, from 0, none twice in a frame.
    pub detections: Vec<usize>,
    /// Overlap of each object with each detection, 0 to 1: `[truths, detections]`, row-major.
    pub overlaps: Vec<f64>,
}

/// What HOTA is made from, at one threshold; those of several sequences add up.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Pairs of object and detection.
    pub pairs: u64,
    /// Objects.
    pub objects: u64,
    /// Detections.
    pub detections: u64,
    /// Sum over the pairs of how well their identities go together over the whole sequence.
    pub association: f64,
    /// Sum of the pairs' overlaps.
    pub overlap: f64,
}

/// The tallies of a sequence by threshold.
pub type Tallies = [Tally; THRESHOLDS];

/// HOTA and its parts, means over the thresholds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Hota {
    /// √(DetA × AssA) of each threshold.
    pub hota: f64,
    /// Pairs of all objects and detections (detection accuracy).
    pub detection: f64,
    /// Association accuracy.
    pub association: f64,
    /// Mean overlap of the pairs.
    pub localization: f64,
}

impl Hota {
    /// Of tallies.
    pub fn of(tallies: &Tallies) -> Self {
        let mut mean = Hota::default();
        for tally in tallies {
            let pairs = tally.pairs as f64;
            let all = (tally.objects + tally.detections - tally.pairs) as f64;
            let detection = pairs / all.max(1.0);
            let association = tally.association / pairs.max(1.0);
            mean.detection += detection;
            mean.association += association;
            mean.hota += (detection * association).sqrt();
            // Without pairs TrackEval says 1.
            mean.localization += tally.overlap.max(1e-10) / pairs.max(1e-10);
        }
        let share = |sum: f64| sum / THRESHOLDS as f64;
        Hota {
            hota: share(mean.hota),
            detection: share(mean.detection),
            association: share(mean.association),
            localization: share(mean.localization),
        }
    }
}

/// Adds the tallies of another sequence.
pub fn add(tallies: &mut Tallies, other: &Tallies) {
    for (sum, other) in tallies.iter_mut().zip(other) {
        sum.pairs += other.pairs;
        sum.objects += other.objects;
        sum.detections += other.detections;
        sum.association += other.association;
        sum.overlap += other.overlap;
    }
}

/// The tallies of a sequence, and of each frame the pairs (place of the object, place of the detection) at any overlap.
///
/// Identities are paired over the whole sequence first: two that overlap much and often go together in each frame, and in a
/// frame the sum of (their going together × their overlap) is the largest. Of more than [`MAX_SIDE`] objects or detections in
/// a frame the first take part.
pub fn tallies(frames: &[TrackedFrame]) -> (Tallies, Vec<Vec<(usize, usize)>>) {
    let together = Together::of(frames);
    let mut tallies = [Tally::default(); THRESHOLDS];
    let mut matches: Vec<Pairs> = vec![Pairs::new(); THRESHOLDS];
    let mut of_frames = Vec::with_capacity(frames.len());
    for frame in frames {
        let pairs = together.pairs(frame);
        for (index, (tally, matches)) in tallies.iter_mut().zip(&mut matches).enumerate() {
            tally.objects += frame.truths.len() as u64;
            tally.detections += frame.detections.len() as u64;
            for (truth, detection) in &pairs {
                let overlap = frame.overlap(*truth, *detection);
                if overlap >= threshold(index) - ROUNDING {
                    tally.pairs += 1;
                    tally.overlap += overlap;
                    *matches
                        .entry((frame.truths[*truth], frame.detections[*detection]))
                        .or_default() += 1.0;
                }
            }
        }
        of_frames.push(pairs);
    }
    for (tally, matches) in tallies.iter_mut().zip(&matches) {
        tally.association = matches
            .iter()
            .map(|(pair, count)| count * together.share(*pair, *count))
            .sum();
    }
    (tallies, of_frames)
}

/// A number for each pair of identities that meet.
type Pairs = std::collections::BTreeMap<(usize, usize), f64>;

/// How well identities go together over a sequence.
struct Together {
    /// Frames of each object, and of each detected identity.
    truths: Vec<f64>,
    detections: Vec<f64>,
    /// Sum over frames of the pair's overlap, as a share of all overlaps of the two.
    pairs: Pairs,
}

impl Together {
    fn of(frames: &[TrackedFrame]) -> Self {
        let count = |of: fn(&TrackedFrame) -> &Vec<usize>| {
            let last = frames.iter().flat_map(of).max();
            let mut counts = vec![0.0; last.map_or(0, |last| last + 1)];
            frames.iter().flat_map(of).for_each(|id| counts[*id] += 1.0);
            counts
        };
        let mut pairs = Pairs::new();
        for frame in frames {
            let [rows, columns] = frame.sums();
            for (truth, id) in frame.truths.iter().enumerate() {
                for (detection, other) in frame.detections.iter().enumerate() {
                    let overlap = frame.overlap(truth, detection);
                    let all = rows[truth] + columns[detection] - overlap;
                    if all > f64::EPSILON {
                        *pairs.entry((*id, *other)).or_default() += overlap / all;
                    }
                }
            }
        }
        Together {
            truths: count(|frame| &frame.truths),
            detections: count(|frame| &frame.detections),
            pairs,
        }
    }

    /// `count` of all frames of the two identities of a pair.
    fn share(&self, (truth, detection): (usize, usize), count: f64) -> f64 {
        count / (self.truths[truth] + self.detections[detection] - count).max(1.0)
    }

    fn pairs(&self, frame: &TrackedFrame) -> Vec<(usize, usize)> {
        let gain = |truth: usize, detection: usize| {
            let pair = (frame.truths[truth], frame.detections[detection]);
            let met = self.pairs.get(&pair).copied().unwrap_or(0.0);
            let all = self.truths[pair.0] + self.detections[pair.1] - met;
            met / all * frame.overlap(truth, detection)
        };
        let [rows, columns] = [&frame.truths, &frame.detections].map(|ids| ids.len().min(MAX_SIDE));
        // The sides are within bounds and every gain is a number, which is all that an assignment asks for.
        let costs = Costs::of(rows, columns, |truth, detection| -gain(truth, detection));
        costs
            .and_then(|costs| assign(&costs, f64::INFINITY))
            .unwrap_or_default()
    }
}

impl TrackedFrame {
    fn overlap(&self, truth: usize, detection: usize) -> f64 {
        self.overlaps[truth * self.detections.len() + detection]
    }

    /// Sums of overlaps of each object and of each detection.
    fn sums(&self) -> [Vec<f64>; 2] {
        let [mut rows, mut columns] = [vec![0.0; self.truths.len()], vec![0.0; self.detections.len()]];
        for (truth, row) in rows.iter_mut().enumerate() {
            for (detection, column) in columns.iter_mut().enumerate() {
                *row += self.overlap(truth, detection);
                *column += self.overlap(truth, detection);
            }
        }
        [rows, columns]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(truths: &[usize], detections: &[usize], overlaps: &[f64]) -> TrackedFrame {
        TrackedFrame {
            truths: truths.into(),
            detections: detections.into(),
            overlaps: overlaps.into(),
        }
    }

    fn hota(frames: &[TrackedFrame]) -> Hota {
        Hota::of(&tallies(frames).0)
    }

    fn near(found: Hota, hota: f64, detection: f64, association: f64, localization: f64) {
        let found = [found.hota, found.detection, found.association, found.localization];
        let expected = [hota, detection, association, localization];
        let apart = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-12, "{found:?} for {expected:?}");
    }

    #[test]
    fn all_found_under_one_identity_is_one() {
        let frames = vec![frame(&[0, 1], &[1, 0], &[0.0, 1.0, 1.0, 0.0]); 5];
        near(hota(&frames), 1.0, 1.0, 1.0, 1.0);
    }

    /// By hand: one object in four frames, found in all with an overlap of 0.72, first as 0, then three times as 1. So 14 of 19
    /// thresholds have all pairs. There DetA is 1; a pair of identity 0 has 1 / (4 + 1 - 1), one of 1 has 3 / (4 + 3 - 3); so
    /// AssA = (1 × 1/4 + 3 × 3/4) / 4 = 0.625. The other 5 have no pair, and TrackEval's LocA of those is 1.
    #[test]
    fn a_changed_identity_costs_association() {
        let frames: Vec<_> = [0, 1, 1, 1].map(|id| frame(&[0], &[id], &[0.72])).into();
        let share = 14.0 / 19.0;
        near(
            hota(&frames),
            0.625f64.sqrt() * share,
            share,
            0.625 * share,
            0.72 * share + 5.0 / 19.0,
        );
    }

    /// By hand: two objects in two frames; object 1 is missed once, and there is a false detection of an identity of its own. At
    /// each threshold 3 pairs, 4 objects, 4 detections: DetA = 3 / 5. AssA: object 0 has 2 × 2/2, object 1 has 1 × 1 / (2 + 1 - 1).
    #[test]
    fn what_is_missed_and_what_is_false_cost_detection() {
        let frames = [
            frame(&[0, 1], &[5, 6], &[1.0, 0.0, 0.0, 1.0]),
            frame(&[0, 1], &[5, 7], &[1.0, 0.0, 0.0, 0.0]),
        ];
        let association = (2.0 + 0.5) / 3.0;
        near(hota(&frames), (0.6f64 * association).sqrt(), 0.6, association, 1.0);
    }

    #[test]
    fn identities_that_go_together_longest_are_paired_where_overlaps_are_alike() {
        // In the second frame detection 1 overlaps object 0 a little more than its own detection 0 does.
        let mut frames = vec![frame(&[0], &[0], &[0.9]); 9];
        frames.insert(1, frame(&[0], &[0, 1], &[0.8, 0.81]));
        let (tallies, pairs) = tallies(&frames);
        assert_eq!(pairs[1], [(0, 0)]);
        assert_eq!((tallies[0].pairs, tallies[0].detections), (10, 11));
    }

    #[test]
    fn sequences_add_up_and_nothing_is_no_division_by_nothing() {
        let frames = [frame(&[0], &[0], &[1.0]), frame(&[], &[0], &[]), frame(&[0], &[], &[])];
        let (one, _) = tallies(&frames);
        let mut both = one;
        add(&mut both, &one);
        assert_eq!((both[3].pairs, both[3].objects, both[3].detections), (2, 4, 4));
        assert_eq!(Hota::of(&both), Hota::of(&one));
        let nothing = hota(&[]);
        assert_eq!((nothing.hota, nothing.detection), (0.0, 0.0));
    }
}
