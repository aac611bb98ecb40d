//! Anchors of the detection head, and boxes as deltas to them (V2X-Real, after SECOND and PointPillars).
//!
//! A box here is seven numbers: x, y, z of the centre, height, width, length (m), yaw (rad).

use crate::model::{Architecture, ClassAnchor, Matching, Model};

/// x, y, z, height, width, length, yaw.
pub type Hwl<T> = [T; 7];

/// The anchors of a head: at every cell of its map, for every class, one box in several headings.
#[derive(Clone, Debug, PartialEq)]
pub struct Anchors {
    /// The head's map.
    pub cells: Cells,
    /// Classes in the order of the head's channels.
    pub classes: Vec<ClassAnchor>,
    /// Headings, rad.
    pub rotations: Vec<f64>,
    /// How objects are laid beside them.
    pub matching: Matching,
}

impl Anchors {
    /// The anchors of a model's heads, in the frame in which its boxes go.
    pub fn of<A: Architecture>(model: &Model<A>) -> Self {
        let [rows, columns] = model.map_size();
        let class = |class: &ClassAnchor| ClassAnchor {
            z: class.z + model.height(),
            ..class.clone()
        };
        Anchors {
            cells: Cells::divided(model.grid.x, model.grid.y, rows, columns),
            classes: model.classes.iter().map(class).collect(),
            rotations: model.rotations.clone(),
            matching: model.matching,
        }
    }

    /// The anchors of V2X-Real over a map. Their second heading is 1.57, not π/2; weights depend on it.
    pub fn v2x_real(cells: Cells) -> Self {
        let class = |name: &str, [length, width, height]: [f64; 3], z, [unmatched, matched]: [f64; 2]| ClassAnchor {
            name: name.into(),
            length,
            width,
            height,
            z,
            matched,
            unmatched,
        };
        Anchors {
            cells,
            classes: vec![
                class("vehicle", [3.9, 1.6, 1.56], -1.78, [0.45, 0.6]),
                class("pedestrian", [0.8, 0.6, 1.73], -0.6, [0.35, 0.5]),
                class("truck", [8.0, 3.0, 3.0], -1.78, [0.45, 0.6]),
            ],
            rotations: vec![0.0, 1.57],
            matching: Matching::Hull,
        }
    }

    /// What of an object is laid beside anchors: it, or it in the nearest of their headings.
    pub fn beside(&self, object: &Hwl<f64>) -> Hwl<f64> {
        let [.., yaw] = *object;
        // Front and rear are alike.
        let off = |rotation: &f64| libm::sin(yaw - rotation).abs();
        let nearest = self.rotations.iter().min_by(|a, b| off(a).total_cmp(&off(b)));
        match (self.matching, nearest) {
            (Matching::Turned, Some(rotation)) => {
                let [x, y, z, h, w, l, _] = *object;
                [x, y, z, h, w, l, *rotation]
            }
            _ => *object,
        }
    }

    /// Anchors at one cell.
    pub fn per_cell(&self) -> usize {
        self.classes.len() * self.rotations.len()
    }

    /// All anchors.
    pub fn count(&self) -> usize {
        self.cells.rows * self.cells.columns * self.per_cell()
    }

    /// The anchor of a class at a cell, in one of the headings; centres lie in the middle of cells.
    pub fn at(&self, row: usize, column: usize, class: usize, rotation: usize) -> Hwl<f64> {
        let [x, y] = self.cells.center(row, column);
        let class = &self.classes[class];
        let yaw = self.rotations[rotation];
        [x, y, class.z, class.height, class.width, class.length, yaw]
    }

    /// Anchor `index` in the order of the head's channels: (row, column, class, heading).
    pub fn get(&self, index: usize) -> Hwl<f64> {
        let (cell, anchor) = (index / self.per_cell(), index % self.per_cell());
        let (row, column) = (cell / self.cells.columns, cell % self.cells.columns);
        let headings = self.rotations.len();
        self.at(row, column, anchor / headings, anchor % headings)
    }

    /// All anchors in the order of the head's channels.
    pub fn iter(&self) -> impl Iterator<Item = Hwl<f64>> + '_ {
        (0..self.count()).map(|index| self.get(index))
    }
}

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
        Self::divided(x, y, count(y), count(x))
    }

    /// The map of so many rows and columns over x and y ranges.
    pub fn divided(x: [f64; 2], y: [f64; 2], rows: usize, columns: usize) -> Self {
        Cells {
            rows,
            columns,
            origin: [x[0], y[0]],
            size: [(x[1] - x[0]) / columns as f64, (y[1] - y[0]) / rows as f64],
        }
    }

    /// (x, y) of a cell's centre, m.
    pub fn center(&self, row: usize, column: usize) -> [f64; 2] {
        [
            self.origin[0] + (column as f64 + 0.5) * self.size[0],
            self.origin[1] + (row as f64 + 0.5) * self.size[1],
        ]
    }
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
        let anchors = Anchors::v2x_real(cells);
        let first = anchors.at(0, 0, 0, 0);
        assert!((first[0] + 102.0).abs() < 1e-12 && (first[1] + 39.6).abs() < 1e-12);
        assert_eq!(
            (anchors.count(), anchors.iter().count()),
            (100 * 256 * 6, 100 * 256 * 6)
        );
    }

    #[test]
    fn anchors_run_by_row_column_class_heading() {
        let anchors = Anchors::v2x_real(Cells::new([0.0, 4.0], [0.0, 2.0], 1.0, 1));
        let index = |row: usize, column: usize, class: usize, yaw: usize| ((row * 4 + column) * 3 + class) * 2 + yaw;
        assert_eq!(anchors.get(index(1, 2, 0, 1)), anchors.at(1, 2, 0, 1));
        assert_eq!(anchors.get(index(0, 3, 2, 0)), [3.5, 0.5, -1.78, 3.0, 3.0, 8.0, 0.0]);
        assert_eq!(anchors.iter().nth(index(0, 3, 1, 1)), Some(anchors.at(0, 3, 1, 1)));
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
