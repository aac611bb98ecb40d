//! Records what a graph perceived: an MCAP file of standard ROS 2 messages.
//!
//! The books of all nodes end `/reports`. Log time is ready, publish time the stamp. The file grows at least every half
//! second of log time: the recording of a run that was killed can be read.

mod channels;
mod error;
mod log;
mod read;
mod recording;

use std::path::PathBuf;

use realo_operator::{Books, Describe, Error, Inputs, NoOutput, Settings, Sink};
use realo_schemas::report::Fated;
use realo_schemas::{AgentState, Boxes, GroundTruth, Header, Packet, PointCloud, Report};
use serde::{Deserialize, Serialize};

pub use channels::{
    Channels, FATES, Times, put_boxes, put_cloud, put_fates, put_packet, put_report, put_state, put_truth,
};
pub use error::RecorderError;
pub use log::{LogRecorder, Settings as LogSettings};
pub use read::{
    BoxesOf, ReportsOf, StatesOf, TruthOf, boxes_of, footprints_of, read_boxes, read_detections, read_reports,
    read_truth, reports_of, states_of, truth_of,
};
use recording::Recording;

/// Settings of the recorder.
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Path of the recording; its folder is made.
    #[setting(default = "recording.mcap", role = "recording", filled)]
    pub path: PathBuf,
    /// Whether sweeps are recorded too.
    pub clouds: bool,
}

/// Records boxes, poses, reports, packets' headers, and clouds when asked for.
#[derive(Describe)]
#[stage(output = NoOutput)]
pub struct Recorder {
    recording: Option<Recording>,
    clouds: bool,
}

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// The final boxes.
    #[port(optional, of(Ego))]
    Boxes(Header, Boxes),
    /// What the ego detected alone.
    #[port(optional, of(Ego))]
    EgoBoxes(Header, Boxes),
    /// What the collaborators detected.
    #[port(optional, of(Others))]
    OtherBoxes(Header, Boxes),
    /// The ego's poses.
    #[port(optional, of(Ego))]
    EgoState(Header, AgentState),
    /// The collaborators' poses.
    #[port(optional, of(Others))]
    States(Header, AgentState),
    /// Ground truth.
    #[port(optional, of(Ego))]
    Truth(Header, GroundTruth),
    /// What crossed the link.
    #[port(optional)]
    Packets(Header, Packet),
    /// The evaluator's report.
    #[port(optional, of(Ego))]
    Evaluation(Header, Report),
    /// The ego's sweeps.
    #[port(optional, of(Ego))]
    EgoClouds(Header, PointCloud),
    /// The collaborators' sweeps.
    #[port(optional, of(Others))]
    Clouds(Header, PointCloud),
}

impl Sink for Recorder {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(Recorder {
            recording: Some(Recording::create(&settings.path)?),
            clouds: settings.clouds,
        })
    }

    fn accept(&mut self, input: Input) -> Result<(), Error> {
        let Some(recording) = &mut self.recording else {
            return Err(RecorderError::Finished.into());
        };
        match input {
            Input::Boxes(header, boxes) => put_boxes(recording, "boxes", &header, &boxes)?,
            Input::EgoBoxes(header, boxes) | Input::OtherBoxes(header, boxes) => {
                put_boxes(recording, "detections", &header, &boxes)?;
            }
            Input::EgoState(header, state) | Input::States(header, state) => put_state(recording, &header, &state)?,
            Input::Truth(header, truth) => put_truth(recording, &header, &truth)?,
            Input::Packets(header, packet) => put_packet(recording, &header, &packet)?,
            Input::Evaluation(header, report) => put_report(recording, &header, &report)?,
            Input::EgoClouds(header, cloud) | Input::Clouds(header, cloud) if self.clouds => {
                put_cloud(recording, &header, &cloud)?;
            }
            Input::EgoClouds(..) | Input::Clouds(..) => {}
        }
        Ok(())
    }

    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        match &mut self.recording {
            Some(recording) if !fates.is_empty() => {
                let last = recording.last();
                Ok(put_fates(recording, last, fates)?)
            }
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
