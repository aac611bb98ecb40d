//! Writes the log of a scene in one go: what is missing or damaged is found on the way, all of it.

use std::collections::BTreeMap;
use std::path::Path;

use realo_logs::{AgentInfo, AgentKind, Levelled, LogInfo, LogWriter};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud};

use super::clock::Clock;
use super::count::points_in_boxes;
use super::frame::{BodySweep, Frame, numbers};
use super::known::Known;
use super::poses::Poses;
use super::residual::{Placed, residual};
use super::truth::{Itself, Labelled, Truth, truth_of};
use super::{AgentSummary, Layout, Scene, SceneAgent, SceneSummary, TruthOf};
use crate::faults::{Faults, FaultsOfSweep};
use crate::level::Level;
use crate::options::SweepStamp;
use crate::places::recorded;
use crate::{ImportError, Options};

/// A scene that is to become a log.
pub struct SceneImport<'a> {
    pub(super) layout: &'a dyn Layout,
    dir: &'a Path,
    pub(super) scene: &'a Scene,
    pub(super) options: &'a Options,
    pub(super) clock: Clock,
}

impl<'a> SceneImport<'a> {
    /// Of the data set in `dir`.
    pub fn new(layout: &'a dyn Layout, dir: &'a Path, scene: &'a Scene, clock: Clock, options: &'a Options) -> Self {
        SceneImport {
            layout,
            dir,
            scene,
            options,
            clock,
        }
    }

    /// Writes the log, if all frames are complete or incomplete ones are to be left out; calls `progress` after each frame. Without
    /// `output` it only finds out what is missing or damaged.
    ///
    /// # Errors
    /// Why the log cannot be written. What is missing or damaged is in the summary.
    pub fn run(&self, output: Option<&Path>, mut progress: impl FnMut()) -> Result<SceneSummary, ImportError> {
        let known = |agent| Known::of(self.layout, self.scene, agent, self.options);
        let known: Vec<Known> = match self.scene.agents.iter().map(known).collect() {
            Ok(known) => known,
            // Other scenes may have what this one lacks.
            Err(error) => return Ok(self.unknown(&error, progress)),
        };
        let poses: Vec<Option<Poses>> = self
            .scene
            .agents
            .iter()
            .map(|agent| self.poses(agent))
            .collect::<Result<_, _>>()?;
        let create = |output| LogWriter::create_atomic(output, &self.info(&known));
        let mut writing = Writing {
            poses,
            log: output.map(create).transpose()?,
            import: self,
            summary: self.summary(&known),
            known,
            tilts: vec![Vec::new(); self.scene.agents.len()],
            newest: vec![None; self.scene.agents.len()],
            faults: self.scene.lost.faults.clone(),
        };
        for number in numbers(self.scene, self.options) {
            match self.frame(number, &writing.known) {
                Ok(frame) => writing.frame(number, &frame)?,
                Err(faults) => writing.incomplete(faults),
            }
            progress();
        }
        writing.finish(output)
    }

    /// What is said of a scene of which too little is known for a log.
    fn unknown(&self, error: &ImportError, mut progress: impl FnMut()) -> SceneSummary {
        let frames = numbers(self.scene, self.options).len();
        (0..frames).for_each(|_| progress());
        SceneSummary {
            scene: self.scene.name.clone(),
            incomplete_frames: frames + self.scene.lost.frames,
            missing: [("no height of a LiDAR".to_string(), vec![error.to_string()])].into(),
            ..SceneSummary::default()
        }
    }

    /// All poses of an agent, where the layout has a file for them.
    fn poses(&self, agent: &SceneAgent) -> Result<Option<Poses>, ImportError> {
        let all = self.options.frames == Options::default().frames;
        let name = self.layout.pose_file();
        name.map_or(Ok(None), |name| Poses::of(agent, name, all))
    }

    fn info(&self, known: &[Known]) -> LogInfo {
        let agents = self.scene.agents.iter().zip(known);
        let agents = agents.map(|(agent, known)| self.agent(agent, known)).collect();
        let mut info = LogInfo::new(source(self.layout, self.scene), agents);
        info.key_frames = self.layout.scored().into();
        if let Some(protocol) = self.layout.protocol() {
            info.protocol = protocol.into();
        }
        info
    }

    fn agent(&self, agent: &SceneAgent, known: &Known) -> AgentInfo {
        let height = known.height;
        let is_fixed = self.options.level != Level::Ground;
        AgentInfo {
            name: agent.name.clone(),
            kind: agent.kind,
            footprint: self.footprint(agent, known),
            sensor: match is_fixed {
                true => format!("LiDAR, {height:.2} m over the body frame"),
                false => "LiDAR".into(),
            },
            sensor_position: is_fixed.then_some([0.0, 0.0, height]),
        }
    }

    /// How long after their stamps the sweeps of an agent are ready, ns.
    fn to_ready(&self, agent: &SceneAgent) -> Nanos {
        match (self.layout.readiness(self.options), self.options.stamp) {
            (Some(readiness), _) => match agent.kind {
                AgentKind::Vehicle => readiness.vehicle,
                AgentKind::Roadside => readiness.roadside,
            },
            (None, SweepStamp::Start) => self.clock.period,
            (None, SweepStamp::End) => 0,
        }
    }

    fn footprint(&self, agent: &SceneAgent, known: &Known) -> Option<[f64; 4]> {
        let outline = known.footprint.unwrap_or(self.options.footprint);
        (agent.kind == AgentKind::Vehicle).then_some(outline)
    }

    fn summary(&self, known: &[Known]) -> SceneSummary {
        let mut assumed = self.layout.assumed(self.options);
        if !known.iter().all(|known| known.said.contains(&"stamps")) {
            let readiness = self.layout.readiness(self.options);
            assumed.insert(
                0,
                readiness.map_or_else(|| self.clock.words(self.options), |it| it.words),
            );
        }
        assumed.push(format!("frames levelled by: {} (--level)", self.options.level));
        assumed.extend(self.scene.assumed.iter().cloned());
        assumed.extend(said_by_files(self.scene, known));
        let agent = |(agent, known): (&SceneAgent, &Known)| AgentSummary {
            folder: agent.folder.clone(),
            name: agent.name.clone(),
            height_m: known.height,
            intensities: known.brightest.rule(),
            times: known.times.clone().unwrap_or_default(),
            ..AgentSummary::default()
        };
        SceneSummary {
            scene: self.scene.name.clone(),
            agents: self.scene.agents.iter().zip(known).map(agent).collect(),
            assumed,
            incomplete_frames: self.scene.lost.frames,
            unwanted: self.scene.unwanted.clone(),
            ..SceneSummary::default()
        }
    }
}

struct Writing<'a> {
    import: &'a SceneImport<'a>,
    /// `None` as soon as it is known that there will be no log.
    log: Option<LogWriter>,
    summary: SceneSummary,
    known: Vec<Known>,
    /// What was levelled of each agent's sweeps, degrees.
    tilts: Vec<Vec<f64>>,
    /// All poses of each agent, where there is a file of them.
    poses: Vec<Option<Poses>>,
    /// Stamp of each agent's newest sweep.
    newest: Vec<Option<Nanos>>,
    faults: Faults,
}

impl Writing<'_> {
    fn incomplete(&mut self, faults: FaultsOfSweep) {
        self.summary.incomplete_frames += 1;
        self.faults.extend(self.import.dir, faults);
        if !self.import.options.skip_incomplete {
            self.log = None;
        }
    }

    fn frame(&mut self, number: u64, (sweeps, labels): &Frame) -> Result<(), ImportError> {
        self.summary.frames += 1;
        sweeps.iter().try_for_each(|sweep| self.in_order(number, sweep))?;
        for (index, sweep) in sweeps.iter().enumerate() {
            self.sweep(sweep, index, labels)?;
        }
        self.overlap(sweeps, labels);
        Ok(())
    }

    /// Checks that a stamp of a file is later than that of the agent's sweep before it.
    fn in_order(&mut self, number: u64, sweep: &BodySweep) -> Result<(), ImportError> {
        let newest = self.newest[sweep.agent].replace(sweep.stamp);
        let agent = &self.import.scene.agents[sweep.agent];
        let labels = agent.sweeps.get(&number).map(|files| files.labels.as_path());
        let reason = if self.known[sweep.agent].said.contains(&"stamps") != sweep.is_stamped {
            format!(
                "stamp of the sweep: expected one in all files of `{}` or in none, found it in some; add it, or remove the key from all",
                agent.folder
            )
        } else if let Some(newest) = newest.filter(|newest| sweep.is_stamped && *newest >= sweep.stamp) {
            format!(
                "stamp of the sweep: expected one later than that of the sweep before, {newest} ns, found {} ns; correct it, or remove \
                 the key from all files of `{}`",
                sweep.stamp, agent.folder
            )
        } else {
            return Ok(());
        };
        Err(ImportError::content(labels.unwrap_or(self.import.dir), reason))
    }

    fn sweep(&mut self, sweep: &BodySweep, index: usize, labels: &[Labelled]) -> Result<(), ImportError> {
        let SceneImport { scene, layout, .. } = self.import;
        let Some(log) = &mut self.log else { return Ok(()) };
        let agent = &scene.agents[sweep.agent];
        let itself = Itself {
            footprint: self.import.footprint(agent, &self.known[sweep.agent]),
            is_object: layout.agents_are_objects(),
        };
        let objects = match sweep.truth {
            TruthOf::AllAgents => truth_of(labels, index, &itself),
            TruthOf::Given { .. } | TruthOf::Nothing => truth_of(&labels[index..=index], 0, &itself),
        };
        let points = points_on(&sweep.cloud, &objects);
        let (name, stamp) = (&agent.name, sweep.stamp);
        let ready = stamp.saturating_add(self.import.to_ready(agent));
        let map_from_body = &labels[index].map_from_body;
        match &mut self.poses[sweep.agent] {
            Some(poses) => poses.sweep(log, name, [stamp, ready], map_from_body)?,
            None => log.pose(name, stamp, stamp, &recorded(*map_from_body))?,
        }
        log.cloud(name, stamp, ready, &sweep.cloud)?;
        let own = &objects.boxes[..objects.own];
        if layout.labels_are_detections() {
            log.detections(name, stamp, ready, &as_detections(own))?;
        }
        let (key, view) = (!sweep.is_unscored, sweep.view.as_ref().map(std::slice::from_ref));
        if let Some(view) = view {
            log.own_views(name, stamp, ready, view)?;
        }
        let truth = match &sweep.truth {
            TruthOf::AllAgents => Some((objects.boxes.clone(), Some(&points[..]), view.unwrap_or_default())),
            TruthOf::Given {
                labels: given, views, ..
            } => {
                let given = Labelled {
                    labels: given.clone(),
                    ..labels[index].clone()
                };
                Some((truth_of(&[given], 0, &itself).boxes, None, &views[..]))
            }
            TruthOf::Nothing => None,
        };
        if let Some((_, _, views @ [_, ..])) = &truth {
            log.truth_views(name, stamp, ready, views)?;
        }
        log.own_labels(name, stamp, ready, own, Some(&points[..objects.own]), key)?;
        if let Some((boxes, points, _)) = &truth {
            log.truth(name, stamp, ready, boxes, *points, key)?;
            self.summary.truth_boxes += boxes.len();
        }
        self.count(sweep, own);
        Ok(())
    }

    fn count(&mut self, sweep: &BodySweep, own: &[Box3]) {
        let summary = &mut self.summary;
        summary.unscored += usize::from(sweep.is_unscored);
        self.tilts[sweep.agent].push(sweep.tilt);
        for object in own {
            *summary.classes.entry(object.class.to_string()).or_default() += 1;
        }
        summary.dropped_labels += sweep.dropped;
        if let TruthOf::Given { dropped, .. } = sweep.truth {
            summary.dropped_labels += dropped;
        }
        summary.has_given_truth |= !matches!(sweep.truth, TruthOf::AllAgents);
        for (cause, name) in &sweep.noted {
            let names = summary.noted.entry((*cause).into()).or_default();
            names.push(name.clone());
        }
        summary.limited_intensities += sweep.limited;
        let agent = &mut summary.agents[sweep.agent];
        if let Some(key) = sweep.pose_of {
            *agent.poses_of.entry(key.into()).or_default() += 1;
        }
        agent.sweeps += 1;
        agent.points += sweep.cloud.len();
        agent.labels += own.len();
    }

    /// Compares the clouds of every two agents, once.
    fn overlap(&mut self, sweeps: &[BodySweep], labels: &[Labelled]) {
        let agents = &self.import.scene.agents;
        let placed: Vec<Placed> = sweeps
            .iter()
            .zip(labels)
            .map(|(sweep, labelled)| Placed {
                name: &agents[sweep.agent].name,
                cloud: &sweep.cloud,
                map_from_body: labelled.map_from_body,
            })
            .collect();
        for (index, a) in placed.iter().enumerate() {
            for b in &placed[index + 1..] {
                let is_known = |known: &super::Residual| known.agents[0] == a.name && known.agents[1] == b.name;
                if !self.summary.residuals.iter().any(is_known) {
                    let advice = self.import.layout.placing();
                    self.summary.residuals.extend(residual(a, b, advice));
                }
            }
        }
    }

    fn finish(mut self, output: Option<&Path>) -> Result<SceneSummary, ImportError> {
        self.summary.missing = self.faults.by_cause;
        let level = self.import.options.level;
        if let Some(mut log) = self.log.filter(|_| self.summary.frames > 0) {
            for (agent, poses) in self.import.scene.agents.iter().zip(&mut self.poses) {
                poses
                    .iter_mut()
                    .try_for_each(|poses| poses.finish(&mut log, &agent.name))?;
            }
            let agents = self.import.scene.agents.iter().zip(&self.tilts);
            let agents = agents.filter(|(_, tilts)| !tilts.is_empty());
            log.levelled(
                agents
                    .map(|(agent, tilts)| (agent.name.clone(), levelled(level, tilts)))
                    .collect(),
            );
            log.finish()?;
            self.summary.log = output.map(Into::into);
        }
        Ok(self.summary)
    }
}

/// Labels as a detector would have found them: without what only who knows the objects can say.
fn as_detections(labels: &[Box3]) -> Boxes {
    let found = |label: &Box3| Box3 {
        track: None,
        velocity: None,
        ..label.clone()
    };
    Boxes(labels.iter().map(found).collect())
}

/// An agent's own points on each box: as its files count them, else the points in the box.
fn points_on(cloud: &PointCloud, truth: &Truth) -> Vec<u32> {
    match truth.points.iter().copied().collect::<Option<Vec<u32>>>() {
        Some(points) => points,
        None => {
            let counted = points_in_boxes(cloud, &truth.boxes).into_iter().zip(&truth.points);
            counted.map(|(inside, own)| own.unwrap_or(inside)).collect()
        }
    }
}

/// What the files of agents say, which counts before what is assumed: a line for all agents whose files say the same.
fn said_by_files(scene: &Scene, known: &[Known]) -> Vec<String> {
    let mut agents: BTreeMap<&[&str], Vec<&str>> = BTreeMap::new();
    for (agent, known) in scene
        .agents
        .iter()
        .zip(known)
        .filter(|(_, known)| !known.said.is_empty())
    {
        agents.entry(&known.said).or_default().push(&agent.name);
    }
    let line = |(said, names): (&[&str], Vec<&str>)| {
        let (said, names) = (said.join(", "), names.join("`, `"));
        format!("the files of `{names}` say it themselves, which counts before all else: {said}")
    };
    agents.into_iter().map(line).collect()
}

/// Where the log of a scene is from, as it says itself.
pub fn source(layout: &dyn Layout, scene: &Scene) -> String {
    format!("{}, scene `{}`", layout.title(), scene.name)
}

fn levelled(level: Level, tilts: &[f64]) -> Levelled {
    let min = tilts.iter().copied().fold(f64::INFINITY, f64::min);
    let max = tilts.iter().copied().fold(0.0, f64::max);
    Levelled {
        by: level.as_str().into(),
        degrees: [min, max],
    }
}

/// What is missing or damaged of all scenes, with the data set's own.
pub fn all_missing(summaries: &[SceneSummary], found: &Faults) -> BTreeMap<String, Vec<String>> {
    let mut all = found.by_cause.clone();
    for (cause, names) in summaries.iter().flat_map(|summary| &summary.missing) {
        all.entry(cause.clone()).or_default().extend(names.iter().cloned());
    }
    all
}
