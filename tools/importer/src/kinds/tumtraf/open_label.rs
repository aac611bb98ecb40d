//! Files of OpenLABEL: the objects of a frame, and the transforms between sensors.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
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

/// A pose, which need not be one before it is used.
#[derive(Deserialize)]
struct Matrix {
    #[serde(default)]
    matrix4x4: Value,
}

/// A matrix that leads from one sensor to another, by their plain names.
struct Edge<'a> {
    to: String,
    from: String,
    to_from_from: &'a Matrix,
    is_inverse: bool,
    /// Where the file has it.
    key: String,
}

impl Edge<'_> {
    fn pose(&self) -> Result<Isometry3<f64>, String> {
        let pose = self.to_from_from.pose(&self.key)?;
        Ok(if self.is_inverse { pose.inverse() } else { pose })
    }
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
    /// No way; a matrix on the way that is not a pose.
    pub fn way(&self, to: &str, from: &str, poses_from_parent: bool) -> Result<Isometry3<f64>, String> {
        let edges = self.edges(poses_from_parent);
        let (to, from) = (plain(to), plain(from));
        // By sensor: the edge from the sensor before it on the way from `to`, and that sensor.
        let mut before: BTreeMap<&str, Option<(&Edge, &str)>> = BTreeMap::from([(to.as_str(), None)]);
        let mut open = VecDeque::from([to.as_str()]);
        while let Some(here) = open.pop_front() {
            for edge in &edges {
                let there = match (edge.to == here, edge.from == here) {
                    (true, false) => edge.from.as_str(),
                    (false, true) => edge.to.as_str(),
                    _ => continue,
                };
                if !before.contains_key(there) {
                    before.insert(there, Some((edge, here)));
                    open.push_back(there);
                }
            }
        }
        if !before.contains_key(from.as_str()) {
            return Err(no_way(&edges, &to, &from));
        }
        let (mut to_from_from, mut at) = (Isometry3::identity(), from.as_str());
        while let Some(Some((edge, nearer))) = before.get(at) {
            let step = edge.pose()?;
            let nearer_from_at = if edge.to == *nearer { step } else { step.inverse() };
            to_from_from = nearer_from_at * to_from_from;
            at = nearer;
        }
        Ok(to_from_from)
    }

    /// All transforms between sensors, unread.
    fn edges(&self, poses_from_parent: bool) -> Vec<Edge<'_>> {
        let transforms = &self.frame().frame_properties.transforms;
        let transforms = transforms.iter().map(|(name, transform)| Edge {
            to: plain(&transform.dst),
            from: plain(&transform.src),
            to_from_from: &transform.transform_src_to_dst,
            is_inverse: false,
            key: format!("transforms.{name}"),
        });
        let systems = self.openlabel.coordinate_systems.iter();
        // Cameras have theirs the other way round, and no part in this.
        let systems =
            systems.filter(|(name, system)| !system.parent.is_empty() && !name.to_lowercase().contains("camera"));
        let systems = systems.filter_map(|(name, system)| {
            Some(Edge {
                to: plain(&system.parent),
                from: plain(name),
                to_from_from: system.pose_wrt_parent.as_ref()?,
                is_inverse: poses_from_parent,
                key: format!("coordinate_systems.{name}.pose_wrt_parent"),
            })
        });
        transforms.chain(systems).collect()
    }
}

fn no_way(edges: &[Edge], to: &str, from: &str) -> String {
    let names = edges.iter().flat_map(|edge| [edge.to.as_str(), edge.from.as_str()]);
    let names = Vec::from_iter(BTreeSet::from_iter(names)).join("`, `");
    format!(
        "no transform leads from `{from}` to `{to}`, the frame of the labels; the file has transforms among `{names}`; name another \
         frame with --label-frame"
    )
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
