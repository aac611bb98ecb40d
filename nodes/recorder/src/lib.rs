//! Records what a graph perceived: an MCAP file of standard ROS 2 messages.
//!
//! | input | type | recorded as |
//! |---|---|---|
//! | `boxes` | Boxes | `/<agent>/boxes`, `…_info`, `…_markers`: the final boxes; [`read_boxes`] restores them bit for bit |
//! | `ego_boxes`, `other_boxes` | Boxes | `/<agent>/detections`, `…_info`: what each agent detected alone; [`read_detections`] |
//! | `ego_state`, `states` | AgentState | `/<agent>/pose`, `/tf` |
//! | `truth` | GroundTruth | `/<agent>/ground_truth`, `…_info`, `…_markers`, `…_views`; `/<agent>/own_labels` and the same |
//! | `packets`, `state_packets` | Packet | `/packets`: their headers and sizes |
//! | `evaluation`, `bank`, `fusion`, `link`, `link_state` | Report | `/reports`: JSON |
//! | `ego_clouds`, `clouds` | PointCloud | `/<agent>/points`, if the argument `clouds` asks for it |
//!
//! The books of all nodes end `/reports`. Log time is ready, publish time the stamp. The file grows at least every half
//! second of log time: the recording of a run that was killed can be read.

mod log;
mod read;
mod recording;

use std::path::PathBuf;

use realo_operator::{Argument, Books, Decided, Describe, Error, Lane, Port, PortId, Sink};
use realo_schemas::report::Fated;
use realo_schemas::{Message, Payload, PayloadType};
use serde::{Deserialize, Serialize};

pub use log::{LogConfig, LogRecorder};
pub use read::{
    BoxesOf, ReportsOf, TruthOf, boxes_of, read_boxes, read_detections, read_reports, read_truth, reports_of, truth_of,
};
pub use recording::FATES;
use recording::Recording;

/// Settings of the recorder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Path of the recording; its folder is made.
    pub path: PathBuf,
    /// Whether sweeps are recorded too.
    pub clouds: bool,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            path: "recording.mcap".into(),
            clouds: false,
        }
    }
}

/// The sink that records.
pub struct Recorder {
    recording: Option<Recording>,
    clouds: bool,
}

const BOXES: PortId = PortId(0);

impl Describe for Recorder {
    type Config = Config;
    const NAME: &'static str = "recorder";
    const ABOUT: &'static str = "records boxes, poses, reports, packets' headers, and clouds when asked for";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "path",
            about: "path of the recording; its folder is made",
        },
        Argument {
            name: "clouds",
            about: "whether sweeps are recorded too",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("boxes", &[PayloadType::Boxes], "the final boxes")
            .optional()
            .of(Lane::Ego),
        Port::new("ego_boxes", &[PayloadType::Boxes], "what the ego detected alone")
            .optional()
            .of(Lane::Ego),
        Port::new("other_boxes", &[PayloadType::Boxes], "what the collaborators detected")
            .optional()
            .of(Lane::Others),
        Port::new("ego_state", &[PayloadType::AgentState], "the ego's poses")
            .optional()
            .of(Lane::Ego),
        Port::new("states", &[PayloadType::AgentState], "the collaborators' poses")
            .optional()
            .of(Lane::Others),
        Port::new("truth", &[PayloadType::GroundTruth], "ground truth")
            .optional()
            .of(Lane::Ego),
        Port::new("packets", &[PayloadType::Packet], "what crossed the link").optional(),
        Port::new("evaluation", &[PayloadType::Report], "the evaluator's report")
            .optional()
            .of(Lane::Ego),
        Port::new("ego_clouds", &[PayloadType::PointCloud], "the ego's sweeps")
            .optional()
            .of(Lane::Ego),
        Port::new("clouds", &[PayloadType::PointCloud], "the collaborators' sweeps")
            .optional()
            .of(Lane::Others),
    ];
    const OUTPUTS: &'static [Port] = &[];
    const DECIDED: &'static [(Decided, &'static str)] = &[(Decided::Recording, "path")];
}

impl Sink for Recorder {
    fn new(config: Config) -> Result<Self, Error> {
        Ok(Recorder {
            recording: Some(Recording::create(&config.path)?),
            clouds: config.clouds,
        })
    }

    fn accept(&mut self, port: PortId, message: Message) -> Result<(), Error> {
        let Some(recording) = &mut self.recording else {
            return Err("a message after the recording was finished".into());
        };
        let header = &message.header;
        match &message.payload {
            Payload::Boxes(boxes) if port == BOXES => recording.boxes("boxes", header, boxes)?,
            Payload::Boxes(boxes) => recording.boxes("detections", header, boxes)?,
            Payload::AgentState(state) => recording.state(header, state)?,
            Payload::GroundTruth(truth) => recording.truth(header, truth)?,
            Payload::Packet(packet) => recording.packet(header, packet)?,
            Payload::Report(report) => recording.report(header, report)?,
            Payload::PointCloud(cloud) if self.clouds => recording.cloud(header, cloud)?,
            Payload::PointCloud(_) => {}
            other => return Err(format!("the recorder does not take a {} ({header})", other.payload_type()).into()),
        }
        Ok(())
    }

    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        match &mut self.recording {
            Some(recording) if !fates.is_empty() => Ok(recording.fates(fates)?),
            _ => Ok(()),
        }
    }

    fn finish(&mut self, books: &Books) -> Result<(), Error> {
        match self.recording.take() {
            Some(recording) => Ok(recording.finish(books)?),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_the_keys_of_the_configuration() {
        let keys: Vec<String> = realo_operator::config::defaults::<Config>().keys().cloned().collect();
        let names: Vec<&str> = Recorder::ARGUMENTS.iter().map(|argument| argument.name).collect();
        assert_eq!(keys, names);
    }
}
