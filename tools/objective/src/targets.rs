//! What each anchor should answer in training (V2X-Real, after PointPillars).
//!
//! Overlap is the IoU of upright hulls on the ground plane, of objects as they stand or turned to an anchor's heading
//! ([`Matching`](realo_nn::model::Matching)), with 1 added to every width and height: a rule for pixels that
//! the reference applies to metres. It enlarges small boxes, so pedestrians depend on it.

use realo_nn::anchors::{Anchors, Hwl, encode};

/// An object that is to be found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object {
    /// Index of its class in the model.
    pub class: usize,
    /// Its box, in the anchors' frame.
    pub hwl: Hwl<f64>,
}

/// What the head of one sample should answer.
#[derive(Clone, Debug, PartialEq)]
pub struct Targets {
    /// For each anchor, `[rows, columns, anchors]`: 1 + its object's class, 0 for background, -1 if it does not count.
    pub labels: Vec<i8>,
    /// The anchors that have an object, in ascending order.
    pub positives: Vec<Positive>,
}

/// An anchor with its object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Positive {
    /// Index of the anchor.
    pub anchor: u32,
    /// Index of the object.
    pub object: u32,
    /// The object's box as deltas to the anchor.
    pub deltas: Hwl<f32>,
}

/// Assigns objects to the anchors of their classes.
///
/// An anchor gets the first object with which it overlaps more than the class's `matched`; besides, each object gets the
/// first of the anchors that overlap most with it, unless that has an object. Background overlaps less than `unmatched`
/// with every object of the anchor's class. Objects with a number that is not finite, without extent, or of no class of
/// the model are left out.
pub fn assign(anchors: &Anchors, objects: &[Object]) -> Targets {
    let mut targets = Targets {
        labels: vec![BACKGROUND; anchors.count()],
        positives: Vec::new(),
    };
    let mut pairs = Vec::new();
    for class in 0..anchors.classes.len() {
        let of_class = |(_, object): &(u32, &Object)| object.class == class && is_valid(&object.hwl);
        let objects: Vec<(u32, &Object)> = (0..).zip(objects).filter(of_class).collect();
        assign_class(anchors, class, &objects, &mut targets.labels, &mut pairs);
    }
    pairs.sort_unstable();
    targets.positives = pairs
        .into_iter()
        .map(|(anchor, object)| Positive {
            anchor,
            object,
            deltas: encode(&objects[object as usize].hwl, &anchors.get(anchor as usize)).map(|delta| delta as f32),
        })
        .collect();
    targets
}

const BACKGROUND: i8 = 0;
const IGNORED: i8 = -1;

fn is_valid(hwl: &Hwl<f64>) -> bool {
    hwl.iter().all(|number| number.is_finite()) && hwl[3..6].iter().all(|extent| *extent > 0.0)
}

fn assign_class(
    anchors: &Anchors,
    class: usize,
    objects: &[(u32, &Object)],
    labels: &mut [i8],
    pairs: &mut Vec<(u32, u32)>,
) {
    let settings = &anchors.classes[class];
    let (matched, unmatched) = (settings.matched as f32, settings.unmatched as f32);
    let positive = class as i8 + 1;
    let shapes = shapes(anchors, class);
    if unmatched <= 0.0 && !objects.is_empty() {
        // Not even an anchor without any overlap is background.
        let own = class * shapes.len()..(class + 1) * shapes.len();
        labels
            .chunks_exact_mut(anchors.per_cell())
            .for_each(|cell| cell[own.clone()].fill(IGNORED));
    }
    let mut best_of_objects = Vec::with_capacity(objects.len());
    for (index, object) in objects {
        let mut best = (0.0, None);
        for_anchors_near(
            anchors,
            class,
            &shapes,
            &Hull::of(&anchors.beside(&object.hwl)),
            |anchor, iou| {
                if iou > best.0 {
                    best = (iou, Some(anchor));
                }
                let label = &mut labels[anchor];
                if *label != positive && iou > matched {
                    *label = positive;
                    pairs.push((anchor as u32, *index));
                } else if *label != positive && iou >= unmatched {
                    *label = IGNORED;
                }
            },
        );
        best_of_objects.extend(best.1.map(|anchor| (anchor, *index)));
    }
    for (anchor, object) in best_of_objects {
        if labels[anchor] != positive {
            labels[anchor] = positive;
            pairs.push((anchor as u32, object));
        }
    }
}

/// The hulls of a class's anchors, one for each heading, about the origin.
fn shapes(anchors: &Anchors, class: usize) -> Vec<Hull> {
    let centered = |rotation| {
        let [_, _, z, h, w, l, yaw] = anchors.at(0, 0, class, rotation);
        Hull::of(&[0.0, 0.0, z, h, w, l, yaw])
    };
    (0..anchors.rotations.len()).map(centered).collect()
}

/// Calls `visit` with the index and the overlap of every anchor of a class that may overlap with a hull, in their order.
fn for_anchors_near(anchors: &Anchors, class: usize, shapes: &[Hull], hull: &Hull, mut visit: impl FnMut(usize, f32)) {
    let cells = &anchors.cells;
    let span = |axis: usize, count: usize| {
        let min = shapes.iter().map(|shape| shape.min[axis]).fold(0.0, f32::min);
        let most = shapes.iter().map(|shape| shape.max[axis]).fold(0.0, f32::max);
        let cell = |position: f64| (position - cells.origin[axis]) / cells.size[axis] - 0.5;
        // A cell more on both sides makes up for rounding.
        let from = cell(f64::from(hull.min[axis] - most) - PIXEL) - 1.0;
        let to = cell(f64::from(hull.max[axis] - min) + PIXEL) + 2.0;
        let within = |cell: f64| cell.clamp(0.0, count as f64) as usize;
        within(from.floor())..within(to.ceil())
    };
    let columns = span(0, cells.columns);
    for row in span(1, cells.rows) {
        for column in columns.clone() {
            let center = cells.center(row, column).map(|metres| metres as f32);
            let first = (row * cells.columns + column) * anchors.per_cell() + class * shapes.len();
            for (anchor, shape) in (first..).zip(shapes) {
                visit(anchor, overlap(&shape.at(center), hull));
            }
        }
    }
}

/// What the reference adds to widths and heights, m.
const PIXEL: f64 = 1.0;

/// The upright rectangle around a box on the ground plane, m.
#[derive(Clone, Copy, Debug)]
struct Hull {
    min: [f32; 2],
    max: [f32; 2],
}

impl Hull {
    fn of(hwl: &Hwl<f64>) -> Hull {
        let [x, y, _, _, width, length, yaw] = hwl.map(|number| number as f32);
        let (sin, cos) = (libm::sinf(yaw), libm::cosf(yaw));
        // Opposite corners mirror each other, so two of them give the reach.
        let corner = |side: f32| {
            let (l, w) = (length / 2.0, side * width / 2.0);
            [(l * cos - w * sin).abs(), (l * sin + w * cos).abs()]
        };
        let (left, right) = (corner(1.0), corner(-1.0));
        let reach = [left[0].max(right[0]), left[1].max(right[1])];
        let origin = Hull {
            min: reach.map(|side| -side),
            max: reach,
        };
        origin.at([x, y])
    }

    fn at(&self, [x, y]: [f32; 2]) -> Hull {
        Hull {
            min: [self.min[0] + x, self.min[1] + y],
            max: [self.max[0] + x, self.max[1] + y],
        }
    }

    fn area(&self) -> f32 {
        (self.max[0] - self.min[0] + PIXEL as f32) * (self.max[1] - self.min[1] + PIXEL as f32)
    }
}

/// IoU of two hulls, each enlarged by 1.
fn overlap(a: &Hull, b: &Hull) -> f32 {
    let common = |axis: usize| a.max[axis].min(b.max[axis]) - a.min[axis].max(b.min[axis]) + PIXEL as f32;
    let (width, height) = (common(0), common(1));
    if width <= 0.0 || height <= 0.0 {
        return 0.0;
    }
    let common = width * height;
    common / (a.area() + b.area() - common)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::vectors::Vector;
    use realo_nn::anchors::Cells;
    use realo_nn::model::Matching;

    /// The definition: every anchor with every object of its class.
    fn plain(anchors: &Anchors, objects: &[Object]) -> Targets {
        let headings = anchors.rotations.len();
        let class_of = |anchor: usize| anchor % anchors.per_cell() / headings;
        let hull = |anchor: usize| {
            let [x, y, z, h, w, l, yaw] = anchors.get(anchor);
            Hull::of(&[0.0, 0.0, z, h, w, l, yaw]).at([x as f32, y as f32])
        };
        let beside = |object: &Object| {
            let [x, y, z, h, w, l, yaw] = object.hwl;
            // The second of the headings is a quarter turn but for rounding.
            let across = yaw.sin().abs() > yaw.cos().abs();
            match anchors.matching {
                Matching::Hull => Hull::of(&object.hwl),
                Matching::Turned => Hull::of(&[x, y, z, h, w, l, if across { 1.57 } else { 0.0 }]),
            }
        };
        let iou = |anchor: usize, object: &Object| overlap(&hull(anchor), &beside(object));
        let mut owner = vec![None; anchors.count()];
        let mut labels = vec![BACKGROUND; anchors.count()];
        for anchor in 0..anchors.count() {
            let class = class_of(anchor);
            let settings = &anchors.classes[class];
            let own = || objects.iter().enumerate().filter(|(_, object)| object.class == class);
            owner[anchor] = own()
                .find(|(_, object)| iou(anchor, object) > settings.matched as f32)
                .map(|(i, _)| i);
            if !own().all(|(_, object)| iou(anchor, object) < settings.unmatched as f32) {
                labels[anchor] = IGNORED;
            }
        }
        for (index, object) in objects.iter().enumerate() {
            let mut best = (0.0, None);
            for anchor in (0..anchors.count()).filter(|anchor| class_of(*anchor) == object.class) {
                let iou = iou(anchor, object);
                if iou > best.0 {
                    best = (iou, Some(anchor));
                }
            }
            if let Some(anchor) = best.1 {
                owner[anchor].get_or_insert(index);
            }
        }
        let positives = (0..anchors.count()).filter_map(|anchor| {
            let object = owner[anchor]?;
            labels[anchor] = class_of(anchor) as i8 + 1;
            let deltas = encode(&objects[object].hwl, &anchors.get(anchor)).map(|delta| delta as f32);
            Some(Positive {
                anchor: anchor as u32,
                object: object as u32,
                deltas,
            })
        });
        let positives = positives.collect();
        Targets { labels, positives }
    }

    fn small() -> Anchors {
        Anchors::v2x_real(Cells::new([-12.8, 12.8], [-6.4, 6.4], 0.4, 2))
    }

    #[test]
    fn reference_vectors_are_met() {
        for case in ["all_classes", "dense", "one_class_absent", "pedestrians_only", "none"] {
            let vector = Vector::open(&format!("targets/{case}.safetensors"));
            let objects: Vec<Object> = vector
                .rows_f64::<8>("in.gt_boxes_hwl_class")
                .iter()
                .map(|row| Object {
                    class: row[7] as usize - 1,
                    hwl: std::array::from_fn(|i| row[i]),
                })
                .collect();
            let found = assign(&small(), &objects);
            let (labels, ambiguous) = (vector.f64("out.labels_yxa"), vector.f64("mid.ambiguous_yxa"));
            for (anchor, label) in labels.iter().enumerate() {
                let same = f64::from(found.labels[anchor]) == *label;
                assert!(
                    same || ambiguous[anchor] == 1.0,
                    "{case}: anchor {anchor} is {}",
                    found.labels[anchor]
                );
            }
            let mut compared = 0;
            let expected = vector.rows_f64::<7>("out.positive_targets");
            for ([row, column, anchor], expected) in
                vector.rows_f64::<3>("out.positive_index_yxa").iter().zip(&expected)
            {
                let index = ((*row as u32 * 32) + *column as u32) * 6 + *anchor as u32;
                let Ok(at) = found.positives.binary_search_by_key(&index, |positive| positive.anchor) else {
                    continue;
                };
                if ambiguous[index as usize] == 1.0 {
                    continue;
                }
                for (value, expected) in found.positives[at].deltas.iter().zip(expected) {
                    let difference = (f64::from(*value) - expected).abs();
                    assert!(difference <= 1e-6 + 1e-6 * expected.abs(), "{case}: anchor {index}");
                }
                compared += 1;
            }
            assert!(
                2 * compared >= expected.len(),
                "{case}: only {compared} of {}",
                expected.len()
            );
        }
    }

    #[test]
    fn an_object_far_from_a_match_still_gets_its_best_anchor() {
        let anchors = small();
        let van = Object {
            class: 0,
            hwl: [0.1, 0.2, -1.0, 3.0, 2.6, 9.0, 0.8],
        };
        let targets = assign(&anchors, &[van]);
        assert_eq!(targets.positives.len(), 1);
        let positive = targets.positives[0];
        assert_eq!((positive.object, targets.labels[positive.anchor as usize]), (0, 1));
        assert_eq!(
            positive.deltas,
            encode(&van.hwl, &anchors.get(positive.anchor as usize)).map(|d| d as f32)
        );
    }

    #[test]
    fn objects_that_are_invalid_or_far_away_change_nothing() {
        let mut broken = [[1.0, 1.0, -1.0, 1.5, 1.6, 3.9, 0.0]; 5];
        broken[0][0] = f64::NAN;
        broken[1][4] = 0.0;
        broken[2][5] = -3.9;
        broken[3][6] = f64::INFINITY;
        broken[4][0] = 1e30;
        let mut objects = broken.map(|hwl| Object { class: 0, hwl }).to_vec();
        objects.push(Object {
            class: 9,
            hwl: [1.0, 1.0, -1.0, 1.5, 1.6, 3.9, 0.0],
        });
        assert_eq!(assign(&small(), &objects), assign(&small(), &[]));
    }

    #[test]
    fn turned_objects_have_as_many_anchors_whatever_their_heading() {
        let positives = |matching, degrees: i32| {
            let hwl = [0.4, 0.4, -1.0, 1.5, 1.85, 4.4, f64::from(degrees).to_radians()];
            let anchors = Anchors { matching, ..small() };
            assign(&anchors, &[Object { class: 0, hwl }]).positives.len()
        };
        let along = positives(Matching::Hull, 0);
        assert!(along > 1, "{along}");
        for degrees in (-180..180).step_by(7) {
            assert_eq!(positives(Matching::Turned, degrees), along, "{degrees}");
        }
        assert_eq!(positives(Matching::Hull, 45), 1);
    }

    fn object() -> impl Strategy<Value = Object> {
        let place = (0usize..3, -15.0..15.0, -8.0..8.0, 0u8..3);
        (place, 0.7..1.4, 0.7..1.4, -4.0..4.0).prop_map(|((class, x, y, snap), wide, long, yaw): (_, f64, f64, f64)| {
            let anchor = small().at(0, 0, class, 0);
            // Objects in the middle of cells and along axes give ties.
            let snapped = |v: f64| if snap == 0 { (v / 0.4).round() * 0.4 } else { v };
            let yaw = if snap < 2 { 0.0 } else { yaw };
            let hwl = [
                snapped(x),
                snapped(y),
                -1.0,
                1.5,
                anchor[4] * wide,
                anchor[5] * long,
                yaw,
            ];
            Object { class, hwl }
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn is_the_plain_definition(
            objects in prop::collection::vec(object(), 0..25),
            unmatched in 0u8..4,
            turned in any::<bool>(),
        ) {
            let mut anchors = small();
            if turned {
                anchors.matching = Matching::Turned;
            }
            if unmatched == 0 {
                anchors.classes[1].unmatched = 0.0;
            }
            prop_assert_eq!(assign(&anchors, &objects), plain(&anchors, &objects));
        }
    }
}
