//! Virtual time by small graphs whose answer can be worked out by hand.

use std::sync::Mutex;

use realo_graph::Graph;
use realo_host::virtual_time::{self, Progress, RunError};
use realo_host::{ComputeProfile, Shared, Stages};
use realo_operator::{
    Books, Counts, Describe, Error, Operator, Outputs, Port, PortError, PortId, Registration, Registry, Settings, Sink,
    Source, StageInputs, StageOutputs,
};
use realo_schemas::{Boxes, Header, Kind, Message, Nanos, PayloadType};
use serde::{Deserialize, Serialize};

const BOXES: &[PayloadType] = &[PayloadType::Boxes];
const PERIOD: Nanos = 100;

macro_rules! describe {
    ($type:ident, $name:literal, $settings:ty, $inputs:expr, $outputs:expr) => {
        const _: () = {
            pub struct Input(pub Message);
            impl StageInputs for Input {
                const PORTS: &'static [Port] = $inputs;
                fn read(_: PortId, message: Message) -> Result<Self, PortError> {
                    Ok(Input(message))
                }
            }
            impl From<Input> for Message {
                fn from(Input(message): Input) -> Self {
                    message
                }
            }
            pub struct Output(Message);
            impl From<Message> for Output {
                fn from(message: Message) -> Self {
                    Output(message)
                }
            }
            impl StageOutputs for Output {
                const PORTS: &'static [Port] = $outputs;
                fn into_message(self) -> (PortId, Message) {
                    (PortId(0), self.0)
                }
            }
            impl Describe for $type {
                type Settings = $settings;
                type Input = Input;
                type Output = Output;
                const NAME: &'static str = $name;
                const ABOUT: &'static str = "";
            }
        };
    };
}

#[derive(Settings, Serialize, Deserialize)]
struct Sweeps {
    /// What a test needs.
    count: u64,
    /// What a test needs.
    agents: Vec<String>,
    /// What a test needs.
    fails: bool,
}
/// A sweep of every agent each period; may fail in the end.
struct Clockwork(Vec<(Nanos, Message)>, bool);
describe!(Clockwork, "clockwork", Sweeps, &[], &[Port::new("out", BOXES, "")]);
impl Source for Clockwork {
    fn build(config: Sweeps) -> Result<Self, Error> {
        let mut messages = Vec::new();
        for seq in (0..config.count).rev() {
            for agent in config.agents.iter().rev() {
                let time = seq as i64 * PERIOD;
                let header = Header::origin(&"t".into(), &agent.as_str().into(), Kind::Boxes, seq, time, time);
                messages.push((time, Message::new(header, Boxes::default())));
            }
        }
        Ok(Clockwork(messages, config.fails))
    }
    fn next(&mut self) -> Result<Option<(Nanos, Self::Output)>, Error> {
        match self.0.pop() {
            None if self.1 => Err("the disk is gone".into()),
            next => Ok(next.map(|(time, message)| (time, <Self as Describe>::Output::from(message)))),
        }
    }
    fn counts(&self) -> Counts {
        let mut counts = Counts::default();
        counts.add_named("left", self.0.len() as u64);
        counts.add_named("made", 1);
        counts
    }
}

#[derive(Settings, Serialize, Deserialize)]
struct Delayed {
    /// What a test needs.
    delay: Nanos,
}
/// Sends every message of an even number on, later.
struct Delay(Nanos);
describe!(
    Delay,
    "delay",
    Delayed,
    &[Port::new("in", BOXES, "").latest()],
    &[Port::new("out", BOXES, "")]
);
impl Operator for Delay {
    fn build(config: Delayed) -> Result<Self, Error> {
        Ok(Delay(config.delay))
    }
    fn on_input(&mut self, input: Self::Input, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        let mut message = Message::from(input);
        if message.header.seq != 77 {
            message.header.ready = out.now() + self.0;
            out.send(<Self as Describe>::Output::from(message));
        }
        Ok(())
    }
}

#[derive(Settings, Serialize, Deserialize)]
struct Nothing {}
/// Sends each message on 30 ns later; takes no message number 3.
#[derive(Default)]
struct Echo(Option<Message>);
describe!(
    Echo,
    "echo",
    Nothing,
    &[Port::new("in", BOXES, "")],
    &[Port::new("echoed", BOXES, "")]
);
impl Operator for Echo {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Echo::default())
    }
    fn on_input(&mut self, input: Self::Input, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        let message = Message::from(input);
        if message.header.seq == 3 {
            return Err("three is not taken".into());
        }
        self.0 = Some(message);
        out.wake_at(out.now() + 30);
        Ok(())
    }
    fn on_wake(&mut self, _: Nanos, out: &mut Outputs<Self::Output>) -> Result<(), Error> {
        if let Some(message) = self.0.take() {
            out.send(<Self as Describe>::Output::from(message));
        }
        Ok(())
    }
}

/// What the sink of [`sinks_are_called_in_order_and_end_with_the_books`] was given.
static GIVEN: Mutex<Vec<String>> = Mutex::new(Vec::new());
struct Notes;
describe!(Notes, "notes", Nothing, &[Port::new("in", BOXES, "")], &[]);
impl Sink for Notes {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Notes)
    }
    fn accept(&mut self, input: Self::Input) -> Result<(), Error> {
        let message = Message::from(input);
        if message.header.agent == "full".into() {
            return Err("no space left".into());
        }
        GIVEN
            .lock()
            .unwrap()
            .push(format!("{} at {}", message.header.seq, message.header.ready));
        Ok(())
    }
    fn finish(&mut self, books: &Books) -> Result<(), Error> {
        let names: Vec<&str> = books.nodes.keys().map(String::as_str).collect();
        GIVEN.lock().unwrap().push(names.join(" "));
        Ok(())
    }
}

static REGISTRY: Registry = Registry(&[
    Registration::source::<Clockwork>(),
    Registration::operator::<Delay>(),
    Registration::operator::<Echo>(),
    Registration::sink::<Notes>(),
]);

fn stage(word: &str, name: &str) -> &'static Registration {
    REGISTRY.find(word, name).expect("registered")
}

type Sent = Vec<(String, String, u64, Nanos)>;

fn profile(nanos: std::collections::BTreeMap<String, Nanos>) -> ComputeProfile {
    ComputeProfile {
        nanos,
        ..ComputeProfile::default()
    }
}

fn simulate(stages: &Stages, compute: &[(&str, Nanos)]) -> Result<(Sent, Books), RunError> {
    let nanos = compute.iter().map(|(key, nanos)| (key.to_string(), *nanos)).collect();
    let mut sent = Vec::new();
    let observer = Box::new(|stage: &str, output: &str, message: &Message| {
        assert_eq!(output == "echoed", stage.contains("echo"));
        let header = &message.header;
        sent.push((stage.into(), header.agent.to_string(), header.seq, header.ready));
    });
    let books = virtual_time::run(stages, &profile(nanos), Some(observer))?;
    Ok((sent, books))
}

fn failure(stages: &Stages, compute: &[(&str, Nanos)]) -> String {
    match simulate(stages, compute) {
        Ok(_) => panic!("the run should fail"),
        Err(error) => error.to_string(),
    }
}

fn source(args: &[&str]) -> Stages {
    let mut stages = Stages::default();
    let args = args.iter().map(|arg| arg.to_string()).collect();
    stages.add("source", stage("node", "clockwork"), args, &[]).unwrap();
    stages
}

/// source > delay > echo.
fn chain(count: u64, agents: &str, delay: &str) -> Stages {
    let mut stages = source(&[&format!("count={count}"), &format!("agents={agents}")]);
    let wire = [("in", "source", "out")];
    stages
        .add("delay", stage("operator", "delay"), vec![delay.into()], &wire)
        .unwrap();
    stages
        .add("echo", stage("operator", "echo"), vec![], &[("in", "delay", "out")])
        .unwrap();
    stages
}

fn of<'a>(sent: &'a Sent, stage: &str) -> Vec<(&'a str, u64, Nanos)> {
    let of_stage = sent.iter().filter(|sent| sent.0 == stage);
    of_stage
        .map(|(_, agent, seq, ready)| (agent.as_str(), *seq, *ready))
        .collect()
}

#[test]
fn delays_follow_computation_and_wakes_fire_on_time() {
    let (sent, books) = simulate(&chain(3, "a", "delay=41"), &[("delay", 7)]).unwrap();
    assert_eq!(of(&sent, "source"), [("a", 0, 0), ("a", 1, 100), ("a", 2, 200)]);
    assert_eq!(of(&sent, "delay"), [("a", 0, 48), ("a", 1, 148), ("a", 2, 248)]);
    assert_eq!(of(&sent, "echo"), [("a", 0, 78), ("a", 1, 178), ("a", 2, 278)]);
    assert_eq!(books.nodes["delay"].compute["in > out"].quantile(0.5), Some(7));
    assert_eq!(books.nodes["echo"].inputs["in"].received.total(), 3);
    let counted = &books.nodes["source"].counters;
    assert_eq!((counted.get("left"), counted["made"]), (None, 1));
    assert_eq!(books.nodes["source"].late.count(), 0);
}

#[test]
fn a_call_is_charged_by_what_triggers_it_and_what_it_sends() {
    // Echo takes its input without an answer and answers when it is woken, 30 later.
    let compute = [
        ("delay", 2),
        ("delay.in > out", 9),
        ("echo.in", 10),
        ("echo.wake > echoed", 5),
        ("echo", 1000),
    ];
    let (sent, books) = simulate(&chain(1, "a", "delay=0"), &compute).unwrap();
    assert_eq!(of(&sent, "delay"), [("a", 0, 9)]);
    // In at 9, asks for 39, is busy until 19, woken at 39, done at 44.
    assert_eq!(of(&sent, "echo"), [("a", 0, 44)]);
    let charged = |stage: &str| {
        let compute = books.nodes[stage].compute.iter();
        compute
            .map(|(trigger, took)| (trigger.clone(), took.max().unwrap()))
            .collect::<Vec<_>>()
    };
    assert_eq!(charged("delay"), [("in > out".to_string(), 9)]);
    assert_eq!(
        charged("echo"),
        [("in".to_string(), 10), ("wake > echoed".to_string(), 5)]
    );

    // A stage that is charged for what it receives, whatever it sends; one that is busy is woken when it is done.
    let (sent, _) = simulate(
        &chain(1, "a", "delay=0"),
        &[("delay.in", 4), ("echo.in", 50), ("echo.wake", 6)],
    )
    .unwrap();
    assert_eq!(of(&sent, "delay"), [("a", 0, 4)]);
    assert_eq!(of(&sent, "echo"), [("a", 0, 60)]);
}

#[test]
fn a_busy_stage_keeps_the_newest_and_counts_what_it_passes_over() {
    let (sent, books) = simulate(&chain(6, "a", "delay=0"), &[("delay", 250)]).unwrap();
    // Busy 0–250 with 0 (1 is replaced by 2), 250–500 with 2 (3 is replaced by 4), 500– with 4 (5 waits: it came at 500).
    assert_eq!(
        of(&sent, "delay"),
        [("a", 0, 250), ("a", 2, 500), ("a", 4, 750), ("a", 5, 1000)]
    );
    assert_eq!(books.nodes["delay"].inputs["in"].skipped.total(), 2);
}

#[test]
fn every_agent_has_a_server_of_its_own() {
    let (sent, books) = simulate(&chain(2, "a,b", "delay=0"), &[("delay", 90)]).unwrap();
    assert_eq!(
        of(&sent, "delay"),
        [("a", 0, 90), ("b", 0, 90), ("a", 1, 190), ("b", 1, 190)]
    );
    assert_eq!(books.nodes["delay"].inputs["in"].skipped.total(), 0);
}

#[test]
fn an_error_in_one_message_is_counted_and_the_run_goes_on() {
    let (sent, books) = simulate(&chain(5, "a", "delay=0"), &[]).unwrap();
    let numbers: Vec<u64> = of(&sent, "echo").iter().map(|sent| sent.1).collect();
    assert_eq!(numbers, [0, 1, 2, 4]);
    assert_eq!(books.nodes["echo"].errors, 1);
}

#[test]
fn what_cannot_go_on_is_named() {
    let error = failure(&chain(2000, "a", "delay=0"), &[("echo", 1_000_000)]);
    assert!(error.contains("`echo`") && error.contains("`in`"), "{error}");
    let error = failure(&chain(1, "a", "dealy=3"), &[]);
    assert!(
        error.contains("`delay`") && error.contains("did you mean `delay`"),
        "{error}"
    );
    let error = failure(&source(&["count=2", "agents=a", "fails=true"]), &[]);
    assert_eq!(error, "node `source` failed: the disk is gone");
    let error = failure(&source(&["count=0", "fails=true"]), &[]);
    assert_eq!(error, "node `source` failed: the disk is gone");
    let mut stages = source(&["count=1", "agents=full"]);
    stages
        .add("notes", stage("node", "notes"), vec![], &[("in", "source", "out")])
        .unwrap();
    assert_eq!(failure(&stages, &[]), "node `notes` failed: no space left");
}

#[test]
fn sinks_are_called_in_order_and_end_with_the_books() {
    let mut stages = chain(2, "a", "delay=200");
    stages
        .add("notes", stage("node", "notes"), vec![], &[("in", "delay", "out")])
        .unwrap();
    let books = virtual_time::run(&stages, &ComputeProfile::default(), None).unwrap();
    let given = std::mem::take(&mut *GIVEN.lock().unwrap());
    assert_eq!(given, ["0 at 200", "1 at 300", "delay echo notes source"]);
    assert_eq!(books.nodes.len(), 4);
}

#[test]
fn a_source_that_has_nothing_ends_the_run() {
    let (sent, books) = simulate(&chain(0, "a", "delay=0"), &[]).unwrap();
    assert!(sent.is_empty() && books.nodes.len() == 3);
}

#[test]
fn a_graph_gives_the_same_in_one_process_or_in_many() {
    let folder = tempfile::tempdir().unwrap();
    let lane = "
module: { name: lane, inputs: [in], outputs: [echoed] }
nodes:
  - { id: delay, path: ../bin/realo, args: operator delay delay=41, inputs: { in: _mod/in }, outputs: [out] }
  - { id: inner, module: echo.yml, inputs: { in: delay/out } }
";
    let echo = "
module: { name: echo, inputs: [in], outputs: [echoed] }
nodes:
  - { id: echo, path: ../bin/realo, args: operator echo, inputs: { in: _mod/in }, outputs: [echoed] }
";
    std::fs::create_dir_all(folder.path().join("modules")).unwrap();
    for (name, text) in [("lane.yml", lane), ("echo.yml", echo)] {
        std::fs::write(folder.path().join("modules").join(name), text).unwrap();
    }
    let run = |lane: &str| {
        let text = format!(
            "nodes: [{{ id: last, path: bin/realo, args: operator delay, inputs: {{ in: lane/echoed }}, outputs: [out] }}, \
             {{ id: source, path: bin/realo, args: 'node clockwork count=3 agents=a', outputs: [out] }}, \
             {{ id: lane, {lane}, inputs: {{ in: source/out }} }}]"
        );
        let graph = Graph::parse(&text, &folder.path().join("g.yml"))
            .unwrap()
            .expand()
            .unwrap();
        let stages = Stages::of(&graph, &REGISTRY).unwrap();
        simulate(&stages, &[("lane.delay", 7), ("lane.inner.echo.wake", 3)]).unwrap()
    };
    let many = run("module: modules/lane.yml");
    let one = run("path: bin/realo, args: host modules/lane.yml, outputs: [echoed]");
    assert_eq!(of(&one.0, "lane.inner.echo")[..2], [("a", 0, 81), ("a", 1, 181)]);
    assert_eq!(of(&one.0, "last").len(), 3);
    assert_eq!(one, many);
}

/// source > echo > delay > last, in which only the delay differs from run to run.
fn late_delay(agents: &str, delay: &str) -> Stages {
    let mut stages = source(&["count=6", &format!("agents={agents}")]);
    let mut add = |id, role, name, args: &[&str], from| {
        let args = args.iter().map(|arg| arg.to_string()).collect();
        stages.add(id, stage(role, name), args, &[from]).unwrap();
    };
    add("echo", "operator", "echo", &[], ("in", "source", "out"));
    add("delay", "operator", "delay", &[delay], ("in", "echo", "echoed"));
    add("last", "operator", "echo", &[], ("in", "delay", "out"));
    stages
}

/// The books of a run, and when its events were.
fn watched(run: impl FnOnce(&mut dyn FnMut(Progress)) -> Result<Books, RunError>) -> (Books, Vec<Progress>) {
    let mut times = Vec::new();
    let books = run(&mut |progress| times.push(progress)).unwrap();
    (books, times)
}

#[test]
fn runs_that_share_calls_give_the_same_as_runs_by_themselves() {
    let compute = profile([("echo".to_string(), 7), ("delay".to_string(), 250)].into());
    let delays = ["delay=0", "delay=41", "delay=300", "delay=41"];
    let all = delays.map(|delay| late_delay("a,b", delay));
    let alone = all
        .each_ref()
        .map(|stages| watched(|watch| virtual_time::run_watched(stages, &compute, None, watch)));
    assert!(alone[0].1 != alone[1].1 && alone[0].0.nodes["echo"].errors == 2);
    // By bytes of memory: stages that computed and that took their calls.
    for (limit, counts, too_large) in [(1 << 20, (8, 8), 0), (0, (16, 0), 4)] {
        let shared = Shared::new(limit);
        let outlines = all.each_ref().map(|stages| shared.outline(stages, &compute));
        let after = shared.plan(&outlines);
        let after: Vec<Vec<usize>> = after.into_iter().map(|before| before.into_iter().collect()).collect();
        assert_eq!(after, [vec![], vec![0], vec![0], vec![0, 1]]);
        for ((stages, outline), alone) in all.iter().zip(&outlines).zip(&alone) {
            let ran = watched(|watch| virtual_time::run_shared(stages, &compute, (&shared, outline), watch));
            assert_eq!(ran, *alone);
        }
        let sharing = shared.sharing();
        assert_eq!((sharing.computed, sharing.repeated), counts, "{limit} bytes");
        assert_eq!(sharing.too_large.len(), too_large, "{sharing:?}");
        assert!(sharing.held_most <= limit);
    }
}

#[test]
fn nothing_is_taken_from_a_run_that_failed() {
    let with_notes = |delay| {
        let mut stages = late_delay("full", delay);
        let wire = [("in", "delay", "out")];
        stages.add("notes", stage("node", "notes"), vec![], &wire).unwrap();
        stages
    };
    let compute = ComputeProfile::default();
    let shared = Shared::new(1 << 20);
    let all = ["delay=0", "delay=1"].map(with_notes);
    let outlines = all.each_ref().map(|stages| shared.outline(stages, &compute));
    shared.plan(&outlines);
    for (stages, outline) in all.iter().zip(&outlines) {
        let error = virtual_time::run_shared(stages, &compute, (&shared, outline), |_| {}).unwrap_err();
        assert_eq!(error.to_string(), "node `notes` failed: no space left");
    }
    assert_eq!((shared.sharing().computed, shared.sharing().repeated), (8, 0));
}
