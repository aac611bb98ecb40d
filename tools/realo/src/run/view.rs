//! `--view`: shows runs to a browser while they go on.

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use eyre::{Result, WrapErr, bail};
use realo_cli::signals;
use realo_graph::FlatGraph;
use realo_host::{Inlet, Seen, Sweeps, Tap};
use realo_logs::Log;
use realo_operator::Role;
use realo_page::{Live, Watched};
use realo_results::scoring::Protocol;
use realo_schemas::PayloadType;
use realo_view::Server;

use super::Mode;
use super::lane::SendingLane;
use super::nodes::{argument, decided_argument, deciding, registration, takers};
use super::prepare::RunPlan;
use crate::roles;

/// How often a signal is looked for.
const LOOK: Duration = Duration::from_millis(50);

/// What opens an address in the browser of a desktop.
const OPENER: &str = "xdg-open";

/// Options of the view.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct ViewArgs {
    /// Shows the run in a browser while it goes on, until Ctrl-C. ADDR is PORT, IP or IP:PORT [default: a free port, for this machine
    /// alone]
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = "", value_parser = realo_view::address)]
    view: Option<SocketAddr>,
    /// Ends with the last run; without it, the view stays until Ctrl-C
    #[arg(long, requires = "view")]
    view_exit: bool,
}

impl ViewArgs {
    /// Begins to serve, where that is asked for, and says where.
    ///
    /// # Errors
    /// An address that cannot be had.
    pub fn start(&self) -> Result<Option<View>> {
        self.view.map(View::start).transpose()
    }
}

/// The view of a command.
#[derive(Clone)]
pub struct View {
    server: Arc<Server>,
    /// Whether a run is shown. Others that run beside it are not.
    taken: Arc<AtomicBool>,
}

impl View {
    fn start(at: SocketAddr) -> Result<Self> {
        let server = Server::start(at, realo_page::live_page).wrap_err("--view")?;
        let url = server.url();
        eprintln!("realo: watch at {url}");
        if !server.address().ip().is_loopback() {
            eprintln!(
                "realo: whoever reaches {} can watch too, and what is sent is not encrypted",
                server.address()
            );
        }
        open_browser(&url);
        Ok(View {
            server: Arc::new(server),
            taken: Arc::default(),
        })
    }

    /// Refuses graphs of which nothing can be drawn.
    ///
    /// # Errors
    /// A graph without final boxes.
    pub fn check<'a>(&self, plans: impl Iterator<Item = &'a RunPlan>) -> Result<()> {
        plans
            .map(|plan| outputs(&plan.graph))
            .try_for_each(|found| found.map(drop))
    }

    /// The scene of a run.
    ///
    /// # Errors
    /// A graph without final boxes.
    pub fn scene(&self, plan: &RunPlan, mode: Mode) -> Result<Scene> {
        let graph = &plan.graph;
        let outputs = outputs(graph)?;
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
            has_truth: outputs.truth,
        };
        Ok(Scene {
            view: self.clone(),
            outputs: outputs.all,
            live: Arc::new(Mutex::new(Live::new(watched, Log::open(plan.log_path()).ok()))),
        })
    }

    /// Stays until somebody ends it, unless that is not wanted.
    pub fn stay(&self, asked: &ViewArgs) {
        if asked.view_exit || signals::first().is_some() {
            return;
        }
        eprintln!("realo: the last run stays at {} until Ctrl-C", self.server.url());
        while signals::first().is_none() {
            std::thread::sleep(LOOK);
        }
    }
}

/// A run that may be shown.
pub struct Scene {
    view: View,
    outputs: Vec<(String, String)>,
    live: Arc<Mutex<Live>>,
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
        if !self.begin()? {
            return Ok(None);
        }
        let Scene { view, outputs, live } = self;
        let server = view.server.clone();
        let tap = Tap::new(outputs, Sweeps::ByClock, move |seen| {
            draw(&live, &server, seen);
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
        self.begin()?;
        let Scene { view, outputs, live } = self;
        let server = view.server.clone();
        // A cast saturates.
        let inlet = Inlet::open(outputs, rate.ceil() as u32, move |seen| draw(&live, &server, seen))?;
        Ok(Showing {
            view,
            tap: None,
            inlet: Some(inlet),
        })
    }

    fn begin(&self) -> Result<bool> {
        let opening = self.live.lock().unwrap_or_else(PoisonError::into_inner).opening()?;
        if self.view.taken.swap(true, Ordering::SeqCst) {
            return Ok(false);
        }
        self.view.server.open(&opening);
        Ok(true)
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
        self.view.taken.store(false, Ordering::SeqCst);
    }
}

/// Draws what is seen.
fn draw(live: &Mutex<Live>, server: &Server, seen: Seen) {
    let mut live = live.lock().unwrap_or_else(PoisonError::into_inner);
    match seen {
        Seen::Message(message) => match live.see(*message) {
            Ok(pictures) => pictures.into_iter().for_each(|picture| server.picture(picture)),
            Err(error) => eprintln!("realo: --view: a sweep cannot be drawn: {error}"),
        },
        Seen::Fates(fates) => {
            if let Some(said) = live.fates(&fates) {
                server.say(&said);
            }
        }
    }
}

/// The outputs of a graph that are looked at.
struct Outputs {
    all: Vec<(String, String)>,
    /// Whether one of them says what is there.
    truth: bool,
}

/// What is scored or recorded of a graph, and the sweeps.
fn outputs(graph: &FlatGraph) -> Result<Outputs> {
    let mut all: Vec<(String, String)> = Vec::new();
    let mut of_port = |port: &str| {
        let sinks = [roles::OUT, roles::RECORDING]
            .into_iter()
            .flat_map(|role| deciding(graph, role));
        let mut sources = sinks.filter_map(|node| node.inputs.get(port)?.output());
        let source = sources
            .next()
            .map(|(node, output)| (node.to_string(), output.to_string()));
        let is_there = source.is_some();
        all.extend(source);
        is_there
    };
    if !of_port("boxes") {
        let (file, nodes) = (graph.file.display(), takers(roles::OUT));
        bail!("--view: {file}: expected a node `{nodes}` with an input `boxes`, found none: there is nothing to draw");
    }
    let truth = of_port("truth");
    for port in ["ego_state", "states"] {
        of_port(port);
    }
    for node in &graph.nodes {
        let Some(known) = registration(node).filter(|known| known.role == Role::Source) else {
            continue;
        };
        let clouds = known
            .outputs
            .iter()
            .filter(|port| port.types == [PayloadType::PointCloud]);
        all.extend(clouds.map(|port| (node.id.clone(), port.name.to_string())));
    }
    all.sort();
    all.dedup();
    Ok(Outputs { all, truth })
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
        let found = outputs(&graph("early_fusion")).unwrap();
        assert!(found.truth);
        let all: Vec<String> = found
            .all
            .iter()
            .map(|(node, output)| format!("{node}/{output}"))
            .collect();
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
        let said = outputs(&graph).err().unwrap().to_string();
        assert!(
            said.contains("early_fusion.yml") && said.contains("`results` with an input `boxes`"),
            "{said}"
        );
    }
}
