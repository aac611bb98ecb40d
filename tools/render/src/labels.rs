use crate::view::{Px, Rect};

/// Gaps between an object and its label that are tried, px.
const GAPS: [f64; 7] = [3.0, 9.0, 17.0, 27.0, 40.0, 56.0, 74.0];
/// Directions that are tried at each gap.
const DIRECTIONS: usize = 16;
/// From this gap on a line leads from the object to its label, px.
const LEADER_FROM: f64 = 9.0;

/// A label that looks for a place.
#[derive(Clone, Copy, Debug)]
pub struct Wanted {
    /// What it belongs to.
    pub object: Rect,
    /// Width and height, px.
    pub size: Px,
}

/// Where a label stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placed {
    /// Its rectangle.
    pub rect: Rect,
    /// A line from the object to the label, where they are apart.
    pub leader: Option<[Px; 2]>,
}

/// Places labels one after the other, so that the first ones get the best places: near their object, inside `frame`, and
/// neither on an obstacle nor on another label. What finds no place is left out (`None`).
pub fn place(wanted: &[Wanted], obstacles: &[Rect], frame: &Rect) -> Vec<Option<Placed>> {
    let mut taken = obstacles.to_vec();
    let mut placed = Vec::with_capacity(wanted.len());
    for label in wanted {
        let free = |rect: &Rect| frame.holds(rect) && !taken.iter().any(|other| other.overlaps(rect));
        let found = GAPS
            .iter()
            .flat_map(|gap| (0..DIRECTIONS).map(move |direction| (*gap, direction)))
            .map(|(gap, direction)| (gap, at(label, gap, direction)))
            .find(|(_, rect)| free(rect));
        let found = found.map(|(gap, rect)| Placed {
            rect,
            leader: (gap >= LEADER_FROM).then(|| leader(&label.object, &rect)),
        });
        taken.extend(found.iter().map(|label| label.rect.grown(1.0)));
        placed.push(found);
    }
    placed
}

/// The label's place in a direction, counted from the right: its edge is `gap` from the object's.
fn at(label: &Wanted, gap: f64, direction: usize) -> Rect {
    // Beside and above first; a turn of an odd number visits all directions.
    const ORDER: [usize; DIRECTIONS] = [0, 8, 4, 12, 2, 14, 6, 10, 1, 15, 7, 9, 3, 13, 5, 11];
    let angle = std::f64::consts::TAU * ORDER[direction] as f64 / DIRECTIONS as f64;
    let (sin, cos) = angle.sin_cos();
    let [x, y] = label.object.center();
    let [width, height] = label.size;
    let reach = |object: f64, own: f64| (object + own) / 2.0 + gap;
    let (reach_x, reach_y) = (
        reach(label.object.right - label.object.left, width),
        reach(label.object.bottom - label.object.top, height),
    );
    // On the rectangle that the label's centre runs along.
    let stretch = (reach_x / cos.abs().max(1e-9)).min(reach_y / sin.abs().max(1e-9));
    let (x, y) = (x + stretch * cos, y - stretch * sin);
    Rect {
        left: x - width / 2.0,
        top: y - height / 2.0,
        right: x + width / 2.0,
        bottom: y + height / 2.0,
    }
}

fn leader(object: &Rect, label: &Rect) -> [Px; 2] {
    let nearest = |rect: &Rect, [x, y]: Px| [x.clamp(rect.left, rect.right), y.clamp(rect.top, rect.bottom)];
    let end = nearest(label, object.center());
    [nearest(object, end), end]
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: Rect = Rect {
        left: 0.0,
        top: 0.0,
        right: 400.0,
        bottom: 400.0,
    };

    fn square(x: f64, y: f64) -> Rect {
        Rect::around(&[[x, y]]).grown(5.0)
    }

    #[test]
    fn labels_of_a_crowd_do_not_touch_each_other_or_any_object() {
        let objects: Vec<Rect> = (0..25)
            .map(|i| square(150.0 + 22.0 * f64::from(i % 5), 150.0 + 22.0 * f64::from(i / 5)))
            .collect();
        let wanted: Vec<Wanted> = objects
            .iter()
            .map(|object| Wanted {
                object: *object,
                size: [60.0, 11.0],
            })
            .collect();
        let placed: Vec<Rect> = place(&wanted, &objects, &FRAME)
            .into_iter()
            .flatten()
            .map(|label| label.rect)
            .collect();
        assert!(placed.len() >= 20, "{} of 25 found a place", placed.len());
        for (i, label) in placed.iter().enumerate() {
            assert!(FRAME.holds(label));
            assert!(
                !objects
                    .iter()
                    .chain(&placed[i + 1..])
                    .any(|other| other.overlaps(label))
            );
        }
    }

    #[test]
    fn a_free_label_stands_beside_its_object_without_a_line() {
        let wanted = Wanted {
            object: square(200.0, 200.0),
            size: [40.0, 10.0],
        };
        let placed = place(&[wanted], &[wanted.object], &FRAME)[0].unwrap();
        assert_eq!(placed.leader, None);
        assert_eq!(placed.rect.left, 208.0);
    }

    #[test]
    fn a_label_without_room_is_left_out() {
        let wanted = Wanted {
            object: square(200.0, 200.0),
            size: [40.0, 10.0],
        };
        assert_eq!(place(&[wanted], &[FRAME], &FRAME), [None]);
    }
}
