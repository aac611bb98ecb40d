//! Reads the sweeps of a frame and brings them into body frames.

use nalgebra::Isometry3;
use realo_schemas::geometry::{LARGEST_M, View, tilt_degrees};
use realo_schemas::{Nanos, PointCloud};

use super::known::Known;
use super::truth::Labelled;
use super::write::SceneImport;
use super::{Label, RawSweep, Scene, SweepFiles, TruthOf};
use crate::clouds::BodyCloud;
use crate::faults::{FaultsOfSweep, FileKind};
use crate::level::body_from_sensor;
use crate::{ImportError, Options};

/// Labels are no farther from their agent, m.
const LABELLED: f64 = 1000.0;

/// A sweep in its body frame.
pub struct BodySweep {
    pub agent: usize,
    pub stamp: Nanos,
    pub tilt: f64,
    pub cloud: PointCloud,
    pub limited: usize,
    pub dropped: usize,
    /// What its pose is of in truth, if not of the LiDAR.
    pub pose_of: Option<&'static str>,
    pub view: Option<View>,
    pub is_unscored: bool,
    /// Whether its files say its stamp.
    pub is_stamped: bool,
    /// What it is scored against; views in the body frame.
    pub truth: TruthOf,
    /// What is strange in its files.
    pub noted: Vec<(&'static str, String)>,
}

/// A frame: the sweeps and the labels of its agents, in one order.
pub type Frame = (Vec<BodySweep>, Vec<Labelled>);

impl SceneImport<'_> {
    /// All sweeps of a frame, or all that is wrong with them.
    pub fn frame(&self, number: u64, known: &[Known]) -> Result<Frame, FaultsOfSweep> {
        let (mut sweeps, mut labels, mut faults) = (Vec::new(), Vec::new(), FaultsOfSweep::default());
        for (index, agent) in self.scene.agents.iter().enumerate() {
            let Some(files) = agent.sweeps.get(&number) else {
                continue;
            };
            let read = self.layout.sweep(files, self.options);
            let read =
                read.and_then(|raw| self.place(index, self.clock.stamp(number, files), files, raw, &known[index]));
            match read {
                Ok((sweep, labelled)) => {
                    sweeps.push(sweep);
                    labels.push(labelled);
                }
                Err(found) => faults.0.extend(found.0),
            }
        }
        faults.or(Some((sweeps, labels)))
    }

    fn place(
        &self,
        agent: usize,
        by_clock: Nanos,
        files: &SweepFiles,
        raw: RawSweep,
        known: &Known,
    ) -> Result<(BodySweep, Labelled), FaultsOfSweep> {
        let RawSweep {
            map_from_lidar,
            pose_of,
            stated,
            points,
            labels,
            dropped,
            view,
            is_unscored,
            truth,
            noted,
        } = raw;
        let stamp = stated.stamp.unwrap_or(by_clock);
        let mut faults = FaultsOfSweep::default();
        faults.keep(FileKind::Labels, check(files, &map_from_lidar, &labels));
        faults.keep(FileKind::Labels, same_outline(files, stated.footprint, known));
        let level = self.options.level;
        let body_from_lidar = body_from_sensor(level, &map_from_lidar.rotation, known.height, &points);
        let placed = body_from_lidar.and_then(|body_from_lidar| {
            let cloud = BodyCloud::new(points, stamp, &body_from_lidar)?;
            let scale = known.brightest.scale(cloud.intensity());
            Ok((body_from_lidar, cloud.scaled_by(scale)?))
        });
        let placed = placed.map_err(|reason| ImportError::content(&files.cloud, reason));
        let placed = faults.keep(FileKind::Cloud, placed);
        let sweep = placed.map(|(body_from_lidar, (cloud, limited))| {
            let sweep = BodySweep {
                agent,
                stamp,
                tilt: tilt_degrees(&body_from_lidar.rotation),
                cloud,
                limited,
                dropped,
                pose_of,
                view: view.map(|view| view.moved(&body_from_lidar)),
                is_unscored,
                is_stamped: stated.stamp.is_some(),
                truth: truth.moved(&body_from_lidar),
                noted,
            };
            let labelled = Labelled {
                folder: self.scene.agents[agent].folder.clone(),
                map_from_body: map_from_lidar * body_from_lidar.inverse(),
                labels,
            };
            (sweep, labelled)
        });
        faults.or(sweep)
    }
}

impl TruthOf {
    /// With the views in the body frame.
    fn moved(mut self, body_from_lidar: &Isometry3<f64>) -> Self {
        if let TruthOf::Given { views, .. } = &mut self {
            for view in views {
                *view = view.moved(body_from_lidar);
            }
        }
        self
    }
}

/// Numbers of the frames that are wanted.
pub fn numbers(scene: &Scene, options: &Options) -> Vec<u64> {
    let mut numbers: Vec<u64> = scene
        .agents
        .iter()
        .flat_map(|agent| agent.sweeps.keys().copied())
        .collect();
    numbers.sort_unstable();
    numbers.dedup();
    numbers.retain(|number| options.wants_frame(*number));
    numbers
}

/// Checks that a file states the outline of its agent that the first files do: a log has one of each agent.
fn same_outline(files: &SweepFiles, stated: Option<[f64; 4]>, known: &Known) -> Result<(), ImportError> {
    let Some(stated) = stated.filter(|stated| known.footprint != Some(*stated)) else {
        return Ok(());
    };
    let first = known
        .footprint
        .map_or("no outline".into(), |first| format!("{first:?}"));
    let reason = format!(
        "footprint: expected one outline in all files of an agent, found {stated:?} here and {first} in its first files; correct it, or remove the key from all of them"
    );
    Err(ImportError::content(&files.labels, reason))
}

/// Checks that labels can be objects near their agent.
fn check(files: &SweepFiles, map_from_lidar: &Isometry3<f64>, labels: &[Label]) -> Result<(), ImportError> {
    let sensor = map_from_lidar.translation.vector;
    for Label {
        id,
        class,
        map_from_object,
        size,
        ..
    } in labels
    {
        let distance = (map_from_object.translation.vector - sensor).norm();
        let fits = size.iter().all(|metres| *metres > 0.0 && *metres <= LARGEST_M);
        if !(fits && distance <= LABELLED) {
            let place = match files.labels_in {
                "" => String::new(),
                place => format!("{place}: "),
            };
            let reason = format!(
                "{place}object `{id}` (`{class}`): expected a box of more than 0, at most {LARGEST_M} m, within {LABELLED} m of its \
                 agent, found one of {size:.2?} m (length, width, height) at {distance:.1} m; see its location and extent, and the \
                 pose of the file"
            );
            return Err(ImportError::content(&files.labels, reason));
        }
    }
    Ok(())
}
