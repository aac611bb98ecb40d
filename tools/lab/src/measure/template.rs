//! Placeholders in the arguments and texts of a page: `{seeds}`, `{out}`, `{env:NAME}`.

use eyre::{Result, eyre};

/// What a placeholder begins with that stands for a variable of the environment.
const VARIABLE: &str = "env:";

/// The names of the placeholders of a text, in order.
pub fn names(text: &str) -> Vec<&str> {
    let starts = text.match_indices('{').map(|(at, _)| &text[at + 1..]);
    starts.filter_map(|rest| Some(rest.split_once('}')?.0)).collect()
}

/// The variable of the environment that a placeholder stands for.
pub fn variable(name: &str) -> Option<&str> {
    name.strip_prefix(VARIABLE)
}

/// The text with all placeholders filled.
///
/// # Errors
/// A name for which `value` has nothing.
pub fn fill(text: &str, value: impl Fn(&str) -> Option<String>) -> Result<String> {
    let mut filled = text.to_string();
    for name in names(text) {
        let value = value(name).ok_or_else(|| eyre!("`{text}`: there is no value for `{name}`"))?;
        filled = filled.replace(&format!("{{{name}}}"), &value);
    }
    Ok(filled)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn placeholders_are_found_and_filled() {
        let text = "--log={log}/{seed}.mcap";
        assert_eq!(names(text), ["log", "seed"]);
        let value = |name: &str| (name != "other").then(|| name.to_uppercase());
        assert_eq!(fill(text, value).unwrap(), "--log=LOG/SEED.mcap");
        assert_eq!(fill("no placeholder }", value).unwrap(), "no placeholder }");
        assert!(fill("{other}", value).unwrap_err().to_string().contains("`other`"));
        assert_eq!((variable("env:HOME"), variable("home")), (Some("HOME"), None));
    }
}
