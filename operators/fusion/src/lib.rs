//! What every fusion operator does before it fuses: pairs the ego's message with what the bank selected for it, puts the
//! collaborators in order, places them in the ego's frame, and says what became of each.
//!
//! A fusion has the inputs [`EGO`] and [`SELECTIONS`], one `join` group ([`inputs`]), and the output [`FUSED`].

use nalgebra::Isometry3;
use realo_operator::{Error, Outputs, Port, PortId, unexpected};
use realo_schemas::geometry::relative;
use realo_schemas::report::Fate;
use realo_schemas::{Header, Message, Payload, PayloadType, Selection, UnexpectedPayload};

/// Input: the ego's own.
pub const EGO: PortId = PortId(0);
/// Input: what the bank selected for it.
pub const SELECTIONS: PortId = PortId(1);
/// Output: what was fused.
pub const FUSED: PortId = PortId(0);

/// The inputs of a fusion of payloads of these types.
pub const fn inputs(types: &'static [PayloadType]) -> [Port; 2] {
    [
        Port::new("ego", types, "the ego's own").latest().joined("frame"),
        Port::new("selections", &[PayloadType::Selection], "what the bank chose for it")
            .latest()
            .joined("frame"),
    ]
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
    /// Who could not take part, and why.
    pub left_out: Vec<(Header, Fate)>,
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
        let mut set = Set {
            header,
            ego,
            collaborators: Vec::new(),
            left_out: Vec::new(),
        };
        set.place(entries, max_collaborators.unwrap_or(usize::MAX));
        Ok(set)
    }
}

impl<T> Set<T> {
    /// Leaves out whoever's data are not in the ego's frame.
    pub fn reject_other_frames(&mut self) {
        let (frame, left_out) = (&self.header.frame, &mut self.left_out);
        self.collaborators.retain(|collaborator| {
            let same = collaborator.header.frame == *frame;
            if !same {
                left_out.push((collaborator.header.clone(), Fate::Rejected));
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
            let named = entry.header.clone();
            let map_from_sender = entry.header.pose.as_ref().map(|pose| pose.map_from_frame);
            let (Ok((header, payload)), Some(map_from_ego), Some(map_from_sender)) =
                (entry.into_parts::<T>(), map_from_ego, map_from_sender)
            else {
                self.left_out.push((named, Fate::Rejected));
                continue;
            };
            if self.collaborators.len() == limit {
                self.left_out.push((named, Fate::OverLimit));
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

impl<T> Set<T> {
    /// Sends what was fused of the set, and says what became of each collaborator's message.
    pub fn send(self, fused: impl Into<Payload>, out: &mut Outputs) {
        for collaborator in &self.collaborators {
            out.used(&collaborator.header, &self.header);
        }
        for (header, fate) in &self.left_out {
            let counter = match fate {
                Fate::OverLimit => "over_limit_messages",
                _ => "rejected_messages",
            };
            out.count(counter, 1);
            out.tell(header, *fate);
        }
        out.send(FUSED, Message::new(self.header, fused));
    }
}
