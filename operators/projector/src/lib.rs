//! Brings sweeps to the ego's frame where they are sent, by what the ego reported of itself; or leaves that to the receiver.
//!
//! | port | direction | types | meaning |
//! |---|---|---|---|
//! | `clouds` | in, latest | PointCloud | an agent's sweeps |
//! | `state` | in, state, optional | AgentState | the ego's states as they arrive, for `project=sender` |
//! | `projected` | out | PointCloud | the same sweeps; with `project=sender` in the ego's body frame at the stamp of its newest known state |
//!
//! | counter | meaning |
//! |---|---|
//! | `no_ego_state` | sweeps that were not sent on, for no state of the ego had arrived |
//! | `of_another` | states of agents that nothing is projected for, which count as superseded |

use std::collections::BTreeMap;

use realo_operator::{
    Argument, Counter, Decided, Describe, Error, Lane, Operator, Outputs, Port, PortId, unexpected, wrong_port,
};
use realo_schemas::geometry::{relative, transform_cloud};
use realo_schemas::report::Fate;
use realo_schemas::{AgentState, Header, Message, Name, Nanos, PayloadType, PointCloud, Pose};
use serde::{Deserialize, Serialize};

/// How long a receiver may have heard nothing of the ego before what it knows is forgotten, ns.
const FORGET: Nanos = 60_000_000_000;

/// Settings of [`Projector`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Who brings points to the ego's frame.
    pub project: Project,
    /// Whose frame that is, where several agents tell their states; empty: that of the agent whose state is the newest.
    pub ego: String,
}

/// Who brings points to the ego's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Project {
    /// Whoever receives them, or what was made of them.
    #[default]
    Receiver,
    /// This stage, with the newest state of the ego that has arrived; nothing is sent on before the first.
    Sender,
}

/// The operator `projector`.
pub struct Projector {
    project: Project,
    /// The only one whose states count; empty: everybody's do.
    only: Name,
    /// The ego's newest state, by who received it; under no name what crossed no link and holds for everybody.
    ego: BTreeMap<Option<Name>, Known>,
}

/// A state of the ego that has arrived.
struct Known {
    header: Header,
    state: AgentState,
    /// Whether something was projected with it.
    used: bool,
}

const CLOUDS: PortId = PortId(0);
const STATE: PortId = PortId(1);
const PROJECTED: PortId = PortId(0);

const NO_EGO_STATE: Counter = Counter::loss(
    "no_ego_state",
    "clouds not sent: nothing was known yet of where the ego is (`project=sender`)",
    "sweeps were not sent, because nothing was known yet of where the ego is",
    "`--project receiver` needs no state of the ego",
)
.quiet_up_to(10);
const OF_ANOTHER: Counter = Counter::plain(
    "of_another",
    "states of agents for whom nothing is projected (`projector.ego` names another); they count as superseded",
);

impl Describe for Projector {
    type Config = Config;
    const NAME: &'static str = "projector";
    const ABOUT: &'static str = "Brings sweeps to the ego's frame where they are sent, or leaves that to the receiver";
    const ARGUMENTS: &'static [Argument] = &[
        Argument {
            name: "project",
            about: "who brings points to the ego's frame: receiver, or sender (with the ego's newest known state)",
        },
        Argument {
            name: "ego",
            about: "whose frame that is, where several agents tell their states; empty: that of the newest state",
        },
    ];
    const INPUTS: &'static [Port] = &[
        Port::new("clouds", &[PayloadType::PointCloud], "an agent's sweeps").latest(),
        Port::new("state", &[PayloadType::AgentState], "the ego's states, as they arrive")
            .state()
            .accounting()
            .needed_when("project", "sender")
            .of(Lane::EgoReceived),
    ];
    const OUTPUTS: &'static [Port] = &[Port::new("projected", &[PayloadType::PointCloud], "the same sweeps")];
    const COUNTERS: &'static [Counter] = &[NO_EGO_STATE, OF_ANOTHER];
    const DECIDED: &'static [(Decided, &'static str)] = &[(Decided::Project, "project")];
}

impl Operator for Projector {
    fn new(config: Config) -> Result<Self, Error> {
        Ok(Projector {
            project: config.project,
            only: config.ego.into(),
            ego: BTreeMap::new(),
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        match port {
            CLOUDS => self.project(message, out),
            STATE => {
                let (header, state): (Header, AgentState) = message.into_parts().map_err(unexpected)?;
                if !self.only.is_empty() && header.agent != self.only {
                    out.count(&OF_ANOTHER, &header.agent, 1);
                    out.report(&header, Fate::Superseded);
                    return Ok(());
                }
                let receiver = header.to.clone();
                if let Some(known) = self
                    .ego
                    .get(&receiver)
                    .filter(|known| known.header.stamp >= header.stamp)
                {
                    // A copy that the channel made takes nobody's place, nor does it lose its own.
                    if known.header.seq != header.seq {
                        out.report(&header, Fate::Superseded);
                    }
                    return Ok(());
                }
                let known = Known {
                    header,
                    state,
                    used: false,
                };
                let now = known.header.ready;
                if let Some(older) = self.ego.insert(receiver, known) {
                    older.leave(Fate::Superseded, out);
                }
                self.forget_before(now.saturating_sub(FORGET), out);
                Ok(())
            }
            _ => Err(wrong_port(Self::INPUTS, port)),
        }
    }

    fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
        let left = std::mem::take(&mut self.ego).into_values();
        left.for_each(|known| known.leave(Fate::InFlight, out));
        Ok(())
    }
}

impl Known {
    /// Is given up; `unused` is the fate of one that nothing was projected with.
    fn leave(self, unused: Fate, out: &mut Outputs) {
        if !self.used {
            out.report(&self.header, unused);
        }
    }
}

impl Projector {
    /// Forgets the receivers that have heard nothing since, so that agents may come and go for days.
    fn forget_before(&mut self, time: Nanos, out: &mut Outputs) {
        let old = self.ego.extract_if(.., |_, known| known.header.ready < time);
        old.for_each(|(_, known)| known.leave(Fate::InFlight, out));
    }

    /// The newest state of the ego that an agent has received.
    fn known_to(&mut self, agent: &Name) -> Option<&mut Known> {
        let own = Some(agent.clone());
        let key = if self.ego.contains_key(&own) { own } else { None };
        self.ego.get_mut(&key)
    }

    fn project(&mut self, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if self.project == Project::Receiver {
            out.send(PROJECTED, message);
            return Ok(());
        }
        let (header, cloud): (Header, PointCloud) = message.into_parts().map_err(unexpected)?;
        self.forget_before(header.ready.saturating_sub(FORGET), out);
        let known = self.known_to(&header.agent);
        out.count_of(&NO_EGO_STATE, &header.agent, u64::from(known.is_none()), 1);
        let Some(known) = known else { return Ok(()) };
        let projected = projected(header, &cloud, known)?;
        known.used = true;
        out.report(&known.header, Fate::Used);
        out.send(PROJECTED, projected);
        Ok(())
    }
}

/// A sweep in the ego's body frame at the state's stamp; the header's frame and pose are then the ego's.
fn projected(header: Header, cloud: &PointCloud, Known { header: ego, state, .. }: &Known) -> Result<Message, Error> {
    let pose = header.pose.as_ref();
    let pose = pose.ok_or_else(|| format!("a sweep without a pose cannot be projected ({header})"))?;
    let ego_from_sender = relative(&state.map_from_body, &pose.map_from_frame);
    let header = Header {
        frame: ego.frame.clone(),
        pose: Some(Pose::exact(state.map_from_body)),
        position: Some(pose.map_from_frame.translation.vector.into()),
        ..header
    };
    Ok(Message::new(header, transform_cloud(&ego_from_sender, cloud)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;
    use realo_schemas::{Kind, PoseStatus};

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    /// Where `agent` is, as rsu1 received it.
    fn state(agent: &str, x: f64, stamp: Nanos) -> Message {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::AgentState, 0, stamp, stamp);
        header.to = Some("rsu1".into());
        let state = AgentState {
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        };
        Message::new(header, state)
    }

    #[test]
    fn of_several_agents_that_tell_where_they_are_the_named_one_counts() {
        for (ego, expected, superseded) in [("", -20.0, "cav1"), ("cav1", -10.0, "cav2")] {
            let config = Config {
                project: Project::Sender,
                ego: ego.into(),
            };
            let mut projector = Projector::new(config).unwrap();
            let mut out = Outputs::at(2 * SECOND);
            projector
                .on_input(STATE, state("cav1", 10.0, SECOND), &mut out)
                .unwrap();
            projector
                .on_input(STATE, state("cav2", 20.0, SECOND + 1), &mut out)
                .unwrap();
            let mut header = Header::origin(&"run".into(), &"rsu1".into(), Kind::Points, 0, SECOND, SECOND);
            header.pose = Some(Pose::exact(Isometry3::identity()));
            let zero = || vec![0.0f32];
            let cloud = PointCloud::new(zero(), zero(), zero(), vec![0u8], vec![0i32], vec![0u16]).unwrap();
            projector
                .on_input(CLOUDS, Message::new(header, cloud), &mut out)
                .unwrap();
            let fates = out.take_fates();
            let (_, message) = out.take_sent().remove(0);
            let (header, cloud): (Header, PointCloud) = message.into_parts().unwrap();
            let message_position = header.sender_position();
            assert_eq!(cloud.x[0], expected, "ego `{ego}`");
            assert_eq!(message_position, Some([0.0; 3]), "the sender's own place stays known");
            let gone = fates.iter().find(|fated| fated.fate == Fate::Superseded).unwrap();
            assert_eq!(gone.message.from, superseded);
        }
    }

    #[test]
    fn receivers_that_hear_no_more_of_the_ego_are_forgotten() {
        let mut projector = Projector::new(Config::default()).unwrap();
        let mut fates = Vec::new();
        // Every second another agent comes, receives one state and goes.
        for k in 0..1000 {
            let stamp = k * SECOND;
            let mut header = Header::origin(
                &"run".into(),
                &"cav1".into(),
                Kind::AgentState,
                k as u64,
                stamp,
                stamp + 7,
            );
            header.to = Some(format!("cav{k}").as_str().into());
            let state = AgentState {
                map_from_body: Isometry3::identity(),
                covariance: None,
                velocity: None,
                angular_rate: None,
                status: PoseStatus::Truth,
            };
            let mut out = Outputs::at(header.ready);
            projector
                .on_input(STATE, Message::new(header, state), &mut out)
                .unwrap();
            fates.extend(out.take_fates());
            assert!(projector.ego.len() <= 61, "{} receivers", projector.ego.len());
        }
        let last: Vec<u64> = projector.ego.values().map(|known| known.header.seq).collect();
        assert_eq!((last.len(), last.iter().min()), (61, Some(&939)));
        assert_eq!(fates.len(), 939, "each one that goes is accounted for");
        assert!(fates.iter().all(|fated| fated.fate == Fate::InFlight));
    }
}
