//! V2V4Real: two vehicles, poses as matrices, boxes in the LiDAR frame of each, joined by `ass_id`.

use std::path::Path;

use super::Kind;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};

/// V2V4Real.
pub static V2V4REAL: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
    // Poses are matrices, or they are not.
    undecided: |_, _| None,
};

static KIND: Kind = Kind {
    name: "v2v4real",
    title: "V2V4Real",
    needs: "SCENE/0/000000.yaml and SCENE/1/000000.yaml with 000000.pcd beside each, also below SPLIT/",
    unit: "frames",
    paths: None,
    is_exact: false,
    options: &options("ground", "right", "pcd"),
};

static FAMILY: Family = Family {
    title: "V2V4Real",
    clouds: &["pcd", "bin"],
    labels_in: LabelFrame::Lidar,
    agents_are_objects: false,
    has_speeds: false,
    roadside: &[],
    note: Some(
        "objects of two agents with the same `ass_id` are one; without one, or with -1, they are the agent's own",
    ),
};

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    match file.pose_numbers() {
        Some(16) => Ok(format!("the pose in `{name}` is a 4×4 matrix")),
        Some(other) => Err(format!(
            "the pose in `{name}` has {other} numbers, not the 16 of a matrix"
        )),
        None => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}
