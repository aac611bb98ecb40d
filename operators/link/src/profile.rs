//! Channel models from files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use realo_operator::config::{did_you_mean, nearest_name};
use realo_schemas::{Kind, report};
use serde::Deserialize;

use crate::inline;
use crate::medium::Phase;

/// Profiles that need no file: name and text.
pub const BUILT_IN: &[(&str, &str)] = &[
    ("perfect", include_str!("../profiles/perfect.toml")),
    ("paper", include_str!("../profiles/paper.toml")),
    ("cv2x-measured", include_str!("../profiles/cv2x-measured.toml")),
];

/// No delay in a profile may be greater, ms.
const LONGEST_MS: f64 = 3_600_000.0;

/// Kinds that a link carries.
pub(super) const CARRIED: [Kind; 4] = [Kind::Points, Kind::Features, Kind::Boxes, Kind::AgentState];

/// What a channel does, by kind of content.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Profile {
    /// One line.
    pub about: String,
    /// For kinds without a model of their own.
    pub default: Model,
    /// By kind.
    pub kinds: BTreeMap<Kind, Model>,
    /// What all packets share; `None`: each crosses as if it was alone.
    pub channel: Option<Channel>,
}

/// What the packets of a link share.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Its course; there is a phase, and they begin one after the other.
    pub phases: Vec<Phase>,
    /// What a packet may wait for those before it, ms; one that would wait longer is lost. `None`: any time.
    pub queue_ms: Option<f64>,
    /// Whether all ways between agents are one.
    pub half_duplex: bool,
}

/// A profile as it is written.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Written {
    about: String,
    default: Model,
    kinds: BTreeMap<Kind, Model>,
    channel: Option<WrittenChannel>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct WrittenChannel {
    bits_per_second: Option<u64>,
    /// A file of phases; without a folder it lies beside the profile.
    trace: Option<PathBuf>,
    queue_ms: Option<f64>,
    half_duplex: bool,
}

/// What a channel does to packets of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Model {
    /// Delay of a packet without bytes, ms.
    pub fixed_ms: f64,
    /// Rate at which bytes cross; `None` takes no time.
    pub bits_per_second: Option<u64>,
    /// Random part of the delay.
    pub jitter: Jitter,
    /// Delays are cut down to whole multiples of this, ms; 0: they are not.
    pub step_ms: f64,
    /// Probability that a packet is lost.
    pub loss: f64,
    /// Probability that one more copy of a packet arrives.
    pub duplicate: f64,
}

/// Random part of a delay, the sum of both; the delay as a whole is never below 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Jitter {
    /// Width w of a uniform part in [-w, w], ms.
    pub uniform_ms: f64,
    /// Standard deviation of a Gaussian part of mean 0, ms.
    pub gaussian_ms: f64,
}

/// Why a profile cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ProfileError {
    /// Neither a built-in name nor a file's.
    #[error(
        "unknown link profile `{name}`{hint}; built in: {}; or a file that ends in .toml, .yml or .yaml, or settings: \
         delay_ms=90,loss=0.05",
        names()
    )]
    Unknown {
        /// The name.
        name: String,
        /// The nearest name.
        hint: String,
    },
    /// Settings in a word that are none.
    #[error("link profile `{text}`: {reason}")]
    Inline {
        /// The word.
        text: String,
        /// What is wrong.
        reason: String,
    },
    /// A file that cannot be read.
    #[error("link profile {path}: {reason}")]
    Read {
        /// The file.
        path: String,
        /// Why.
        reason: std::io::Error,
    },
    /// A file that is no profile.
    #[error("link profile {path}: {reason}")]
    Syntax {
        /// The file.
        path: String,
        /// What is wrong and where.
        reason: String,
    },
    /// A number that cannot be.
    #[error("link profile {path}: `{field}` of {of}: expected {expected}, found {found}")]
    Value {
        /// The file.
        path: String,
        /// The field.
        field: &'static str,
        /// Kind, or the default.
        of: String,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: f64,
    },
}

fn names() -> String {
    BUILT_IN.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
}

impl Profile {
    /// A built-in profile, one from a TOML or YAML file, a channel from its trace (`drive.csv`), or settings in a word, also behind one of
    /// these: `delay_ms=90,loss=0.05`, `paper,loss=0.05`.
    ///
    /// # Errors
    /// [`ProfileError`] names the file, the field and what was expected.
    pub fn load(name: &str) -> Result<Self, ProfileError> {
        if let Some((_, text)) = BUILT_IN.iter().find(|(known, _)| *known == name) {
            return Profile::from_toml(name, text);
        }
        if inline::is_inline(name) {
            return inline::read(name);
        }
        let parse = match Path::new(name).extension().and_then(|extension| extension.to_str()) {
            Some("toml") => Profile::from_toml,
            Some("yml" | "yaml") => Profile::from_yaml,
            Some("csv") => Profile::from_trace,
            _ => {
                let hint = did_you_mean(&nearest_name(name, BUILT_IN.iter().map(|(known, _)| *known)));
                return Err(ProfileError::Unknown {
                    name: name.into(),
                    hint,
                });
            }
        };
        let read = realo_documents::read(Path::new(name));
        parse(
            name,
            &read.map_err(|reason| ProfileError::Read {
                path: name.into(),
                reason,
            })?,
        )
    }

    fn from_toml(path: &str, text: &str) -> Result<Self, ProfileError> {
        let written = toml::from_str(text).map_err(|error| realo_documents::shown(&error.to_string()));
        Profile::checked(path, written)
    }

    fn from_yaml(path: &str, text: &str) -> Result<Self, ProfileError> {
        let written = realo_documents::yaml(text);
        Profile::checked(path, written)
    }

    /// A channel of this trace, and nothing else.
    fn from_trace(path: &str, text: &str) -> Result<Self, ProfileError> {
        let phases = phases(text).map_err(|reason| ProfileError::Syntax {
            path: path.into(),
            reason,
        })?;
        let channel = Channel {
            phases,
            queue_ms: None,
            half_duplex: false,
        };
        Ok(Profile {
            channel: Some(channel),
            ..Profile::default()
        })
    }

    fn checked(path: &str, written: Result<Written, String>) -> Result<Self, ProfileError> {
        let written = written.map_err(|reason| ProfileError::Syntax {
            path: path.into(),
            reason,
        })?;
        let channel = written.channel.map(|channel| channel.read(path)).transpose()?;
        let profile = Profile {
            about: written.about,
            default: written.default,
            kinds: written.kinds,
            channel,
        };
        if let Some(kind) = profile.kinds.keys().find(|kind| !CARRIED.contains(kind)) {
            let reason = format!("`kinds.{kind}`: no link carries it; expected points, features, boxes or agent_state");
            return Err(ProfileError::Syntax {
                path: path.into(),
                reason,
            });
        }
        profile.check(path)?;
        Ok(profile)
    }

    /// Whether its numbers can be.
    pub(super) fn check(&self, path: &str) -> Result<(), ProfileError> {
        self.default.check(path, "default")?;
        for (kind, model) in &self.kinds {
            model.check(path, kind.as_str())?;
        }
        self.channel.as_ref().map_or(Ok(()), |channel| channel.check(path))
    }

    /// What the channel does to packets of a kind.
    pub fn model(&self, kind: Kind) -> &Model {
        self.kinds.get(&kind).unwrap_or(&self.default)
    }
}

/// The files that a profile is read from: its own, and the trace that it names; none of one that is built in or in a word.
pub fn files(text: &str) -> Vec<PathBuf> {
    let mut files = Vec::new();
    inline::with_base(text, |name| {
        let path = Path::new(name);
        if let Ok(text) = realo_documents::read(path) {
            files.push(path.into());
            let written = match path.extension().and_then(|kind| kind.to_str()) {
                Some("toml") => toml::from_str(&text).ok(),
                Some("csv") => None,
                _ => realo_documents::yaml(&text).ok(),
            };
            let trace = written.and_then(|written: Written| written.channel?.trace);
            files.extend(trace.map(|trace| path.parent().unwrap_or(Path::new("")).join(trace)));
        }
        String::new()
    });
    files
}

impl Channel {
    fn check(&self, path: &str) -> Result<(), ProfileError> {
        if self.phases.is_empty() {
            let reason = "`channel` without a rate: add channel.bits_per_second".to_string();
            let path = path.to_string();
            return Err(ProfileError::Syntax { path, reason });
        }
        match self.queue_ms.filter(|queue| !(0.0..=LONGEST_MS).contains(queue)) {
            Some(found) => Err(ProfileError::Value {
                path: path.into(),
                field: "queue_ms",
                of: "channel".into(),
                expected: "0 to 3600000 ms",
                found,
            }),
            None => Ok(()),
        }
    }
}

impl WrittenChannel {
    fn read(self, path: &str) -> Result<Channel, ProfileError> {
        let wrong = |reason: String| ProfileError::Syntax {
            path: path.into(),
            reason,
        };
        let phases = match (self.bits_per_second, self.trace) {
            (Some(bits_per_second), None) if bits_per_second > 0 => vec![Phase {
                from: 0,
                bits_per_second,
                delay_ms: 0.0,
                loss: 0.0,
            }],
            (None, Some(trace)) => {
                let trace = Path::new(path).parent().unwrap_or(Path::new("")).join(trace);
                let name = trace.display().to_string();
                let text = realo_documents::read(&trace).map_err(|reason| ProfileError::Read {
                    path: name.clone(),
                    reason,
                })?;
                phases(&text).map_err(|reason| ProfileError::Syntax { path: name, reason })?
            }
            (rate, trace) => {
                return Err(wrong(format!(
                    "`channel`: expected `bits_per_second`, at least 1, or `trace`, a file; found {rate:?} and {trace:?}"
                )));
            }
        };
        Ok(Channel {
            phases,
            queue_ms: self.queue_ms,
            half_duplex: self.half_duplex,
        })
    }
}

/// Lines of a trace at most.
const MOST_PHASES: usize = 1_000_000;

/// The phases of a trace.
fn phases(text: &str) -> Result<Vec<Phase>, String> {
    let mut lines = text
        .lines()
        .map(str::trim)
        .enumerate()
        .filter(|(_, line)| !line.is_empty());
    let head = lines.next().map(|(_, line)| line.replace(' ', ""));
    if head.as_deref() != Some(report::Phase::COLUMNS) {
        let found = realo_documents::shown(head.as_deref().unwrap_or_default());
        return Err(format!(
            "line 1: expected `{}`, found `{found}`",
            report::Phase::COLUMNS
        ));
    }
    let mut phases: Vec<Phase> = Vec::new();
    for (index, line) in lines {
        let wrong = |expected: &str| {
            format!(
                "line {}: expected {expected}, found `{}`",
                index + 1,
                realo_documents::shown(line)
            )
        };
        let numbers: Vec<f64> = line.split(',').filter_map(|word| word.trim().parse().ok()).collect();
        let &[seconds, rate, delay_ms, loss] = &numbers[..] else {
            return Err(wrong("four numbers"));
        };
        let fits = (0.0..=1e7).contains(&seconds)
            && (0.0..=1e15).contains(&rate)
            && (0.0..=LONGEST_MS).contains(&delay_ms)
            && (0.0..=1.0).contains(&loss);
        if !fits || line.split(',').count() != 4 {
            return Err(wrong(
                "seconds from 0 on, a rate from 0 on, 0 to 3600000 ms, and a probability",
            ));
        }
        let from = (seconds * 1e9).round() as i64;
        if phases.last().is_some_and(|last| last.from >= from) || phases.len() == MOST_PHASES {
            return Err(wrong(
                "a later time than that of the line before, and at most 1,000,000 lines",
            ));
        }
        phases.push(Phase {
            from,
            bits_per_second: rate.round() as u64,
            delay_ms,
            loss,
        });
    }
    match phases.is_empty() {
        true => Err("expected a line behind the first, found none".into()),
        false => Ok(phases),
    }
}

impl Model {
    fn check(&self, path: &str, of: &str) -> Result<(), ProfileError> {
        let (path, of) = (path.to_string(), of.to_string());
        let millis = [
            ("fixed_ms", self.fixed_ms),
            ("jitter.uniform_ms", self.jitter.uniform_ms),
            ("jitter.gaussian_ms", self.jitter.gaussian_ms),
            ("step_ms", self.step_ms),
        ];
        for (field, found) in millis {
            if !(0.0..=LONGEST_MS).contains(&found) {
                return Err(ProfileError::Value {
                    path,
                    field,
                    of,
                    expected: "0 to 3600000 ms",
                    found,
                });
            }
        }
        for (field, found) in [("loss", self.loss), ("duplicate", self.duplicate)] {
            if !(0.0..=1.0).contains(&found) {
                return Err(ProfileError::Value {
                    path,
                    field,
                    of,
                    expected: "a probability, 0 to 1",
                    found,
                });
            }
        }
        if self.bits_per_second == Some(0) {
            let (field, expected) = ("bits_per_second", "at least 1; leave it out where bytes take no time");
            return Err(ProfileError::Value {
                path,
                field,
                of,
                expected,
                found: 0.0,
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_profiles_are_as_published() {
        assert_eq!(Profile::load("perfect").unwrap().model(Kind::Points), &Model::default());
        let paper = Profile::load("paper").unwrap();
        let fixed: Vec<f64> = CARRIED.iter().map(|kind| paper.model(*kind).fixed_ms).collect();
        assert_eq!(fixed, [144.2, 41.7, 10.0, 10.0]);
        let measured = Profile::load("cv2x-measured").unwrap().channel.unwrap();
        assert_eq!(
            (measured.phases[0].bits_per_second, measured.half_duplex),
            (1_600_000, true)
        );
        assert!(
            BUILT_IN
                .iter()
                .all(|(name, _)| !Profile::load(name).unwrap().about.is_empty())
        );
    }

    #[test]
    fn reads_both_syntaxes() {
        let toml = "[default]\nfixed_ms = 2.0\nbits_per_second = 20_000_000\njitter = { gaussian_ms = 1.5 }\nloss = 0.02\n\
                    [kinds.boxes]\njitter = { uniform_ms = 3 }\nduplicate = 1.0";
        let yaml = "default: { fixed_ms: 2, bits_per_second: 20000000, jitter: { gaussian_ms: 1.5 }, loss: 0.02 }\n\
                    kinds: { boxes: { jitter: { uniform_ms: 3 }, duplicate: 1 } }";
        let folder = tempfile::tempdir().unwrap();
        let load = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::write(&path, text).unwrap();
            Profile::load(path.to_str().unwrap()).unwrap()
        };
        let profile = load("radio.toml", toml);
        assert_eq!(profile, load("radio.yml", yaml));
        assert_eq!(profile.model(Kind::Features).bits_per_second, Some(20_000_000));
        assert_eq!(
            profile.model(Kind::Boxes).jitter,
            Jitter {
                uniform_ms: 3.0,
                gaussian_ms: 0.0
            }
        );
        assert_eq!(profile.model(Kind::Boxes).fixed_ms, 0.0);
    }

    #[test]
    fn a_channel_is_a_rate_or_a_trace_that_lies_beside_the_profile() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        let load = |text: &str| {
            write("radio.toml", text);
            Profile::load(folder.path().join("radio.toml").to_str().unwrap())
        };
        let profile = load("[channel]\nbits_per_second = 27_000_000\nqueue_ms = 100\nhalf_duplex = true").unwrap();
        let channel = profile.channel.unwrap();
        assert_eq!(
            (channel.queue_ms, channel.half_duplex, channel.phases.len()),
            (Some(100.0), true, 1)
        );
        assert_eq!(channel.phases[0].bits_per_second, 27_000_000);
        write(
            "drive.csv",
            "seconds, bits_per_second, delay_ms, loss\n0,27e6,20,0\n1.5,0,20,0\n\n2,6000000,35.5,0.01\n",
        );
        let channel = load("[channel]\ntrace = \"drive.csv\"").unwrap().channel.unwrap();
        let last = Phase {
            from: 2_000_000_000,
            bits_per_second: 6_000_000,
            delay_ms: 35.5,
            loss: 0.01,
        };
        assert_eq!((channel.phases.len(), channel.phases[2]), (3, last));
        let alone = folder.path().join("drive.csv").to_str().unwrap().to_string();
        let of_trace = |text: &str| Profile::load(text).unwrap().channel.unwrap();
        assert_eq!(of_trace(&alone), channel);
        assert_eq!(files(&alone), [PathBuf::from(&alone)]);
        let limited = of_trace(&format!("{alone},channel.queue_ms=200"));
        assert_eq!((limited.queue_ms, limited.phases), (Some(200.0), channel.phases));
        let refused = |text: &str| load(text).unwrap_err().to_string();
        assert!(refused("[channel]\nqueue_ms = 5").contains("`bits_per_second`, at least 1, or `trace`"));
        assert!(refused("[channel]\nbits_per_second = 0").contains("at least 1"));
        assert!(refused("[channel]\nbits_per_second = 5\ntrace = \"drive.csv\"").contains("`trace`"));
        assert!(refused("[channel]\nbits_per_second = 5\nqueue_ms = -1").contains("`queue_ms` of channel"));
        assert!(refused("[channel]\ntrace = \"none.csv\"").contains("none.csv"));
        let head = "seconds,bits_per_second,delay_ms,loss";
        for (text, expected) in [
            ("0,1,2,3".to_string(), "line 1: expected `seconds,"),
            (head.to_string(), "expected a line behind the first"),
            (format!("{head}\n0,1,2"), "line 2: expected four numbers, found `0,1,2`"),
            (format!("{head}\n0,1,2,0,"), "line 2: expected"),
            (format!("{head}\n0,1,2,2"), "a probability"),
            (format!("{head}\n0,NaN,2,0"), "a rate from 0 on"),
            (format!("{head}\n1,1,0,0\n1,1,0,0"), "line 3: expected a later time"),
        ] {
            write("drive.csv", &text);
            let error = refused("[channel]\ntrace = \"drive.csv\"");
            assert!(
                error.contains("drive.csv") && error.contains(expected),
                "{text}: {error}"
            );
        }
    }

    #[test]
    fn refuses_with_file_field_and_what_was_expected() {
        let cases = [
            ("[default]\nfixd_ms = 1", "fixd_ms"),
            (
                "[default]\nfixed_ms = -1",
                "`fixed_ms` of default: expected 0 to 3600000 ms, found -1",
            ),
            ("[default]\nfixed_ms = nan", "found NaN"),
            ("[default]\nstep_ms = -5", "`step_ms` of default"),
            (
                "[kinds.boxes]\nloss = 1.5",
                "`loss` of boxes: expected a probability, 0 to 1, found 1.5",
            ),
            ("[kinds.boxes]\nbits_per_second = 0", "`bits_per_second` of boxes"),
            (
                "[kinds.boxes]\njitter = { uniform_ms = inf }",
                "`jitter.uniform_ms` of boxes",
            ),
            ("[kinds.cars]\nloss = 0", "cars"),
            ("[kinds.report]\nloss = 0", "`kinds.report`: no link carries it"),
        ];
        for (text, expected) in cases {
            let error = Profile::from_toml("radio.toml", text).unwrap_err().to_string();
            assert!(
                error.contains("radio.toml") && error.contains(expected),
                "{text}: {error}"
            );
        }
        let error = Profile::load("papr").unwrap_err().to_string();
        assert!(
            error.contains("did you mean `paper`") && error.contains("perfect, paper, cv2x-measured"),
            "{error}"
        );
        let error = Profile::load("no/such.toml").unwrap_err().to_string();
        assert!(error.contains("no/such.toml"), "{error}");
    }
}
