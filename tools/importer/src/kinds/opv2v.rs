//! OPV2V and sets of its making, V2XSet, V2X-InfraSet and Adver-City: CARLA's left-handed world, half extents, numbers that step by two.

use std::path::Path;

use super::Kind;
use super::cooperscene::file_beside;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};
use super::v2x_real;

/// OPV2V, V2XSet, V2X-InfraSet, Adver-City.
pub static OPV2V: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
    undecided,
};

static KIND: Kind = Kind {
    name: "opv2v",
    title: "OPV2V, V2XSet, V2X-InfraSet, Adver-City",
    needs: "SCENE/AGENT/000068.yaml with 000068.pcd or 000068_lidar0.pcd beside it, also below SPLIT/",
    unit: "frames",
    paths: None,
    is_exact: false,
    options: &options("pose", "left", "pcd"),
};

static FAMILY: Family = Family {
    title: "OPV2V",
    clouds: &["pcd", "bin", "ply"],
    labels_in: LabelFrame::World,
    agents_are_objects: true,
    has_speeds: true,
    roadside: &[],
    note: None,
};

/// The cloud of the first of several LiDARs.
fn of_first_lidar(labels: &Path) -> std::path::PathBuf {
    let stem = labels.file_stem().unwrap_or_default().to_string_lossy();
    labels.with_file_name(format!("{stem}_lidar0.pcd"))
}

/// Keys that V2X-Real does not have.
pub const KEYS: [&str; 4] = ["RSU", "true_ego_pos", "camera0", "lidar_pose0"];

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    if let Some(key) = file.key_of(&v2x_real::KEYS) {
        return Err(format!("`{name}` has the key `{key}`, as V2X-Real"));
    }
    if let Some(beside) = file_beside(path) {
        return Err(format!("`{name}` has `{beside}` beside it, as CooperScene"));
    }
    let key = file.key_of(&KEYS);
    let cloud = if path.with_extension("pcd").is_file() || of_first_lidar(path).is_file() {
        Some(".pcd")
    } else {
        let is_bin = key.is_some() && path.with_extension("bin").is_file();
        is_bin.then_some(".bin")
    };
    match (file.pose_numbers(), cloud) {
        (Some(6), Some(cloud)) => Ok(format!(
            "`{name}` has the key `{}`, a pose of 6 numbers, and a {cloud} beside it",
            key.or(file.key_of(&["lidar_pose"])).unwrap_or("pose")
        )),
        (Some(6), None) => Err(format!("`{name}` has no .pcd beside it")),
        (Some(other), _) => Err(format!("the pose in `{name}` has {other} numbers, not 6")),
        (None, _) => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}

/// Signs of two sets, or of none, do not tell it from the other.
fn undecided(path: &Path, file: &FrameFile) -> Option<String> {
    if file.pose_numbers() != Some(6) {
        return None;
    }
    let said = match (file.key_of(&KEYS), file.key_of(&v2x_real::KEYS), file_beside(path)) {
        (Some(own), Some(other), _) => format!("has `{own}`, as OPV2V, and `{other}`, as V2X-Real"),
        (Some(own), None, Some(beside)) => format!("has `{own}`, as OPV2V, and `{beside}` beside it, as CooperScene"),
        (None, None, None) => "has no key that tells OPV2V from V2X-Real".into(),
        _ => return None,
    };
    Some(format!("`{}` {said}", path.display()))
}
