//! Commands that a person may paste into a shell.

use std::path::Path;

/// A text as a word of a shell: quoted where it has spaces, quotes and the like.
pub fn quoted(text: &str) -> String {
    if text.contains(char::is_control) {
        return escaped(text);
    }
    // Only NUL cannot be quoted, and it is escaped above.
    shlex::try_quote(text).map_or_else(|_| escaped(text), |quoted| quoted.into_owned())
}

/// A path as a word of a shell, which is no option.
pub fn word(path: impl AsRef<Path>) -> String {
    let text = path.as_ref().to_string_lossy();
    match text.starts_with('-') {
        true => quoted(&format!("./{text}")),
        false => quoted(&text),
    }
}

/// Paths as words of a shell.
pub fn words<P: AsRef<Path>>(paths: impl IntoIterator<Item = P>) -> String {
    let words: Vec<String> = paths.into_iter().map(word).collect();
    words.join(" ")
}

/// A text with letters that a terminal takes as commands, as bash and zsh write them.
fn escaped(text: &str) -> String {
    let letter = |letter: char| match letter {
        '\'' | '\\' => format!("\\{letter}"),
        letter if letter.is_control() => format!("\\u{:04x}", u32::from(letter)),
        letter => letter.into(),
    };
    format!("$'{}'", text.chars().map(letter).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shell_reads_back_what_was_quoted() {
        for path in [
            "plain/a.bag",
            "my data/a b",
            "it's",
            "a\"b",
            "$(x)",
            "*",
            "ä",
            "a;b",
            "~",
        ] {
            assert_eq!(shlex::split(&word(path)).unwrap(), [path]);
        }
        for (path, expected) in [
            ("data/a.mcap", "data/a.mcap"),
            ("my data", "'my data'"),
            ("-x", "./-x"),
            ("a\u{1b}[2J'b", "$'a\\u001b[2J\\'b'"),
        ] {
            assert_eq!(word(path), expected);
        }
        assert_eq!(words(["a b", "c"]), "'a b' c");
    }
}
