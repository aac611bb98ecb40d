//! Virtual time by small graphs whose answer can be worked out by hand.

use std::collections::BTreeMap;

use realo_runtime::virtual_time::{RunError, run};
use realo_runtime::*;
use realo_schemas::{Boxes, Header, Kind, Message, Nanos, PayloadType};
use serde::{Deserialize, Serialize};

const BOXES: &[PayloadType] = &[PayloadType::Boxes];
const PERIOD: Nanos = 100;

macro_rules! describe {
    ($type:ty, $name:literal, $config:ty, [$($arg:literal),*], $inputs:expr, $outputs:expr) => {
        impl Describe for $type {
            type Config = $config;
            const NAME: &'static str = $name;
            const ABOUT: &'static str = "";
            const ARGUMENTS: &'static [Argument] = &[$(Argument { name: $arg, about: "" }),*];
            const INPUTS: &'static [Port] = $inputs;
            const OUTPUTS: &'static [Port] = $outputs;
        }
    };
}

#[derive(Serialize, Deserialize, Default)]
struct Sweeps {
    count: u64,
    agents: Vec<String>,
}
struct Clockwork(Vec<(Nanos, Message)>);
describe!(
    Clockwork,
    "clockwork",
    Sweeps,
    ["count", "agents"],
    &[],
    &[Port::new("out", BOXES, "")]
);
impl Source for Clockwork {
    fn new(config: Sweeps) -> Result<Self, Error> {
        let mut messages = Vec::new();
        for seq in (0..config.count).rev() {
            for agent in config.agents.iter().rev() {
                let time = seq as i64 * PERIOD;
                let header = Header::origin(&"t".into(), &agent.as_str().into(), Kind::Boxes, seq, time, time);
                messages.push((time, Message::new(header, Boxes::default())));
            }
        }
        Ok(Clockwork(messages))
    }
    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
        Ok(self.0.pop().map(|(time, message)| (time, PortId(0), message)))
    }
}

#[derive(Serialize, Deserialize, Default)]
struct Delayed {
    delay: Nanos,
}
struct Delay(Nanos);
describe!(
    Delay,
    "delay",
    Delayed,
    ["delay"],
    &[Port::new("in", BOXES, "").latest()],
    &[Port::new("out", BOXES, "")]
);
impl Operator for Delay {
    fn new(config: Delayed) -> Result<Self, Error> {
        Ok(Delay(config.delay))
    }
    fn on_input(&mut self, _: PortId, mut message: Message, out: &mut Outputs) -> Result<(), Error> {
        message.header.ready = out.now() + self.0;
        out.send(PortId(0), message);
        Ok(())
    }
}

#[derive(Serialize, Deserialize, Default)]
struct Nothing {}
#[derive(Default)]
struct Echo(Option<Message>);
describe!(
    Echo,
    "echo",
    Nothing,
    [],
    &[Port::new("in", BOXES, "")],
    &[Port::new("out", BOXES, "")]
);
impl Operator for Echo {
    fn new(_: Nothing) -> Result<Self, Error> {
        Ok(Echo::default())
    }
    fn on_input(&mut self, _: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        if message.header.seq == 3 {
            return Err("three is not taken".into());
        }
        self.0 = Some(message);
        out.wake_at(out.now() + 30);
        Ok(())
    }
    fn on_wake(&mut self, _: Nanos, out: &mut Outputs) -> Result<(), Error> {
        if let Some(message) = self.0.take() {
            out.send(PortId(0), message);
        }
        Ok(())
    }
}

static REGISTRY: &[Registration] = &[
    Registration::source::<Clockwork>(),
    Registration::operator::<Delay>(),
    Registration::operator::<Echo>(),
];

fn node(word: &str, name: &str) -> &'static Registration {
    Registry(REGISTRY).find(word, name).expect("registered")
}

type Sent = Vec<(String, String, u64, Nanos)>;

fn simulate(wiring: &Wiring, compute: &[(&str, Nanos)]) -> Result<(Sent, Books), RunError> {
    let nodes = compute
        .iter()
        .map(|(node, nanos)| (node.to_string(), *nanos))
        .collect::<BTreeMap<_, _>>();
    let mut sent = Vec::new();
    let books = run(wiring, &ComputeProfile { nodes }, &mut |node, _, message| {
        sent.push((
            node.into(),
            message.header.agent.to_string(),
            message.header.seq,
            message.header.ready,
        ));
    })?;
    Ok((sent, books))
}

fn chain(count: u64, agents: &str, delay: Nanos) -> Wiring {
    let mut wiring = Wiring::default();
    let args = vec![format!("count={count}"), format!("agents={agents}")];
    wiring.add("source", node("node", "clockwork"), args, &[]).unwrap();
    wiring
        .add(
            "delay",
            node("operator", "delay"),
            vec![format!("delay={delay}")],
            &[("in", "source", "out")],
        )
        .unwrap();
    wiring
        .add("echo", node("operator", "echo"), vec![], &[("in", "delay", "out")])
        .unwrap();
    wiring
}

fn of<'a>(sent: &'a Sent, node: &'a str) -> impl Iterator<Item = (&'a str, u64, Nanos)> {
    sent.iter()
        .filter(move |s| s.0 == node)
        .map(|s| (s.1.as_str(), s.2, s.3))
}

#[test]
fn delays_follow_computation_and_wakes_fire_on_time() {
    let (sent, books) = simulate(&chain(3, "a", 41), &[("delay", 7)]).unwrap();
    assert_eq!(
        of(&sent, "delay").collect::<Vec<_>>(),
        [("a", 0, 48), ("a", 1, 148), ("a", 2, 248)]
    );
    assert_eq!(
        of(&sent, "echo").collect::<Vec<_>>(),
        [("a", 0, 78), ("a", 1, 178), ("a", 2, 278)]
    );
    assert_eq!(books.nodes["delay"].compute.quantile(0.5), Some(7));
    assert_eq!(books.nodes["echo"].inputs["in"].received.total(), 3);
}

#[test]
fn a_busy_stage_keeps_the_newest_and_counts_what_it_passes_over() {
    let (sent, books) = simulate(&chain(6, "a", 0), &[("delay", 250)]).unwrap();
    // Busy 0–250 with 0 (1 is replaced by 2), 250–500 with 2 (3 is replaced by 4), 500– with 4 (5 waits: it came at 500).
    assert_eq!(
        of(&sent, "delay").map(|s| (s.1, s.2)).collect::<Vec<_>>(),
        [(0, 250), (2, 500), (4, 750), (5, 1000)]
    );
    assert_eq!(books.nodes["delay"].inputs["in"].skipped.total(), 2);
}

#[test]
fn every_agent_has_a_server_of_its_own() {
    let (sent, books) = simulate(&chain(2, "a,b", 0), &[("delay", 90)]).unwrap();
    assert_eq!(
        of(&sent, "delay").collect::<Vec<_>>(),
        [("a", 0, 90), ("b", 0, 90), ("a", 1, 190), ("b", 1, 190)]
    );
    assert_eq!(books.nodes["delay"].inputs["in"].skipped.total(), 0);
}

#[test]
fn an_error_in_one_message_is_counted_and_the_run_goes_on() {
    let (sent, books) = simulate(&chain(5, "a", 0), &[]).unwrap();
    assert_eq!(of(&sent, "echo").map(|s| s.1).collect::<Vec<_>>(), [0, 1, 2, 4]);
    assert_eq!(books.nodes["echo"].errors, 1);
}

#[test]
fn a_queue_that_runs_over_fails_the_run_by_name() {
    let error = simulate(&chain(2000, "a", 0), &[("echo", 1_000_000)])
        .map(|_| ())
        .unwrap_err()
        .to_string();
    assert!(error.contains("`echo`") && error.contains("`in`"), "{error}");
}

#[test]
fn a_node_that_cannot_be_built_is_named() {
    let mut wiring = chain(1, "a", 0);
    wiring.nodes[1].args = vec!["dealy=3".into()];
    let error = simulate(&wiring, &[]).map(|_| ()).unwrap_err().to_string();
    assert!(
        error.contains("`delay`") && error.contains("did you mean `delay`"),
        "{error}"
    );
}
