//! Curves with intervals over the values of a setting.

use crate::drawing::Drawing;
use crate::font::{Fonts, Weight};
use crate::style::{self, Fill, Line, Style};
use crate::view::{Px, line, number, polygon};

const SIZE: Px = [900.0, 560.0];
/// The area of the curves: left, top, right, bottom.
const AREA: [f64; 4] = [80.0, 80.0, 660.0, 470.0];
const LETTERS: f64 = 14.0;
/// Distance of lines of text, px.
const LEADING: f64 = 24.0;
/// Lines of the grid at most.
const STEPS: f64 = 6.0;

/// A number and its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Value {
    /// The number.
    pub value: f64,
    /// Its interval, where it is known.
    pub interval: Option<[f64; 2]>,
}

/// One line of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// What it is of.
    pub name: String,
    /// What others are compared with; it is drawn dashed.
    pub is_reference: bool,
    /// By place on the x axis; `None` where it is not known.
    pub values: Vec<Option<Value>>,
}

/// Curves over the values of a setting.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// What it shows, in a line.
    pub title: String,
    /// What else there is to say, below the title.
    pub about: String,
    /// Name of the x axis.
    pub x: String,
    /// Name of the y axis.
    pub y: String,
    /// The values of the setting as they were written; numbers lie where they are, words side by side.
    pub places: Vec<String>,
    /// The curves.
    pub curves: Vec<Curve>,
}

impl Chart {
    /// The chart as a drawing.
    pub fn draw(&self) -> Drawing {
        let fonts = Fonts::new();
        let mut drawing = Drawing {
            size: SIZE,
            title: self.title.clone(),
            ground: style::GROUND,
            items: Vec::new(),
        };
        let mut pen = Pen {
            drawing: &mut drawing,
            fonts: &fonts,
        };
        pen.text(&self.title, [AREA[0], 34.0], 20.0, Weight::Bold, style::TEXT);
        pen.text(&self.about, [AREA[0], 58.0], LETTERS, Weight::Regular, style::MUTED);
        let scale = Scale::of(self);
        self.grid(&mut pen, &scale);
        for (index, curve) in self.curves.iter().enumerate() {
            pen.curve(curve, style::agent(index), &scale);
            let y = AREA[1] + 20.0 + index as f64 * LEADING;
            let sample = line([AREA[2] + 20.0, y - 5.0], [AREA[2] + 46.0, y - 5.0]);
            pen.drawing
                .mark("legend", sample, stroke(style::agent(index), curve.is_reference));
            pen.text(&curve.name, [AREA[2] + 54.0, y], LETTERS, Weight::Regular, style::TEXT);
        }
        drawing
    }

    fn grid(&self, pen: &mut Pen, scale: &Scale) {
        let [left, top, right, bottom] = AREA;
        let mut value = (scale.low / scale.step).ceil() * scale.step;
        while value <= scale.high + scale.step / 1e3 {
            let y = scale.y(value);
            pen.drawing.mark("grid", line([left, y], [right, y]), style::GRID);
            let text = number(value);
            let width = pen.fonts.width(&text, LETTERS, Weight::Regular);
            pen.text(
                &text,
                [left - 10.0 - width, y + 5.0],
                LETTERS,
                Weight::Regular,
                style::MUTED,
            );
            value += scale.step;
        }
        let mut end = f64::NEG_INFINITY;
        for (place, x) in self.places.iter().zip(&scale.places) {
            pen.drawing.mark("grid", line([*x, top], [*x, bottom]), style::GRID);
            let half = pen.fonts.width(place, LETTERS, Weight::Regular) / 2.0;
            // What would lie on its neighbour is left out.
            if x - half > end {
                pen.text(place, [x - half, bottom + 22.0], LETTERS, Weight::Regular, style::MUTED);
                end = x + half + 6.0;
            }
        }
        pen.text(
            &self.y,
            [left - 66.0, top - 18.0],
            LETTERS,
            Weight::Regular,
            style::TEXT,
        );
        let half = pen.fonts.width(&self.x, LETTERS, Weight::Regular) / 2.0;
        let middle = (left + right) / 2.0 - half;
        pen.text(&self.x, [middle, bottom + 50.0], LETTERS, Weight::Regular, style::TEXT);
    }
}

/// Where values lie.
struct Scale {
    low: f64,
    high: f64,
    step: f64,
    places: Vec<f64>,
}

impl Scale {
    fn of(chart: &Chart) -> Self {
        let values = chart.curves.iter().flat_map(|curve| curve.values.iter().flatten());
        let all = values.flat_map(|value| value.interval.into_iter().flatten().chain([value.value]));
        let (min, max) = all
            .filter(|value| value.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), value| {
                (min.min(value), max.max(value))
            });
        let (min, max) = if min <= max { (min, max) } else { (0.0, 1.0) };
        let span = (max - min).max(1e-3);
        let power = 10.0_f64.powf((span / STEPS).log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|step| step * power);
        let step = steps
            .into_iter()
            .find(|step| span / step <= STEPS)
            .unwrap_or(10.0 * power);
        let [low, high] = [(min / step).floor() * step, (max / step).ceil() * step];
        Scale {
            low,
            high: high.max(low + step),
            step,
            places: places(&chart.places),
        }
    }

    fn y(&self, value: f64) -> f64 {
        let share = (value - self.low) / (self.high - self.low);
        AREA[3] - share * (AREA[3] - AREA[1])
    }
}

/// Where the values of a setting lie, px: numbers in their order of size, words one after the other.
fn places(texts: &[String]) -> Vec<f64> {
    let numbers: Option<Vec<f64>> = texts
        .iter()
        .map(|text| text.parse().ok().filter(|n: &f64| n.is_finite()))
        .collect();
    let at = numbers.unwrap_or_else(|| (0..texts.len()).map(|at| at as f64).collect());
    let min = at.iter().copied().fold(f64::INFINITY, f64::min);
    let max = at.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let [left, right] = [AREA[0] + 20.0, AREA[2] - 20.0];
    let place = |value: f64| match max > min {
        true => left + (value - min) / (max - min) * (right - left),
        false => (left + right) / 2.0,
    };
    at.into_iter().map(place).collect()
}

fn stroke(color: &'static str, is_reference: bool) -> Style {
    let whole = Line::new(color, 2.2);
    Style {
        line: Some(Line {
            dash: if is_reference { [7.0, 5.0] } else { [0.0, 0.0] },
            ..whole
        }),
        fill: None,
    }
}

struct Pen<'a> {
    drawing: &'a mut Drawing,
    fonts: &'a Fonts,
}

impl Pen<'_> {
    fn text(&mut self, text: &str, at: Px, size: f64, weight: Weight, color: &'static str) {
        let path = self.fonts.outline(text, at, size, weight);
        self.drawing.mark("text", path, style::filled(color));
    }

    fn curve(&mut self, curve: &Curve, color: &'static str, scale: &Scale) {
        let known = curve.values.iter().zip(&scale.places);
        let mut known: Vec<(f64, Value)> = known.filter_map(|(value, x)| Some((*x, (*value)?))).collect();
        known.sort_by(|a, b| a.0.total_cmp(&b.0));
        let bound = |end: usize| {
            let at = move |(x, value): &(f64, Value)| Some([*x, scale.y(value.interval?[end])]);
            known.iter().filter_map(at).collect::<Vec<Px>>()
        };
        let (low, high) = (bound(0), bound(1));
        if low.len() > 1 {
            let around: Vec<Px> = low.into_iter().chain(high.into_iter().rev()).collect();
            let fill = Some(Fill { color, alpha: 0.15 });
            self.drawing
                .mark("interval", polygon(&around), Style { line: None, fill });
        }
        for ((x, value), (next, following)) in known.iter().zip(known.iter().skip(1)) {
            let path = line([*x, scale.y(value.value)], [*next, scale.y(following.value)]);
            self.drawing.mark("curve", path, stroke(color, curve.is_reference));
        }
        for (x, value) in known {
            let y = scale.y(value.value);
            let dot = polygon(&[[x - 3.5, y], [x, y - 3.5], [x + 3.5, y], [x, y + 3.5]]);
            let said = format!("{}: {:.3}", curve.name, value.value);
            self.drawing.reported("value", Some(said), dot, style::filled(color));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(places: &[&str], values: Vec<Option<Value>>) -> Chart {
        Chart {
            title: "mAP@0.5 over delay".into(),
            about: "one log".into(),
            x: "link.delay_ms".into(),
            y: "mAP@0.5".into(),
            places: places.iter().map(|place| place.to_string()).collect(),
            curves: vec![Curve {
                name: "late_fusion".into(),
                is_reference: false,
                values,
            }],
        }
    }

    fn value(value: f64, low: f64, high: f64) -> Option<Value> {
        Some(Value {
            value,
            interval: Some([low, high]),
        })
    }

    #[test]
    fn numbers_lie_where_they_are_and_words_side_by_side() {
        let at = |texts: &[&str]| places(&texts.iter().map(|text| text.to_string()).collect::<Vec<_>>());
        let numbers = at(&["0", "50", "200"]);
        assert!(((numbers[1] - numbers[0]) / (numbers[2] - numbers[0]) - 0.25).abs() < 1e-9);
        let words = at(&["paper", "perfect", "50"]);
        assert!((words[1] - words[0] - (words[2] - words[1])).abs() < 1e-9);
        assert_eq!(at(&["7"]), [(AREA[0] + AREA[2]) / 2.0]);
    }

    #[test]
    fn a_chart_shows_every_value_with_its_interval() {
        let values = vec![value(0.9, 0.85, 0.93), None, value(0.7, 0.6, 0.8)];
        let text = crate::svg(&chart(&["0", "50", "100"], values).draw());
        let count = |class: &str| text.matches(&format!("class=\"{class}\"")).count();
        assert_eq!((count("value"), count("curve"), count("interval")), (2, 1, 1));
        assert!(
            text.contains("<title>late_fusion: 0.700</title>") && !text.contains("NaN"),
            "{text}"
        );
        let empty = crate::svg(&chart(&["0"], vec![None]).draw());
        assert!(!empty.contains("NaN") && !empty.contains("inf"));
    }
}
