/// All-point average precision (PASCAL VOC 2010 and later): the area under the precision envelope.
///
/// `hits`: whether each detection is true, best first; `total`: objects. `None` without objects.
pub fn average_precision(hits: &[bool], total: u64) -> Option<f64> {
    if total == 0 {
        return None;
    }
    let mut found = hits.iter().filter(|hit| **hit).count();
    let (mut envelope, mut area) = (0.0f64, 0.0);
    for (index, _) in hits.iter().enumerate().rev().filter(|(_, hit)| **hit) {
        // Between two hits precision only falls, so the envelope is set at hits.
        envelope = envelope.max(found as f64 / (index + 1) as f64);
        area += envelope;
        found -= 1;
    }
    Some(area / total as f64)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Recall and the precision envelope after each detection, between the conventional ends (0, envelope) and (1, 0).
    ///
    /// Without objects, recall is 0 throughout.
    fn curve(hits: &[bool], total: u64) -> (Vec<f64>, Vec<f64>) {
        let mut recall = vec![0.0];
        let mut precision = vec![0.0];
        let mut found = 0u64;
        for (index, hit) in hits.iter().enumerate() {
            found += u64::from(*hit);
            recall.push(if total > 0 { found as f64 / total as f64 } else { 0.0 });
            precision.push(found as f64 / (index + 1) as f64);
        }
        recall.push(1.0);
        precision.push(0.0);
        for i in (1..precision.len()).rev() {
            precision[i - 1] = precision[i - 1].max(precision[i]);
        }
        (recall, precision)
    }

    #[test]
    fn exact_cases() {
        let cases: [(&[bool], u64, Option<f64>); 8] = [
            (&[true, true], 2, Some(1.0)),
            (&[true, true], 4, Some(0.5)),
            (&[true, false, false], 2, Some(0.5)),
            (&[false, true], 1, Some(0.5)),
            (&[true, false, true], 2, Some(0.5 + 0.5 * 2.0 / 3.0)),
            (&[false, true, true], 2, Some(2.0 / 3.0)),
            (&[], 3, Some(0.0)),
            (&[false], 0, None),
        ];
        for (hits, total, expected) in cases {
            assert_eq!(average_precision(hits, total), expected, "{hits:?} {total}");
        }
    }

    proptest! {
        #[test]
        fn is_the_area_under_the_curve(hits in prop::collection::vec(any::<bool>(), 0..60), more in 0u64..20) {
            let total = hits.iter().filter(|hit| **hit).count() as u64 + more;
            let (recall, envelope) = curve(&hits, total);
            let area: f64 = (1..recall.len()).map(|i| (recall[i] - recall[i - 1]) * envelope[i]).sum();
            match average_precision(&hits, total) {
                Some(ap) => prop_assert!((ap - area).abs() < 1e-12, "{ap} {area}"),
                None => prop_assert_eq!(total, 0),
            }
        }
    }
}
