//! OPV2V: `AGENT/000000.yaml` with `.pcd` beside it, in CARLA's left-handed world.

mod cloud;
mod labels;
mod poses;

use std::collections::{BTreeMap, BTreeSet};

use realo_logs::{AgentKind, Log};
use realo_schemas::{Nanos, PointCloud};

use self::cloud::pcd;
use self::labels::{Ids, yaml};
use super::{Exporter, Kind, Report};
use crate::lost::{self, Lost};
use crate::scene::{Scene, SceneAgent, Sweep, speed};
use crate::{ExportError, Exported, ExportedAgent, Folder, Options};

/// OPV2V.
pub struct Opv2v;

static KIND: Kind = Kind {
    name: "opv2v",
    title: "OPV2V's layout, a scene of all agents",
    writes: "AGENT/000000.yaml (pose, boxes) and AGENT/000000.pcd for each sweep, and AGENT/poses.csv for the import",
    unit: "sweeps",
    options: &[
        ("agents", ""),
        ("classes", ""),
        ("labels", "truth"),
        ("motion", "removed"),
        ("height", ""),
    ],
};

/// Where what the layout has no place for is nevertheless.
const ASIDE: &str = "there for `realo-lab import`, other readers skip it";

impl Exporter for Opv2v {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn write(
        &self,
        log: &Log,
        folder: &mut Folder,
        options: &Options,
        report: Report,
    ) -> Result<Exported, ExportError> {
        let scene = Scene::open(log, options)?;
        let folders = folders(&scene);
        let mut writing = Writing::new(&scene, folders);
        let left_out = scene.each_sweep(report, |sweep| writing.sweep(folder, &sweep))?;
        writing.need_any()?;
        writing.poses(folder)?;
        let mut exported = writing.exported();
        exported.left_out.splice(0..0, left_out.lines(options.labels));
        Ok(exported)
    }
}

/// The folder of each agent: of a vehicle its track in the boxes of others, so that it is known among them; of a roadside unit a
/// negative number.
fn folders(scene: &Scene) -> Vec<String> {
    let mut taken: BTreeSet<u64> = scene.tracks.clone();
    let mut own = BTreeSet::new();
    let mut roadside = 0;
    let mut folder = |agent: &SceneAgent| {
        if agent.kind == AgentKind::Roadside {
            roadside += 1;
            return format!("-{roadside}");
        }
        if let Some(track) = agent.own_track.filter(|track| own.insert(*track)) {
            return track.to_string();
        }
        let digits: String = agent.name.chars().filter(char::is_ascii_digit).take(9).collect();
        let wanted: u64 = digits.parse().unwrap_or(1);
        let free = (wanted..).find(|number| taken.insert(*number)).unwrap_or(wanted);
        free.to_string()
    };
    scene.agents.iter().map(&mut folder).collect()
}

/// A line of what the layout does not hold, with where it is nevertheless: `poses.csv` has all poses, and clouds whose motion was
/// kept have the times of points.
fn aside(lost: Lost, keeps_motion: bool) -> String {
    match lost {
        Lost::PosesBetween | Lost::BelievedPoses => format!("{lost} (times and poses: {ASIDE})"),
        Lost::PointTimes if keeps_motion => format!("{lost} (times and poses: {ASIDE})"),
        other => other.to_string(),
    }
}

struct Writing<'a> {
    scene: &'a Scene<'a>,
    agents: Vec<ExportedAgent>,
    folders: Vec<String>,
    ids: Ids,
    /// The next number of each agent that is free.
    next: Vec<u64>,
    frames: BTreeSet<u64>,
    /// By how much a stamp differs from its frame's at most.
    apart: Nanos,
    /// What velocities have aside, m/s, at most.
    aside: f64,
    /// Sweeps whose points are as they were measured, for the motion during them is not known.
    unmoved: u64,
}

impl<'a> Writing<'a> {
    fn new(scene: &'a Scene, folders: Vec<String>) -> Self {
        let agent = |(agent, folder): (&SceneAgent, &String)| ExportedAgent {
            name: agent.name.clone(),
            place: format!("folder `{folder}`"),
            height_m: Some(agent.height),
            ..ExportedAgent::default()
        };
        Writing {
            agents: scene.agents.iter().zip(&folders).map(agent).collect(),
            next: vec![0; folders.len()],
            ids: Ids::new(&scene.tracks, &folders),
            folders,
            scene,
            frames: BTreeSet::new(),
            apart: 0,
            aside: 0.0,
            unmoved: 0,
        }
    }

    /// The cloud as it is written.
    fn cloud(&mut self, sweep: &Sweep) -> PointCloud {
        if self.scene.options.keeps_motion {
            return sweep.cloud.clone();
        }
        let moved = self.scene.agents[sweep.agent].at_stamp(sweep.stamp, &sweep.cloud);
        self.unmoved += u64::from(moved.is_none());
        moved.unwrap_or_else(|| sweep.cloud.clone())
    }

    fn sweep(&mut self, folder: &mut Folder, sweep: &Sweep) -> Result<(), ExportError> {
        let scene = self.scene;
        let agent = &scene.agents[sweep.agent];
        let number = scene.frame_of(sweep.stamp).max(self.next[sweep.agent]);
        self.next[sweep.agent] = number + 1;
        self.frames.insert(number);
        let of_frame = scene.first.saturating_add(scene.period.saturating_mul(number as Nanos));
        self.apart = self.apart.max((sweep.stamp - of_frame).abs());
        let ids = self.ids.of(number, sweep);
        let cloud = self.cloud(sweep);
        let times = scene.options.keeps_motion.then_some(&*cloud.time);
        let file = |end: &str| format!("{}/{number:06}.{end}", self.folders[sweep.agent]);
        folder.write(&file("yaml"), yaml(agent, sweep, &ids).as_bytes())?;
        folder.write(&file("pcd"), &pcd(&agent.in_lidar(&cloud), &cloud.intensity, times))?;
        let speeds = sweep.boxes.iter().filter_map(speed);
        self.aside = speeds.fold(self.aside, |most, (_, aside)| most.max(aside));
        let summary = &mut self.agents[sweep.agent];
        summary.sweeps += 1;
        summary.points += sweep.cloud.len();
        summary.boxes += sweep.boxes.len();
        Ok(())
    }

    fn poses(&self, folder: &mut Folder) -> Result<(), ExportError> {
        for (agent, place) in self.scene.agents.iter().zip(&self.folders) {
            let table = poses::table(self.scene.log, &agent.name)?;
            folder.write(&format!("{place}/{}", poses::FILE), table.as_bytes())?;
        }
        Ok(())
    }

    fn need_any(&self) -> Result<(), ExportError> {
        match self.frames.is_empty() {
            false => Ok(()),
            true => Err(ExportError::unfit(
                self.scene.log.path(),
                "expected sweeps with points, a pose and boxes at one stamp, found none; see `realo info`",
            )),
        }
    }

    fn exported(self) -> Exported {
        let Writing { scene, .. } = self;
        let rate = 1e9 / scene.period as f64;
        let mut assumed = lost::assumed_heights(scene);
        assumed.push(format!(
            "a frame is {:.4} s, which is what the sweeps of the log are apart",
            1.0 / rate
        ));
        let names: BTreeMap<&str, &str> = scene
            .agents
            .iter()
            .zip(&self.folders)
            .map(|(agent, folder)| (agent.name.as_str(), folder.as_str()))
            .collect();
        let names: Vec<String> = names
            .iter()
            .map(|(name, folder)| format!("{name} is `{folder}`"))
            .collect();
        let mut lines = vec![
            format!("names of agents: {} ({ASIDE})", names.join(", ")),
            format!(
                "stamps: frame 0 is at {} ns, and sweeps are up to {:.3} ms from their frames ({ASIDE})",
                scene.first,
                self.apart as f64 / 1e6
            ),
            format!("outlines of vehicles ({ASIDE}), and words about sensors"),
        ];
        if self.aside > 0.0 {
            lines.push(format!("velocities beside the heading, up to {:.2} m/s", self.aside));
        }
        if self.ids.without_track > 0 {
            let count = self.ids.without_track;
            lines.push(format!(
                "that {count} boxes have no track: each has an id of its own for one frame"
            ));
        }
        if self.unmoved > 0 {
            let sweeps = self.unmoved;
            assumed.push(format!(
                "the points of {sweeps} sweeps are as they were measured: the log has no poses over the whole of those sweeps"
            ));
        }
        let keeps_motion = scene.options.keeps_motion;
        lines.extend(lost::of_frames(scene).into_iter().map(|lost| aside(lost, keeps_motion)));
        let mut command = "realo-lab import opv2v PATH -o LOG.mcap".to_string();
        let is_open = |agent: &&SceneAgent| agent.kind == AgentKind::Vehicle && agent.stated_footprint.is_none();
        let vehicles = scene.agents.iter().filter(is_open);
        command += &lost::footprint(vehicles).unwrap_or_default();
        if (rate - 10.0).abs() > 0.005 {
            command += &format!(" --rate {rate:.3}");
        }
        if scene.agents.iter().any(|agent| agent.tilt > 0.0) {
            command += " --level none";
        }
        Exported {
            agents: self.agents,
            assumed,
            lost: lines,
            read_back: command,
            ..Exported::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_and_kept_times_are_there_for_the_import() {
        let said = |lost, keeps_motion| aside(lost, keeps_motion).contains(ASIDE);
        for keeps_motion in [true, false] {
            assert!(said(Lost::PosesBetween, keeps_motion) && said(Lost::BelievedPoses, keeps_motion));
            assert_eq!(said(Lost::PointTimes, keeps_motion), keeps_motion);
            for lost in [Lost::Detections, Lost::Views, Lost::Packets, Lost::MapOrigin] {
                assert_eq!(aside(lost, keeps_motion), lost.to_string());
            }
        }
    }
}
