//! A frame of the reference's data set: who is in reach, what comes late and from where, pillars, and truth.
//!
//! Clouds are brought to the ego's frame by the projector, and where they are then is corrected as a fusion does.
//! `pairwise_t_matrix` of a frame is not checked: for data in the ego's frame it moves nothing, and no graph has it.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry3;
use realo_feature_bank::Bank;
use realo_fusion::Pairing;
use realo_link::in_reach;
use realo_localization::PoseNoise;
use realo_methods::detect::pillars::{Pillariser, Points};
use realo_operator::{Operator, Outputs};
use realo_projector::{Project, Projector};
use realo_schemas::geometry::relative;
use realo_schemas::{
    AgentState, Box3, Header, Kind, Message, Name, Nanos, Payload, PointCloud, Pose, PoseStatus, Selection,
};
use realo_scoring::Protocol;
use serde::Deserialize;

use super::Mode;
use super::scene::{Document, Recording, Workspace};
use crate::boxes::{compare_boxes, corners_of};
use crate::noise::delay_of_overhead;
use crate::pillars::{OWN_BODY, points};
use crate::reference::{SLOTS, grid_of, row_of};
use crate::vector::{Tensors, Vector, compare, equal, flat};

/// Most pillars of an agent; no vector comes near it.
const MOST_PILLARS: usize = 64_000;
/// Agents for which the reference has places in its tensors.
const PLACES: usize = 4;
/// A point that no pillar takes, for sweeps of which the vector has no points: whoever takes one of them has too few.
const ELSEWHERE: [f32; 4] = [9000.0, 9000.0, 0.0, 0.0];

/// How positions are off and how late data come.
#[derive(Deserialize)]
struct Wild {
    #[serde(rename = "async")]
    is_async: bool,
    async_mode: String,
    async_overhead: f64,
    seed: u32,
    loc_err: bool,
    xyz_std: f64,
    ryp_std: f64,
}

/// What a frame's configuration says.
struct Case {
    mode: Mode,
    wild: Option<Wild>,
    frame: usize,
    reach_m: f64,
    /// Whether late data are brought to where the ego is now; else to where it was at their time.
    to_ego_now: bool,
    tolerance: f64,
    document: Document,
}

impl Case {
    fn of(vector: &Vector) -> Result<Self, String> {
        let config = &vector.entry.config;
        let wild = config.get("wild_setting").filter(|wild| !wild.is_null());
        let wild: Option<Wild> = wild
            .map(|wild| serde_json::from_value(wild.clone()))
            .transpose()
            .map_err(|error| format!("config `wild_setting`: {error}"))?;
        if let Some(wild) = wild.as_ref().filter(|wild| wild.is_async && wild.async_mode != "sim") {
            return Err(format!(
                "config `async_mode`: expected `sim`, found `{}`",
                wild.async_mode
            ));
        }
        let to_ego_now = config["cur_ego_pose_flag"].as_bool();
        Ok(Case {
            mode: Mode::of(vector.text("mode")?)?,
            wild,
            frame: vector.number("frame_index")? as usize,
            reach_m: vector.number("com_range")?,
            to_ego_now: to_ego_now.ok_or("config `cur_ego_pose_flag`: expected true or false")?,
            tolerance: vector.tolerance()?,
            document: vector.json(Some(&vector.beside(vector.text("metadata_file")?)))?,
        })
    }

    /// The delay of a collaborator's data.
    fn delay(&self) -> Nanos {
        let wild = self.wild.as_ref().filter(|wild| wild.is_async);
        wild.map_or(0, |wild| delay_of_overhead(wild.async_overhead))
    }

    /// Where a collaborator believes that it is.
    fn believed(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let Some(wild) = self.wild.as_ref().filter(|wild| wild.loc_err) else {
            return *pose;
        };
        let noise = PoseNoise {
            position_m: wild.xyz_std,
            heading_deg: wild.ryp_std,
        };
        noise.reference(wild.seed).of(pose)
    }

    /// Writes the scene. Points are of the frame that a vector gives them for.
    fn write(&self, workspace: &Workspace, tensors: &Tensors) -> Result<(), String> {
        for agent in &self.document.agents_in_order {
            let given = points(tensors, &format!("in.points_raw_agent_{}", agent.agent))?;
            let late = usize::try_from(agent.time_delay_frames).map_err(|_| "a delay is below 0".to_string())?;
            for (index, (frame, labels)) in agent.frames.iter().enumerate() {
                let points = if index + late == self.frame {
                    &given[..]
                } else {
                    &[ELSEWHERE]
                };
                workspace.write(["scene", &agent.agent, frame], labels, points)?;
            }
        }
        Ok(())
    }
}

/// An agent's part of a frame.
struct Part<'a> {
    folder: &'a str,
    /// How many frames it is late.
    late: usize,
    in_reach: bool,
    /// Its points without its own body, where data are brought to.
    cloud: PointCloud,
    /// The ego, where data are brought to, from the agent.
    ego_from_agent: Isometry3<f64>,
    /// The ego now from there.
    correction: Isometry3<f64>,
}

pub(super) fn frame(vector: &Vector) -> Result<(), String> {
    let (case, tensors) = (Case::of(vector)?, vector.tensors()?);
    let workspace = Workspace::new()?;
    case.write(&workspace, &tensors)?;
    let imported = workspace.import(&[])?;
    let (_, recording) = imported.first().ok_or("no scene was imported")?;
    let parts = parts(&case, recording)?;
    check_matrices(&case, &parts, &tensors)?;
    let near: Vec<&Part> = parts.iter().filter(|part| part.in_reach).collect();
    check_prior(&near, &tensors)?;
    check_pillars(vector, &case, &near, &tensors)?;

    // Only the labels of agents that take part are truth.
    let agents: Vec<&str> = near.iter().map(|part| part.folder).collect();
    let imported = workspace.import(&[("agents", &agents.join(","))])?;
    let (_, recording) = imported.first().ok_or("no scene was imported")?;
    let ego = recording.of(agents[0])?.values().nth(case.frame);
    check_truth(vector, &case, &ego.ok_or("the ego has no such frame")?.truth, &tensors)
}

/// Ego first, the others as the reference orders them: by kind, then by folder as a text.
fn parts<'a>(case: &Case, recording: &'a Recording) -> Result<Vec<Part<'a>>, String> {
    let run = case.mode.run(recording)?;
    let folders = run.agents().map(|agent| recording.folder(agent));
    let mut folders = folders.collect::<Result<Vec<&str>, String>>()?;
    let is_like_ego = |folder: &str| folder.starts_with('-') == folders[0].starts_with('-');
    let order: BTreeMap<&str, (bool, &str)> = folders.iter().map(|f| (*f, (!is_like_ego(f), *f))).collect();
    folders.sort_by_key(|folder| order[folder]);
    let no_frame = || format!("no agent has frame {}", case.frame);
    let ego = recording.of(folders[0])?;
    let (ego_stamp, ego_now) = ego.iter().nth(case.frame).ok_or_else(no_frame)?;
    let there = in_time(case, recording, &run.ego, *ego_stamp)?;
    let part = |folder: &&'a str| {
        let is_ego = *folder == folders[0];
        let name = &recording.names[*folder];
        let stamp = if is_ego {
            *ego_stamp
        } else {
            *there.get(name).ok_or("nothing of a collaborator is there")?
        };
        let sweeps = recording.of(folder)?;
        let sweep = sweeps.get(&stamp).ok_or_else(no_frame)?;
        let ego_then = ego.get(&stamp).ok_or_else(no_frame)?.map_from_lidar;
        let (now, pose) = (ego_now.map_from_lidar, sweep.map_from_lidar);
        let to = if case.to_ego_now { now } else { ego_then };
        let believed = if is_ego { pose } else { case.believed(&pose) };
        let place = |pose: &Isometry3<f64>| [pose.translation.x, pose.translation.y];
        let of = |agent: &str, stamp| (Name::from(agent), stamp);
        let cloud = clean(sweep.cloud.as_ref().ok_or("a sweep has no cloud")?);
        let (cloud, correction) = match is_ego {
            // The ego's points are in its frame as they are.
            true => (cloud, Isometry3::identity()),
            false => {
                let sent = projected(of(name, stamp), believed, cloud, to)?;
                (sent.1.clone(), corrected(of(&run.ego, *ego_stamp), now, sent)?)
            }
        };
        Ok(Part {
            folder,
            late: case.frame - sweeps.range(..stamp).count(),
            in_reach: in_reach(place(&now), place(&pose), case.reach_m),
            cloud,
            ego_from_agent: relative(&to, &believed),
            correction,
        })
    };
    folders.iter().map(part).collect()
}

/// Stamps of the sweeps of collaborators that the ego's bank chooses at a moment.
fn in_time(case: &Case, recording: &Recording, ego: &str, now: Nanos) -> Result<BTreeMap<String, Nanos>, String> {
    const WINDOW: Nanos = 400_000_000;
    let mut bank = Bank::new(WINDOW, false, 0, 64, WINDOW);
    let run = Name::from("vector");
    for (agent, sweeps) in &recording.sweeps {
        for (seq, (stamp, sweep)) in (0..).zip(sweeps) {
            let ready = stamp + case.delay();
            let header = Header::origin(&run, &Name::from(agent.as_str()), Kind::Points, seq, *stamp, ready);
            let cloud = sweep.cloud.clone().ok_or("a sweep has no cloud")?;
            let message = Message {
                header,
                payload: Payload::PointCloud(cloud),
            };
            bank.insert(message).map_err(|error| error.to_string())?;
        }
    }
    let query = Header::origin(&run, &Name::from(ego), Kind::Points, 0, now, now);
    let answer = bank.answer(&query, now, &BTreeSet::new());
    let chosen = answer.entries.into_iter().map(|message| message.header);
    Ok(chosen.map(|header| (header.agent.to_string(), header.stamp)).collect())
}

fn row_major(pose: &Isometry3<f64>) -> Vec<f64> {
    pose.to_homogeneous().transpose().as_slice().to_vec()
}

fn check_matrices(case: &Case, parts: &[Part], tensors: &Tensors) -> Result<(), String> {
    let folders: Vec<&str> = parts.iter().map(|part| part.folder).collect();
    let expected: Vec<&str> = case
        .document
        .agents_in_order
        .iter()
        .map(|agent| agent.agent.as_str())
        .collect();
    equal("agents", &folders, &expected)?;
    let delays: Vec<i64> = parts.iter().map(|part| part.late as i64).collect();
    let expected: Vec<i64> = case
        .document
        .agents_in_order
        .iter()
        .map(|agent| agent.time_delay_frames)
        .collect();
    equal("delays", &delays, &expected)?;
    let t = case.tolerance;
    for Part {
        folder,
        ego_from_agent,
        correction,
        ..
    } in parts
    {
        for (what, found) in [("matrix_agent", ego_from_agent), ("spatial_correction", correction)] {
            let what = format!("{what}_{folder}");
            compare(&what, &row_major(found), &tensors.numbers(&format!("mid.{what}"))?, t)?;
        }
    }
    let near = parts.iter().filter(|part| part.in_reach).map(|part| part.correction);
    let mut corrections: Vec<Isometry3<f64>> = near.collect();
    corrections.resize(PLACES, Isometry3::identity());
    let found: Vec<f64> = corrections.iter().flat_map(row_major).collect();
    compare(
        "spatial_correction_matrix",
        &found,
        &tensors.numbers("out.spatial_correction_matrix")?,
        t,
    )
}

/// Delays and kinds. The reference gives its networks the speed of agents too, which none of them uses.
fn check_prior(near: &[&Part], tensors: &Tensors) -> Result<(), String> {
    equal("record_len", &[near.len() as f64], &tensors.numbers("out.record_len")?)?;
    let mut found: Vec<[f64; 2]> = near
        .iter()
        .map(|part| [part.late as f64, f64::from(u8::from(part.folder.starts_with('-')))])
        .collect();
    found.resize(PLACES, [0.0; 2]);
    let expected = tensors.rows::<3>("out.prior_encoding")?;
    let expected: Vec<[f64; 2]> = expected.iter().map(|[_, delay, kind]| [*delay, *kind]).collect();
    compare("prior_encoding", &flat(&found), &flat(&expected), 0.0)
}

/// Own bodies, the way to the ego's frame, and pillars.
fn check_pillars(vector: &Vector, case: &Case, near: &[&Part], tensors: &Tensors) -> Result<(), String> {
    let grid = grid_of(vector.setting("range")?);
    let (mut places, mut counts, mut sums) = (Vec::new(), Vec::new(), Vec::new());
    for (index, part) in near.iter().enumerate() {
        let cloud = &part.cloud;
        let mut pillariser = Pillariser::new(&grid, SLOTS, MOST_PILLARS);
        let pillars = pillariser.run(&Points {
            x: &cloud.x,
            y: &cloud.y,
            z: &cloud.z,
            intensity: None,
        });
        for (pillar, cell) in pillars.cells.iter().enumerate() {
            let (row, column) = (*cell as usize / grid.columns(), *cell as usize % grid.columns());
            places.push([index, 0, row, column].map(|number| number as f64));
            let points = pillars.points_of(pillar);
            counts.push(points.len() as f64);
            let sum = |axis: usize| points.iter().map(|point| f64::from(point[axis])).sum::<f64>();
            sums.push([0, 1, 2, 3].map(sum));
        }
    }
    equal("coords_bzyx", &places, &tensors.rows::<4>("out.coords_bzyx")?)?;
    equal("num_points", &counts, &tensors.numbers("out.num_points")?)?;
    compare(
        "voxel_point_sum",
        &flat(&sums),
        &tensors.numbers("out.voxel_point_sum")?,
        case.tolerance,
    )
}

/// Points that are not on the agent itself.
fn clean(cloud: &PointCloud) -> PointCloud {
    let [x0, y0, x1, y1] = OWN_BODY;
    let body = realo_sync::OwnBody {
        x: [x0, x1],
        y: [y0, y1],
    };
    realo_sync::clean(cloud, Some(body), None).cloud
}

/// The header of an agent's sweep, with where it believes to be.
fn header((agent, stamp): (Name, Nanos), kind: Kind, pose: Isometry3<f64>) -> Header {
    let mut header = Header::origin(&Name::from("vector"), &agent, kind, 0, stamp, stamp);
    header.pose = Some(Pose::exact(pose));
    header
}

/// What a projector sends of a sweep to an ego that it knows at `to`.
fn projected(
    agent: (Name, Nanos),
    believed: Isometry3<f64>,
    cloud: PointCloud,
    to: Isometry3<f64>,
) -> Result<(Header, PointCloud), String> {
    let settings = realo_projector::Settings {
        project: Project::Sender,
        ..Default::default()
    };
    let mut projector = Projector::new(settings).map_err(|error| error.to_string())?;
    let state = AgentState {
        map_from_body: to,
        covariance: None,
        velocity: None,
        angular_rate: None,
        status: PoseStatus::Truth,
    };
    let of_ego = header((Name::from("ego"), agent.1), Kind::AgentState, to);
    let inputs = [
        realo_projector::Input::State(of_ego, state),
        realo_projector::Input::Clouds(header(agent, Kind::Points, believed), cloud),
    ];
    let mut out = Outputs::at(0);
    for input in inputs {
        projector.on_input(input, &mut out).map_err(|error| error.to_string())?;
    }
    let (_, message) = out.take_sent().pop().ok_or("the projector sent nothing")?;
    message.into_parts().map_err(|error| error.to_string())
}

/// How a fusion moves what a collaborator sent to where the ego is now.
fn corrected(
    ego: (Name, Nanos),
    now: Isometry3<f64>,
    (sent, cloud): (Header, PointCloud),
) -> Result<Isometry3<f64>, String> {
    let of_ego = header(ego, Kind::Points, now);
    let selection = Selection {
        query: of_ego.seq,
        entries: vec![Message::new(sent, cloud.clone())],
    };
    let mut pairing = Pairing::default();
    let inputs = [
        realo_fusion::Input::Ego(of_ego.clone(), cloud),
        realo_fusion::Input::Selections(of_ego, selection),
    ];
    let mut set = None;
    for input in inputs {
        set = pairing.take(input, None).map_err(|error| error.to_string())?;
    }
    let placed = set.and_then(|set| Some(set.collaborators.first()?.ego_from_sender));
    placed.ok_or_else(|| "the fusion took nobody".into())
}

/// The truth of the ego's log. The reference leaves out objects of which fewer than two of eight corners are in the range of
/// the network; that is no part of any graph, so such objects may be left here.
fn check_truth(vector: &Vector, case: &Case, truth: &[Box3], tensors: &Tensors) -> Result<(), String> {
    let protocol = Protocol::load("default").map_err(|error| error.to_string())?;
    let range = vector.setting::<6>("range")?;
    let ids: Vec<u64> = tensors
        .numbers("out.gt_object_ids_sorted")?
        .iter()
        .map(|id| *id as u64)
        .collect();
    let expected = tensors.rows::<8>("out.gt_boxes_hwl_class_sorted_by_id")?;
    let mut scored = Vec::new();
    for object in truth {
        let Some(class) = protocol.class_of(&object.class) else {
            continue;
        };
        let place = object.track.and_then(|track| ids.iter().position(|id| *id == track));
        match place.and_then(|place| expected.get(place)) {
            Some(expected) => {
                let mut row = row_of(object, expected[6]).to_vec();
                row.push(f64::from(class) + 1.0);
                compare(&format!("object {:?}", object.track), &row, expected, case.tolerance)?;
                scored.push(object);
            }
            None if corners_inside(object, &range) < 2 => {}
            None => {
                return Err(format!(
                    "object {:?}: expected outside of the range, found inside",
                    object.track
                ));
            }
        }
    }
    equal("number of objects", &[scored.len()], &[expected.len()])?;
    scored.retain(|object| protocol.takes_in(object));
    scored.sort_by(|a, b| corners_of(a)[0][0].total_cmp(&corners_of(b)[0][0]));
    let label = |object: &&Box3| {
        protocol
            .class_of(&object.class)
            .map_or(f64::NAN, |class| f64::from(class) + 1.0)
    };
    let labels: Vec<f64> = scored.iter().map(label).collect();
    equal("eval_gt_labels", &labels, &tensors.numbers("out.eval_gt_labels")?)?;
    let found: Vec<Box3> = scored.into_iter().cloned().collect();
    let corners = tensors.corners("out.eval_gt_corners_sorted_by_first_x")?;
    equal("eval_gt_corners_count", &[found.len()], &[corners.len()])?;
    compare_boxes("scored truth", &found, &corners, case.tolerance)
}

/// How many of the eight corners of a box are inside x min, y min, z min, x max, y max, z max.
fn corners_inside(object: &Box3, range: &[f64; 6]) -> usize {
    let inside = |corner: &&[f64; 3]| (0..3).all(|axis| (range[axis]..=range[axis + 3]).contains(&corner[axis]));
    corners_of(object).iter().filter(inside).count()
}
