//! Scores boxes against ground truth by a protocol, in a graph.
//!
//! | port | type | content |
//! |---|---|---|
//! | in `truth` | GroundTruth | one for every sweep of the ego, in its true body frame |
//! | in `boxes` | Boxes | what was detected, in the ego's body frame; joined with `truth` by (agent, seq) |
//! | out `report` | Report | topic `evaluation`, at the end: an [`EvaluationReport`] |

#[cfg(test)]
mod tests;

use realo_operator::{
    Argument, Counter, Decided, Describe, Error, Lane, Operator, Outputs, Port, PortId, unexpected, wrong_port,
};
use realo_schemas::report::to_report;
use realo_schemas::{Boxes, GroundTruth, Header, Kind, Message, PayloadType};
use realo_scoring::{BOXES_WIRE, Collector, EvaluationReport, Protocol, TOPIC, TRUTH_WIRE};
use serde::{Deserialize, Serialize};

/// Settings of [`Evaluator`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// `default`, `dair`, `dair-vehicle`, `dair-roadside`, or the path of a protocol file.
    pub protocol: String,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            protocol: "default".into(),
        }
    }
}

/// The operator `evaluator`.
pub struct Evaluator {
    collector: Option<Collector>,
    /// The header of the report derives from it.
    last: Option<Header>,
}

const TRUTH: PortId = PortId(0);
const BOXES: PortId = PortId(1);
const REPORT: PortId = PortId(0);

/// Scores have the note, in a graph and after the fact.
const BOXES_WITHOUT_TRUTH: Counter = Counter::plain(
    "boxes_without_truth",
    "messages with boxes for whose sweep no truth came; not scored",
);

impl Describe for Evaluator {
    type Config = Config;
    const NAME: &'static str = "evaluator";
    const ABOUT: &'static str = "scores boxes against ground truth: average precision by a protocol";
    const ARGUMENTS: &'static [Argument] = &[Argument {
        name: "protocol",
        about: "what counts: default, dair, dair-vehicle, dair-roadside, or the path of a protocol file",
    }];
    const INPUTS: &'static [Port] = &[
        Port::new(
            "truth",
            &[PayloadType::GroundTruth],
            "one for every sweep of the ego, in its true body frame",
        )
        .of(Lane::Ego)
        .on_wire(TRUTH_WIRE),
        Port::new(
            "boxes",
            &[PayloadType::Boxes],
            "what was detected, in the ego's body frame",
        )
        .of(Lane::Ego)
        .on_wire(BOXES_WIRE),
    ];
    const OUTPUTS: &'static [Port] = &[Port::new(
        "report",
        &[PayloadType::Report],
        "topic `evaluation`, at the end: the scores and their frames",
    )];
    const COUNTERS: &'static [Counter] = &[BOXES_WITHOUT_TRUTH];
    const DECIDED: &'static [(Decided, &'static str)] = &[(Decided::Protocol, "protocol")];
}

impl Operator for Evaluator {
    fn new(config: Config) -> Result<Self, Error> {
        Ok(Evaluator {
            collector: Some(Collector::new(Protocol::load(&config.protocol)?)),
            last: None,
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, _out: &mut Outputs) -> Result<(), Error> {
        let collector = self.collector.as_mut().ok_or("a message after the end")?;
        match port {
            TRUTH => {
                let (header, truth): (Header, GroundTruth) = message.into_parts().map_err(unexpected)?;
                collector.add_truth(&header, &truth)?;
                self.last = Some(header);
            }
            BOXES => {
                let (header, boxes): (Header, Boxes) = message.into_parts().map_err(unexpected)?;
                collector.add_boxes(&header, boxes)?;
            }
            _ => return Err(wrong_port(Self::INPUTS, port)),
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
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
        out.send(REPORT, Message::new(header, to_report(TOPIC, &report)));
        Ok(())
    }
}
