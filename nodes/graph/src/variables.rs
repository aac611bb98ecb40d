//! What a graph says once for all its nodes: entries of its `env`, named in their settings.

use std::collections::BTreeMap;

use serde_yaml::{Mapping, Value};

/// Replaces `$NAME` and `${NAME}` where `value` knows NAME, once, from left to right; anything else stays as it is.
/// `$PARAM_NAME` is left to modules.
pub fn with_variables(text: &str, value: impl Fn(&str) -> Option<String>) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find('$') {
        out.push_str(&rest[..start]);
        rest = &rest[start..];
        let (token, name) = token(rest);
        match name.and_then(&value) {
            Some(value) => out.push_str(&value),
            None => out.push_str(token),
        }
        rest = &rest[token.len()..];
    }
    out + rest
}

/// The first variable or parameter that a text names.
pub(super) fn named(text: &str) -> Option<&str> {
    let (start, _) = text.match_indices('$').find(|(start, _)| {
        let rest = &text[*start..];
        token(rest).0.len() > 1 || rest.starts_with("${")
    })?;
    Some(token(&text[start..]).0)
}

/// The token at the head of a text that begins with `$`, and the name of the variable that it is.
fn token(text: &str) -> (&str, Option<&str>) {
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let braced = text.starts_with("${");
    let start = if braced { 2 } else { 1 };
    let end = text[start..]
        .find(|c| !is_name(c))
        .map_or(text.len(), |end| start + end);
    let name = &text[start..end];
    let is_closed = !braced || text[end..].starts_with('}');
    if name.is_empty() || name.starts_with(|c: char| c.is_ascii_digit()) || !is_closed {
        return (&text[..1], None);
    }
    let token = &text[..end + usize::from(braced)];
    (token, Some(name).filter(|name| !name.starts_with("PARAM_")))
}

/// The entries of a graph's `env` that say all themselves: those that name variables of the system are dora's to fill in.
pub(super) fn of_graph(settings: &Mapping) -> BTreeMap<String, String> {
    let entries = settings.get("env").and_then(Value::as_mapping);
    let entry = |(name, value): (&Value, &Value)| {
        let text = match value {
            Value::String(text) => text.clone(),
            Value::Bool(truth) => truth.to_string(),
            Value::Number(number) => number.to_string(),
            _ => return None,
        };
        Some((name.as_str()?.to_string(), text)).filter(|(_, text)| !text.contains('$'))
    };
    entries.into_iter().flatten().filter_map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_whole_names_once() {
        let value = |name: &str| match name {
            "MODEL" => Some("a b/$OUT".to_string()),
            "OUT" => Some("x".to_string()),
            "PARAM_A" => Some("never".to_string()),
            _ => None,
        };
        let cases = [
            ("head.model=$MODEL", "head.model=a b/$OUT"),
            ("${OUT}/$OUT.mcap", "x/x.mcap"),
            (
                "$OUTS $ $1 ${OUT $PARAM_A ${PARAM_A} ${_param.a}",
                "$OUTS $ $1 ${OUT $PARAM_A ${PARAM_A} ${_param.a}",
            ),
            ("ü$$OUT", "ü$x"),
        ];
        for (text, expected) in cases {
            assert_eq!(with_variables(text, value), expected, "{text}");
        }
    }

    #[test]
    fn finds_what_is_left() {
        let cases = [
            ("model=$MODEL", Some("$MODEL")),
            ("a=$PARAM_A", Some("$PARAM_A")),
            ("a=${_param.a}", Some("$")),
            ("a=5$ $1 $$", None),
        ];
        for (text, expected) in cases {
            assert_eq!(named(text), expected, "{text}");
        }
    }
}
