use realo_schemas::geometry::is_valid;
use realo_schemas::{Box3, GroundTruth, Name, OwnLabels};

/// How the truth of a sweep that was recorded differs from that of the log that is said to have been played.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TruthMismatch {
    /// Another number of objects, or scored in one of them only.
    #[error(
        "{} objects ({}) in the recording, {} ({}) in the log", .found.0, scored(.found.1), .expected.0, scored(.expected.1)
    )]
    Frame {
        /// Objects of the recording, and whether its sweep is scored.
        found: (usize, bool),
        /// The same of the log.
        expected: (usize, bool),
    },
    /// Another object.
    #[error(
        "object {index} differs: a `{}` at {:.2?} m in the recording, a `{}` at {:.2?} m in the log",
        .found.0, .found.1, .expected.0, .expected.1
    )]
    Object {
        /// Its number in the sweep.
        index: usize,
        /// Class and centre in the recording.
        found: (Name, [f64; 3]),
        /// The same in the log.
        expected: (Name, [f64; 3]),
    },
}

fn scored(key: bool) -> &'static str {
    if key { "scored" } else { "not scored" }
}

/// Whether two truths of a sweep are of one log: the same objects, and the ego's points on them.
///
/// The others' points are not asked for: they depend on who took part.
///
/// # Errors
/// [`TruthMismatch`] says what differs first.
pub fn same_truth(recorded: &GroundTruth, logged: &GroundTruth) -> Result<(), TruthMismatch> {
    let [found, expected] = [recorded, logged].map(|truth| (truth.boxes.len(), truth.key));
    if found != expected {
        return Err(TruthMismatch::Frame { found, expected });
    }
    let same = |index: &usize| {
        same_box(&recorded.boxes[*index], &logged.boxes[*index])
            && recorded.points_of_ego(*index) == logged.points_of_ego(*index)
    };
    if let Some(index) = (0..expected.0).find(|index| !same(index)) {
        return Err(differing(index, &recorded.boxes[index], &logged.boxes[index]));
    }
    match (&recorded.own, &logged.own) {
        (Some(recorded), Some(logged)) => same_labels(recorded, logged),
        // Recordings did not always keep them.
        _ => Ok(()),
    }
}

fn same_labels(recorded: &OwnLabels, logged: &OwnLabels) -> Result<(), TruthMismatch> {
    let [found, expected] = [recorded, logged].map(|own| (own.boxes.len(), own.key));
    if found != expected {
        return Err(TruthMismatch::Frame { found, expected });
    }
    let mut pairs = recorded.boxes.iter().zip(&logged.boxes).enumerate();
    match pairs.find(|(_, (one, other))| !same_box(one, other)) {
        Some((index, (one, other))) => Err(differing(index, one, other)),
        None => Ok(()),
    }
}

fn differing(index: usize, found: &Box3, expected: &Box3) -> TruthMismatch {
    let [found, expected] = [found, expected].map(|object| (object.class.clone(), object.center));
    TruthMismatch::Object { index, found, expected }
}

/// Boxes that no protocol counts, such as those with NaN, cannot be compared.
fn same_box(a: &Box3, b: &Box3) -> bool {
    a == b || !(is_valid(a) || is_valid(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn truth(x: f64, points: [u32; 2]) -> GroundTruth {
        let object = Box3::new("Car", [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0);
        GroundTruth {
            boxes: vec![object],
            agents: vec!["cav1".into(), "rsu1".into()],
            points: points.to_vec(),
            ego_footprint: None,
            key: true,
            ..GroundTruth::default()
        }
    }

    #[test]
    fn who_took_part_does_not_matter() {
        let one = truth(1.0, [9, 5]);
        assert_eq!(same_truth(&one, &truth(1.0, [9, 7])), Ok(()));
        let alone = GroundTruth {
            agents: vec!["cav1".into()],
            points: vec![9],
            ..one.clone()
        };
        assert_eq!(same_truth(&alone, &one), Ok(()));
        let nowhere = truth(f64::NAN, [9, 5]);
        assert_eq!(same_truth(&nowhere, &nowhere), Ok(()));
    }

    #[test]
    fn what_differs_is_named() {
        let one = truth(1.0, [9, 5]);
        let error = |other: &GroundTruth| same_truth(&one, other).unwrap_err().to_string();
        let empty = GroundTruth {
            boxes: Vec::new(),
            ..one.clone()
        };
        assert_eq!(
            error(&empty),
            "1 objects (scored) in the recording, 0 (scored) in the log"
        );
        let unscored = GroundTruth {
            key: false,
            ..one.clone()
        };
        assert_eq!(
            error(&unscored),
            "1 objects (scored) in the recording, 1 (not scored) in the log"
        );
        let moved = error(&truth(1.5, [9, 5]));
        assert!(
            moved.contains("object 0") && moved.contains("[1.50, 0.00, 0.80] m in the log"),
            "{moved}"
        );
        assert!(error(&truth(1.0, [8, 5])).contains("object 0"));
        // What the ego's own side labelled is compared where both have it.
        let labelled = |x: f64| GroundTruth {
            own: Some(Box::new(OwnLabels {
                boxes: truth(x, [9, 5]).boxes,
                ..OwnLabels::default()
            })),
            ..one.clone()
        };
        assert_eq!(same_truth(&one, &labelled(2.0)), Ok(()));
        let error_of = same_truth(&labelled(1.0), &labelled(2.0)).unwrap_err().to_string();
        assert!(
            error_of.contains("object 0") && error_of.contains("[2.00"),
            "{error_of}"
        );
        // One that counts is not the same as one that does not.
        assert!(error(&truth(f64::NAN, [9, 5])).contains("object 0"));
    }
}
