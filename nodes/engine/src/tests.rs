//! The engine by stages whose calls a test answers itself.

use std::collections::{BTreeMap, BTreeSet};

use proptest::prelude::*;
use realo_operator::{Books, Counts, Error, Made, Port, PortId, Registration, Role};
use realo_schemas::report::{Channel, Fate, Fated, Traffic};
use realo_schemas::{Boxes, Clock, Header, Kind, Message, Nanos, PayloadType, Report, Selection};

use crate::{Call, Called, Engine, EngineError, Feed, Gone, Leaving, Servers, Step, Ticket, Wiring};

const ANY: &[PayloadType] = &[PayloadType::Boxes, PayloadType::Selection];

const fn port(name: &'static str) -> Port {
    Port::new(name, ANY, "")
}

const fn stage(name: &'static str, role: Role, inputs: &'static [Port], outputs: &'static [Port]) -> Registration {
    Registration {
        name,
        about: "",
        role,
        inputs,
        outputs,
        settings: &[],
        counters: &[],
        defaults: Default::default,
        check: |_| Ok(()),
        examine: |_| Ok(()),
        maps: |_| Vec::new(),
        build: |_| Err("a test answers its calls".into()),
    }
}

static SOURCE: Registration = stage("source", Role::Source, &[], &[port("out"), port("aside")]);
static SINK: Registration = stage("sink", Role::Sink, &[port("in")], &[]);
static RELAY: Registration = stage("relay", Role::Operator, &[port("in")], &[port("out"), port("aside")]);
static SLOT: Registration = stage("slot", Role::Operator, &[port("in").latest()], &[port("out")]);
static JOIN: Registration = stage(
    "join",
    Role::Operator,
    &[
        port("a").joined("pair"),
        port("b").state().joined("pair"),
        port("c").joined("pair").optional(),
    ],
    &[port("out")],
);
static CLASSES: Registration = stage(
    "classes",
    Role::Operator,
    &[
        port("query").query(),
        port("second"),
        port("first"),
        port("state").state(),
    ],
    &[port("out")],
);

static GATEWAY: Registration = stage(
    "gateway",
    Role::Gateway,
    &[port("in"), port("state")],
    &[port("out"), port("states").ends_early()],
);

static HEARS: Registration = stage(
    "hears",
    Role::Operator,
    &[port("in"), port("back").feedback()],
    &[port("out")],
);

fn message(agent: &str, seq: u64, ready: Nanos) -> Message {
    let header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, seq, ready, ready);
    Message::new(header, Boxes::default())
}

/// The same, having crossed a link.
fn crossed(agent: &str, seq: u64, ready: Nanos) -> Message {
    let mut message = message(agent, seq, ready);
    message.header.to = Some("ego".into());
    message
}

fn selection(seq: u64, ready: Nanos, entries: Vec<Message>) -> Message {
    Message::new(message("ego", seq, ready).header, Selection { query: seq, entries })
}

/// What comes of a call, and how long it takes.
#[derive(Default)]
struct Answer {
    sent: Vec<(usize, Message)>,
    wakes: Vec<Nanos>,
    errors: Vec<&'static str>,
    fates: Vec<Fated>,
    steps: Vec<(&'static str, Nanos)>,
    traffic: Vec<Channel>,
    counts: Vec<(&'static str, u64)>,
    gone: Option<Error>,
    took: Nanos,
}

fn takes(took: Nanos) -> Answer {
    Answer {
        took,
        ..Answer::default()
    }
}

fn counts(named: &[(&'static str, u64)]) -> Counts {
    let mut counts = Counts::default();
    named.iter().for_each(|(name, n)| counts.add_named(*name, *n));
    counts
}

type Script<'a> = Box<dyn FnMut(&str, &Call, Nanos) -> Answer + 'a>;

struct Rig<'a> {
    engine: Engine,
    script: Script<'a>,
    now: Nanos,
    /// Each call: time, stage, trigger, messages.
    log: Vec<String>,
    released: Vec<usize>,
    /// Fates that each call was given.
    reported: Vec<(String, Vec<Fated>)>,
    /// What sinks were given at the end.
    books: Vec<(String, Books)>,
}

impl<'a> Rig<'a> {
    fn new(wiring: &Wiring, servers: Servers, script: impl FnMut(&str, &Call, Nanos) -> Answer + 'a) -> Self {
        Rig {
            engine: Engine::new(wiring, servers),
            script: Box::new(script),
            now: Nanos::MIN,
            log: Vec::new(),
            released: Vec::new(),
            reported: Vec::new(),
            books: Vec::new(),
        }
    }

    /// One stage that is fed from outside and whose outputs leave.
    fn one(registration: &'static Registration, script: impl FnMut(&str, &Call, Nanos) -> Answer + 'a) -> Self {
        Rig::new(&alone(registration), Servers::PerStream, script)
    }

    fn give(&mut self, port: usize, message: Message) {
        self.engine.deliver(0, PortId(port), message);
    }

    fn end(&mut self) {
        for port in 0..self.engine.registration(0).inputs.len() {
            self.engine.end_input(0, PortId(port), Nanos::MIN);
        }
    }

    fn try_until(&mut self, until: Nanos) -> Result<(), EngineError> {
        while let Some(due) = self.engine.next_due().filter(|due| *due <= until) {
            self.now = self.now.max(due);
            match self.engine.step(self.now)? {
                None => {}
                Some(Step::Released(stage)) => self.released.push(stage),
                Some(Step::Call(task)) => {
                    let id = self.engine.id(task.ticket.stage).to_string();
                    let what = match &task.call {
                        Call::Inputs(calls) => {
                            let names = calls.iter().map(|(port, message)| {
                                let header = &message.header;
                                format!(" {}.{}{}", port.0, header.agent, header.seq)
                            });
                            names.collect()
                        }
                        Call::Wake => String::new(),
                        Call::End(books) => {
                            self.books.push((id.clone(), (**books).clone()));
                            String::new()
                        }
                    };
                    let start = match task.ticket.start {
                        Nanos::MIN => "-".to_string(),
                        start => start.to_string(),
                    };
                    self.log.push(format!("{start} {id} {}{what}", task.ticket.cause));
                    assert_eq!(task.ticket.start, self.now);
                    assert_eq!(task.ticket.is_end(), matches!(task.call, Call::End(_)));
                    let answer = (self.script)(&id, &task.call, task.ticket.start);
                    self.reported.push((id, task.fates));
                    self.answer(&task.ticket, answer)?;
                }
            }
        }
        Ok(())
    }

    fn answer(&mut self, ticket: &Ticket, answer: Answer) -> Result<(), EngineError> {
        let took = answer.took;
        let called = Called {
            made: Made {
                sent: answer
                    .sent
                    .into_iter()
                    .map(|(port, message)| (PortId(port), message))
                    .collect(),
                wakes: answer.wakes.into_iter().collect(),
                fates: answer.fates,
                traffic: answer.traffic,
                counts: counts(&answer.counts),
                explained: BTreeMap::new(),
                steps: answer.steps,
            },
            errors: answer.errors.into_iter().map(str::to_string).collect(),
            other_errors: 0,
            gone: answer.gone,
        };
        let done = ticket.start + took;
        self.engine.complete(ticket, called, done, took)?;
        self.engine.free(ticket, done, self.now);
        Ok(())
    }

    fn until(&mut self, until: Nanos) -> Vec<String> {
        self.try_until(until).unwrap_or_else(|error| panic!("{error}"));
        std::mem::take(&mut self.log)
    }

    fn rest(&mut self) -> Vec<String> {
        self.until(Nanos::MAX)
    }

    fn left(&mut self) -> Vec<(usize, usize, Message)> {
        let leaving = self.engine.take_leaving().into_iter();
        leaving
            .map(|Leaving { stage, port, message }| (stage, port.0, message))
            .collect()
    }

    fn skipped(&mut self) -> Vec<(String, u64)> {
        let fates = self.engine.take_fates().into_iter();
        fates
            .map(|fated| {
                assert_eq!((fated.fate, fated.r#use), (Fate::Skipped, None));
                (fated.message.from, fated.message.seq)
            })
            .collect()
    }
}

fn alone(registration: &'static Registration) -> Wiring {
    let mut wiring = Wiring::default();
    wiring.add("s", registration, &[]).unwrap();
    for port in registration.inputs {
        wiring.feed_from_outside(port.name).unwrap();
    }
    wiring.stages[0].leaves.fill(true);
    wiring
}

/// Sends each message on as it came, at the time of the call.
fn forward(call: &Call, start: Nanos) -> Answer {
    let mut answer = Answer::default();
    if let Call::Inputs(calls) = call {
        for (_, message) in calls {
            let mut message = message.clone();
            message.header.ready = message.header.ready.max(start);
            answer.sent.push((0, message));
        }
    }
    answer
}

// The order of events.

#[test]
fn an_instant_goes_by_class_then_port_then_agent_then_kind_then_number() {
    let mut rig = Rig::one(&CLASSES, |_, call, _| match call {
        Call::Inputs(calls) if calls[0].1.header.seq == 99 => Answer {
            wakes: vec![10, 10],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(3, message("b", 99, 0));
    assert_eq!(rig.until(9), ["0 s state 3.b99"]);
    let mut other = message("a", 1, 10);
    other.header.kind = Kind::AgentState;
    let mut points = message("a", 7, 10);
    points.header.kind = Kind::Points;
    for (port, message) in [
        (0, message("a", 1, 10)),
        (2, message("a", 4, 10)),
        (1, message("b", 1, 10)),
        (1, other),
        (1, message("a", 3, 10)),
        (1, message("a", 2, 10)),
        (1, points),
        (3, message("z", 5, 10)),
        (2, message("a", 1, 9)),
    ] {
        rig.give(port, message);
    }
    rig.end();
    let expected = [
        "9 s first 2.a1",
        "10 s state 3.z5",
        "10 s second 1.a7",
        "10 s second 1.a2",
        "10 s second 1.a3",
        "10 s second 1.a1",
        "10 s second 1.b1",
        "10 s first 2.a4",
        "10 s wake",
        "10 s query 0.a1",
        "10 s end",
    ];
    assert_eq!(rig.rest(), expected);
}

#[test]
fn feedback_closes_a_circle_that_ends_with_the_other_inputs() {
    let mut wiring = Wiring::default();
    let added = wiring.add("hears", &HEARS, &[]);
    let fed = added.and_then(|()| wiring.feed_from_outside("in"));
    let relayed = fed.and_then(|_| wiring.add("relay", &RELAY, &[("in", "hears", "out")]));
    let closed = relayed.and_then(|()| wiring.feed_back("hears", "back", "relay", "out"));
    assert_eq!(closed, Ok(()));
    assert_eq!(
        wiring.feed_back("hears", "back", "nobody", "out"),
        Err("no stage `nobody`".into())
    );
    let mut rig = Rig::new(&wiring, Servers::PerStream, |_, call, now| match call {
        Call::Inputs(calls) if calls[0].0 == PortId(0) => Answer {
            sent: vec![(0, message("a", calls[0].1.header.seq, now + 10))],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(0, message("a", 1, 0));
    rig.give(0, message("a", 2, 100));
    rig.engine.end_input(0, PortId(0), 0);
    let expected = [
        "0 hears in 0.a1",
        "10 relay in 0.a1",
        "20 hears back 1.a1",
        "100 hears in 0.a2",
        "100 hears end",
        "110 relay in 0.a2",
        "110 relay end",
    ];
    assert_eq!(rig.rest(), expected, "what comes back after its end is dropped");
    assert!(rig.engine.is_done());
}

#[test]
fn what_is_alike_goes_in_the_order_in_which_it_came() {
    let stamps = [3, 1, 4, 1, 5, 9, 2, 6];
    let mut found = Vec::new();
    let mut rig = Rig::one(&RELAY, |_, call, _| {
        if let Call::Inputs(calls) = call {
            found.push(calls[0].1.header.stamp);
        }
        Answer::default()
    });
    for stamp in stamps {
        let mut alike = message("a", 0, 10);
        alike.header.stamp = stamp;
        rig.give(0, alike);
    }
    rig.rest();
    drop(rig);
    assert_eq!(found, stamps);
}

#[test]
fn what_waits_for_a_busy_stage_goes_in_the_order_of_events() {
    let mut rig = Rig::new(&alone(&CLASSES), Servers::One, |_, call, _| match call {
        Call::Inputs(calls) if calls[0].1.header.seq == 99 => takes(50),
        _ => Answer::default(),
    });
    rig.give(3, message("b", 99, 0));
    let mut other = message("a", 1, 10);
    other.header.kind = Kind::AgentState;
    for (port, message) in [
        (0, message("a", 1, 10)),
        (2, message("a", 4, 10)),
        (1, message("b", 1, 10)),
        (1, other),
        (1, message("a", 3, 10)),
        (1, message("a", 2, 10)),
        (3, message("z", 5, 10)),
        (0, message("a", 1, 9)),
    ] {
        rig.give(port, message);
    }
    let expected = [
        "0 s state 3.b99",
        "50 s query 0.a1",
        "50 s state 3.z5",
        "50 s second 1.a2",
        "50 s second 1.a3",
        "50 s second 1.a1",
        "50 s second 1.b1",
        "50 s first 2.a4",
        "50 s query 0.a1",
    ];
    assert_eq!(rig.rest(), expected);
}

#[test]
fn earlier_stages_go_first_at_one_instant() {
    let mut wiring = Wiring::default();
    for id in ["x", "y"] {
        wiring.add(id, &RELAY, &[]).unwrap();
        wiring.feed_from_outside("in").unwrap();
    }
    let mut rig = Rig::new(&wiring, Servers::PerStream, |_, _, _| Answer::default());
    rig.engine.deliver(1, PortId(0), message("a", 0, 5));
    rig.engine.deliver(0, PortId(0), message("z", 9, 5));
    rig.engine.deliver(0, PortId(0), message("z", 8, 6));
    rig.engine.deliver(1, PortId(0), message("a", 1, 4));
    let expected = ["4 y in 0.a1", "5 x in 0.z9", "5 y in 0.a0", "6 x in 0.z8"];
    assert_eq!(rig.rest(), expected);
}

#[test]
fn a_server_becomes_free_before_what_comes_at_that_instant() {
    for servers in [Servers::One, Servers::PerStream] {
        let mut rig = Rig::new(&alone(&SLOT), servers, |_, _, _| takes(10));
        for (seq, ready) in [(0, 0), (1, 5), (2, 10), (3, 15), (4, 16)] {
            rig.give(0, message("a", seq, ready));
        }
        rig.end();
        let expected = ["0 s in 0.a0", "10 s in 0.a1", "20 s in 0.a4", "30 s end"];
        assert_eq!(rig.rest(), expected, "2 waits from 10 and is replaced by 3, that by 4");
        assert_eq!(rig.engine.books().nodes["s"].inputs["in"].skipped.total(), 2);
        assert!(rig.engine.is_done());
    }
}

#[test]
fn agents_have_servers_of_their_own_or_share_one() {
    let run = |servers| {
        let mut rig = Rig::new(&alone(&RELAY), servers, |_, _, _| takes(10));
        rig.give(0, message("a", 0, 0));
        rig.give(0, message("b", 0, 0));
        rig.give(0, message("a", 1, 1));
        rig.end();
        rig.rest()
    };
    let each = ["0 s in 0.a0", "0 s in 0.b0", "10 s in 0.a1", "20 s end"];
    assert_eq!(run(Servers::PerStream), each);
    let one = ["0 s in 0.a0", "10 s in 0.b0", "20 s in 0.a1", "30 s end"];
    assert_eq!(run(Servers::One), one);
}

#[test]
fn a_call_under_way_holds_its_server_and_the_end() {
    let mut engine = Engine::new(&alone(&RELAY), Servers::PerStream);
    for (agent, seq) in [("a", 0), ("a", 1), ("b", 0)] {
        engine.deliver(0, PortId(0), message(agent, seq, 0));
    }
    engine.end_input(0, PortId(0), 0);
    let call = |engine: &mut Engine| match engine.step(5) {
        Ok(Some(Step::Call(task))) => Some(task.ticket),
        _ => None,
    };
    let (a, b) = (call(&mut engine).unwrap(), call(&mut engine).unwrap());
    assert!(call(&mut engine).is_none(), "a is called, and so is b");
    let done = |engine: &mut Engine, ticket: &Ticket| {
        engine.complete(ticket, Called::default(), 5, 0).unwrap();
        engine.free(ticket, 5, 5);
    };
    done(&mut engine, &b);
    assert!(call(&mut engine).is_none(), "the end waits for a");
    done(&mut engine, &a);
    let second = call(&mut engine).unwrap();
    assert!(!second.is_end() && call(&mut engine).is_none());
    done(&mut engine, &second);
    assert!(call(&mut engine).is_some_and(|ticket| ticket.is_end()));
}

#[test]
fn a_wake_that_comes_late_stands_in_line_by_its_time() {
    // The wake is due at 10, the stage is busy until 20; what else waits is ready at …
    for (port, ready, wake_first) in [
        (1, 9, false),
        (1, 10, false),
        (0, 9, false),
        (0, 10, true),
        (3, 11, true),
        (1, 11, true),
    ] {
        let mut rig = Rig::one(&CLASSES, |_, call, _| match call {
            Call::Inputs(calls) if calls[0].1.header.seq == 0 => Answer {
                wakes: vec![10],
                took: 20,
                ..Answer::default()
            },
            _ => Answer::default(),
        });
        rig.give(1, message("a", 0, 0));
        rig.give(port, message("a", 1, ready));
        let log = rig.rest();
        assert_eq!(log.len(), 3);
        assert_eq!(log[1] == "20 s wake", wake_first, "port {port}, ready {ready}: {log:?}");
        assert_eq!(
            log[2] == "20 s wake",
            !wake_first,
            "port {port}, ready {ready}: {log:?}"
        );
    }
}

#[test]
fn wakes_belong_to_the_server_that_asked_and_come_once_each() {
    let mut asked = BTreeSet::new();
    let mut rig = Rig::one(&RELAY, move |_, call, start| match call {
        Call::Inputs(calls) if calls[0].1.header.agent == "a".into() => Answer {
            wakes: vec![30, 10, 10],
            took: if asked.insert(start) && start == 0 { 5 } else { 100 },
            ..Answer::default()
        },
        Call::Inputs(_) => Answer {
            wakes: vec![20],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(0, message("a", 0, 0));
    rig.give(0, message("a", 1, 8));
    rig.give(0, message("b", 0, 8));
    rig.end();
    // From 8 to 108 a's server is busy; its wakes of 10 and 30 come then, b's comes on time.
    let expected = [
        "0 s in 0.a0",
        "8 s in 0.a1",
        "8 s in 0.b0",
        "20 s wake",
        "108 s wake",
        "108 s wake",
        "108 s end",
    ];
    assert_eq!(rig.rest(), expected);
}

// Slots, sets, and what is skipped.

#[test]
fn a_busy_stage_says_of_messages_over_links_that_it_passed_them_over() {
    let mut rig = Rig::one(&SLOT, |_, _, _| takes(100));
    rig.give(0, crossed("a", 0, 0));
    rig.give(0, crossed("a", 1, 1));
    rig.give(0, crossed("a", 2, 2));
    for seq in 0..3 {
        rig.give(0, message("e", seq, seq as Nanos));
    }
    rig.give(0, selection(0, 3, vec![]));
    rig.give(
        0,
        selection(1, 4, vec![crossed("b", 7, 1), message("c", 7, 1), crossed("d", 8, 1)]),
    );
    rig.give(0, selection(2, 5, vec![crossed("b", 9, 1)]));
    rig.give(0, crossed("a", 3, 6));
    assert_eq!(rig.until(10), ["0 s in 0.a0", "0 s in 0.e0", "3 s in 0.ego0"]);
    let expected = [("a".to_string(), 1), ("b".into(), 7), ("d".into(), 8), ("a".into(), 2)];
    assert_eq!(
        rig.skipped(),
        expected,
        "what e says crossed no link; what waits may still be taken"
    );
    assert_eq!(rig.skipped(), [], "each is said once");
    rig.end();
    assert_eq!(
        rig.rest(),
        ["100 s in 0.a3", "100 s in 0.e2", "103 s in 0.ego2", "203 s end"]
    );
    assert_eq!(rig.skipped(), []);
}

#[test]
fn what_crossed_to_one_does_not_wait_for_what_crossed_to_another() {
    let mut rig = Rig::one(&SLOT, |_, _, _| takes(100));
    for to in ["b", "c", "d"] {
        let mut state = crossed("ego", 0, 0);
        state.header.to = Some(to.into());
        rig.give(0, state);
    }
    assert_eq!(rig.until(10), ["0 s in 0.ego0"; 3]);
    assert_eq!(rig.skipped(), []);
}

#[test]
fn a_set_is_one_call_when_its_last_part_is_ready() {
    let mut rig = Rig::one(&JOIN, |_, call, start| forward(call, start));
    rig.give(0, message("x", 1, 10));
    rig.give(1, message("x", 1, 8));
    rig.give(2, message("x", 1, 4));
    rig.give(0, crossed("x", 0, 3));
    rig.give(1, crossed("y", 0, 20));
    rig.end();
    assert_eq!(rig.rest(), ["10 s a 0.x1 1.x1 2.x1", "20 s end"]);
    assert_eq!(
        rig.skipped(),
        [("x".to_string(), 0), ("y".into(), 0)],
        "the last at the end"
    );
    let left = rig.left();
    assert_eq!(left.len(), 3);
    let traced = &left[2].2.header.trace[0];
    assert_eq!(
        (traced.input, traced.start, traced.done, traced.ready),
        (10, 10, 10, 10)
    );
    let books = &rig.engine.books().nodes["s"];
    assert_eq!(
        (books.inputs["a"].unjoined.total(), books.inputs["b"].unjoined.total()),
        (1, 1)
    );
    assert_eq!(books.compute.keys().collect::<Vec<_>>(), ["a > out"]);
}

#[test]
fn a_set_does_not_wait_for_an_input_that_the_graph_leaves_open() {
    let mut wiring = Wiring::default();
    wiring.add("s", &JOIN, &[]).unwrap();
    wiring.feed_from_outside("a").unwrap();
    wiring.feed_from_outside("b").unwrap();
    let mut rig = Rig::new(&wiring, Servers::One, |_, _, _| Answer::default());
    rig.give(1, message("x", 0, 1));
    rig.give(0, message("x", 0, 2));
    rig.engine.end_input(0, PortId(0), 0);
    rig.engine.end_input(0, PortId(1), 0);
    assert_eq!(rig.rest(), ["2 s a 0.x0 1.x0", "2 s end"]);
    assert_eq!(
        rig.engine.books().nodes["s"].inputs.keys().collect::<Vec<_>>(),
        ["a", "b"]
    );
}

#[test]
fn what_fails_the_run_names_the_stage_and_the_input() {
    let mut rig = Rig::one(&RELAY, |_, _, _| takes(1));
    let report = Report {
        topic: "x".into(),
        json: String::new(),
    };
    rig.give(0, Message::new(message("a", 0, 0).header, report));
    let error = rig.try_until(10).unwrap_err();
    assert!(
        matches!(&error, EngineError::Type { node, .. } if node == "s"),
        "{error}"
    );
    assert!(error.to_string().contains("node `s`: input `in` takes"), "{error}");

    let mut rig = Rig::one(&RELAY, |_, _, _| takes(1_000_000));
    for seq in 0..=realo_operator::Queue::CAPACITY as u64 {
        rig.give(0, message("a", seq, seq as Nanos));
    }
    assert!(rig.try_until(10_000).is_ok());
    rig.give(0, message("a", 9999, 9999));
    let error = rig.try_until(10_000).unwrap_err().to_string();
    assert!(
        error.contains("node `s`: input `in` holds 1024 waiting messages"),
        "{error}"
    );

    let mut rig = Rig::one(&RELAY, |_, _, _| Answer {
        gone: Some(Box::new(Gone("its program died".into()))),
        ..Answer::default()
    });
    rig.give(0, message("a", 0, 0));
    let error = rig.try_until(10).unwrap_err().to_string();
    assert_eq!(error, "node `s` failed: its program died");
}

// Sources, times and numbers.

#[test]
fn a_source_releases_on_time_and_says_when_it_was_late() {
    let mut wiring = alone(&SOURCE);
    wiring.add("relay", &RELAY, &[("in", "s", "out")]).unwrap();
    let mut rig = Rig::new(&wiring, Servers::PerStream, |_, _, _| Answer::default());
    assert_eq!(
        rig.engine.next_due(),
        Some(Nanos::MIN),
        "stages without inputs are looked at once"
    );
    assert!(rig.until(0).is_empty());
    assert_eq!(rig.engine.next_due(), None);
    rig.engine.schedule(0, 10, PortId(0), message("a", 0, 7));
    rig.engine.schedule(0, 12, PortId(1), message("a", 0, 15));
    assert_eq!(rig.engine.next_due(), Some(10));
    assert!(matches!(rig.engine.step(9), Ok(None)), "not before it is due");
    assert_eq!(rig.rest(), ["10 relay in 0.a0"]);
    assert_eq!(rig.released, [0, 0]);
    let left = rig.left();
    let header = |n: usize| (&left[n].2.header, left[n].1);
    assert_eq!((header(0).0.ready, header(0).1), (10, 0));
    assert_eq!(
        (header(1).0.ready, header(1).1),
        (15, 1),
        "what is ready later stays so"
    );
    let clock = Clock {
        wall_origin: 5,
        log_origin: 7,
        rate: 1.0,
    };
    rig.engine.set_clock(clock);
    rig.engine.set_clock(Clock { rate: 2.0, ..clock });
    assert_eq!(rig.engine.clock(), Some(clock), "the first one stays");
    rig.engine.release(0, PortId(0), message("a", 1, 20), 20, 23);
    rig.engine.release(0, PortId(0), message("a", 2, 28), 30, 29);
    assert_eq!(rig.rest(), ["23 relay in 0.a1", "30 relay in 0.a2"]);
    let left = rig.left();
    let header = &left[0].2.header;
    assert_eq!((header.ready, header.hop, header.clock), (23, 1, Some(clock)));
    let trace = &header.trace[0];
    assert_eq!(
        (&*trace.node, trace.input, trace.start, trace.done, trace.ready),
        ("s", 20, 23, 23, 23)
    );
    assert_eq!(left[1].2.header.ready, 30, "none is released before its time");
    rig.engine.close_source(0, counts(&[("read", 3)]), 40);
    assert!(rig.engine.has_ended(0) && !rig.engine.has_ended(1) && !rig.engine.is_done());
    assert_eq!(rig.rest(), ["40 relay end"]);
    assert!(rig.engine.is_done());
    let books = rig.engine.books();
    assert_eq!(books.nodes["s"].counters, BTreeMap::from([("read".into(), 3)]));
    let late = &books.nodes["s"].late;
    assert_eq!(
        (late.count(), late.max()),
        (2, Some(3)),
        "without a clock nobody is late"
    );
    assert_eq!(books.nodes["s"].outputs["out"].total(), 3);
    assert_eq!(books.nodes["relay"].inputs["in"].received.total(), 3);
}

#[test]
fn messages_are_stamped_numbered_and_handed_to_everybody() {
    let mut wiring = alone(&RELAY);
    wiring.stages[0].leaves[1] = false;
    wiring.add("x", &RELAY, &[("in", "s", "out")]).unwrap();
    wiring.add("y", &SINK, &[("in", "s", "out")]).unwrap();
    wiring.add("z", &SINK, &[("in", "s", "aside")]).unwrap();
    let mut rig = Rig::new(&wiring, Servers::PerStream, |id, call, start| {
        let mut answer = match id {
            "s" => forward(call, start),
            _ => Answer::default(),
        };
        if let (Call::Inputs(calls), "s") = (call, id) {
            let mut later = calls[0].1.clone();
            later.header.ready = start + 100;
            later.header.run = "".into();
            answer.sent.push((1, later.clone()));
            answer.sent.push((1, later));
            answer.took = 7;
        }
        answer
    });
    rig.give(0, message("a", 4, 50));
    let expected = [
        "50 s in 0.a4",
        "57 x in 0.a4",
        "57 y in 0.a4",
        "157 z in 0.a4",
        "157 z in 0.a4",
    ];
    assert_eq!(rig.until(200), expected);
    let left = rig.left();
    assert_eq!(left.len(), 1, "the other output does not leave");
    assert_eq!(left[0].2.header.ready, 57);
    assert_eq!((rig.engine.hops(0, PortId(0)), rig.engine.hops(0, PortId(1))), (1, 2));
    assert_eq!(
        (rig.engine.take_hop(0, PortId(1)), rig.engine.take_hop(0, PortId(1))),
        (2, 3)
    );
    assert_eq!(rig.engine.hops(0, PortId(1)), 4);
    rig.end();
    // The end of an output follows its last message.
    let expected = ["200 s end", "200 x end", "200 y end", "200 z end"];
    rig.now = 200;
    assert_eq!(rig.rest(), expected);
}

#[test]
fn the_name_of_the_run_is_that_of_the_first_message() {
    for from_outside in [true, false] {
        let mut wiring = alone(&RELAY);
        wiring.add("source", &SOURCE, &[]).unwrap();
        let mut rig = Rig::new(&wiring, Servers::One, |_, call, _| match call {
            Call::End(_) => {
                let mut last = message("", 0, 0);
                last.header.run = "".into();
                Answer {
                    sent: vec![(0, last)],
                    ..Answer::default()
                }
            }
            _ => Answer::default(),
        });
        if from_outside {
            rig.give(0, message("a", 0, 1));
        } else {
            rig.engine.release(1, PortId(0), message("a", 0, 1), 1, 1);
        }
        let mut other = message("a", 1, 2);
        other.header.run = "other".into();
        rig.give(0, other.clone());
        rig.engine.release(1, PortId(0), other, 1, 1);
        rig.end();
        rig.rest();
        let left = rig.left();
        assert_eq!(&*left.last().unwrap().2.header.run, "run");
        assert_eq!(left.last().unwrap().2.header.clock, None);
    }
}

// Ends.

#[test]
fn a_stage_ends_when_all_inputs_have_and_nothing_is_left_to_do() {
    let mut rig = Rig::one(&CLASSES, |_, call, start| match call {
        Call::Inputs(_) => Answer {
            took: 30,
            wakes: vec![start + 50],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(0, message("a", 0, 10));
    rig.give(1, message("b", 0, 12));
    for port in 1..4 {
        rig.engine.end_input(0, PortId(port), 5);
    }
    assert_eq!(
        rig.until(1000),
        ["10 s query 0.a0", "12 s second 1.b0", "60 s wake", "62 s wake"]
    );
    assert!(!rig.engine.is_done(), "one input is open");
    rig.engine.end_input(0, PortId(0), 1000);
    assert_eq!(rig.rest(), ["1000 s end"]);
    assert!(rig.engine.is_done() && rig.engine.has_ended(0));
    assert_eq!(rig.engine.next_due(), None);
}

#[test]
fn the_end_waits_for_messages_that_are_ready_later_and_for_busy_servers() {
    let mut rig = Rig::one(&RELAY, |_, _, _| takes(30));
    rig.give(0, message("a", 0, 10));
    rig.give(0, message("b", 0, 90));
    rig.give(0, message("b", 1, 95));
    rig.end();
    assert_eq!(
        rig.rest(),
        ["10 s in 0.a0", "90 s in 0.b0", "120 s in 0.b1", "150 s end"]
    );
    let books = &rig.engine.books().nodes["s"];
    assert_eq!(books.compute.len(), 1, "nothing is charged for the end");
    assert_eq!((books.compute["in"].count(), books.compute["in"].max()), (3, Some(30)));
}

#[test]
fn what_is_sent_at_the_end_still_arrives_and_nobody_is_woken_after_it() {
    let mut wiring = alone(&RELAY);
    wiring.add("next", &RELAY, &[("in", "s", "out")]).unwrap();
    let mut rig = Rig::new(&wiring, Servers::PerStream, |id, call, start| match (id, call) {
        ("s", Call::End(_)) => Answer {
            sent: vec![(0, message("a", 9, 70))],
            wakes: vec![start, start + 5],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(0, message("a", 0, 10));
    rig.end();
    assert_eq!(
        rig.rest(),
        ["10 s in 0.a0", "10 s end", "70 next in 0.a9", "70 next end"]
    );
}

#[test]
fn a_early_output_ends_with_the_first_input_of_its_gateway_so_that_what_it_feeds_can() {
    let mut wiring = alone(&GATEWAY);
    wiring.add("lane", &RELAY, &[("in", "s", "states")]).unwrap();
    wiring.add("far", &RELAY, &[("in", "s", "out")]).unwrap();
    let mut rig = Rig::new(&wiring, Servers::PerStream, |id, call, start| match (id, call) {
        ("s", Call::Inputs(_)) => Answer {
            sent: vec![
                (0, crossed("b", start as u64, start)),
                (1, crossed("c", start as u64, start)),
            ],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.give(0, message("a", 0, 10));
    rig.engine.end_input(0, PortId(1), 20);
    assert!(!rig.engine.output_has_ended(0, PortId(1)));
    assert_eq!(
        rig.until(25),
        ["10 s in 0.a0", "10 lane in 0.c10", "10 far in 0.b10", "20 lane end"]
    );
    assert!(rig.engine.output_has_ended(0, PortId(1)) && !rig.engine.output_has_ended(0, PortId(0)));
    assert!(rig.engine.has_ended(1) && !rig.engine.has_ended(0));
    rig.give(0, message("a", 1, 30));
    rig.engine.end_input(0, PortId(0), 40);
    assert_eq!(
        rig.rest(),
        ["30 s in 0.a1", "30 far in 0.b30", "40 s end", "40 far end"]
    );
    assert_eq!(rig.engine.hops(0, PortId(1)), 1, "one was sent before the end");
    let fates = rig.engine.take_fates();
    let late: Vec<_> = fates
        .iter()
        .map(|fated| (&*fated.message.from, fated.message.seq, fated.fate))
        .collect();
    assert_eq!(late, [("c", 30, Fate::InFlight)]);
}

#[test]
fn stages_that_nothing_feeds_end_at_once_and_sinks_last_with_the_books_of_all() {
    let mut wiring = Wiring::default();
    wiring.add("early", &SINK, &[]).unwrap();
    wiring.add("source", &SOURCE, &[]).unwrap();
    wiring.add("idle", &RELAY, &[]).unwrap();
    wiring.add("relay", &RELAY, &[("in", "source", "out")]).unwrap();
    wiring.add("late", &SINK, &[("in", "relay", "out")]).unwrap();
    let mut rig = Rig::new(&wiring, Servers::PerStream, |id, call, start| match id {
        "relay" => forward(call, start),
        _ => Answer::default(),
    });
    assert_eq!(rig.until(0), ["- idle end"]);
    let mut outside = Books::default();
    outside.nodes.insert("far".into(), Default::default());
    rig.engine.merge_books(&outside);
    rig.engine.release(1, PortId(0), message("a", 0, 3), 3, 3);
    assert_eq!(rig.rest(), ["3 relay in 0.a0", "3 late in 0.a0"]);
    rig.engine.close_source(1, Counts::default(), 5);
    assert_eq!(rig.rest(), ["5 relay end", "5 early end", "5 late end"]);
    assert!(rig.engine.is_done());
    let names = |books: &Books| books.nodes.keys().cloned().collect::<Vec<_>>();
    let of = |sink: &str| rig.books.iter().find(|(id, _)| id == sink).unwrap().1.clone();
    assert_eq!(names(&of("early")), ["early", "far", "idle", "relay", "source"]);
    assert_eq!(names(&of("late")), ["far", "idle", "late", "relay", "source"]);
    assert_eq!(of("late").nodes["late"].inputs["in"].received.total(), 1);
    assert_eq!(of("late").nodes["relay"].name, "relay");
    assert_eq!(names(&of("relay")), Vec::<String>::new(), "an operator gets no fates");
    let all = rig.engine.books();
    assert_eq!(names(&all), ["early", "far", "idle", "late", "relay", "source"]);
    assert_eq!(all.nodes["late"].compute.len(), 0, "sinks are not charged");
}

#[test]
fn a_source_that_gives_nothing_ends_its_graph() {
    let mut wiring = alone(&SOURCE);
    wiring.add("relay", &RELAY, &[("in", "s", "out")]).unwrap();
    wiring.stages[1].leaves.fill(true);
    let mut rig = Rig::new(&wiring, Servers::PerStream, |_, call, _| match call {
        Call::End(_) => Answer {
            sent: vec![(0, message("a", 0, 7))],
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    rig.engine.close_source(0, Counts::default(), Nanos::MIN);
    assert_eq!(rig.rest(), ["- relay end"]);
    assert_eq!(rig.left()[0].2.header.ready, 7);
}

// Fates, errors and counters.

#[test]
fn fates_reach_every_sink_with_its_next_call_and_leave_once() {
    let mut wiring = alone(&RELAY);
    wiring.add("first", &SINK, &[("in", "s", "out")]).unwrap();
    wiring.add("second", &SINK, &[("in", "s", "aside")]).unwrap();
    let fated = |seq| Fated {
        message: realo_schemas::report::Crossing::of(&crossed("a", seq, 0).header).unwrap(),
        fate: Fate::Used,
        r#use: None,
        entry: None,
    };
    let mut rig = Rig::new(&wiring, Servers::PerStream, move |id, call, start| {
        let mut answer = if id == "s" {
            forward(call, start)
        } else {
            Answer::default()
        };
        if let (Call::Inputs(calls), "s") = (call, id) {
            answer.fates = vec![fated(calls[0].1.header.seq)];
        }
        answer
    });
    rig.give(0, message("a", 0, 0));
    rig.until(0);
    assert_eq!(rig.engine.take_fates(), [fated(0)]);
    assert_eq!(rig.engine.take_fates(), []);
    rig.engine.report(vec![fated(5)]);
    rig.give(0, message("a", 1, 1));
    rig.end();
    rig.rest();
    assert_eq!(rig.engine.take_fates(), [fated(5), fated(1)]);
    let reported = |sink: &str| {
        let of = rig.reported.iter().filter(|(id, _)| id == sink);
        of.map(|(_, fates)| fates.clone()).collect::<Vec<_>>()
    };
    assert_eq!(reported("first"), [vec![fated(0)], vec![fated(5), fated(1)], vec![]]);
    assert_eq!(reported("second"), [vec![fated(0), fated(5), fated(1)]], "at its end");
    assert_eq!(reported("s"), vec![Vec::<Fated>::new(); 3], "only sinks get fates");
}

#[test]
fn what_a_stage_counts_is_summed_in_its_books() {
    let channel = |to: &str, kind, sent| Channel {
        from: "a".into(),
        to: to.into(),
        kind,
        traffic: Traffic {
            sent,
            bytes: 10 * sent,
            ..Traffic::default()
        },
    };
    let mut rig = Rig::one(&RELAY, |_, call, _| match call {
        Call::Inputs(calls) => Answer {
            traffic: vec![
                channel("b", Kind::Boxes, 1),
                channel("b", Kind::Points, 2),
                channel("c", Kind::Boxes, 4),
            ],
            counts: vec![("points", 3), ("most", u64::MAX)],
            sent: match calls[0].1.header.seq {
                0 => vec![
                    (1, message("a", 0, 0)),
                    (0, message("b", 0, 0)),
                    (1, message("a", 1, 0)),
                ],
                1 => vec![(1, message("a", 1, 0))],
                _ => vec![],
            },
            wakes: if calls[0].1.header.seq == 3 { vec![9] } else { vec![] },
            took: 2,
            ..Answer::default()
        },
        Call::Wake => takes(3),
        Call::End(_) => takes(50),
    });
    for seq in 0..4 {
        rig.give(0, message("a", seq, 0));
    }
    rig.end();
    rig.rest();
    let books = &rig.engine.books().nodes["s"];
    assert_eq!(
        books.channels,
        [
            channel("b", Kind::Boxes, 4),
            channel("b", Kind::Points, 8),
            channel("c", Kind::Boxes, 16)
        ]
    );
    assert_eq!((books.counters["points"], books.counters["most"]), (12, u64::MAX));
    let compute: Vec<(&str, u64, Option<Nanos>)> = books
        .compute
        .iter()
        .map(|(trigger, took)| (trigger.as_str(), took.count(), took.max()))
        .collect();
    let expected = [
        ("in", 2, Some(2)),
        ("in > aside", 1, Some(2)),
        ("in > out, aside", 1, Some(2)),
        ("wake", 1, Some(3)),
    ];
    assert_eq!(compute, expected);
    assert_eq!((books.outputs["out"].total(), books.outputs["aside"].total()), (1, 3));
    assert_eq!(books.name, "relay");
}

#[test]
fn errors_are_counted_and_the_first_five_are_reported() {
    let mut rig = Rig::one(&RELAY, |_, call, _| match call {
        Call::Inputs(calls) => Answer {
            errors: if calls[0].1.header.seq == 0 {
                vec!["e", "f"]
            } else {
                vec!["g"]
            },
            ..Answer::default()
        },
        _ => Answer::default(),
    });
    for seq in 0..6 {
        rig.give(0, message("a", seq, 0));
    }
    rig.end();
    rig.rest();
    let complaints = rig.engine.take_complaints();
    let expected = [
        "s (relay): e (and 1 more of this set)",
        "s (relay): g",
        "s (relay): g",
        "s (relay): g",
        "s (relay): g",
        "s: further errors are counted, not printed",
    ];
    assert_eq!(complaints, expected);
    assert_eq!(rig.engine.take_complaints(), [""; 0]);
    let books = rig.engine.books();
    assert_eq!(
        (books.nodes["s"].errors, books.nodes["s"].first_error.as_deref()),
        (6, Some("e")),
        "a set of which two parts fail is one failure"
    );
}

#[test]
fn who_brings_messages_counts_in_the_books_of_the_input() {
    let mut rig = Rig::one(&RELAY, |_, _, _| Answer::default());
    rig.engine.input_books(0, PortId(0)).transport_lost += 4;
    rig.end();
    rig.rest();
    assert_eq!(rig.engine.books().nodes["s"].inputs["in"].transport_lost, 4);
    assert_eq!(&**rig.engine.id(0), "s");
    assert_eq!(rig.engine.registration(0).name, "relay");
}

// Wires.

#[test]
fn wires_are_checked_and_consumers_found_in_order() {
    let mut wiring = Wiring::default();
    assert!(wiring.feed_from_outside("in").is_err());
    wiring.add("s", &RELAY, &[]).unwrap();
    let error = wiring.feed_from_outside("inn").unwrap_err();
    assert_eq!(error, "node `s`: relay has no input `inn`; it has: in");
    assert_eq!(wiring.feed_from_outside("in"), Ok((0, PortId(0))));
    wiring
        .add("j", &JOIN, &[("b", "s", "out"), ("a", "s", "out"), ("c", "s", "aside")])
        .unwrap();
    wiring.add("k", &RELAY, &[("in", "s", "out")]).unwrap();
    let consumers = |output| wiring.consumers(0, PortId(output));
    assert_eq!(consumers(0), [(1, PortId(0)), (1, PortId(1)), (2, PortId(0))]);
    assert_eq!(consumers(1), [(1, PortId(2))]);
    assert_eq!(wiring.consumers(2, PortId(0)), []);
    assert!(Feed::Outside.is_outside() && !Feed::Stage(0, PortId(0)).is_outside());
    let mut error = |inputs: &[(&str, &str, &str)]| wiring.add("x", &JOIN, inputs).unwrap_err();
    assert_eq!(
        error(&[("d", "s", "out")]),
        "node `x`: join has no input `d`; it has: a, b, c"
    );
    assert_eq!(
        error(&[("a", "t", "out")]),
        "node `x`: input `a` comes from unknown node `t`"
    );
    assert_eq!(error(&[("a", "s", "oot")]), "node `s` has no output `oot`");
    assert_eq!(wiring.stages.len(), 3, "a stage that does not fit is not added");
}

// Random graphs.

#[derive(Clone, Debug)]
struct RandomStage {
    kind: usize,
    /// For each input the stage that feeds it; nobody before the first, and then somebody outside does.
    feeds: Vec<usize>,
    took: Nanos,
    delay: Nanos,
    wake: Nanos,
}

fn random_stage() -> impl Strategy<Value = RandomStage> {
    let kind = 0..KINDS.len();
    let feeds = proptest::collection::vec(0usize..8, 4);
    (kind, feeds, 0i64..4, 0i64..3, 0i64..6).prop_map(|(kind, feeds, took, delay, wake)| RandomStage {
        kind,
        feeds,
        took,
        delay,
        wake,
    })
}

static KINDS: [&Registration; 5] = [&RELAY, &SLOT, &JOIN, &CLASSES, &SINK];

fn random_wiring(stages: &[RandomStage]) -> (Wiring, Vec<(usize, PortId)>) {
    let (mut wiring, mut outside) = (Wiring::default(), Vec::new());
    for (index, stage) in stages.iter().enumerate() {
        let registration = KINDS[stage.kind];
        let ids: Vec<String> = wiring.stages.iter().map(|wired| wired.id.to_string()).collect();
        let mut inside = Vec::new();
        let mut free = Vec::new();
        for (port, feed) in registration.inputs.iter().zip(&stage.feeds) {
            match stages.get(*feed).filter(|_| *feed < index && stages[*feed].kind != 4) {
                Some(_) => inside.push((port.name, ids[*feed].as_str(), "out")),
                None => free.push(port.name),
            }
        }
        wiring.add(&format!("s{index}"), registration, &inside).unwrap();
        for port in free {
            outside.push(wiring.feed_from_outside(port).unwrap());
        }
        wiring.stages[index].leaves.fill(true);
    }
    (wiring, outside)
}

/// Calls, what left, books, fates, and the fates that each call was given.
type Trail = (Vec<String>, Vec<String>, Books, Vec<Fated>, Vec<(String, Vec<Fated>)>);

fn drive(
    stages: &[RandomStage],
    messages: &[(usize, &'static str, Nanos)],
    servers: Servers,
    chunk: Option<Nanos>,
) -> Trail {
    let (wiring, outside) = random_wiring(stages);
    let plan = stages.to_vec();
    let mut rig = Rig::new(&wiring, servers, move |id, call, start| {
        let plan = &plan[id[1..].parse::<usize>().unwrap()];
        if plan.kind == 4 {
            return takes(plan.took);
        }
        let mut answer = forward(call, start);
        answer.sent.truncate(1);
        for (_, message) in &mut answer.sent {
            message.header.ready += plan.delay;
        }
        answer.took = plan.took;
        if let (Call::Inputs(_), 1..) = (call, plan.wake) {
            answer.wakes = vec![start + plan.wake];
        }
        answer
    });
    let mut left: Vec<(Nanos, (usize, PortId), Message)> = Vec::new();
    if !outside.is_empty() {
        let mut ready = 0;
        for (seq, (entry, agent, pause)) in messages.iter().enumerate() {
            ready += pause;
            // Numbers meet across inputs, so that sets become complete.
            let message = crossed(agent, seq as u64 / 2, ready);
            left.push((ready, outside[entry % outside.len()], message));
        }
    }
    let ends = |left: &[(Nanos, (usize, PortId), Message)], input: (usize, PortId)| {
        !left.iter().any(|(_, of, _)| *of == input)
    };
    for input in outside.iter().filter(|input| ends(&left, **input)) {
        rig.engine.end_input(input.0, input.1, Nanos::MIN);
    }
    left.reverse();
    while let Some((ready, input, message)) = left.pop() {
        if let Some(chunk) = chunk {
            // As late as may be, with looks in between that find nothing.
            rig.try_until(ready - 1 - chunk).unwrap();
            assert!(rig.engine.next_due().is_none_or(|due| due > ready - 1 - chunk));
            rig.try_until(ready - 1).unwrap();
            assert!(matches!(rig.engine.step(rig.now.min(ready - 1)), Ok(None)));
        }
        rig.engine.deliver(input.0, input.1, message);
        if ends(&left, input) {
            rig.engine.end_input(input.0, input.1, Nanos::MIN);
        }
    }
    rig.try_until(Nanos::MAX).unwrap();
    assert!(rig.engine.is_done(), "every stage ends");
    let leaving = rig.left().into_iter();
    let leaving = leaving
        .map(|(stage, port, message)| format!("{stage} {port} {:?}", message.header))
        .collect();
    (
        rig.log.clone(),
        leaving,
        rig.engine.books(),
        rig.engine.take_fates(),
        rig.reported.clone(),
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn a_graph_does_the_same_however_time_is_cut(
        stages in proptest::collection::vec(random_stage(), 1..6),
        messages in proptest::collection::vec((0usize..12, prop_oneof![Just("a"), Just("b")], 0i64..5), 0..40),
        one in any::<bool>(),
        chunk in 0i64..7,
    ) {
        let servers = if one { Servers::One } else { Servers::PerStream };
        let whole = drive(&stages, &messages, servers, None);
        let cut = drive(&stages, &messages, servers, Some(chunk));
        prop_assert_eq!(&whole, &cut);
        // Every stage ends once, as its last call, and sinks after all others.
        let (log, _, books, fates, _) = whole;
        for index in 0..stages.len() {
            let calls: Vec<&String> = log.iter().filter(|line| line.contains(&format!(" s{index} "))).collect();
            prop_assert_eq!(calls.iter().filter(|line| line.ends_with("end")).count(), 1);
            prop_assert!(calls.last().is_some_and(|line| line.ends_with("end")));
        }
        let of_sink = |line: &String| stages.iter().enumerate().any(|(index, stage)| stage.kind == 4 && line.contains(&format!(" s{index} ")));
        let first = log.iter().position(|line| of_sink(line) && line.ends_with("end")).unwrap_or(log.len());
        prop_assert!(log[first..].iter().all(of_sink));
        // What an input received was taken, skipped, or part of no set; and what was not taken was reported to it.
        let mut passed = 0;
        for (index, stage) in stages.iter().enumerate() {
            let node = &books.nodes[&format!("s{index}")];
            let mut taken = 0;
            for line in log.iter().filter(|line| line.contains(&format!(" s{index} ")) && !line.ends_with("end")) {
                taken += line.split(' ').skip(3).count() as u64;
            }
            let received: u64 = node.inputs.values().map(|input| input.received.total()).sum();
            let gone: u64 = node.inputs.values().map(|input| input.skipped.total() + input.unjoined.total()).sum();
            prop_assert_eq!(received, taken + gone, "stage {} of {}", index, KINDS[stage.kind].name);
            passed += gone;
        }
        prop_assert_eq!(passed, fates.len() as u64);
        // Times go on, and within a wire numbers do.
        let starts: Vec<Nanos> = log.iter().map(|line| line.split(' ').next().unwrap().parse().unwrap_or(Nanos::MIN)).collect();
        prop_assert!(starts.is_sorted());
    }
}
