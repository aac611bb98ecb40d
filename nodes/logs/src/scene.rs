//! Boxes as Foxglove's viewers draw them: `foxglove_msgs/msg/SceneUpdate`.

use realo_schemas::{Box3, Nanos};

use crate::boxes::pose_of;
use crate::cdr::CdrWriter;

/// Height of a text, m.
const TEXT_M: f64 = 0.8;
/// A text is so far above its box, m.
const ABOVE_M: f64 = 0.7;
/// Width of edges, pixels.
const EDGE_PIXELS: f64 = 2.0;

/// How boxes are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Red, green, blue, 0 to 1.
    pub color: [f64; 3],
    /// How opaque their sides are, 0 to 1; at 0 only edges are drawn.
    pub fill: f64,
    /// Whether each box says its class and score.
    pub labelled: bool,
}

/// The numbers of a box for its primitives: its own frame, and its size.
struct Placed {
    pose: [f64; 7],
    size: [f64; 3],
    label: String,
}

impl Placed {
    fn of(object: &Box3) -> Self {
        Placed {
            pose: pose_of(object),
            size: [object.length, object.width, object.height],
            label: format!("{} {:.2}", object.class, object.score),
        }
    }

    /// The ends of its edges in its own frame, in pairs.
    fn edges(&self) -> [[f64; 3]; 24] {
        let corner = |at: usize| [0, 1, 2].map(|axis| self.size[axis] * if at >> axis & 1 == 1 { 0.5 } else { -0.5 });
        let mut ends = [[0.0; 3]; 24];
        for (pair, ends) in ends.chunks_exact_mut(2).enumerate() {
            // Four edges along each axis.
            let (axis, at) = (pair / 4, pair % 4);
            let low = (at & !((1 << axis) - 1)) << 1 | at & ((1 << axis) - 1);
            ends[0] = corner(low);
            ends[1] = corner(low | 1 << axis);
        }
        ends
    }
}

/// Appends boxes as one entity that replaces the one before with this id.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, id: &str, boxes: &[Box3], look: &Look) {
    let boxes: Vec<Placed> = boxes.iter().map(Placed::of).collect();
    let mut out = CdrWriter::new(buffer);
    out.length(0);
    out.length(1);
    out.time(stamp);
    out.string(frame);
    out.string(id);
    // Until it is replaced.
    out.time(0);
    // Where it was at its stamp.
    out.bool(false);
    // Metadata, arrows.
    out.length(0);
    out.length(0);
    write_cubes(&mut out, &boxes, look);
    // Spheres, cylinders.
    out.length(0);
    out.length(0);
    write_edges(&mut out, &boxes, look);
    // Triangles.
    out.length(0);
    write_labels(&mut out, &boxes, look);
    // Models.
    out.length(0);
}

fn write_cubes(out: &mut CdrWriter, boxes: &[Placed], look: &Look) {
    if look.fill <= 0.0 {
        return out.length(0);
    }
    out.length(boxes.len());
    for Placed { pose, size, .. } in boxes {
        out.f64s(pose);
        out.f64s(size);
        write_color(out, look, look.fill);
    }
}

fn write_edges(out: &mut CdrWriter, boxes: &[Placed], look: &Look) {
    const LINE_LIST: u8 = 2;
    out.length(boxes.len());
    for placed in boxes {
        out.u8(LINE_LIST);
        out.f64s(&placed.pose);
        out.f64(EDGE_PIXELS);
        // Pixels, not metres.
        out.bool(true);
        let edges = placed.edges();
        out.length(edges.len());
        out.f64s(edges.as_flattened());
        write_color(out, look, 1.0);
        // Colours of single points, indices.
        out.length(0);
        out.length(0);
    }
}

fn write_labels(out: &mut CdrWriter, boxes: &[Placed], look: &Look) {
    if !look.labelled {
        return out.length(0);
    }
    out.length(boxes.len());
    for Placed { pose, size, label } in boxes {
        let mut pose = *pose;
        pose[2] += size[2] / 2.0 + ABOVE_M;
        out.f64s(&pose);
        // Turned to who looks.
        out.bool(true);
        out.f64(TEXT_M);
        out.bool(false);
        write_color(out, look, 1.0);
        out.string(label);
    }
}

fn write_color(out: &mut CdrWriter, look: &Look, alpha: f64) {
    out.f64s(&look.color);
    out.f64(alpha);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Schema;
    use crate::cdr::CdrReader;

    const LOOK: Look = Look {
        color: [0.0, 0.5, 1.0],
        fill: 0.25,
        labelled: true,
    };

    fn car() -> Box3 {
        Box3::new("Car", [10.0, -2.0, 0.75], [4.0, 2.0, 1.5], 0.5)
    }

    #[test]
    fn a_box_has_a_cube_its_twelve_edges_and_its_class() {
        let mut bytes = Vec::new();
        encode(&mut bytes, 3_000_000_005, "cav1/body", "/cav1/boxes", &[car()], &LOOK);
        let mut input = CdrReader::new(&bytes).unwrap();
        assert_eq!(input.u32(), Ok(0), "nothing is taken away");
        assert_eq!(input.u32(), Ok(1));
        assert_eq!(input.header().unwrap(), (3_000_000_005, "cav1/body"));
        assert_eq!(input.string(), Ok("/cav1/boxes"));
        assert_eq!((input.time().unwrap(), input.bool()), (0, Ok(false)));
        assert_eq!([input.u32(), input.u32(), input.u32()], [Ok(0), Ok(0), Ok(1)]);
        let [x, y, z, qx, qy, qz, qw] = input.f64s::<7>().unwrap();
        assert_eq!(([x, y, z], [qx, qy]), ([10.0, -2.0, 0.75], [0.0, 0.0]));
        assert!((2.0 * qz.atan2(qw) - 0.5).abs() < 1e-12);
        assert_eq!(input.f64s::<3>().unwrap(), [4.0, 2.0, 1.5]);
        assert_eq!(input.f64s::<4>().unwrap(), [0.0, 0.5, 1.0, 0.25]);
        assert_eq!([input.u32(), input.u32(), input.u32()], [Ok(0), Ok(0), Ok(1)]);
        assert_eq!(input.u8(), Ok(2));
        input.f64s::<7>().unwrap();
        assert_eq!((input.f64(), input.bool(), input.u32()), (Ok(2.0), Ok(true), Ok(24)));
        input.f64s::<72>().unwrap();
        assert_eq!(input.f64s::<4>().unwrap(), [0.0, 0.5, 1.0, 1.0]);
        assert_eq!([0; 4].map(|_| input.u32().unwrap()), [0, 0, 0, 1]);
        assert!((input.f64s::<7>().unwrap()[2] - 2.2).abs() < 1e-12);
        assert_eq!(
            (input.bool(), input.f64(), input.bool()),
            (Ok(true), Ok(0.8), Ok(false))
        );
        input.f64s::<4>().unwrap();
        assert_eq!(input.string(), Ok("Car 1.00"));
        assert_eq!((input.u32(), input.rest()), (Ok(0), 0));
    }

    #[test]
    fn edges_join_corners_that_differ_along_one_axis() {
        let mut edges: Vec<[[f64; 3]; 2]> = Placed::of(&car()).edges().as_chunks().0.to_vec();
        for [from, to] in &edges {
            let differ = (0..3).filter(|axis| from[*axis] != to[*axis]).count();
            assert_eq!(differ, 1, "{from:?} {to:?}");
            assert!(from.iter().zip([2.0, 1.0, 0.75]).all(|(at, half)| at.abs() == half));
        }
        edges.sort_by(|a, b| a.partial_cmp(b).unwrap());
        edges.dedup();
        assert_eq!(edges.len(), 12);
    }

    #[test]
    fn without_fill_and_labels_there_are_edges_alone() {
        let look = Look {
            fill: 0.0,
            labelled: false,
            ..LOOK
        };
        let (mut all, mut edges) = (Vec::new(), Vec::new());
        encode(&mut all, 0, "f", "i", &[car()], &LOOK);
        encode(&mut edges, 0, "f", "i", &[car()], &look);
        assert!(edges.len() + 200 < all.len());
    }

    #[test]
    fn its_schema_has_all_that_it_names() {
        let text = Schema::SceneUpdate.text();
        assert_eq!(Schema::SceneUpdate.name(), "foxglove_msgs/msg/SceneUpdate");
        for nested in ["SceneEntity", "LinePrimitive", "TextPrimitive", "Color"] {
            assert_eq!(
                text.matches(&format!("MSG: foxglove_msgs/{nested}\n")).count(),
                1,
                "{nested}"
            );
        }
        assert_eq!(Schema::named("foxglove_msgs/msg/SceneUpdate"), None, "logs have none");
    }
}
