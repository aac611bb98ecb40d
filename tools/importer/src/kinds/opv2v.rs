//! OPV2V and sets of its making: CARLA's left-handed world, half extents, numbers that step by two.

use std::path::Path;

use super::family::{Family, LabelFrame, OPENCOOD_FOOTPRINT, first_labels};
use super::{Importer, Job, Kind};
use crate::{ImportError, Options};

/// OPV2V, V2XSet, Adver-City.
pub struct Opv2v;

static KIND: Kind = Kind {
    name: "opv2v",
    title: "OPV2V, V2XSet, Adver-City",
    needs: "SCENE/AGENT/000068.yaml with 000068.pcd beside it, also below SPLIT/",
    unit: "frames",
    options: &[
        ("scenes", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", "pose"),
        ("height", "ground"),
        ("handed", "left"),
        ("pose-key", ""),
        ("class", "Car"),
        ("footprint", OPENCOOD_FOOTPRINT),
        ("cloud", "pcd"),
        ("columns", "4"),
        ("skip-incomplete", ""),
    ],
};

static FAMILY: Family = Family {
    title: "OPV2V",
    clouds: &["pcd", "bin"],
    labels_in: LabelFrame::World,
    agents_are_objects: true,
    has_speeds: true,
    note: None,
};

impl Importer for Opv2v {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        let (path, file) = first_labels(dir)?;
        let name = path.display();
        if let Some(key) = ["true_ego_pose", "infra", "cam1"].into_iter().find(|key| file.has(key)) {
            return Err(format!("`{name}` has the key `{key}`, as V2X-Real"));
        }
        match file.pose_numbers() {
            Some(6) if path.with_extension("pcd").is_file() => {
                let key = ["RSU", "true_ego_pos", "lidar_pose"]
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

    fn job(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&FAMILY, dir, output, options)
    }
}
