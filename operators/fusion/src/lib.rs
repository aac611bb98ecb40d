//! What every fusion operator does before it fuses: pairs the ego's message with what the bank selected for it, puts the
//! collaborators in order, places them in the ego's frame, and says what became of each.
//!
//! A fusion has the inputs [`Input`], one `join` group, and one output. One of BEV maps finds the collaborators' features at the cells of the ego's map by [`Set::maps`].

mod maps;

use std::collections::BTreeSet;

use nalgebra::Isometry3;
use realo_operator::{Counter, Inputs, Outputs, PortPayload, StageOutputs};
use realo_schemas::geometry::relative;
use realo_schemas::report::Fate;
use realo_schemas::{Header, Message, Selection};

pub use maps::{Maps, PlacedMap};

/// Counts messages beyond the collaborators that a fusion takes; the books of links have the note.
pub const OVER_LIMIT_MESSAGES: Counter = Counter::plain(
    "over_limit_messages",
    "messages beyond the collaborators that the fusion takes; those of a channel are `over_limit` in `links`",
);
/// Counts messages that cannot be fused.
pub const REJECTED_MESSAGES: Counter = Counter::loss(
    "rejected_messages",
    "messages that could not be fused: without a pose, in another frame, or of another grid",
    "messages could not be fused, because they have no pose, or lie in another frame or grid than the ego's",
    "all agents need one model and poses, and one of sender and receiver has to project (`--project`)",
);
/// Counts messages of agents whose heights cannot be those of one street.
pub const OTHER_LEVEL: Counter = Counter::loss(
    "other_level",
    "messages of agents that are farther above or below the ego than a street may rise: 10 m, and a quarter of the way",
    "messages are of agents that are farther above or below the ego than a street may rise, so they show nothing of its surroundings",
    "do they drive on another level? If not, heights are of different references, such as the sea's level and the ellipsoid: `realo info` \
     has the poses",
);
/// What every fusion counts.
pub const COUNTERS: &[Counter] = &[OVER_LIMIT_MESSAGES, REJECTED_MESSAGES, OTHER_LEVEL];

/// Agents are on another level from so much of height between them on, m, and so much for each metre on the ground.
const LEVEL: [f64; 2] = [10.0, 0.25];

/// The inputs of a fusion of one form of payload; both come as one set.
#[derive(Debug, Inputs)]
pub enum Input<T: PortPayload> {
    /// The ego's own.
    #[port(latest, joined("frame"), of(Ego))]
    Ego(Header, T),
    /// What the bank chose for it.
    #[port(latest, joined("frame"), of(Ego))]
    Selections(Header, Selection),
}

/// Keeps the ego's part of a set until its selection comes.
#[derive(Debug)]
pub struct Pairing<T> {
    ego: Option<(Header, T)>,
}

impl<T> Default for Pairing<T> {
    fn default() -> Self {
        Pairing { ego: None }
    }
}

/// A set that cannot be fused.
#[derive(Debug, thiserror::Error)]
pub enum PairingError {
    /// The selection came alone.
    #[error("a selection without the ego's message of the same set ({0})")]
    Alone(Box<Header>),
    /// The two do not belong together.
    #[error("a selection for query {query} of {}, but the ego's message is {ego}", .asked.agent)]
    Other {
        /// The seq that the selection answers.
        query: u64,
        /// The selection's header.
        asked: Box<Header>,
        /// The ego's.
        ego: Box<Header>,
    },
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

impl<T: PortPayload> Pairing<T> {
    /// Takes an input; gives the set that the selection completes. At most `max_collaborators` of it take part, those nearest to
    /// the ego. Of equally far ones, and where it is unknown how far they are, the first by name.
    ///
    /// # Errors
    /// A selection for another message than the ego's.
    pub fn take(&mut self, input: Input<T>, max_collaborators: Option<usize>) -> Result<Option<Set<T>>, PairingError> {
        let (asked, Selection { query, entries }) = match input {
            Input::Ego(header, ego) => {
                self.ego = Some((header, ego));
                return Ok(None);
            }
            Input::Selections(header, selection) => (header, selection),
        };
        let Some((header, ego)) = self.ego.take() else {
            return Err(PairingError::Alone(asked.into()));
        };
        if (&header.agent, header.seq) != (&asked.agent, query) {
            let (asked, ego) = (asked.into(), header.into());
            return Err(PairingError::Other { query, asked, ego });
        }
        let mut set = Set {
            header,
            ego,
            collaborators: Vec::new(),
            left_out: Vec::new(),
        };
        set.place(entries);
        if let Some(limit) = max_collaborators {
            set.keep_nearest(limit);
        }
        Ok(Some(set))
    }
}

impl<T> Set<T> {
    /// Leaves out whoever's data are not in the ego's frame.
    pub fn reject_other_frames(&mut self) {
        let frame = self.header.frame.clone();
        self.reject(|collaborator| collaborator.header.frame != frame);
    }

    /// Leaves out whoever cannot be fused.
    pub fn reject(&mut self, mut cannot: impl FnMut(&Collaborator<T>) -> bool) {
        let left_out = &mut self.left_out;
        self.collaborators.retain(|collaborator| {
            let can = !cannot(collaborator);
            if !can {
                left_out.push((collaborator.header.clone(), Fate::Rejected));
            }
            can
        });
    }
}

impl<T: PortPayload> Set<T> {
    fn place(&mut self, mut entries: Vec<Message>) {
        entries.sort_by(|a, b| a.header.agent.cmp(&b.header.agent));
        let map_from_ego = self.header.pose.as_ref().map(|pose| pose.map_from_frame);
        for entry in entries {
            let named = entry.header.clone();
            let map_from_sender = entry.header.pose.as_ref().map(|pose| pose.map_from_frame);
            let (Ok((header, payload)), Some(map_from_ego), Some(map_from_sender)) =
                (T::of_message(entry), map_from_ego, map_from_sender)
            else {
                self.left_out.push((named, Fate::Rejected));
                continue;
            };
            self.collaborators.push(Collaborator {
                header,
                payload,
                ego_from_sender: relative(&map_from_ego, &map_from_sender),
            });
        }
    }
}

impl<T> Set<T> {
    /// Leaves out whoever is farther from the ego than `limit` others.
    fn keep_nearest(&mut self, limit: usize) {
        if self.collaborators.len() <= limit {
            return;
        }
        let ego = self.header.pose.as_ref().map(|pose| pose.map_from_frame.translation);
        let distance = |collaborator: &Collaborator<T>| {
            let (ego, [x, y, _]) = ego.zip(collaborator.header.sender_position())?;
            Some((x - ego.x).hypot(y - ego.y))
        };
        let distances = self
            .collaborators
            .iter()
            .map(|one| distance(one).unwrap_or(f64::INFINITY));
        let mut nearest: Vec<(f64, usize)> = distances.zip(0..).collect();
        nearest.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let kept: BTreeSet<usize> = nearest.iter().take(limit).map(|(_, place)| *place).collect();
        for (place, collaborator) in std::mem::take(&mut self.collaborators).into_iter().enumerate() {
            match kept.contains(&place) {
                true => self.collaborators.push(collaborator),
                false => self.left_out.push((collaborator.header, Fate::OverLimit)),
            }
        }
    }

    /// How much higher than the ego a sender is, and how far away on the ground, m.
    fn rise(&self, header: &Header) -> Option<[f64; 2]> {
        let ego = self.header.pose.as_ref()?.map_from_frame.translation;
        let [x, y, z] = header.sender_position()?;
        Some([z - ego.z, (x - ego.x).hypot(y - ego.y)])
    }

    /// Sends what was fused of the set, and says what became of each collaborator's message.
    ///
    /// `output`: the port, such as `Output::Proposals`.
    pub fn send<P, O: StageOutputs>(self, output: impl FnOnce(Header, P) -> O, fused: P, out: &mut Outputs<O>) {
        for Collaborator { header, .. } in &self.collaborators {
            out.count_of(&REJECTED_MESSAGES, &header.agent, 0, 1);
            let rise = self
                .rise(header)
                .filter(|[height, way]| height.abs() > LEVEL[0] + LEVEL[1] * way);
            out.count_of(&OTHER_LEVEL, &header.agent, u64::from(rise.is_some()), 1);
            if let Some([height, way]) = rise {
                out.found(&OTHER_LEVEL, &header.agent, || {
                    format!("{height:+.1} m, {way:.0} m away")
                });
            }
            out.used(header, &self.header);
        }
        for (header, fate) in &self.left_out {
            let over_limit = u64::from(*fate == Fate::OverLimit);
            out.count(&OVER_LIMIT_MESSAGES, &header.agent, over_limit);
            out.count_of(&REJECTED_MESSAGES, &header.agent, 1 - over_limit, 1);
            out.report(header, *fate);
        }
        out.send(output(self.header, fused));
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Translation3, UnitQuaternion};
    use realo_operator::{PortId, StageInputs};
    use realo_schemas::{AgentState, Boxes, Kind, Pose, PoseStatus};

    use super::*;

    /// What a fusion sends.
    #[derive(Outputs)]
    pub(crate) enum Output {
        /// What was fused.
        Fused(Header, Boxes),
    }

    fn pose(x: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(1e5 + x, -1e5, 3.0),
            UnitQuaternion::from_euler_angles(0.0, 0.0, yaw),
        )
    }

    fn header(agent: &str, seq: u64) -> Header {
        let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, 100, 180);
        header.to = Some("cav1".into());
        header
    }

    fn boxes(agent: &str, x: f64) -> Message {
        let mut header = header(agent, 3);
        (header.stamp, header.pose) = (40, Some(Pose::exact(pose(x, 0.5))));
        Message::new(header, Boxes::default())
    }

    fn ego(seq: u64) -> Message {
        let mut header = header("cav1", seq);
        header.pose = Some(Pose::exact(pose(0.0, 0.1)));
        Message::new(header, Boxes::default())
    }

    fn selection(query: u64, of: &Message, entries: Vec<Message>) -> Message {
        Message::new(of.header.clone(), Selection { query, entries })
    }

    fn agents(set: &Set<Boxes>) -> Vec<&str> {
        set.collaborators.iter().map(|one| &*one.header.agent).collect()
    }

    fn take(
        pairing: &mut Pairing<Boxes>,
        port: PortId,
        message: Message,
        limit: Option<usize>,
    ) -> Result<Option<Set<Boxes>>, PairingError> {
        pairing.take(Input::read(port, message).unwrap(), limit)
    }

    fn paired(entries: Vec<Message>, limit: Option<usize>) -> Set<Boxes> {
        let mut pairing = Pairing::default();
        take(&mut pairing, Input::<Boxes>::EGO, ego(7), limit).unwrap();
        let set = take(
            &mut pairing,
            Input::<Boxes>::SELECTIONS,
            selection(7, &ego(7), entries),
            limit,
        );
        set.unwrap().expect("a selection completes the set")
    }

    #[test]
    fn a_selection_finds_only_the_message_that_asked_for_it() {
        let chosen = |pairing: &mut Pairing<Boxes>, message| take(pairing, Input::<Boxes>::SELECTIONS, message, None);
        let other = |query, agent: &str| {
            let mut asked = ego(7);
            asked.header.agent = agent.into();
            let mut pairing = Pairing::default();
            take(&mut pairing, Input::<Boxes>::EGO, ego(7), None).unwrap();
            let error = chosen(&mut pairing, selection(query, &asked, vec![])).err();
            error.map(|error| error.to_string())
        };
        assert_eq!(other(7, "cav1"), None);
        assert!(other(6, "cav1").unwrap().contains("query 6 of cav1"));
        assert!(other(7, "cav2").unwrap().contains("query 7 of cav2"));
        let mut pairing = Pairing::default();
        let alone = chosen(&mut pairing, selection(7, &ego(7), vec![])).unwrap_err();
        assert!(alone.to_string().contains("without the ego's message"));
        take(&mut pairing, Input::<Boxes>::EGO, ego(7), None).unwrap();
        chosen(&mut pairing, selection(7, &ego(7), vec![])).unwrap();
        let again = chosen(&mut pairing, selection(7, &ego(7), vec![]));
        assert!(again.is_err(), "the ego's message is used up");
    }

    fn left(set: &Set<Boxes>) -> Vec<(&str, Fate)> {
        let left = set.left_out.iter();
        left.map(|(header, fate)| (&*header.agent, *fate)).collect()
    }

    #[test]
    fn collaborators_stand_by_name_and_the_first_of_equally_far_ones_fill_the_limit() {
        let entries = || ["rsu1", "cav3", "cav2"].map(|agent| boxes(agent, 5.0)).to_vec();
        assert_eq!(agents(&paired(entries(), None)), ["cav2", "cav3", "rsu1"]);
        let set = paired(entries(), Some(2));
        assert_eq!(agents(&set), ["cav2", "cav3"]);
        assert_eq!(left(&set), [("rsu1", Fate::OverLimit)]);
        assert_eq!(agents(&paired(entries(), Some(3))).len(), 3);
        assert_eq!(agents(&paired(entries(), Some(0))).len(), 0);
    }

    #[test]
    fn the_nearest_fill_the_limit_whatever_their_names_and_order() {
        let at = [
            ("cav2", 90.0),
            ("cav3", -8.0),
            ("cav4", 30.0),
            ("cav5", -31.0),
            ("rsu1", 2.0),
        ];
        let mut entries = at.map(|(agent, x)| boxes(agent, x)).to_vec();
        for turn in 0..entries.len() {
            entries.rotate_left(1);
            for (limit, expected) in [
                (1, &["rsu1"][..]),
                (2, &["cav3", "rsu1"]),
                (3, &["cav3", "cav4", "rsu1"]),
                (4, &["cav3", "cav4", "cav5", "rsu1"]),
            ] {
                let set = paired(entries.clone(), Some(limit));
                assert_eq!(agents(&set), expected, "limit {limit}, turn {turn}");
                assert_eq!(left(&set).len(), at.len() - limit);
                assert!(left(&set).iter().all(|(_, fate)| *fate == Fate::OverLimit));
            }
        }
    }

    #[test]
    fn senders_that_project_are_where_their_messages_say() {
        let projected = |(agent, x): (&str, Option<f64>)| {
            let mut message = boxes(agent, 0.0);
            message.header.frame = ego(7).header.frame;
            message.header.position = x.map(|x| pose(x, 0.0).translation.vector.into());
            message
        };
        let chosen = |at: [Option<f64>; 4]| -> Vec<String> {
            let entries = ["cav2", "cav3", "cav4", "rsu1"].into_iter().zip(at).map(projected);
            let set = paired(entries.collect(), Some(2));
            agents(&set).iter().map(|agent| agent.to_string()).collect()
        };
        assert_eq!(chosen([None; 4]), ["cav2", "cav3"], "nobody says how far it is");
        assert_eq!(
            chosen([None, None, None, Some(60.0)]),
            ["cav2", "rsu1"],
            "who is known goes first"
        );
        assert_eq!(chosen([50.0, 70.0, -7.0, 60.0].map(Some)), ["cav2", "cav4"]);
        assert_eq!(chosen([50.0, 70.0, -7.0, 6.0].map(Some)), ["cav4", "rsu1"]);
    }

    #[test]
    fn places_a_collaborator_by_the_poses_of_the_two_stamps() {
        let set = paired(vec![boxes("cav2", 12.0)], None);
        let point = Point3::new(2.0, -3.0, 1.0);
        let there = pose(12.0, 0.5) * point;
        let here = pose(0.0, 0.1) * (set.collaborators[0].ego_from_sender * point);
        assert!((there - here).norm() < 1e-9);
    }

    #[test]
    fn leaves_out_what_has_no_place_or_is_something_else() {
        let mut lost = boxes("cav2", 1.0);
        lost.header.pose = None;
        let state = AgentState {
            map_from_body: pose(0.0, 0.0),
            covariance: None,
            velocity: None,
            angular_rate: None,
            status: PoseStatus::Truth,
        };
        let other = Message::new(boxes("cav3", 1.0).header, state);
        let set = paired(vec![lost, other, boxes("rsu1", 1.0)], Some(1));
        assert_eq!(agents(&set), ["rsu1"], "who is left out takes no place");
        let left: Vec<_> = set
            .left_out
            .iter()
            .map(|(header, fate)| (&*header.agent, *fate))
            .collect();
        assert_eq!(left, [("cav2", Fate::Rejected), ("cav3", Fate::Rejected)]);

        let mut nowhere = ego(7);
        nowhere.header.pose = None;
        let mut pairing = Pairing::default();
        take(&mut pairing, Input::<Boxes>::EGO, nowhere, None).unwrap();
        let chosen = selection(7, &ego(7), vec![boxes("rsu1", 1.0)]);
        let set = take(&mut pairing, Input::<Boxes>::SELECTIONS, chosen, None)
            .unwrap()
            .unwrap();
        assert!(set.collaborators.is_empty() && set.left_out[0].1 == Fate::Rejected);
    }

    #[test]
    fn other_frames_are_left_out_when_points_stay_where_they_are() {
        let mut projected = boxes("cav2", 1.0);
        projected.header.frame = ego(7).header.frame;
        let mut set = paired(vec![projected, boxes("rsu1", 1.0)], None);
        set.reject_other_frames();
        assert_eq!(agents(&set), ["cav2"]);
        assert_eq!((&*set.left_out[0].0.agent, set.left_out[0].1), ("rsu1", Fate::Rejected));
    }

    #[test]
    fn agents_that_no_street_leads_to_are_named() {
        let counted = |height: f64, way: f64| {
            let mut message = boxes("cav2", way);
            let pose = message.header.pose.as_mut().unwrap();
            pose.map_from_frame.translation.z += height;
            let mut out = Outputs::at(200);
            paired(vec![message], None).send(Output::Fused, Boxes::default(), &mut out);
            out.counted("other_level")
        };
        assert_eq!(
            [0.0, 9.9, -9.9, 10.1, -47.0].map(|height| counted(height, 0.0)),
            [0, 0, 0, 1, 1]
        );
        assert_eq!([19.9, -20.1].map(|height| counted(height, 40.0)), [0, 1]);
        assert_eq!(counted(f64::NAN, 40.0), 0);
    }

    #[test]
    fn sends_with_the_egos_header_and_says_what_became_of_everybody() {
        let mut lost = boxes("cav3", 1.0);
        lost.header.pose = None;
        let set = paired(vec![boxes("cav2", 1.0), lost, boxes("rsu1", 1.0)], Some(1));
        let mut out = Outputs::at(200);
        set.send(Output::Fused, Boxes::default(), &mut out);
        let fates: Vec<_> = out
            .take_fates()
            .into_iter()
            .map(|fated| (fated.message.from, fated.fate, fated.r#use.map(|u| (u.query, u.age_ns))))
            .collect();
        let expected = [
            ("cav2".to_string(), Fate::Used, Some((7, 140))),
            ("cav3".to_string(), Fate::Rejected, None),
            ("rsu1".to_string(), Fate::OverLimit, None),
        ];
        assert_eq!(fates, expected);
        let counted = ["over_limit_messages", "rejected_messages"].map(|counter| out.counted(counter));
        assert_eq!(counted, [1, 1]);
        let sent = out.take_sent();
        assert_eq!((sent.len(), sent[0].0, sent[0].1.header.seq), (1, Output::FUSED, 7));
        assert_eq!(&*sent[0].1.header.agent, "cav1");
    }
}
