//! Scores boxes against ground truth by a protocol, in a graph.

#[cfg(test)]
mod tests;

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::report::to_report;
use realo_schemas::{Boxes, GroundTruth, Header, Kind, Report};
use realo_scoring::{BOXES_WIRE, Collector, EvaluationReport, Protocol, TOPIC, TRUTH_WIRE};
use serde::{Deserialize, Serialize};

/// Settings of [`Evaluator`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// What counts: `default`, `dair`, `dair-vehicle`, `dair-roadside`, or the path of a protocol file.
    #[setting(default = "default", role = "protocol", path, filled)]
    pub protocol: String,
}

/// A message came after the scores were made.
#[derive(Debug, thiserror::Error)]
#[error("a message after the end")]
pub struct AfterTheEnd;

/// Scores boxes against ground truth: average precision by a protocol.
#[derive(Describe)]
#[stage(counters(BOXES_WITHOUT_TRUTH))]
pub struct Evaluator {
    collector: Option<Collector>,
    /// The header of the report derives from it.
    last: Option<Header>,
}

/// Scores have the note, in a graph and after the fact.
const BOXES_WITHOUT_TRUTH: Counter = Counter::plain(
    "boxes_without_truth",
    "messages with boxes for whose sweep no truth came; not scored",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// One for every sweep of the ego, in its true body frame.
    #[port(of(Ego), on_wire(TRUTH_WIRE))]
    Truth(Header, GroundTruth),
    /// What was detected, in the ego's body frame.
    #[port(of(Ego), on_wire(BOXES_WIRE))]
    Boxes(Header, Boxes),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// Topic `evaluation`, at the end: the scores and their frames.
    Report(Header, Report),
}

impl Operator for Evaluator {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(Evaluator {
            collector: Some(Collector::new(Protocol::load(&settings.protocol)?)),
            last: None,
        })
    }

    fn on_input(&mut self, input: Input, _out: &mut Outputs<Output>) -> Result<(), Error> {
        let collector = self.collector.as_mut().ok_or(AfterTheEnd)?;
        match input {
            Input::Truth(header, truth) => {
                collector.add_truth(&header, &truth)?;
                self.last = Some(header);
            }
            Input::Boxes(header, boxes) => collector.add_boxes(&header, boxes)?,
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        // Without any truth there is no ego to report on.
        let (Some(collector), Some(last)) = (self.collector.take(), self.last.take()) else {
            return Ok(());
        };
        let report = EvaluationReport::from(collector.finish());
        out.count(&BOXES_WITHOUT_TRUTH, "", report.scores.boxes_without_truth);
        let header = Header {
            kind: Kind::Report,
            seq: 0,
            pose: None,
            trace: Vec::new(),
            ..last
        };
        out.send(Output::Report(header, to_report(TOPIC, &report)));
        Ok(())
    }
}
