use crate::style::Style;
use crate::view::Px;

/// A picture as a list of what is drawn, in order; px from the upper left corner.
#[derive(Clone, Debug)]
pub struct Drawing {
    /// Width and height, px.
    pub size: Px,
    /// What the picture shows, in a line.
    pub title: String,
    /// Its ground, `#rrggbb`.
    pub ground: &'static str,
    /// What is drawn, first first.
    pub items: Vec<Item>,
}

/// Something that is drawn.
#[derive(Clone, Debug)]
pub enum Item {
    /// A shape.
    Mark(Mark),
    /// Points.
    Dots(Dots),
}

/// A shape.
#[derive(Clone, Debug)]
pub struct Mark {
    /// What it stands for.
    pub class: &'static str,
    /// Words that a reader sees for it, if any.
    pub title: Option<String>,
    /// Path data as in SVG, px.
    pub path: String,
    /// How it is drawn.
    pub style: Style,
}

/// Round dots at cells of a grid.
#[derive(Clone, Debug)]
pub struct Dots {
    /// `#rrggbb`.
    pub color: &'static str,
    /// In [0, 1].
    pub alpha: f64,
    /// Diameter, px.
    pub diameter: f64,
    /// Centre of cell (0, 0).
    pub origin: Px,
    /// Side of a cell, px; rows run upwards, columns to the right.
    pub cell: f64,
    /// (row, column) of each dot, in order.
    pub cells: Vec<[i32; 2]>,
}

impl Drawing {
    /// Adds a shape.
    pub fn mark(&mut self, class: &'static str, path: String, style: Style) {
        self.reported(class, None, path, style);
    }

    /// Adds a shape that reports something.
    pub fn reported(&mut self, class: &'static str, title: Option<String>, path: String, style: Style) {
        self.items.push(Item::Mark(Mark {
            class,
            title,
            path,
            style,
        }));
    }
}
