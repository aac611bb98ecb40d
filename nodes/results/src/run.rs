use std::collections::BTreeMap;
use std::path::PathBuf;

use realo_schemas::Kind;
use realo_scoring::{Evaluation, LocalizationFrame};
use serde::{Deserialize, Serialize};

use crate::{AgeTable, Ages, NodeSummary, RunResult, Settings, Spread, Timing, VERSION};

/// Names `evaluation.json`.
pub const SAMPLES: &str = "realo/evaluation";

/// The stages of a graph as it was run: by their ids, what each runs, its settings and its wires, by name.
pub type GraphStages = BTreeMap<String, BTreeMap<String, String>>;

/// The entry of a stage with the module that groups its process with others: for pictures, and no part of the graph's hash.
pub const GROUP: &str = "group";

/// What results are made from, so that runs can be pooled exactly: `evaluation.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Samples {
    /// [`SAMPLES`].
    pub schema: String,
    /// [`VERSION`].
    pub version: u32,
    /// Ages of the data that were used, ns, by kind.
    pub ages_ns: BTreeMap<Kind, Ages>,
    /// Hashes of what the logs hold, by their names, where they are known.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub logs: BTreeMap<String, String>,
    /// The graph whose hash is in `result.json`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub graph: GraphStages,
    /// Names of the settings that whoever started the run chose: `model`, `isa`, `seed`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub given: Vec<String>,
    /// By agent: each estimate of its pose, where poses were estimated.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub localization: BTreeMap<String, Vec<LocalizationFrame>>,
    /// Frames with what was detected and what is there; `None` if nothing was evaluated.
    pub evaluation: Option<Evaluation>,
}

impl Default for Samples {
    fn default() -> Self {
        Samples {
            schema: SAMPLES.into(),
            version: VERSION,
            ages_ns: BTreeMap::new(),
            logs: BTreeMap::new(),
            graph: GraphStages::new(),
            given: Vec::new(),
            localization: BTreeMap::new(),
            evaluation: None,
        }
    }
}

impl Samples {
    /// The ages in a few numbers.
    pub fn ages(&self) -> AgeTable {
        let mut all = Ages::default();
        self.ages_ns.values().for_each(|ages| all.merge(ages));
        let by_kind = self.ages_ns.iter();
        AgeTable {
            all: Spread::of_ages(&all),
            by_kind: by_kind
                .map(|(kind, ages)| (kind.to_string(), Spread::of_ages(ages)))
                .collect(),
        }
    }
}

/// A run: what its folder holds.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// `result.json`.
    pub result: RunResult,
    /// `timing.json`.
    pub timing: Timing,
    /// `evaluation.json`.
    pub samples: Samples,
}

impl Run {
    /// The run of an evaluation that was made after the fact, without a graph: it has scores, and what nodes counted that
    /// were needed for them.
    pub fn of_evaluation(
        settings: Settings,
        evaluation: Evaluation,
        nodes: impl IntoIterator<Item = (String, NodeSummary)>,
    ) -> Self {
        let mut result = RunResult::new(settings);
        result.nodes.extend(nodes);
        for scene in &evaluation.scenes {
            let processed = scene.frames.iter().filter(|frame| frame.processed).count() as u64;
            result.frames.total += scene.frames.len() as u64;
            result.frames.processed += processed;
            add_name(&mut result.logs, &scene.name);
            add_name(&mut result.egos, &scene.ego);
        }
        result.frames.skipped = result.frames.total - result.frames.processed;
        if result.settings.ego.is_empty() {
            result.settings.ego = result.egos.join(", ");
        }
        let samples = Samples {
            evaluation: Some(evaluation),
            ..Samples::default()
        };
        result.conclude(&samples);
        Run {
            result,
            timing: Timing::default(),
            samples,
        }
    }

    /// Where the log of a run over one log may lie, likeliest first: where it was played from, then under its name in
    /// each of the folders.
    pub fn log_candidates(&self, folders: &[PathBuf]) -> Vec<PathBuf> {
        let name = self.result.logs.first().filter(|name| !name.is_empty());
        let named = name.map(|name| folders.iter().map(move |folder| folder.join(format!("{name}.mcap"))));
        let mut candidates: Vec<PathBuf> = self.timing.log_path.iter().map(PathBuf::from).collect();
        for path in named.into_iter().flatten() {
            if !candidates.contains(&path) {
                candidates.push(path);
            }
        }
        candidates
    }
}

/// Adds a name to a list that names everything once, in order of appearance.
pub fn add_name(names: &mut Vec<String>, name: &str) {
    if !name.is_empty() && !names.iter().any(|known| known == name) {
        names.push(name.into());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_is_looked_for_where_it_was_played_from_then_by_its_name() {
        let mut run = Run {
            result: RunResult::new(Settings::default()),
            timing: Timing::default(),
            samples: Samples::default(),
        };
        let folders = [PathBuf::from("here"), PathBuf::from("logs"), PathBuf::from("here")];
        let found = |run: &Run| -> Vec<String> {
            let paths = run.log_candidates(&folders).into_iter();
            paths.map(|path| path.to_string_lossy().into_owned()).collect()
        };
        assert_eq!(found(&run), [""; 0], "a log without a name is nowhere");
        run.result.logs.push("demo".into());
        assert_eq!(found(&run), ["here/demo.mcap", "logs/demo.mcap"]);
        run.timing.log_path = Some("/far/demo.mcap".into());
        assert_eq!(found(&run), ["/far/demo.mcap", "here/demo.mcap", "logs/demo.mcap"]);
    }
}
