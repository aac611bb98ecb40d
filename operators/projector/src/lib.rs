//! Brings sweeps to the ego's frame where they are sent, by what the ego reported of itself; or leaves that to the receiver.
//!
//! The frame is that in which the ego will be at the sweep's stamp, as the velocity and angular rate of its newest state say. What is
//! left between that and where the ego is when it uses the data, the receiver corrects. Offline nothing is late: a sweep waits for the
//! state of the ego that belongs to it.

use std::collections::BTreeMap;

use realo_operator::{Counter, Describe, Error, Inputs, Operator, Outputs, Settings};
use realo_schemas::geometry::{relative, transform_cloud};
use realo_schemas::report::Fate;
use realo_schemas::{AgentState, Header, Name, Nanos, OFFLINE_REACH, PointCloud, Pose};
use serde::{Deserialize, Serialize};

/// How long a receiver may have heard nothing of the ego before what it knows is forgotten, ns.
const FORGET: Nanos = 60_000_000_000;

/// A state of the ego tells where it is for at most so long, ns; from then on it is taken to stand still.
const FORESEEN: Nanos = 2_000_000_000;

/// Settings of [`Projector`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct Settings {
    /// Who brings points to the ego's frame: `receiver`, or `sender` (as foreseen by the ego's newest known state).
    #[setting(role = "project")]
    pub project: Project,
    /// Whose frame that is, where several agents send their states; empty: that of the newest state.
    pub ego: String,
    /// A sweep waits up to 50 ms for a state of the ego within 50 ms of it.
    #[setting(role = "offline")]
    pub offline: bool,
}

/// Who brings points to the ego's frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Project {
    /// Whoever receives them, or what was made of them.
    #[default]
    Receiver,
    /// This stage, to where the ego will be by its newest state that has arrived; nothing is sent on before the first.
    Sender,
}

impl Project {
    /// All, with their names and what they mean.
    pub const ALL: &[(Project, &str, &str)] = &[
        (
            Project::Receiver,
            "receiver",
            "Whoever receives it, by the poses of the two stamps",
        ),
        (
            Project::Sender,
            "sender",
            "Whoever sends it, to where the ego will be by its newest state that has arrived",
        ),
    ];

    /// As settings name it.
    pub fn as_str(self) -> &'static str {
        match self {
            Project::Receiver => "receiver",
            Project::Sender => "sender",
        }
    }
}

/// Brings sweeps to the ego's frame where they are sent, or leaves that to the receiver.
#[derive(Describe)]
#[stage(counters(NO_EGO_STATE, OF_ANOTHER))]
pub struct Projector {
    project: Project,
    /// The only one whose states count; empty: everybody's do.
    only: Name,
    /// The ego's newest state, by who received it; under no name what crossed no link and holds for everybody.
    ego: BTreeMap<Option<Name>, Known>,
    offline: bool,
    /// Sweeps that wait for a state, by the time until which they do, and arrival.
    waiting: BTreeMap<(Nanos, u64), (Header, PointCloud)>,
    /// Sweeps that have waited so far.
    waited: u64,
}

/// A state of the ego that has arrived.
struct Known {
    header: Header,
    state: AgentState,
    /// Whether something was projected with it.
    used: bool,
}

const NO_EGO_STATE: Counter = Counter::loss(
    "no_ego_state",
    "clouds not sent: nothing was known yet of where the ego is (`project=sender`)",
    "sweeps were not sent, because nothing was known yet of where the ego is",
    "`--project receiver` needs no state of the ego",
)
.quiet_up_to(10);
const OF_ANOTHER: Counter = Counter::plain(
    "of_another",
    "states of agents for whom nothing is projected, because the setting `ego` names another; they count as superseded",
);

/// What comes in.
#[derive(Debug, Inputs)]
pub enum Input {
    /// An agent's sweeps.
    #[port(latest)]
    Clouds(Header, PointCloud),
    /// The ego's states, as they arrive.
    #[port(state, accounting, needed_when("project", "sender"), of(EgoReceived))]
    State(Header, AgentState),
}

/// What it sends.
#[derive(Debug, Outputs)]
pub enum Output {
    /// The same sweeps.
    Projected(Header, PointCloud),
}

impl Operator for Projector {
    fn build(settings: Settings) -> Result<Self, Error> {
        Ok(Projector {
            project: settings.project,
            only: settings.ego.into(),
            ego: BTreeMap::new(),
            offline: settings.offline,
            waiting: BTreeMap::new(),
            waited: 0,
        })
    }

    fn on_input(&mut self, input: Input, out: &mut Outputs<Output>) -> Result<(), Error> {
        match input {
            Input::Clouds(header, cloud) if self.waits(&header) => {
                let until = header.stamp.saturating_add(OFFLINE_REACH);
                out.wake_at(until);
                self.waiting.insert((until, self.waited), (header, cloud));
                self.waited += 1;
                Ok(())
            }
            Input::Clouds(header, cloud) => self.project(header, cloud, out),
            Input::State(header, state) => {
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
                self.go_on(out)
            }
        }
    }

    fn on_wake(&mut self, now: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        let later = self.waiting.split_off(&(now.saturating_add(1), 0));
        for (header, cloud) in std::mem::replace(&mut self.waiting, later).into_values() {
            self.project(header, cloud, out)?;
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        for (header, cloud) in std::mem::take(&mut self.waiting).into_values() {
            self.project(header, cloud, out)?;
        }
        let left = std::mem::take(&mut self.ego).into_values();
        left.for_each(|known| known.leave(Fate::InFlight, out));
        Ok(())
    }
}

impl Known {
    /// Is given up; `unused` is the fate of one that nothing was projected with.
    fn leave(self, unused: Fate, out: &mut Outputs<Output>) {
        if !self.used {
            out.report(&self.header, unused);
        }
    }
}

impl Projector {
    /// Forgets the receivers that have heard nothing since, so that agents may come and go for days.
    fn forget_before(&mut self, time: Nanos, out: &mut Outputs<Output>) {
        let old = self.ego.extract_if(.., |_, known| known.header.ready < time);
        old.for_each(|(_, known)| known.leave(Fate::InFlight, out));
    }

    /// The newest state of the ego that an agent has received.
    fn known_to(&mut self, agent: &Name) -> Option<&mut Known> {
        let own = Some(agent.clone());
        let key = if self.ego.contains_key(&own) { own } else { None };
        self.ego.get_mut(&key)
    }

    /// Whether the state that belongs to a sweep may yet come.
    fn waits(&mut self, header: &Header) -> bool {
        let known = self.known_to(&header.agent);
        let belongs = known.is_some_and(|known| header.stamp.saturating_sub(known.header.stamp) <= OFFLINE_REACH);
        self.offline && self.project == Project::Sender && !belongs
    }

    /// A state has come: sweeps that it belongs to wait no longer.
    fn go_on(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        for (key, (header, cloud)) in std::mem::take(&mut self.waiting) {
            match self.waits(&header) {
                true => drop(self.waiting.insert(key, (header, cloud))),
                false => self.project(header, cloud, out)?,
            }
        }
        Ok(())
    }

    fn project(&mut self, header: Header, cloud: PointCloud, out: &mut Outputs<Output>) -> Result<(), Error> {
        if self.project == Project::Receiver {
            out.send(Output::Projected(header, cloud));
            return Ok(());
        }
        self.forget_before(header.ready.saturating_sub(FORGET), out);
        let known = self.known_to(&header.agent);
        out.count_of(&NO_EGO_STATE, &header.agent, u64::from(known.is_none()), 1);
        let Some(known) = known else { return Ok(()) };
        let projected = projected(header, &cloud, known)?;
        known.used = true;
        out.report(&known.header, Fate::Used);
        out.send(projected);
        Ok(())
    }
}

/// A sweep that nobody knows the place of.
#[derive(Debug, thiserror::Error)]
#[error("a sweep without a pose cannot be projected ({0})")]
pub struct Unposed(Box<Header>);

/// A sweep in the ego's body frame, as foreseen for the sweep's stamp; the header's frame and pose are then the ego's.
fn projected(header: Header, cloud: &PointCloud, Known { header: ego, state, .. }: &Known) -> Result<Output, Unposed> {
    let pose = header.pose.as_ref();
    let pose = pose.ok_or_else(|| Unposed(Box::new(header.clone())))?;
    let ahead = header.stamp.saturating_sub(ego.stamp).clamp(-FORESEEN, FORESEEN);
    let map_from_ego = state.extrapolated(ahead);
    let ego_from_sender = relative(&map_from_ego, &pose.map_from_frame);
    let header = Header {
        frame: ego.frame.clone(),
        pose: Some(Pose::exact(map_from_ego)),
        position: Some(pose.map_from_frame.translation.vector.into()),
        ..header
    };
    Ok(Output::Projected(header, transform_cloud(&ego_from_sender, cloud)))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
    use realo_schemas::{Kind, Message, PoseStatus};

    use super::*;

    const SECOND: Nanos = 1_000_000_000;

    /// Where `agent` is, as rsu1 received it.
    fn state(agent: &str, x: f64, stamp: Nanos) -> Message {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::AgentState, 0, stamp, stamp);
        header.to = Some("rsu1".into());
        let state = AgentState {
            map_from_body: Isometry3::translation(x, 0.0, 0.0),
            ..at_rest()
        };
        Message::new(header, state)
    }

    fn at_rest() -> AgentState {
        AgentState {
            map_from_body: Isometry3::identity(),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        }
    }

    /// An ego that drives a circle of 20 m to the left about the origin at 10 m/s.
    fn on_a_circle(angle: f64) -> AgentState {
        let heading = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        AgentState {
            map_from_body: Isometry3::from_parts(Translation3::from(heading * Vector3::new(0.0, -20.0, 0.0)), heading),
            velocity: Some(heading * Vector3::new(10.0, 0.0, 0.0)),
            angular_rate: Some(Vector3::new(0.0, 0.0, 0.5)),
            ..at_rest()
        }
    }

    #[test]
    fn points_are_brought_to_where_the_ego_will_be() {
        for (after, expected) in [
            (0, 0.0),
            (SECOND / 10, 0.1),
            (2 * SECOND, 2.0),
            (9 * SECOND, 2.0),
            (-SECOND, -1.0),
        ] {
            let header = |kind, stamp| Header::origin(&"run".into(), &"cav1".into(), kind, 0, stamp, stamp);
            let ego = header(Kind::AgentState, SECOND);
            let known = Known {
                header: ego,
                state: on_a_circle(0.3),
                used: false,
            };
            let mut header = header(Kind::Points, SECOND + after);
            header.pose = Some(Pose::exact(Isometry3::identity()));
            let none = PointCloud::new(vec![], vec![], vec![], vec![], vec![], vec![]).unwrap();
            let Output::Projected(header, _) = projected(header, &none, &known).unwrap();
            let found = header.pose.unwrap().map_from_frame;
            let there = on_a_circle(0.3 + 0.5 * expected).map_from_body;
            let off = (found.translation.vector - there.translation.vector).norm();
            assert!(off < 1e-9, "{off} m after {after} ns");
            assert!(found.rotation.angle_to(&there.rotation) < 1e-9, "after {after} ns");
        }
    }

    #[test]
    fn of_several_agents_that_tell_where_they_are_the_named_one_counts() {
        for (ego, expected, superseded) in [("", -20.0, "cav1"), ("cav1", -10.0, "cav2")] {
            let settings = Settings {
                project: Project::Sender,
                ego: ego.into(),
                offline: false,
            };
            let mut projector = Projector::new(settings).unwrap();
            let mut out = Outputs::at(2 * SECOND);
            projector
                .on_message(Input::STATE, state("cav1", 10.0, SECOND), &mut out)
                .unwrap();
            projector
                .on_message(Input::STATE, state("cav2", 20.0, SECOND + 1), &mut out)
                .unwrap();
            let mut header = Header::origin(&"run".into(), &"rsu1".into(), Kind::Points, 0, SECOND, SECOND);
            header.pose = Some(Pose::exact(Isometry3::identity()));
            let zero = || vec![0.0f32];
            let cloud = PointCloud::new(zero(), zero(), zero(), vec![0u8], vec![0i32], vec![0u16]).unwrap();
            projector
                .on_message(Input::CLOUDS, Message::new(header, cloud), &mut out)
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
    fn offline_a_sweep_waits_for_the_state_that_belongs_to_it() {
        const MILLI: Nanos = 1_000_000;
        let settings = Settings {
            project: Project::Sender,
            offline: true,
            ..Settings::default()
        };
        let mut projector = Projector::new(settings).unwrap();
        let mut out = Outputs::at(SECOND);
        let cloud = |stamp: Nanos| {
            let mut header = Header::origin(&"run".into(), &"rsu1".into(), Kind::Points, 0, stamp, stamp);
            header.pose = Some(Pose::exact(Isometry3::identity()));
            Message::new(
                header,
                PointCloud::new(vec![], vec![], vec![], vec![], vec![], vec![]).unwrap(),
            )
        };
        let mut states = |projector: &mut Projector, stamps: [Nanos; 3]| {
            let [early, sweep, late] = stamps;
            projector
                .on_message(Input::STATE, state("cav1", 10.0, early), &mut out)
                .unwrap();
            projector.on_message(Input::CLOUDS, cloud(sweep), &mut out).unwrap();
            let before = out.take_sent().len();
            projector
                .on_message(Input::STATE, state("cav1", 20.0, late), &mut out)
                .unwrap();
            let sent = out.take_sent();
            let place = sent
                .first()
                .map(|(_, message)| message.header.pose.as_ref().unwrap().map_from_frame);
            (before, place.map(|place| place.translation.x))
        };
        let later = |at: Nanos| SECOND + at * MILLI;
        // The state of 1.1 s belongs to it, that of 1 s does not.
        assert_eq!(
            states(&mut projector, [later(0), later(99), later(100)]),
            (0, Some(20.0))
        );
        // That of 1.2 s does.
        assert_eq!(states(&mut projector, [later(200), later(220), later(300)]), (1, None));
        // None comes: it goes with what is known when its time is over.
        assert_eq!(states(&mut projector, [later(400), later(460), later(400)]), (0, None));
        let mut out = Outputs::at(later(510));
        projector.on_wake(later(509), &mut out).unwrap();
        assert_eq!(out.take_sent().len(), 0);
        projector.on_wake(later(510), &mut out).unwrap();
        assert_eq!(out.take_sent().len(), 1);
    }

    #[test]
    fn receivers_that_hear_no_more_of_the_ego_are_forgotten() {
        let mut projector = Projector::new(Settings::default()).unwrap();
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
            let mut out = Outputs::at(header.ready);
            projector
                .on_message(Input::STATE, Message::new(header, at_rest()), &mut out)
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
