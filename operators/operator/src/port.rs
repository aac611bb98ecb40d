use std::fmt;

use realo_schemas::{Message, Name, PayloadType};
use serde::{Deserialize, Serialize};

/// Index of a port in its operator's `INPUTS` or `OUTPUTS`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PortId(pub usize);

/// What an input does with messages that arrive while its stage is busy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// Keeps every message in order; more than [`Queue::CAPACITY`] waiting messages fail the run.
    All,
    /// One slot per agent and kind, and of what crossed a link per sender and receiver: a newer message replaces the waiting one,
    /// which counts as skipped.
    Latest,
}

impl Queue {
    /// Messages that an [`Queue::All`] port may hold.
    pub const CAPACITY: usize = 1024;
}

/// Which of several messages that are ready at one time goes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Poses and the like: known before the data of the same instant.
    State,
    /// Ordinary messages.
    Data,
    /// Asks for what is there; sees everything that is ready at the same instant.
    Query,
}

/// Whose data a wire carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The ego's own.
    Ego,
    /// The other agents', where they are made.
    Others,
    /// The other agents', after a link brought it to the ego.
    OthersReceived,
    /// The ego's, after a link brought it to the others.
    EgoReceived,
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Side::Ego => "the ego's data",
            Side::Others => "the others' data",
            Side::OthersReceived => "the others' data, through a link",
            Side::EgoReceived => "the ego's data, through a link",
        })
    }
}

/// A message of a type that an input does not take.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("input `{port}` takes {}, found {found} from `{from}`; wire an output of such a type to it", names(.expected))]
pub struct WrongType {
    /// The input's name.
    pub port: &'static str,
    /// What it takes.
    pub expected: &'static [PayloadType],
    /// What came.
    pub found: PayloadType,
    /// The node that sent it.
    pub from: Name,
}

fn names(types: &[PayloadType]) -> String {
    let names: Vec<_> = types.iter().map(|known| known.as_str()).collect();
    names.join(" or ")
}

/// What is known of the BEV maps of a port before a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownMap {
    /// Rows, columns and channels; `None` where any number may come.
    pub size: [Option<u32>; 3],
    /// What says so: a file, and which of its inputs or outputs.
    pub by: String,
}

impl KnownMap {
    /// What their numbers are of.
    pub const DIMENSIONS: [&str; 3] = ["rows", "columns", "channels"];

    /// The first dimension in which two maps differ, with both numbers.
    pub fn differs(&self, other: &KnownMap) -> Option<(&'static str, u32, u32)> {
        let pairs = self.size.iter().zip(&other.size).zip(Self::DIMENSIONS).rev();
        let mut known = pairs.filter_map(|((own, other), name)| Some((name, (*own)?, (*other)?)));
        known.find(|(_, own, other)| own != other)
    }
}

/// One input or output of an operator or node.
#[derive(Clone, Copy, Debug)]
pub struct Port {
    /// Name in graphs.
    pub name: &'static str,
    /// Payloads that it carries; a graph may narrow them.
    pub types: &'static [PayloadType],
    /// One line for `realo operators`.
    pub about: &'static str,
    /// What happens to waiting messages (inputs).
    pub queue: Queue,
    /// Order among messages of one instant (inputs).
    pub class: Class,
    /// Whether a graph must wire it (inputs).
    pub required: bool,
    /// Ports of one group are assembled by (agent, seq) into one set (inputs).
    pub join: Option<&'static str>,
    /// Whether the way of what crossed a link ends here, and the stage says what became of it (inputs).
    pub accounts: bool,
    /// A setting and its value with which a graph must wire an optional input.
    pub needed: Option<(&'static str, &'static str)>,
    /// Whose data it carries, whatever the other ports do; of the others all inputs carry those of one side, and so do
    /// the outputs.
    pub side: Option<Side>,
    /// Whether it ends as soon as one of the inputs has (outputs of gateways).
    pub ends_early: bool,
    /// Inputs of a graph that say the same word here hang on one wire.
    pub wire: Option<&'static str>,
    /// Whether it brings word of what the stage itself sent: the order of a graph does not go along its wire, and the stage ends
    /// without waiting for it (inputs).
    pub feedback: bool,
    /// What a program says of the BEV maps that it carries; stages of this process say it by [`Registration::maps`](crate::Registration::maps).
    pub map: Option<&'static KnownMap>,
}

impl Port {
    /// A required input that keeps every message; as an output, the rest does not matter.
    pub const fn new(name: &'static str, types: &'static [PayloadType], about: &'static str) -> Self {
        Port {
            name,
            types,
            about,
            queue: Queue::All,
            class: Class::Data,
            required: true,
            join: None,
            accounts: false,
            needed: None,
            side: None,
            ends_early: false,
            wire: None,
            feedback: false,
            map: None,
        }
    }

    /// Whether a message may come in here; both drivers ask this of every message.
    ///
    /// # Errors
    /// [`WrongType`] ends the run: no message of such a wire can ever be taken.
    pub fn admit(&self, message: &Message) -> Result<(), WrongType> {
        let found = message.payload.payload_type();
        if self.types.contains(&found) {
            return Ok(());
        }
        let sender = message.header.trace.last().map(|stage| stage.node.clone());
        Err(WrongType {
            port: self.name,
            expected: self.types,
            found,
            from: sender.unwrap_or_default(),
        })
    }

    /// Keeps only the newest waiting message, as [`Queue::Latest`] says.
    pub const fn latest(mut self) -> Self {
        self.queue = Queue::Latest;
        self
    }

    /// Goes before data of the same instant.
    pub const fn state(mut self) -> Self {
        self.class = Class::State;
        self
    }

    /// Goes after data and wakes of the same instant.
    pub const fn query(mut self) -> Self {
        self.class = Class::Query;
        self
    }

    /// May stay unwired.
    pub const fn optional(mut self) -> Self {
        self.required = false;
        self
    }

    /// Is assembled with the other ports of the group.
    pub const fn joined(mut self, group: &'static str) -> Self {
        self.join = Some(group);
        self
    }

    /// May stay unwired unless `setting` is `value`.
    pub const fn needed_when(mut self, setting: &'static str, value: &'static str) -> Self {
        self.required = false;
        self.needed = Some((setting, value));
        self
    }

    /// Carries the data of this side, where sides begin, meet or cross.
    pub const fn of(mut self, side: Side) -> Self {
        self.side = Some(side);
        self
    }

    /// Ends as soon as one of the inputs of its gateway has, so that a stage which it feeds and which feeds the gateway can
    /// end: what would come later stays on its way.
    pub const fn ends_early(mut self) -> Self {
        self.ends_early = true;
        self
    }

    /// May stay unwired, and brings word of what the stage itself sent: its wire closes a circle. What comes after the stage's other
    /// inputs have ended is dropped.
    pub const fn feedback(mut self) -> Self {
        self.required = false;
        self.feedback = true;
        self
    }

    /// Hangs on the same wire as all inputs that say the same word.
    pub const fn on_wire(mut self, word: &'static str) -> Self {
        self.wire = Some(word);
        self
    }

    /// Ends the way of what crossed a link: the stage says what became of each message.
    pub const fn accounting(mut self) -> Self {
        self.accounts = true;
        self
    }
}
