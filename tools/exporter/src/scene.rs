//! A log as sweeps with what belongs to them: a pose, points, and the boxes at its stamp.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use realo_logs::boxes::BoxesInfo;
use realo_logs::{AgentKind, Log, LogError, MAX_GAP, Stream, pose_track};
use realo_schemas::geometry::{Motion, PoseTrack, tilt_degrees, transform_box};
use realo_schemas::{Box3, Boxes, Nanos, PointCloud};

use crate::options::LabelSource;
use crate::{ExportError, Options};

/// Height of a LiDAR over the ground of which the log does not say it, m.
pub const USUAL_HEIGHT: f64 = 1.8;
/// Sweeps of an agent that wait for their boxes at most.
const WAITING: usize = 16;
/// Poses that tilt less are level, degrees: importers that level by the pose move nothing.
const LEVEL: f64 = 1e-6;
/// Outline of what has none, for importers that take each agent for a vehicle, m.
const NOTHING: [f64; 4] = [-0.01, 0.01, -0.01, 0.01];
/// Outline of a vehicle whose log has none, m: an object centred in it is the vehicle itself.
const NO_FOOTPRINT: [f64; 4] = [-1.5, 1.5, -0.9, 0.9];

/// A log that is to be exported.
pub struct Scene<'a> {
    pub log: &'a Log,
    pub options: &'a Options,
    pub agents: Vec<SceneAgent>,
    /// Stamp of the first sweep of all agents.
    pub first: Nanos,
    /// Time from one sweep to the next, ns.
    pub period: Nanos,
    /// Sweeps of all agents.
    pub sweeps: u64,
    /// All tracks of the log's boxes.
    pub tracks: BTreeSet<u64>,
}

/// An agent of a log.
pub struct SceneAgent {
    pub name: String,
    pub kind: AgentKind,
    /// Height of its LiDAR over the ground, m.
    pub height: f64,
    /// Whether the log says the height.
    pub is_height_known: bool,
    /// Its true poses, or where the log has none, its believed ones.
    pub track: PoseTrack,
    /// The track that others' boxes of this vehicle have.
    pub own_track: Option<u64>,
    /// The largest tilt of its poses, degrees.
    pub tilt: f64,
    /// Its outline as the log states it.
    pub stated_footprint: Option<[f64; 4]>,
    has_labels: bool,
    has_info: bool,
}

/// A sweep of an agent.
pub struct Sweep {
    /// Place in [`Scene::agents`].
    pub agent: usize,
    pub stamp: Nanos,
    pub map_from_body: Isometry3<f64>,
    /// In the body frame.
    pub cloud: PointCloud,
    /// In the body frame, without the agent itself.
    pub boxes: Vec<Box3>,
    /// The agent's own points on each box, where the log counts them.
    pub points: Option<Vec<u32>>,
    /// Whether the frame is scored.
    pub is_scored: bool,
}

/// Sweeps and boxes that were left out.
#[derive(Default)]
pub struct LeftOut {
    without_boxes: u64,
    without_pose: u64,
    without_way: u64,
    /// Boxes that are the agent itself.
    itself: u64,
}

impl LeftOut {
    /// A line for each cause.
    pub fn lines(&self, labels: LabelSource) -> Vec<String> {
        let stream = stream_of(labels).as_str();
        let causes = [
            (self.without_boxes, format!("without `{stream}` at their stamps")),
            (self.without_pose, "without a pose within 150 ms".into()),
            (self.without_way, "without a transform to the body frame".into()),
        ];
        let lines = causes.iter().filter(|(count, _)| *count > 0);
        let lines = lines.map(|(count, cause)| format!("{count} sweeps {cause}"));
        let itself = format!(
            "{} boxes centred in the outline of their agent, which are the agent itself",
            self.itself
        );
        lines.chain((self.itself > 0).then_some(itself)).collect()
    }
}

fn stream_of(labels: LabelSource) -> Stream {
    match labels {
        LabelSource::Truth => Stream::GroundTruth,
        LabelSource::Own => Stream::OwnLabels,
    }
}

fn info_of(labels: LabelSource) -> Stream {
    match labels {
        LabelSource::Truth => Stream::GroundTruthInfo,
        LabelSource::Own => Stream::OwnLabelsInfo,
    }
}

impl SceneAgent {
    /// LiDAR from body: the LiDAR is straight above the body's origin.
    pub fn lidar_from_body(&self) -> Isometry3<f64> {
        Translation3::new(0.0, 0.0, -self.height).into()
    }

    /// Points in the frame of the LiDAR.
    pub fn in_lidar(&self, cloud: &PointCloud) -> Vec<[f32; 3]> {
        let points = cloud.x.iter().zip(cloud.y.iter()).zip(cloud.z.iter());
        let lower = |z: f32| (f64::from(z) - self.height) as f32;
        points.map(|((x, y), z)| [*x, *y, lower(*z)]).collect()
    }

    /// What importers may take for the agent itself, m: [x min, x max, y min, y max].
    pub fn outline(&self) -> [f64; 4] {
        match self.kind {
            AgentKind::Vehicle => self.stated_footprint.unwrap_or(NO_FOOTPRINT),
            AgentKind::Roadside => NOTHING,
        }
    }

    /// A sweep's cloud where its points are at the stamp. Points on the agent itself move with it and stay. `None`: the motion over
    /// the sweep is not known.
    pub fn at_stamp(&self, stamp: Nanos, cloud: &PointCloud) -> Option<PointCloud> {
        let times = || cloud.time.iter().copied();
        let (Some(first), Some(last)) = (times().min(), times().max()) else {
            return Some(cloud.clone());
        };
        if (first, last) == (0, 0) {
            return Some(cloud.clone());
        }
        let motion = Motion::new(&self.track, stamp, first.into(), last.into())?;
        let [mut x, mut y, mut z] = motion.at_stamp([&cloud.x, &cloud.y, &cloud.z], &cloud.time);
        for (index, (own_x, own_y)) in cloud.x.iter().zip(cloud.y.iter()).enumerate() {
            if self.is_itself([f64::from(*own_x), f64::from(*own_y), 0.0]) {
                (x[index], y[index], z[index]) = (*own_x, *own_y, cloud.z[index]);
            }
        }
        Some(PointCloud {
            x: x.into(),
            y: y.into(),
            z: z.into(),
            ..cloud.clone()
        })
    }

    fn is_itself(&self, [x, y, _]: [f64; 3]) -> bool {
        let [x0, x1, y0, y1] = self.stated_footprint.unwrap_or(NO_FOOTPRINT);
        self.kind == AgentKind::Vehicle && (x0..=x1).contains(&x) && (y0..=y1).contains(&y)
    }
}

impl<'a> Scene<'a> {
    /// Looks at a log: its agents, the times of its sweeps, and the tracks of its boxes.
    ///
    /// # Errors
    /// An agent that is not there; no clouds, poses or boxes.
    pub fn open(log: &'a Log, options: &'a Options) -> Result<Self, ExportError> {
        let names = chosen(log, options)?;
        let labels = stream_of(options.labels);
        if !names.iter().any(|name| log.has(name, labels)) {
            let next = match options.labels {
                LabelSource::Truth => {
                    "add ground truth to the log (docs/guide/your-data.md), or take --labels own where it has own labels"
                }
                LabelSource::Own => "take --labels truth",
            };
            let reason = format!(
                "topic `{}`: expected boxes of at least one agent, found none; {next}",
                labels.topic(&names[0])
            );
            return Err(ExportError::unfit(log.path(), reason));
        }
        let mut agents = Vec::new();
        for name in &names {
            agents.push(agent(log, name, options)?);
        }
        let mut scene = Scene {
            log,
            options,
            agents,
            first: 0,
            period: 1,
            sweeps: 0,
            tracks: BTreeSet::new(),
        };
        scene.look_at_stamps()?;
        scene.look_at_tracks()?;
        Ok(scene)
    }

    fn look_at_stamps(&mut self) -> Result<(), ExportError> {
        let wanted: Vec<_> = self.names().map(|name| (name, Stream::Points)).collect();
        let mut stamps: BTreeMap<String, Vec<Nanos>> = BTreeMap::new();
        let mut reader = self.log.read_all(&wanted)?;
        while let Some(entry) = reader.next()? {
            stamps.entry(entry.agent.to_string()).or_default().push(entry.stamp());
        }
        self.first = stamps.values().flatten().copied().min().unwrap_or(0);
        self.sweeps = stamps.values().map(|stamps| stamps.len() as u64).sum();
        let mut steps: Vec<Nanos> = Vec::new();
        for stamps in stamps.values_mut() {
            stamps.sort_unstable();
            steps.extend(stamps.windows(2).map(|pair| pair[1] - pair[0]));
        }
        steps.sort_unstable();
        self.period = steps.get(steps.len() / 2).copied().unwrap_or(100_000_000).max(1);
        Ok(())
    }

    /// All tracks, and which of them vehicles of the log have in the boxes of others.
    fn look_at_tracks(&mut self) -> Result<(), ExportError> {
        let stream = stream_of(self.options.labels);
        let wanted: Vec<_> = self.names().map(|name| (name, stream)).collect();
        let wanted: Vec<_> = wanted
            .into_iter()
            .filter(|(name, stream)| self.log.has(name, *stream))
            .collect();
        let mut votes: Vec<BTreeMap<u64, usize>> = vec![BTreeMap::new(); self.agents.len()];
        let mut reader = self.log.read_all(&wanted)?;
        let (mut tracks, mut classes) = (BTreeSet::new(), BTreeSet::new());
        while let Some(entry) = reader.next()? {
            let boxes = entry.boxes()?.0;
            for object in &boxes {
                if !classes.contains(&*object.class) {
                    classes.insert(object.class.to_string());
                }
            }
            tracks.extend(boxes.iter().filter_map(|object| object.track));
            let at = self.agents.iter().find(|agent| agent.name == *entry.agent);
            let Some(map_from_body) = at.and_then(|agent| agent.track.at(entry.stamp())) else {
                continue;
            };
            for (agent, votes) in self.agents.iter().zip(&mut votes) {
                let Some(there) = agent.track.at(entry.stamp()) else {
                    continue;
                };
                let own_from_body = there.inv_mul(&map_from_body);
                for object in &boxes {
                    let center: [f64; 3] = (own_from_body * Point3::from(object.center)).into();
                    if let Some(track) = object.track.filter(|_| agent.is_itself(center)) {
                        *votes.entry(track).or_default() += 1;
                    }
                }
            }
        }
        drop(wanted);
        self.tracks = tracks;
        self.has_a_class(&classes)?;
        for (agent, votes) in self.agents.iter_mut().zip(votes) {
            agent.own_track = votes
                .into_iter()
                .max_by_key(|(_, count)| *count)
                .map(|(track, _)| track);
        }
        Ok(())
    }

    /// Refuses classes of which no box is.
    fn has_a_class(&self, classes: &BTreeSet<String>) -> Result<(), ExportError> {
        if classes.is_empty() || classes.iter().any(|class| self.options.wants_class(class)) {
            return Ok(());
        }
        let has: Vec<&str> = classes.iter().map(String::as_str).collect();
        Err(ExportError::Option(format!(
            "--classes: no box of `{}` is of the class {}; there are {}",
            self.log.path().display(),
            self.options.classes.join(", ").escape_debug(),
            has.join(", ").escape_debug()
        )))
    }

    fn names(&self) -> impl Iterator<Item = &str> {
        self.agents.iter().map(|agent| agent.name.as_str())
    }

    /// Number of the frame that is nearest to a stamp, from 0.
    pub fn frame_of(&self, stamp: Nanos) -> u64 {
        let since = stamp.saturating_sub(self.first).max(0);
        (since.saturating_add(self.period / 2) / self.period) as u64
    }

    /// Calls `each` with all sweeps, roughly in the order of time, and `report` with sweeps that were read, and all.
    ///
    /// # Errors
    /// A log that cannot be read; why `each` failed.
    pub fn each_sweep(
        &self,
        report: &mut dyn FnMut(u64, u64),
        mut each: impl FnMut(Sweep) -> Result<(), ExportError>,
    ) -> Result<LeftOut, ExportError> {
        let [labels, info] = [stream_of(self.options.labels), info_of(self.options.labels)];
        let all = self
            .names()
            .flat_map(|name| [Stream::Points, labels, info].map(|stream| (name, stream)));
        let wanted: Vec<_> = all.filter(|(name, stream)| self.log.has(name, *stream)).collect();
        let mut waiting: Vec<BTreeMap<Nanos, Parts>> = self.agents.iter().map(|_| BTreeMap::new()).collect();
        let (mut left_out, mut done) = (LeftOut::default(), 0);
        report(0, self.sweeps);
        let mut reader = self.log.read_all(&wanted)?;
        while let Some(entry) = reader.next()? {
            let Some(index) = self.agents.iter().position(|agent| agent.name == *entry.agent) else {
                continue;
            };
            let (agent, stamp) = (&self.agents[index], entry.stamp());
            let parts = waiting[index].entry(stamp).or_default();
            match entry.stream {
                Stream::Points => {
                    match entry.cloud() {
                        Ok(cloud) => parts.cloud = Some(cloud),
                        Err(LogError::Unplaced { .. }) => left_out.without_way += 1,
                        Err(error) => return Err(error.into()),
                    }
                    done += 1;
                    report(done, self.sweeps);
                }
                stream if stream == labels => parts.boxes = Some(entry.boxes()?),
                _ => {
                    if let Some(boxes) = &mut parts.boxes {
                        let info = entry.info(boxes)?;
                        parts.points = own_points(&info, &agent.name);
                        (parts.has_info, parts.is_unscored) = (true, !info.key);
                    }
                }
            }
            if parts.are_complete(agent)
                && let Some(parts) = waiting[index].remove(&stamp)
            {
                match self.sweep(index, stamp, parts) {
                    Some((sweep, itself)) => {
                        left_out.itself += itself;
                        each(sweep)?;
                    }
                    None => left_out.without_pose += 1,
                }
            }
            while waiting[index].len() > WAITING
                && let Some((_, parts)) = waiting[index].pop_first()
            {
                left_out.without_boxes += u64::from(parts.cloud.is_some());
            }
        }
        let rest = waiting.iter().flat_map(BTreeMap::values);
        left_out.without_boxes += rest.filter(|parts| parts.cloud.is_some()).count() as u64;
        Ok(left_out)
    }

    /// A sweep, and how many wanted boxes are the agent itself.
    fn sweep(&self, index: usize, stamp: Nanos, parts: Parts) -> Option<(Sweep, u64)> {
        let agent = &self.agents[index];
        let boxes = parts.boxes.unwrap_or_default().0;
        let of_class = boxes.iter().filter(|object| self.options.wants_class(&object.class));
        let itself = of_class.filter(|object| agent.is_itself(object.center)).count() as u64;
        let is_wanted = |object: &Box3| !agent.is_itself(object.center) && self.options.wants_class(&object.class);
        let wanted: Vec<bool> = boxes.iter().map(is_wanted).collect();
        let points = parts.points.filter(|points| points.len() == boxes.len());
        let sweep = Sweep {
            agent: index,
            stamp,
            map_from_body: agent.track.at(stamp)?,
            cloud: parts.cloud?,
            boxes: chosen_of(boxes, &wanted),
            points: points.map(|points| chosen_of(points, &wanted)),
            is_scored: !parts.is_unscored,
        };
        Some((sweep, itself))
    }
}

/// What was read of a sweep so far.
#[derive(Default)]
struct Parts {
    cloud: Option<PointCloud>,
    boxes: Option<Boxes>,
    points: Option<Vec<u32>>,
    has_info: bool,
    is_unscored: bool,
}

/// The points of one agent on each box.
fn own_points(info: &BoxesInfo, agent: &str) -> Option<Vec<u32>> {
    let column = info.agents.iter().position(|name| **name == *agent)?;
    let counts = info.points.as_ref()?.chunks_exact(info.agents.len());
    Some(counts.map(|row| row[column]).collect())
}

/// The items that are wanted.
fn chosen_of<T>(items: Vec<T>, wanted: &[bool]) -> Vec<T> {
    let pairs = items.into_iter().zip(wanted);
    pairs.filter_map(|(item, wanted)| wanted.then_some(item)).collect()
}

impl Parts {
    fn are_complete(&self, agent: &SceneAgent) -> bool {
        let has_boxes = !agent.has_labels || (self.boxes.is_some() && (self.has_info || !agent.has_info));
        self.cloud.is_some() && has_boxes
    }
}

/// The agents that are wanted, vehicles first as in the layouts.
fn chosen(log: &Log, options: &Options) -> Result<Vec<String>, ExportError> {
    options.agents.iter().try_for_each(|name| log.need_agent(name))?;
    let info = log.info();
    let is_wanted = |name: &str| options.agents.is_empty() || options.agents.iter().any(|wanted| wanted == name);
    let mut agents: Vec<_> = info.agents.iter().filter(|agent| is_wanted(&agent.name)).collect();
    agents.sort_by_key(|agent| agent.kind);
    let with_clouds = agents.iter().filter(|agent| log.has(&agent.name, Stream::Points));
    let names: Vec<String> = with_clouds.map(|agent| agent.name.clone()).collect();
    if names.is_empty() {
        let of: Vec<&str> = agents.iter().map(|agent| agent.name.as_str()).collect();
        let reason = format!(
            "topic `/AGENT/points`: expected clouds of at least one of the agents {}, found none; record or simulate the log with clouds, \
             or see what it has by `realo info`",
            of.join(", ")
        );
        return Err(ExportError::unfit(log.path(), reason));
    }
    Ok(names)
}

fn agent(log: &Log, name: &str, options: &Options) -> Result<SceneAgent, ExportError> {
    let info = log.info().agent(name);
    let stream = match log.has(name, Stream::PoseTruth) {
        true => Stream::PoseTruth,
        false => Stream::Pose,
    };
    log.need(name, stream)?;
    let stated = info.and_then(|info| Some(info.sensor_position?[2]));
    let labels = stream_of(options.labels);
    Ok(SceneAgent {
        name: name.into(),
        kind: info.map_or(AgentKind::Vehicle, |info| info.kind),
        height: options.height_m.or(stated).unwrap_or(USUAL_HEIGHT),
        is_height_known: options.height_m.or(stated).is_some(),
        track: pose_track(log, name, stream, MAX_GAP)?,
        own_track: None,
        tilt: tilt(log, name, stream)?,
        stated_footprint: info.and_then(|info| info.footprint),
        has_labels: log.has(name, labels),
        has_info: log.has(name, info_of(options.labels)),
    })
}

fn tilt(log: &Log, name: &str, stream: Stream) -> Result<f64, ExportError> {
    let (mut reader, mut most) = (log.read_all(&[(name, stream)])?, 0.0_f64);
    while let Some(entry) = reader.next()? {
        // What is no pose is not taken for one by the track either.
        if let Ok(state) = entry.pose() {
            most = most.max(tilt_degrees(&state.map_from_body.rotation));
        }
    }
    Ok(if most < LEVEL { 0.0 } else { most })
}

/// A box in the map: the pose of its middle.
pub fn map_from_object(map_from_body: &Isometry3<f64>, object: &Box3) -> Isometry3<f64> {
    let turn = nalgebra::UnitQuaternion::from_axis_angle(&Vector3::z_axis(), object.yaw);
    let [x, y, z] = object.center;
    map_from_body * Isometry3::from_parts(Translation3::new(x, y, z), turn)
}

/// The middle of a box in the map.
pub fn center_in_map(map_from_body: &Isometry3<f64>, object: &Box3) -> Point3<f64> {
    transform_box(map_from_body, object).center.into()
}

/// Along its heading, m/s, and how much goes aside or up.
pub fn speed(object: &Box3) -> Option<(f64, f64)> {
    let [x, y, z] = object.velocity?;
    let (sin, cos) = libm::sincos(object.yaw);
    Some((x * cos + y * sin, libm::hypot(y * cos - x * sin, z)))
}
