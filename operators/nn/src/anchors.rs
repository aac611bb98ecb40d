//! Anchors of the detection head, and boxes as deltas to them (V2X-Real, after SECOND and PointPillars).
//!
//! A box here is seven numbers: x, y, z of the centre, height, width, length (m), yaw (rad).

/// x, y, z, height, width, length, yaw.
pub type Hwl<T> = [T; 7];

/// The anchors of one class: one box in several headings at every cell.
#[derive(Clone, Debug, PartialEq)]
pub struct AnchorClass {
    /// Super-class.
    pub name: &'static str,
    /// Length, width, height, m.
    pub extent: [f64; 3],
    /// Height of the centre in the network's frame, m.
    pub z: f64,
    /// Headings, rad.
    pub yaws: [f64; 2],
}

/// The classes of V2X-Real. Its second heading is 1.57, not π/2; weights depend on it.
pub const V2X_REAL: [AnchorClass; 3] = [
    AnchorClass {
        name: "vehicle",
        extent: [3.9, 1.6, 1.56],
        z: -1.78,
        yaws: [0.0, 1.57],
    },
    AnchorClass {
        name: "pedestrian",
        extent: [0.8, 0.6, 1.73],
        z: -0.6,
        yaws: [0.0, 1.57],
    },
    AnchorClass {
        name: "truck",
        extent: [8.0, 3.0, 3.0],
        z: -1.78,
        yaws: [0.0, 1.57],
    },
];

/// The cells of a BEV map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cells {
    /// Cells along y.
    pub rows: usize,
    /// Cells along x.
    pub columns: usize,
    /// (x, y) of the outer corner of cell (0, 0), m.
    pub origin: [f64; 2],
    /// Extent of a cell along x and y, m.
    pub size: [f64; 2],
}

impl Cells {
    /// The map that `stride` voxels of side `voxel` (m) make one cell of, over x and y ranges; cells cover it all.
    pub fn new(x: [f64; 2], y: [f64; 2], voxel: f64, stride: usize) -> Self {
        let count = |[from, to]: [f64; 2]| (((to - from) / voxel).round() / stride as f64).ceil() as usize;
        let (columns, rows) = (count(x), count(y));
        let size = [(x[1] - x[0]) / columns as f64, (y[1] - y[0]) / rows as f64];
        Cells {
            rows,
            columns,
            origin: [x[0], y[0]],
            size,
        }
    }
}

/// The anchor of a class at a cell, in one of its headings; centres lie in the middle of cells.
pub fn anchor(class: &AnchorClass, cells: &Cells, row: usize, column: usize, heading: usize) -> Hwl<f64> {
    let x = cells.origin[0] + (column as f64 + 0.5) * cells.size[0];
    let y = cells.origin[1] + (row as f64 + 0.5) * cells.size[1];
    let [length, width, height] = class.extent;
    [x, y, class.z, height, width, length, class.yaws[heading]]
}

/// All anchors in the order of the head's channels: (row, column, class, heading).
pub fn anchors(classes: &[AnchorClass], cells: &Cells) -> Vec<Hwl<f64>> {
    let mut all = Vec::with_capacity(cells.rows * cells.columns * classes.len() * 2);
    for row in 0..cells.rows {
        for column in 0..cells.columns {
            for class in classes {
                all.extend((0..2).map(|heading| anchor(class, cells, row, column, heading)));
            }
        }
    }
    all
}

/// A box as deltas to an anchor: centre in units of the anchor's diagonal and height, logarithms of the extents' ratios,
/// difference of the headings (not wrapped).
pub fn encode(object: &Hwl<f64>, anchor: &Hwl<f64>) -> Hwl<f64> {
    let diagonal = (anchor[4] * anchor[4] + anchor[5] * anchor[5]).sqrt();
    [
        (object[0] - anchor[0]) / diagonal,
        (object[1] - anchor[1]) / diagonal,
        (object[2] - anchor[2]) / anchor[3],
        libm::log(object[3] / anchor[3]),
        libm::log(object[4] / anchor[4]),
        libm::log(object[5] / anchor[5]),
        object[6] - anchor[6],
    ]
}

/// The box of deltas to an anchor, in single precision as the reference does.
pub fn decode(deltas: &Hwl<f32>, anchor: &Hwl<f32>) -> Hwl<f32> {
    let diagonal = (anchor[4] * anchor[4] + anchor[5] * anchor[5]).sqrt();
    [
        deltas[0] * diagonal + anchor[0],
        deltas[1] * diagonal + anchor[1],
        deltas[2] * anchor[3] + anchor[2],
        libm::expf(deltas[3]) * anchor[3],
        libm::expf(deltas[4]) * anchor[4],
        libm::expf(deltas[5]) * anchor[5],
        deltas[6] + anchor[6],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_map_of_the_full_size_network_has_its_shape() {
        let cells = Cells::new([-102.4, 102.4], [-40.0, 40.0], 0.4, 2);
        assert_eq!((cells.rows, cells.columns), (100, 256));
        let first = anchor(&V2X_REAL[0], &cells, 0, 0, 0);
        assert!((first[0] + 102.0).abs() < 1e-12 && (first[1] + 39.6).abs() < 1e-12);
        assert_eq!(anchors(&V2X_REAL, &cells).len(), 100 * 256 * 6);
    }

    #[test]
    fn anchors_run_by_row_column_class_heading() {
        let cells = Cells::new([0.0, 4.0], [0.0, 2.0], 1.0, 1);
        let all = anchors(&V2X_REAL, &cells);
        let at = |row: usize, column: usize, class: usize, yaw: usize| all[((row * 4 + column) * 3 + class) * 2 + yaw];
        assert_eq!(at(1, 2, 0, 1), anchor(&V2X_REAL[0], &cells, 1, 2, 1));
        assert_eq!(at(0, 3, 2, 0)[..3], [3.5, 0.5, -1.78]);
    }

    #[test]
    fn deltas_lead_back_to_the_box() {
        let anchor = [1.0, 2.0, -1.0, 1.56, 1.6, 3.9, 1.57];
        let object = [1.5, 1.0, -0.8, 1.7, 1.9, 4.4, -2.0];
        let deltas = encode(&object, &anchor).map(|v| v as f32);
        let back = decode(&deltas, &anchor.map(|v| v as f32));
        for (value, expected) in back.iter().zip(object) {
            assert!((f64::from(*value) - expected).abs() < 1e-5, "{back:?}");
        }
    }
}
