//! What waits in front of a stage: queues, slots and joins.

use std::collections::BTreeMap;

use realo_operator::{Class, InputBooks, Port, PortId, Queue};
use realo_schemas::{Header, Kind, Message, Name, Nanos};

/// Messages that a stage takes in one go: one, or a complete set of a join group in declared order.
#[derive(Debug)]
pub(crate) struct Work {
    /// When the last of them was ready.
    pub ready: Nanos,
    /// The calls of `on_input`.
    pub calls: Vec<(PortId, Message)>,
}

/// Order of waiting work: as the events of virtual time.
type Place = (Nanos, Class, PortId, Name, Kind, u64, u64);

/// An [`Queue::All`] port that ran over.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "input `{port}` holds {} waiting messages: the stage cannot keep up",
    Queue::CAPACITY
)]
pub struct Overflow {
    /// The port's name.
    pub port: &'static str,
}

/// Sets of one join group and agent that are not complete yet.
#[derive(Default)]
struct Partial {
    /// By seq; `None` where a part is missing.
    sets: BTreeMap<u64, Vec<Option<Message>>>,
    /// Stamp of the last complete set.
    last: Option<Nanos>,
}

/// The waiting room of one stage.
pub(crate) struct Intake {
    inputs: &'static [Port],
    /// By input: the group in which it is assembled with other wired inputs. A part without partners is a set by itself.
    joins: Vec<Option<&'static str>>,
    books: BTreeMap<&'static str, InputBooks>,
    partial: BTreeMap<(&'static str, Name), Partial>,
    /// By server; in order of start.
    waiting: BTreeMap<Name, BTreeMap<Place, Work>>,
    held: Vec<usize>,
    arrivals: u64,
    /// Messages that the stage will never be given.
    skipped: Vec<Message>,
}

impl Intake {
    /// `wired`: whether the graph feeds each input; unwired ports of a join group are not waited for.
    pub fn new(inputs: &'static [Port], wired: Vec<bool>) -> Self {
        let fed = || inputs.iter().zip(&wired).filter(|(_, w)| **w).map(|(port, _)| port);
        let is_joined = |group: &&'static str| fed().filter(|port| port.join == Some(*group)).count() > 1;
        let joins = inputs
            .iter()
            .zip(&wired)
            .map(|(port, wired)| port.join.filter(|_| *wired).filter(is_joined));
        Intake {
            inputs,
            joins: joins.collect(),
            books: fed().map(|port| (port.name, books_of(port))).collect(),
            held: vec![0; inputs.len()],
            partial: BTreeMap::new(),
            waiting: BTreeMap::new(),
            arrivals: 0,
            skipped: Vec::new(),
        }
    }

    /// What the inputs counted.
    pub fn books(&self) -> &BTreeMap<&'static str, InputBooks> {
        &self.books
    }

    /// The books of one input, to add to.
    pub fn books_of(&mut self, port: PortId) -> &mut InputBooks {
        self.books.entry(self.inputs[port.0].name).or_default()
    }

    /// Whether nothing waits for any server.
    pub fn is_idle(&self) -> bool {
        self.waiting.values().all(BTreeMap::is_empty)
    }

    /// Takes in a message for a server.
    ///
    /// # Errors
    /// [`Overflow`] if an `all` port holds too many.
    pub fn offer(&mut self, server: &Name, port: PortId, message: Message) -> Result<(), Overflow> {
        let accounts = self.inputs[port.0].accounts;
        let books = self.books_of(port);
        books.received.add(&message);
        if let Some(to) = message
            .header
            .to
            .as_ref()
            .filter(|to| accounts && !books.receivers.contains(&***to))
        {
            books.receivers.insert(to.to_string());
        }
        match self.joins[port.0] {
            None => {
                let ready = message.header.ready;
                self.enqueue(
                    server,
                    port,
                    Work {
                        ready,
                        calls: vec![(port, message)],
                    },
                )
            }
            Some(group) => match self.complete(group, port, message) {
                Some(work) => self.enqueue(server, work.calls[0].0, work),
                None => Ok(()),
            },
        }
    }

    /// The next work of a server.
    pub fn next(&mut self, server: &str) -> Option<Work> {
        let (_, work) = self.waiting.get_mut(server)?.pop_first()?;
        self.release(&work);
        Some(work)
    }

    /// What was replaced or never joined since the last call.
    pub fn take_skipped(&mut self) -> Vec<Message> {
        std::mem::take(&mut self.skipped)
    }

    /// Place in line of the next work of a server: its time and class.
    pub fn first(&self, server: &str) -> Option<(Nanos, Class)> {
        let (place, _) = self.waiting.get(server)?.first_key_value()?;
        Some((place.0, place.1))
    }

    /// Parts of sets that never became complete; called once, at the end.
    pub fn close(&mut self) {
        let left: Vec<(PortId, Message)> = std::mem::take(&mut self.partial)
            .into_iter()
            .flat_map(|((group, _), partial)| partial.sets.into_values().map(move |parts| (group, parts)))
            .flat_map(|(group, parts)| self.parts_of(group, parts))
            .collect();
        self.count_unjoined(left);
    }

    fn members(&self, group: &str) -> Vec<PortId> {
        let is_member = |port: &usize| self.joins[*port] == Some(group);
        (0..self.inputs.len()).filter(is_member).map(PortId).collect()
    }

    fn parts_of(&self, group: &str, parts: Vec<Option<Message>>) -> Vec<(PortId, Message)> {
        self.members(group)
            .into_iter()
            .zip(parts)
            .filter_map(|(port, part)| Some((port, part?)))
            .collect()
    }

    fn count_unjoined(&mut self, parts: Vec<(PortId, Message)>) {
        for (port, message) in parts {
            self.books_of(port).unjoined.add(&message);
            self.skipped.push(message);
        }
    }

    /// Adds a part to its set; the set, if that completes it.
    fn complete(&mut self, group: &'static str, port: PortId, message: Message) -> Option<Work> {
        let members = self.members(group);
        let position = members.iter().position(|member| *member == port)?;
        let (seq, stamp, agent) = (message.header.seq, message.header.stamp, message.header.agent.clone());
        let partial = self.partial.entry((group, agent)).or_default();
        if partial.last.is_some_and(|last| stamp <= last) {
            self.count_unjoined(vec![(port, message)]);
            return None;
        }
        let parts = partial.sets.entry(seq).or_insert_with(|| vec![None; members.len()]);
        let replaced = parts[position].replace(message);
        let set = if parts.iter().all(Option::is_some) {
            partial.sets.remove(&seq)
        } else {
            None
        };
        let mut gone: Vec<Vec<Option<Message>>> = Vec::new();
        if set.is_some() {
            partial.last = Some(stamp);
            let older = |parts: &Vec<Option<Message>>| parts.iter().flatten().all(|part| part.header.stamp <= stamp);
            gone.extend(
                partial
                    .sets
                    .extract_if(.., |_, parts| older(parts))
                    .map(|(_, parts)| parts),
            );
        } else if partial.sets.len() > Queue::CAPACITY {
            gone.extend(partial.sets.pop_first().map(|(_, parts)| parts));
        }
        self.count_unjoined(replaced.map(|message| (port, message)).into_iter().collect());
        for parts in gone {
            let parts = self.parts_of(group, parts);
            self.count_unjoined(parts);
        }
        let calls: Vec<_> = members.into_iter().zip(set?.into_iter().flatten()).collect();
        let ready = calls.iter().map(|(_, message)| message.header.ready).max()?;
        Some(Work { ready, calls })
    }

    fn enqueue(&mut self, server: &Name, port: PortId, work: Work) -> Result<(), Overflow> {
        let declared = &self.inputs[port.0];
        let agent = work.calls[0].1.header.agent.clone();
        let work = match declared.queue {
            Queue::All => Some(work),
            Queue::Latest => self.replace_waiting(server, port, work),
        };
        let Some(work) = work else {
            return Ok(());
        };
        self.held[port.0] += 1;
        if self.held[port.0] > Queue::CAPACITY {
            return Err(Overflow { port: declared.name });
        }
        self.arrivals += 1;
        let class = work
            .calls
            .iter()
            .map(|(port, _)| self.inputs[port.0].class)
            .max()
            .unwrap_or(declared.class);
        let place = (
            work.ready,
            class,
            port,
            agent,
            work.calls[0].1.header.kind,
            work.calls[0].1.header.seq,
            self.arrivals,
        );
        match self.waiting.get_mut(server) {
            Some(line) => line.insert(place, work),
            None => self.waiting.entry(server.clone()).or_default().insert(place, work),
        };
        Ok(())
    }

    /// Empties the slot of a `latest` port, agent, receiver and kind for newer work; what is older than the waiting one is
    /// skipped itself.
    fn replace_waiting(&mut self, server: &str, port: PortId, work: Work) -> Option<Work> {
        let Header {
            agent, to, kind, stamp, ..
        } = &work.calls[0].1.header;
        let of_slot = |header: &Header| header.agent == *agent && header.to == *to && header.kind == *kind;
        let line = self.waiting.get_mut(server);
        let slot = line.and_then(|line| {
            line.extract_if(.., |place, waiting| {
                place.2 == port && of_slot(&waiting.calls[0].1.header)
            })
            .next()
        });
        let Some((place, waiting)) = slot else {
            return Some(work);
        };
        if waiting.calls[0].1.header.stamp > *stamp {
            self.skip(work);
            self.waiting.entry(server.into()).or_default().insert(place, waiting);
            return None;
        }
        self.release(&waiting);
        self.skip(waiting);
        Some(work)
    }

    fn skip(&mut self, work: Work) {
        for (port, message) in work.calls {
            self.books_of(port).skipped.add(&message);
            self.skipped.push(message);
        }
    }

    fn release(&mut self, work: &Work) {
        self.held[work.calls[0].0.0] -= 1;
    }
}

/// Empty books of an input.
fn books_of(port: &Port) -> InputBooks {
    let kinds = |port: &Port| port.types.iter().filter_map(|carried| Kind::of(*carried)).collect();
    InputBooks {
        accounts: if port.accounts { kinds(port) } else { Vec::new() },
        ..InputBooks::default()
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::{Boxes, Header, Kind};

    use super::*;

    const PORTS: &[Port] = &[
        Port::new("a", &[], "").latest().joined("pair"),
        Port::new("b", &[], "").latest().joined("pair"),
        Port::new("all", &[], ""),
        Port::new("latest", &[], "").latest(),
    ];

    fn message(agent: &str, seq: u64) -> Message {
        let stamp = seq as i64 * 100;
        Message::new(
            Header::origin(&"r".into(), &agent.into(), Kind::Boxes, seq, stamp, stamp + 5),
            Boxes::default(),
        )
    }

    fn intake() -> Intake {
        Intake::new(PORTS, vec![true; 4])
    }

    fn of(message: &Message) -> (Name, u64) {
        (message.header.agent.clone(), message.header.seq)
    }

    fn seqs(work: Work) -> Vec<(usize, u64)> {
        work.calls
            .into_iter()
            .map(|(port, message)| (port.0, message.header.seq))
            .collect()
    }

    #[test]
    fn joins_by_agent_and_seq_and_discards_older_parts() {
        let (mut intake, x) = (intake(), Name::from("x"));
        intake.offer(&x, PortId(0), message("x", 1)).unwrap();
        intake.offer(&x, PortId(1), message("x", 2)).unwrap();
        intake.offer(&x, PortId(1), message("y", 1)).unwrap();
        assert!(intake.next("x").is_none(), "no set is complete");
        intake.offer(&x, PortId(0), message("x", 2)).unwrap();
        assert_eq!(seqs(intake.next("x").unwrap()), [(0, 2), (1, 2)]);
        intake.offer(&x, PortId(1), message("x", 1)).unwrap();
        assert!(
            intake.next("x").is_none(),
            "a set older than the last is not taken up again"
        );
        assert_eq!(intake.books()["a"].unjoined.total(), 1);
        assert_eq!(intake.books()["b"].unjoined.total(), 1);
        intake.close();
        assert_eq!(
            intake.books()["b"].unjoined.total(),
            2,
            "the part of y never met its partner"
        );
        let gone: Vec<(Name, u64)> = intake.take_skipped().iter().map(of).collect();
        assert_eq!(gone, [("x".into(), 1), ("x".into(), 1), ("y".into(), 1)]);
    }

    #[test]
    fn a_part_whose_partners_are_not_wired_waits_for_none_and_may_come_late() {
        let (mut intake, x) = (Intake::new(PORTS, vec![true, false, true, true]), Name::from("x"));
        for seq in [2, 1] {
            intake.offer(&x, PortId(0), message("x", seq)).unwrap();
            assert_eq!(seqs(intake.next("x").unwrap()), [(0, seq)]);
        }
        assert_eq!(intake.books()["a"].unjoined.total(), 0);
    }

    #[test]
    fn latest_keeps_the_newest_per_agent_and_counts_the_rest() {
        let (mut intake, x) = (intake(), Name::from(""));
        for seq in 0..3 {
            intake.offer(&x, PortId(3), message("x", seq)).unwrap();
        }
        intake.offer(&x, PortId(3), message("y", 0)).unwrap();
        assert_eq!(seqs(intake.next("").unwrap()), [(3, 0)], "y's message is ready first");
        assert_eq!(seqs(intake.next("").unwrap()), [(3, 2)]);
        assert!(intake.next("").is_none() && intake.is_idle());
        assert_eq!(intake.books()["latest"].skipped.total(), 2);
        let gone: Vec<(Name, u64)> = intake.take_skipped().iter().map(of).collect();
        assert_eq!(gone, [("x".into(), 0), ("x".into(), 1)]);
    }

    #[test]
    fn latest_keeps_one_for_each_kind() {
        let (mut intake, one) = (intake(), Name::from(""));
        for kind in [Kind::Points, Kind::Boxes, Kind::Points] {
            let mut message = message("x", 0);
            message.header.kind = kind;
            intake.offer(&one, PortId(3), message).unwrap();
        }
        assert_eq!(intake.books()["latest"].skipped.total(), 1, "the first one of points");
        let left: Vec<Work> = std::iter::from_fn(|| intake.next("")).collect();
        assert_eq!(left.len(), 2);
    }

    #[test]
    fn latest_keeps_one_for_each_receiver() {
        let (mut intake, one) = (intake(), Name::from(""));
        let to = |receiver: &str| {
            let mut message = message("x", 0);
            message.header.to = Some(receiver.into());
            message
        };
        for receiver in ["a", "b", "c", "b"] {
            intake.offer(&one, PortId(3), to(receiver)).unwrap();
        }
        assert_eq!(intake.books()["latest"].skipped.total(), 1, "that to b");
        let left: Vec<Work> = std::iter::from_fn(|| intake.next("")).collect();
        assert_eq!(left.len(), 3);
    }

    #[test]
    fn latest_passes_over_what_comes_older_than_what_waits() {
        let (mut intake, x) = (intake(), Name::from("x"));
        for seq in [1, 3, 2] {
            intake.offer(&x, PortId(3), message("x", seq)).unwrap();
        }
        assert_eq!(seqs(intake.next("x").unwrap()), [(3, 3)]);
        assert!(intake.next("x").is_none() && intake.is_idle());
        assert_eq!(intake.books()["latest"].skipped.total(), 2);
    }

    #[test]
    fn of_one_stamp_the_latest_to_come_takes_the_slot() {
        let (mut intake, x) = (intake(), Name::from("x"));
        for seq in [5, 4, 6] {
            let mut same = message("x", seq);
            same.header.stamp = 100;
            intake.offer(&x, PortId(3), same).unwrap();
        }
        assert_eq!(seqs(intake.next("x").unwrap()), [(3, 6)]);
        let gone: Vec<(Name, u64)> = intake.take_skipped().iter().map(of).collect();
        assert_eq!(gone, [("x".into(), 5), ("x".into(), 4)]);
    }

    #[test]
    fn all_keeps_order_and_refuses_to_overflow() {
        let (mut intake, x) = (intake(), Name::from("x"));
        for seq in 0..Queue::CAPACITY as u64 {
            intake.offer(&x, PortId(2), message("x", seq)).unwrap();
        }
        assert_eq!(
            intake.offer(&x, PortId(2), message("x", 9999)),
            Err(Overflow { port: "all" })
        );
        assert_eq!(seqs(intake.next("x").unwrap()), [(2, 0)]);
        assert_eq!(seqs(intake.next("x").unwrap()), [(2, 1)]);
    }

    #[test]
    fn a_part_that_comes_again_replaces_the_first_and_counts() {
        let (mut intake, x) = (intake(), Name::from("x"));
        intake.offer(&x, PortId(0), message("x", 1)).unwrap();
        intake.offer(&x, PortId(0), message("x", 1)).unwrap();
        assert_eq!(intake.books()["a"].unjoined.total(), 1);
        intake.offer(&x, PortId(1), message("x", 1)).unwrap();
        assert_eq!(intake.books()["a"].received.total(), 2);
        assert!(!intake.is_idle());
        assert_eq!(seqs(intake.next("x").unwrap()), [(0, 1), (1, 1)]);
        assert_eq!(intake.take_skipped().len(), 1);
        assert!(intake.take_skipped().is_empty());
    }

    #[test]
    fn a_complete_set_takes_the_slot_and_newer_parts_stay() {
        let (mut intake, x) = (intake(), Name::from("x"));
        intake.offer(&x, PortId(0), message("x", 3)).unwrap();
        for seq in [1, 2] {
            intake.offer(&x, PortId(0), message("x", seq)).unwrap();
            intake.offer(&x, PortId(1), message("x", seq)).unwrap();
        }
        // The older set was complete and waited: it is skipped, both parts of it.
        assert_eq!(
            (intake.books()["a"].skipped.total(), intake.books()["b"].skipped.total()),
            (1, 1)
        );
        assert_eq!(intake.books()["a"].unjoined.total(), 0);
        assert_eq!(intake.first("x"), Some((205, Class::Data)));
        assert_eq!(seqs(intake.next("x").unwrap()), [(0, 2), (1, 2)]);
        intake.offer(&x, PortId(1), message("x", 3)).unwrap();
        assert_eq!(seqs(intake.next("x").unwrap()), [(0, 3), (1, 3)]);
        intake.close();
        assert!(intake.take_skipped().len() == 2 && intake.first("x").is_none());
    }

    #[test]
    fn sets_of_one_stamp_are_not_taken_twice_and_of_parts_only_so_many_are_held() {
        let (mut intake, x) = (intake(), Name::from("x"));
        let mut same = message("x", 2);
        same.header.stamp = 100;
        intake.offer(&x, PortId(0), same).unwrap();
        intake.offer(&x, PortId(0), message("x", 1)).unwrap();
        intake.offer(&x, PortId(1), message("x", 1)).unwrap();
        assert_eq!(intake.books()["a"].unjoined.total(), 1, "a part as old as the set");
        let more = Queue::CAPACITY as u64;
        for seq in 10..10 + more {
            intake.offer(&x, PortId(0), message("x", seq)).unwrap();
        }
        assert_eq!(intake.books()["a"].unjoined.total(), 1);
        intake.offer(&x, PortId(0), message("x", 10 + more)).unwrap();
        assert_eq!(intake.books()["a"].unjoined.total(), 2, "the oldest went");
        assert_eq!(of(&intake.take_skipped()[1]), ("x".into(), 10));
    }

    #[test]
    fn a_queue_has_room_again_for_what_was_taken_or_replaced() {
        let (mut intake, x) = (intake(), Name::from("x"));
        for seq in 0..3 * Queue::CAPACITY as u64 {
            intake.offer(&x, PortId(3), message("x", seq)).unwrap();
            intake.offer(&x, PortId(2), message("x", seq)).unwrap();
            assert_eq!(intake.next("x").unwrap().calls[0].0, PortId(2), "port by port");
        }
        assert_eq!(seqs(intake.next("x").unwrap()).len(), 1);
        assert!(intake.next("x").is_none() && intake.is_idle());
    }

    #[test]
    fn an_accounting_input_says_of_which_kinds_and_for_whom() {
        const ENDS: &[Port] = &[
            Port::new("ends", &[realo_schemas::PayloadType::Boxes], "").accounting(),
            Port::new("passes", &[realo_schemas::PayloadType::Boxes], ""),
            Port::new("open", &[realo_schemas::PayloadType::Boxes], ""),
        ];
        let (mut intake, x) = (Intake::new(ENDS, vec![true, true, false]), Name::from("x"));
        let mut crossed = message("x", 0);
        crossed.header.to = Some("ego".into());
        for port in [0, 0, 1] {
            intake.offer(&x, PortId(port), crossed.clone()).unwrap();
        }
        intake.offer(&x, PortId(0), message("x", 1)).unwrap();
        let books = intake.books();
        assert_eq!(books.keys().copied().collect::<Vec<_>>(), ["ends", "passes"]);
        assert_eq!(books["ends"].accounts, [Kind::Boxes]);
        assert_eq!(books["ends"].receivers.iter().collect::<Vec<_>>(), ["ego"]);
        assert!(books["passes"].accounts.is_empty() && books["passes"].receivers.is_empty());
    }
}
