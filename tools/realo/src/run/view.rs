//! `--view` and `--foxglove`: show runs to a browser, or to Foxglove's viewers, while they go on.

use std::collections::{BTreeMap, BTreeSet};
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use clap::ArgGroup;
use eyre::{Result, WrapErr, bail};
use realo_cli::signals;
use realo_graph::FlatGraph;
use realo_host::{Inlet, Seen, Sweeps, Tap};
use realo_logs::Log;
use realo_operator::Role;
use realo_page::{Live, Watched};
use realo_results::scoring::Protocol;
use realo_schemas::PayloadType;
use realo_view::{AddressError, Foxglove, Server, from_elsewhere};

use super::Mode;
use super::foxglove::Channelled;
use super::lane::SendingLane;
use super::nodes::{argument, decided_argument, deciding, registration, takers};
use super::prepare::RunPlan;
use crate::roles;

/// How often a signal is looked for.
const LOOK: Duration = Duration::from_millis(50);

/// What opens an address in the browser of a desktop.
const OPENER: &str = "xdg-open";

/// Where Foxglove's viewers look if nobody says otherwise.
const FOXGLOVE_PORT: u16 = 8765;

/// Options of the view.
#[derive(clap::Args, Clone, Debug, Default)]
#[command(group = ArgGroup::new("watched").args(["view", "foxglove"]).multiple(true))]
pub struct ViewArgs {
    /// Shows the run in a browser while it goes on, until Ctrl-C. ADDR is PORT, IP or IP:PORT [default: a free port, for this machine
    /// alone]
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = "", value_parser = realo_view::address)]
    view: Option<SocketAddr>,
    /// Shows the run's messages to Foxglove or Lichtblick while it goes on, until Ctrl-C. ADDR as for --view [default: 8765, for this
    /// machine alone]
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = "", value_parser = foxglove_address)]
    foxglove: Option<SocketAddr>,
    /// Ends with the last run; without it, the view stays until Ctrl-C
    #[arg(long, requires = "watched")]
    view_exit: bool,
}

fn foxglove_address(text: &str) -> Result<SocketAddr, AddressError> {
    realo_view::address_at(text, FOXGLOVE_PORT)
}

impl ViewArgs {
    /// Whether a run is to be shown.
    pub fn is_asked(&self) -> bool {
        self.view.is_some() || self.foxglove.is_some()
    }

    /// Begins to serve, where that is asked for, and says where.
    ///
    /// # Errors
    /// An address that cannot be had.
    pub fn start(&self) -> Result<Option<View>> {
        if let (Some(view), Some(foxglove)) = (self.view, self.foxglove)
            && view == foxglove
            && view.port() != 0
        {
            bail!(
                "--view and --foxglove: expected two addresses, found {view} for both; give one of them another port"
            );
        }
        let foxglove = self.foxglove.map(start_foxglove).transpose()?;
        let page = self.view.map(start_page).transpose()?;
        Ok((page.is_some() || foxglove.is_some()).then(|| View {
            page: page.map(Arc::new),
            foxglove: foxglove.map(Arc::new),
            taken: Arc::default(),
        }))
    }
}

fn start_page(at: SocketAddr) -> Result<Server> {
    let server = Server::start(at, realo_page::live_page).wrap_err("--view")?;
    let url = server.url();
    eprintln!("realo: watch at {url}");
    warn_of(server.address(), "http");
    open_browser(&url);
    Ok(server)
}

fn start_foxglove(at: SocketAddr) -> Result<Foxglove> {
    let server = Foxglove::start(at).wrap_err("--foxglove")?;
    eprintln!(
        "realo: Foxglove and Lichtblick find the run at {} (Foxglove WebSocket); docs/foxglove-layout.json is a layout for it",
        server.url()
    );
    warn_of(server.address(), "ws");
    Ok(server)
}

/// Says that others can watch too and where, where they can.
fn warn_of(address: SocketAddr, scheme: &str) {
    if !address.ip().is_loopback() {
        let at: Vec<String> = from_elsewhere(address)
            .iter()
            .map(|at| format!("{scheme}://{at}/"))
            .collect();
        let at = match at.as_slice() {
            [] => format!("port {}", address.port()),
            at => at.join(" or "),
        };
        eprintln!("realo: whoever reaches {at} can watch too, and what is sent is not encrypted");
    }
}

/// The view of a command.
#[derive(Clone)]
pub struct View {
    page: Option<Arc<Server>>,
    foxglove: Option<Arc<Foxglove>>,
    /// Whether a run is shown. Others that run beside it are not.
    taken: Arc<AtomicBool>,
}

impl View {
    /// Refuses graphs of which nothing can be drawn.
    ///
    /// # Errors
    /// A graph without final boxes.
    pub fn check<'a>(&self, plans: impl Iterator<Item = &'a RunPlan>) -> Result<()> {
        plans
            .map(|plan| self.outputs(&plan.graph))
            .try_for_each(|found| found.map(drop))
    }

    fn outputs(&self, graph: &FlatGraph) -> Result<Outputs> {
        let option = if self.page.is_some() { "--view" } else { "--foxglove" };
        Outputs::of(graph, self.foxglove.is_some()).wrap_err(option)
    }

    /// The scene of a run.
    ///
    /// # Errors
    /// A graph without final boxes.
    pub fn scene(&self, plan: &RunPlan, mode: Mode) -> Result<Scene> {
        let graph = &plan.graph;
        let outputs = self.outputs(graph)?;
        let mut protocols = deciding(graph, roles::PROTOCOL);
        let protocol = protocols.find_map(|node| argument(node, decided_argument(node, roles::PROTOCOL)?));
        let watched = Watched {
            name: plan.name.clone(),
            mode: mode.as_str().into(),
            log: plan.log().0,
            ego: plan.ego().into(),
            // Several channels, which a lane cannot be of, are no error here.
            alone: SendingLane::of(graph).is_ok_and(|lane| lane.is_none()),
            protocol: Protocol::load(protocol.as_deref().unwrap_or("default"))?,
            has_truth: outputs.has(Part::Truth),
        };
        Ok(Scene {
            view: self.clone(),
            outputs,
            name: plan.name.clone(),
            live: Live::new(watched, Log::open(plan.log_path()).ok()),
        })
    }

    /// Stays until somebody ends it, unless that is not wanted.
    pub fn stay(&self, asked: &ViewArgs) {
        if asked.view_exit || signals::first().is_some() {
            return;
        }
        let page = self.page.as_ref().map(|page| page.url());
        let foxglove = self.foxglove.as_ref().map(|foxglove| foxglove.url());
        let places: Vec<String> = page.into_iter().chain(foxglove).collect();
        eprintln!("realo: the last run stays at {} until Ctrl-C", places.join(" and "));
        while signals::first().is_none() {
            std::thread::sleep(LOOK);
        }
    }
}

/// A run that may be shown.
pub struct Scene {
    view: View,
    outputs: Outputs,
    name: String,
    live: Live,
}

/// A run that is shown, until this is dropped.
pub struct Showing {
    view: View,
    tap: Option<Tap>,
    inlet: Option<Inlet>,
}

impl Scene {
    /// Shows a run in virtual time, unless another one is shown.
    ///
    /// # Errors
    /// A system without threads.
    pub fn show(self) -> Result<Option<Showing>> {
        let (view, outputs) = (self.view.clone(), self.outputs.named());
        let Some(watcher) = self.begin()? else {
            return Ok(None);
        };
        let tap = Tap::new(outputs, Sweeps::ByClock, move |seen| {
            watcher.see(seen);
            true
        })?;
        Ok(Some(Showing {
            view,
            tap: Some(tap),
            inlet: None,
        }))
    }

    /// Shows a run in realtime, at so many seconds of log time per second.
    ///
    /// # Errors
    /// A system without sockets or threads.
    pub fn show_processes(self, rate: f64) -> Result<Showing> {
        let (view, outputs) = (self.view.clone(), self.outputs.named());
        let inlet = match self.begin()? {
            // A cast saturates.
            Some(watcher) => Some(Inlet::open(outputs, rate.ceil() as u32, move |seen| watcher.see(seen))?),
            None => None,
        };
        Ok(Showing { view, tap: None, inlet })
    }

    /// Who sees the run, unless another one is shown.
    fn begin(self) -> Result<Option<Watcher>> {
        let Scene {
            view,
            outputs,
            name,
            live,
        } = self;
        let opening = live.opening()?;
        if view.taken.swap(true, Ordering::SeqCst) {
            return Ok(None);
        }
        let page = view.page.as_ref().map(|server| {
            server.open(&opening);
            (server.clone(), Mutex::new(live))
        });
        let foxglove = view.foxglove.as_ref();
        Ok(Some(Watcher {
            parts: outputs.0.into_values().collect(),
            page,
            foxglove: foxglove.map(|foxglove| Mutex::new(Channelled::new(foxglove.open(&name)))),
        }))
    }
}

impl Showing {
    /// What sees the run in virtual time.
    pub fn tap(&self) -> Option<&Tap> {
        self.tap.as_ref()
    }

    /// What its processes are told.
    ///
    /// # Errors
    /// Names that JSON cannot hold.
    pub fn told(&self) -> Result<Option<String>> {
        Ok(self.inlet.as_ref().map(Inlet::told).transpose()?)
    }
}

impl Drop for Showing {
    fn drop(&mut self) {
        if let Some(tap) = &self.tap {
            tap.flush(Duration::from_millis(500));
            tap.close();
        }
        // Another run that goes on beside it may be the one that is shown.
        if self.tap.is_none() && self.inlet.take().is_none() {
            return;
        }
        if let Some(page) = &self.view.page {
            page.say(&Live::ending());
        }
        self.view.taken.store(false, Ordering::SeqCst);
    }
}

/// Passes on what is seen.
struct Watcher {
    /// What each output is, by its number.
    parts: Vec<BTreeSet<Part>>,
    page: Option<(Arc<Server>, Mutex<Live>)>,
    foxglove: Option<Mutex<Channelled>>,
}

impl Watcher {
    fn see(&self, seen: Seen) {
        if let Some(foxglove) = &self.foxglove {
            let mut foxglove = foxglove.lock().unwrap_or_else(PoisonError::into_inner);
            match &seen {
                Seen::Message(output, message) => {
                    let parts = usize::try_from(*output).ok().and_then(|output| self.parts.get(output));
                    parts
                        .into_iter()
                        .flatten()
                        .for_each(|part| foxglove.see(*part, message));
                }
                Seen::Fates(fates) => foxglove.fates(fates),
            }
        }
        if let Some((server, live)) = &self.page {
            let mut live = live.lock().unwrap_or_else(PoisonError::into_inner);
            self.draw(&mut live, server, seen);
        }
    }

    fn draw(&self, live: &mut Live, server: &Server, seen: Seen) {
        match seen {
            Seen::Message(output, message) => {
                let parts = usize::try_from(output).ok().and_then(|output| self.parts.get(output));
                if !parts.into_iter().flatten().any(|part| part.is_drawn()) {
                    return;
                }
                match live.see(*message) {
                    Ok(pictures) => pictures.into_iter().for_each(|picture| server.picture(picture)),
                    Err(error) => eprintln!("realo: --view: a sweep cannot be drawn: {error}"),
                }
            }
            Seen::Fates(fates) => {
                if let Some(said) = live.fates(&fates) {
                    server.say(&said);
                }
            }
        }
    }
}

/// What an output that is looked at is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The final boxes.
    Boxes,
    /// What an agent detected alone.
    Detections,
    /// What is there.
    Truth,
    /// Poses.
    States,
    /// Sweeps.
    Clouds,
    /// What the evaluator says.
    Reports,
}

impl Part {
    /// Whether the page draws it.
    fn is_drawn(self) -> bool {
        !matches!(self, Part::Detections | Part::Reports)
    }

    /// The inputs, of what scores or records, to which it goes.
    fn ports(self) -> &'static [&'static str] {
        match self {
            Part::Boxes => &["boxes"],
            Part::Detections => &["ego_boxes", "other_boxes"],
            Part::Truth => &["truth"],
            Part::States => &["ego_state", "states"],
            Part::Clouds => &[],
            Part::Reports => &["evaluation"],
        }
    }
}

/// The outputs (stage, output) of a graph that are looked at: what is scored or recorded of it, and the sweeps.
#[derive(Debug, Default)]
struct Outputs(BTreeMap<(String, String), BTreeSet<Part>>);

impl Outputs {
    /// Those of a graph that the page draws, or all.
    ///
    /// # Errors
    /// A graph without final boxes.
    fn of(graph: &FlatGraph, all: bool) -> Result<Self> {
        let mut outputs = Outputs::default();
        let parts = [Part::Boxes, Part::Detections, Part::Truth, Part::States, Part::Reports];
        for part in parts.into_iter().filter(|part| all || part.is_drawn()) {
            for port in part.ports() {
                outputs.add_source(graph, part, port);
            }
        }
        if !outputs.has(Part::Boxes) {
            let (file, nodes) = (graph.file.display(), takers(roles::OUT));
            bail!("{file}: expected a node `{nodes}` with an input `boxes`, found none: there is nothing to draw");
        }
        for node in &graph.nodes {
            let Some(known) = registration(node).filter(|known| known.role == Role::Source) else {
                continue;
            };
            let clouds = known
                .outputs
                .iter()
                .filter(|port| port.types == [PayloadType::PointCloud]);
            for port in clouds {
                outputs.add(&node.id, port.name, Part::Clouds);
            }
        }
        Ok(outputs)
    }

    /// Adds what goes to an input of what scores or records.
    fn add_source(&mut self, graph: &FlatGraph, part: Part, port: &str) {
        let mut sinks = [roles::OUT, roles::RECORDING]
            .into_iter()
            .flat_map(|role| deciding(graph, role));
        if let Some((node, output)) = sinks.find_map(|node| node.inputs.get(port)?.output()) {
            self.add(node, output, part);
        }
    }

    fn add(&mut self, node: &str, output: &str, part: Part) {
        self.0.entry((node.into(), output.into())).or_default().insert(part);
    }

    fn has(&self, part: Part) -> bool {
        self.0.values().any(|parts| parts.contains(&part))
    }

    /// Stage and output, in the order of their numbers.
    fn named(&self) -> Vec<(String, String)> {
        self.0.keys().cloned().collect()
    }
}

/// Opens the browser of a desktop, where there is one and somebody sits before it.
fn open_browser(url: &str) {
    let has_desktop = ["DISPLAY", "WAYLAND_DISPLAY"]
        .iter()
        .any(|name| std::env::var_os(name).is_some());
    let folders = std::env::var_os("PATH").unwrap_or_default();
    let has_opener = std::env::split_paths(&folders).any(|folder| Path::new(&folder).join(OPENER).is_file());
    if !(std::io::stdout().is_terminal() && has_desktop && has_opener) {
        return;
    }
    let mut opener = Command::new(OPENER);
    opener
        .arg(url)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    // Without a browser the address is there to be opened by hand.
    if let Ok(mut opener) = opener.spawn() {
        std::thread::spawn(move || opener.wait());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn graph(name: &str) -> FlatGraph {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        FlatGraph::load(&root.join(format!("dataflows/{name}.yml"))).unwrap()
    }

    #[test]
    fn final_boxes_truth_poses_and_sweeps_are_looked_at() {
        let found = Outputs::of(&graph("early_fusion"), false).unwrap();
        assert!(found.has(Part::Truth) && !found.has(Part::Reports));
        let named = found.named();
        let all: Vec<String> = named.iter().map(|(node, output)| format!("{node}/{output}")).collect();
        for expected in [
            "player/truth",
            "player/ego_clouds",
            "player/clouds",
            "others.sense.localization/state",
        ] {
            assert!(all.iter().any(|output| output == expected), "{expected}: {all:?}");
        }
        assert_eq!(
            all.iter().filter(|output| output.ends_with("/boxes")).count(),
            1,
            "{all:?}"
        );
    }

    #[test]
    fn a_graph_without_final_boxes_cannot_be_watched() {
        let mut graph = graph("early_fusion");
        graph.nodes.iter_mut().for_each(|node| {
            node.inputs.remove("boxes");
        });
        let said = Outputs::of(&graph, true).err().unwrap().to_string();
        assert!(
            said.contains("early_fusion.yml") && said.contains("`results` with an input `boxes`"),
            "{said}"
        );
    }

    #[test]
    fn viewers_of_all_see_what_each_detected_alone_apart_from_the_final_boxes() {
        let mut graph = graph("late_fusion");
        let mut nodes = graph.nodes.iter_mut();
        let recorder = nodes.find(|node| node.id.ends_with("recorder")).unwrap();
        let others = recorder.inputs["states"].clone();
        recorder.inputs.insert("other_boxes".into(), others);
        let found = Outputs::of(&graph, true).unwrap();
        let of = |part: Part| found.0.iter().filter(move |(_, parts)| parts.contains(&part));
        assert_eq!(
            (of(Part::Boxes).count(), of(Part::Detections).count()),
            (1, 1),
            "{found:?}"
        );
        assert!(of(Part::Boxes).all(|(_, parts)| parts.len() == 1), "{found:?}");
        assert!(
            of(Part::Reports).any(|((node, _), _)| node.ends_with("evaluator")),
            "{found:?}"
        );
    }
}
