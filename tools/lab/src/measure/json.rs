//! Paths into JSON: `/accuracy/sorted/mAP/0.3`, and `/methods/name=grid/median_ms` for an element of a list.

use eyre::{Result, bail};
use serde_json::Value;

/// The value at a path; the path `` is the value itself.
///
/// # Errors
/// The first part of the path that is not there.
pub fn find<'a>(value: &'a Value, path: &str) -> Result<&'a Value> {
    let mut found = value;
    for part in path.split('/').skip(1) {
        found = match part_of(found, part) {
            Some(inner) => inner,
            None => bail!("`{path}`: there is no `{part}`{}", known(found)),
        };
    }
    Ok(found)
}

fn part_of<'a>(value: &'a Value, part: &str) -> Option<&'a Value> {
    match value {
        Value::Object(fields) => fields.get(part),
        Value::Array(elements) => match part.split_once('=') {
            Some((field, wanted)) => elements.iter().find(|element| element[field] == wanted),
            None => elements.get(part.parse::<usize>().ok()?),
        },
        _ => None,
    }
}

/// What there is instead, for the message.
fn known(value: &Value) -> String {
    match value {
        Value::Object(fields) => format!(", but: {}", fields.keys().cloned().collect::<Vec<_>>().join(", ")),
        Value::Array(elements) => format!("; the list has {} elements", elements.len()),
        other => format!(" in {other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn paths_lead_through_objects_and_lists() {
        let value =
            json!({ "mAP": { "0.3": 0.9, "0.5": null }, "methods": [{ "name": "a" }, { "name": "b", "ms": 2 }] });
        for (path, expected) in [
            ("/mAP/0.3", json!(0.9)),
            ("/mAP/0.5", json!(null)),
            ("/methods/0/name", json!("a")),
            ("/methods/name=b/ms", json!(2)),
        ] {
            assert_eq!(*find(&value, path).unwrap(), expected, "{path}");
        }
        assert_eq!(*find(&value, "").unwrap(), value);
    }

    #[test]
    fn a_part_that_is_missing_is_named() {
        let value = json!({ "mAP": { "0.3": 0.9 }, "list": [1] });
        for (path, expected) in [
            ("/mAP/0.7", "there is no `0.7`, but: 0.3"),
            ("/list/name=x", "there is no `name=x`; the list has 1 elements"),
            ("/mAP/0.3/x", "there is no `x` in 0.9"),
        ] {
            assert!(find(&value, path).unwrap_err().to_string().contains(expected), "{path}");
        }
    }
}
