use realo_schemas::geometry::{Footprint, Region};
use realo_scoring::Outline;

/// Width of a picture, px.
pub const WIDTH: f64 = 1600.0;
/// Free space at the left and right, px.
pub const MARGIN: f64 = 28.0;
/// Height of the title above the view, px.
pub const TOP: f64 = 84.0;
/// Largest height of the view, px.
const MOST_HEIGHT: f64 = 1200.0;
/// What is shown beyond the region's edges, m.
const BEYOND_M: f64 = 4.0;

/// A place in the picture, px from its upper left corner.
pub type Px = [f64; 2];

/// Where metres of the ego's frame lie in the picture: forward is right, left is up.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// What is shown, m.
    pub shown: Region,
    /// The upper left corner of what is shown.
    pub corner: Px,
    /// Pixels of a metre.
    pub scale: f64,
}

impl View {
    /// A view of a region and a little around it.
    pub fn of(region: &Region) -> Self {
        let wider = |[from, to]: [f64; 2]| [from - BEYOND_M, to + BEYOND_M];
        let shown = Region {
            x: wider(region.x),
            y: wider(region.y),
        };
        let extent = |[from, to]: [f64; 2]| to - from;
        let room = WIDTH - 2.0 * MARGIN;
        let scale = (room / extent(shown.x)).min(MOST_HEIGHT / extent(shown.y));
        let corner = [(WIDTH - scale * extent(shown.x)) / 2.0, TOP];
        View { shown, corner, scale }
    }

    /// Width and height, px.
    pub fn size(&self) -> Px {
        let Region { x, y } = self.shown;
        [x, y].map(|[from, to]| self.scale * (to - from))
    }

    /// The lower edge, px.
    pub fn bottom(&self) -> f64 {
        self.corner[1] + self.size()[1]
    }

    /// A place on the ground.
    pub fn px(&self, [x, y]: [f64; 2]) -> Px {
        [
            self.corner[0] + self.scale * (x - self.shown.x[0]),
            self.corner[1] + self.scale * (self.shown.y[1] - y),
        ]
    }

    /// A part of the ground.
    pub fn rect(&self, region: &Region) -> Rect {
        let ([left, bottom], [right, top]) = (self.px([region.x[0], region.y[0]]), self.px([region.x[1], region.y[1]]));
        Rect {
            left,
            top,
            right,
            bottom,
        }
    }
}

/// A rectangle in the picture, px; `top` is less than `bottom`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Rect {
    /// The smallest rectangle with all the points.
    pub fn around(points: &[Px]) -> Self {
        let fold = |axis: usize, fold: fn(f64, f64) -> f64, start| points.iter().map(|p| p[axis]).fold(start, fold);
        Rect {
            left: fold(0, f64::min, f64::INFINITY),
            top: fold(1, f64::min, f64::INFINITY),
            right: fold(0, f64::max, f64::NEG_INFINITY),
            bottom: fold(1, f64::max, f64::NEG_INFINITY),
        }
    }

    /// Larger by so much on all sides.
    pub fn grown(&self, by: f64) -> Self {
        Rect {
            left: self.left - by,
            top: self.top - by,
            right: self.right + by,
            bottom: self.bottom + by,
        }
    }

    pub fn center(&self) -> Px {
        [(self.left + self.right) / 2.0, (self.top + self.bottom) / 2.0]
    }

    pub fn overlaps(&self, other: &Rect) -> bool {
        self.left < other.right && other.left < self.right && self.top < other.bottom && other.top < self.bottom
    }

    pub fn holds(&self, other: &Rect) -> bool {
        self.left <= other.left && other.right <= self.right && self.top <= other.top && other.bottom <= self.bottom
    }
}

/// The rectangle of an outline, m.
pub fn footprint(outline: &Outline) -> Footprint {
    let metres = |micrometres: i32| f64::from(micrometres) * 1e-6;
    Footprint::new(
        outline.center_m(),
        metres(outline.length),
        metres(outline.width),
        f64::from(outline.yaw) * 1e-8,
    )
}

/// A number with at most two decimals, as short as it can be.
pub fn number(value: f64) -> String {
    let rounded = (value * 100.0).round() / 100.0;
    // No "-0".
    format!("{}", rounded + 0.0)
}

/// The path data of a polygon.
pub fn polygon(points: &[Px]) -> String {
    let corners: Vec<String> = points
        .iter()
        .map(|[x, y]| format!("{} {}", number(*x), number(*y)))
        .collect();
    format!("M{}Z", corners.join("L"))
}

/// The path data of a line.
pub fn line([x0, y0]: Px, [x1, y1]: Px) -> String {
    format!("M{} {}L{} {}", number(x0), number(y0), number(x1), number(y1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forward_is_right_and_left_is_up() {
        let region = Region {
            x: [-100.0, 100.0],
            y: [-40.0, 40.0],
        };
        let view = View::of(&region);
        let [x, y] = view.px([0.0, 0.0]);
        assert_eq!([x, y], Rect::center(&view.rect(&region)));
        assert!(view.px([10.0, 0.0])[0] > x && view.px([0.0, 10.0])[1] < y);
        assert!((view.size()[0] - (WIDTH - 2.0 * MARGIN)).abs() < 1e-9);
    }

    #[test]
    fn numbers_are_short() {
        for (value, text) in [(1.0, "1"), (-0.001, "0"), (2.345, "2.35"), (-7.1, "-7.1")] {
            assert_eq!(number(value), text);
        }
    }
}
