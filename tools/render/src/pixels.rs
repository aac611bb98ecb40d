use zeno::{Cap, Join, Mask, Stroke};

use crate::drawing::{Dots, Drawing, Item, Mark};

/// A picture in pixels: rows of red, green, blue from the upper left corner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pixels {
    pub width: u32,
    pub height: u32,
    pub rgb: Vec<[u8; 3]>,
}

impl Pixels {
    /// A drawing in pixels, one for each px.
    pub fn of(drawing: &Drawing) -> Self {
        let [width, height] = drawing.size.map(|extent| extent.ceil().max(1.0) as u32);
        let ground = color(drawing.ground);
        let mut pixels = Pixels {
            width,
            height,
            rgb: vec![ground; width as usize * height as usize],
        };
        for item in &drawing.items {
            match item {
                Item::Mark(mark) => pixels.mark(mark),
                Item::Dots(dots) => pixels.dots(dots),
            }
        }
        pixels
    }

    fn mark(&mut self, mark: &Mark) {
        if let Some(line) = mark.style.line {
            let dash = line.dash.map(|length| length as f32);
            let mut stroke = Stroke::new(line.width as f32);
            stroke.join(Join::Round).cap(Cap::Butt);
            if line.dash != [0.0, 0.0] {
                stroke.dash(&dash, 0.0);
            }
            let (mask, place) = Mask::new(mark.path.as_str()).style(stroke).render();
            self.stamp(&mask, place, color(line.color), line.alpha);
        }
        if let Some(fill) = mark.style.fill {
            let (mask, place) = Mask::new(mark.path.as_str()).style(zeno::Fill::NonZero).render();
            self.stamp(&mask, place, color(fill.color), fill.alpha);
        }
    }

    fn stamp(&mut self, mask: &[u8], place: zeno::Placement, color: [u8; 3], alpha: f64) {
        if place.width == 0 {
            return;
        }
        for (row, line) in mask.chunks_exact(place.width as usize).enumerate() {
            for (column, coverage) in line.iter().enumerate().filter(|(_, coverage)| **coverage > 0) {
                let (x, y) = (place.left + column as i32, place.top + row as i32);
                self.blend([x, y], color, alpha * f64::from(*coverage) / 255.0);
            }
        }
    }

    /// Dots are too many for masks; a pixel is covered as far as its centre lies inside the rim.
    fn dots(&mut self, dots: &Dots) {
        let (radius, color) = (dots.diameter / 2.0, color(dots.color));
        for [row, column] in &dots.cells {
            let x = dots.origin[0] + f64::from(*column) * dots.cell;
            let y = dots.origin[1] - f64::from(*row) * dots.cell;
            let around = |center: f64| (center - radius - 0.5).floor() as i32..=(center + radius + 0.5).floor() as i32;
            for py in around(y) {
                for px in around(x) {
                    let distance = (f64::from(px) + 0.5 - x).hypot(f64::from(py) + 0.5 - y);
                    let coverage = (radius + 0.5 - distance).clamp(0.0, 1.0);
                    self.blend([px, py], color, dots.alpha * coverage);
                }
            }
        }
    }

    fn blend(&mut self, [x, y]: [i32; 2], color: [u8; 3], alpha: f64) {
        let inside = |value: i32, extent: u32| u32::try_from(value).ok().filter(|value| *value < extent);
        let (Some(x), Some(y)) = (inside(x, self.width), inside(y, self.height)) else {
            return;
        };
        let pixel = &mut self.rgb[y as usize * self.width as usize + x as usize];
        for (channel, value) in pixel.iter_mut().zip(color) {
            let mixed = f64::from(*channel) + alpha * (f64::from(value) - f64::from(*channel));
            *channel = mixed.round() as u8;
        }
    }
}

/// The colour `#rrggbb`; colours are constants of [`crate::style`].
fn color(text: &str) -> [u8; 3] {
    let value = u32::from_str_radix(text.trim_start_matches('#'), 16).expect("a colour is #rrggbb");
    let [_, red, green, blue] = value.to_be_bytes();
    [red, green, blue]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::style;

    fn drawing(items: Vec<Item>) -> Drawing {
        Drawing {
            size: [20.0, 10.0],
            title: String::new(),
            ground: "#000000",
            items,
        }
    }

    #[test]
    fn shapes_and_dots_are_where_they_belong_and_nothing_else_changes() {
        let square = Item::Mark(Mark {
            class: "square",
            title: None,
            path: "M2 2L6 2L6 6L2 6Z".into(),
            style: style::filled("#ff8000"),
        });
        let dots = Item::Dots(Dots {
            color: "#0000ff",
            alpha: 1.0,
            diameter: 2.0,
            origin: [12.5, 8.5],
            cell: 2.0,
            cells: vec![[0, 0], [1, 2]],
        });
        let pixels = Pixels::of(&drawing(vec![square, dots]));
        let at = |x: usize, y: usize| pixels.rgb[y * 20 + x];
        assert_eq!((pixels.width, pixels.height), (20, 10));
        for (x, y) in [(2, 2), (5, 5), (3, 4)] {
            assert_eq!(at(x, y), [255, 128, 0]);
        }
        assert_eq!((at(12, 8), at(16, 6)), ([0, 0, 255], [0, 0, 255]));
        assert_eq!((at(7, 3), at(1, 1), at(19, 0)), ([0; 3], [0; 3], [0; 3]));
    }

    #[test]
    fn what_lies_outside_is_cut_off() {
        let line = Item::Mark(Mark {
            class: "line",
            title: None,
            path: "M-50 5L70 5".into(),
            style: style::leader("#ffffff"),
        });
        let pixels = Pixels::of(&drawing(vec![line]));
        assert!(pixels.rgb[5 * 20][0] > 0 && pixels.rgb[5 * 20 + 19][0] > 0);
    }
}
