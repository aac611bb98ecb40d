//! The document that a page holds as JSON.

use std::collections::BTreeMap;

use realo_report::{fields, has_recorded_detections};
use realo_results::{Ages, GraphStages, Run};
use realo_schemas::Kind;
use realo_schemas::report::Fate;
use serde::Serialize;
use serde_json::{Value, json};

use crate::PageError;
use crate::alone::{Against, is_alone};
use crate::curves::{PrecisionRecall, age_quantiles, precision_recall, quantiles};
use crate::html::escaped;
use crate::points::CloudPart;
use crate::recorded::FEWER_SWEEPS;
use crate::scenes::{FEWER_MESSAGES, ScenePart};

/// All that a page shows.
#[derive(Debug, Serialize)]
pub struct Document {
    pub version: u32,
    pub program: String,
    /// Sentences.
    pub verdict: Vec<String>,
    /// The overlap that sentences and charts are about.
    pub iou: String,
    pub differences: Vec<String>,
    pub runs: Vec<RunPart>,
    pub classes: Vec<String>,
    pub scenes: Vec<ScenePart>,
    pub points: Vec<CloudPart>,
    /// What is not on the page, and why.
    pub left_out: Vec<String>,
}

/// A run as a whole.
#[derive(Debug, Serialize)]
pub struct RunPart {
    pub name: String,
    /// Whether nothing of others is fused.
    pub alone: bool,
    /// Whether detections came out of the log and not from a network.
    pub recorded: bool,
    /// The run of the ego alone that it is compared with.
    #[serde(flatten)]
    pub against: Against,
    /// Name and version of the program that ran, as the recording has it.
    pub program: Option<String>,
    /// All settings and main numbers as the table for programs has them.
    pub fields: BTreeMap<String, String>,
    /// What `result.json` has, without the counters of stages.
    pub result: Value,
    /// Spreads of `timing.json`, by stage, and its machine.
    pub timing: Value,
    /// The 0, 1 … 100 % quantiles, ms: from sweep to boxes, of each stage, and of ages.
    pub quantiles: BTreeMap<String, Vec<f64>>,
    pub ages: Vec<f64>,
    pub curves: PrecisionRecall,
    /// Stages of the graph, with their settings and inputs.
    pub graph: GraphStages,
    /// The graph as an SVG document.
    pub picture: Option<String>,
}

impl RunPart {
    pub fn of(name: &str, run: &Run, against: Against) -> Self {
        let mut result = serde_json::to_value(&run.result).unwrap_or_default();
        if let Some(result) = result.as_object_mut() {
            for unused in ["nodes", "accuracy_processed", "peers", "clocks"] {
                result.shift_remove(unused);
            }
        }
        let timing = &run.timing;
        let samples = &timing.samples;
        let mut all = BTreeMap::from([("end_to_end".to_string(), quantiles(&samples.end_to_end))]);
        for (stage, of_stage) in &samples.stages {
            all.insert(stage.clone(), quantiles(&of_stage.latency));
        }
        let mut ages = Ages::default();
        let kinds = run
            .samples
            .ages_ns
            .iter()
            .filter(|(kind, _)| **kind != Kind::AgentState);
        kinds.for_each(|(_, of_kind)| ages.merge(of_kind));
        let fields = fields(&[run]).into_iter();
        RunPart {
            name: name.into(),
            alone: is_alone(run),
            recorded: has_recorded_detections(run),
            against,
            program: None,
            fields: fields.map(|(field, values)| (field, values.concat())).collect(),
            result,
            timing: json!({
                "latency": timing.latency_ms,
                "waiting": timing.waiting_ms,
                "joining": timing.joining_ms,
                "rate_hz": timing.rate_hz,
                "machine": timing.machine,
            }),
            quantiles: all.into_iter().filter(|(_, values)| !values.is_empty()).collect(),
            ages: age_quantiles(&ages),
            curves: run
                .samples
                .evaluation
                .as_ref()
                .map(precision_recall)
                .unwrap_or_default(),
            graph: run.samples.graph.clone(),
            picture: None,
        }
    }
}

/// Words that rows name by their places.
pub fn words() -> Value {
    json!({
        "kinds": Kind::ALL.map(Kind::as_str),
        "fates": Fate::ALL,
    })
}

impl Document {
    /// What the window of a browser is called.
    pub fn title(&self) -> String {
        let names: Vec<&str> = self.runs.iter().map(|run| run.name.as_str()).collect();
        match names.as_slice() {
            [] => "realo".into(),
            [first, second, third, _, ..] => format!("{first}, {second}, {third} and {} more", names.len() - 3),
            few => few.join(", "),
        }
    }

    /// Sweeps that the player has.
    pub fn sweeps(&self) -> usize {
        let runs = self.scenes.iter().flat_map(|scene| &scene.runs);
        runs.map(|run| run.frames.len()).sum()
    }

    /// Messages that the player has.
    fn messages(&self) -> usize {
        let runs = self.scenes.iter().flat_map(|scene| &scene.runs);
        runs.map(|run| run.messages.len()).sum()
    }

    /// The document as JSON, thinned to so many bytes at most as the page writes it: every 2nd, 4th, 8th … sweep of the player
    /// is kept. What was taken away is said in [`Document::left_out`].
    ///
    /// # Errors
    /// [`PageError::TooLarge`] where the rest is too large without any sweep.
    pub fn fitted(&mut self, most: usize) -> Result<String, PageError> {
        let mut stride: u64 = 1;
        let (scenes, all) = (self.scenes.len(), self.totals());
        loop {
            let text = self.json()?;
            let bytes = written(&text);
            if bytes <= most {
                return Ok(text);
            }
            if self.sweeps() == 0 {
                return Err(PageError::TooLarge {
                    runs: self.runs.len(),
                    bytes,
                    most,
                });
            }
            // From far off at once: the rest of the document is small beside the sweeps.
            let factor = (bytes / most.max(1)) as u64 + 1;
            stride = stride.saturating_mul(factor.next_power_of_two());
            self.thin(stride);
            // It says it of all.
            let said = |line: &String| line.contains(FEWER_SWEEPS) || line.contains(FEWER_MESSAGES);
            self.left_out.retain(|line| !said(line) && !line.starts_with(THINNED));
            self.left_out.push(self.thinned(stride, scenes, all, most));
        }
    }

    /// Recorded sweeps and messages, with those that are not on the page.
    fn totals(&self) -> [usize; 2] {
        let runs = || self.scenes.iter().flat_map(|scene| &scene.runs);
        [
            runs().map(|run| run.recorded).sum(),
            runs().map(|run| run.all_messages.max(run.messages.len())).sum(),
        ]
    }

    /// What is said where every n-th sweep is left. `scenes`, `sweeps`, `messages`: how many there were.
    fn thinned(&self, stride: u64, scenes: usize, [sweeps, messages]: [usize; 2], most: usize) -> String {
        let mut gone = String::new();
        if self.messages() < messages {
            gone += &format!("; it has {} of {messages} messages", self.messages());
        }
        if self.scenes.len() < scenes {
            gone += &format!(
                "; it has {} of {scenes} scenes, the others have no sweep left",
                self.scenes.len()
            );
        }
        format!(
            "{THINNED} {stride}, {} of {sweeps}, so that the page stays below {} MB{gone}; a report of fewer runs, or of one \
             log and ego (`RUN/LOG/EGO`), has more",
            self.sweeps(),
            most.div_ceil(1_000_000)
        )
    }

    /// The document as JSON.
    ///
    /// # Errors
    /// One that JSON cannot hold.
    pub fn json(&self) -> Result<String, PageError> {
        let mut value = serde_json::to_value(self)?;
        if let Some(fields) = value.as_object_mut() {
            fields.insert("words".into(), words());
        }
        Ok(value.to_string())
    }

    /// Keeps every n-th sweep of each scene, by its number, and the scenes that have one then.
    fn thin(&mut self, stride: u64) {
        for scene in &mut self.scenes {
            let few = scene.frames.len() as u64 <= 1;
            scene.frames.retain(|seq, _| !few && seq.is_multiple_of(stride));
            let kept: Vec<u64> = scene.frames.keys().copied().collect();
            for run in &mut scene.runs {
                run.frames.retain(|seq, _| kept.binary_search(seq).is_ok());
                let most = 4 * kept.len();
                let nth = run.messages.len() / most.max(1) + 1;
                let mut place = 0;
                run.messages.retain(|_| {
                    place += 1;
                    (place - 1) % nth == 0
                });
            }
        }
        // The player opens the first scene.
        self.scenes.retain(|scene| !scene.frames.is_empty());
    }
}

/// Bytes of a text of JSON on the page, which writes one letter of it longer.
fn written(json: &str) -> usize {
    json.len() + (escaped("<").len() - 1) * json.matches('<').count()
}

const THINNED: &str = "the player has one sweep of";

#[cfg(test)]
mod tests {
    use realo_results::{RunResult, Samples, Settings, Timing};

    use super::*;
    use crate::scenes::{FramePart, RunFrame, SceneRun};

    fn run() -> Run {
        Run {
            result: RunResult::new(Settings::default()),
            timing: Timing::default(),
            samples: Samples::default(),
        }
    }

    fn document(sweeps: u64) -> Document {
        let frames = (0..sweeps).map(|seq| (seq, FramePart::default())).collect();
        let boxes = || RunFrame {
            boxes: Some(vec![vec![1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]; 20]),
            ..RunFrame::default()
        };
        let of_run = SceneRun {
            run: 0,
            recorded: sweeps as usize,
            frames: (0..sweeps).map(|seq| (seq, boxes())).collect(),
            ..SceneRun::empty()
        };
        let mut scene = ScenePart::empty("log", "cav1");
        (scene.frames, scene.runs) = (frames, vec![of_run]);
        Document {
            version: 1,
            program: "realo".into(),
            verdict: Vec::new(),
            iou: "0.5".into(),
            differences: Vec::new(),
            runs: vec![RunPart::of("late", &run(), Against::default())],
            classes: Vec::new(),
            scenes: vec![scene],
            points: Vec::new(),
            left_out: Vec::new(),
        }
    }

    #[test]
    fn a_document_is_thinned_until_it_fits_and_says_so() {
        let mut whole = document(3000);
        let text = whole.fitted(100_000_000).unwrap();
        assert_eq!((whole.sweeps(), whole.left_out.len()), (3000, 0));
        for most in [text.len() / 2, text.len() / 50] {
            let mut thin = document(3000);
            assert!(thin.fitted(most).unwrap().len() <= most);
            assert!(thin.sweeps() > 10 && thin.sweeps() * text.len() <= 3000 * 2 * most);
            assert_eq!(thin.left_out.len(), 1, "{:?}", thin.left_out);
        }
    }

    #[test]
    fn a_document_fits_as_the_page_writes_it() {
        let mut wild = document(10);
        wild.differences = vec!["<".repeat(1000)];
        let text = wild.json().unwrap();
        assert_eq!(written(&text), escaped(&text).len());
        let most = written(&text) - 1;
        let fitted = wild.fitted(most).unwrap();
        assert!(escaped(&fitted).len() <= most && wild.sweeps() < 10);
    }

    #[test]
    fn a_scene_that_is_thinned_to_nothing_is_gone_and_that_is_said() {
        let mut thin = document(3000);
        let mut short = ScenePart::empty("short", "cav1");
        short.frames.insert(7, FramePart::default());
        thin.scenes.insert(0, short);
        thin.scenes[1].runs[0].messages = vec![[1, 0, 5, 0, 9]; 30_000];
        let whole = thin.json().unwrap().len();
        thin.fitted(whole / 3).unwrap();
        assert!(thin.scenes.len() == 1 && thin.scenes[0].log == "log");
        let said = thin.left_out.join("\n");
        assert!(
            said.contains("1 of 2 scenes") && said.contains("of 30000 messages"),
            "{said}"
        );
    }

    #[test]
    fn tables_that_do_not_fit_are_an_error_that_says_what_to_do() {
        let error = document(100).fitted(500).unwrap_err().to_string();
        assert!(error.contains("name fewer runs"), "{error}");
    }
}
