//! CooperScene: OPV2V's layout with a roadside unit in the folder `0` and files of other content beside the labels.

mod radio;

use std::path::Path;

use super::family::{Family, FamilyKind, FrameFile, LabelFrame, is_number, options};
use super::folders::{list, name_of};
use super::{Imported, Importer, Job, Kind, v2x_real};
use crate::{ImportError, Options};

/// CooperScene, with its measured radio.
pub struct CooperScene;

impl Importer for CooperScene {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        TAKES.recognise(dir)
    }

    fn undecided(&self, dir: &Path) -> Option<String> {
        TAKES.undecided(dir)
    }

    fn prepare(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        let (whole, options) = (dir.to_path_buf(), options.clone());
        let job = TAKES.prepare(dir, output, &options)?;
        Ok(job.with(move |imported| {
            if let Imported::Scenes(scenes, _) = imported {
                scenes.iter_mut().for_each(|scene| radio::add(&whole, &options, scene));
            }
        }))
    }
}

/// Its clouds and labels.
static TAKES: FamilyKind = FamilyKind {
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
    note: Some("the agent `0` is the roadside unit"),
};

/// How names of files end that only this set has beside its labels.
const BESIDE: [&str; 2] = ["_additional.yaml", "_separate.yaml"];

/// A file beside a label file that only this set has.
pub fn file_beside(labels: &Path) -> Option<String> {
    let entries = std::fs::read_dir(labels.parent()?).ok()?;
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name().to_string_lossy().into_owned()));
    names.filter(|name| BESIDE.iter().any(|end| name.ends_with(end))).min()
}

/// The agents of a take; no other layout of the family has these alone but by chance.
const AGENTS: [&str; 4] = ["0", "1", "2", "3"];

/// Agents beside the one of a label file that no take has: OPV2V and sets of its making name theirs by numbers of CARLA.
fn strangers(labels: &Path) -> Option<String> {
    let scene = labels.parent()?.parent()?;
    let listed = list(scene).ok()?;
    let names = listed.folders.iter().map(|folder| name_of(folder));
    let names: Vec<String> = names
        .filter(|name| is_number(name) && !AGENTS.contains(&name.as_str()))
        .collect();
    let shown: Vec<String> = names.iter().take(4).map(|name| format!("`{name}`")).collect();
    (!names.is_empty()).then(|| {
        format!(
            "`{}` has agents {}, and those of CooperScene are 0 to 3",
            scene.display(),
            shown.join(", ")
        )
    })
}

fn recognise(path: &Path, file: &FrameFile) -> Result<String, String> {
    let name = path.display();
    if let Some(reason) = strangers(path) {
        return Err(reason);
    }
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
    let may_be = file.pose_numbers() == Some(6) && file.key_of(&v2x_real::KEYS).is_none() && strangers(path).is_none();
    let ends = BESIDE.map(|end| format!("*{end}")).join("` or `");
    may_be.then(|| {
        format!(
            "`{}` has no `{ends}` beside it, which OPV2V has not either",
            path.display()
        )
    })
}
