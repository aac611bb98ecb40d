//! What the radio makes of a link that is too slow for clouds, and what Zenoh's defaults make of it.

use std::collections::BTreeMap;
use std::fmt;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use eyre::{Result, WrapErr, bail, eyre};
use linkemu::{ADDRESSES, Ground, Link, Machines, Relay};
use realo_cli::{Outcome, Progress};
use realo_clock::{steady, wall};
use realo_operator::Waker;
use realo_radio::network::Network;
use realo_radio::protocol::{Offer, Settings};
use realo_radio::session::Place;
use realo_radio::station::{Event, Station};
use realo_schemas::{Clock, Kind, Nanos, to_millis};
use serde::{Deserialize, Serialize};
use zenoh::Wait;

use crate::emulate::relayed;

/// What is offered, ten times a second: kind and bytes.
const STREAMS: [(Kind, usize); 2] = [(Kind::Boxes, 4_096), (Kind::Points, 3_700_000)];
const PERIOD: Duration = Duration::from_millis(100);
/// How long the ends look for each other.
const MEETING: Duration = Duration::from_secs(2);
/// How long the link is cut, from `CUT_AT` on.
const CUT: Duration = Duration::from_secs(8);
const CUT_AT: Duration = Duration::from_secs(4);
/// Largest message.
const LARGEST: usize = 8 << 20;

/// What carries the messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Way {
    /// The radio.
    Radio,
    /// Zenoh's `put` with its defaults, on one session.
    Zenoh,
}

/// One end of the link; the bench starts both
#[derive(clap::Args)]
pub struct End {
    /// What carries the messages
    #[arg(value_enum)]
    way: Way,
    /// Where it listens, or whom the one that sends finds
    #[arg(long)]
    address: String,
    /// Whether it sends; the other one reports what came
    #[arg(long)]
    sends: bool,
    /// How long
    #[arg(long)]
    seconds: f64,
    /// Age at which clouds must have arrived, ms (radio)
    #[arg(long)]
    deadline_ms: i64,
}

/// All cases.
#[derive(Serialize)]
pub struct Radio {
    link: &'static str,
    cases: Vec<Case>,
}

/// One case.
#[derive(Serialize)]
struct Case {
    name: String,
    way: Way,
    /// By kind.
    kinds: BTreeMap<Kind, Spread>,
    /// With a cut: from when the link is back to the next boxes, ms.
    back_ms: Option<f64>,
}

/// What became of the messages of a kind.
#[derive(Serialize)]
struct Spread {
    offered: usize,
    arrived: usize,
    p50_ms: f64,
    p95_ms: f64,
    most_ms: f64,
}

/// A message that came: when it was given and when it was here, ns since the epoch.
#[derive(Clone, Copy, Serialize, Deserialize)]
struct Came {
    kind: Kind,
    given: Nanos,
    here: Nanos,
}

/// Runs the cases whose names have `only` in them.
pub fn bench(seconds: f64, only: &str, loopback: bool, progress: &Progress) -> Result<Radio> {
    let relays = loopback
        || Ground::find()
            .inspect_err(|error| eprintln!("realo-lab: {error}; a relay on loopback takes their place"))
            .is_err();
    let all = if relays {
        over_relay(seconds)
    } else {
        over_namespaces(seconds)
    };
    let chosen: Vec<_> = all.iter().filter(|(name, _)| name.contains(only)).collect();
    if chosen.is_empty() {
        let known: Vec<&str> = all.iter().map(|(name, _)| &**name).collect();
        bail!("--only {only}: no case is named so; there are: {}", known.join("; "));
    }
    let link = match relays {
        true => "a relay on loopback: no loss, nothing for congestion control to do",
        false if Ground::find()? == Ground::User => "two network namespaces in a user namespace",
        false => "two network namespaces",
    };
    progress.count("cases", chosen.len() as f64);
    let cases = chosen
        .into_iter()
        .map(|(name, setup)| case(name, *setup).inspect(|_| progress.add(1.0)));
    Ok(Radio {
        cases: cases.collect::<Result<_>>()?,
        link,
    })
}

fn over_namespaces(seconds: f64) -> Vec<(String, Setup)> {
    let mut cases = Vec::new();
    let usual = Setup::of(seconds, Some("bbr"));
    for (loss, control) in [(0.0, "bbr"), (0.0, "cubic"), (0.01, "bbr"), (0.01, "cubic")] {
        let name = format!("{} % loss, {control}", loss * 100.0);
        let setup = Setup {
            loss,
            control: Some(control),
            ..usual
        };
        cases.push((name.clone(), setup));
        if loss == 0.0 {
            cases.push((format!("{name}, clouds may take 2 s"), setup.patient()));
        }
        cases.push((name, setup.over_zenoh()));
    }
    cases.push(("cut for 8 s, bbr".into(), usual.cut()));
    cases
}

/// A relay knows neither loss nor congestion.
fn over_relay(seconds: f64) -> Vec<(String, Setup)> {
    let usual = Setup::of(seconds, None);
    vec![
        ("no loss".into(), usual),
        ("no loss, clouds may take 2 s".into(), usual.patient()),
        ("no loss".into(), usual.over_zenoh()),
        ("cut for 8 s".into(), usual.cut()),
    ]
}

/// What a case is run with.
#[derive(Clone, Copy)]
struct Setup {
    way: Way,
    seconds: f64,
    loss: f64,
    /// Of TCP's congestion; `None`: over a relay on loopback.
    control: Option<&'static str>,
    deadline_ms: i64,
    is_cut: bool,
}

impl Setup {
    fn of(seconds: f64, control: Option<&'static str>) -> Self {
        Setup {
            way: Way::Radio,
            seconds,
            loss: 0.0,
            control,
            deadline_ms: 400,
            is_cut: false,
        }
    }

    fn over_zenoh(self) -> Self {
        Setup {
            way: Way::Zenoh,
            ..self
        }
    }

    fn patient(self) -> Self {
        Setup {
            deadline_ms: 2000,
            ..self
        }
    }

    fn cut(self) -> Self {
        Setup {
            seconds: CUT_AT.as_secs_f64() + CUT.as_secs_f64() + self.seconds,
            is_cut: true,
            ..self
        }
    }
}

/// Where the ends of a case are.
enum Joined {
    Namespaces(Machines),
    Loopback {
        port: u16,
        /// Held until the end.
        _relay: Relay,
    },
}

impl Joined {
    fn of(setup: Setup) -> Result<(Joined, Arc<Link>)> {
        if let Some(control) = setup.control {
            let (machines, link) = machines(&[("loss", setup.loss)], control)?;
            return Ok((Joined::Namespaces(machines), link));
        }
        let link = Arc::new(Link::default());
        for (what, value) in USUAL {
            link.set(what, *value);
        }
        let port = free_port()?;
        let [near, far] = relayed(port);
        let ways: Vec<_> = near.into_iter().zip(far).collect();
        let _relay = Relay::start(link.clone(), &ways)?;
        Ok((Joined::Loopback { port, _relay }, link))
    }

    /// One end, and the address that both have to know.
    fn command(&self, sends: bool, program: &Path) -> (Command, String) {
        match self {
            Joined::Namespaces(machines) => {
                let command = machines.command(usize::from(sends), program);
                (command, format!("{}:7447", ADDRESSES[0]))
            }
            Joined::Loopback { port, .. } => {
                let [near, far] = relayed(*port);
                let address = if sends { near } else { far }[0];
                (Command::new(program), address.to_string())
            }
        }
    }
}

/// A port that is free for the ends and the relay between them, as is the one behind it.
fn free_port() -> Result<u16> {
    for _ in 0..100 {
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let all = relayed(port.min(u16::MAX - 1)).concat();
        if all.iter().all(|address| TcpListener::bind(address).is_ok()) {
            return Ok(all[0].port());
        }
    }
    bail!("no two ports side by side are free on 127.0.0.1 and 127.0.0.2")
}

/// The link, but for what is set otherwise.
const USUAL: &[(&str, f64)] = &[("rate", 27.0), ("delay", 20.0), ("queue", 100.0)];

/// Two machines that a link of 27 Mbit/s and 20 ms joins, but for what is set otherwise; `control`: of TCP's congestion.
pub(super) fn machines(set: &[(&str, f64)], control: &str) -> Result<(Machines, Arc<Link>)> {
    let link = Arc::new(Link::default());
    for (what, value) in USUAL.iter().chain(set) {
        link.set(what, *value);
    }
    let id = std::process::id();
    let machines = Machines::join(&format!("realo{id}a"), &format!("realo{id}b"), link.clone())
        .wrap_err("two machines in one: run it as root, on Linux")?;
    for machine in [0, 1] {
        machines.set_congestion_control(machine, control)?;
    }
    Ok((machines, link))
}

fn case(name: &str, setup: Setup) -> Result<Case> {
    let Setup {
        way,
        seconds,
        deadline_ms,
        is_cut,
        ..
    } = setup;
    let (joined, link) = Joined::of(setup)?;
    let program = std::env::current_exe()?;
    let word = way
        .to_possible_value()
        .map_or(String::new(), |value| value.get_name().into());
    let start = |sends: bool| {
        let (mut command, address) = joined.command(sends, &program);
        command.args([
            "radio-end",
            &word,
            "--address",
            &address,
            "--seconds",
            &seconds.to_string(),
        ]);
        command.args(["--deadline-ms", &deadline_ms.to_string()]);
        if sends {
            command.arg("--sends");
        }
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
    };
    let (hears, sends) = (start(false)?, start(true)?);
    let mut back = None;
    if is_cut {
        std::thread::sleep(MEETING + CUT_AT);
        link.set("cut", 1.0);
        std::thread::sleep(CUT);
        back = Some(wall());
        link.set("cut", 0.0);
    }
    for (end, child) in [("sender", sends), ("receiver", hears)].map(|(end, child)| (end, child.wait_with_output())) {
        let output = child?;
        if !output.status.success() {
            bail!("the {end} failed: {}", String::from_utf8_lossy(&output.stderr).trim());
        }
        if end == "receiver" {
            let came: Vec<Came> = serde_json::from_slice(&output.stdout)?;
            return Ok(Case {
                kinds: STREAMS
                    .into_iter()
                    .map(|(kind, _)| (kind, spread(kind, &came, seconds)))
                    .collect(),
                back_ms: back.map(|back| until_boxes(&came, back)).transpose()?,
                name: name.into(),
                way,
            });
        }
    }
    bail!("no receiver")
}

fn until_boxes(came: &[Came], back: Nanos) -> Result<f64> {
    let boxes = came.iter().filter(|came| came.kind == Kind::Boxes && came.here >= back);
    let next = boxes.map(|came| came.here).min();
    next.map(|next| to_millis(next - back))
        .ok_or_else(|| eyre!("no boxes after the cut"))
}

fn spread(kind: Kind, came: &[Came], seconds: f64) -> Spread {
    let of_kind = came.iter().filter(|came| came.kind == kind);
    let mut took: Vec<f64> = of_kind.map(|came| to_millis(came.here - came.given)).collect();
    took.sort_by(f64::total_cmp);
    let at = |share: f64| match took.len() {
        0 => f64::NAN,
        count => took[((count - 1) as f64 * share).round() as usize],
    };
    Spread {
        offered: (seconds / PERIOD.as_secs_f64()).round() as usize,
        arrived: took.len(),
        p50_ms: at(0.5),
        p95_ms: at(0.95),
        most_ms: at(1.0),
    }
}

/// One end: sends, or listens and prints what came.
pub fn end(args: &End) -> Result<Outcome> {
    let came = match args.way {
        Way::Radio => over_radio(args)?,
        Way::Zenoh => over_zenoh(args)?,
    };
    println!("{}", serde_json::to_string(&came)?);
    Ok(Outcome::Complete)
}

/// A message: when it is given, then filler.
fn message(bytes: usize) -> Vec<u8> {
    let mut message = vec![7; bytes];
    message[..8].copy_from_slice(&wall().to_le_bytes());
    message
}

fn given(bytes: &[u8]) -> Nanos {
    bytes.first_chunk().map_or(0, |first| Nanos::from_le_bytes(*first))
}

/// Calls ten times a second, with the number of the call.
fn ten_times_a_second(seconds: f64, mut call: impl FnMut(u64)) {
    let begun = Instant::now();
    for seq in 0..(seconds / PERIOD.as_secs_f64()).round() as u64 {
        std::thread::sleep((begun + PERIOD * seq as u32).saturating_duration_since(Instant::now()));
        call(seq);
    }
}

fn over_radio(args: &End) -> Result<Vec<Came>> {
    let address = format!("tcp/{}", args.address).parse()?;
    let name = if args.sends { "sender" } else { "receiver" };
    let (listen, connect) = if args.sends {
        (vec![], vec![address])
    } else {
        (vec![address], vec![])
    };
    let place = Place {
        site: "bench".into(),
        agent: name.into(),
        listen,
        connect,
        ..Place::default()
    };
    let settings = Settings {
        deadline: args.deadline_ms * 1_000_000,
        ..Settings::default()
    };
    let station = Station::new(name.into(), settings, LARGEST, wall() as u64, None);
    let (wake, woken) = channel();
    let mut network = Network::join(
        &place,
        station,
        Waker::new(move || {
            let _ = wake.send(());
        }),
    )?;
    network.set_clock(Clock::live(wall()));
    let mut came = Vec::new();
    if args.sends {
        std::thread::sleep(MEETING);
        ten_times_a_second(args.seconds, |seq| {
            for (kind, bytes) in STREAMS {
                network.offer(Offer {
                    kind,
                    seq,
                    stamp: wall(),
                    born: steady(),
                    bytes: message(bytes).into(),
                });
            }
        });
    } else {
        let until = Instant::now() + MEETING + Duration::from_secs_f64(args.seconds) + MEETING;
        while let Some(left) = until.checked_duration_since(Instant::now()) {
            let _ = woken.recv_timeout(left);
            for event in network.take().events {
                if let Event::Arrived(_, message, _) = event {
                    came.push(Came {
                        kind: message.kind,
                        given: given(&message.bytes),
                        here: wall(),
                    });
                }
            }
        }
    }
    network.leave();
    Ok(came)
}

fn over_zenoh(args: &End) -> Result<Vec<Came>> {
    let failed = |error: zenoh::Error| eyre!("zenoh: {error}");
    let address = format!("tcp/{}", args.address);
    let side = if args.sends { "connect" } else { "listen" };
    let text = format!(
        r#"{{ mode: "peer", scouting: {{ multicast: {{ enabled: false }} }}, {side}: {{ endpoints: ["{address}"] }},
            transport: {{ shared_memory: {{ enabled: false }} }} }}"#
    );
    let session = zenoh::open(zenoh::Config::from_json5(&text).map_err(failed)?)
        .wait()
        .map_err(failed)?;
    if args.sends {
        std::thread::sleep(MEETING);
        ten_times_a_second(args.seconds, |_| {
            for (kind, bytes) in STREAMS {
                let _ = session.put(format!("bench/{kind}"), message(bytes)).wait();
            }
        });
        std::thread::sleep(MEETING);
        return Ok(Vec::new());
    }
    let (sender, heard) = channel();
    let hear = move |sample: zenoh::sample::Sample| {
        let kind = sample
            .key_expr()
            .as_str()
            .rsplit('/')
            .next()
            .and_then(|kind| kind.parse().ok());
        if let Some(kind) = kind {
            let given = given(&sample.payload().to_bytes());
            let _ = sender.send(Came {
                kind,
                given,
                here: wall(),
            });
        }
    };
    let subscriber = session
        .declare_subscriber("bench/*")
        .callback(hear)
        .wait()
        .map_err(failed)?;
    std::thread::sleep(MEETING + Duration::from_secs_f64(args.seconds) + MEETING);
    drop(subscriber);
    Ok(heard.iter().collect())
}

impl fmt::Display for Radio {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(
            f,
            "{}; 27 Mbit/s, 20 ms, a queue of 100 ms; offered ten times a second; how many arrived, and after how many ms",
            self.link
        )?;
        for case in &self.cases {
            for (kind, spread) in &case.kinds {
                let Spread {
                    offered,
                    arrived,
                    p50_ms,
                    p95_ms,
                    most_ms,
                } = spread;
                let way = match case.way {
                    Way::Radio => "radio",
                    Way::Zenoh => "Zenoh's defaults",
                };
                let line = format!("{}, {way}, {kind}", case.name);
                write!(f, "{line:<48} {arrived:>4} of {offered:<4}")?;
                if *arrived > 0 {
                    write!(f, " p50 {p50_ms:.1}, p95 {p95_ms:.1}, most {most_ms:.1}")?;
                }
                writeln!(f)?;
            }
            if let Some(back) = case.back_ms {
                writeln!(f, "{}: boxes again {back:.0} ms after the link is back", case.name)?;
            }
        }
        Ok(())
    }
}
