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

    /// Methods whose inference the paper measured, as stages or models' `arch` name them.
    pub fn methods(&self) -> impl Iterator<Item = &str> {
        self.inference_ms.keys().map(String::as_str)
    }

    /// The message of a kind.
    pub fn message(&self, kind: Kind) -> Option<&Crossing> {
        self.messages.iter().find(|message| message.name == kind.to_string())
    }
}
