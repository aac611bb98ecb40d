//! What every fusion operator owes its graph, as checks that its tests call.
//!
//! A fusion takes `ego` and `selections`, joined by (agent, seq), and sends for each set one message on its first output
//! that is no Report, with the header of the ego's message. [`FusionCase::check`] builds it anew for each check and drives
//! it through the [`Engine`], as every driver does.

use realo_operator::{Built, Operator, Outputs, PortId, Registration};
use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Header, Message, Nanos, Payload, PayloadType, Selection};

use crate::{Engine, Leaving, Servers, Step, Wiring};

/// Between two sets that a check feeds, ns.
const PERIOD: Nanos = 100_000_000;
/// Wakes after the last input before a stream counts as one that does not end.
const MOST_WAKES: usize = 10_000;

/// A fusion operator's arguments and one set of messages that it can fuse.
#[derive(Clone, Debug)]
pub struct FusionCase {
    /// `key=value`, as in a graph.
    pub args: Vec<String>,
    /// The ego's message.
    pub ego: Message,
    /// What at least two collaborators contribute.
    pub entries: Vec<Message>,
    /// What the fusion makes of the ego's message alone; often its own payload.
    pub alone: Payload,
}

impl FusionCase {
    /// All checks.
    ///
    /// # Panics
    /// Where the operator does not hold one; the message says which, what was expected and what came.
    pub fn check<O: Operator + Send + 'static>(&self) {
        assert!(
            self.entries.len() >= 2,
            "a case needs entries of at least two collaborators"
        );
        self.agent_order_does_not_matter::<O>();
        self.no_collaborator_equals_the_ego_alone::<O>();
        self.stale_and_repeated_messages_are_ignored::<O>();
        self.the_stream_ends::<O>();
    }

    /// Whatever the order of a Selection's entries, the same bits come out.
    ///
    /// # Panics
    /// As [`FusionCase::check`].
    pub fn agent_order_does_not_matter<O: Operator + Send + 'static>(&self) {
        let fused = |entries: Vec<Message>| Rig::new::<O>(&self.args).set(self.set(0, entries));
        let expected = fused(self.entries.clone());
        let mut entries = self.entries.clone();
        for _ in 0..entries.len() {
            entries.rotate_left(1);
            assert_eq!(
                fused(entries.clone()),
                expected,
                "entries in the order {}",
                agents(&entries)
            );
            let reversed: Vec<Message> = entries.iter().rev().cloned().collect();
            assert_eq!(
                fused(reversed.clone()),
                expected,
                "entries in the order {}",
                agents(&reversed)
            );
        }
    }

    /// A Selection without entries gives [`FusionCase::alone`], and so does one whose entries have no pose.
    ///
    /// # Panics
    /// As [`FusionCase::check`].
    pub fn no_collaborator_equals_the_ego_alone<O: Operator + Send + 'static>(&self) {
        let mut lost = self.entries.clone();
        lost.iter_mut().for_each(|entry| entry.header.pose = None);
        for (what, entries) in [("no entry", vec![]), ("entries without a pose", lost)] {
            let mut rig = Rig::new::<O>(&self.args);
            let sent = rig.set(self.set(0, entries));
            let used = rig.fates.iter().filter(|fated| fated.fate == Fate::Used).count();
            assert_eq!(used, 0, "{what}: nothing was used");
            let fused = rig.fused(&sent);
            assert_eq!(fused.len(), 1, "{what}: one message for one query");
            assert!(
                fused[0].payload == self.alone,
                "{what}: expected what the ego alone gives, found {:?}",
                fused[0]
            );
        }
    }

    /// A set that comes again, or after a newer one, changes nothing; a Selection for another query is not fused.
    ///
    /// # Panics
    /// As [`FusionCase::check`].
    pub fn stale_and_repeated_messages_are_ignored<O: Operator + Send + 'static>(&self) {
        let set = |seq| self.set(seq, self.entries.clone());
        let mut plain = Rig::new::<O>(&self.args);
        let expected = [plain.set(set(5)), plain.set(set(6))];
        let mut rig = Rig::new::<O>(&self.args);
        assert_eq!(rig.set(set(5)), expected[0]);
        assert_eq!(rig.set(set(5)), [], "the same set again");
        assert_eq!(rig.set(set(4)), [], "a set older than the last");
        assert_eq!(
            rig.set(set(6)),
            expected[1],
            "the next set, after stale and repeated ones"
        );

        let mut rig = Rig::new::<O>(&self.args);
        let ([(ego, own), _], [_, (selections, other)]) = (set(6), set(5));
        let mut out = Outputs::at(own.header.ready);
        let (ego, selections) = (rig.port(ego), rig.port(selections));
        let Built::Operator(operator) = &mut rig.built else {
            unreachable!("a rig holds an operator");
        };
        // Whether the operator calls it an error is its own affair.
        let _ = operator.on_input(ego, own, &mut out);
        let _ = operator.on_input(selections, other, &mut out);
        let sent = out.take_sent();
        assert!(
            rig.fused(&sent).is_empty(),
            "a selection for query 5 was fused with the ego's message 6"
        );
    }

    /// Each set is answered once, with the ego's header, and a fate is reported of every message that was selected for it;
    /// after the last input wakes come to an end, and the end is taken without an error.
    ///
    /// # Panics
    /// As [`FusionCase::check`].
    pub fn the_stream_ends<O: Operator + Send + 'static>(&self) {
        let mut rig = Rig::new::<O>(&self.args);
        let mut sent = Vec::new();
        for seq in 0..3 {
            sent.extend(rig.set(self.set(seq, self.entries.clone())));
        }
        sent.extend(rig.end());
        assert_eq!(rig.complaints, [""; 0], "calls that failed");
        let fused = rig.fused(&sent);
        let seqs: Vec<u64> = fused.iter().map(|message| message.header.seq).collect();
        assert_eq!(seqs, [0, 1, 2], "each query is answered once, in order");
        for (message, seq) in fused.iter().zip(0..) {
            let [(_, ego), _] = self.set(seq, vec![]);
            assert_eq!(
                identity(&message.header),
                identity(&ego.header),
                "the header is the ego's"
            );
        }
        for seq in 0..3 {
            for entry in &self.entries {
                let agent = &*entry.header.agent;
                let reported = rig
                    .fates
                    .iter()
                    .any(|fated| fated.message.seq == seq && fated.message.from == agent);
                assert!(
                    reported,
                    "what became of message {seq} of {agent}: `out.used` or `out.report` says it"
                );
            }
        }
    }

    /// The set of number `seq`: the ego's message and a Selection that answers it.
    fn set(&self, seq: u64, mut entries: Vec<Message>) -> Set {
        let mut ego = self.ego.clone();
        later(&mut ego.header, seq);
        for entry in &mut entries {
            later(&mut entry.header, seq);
            entry.header.to = Some(ego.header.agent.clone());
        }
        let selection = Message::new(ego.header.clone(), Selection { query: seq, entries });
        [("ego", ego), ("selections", selection)]
    }
}

type Set = [(&'static str, Message); 2];

fn later(header: &mut Header, seq: u64) {
    header.seq = seq;
    header.stamp += seq as Nanos * PERIOD;
    header.ready += seq as Nanos * PERIOD;
}

fn agents(entries: &[Message]) -> String {
    entries
        .iter()
        .map(|entry| &*entry.header.agent)
        .collect::<Vec<_>>()
        .join(", ")
}

fn identity(header: &Header) -> (&str, u64, Nanos, &str) {
    (&header.agent, header.seq, header.stamp, &header.frame)
}

/// An operator behind the engine that drivers put before it.
struct Rig {
    engine: Engine,
    built: Built,
    registration: &'static Registration,
    now: Nanos,
    fates: Vec<Fated>,
    complaints: Vec<String>,
}

impl Rig {
    fn new<O: Operator + Send + 'static>(args: &[String]) -> Self {
        let registration = const { &Registration::operator::<O>() };
        let built = match (registration.build)(args) {
            Ok(built @ Built::Operator(_)) => built,
            Ok(_) => panic!("{} is no operator", registration.name),
            Err(error) => panic!("{} with {args:?}: {error}", registration.name),
        };
        let mut wiring = Wiring::default();
        let wired = wiring.add(registration.name, registration, &[]).and_then(|()| {
            let mut ports = registration.inputs.iter();
            ports.try_for_each(|port| wiring.feed_from_outside(port.name).map(|_| ()))
        });
        wired.unwrap_or_else(|reason| panic!("{reason}"));
        wiring.stages[0].leaves.fill(true);
        Rig {
            engine: Engine::new(&wiring, Servers::One),
            built,
            registration,
            now: Nanos::MIN,
            fates: Vec::new(),
            complaints: Vec::new(),
        }
    }

    fn port(&self, name: &str) -> PortId {
        let port = self.registration.input(name);
        let Some((port, _)) = port else {
            panic!(
                "{} has no input `{name}`, by which graphs feed a fusion",
                self.registration.name
            );
        };
        port
    }

    /// Feeds a set and gives what came of it.
    fn set(&mut self, set: Set) -> Vec<(PortId, Message)> {
        for (port, message) in set {
            self.now = self.now.max(message.header.ready);
            self.engine.deliver(0, self.port(port), message);
        }
        self.run(self.now)
    }

    fn end(&mut self) -> Vec<(PortId, Message)> {
        for port in 0..self.registration.inputs.len() {
            self.engine.end_input(0, PortId(port), self.now);
        }
        let mut sent = Vec::new();
        for _ in 0..MOST_WAKES {
            let Some(due) = self.engine.next_due() else {
                assert!(self.engine.is_done(), "the stream has not ended");
                return sent;
            };
            self.now = self.now.max(due);
            sent.extend(self.run(self.now));
        }
        panic!("after the last input {MOST_WAKES} wakes followed: the stream does not end");
    }

    /// Makes the calls that are due.
    fn run(&mut self, now: Nanos) -> Vec<(PortId, Message)> {
        loop {
            let step = self.engine.step(now).unwrap_or_else(|error| panic!("{error}"));
            let Some(Step::Call(task)) = step else { break };
            let called = task
                .call
                .make(&mut self.built, self.registration, Outputs::at(now), &task.fates);
            let done = self.engine.complete(&task.ticket, called, now, 0);
            done.unwrap_or_else(|error| panic!("{error}"));
            self.engine.free(&task.ticket, now, now);
        }
        self.fates.extend(self.engine.take_fates());
        self.complaints.extend(self.engine.take_complaints());
        let leaving = self.engine.take_leaving().into_iter();
        leaving.map(|Leaving { port, message, .. }| (port, message)).collect()
    }

    /// What was sent on the first output that is no Report.
    fn fused<'a>(&self, sent: &'a [(PortId, Message)]) -> Vec<&'a Message> {
        let outputs = self.registration.outputs;
        let main = outputs
            .iter()
            .position(|port| !port.types.contains(&PayloadType::Report));
        let main = main.unwrap_or_else(|| panic!("{} has no output but reports", self.registration.name));
        sent.iter()
            .filter(|(port, _)| port.0 == main)
            .map(|(_, message)| message)
            .collect()
    }
}

#[cfg(test)]
mod tests;
