//! What a program says on standard error, passed on within bounds: it may say the same for each of ten million points.

use std::io::Write;
use std::time::{Duration, Instant};

/// Lines of one second.
const LINES: u32 = 200;
/// Bytes of one line.
const BYTES: usize = 4096;

/// Passes on so many lines a second and so many bytes of each; counts the rest.
pub(super) struct Relay<W> {
    to: W,
    /// The program's node.
    node: String,
    /// When the second began whose lines are counted.
    second: Option<Instant>,
    lines: u32,
    /// Bytes of the line so far.
    bytes: usize,
    /// Whether the line is passed on.
    is_passed: bool,
    /// Lines that were not passed on.
    lines_left_out: u64,
    /// Bytes that were not passed on, of lines that were.
    bytes_left_out: u64,
}

impl<W: Write> Relay<W> {
    pub fn to(to: W, node: &str) -> Self {
        Relay {
            to,
            node: node.into(),
            second: None,
            lines: 0,
            bytes: 0,
            is_passed: true,
            lines_left_out: 0,
            bytes_left_out: 0,
        }
    }

    /// Passes on what came at `now`.
    pub fn pass(&mut self, said: &[u8], now: Instant) {
        // A progress bar ends its lines by a carriage return.
        for piece in said.split_inclusive(|byte| matches!(byte, b'\n' | b'\r')) {
            if self.bytes == 0 {
                self.begin(now);
            }
            let (text, end) = match piece {
                [text @ .., b'\n' | b'\r'] => (text, &piece[text.len()..]),
                text => (text, &[][..]),
            };
            if self.is_passed {
                let fits = text.len().min(BYTES.saturating_sub(self.bytes));
                self.write(&text[..fits]);
                self.write(end);
                self.bytes_left_out += (text.len() - fits) as u64;
            }
            self.bytes = if end.is_empty() { self.bytes + text.len() } else { 0 };
        }
    }

    /// Decides whether a line is passed on.
    fn begin(&mut self, now: Instant) {
        if self.second.is_none_or(|second| now - second >= Duration::from_secs(1)) {
            (self.second, self.lines) = (Some(now), 0);
        }
        self.is_passed = self.lines < LINES;
        self.lines += u32::from(self.is_passed);
        self.lines_left_out += u64::from(!self.is_passed);
    }

    /// Says what was left out.
    pub fn end(mut self) {
        let (lines, bytes) = (self.lines_left_out, self.bytes_left_out);
        if lines + bytes > 0 {
            let begun = if self.bytes > 0 && self.is_passed { "\n" } else { "" };
            let said = format!(
                "{begun}realo: node `{}`: {lines} lines of its program's standard error and {bytes} bytes of longer ones were left out: at most \
                 {LINES} lines a second and {BYTES} bytes a line are passed on; let the program say less, or write to a file\n",
                self.node
            );
            self.write(said.as_bytes());
        }
    }

    fn write(&mut self, bytes: &[u8]) {
        // Nothing can be done about a terminal that is gone.
        let _ = self.to.write_all(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_bounded_and_what_is_left_out_is_said_once() {
        let mut heard = Vec::new();
        let mut relay = Relay::to(&mut heard, "fusion");
        let begun = Instant::now();
        relay.pass(&b"again\n".repeat(1000), begun);
        relay.pass(b"still the same sec", begun);
        relay.pass(b"ond\n", begun);
        let later = begun + Duration::from_secs(1);
        relay.pass(&[b'x'; 3000], later);
        relay.pass(&[b'x'; 3000], later);
        relay.pass(b"x\nlast\n", later);
        relay.end();
        let heard = String::from_utf8(heard).unwrap();
        assert_eq!(heard.matches("again\n").count(), 200);
        assert!(!heard.contains("second\n"), "{heard}");
        assert!(heard.contains(&format!("\n{}\nlast\n", "x".repeat(4096))), "{heard}");
        assert_eq!(heard.matches("`fusion`: 801 lines ").count(), 1, "{heard}");
        assert!(heard.contains(" and 1905 bytes of longer ones"), "{heard}");
    }

    #[test]
    fn what_is_within_the_bounds_is_passed_on_as_it_is() {
        let said = b"10 %\r20 %\r\nWarning: slow\n\nno end";
        let mut heard = Vec::new();
        let mut relay = Relay::to(&mut heard, "fusion");
        said.chunks(7).for_each(|chunk| relay.pass(chunk, Instant::now()));
        relay.end();
        assert_eq!(heard, said);
    }
}
