//! Where objects stand, and what lies on them.

use realo_nn::anchors::Hwl;

use super::cells::Cells;

/// Side of the cells by which points find the objects around them, m.
const CELL: f32 = 4.0;

/// An upright box, a little larger than it says.
#[derive(Clone, Debug)]
pub(crate) struct Outline {
    /// Of its ground plane.
    pub center: [f32; 2],
    /// Cosine and sine of its heading.
    axis: [f32; 2],
    /// Half of its length and width.
    half: [f32; 2],
    /// Bottom and top, as far around it as its sides.
    pub heights: [f32; 2],
}

impl Outline {
    /// The outline of a box and of so much, m, around it.
    pub fn new([x, y, z, height, width, length, yaw]: &Hwl<f64>, margin: f32) -> Self {
        let [bottom, top] = [-0.5, 0.5].map(|share| (z + share * height) as f32);
        Outline {
            center: [*x as f32, *y as f32],
            axis: [yaw.cos() as f32, yaw.sin() as f32],
            half: [*length, *width].map(|side| side as f32 / 2.0 + margin),
            heights: [bottom - margin, top + margin],
        }
    }

    /// Along and across, from its centre.
    pub fn local(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let ([dx, dy], [cos, sin]) = ([x - self.center[0], y - self.center[1]], self.axis);
        [dx * cos + dy * sin, dy * cos - dx * sin]
    }

    /// The place that lies so far along and across.
    pub fn place(&self, [along, across]: [f32; 2]) -> [f32; 2] {
        let ([x, y], [cos, sin]) = (self.center, self.axis);
        [x + along * cos - across * sin, y + along * sin + across * cos]
    }

    /// Whether a point lies in it.
    pub fn holds(&self, [x, y, z]: [f32; 3]) -> bool {
        let [along, across] = self.local([x, y]);
        let [bottom, top] = self.heights;
        along.abs() <= self.half[0] && across.abs() <= self.half[1] && (bottom..=top).contains(&z)
    }
}

/// Outlines by where they stand.
pub(crate) struct Outlines {
    all: Vec<Outline>,
    cells: Cells,
}

impl Outlines {
    /// Finds these.
    pub fn new(all: Vec<Outline>) -> Self {
        let mut cells = Cells::new(CELL);
        for (number, outline) in all.iter().enumerate() {
            cells.add(number as u32, outline.center, outline.half[0].hypot(outline.half[1]));
        }
        Outlines { all, cells }
    }

    /// The number of the first one that holds a point, and itself.
    pub fn at(&self, point: [f32; 3]) -> Option<(usize, &Outline)> {
        let near = self.cells.at([point[0], point[1]]).iter();
        let mut near = near.map(|number| (*number as usize, &self.all[*number as usize]));
        near.find(|(_, outline)| outline.holds(point))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_find_the_box_that_they_lie_on() {
        let boxes = [
            [10.0, 2.0, 1.0, 2.0, 2.0, 4.0, 0.0],
            [10.0, 8.0, 1.0, 2.0, 2.0, 12.0, std::f64::consts::FRAC_PI_2],
        ];
        let outlines = Outlines::new(boxes.iter().map(|hwl| Outline::new(hwl, 0.1)).collect());
        let at = |x: f32, y: f32, z: f32| outlines.at([x, y, z]).map(|(number, _)| number);
        assert_eq!((at(12.05, 2.0, 1.0), at(10.0, 13.9, 1.0)), (Some(0), Some(1)));
        assert_eq!(
            (at(10.0, 2.5, 1.0), at(10.9, 8.0, 2.05)),
            (Some(0), Some(1)),
            "the first of both; the margin"
        );
        assert_eq!(
            (at(12.2, 2.0, 1.0), at(10.0, 8.0, 2.2), at(40.0, 8.0, 1.0)),
            (None, None, None)
        );
        let (_, outline) = outlines.at([10.0, 13.0, 1.0]).unwrap();
        let there = outline.place(outline.local([10.5, 13.0]));
        assert!((there[0] - 10.5).abs() < 1e-5 && (there[1] - 13.0).abs() < 1e-5);
    }
}
