use realo_nn::anchors::Anchors;
use realo_objective::targets::{Object, assign};

use crate::Kind;
use crate::reference::anchors_of;
use crate::vector::{Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[Kind::new(&["in.gt_boxes_hwl_class", "out.labels_yxa"], targets)];

/// The manifest gives this tolerance in words.
const DELTAS: f64 = 1e-6;

/// Labels outside the anchors where rounding decides, and the deltas of those that are positive in both.
fn targets(vector: &Vector) -> Result<(), String> {
    let tensors = vector.tensors()?;
    let anchors = anchors_of(vector.setting("range")?)?;
    let object = |row: &[f64; 8]| Object {
        class: (row[7] as usize).saturating_sub(1),
        hwl: std::array::from_fn(|i| row[i]),
    };
    let objects: Vec<Object> = tensors.rows::<8>("in.gt_boxes_hwl_class")?.iter().map(object).collect();
    let found = assign(&anchors, &objects);

    let ambiguous = tensors.numbers("mid.ambiguous_yxa")?;
    let clear = |labels: Vec<f64>| -> Vec<Option<f64>> {
        let pairs = labels.into_iter().zip(&ambiguous);
        pairs
            .map(|(label, ambiguous)| (*ambiguous == 0.0).then_some(label))
            .collect()
    };
    let labels = found.labels.iter().map(|label| f64::from(*label)).collect();
    equal("labels", &clear(labels), &clear(tensors.numbers("out.labels_yxa")?))?;

    let places = tensors.rows::<3>("out.positive_index_yxa")?;
    let deltas = tensors.rows::<7>("out.positive_targets")?;
    for ([row, column, anchor], expected) in places.iter().zip(&deltas) {
        let cell = *row as usize * anchors.cells.columns + *column as usize;
        let index = cell * anchors.per_cell() + *anchor as usize;
        let at = found
            .positives
            .binary_search_by_key(&index, |positive| positive.anchor as usize);
        if let (Ok(at), Some(0.0)) = (at, ambiguous.get(index)) {
            let deltas = found.positives[at].deltas.map(f64::from);
            compare(
                &format!("deltas of anchor ({row}, {column}, {anchor})"),
                &deltas,
                expected,
                DELTAS,
            )?;
        }
    }
    objects_with_an_anchor(
        &anchors,
        &objects,
        found.positives.iter().map(|positive| positive.object),
    )
}

/// Whatever rounding decides, an object inside the map has an anchor, unless another object took its best one.
fn objects_with_an_anchor(
    anchors: &Anchors,
    objects: &[Object],
    taken: impl Iterator<Item = u32>,
) -> Result<(), String> {
    let taken: Vec<usize> = taken.map(|object| object as usize).collect();
    for (index, object) in objects.iter().enumerate() {
        let alone = assign(anchors, std::slice::from_ref(object));
        let others_nearby = objects.iter().enumerate().any(|(other, near)| {
            let distance = libm::hypot(near.hwl[0] - object.hwl[0], near.hwl[1] - object.hwl[1]);
            other != index && near.class == object.class && distance < object.hwl[5] + near.hwl[5]
        });
        if !alone.positives.is_empty() && !others_nearby && !taken.contains(&index) {
            return Err(format!("object {index} has no anchor"));
        }
    }
    Ok(())
}
