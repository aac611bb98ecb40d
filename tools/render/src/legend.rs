//! Title, scale bar and legend.

use realo_schemas::{Nanos, to_millis};

use crate::drawing::{Dots, Drawing, Item};
use crate::font::{Fonts, Weight};
use crate::scene::{Agent, Scene};
use crate::style::{self, Style};
use crate::view::{MARGIN, Px, Rect, View, WIDTH, line, polygon};

/// Length of the scale bar, m.
const BAR_M: f64 = 20.0;
/// Size of letters in the legend, px.
const LETTERS: f64 = 14.0;
/// Distance of its lines, px.
const LEADING: f64 = 25.0;
/// Space between entries, px.
const GAP: f64 = 30.0;
/// Space of a sample, px.
const SAMPLE: f64 = 34.0;

/// What the picture shows, in a line.
pub fn title(scene: &Scene) -> String {
    let ego = scene.agents.first().map_or("", |agent| &agent.name);
    format!("{} · log {} · ego {ego}", scene.graph, scene.log)
}

/// How the points were thinned.
pub fn about_points(cell_m: f64) -> String {
    format!(
        "Points: of each agent the sweep nearest the ego's stamp, in the ego's frame, at most one dot in {cell_m:.2} m; \
         faint on the ground."
    )
}

/// What else must be said of the boxes.
pub fn about_boxes(scene: &Scene, left_out: usize) -> Vec<String> {
    let mut notes = vec!["Boxes: class and score; the line points ahead. The ego faces right.".to_string()];
    let scores = scene.judged.detected.iter().map(|detected| detected.score);
    if let Some(min) = scores.min_by(f32::total_cmp) {
        notes.push(format!("All boxes of the run are drawn; the lowest score is {min:.2}."));
    }
    let mut note = |condition: bool, text: String| {
        if condition {
            notes.push(text);
        }
    };
    note(!scene.processed, "The ego gave no boxes for this sweep.".into());
    note(
        !scene.has_truth,
        "The log does not say what is there: nothing is true or false.".into(),
    );
    note(
        scene.has_truth && !scene.judged.knows_points(),
        "The log does not count points on objects: what only cooperation saw is not known.".into(),
    );
    note(
        !scene.left_out.is_empty(),
        format!(
            "Not drawn for want of a pose: {} of the agents or their points.",
            scene.left_out.len()
        ),
    );
    note(left_out > 0, format!("{left_out} labels found no room."));
    notes
}

/// Draws the title above the view.
pub fn head(drawing: &mut Drawing, fonts: &Fonts, scene: &Scene) {
    let mut write = |text: &str, y: f64, size: f64, weight: Weight, color: &'static str| {
        let path = fonts.outline(text, [MARGIN, y], size, weight);
        drawing.mark("text", path, style::filled(color));
    };
    write(&title(scene), 38.0, 23.0, Weight::Bold, style::TEXT);
    let scored = if scene.key { "scored" } else { "not scored" };
    let caption = [
        format!("sweep {} ({scored}), {:.2} s into the log", scene.seq, scene.second),
        format!("stamp {} ns", scene.stamp),
        scene.how.clone(),
        scene.rule.clone(),
    ];
    let caption: Vec<&str> = caption
        .iter()
        .map(|part| &**part)
        .filter(|part| !part.is_empty())
        .collect();
    write(&caption.join(" · "), 64.0, LETTERS, Weight::Regular, style::MUTED);
}

/// Draws the scale bar into the view's lower right corner; gives what it takes.
pub fn scale_bar(drawing: &mut Drawing, fonts: &Fonts, view: &View) -> Rect {
    let shown = view.rect(&view.shown);
    let (right, y) = (shown.right - 18.0, shown.bottom - 16.0);
    let left = right - BAR_M * view.scale;
    let ticks = [
        line([left, y - 5.0], [left, y + 5.0]),
        line([right, y - 5.0], [right, y + 5.0]),
    ];
    let path = format!("{}{}", line([left, y], [right, y]), ticks.concat());
    let text = format!("{BAR_M} m");
    let width = fonts.width(&text, LETTERS, Weight::Bold);
    let at = [(left + right - width) / 2.0, y - 7.0];
    drawing.mark("scale", path, style::SCALE);
    let letters = fonts.outline(&text, at, LETTERS, Weight::Bold);
    drawing.mark("text", letters, style::letters(style::TEXT));
    Rect {
        left,
        top: y - 22.0,
        right,
        bottom: y + 6.0,
    }
}

/// Draws the legend below the view and sets the drawing's height.
pub fn legend(drawing: &mut Drawing, fonts: &Fonts, view: &View, scene: &Scene, notes: &[String]) {
    let mut flow = Flow {
        drawing,
        fonts,
        at: [MARGIN, view.bottom() + 34.0],
    };
    for (class, style, text) in kinds_of_boxes(scene) {
        flow.entry(Sample::Box(class, style), &text);
    }
    flow.next_line();
    for (index, agent) in scene.agents.iter().enumerate() {
        flow.entry(Sample::Points(style::agent(index)), &of_agent(agent, index == 0));
    }
    flow.next_line();
    flow.note(&notes.join(" "));
    let height = flow.at[1] + 22.0;
    drawing.size[1] = height;
}

/// The styles that there are, with their counts.
fn kinds_of_boxes(scene: &Scene) -> Vec<(&'static str, Style, String)> {
    let judged = &scene.judged;
    if !scene.has_truth {
        let text = format!("{} detected", judged.detected.len());
        return vec![("sample-detected", style::HIT, text)];
    }
    let (hits, added) = (judged.hits(), judged.added());
    let mut kinds = Vec::new();
    if judged.knows_gain() {
        let few = scene.seen_points;
        let text = format!("{added} found only by cooperation (the ego has fewer than {few} points on it)");
        kinds.push(("sample-added", style::ADDED, text));
        kinds.push(("sample-hit", style::HIT, format!("{} others found", hits - added)));
    } else {
        kinds.push(("sample-hit", style::HIT, format!("{hits} found")));
    }
    kinds.extend([
        ("sample-missed", style::MISSED, format!("{} missed", judged.missed())),
        ("sample-false", style::FALSE, format!("{} false", judged.wrong())),
        (
            "sample-there",
            style::THERE,
            format!("{} objects are there", judged.there.len()),
        ),
        ("sample-region", style::REGION, "where objects count".into()),
    ]);
    kinds
}

fn of_agent(agent: &Agent, is_ego: bool) -> String {
    let mut text = agent.name.clone();
    if is_ego {
        text.push_str(" (ego)");
    }
    match agent.sweep_offset {
        None => text.push_str(": no points in the log"),
        Some(offset) => {
            text.push_str(&format!(": {} points", thousands(agent.points.len())));
            // Clocks of locked sensors differ by microseconds.
            if to_millis(offset.abs()) >= 0.5 {
                text.push_str(&format!(", sweep {}", apart(offset)));
            }
        }
    }
    for (kind, age) in &agent.fused {
        text.push_str(&format!(", {kind} {} when fused", old(*age)));
    }
    if agent.fused.is_empty() && !is_ego {
        text.push_str(", nothing fused");
    }
    text
}

/// How old data are; offline they may be younger than what they are fused with.
fn old(age: Nanos) -> String {
    let ms = to_millis(age).round();
    match ms < 0.0 {
        true => format!("{:.0} ms younger", -ms),
        false => format!("{:.0} ms old", ms + 0.0),
    }
}

fn apart(offset: Nanos) -> String {
    let word = if offset < 0 { "earlier" } else { "later" };
    format!("{:.0} ms {word}", to_millis(offset.abs()))
}

fn thousands(count: usize) -> String {
    let digits = count.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// What stands before an entry.
enum Sample {
    Box(&'static str, Style),
    Points(&'static str),
}

/// Entries one after the other, on a new line where one does not fit.
struct Flow<'a> {
    drawing: &'a mut Drawing,
    fonts: &'a Fonts,
    at: Px,
}

impl Flow<'_> {
    fn entry(&mut self, sample: Sample, text: &str) {
        let width = SAMPLE + self.fonts.width(text, LETTERS, Weight::Regular);
        if self.at[0] > MARGIN && self.at[0] + width > WIDTH - MARGIN {
            self.next_line();
        }
        let [x, y] = self.at;
        self.sample(sample, [x, y - 5.0]);
        self.text(text, [x + SAMPLE, y], LETTERS, style::TEXT);
        self.at[0] += width + GAP;
    }

    fn sample(&mut self, sample: Sample, [x, y]: Px) {
        match sample {
            Sample::Box(class, style) => {
                let (left, right, top, bottom) = (x + 1.0, x + 25.0, y - 6.0, y + 6.0);
                let mut path = polygon(&[[left, top], [right, top], [right, bottom], [left, bottom]]);
                if class == "sample-false" {
                    path.push_str(&line([left, top], [right, bottom]));
                    path.push_str(&line([left, bottom], [right, top]));
                }
                self.drawing.mark(class, path, style);
            }
            Sample::Points(color) => self.drawing.items.push(Item::Dots(Dots {
                color,
                alpha: 1.0,
                diameter: 4.0,
                origin: [x + 3.0, y + 4.0],
                cell: 4.5,
                cells: [[0, 0], [0, 3], [1, 1], [1, 4], [2, 0], [2, 2]].to_vec(),
            })),
        }
    }

    fn text(&mut self, text: &str, at: Px, size: f64, color: &'static str) {
        let path = self.fonts.outline(text, at, size, Weight::Regular);
        self.drawing.mark("text", path, style::filled(color));
    }

    fn next_line(&mut self) {
        self.at = [MARGIN, self.at[1] + LEADING];
    }

    /// A text that is broken between words.
    fn note(&mut self, text: &str) {
        let size = LETTERS - 1.0;
        let mut words = text.split(' ').peekable();
        let mut row = String::new();
        while let Some(word) = words.next() {
            let longer = if row.is_empty() {
                word.to_string()
            } else {
                format!("{row} {word}")
            };
            row = match self.fonts.width(&longer, size, Weight::Regular) > WIDTH - 2.0 * MARGIN && !row.is_empty() {
                true => {
                    self.text(&row, self.at, size, style::MUTED);
                    self.at[1] += size * 1.5;
                    word.to_string()
                }
                false => longer,
            };
            if words.peek().is_none() {
                self.text(&row, self.at, size, style::MUTED);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_in_groups_of_three() {
        for (count, text) in [(0, "0"), (999, "999"), (1000, "1,000"), (1234567, "1,234,567")] {
            assert_eq!(thousands(count), text);
        }
    }

    #[test]
    fn no_age_is_below_zero() {
        let cases = [
            (0, "0 ms old"),
            (150_000_000, "150 ms old"),
            (-300_000, "0 ms old"),
            (-20_000_000, "20 ms younger"),
        ];
        assert!(cases.iter().all(|(age, text)| old(*age) == *text));
    }

    #[test]
    fn a_sweep_is_earlier_or_later() {
        assert_eq!(apart(-16_600_000), "17 ms earlier");
        assert_eq!(apart(40_000_000), "40 ms later");
    }
}
