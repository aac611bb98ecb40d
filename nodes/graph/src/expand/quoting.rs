//! Parameters with spaces. Each word of one is a word of the command line, so that a module takes settings that way; a name with a
//! space in it needs quotes of its own.

use std::collections::BTreeMap;
use std::path::Path;

use realo_documents::shown;

use crate::params;

/// Refuses a parameter of which a file's name or another value is cut at its spaces. `args` names the parameters; `root` is the
/// graph's folder.
pub(super) fn check(args: &str, given: &BTreeMap<String, String>, root: &Path) -> Result<(), String> {
    for name in params::named(args) {
        let Some((key, value)) = given.iter().find(|(key, _)| key.to_lowercase() == name) else {
            continue;
        };
        let Some(words) = shlex::split(value).filter(|words| words.len() > 1) else {
            continue;
        };
        let (key, text) = (shown(key), shown(value));
        let mend =
            format!("spaces separate a value from its settings: quote a value that has some, as {key}: \"'{text}'\"");
        if root.join(value).exists() {
            return Err(format!(
                "parameter `{key}`: expected a value in quotes, found a file whose name has spaces, `{text}`; {mend}"
            ));
        }
        if let Some(word) = words[1..].iter().find(|word| !word.contains('=')) {
            let word = shown(word);
            return Err(format!(
                "parameter `{key}`: expected a value and settings `key=value` behind it, found `{word}` in `{text}`; {mend}"
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_that_is_cut_at_its_spaces_is_refused_with_how_to_quote_it() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a repeat=3.mcap"), "").unwrap();
        let check = |value: &str| {
            let given = [("log".to_string(), value.to_string())].into();
            check("node player log=$PARAM_LOG ego=cav1", &given, folder.path())
        };
        for fine in [
            "a.mcap",
            "a.mcap repeat=3",
            "'a repeat=3.mcap'",
            "'my logs/a.mcap' repeat=3",
            "'",
            "",
        ] {
            assert_eq!(check(fine), Ok(()), "{fine}");
        }
        let said = check("a repeat=3.mcap").unwrap_err();
        assert!(
            said.contains("a file whose name has spaces") && said.contains("log: \"'a repeat=3.mcap'\""),
            "{said}"
        );
        let said = check("../my logs/a.mcap").unwrap_err();
        assert!(
            said.contains("found `logs/a.mcap` in `../my logs/a.mcap`") && said.contains("quote"),
            "{said}"
        );
        let others = [("log".to_string(), "a b".to_string())].into();
        assert_eq!(
            super::check("node player ego=cav1", &others, folder.path()),
            Ok(()),
            "it is not named"
        );
    }
}
