//! Seeded changes of YAML documents as trees: what nodes are, how many, how deep, which names they have.

use serde_yaml::Value;

use crate::Draw;

/// A document that may hold what no sound one does.
#[derive(Clone, Debug)]
enum Tree {
    /// As it stands in the text.
    Raw(String),
    /// In quotes.
    Text(String),
    List(Vec<Tree>),
    Map(Vec<(Tree, Tree)>),
    /// `&name value`.
    Named(usize, Box<Tree>),
    /// `*name`.
    Alias(usize),
    /// `!tag value`.
    Tagged(Box<Tree>),
}

use Tree::{Alias, List, Map, Named, Raw, Tagged, Text};

const SCALARS: &[&str] = &[
    "",
    "~",
    "0",
    "-1",
    "3",
    "1.5",
    ".nan",
    "-.inf",
    ".inf",
    "1e308",
    "1e999",
    "18446744073709551615",
    "18446744073709551616",
    "-9223372036854775809",
    "340282366920938463463374607431768211456",
    "true",
    "yes",
    "x",
    "a/b",
    "/",
    "//",
    "dora",
    "dora/timer",
    "_mod/clouds",
    "_outside/x",
    ".",
    "..",
    "<<",
    "=",
    "!",
    "!!binary aGk=",
    "!!str 3",
    "&a",
    "*a",
    "2026-01-01",
    "0x7f",
    "0o7",
    "\"\\ud800\"",
    "\"\\0\"",
    "'",
    "\u{feff}",
    "\u{85}",
    "ä",
    "|",
    "null",
    "[]",
    "{}",
];

impl From<&Value> for Tree {
    fn from(value: &Value) -> Self {
        match value {
            Value::String(text) => Text(text.clone()),
            Value::Sequence(list) => List(list.iter().map(Tree::from).collect()),
            Value::Mapping(map) => Map(map.iter().map(|(key, value)| (key.into(), value.into())).collect()),
            Value::Tagged(tagged) => Tagged(Box::new((&tagged.value).into())),
            Value::Null => Raw("~".into()),
            Value::Bool(value) => Raw(value.to_string()),
            Value::Number(number) => Raw(number.to_string()),
        }
    }
}

impl Tree {
    fn parse(text: &str) -> Self {
        Tree::from(&serde_yaml::from_str::<Value>(text).unwrap())
    }

    fn write(&self, out: &mut String) {
        let all = |out: &mut String, marks: [char; 2], items: &mut dyn Iterator<Item = Vec<&Tree>>| {
            out.push(marks[0]);
            for item in items {
                for (k, part) in item.into_iter().enumerate() {
                    out.push_str(if k == 0 { "" } else { ": " });
                    part.write(out);
                }
                out.push_str(", ");
            }
            out.push(marks[1]);
        };
        match self {
            Raw(text) => out.push_str(text),
            Text(text) => out.push_str(&serde_json_like(text)),
            List(list) => all(out, ['[', ']'], &mut list.iter().map(|item| vec![item])),
            Map(map) => all(out, ['{', '}'], &mut map.iter().map(|(key, value)| vec![key, value])),
            Named(name, value) => {
                out.push_str(&format!("&n{name} "));
                value.write(out);
            }
            Alias(name) => out.push_str(&format!("*n{name} ")),
            Tagged(value) => {
                out.push_str("!t ");
                value.write(out);
            }
        }
    }

    fn size(&self) -> usize {
        1 + match self {
            Raw(_) | Text(_) | Alias(_) => 0,
            List(list) => list.iter().map(Tree::size).sum(),
            Map(map) => map.iter().map(|(key, value)| key.size() + value.size()).sum(),
            Named(_, value) | Tagged(value) => value.size(),
        }
    }

    /// The node of this number, in order.
    fn nth(&mut self, n: &mut usize) -> Option<&mut Tree> {
        if *n == 0 {
            return Some(self);
        }
        *n -= 1;
        match self {
            Raw(_) | Text(_) | Alias(_) => None,
            List(list) => list.iter_mut().find_map(|item| item.nth(n)),
            Map(map) => map
                .iter_mut()
                .flat_map(|(key, value)| [key, value])
                .find_map(|node| node.nth(n)),
            Named(_, value) | Tagged(value) => value.nth(n),
        }
    }

    fn any(&mut self, draw: &mut Draw) -> &mut Tree {
        let mut n = draw.below(self.size());
        self.nth(&mut n).expect("there are as many")
    }

    /// Changes the document in one to four places; `words` are texts that mean something in it.
    fn change(&mut self, draw: &mut Draw, words: &[&str]) {
        for _ in 0..=draw.below(4) {
            self.change_once(draw, words);
        }
    }

    fn change_once(&mut self, draw: &mut Draw, words: &[&str]) {
        let other = self.any(draw).clone();
        let copies = if draw.chance(50) { 1100 } else { draw.pick(&[1, 2, 40]) };
        let node = self.any(draw);
        match draw.below(12) {
            0 | 1 => *node = Raw(draw.pick(SCALARS).into()),
            2 | 3 => *node = Text(draw.pick(words).into()),
            4 => *node = other,
            5 => node.nest(draw),
            6 => {
                let name = draw.below(3);
                *node = Named(name, Box::new(node.clone()));
                for _ in 0..draw.pick(&[1, 3, 50]) {
                    *self.any(draw) = Alias(name);
                }
            }
            7 => *node = laughs(other, draw),
            8 => {
                let long = if draw.chance(50) {
                    100_000
                } else {
                    draw.pick(&[65, 201, 5_000])
                };
                *node = Text("x".repeat(long));
            }
            _ => node.change_entries(other, copies, draw, words),
        }
    }

    /// Puts it deep into lists, maps or tags.
    fn nest(&mut self, draw: &mut Draw) {
        let deep = if draw.chance(50) {
            2000
        } else {
            draw.pick(&[1, 2, 3, 60, 127, 200])
        };
        let kind = draw.below(4);
        let mut inner = std::mem::replace(self, Alias(0));
        for _ in 0..deep {
            inner = match kind {
                0 => List(vec![inner]),
                1 => Map(vec![(Text("a".into()), inner)]),
                2 => Map(vec![(inner, Text("a".into()))]),
                _ => Tagged(Box::new(inner)),
            };
        }
        *self = inner;
    }

    /// Makes fewer, more or other entries of it.
    fn change_entries(&mut self, other: Tree, copies: usize, draw: &mut Draw, words: &[&str]) {
        match self {
            List(list) if !list.is_empty() => {
                let at = draw.below(list.len());
                match draw.below(4) {
                    0 => drop(list.remove(at)),
                    1 => list.insert(at, other),
                    2 => list.swap(0, at),
                    _ => (0..copies).for_each(|_| list.push(list[at].clone())),
                }
            }
            Map(map) if !map.is_empty() => {
                let at = draw.below(map.len());
                let (key, value) = map[at].clone();
                match draw.below(5) {
                    0 => drop(map.remove(at)),
                    1 => map[at].1 = other,
                    2 => map[at].0 = Text(draw.pick(words).into()),
                    3 => map.push((key, other)),
                    _ => (0..copies).for_each(|k| map.push((Text(format!("k{k}")), value.clone()))),
                }
            }
            Text(text) => {
                let end = text
                    .char_indices()
                    .map(|(at, _)| at)
                    .nth(draw.below(text.len()))
                    .unwrap_or(0);
                text.truncate(end);
                text.push_str(draw.pick(words));
            }
            other => *other = Raw(draw.pick(SCALARS).into()),
        }
    }
}

/// Lists of lists: as many items as the product of their lengths.
fn laughs(item: Tree, draw: &mut Draw) -> Tree {
    let width = draw.pick(&[2, 3, 10, 40]);
    let mut laughs = vec![Named(0, Box::new(item))];
    for k in 0..draw.pick(&[2, 5, 30]) {
        laughs.push(Named(k + 1, Box::new(List(vec![Alias(k); width]))));
    }
    List(laughs)
}

/// The text in double quotes.
fn serde_json_like(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            '\n' => out.push_str("\\n"),
            c if (c as u32) < 0x20 => out.push_str(&format!("\\x{:02x}", c as u32)),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// A YAML document as a file: changed as a tree, and now and then as bytes; `words` are texts that mean something in it.
///
/// # Panics
/// If the document is none.
pub fn damaged_yaml(text: &str, draw: &mut Draw, words: &[&str]) -> Vec<u8> {
    let mut bytes = match draw.below(8) {
        0 => text.as_bytes().to_vec(),
        _ => {
            let mut tree = Tree::parse(text);
            tree.change(draw, words);
            let mut out = String::new();
            tree.write(&mut out);
            out.into_bytes()
        }
    };
    match draw.below(12) {
        0 => draw.damage(&mut bytes),
        1 => {
            let more: &[&[u8]] = &[
                b"\n---\n",
                b"\n...\n",
                b"\n---\nnodes: []\n",
                b"\xff\xfe",
                b"\n\t",
                b"\n%YAML 9.9\n---\n",
                b"\n\xc3",
            ];
            bytes.extend(draw.pick(more));
        }
        _ => {}
    }
    bytes
}
