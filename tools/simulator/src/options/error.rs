//! Why options cannot be.

use super::MOST_AGENTS;

/// Options that no simulation can meet.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Error {
    /// A number out of its range.
    #[error("simulation option `{field}`: expected {expected}, found {found}")]
    Range {
        /// The option.
        field: &'static str,
        /// What it takes.
        expected: &'static str,
        /// What came.
        found: String,
    },
    /// An agent that no place has.
    #[error("simulation option `agents`: no agent `{found}`; a place has cav1 to cav16 and rsu1 to rsu16")]
    UnknownAgent {
        /// The name that came.
        found: String,
    },
    /// The same agent twice.
    #[error("simulation option `agents`: `{found}` is named twice; name each agent once")]
    AgentTwice {
        /// The name that came twice.
        found: String,
    },
    /// A scenario that there is not.
    #[error(
        "simulation option `scenario`: no scenario `{found}`; there are intersection, corridor, junction, tee, roundabout, \
         curve, residential, motorway, car_park, avenue, rural, market, loop and mixed"
    )]
    UnknownScenario {
        /// The name that came.
        found: String,
    },
    /// Something of an agent that does not record.
    #[error("simulation option `{field}`: `{agent}` does not record; the agents are {agents}")]
    NotAnAgent {
        /// The option.
        field: &'static str,
        /// The name that came.
        agent: String,
        /// Who records.
        agents: String,
    },
    /// A place whose traffic has no two cars that can carry agents.
    #[error(
        "simulation options `scenario`, `seed` and `place`: in {scenario}, place {place}, no two cars of seed {seed}'s \
         traffic are near each other; take another seed"
    )]
    NoRoom {
        /// What was built.
        scenario: &'static str,
        /// The place's number.
        place: u64,
        /// The traffic's.
        seed: u64,
    },
    /// Nobody records.
    #[error("simulation option `agents`: nobody records; name at least one of cav1, cav2, rsu1 and rsu2")]
    NoAgent,
    /// More agents than a fleet has.
    #[error("simulation option `agents`: expected at most {MOST_AGENTS} agents, found {found}")]
    TooManyAgents {
        /// How many came.
        found: usize,
    },
    /// A vehicle that no car can be.
    #[error(
        "simulation option `agents`: no car for `{name}`: {found} cars stay for the whole log; \
         ask for fewer vehicles, a shorter log or dense traffic"
    )]
    NoCar {
        /// The agent.
        name: String,
        /// Cars that could be agents.
        found: usize,
    },
    /// A roadside unit for which there is no place.
    #[error("simulation option `agents`: no place beside the roads for `{name}`; ask for fewer roadside units")]
    NoStand {
        /// The agent.
        name: String,
    },
}

pub(super) fn require(holds: bool, field: &'static str, value: f64, expected: &'static str) -> Result<(), Error> {
    if holds {
        Ok(())
    } else {
        Err(Error::Range {
            field,
            expected,
            found: value.to_string(),
        })
    }
}
