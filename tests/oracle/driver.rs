//! The shipped operators in virtual time, and what they say of themselves.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;

use realo_host::{ComputeProfile, Stages, virtual_time};
use realo_operator::{Argument, Books, Describe, Error, Port, PortId, Registration, Sink, Source, wrong_port};
use realo_results::{Ledger, LinkBooks, link_books};
use realo_schemas::report::Fated;
use realo_schemas::{
    Box3, Boxes, EgoState, Header, Kind, Message, Nanos, Payload, PayloadType, Pose, PoseStatus, Selection,
};
use serde::{Deserialize, Serialize};

use crate::account::{Account, Answer, Fusion, Id, Line};
use crate::world::{EGO, Fix, STAGES, Sweep, World};

const BOXES: &[PayloadType] = &[PayloadType::Boxes];
const STATES: &[PayloadType] = &[PayloadType::EgoState];

/// Settings of [`Log`].
#[derive(Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LogConfig {
    seed: u64,
}

/// Plays the log of a world.
struct Log(std::vec::IntoIter<(Nanos, PortId, Message)>);

impl Describe for Log {
    type Config = LogConfig;
    const NAME: &'static str = "log";
    const ABOUT: &'static str = "plays the log of a world";
    const ARGUMENTS: &'static [Argument] = &[Argument {
        name: "seed",
        about: "seed of the world",
    }];
    const INPUTS: &'static [Port] = &[];
    const OUTPUTS: &'static [Port] = &[
        Port::new("ego_boxes", BOXES, ""),
        Port::new("boxes", BOXES, ""),
        Port::new("ego_states", STATES, ""),
        Port::new("states", STATES, ""),
    ];
}

impl Source for Log {
    fn new(config: LogConfig) -> Result<Self, Error> {
        let world = World::of(config.seed);
        let port = |agent: &str, ego: usize| PortId(if agent == EGO { ego } else { ego + 1 });
        let sweeps = world
            .sweeps
            .iter()
            .map(|sweep| (sweep.ready, port(&sweep.agent, 0), detections(sweep)));
        let fixes = world
            .fixes
            .iter()
            .map(|fix| (fix.ready, port(&fix.agent, 2), state(fix)));
        let mut all: Vec<_> = sweeps.chain(fixes).collect();
        all.sort_by_key(|(ready, ..)| *ready);
        Ok(Log(all.into_iter()))
    }

    fn next(&mut self) -> Result<Option<(Nanos, PortId, Message)>, Error> {
        Ok(self.0.next())
    }
}

fn pose(at: [f64; 2]) -> Pose {
    Pose::from_parts([at[0], at[1], 0.0], [0.0, 0.0, 0.0, 1.0]).expect("the numbers are finite")
}

fn detections(sweep: &Sweep) -> Message {
    let Sweep {
        agent,
        seq,
        stamp,
        ready,
        boxes,
        tracked,
        posed,
    } = sweep;
    let mut header = Header::origin(
        &"oracle".into(),
        &agent.as_str().into(),
        Kind::Boxes,
        *seq,
        *stamp,
        *ready,
    );
    header.pose = posed.then(|| pose([1.0, 2.0]));
    let boxes = (0..*boxes).map(|place| Box3 {
        // Far enough apart that none suppresses another.
        center: [10.0 * place as f64, 0.0, 1.0],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: tracked.then_some([1.0, 0.0, 0.0]),
        class: "Car".into(),
        score: 0.5,
        track: tracked.then_some(place as u64),
        covariance: None,
    });
    Message::new(header, Boxes(boxes.collect()))
}

fn state(fix: &Fix) -> Message {
    let agent = fix.agent.as_str().into();
    let header = Header::origin(&"oracle".into(), &agent, Kind::EgoState, fix.seq, fix.stamp, fix.ready);
    let state = EgoState {
        map_from_body: pose(fix.at).map_from_frame,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    Message::new(header, state)
}

thread_local! {
    /// What the last run of this thread closed with.
    static CLOSED: RefCell<Closed> = RefCell::default();
}

/// What a run closed with.
#[derive(Default)]
struct Closed {
    links: BTreeMap<String, BTreeMap<String, LinkBooks>>,
    fates: Vec<Fated>,
}

/// Closes the books as the node `results` does, without its files.
#[derive(Default)]
struct Closing(Vec<Fated>);

#[derive(Default, Serialize, Deserialize)]
struct Nothing {}

impl Describe for Closing {
    type Config = Nothing;
    const NAME: &'static str = "closing";
    const ABOUT: &'static str = "closes the books";
    const ARGUMENTS: &'static [Argument] = &[];
    const INPUTS: &'static [Port] = &[Port::new("boxes", BOXES, "")];
    const OUTPUTS: &'static [Port] = &[];
}

impl Sink for Closing {
    fn new(_: Nothing) -> Result<Self, Error> {
        Ok(Closing::default())
    }

    fn accept(&mut self, port: PortId, _: Message) -> Result<(), Error> {
        match port {
            PortId(0) => Ok(()),
            _ => Err(wrong_port(Self::INPUTS, port)),
        }
    }

    fn fates(&mut self, fates: &[Fated]) -> Result<(), Error> {
        self.0.extend_from_slice(fates);
        Ok(())
    }

    fn finish(&mut self, books: &Books) -> Result<(), Error> {
        let mut ledger = Ledger::default();
        self.0.iter().for_each(|fated| ledger.take(fated));
        CLOSED.set(Closed {
            links: link_books(&ledger.close().0, books),
            fates: std::mem::take(&mut self.0),
        });
        Ok(())
    }
}

static LOG: Registration = Registration::source::<Log>();
static NMS: Registration = Registration::operator::<realo_nms::Nms>();
static ENCODER: Registration = Registration::operator::<realo_transmission::TransmissionEncoder>();
static LINK: Registration = Registration::operator::<realo_link::Link>();
static DECODER: Registration = Registration::operator::<realo_transmission::TransmissionDecoder>();
static BANK: Registration = Registration::operator::<realo_feature_bank::FeatureBank>();
static FUSION: Registration = Registration::operator::<realo_fusion_boxes::FusionBoxes>();
static CLOSING: Registration = Registration::sink::<Closing>();
static RESULTS: Registration = Registration::sink::<realo_results::Results>();

/// Late fusion from the detections on; `results`: a folder for the node of that name, where it is to run as well.
fn stages(seed: u64, world: &World, folder: &Path, results: bool) -> Result<Stages, String> {
    let profile = folder.join("profile.toml");
    std::fs::write(&profile, world.profile()).map_err(|error| error.to_string())?;
    let link = vec![
        format!("profile={}", profile.display()),
        format!("range_m={:?}", world.range_m),
        format!("offline={}", world.offline),
        format!("ego={EGO}"),
        format!("seed={}", world.channel_seed),
    ];
    let bank = vec![
        format!("window_ms={}", world.window_ms),
        format!("offline={}", world.offline),
        format!("ahead_ms={}", world.ahead_ms),
    ];
    let limit = world
        .max_collaborators
        .map_or("null".to_string(), |limit| limit.to_string());
    let mut stages = Stages::default();
    let mut add = |id: &str, node, args: Vec<String>, inputs: &[_]| stages.add(id, node, args, inputs);
    add("log", &LOG, vec![format!("seed={seed}")], &[])?;
    add("ego-nms", &NMS, vec![], &[("proposals", "log", "ego_boxes")])?;
    add("nms", &NMS, vec![], &[("proposals", "log", "boxes")])?;
    add("encoder", &ENCODER, vec![], &[("messages", "nms", "boxes")])?;
    let inputs = [
        ("others", "encoder", "packets"),
        ("ego_state", "log", "ego_states"),
        ("states", "log", "states"),
    ];
    add("link", &LINK, link, &inputs)?;
    add(
        "decoder",
        &DECODER,
        vec![format!("max_bytes={}", world.max_bytes)],
        &[("packets", "link", "to_ego")],
    )?;
    add(
        "bank",
        &BANK,
        bank,
        &[("ego", "ego-nms", "boxes"), ("others", "decoder", "messages")],
    )?;
    let inputs = [("ego", "ego-nms", "boxes"), ("selections", "bank", "selections")];
    add("fusion", &FUSION, vec![format!("max_collaborators={limit}")], &inputs)?;
    let boxes = [("boxes", "fusion", "proposals")];
    add("closing", &CLOSING, vec![], &boxes)?;
    if results {
        let args = vec![format!("out={}", folder.join("results").display())];
        add("results", &RESULTS, args, &boxes)?;
    }
    Ok(stages)
}

/// Runs a world. `folder` is for files; with `results` the node `results` runs as well and must say the same.
///
/// # Errors
/// What failed, or does not fit together.
pub fn account(seed: u64, world: &World, folder: &Path, results: bool) -> Result<Account, String> {
    let stages = stages(seed, world, folder, results)?;
    let mut account = Account::default();
    let mut asked: BTreeMap<u64, Nanos> = BTreeMap::new();
    let compute = ComputeProfile {
        nanos: world.compute.clone(),
    };
    let observer = |node: &str, output: &str, message: &Message| match (node, output) {
        ("ego-nms", "boxes") => {
            asked.insert(message.header.seq, message.header.ready);
        }
        ("bank", "selections") => account.selections.push(answer(message, &asked)),
        ("fusion", "proposals") => account.fusions.push(fusion(message)),
        _ => {}
    };
    let books = virtual_time::run(&stages, &compute, Some(Box::new(observer))).map_err(|error| error.to_string())?;
    let Closed { links: closed, fates } = CLOSED.take();
    for fated in fates {
        let Some(r#use) = fated.r#use else { continue };
        let fusion = account.fusions.iter_mut().find(|fusion| fusion.query == r#use.query);
        let fusion = fusion.ok_or_else(|| format!("a use in fusion {}, which did not take place", r#use.query))?;
        fusion
            .used
            .push(((fated.message.from, fated.message.seq), r#use.age_ns));
    }
    if results {
        let run = realo_results::read_run(folder.join("results")).map_err(|error| error.to_string())?;
        if run.result.links != closed {
            return Err(format!("results say {:?}\nthe books are {closed:?}", run.result.links));
        }
    }
    for (name, kinds) in closed {
        let from = name
            .strip_suffix(&format!("-{EGO}"))
            .ok_or_else(|| format!("channel {name}"))?;
        for (kind, books) in kinds {
            if kind != Kind::Boxes.as_str() {
                return Err(format!("channel {name} carries {kind}"));
            }
            account.channels.insert(from.to_string(), line(&books)?);
        }
    }
    for stage in STAGES {
        let inputs = books.nodes[stage].inputs.values();
        let passed = inputs.map(|input| input.skipped.total() + input.unjoined.total()).sum();
        account.passed_over.insert(stage.into(), passed);
    }
    Ok(account)
}

/// What the bank answered; `asked`: when each of the ego's messages was ready.
fn answer(message: &Message, asked: &BTreeMap<u64, Nanos>) -> Answer {
    let Payload::Selection(Selection { query, entries }) = &message.payload else {
        panic!("no Selection: {}", message.header);
    };
    let entries = entries.iter().map(|entry| {
        let id: Id = (entry.header.agent.to_string(), entry.header.seq);
        (id, asked[query] - entry.header.stamp)
    });
    Answer {
        query: *query,
        ready: message.header.ready,
        entries: entries.collect(),
    }
}

/// A fusion that took place; what it used the fates say.
fn fusion(message: &Message) -> Fusion {
    let Payload::Boxes(Boxes(list)) = &message.payload else {
        panic!("no boxes: {}", message.header)
    };
    Fusion {
        query: message.header.seq,
        ready: message.header.ready,
        boxes: list.len(),
        used: Vec::new(),
    }
}

fn line(books: &LinkBooks) -> Result<Line, String> {
    let accounted = books.accounted.ok_or("the channel is not accounted for")?;
    if accounted.unaccounted != 0 {
        return Err(format!("the terms do not add up: {books:?}"));
    }
    Ok(Line {
        out_of_range: books.out_of_range,
        sent: books.sent,
        bytes: books.bytes,
        duplicated: books.duplicated,
        used: accounted.fates.used,
        skipped: accounted.fates.skipped,
        over_limit: accounted.fates.over_limit,
        stale: accounted.fates.stale,
        superseded: accounted.fates.superseded,
        lost: books.lost,
        rejected: accounted.fates.rejected,
        in_flight: accounted.fates.in_flight,
    })
}
