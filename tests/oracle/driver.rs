//! The shipped operators in virtual time, and what they say of themselves.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;

use realo_host::{ComputeProfile, Stages, virtual_time};
use realo_operator::{
    Books, Describe, Error, Inputs, NoInput, NoOutput, Outputs, Registration, Settings, Sink, Source,
};
use realo_results::{Ledger, LinkBooks, link_books};
use realo_schemas::report::Fated;
use realo_schemas::{
    AgentState, Box3, Boxes, Header, Kind, Message, Nanos, Payload, PointCloud, Pose, PoseStatus, Selection,
};
use serde::{Deserialize, Serialize};

use crate::account::{Account, Answer, Fusion, Id, Line, Place};
use crate::world::{EGO, Said, Spot, Strategy, World, content};

/// Settings of [`Log`].
#[derive(Settings, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LogSettings {
    /// Seed of the world.
    seed: u64,
}

/// What the log has.
#[derive(Outputs)]
enum Output {
    /// The ego's boxes.
    EgoBoxes(Header, Boxes),
    /// Boxes.
    Boxes(Header, Boxes),
    /// The ego's states.
    EgoStates(Header, AgentState),
    /// States.
    States(Header, AgentState),
    /// The ego's clouds.
    EgoClouds(Header, PointCloud),
    /// Clouds.
    Clouds(Header, PointCloud),
}

/// Plays the log of a world.
#[derive(Describe)]
#[stage(settings = LogSettings, input = NoInput)]
struct Log(std::vec::IntoIter<(Nanos, Output)>);

impl Source for Log {
    fn build(settings: LogSettings) -> Result<Self, Error> {
        let world = World::of(settings.seed);
        let sweeps = world.sweeps.iter().map(|said| match world.strategy {
            Strategy::Late => output(said, [Output::EgoBoxes, Output::Boxes], detections(said)),
            Strategy::Early | Strategy::Projected => output(said, [Output::EgoClouds, Output::Clouds], cloud(said)),
        });
        let fixes = world.states.iter();
        let fixes = fixes.map(|said| output(said, [Output::EgoStates, Output::States], state(said)));
        let mut all: Vec<_> = sweeps.chain(fixes).collect();
        all.sort_by_key(|(ready, _)| *ready);
        Ok(Log(all.into_iter()))
    }

    fn next(&mut self) -> Result<Option<(Nanos, Output)>, Error> {
        Ok(self.0.next())
    }
}

fn output<P>(
    said: &Said,
    [ego, other]: [fn(Header, P) -> Output; 2],
    (header, payload): (Header, P),
) -> (Nanos, Output) {
    let of = if said.agent == EGO { ego } else { other };
    (said.ready, of(header, payload))
}

fn pose(spot: Spot) -> Pose {
    let [x, y] = spot.at;
    let half = spot.yaw / 2.0;
    Pose::from_parts([x, y, 0.0], [0.0, 0.0, half.sin(), half.cos()]).expect("the numbers are finite")
}

fn header(said: &Said, kind: Kind) -> Header {
    let agent = said.agent.as_str().into();
    Header::origin(&"oracle".into(), &agent, kind, said.seq, said.stamp, said.ready)
}

fn detections(said: &Said) -> (Header, Boxes) {
    let mut header = header(said, Kind::Boxes);
    header.pose = said.spot.map(pose);
    let boxes = (0..said.count).map(|place| Box3 {
        center: [content(place)[0], content(place)[1], 1.0],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: said.tracked.then_some([1.0, 0.0, 0.0]),
        class: "Car".into(),
        score: 0.5,
        track: said.tracked.then_some(place as u64),
        covariance: None,
    });
    (header, Boxes(boxes.collect()))
}

fn cloud(said: &Said) -> (Header, PointCloud) {
    let mut header = header(said, Kind::Points);
    header.pose = said.spot.map(pose);
    let axis = |axis: usize| {
        (0..said.count)
            .map(|place| content(place)[axis] as f32)
            .collect::<Vec<f32>>()
    };
    let n = said.count;
    let cloud = PointCloud::new(axis(0), axis(1), vec![1f32; n], vec![9; n], vec![0; n], vec![0u16; n]);
    (header, cloud.expect("columns are of one length"))
}

fn state(said: &Said) -> (Header, AgentState) {
    let state = AgentState {
        map_from_body: pose(said.spot.expect("a state is somewhere")).map_from_frame,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Recorded,
    };
    (header(said, Kind::AgentState), state)
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

/// Nothing is to be set.
#[derive(Settings, Serialize, Deserialize)]
struct Nothing {}

/// What is closed with.
#[derive(Inputs)]
enum Input {
    /// Anything that was fused.
    #[port(any_of(Boxes, PointCloud))]
    Fused(#[allow(dead_code)] Message),
}

impl Describe for Closing {
    type Settings = Nothing;
    type Input = Input;
    type Output = NoOutput;
    const NAME: &'static str = "closing";
    const ABOUT: &'static str = "closes the books";
}

impl Sink for Closing {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Closing::default())
    }

    fn accept(&mut self, _: Input) -> Result<(), Error> {
        Ok(())
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
static PROJECTOR: Registration = Registration::operator::<realo_projector::Projector>();
static LINK: Registration = Registration::operator::<realo_link::Link>();
static DECODER: Registration = Registration::operator::<realo_transmission::TransmissionDecoder>();
static BANK: Registration = Registration::operator::<realo_feature_bank::FeatureBank>();
static BOX_FUSION: Registration = Registration::operator::<realo_fusion_boxes::FusionBoxes>();
static POINT_FUSION: Registration = Registration::operator::<realo_fusion_points::FusionPoints>();
static CLOSING: Registration = Registration::sink::<Closing>();
static RESULTS: Registration = Registration::sink::<realo_results::Results>();

/// Late fusion from the detections on, or early fusion from the sweeps on; `results`: a folder for the node of that name,
/// where it is to run as well.
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
        format!("patience_ms={}", world.patience_ms),
        format!("offline={}", world.offline),
        format!("ahead_ms={}", world.ahead_ms),
    ];
    let limit = world
        .max_collaborators
        .map_or("null".to_string(), |limit| limit.to_string());
    let mut fusion = vec![format!("max_collaborators={limit}")];
    let mut stages = Stages::default();
    let mut add = |id: &str, node, args: Vec<String>, inputs: &[_]| stages.add(id, node, args, inputs);
    add("log", &LOG, vec![format!("seed={seed}")], &[])?;
    let (ego, others) = match world.strategy {
        Strategy::Late => {
            add("ego-nms", &NMS, vec![], &[("proposals", "log", "ego_boxes")])?;
            add("nms", &NMS, vec![], &[("proposals", "log", "boxes")])?;
            (("ego", "ego-nms", "boxes"), ("messages", "nms", "boxes"))
        }
        Strategy::Early | Strategy::Projected => {
            fusion.push(format!("as_sent={}", world.as_sent));
            (("ego", "log", "ego_clouds"), ("messages", "log", "clouds"))
        }
    };
    let states = [("ego_state", "log", "ego_states"), ("states", "log", "states")];
    if world.strategy == Strategy::Projected {
        // As in `dataflows/modules/v2x.yml` and `points.yml`.
        add("ego-sender", &ENCODER, vec![], &[("messages", "log", "ego_states")])?;
        add("state-sender", &ENCODER, vec![], &[("messages", "log", "states")])?;
        let packets = [
            ("ego", "ego-sender", "state_packets"),
            ("others", "state-sender", "state_packets"),
        ];
        add("state-link", &LINK, link.clone(), &[&packets[..], &states].concat())?;
        add(
            "state-receiver",
            &DECODER,
            vec![],
            &[("packets", "state-link", "to_others")],
        )?;
        let known = ("state", "state-receiver", "states");
        // The time that is charged to the encoder is the projector's.
        let (_, log, clouds) = others;
        let clouds = ("clouds", log, clouds);
        add("encoder", &PROJECTOR, vec!["project=sender".into()], &[clouds, known])?;
        add("packer", &ENCODER, vec![], &[("messages", "encoder", "projected")])?;
    } else {
        add("encoder", &ENCODER, vec![], &[others])?;
    }
    let packer = match world.strategy {
        Strategy::Projected => "packer",
        Strategy::Late | Strategy::Early => "encoder",
    };
    let packets = [("others", packer, "packets")];
    add("link", &LINK, link, &[&packets[..], &states].concat())?;
    let max_bytes = vec![format!("max_bytes={}", world.max_bytes)];
    add("decoder", &DECODER, max_bytes, &[("packets", "link", "to_ego")])?;
    add("bank", &BANK, bank, &[ego, ("others", "decoder", "messages")])?;
    let (operator, fused) = match world.strategy {
        Strategy::Late => (&BOX_FUSION, "proposals"),
        Strategy::Early | Strategy::Projected => (&POINT_FUSION, "clouds"),
    };
    add("fusion", operator, fusion, &[ego, ("selections", "bank", "selections")])?;
    add("closing", &CLOSING, vec![], &[("fused", "fusion", fused)])?;
    if results {
        let args = vec![format!("out={}", folder.join("results").display())];
        add("results", &RESULTS, args, &[("boxes", "fusion", fused)])?;
    }
    Ok(stages)
}

/// Runs a world. `folder` is for files; with `results` the node `results` runs as well and must say the same.
///
/// # Errors
/// What failed, or does not fit together.
pub fn account(seed: u64, world: &World, folder: &Path, results: bool) -> Result<Account, String> {
    // That node takes boxes alone.
    let results = results && world.strategy == Strategy::Late;
    let stages = stages(seed, world, folder, results)?;
    let mut account = Account::default();
    let mut asked: BTreeMap<u64, Nanos> = BTreeMap::new();
    let compute = ComputeProfile {
        nanos: world.compute.clone(),
        ..ComputeProfile::default()
    };
    let observer = |node: &str, output: &str, message: &Message| match (node, output) {
        ("ego-nms", "boxes") | ("log", "ego_clouds") => {
            asked.insert(message.header.seq, message.header.ready);
        }
        ("bank", "selections") => account.selections.push(answer(message, &asked)),
        ("fusion", _) => account.fusions.push(fusion(message)),
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
        for (kind, books) in kinds {
            account.channels.insert(format!("{name}.{kind}"), line(&books)?);
        }
    }
    let encoder = &books.nodes["encoder"];
    account.no_ego_state = encoder.counters.get("no_ego_state").copied().unwrap_or(0);
    account.errors = encoder.errors;
    for stage in world.stages() {
        let inputs = books.nodes[stage].inputs.values();
        let passed = inputs.map(|input| input.skipped.total() + input.unjoined.total()).sum();
        account.skipped.insert(stage.into(), passed);
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
    let content = match &message.payload {
        Payload::Boxes(Boxes(list)) => list
            .iter()
            .map(|object| Place([object.center[0], object.center[1]]))
            .collect(),
        Payload::PointCloud(cloud) => {
            let points = cloud.x.iter().zip(cloud.y.iter());
            points.map(|(x, y)| Place([f64::from(*x), f64::from(*y)])).collect()
        }
        _ => panic!("neither boxes nor points: {}", message.header),
    };
    Fusion {
        query: message.header.seq,
        ready: message.header.ready,
        content,
        used: Vec::new(),
    }
}

fn line(books: &LinkBooks) -> Result<Line, String> {
    let Some(accounted) = books.accounted else {
        return Ok(Line {
            out_of_range: books.out_of_range,
            sent: books.sent,
            bytes: books.bytes,
            duplicated: books.duplicated,
            lost: books.lost,
            ..Line::default()
        });
    };
    if accounted.unaccounted != 0 {
        return Err(format!("the terms do not add up: {books:?}"));
    }
    Ok(Line {
        accounted: true,
        out_of_range: books.out_of_range,
        sent: books.sent,
        bytes: books.bytes,
        duplicated: books.duplicated,
        used: accounted.fates.used,
        skipped: accounted.fates.skipped,
        over_limit: accounted.fates.over_limit,
        distrusted: accounted.fates.distrusted,
        stale: accounted.fates.stale,
        superseded: accounted.fates.superseded,
        lost: books.lost,
        rejected: accounted.fates.rejected,
        in_flight: accounted.fates.in_flight,
    })
}
