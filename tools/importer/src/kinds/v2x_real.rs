//! V2X-Real: real LiDAR frames, right-handed, in a world that is not level and whose z is not a height.

use std::path::Path;

use super::Kind;
use super::cooperscene::file_beside;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};
use super::opv2v;

/// V2X-Real.
pub static V2X_REAL: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
    undecided,
};

static KIND: Kind = Kind {
    name: "v2x-real",
    title: "V2X-Real",
    needs: "SCENE/AGENT/000030.yaml with 000030.bin or 000030.pcd beside it, also below SPLIT/; roadside AGENTs are negative",
    unit: "frames",
    paths: None,
    is_exact: false,
    options: &options("ground", "right", "bin"),
};

static FAMILY: Family = Family {
    title: "V2X-Real",
    clouds: &["bin", "pcd", "ply"],
    labels_in: LabelFrame::World,
    agents_are_objects: false,
    // Its files say 0 for all.
    has_speeds: false,
    roadside: &[],
    note: Some(
        "classes keep their names; `TrashCan` has the size of a truck, and the protocol `default` counts it as one",
    ),
};

/// Keys that OPV2V and CooperScene do not have.
pub const KEYS: [&str; 3] = ["true_ego_pose", "infra", "cam1"];

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    match (file.pose_numbers(), file.key_of(&KEYS), file.key_of(&opv2v::KEYS)) {
        (Some(6), Some(key), _) => Ok(format!("`{name}` has the key `{key}`, and a pose of 6 numbers")),
        (Some(6), None, Some(key)) => Err(format!("`{name}` has the key `{key}`, as OPV2V")),
        (Some(6), None, None) if path.with_extension("bin").is_file() => {
            Ok(format!("`{name}` has a pose of 6 numbers, and a .bin beside it"))
        }
        (Some(6), None, None) => Err(format!(
            "`{name}` has none of the keys {}, and no .bin beside it",
            KEYS.join(", ")
        )),
        (Some(other), ..) => Err(format!("the pose in `{name}` has {other} numbers, not 6")),
        (None, ..) => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}

/// Without keys of either set nothing tells it from OPV2V.
fn undecided(path: &Path, file: &FrameFile) -> Option<String> {
    let may_be = file.pose_numbers() == Some(6) && file_beside(path).is_none() && file.key_of(&opv2v::KEYS).is_none();
    may_be.then(|| format!("`{}` has no key that tells V2X-Real from OPV2V", path.display()))
}
