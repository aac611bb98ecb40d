use realo_schemas::geometry::{Footprint, iou_exceeds};
use serde::{Deserialize, Serialize};

use crate::{grid, rtree};

/// How boxes near a candidate are found; each gives the same result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Index {
    /// Uniform grid of the kept boxes: the fastest.
    #[default]
    Grid,
    /// R-tree of all boxes, bulk-loaded.
    Rtree,
    /// All kept boxes, one after the other.
    Brute,
}

/// Which of several boxes of one score goes first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Ties {
    /// The one that came first.
    #[default]
    First,
    /// The one that came last, as in V2X-Real.
    Last,
}

/// Indices of scores, largest first; NaN has no place among them and must not occur.
pub fn order(scores: &[f32], ties: Ties) -> Vec<u32> {
    // One number each, whose order is that of (score descending, index): sorts several times as fast as pairs.
    let flip = match ties {
        Ties::First => 0,
        Ties::Last => u32::MAX,
    };
    let key = |(score, index): (&f32, u32)| u64::from(descending(*score)) << 32 | u64::from(index ^ flip);
    let mut keys: Vec<u64> = scores.iter().zip(0u32..).map(key).collect();
    keys.sort_unstable();
    keys.into_iter().map(|key| key as u32 ^ flip).collect()
}

/// A number that is the smaller the greater the score, in the order of `f32::total_cmp`.
fn descending(score: f32) -> u32 {
    let bits = score.to_bits();
    if bits >> 31 == 0 { !(bits | 1 << 31) } else { bits }
}

/// Greedy suppression: goes through `order` and keeps a footprint unless one that it kept before overlaps it by an IoU
/// above `threshold`. Returns the kept indices in order.
///
/// Footprints without area, or with numbers that are not finite, overlap nothing and are kept.
pub fn suppress(footprints: &[Footprint], order: &[u32], threshold: f64, index: Index) -> Vec<u32> {
    match index {
        Index::Grid => grid::suppress(footprints, order, threshold),
        Index::Rtree => rtree::suppress(footprints, order, threshold),
        Index::Brute => brute(footprints, order, threshold),
    }
}

fn brute(footprints: &[Footprint], order: &[u32], threshold: f64) -> Vec<u32> {
    let mut kept: Vec<u32> = Vec::new();
    for &candidate in order {
        let object = &footprints[candidate as usize];
        // The kept one first: the last bits of an IoU depend on the order.
        if !kept
            .iter()
            .any(|k| iou_exceeds(&footprints[*k as usize], object, threshold))
        {
            kept.push(candidate);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Debug)]
    struct Scene {
        footprints: Vec<Footprint>,
        scores: Vec<f32>,
    }

    /// Boxes of all sizes around some centres; `spread` 0 puts all on one spot.
    fn scene(heaps: usize, spread: f64, offset: f64) -> impl Strategy<Value = Scene> {
        let centers = prop::collection::vec((-100.0..100.0f64, -40.0..40.0f64), heaps);
        let length = prop_oneof![8 => 3.0..6.0f64, 1 => 0.3..1.0f64, 1 => 9.0..18.0f64];
        let score = prop_oneof![0.0..=1.0f32, (0..=10u8).prop_map(|tenths| f32::from(tenths) / 10.0)];
        let object = (
            0..heaps,
            -1.0..1.0f64,
            -1.0..1.0f64,
            length,
            0.3..3.0f64,
            -4.0..4.0f64,
            score,
        );
        (centers, prop::collection::vec(object, 0..120)).prop_map(move |(centers, objects)| {
            let footprint = |(heap, dx, dy, length, width, yaw, _): &(usize, f64, f64, f64, f64, f64, f32)| {
                let center = [
                    centers[*heap].0 + dx * spread + offset,
                    centers[*heap].1 + dy * spread - offset,
                ];
                Footprint::new(center, *length, *width, *yaw)
            };
            Scene {
                footprints: objects.iter().map(footprint).collect(),
                scores: objects.iter().map(|o| o.6).collect(),
            }
        })
    }

    fn any_scene() -> impl Strategy<Value = Scene> {
        prop_oneof![
            scene(40, 30.0, 0.0),
            scene(5, 1.5, 0.0),
            scene(1, 0.0, 0.0),
            scene(1, 0.3, 0.0),
            scene(8, 4.0, 1e6),
            // A few boxes far from the others must not blow up the grid.
            scene(6, 1e7, 0.0),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1500))]

        #[test]
        fn every_index_keeps_the_same_boxes(
            scene in any_scene(),
            threshold in prop_oneof![Just(0.0), Just(0.15), Just(1.0), 0.0..0.9f64],
            ties in prop_oneof![Just(Ties::First), Just(Ties::Last)],
        ) {
            let order = order(&scene.scores, ties);
            let expected = suppress(&scene.footprints, &order, threshold, Index::Brute);
            prop_assert_eq!(&suppress(&scene.footprints, &order, threshold, Index::Grid), &expected);
            prop_assert_eq!(&suppress(&scene.footprints, &order, threshold, Index::Rtree), &expected);
        }
    }

    proptest! {
        #[test]
        fn who_overlaps_a_box_is_among_its_neighbours(scene in any_scene()) {
            let order = order(&scene.scores, Ties::First);
            let neighbours = grid::Neighbours::new(&scene.footprints, &order);
            for index in 0..scene.footprints.len() as u32 {
                let near = neighbours.of(index);
                let overlaps = |other: &u32| {
                    let [one, other] = [index, *other].map(|i| &scene.footprints[i as usize]);
                    iou_exceeds(one, other, 0.0)
                };
                let overlapping = order.iter().filter(|other| overlaps(other));
                prop_assert!(near.iter().filter(|other| overlaps(other)).eq(overlapping), "each once, in the order");
                prop_assert!(near.contains(&index));
            }
        }
    }

    proptest! {
        #[test]
        fn orders_by_score_then_index(scores in prop::collection::vec(prop_oneof![-2.0..2.0f32, Just(0.0), Just(-0.0), Just(0.5)], 0..50)) {
            let mut expected: Vec<u32> = (0..scores.len() as u32).collect();
            expected.sort_by(|a, b| scores[*b as usize].total_cmp(&scores[*a as usize]));
            prop_assert_eq!(order(&scores, Ties::First), expected);
        }
    }

    #[test]
    fn equal_scores_keep_their_order() {
        let scores = [0.5, 0.9, 0.5, 0.9, 0.1];
        assert_eq!(order(&scores, Ties::First), [1, 3, 0, 2, 4]);
        assert_eq!(order(&scores, Ties::Last), [3, 1, 2, 0, 4]);
    }

    #[test]
    fn what_has_no_area_or_is_not_a_number_is_kept_and_suppresses_nothing() {
        let footprints = [
            Footprint::new([0.0, 0.0], 0.0, 2.0, 0.0),
            Footprint::new([0.0, 0.0], 4.0, 2.0, 0.0),
            Footprint::new([0.0, f64::NAN], 4.0, 2.0, 0.0),
            Footprint::new([f64::INFINITY, 0.0], 4.0, 2.0, 0.0),
            Footprint::new([0.1, 0.0], 4.0, 2.0, 0.0),
            Footprint::new([-1e308, 1e308], 4.0, 2.0, 0.0),
        ];
        for index in [Index::Brute, Index::Grid, Index::Rtree] {
            assert_eq!(
                suppress(&footprints, &[0, 1, 2, 3, 4, 5], 0.15, index),
                [0, 1, 2, 3, 5],
                "{index:?}"
            );
            assert_eq!(suppress(&footprints, &[], 0.15, index), [0u32; 0]);
        }
        let points = [Footprint::new([7.0, 7.0], 0.0, 0.0, 0.0); 3];
        for index in [Index::Brute, Index::Grid, Index::Rtree] {
            assert_eq!(suppress(&points, &[0, 1, 2], 0.15, index), [0, 1, 2], "{index:?}");
        }
    }
}
