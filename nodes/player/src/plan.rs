use std::fmt;
use std::str::FromStr;

use realo_logs::{AgentInfo, AgentKind, Log, LogError};
use serde::{Deserialize, Serialize};

/// Who collaborates with whom.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Coop {
    /// Everybody with the ego.
    #[default]
    All,
    /// Vehicles with a vehicle.
    V2v,
    /// Roadside units with a vehicle.
    V2i,
    /// Roadside units with a roadside unit.
    I2i,
}

impl Coop {
    const ALL: [Coop; 4] = [Coop::All, Coop::V2v, Coop::V2i, Coop::I2i];

    /// The modes that leave agents out, with their names and what they mean.
    pub const RESTRICTED: &[(Coop, &str, &str)] = &[
        (Coop::V2v, "v2v", "Vehicle ego, vehicles"),
        (Coop::V2i, "v2i", "Vehicle ego, roadside units"),
        (Coop::I2i, "i2i", "Roadside ego, roadside units"),
    ];

    /// The mode's name.
    pub fn as_str(self) -> &'static str {
        match self {
            Coop::All => "all",
            Coop::V2v => "v2v",
            Coop::V2i => "v2i",
            Coop::I2i => "i2i",
        }
    }

    fn takes_as_ego(self, kind: AgentKind) -> bool {
        match self {
            Coop::All => true,
            Coop::V2v | Coop::V2i => kind == AgentKind::Vehicle,
            Coop::I2i => kind == AgentKind::Roadside,
        }
    }

    fn takes_as_collaborator(self, kind: AgentKind) -> bool {
        match self {
            Coop::All => true,
            Coop::V2v => kind == AgentKind::Vehicle,
            Coop::V2i | Coop::I2i => kind == AgentKind::Roadside,
        }
    }
}

impl fmt::Display for Coop {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Coop {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Coop::ALL.into_iter().find(|coop| coop.as_str() == text);
        found.ok_or_else(|| format!("unknown mode `{text}`; there are: all, v2v, v2i, i2i"))
    }
}

/// The runs that a mode means on a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedRuns {
    /// The mode.
    pub coop: Coop,
    /// A run for each ego, in the log's order of agents; at least one.
    pub runs: Vec<PlannedRun>,
}

/// Who takes part in a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlannedRun {
    /// The ego.
    pub ego: String,
    /// Who sends to it, in the log's order of agents.
    pub collaborators: Vec<String>,
}

impl PlannedRun {
    /// The ego, then its collaborators.
    pub fn agents(&self) -> impl Iterator<Item = &str> {
        std::iter::once(self.ego.as_str()).chain(self.collaborators.iter().map(String::as_str))
    }
}

/// Why a mode cannot be played from a log.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The log.
    #[error(transparent)]
    Log(#[from] LogError),
    /// An ego of the wrong kind.
    #[error("`{ego}` is a {} and cannot be the ego of mode {coop}; eligible are: {eligible}", .kind.as_str())]
    Ego {
        /// The agent.
        ego: String,
        /// What it is.
        kind: AgentKind,
        /// The mode.
        coop: Coop,
        /// Agents that could be the ego.
        eligible: String,
    },
    /// No agent can be the ego.
    #[error("no agent of the log can be the ego of mode {coop}; it has: {agents}")]
    NoEgo {
        /// The mode.
        coop: Coop,
        /// Agents and what they are.
        agents: String,
    },
}

/// Who is ego in turn, and who collaborates with each.
///
/// `ego` empty means every eligible agent in turn: vehicles, in mode i2i roadside units (in mode all these too if the log
/// has no vehicle). `agents` restricts who takes part; empty means all; an ego named explicitly always does.
///
/// # Errors
/// Names that the log does not have; a mode without an ego.
pub fn plan(log: &Log, ego: &str, coop: Coop, agents: &[String]) -> Result<PlannedRuns, PlanError> {
    for name in agents
        .iter()
        .map(String::as_str)
        .chain((!ego.is_empty()).then_some(ego))
    {
        log.need_agent(name)?;
    }
    let all = &log.info().agents;
    let allowed = |agent: &&AgentInfo| agents.is_empty() || agents.contains(&agent.name);
    let mut egos: Vec<&AgentInfo> = all
        .iter()
        .filter(allowed)
        .filter(|agent| coop.takes_as_ego(agent.kind))
        .collect();
    if egos.iter().any(|agent| agent.kind == AgentKind::Vehicle) {
        egos.retain(|agent| agent.kind == AgentKind::Vehicle);
    }
    if let Some(named) = log.info().agent(ego) {
        if !coop.takes_as_ego(named.kind) {
            let eligible = names(egos.iter().map(|agent| agent.name.clone()));
            return Err(PlanError::Ego {
                ego: ego.into(),
                kind: named.kind,
                coop,
                eligible,
            });
        }
        egos = vec![named];
    }
    if egos.is_empty() {
        let agents = names(
            all.iter()
                .map(|agent| format!("{} ({})", agent.name, agent.kind.as_str())),
        );
        return Err(PlanError::NoEgo { coop, agents });
    }
    let runs = egos.into_iter().map(|ego| {
        let others = all.iter().filter(|agent| agent.name != ego.name).filter(allowed);
        let others = others.filter(|agent| coop.takes_as_collaborator(agent.kind));
        PlannedRun {
            ego: ego.name.clone(),
            collaborators: others.map(|agent| agent.name.clone()).collect(),
        }
    });
    Ok(PlannedRuns {
        coop,
        runs: runs.collect(),
    })
}

fn names(names: impl Iterator<Item = String>) -> String {
    let names: Vec<String> = names.collect();
    if names.is_empty() {
        "none".into()
    } else {
        names.join(", ")
    }
}
