//! Text in columns of a terminal.

/// Columns that a text takes.
pub fn width_of(text: &str) -> usize {
    text.chars().count()
}

/// Stands for what no terminal should be given.
const UNPRINTABLE: char = '\u{fffd}';

/// A text without control characters: line ends and tabs are blanks.
pub fn one_line(text: &str) -> String {
    let shown = |letter: char| match letter {
        '\n' | '\r' | '\t' => ' ',
        letter if letter.is_control() => UNPRINTABLE,
        letter => letter,
    };
    text.chars().map(shown).collect()
}

/// The same of lines, which stay.
pub fn printable(text: &str) -> String {
    text.split('\n').map(one_line).collect::<Vec<_>>().join("\n")
}

/// Lines of at most `width` columns, broken at spaces, else behind `/`, `,`, `_`, `.` or `-`, else anywhere.
pub fn lines(text: &str, width: usize) -> Vec<String> {
    let width = width.max(1);
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let line = lines.last_mut().expect("there is a line");
        let used = width_of(line);
        let gap = usize::from(used > 0);
        if used + gap + width_of(word) <= width {
            line.push_str(&" ".repeat(gap));
            line.push_str(word);
            continue;
        }
        let mut pieces = pieces(word, width).into_iter();
        if used == 0 {
            line.push_str(&pieces.next().unwrap_or_default());
        }
        lines.extend(pieces);
    }
    lines
}

/// A word in pieces of at most `width` columns.
fn pieces(word: &str, width: usize) -> Vec<String> {
    let mut rest: Vec<char> = word.chars().collect();
    let mut pieces = Vec::new();
    while rest.len() > width {
        let ends = |letter: &char| "/,_.-=".contains(*letter);
        let at = rest[..width].iter().rposition(ends).map_or(width, |at| at + 1);
        pieces.push(rest.drain(..at).collect());
    }
    pieces.push(rest.into_iter().collect());
    pieces
}

/// A paragraph, its lines after the first indented by two columns.
pub fn paragraph(text: &str, width: usize) -> String {
    let mut lines = lines(text, width.saturating_sub(2)).into_iter();
    let mut paragraph = lines.next().unwrap_or_default();
    for line in lines {
        paragraph.push_str("\n  ");
        paragraph.push_str(&line);
    }
    paragraph.push('\n');
    paragraph
}

/// How a cell is aligned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    Left,
    Right,
}

/// Writes a row of cells, each in lines of its own column: the width, the gap before it, and how it is aligned.
pub fn write_row<'a>(text: &mut String, cells: impl IntoIterator<Item = (&'a [String], usize, usize, Align)>) {
    let cells: Vec<_> = cells.into_iter().collect();
    let height = cells.iter().map(|(lines, ..)| lines.len()).max().unwrap_or(0);
    for at in 0..height {
        let mut row = String::new();
        for (lines, width, gap, align) in &cells {
            let part = lines.get(at).map_or("", String::as_str);
            row.push_str(&" ".repeat(*gap));
            match align {
                Align::Left => row.push_str(&format!("{part:<width$}")),
                Align::Right => row.push_str(&format!("{part:>width$}")),
            }
        }
        text.push_str(row.trim_end());
        text.push('\n');
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_controls_a_terminal() {
        assert_eq!(one_line("a\n\tb\u{1b}[31m\u{9b}"), "a  b\u{fffd}[31m\u{fffd}");
        assert_eq!(printable("a\u{7}\nb\n"), "a\u{fffd}\nb\n");
    }

    #[test]
    fn breaks_at_spaces_else_at_signs_else_anywhere() {
        for (text, width, expected) in [
            ("", 5, vec![""]),
            ("one two", 7, vec!["one two"]),
            ("one two", 6, vec!["one", "two"]),
            ("lat100/late_fusion", 10, vec!["lat100/", "late_", "fusion"]),
            ("lat100/late_fusion", 12, vec!["lat100/late_", "fusion"]),
            ("abcdefgh", 3, vec!["abc", "def", "gh"]),
            ("a=1, b=22222", 8, vec!["a=1,", "b=22222"]),
        ] {
            assert_eq!(lines(text, width), expected, "{text}");
        }
        assert_eq!(paragraph("one two three", 9), "one two\n  three\n");
    }
}
