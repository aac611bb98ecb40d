use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::Protocol;
use crate::sequence::Sequence;

/// Values by super-class and IoU.
pub type Table<T> = BTreeMap<String, BTreeMap<String, T>>;

/// The same figures in the two orders of detections.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Orders<T> {
    /// All detections of all frames by score.
    pub sorted: T,
    /// By score within a frame only, frames one after the other.
    #[serde(rename = "v2x-real")]
    pub v2x_real: T,
}

/// A value of the sequence of each class and IoU.
pub fn table<T>(protocol: &Protocol, sequences: &[Vec<Sequence>], value: impl Fn(&Sequence) -> T) -> Table<T> {
    let per_iou = |sequences: &Vec<Sequence>| {
        protocol
            .ious
            .iter()
            .zip(sequences)
            .map(|(iou, sequence)| (Protocol::iou_key(*iou), value(sequence)))
            .collect()
    };
    let classes = protocol.classes.iter().zip(sequences);
    classes
        .map(|(class, sequences)| (class.name.clone(), per_iou(sequences)))
        .collect()
}

/// The mean, `None` if a value is missing.
pub fn mean_of(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let count = values.len() as f64;
    values.sum::<Option<f64>>().map(|sum| sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_misses_no_value() {
        assert_eq!(mean_of([Some(0.25), Some(0.75), Some(0.5)].into_iter()), Some(0.5));
        assert_eq!(mean_of([Some(0.5), None].into_iter()), None);
    }
}
