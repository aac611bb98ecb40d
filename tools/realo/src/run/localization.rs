//! Where agents get their poses from: the options, and what a log and a map must have for them.

use std::path::{Path, PathBuf};

use eyre::{Result, WrapErr, bail};
use realo_graph::{FlatGraph, FlatNode};
use realo_logs::{AgentKind, Log, Stream};
use realo_player::PlannedRun;
use realo_registration::VoxelMap;

use super::named;
use super::nodes::{argument, decide, decided_argument, deciding, given, takers};
use crate::roles;

/// Where poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The log.
    Recorded,
    /// Motion sensors and a map.
    Map,
    /// Motion sensors.
    Gnss,
}

impl PoseSource {
    /// All, with their names and what they mean.
    pub const ALL: &[(PoseSource, &str, &str)] = &[
        (PoseSource::Recorded, "recorded", "as the log has them"),
        (
            PoseSource::Map,
            "map",
            "estimated from IMU, GNSS, wheels, and sweeps on --map",
        ),
        (PoseSource::Gnss, "gnss", "estimated from IMU, GNSS and wheels"),
    ];

    /// Whether agents find poses themselves.
    pub fn is_estimated(self) -> bool {
        self != PoseSource::Recorded
    }

    /// As it is written.
    pub fn name(self) -> &'static str {
        let of = PoseSource::ALL.iter().find(|(source, ..)| *source == self);
        of.map_or("", |(_, name, _)| name)
    }
}

/// Agents are on a map that reaches so far around what it has, m.
const AROUND: f64 = 50.0;

/// Puts the options into a graph.
///
/// # Errors
/// A map without `--localization map`, or the other way round; a graph in which nobody localises.
pub fn choose(graph: &mut FlatGraph, source: Option<PoseSource>, map: Option<&Path>) -> Result<()> {
    if source != Some(PoseSource::Map) && map.is_some() {
        bail!("--map: it is looked at with --localization map alone: add that, or drop --map");
    }
    let Some(source) = source else { return Ok(()) };
    if deciding(graph, roles::LOCALIZATION).next().is_none() {
        bail!(
            "--localization: {} has no node `{}`: drop --localization",
            graph.file.display(),
            takers(roles::LOCALIZATION)
        );
    }
    decide(graph, roles::LOCALIZATION, source.name());
    if let Some(map) = map {
        let map = std::path::absolute(map).wrap_err_with(|| format!("--map {}", map.display()))?;
        decide(graph, roles::MAP, &map.to_string_lossy());
    }
    Ok(())
}

/// What results say of the sources: `map (loop.map-1a2b3c4d)`; nothing where all poses are those of the log.
pub fn in_words(graph: &FlatGraph) -> String {
    let words = deciding(graph, roles::LOCALIZATION).filter_map(|node| {
        let source = source(node).filter(|source| is_estimated(source))?;
        Some(match map(node) {
            Some(map) => format!("{source} ({})", named::file(&map)),
            None => source,
        })
    });
    let mut words: Vec<String> = words.collect();
    words.sort();
    words.dedup();
    words.join(", ")
}

fn source(node: &FlatNode) -> Option<String> {
    argument(node, decided_argument(node, roles::LOCALIZATION)?)
}

fn is_estimated(source: &str) -> bool {
    [PoseSource::Map, PoseSource::Gnss]
        .iter()
        .any(|known| known.name() == source)
}

fn map(node: &FlatNode) -> Option<PathBuf> {
    let path = given(node, decided_argument(node, roles::MAP)?)?;
    (!path.is_empty()).then(|| PathBuf::from(path))
}

/// Refuses a run whose agents cannot be localised as the graph wants it.
///
/// # Errors
/// No map, one that cannot be read, one of another frame or place; an agent without motion sensors.
pub fn check(graph: &FlatGraph, log: &Log, planned: &PlannedRun) -> Result<()> {
    let estimating = |node: &&FlatNode| source(node).is_some_and(|source| is_estimated(&source));
    let nodes: Vec<&FlatNode> = deciding(graph, roles::LOCALIZATION).filter(estimating).collect();
    if nodes.is_empty() {
        return Ok(());
    }
    let agents: Vec<&str> = planned.agents().collect();
    agents.iter().try_for_each(|agent| has_sensors(log, agent))?;
    let mut known: Vec<PathBuf> = Vec::new();
    for node in nodes {
        if source(node).as_deref() != Some(PoseSource::Map.name()) {
            continue;
        }
        let Some(path) = map(node) else {
            bail!(
                "--localization map: expected a map, found none: add --map FILE, made by `realo map build LOG… -o FILE`"
            );
        };
        if !known.contains(&path) {
            fits(&VoxelMap::open(&path)?, &path, log, &agents)?;
            known.push(path);
        }
    }
    Ok(())
}

/// Whether an agent measures its motion.
fn has_sensors(log: &Log, agent: &str) -> Result<()> {
    let is_roadside = log
        .info()
        .agent(agent)
        .is_some_and(|info| info.kind == AgentKind::Roadside);
    let needed: &[Stream] = match is_roadside {
        true => &[Stream::Fix],
        false => &[Stream::Imu, Stream::Fix],
    };
    let Some(missing) = needed.iter().find(|stream| !log.has(agent, **stream)) else {
        return Ok(());
    };
    bail!(
        "{}: `{agent}` has no motion sensors to be localised by: expected the topic /{agent}/{}, found none; take a log with them \
         (`realo-lab simulate --inertial tactical` makes one), or --localization recorded",
        log.path().display(),
        missing.as_str()
    )
}

/// Whether a map is of the frame and the place where agents are.
fn fits(map: &VoxelMap, path: &Path, log: &Log, agents: &[&str]) -> Result<()> {
    let (map_frame, log_frame) = (&map.info().frame, &log.info().map_frame);
    if map_frame != log_frame {
        bail!(
            "{}: its frame is `{map_frame}`, that of {} is `{log_frame}`: build a map from logs of this frame",
            path.display(),
            log.path().display()
        );
    }
    let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for voxel in map.voxels() {
        for (bound, at) in bounds.iter_mut().zip([voxel.mean.x, voxel.mean.y]) {
            *bound = [bound[0].min(at), bound[1].max(at)];
        }
    }
    let mut places = Vec::new();
    for agent in agents {
        let Some(place) = first_fix(log, agent)? else { continue };
        let is_on = |(bound, at): (&[f64; 2], &f64)| *at >= bound[0] - AROUND && *at <= bound[1] + AROUND;
        if bounds.iter().zip(&place[..2]).all(is_on) {
            return Ok(());
        }
        places.push(format!("{agent} at ({:.0}, {:.0}) m", place[0], place[1]));
    }
    if places.is_empty() {
        // Without positions nothing is known before it runs.
        return Ok(());
    }
    let [[x0, x1], [y0, y1]] = bounds;
    bail!(
        "{}: a map of another place: it has x {x0:.0} to {x1:.0} and y {y0:.0} to {y1:.0} m of `{map_frame}`, and GNSS has {} in the \
         beginning of {}: take the map of this place (`realo map info` says where one is)",
        path.display(),
        places.join(", "),
        log.path().display()
    )
}

/// The first position of an agent's receiver, m in `map`.
fn first_fix(log: &Log, agent: &str) -> Result<Option<[f64; 3]>> {
    if !log.has(agent, Stream::Fix) {
        return Ok(None);
    }
    let mut reader = log.read_all(&[(agent, Stream::Fix)])?;
    while let Some(entry) = reader.next()? {
        // What cannot be used is counted when the log is played.
        if let Some(fix) = entry.motion().ok().and_then(|motion| motion.fixes.first().copied()) {
            return Ok(Some(fix.position));
        }
    }
    Ok(None)
}
