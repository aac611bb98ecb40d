//! The data set's side: classes, who takes part, and whole frames from label files and clouds to pillars and truth.
//!
//! A vector's scene is written in V2X-Real's layout and imported as users import theirs. What takes part, what is in reach,
//! what comes late and where agents believe to be is then said by the player's plan, the link, the bank and localization.

mod frame;
mod scene;

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use realo_logs::AgentKind;
use realo_player::{Coop, PlannedRun, plan};
use realo_schemas::geometry::relative;
use realo_scoring::Protocol;
use serde::Deserialize;

use self::scene::{Document, LabelFile, Recording, Sweep, Vehicle, Workspace};
use crate::Kind;
use crate::reference::pose_of;
use crate::vector::{Vector, compare, equal};

pub(crate) const KINDS: &[Kind] = &[
    Kind::new(&["raw_to_super", "super_class_id"], class_map),
    Kind::new(&["folders", "test_mode"], modes),
    Kind::new(&["agents_in_order"], label_files),
    Kind::new(
        &["out.coords_bzyx", "out.prior_encoding", "out.record_len"],
        frame::frame,
    ),
];

/// How near places and sizes of a log must be to those of label files, m.
const EXACT: f64 = 1e-9;

#[derive(Deserialize)]
struct ClassMap {
    super_class_id: BTreeMap<String, u8>,
    raw_to_super: BTreeMap<String, String>,
    #[serde(default)]
    unmapped_examples_dropped: Vec<String>,
}

/// The protocol's classes.
fn class_map(vector: &Vector) -> Result<(), String> {
    let map: ClassMap = vector.json(None)?;
    let protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let number = |name: &str| protocol.class_of(name).map(|class| class + 1);
    for (raw, of) in &map.raw_to_super {
        let expected = map.super_class_id.get(of).copied();
        equal(&format!("class of {raw}"), &[number(raw)], &[expected])?;
    }
    // Any name that is a super-class's but for its letter case belongs to it.
    for (name, id) in &map.super_class_id {
        for raw in [name.clone(), name.to_uppercase()] {
            equal(&format!("class of {raw}"), &[number(&raw)], &[Some(*id)])?;
        }
    }
    for raw in &map.unmapped_examples_dropped {
        equal(&format!("class of {raw}"), &[number(raw)], &[None])?;
    }
    Ok(())
}

/// A mode of the reference: who is the ego, who collaborates, and which scenes are left out.
struct Mode {
    coop: Coop,
    ego: AgentKind,
    /// Whether scenes without roadside units are left out by their date.
    without: Option<&'static str>,
}

impl Mode {
    fn of(name: &str) -> Result<Self, String> {
        let (coop, ego, without) = match name {
            "vc" => (Coop::All, AgentKind::Vehicle, Some(VEHICLES_ONLY)),
            "ic" => (Coop::All, AgentKind::Roadside, Some(VEHICLES_ONLY)),
            "v2v" => (Coop::V2v, AgentKind::Vehicle, None),
            "i2i" => (Coop::I2i, AgentKind::Roadside, Some(VEHICLES_ONLY)),
            other => return Err(format!("there is no mode `{other}`")),
        };
        Ok(Mode { coop, ego, without })
    }

    /// The run of a log's first ego of the mode.
    fn run(&self, recording: &Recording) -> Result<PlannedRun, String> {
        let agents = &recording.log.info().agents;
        let ego = agents.iter().find(|agent| agent.kind == self.ego);
        let ego = ego.ok_or_else(|| format!("the log has no {}", self.ego.as_str()))?;
        let plan = plan(&recording.log, &ego.name, self.coop, &[]).map_err(|error| error.to_string())?;
        let first = plan.runs.into_iter().next();
        first.ok_or_else(|| "the plan has no run".into())
    }
}

/// The day whose scenes have no roadside unit.
const VEHICLES_ONLY: &str = "2023-04-07";

#[derive(Deserialize)]
struct Modes {
    folders: BTreeMap<String, Vec<String>>,
    test_mode: BTreeMap<String, Taking>,
}

/// Who takes part in a mode.
#[derive(Deserialize)]
struct Taking {
    scenarios: Vec<String>,
    agents_ego_first: Vec<Vec<String>>,
    frames: usize,
}

/// Scenes, egos and collaborators. The order of collaborators decides nothing: fusion takes the nearest, and orders them
/// by name.
fn modes(vector: &Vector) -> Result<(), String> {
    let modes: Modes = vector.json(None)?;
    let workspace = Workspace::new()?;
    for (scene, agents) in &modes.folders {
        for agent in agents {
            for frame in FRAMES {
                workspace.write([scene, agent, frame], &nothing(), &[[1.0; 4]])?;
            }
        }
    }
    for (name, expected) in &modes.test_mode {
        taking(&workspace, name, expected).map_err(|difference| format!("{name}: {difference}"))?;
    }
    Ok(())
}

/// Frames of the scenes of modes.
const FRAMES: [&str; 3] = ["000000", "000001", "000002"];

fn nothing() -> LabelFile {
    LabelFile {
        lidar_pose: [0.0; 6],
        vehicles: BTreeMap::new(),
        rest: BTreeMap::new(),
    }
}

fn taking(workspace: &Workspace, name: &str, expected: &Taking) -> Result<(), String> {
    let mode = Mode::of(name)?;
    let set: Vec<(&str, &str)> = mode.without.map(|words| ("without", words)).into_iter().collect();
    let (mut agents, mut frames) = (BTreeMap::new(), 0);
    for (scene, recording) in workspace.import(&set)? {
        let run = mode.run(&recording)?;
        let folders = run.agents().map(|agent| recording.folder(agent));
        let folders = folders.collect::<Result<Vec<&str>, String>>()?;
        frames += recording.of(folders[0])?.len();
        agents.insert(scene, ego_first(&folders));
    }
    let order = expected.agents_ego_first.iter().map(|agents| ego_first(agents));
    let wanted: BTreeMap<String, (String, Vec<String>)> = expected.scenarios.iter().cloned().zip(order).collect();
    equal("scenes and agents", &Vec::from_iter(agents), &Vec::from_iter(wanted))?;
    equal("frames", &[frames], &[expected.frames])
}

/// The ego, and the others in order of their names.
fn ego_first<T: ToString>(agents: &[T]) -> (String, Vec<String>) {
    let mut names: Vec<String> = agents.iter().map(T::to_string).collect();
    let ego = names.remove(0);
    names.sort();
    (ego, names)
}

/// Label files through the importer: poses and own boxes of every frame.
fn label_files(vector: &Vector) -> Result<(), String> {
    let document: Document = vector.json(None)?;
    let workspace = Workspace::new()?;
    for agent in &document.agents_in_order {
        for (frame, labels) in &agent.frames {
            workspace.write(["scene", &agent.agent, frame], labels, &[[1.0; 4]])?;
        }
    }
    let imported = workspace.import(&[])?;
    let (_, recording) = imported.first().ok_or("no scene was imported")?;
    for agent in &document.agents_in_order {
        let sweeps = recording.of(&agent.agent)?;
        equal("number of frames", &[sweeps.len()], &[agent.frames.len()])?;
        for (sweep, (frame, labels)) in sweeps.values().zip(&agent.frames) {
            as_labelled(sweep, labels).map_err(|difference| format!("{}/{frame}: {difference}", agent.agent))?;
        }
    }
    Ok(())
}

fn as_labelled(sweep: &Sweep, labels: &LabelFile) -> Result<(), String> {
    let expected = pose_of(labels.lidar_pose);
    let numbers = |pose: &Isometry3<f64>| pose.to_homogeneous().as_slice().to_vec();
    compare("pose", &numbers(&sweep.map_from_lidar), &numbers(&expected), EXACT)?;
    let lidar_from_map = relative(&expected, &Isometry3::identity());
    equal("number of labels", &[sweep.own.len()], &[labels.vehicles.len()])?;
    for (id, vehicle) in &labels.vehicles {
        let track = id.parse().ok();
        let found = sweep.own.iter().find(|object| object.track == track);
        let found = found.ok_or_else(|| format!("object {id} is not among the own labels"))?;
        let (place, sizes) = placed(vehicle, &lidar_from_map);
        let size = [found.length, found.width, found.height];
        compare(&format!("place of object {id}"), &found.center, &place, EXACT)?;
        compare(&format!("size of object {id}"), &size, &sizes, EXACT)?;
        equal(
            &format!("class of object {id}"),
            &[&*found.class],
            &[&*vehicle.obj_type],
        )?;
    }
    Ok(())
}

/// The middle and the size of an object.
fn placed(vehicle: &Vehicle, lidar_from_map: &Isometry3<f64>) -> ([f64; 3], [f64; 3]) {
    let ([x, y, z], [roll, yaw, pitch]) = (vehicle.location, vehicle.angle);
    let middle = pose_of([x, y, z, roll, yaw, pitch]) * nalgebra::Point3::from(vehicle.center);
    ((lidar_from_map * middle).into(), vehicle.extent.map(|half| 2.0 * half))
}
