//! V2X-Real: real LiDAR frames, right-handed, in a world that is not level and whose z is not a height.

use std::path::Path;

use super::Kind;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};

/// V2X-Real.
pub static V2X_REAL: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
};

static KIND: Kind = Kind {
    name: "v2x-real",
    title: "V2X-Real",
    needs: "SCENE/AGENT/000030.yaml with 000030.bin or 000030.pcd beside it, also below SPLIT/; roadside AGENTs are negative",
    unit: "frames",
    paths: None,
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

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    let keys = ["true_ego_pose", "infra", "cam1"];
    match (file.pose_numbers(), keys.into_iter().find(|key| file.has(key))) {
        (Some(6), Some(key)) => Ok(format!("`{name}` has the key `{key}`, and a pose of 6 numbers")),
        (Some(6), None) if path.with_extension("bin").is_file() => {
            Ok(format!("`{name}` has a pose of 6 numbers, and a .bin beside it"))
        }
        (Some(6), None) => Err(format!(
            "`{name}` has none of the keys {}, and no .bin beside it",
            keys.join(", ")
        )),
        (Some(other), _) => Err(format!("the pose in `{name}` has {other} numbers, not 6")),
        (None, _) => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}
