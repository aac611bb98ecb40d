//! The sweeps of one log and ego in all runs, on one clock and in one frame.
//!
//! Lengths are whole centimetres, angles thousandths of a radian, times whole milliseconds from the log's first sweep,
//! scores thousandths. Boxes are in the ego's frame at their sweep; poses are in the map, from a place near the first ego.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Vector3};
use realo_logs::{AgentKind, Log, LogError, Stream};
use realo_render::{RECORDING, RenderError, clouds, single_runs};
use realo_results::{Run, read_run, run_folder};
use realo_schemas::geometry::yaw_of;
use realo_schemas::report::{Fate, Fated};
use realo_schemas::{Box3, Kind, Name, Nanos};
use realo_scoring::{Protocol, same_truth};
use serde::Serialize;

use crate::judged::{Judged, is_known, labelled};
use crate::recorded::{Recorded, Sweep};
use crate::{DifferentProtocols, PageError, Request, own};

const MILLI: Nanos = 1_000_000;
/// Messages of one recording that are on the page, at most; those that were not used go first.
const MOST_MESSAGES: usize = 12_000;

/// Stands in what is said of a run of which not all messages are on the page.
pub const FEWER_MESSAGES: &str = "messages that were not used come first";

/// Names of classes, each once; rows hold their places.
#[derive(Debug, Default)]
pub struct Names {
    pub classes: Vec<String>,
}

impl Names {
    pub fn class(&mut self, name: &str) -> i32 {
        place(&mut self.classes, name) as i32
    }
}

fn place(names: &mut Vec<String>, name: &str) -> usize {
    names.iter().position(|known| known == name).unwrap_or_else(|| {
        names.push(name.into());
        names.len() - 1
    })
}

/// An object: `[class, x, y, z, length, width, height, yaw, the scene's place of its track or -1, counts: 0 or 1]` and the
/// points of each agent of the scene on it, nothing where the log does not say.
pub type ObjectRow = (Vec<i32>, Vec<u32>);

/// Whose number a track has: the log's (`None`), or that of a run by its place; and the number.
type Track = (Option<usize>, u64);

/// The number of a track, which is new for a new one.
fn number_of(tracks: &mut BTreeMap<Track, i32>, track: Track) -> i32 {
    let next = tracks.len() as i32;
    *tracks.entry(track).or_insert(next)
}

/// `[x, y, z, yaw]` of a body in the map.
pub type PoseRow = [i64; 4];

/// All runs over one log with one ego.
#[derive(Debug, Serialize)]
pub struct ScenePart {
    pub log: String,
    pub ego: String,
    /// Stamp of the time 0, ns since the epoch, as text: it has more digits than a number of JavaScript.
    pub start: String,
    pub agents: Vec<AgentPart>,
    /// Where objects count: x min, x max, y min, y max, in the ego's frame.
    pub region: [i32; 4],
    pub protocol: String,
    /// Classes that the protocol scores, in its order.
    pub scored: Vec<String>,
    pub ious: Vec<String>,
    /// Smallest points of the ego on an object that it counts as having seen.
    pub seen_points: u64,
    /// By number of the sweep.
    pub frames: BTreeMap<u64, FramePart>,
    pub runs: Vec<SceneRun>,
    #[serde(skip)]
    pub start_ns: Nanos,
    #[serde(skip)]
    pub exact: bool,
    /// What its sweeps are judged by.
    #[serde(skip)]
    pub rules: Protocol,
    /// Name of the run that it was made for.
    #[serde(skip)]
    pub first_run: String,
    /// Places of the tracks of the log and of runs on the page.
    #[serde(skip)]
    pub tracks: BTreeMap<Track, i32>,
    /// By place, the number of each track as the log or the run has it: text, for it may have more digits than a number of
    /// JavaScript.
    #[serde(rename = "tracks")]
    pub track_names: BTreeMap<i32, String>,
    /// Outlines as a graph knew them, m.
    #[serde(skip)]
    footprints: BTreeMap<Name, [f64; 4]>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AgentPart {
    pub name: String,
    pub roadside: bool,
    /// x min, x max, y min, y max in its body frame.
    pub footprint: Option<[i32; 4]>,
}

/// What a sweep has in all runs.
#[derive(Debug, Default, Serialize)]
pub struct FramePart {
    pub t: i64,
    /// Whether it is scored.
    pub key: bool,
    /// Of every agent, where known; the ego's is the frame of all boxes.
    pub poses: Vec<Option<PoseRow>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub objects: Vec<ObjectRow>,
}

/// What one run has of the scene.
#[derive(Debug, Serialize)]
pub struct SceneRun {
    /// Its place among the runs of the page.
    pub run: usize,
    /// Sweeps that were recorded, with those that are not on the page.
    pub recorded: usize,
    pub frames: BTreeMap<u64, RunFrame>,
    /// `[agent, kind, number, fate, time]` of messages to the ego; a message that was not used is placed by its number.
    pub messages: Vec<[i64; 5]>,
    /// `[agent, time, messages, bytes]` of what each agent sent to the ego in a second, which begins at this time.
    pub carried: Vec<[i64; 4]>,
    /// How many messages there are with those that are not on the page.
    #[serde(skip)]
    pub all_messages: usize,
}

impl SceneRun {
    /// The only run of a page, without sweeps.
    pub fn empty() -> Self {
        SceneRun {
            run: 0,
            recorded: 0,
            frames: BTreeMap::new(),
            messages: Vec::new(),
            carried: Vec::new(),
            all_messages: 0,
        }
    }
}

#[derive(Debug, Default, Serialize)]
pub struct RunFrame {
    /// `[class, score, x, y, z, length, width, height, yaw, what became of it at each IoU …]`: the place of the object that
    /// it found, or -1 false, -2 not counted, -3 not known. Where the run follows boxes, then the place of its track or -1, and
    /// its velocity x, y in cm/s where it is known. `None`: no boxes came.
    pub boxes: Option<Vec<Vec<i32>>>,
    /// Whether the log says what is there, which may be nothing.
    pub known: bool,
    /// Its objects, where they differ from those of the frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub objects: Option<Vec<ObjectRow>>,
    /// `[agent, kind, age in 0.1 ms, number]` of each message that was fused.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub used: Vec<[i64; 4]>,
    /// The ego's pose, where it is another than that of the frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseRow>,
}

/// The scenes of a page.
#[derive(Default)]
pub struct Scenes {
    pub parts: Vec<ScenePart>,
    /// By name of the log: where the map begins, and the time 0.
    pub origins: BTreeMap<String, (Vector3<f64>, Nanos)>,
    /// By name; `None`: not found.
    pub logs: BTreeMap<String, Option<Log>>,
    given: Given,
    /// By the place of a run on the page: the program that ran.
    pub programs: BTreeMap<usize, String>,
    /// Names of runs, and why a part of them is not in the player.
    pub failed: Vec<(String, PageError)>,
}

/// The recording of a run, if it is that of the run.
fn recorded(recording: &Path, run: &Run, most: usize) -> Result<Recorded, PageError> {
    let ego = &run.result.settings.ego;
    let mut recorded = Recorded::read(recording, ego, most)?;
    recorded.take_footprint(recorded.footprints.get(&**ego).copied());
    own::check(recording, run, &recorded)?;
    Ok(recorded)
}

/// What became of the log that was named.
#[derive(Default)]
struct Given {
    used: bool,
    /// Name of the log of a run, and why it is another.
    differs: Vec<(String, String)>,
}

impl Scenes {
    /// Adds the recordings of a run; one that cannot be read, or is of another run, is left out and said in [`Scenes::failed`].
    ///
    /// # Errors
    /// A folder that cannot be read; a log that was named and does not fit; runs of different protocols.
    #[allow(clippy::too_many_arguments, reason = "a pass over a run fills them all")]
    pub fn read(
        &mut self,
        number: usize,
        name: &str,
        folder: &Path,
        request: &Request,
        most_sweeps: usize,
        names: &mut Names,
        left_out: &mut Vec<String>,
    ) -> Result<(), PageError> {
        let folders = single_runs(folder)?;
        let most = (most_sweeps / folders.len().max(1)).max(16);
        let mut known = Vec::new();
        for folder in &folders {
            let run = match read_run(folder) {
                Ok(run) => run,
                Err(error) => {
                    self.failed.push((name.into(), error.into()));
                    continue;
                }
            };
            known.push((run.result.logs.first().cloned(), run.result.settings.ego.clone()));
            let recording = folder.join(RECORDING);
            if !recording.exists() {
                left_out.push(format!(
                    "{name}: {} is not there, so the player does not show this run; run it again, with a node `recorder` in its graph",
                    recording.display()
                ));
                continue;
            }
            match recorded(&recording, &run, most) {
                Ok(mut recorded) => {
                    if (recorded.total as u64) < run.result.frames.total {
                        left_out.push(format!(
                            "{name}: {} holds {} of {} sweeps: it was cut; run it again to have all",
                            recording.display(),
                            recorded.total,
                            run.result.frames.total
                        ));
                    }
                    if let Some(program) = recorded.program.take() {
                        self.programs.insert(number, program);
                    }
                    left_out.extend(recorded.left_out(&format!("{name}: {}", recording.display())));
                    self.add(number, name, &run, &mut recorded, request, names, left_out)?;
                }
                Err(error) => self.failed.push((name.into(), error)),
            }
        }
        self.find_missing(name, &run_folder(folder), &folders, &known);
        Ok(())
    }

    /// Says which of the runs that a batch is the sum of are gone or damaged. `found`: folders of single runs; `known`: logs and
    /// egos of those that could be read.
    fn find_missing(&mut self, name: &str, folder: &Path, found: &[PathBuf], known: &[(Option<String>, String)]) {
        // Without any single run the sum stands for all.
        let stands_for_all = found.iter().any(|one| one == folder);
        let Ok(sum) = read_run(folder) else { return };
        for scene in sum.samples.evaluation.iter().flat_map(|all| &all.scenes) {
            let single = folder.join(&scene.name).join(&scene.ego);
            let is_known =
                |(log, ego): &(Option<String>, String)| log.as_ref() == Some(&scene.name) && *ego == scene.ego;
            let is_there = match stands_for_all {
                true => !single.exists(),
                false => known.iter().any(is_known) || found.contains(&single),
            };
            if !is_there && let Err(error) = read_run(&single) {
                self.failed.push((name.into(), error.into()));
            }
        }
    }

    #[allow(clippy::too_many_arguments, reason = "a pass over a run fills them all")]
    fn add(
        &mut self,
        number: usize,
        name: &str,
        run: &Run,
        recorded: &mut Recorded,
        request: &Request,
        names: &mut Names,
        left_out: &mut Vec<String>,
    ) -> Result<(), PageError> {
        let log = run.result.logs.first().cloned().unwrap_or_default();
        let ego = run.result.settings.ego.clone();
        let found = match self.logs.entry(log.clone()) {
            Entry::Occupied(entry) => entry.into_mut(),
            Entry::Vacant(entry) => entry.insert(open(run, request, recorded, &mut self.given, left_out)?),
        };
        let outline = |found: &Log| found.info().agent(&ego).and_then(|agent| agent.footprint);
        // The log's has more digits.
        let logged = found.as_ref().and_then(outline);
        let known = logged.or_else(|| recorded.footprints.get(&*ego).copied());
        recorded.take_footprint(known);
        if found.is_none() && recorded.footprints.is_empty() {
            let line = format!(
                "the log `{log}` is not here, and the recording has no outlines of agents: boxes on the ego itself count as false \
                 in the player; say where the log is with --log"
            );
            if !left_out.contains(&line) {
                left_out.push(line);
            }
        }
        let known = self.parts.iter().find(|scene| scene.log == log && scene.ego == ego);
        let protocol = match (&run.samples.evaluation, known, &found) {
            (Some(evaluation), ..) => evaluation.protocol.clone(),
            (None, Some(scene), _) => scene.rules.clone(),
            (None, None, Some(log)) => Protocol::load(&log.info().protocol)?,
            (None, None, None) => Protocol::load("default")?,
        };
        if let Some(scene) = known {
            scene.check_protocol(name, &protocol)?;
        }
        // In the protocol's order, before any other name.
        protocol.classes.iter().for_each(|class| {
            names.class(&class.name);
        });
        let Some((first, pose)) = recorded.sweeps.values().find_map(begin) else {
            return Ok(());
        };
        let start = found.as_ref().and_then(Log::span).map_or(first, |(start, _)| start);
        let (origin, start) = *self
            .origins
            .entry(log.clone())
            .or_insert_with(|| (pose.translation.vector.map(f64::round), start));
        let at = self.parts.iter().position(|scene| scene.log == log && scene.ego == ego);
        let at = at.unwrap_or_else(|| {
            self.parts.push(ScenePart {
                first_run: name.into(),
                ..ScenePart::new(&log, &ego, start, &protocol)
            });
            self.parts.len() - 1
        });
        let scene = &mut self.parts[at];
        scene.take_footprints(recorded.footprints.iter().map(|(agent, sides)| (agent, *sides)));
        scene.exact &= run.result.settings.mode == "offline";
        for agent in run.result.agents.iter().map(String::as_str) {
            scene.agent(agent, found.as_ref());
        }
        let truths = recorded.sweeps.values().filter_map(|sweep| sweep.truth.as_ref());
        for agent in truths.flat_map(|(_, truth)| &truth.agents).chain(recorded.poses.keys()) {
            scene.agent(agent, found.as_ref());
        }
        let mut of_run = SceneRun {
            run: number,
            recorded: recorded.total,
            ..SceneRun::empty()
        };
        for (seq, sweep) in &recorded.sweeps {
            scene.add_sweep(*seq, sweep, recorded, &protocol, origin, &mut of_run, names)?;
        }
        let all = scene.add_fates(recorded, &mut of_run);
        of_run.all_messages = all;
        scene.add_carried(recorded, &mut of_run);
        if of_run.messages.len() < all {
            left_out.push(format!(
                "{name}: the player has {} of {all} messages to `{ego}` in `{log}`; {FEWER_MESSAGES}",
                of_run.messages.len()
            ));
        }
        scene.runs.push(of_run);
        Ok(())
    }

    /// Refuses a named log that no run played.
    pub fn check_given(&self, request: &Request) -> Result<(), PageError> {
        match (&request.log, self.given.differs.first()) {
            (Some(log), Some((name, reason))) if !self.given.used => Err(RenderError::OtherLog {
                log: log.clone(),
                name: name.clone(),
                reason: reason.clone(),
            }
            .into()),
            _ => Ok(()),
        }
    }

    /// Runs over one log have mostly the same objects: they are kept once.
    pub fn share_truth(&mut self) {
        for scene in &mut self.parts {
            for run in &mut scene.runs {
                for (seq, frame) in &mut run.frames {
                    let Some(shared) = scene.frames.get_mut(seq) else {
                        continue;
                    };
                    match &frame.objects {
                        Some(objects) if shared.objects.is_empty() => {
                            shared.objects = frame.objects.take().unwrap_or_default()
                        }
                        Some(objects) if *objects == shared.objects => frame.objects = None,
                        _ => {}
                    }
                    if frame.pose == shared.poses.first().copied().flatten() {
                        frame.pose = None;
                    }
                }
            }
        }
    }
}

/// Stamp and pose of a sweep that has both.
pub fn begin(sweep: &Sweep) -> Option<(Nanos, Isometry3<f64>)> {
    let boxes = sweep.boxes.as_ref().map(|(header, _)| header);
    let truth = sweep.truth.as_ref().map(|(header, _)| header);
    let pose = boxes.into_iter().chain(truth).find_map(|header| header.pose.as_ref());
    Some((
        boxes.or(truth)?.stamp,
        pose.map_or_else(Isometry3::identity, |pose| pose.map_from_frame),
    ))
}

/// The log of a run, if it is there; the player does without. A log that was named goes first, under any name.
fn open(
    run: &Run,
    request: &Request,
    recorded: &Recorded,
    given: &mut Given,
    left_out: &mut Vec<String>,
) -> Result<Option<Log>, PageError> {
    let name = run.result.logs.first().map(String::as_str).unwrap_or_default();
    let named = request.log.iter().cloned().map(|path| (path, true));
    let others = run.log_candidates(&request.log_folders);
    let candidates: Vec<(PathBuf, bool)> = named.chain(others.into_iter().map(|path| (path, false))).collect();
    for (path, is_given) in candidates {
        if !path.exists() {
            continue;
        }
        let log = match Log::open(&path) {
            Ok(log) => log,
            Err(error) if is_given => return Err(error.into()),
            Err(_) => continue,
        };
        let reason = differs(&log, &run.result.settings.ego, recorded).unwrap_or_else(|error| Some(error.to_string()));
        let Some(reason) = reason else {
            given.used |= is_given;
            return Ok(Some(log));
        };
        match is_given {
            true => given.differs.push((name.into(), reason)),
            false => left_out.push(format!(
                "{}: not taken for the log `{name}` of a run, as {reason}; say where that is with --log",
                path.display()
            )),
        }
    }
    Ok(None)
}

/// Why a log is not the one of a recording; `None`: it has the ego, its sweep and the same objects.
fn differs(log: &Log, ego: &str, recorded: &Recorded) -> Result<Option<String>, LogError> {
    if log.info().agent(ego).is_none() {
        return Ok(Some(format!("it has no agent `{ego}`")));
    }
    let has_objects = |sweep: &&Sweep| sweep.truth.as_ref().is_some_and(|(_, truth)| is_known(truth));
    let asked = recorded.sweeps.values().find(has_objects);
    let Some(sweep) = asked.or_else(|| recorded.sweeps.values().next()) else {
        return Ok(None);
    };
    let Some((stamp, _)) = begin(sweep) else {
        return Ok(None);
    };
    let has_sweeps = log.has(ego, Stream::Sweeps) || log.has(ego, Stream::Points);
    if has_sweeps && !clouds::has_sweep(log, ego, stamp)? {
        let span = log.span().map_or(String::new(), |(from, until)| {
            format!(" (it lasts from {from} to {until} ns)")
        });
        return Ok(Some(format!("it has no sweep of `{ego}` at {stamp} ns{span}")));
    }
    let Some((_, truth)) = &sweep.truth else {
        return Ok(None);
    };
    let logged = clouds::truth(log, ego, stamp)?;
    let other = same_truth(truth, &logged).err();
    Ok(other.map(|reason| format!("the ground truth is another ({reason}) at the sweep of `{ego}` at {stamp} ns")))
}

fn cm(metres: f64) -> i32 {
    // A cast saturates.
    (metres * 100.0).round() as i32
}

fn pose_row(map_from_body: &Isometry3<f64>, origin: Vector3<f64>) -> PoseRow {
    let place = map_from_body.translation.vector - origin;
    let [x, y, z] = [place.x, place.y, place.z].map(|value| (value * 100.0).round() as i64);
    [x, y, z, (yaw_of(&map_from_body.rotation) * 1000.0).round() as i64]
}

fn place_of(object: &Box3) -> [i32; 7] {
    let [x, y, z] = object.center.map(cm);
    let [length, width, height] = [object.length, object.width, object.height].map(cm);
    [x, y, z, length, width, height, (object.yaw * 1000.0).round() as i32]
}

/// The super-class of a box, also of one that does not count; the name of its own where the protocol has none for it.
fn class_of<'a>(object: &'a Box3, counted: Option<u8>, protocol: &'a Protocol) -> &'a str {
    let number = counted.or_else(|| protocol.class_of(&object.class));
    number.map_or(&*object.class, |number| {
        protocol.classes[usize::from(number)].name.as_str()
    })
}

/// The place of a track, which gets its name when it is new; -1 for none.
fn track_place(tracks: &mut BTreeMap<Track, i32>, names: &mut BTreeMap<i32, String>, track: Option<Track>) -> i32 {
    track.map_or(-1, |track| {
        let place = number_of(tracks, track);
        names.entry(place).or_insert_with(|| track.1.to_string());
        place
    })
}

impl ScenePart {
    pub fn new(log: &str, ego: &str, start: Nanos, protocol: &Protocol) -> Self {
        let [x, y] = [protocol.region.x, protocol.region.y];
        ScenePart {
            log: log.into(),
            ego: ego.into(),
            start: start.to_string(),
            agents: Vec::new(),
            region: [x[0], x[1], y[0], y[1]].map(cm),
            protocol: protocol.name.clone(),
            scored: protocol.classes.iter().map(|class| class.name.clone()).collect(),
            ious: protocol.ious.iter().map(|iou| Protocol::iou_key(*iou)).collect(),
            seen_points: protocol.seen_points,
            frames: BTreeMap::new(),
            runs: Vec::new(),
            start_ns: start,
            exact: true,
            rules: protocol.clone(),
            first_run: String::new(),
            tracks: BTreeMap::new(),
            track_names: BTreeMap::new(),
            footprints: BTreeMap::new(),
        }
    }

    #[cfg(test)]
    pub fn empty(log: &str, ego: &str) -> Self {
        ScenePart::new(log, ego, 0, &Protocol::load("default").expect("it is shipped"))
    }

    /// Whether a further run is judged by the rules of the scene: its outcomes are under the scene's IoUs.
    fn check_protocol(&self, run: &str, protocol: &Protocol) -> Result<(), PageError> {
        if *protocol == self.rules {
            return Ok(());
        }
        Err(PageError::Protocols(Box::new(DifferentProtocols {
            first: self.first_run.clone(),
            first_protocol: self.rules.name.clone(),
            second: run.into(),
            second_protocol: match protocol.name == self.rules.name {
                true => format!("{} with other settings", protocol.name),
                false => protocol.name.clone(),
            },
            log: self.log.clone(),
            ego: self.ego.clone(),
        })))
    }

    /// The place of an agent, ego first.
    pub fn agent(&mut self, name: &str, log: Option<&Log>) -> usize {
        if self.agents.is_empty() && name != self.ego {
            let ego = self.ego.clone();
            self.agent(&ego, log);
        }
        if let Some(at) = self.agents.iter().position(|agent| agent.name == name) {
            return at;
        }
        let info = log.and_then(|log| log.info().agent(name));
        let footprint = info
            .and_then(|info| info.footprint)
            .or_else(|| self.footprints.get(name).copied());
        self.agents.push(AgentPart {
            name: name.into(),
            roadside: info.is_some_and(|info| info.kind == AgentKind::Roadside),
            footprint: footprint.map(|sides| sides.map(cm)),
        });
        self.agents.len() - 1
    }

    /// Takes outlines of agents, for those of whom the log does not say any.
    pub fn take_footprints<'a>(&mut self, known: impl Iterator<Item = (&'a Name, [f64; 4])>) {
        for (name, sides) in known {
            if self.footprints.insert(name.clone(), sides).is_some() {
                continue;
            }
            let mut agents = self.agents.iter_mut();
            if let Some(agent) = agents.find(|agent| *agent.name == **name) {
                agent.footprint.get_or_insert(sides.map(cm));
            }
        }
    }

    #[allow(clippy::too_many_arguments, reason = "what a row is made of")]
    /// Adds a sweep of a run.
    ///
    /// # Errors
    /// Truth and boxes that cannot be compared.
    pub fn add_sweep(
        &mut self,
        seq: u64,
        sweep: &Sweep,
        recorded: &Recorded,
        protocol: &Protocol,
        origin: Vector3<f64>,
        run: &mut SceneRun,
        names: &mut Names,
    ) -> Result<(), PageError> {
        let Some((stamp, map_from_ego)) = begin(sweep) else {
            return Ok(());
        };
        let judged = Judged::of(sweep.truth.as_ref(), sweep.boxes.as_ref(), protocol)?;
        let ego = pose_row(&map_from_ego, origin);
        let poses: Vec<Option<PoseRow>> = (0..self.agents.len())
            .map(|at| {
                let track = recorded.poses.get(self.agents[at].name.as_str());
                let pose = track.and_then(|track| track.at(stamp).or_else(|| track.nearest(stamp)));
                if at == 0 {
                    Some(ego)
                } else {
                    pose.map(|pose| pose_row(&pose, origin))
                }
            })
            .collect();
        let frame = self.frames.entry(seq).or_default();
        frame.t = (stamp - self.start_ns) / MILLI;
        if poses.iter().flatten().count() > frame.poses.iter().flatten().count() {
            frame.poses = poses;
        }
        let mut of_run = RunFrame {
            pose: Some(ego),
            ..RunFrame::default()
        };
        if let Some((_, truth)) = &sweep.truth {
            frame.key |= truth.key;
            of_run.known = is_known(truth);
            let order: Vec<Option<usize>> = self
                .agents
                .iter()
                .map(|agent| truth.agents.iter().position(|name| **name == *agent.name))
                .collect();
            let is_whole = truth.points.len() == truth.boxes.len() * truth.agents.len();
            let objects = labelled(truth, protocol).iter().enumerate().map(|(index, object)| {
                let counted = judged.object_classes.get(index).copied().flatten();
                let mut row = vec![names.class(class_of(object, counted, protocol))];
                row.extend(place_of(object));
                let track = object.track.map(|track| (None, track));
                row.push(track_place(&mut self.tracks, &mut self.track_names, track));
                row.push(i32::from(counted.is_some()));
                let points = |agent: &Option<usize>| {
                    let at = index * truth.agents.len() + (*agent)?;
                    truth.points.get(at).copied()
                };
                let known = is_whole && truth.own.is_none();
                let of_agents = order.iter().map(|agent| points(agent).unwrap_or(0));
                (row, if known { of_agents.collect() } else { Vec::new() })
            });
            of_run.objects = Some(objects.collect());
        }
        if let Some((_, boxes)) = &sweep.boxes {
            let rows = boxes.0.iter().enumerate().map(|(index, object)| {
                let counted = judged.detection_classes[index];
                let mut row = vec![names.class(class_of(object, counted, protocol))];
                row.push((object.score * 1000.0).round() as i32);
                row.extend(place_of(object));
                row.extend(&judged.detections[index]);
                if object.track.is_some() || object.velocity.is_some() {
                    let track = object.track.map(|track| (Some(run.run), track));
                    row.push(track_place(&mut self.tracks, &mut self.track_names, track));
                }
                if let Some([x, y, _]) = object.velocity {
                    row.extend([x, y].map(cm));
                }
                row
            });
            of_run.boxes = Some(rows.collect());
        }
        run.frames.insert(seq, of_run);
        Ok(())
    }

    /// The numbers of the tracks of a sweep, as their sources have them.
    pub fn names_of(&self, frame: &FramePart, run: &RunFrame) -> BTreeMap<i32, &str> {
        let objects = frame.objects.iter().map(|(row, _)| row.get(8));
        let boxes = run.boxes.iter().flatten().map(|row| row.get(9 + self.ious.len()));
        let places = objects.chain(boxes).flatten();
        places
            .filter_map(|place| Some((*place, self.track_names.get(place)?.as_str())))
            .collect()
    }

    /// What was sent to the ego, by the second.
    fn add_carried(&mut self, recorded: &Recorded, run: &mut SceneRun) {
        for ((from, second), carried) in &recorded.carried {
            let agent = self.agent(from, None) as i64;
            let t = (second.saturating_mul(1_000_000_000).saturating_sub(self.start_ns)).div_euclid(MILLI);
            let number = |value: u64| i64::try_from(value).unwrap_or(i64::MAX);
            run.carried
                .push([agent, t, number(carried.messages), number(carried.bytes)]);
        }
    }

    /// What became of each message, and what was fused for each sweep. Returns how many messages there are with those that
    /// are not kept.
    fn add_fates(&mut self, recorded: &Recorded, run: &mut SceneRun) -> usize {
        // A message's fate is the first that fits; a use says for which sweep.
        let mut ends: BTreeMap<(usize, i64, u64), (Fate, Option<u64>)> = BTreeMap::new();
        for fated in recorded
            .fates
            .iter()
            .filter(|fated| fated.message.kind != Kind::AgentState)
        {
            let agent = self.agent(&fated.message.from, None);
            let (kind, seq) = (number_of_kind(fated.message.kind), fated.message.seq);
            let end = ends.entry((agent, kind, seq)).or_insert((fated.fate, None));
            end.0 = end.0.min(fated.fate);
            let Some(used) = fated.r#use else { continue };
            end.1 = end.1.or(Some(used.query));
            if let Some(frame) = run.frames.get_mut(&used.query) {
                let row = used_row(agent, fated, used.age_ns);
                if !frame.used.contains(&row) {
                    frame.used.push(row);
                }
            }
        }
        // Evenly over all senders and times.
        let used = ends.values().filter(|(fate, _)| *fate == Fate::Used).count();
        let others = ends.len() - used;
        let (keep_others, keep_used) = (
            others.min(MOST_MESSAGES),
            used.min(MOST_MESSAGES.saturating_sub(others)),
        );
        let (mut at_used, mut at_other) = (0, 0);
        let kept = ends.iter().filter(|(_, (fate, _))| {
            let (at, keep, all) = match *fate == Fate::Used {
                true => (&mut at_used, keep_used, used),
                false => (&mut at_other, keep_others, others),
            };
            *at += 1;
            is_kept(*at - 1, keep, all)
        });
        // By sender and kind: the sweeps that used its messages, for those that none used.
        let mut times: BTreeMap<(usize, i64), Vec<(u64, i64)>> = BTreeMap::new();
        for ((agent, kind, seq), (_, query)) in &ends {
            if let Some(frame) = query.and_then(|query| self.frames.get(&query)) {
                times.entry((*agent, *kind)).or_default().push((*seq, frame.t));
            }
        }
        for ((agent, kind, seq), (fate, query)) in kept {
            let t = query.and_then(|query| self.frames.get(&query)).map(|frame| frame.t);
            let t = t.or_else(|| placed(*seq, times.get(&(*agent, *kind))?));
            let number = Fate::ALL.iter().position(|known| known == fate).unwrap_or(0);
            run.messages
                .push([*agent as i64, *kind, *seq as i64, number as i64, t.unwrap_or(-1)]);
        }
        ends.len()
    }
}

/// The place of a kind among the words of a page.
fn number_of_kind(kind: Kind) -> i64 {
    Kind::ALL.iter().position(|known| *known == kind).unwrap_or(0) as i64
}

/// A message that was fused, as [`RunFrame::used`] has it. `agent`: the place of its sender.
pub fn used_row(agent: usize, fated: &Fated, age: Nanos) -> [i64; 4] {
    let kind = number_of_kind(fated.message.kind);
    [agent as i64, kind, age / (MILLI / 10), fated.message.seq as i64]
}

/// Whether the thing at a place stays, where so many of all stay, evenly spread.
fn is_kept(at: usize, keep: usize, all: usize) -> bool {
    (at + 1) * keep / all > at * keep / all
}

/// The time of a message by those of its sender before and after it, ms; `None` with fewer than two.
fn placed(seq: u64, used: &[(u64, i64)]) -> Option<i64> {
    if used.len() < 2 {
        return None;
    }
    let after = used.partition_point(|(known, _)| *known < seq).clamp(1, used.len() - 1);
    let ((from, start), (to, end)) = (used[after - 1], used[after]);
    let step = (end - start) as f64 / (to - from).max(1) as f64;
    Some(start + ((seq as f64 - from as f64) * step).round() as i64)
}

#[cfg(test)]
mod tests {
    use realo_schemas::{Boxes, Header};

    use super::*;

    #[test]
    fn runs_of_different_protocols_are_refused_by_name() {
        let mut scene = ScenePart::empty("log", "cav1");
        scene.first_run = "early".into();
        let mut protocol = scene.rules.clone();
        assert!(scene.check_protocol("late", &protocol).is_ok());
        protocol.ious.pop();
        let same_name = scene.check_protocol("late", &protocol).unwrap_err().to_string();
        assert!(same_name.contains("with other settings"), "{same_name}");
        protocol.name = "other".into();
        let said = scene.check_protocol("late", &protocol).unwrap_err().to_string();
        for word in ["early", "`default`", "late", "`other`", "a report for each"] {
            assert!(said.contains(word), "{word}: {said}");
        }
    }

    #[test]
    fn a_track_keeps_its_own_number_as_text() {
        let (mut tracks, mut names) = (BTreeMap::new(), BTreeMap::new());
        let mut place = |whose, track| track_place(&mut tracks, &mut names, Some((whose, track)));
        let places = [u64::MAX, 7, u64::MAX].map(|track| place(None, track));
        assert_eq!(places, [0, 1, 0]);
        // A run counts its own tracks.
        assert_eq!([place(Some(0), 7), place(Some(1), 7), place(Some(0), 7)], [2, 3, 2]);
        assert_eq!(track_place(&mut tracks, &mut names, None), -1);
        let names: Vec<&str> = names.values().map(String::as_str).collect();
        assert_eq!(names, ["18446744073709551615", "7", "7", "7"]);
    }

    #[test]
    fn boxes_of_a_tracker_bring_their_tracks_and_velocities_and_classes_are_the_protocols() {
        let object = |class: &str, x: f64| Box3::new(class, [x, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0);
        let header = |kind| Header::origin(&"run".into(), &"cav1".into(), kind, 3, 10, 20);
        let (mut tracked, mut moving) = (object("Car", 10.0), object("Car", 5000.0));
        tracked.track = Some(41);
        moving.velocity = Some([1.5, -2.0, 0.0]);
        let kite = object("Kite", 30.0);
        let sweep = Sweep {
            truth: None,
            boxes: Some((header(Kind::Boxes), Boxes(vec![tracked, moving, kite]))),
        };
        let mut scene = ScenePart::empty("log", "cav1");
        let (mut run, mut names, rules) = (SceneRun::empty(), Names::default(), scene.rules.clone());
        let recorded = Recorded::empty();
        scene
            .add_sweep(3, &sweep, &recorded, &rules, Vector3::zeros(), &mut run, &mut names)
            .unwrap();
        let rows = run.frames[&3].boxes.clone().unwrap();
        let beyond: Vec<&[i32]> = rows.iter().map(|row| &row[9 + rules.ious.len()..]).collect();
        assert_eq!(beyond, [&[0][..], &[-1, 150, -200], &[]]);
        assert_eq!(scene.track_names[&0], "41");
        let classes: Vec<&str> = rows.iter().map(|row| names.classes[row[0] as usize].as_str()).collect();
        assert_eq!(
            classes,
            ["vehicle", "vehicle", "Kite"],
            "also of a box that does not count"
        );
    }

    #[test]
    fn what_stays_is_evenly_spread() {
        let kept = |keep, all| (0..all).filter(|at| is_kept(*at, keep, all)).collect::<Vec<_>>();
        assert_eq!(kept(3, 9), [2, 5, 8]);
        assert_eq!(kept(4, 4), [0, 1, 2, 3]);
        assert_eq!((kept(0, 5).len(), kept(7, 10).len()), (0, 7));
    }

    #[test]
    fn a_message_is_placed_between_its_neighbours() {
        let used = [(10, 1000), (12, 1200), (20, 2000)];
        let at = |seq| placed(seq, &used);
        assert_eq!(
            [10, 11, 15, 20, 22, 8].map(at),
            [1000, 1100, 1500, 2000, 2200, 800].map(Some)
        );
        assert_eq!(placed(3, &[(1, 5)]), None);
    }
}
