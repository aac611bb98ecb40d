//! `key=value` settings to typed configurations.

use std::fmt;

use serde::Serialize;
use serde_json::Value;

use crate::StageSettings;

/// Why an operator's settings were refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// Not of the form `key=value`.
    #[error("setting `{0}` is not of the form key=value")]
    Form(String),
    /// A key that the operator does not have.
    #[error("unknown setting `{key}`{}; it takes: {}", did_you_mean(.nearest), .known.join(", "))]
    Unknown {
        /// The key.
        key: String,
        /// The most similar key that exists.
        nearest: Option<String>,
        /// All keys.
        known: Vec<String>,
    },
    /// The same key twice.
    #[error("setting `{key}` is given twice, as `{first}` and as `{second}`: keep one")]
    Twice {
        /// The key.
        key: String,
        /// The first value.
        first: String,
        /// The second one.
        second: String,
    },
    /// A value that does not fit.
    #[error("setting `{key}`: `{value}` does not fit: {reason}")]
    Value {
        /// The key.
        key: String,
        /// The value as written.
        value: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A value outside the range of the setting.
    #[error("setting `{key}`: expected {expected}, found {found}")]
    Range {
        /// The key.
        key: &'static str,
        /// The range, in words.
        expected: &'static str,
        /// The value.
        found: String,
    },
}

impl ConfigError {
    /// A value outside a range, both in words.
    pub fn range(key: &'static str, expected: &'static str, found: &impl fmt::Display) -> Self {
        let found = found.to_string();
        ConfigError::Range { key, expected, found }
    }
}

/// ` (did you mean …?)` of the nearest name, or nothing.
pub fn did_you_mean(nearest: &Option<String>) -> String {
    nearest
        .as_ref()
        .map(|name| format!(" (did you mean `{name}`?)"))
        .unwrap_or_default()
}

/// Names that are longer are like no other.
const LONGEST: usize = 64;

/// The known name that is most like `name`, if one is near enough to be a slip.
pub fn nearest_name<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    let is_short = |name: &str| name.len() <= LONGEST;
    known
        .into_iter()
        .filter(|candidate| is_short(name) && is_short(candidate))
        .map(|candidate| (strsim::damerau_levenshtein(name, candidate), candidate))
        .filter(|(distance, candidate)| *distance <= 1 + candidate.len().max(name.len()) / 3)
        .min()
        .map(|(_, candidate)| candidate.to_string())
}

/// The keys of a configuration with their defaults.
pub fn defaults<C: Serialize + Default>() -> serde_json::Map<String, Value> {
    match serde_json::to_value(C::default()) {
        Ok(Value::Object(map)) => map,
        _ => serde_json::Map::new(),
    }
}

/// Builds a configuration from `key=value` settings over its defaults.
///
/// A value is read as YAML; where the default is a text the value is taken as it stands, where it is a list
/// `a,b` means `[a, b]`.
///
/// # Errors
/// [`ConfigError`] names the key, what was expected and what was found.
pub fn parse<C: StageSettings>(args: &[String]) -> Result<C, ConfigError> {
    let mut values = defaults::<C>();
    let mut seen: Vec<(&str, &str)> = Vec::new();
    for arg in args {
        let (key, text) = arg.split_once('=').ok_or_else(|| ConfigError::Form(arg.clone()))?;
        if let Some((_, first)) = seen.iter().find(|(known, _)| *known == key) {
            return Err(ConfigError::Twice {
                key: key.into(),
                first: first.to_string(),
                second: text.into(),
            });
        }
        seen.push((key, text));
        let Some(default) = values.get(key) else {
            return Err(ConfigError::Unknown {
                key: key.into(),
                nearest: nearest_name(key, values.keys().map(String::as_str)),
                known: values.keys().cloned().collect(),
            });
        };
        let bad = |reason: String| ConfigError::Value {
            key: key.into(),
            value: text.into(),
            reason,
        };
        let value = read_value(default, text).map_err(bad)?;
        // One key at a time, so that an error names the key it belongs to.
        let mut one = defaults::<C>();
        one.insert(key.into(), value.clone());
        let read = serde_json::from_value::<C>(Value::Object(one));
        read.map_err(|error| bad(without_types::<C>(key, &error.to_string())))?;
        values.insert(key.into(), value);
    }
    let settings: C = serde_json::from_value(Value::Object(values)).map_err(|error| ConfigError::Value {
        key: seen.iter().map(|(key, _)| *key).collect::<Vec<_>>().join(" "),
        value: args.join(" "),
        reason: error.to_string(),
    })?;
    settings.check()?;
    Ok(settings)
}

/// What serde expects of a number, in words that name no type of Rust, with the range of the setting.
fn without_types<C: StageSettings>(key: &str, error: &str) -> String {
    let of = error.rsplit(' ').next().unwrap_or_default();
    let what = match of {
        "f32" | "f64" => "a number",
        "i8" | "i16" | "i32" | "i64" | "isize" | "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number",
        _ => return error.into(),
    };
    let setting = C::SETTINGS.iter().find(|setting| setting.name == key);
    let range = setting.and_then(|setting| setting.range);
    if let (Some(range), Some(max)) = (range.and_then(|range| range.strip_prefix("at least ")), max_of(of)) {
        return format!("expected {what} from {range} to {max}");
    }
    match range {
        Some(range) => format!("expected {what}, {range}"),
        None if of.starts_with('u') => match max_of(of) {
            Some(max) => format!("expected {what} from 0 to {max}"),
            None => format!("expected {what}, at least 0"),
        },
        None => format!("expected {what}"),
    }
}

/// The greatest whole number of a type that people may exceed.
fn max_of(name: &str) -> Option<u32> {
    match name {
        "u8" => Some(u8::MAX.into()),
        "u16" => Some(u16::MAX.into()),
        "u32" => Some(u32::MAX),
        _ => None,
    }
}

fn read_value(default: &Value, text: &str) -> Result<Value, String> {
    match default {
        Value::String(_) => Ok(Value::String(text.into())),
        Value::Array(_) if !text.trim_start().starts_with('[') => {
            let items = text.split(',').map(str::trim).filter(|item| !item.is_empty());
            Ok(Value::Array(items.map(read_yaml).collect::<Result<_, _>>()?))
        }
        _ if text.trim().is_empty() => {
            Err("expected a value, found nothing; leave the setting out to get its default".into())
        }
        _ => read_yaml(text),
    }
}

/// Reads a value that is not a text.
fn read_yaml(text: &str) -> Result<Value, String> {
    // YAML's become null, which means something else; those of other languages would be texts.
    let word = text.trim().trim_start_matches(['+', '-', '.']).to_ascii_lowercase();
    if ["nan", "inf", "infinity"].contains(&word.as_str()) {
        return Err("expected a finite number".into());
    }
    if text.trim().parse::<f64>().is_ok_and(f64::is_infinite) {
        return Err("expected a finite number, at most about 1.8e308".into());
    }
    realo_documents::yaml(text)
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Debug, PartialEq, crate::Settings, Serialize, Deserialize)]
    struct Settings {
        /// IoU.
        #[setting(default = 0.15, range = 0.0..=1.0)]
        threshold: f64,
        /// Name.
        #[setting(default = "cav1", role = "ego")]
        ego: String,
        /// Names.
        agents: Vec<String>,
        /// A file.
        model: std::path::PathBuf,
        /// A name or a file.
        #[setting(path, filled, default = "perfect")]
        profile: String,
        /// Time, ms.
        #[setting(range = 1..)]
        window_ms: Option<u32>,
        /// A part.
        #[setting(flatten)]
        #[serde(flatten)]
        part: Part,
        /// Time by time.
        #[setting(default = 1.0, range = 0.0<..=8.0)]
        rate: f64,
    }

    #[derive(Debug, PartialEq, crate::Settings, Serialize, Deserialize)]
    struct Part {
        /// Threads.
        #[setting(default = 2, range = 1..)]
        threads: usize,
    }

    fn read(args: &[&str]) -> Result<Settings, ConfigError> {
        parse(&args.iter().map(|arg| arg.to_string()).collect::<Vec<_>>())
    }

    #[test]
    fn reads_values_over_defaults() {
        let settings = read(&["threshold=0.3", "ego=7", "agents=a, b", "window_ms=5", "threads=3"]).unwrap();
        let expected = Settings {
            threshold: 0.3,
            ego: "7".into(),
            agents: vec!["a".into(), "b".into()],
            model: "".into(),
            profile: "perfect".into(),
            window_ms: Some(5),
            part: Part { threads: 3 },
            rate: 1.0,
        };
        assert_eq!(settings, expected);
        assert_eq!(read(&[]).unwrap(), Settings::default());
    }

    #[test]
    fn refuses_with_the_nearest_name() {
        let error = read(&["treshold=1"]).unwrap_err().to_string();
        assert!(
            error.contains("`treshold`") && error.contains("did you mean `threshold`"),
            "{error}"
        );
        let error = read(&["threshold=many"]).unwrap_err().to_string();
        assert!(error.contains("`threshold`") && error.contains("`many`"), "{error}");
        let error = read(&["ego=a", "ego=b"]).unwrap_err().to_string();
        assert_eq!(error, "setting `ego` is given twice, as `a` and as `b`: keep one");
        assert_eq!(read(&["ego"]), Err(ConfigError::Form("ego".into())));
    }
    #[test]
    fn refuses_what_is_out_of_range() {
        assert!(read(&["threshold=1", "window_ms=null", "rate=8"]).is_ok());
        assert!(read(&["rate=1e-9"]).is_ok());
        let cases = [
            ("threshold=1.01", "setting `threshold`: expected 0 to 1, found 1.01"),
            (
                "threshold=.nan",
                "setting `threshold`: `.nan` does not fit: expected a finite number",
            ),
            (
                "window_ms=-.INF",
                "setting `window_ms`: `-.INF` does not fit: expected a finite number",
            ),
            (
                "window_ms=inf",
                "setting `window_ms`: `inf` does not fit: expected a finite number",
            ),
            (
                "threshold=NaN",
                "setting `threshold`: `NaN` does not fit: expected a finite number",
            ),
            (
                "window_ms=",
                "setting `window_ms`: `` does not fit: expected a value, found nothing; leave the setting out to get its default",
            ),
            (
                "threshold=1e999",
                "setting `threshold`: `1e999` does not fit: expected a finite number, at most about 1.8e308",
            ),
            (
                "threads=-1",
                "setting `threads`: `-1` does not fit: expected a whole number, at least 1",
            ),
            (
                "window_ms=99999999999",
                "setting `window_ms`: `99999999999` does not fit: expected a whole number from 1 to 4294967295",
            ),
            (
                "threshold=many",
                "setting `threshold`: `many` does not fit: expected a number, 0 to 1",
            ),
            ("profile=", "setting `profile`: expected a value, found nothing"),
            ("window_ms=0", "setting `window_ms`: expected at least 1, found 0"),
            ("threads=0", "setting `threads`: expected at least 1, found 0"),
            ("rate=0", "setting `rate`: expected above 0, up to 8, found 0"),
            ("rate=9", "setting `rate`: expected above 0, up to 8, found 9"),
            (
                "rate=.inf",
                "setting `rate`: `.inf` does not fit: expected a finite number",
            ),
        ];
        for (arg, expected) in cases {
            assert_eq!(read(&[arg]).unwrap_err().to_string(), expected);
        }
    }

    #[test]
    fn a_setting_has_what_its_field_says() {
        let [threshold, ego, ..] = Settings::SETTINGS else {
            panic!()
        };
        assert_eq!(
            (threshold.name, threshold.about, threshold.range),
            ("threshold", "IoU", Some("0 to 1"))
        );
        assert_eq!((ego.role, ego.range), (Some("ego"), None));
        let names = Settings::SETTINGS.iter().map(|setting| setting.name);
        let expected = [
            "threshold",
            "ego",
            "agents",
            "model",
            "profile",
            "window_ms",
            "threads",
            "rate",
        ];
        assert_eq!(names.collect::<Vec<_>>(), expected);
        let paths = Settings::SETTINGS.iter().filter(|setting| setting.is_path);
        let paths: Vec<&str> = paths.map(|setting| setting.name).collect();
        assert_eq!(paths, ["model", "profile"]);
    }
}
