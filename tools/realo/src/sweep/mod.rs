//! `realo sweep`: the same graphs over the values of settings, with what their runs have in common computed once.

mod plan;
mod points;
mod table;
mod vary;
mod worlds;

use std::path::{Path, PathBuf};

use clap::builder::RangedU64ValueParser;
use eyre::{Result, bail};
use realo_cli::campaign::{self, Campaign, Parts};
use realo_cli::{find, one_of, signals};
use realo_player::Coop;

use crate::Outcome;
use crate::run::{self, Choices};
use plan::Planned;
use points::Sweep;
use vary::Vary;

/// Runs graphs in virtual time over all values of settings: tables, curves, and where cooperation does harm
#[derive(clap::Args, Clone)]
pub struct Args {
    /// Dataflow files, or names of shipped ones; the ego alone (no_fusion) is always run with them
    #[arg(required = true)]
    pub graphs: Vec<PathBuf>,
    /// SETTING=VALUE,VALUE…; several are crossed. A setting is STAGE.KEY, link.KEY, simulator.KEY (a log is made for each value),
    /// protocol, link, model, project, localization, coop, agents, seed or compute
    #[arg(long, required = true)]
    pub vary: Vec<Vary>,
    /// Logs to play, over which scores are pooled [default: the demo log, made on first use]
    #[arg(long)]
    pub log: Vec<PathBuf>,
    /// No delays and exact poses, pairs by stamp
    #[arg(long)]
    pub offline: bool,
    /// Who cooperates [default: every vehicle is ego in turn, all others collaborate]
    #[arg(long, value_parser = one_of(Coop::RESTRICTED))]
    pub coop: Option<Coop>,
    /// The ego [default: each that the mode allows, in turn]
    #[arg(long)]
    pub ego: Option<String>,
    /// Only these agents take part
    #[arg(long, value_delimiter = ',')]
    pub agents: Vec<String>,
    /// How long stages take in virtual time: a TOML file of stage = ns (a realtime run leaves a compute.toml), or `paper`
    #[arg(long)]
    pub compute: Option<PathBuf>,
    /// Evaluation protocol: a name or a file [default: the log's]
    #[arg(long)]
    pub protocol: Option<String>,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub choices: Choices,
    #[allow(missing_docs, reason = "clap would print it")]
    #[command(flatten)]
    pub parts: Parts,
    /// Memory for what runs have in common; 0: each run computes everything by itself, and gives the same
    #[arg(long, value_name = "MIB", default_value_t = 2048, value_parser = RangedU64ValueParser::<u64>::new().range(0..=1 << 20))]
    pub share_mib: u64,
    /// Where results go; what is done there already stays
    #[arg(short = 'o', long)]
    pub out: PathBuf,
}

impl Args {
    /// The options of a run with none of the values yet.
    fn run(&self, graphs: Vec<PathBuf>) -> run::Args {
        run::Args {
            graphs,
            log: self.log.clone(),
            mode: Some(run::Mode::Virtual),
            offline: self.offline,
            rate: None,
            coop: self.coop,
            ego: self.ego.clone(),
            agents: self.agents.clone(),
            compute: self.compute.clone(),
            protocol: self.protocol.clone(),
            choices: self.choices.clone(),
            out: None,
            no_cost: false,
            resume: false,
            view: Default::default(),
            show: Default::default(),
        }
    }
}

/// The graphs, the ego alone last, and their names.
fn graphs(args: &Args) -> Result<(Vec<PathBuf>, Vec<String>)> {
    let mut graphs = Vec::new();
    for path in &args.graphs {
        graphs.push(find::graph(path)?);
    }
    let is_alone = |path: &PathBuf| path.file_stem().is_some_and(|name| name == points::ALONE);
    let alone = match graphs.iter().position(is_alone) {
        Some(at) => graphs.remove(at),
        None => find::graph(points::ALONE.as_ref())?,
    };
    graphs.push(alone);
    let names = run::names_of(&graphs)?;
    Ok((graphs, names))
}

/// Plans the runs, makes those that are not done, and writes what all came to.
pub fn main(args: &Args) -> Result<Outcome> {
    signals::catch(realo_host::virtual_time::end_all)?;
    vary::refuse_twice(&args.vary)?;
    let varied = args.vary.iter().filter(|vary| vary.name == "compute");
    let varied = varied.flat_map(|vary| vary.values.iter().map(Path::new));
    run::refuse_measured(args.compute.iter().map(PathBuf::as_path).chain(varied))?;
    let has_world = args.vary.iter().any(|vary| vary.world().is_some());
    if has_world && !args.log.is_empty() {
        bail!("--vary simulator.…: a log is made for each value: drop --log");
    }
    if args.vary.iter().any(|vary| vary.name == "link") && args.vary.iter().any(Vary::is_of_profile) {
        bail!("--vary link: its profiles cannot be crossed with settings of the profile (link.KEY): vary one of them");
    }
    let (graphs, names) = graphs(args)?;
    run::check_threads()?;
    let Planned {
        plan,
        points,
        runs,
        not_played,
    } = plan::plan(args, graphs, names)?;
    plan::refuse_without_truth(&runs)?;
    let campaign = Campaign::open(&args.out, &plan, &args.parts)?;
    signals::begin();
    let ended = plan::run(args, &campaign, &plan, &runs)?;
    let sweep = Sweep::read(args, &campaign, points)?;
    sweep.write(&args.out)?;
    print!("{}", sweep.table());
    not_played
        .iter()
        .for_each(|reason| eprintln!("realo: not played: {reason}"));
    if let Some(ending) = signals::first() {
        eprintln!("realo: ended by {ending}; the same command runs what is missing");
        return Ok(Outcome::Ended(ending.number()));
    }
    if let Some(reason) = campaign::failed(&ended) {
        eprintln!("realo: {reason:#}");
        return Ok(Outcome::Failed);
    }
    let is_partial = !not_played.is_empty() || (args.parts.shard.is_none() && sweep.missing() > 0);
    Ok(if is_partial {
        Outcome::Partial
    } else {
        Outcome::Complete
    })
}
