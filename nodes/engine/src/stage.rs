//! One stage's identity, counters and numbering of outputs; and one call of it.

use std::collections::BTreeSet;

use realo_operator::{AnyOperator, AnySink, Built, Counts, Error, Made, NodeBooks, Outputs, PortId, Registration};
use realo_schemas::report::{Crossing, Fate, Fated};
use realo_schemas::{Message, Name, Nanos, Payload, TraceEntry};

/// Errors of a stage that are reported; the rest is only counted.
const REPORTED_ERRORS: u64 = 5;
/// Characters of an error that are reported: what a plug-in says may be of any length.
const REPORTED_CHARACTERS: usize = 1000;

/// Why a stage can no longer be called; the run fails.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Gone(pub String);

/// What a stage is called for.
#[derive(Debug)]
pub enum Call {
    /// One message, or a complete set in declared order.
    Inputs(Vec<(PortId, Message)>),
    /// A wake that it asked for.
    Wake,
    /// Nothing follows; a sink gets the books of the graph.
    End(Box<realo_operator::Books>),
}

/// All that came of a call.
#[derive(Debug, Default)]
pub struct Called {
    pub(crate) made: Made,
    /// What the operator could not take: the place, the reason.
    pub(crate) errors: Vec<String>,
    /// How many of the errors are of a wake or of the end of the stream.
    pub(crate) other_errors: u64,
    /// Why the stage cannot be called again.
    pub(crate) gone: Option<Error>,
}

impl Call {
    /// Calls a stage; `out` says when the call starts, `fates` what a sink has not seen yet.
    pub fn make(self, built: &mut Built, inputs: &Registration, mut out: Outputs, fates: &[Fated]) -> Called {
        let mut called = Called::default();
        match built {
            Built::Operator(operator) => self.of_operator(operator.as_mut(), inputs, &mut out, &mut called),
            Built::Gateway(gateway) => self.of_operator(gateway.stage(), inputs, &mut out, &mut called),
            Built::Sink(sink) => match sink.fates(fates) {
                Ok(()) => self.of_sink(sink.as_mut(), inputs, &mut out, &mut called),
                Err(error) => called.gone = Some(error),
            },
            Built::Source(_) => {}
        }
        let rejected = std::mem::take(&mut called.made.fates);
        called.made = out.into_made();
        called.made.fates.extend(rejected);
        called
    }
}

impl Call {
    fn of_operator(self, operator: &mut dyn AnyOperator, known: &Registration, out: &mut Outputs, called: &mut Called) {
        let start = out.now();
        match self {
            Call::Inputs(calls) => {
                for (port, message) in calls {
                    let (text, carried) = (message.header.to_string(), crossings(&message));
                    let Err(error) = operator.on_input(port, message, out) else {
                        continue;
                    };
                    if error.is::<Gone>() {
                        called.gone = Some(error);
                        break;
                    }
                    called.refuse(known, port, &text, &error);
                    called.made.fates.extend(reported(carried, Fate::Rejected));
                }
            }
            Call::Wake => called.note(&format!("wake at {start} ns"), operator.on_wake(start, out)),
            Call::End(_) => called.note("end of the stream", operator.on_end(out)),
        }
    }

    fn of_sink(self, sink: &mut dyn AnySink, known: &Registration, out: &mut Outputs, called: &mut Called) {
        match self {
            Call::Inputs(calls) => {
                for (port, message) in calls {
                    let text = message.header.to_string();
                    let Err(error) = sink.accept(port, message, out) else {
                        continue;
                    };
                    if error.is::<Gone>() || !sink.outlives_errors() {
                        called.gone = Some(error);
                        break;
                    }
                    called.refuse(known, port, &text, &error);
                }
            }
            Call::Wake => {}
            Call::End(books) => match sink.finish(&books, out) {
                Err(error) if !sink.outlives_errors() => called.gone = Some(error),
                done => called.note("end of the stream", done),
            },
        }
    }
}

impl Called {
    /// Notes a message that was not taken.
    fn refuse(&mut self, known: &Registration, port: PortId, header: &str, error: &Error) {
        let name = known.inputs.get(port.0).map_or("?", |port| port.name);
        self.errors
            .push(format!("input `{name}`, {header}: {}", words_of(error)));
    }

    fn note(&mut self, place: &str, done: Result<(), Error>) {
        match done {
            Err(error) if error.is::<Gone>() => self.gone = Some(error),
            Err(error) => {
                self.other_errors += 1;
                self.errors.push(format!("{place}: {}", words_of(&error)));
            }
            Ok(()) => {}
        }
    }

    /// The same once more; `None` of a call after which the stage is gone.
    pub fn copy(&self) -> Option<Called> {
        self.copy_with(|_, message| message.clone())
    }

    /// The same with other messages in the place of those that were sent.
    pub fn copy_with(&self, kept: impl Fn(PortId, &Message) -> Message) -> Option<Called> {
        let sent = self
            .made
            .sent
            .iter()
            .map(|(port, message)| (*port, kept(*port, message)));
        self.gone.is_none().then(|| Called {
            made: Made {
                sent: sent.collect(),
                wakes: self.made.wakes.clone(),
                counts: self.made.counts.clone(),
                explained: self.made.explained.clone(),
                fates: self.made.fates.clone(),
                traffic: self.made.traffic.clone(),
                steps: self.made.steps.clone(),
            },
            errors: self.errors.clone(),
            other_errors: self.other_errors,
            gone: None,
        })
    }

    /// The messages that were sent.
    pub fn sent(&self) -> impl Iterator<Item = &(PortId, Message)> {
        self.made.sent.iter()
    }

    /// What is charged for the call: what triggered it, and which outputs it sent on.
    pub fn trigger(&self, cause: &str, registration: &Registration) -> String {
        let ports: BTreeSet<PortId> = self.made.sent.iter().map(|(port, _)| *port).collect();
        let names: Vec<&str> = ports
            .iter()
            .filter_map(|port| Some(registration.outputs.get(port.0)?.name))
            .collect();
        match names.is_empty() {
            true => cause.to_string(),
            false => format!("{cause} > {}", names.join(", ")),
        }
    }
}

/// What an error says, as a terminal may have it.
fn words_of(error: &Error) -> String {
    let plain = |c: char| if c.is_control() && c != '\n' { ' ' } else { c };
    realo_documents::head(&error.to_string(), REPORTED_CHARACTERS)
        .chars()
        .map(plain)
        .collect()
}

/// The messages over links that a message is, or that it selects.
pub(crate) fn crossings(message: &Message) -> Vec<Crossing> {
    match &message.payload {
        Payload::Selection(selection) => selection
            .entries
            .iter()
            .filter_map(|entry| Crossing::of(&entry.header))
            .collect(),
        _ => Crossing::of(&message.header).into_iter().collect(),
    }
}

pub(crate) fn reported(messages: Vec<Crossing>, fate: Fate) -> impl Iterator<Item = Fated> {
    messages.into_iter().map(move |message| Fated {
        message,
        fate,
        r#use: None,
        entry: None,
    })
}

/// One stage's identity, counters and numbering of outputs.
pub(crate) struct Stage {
    pub id: Name,
    pub registration: &'static Registration,
    pub books: NodeBooks,
    /// Messages sent so far on each output.
    pub hops: Vec<u64>,
}

impl Stage {
    pub fn new(id: Name, registration: &'static Registration) -> Self {
        let books = NodeBooks {
            name: registration.name.into(),
            ..NodeBooks::default()
        };
        Stage {
            id,
            registration,
            books,
            hops: vec![0; registration.outputs.len()],
        }
    }

    /// Takes over what was counted; gives what is to be reported of counters that the stage does not declare.
    pub fn count_up(&mut self, counts: Counts) -> Vec<String> {
        let declared = self.registration.counters;
        let is_new = |name: &&str| !declared.is_empty() && !self.books.counters.contains_key(*name);
        let new = counts.counters.keys().map(|name| &**name).filter(is_new);
        let undeclared = new.filter(|name| !declared.iter().any(|counter| counter.name == *name));
        let lines = undeclared.map(|name| {
            let (id, operator) = (&self.id, self.registration.name);
            format!("{id} ({operator}): it counts `{name}`, which is not among its COUNTERS: no note can say what that means")
        });
        let lines = lines.collect();
        self.books.count(counts);
        lines
    }

    /// Counts what came of a call; gives what is to be reported of its errors.
    pub fn count(&mut self, called: &mut Called) -> Vec<String> {
        let mut lines = self.count_up(std::mem::take(&mut called.made.counts));
        self.books.explained.append(&mut called.made.explained);
        for (step, took) in std::mem::take(&mut called.made.steps) {
            match self.books.steps.get_mut(step) {
                Some(durations) => durations.record(took),
                None => self.books.steps.entry(step.into()).or_default().record(took),
            }
        }
        for channel in std::mem::take(&mut called.made.traffic) {
            self.books.carried(channel);
        }
        let errors = std::mem::take(&mut called.errors);
        let Some(first) = errors.first() else { return lines };
        // A set of which several parts fail is one failure.
        self.books.errors += 1;
        self.books.other_errors += called.other_errors;
        self.books.first_error.get_or_insert_with(|| first.clone());
        if self.books.errors <= REPORTED_ERRORS {
            let more = match errors.len() {
                1 => String::new(),
                all => format!(" (and {} more of this set)", all - 1),
            };
            lines.push(format!("{} ({}): {first}{more}", self.id, self.registration.name));
        }
        if self.books.errors == REPORTED_ERRORS {
            lines.push(format!("{}: further errors are counted, not printed", self.id));
        }
        lines
    }

    /// Stamps an outgoing message: its number on the output, when it is ready, and this stage in its trace.
    ///
    /// The operator saw the call begin at `start`; a `ready` beyond that is a delay which follows the computation.
    /// Before the first message `start` may be the smallest time there is.
    pub fn stamp(&mut self, port: PortId, message: &mut Message, input: Nanos, start: Nanos, done: Nanos) {
        let header = &mut message.header;
        header.ready = header.ready.max(start) + (done - start);
        header.hop = self.hops[port.0];
        self.hops[port.0] += 1;
        header.trace.push(TraceEntry {
            node: self.id.clone(),
            input,
            start,
            done,
            ready: header.ready,
        });
        let output = self.registration.outputs[port.0].name;
        match self.books.outputs.get_mut(output) {
            Some(tally) => tally.add(message),
            None => self.books.outputs.entry(output.into()).or_default().add(message),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use realo_operator::{AnySource, Books, Counter, Port, Role};
    use realo_schemas::{Boxes, Clock, Header, Kind, PayloadType, Selection};

    use super::*;

    static PORTS: Registration = Registration {
        name: "test",
        about: "",
        role: Role::Operator,
        inputs: &[Port::new("in", &[PayloadType::Boxes], "")],
        outputs: &[
            Port::new("one", &[PayloadType::Boxes], ""),
            Port::new("two", &[PayloadType::Boxes], ""),
        ],
        settings: &[],
        counters: &[],
        defaults: Default::default,
        check: |_| Ok(()),
        examine: |_| Ok(()),
        maps: |_| Vec::new(),
        build: |_| Err("built by the test".into()),
    };

    const WAKES: Counter = Counter::plain("wakes", "ns at which it was woken");

    fn message(seq: u64) -> Message {
        let mut header = Header::origin(&"r".into(), &"a".into(), Kind::Boxes, seq, 10, 20);
        header.to = Some("ego".into());
        Message::new(header, Boxes::default())
    }

    /// Fails with every message of an odd number, and is gone with number 9.
    struct Moody {
        gone: bool,
    }

    impl AnyOperator for Moody {
        fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
            match message.header.seq {
                9 => return Err(Box::new(Gone("dead".into()))),
                odd if odd % 2 == 1 => return Err("odd".into()),
                _ => out.report(&message.header, Fate::Used),
            }
            out.send_on(port, message);
            Ok(())
        }
        fn on_wake(&mut self, now: Nanos, out: &mut Outputs) -> Result<(), Error> {
            out.count(&WAKES, "", now as u64);
            match self.gone {
                true => Err(Box::new(Gone("asleep".into()))),
                false => Err("tired".into()),
            }
        }
        fn on_end(&mut self, out: &mut Outputs) -> Result<(), Error> {
            out.send_on(PortId(0), message(4));
            Ok(())
        }
    }

    fn call(call: Call) -> Called {
        let mut built = Built::Operator(Box::new(Moody { gone: false }));
        call.make(&mut built, &PORTS, Outputs::at(7), &[])
    }

    fn inputs(seqs: &[u64]) -> Call {
        Call::Inputs(seqs.iter().map(|seq| (PortId(0), message(*seq))).collect())
    }

    fn fates(called: &Called) -> Vec<(u64, Fate)> {
        let fates = called.made.fates.iter();
        fates.map(|fated| (fated.message.seq, fated.fate)).collect()
    }

    #[test]
    fn what_an_operator_cannot_take_is_rejected_and_the_set_goes_on() {
        let called = call(inputs(&[1, 2, 3]));
        assert_eq!(
            fates(&called),
            [(2, Fate::Used), (1, Fate::Rejected), (3, Fate::Rejected)]
        );
        assert_eq!(called.errors.len(), 2);
        assert_eq!(called.errors[0], format!("input `in`, {}: odd", message(1).header));
        assert_eq!(called.made.sent.len(), 1);
        assert!(called.gone.is_none());
        assert_eq!(called.trigger("in", &PORTS), "in > one");
        let strange = call(Call::Inputs(vec![(PortId(7), message(1))]));
        assert!(strange.errors[0].starts_with("input `?`"), "{:?}", strange.errors);
        let selection = Selection {
            query: 1,
            entries: vec![message(4), message(6)],
        };
        let mut ego = Message::new(message(1).header, selection);
        ego.header.to = None;
        let called = call(Call::Inputs(vec![(PortId(0), ego)]));
        assert_eq!(fates(&called), [(4, Fate::Rejected), (6, Fate::Rejected)]);
    }

    #[test]
    fn a_stage_that_is_gone_is_called_no_more() {
        let called = call(inputs(&[2, 9, 1]));
        assert_eq!(called.gone.as_ref().map(ToString::to_string), Some("dead".into()));
        assert_eq!((called.errors.len(), fates(&called)), (0, vec![(2, Fate::Used)]));
        let mut built = Built::Operator(Box::new(Moody { gone: true }));
        let called = Call::Wake.make(&mut built, &PORTS, Outputs::at(7), &[]);
        assert!(called.gone.is_some() && called.errors.is_empty());
    }

    #[test]
    fn wakes_and_the_end_are_calls_like_others() {
        let woken = call(Call::Wake);
        assert_eq!(woken.errors, ["wake at 7 ns: tired"]);
        assert_eq!(woken.other_errors, 1);
        assert_eq!(woken.made.counts.get("wakes"), 7);
        assert_eq!(woken.trigger("wake", &PORTS), "wake");
        let ended = call(Call::End(Box::default()));
        assert!(ended.errors.is_empty() && ended.gone.is_none());
        assert_eq!(ended.made.sent[0].1.header.ready, 20);
    }

    /// Writes down what it is given; fails with number 9.
    #[derive(Clone, Default)]
    struct Notes(Arc<Mutex<Vec<String>>>);

    impl AnySink for Notes {
        fn accept(&mut self, port: PortId, message: Message, _: &mut Outputs) -> Result<(), Error> {
            self.0
                .lock()
                .unwrap()
                .push(format!("{} {}", port.0, message.header.seq));
            match message.header.seq {
                9 => Err("full".into()),
                _ => Ok(()),
            }
        }
        fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
            self.0.lock().unwrap().push(format!("{} fates", fates.len()));
            match fates.len() {
                2 => Err("too many".into()),
                _ => Ok(()),
            }
        }
        fn finish(&mut self, books: &Books, _: &mut Outputs) -> Result<(), Error> {
            self.0.lock().unwrap().push(format!("{} books", books.nodes.len()));
            Ok(())
        }
    }

    /// Counts what it is given; cannot take number 9.
    struct Outside;

    const TAKEN: Counter = Counter::plain("taken", "messages that were taken");

    impl AnySink for Outside {
        fn accept(&mut self, _: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
            if message.header.seq == 9 {
                return Err("nobody listens".into());
            }
            out.count(&TAKEN, &message.header.agent, 1);
            Ok(())
        }
        fn fates(&mut self, _: &[Fated]) -> Result<(), Error> {
            Ok(())
        }
        fn finish(&mut self, _: &Books, _: &mut Outputs) -> Result<(), Error> {
            Err("it was not said goodbye to".into())
        }
        fn outlives_errors(&self) -> bool {
            true
        }
    }

    #[test]
    fn a_sink_of_the_world_outside_counts_and_goes_on_after_an_error() {
        let mut built = Built::Sink(Box::new(Outside));
        let mut make = |call: Call| call.make(&mut built, &PORTS, Outputs::at(7), &[]);
        let called = make(inputs(&[8, 9, 10]));
        let taken: u64 = called.made.counts.counters.values().sum();
        assert_eq!((taken, called.errors.len(), called.gone.is_none()), (2, 1, true));
        assert!(
            called.errors[0].contains("input `in`") && called.errors[0].contains("nobody listens"),
            "{:?}",
            called.errors
        );
        let ended = make(Call::End(Box::default()));
        assert_eq!((ended.other_errors, ended.gone.is_none()), (1, true));
    }

    #[test]
    fn a_sink_hears_of_fates_first_and_its_errors_fail_the_run() {
        let notes = Notes::default();
        let mut built = Built::Sink(Box::new(notes.clone()));
        let fate: Vec<Fated> = reported(crossings(&message(0)), Fate::Lost).collect();
        let mut make = |call: Call, fates: &[Fated]| {
            let called = call.make(&mut built, &PORTS, Outputs::at(7), fates);
            let said = std::mem::take(&mut *notes.0.lock().unwrap());
            (said, called.gone.map(|error| error.to_string()))
        };
        let said = |lines: &[&str]| lines.iter().map(|line| line.to_string()).collect::<Vec<_>>();
        assert_eq!(make(inputs(&[3, 4]), &fate), (said(&["1 fates", "0 3", "0 4"]), None));
        assert_eq!(
            make(inputs(&[9, 4]), &[]),
            (said(&["0 fates", "0 9"]), Some("full".into()))
        );
        let two = [fate.clone(), fate.clone()].concat();
        assert_eq!(make(inputs(&[3]), &two), (said(&["2 fates"]), Some("too many".into())));
        assert_eq!(make(Call::Wake, &fate), (said(&["1 fates"]), None));
        let mut books = Books::default();
        books.nodes.insert("x".into(), NodeBooks::default());
        assert_eq!(
            make(Call::End(Box::new(books)), &[]),
            (said(&["0 fates", "1 books"]), None)
        );
    }

    struct Nothing;

    impl AnySource for Nothing {
        fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
            Err("nobody calls it here".into())
        }
        fn rate(&self) -> f64 {
            1.0
        }
        fn clock(&self, _: Nanos) -> Option<Clock> {
            None
        }
        fn counts(&self) -> Counts {
            Default::default()
        }
    }

    #[test]
    fn a_source_is_not_called() {
        let called = inputs(&[1]).make(&mut Built::Source(Box::new(Nothing)), &PORTS, Outputs::at(7), &[]);
        assert!(called.gone.is_none() && called.errors.is_empty() && called.made.sent.is_empty());
    }

    #[test]
    fn a_delay_follows_the_computation() {
        let mut stage = Stage::new("s".into(), &PORTS);
        // ready, start, done -> ready.
        let cases = [
            (20, 20, 20, 20),
            (20, 25, 30, 30),
            (45, 25, 30, 50),
            (7, Nanos::MIN, Nanos::MIN, 7),
        ];
        for (hop, (ready, start, done, expected)) in (0..).zip(cases) {
            let mut sent = message(0);
            sent.header.ready = ready;
            stage.stamp(PortId(1), &mut sent, 3, start, done);
            assert_eq!((sent.header.ready, sent.header.hop), (expected, hop));
            let traced = sent.header.trace.last().unwrap();
            assert_eq!((&*traced.node, traced.input, traced.start), ("s", 3, start));
            assert_eq!((traced.done, traced.ready), (done, expected));
        }
        assert_eq!((stage.hops, stage.books.outputs["two"].total()), (vec![0, 4], 4));
    }

    #[test]
    fn words_of_an_error_are_few_and_plain() {
        let error: Error = "one\ntwo\x1b[31m\tthree".into();
        assert_eq!(words_of(&error), "one\ntwo [31m three");
        let long: Error = "é".repeat(5000).into();
        assert_eq!(
            words_of(&long).chars().filter(|c| *c == 'é').count(),
            REPORTED_CHARACTERS
        );
        assert!(words_of(&long).ends_with("… (10000 bytes)"));
    }
}
