//! OPV2V and sets of its making, V2XSet, V2X-InfraSet and Adver-City: CARLA's left-handed world, half extents, numbers that step by two.

use std::path::Path;

use super::Kind;
use super::cooperscene::file_beside;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};

/// OPV2V, V2XSet, V2X-InfraSet, Adver-City.
pub static OPV2V: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
};

static KIND: Kind = Kind {
    name: "opv2v",
    title: "OPV2V, V2XSet, V2X-InfraSet, Adver-City",
    needs: "SCENE/AGENT/000068.yaml with 000068.pcd or 000068_lidar0.pcd beside it, also below SPLIT/",
    unit: "frames",
    paths: None,
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

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    if let Some(key) = ["true_ego_pose", "infra", "cam1"].into_iter().find(|key| file.has(key)) {
        return Err(format!("`{name}` has the key `{key}`, as V2X-Real"));
    }
    if let Some(beside) = file_beside(path) {
        return Err(format!("`{name}` has `{beside}` beside it, as CooperScene"));
    }
    match file.pose_numbers() {
        Some(6) if path.with_extension("pcd").is_file() || of_first_lidar(path).is_file() => {
            let key = ["RSU", "true_ego_pos", "lidar_pose", "lidar_pose0"]
                .into_iter()
                .find(|key| file.has(key));
            Ok(format!(
                "`{name}` has the key `{}`, a pose of 6 numbers, and a .pcd beside it",
                key.unwrap_or("pose")
            ))
        }
        Some(6) => Err(format!("`{name}` has no .pcd beside it")),
        Some(other) => Err(format!("the pose in `{name}` has {other} numbers, not 6")),
        None => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}
