//! A module's parameters in the `args` of its nodes.

use std::collections::BTreeMap;

/// Bytes of a node's `args`: more than systems take.
const MAX_ARGS: usize = 1 << 20;

/// Replaces `$PARAM_KEY` (the longest name wins) and `${_param.key}`, once, from left to right; what no parameter
/// names stays as it is.
///
/// # Errors
/// What would become longer than [`MAX_ARGS`].
pub(super) fn substitute(text: &str, params: &BTreeMap<String, String>) -> Result<String, String> {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find('$') {
        out.push_str(&rest[..start]);
        rest = &rest[start..];
        let (token, value) = token(rest, params);
        out.push_str(value.unwrap_or(token));
        rest = &rest[token.len()..];
        if out.len() + rest.len() > MAX_ARGS {
            return Err(format!(
                "`args`: expected at most {MAX_ARGS} bytes with the parameters in it, found more"
            ));
        }
    }
    Ok(out + rest)
}

/// The parameters that a text names, in small letters.
pub(super) fn named(text: &str) -> Vec<String> {
    let starts = text.match_indices('$').map(|(start, _)| &text[start..]);
    let none = BTreeMap::new();
    let name = |rest: &str| {
        let (token, _) = token(rest, &none);
        let braced = || token.strip_prefix("${_param.")?.strip_suffix('}');
        let name = token.strip_prefix("$PARAM_").or_else(braced)?;
        Some(name.to_lowercase()).filter(|name| !name.is_empty())
    };
    starts.filter_map(name).collect()
}

/// The token at the head of `text`, and its value if a parameter has it.
fn token<'a>(text: &'a str, params: &'a BTreeMap<String, String>) -> (&'a str, Option<&'a str>) {
    if let Some(after) = text.strip_prefix("${_param.") {
        let Some(end) = after.find('}') else {
            return ("${_param.", None);
        };
        let token = &text[..text.len() - after.len() + end + 1];
        return (token, params.get(&after[..end]).map(String::as_str));
    }
    if let Some(after) = text.strip_prefix("$PARAM_") {
        let name = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let end = after.find(|c| !name(c)).unwrap_or(after.len());
        let found = params.iter().find(|(key, _)| key.to_uppercase() == after[..end]);
        return (
            &text[..text.len() - after.len() + end],
            found.map(|(_, value)| value.as_str()),
        );
    }
    (&text[..1], None)
}

/// Checks the names: letters, digits and `_`, unique without regard to case.
pub(super) fn check_names(params: &BTreeMap<String, String>) -> Result<(), String> {
    let mut seen: BTreeMap<String, &str> = BTreeMap::new();
    for key in params.keys() {
        if key.is_empty() || !key.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') {
            return Err(format!("parameter `{key}`: a name has letters, digits and `_` only"));
        }
        if let Some(other) = seen.insert(key.to_uppercase(), key) {
            return Err(format!(
                "parameters `{other}` and `{key}` differ in case only; rename one"
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn substitutes_once_and_by_whole_names() {
        let pairs = [("speed", "3"), ("speed_limit", "$PARAM_SPEED"), ("a", "1")];
        let params = pairs.map(|(key, value)| (key.to_string(), value.to_string())).into();
        let cases = [
            ("x=$PARAM_SPEED y", "x=3 y"),
            ("$PARAM_SPEED_LIMIT", "$PARAM_SPEED"),
            ("$PARAM_SPEED_LIMITS", "$PARAM_SPEED_LIMITS"),
            (
                "${_param.speed}m ${_param.Speed} ${_param.a",
                "3m ${_param.Speed} ${_param.a",
            ),
            ("$$PARAM_A $ ${HOME} ü$PARAM_A", "$1 $ ${HOME} ü1"),
        ];
        for (text, expected) in cases {
            assert_eq!(substitute(text, &params).as_deref(), Ok(expected), "{text}");
        }
    }

    #[test]
    fn knows_what_a_text_names() {
        let text = "host $PARAM_LANE ${_param.More} a=$PARAM_OUT/x $5 $PARAM_ ${_param.a $HOME";
        assert_eq!(named(text), ["lane", "more", "out"]);
    }

    #[test]
    fn refuses_what_parameters_make_too_long() {
        let params = [("a".to_string(), "x".repeat(10_000))].into();
        assert!(
            substitute(&"$PARAM_A".repeat(10_000), &params)
                .unwrap_err()
                .contains("1048576 bytes")
        );
    }

    #[test]
    fn refuses_names_that_collide() {
        let params = |keys: &[&str]| keys.iter().map(|key| (key.to_string(), String::new())).collect();
        assert!(check_names(&params(&["mode", "Mode"])).unwrap_err().contains("case"));
        assert!(check_names(&params(&["a-b"])).is_err());
        assert_eq!(check_names(&params(&["a_b", "c"])), Ok(()));
    }
}
