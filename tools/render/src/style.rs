//! Colours and line styles. Hues are those of Okabe and Ito, which colour-blind readers tell apart, some of them lighter
//! for the dark ground; no two kinds of boxes differ in hue alone.

/// Colours of agents, ego first; they repeat when there are more.
pub const AGENTS: [&str; 6] = ["#56b4e9", "#e69f00", "#cc79a7", "#2fbf9a", "#8c9cff", "#b9c4cf"];

/// Ground of the picture.
pub const GROUND: &str = "#081018";
/// Ground of the view.
pub const VIEW: &str = "#101820";
/// Text.
pub const TEXT: &str = "#e8edf2";
/// Text of less weight, and truth.
pub const MUTED: &str = "#9fb0c0";
/// A detection that is true.
pub const FOUND: &str = "#ffffff";
/// A true detection that only cooperation made possible.
pub const COOPERATION: &str = "#f0e442";
/// What is wrong: a missed object, a false detection.
pub const WRONG: &str = "#ff6a3d";

/// The colour of an agent by its place in the list, ego first.
pub fn agent(index: usize) -> &'static str {
    AGENTS[index % AGENTS.len()]
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// `#rrggbb`.
    pub color: &'static str,
    /// In [0, 1].
    pub alpha: f64,
    /// px.
    pub width: f64,
    /// Lengths of dash and gap, px; both 0: a whole line.
    pub dash: [f64; 2],
}

impl Line {
    /// A whole line.
    pub const fn new(color: &'static str, width: f64) -> Self {
        Line {
            color,
            alpha: 1.0,
            width,
            dash: [0.0, 0.0],
        }
    }

    const fn dashed(self, dash: f64, gap: f64) -> Self {
        Line {
            dash: [dash, gap],
            ..self
        }
    }

    /// The same line, less visible.
    pub const fn faint(self, alpha: f64) -> Self {
        Line { alpha, ..self }
    }
}

/// How an area is filled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fill {
    /// `#rrggbb`.
    pub color: &'static str,
    /// In [0, 1].
    pub alpha: f64,
}

/// How something is drawn: its line, then what fills it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Style {
    /// Its line.
    pub line: Option<Line>,
    /// What fills it, above the inner half of the line.
    pub fill: Option<Fill>,
}

const fn lined(line: Line) -> Style {
    Style {
        line: Some(line),
        fill: None,
    }
}

/// Every 20 m.
pub const GRID: Style = lined(Line::new("#203040", 1.0));
/// Where objects count.
pub const REGION: Style = lined(Line::new("#6b7f92", 1.4).dashed(9.0, 5.0));
/// An object that was found.
pub const THERE: Style = lined(Line::new(MUTED, 1.1).dashed(2.0, 2.0));
/// An object that was not.
pub const MISSED: Style = lined(Line::new(WRONG, 2.0).dashed(4.5, 3.0));
/// A true detection.
pub const HIT: Style = lined(Line::new(FOUND, 1.5));
/// A detection that found nothing, and the cross in it.
pub const FALSE: Style = lined(Line::new(WRONG, 1.6));
/// A true detection that only cooperation made possible.
pub const ADDED: Style = Style {
    line: Some(Line::new(COOPERATION, 2.4)),
    fill: Some(Fill {
        color: COOPERATION,
        alpha: 0.35,
    }),
};

/// An area of one colour.
pub const fn filled(color: &'static str) -> Style {
    Style {
        line: None,
        fill: Some(Fill { color, alpha: 1.0 }),
    }
}

/// Letters on the view: a rim of its colour keeps them apart from the points.
pub const fn letters(color: &'static str) -> Style {
    Style {
        line: Some(Line::new(VIEW, 3.2).faint(0.85)),
        fill: Some(Fill { color, alpha: 1.0 }),
    }
}

/// A line from an object to its label.
pub const fn leader(color: &'static str) -> Style {
    lined(Line::new(color, 0.8).faint(0.75))
}

/// The body of an agent, with a rim that keeps it apart from its own points.
pub const fn agent_body(color: &'static str) -> Style {
    Style {
        line: Some(Line::new(GROUND, 4.0)),
        fill: Some(Fill { color, alpha: 1.0 }),
    }
}

/// The scale bar.
pub const SCALE: Style = lined(Line::new(TEXT, 2.0));
