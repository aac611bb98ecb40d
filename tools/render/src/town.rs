//! A map of what stands still, from above.

use std::collections::BTreeMap;

use crate::drawing::{Dots, Drawing, Item};
use crate::font::{Fonts, Weight};
use crate::style;
use crate::view::{Px, line, number};

/// Longer side of the drawn map, px, and cells per px at most.
const LONG: f64 = 1400.0;
const LARGEST_CELL: f64 = 8.0;
/// From the map to the edges, px; above it stand title, words and heights.
const EDGE: f64 = 40.0;
const HEAD: f64 = 110.0;
const LETTERS: f64 = 14.0;
/// Room for the length of the bar in words, px.
const BAR_WORDS: f64 = 60.0;
/// What is drawn of columns by their highest point over the lowest around: up to a height, m, its colour and words.
const HEIGHTS: [(f64, &str, &str); 4] = [
    (0.5, "#2f4254", "ground"),
    (2.0, "#56b4e9", "to 2 m"),
    (5.0, "#e69f00", "to 5 m"),
    (f64::INFINITY, "#f0e442", "higher"),
];
/// The lowest point is looked for so many columns around, since below a wall there may be none.
const AROUND: i32 = 2;

/// Points of a map, by the columns of a grid on the ground.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Town {
    /// What it shows, in a line.
    pub title: String,
    /// What else there is to say, below the title.
    pub about: String,
    /// Side of a column, m.
    pub cell_m: f64,
    /// Lowest and highest point of a column, m, by its number along x and y.
    pub columns: BTreeMap<[i32; 2], [f64; 2]>,
}

impl Town {
    /// Adds a point at a height, m, to a column.
    pub fn add(&mut self, column: [i32; 2], height: f64) {
        let [low, high] = self.columns.entry(column).or_insert([height; 2]);
        (*low, *high) = (low.min(height), high.max(height));
    }

    /// The map as a drawing, x to the right and y up.
    pub fn draw(&self) -> Drawing {
        let [from, to] = self.extent();
        let cells = [0, 1].map(|axis| f64::from(to[axis] - from[axis]) + 1.0);
        let cell = (LONG / cells[0].max(cells[1])).min(LARGEST_CELL);
        let size = [(cells[0] * cell).max(500.0) + 2.0 * EDGE, cells[1] * cell + HEAD + EDGE];
        let mut drawing = Drawing {
            size,
            title: self.title.clone(),
            ground: style::GROUND,
            items: Vec::new(),
        };
        let origin = [
            EDGE + (0.5 - f64::from(from[0])) * cell,
            size[1] - EDGE - (0.5 - f64::from(from[1])) * cell,
        ];
        let mut of = HEIGHTS.map(|_| Vec::new());
        for ([x, y], [_, high]) in &self.columns {
            let over = high - self.ground([*x, *y]);
            let band = HEIGHTS.iter().position(|(height, ..)| over < *height);
            of[band.unwrap_or(HEIGHTS.len() - 1)].push([*y, *x]);
        }
        for ((_, color, _), cells) in HEIGHTS.iter().zip(of) {
            drawing.items.push(Item::Dots(Dots {
                color,
                alpha: 1.0,
                diameter: cell.max(1.0),
                origin,
                cell,
                cells,
            }));
        }
        self.words(&mut drawing, cell);
        drawing
    }

    /// The lowest height around a column.
    fn ground(&self, [x, y]: [i32; 2]) -> f64 {
        let around = (x - AROUND..=x + AROUND).flat_map(|x| (y - AROUND..=y + AROUND).map(move |y| [x, y]));
        let lows = around.filter_map(|column| self.columns.get(&column).map(|[low, _]| *low));
        lows.fold(f64::INFINITY, f64::min)
    }

    fn extent(&self) -> [[i32; 2]; 2] {
        let mut columns = self.columns.keys();
        let Some(first) = columns.next() else {
            return [[0; 2]; 2];
        };
        columns.fold([*first; 2], |[from, to], [x, y]| {
            [[from[0].min(*x), from[1].min(*y)], [to[0].max(*x), to[1].max(*y)]]
        })
    }

    /// Title, what colours mean, and a bar of a length that is said.
    fn words(&self, drawing: &mut Drawing, cell: f64) {
        let fonts = Fonts::new();
        let width = drawing.size[0];
        let mut text = |text: &str, at: Px, size: f64, weight: Weight, color: &'static str| {
            let path = fonts.outline(text, at, size, weight);
            drawing.mark("text", path, style::filled(color));
            at[0] + fonts.width(text, size, weight)
        };
        text(&self.title, [EDGE, 34.0], 20.0, Weight::Bold, style::TEXT);
        text(&self.about, [EDGE, 58.0], LETTERS, Weight::Regular, style::MUTED);
        let mut x = EDGE;
        for (height, color, words) in HEIGHTS {
            // The colour of the ground is too dark for letters.
            let color = if height == HEIGHTS[0].0 { style::MUTED } else { color };
            x = 26.0 + text(words, [x, 86.0], LETTERS, Weight::Bold, color);
        }
        // The longest of round lengths for which there is room beside the words.
        let room_m = (width - EDGE - x - BAR_WORDS) / cell * self.cell_m;
        let lengths = [200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0];
        let fitting = lengths.into_iter().find(|metres| *metres <= room_m);
        let Some(metres) = fitting.filter(|_| self.cell_m > 0.0) else {
            return;
        };
        let end = text(
            &format!("{} m", number(metres)),
            [x, 86.0],
            LETTERS,
            Weight::Regular,
            style::TEXT,
        ) + 8.0;
        let length = metres / self.cell_m * cell;
        drawing.mark("scale", line([end, 81.0], [end + length, 81.0]), style::SCALE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_have_the_colour_of_their_height_over_the_ground_around() {
        let mut town = Town {
            title: "a.map".into(),
            cell_m: 1.0,
            ..Town::default()
        };
        // Ground on a slope, a wall on it, and a tree whose foot nobody saw.
        for x in 0..20 {
            town.add([x, 0], 0.1 * f64::from(x));
        }
        town.add([10, 0], 3.0);
        town.add([15, 1], 8.0);
        let drawing = town.draw();
        let dots: Vec<(&str, usize)> = drawing
            .items
            .iter()
            .filter_map(|item| match item {
                Item::Dots(dots) => Some((dots.color, dots.cells.len())),
                Item::Mark(_) => None,
            })
            .collect();
        let of = HEIGHTS.map(|(_, color, _)| color);
        assert_eq!(dots, [(of[0], 19), (of[1], 0), (of[2], 1), (of[3], 1)]);
        assert!(
            drawing.size.iter().all(|side| side.is_finite() && *side < 2000.0),
            "{:?}",
            drawing.size
        );
        let empty = crate::svg(&Town::default().draw());
        assert!(!empty.contains("NaN") && !empty.contains("inf"), "{empty}");
    }
}
