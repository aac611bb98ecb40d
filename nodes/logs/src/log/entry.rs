//! One message of a log.

use std::sync::Arc;

use realo_schemas::geometry::View;
use realo_schemas::{AgentState, Boxes, Name, Nanos, PointCloud, PoseStatus, SAME_STAMP, body_frame};

use super::nanos;
use crate::cdr::CdrReader;
use crate::frames::bare;
use crate::mcap_file::RawMessage;
use crate::packets::{self, SentPacket};
use crate::stamps::stamp_of;
use crate::sweeps::{Context, NoCloud};
use crate::{BoxesInfo, LogError, Stream, boxes, pose, views};

/// One message of a log.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Its agent.
    pub agent: Name,
    /// Its stream.
    pub stream: Stream,
    pub(super) stamp: Nanos,
    pub(super) raw: RawMessage,
    pub(super) context: Arc<Context>,
}

impl Entry {
    /// Its number on its topic, from 0 at the log's beginning.
    pub fn seq(&self) -> u64 {
        self.raw.sequence.into()
    }

    /// The measurement's reference time, ns: the stamp of the message's header; where that is 0, the publish time. Messages of
    /// an agent whose stamps differ by at most [`SAME_STAMP`] have the first of them.
    pub fn stamp(&self) -> Nanos {
        self.stamp
    }

    /// By how much the publish time is later than the stamp of the header, ns, where the two differ: one of them is wrong.
    pub fn published_apart(&self) -> Option<Nanos> {
        let apart = nanos(self.raw.publish_time).saturating_sub(stamp_of(self.stream, &self.raw));
        (apart.abs() > SAME_STAMP).then_some(apart)
    }

    /// When it existed on the log's time line, ns.
    pub fn ready(&self) -> Nanos {
        nanos(self.raw.log_time)
    }

    /// The message as written.
    pub fn data(&self) -> &[u8] {
        self.raw.data()
    }

    /// The points of a sweep ([`Stream::Points`]) in the agent's body frame; intensities that the log has as floats in
    /// 0…1 are scaled to 0…255.
    ///
    /// # Errors
    /// Bytes that are no such message; points in a frame from which the log has no transform into the body frame;
    /// [`LogError::Unplaced`] where it has some, but none near this time.
    pub fn cloud(&self) -> Result<PointCloud, LogError> {
        let cloud = self
            .context
            .cloud(self.raw.channel, &self.agent, self.stamp(), self.data());
        cloud.map_err(|no_cloud| match no_cloud {
            NoCloud::Unreadable(reason) => self.bad(reason),
            NoCloud::Unplaced(reason) => LogError::Unplaced {
                topic: self.stream.topic(&self.agent),
                log_time: self.ready(),
                reason,
            },
        })
    }

    /// Looks whether a sweep ([`Stream::Points`]) is whole and its frame one that leads to the agent's body, without its points.
    ///
    /// # Errors
    /// As [`Entry::cloud`], but for what the points alone tell.
    pub(crate) fn look_at_cloud(&self) -> Result<(), LogError> {
        let looked = self.context.look(&self.agent, self.stamp(), self.data());
        looked.map_err(|reason| self.bad(reason))
    }

    /// A pose ([`Stream::Pose`], [`Stream::PoseTruth`]).
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the map's; numbers that are no pose.
    pub fn pose(&self) -> Result<AgentState, LogError> {
        let status = match self.stream {
            Stream::PoseTruth => PoseStatus::Truth,
            _ => PoseStatus::Recorded,
        };
        self.in_frame(&self.context.map_frame)
            .and_then(|()| pose::decode(self.data(), status))
            .and_then(|(_, state)| pose::fault(&state).map_or(Ok(state), Err))
            .map_err(|reason| self.bad(reason))
    }

    /// Why the covariance of a pose that can be read cannot be right, in words; such a pose has an unknown one.
    pub fn wrong_covariance(&self) -> Option<String> {
        pose::wrong_covariance(self.data())
    }

    /// Boxes ([`Stream::Detections`], [`Stream::GroundTruth`], [`Stream::OwnLabels`]) without what their companion says.
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the agent's body.
    pub fn boxes(&self) -> Result<Boxes, LogError> {
        self.in_frame(&body_frame(&self.agent))
            .and_then(|()| boxes::decode_with(self.data(), |id| self.context.track(id)))
            .map(|(_, boxes)| boxes)
            .map_err(|reason| self.bad(reason))
    }

    /// Companion of `boxes` ([`Stream::DetectionsInfo`], [`Stream::GroundTruthInfo`], [`Stream::OwnLabelsInfo`]), which it completes.
    ///
    /// # Errors
    /// Bytes that are no such message; a companion of other boxes.
    pub fn info(&self, boxes: &mut Boxes) -> Result<BoxesInfo, LogError> {
        boxes::decode_info(self.data(), boxes)
            .map(|(_, info)| info)
            .map_err(|reason| self.bad(reason))
    }

    /// Views ([`Stream::GroundTruthViews`], [`Stream::OwnLabelsViews`]).
    ///
    /// # Errors
    /// Bytes that are no such message; another frame than the agent's body; numbers that are no view.
    pub fn views(&self) -> Result<Vec<View>, LogError> {
        self.in_frame(&body_frame(&self.agent))
            .and_then(|()| views::decode(self.data()))
            .map(|(_, views)| views)
            .map_err(|reason| self.bad(reason))
    }

    /// What the agent sent ([`Stream::Packets`]).
    ///
    /// # Errors
    /// Bytes that are no such message.
    pub fn packet(&self) -> Result<SentPacket, LogError> {
        let packet = packets::decode(self.data()).map(|(_, packet)| packet);
        packet.map_err(|reason| self.bad(reason))
    }

    /// Stamp in the message itself ([`Stream::Sweeps`]).
    ///
    /// # Errors
    /// Bytes that are no such message.
    pub fn header_stamp(&self) -> Result<Nanos, LogError> {
        let read = || CdrReader::new(self.data())?.header().map(|(stamp, _)| stamp);
        read().map_err(|reason| self.bad(reason))
    }

    fn in_frame(&self, expected: &str) -> Result<(), String> {
        let (_, frame) = CdrReader::new(self.data())?.header()?;
        match bare(frame) == bare(expected) {
            true => Ok(()),
            false => Err(format!(
                "its frame is `{frame}`, expected `{expected}`; write it in that frame"
            )),
        }
    }

    pub(super) fn bad(&self, reason: String) -> LogError {
        LogError::Content {
            topic: self.stream.topic(&self.agent),
            log_time: self.ready(),
            reason,
        }
    }
}
