use realo_schemas::geometry::{Footprint, iou};

use crate::{Frame, Protocol};

/// Which objects count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// All objects of the mode; where the protocol ignores what is in no view, those that are in one.
    All,
    /// Those on which the ego alone has enough points; the others are ignored: finding one is neither true nor false.
    Seen,
}

/// What became of a detection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It found the object of this index in its frame.
    True(usize),
    /// It found no object.
    False,
    /// It found an ignored object, or none where none could be labelled.
    Ignored,
}

/// The IoUs of one class of one frame.
pub(crate) struct Overlaps {
    /// Indices of the class's detections, best score first; equal scores keep their order.
    pub detections: Vec<usize>,
    /// Indices of the class's objects.
    pub truths: Vec<usize>,
    /// `[detections, truths]`, row-major.
    ious: Vec<f64>,
}

impl Overlaps {
    pub fn new(frame: &Frame, class: u8) -> Self {
        let mut detections: Vec<usize> = (0..frame.detections.len())
            .filter(|i| frame.detections[*i].class == class)
            .collect();
        detections.sort_by(|a, b| frame.detections[*b].score.total_cmp(&frame.detections[*a].score));
        let truths: Vec<usize> = (0..frame.truths.len())
            .filter(|i| frame.truths[*i].class == class)
            .collect();
        let objects: Vec<Footprint> = truths.iter().map(|i| frame.truths[*i].outline.footprint()).collect();
        let mut ious = Vec::with_capacity(detections.len() * truths.len());
        for detection in &detections {
            let footprint = frame.detections[*detection].outline.footprint();
            ious.extend(objects.iter().map(|object| iou(&footprint, object)));
        }
        Overlaps {
            detections,
            truths,
            ious,
        }
    }

    /// Best score first, each detection takes the unused object of largest IoU; it is true if that reaches the
    /// threshold. Where objects are ignored, one that counts goes before one that does not. A detection that found nothing
    /// and is in no view is ignored too.
    pub fn matched(&self, frame: &Frame, threshold: f64, scope: Scope, protocol: &Protocol) -> Vec<Outcome> {
        let counts = |truth: usize| scope.counts(frame, truth, protocol);
        let mut used = vec![false; self.truths.len()];
        let best = |row: &[f64], used: &[bool], counted: bool| {
            let free = (0..row.len()).filter(|t| !used[*t] && counts(self.truths[*t]) == counted);
            // The first of equals, as `max_by` would give the last.
            free.fold(None, |best: Option<usize>, t| {
                if best.is_none_or(|b| row[t] > row[b]) {
                    Some(t)
                } else {
                    best
                }
            })
            .filter(|t| row[*t] >= threshold)
        };
        (0..self.detections.len())
            .map(|d| {
                let row = &self.ious[d * self.truths.len()..(d + 1) * self.truths.len()];
                let found = best(row, &used, true);
                match found.or_else(|| best(row, &used, false)) {
                    None if frame.in_no_view.detections.binary_search(&self.detections[d]).is_ok() => Outcome::Ignored,
                    None => Outcome::False,
                    Some(t) => {
                        used[t] = true;
                        if found.is_some() {
                            Outcome::True(self.truths[t])
                        } else {
                            Outcome::Ignored
                        }
                    }
                }
            })
            .collect()
    }
}

impl Scope {
    /// Whether an object of a frame counts.
    pub(crate) fn counts(self, frame: &Frame, truth: usize, protocol: &Protocol) -> bool {
        let seen = |[_, ego]: [u64; 2]| ego >= protocol.seen_points;
        let taken = match self {
            Scope::All => true,
            Scope::Seen => frame.truths[truth].points.is_some_and(seen),
        };
        taken && frame.in_no_view.truths.binary_search(&truth).is_err()
    }
}

/// What became of each detection of a class in a frame, best score first: (index of the detection, outcome).
pub fn match_frame(frame: &Frame, protocol: &Protocol, class: u8, iou: f64, scope: Scope) -> Vec<(usize, Outcome)> {
    let overlaps = Overlaps::new(frame, class);
    let outcomes = overlaps.matched(frame, iou, scope, protocol);
    overlaps.detections.into_iter().zip(outcomes).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Detection, InNoView, Outline, Truth};

    fn square(x: f64) -> Outline {
        Outline::new([x, 0.0], 2.0, 2.0, 0.0)
    }

    fn frame(detections: &[(f64, f32)], truths: &[(f64, Option<u64>)]) -> Frame {
        let detection = |(x, score): &(f64, f32)| Detection {
            class: 0,
            score: *score,
            outline: square(*x),
        };
        let truth = |(x, ego): &(f64, Option<u64>)| Truth {
            class: 0,
            outline: square(*x),
            points: ego.map(|n| [n + 5, n]),
        };
        Frame {
            key: true,
            processed: true,
            detections: detections.iter().map(detection).collect(),
            truths: truths.iter().map(truth).collect(),
            ..Frame::default()
        }
    }

    fn outcomes(frame: &Frame, scope: Scope) -> Vec<(usize, Outcome)> {
        match_frame(frame, &Protocol::load("default").unwrap(), 0, 0.5, scope)
    }

    #[test]
    fn the_better_score_takes_the_object_and_the_duplicate_is_false() {
        let frame = frame(&[(0.1, 0.5), (0.2, 0.9), (20.0, 0.7)], &[(0.0, None)]);
        assert_eq!(
            outcomes(&frame, Scope::All),
            [(1, Outcome::True(0)), (2, Outcome::False), (0, Outcome::False)]
        );
    }

    #[test]
    fn each_takes_the_unused_object_of_largest_overlap() {
        let frame = frame(&[(0.2, 0.9), (0.2, 0.9)], &[(-0.1, None), (0.3, None)]);
        assert_eq!(
            outcomes(&frame, Scope::All),
            [(0, Outcome::True(1)), (1, Outcome::True(0))]
        );
    }

    #[test]
    fn a_failed_match_leaves_the_object_free() {
        let frame = frame(&[(1.9, 0.9), (0.1, 0.1)], &[(0.0, None)]);
        assert_eq!(
            outcomes(&frame, Scope::All),
            [(0, Outcome::False), (1, Outcome::True(0))]
        );
    }

    #[test]
    fn finding_what_the_ego_does_not_see_is_neither_true_nor_false() {
        let frame = frame(
            &[(0.0, 0.9), (10.0, 0.8), (30.0, 0.7), (10.1, 0.6)],
            &[(0.0, Some(10)), (10.0, Some(9))],
        );
        assert_eq!(
            outcomes(&frame, Scope::Seen),
            [
                (0, Outcome::True(0)),
                (1, Outcome::Ignored),
                (2, Outcome::False),
                (3, Outcome::False)
            ]
        );
    }

    #[test]
    fn an_object_that_counts_goes_before_one_that_is_ignored() {
        let frame = frame(&[(0.3, 0.9)], &[(0.2, Some(0)), (0.0, Some(50))]);
        assert_eq!(outcomes(&frame, Scope::Seen), [(0, Outcome::True(1))]);
        assert_eq!(outcomes(&frame, Scope::All), [(0, Outcome::True(0))]);
    }

    #[test]
    fn what_no_view_shows_is_neither_missed_nor_found_and_what_finds_nothing_there_is_not_false() {
        let mut frame = frame(
            &[(0.0, 0.9), (10.0, 0.8), (20.0, 0.7), (30.0, 0.6), (40.0, 0.5)],
            &[(0.0, None), (10.0, None), (20.0, None)],
        );
        frame.in_no_view = InNoView {
            detections: vec![2, 4],
            truths: vec![1],
        };
        // The third is in no view itself, but what it found was labelled.
        assert_eq!(
            outcomes(&frame, Scope::All),
            [
                (0, Outcome::True(0)),
                (1, Outcome::Ignored),
                (2, Outcome::True(2)),
                (3, Outcome::False),
                (4, Outcome::Ignored)
            ]
        );
        // One that is labelled goes before one that could not be.
        frame.truths[1].outline = square(0.0);
        frame.truths[0].outline = square(0.3);
        assert_eq!(outcomes(&frame, Scope::All)[0], (0, Outcome::True(0)));
    }

    #[test]
    fn of_equal_overlaps_the_first_object_is_taken() {
        let frame = frame(&[(0.0, 0.9)], &[(0.25, None), (-0.25, None)]);
        assert_eq!(outcomes(&frame, Scope::All), [(0, Outcome::True(0))]);
    }

    #[test]
    fn classes_do_not_meet() {
        let mut frame = frame(&[(0.0, 0.9)], &[(0.0, None)]);
        frame.truths[0].class = 1;
        assert_eq!(outcomes(&frame, Scope::All), [(0, Outcome::False)]);
    }
}
