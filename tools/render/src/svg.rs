use std::fmt::Write;

use crate::drawing::{Dots, Drawing, Item, Mark};
use crate::view::number;

/// A drawing as an SVG document. Every shape has its class; boxes tell their class and score.
pub fn svg(drawing: &Drawing) -> String {
    let [width, height] = drawing.size.map(number);
    let title = escaped(&drawing.title);
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" role=\"img\">\n<title>{title}</title>\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"{}\"/>\n",
        drawing.ground
    );
    for item in &drawing.items {
        match item {
            Item::Mark(mark) => put_mark(&mut text, mark),
            Item::Dots(dots) => put_dots(&mut text, dots),
        }
    }
    text.push_str("</svg>\n");
    text
}

fn put_mark(text: &mut String, mark: &Mark) {
    let mut attributes = String::new();
    match mark.style.fill {
        Some(fill) => {
            attribute(&mut attributes, "fill", fill.color);
            opacity(&mut attributes, "fill-opacity", fill.alpha);
        }
        None => attribute(&mut attributes, "fill", "none"),
    }
    if let Some(line) = mark.style.line {
        attribute(&mut attributes, "stroke", line.color);
        attribute(&mut attributes, "stroke-width", &number(line.width));
        opacity(&mut attributes, "stroke-opacity", line.alpha);
        attribute(&mut attributes, "stroke-linejoin", "round");
        if line.dash != [0.0, 0.0] {
            attribute(&mut attributes, "stroke-dasharray", &line.dash.map(number).join(" "));
        }
        if mark.style.fill.is_some() {
            attribute(&mut attributes, "paint-order", "stroke");
        }
    }
    let (class, path) = (mark.class, &mark.path);
    let end = match &mark.title {
        Some(title) => format!("><title>{}</title></path>\n", escaped(title)),
        None => "/>\n".into(),
    };
    text.push_str(&format!("<path class=\"{class}\" d=\"{path}\"{attributes}{end}"));
}

/// Dots as strokes without length, in cells of the grid from one to the next.
fn put_dots(text: &mut String, dots: &Dots) {
    if dots.cells.is_empty() {
        return;
    }
    let [x, y] = dots.origin.map(number);
    let width = format!("{:.4}", dots.diameter / dots.cell);
    let mut path = String::new();
    let mut last = [0, 0];
    for [row, column] in &dots.cells {
        let step = [column - last[1], row - last[0]];
        write!(path, "m{} {}h0", step[0], step[1]).expect("text takes all");
        last = [*row, *column];
    }
    text.push_str(&format!(
        "<path class=\"points\" transform=\"translate({x} {y}) scale({cell:.6} -{cell:.6})\" d=\"{path}\" fill=\"none\" \
         stroke=\"{}\" stroke-opacity=\"{}\" stroke-width=\"{width}\" stroke-linecap=\"round\"/>\n",
        dots.color,
        number(dots.alpha),
        cell = dots.cell,
    ));
}

fn attribute(text: &mut String, name: &str, value: &str) {
    text.push_str(&format!(" {name}=\"{value}\""));
}

fn opacity(text: &mut String, name: &str, alpha: f64) {
    if alpha < 1.0 {
        attribute(text, name, &number(alpha));
    }
}

/// A text as it stands in a document or in an attribute, which it cannot leave.
pub fn escaped(text: &str) -> String {
    let mut all = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => all.push_str("&amp;"),
            '<' => all.push_str("&lt;"),
            '>' => all.push_str("&gt;"),
            '"' => all.push_str("&quot;"),
            '\'' => all.push_str("&#39;"),
            // XML has no place for them.
            letter if letter.is_control() => all.push(' '),
            letter => all.push(letter),
        }
    }
    all
}
