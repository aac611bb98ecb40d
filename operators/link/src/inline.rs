//! Profiles in a word: `delay_ms=90,loss=0.05`, and changes of a profile: `paper,boxes.loss=0.05`.

use std::path::Path;

use realo_documents::shown;
use realo_operator::config::nearest_name;
use realo_schemas::Kind;

use super::medium::Phase;
use super::profile::{CARRIED, Channel, Model, Profile, ProfileError};

/// Keys of a kind.
const KEYS: [&str; 8] = [
    "delay_ms",
    "fixed_ms",
    "bits_per_second",
    "jitter.uniform_ms",
    "jitter.gaussian_ms",
    "step_ms",
    "loss",
    "duplicate",
];
const CHANNEL_KEYS: [&str; 3] = ["channel.bits_per_second", "channel.queue_ms", "channel.half_duplex"];
/// A trace is a profile of its own.
const TRACE: &str = "channel.trace=";
/// The largest rate; f64 still holds all whole numbers up to here.
const MOST_BITS: f64 = 9e15;

/// Whether a profile is written in a word rather than named.
pub(super) fn is_inline(text: &str) -> bool {
    let is_file = |text: &str| {
        [".toml", ".yml", ".yaml", ".csv"]
            .iter()
            .any(|ending| text.ends_with(ending))
    };
    text.contains('=') && (!is_file(text) || text.starts_with(TRACE))
}

/// A profile with the name or file in it, if there is one, as `named` gives it: `/home/me/radio.toml,loss=0.1` for
/// `radio.toml,loss=0.1`.
pub fn with_base(text: &str, named: impl FnOnce(&str) -> String) -> String {
    if !is_inline(text) {
        return named(text);
    }
    match text.split_once(',') {
        Some((base, rest)) if !base.contains('=') => format!("{},{rest}", named(base)),
        _ => text.into(),
    }
}

/// The profile that is written in a word.
pub(super) fn read(text: &str) -> Result<Profile, ProfileError> {
    let wrong = |reason: String| ProfileError::Inline {
        text: shown(text),
        reason,
    };
    let mut words: Vec<&str> = text.split(',').map(str::trim).collect();
    let mut profile = match words.first() {
        Some(base) if !base.contains('=') => Profile::load(words.remove(0))?,
        _ => Profile::default(),
    };
    let mut settings = Vec::new();
    for word in words {
        let (key, value) = word
            .split_once('=')
            .ok_or_else(|| wrong(format!("`{}` is not of the form key=value", shown(word))))?;
        if settings.iter().any(|(known, _)| *known == key) {
            return Err(wrong(format!("`{}` is given twice", shown(key))));
        }
        settings.push((key, value));
    }
    // What is for all kinds first, whatever the order: a kind's own value stands above it.
    settings.sort_by_key(|(key, _)| kind_of(key).is_some());
    for (key, value) in settings {
        set(&mut profile, key, value)
            .map_err(|reason| wrong(format!("`{}={}`: {reason}", shown(key), shown(value))))?;
    }
    profile.check(&shown(text))?;
    Ok(profile)
}

/// The kind that a key is for, and the rest of the key.
fn kind_of(key: &str) -> Option<(Kind, &str)> {
    let (kind, rest) = key.split_once('.')?;
    let kind = CARRIED.into_iter().find(|known| known.as_str() == kind)?;
    Some((kind, rest))
}

fn set(profile: &mut Profile, key: &str, value: &str) -> Result<(), String> {
    if TRACE.strip_suffix('=') == Some(key) {
        return Err(format!(
            "a trace goes first, by its file alone: `{value}`, or `{value},channel.queue_ms=200`"
        ));
    }
    if key.starts_with("channel.") {
        return set_channel(&mut profile.channel, key, value);
    }
    if let Some((kind, rest)) = kind_of(key) {
        let default = profile.default;
        return set_model(profile.kinds.entry(kind).or_insert(default), rest, key, value);
    }
    set_model(&mut profile.default, key, key, value)?;
    profile
        .kinds
        .values_mut()
        .try_for_each(|model| set_model(model, key, key, value))
}

fn set_model(model: &mut Model, key: &str, written: &str, value: &str) -> Result<(), String> {
    match key {
        "delay_ms" | "fixed_ms" => model.fixed_ms = number(value)?,
        "bits_per_second" => model.bits_per_second = Some(bits(value)?),
        "jitter.uniform_ms" => model.jitter.uniform_ms = number(value)?,
        "jitter.gaussian_ms" => model.jitter.gaussian_ms = number(value)?,
        "step_ms" => model.step_ms = number(value)?,
        "loss" => model.loss = number(value)?,
        "duplicate" => model.duplicate = number(value)?,
        _ => return Err(unknown(written)),
    }
    Ok(())
}

fn set_channel(channel: &mut Option<Channel>, key: &str, value: &str) -> Result<(), String> {
    if !CHANNEL_KEYS.contains(&key) {
        return Err(unknown(key));
    }
    let empty = Channel {
        phases: Vec::new(),
        queue_ms: None,
        half_duplex: false,
    };
    let channel = channel.get_or_insert(empty);
    match key {
        "channel.bits_per_second" => {
            channel.phases = vec![Phase {
                from: 0,
                bits_per_second: bits(value)?,
                delay_ms: 0.0,
                loss: 0.0,
            }];
        }
        "channel.queue_ms" => channel.queue_ms = Some(number(value)?),
        _ => {
            let flag = value.parse();
            channel.half_duplex = flag.map_err(|_| "expected true or false".to_string())?;
        }
    }
    Ok(())
}

fn number(value: &str) -> Result<f64, String> {
    let number = value.replace('_', "").parse::<f64>().ok();
    number
        .filter(|number| number.is_finite())
        .ok_or_else(|| "expected a number".into())
}

fn bits(value: &str) -> Result<u64, String> {
    let number = number(value)?;
    match (1.0..=MOST_BITS).contains(&number) && number.fract() == 0.0 {
        true => Ok(number as u64),
        false => Err("expected a whole number of bits per second, at least 1".into()),
    }
}

fn unknown(key: &str) -> String {
    let (kind, own) = kind_of(key).map_or((None, key), |(kind, own)| (Some(kind), own));
    let known = KEYS.into_iter().chain(CHANNEL_KEYS);
    let hint = nearest_name(own, known).map(|near| match kind {
        Some(kind) => format!(" (did you mean `{kind}.{near}`?)"),
        None => format!(" (did you mean `{near}`?)"),
    });
    let all: Vec<&str> = KEYS.into_iter().chain(CHANNEL_KEYS).collect();
    format!(
        "unknown key{}; there are: {}; for one kind alone behind points., features., boxes. or agent_state.",
        hint.unwrap_or_default(),
        all.join(", ")
    )
}

/// How a profile is named in results: a file without its folder and ending.
pub fn in_words(text: &str) -> String {
    let stem = |text: &str| {
        Path::new(text)
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    with_base(text, stem)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(text: &str) -> Profile {
        Profile::load(text).unwrap_or_else(|error| panic!("{text}: {error}"))
    }

    #[test]
    fn a_profile_in_a_word_is_the_file_that_says_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("radio.toml");
        let text = "[default]\nfixed_ms = 100\nloss = 0.05\njitter = { gaussian_ms = 1.5 }\nbits_per_second = 27_000_000\n\
                    [channel]\nbits_per_second = 6_000_000\nqueue_ms = 100\nhalf_duplex = true";
        std::fs::write(&file, text).unwrap();
        let inline = "delay_ms=100,loss=0.05,jitter.gaussian_ms=1.5,bits_per_second=27e6,channel.bits_per_second=6_000_000,\
                      channel.queue_ms=100,channel.half_duplex=true";
        assert_eq!(load(inline), load(file.to_str().unwrap()));
        assert_eq!(load("fixed_ms=100"), load("delay_ms=100"));
        let changed = load(&format!("{},boxes.loss=0.5", file.display()));
        assert_eq!(changed.model(Kind::Boxes).loss, 0.5);
        assert_eq!(
            changed.model(Kind::Boxes).fixed_ms,
            100.0,
            "a kind begins with what holds for all"
        );
        assert_eq!(changed.model(Kind::Points).loss, 0.05);
    }

    #[test]
    fn a_change_for_all_kinds_changes_each_and_a_kind_stands_above() {
        let paper = load("paper");
        let changed = load("paper,boxes.loss=0.2,loss=0.05");
        for kind in CARRIED {
            let expected = if kind == Kind::Boxes { 0.2 } else { 0.05 };
            assert_eq!(changed.model(kind).loss, expected, "{kind}");
            assert_eq!(changed.model(kind).fixed_ms, paper.model(kind).fixed_ms, "{kind}");
        }
    }

    #[test]
    fn refuses_with_the_key_and_the_nearest() {
        for (text, expected) in [
            (
                "dlay_ms=100",
                "unknown key (did you mean `delay_ms`?); there are: delay_ms, fixed_ms",
            ),
            ("boxes.los=0.1", "(did you mean `boxes.loss`?)"),
            ("channel.queue=5", "(did you mean `channel.queue_ms`?)"),
            ("loss=5%", "`loss=5%`: expected a number"),
            (
                "loss=1.5",
                "`loss` of default: expected a probability, 0 to 1, found 1.5",
            ),
            ("delay_ms=-1", "expected 0 to 3600000 ms"),
            ("delay_ms=nan", "expected a number"),
            ("bits_per_second=0", "at least 1"),
            ("loss=0.1,loss=0.2", "given twice"),
            ("loss=0.1,paper", "`paper` is not of the form key=value"),
            ("papr,loss=0.1", "did you mean `paper`"),
            ("channel.queue_ms=5", "channel.bits_per_second"),
        ] {
            match Profile::load(text) {
                Ok(profile) => panic!("{text}: {profile:?}"),
                Err(error) => assert!(error.to_string().contains(expected), "{text}: {error}"),
            }
        }
    }

    #[test]
    fn results_name_it_without_folders() {
        for (text, expected) in [
            ("paper", "paper"),
            ("/home/me/radio.toml", "radio"),
            ("delay_ms=100,loss=0.05", "delay_ms=100,loss=0.05"),
            ("/home/me/radio.toml,loss=0.05", "radio,loss=0.05"),
        ] {
            assert_eq!(in_words(text), expected);
        }
    }
}
