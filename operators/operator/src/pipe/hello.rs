//! What a program says of itself first.

use std::collections::BTreeMap;
use std::sync::Mutex;

use arrow_array::UInt32Array;
use arrow_buffer::Buffer;
use realo_schemas::PayloadType;
use serde::{Deserialize, Serialize};

use super::VERSION;
use super::row::{Received, Row};
use crate::config::ConfigError;
use crate::{Class, KnownMap, Port, Queue, Registration, Role, Side};

/// Ports of one side that a program may declare.
const MOST_PORTS: usize = 64;

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PortWords {
    name: String,
    types: Vec<String>,
    #[serde(default)]
    about: String,
    #[serde(default = "all")]
    queue: String,
    #[serde(default = "data")]
    class: String,
    #[serde(default = "yes")]
    required: bool,
    #[serde(default)]
    join: Option<String>,
    #[serde(default)]
    accounts: bool,
    #[serde(default)]
    lane: Option<Side>,
    #[serde(default)]
    wire: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    map: Option<KnownMap>,
}

fn all() -> String {
    "all".into()
}

fn data() -> String {
    "data".into()
}

fn yes() -> bool {
    true
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Ports {
    /// `operator`, `source` or `sink`.
    #[serde(default = "operator", skip_serializing_if = "is_operator")]
    role: String,
    inputs: Vec<PortWords>,
    outputs: Vec<PortWords>,
}

fn operator() -> String {
    role_word(Role::Operator).into()
}

fn is_operator(word: &String) -> bool {
    *word == operator()
}

/// The word of a role that a program may have; empty of one that it may not.
fn role_word(role: Role) -> &'static str {
    match role {
        Role::Operator => "operator",
        Role::Source => "source",
        Role::Sink => "sink",
        Role::Gateway => "",
    }
}

/// How frames of a program travel that has no memory to share.
const PIPE: &str = "pipe";
/// How big frames of a program travel that has.
const MEMFD: &str = "memfd";

/// What a program says of itself.
#[derive(Clone, Copy)]
pub struct Hello {
    /// What it hosts.
    pub registration: &'static Registration,
    /// Whether big frames go through shared memory, both ways.
    pub shares: bool,
}

/// The first frame of a program that hosts a stage, in parts. `maps`: what is known of the BEV maps of ports.
///
/// # Errors
/// What Arrow cannot write.
pub fn write(registration: &Registration, maps: &[(&str, KnownMap)], shares: bool) -> Result<Vec<Buffer>, String> {
    let words = |port: &Port| {
        let map = maps.iter().find(|(name, _)| *name == port.name);
        PortWords {
            map: map.map(|(_, map)| map.clone()),
            ..PortWords::of(port)
        }
    };
    let ports = Ports {
        role: role_word(registration.role).into(),
        inputs: registration.inputs.iter().map(words).collect(),
        outputs: registration.outputs.iter().map(words).collect(),
    };
    let json = serde_json::to_string(&ports).map_err(|error| error.to_string())?;
    Row::default()
        .put("version", UInt32Array::from(vec![VERSION]))
        .text("name", registration.name)
        .text("memory", if shares { MEMFD } else { PIPE })
        .text("ports", &json)
        .into_parts()
}

/// The first and only frame of a program that hosts no stage, because it is given something wrong, in parts.
///
/// # Errors
/// What Arrow cannot write.
pub fn write_refusal(name: &str, reason: &str) -> Result<Vec<Buffer>, String> {
    Row::default()
        .put("version", UInt32Array::from(vec![VERSION]))
        .text("name", name)
        .text(REFUSED, reason)
        .into_parts()
}

/// The column of a reason not to host a stage.
const REFUSED: &str = "refused";

/// Why a program hosts no stage.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoHello {
    /// It is given something wrong, as it says itself.
    #[error("{0}")]
    Refused(String),
    /// Another version, or ports that cannot be.
    #[error("{0}")]
    Wrong(String),
}

impl From<String> for NoHello {
    fn from(reason: String) -> Self {
        NoHello::Wrong(reason)
    }
}

/// What the first frame of a program declares.
///
/// # Errors
/// A program that refuses what it is given; another version, or ports that cannot be.
pub fn read(bytes: Buffer) -> Result<Hello, NoHello> {
    let row = Received::from_bytes(bytes)?;
    let version = row.u32("version")?;
    if version != VERSION {
        return Err(NoHello::Wrong(format!(
            "expected version {VERSION} of the pipe protocol, found {version}: build the program against this realo"
        )));
    }
    let name = row.text("name")?;
    if name.is_empty() {
        return Err(NoHello::Wrong("expected a name, found an empty one".into()));
    }
    if let Ok(reason) = row.text(REFUSED) {
        return Err(NoHello::Refused(reason.into()));
    }
    let ports: Ports = serde_json::from_str(row.text("ports")?).map_err(|error| {
        format!(
            "the declaration of ports: {error}; correct it, or build the program against this realo where it knows a field that this \
             realo does not"
        )
    })?;
    let shares = match row.text("memory")? {
        MEMFD => true,
        PIPE => false,
        other => {
            return Err(NoHello::Wrong(format!(
                "column `memory`: expected `{MEMFD}` or `{PIPE}`, found `{other}`"
            )));
        }
    };
    let registration = register(name, ports)?;
    Ok(Hello { registration, shares })
}

/// What a program is to its graph; its ports must fit.
fn role_of(ports: &Ports) -> Result<Role, String> {
    let word = ports.role.as_str();
    let roles = [Role::Operator, Role::Source, Role::Sink];
    let role = roles.into_iter().find(|role| role_word(*role) == word);
    let role = role.ok_or_else(|| format!("role: expected `operator`, `source` or `sink`, found `{word}`"))?;
    let wrong = |expected: &str| Err(format!("a program of role `{word}`: {expected}"));
    match (role, ports.inputs.len(), ports.outputs.len()) {
        (Role::Source, 0, 0) => wrong("expected at least one output, found none"),
        (Role::Source, 0, _) | (Role::Sink, 1.., 0) => Ok(role),
        (Role::Source, n, _) => wrong(&format!("expected no input, found {n}")),
        (Role::Sink, 1.., n) => wrong(&format!("expected no output, found {n}")),
        (_, 0, _) => wrong("expected at least one input, found none; what only sends has the role `source`"),
        _ => Ok(role),
    }
}

/// Declarations live as long as the process, each distinct one once.
fn register(name: &str, ports: Ports) -> Result<&'static Registration, String> {
    static KNOWN: Mutex<BTreeMap<(String, Ports), &'static Registration>> = Mutex::new(BTreeMap::new());
    let inputs = declared(&ports.inputs, "input")?;
    let outputs = declared(&ports.outputs, "output")?;
    let role = role_of(&ports)?;
    let mut known = KNOWN.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    let registration = known.entry((name.to_string(), ports)).or_insert_with(|| {
        Box::leak(Box::new(Registration {
            name: leaked(name),
            about: "a program of its own",
            role,
            inputs: leaked_ports(inputs),
            outputs: leaked_ports(outputs),
            settings: &[],
            counters: &[],
            defaults: serde_json::Map::new,
            check: |_| Ok::<(), ConfigError>(()),
            examine: |_| Ok(()),
            maps: |_| Vec::new(),
            build: |_| Err("a program of its own cannot be built in this process".into()),
        }))
    });
    Ok(registration)
}

fn leaked(text: &str) -> &'static str {
    Box::leak(text.to_string().into_boxed_str())
}

fn leaked_ports(ports: Vec<Declared>) -> &'static [Port] {
    let types = |types: Vec<PayloadType>| -> &'static [PayloadType] { Box::leak(types.into_boxed_slice()) };
    let ports = ports.into_iter().map(|port| Port {
        name: leaked(&port.words.name),
        types: types(port.types),
        about: leaked(&port.words.about),
        queue: port.queue,
        class: port.class,
        required: port.words.required,
        join: port.words.join.as_deref().map(leaked),
        accounts: port.words.accounts,
        needed: None,
        side: port.words.lane,
        ends_early: false,
        wire: port.words.wire.as_deref().map(leaked),
        feedback: false,
        map: port.words.map.map(|map| &*Box::leak(Box::new(map))),
    });
    Box::leak(ports.collect())
}

/// A port whose words were understood.
struct Declared {
    words: PortWords,
    types: Vec<PayloadType>,
    queue: Queue,
    class: Class,
}

fn declared(ports: &[PortWords], side: &str) -> Result<Vec<Declared>, String> {
    if ports.len() > MOST_PORTS {
        return Err(format!("expected at most {MOST_PORTS} {side}s, found {}", ports.len()));
    }
    let mut found: Vec<Declared> = Vec::new();
    for words in ports {
        if words.name.is_empty() || found.iter().any(|port| port.words.name == words.name) {
            return Err(format!("{side} `{}`: expected a name of its own", words.name));
        }
        let port = words
            .understood()
            .map_err(|reason| format!("{side} `{}`: {reason}", words.name))?;
        found.push(port);
    }
    Ok(found)
}

impl PortWords {
    fn of(port: &Port) -> Self {
        PortWords {
            name: port.name.into(),
            types: port.types.iter().map(|name| name.to_string()).collect(),
            about: port.about.into(),
            queue: queue_word(port.queue).into(),
            class: class_word(port.class).into(),
            required: port.required,
            join: port.join.map(Into::into),
            accounts: port.accounts,
            lane: port.side,
            wire: port.wire.map(Into::into),
            map: port.map.cloned(),
        }
    }

    fn understood(&self) -> Result<Declared, String> {
        let types: Vec<PayloadType> = self.types.iter().map(|name| name.parse()).collect::<Result<_, _>>()?;
        if types.is_empty() {
            return Err("expected at least one payload type, found none".into());
        }
        let queues = [Queue::All, Queue::Latest];
        let queue = queues.into_iter().find(|queue| queue_word(*queue) == self.queue);
        let classes = [Class::State, Class::Data, Class::Query];
        let class = classes.into_iter().find(|class| class_word(*class) == self.class);
        Ok(Declared {
            words: self.clone(),
            types,
            queue: queue.ok_or_else(|| format!("queue: expected `all` or `latest`, found `{}`", self.queue))?,
            class: class
                .ok_or_else(|| format!("class: expected `state`, `data` or `query`, found `{}`", self.class))?,
        })
    }
}

fn queue_word(queue: Queue) -> &'static str {
    match queue {
        Queue::All => "all",
        Queue::Latest => "latest",
    }
}

fn class_word(class: Class) -> &'static str {
    match class {
        Class::State => "state",
        Class::Data => "data",
        Class::Query => "query",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn whole(parts: Result<Vec<Buffer>, String>) -> Buffer {
        Buffer::from_vec(
            parts
                .unwrap()
                .iter()
                .flat_map(|part| part.to_vec())
                .collect::<Vec<u8>>(),
        )
    }

    fn said(ports: &str) -> Result<Hello, NoHello> {
        let row = Row::default()
            .put("version", UInt32Array::from(vec![VERSION]))
            .text("name", "mine")
            .text("memory", PIPE)
            .text("ports", ports);
        read(whole(row.into_parts()))
    }

    #[test]
    fn declarations_come_back_as_they_were() {
        const PORTS: &[Port] = &[
            Port::new("ego", &[PayloadType::Boxes], "own")
                .latest()
                .joined("frame")
                .query(),
            Port::new("state", &[PayloadType::AgentState, PayloadType::Packet], "")
                .state()
                .accounting()
                .optional(),
        ];
        let registration = Registration {
            name: "mine",
            about: "",
            role: Role::Operator,
            inputs: PORTS,
            outputs: &PORTS[1..],
            settings: &[],
            counters: &[],
            defaults: serde_json::Map::new,
            check: |_| Ok(()),
            examine: |_| Ok(()),
            maps: |_| Vec::new(),
            build: |_| Err("".into()),
        };
        let hello = read(whole(write(&registration, &[], true))).unwrap();
        let back = hello.registration;
        assert!(hello.shares);
        assert_eq!(format!("{:?}", back.inputs), format!("{PORTS:?}"));
        assert_eq!((back.name, back.outputs.len()), ("mine", 1));
        let again = read(whole(write(&registration, &[], false))).unwrap();
        assert!(std::ptr::eq(back, again.registration), "a declaration is kept once");
        assert!(!again.shares);
        let map = KnownMap {
            size: [None, Some(256), Some(64)],
            by: "a.onnx, `features`".into(),
        };
        let with_map = read(whole(write(&registration, &[("ego", map.clone())], false))).unwrap();
        let found = with_map.registration.inputs;
        assert_eq!((found[0].map, found[1].map.is_none()), (Some(&map), true));
        assert_eq!(back.role, Role::Operator);
        let source = Registration {
            role: Role::Source,
            inputs: &[],
            ..registration
        };
        let back = read(whole(write(&source, &[], false))).unwrap().registration;
        assert_eq!((back.role, back.outputs.len()), (Role::Source, 1));
        let gateway = Registration {
            role: Role::Gateway,
            ..registration
        };
        let error = read(whole(write(&gateway, &[], false)))
            .map(|_| ())
            .unwrap_err()
            .to_string();
        assert!(error.contains("role: expected"), "{error}");
    }

    #[test]
    fn what_a_program_leaves_out_of_a_port_is_as_in_programs_that_do_not_know_it() {
        let old =
            r#"{"inputs": [{"name": "a", "types": ["FeatureMap"]}], "outputs": [{"name": "b", "types": ["Boxes"]}]}"#;
        let hello = said(old).unwrap().registration;
        let expected = Port::new("a", &[PayloadType::FeatureMap], "");
        assert_eq!(format!("{:?}", hello.inputs[0]), format!("{expected:?}"));
        assert!(hello.inputs[0].map.is_none() && hello.outputs[0].map.is_none());
        let new = old.replacen('}', r#", "map": {"size": [null, 256, 64], "by": "a.onnx"}}"#, 1);
        let hello = said(&new).unwrap().registration;
        let map = hello.inputs[0].map.unwrap();
        assert_eq!((map.size, map.by.as_str()), ([None, Some(256), Some(64)], "a.onnx"));
    }

    #[test]
    fn refuses_what_cannot_be_with_what_was_expected() {
        let cases = [
            (r#"{"inputs": [], "outputs": []}"#, "at least one input"),
            (r#"{"role": "radio", "inputs": [], "outputs": []}"#, "found `radio`"),
            (
                r#"{"role": "source", "inputs": [], "outputs": []}"#,
                "at least one output",
            ),
            (
                r#"{"role": "source", "inputs": [{"name": "a", "types": ["Boxes"]}], "outputs": []}"#,
                "expected no input, found 1",
            ),
            (
                r#"{"role": "sink", "inputs": [{"name": "a", "types": ["Boxes"]}], "outputs": [{"name": "b", "types": ["Boxes"]}]}"#,
                "expected no output, found 1",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": ["Boxs"]}], "outputs": []}"#,
                "`Boxs`",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": []}], "outputs": []}"#,
                "payload type",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": ["Boxes"], "queue": "some"}], "outputs": []}"#,
                "`some`",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": ["Boxes"]}, {"name": "a", "types": ["Boxes"]}], "outputs": []}"#,
                "a name of its own",
            ),
            ("nonsense", "declaration of ports"),
            (
                r#"{"inputs": [{"name": "a", "types": ["Boxes"], "requird": false}], "outputs": []}"#,
                "unknown field `requird`",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": ["Boxes"], "colour": 1}], "outputs": []}"#,
                "build the program against this realo where it knows a field that this realo does not",
            ),
            (
                r#"{"inputs": [{"name": "a", "types": ["FeatureMap"], "map": {"size": [1, 2]}}], "outputs": []}"#,
                "declaration of ports",
            ),
        ];
        for (ports, expected) in cases {
            let error = said(ports).map(|_| ()).unwrap_err().to_string();
            assert!(error.contains(expected), "{ports}: {error}");
        }
        let newer = Row::default()
            .put("version", UInt32Array::from(vec![VERSION + 1]))
            .into_parts();
        let error = read(whole(newer)).map(|_| ()).unwrap_err().to_string();
        let expected = format!("expected version {VERSION} of the pipe protocol, found {}", VERSION + 1);
        assert!(error.contains(&expected), "{error}");
        let refusal = read(whole(write_refusal("mine", "no such file"))).map(|_| ());
        assert_eq!(refusal, Err(NoHello::Refused("no such file".into())));
    }
}
