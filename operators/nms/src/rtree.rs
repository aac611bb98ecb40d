use realo_schemas::geometry::{Footprint, iou_exceeds};
use rstar::{AABB, RTree, RTreeObject};

/// A footprint's hull and its place in the order.
struct Entry {
    hull: AABB<[f64; 2]>,
    rank: u32,
}

impl RTreeObject for Entry {
    type Envelope = AABB<[f64; 2]>;

    fn envelope(&self) -> Self::Envelope {
        self.hull
    }
}

fn hull(object: &Footprint) -> AABB<[f64; 2]> {
    let ([x, y], [hx, hy]) = (object.center, object.hull);
    AABB::from_corners([x - hx, y - hy], [x + hx, y + hy])
}

pub(crate) fn suppress(footprints: &[Footprint], order: &[u32], threshold: f64) -> Vec<u32> {
    // Others overlap nothing, and the tree cannot order NaN.
    let overlaps =
        |object: &Footprint| object.area > 0.0 && object.center.iter().chain(&object.hull).all(|v| v.is_finite());
    let entries = order
        .iter()
        .zip(0u32..)
        .map(|(i, rank)| (&footprints[*i as usize], rank));
    let entries = entries.filter(|(object, _)| overlaps(object));
    let tree = RTree::bulk_load(
        entries
            .map(|(object, rank)| Entry {
                hull: hull(object),
                rank,
            })
            .collect(),
    );
    let mut suppressed = vec![false; order.len()];
    let mut kept = Vec::with_capacity(order.len());
    for (rank, &index) in order.iter().enumerate() {
        if suppressed[rank] {
            continue;
        }
        kept.push(index);
        let object = &footprints[index as usize];
        if !overlaps(object) {
            continue;
        }
        for other in tree.locate_in_envelope_intersecting(hull(object)) {
            let later = other.rank as usize;
            if later > rank && !suppressed[later] {
                suppressed[later] = iou_exceeds(object, &footprints[order[later] as usize], threshold);
            }
        }
    }
    kept
}
