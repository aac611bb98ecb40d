//! A label file of the family: pose and objects of an agent at a frame.

use std::path::Path;

use nalgebra::Isometry3;
use realo_schemas::geometry::tilt_degrees;
use serde_yaml::Value;

use super::poses::world_from_numbers;
use crate::ImportError;
use crate::places::MOST_TILT;
use crate::yaml::{Document, numbers, text, what};

/// Keys of the pose of the LiDAR, the first that is there counts. `predicted_ego_pos` is an estimate, and is not one of them.
pub const POSES: [&str; 4] = ["lidar_pose", "lidar_pose0", "true_ego_pose", "true_ego_pos"];
/// Those of them that are the pose of the vehicle, whose LiDAR is elsewhere.
const OF_VEHICLE: [&str; 2] = ["true_ego_pose", "true_ego_pos"];
/// Keys that say that an agent is a roadside unit.
pub const ROADSIDE: [&str; 3] = ["RSU", "rsu", "infra"];
/// Key that a frame is not scored, as `realo-lab export` writes it.
const SCORED: &str = "scored";
/// Key of the agent's own points on an object, as `realo-lab export` writes it.
const POINTS: &str = "points";
/// Keys of the class of an object.
const CLASSES: [&str; 3] = ["obj_type", "object_type", "class"];
/// Keys of the objects. Those of V2X-InfraSet have no middle of their boxes: their locations are on the ground.
const OBJECTS: [&str; 2] = ["vehicles", "cars"];
const ON_GROUND: &str = "cars";

/// A label file.
pub struct FrameFile {
    pub(super) document: Document,
    agent: String,
}

/// An object as a file has it.
pub struct Object {
    pub id: String,
    /// The id over all agents, where the set has one.
    pub joined: Option<String>,
    pub class: Option<String>,
    pub location: [f64; 3],
    /// The middle of the box from the location, along the axes of the object.
    pub center: [f64; 3],
    /// Roll, yaw, pitch, degrees.
    pub angle: [f64; 3],
    /// Half sizes.
    pub extent: [f64; 3],
    pub speed_kmh: Option<f64>,
    /// The agent's own points on it.
    pub points: Option<u32>,
}

impl Object {
    /// Its pose in six numbers.
    pub fn six(&self) -> [f64; 6] {
        let ([x, y, z], [roll, yaw, pitch]) = (self.location, self.angle);
        [x, y, z, roll, yaw, pitch]
    }
}

impl FrameFile {
    /// Reads a file.
    ///
    /// # Errors
    /// A file that cannot be read, or is not YAML.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let folder = path.parent().and_then(Path::file_name);
        Ok(FrameFile {
            document: Document::read(path)?,
            agent: folder.unwrap_or_default().to_string_lossy().into_owned(),
        })
    }

    /// The folder of its agent.
    pub fn agent(&self) -> &str {
        &self.agent
    }

    /// Whether it has a key.
    pub fn has(&self, key: &str) -> bool {
        self.document.get(key).is_some()
    }

    /// The first of some keys that it has.
    pub fn key_of(&self, keys: &[&'static str]) -> Option<&'static str> {
        keys.iter().copied().find(|key| self.has(key))
    }

    /// Its first keys, for messages.
    pub fn keys(&self) -> String {
        let keys: Vec<String> = self
            .document
            .keys()
            .take(12)
            .map(|key| format!("`{}`", crate::shown(&key)))
            .collect();
        keys.join(", ")
    }

    /// The key of a vehicle that stands for the pose of its LiDAR, where the file has none of a LiDAR.
    pub fn vehicle_pose(&self) -> Option<&'static str> {
        let key = POSES.into_iter().find(|key| self.has(key))?;
        OF_VEHICLE.contains(&key).then_some(key)
    }

    /// How many numbers the pose of the LiDAR has.
    pub fn pose_numbers(&self) -> Option<usize> {
        let pose = POSES.iter().find_map(|key| self.document.get(key))?;
        numbers(pose).ok().map(|numbers| numbers.len())
    }

    /// Whether a key says that the agent is a roadside unit.
    pub fn is_roadside(&self) -> bool {
        let says = |key: &&str| {
            self.document
                .get(key)
                .is_some_and(|value| matches!(text(value).to_lowercase().as_str(), "true" | "1" | "yes"))
        };
        ROADSIDE.iter().any(says)
    }

    /// Whether it says that its frame is not scored.
    pub fn is_unscored(&self) -> bool {
        self.document.get(SCORED).and_then(Value::as_bool) == Some(false)
    }

    /// World from LiDAR; `key`: the only one that counts.
    ///
    /// # Errors
    /// None, or one that cannot be a LiDAR's.
    pub fn pose(&self, key: Option<&str>) -> Result<Isometry3<f64>, ImportError> {
        let wanted: Vec<&str> = key.map_or(POSES.to_vec(), |key| vec![key]);
        let found = wanted.iter().find_map(|key| Some((*key, self.document.get(key)?)));
        let Some((key, value)) = found else {
            let reason = format!(
                "expected the pose of the LiDAR, a key `{}`, found {}; name it with --pose-key, or fetch the file anew if it was cut",
                wanted.join("` or `"),
                self.keys()
            );
            return Err(self.document.error(reason));
        };
        let pose = numbers(value).and_then(|numbers| world_from_numbers(&numbers));
        let pose = pose.map_err(|reason| self.document.error(format!("{key}: {reason}")))?;
        let tilt = tilt_degrees(&pose.rotation);
        match tilt <= MOST_TILT {
            true => Ok(pose),
            false => Err(self.document.error(format!(
                "{key}: expected a LiDAR that tilts by at most {MOST_TILT}°, found {tilt:.1}°; expected are roll, yaw and pitch in this order"
            ))),
        }
    }

    /// All objects, in the order of the file.
    ///
    /// # Errors
    /// No list of objects, or one of which a field is missing or not what it should be.
    pub fn objects(&self) -> Result<Vec<Object>, ImportError> {
        let found = OBJECTS.iter().find_map(|key| Some((*key, self.document.get(key)?)));
        let key = found.map_or(OBJECTS[0], |(key, _)| key);
        let Some((_, Value::Mapping(objects))) = found else {
            let found = found.map_or_else(
                || format!("no such key among {}", self.keys()),
                |(_, value)| what(value),
            );
            let reason = format!(
                "{key}: expected the objects by their ids, `{{}}` where there are none, found {found}; fetch the file anew if it was cut"
            );
            return Err(self.document.error(reason));
        };
        let object = |(id, fields): (&Value, &Value)| {
            let id = text(id);
            object(&id, fields, key == ON_GROUND).map_err(|reason| {
                self.document
                    .error(format!("{key}: object `{}`: {reason}", crate::shown(&id)))
            })
        };
        objects.iter().map(object).collect()
    }
}

/// An object; `on_ground`: where its middle is not said, its location is that of its bottom.
fn object(id: &str, fields: &Value, on_ground: bool) -> Result<Object, String> {
    let three = |key: &str, or: Option<[f64; 3]>| -> Result<[f64; 3], String> {
        match (fields.get(key), or) {
            (Some(value), _) => {
                let found = numbers(value).map_err(|reason| format!("{key}: {reason}"))?;
                let finite = <[f64; 3]>::try_from(found.as_slice())
                    .ok()
                    .filter(|three| three.iter().all(|v| v.is_finite()));
                finite.ok_or_else(|| format!("{key}: expected 3 finite numbers, found {found:?}"))
            }
            (None, Some(or)) => Ok(or),
            (None, None) => Err(format!(
                "expected a key `{key}`, found {}; fetch the file anew if it was cut",
                what(fields)
            )),
        }
    };
    let extent = three("extent", None)?;
    if extent.iter().any(|half| *half < 0.0) {
        return Err(format!("extent: expected half sizes of 0 or more, found {extent:?}"));
    }
    let middle = if on_ground { [0.0, 0.0, extent[2]] } else { [0.0; 3] };
    let word = |key: &str| fields.get(key).map(text).filter(|text| !text.is_empty());
    Ok(Object {
        id: id.into(),
        joined: word("ass_id"),
        class: CLASSES.iter().find_map(|key| word(key)),
        location: three("location", None)?,
        center: three("center", Some(middle))?,
        angle: three("angle", None)?,
        extent,
        speed_kmh: fields
            .get("speed")
            .and_then(Value::as_f64)
            .filter(|speed| speed.is_finite()),
        points: points(fields)?,
    })
}

/// The agent's own points on an object, where the file counts them.
fn points(fields: &Value) -> Result<Option<u32>, String> {
    let Some(value) = fields.get(POINTS) else {
        return Ok(None);
    };
    let count = value.as_u64().and_then(|count| u32::try_from(count).ok());
    count.map(Some).ok_or_else(|| {
        let found = what(value);
        format!("{POINTS}: expected a whole number of points from 0 on, found {found}; correct it, or remove the key")
    })
}
