//! A picture as SVG. Hues are those of Okabe and Ito, which colour-blind readers tell apart, and each arrow's type is written
//! at its begin too.

use std::fmt::Write;

use realo_render::{Fonts, Weight, escaped};

use crate::picture::{BoxAt, FrameAt, LEADING, LETTERS, Picture, PortAt, TITLE, picture, short};
use crate::{Diagram, Port};

/// Colours of the page, light and dark.
const STYLE: &str = "\
svg{--page:#ffffff;--group:#fafbfc;--process:#f3f5f7;--module:#e4e9ee;--box:#ffffff;--line:#b9c3cd;--ink:#17212b;--muted:#5d6b79;--lost:#c24e00;\
--points:#0072b2;--features:#b06a00;--boxes:#00795a;--state:#a8407d;--packet:#17212b;--other:#6b7783}\
@media (prefers-color-scheme:dark){svg{--page:#0a1118;--group:#0c151e;--process:#101820;--module:#192430;--box:#16202a;--line:#3a4a5a;--ink:#e8edf2;\
--muted:#9fb0c0;--lost:#ff8a5c;--points:#56b4e9;--features:#e69f00;--boxes:#2fbf9a;--state:#e09ac4;--packet:#e8edf2;--other:#8c9cab}}\
.page{fill:var(--page)}.group{fill:var(--group);stroke:var(--line);stroke-width:1.5}.process{fill:var(--process);stroke:var(--line)}.module{fill:var(--module);stroke:var(--line);stroke-dasharray:3 3}\
.stage{fill:var(--box);stroke:var(--line)}text{fill:var(--ink);font-family:Inter,system-ui,'Segoe UI',Roboto,'Liberation Sans',sans-serif}\
.bold{font-weight:600}.muted{fill:var(--muted)}.lost{fill:var(--lost);font-weight:600}\
.wire{fill:none;stroke-width:1.5}.head,.dot{stroke:none}.rim{fill:none;stroke:var(--process);stroke-width:4}";

/// How a payload type is drawn: its colour's name and the dashes of its arrows.
fn look(payload: &str) -> (&'static str, &'static str) {
    match payload {
        "PointCloud" => ("points", ""),
        "FeatureMap" => ("features", ""),
        "Boxes" => ("boxes", ""),
        "Selection" => ("boxes", "6 3"),
        "AgentState" => ("state", ""),
        "Motion" => ("state", "6 3"),
        "Packet" => ("packet", ""),
        _ => ("other", "2 3"),
    }
}

/// A diagram as an SVG document.
pub fn svg(diagram: &Diagram) -> String {
    let drawn = picture(diagram);
    let [width, height] = drawn.size.map(|size| size.ceil());
    let mut page = Page {
        text: format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
             role=\"img\">\n<title>{}</title>\n<style>{STYLE}</style>\n<rect class=\"page\" width=\"{width}\" height=\"{height}\"/>\n",
            escaped(&diagram.title)
        ),
        fonts: Fonts::new(),
    };
    page.head(diagram);
    drawn.groups.iter().for_each(|group| page.group(group));
    drawn.frames.iter().for_each(|frame| page.frame(frame));
    page.wires(diagram, &drawn);
    drawn.boxes.iter().for_each(|drawn| page.stage(diagram, drawn));
    page.arrows(diagram, &drawn);
    page.text + "</svg>\n"
}

/// Where a text is aligned.
#[derive(Clone, Copy, PartialEq)]
enum Align {
    Left,
    Right,
}

struct Page {
    text: String,
    fonts: Fonts,
}

impl Page {
    fn put(&mut self, arguments: std::fmt::Arguments) {
        self.text.write_fmt(arguments).expect("text takes all");
        self.text.push('\n');
    }

    /// Writes a line, as wide as the letters that it was measured with; gives where it ends, or begins if it ends here.
    fn line(&mut self, text: &str, [x, y]: [f64; 2], size: f64, class: &str, align: Align) -> f64 {
        if text.is_empty() {
            return x;
        }
        let weight = if ["bold", "lost"].contains(&class) {
            Weight::Bold
        } else {
            Weight::Regular
        };
        let width = self.fonts.width(text, size, weight);
        let left = if align == Align::Left { x } else { x - width };
        let class = match class.is_empty() {
            true => String::new(),
            false => format!(" class=\"{class}\""),
        };
        self.put(format_args!(
            "<text{class} x=\"{}\" y=\"{}\" font-size=\"{size}\" textLength=\"{}\" lengthAdjust=\"spacingAndGlyphs\">{}</text>",
            short(left),
            short(y),
            short(width),
            escaped(text)
        ));
        if align == Align::Left { x + width } else { left }
    }

    fn head(&mut self, diagram: &Diagram) {
        self.line(&diagram.title, [16.0, 16.0 + TITLE - 3.0], TITLE, "bold", Align::Left);
        for (at, line) in diagram.about.iter().enumerate() {
            let y = 16.0 + TITLE + LEADING * (at as f64 + 0.8);
            self.line(line, [16.0, y], LETTERS[1] + 1.0, "muted", Align::Left);
        }
    }

    fn group(&mut self, group: &FrameAt) {
        self.rect("group", &group.rect, 12, &format!("{}: {}", group.name, group.what));
        let [x, y] = [group.rect.x + 12.0, group.rect.y + 22.0];
        let end = self.line(&group.name, [x, y], LETTERS[0] + 1.0, "bold", Align::Left);
        self.line(&group.what, [end + 8.0, y], LETTERS[1], "muted", Align::Left);
    }

    fn frame(&mut self, frame: &FrameAt) {
        let (class, round) = if frame.is_process {
            ("process", 8)
        } else {
            ("module", 6)
        };
        self.rect(class, &frame.rect, round, &frame.name);
        let [x, y] = [frame.rect.x + 9.0, frame.rect.y];
        match frame.is_process {
            true => {
                self.line(&frame.name, [x, y + 19.0], LETTERS[0], "bold", Align::Left);
                self.line(&frame.what, [x, y + 34.0], LETTERS[1], "muted", Align::Left);
            }
            false => {
                self.line(&frame.name, [x, y + 14.0], LETTERS[1], "bold", Align::Left);
            }
        }
    }

    fn rect(&mut self, class: &str, rect: &crate::Rect, round: u8, title: &str) {
        self.put(format_args!(
            "<rect class=\"{class}\" x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" rx=\"{round}\"><title>{}</title></rect>",
            short(rect.x),
            short(rect.y),
            short(rect.width),
            short(rect.height),
            escaped(title)
        ));
    }

    fn wires(&mut self, diagram: &Diagram, drawn: &Picture) {
        for wire in &drawn.wires {
            let known = diagram.wires[wire.wire];
            let output = &diagram.stages[known.from.stage].outputs[known.from.port];
            let input = &diagram.stages[known.to.stage].inputs[known.to.port];
            let (color, dash) = look(&output.payload);
            let dash = if known.feedback { "8 4 2 4" } else { dash };
            let dash = match dash.is_empty() {
                true => String::new(),
                false => format!(" stroke-dasharray=\"{dash}\""),
            };
            let title = format!(
                "{}/{} ({}) to {}/{}{}",
                diagram.name_of(known.from.stage),
                output.name,
                output.payload,
                diagram.name_of(known.to.stage),
                input.name,
                if known.feedback { ", back" } else { "" }
            );
            self.put(format_args!(
                "<path class=\"wire\" style=\"stroke:var(--{color})\"{dash} d=\"{}\"><title>{}</title></path>",
                wire.path,
                escaped(&title)
            ));
        }
    }

    fn stage(&mut self, diagram: &Diagram, drawn: &BoxAt) {
        let stage = &diagram.stages[drawn.stage];
        self.rect("stage", &drawn.rect, 5, &diagram.name_of(drawn.stage));
        let [x, mut y] = [drawn.rect.x + 10.0, drawn.rect.y + 17.0];
        self.line(&stage.name, [x, y], LETTERS[0], "bold", Align::Left);
        for (line, class) in std::iter::once((&stage.what, "muted")).chain(stage.facts.iter().map(|fact| (fact, ""))) {
            if !line.is_empty() {
                y += 15.0;
                self.line(line, [x, y], LETTERS[1], class, Align::Left);
            }
        }
        for port in &drawn.ports {
            let ports = if port.is_output { &stage.outputs } else { &stage.inputs };
            self.port(port, &ports[port.end.port]);
        }
    }

    /// The words of a port, within its box.
    fn port(&mut self, at: &PortAt, port: &Port) {
        let [x, y] = [at.at[0], at.at[1] + 4.0];
        let size = LETTERS[1];
        let more = if at.is_output { &port.payload } else { &port.from };
        let facts = if at.is_output { "" } else { &port.facts };
        let said = if port.lost { "lost" } else { "muted" };
        match at.is_right {
            false => {
                let end = self.line(&port.name, [x + 10.0, y], size, "", Align::Left);
                let end = self.line(more, [end + 6.0, y], size, "muted", Align::Left);
                let gap = if more.is_empty() { 0.0 } else { 6.0 };
                self.line(facts, [end + gap, y], size, said, Align::Left);
            }
            true => {
                let end = self.line(more, [x - 10.0, y], size, "muted", Align::Right);
                let gap = if more.is_empty() { 0.0 } else { 6.0 };
                let end = self.line(&port.name, [end - gap, y], size, "", Align::Right);
                self.line(facts, [end - 6.0, y], size, said, Align::Right);
            }
        }
    }

    /// Begins and ends of wires, and what outputs say of them.
    fn arrows(&mut self, diagram: &Diagram, drawn: &Picture) {
        for at in drawn.boxes.iter().flat_map(|drawn| &drawn.ports) {
            let stage = &diagram.stages[at.end.stage];
            let [x, y] = at.at;
            if at.is_output {
                let port = &stage.outputs[at.end.port];
                let color = look(&port.payload).0;
                self.put(format_args!(
                    "<circle class=\"dot\" style=\"fill:var(--{color})\" cx=\"{}\" cy=\"{}\" r=\"3\"/>",
                    short(x),
                    short(y)
                ));
                let class = if port.lost { "lost" } else { "muted" };
                self.line(&port.facts, [x + 14.0, y - 3.5], LETTERS[1], class, Align::Left);
                continue;
            }
            let mut wires = diagram.wires.iter().filter(|wire| wire.to == at.end);
            let Some(wire) = wires.next() else { continue };
            let color = look(&diagram.stages[wire.from.stage].outputs[wire.from.port].payload).0;
            let back = if at.is_right { 7.0 } else { -7.0 };
            self.put(format_args!(
                "<path class=\"head\" style=\"fill:var(--{color})\" d=\"M{} {}l{back} -4v8z\"/>",
                short(x),
                short(y)
            ));
        }
    }
}
