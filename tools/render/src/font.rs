use ttf_parser::{Face, OutlineBuilder};

use crate::view::{Px, number};

/// Weight of letters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weight {
    /// As text.
    Regular,
    /// As titles.
    Bold,
}

/// The letters that the crate carries.
pub struct Fonts {
    regular: Face<'static>,
    bold: Face<'static>,
}

impl Default for Fonts {
    fn default() -> Self {
        Fonts::new()
    }
}

impl Fonts {
    /// Reads them.
    pub fn new() -> Self {
        let face = |bytes| Face::parse(bytes, 0).expect("the font is part of the crate");
        Fonts {
            regular: face(include_bytes!("../font/Inter-Regular.subset.ttf")),
            bold: face(include_bytes!("../font/Inter-SemiBold.subset.ttf")),
        }
    }

    fn face(&self, weight: Weight) -> &Face<'static> {
        match weight {
            Weight::Regular => &self.regular,
            Weight::Bold => &self.bold,
        }
    }

    /// Width of a line of text, px.
    pub fn width(&self, text: &str, size: f64, weight: Weight) -> f64 {
        let face = self.face(weight);
        let advance = |letter| f64::from(face.glyph_hor_advance(glyph(face, letter)).unwrap_or(0));
        text.chars().map(advance).sum::<f64>() * size / f64::from(face.units_per_em())
    }

    /// Path data of a line of text that starts at a place on its base line. A letter that the font lacks is a `?`.
    pub fn outline(&self, text: &str, [x, y]: Px, size: f64, weight: Weight) -> String {
        let face = self.face(weight);
        let scale = size / f64::from(face.units_per_em());
        let mut pen = Pen {
            x,
            y,
            scale,
            data: String::new(),
        };
        for letter in text.chars() {
            let glyph = glyph(face, letter);
            face.outline_glyph(glyph, &mut pen);
            pen.x += scale * f64::from(face.glyph_hor_advance(glyph).unwrap_or(0));
        }
        pen.data
    }
}

fn glyph(face: &Face, letter: char) -> ttf_parser::GlyphId {
    let known = face.glyph_index(letter).or_else(|| face.glyph_index('?'));
    known.unwrap_or(ttf_parser::GlyphId(0))
}

/// Writes outlines as path data.
struct Pen {
    x: f64,
    y: f64,
    scale: f64,
    data: String,
}

impl Pen {
    fn put(&mut self, command: char, points: &[(f32, f32)]) {
        self.data.push(command);
        let coordinate = |(x, y): &(f32, f32)| {
            let (x, y) = (self.x + self.scale * f64::from(*x), self.y - self.scale * f64::from(*y));
            format!("{} {}", number(x), number(y))
        };
        let points: Vec<String> = points.iter().map(coordinate).collect();
        self.data.push_str(&points.join(" "));
    }
}

impl OutlineBuilder for Pen {
    fn move_to(&mut self, x: f32, y: f32) {
        self.put('M', &[(x, y)]);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.put('L', &[(x, y)]);
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        self.put('Q', &[(x1, y1), (x, y)]);
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        self.put('C', &[(x1, y1), (x2, y2), (x, y)]);
    }

    fn close(&mut self) {
        self.data.push('Z');
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_that_is_written_has_an_outline() {
        let fonts = Fonts::new();
        for weight in [Weight::Regular, Weight::Bold] {
            for letter in ('!'..='~').chain("·×–−±".chars()) {
                let one = letter.to_string();
                assert!(fonts.face(weight).glyph_index(letter).is_some(), "{letter}");
                assert!(fonts.outline(&one, [0.0, 0.0], 12.0, weight).ends_with('Z'), "{letter}");
                assert!(fonts.width(&one, 12.0, weight) > 1.0, "{letter}");
            }
        }
        assert_eq!(
            fonts.outline("é", [0.0, 0.0], 12.0, Weight::Regular),
            fonts.outline("?", [0.0, 0.0], 12.0, Weight::Regular)
        );
    }

    #[test]
    fn text_is_as_wide_as_its_letters() {
        let fonts = Fonts::new();
        let width = |text: &str| fonts.width(text, 10.0, Weight::Regular);
        assert!((width("truck 0.9") - width("truck") - width(" 0.9")).abs() < 1e-9);
        assert_eq!(width(""), 0.0);
    }
}
