//! Files of OpenLABEL: the objects of a frame, and how sensors lie to each other.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use realo_logs::track_of;
use serde::Deserialize;
use serde_json::Value;

use crate::ImportError;
use crate::files::read_json;
use crate::options::BoxPlace;
use crate::places::of_rows;
use crate::scenes::Label;

/// A file: the labels of one frame.
#[derive(Deserialize)]
pub struct OpenLabel {
    openlabel: Content,
}

#[derive(Deserialize)]
struct Content {
    #[serde(default)]
    frames: BTreeMap<String, Frame>,
    #[serde(default)]
    coordinate_systems: BTreeMap<String, System>,
}

#[derive(Deserialize)]
struct Frame {
    #[serde(default)]
    objects: BTreeMap<String, Object>,
    #[serde(default)]
    frame_properties: Properties,
}

#[derive(Default, Deserialize)]
struct Properties {
    #[serde(default)]
    transforms: BTreeMap<String, Transform>,
}

#[derive(Deserialize)]
struct Transform {
    src: String,
    dst: String,
    transform_src_to_dst: Matrix,
}

#[derive(Deserialize)]
struct System {
    #[serde(default)]
    parent: String,
    pose_wrt_parent: Option<Matrix>,
}

#[derive(Deserialize)]
struct Matrix {
    matrix4x4: Value,
}

#[derive(Deserialize)]
struct Object {
    object_data: Data,
}

#[derive(Deserialize)]
struct Data {
    #[serde(rename = "type")]
    class: String,
    cuboid: Option<Cuboids>,
}

/// One cuboid, or a list as the standard has it.
#[derive(Deserialize)]
#[serde(untagged)]
enum Cuboids {
    One(Cuboid),
    Many(Vec<Cuboid>),
}

#[derive(Deserialize)]
struct Cuboid {
    val: Vec<f64>,
}

/// A name that is the same for all ways of writing a sensor: `s40` and `s040` are one, and letter case counts for nothing.
fn plain(name: &str) -> String {
    let part = |part: &str| match part.strip_prefix('s').and_then(|digits| digits.parse::<u32>().ok()) {
        Some(number) => format!("s{number}"),
        None => part.to_string(),
    };
    let name = name.to_lowercase();
    name.split('_').map(part).collect::<Vec<_>>().join("_")
}

impl Matrix {
    /// The pose of a matrix of 16 numbers or four rows; `key` names it in errors.
    fn pose(&self, key: &str) -> Result<Isometry3<f64>, String> {
        fn numbers(value: &Value, into: &mut Vec<f64>) {
            match value {
                Value::Array(items) => items.iter().for_each(|item| numbers(item, into)),
                other => into.push(other.as_f64().unwrap_or(f64::NAN)),
            }
        }
        let mut found = Vec::new();
        numbers(&self.matrix4x4, &mut found);
        let pose = (found.len() == 16 && found[12..] == [0.0, 0.0, 0.0, 1.0])
            .then(|| of_rows(&found))
            .flatten();
        pose.ok_or_else(|| format!("{key}: expected a rotation and a translation as a 4×4 matrix, found {found:?}"))
    }
}

impl OpenLabel {
    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, or holds something else.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let file: OpenLabel = read_json(path)?;
        match file.openlabel.frames.len() {
            1 => Ok(file),
            other => Err(ImportError::content(
                path,
                format!("openlabel.frames: expected one frame, found {other}; split the file, as the data set has it"),
            )),
        }
    }

    fn frame(&self) -> &Frame {
        let first = self.openlabel.frames.values().next();
        first.expect("a file that was read has a frame")
    }

    /// The objects, in the frame of the labels, and how many have no cuboid or no size.
    ///
    /// # Errors
    /// A cuboid that is none.
    pub fn labels(&self, place: BoxPlace) -> Result<(Vec<Label>, usize), String> {
        let (mut labels, mut dropped) = (Vec::new(), 0);
        for (track, Object { object_data }) in &self.frame().objects {
            let cuboid = match &object_data.cuboid {
                Some(Cuboids::One(cuboid)) => Some(cuboid),
                Some(Cuboids::Many(list)) => list.first(),
                None => None,
            };
            let Some(cuboid) = cuboid else {
                dropped += 1;
                continue;
            };
            let wrong = || {
                format!(
                    "object `{}`: cuboid.val: expected x, y, z, qx, qy, qz, qw, length, width, height, found {:?}",
                    crate::shown(track),
                    cuboid.val
                )
            };
            let Ok([x, y, z, qx, qy, qz, qw, length, width, height]) = <[f64; 10]>::try_from(&cuboid.val[..]) else {
                return Err(wrong());
            };
            let turn = Quaternion::new(qw, qx, qy, qz);
            if !((turn.norm() - 1.0).abs() < 0.01 && cuboid.val.iter().all(|number| number.is_finite())) {
                return Err(wrong());
            }
            if [length, width, height].contains(&0.0) {
                dropped += 1;
                continue;
            }
            let turn = UnitQuaternion::from_quaternion(turn);
            let mut map_from_object = Isometry3::from_parts(Translation3::new(x, y, z), turn);
            if place == BoxPlace::Bottom {
                map_from_object *= Translation3::new(0.0, 0.0, height / 2.0);
            }
            labels.push(Label {
                id: track.clone(),
                track: track_of(track),
                class: object_data.class.clone(),
                map_from_object,
                size: [length, width, height],
                speed: None,
                points: None,
            });
        }
        Ok((labels, dropped))
    }

    /// Brings points of a sensor to another: by the transforms of the frame and the poses of sensors at their parents.
    ///
    /// # Errors
    /// No way; a matrix that is no pose.
    pub fn way(&self, to: &str, from: &str, poses_from_parent: bool) -> Result<Isometry3<f64>, String> {
        let mut edges: Vec<(String, String, Isometry3<f64>)> = Vec::new();
        for (name, transform) in &self.frame().frame_properties.transforms {
            let pose = transform.transform_src_to_dst.pose(&format!("transforms.{name}"))?;
            edges.push((plain(&transform.dst), plain(&transform.src), pose));
        }
        for (name, system) in &self.openlabel.coordinate_systems {
            let Some(matrix) = system.pose_wrt_parent.as_ref().filter(|_| !system.parent.is_empty()) else {
                continue;
            };
            // Cameras have theirs the other way round, and no part in this.
            if name.contains("camera") {
                continue;
            }
            let pose = matrix.pose(&format!("coordinate_systems.{name}.pose_wrt_parent"))?;
            let pose = if poses_from_parent { pose.inverse() } else { pose };
            edges.push((plain(&system.parent), plain(name), pose));
        }
        let (to, from) = (plain(to), plain(from));
        let mut known = BTreeMap::from([(to.clone(), Isometry3::identity())]);
        let mut open = VecDeque::from([to.clone()]);
        while let Some(here) = open.pop_front() {
            let to_from_here = known[&here];
            for (a, b, a_from_b) in &edges {
                let (there, step) = match (*a == here, *b == here) {
                    (true, false) => (b, *a_from_b),
                    (false, true) => (a, a_from_b.inverse()),
                    _ => continue,
                };
                if !known.contains_key(there) {
                    known.insert(there.clone(), to_from_here * step);
                    open.push_back(there.clone());
                }
            }
        }
        known.get(&from).copied().ok_or_else(|| {
            let names: Vec<&str> = edges.iter().flat_map(|(a, b, _)| [a.as_str(), b.as_str()]).collect();
            let names = std::collections::BTreeSet::from_iter(names);
            let names = Vec::from_iter(names).join("`, `");
            format!(
                "no transform leads from `{from}` to `{to}`, the frame of the labels; the file has transforms among `{names}`; name another \
                 frame with --label-frame"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::plain;

    #[test]
    fn a_sensor_has_one_name_however_it_is_written() {
        assert_eq!(plain("s040_lidar_ouster"), plain("S40_lidar_Ouster"));
        assert_ne!(plain("s040_lidar"), plain("s400_lidar"));
        assert_eq!(plain("vehicle_lidar_robosense"), "vehicle_lidar_robosense");
    }
}
