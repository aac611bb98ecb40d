//! V2V4Real: two vehicles, poses as matrices, boxes in the LiDAR frame of each, joined by `ass_id`.

use std::path::Path;

use super::family::{Family, LabelFrame, OPENCOOD_FOOTPRINT, first_labels};
use super::{Importer, Job, Kind};
use crate::{ImportError, Options};

/// V2V4Real.
pub struct V2v4Real;

static KIND: Kind = Kind {
    name: "v2v4real",
    title: "V2V4Real",
    needs: "SCENE/0/000000.yaml and SCENE/1/000000.yaml with 000000.pcd beside each, also below SPLIT/",
    unit: "frames",
    options: &[
        ("scenes", ""),
        ("frames", ""),
        ("agents", ""),
        ("rate", "10"),
        ("stamp", "start"),
        ("level", "ground"),
        ("height", "ground"),
        ("handed", "right"),
        ("pose-key", ""),
        ("class", "Car"),
        ("footprint", OPENCOOD_FOOTPRINT),
        ("cloud", "pcd"),
        ("columns", "4"),
        ("skip-incomplete", ""),
    ],
};

static FAMILY: Family = Family {
    title: "V2V4Real",
    clouds: &["pcd", "bin"],
    labels_in: LabelFrame::Lidar,
    agents_are_objects: false,
    has_speeds: false,
    note: Some(
        "objects of two agents with the same `ass_id` are one; without one, or with -1, they are the agent's own",
    ),
};

impl Importer for V2v4Real {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn recognise(&self, dir: &Path) -> Result<String, String> {
        let (path, file) = first_labels(dir)?;
        let name = path.display();
        match file.pose_numbers() {
            Some(16) => Ok(format!("the pose in `{name}` is a 4×4 matrix")),
            Some(other) => Err(format!(
                "the pose in `{name}` has {other} numbers, not the 16 of a matrix"
            )),
            None => Err(format!("`{name}` has no pose; its keys are {}", file.keys())),
        }
    }

    fn job(&self, dir: &Path, output: &Path, options: &Options) -> Result<Job, ImportError> {
        Job::of_scenes(&FAMILY, dir, output, options)
    }
}
