use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_core::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};

use crate::sequence::{Entry, Order, Sequence, logs};
use crate::table::{Orders, Table, mean_of, table};
use crate::{Evaluation, Protocol, average_precision};

/// Samples of the logs.
const SAMPLES: usize = 1000;
const SEED: u64 = 0x0052_6561_6c6f;

/// 95 % intervals of the accuracies, by drawing as many logs as there are, with replacement, 1,000 times.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intervals {
    /// Of `accuracy`.
    pub accuracy: Orders<Bounds>,
    /// Of `accuracy_seen`.
    pub accuracy_seen: Orders<Bounds>,
}

/// The 2.5 and 97.5 % quantiles over the samples in which the value is defined; `None` where it never is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Of average precision.
    #[serde(rename = "AP")]
    pub ap: Table<Option<[f64; 2]>>,
    /// Of its mean over classes.
    #[serde(rename = "mAP")]
    pub mean_ap: BTreeMap<String, Option<[f64; 2]>>,
}

/// The intervals of two scopes; `None` with fewer than two logs.
pub(crate) fn intervals(evaluation: &Evaluation, all: &[Vec<Sequence>], seen: &[Vec<Sequence>]) -> Option<Intervals> {
    let logs = logs(evaluation).len();
    let draws = (logs >= 2).then(|| draws(logs))?;
    let orders = |sequences: &[Vec<Sequence>]| Orders {
        sorted: bounds(&evaluation.protocol, sequences, Order::Sorted, &draws),
        v2x_real: bounds(&evaluation.protocol, sequences, Order::V2xReal, &draws),
    };
    Some(Intervals {
        accuracy: orders(all),
        accuracy_seen: orders(seen),
    })
}

/// The logs of each sample.
fn draws(logs: usize) -> Vec<Vec<usize>> {
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut one = || ((u128::from(random.next_u64()) * logs as u128) >> 64) as usize;
    (0..SAMPLES).map(|_| (0..logs).map(|_| one()).collect()).collect()
}

fn bounds(protocol: &Protocol, sequences: &[Vec<Sequence>], order: Order, draws: &[Vec<usize>]) -> Bounds {
    let samples: Table<Vec<Option<f64>>> = table(protocol, sequences, |sequence| resampled(sequence, order, draws));
    let mean = |iou: &f64| {
        let key = Protocol::iou_key(*iou);
        let sample = |i: usize| mean_of(protocol.classes.iter().map(|class| samples[&class.name][&key][i]));
        let bounds = quantiles((0..draws.len()).map(sample).collect());
        (key, bounds)
    };
    let mean_ap = protocol.ious.iter().map(mean).collect();
    let per_iou = |values: BTreeMap<String, Vec<Option<f64>>>| {
        values
            .into_iter()
            .map(|(iou, values)| (iou, quantiles(values)))
            .collect()
    };
    Bounds {
        mean_ap,
        ap: samples
            .into_iter()
            .map(|(class, values)| (class, per_iou(values)))
            .collect(),
    }
}

/// The average precision of each sample.
fn resampled(sequence: &Sequence, order: Order, draws: &[Vec<usize>]) -> Vec<Option<f64>> {
    let entries = sequence.ordered(order);
    let mut per_log: Vec<Vec<Entry>> = vec![Vec::new(); sequence.totals.len()];
    for entry in &entries {
        per_log[entry.log].push(*entry);
    }
    let mut hits = Vec::with_capacity(2 * entries.len());
    let mut sample = |drawn: &Vec<usize>| {
        hits.clear();
        match order {
            Order::Sorted => {
                let mut times = vec![0; per_log.len()];
                drawn.iter().for_each(|log| times[*log] += 1);
                for entry in &entries {
                    hits.extend(std::iter::repeat_n(entry.hit, times[entry.log]));
                }
            }
            Order::V2xReal => hits.extend(drawn.iter().flat_map(|log| &per_log[*log]).map(|entry| entry.hit)),
        }
        average_precision(&hits, drawn.iter().map(|log| sequence.totals[*log]).sum())
    };
    draws.iter().map(&mut sample).collect()
}

fn quantiles(samples: Vec<Option<f64>>) -> Option<[f64; 2]> {
    let mut values: Vec<f64> = samples.into_iter().flatten().collect();
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)? as f64;
    Some([0.025, 0.975].map(|share| {
        let at = share * last;
        let (low, high) = (values[at.floor() as usize], values[at.ceil() as usize]);
        low + (high - low) * at.fract()
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_lie_between_samples() {
        assert_eq!(quantiles(vec![None, None]), None);
        assert_eq!(quantiles(vec![Some(0.5), None]), Some([0.5, 0.5]));
        let [low, high] = quantiles((0..=1000).rev().map(|i| Some(f64::from(i))).collect()).unwrap();
        assert!((low - 25.0).abs() < 1e-9 && (high - 975.0).abs() < 1e-9, "{low} {high}");
        let [low, high] = quantiles(vec![Some(3.0), Some(1.0)]).unwrap();
        assert!((low - 1.05).abs() < 1e-9 && (high - 2.95).abs() < 1e-9, "{low} {high}");
    }

    #[test]
    fn draws_are_the_same_each_time_and_reach_every_log() {
        let drawn = draws(7);
        assert_eq!(drawn, draws(7));
        assert!((0..7).all(|log| drawn.iter().flatten().any(|d| *d == log)));
        assert!(drawn.iter().flatten().all(|log| *log < 7));
    }
}
