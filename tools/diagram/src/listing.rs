//! A diagram in a terminal.

use crate::blocks::{Block, layers, of_process};
use crate::overview::overview;
use crate::{Diagram, End, Stage};

/// A terminal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Terminal {
    /// Its columns.
    pub width: usize,
    /// Whether it shows colours.
    pub colour: bool,
}

/// Stands for what no terminal should be given.
const UNPRINTABLE: char = '\u{fffd}';
/// Names of ports are padded to so many columns at most.
const NAMES: usize = 24;
/// Names of payload types are.
const TYPES: usize = 12;

/// A text without what controls a terminal.
pub fn printable(text: &str) -> String {
    text.chars()
        .map(|letter| if letter.is_control() { UNPRINTABLE } else { letter })
        .collect()
}

/// A diagram as lines of text: the processes with what flows between them, where that fits, then each with its stages, their
/// inputs and where these come from, and their outputs and where these go.
pub fn text(diagram: &Diagram, terminal: Terminal) -> String {
    let mut list = Listing {
        diagram,
        terminal,
        text: String::new(),
        names: names(diagram),
        facts: diagram
            .stages
            .iter()
            .flat_map(|stage| &stage.outputs)
            .map(|port| columns(&port.facts))
            .max()
            .unwrap_or(0),
    };
    list.line(&[(&diagram.title, BOLD)], "");
    diagram.about.iter().for_each(|line| list.wrapped("", &words(line), ""));
    let flow = overview(diagram, terminal.width);
    if !flow.is_empty() {
        list.text.push('\n');
        list.text.push_str(&flow);
    }
    let layers = layers(diagram);
    let mut order: Vec<usize> = (0..layers.len()).collect();
    order.sort_by_key(|process| layers[*process]);
    order.into_iter().for_each(|process| list.process(process));
    list.text
}

const BOLD: &str = "1";
const DIM: &str = "2";
const WARN: &str = "1;33";

fn columns(text: &str) -> usize {
    text.chars().count()
}

fn words(text: &str) -> Vec<String> {
    text.split_whitespace().map(printable).collect()
}

fn names(diagram: &Diagram) -> usize {
    let ports = diagram
        .stages
        .iter()
        .flat_map(|stage| stage.inputs.iter().chain(&stage.outputs));
    ports.map(|port| columns(&port.name)).max().unwrap_or(0).min(NAMES)
}

struct Listing<'a> {
    diagram: &'a Diagram,
    terminal: Terminal,
    text: String,
    /// Columns of the names of ports.
    names: usize,
    /// Columns of what arrows say.
    facts: usize,
}

impl Listing<'_> {
    fn styled(&self, text: &str, style: &str) -> String {
        let text = printable(text);
        match self.terminal.colour && !style.is_empty() && !text.is_empty() {
            true => format!("\u{1b}[{style}m{text}\u{1b}[0m"),
            false => text,
        }
    }

    /// A line of parts on the left, and words on the right where there is room for them, else below.
    fn line(&mut self, parts: &[(&str, &str)], right: &str) {
        let used: usize = parts.iter().map(|(text, _)| columns(text)).sum();
        let width = self.terminal.width;
        if used > width {
            // It needs several lines, and is not styled.
            let all: String = parts.iter().map(|(text, _)| printable(text)).collect();
            self.wrapped("", &[all], "");
            self.text.pop();
        } else {
            for (text, style) in parts {
                let text = self.styled(text, style);
                self.text.push_str(&text);
            }
        }
        let right = printable(right);
        if !right.is_empty() {
            let wide = columns(&right);
            if used + 1 + wide > width {
                self.text.push('\n');
                self.text.push_str(&" ".repeat(width.saturating_sub(wide)));
            } else {
                self.text.push_str(&" ".repeat(width - used - wide));
            }
            let right = self.styled(&right, DIM);
            self.text.push_str(&right);
        }
        self.text.push('\n');
    }

    /// Words behind a beginning, in as many lines as it takes; all but the first begin with `more`, and blanks.
    fn wrapped(&mut self, begin: &str, words: &[String], more: &str) {
        let indent = columns(begin);
        let room = self.terminal.width.saturating_sub(indent).max(8);
        let mut lines = vec![String::new()];
        for word in words {
            // What is longer than a line is cut into pieces of one.
            let letters: Vec<char> = word.chars().collect();
            for piece in letters.chunks(room) {
                let last = lines.last_mut().expect("there is a line");
                let gap = usize::from(!last.is_empty());
                if columns(last) + gap + piece.len() > room {
                    lines.push(piece.iter().collect());
                    continue;
                }
                last.push_str(&" ".repeat(gap));
                last.extend(piece);
            }
        }
        for (at, line) in lines.into_iter().enumerate() {
            let begin = match at {
                0 => begin.to_string(),
                _ => format!("{more}{}", " ".repeat(indent.saturating_sub(columns(more)))),
            };
            self.text.push_str(format!("{begin}{line}").trim_end());
            self.text.push('\n');
        }
    }

    fn process(&mut self, process: usize) {
        let drawn = &self.diagram.processes[process];
        let (name, what) = (printable(&drawn.name), printable(&drawn.what));
        let used = columns(&name) + columns(&what) + 2;
        let bar = "─".repeat(self.terminal.width.saturating_sub(used).max(2));
        self.text.push('\n');
        match what.is_empty() || used + 2 > self.terminal.width {
            true => {
                let bar = "─".repeat(self.terminal.width.saturating_sub(columns(&name) + 1));
                self.line(&[(&name, BOLD), (" ", ""), (&bar, DIM)], &what);
            }
            false => self.line(&[(&name, BOLD), (" ", ""), (&bar, DIM), (" ", ""), (&what, DIM)], ""),
        }
        for block in of_process(self.diagram, process) {
            self.block(&block, "");
        }
    }

    fn block(&mut self, block: &Block, rail: &str) {
        match block {
            Block::Stage(stage) => self.stage(*stage, rail),
            Block::Module(name, inner) => {
                self.line(&[(rail, ""), ("╭ ", DIM), (name, "")], "");
                inner.iter().for_each(|block| self.block(block, &format!("{rail}│ ")));
                self.line(&[(rail, ""), ("╰", DIM)], "");
            }
        }
    }

    fn stage(&mut self, stage: usize, rail: &str) {
        let drawn = &self.diagram.stages[stage];
        self.line(&[(rail, ""), (&drawn.name, BOLD)], &drawn.what);
        for fact in &drawn.facts {
            self.wrapped(&format!("{rail}  "), &words(fact), rail);
        }
        for at in 0..drawn.inputs.len() {
            self.input(drawn, End { stage, port: at }, rail);
        }
        for at in 0..drawn.outputs.len() {
            self.output(drawn, End { stage, port: at }, rail);
        }
    }

    /// A stage with its port, within its process by its name there.
    fn seen_from(&self, process: usize, end: End, port: &str) -> String {
        let stage = match self.diagram.process_of(end) == process {
            true => self.diagram.inner_name(end.stage),
            false => self.diagram.name_of(end.stage),
        };
        printable(&format!("{stage}/{port}"))
    }

    fn begin(&self, rail: &str, mark: char, name: &str) -> String {
        format!("{rail}  {mark} {:<width$} ", printable(name), width = self.names)
    }

    fn input(&mut self, drawn: &Stage, end: End, rail: &str) {
        let port = &drawn.inputs[end.port];
        let wires = self.diagram.wires.iter().filter(|wire| wire.to == end);
        let mut from: Vec<String> = wires
            .map(|wire| {
                let output = &self.diagram.stages[wire.from.stage].outputs[wire.from.port];
                let back = if wire.feedback { " (back)" } else { "" };
                self.seen_from(drawn.process, wire.from, &output.name) + back
            })
            .collect();
        from.extend((!port.from.is_empty()).then(|| printable(&port.from)));
        if !port.facts.is_empty() {
            from.push(self.styled(&port.facts, if port.lost { WARN } else { "" }));
        }
        self.wrapped(&self.begin(rail, '◂', &port.name), &from, rail);
    }

    fn output(&mut self, drawn: &Stage, end: End, rail: &str) {
        let port = &drawn.outputs[end.port];
        let wires = self.diagram.wires.iter().filter(|wire| wire.from == end);
        let mut to: Vec<String> = wires
            .map(|wire| {
                let input = &self.diagram.stages[wire.to.stage].inputs[wire.to.port];
                self.seen_from(drawn.process, wire.to, &input.name) + ","
            })
            .collect();
        if let Some(last) = to.last_mut() {
            last.pop();
        }
        let begin = self.begin(rail, '▸', &port.name);
        let begin = format!("{begin}{:<TYPES$} ", printable(&port.payload));
        let facts = printable(&port.facts);
        let room = self.terminal.width.saturating_sub(columns(&begin));
        match facts.is_empty() {
            true if self.facts + 48 <= room && self.facts > 0 => {
                self.wrapped(&format!("{begin}{}→ ", " ".repeat(self.facts + 1)), &to, rail);
            }
            true => self.wrapped(&format!("{begin}→ "), &to, rail),
            // On a wide terminal in a column of their own, else in a line of their own.
            false if self.facts + 48 <= room => {
                self.wrapped(&format!("{begin}{facts:<width$} → ", width = self.facts), &to, rail);
            }
            false => {
                self.wrapped(&format!("{begin}→ "), &to, rail);
                let indent = " ".repeat(columns(&begin).saturating_sub(columns(rail)));
                self.wrapped(&format!("{rail}{indent}"), &words(&facts), rail);
            }
        }
    }
}
