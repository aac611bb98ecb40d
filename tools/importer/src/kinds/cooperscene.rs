//! CooperScene: OPV2V's layout with a roadside unit in the folder `0` and files of other content beside the labels.

use std::path::Path;

use super::Kind;
use super::family::{Family, FamilyKind, FrameFile, LabelFrame, options};
use super::v2x_real;

/// CooperScene.
pub static COOPERSCENE: FamilyKind = FamilyKind {
    kind: &KIND,
    family: &FAMILY,
    recognise,
    undecided,
};

static KIND: Kind = Kind {
    name: "cooperscene",
    title: "CooperScene",
    needs: "TAKE/{0..3}/000001.yaml with 000001.pcd beside it, also below SPLIT/; AGENT 0 is the roadside unit",
    unit: "frames",
    paths: None,
    is_exact: false,
    options: &options("pose", "left", "pcd"),
};

static FAMILY: Family = Family {
    title: "CooperScene",
    clouds: &["pcd"],
    labels_in: LabelFrame::World,
    agents_are_objects: false,
    has_speeds: true,
    roadside: &["0"],
    note: Some("the agent `0` is the roadside unit; the measured radio in `mcap/` is not imported"),
};

/// How names of files end that only this set has beside its labels.
const BESIDE: [&str; 2] = ["_additional.yaml", "_separate.yaml"];

/// A file beside a label file that only this set has.
pub fn file_beside(labels: &Path) -> Option<String> {
    let entries = std::fs::read_dir(labels.parent()?).ok()?;
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name().to_string_lossy().into_owned()));
    names.filter(|name| BESIDE.iter().any(|end| name.ends_with(end))).min()
}

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    match (file.pose_numbers(), file_beside(path)) {
        (Some(6), Some(beside)) => Ok(format!("`{name}` has a pose of 6 numbers, and `{beside}` beside it")),
        (Some(6), None) => {
            let ends = BESIDE.map(|end| format!("*{end}")).join("` or `");
            Err(format!("`{name}` has no `{ends}` beside it"))
        }
        (Some(other), _) => Err(format!("the pose in `{name}` has {other} numbers, not 6")),
        (None, _) => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
    }
}

/// OPV2V has the same keys.
fn undecided(path: &Path, file: &FrameFile) -> Option<String> {
    let may_be = file.pose_numbers() == Some(6) && file.key_of(&v2x_real::KEYS).is_none();
    let ends = BESIDE.map(|end| format!("*{end}")).join("` or `");
    may_be.then(|| {
        format!(
            "`{}` has no `{ends}` beside it, which OPV2V has not either",
            path.display()
        )
    })
}
