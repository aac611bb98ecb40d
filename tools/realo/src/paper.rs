//! What V2X-ReaLO measured, as the file beside the link profile `paper` has it.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use realo_schemas::{Kind, Nanos};
use serde::Deserialize;

/// The paper's times.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PaperTimes {
    inference_ms: BTreeMap<String, f64>,
    /// Messages, by their kind.
    pub messages: Vec<Crossing>,
    /// Feature maps, by how they were compressed.
    pub compression: Vec<Crossing>,
    /// Parts of the transmission module.
    pub module: Vec<Part>,
}

/// A message that crossed the paper's Wi-Fi.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Crossing {
    /// What it was.
    pub name: String,
    /// Its size, KB.
    pub kilobytes: f64,
    /// Half of a round trip, ms.
    pub ms: f64,
}

/// A part of the paper's transmission module.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// What it does.
    pub name: String,
    /// In the encoder, ms.
    pub encoder_ms: f64,
    /// In the decoder, ms.
    pub decoder_ms: f64,
}

impl PaperTimes {
    /// The times of the file.
    pub fn get() -> &'static Self {
        static TIMES: LazyLock<PaperTimes> = LazyLock::new(|| {
            let text = include_str!("../../../operators/link/profiles/paper_times.toml");
            toml::from_str(text).expect("a test reads the file")
        });
        &TIMES
    }

    /// The whole inference of a method: a fusion stage, or what a model file calls `arch`. `None`: the paper has no time of it.
    pub fn inference(&self, method: &str) -> Option<Nanos> {
        let millis = self.inference_ms.get(method)?;
        Some((millis * 1e6).round() as Nanos)
    }

    /// The message of a kind.
    pub fn message(&self, kind: Kind) -> Option<&Crossing> {
        self.messages.iter().find(|message| message.name == kind.to_string())
    }
}

#[cfg(test)]
mod tests {
    use realo_link::Profile;

    use super::*;
    use crate::registry;

    #[test]
    fn the_link_profile_has_the_same_times() {
        let profile = Profile::load("paper").unwrap();
        for kind in [Kind::Boxes, Kind::Features, Kind::Points] {
            let message = PaperTimes::get().message(kind).unwrap();
            assert_eq!(profile.model(kind).fixed_ms, message.ms, "{kind}");
        }
        assert!(PaperTimes::get().message(Kind::Report).is_none());
    }

    #[test]
    fn every_method_is_a_stage_or_an_arch() {
        let archs = ["pointpillars", "fcooper", "attfuse", "v2xvit"];
        for method in PaperTimes::get().inference_ms.keys() {
            let is_stage = registry().0.iter().any(|entry| entry.name == method);
            assert!(is_stage || archs.contains(&method.as_str()), "{method}");
        }
        assert_eq!(PaperTimes::get().inference("attfuse"), Some(68_600_000));
        assert_eq!(PaperTimes::get().inference("v2vnet"), None);
    }
}
