use realo_schemas::PayloadType;

/// Index of a port in its operator's `INPUTS` or `OUTPUTS`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PortId(pub usize);

/// What an input does with messages that arrive while its stage is busy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// Keeps every message in order; more than [`Queue::CAPACITY`] waiting messages fail the run.
    All,
    /// One slot per agent: a newer message replaces the waiting one, which counts as skipped.
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
        }
    }

    /// Keeps only the newest waiting message of each agent.
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
}
