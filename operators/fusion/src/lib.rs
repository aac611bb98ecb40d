//! What every fusion operator does before it fuses: pairs the ego's message with what the bank selected for it, puts the
//! collaborators in order, places them in the ego's frame, and reports what could not take part.
//!
//! A fusion has the inputs [`EGO`] and [`SELECTIONS`], one `join` group ([`inputs`]), and the outputs [`FUSED`] and [`REPORT`].

use nalgebra::Isometry3;
use realo_runtime::{Error, Outputs, Port, PortId, unexpected};
use realo_schemas::geometry::relative;
use realo_schemas::report::{FusionReport, MessageId, to_report};
use realo_schemas::{Header, Kind, Message, Payload, PayloadType, Selection, UnexpectedPayload};

/// Input: the ego's own.
pub const EGO: PortId = PortId(0);
/// Input: what the bank selected for it.
pub const SELECTIONS: PortId = PortId(1);
/// Output: what was fused.
pub const FUSED: PortId = PortId(0);
/// Output: topic `fusion`, one for each fusion that took place.
pub const REPORT: PortId = PortId(1);

/// The inputs of a fusion of payloads of these types.
pub const fn inputs(types: &'static [PayloadType]) -> [Port; 2] {
    [
        Port::new("ego", types, "the ego's own").latest().joined("frame"),
        Port::new("selections", &[PayloadType::Selection], "what the bank chose for it")
            .latest()
            .joined("frame"),
    ]
}

/// The outputs of a fusion: what it fuses, and the report.
pub const fn outputs(fused: Port) -> [Port; 2] {
    let report = "topic `fusion`: one for each fusion that took place";
    [fused, Port::new("report", &[PayloadType::Report], report)]
}

/// Keeps the ego's part of a set until its selection comes.
#[derive(Debug, Default)]
pub struct Pairing {
    ego: Option<Message>,
}

/// The ego and those that take part in one fusion.
#[derive(Debug)]
pub struct Set<T> {
    /// Header of the ego's message, and of what is fused.
    pub header: Header,
    /// The ego's own.
    pub ego: T,
    /// By agent name.
    pub collaborators: Vec<Collaborator<T>>,
    /// Who could not take part.
    pub report: FusionReport,
}

/// One that takes part.
#[derive(Debug)]
pub struct Collaborator<T> {
    /// Header of its message.
    pub header: Header,
    /// What it sent.
    pub payload: T,
    /// From its frame at its stamp to the ego's at the ego's.
    pub ego_from_sender: Isometry3<f64>,
}

impl Pairing {
    /// Takes the ego's part.
    pub fn ego(&mut self, message: Message) {
        self.ego = Some(message);
    }

    /// Takes the selection that completes the set; at most `max_collaborators` of it take part, the first by name.
    ///
    /// # Errors
    /// A selection for another message than the ego's, or an ego of another payload.
    pub fn selection<T>(&mut self, message: Message, max_collaborators: Option<usize>) -> Result<Set<T>, Error>
    where
        (Header, T): TryFrom<Message, Error = UnexpectedPayload>,
    {
        let ego = self.ego.take();
        let (asked, Selection { query, entries }) = message.into_parts::<Selection>().map_err(unexpected)?;
        let Some(ego) = ego else {
            return Err(format!("a selection without the ego's message of the same set ({asked})").into());
        };
        let (header, ego) = ego.into_parts::<T>().map_err(unexpected)?;
        if (&header.agent, header.seq) != (&asked.agent, query) {
            let agent = &asked.agent;
            return Err(format!("a selection for query {query} of {agent}, but the ego's message is {header}").into());
        }
        let report = FusionReport {
            query,
            agent: header.agent.to_string(),
            over_limit: Vec::new(),
            rejected: Vec::new(),
        };
        let mut set = Set {
            header,
            ego,
            collaborators: Vec::new(),
            report,
        };
        set.place(entries, max_collaborators.unwrap_or(usize::MAX));
        Ok(set)
    }
}

impl<T> Set<T> {
    /// Leaves out whoever's data are not in the ego's frame.
    pub fn reject_other_frames(&mut self) {
        let (frame, rejected) = (&self.header.frame, &mut self.report.rejected);
        self.collaborators.retain(|collaborator| {
            let same = collaborator.header.frame == *frame;
            if !same {
                rejected.push(MessageId::of(&collaborator.header));
            }
            same
        });
    }
}

impl<T> Set<T>
where
    (Header, T): TryFrom<Message, Error = UnexpectedPayload>,
{
    fn place(&mut self, mut entries: Vec<Message>, limit: usize) {
        entries.sort_by(|a, b| a.header.agent.cmp(&b.header.agent));
        let map_from_ego = self.header.pose.as_ref().map(|pose| pose.map_from_frame);
        for entry in entries {
            let id = MessageId::of(&entry.header);
            let map_from_sender = entry.header.pose.as_ref().map(|pose| pose.map_from_frame);
            let (Ok((header, payload)), Some(map_from_ego), Some(map_from_sender)) =
                (entry.into_parts::<T>(), map_from_ego, map_from_sender)
            else {
                self.report.rejected.push(id);
                continue;
            };
            if self.collaborators.len() == limit {
                self.report.over_limit.push(id);
                continue;
            }
            self.collaborators.push(Collaborator {
                header,
                payload,
                ego_from_sender: relative(&map_from_ego, &map_from_sender),
            });
        }
    }
}

/// Sends what was fused, and the report.
pub fn send(header: Header, fused: impl Into<Payload>, report: &FusionReport, out: &mut Outputs) {
    out.count("over_limit_messages", report.over_limit.len() as u64);
    out.count("rejected_messages", report.rejected.len() as u64);
    let report_header = Header {
        kind: Kind::Report,
        ..header.clone()
    };
    out.send(FUSED, Message::new(header, fused));
    out.send(REPORT, Message::new(report_header, to_report("fusion", report)));
}
