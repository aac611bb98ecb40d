//! Lines and words on a grid of characters.

/// Directions in which lines leave a place.
const UP: u8 = 1;
const DOWN: u8 = 2;
const LEFT: u8 = 4;
const RIGHT: u8 = 8;
/// What stands for lines that leave in some directions, by the sum of these.
const LINES: [char; 16] = [
    ' ', '│', '│', '│', '─', '╯', '╮', '┤', '─', '╰', '╭', '├', '─', '┴', '┬', '┼',
];

/// A grid of characters.
pub struct Canvas {
    width: usize,
    lines: Vec<u8>,
    words: Vec<Option<char>>,
}

impl Canvas {
    pub fn new(width: usize, height: usize) -> Self {
        Canvas {
            width,
            lines: vec![0; width * height],
            words: vec![None; width * height],
        }
    }

    fn join(&mut self, [x, y]: [usize; 2], directions: u8) {
        self.lines[y * self.width + x] |= directions;
    }

    /// A line from one column to another.
    pub fn across(&mut self, from: usize, to: usize, y: usize) {
        for x in from.min(to)..from.max(to) {
            self.join([x, y], RIGHT);
            self.join([x + 1, y], LEFT);
        }
    }

    /// A line from one row to another.
    pub fn down(&mut self, x: usize, from: usize, to: usize) {
        for y in from.min(to)..from.max(to) {
            self.join([x, y], DOWN);
            self.join([x, y + 1], UP);
        }
    }

    /// Words, above all lines.
    pub fn write(&mut self, text: &str, [x, y]: [usize; 2]) {
        for (letter, at) in text.chars().zip(x..self.width) {
            self.words[y * self.width + at] = Some(letter);
        }
    }

    /// A rule in a row, below all lines, with words where they have room.
    pub fn rule(&mut self, words: &str, y: usize) {
        let length = words.chars().count();
        let row = &self.lines[y * self.width..(y + 1) * self.width];
        let is_free = |x: &usize| row[*x..].len() >= length && row[*x..*x + length].iter().all(|line| *line == 0);
        // The last column stays empty.
        let dots: Vec<usize> = (0..self.width - 1).filter(|x| row[*x] == 0).collect();
        let place = (0..self.width).find(is_free).unwrap_or(0);
        dots.into_iter().for_each(|x| self.write("┄", [x, y]));
        self.write(words, [place, y]);
    }

    /// The lines of text, without empty ones at the end.
    pub fn text(&self) -> String {
        let rows = self.lines.chunks(self.width).zip(self.words.chunks(self.width));
        let row = |(lines, words): (&[u8], &[Option<char>])| {
            let letters = lines.iter().zip(words);
            let row: String = letters
                .map(|(line, word)| word.unwrap_or(LINES[usize::from(*line)]))
                .collect();
            format!("{}\n", row.trim_end())
        };
        let text: String = rows.map(row).collect();
        text.trim_end().to_string() + "\n"
    }
}
