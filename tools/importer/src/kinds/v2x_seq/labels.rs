//! Labels of V2X-Seq-SPD: of a side with its own tracks, and cooperative ones that say which tracks of the sides an object is.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use realo_logs::track_of;
use realo_schemas::Box3;
use serde::Deserialize;
use serde_json::Value;

use crate::ImportError;
use crate::dair::labels::SideLabel;
use crate::dair::lists::{FrameId, words};
use crate::files::read_json;
use crate::options::BoxPlace;
use crate::scenes::Label;

/// What stands for no track.
const NO_TRACK: &str = "-1";
/// The class whose objects have no tracks.
const UNTRACKED: &str = "trafficcone";
/// A cooperative label farther from the vehicle's own label of the object is in another frame, m.
const MOST_APART: f64 = 2.0;

/// Why a track is told of.
const TEXT: &str = "track_id that is not a whole number: its text is the identity";
/// Why a cooperative label is told of.
const APART: &str = "cooperative label more than 2 m from the vehicle's own label of its veh_track_id: its frame may be another than \
                     that of the vehicle's LiDAR";

/// A label of a file.
#[derive(Deserialize)]
struct FileLabel {
    #[serde(flatten)]
    label: SideLabel,
    track_id: Option<Value>,
    veh_frame_id: Option<Value>,
    inf_frame_id: Option<Value>,
    veh_track_id: Option<Value>,
    inf_track_id: Option<Value>,
}

/// A label that has a size, in the frame of a LiDAR.
struct Boxed {
    object: Box3,
    track: Option<String>,
    /// Tracks of the vehicle's and of the roadside unit's side.
    of_sides: [Option<String>; 2],
}

/// The labels of a file.
pub struct LabelFile {
    path: PathBuf,
    labels: Vec<Boxed>,
    /// Labels without a size.
    pub dropped: usize,
    /// What is strange and was taken.
    pub noted: Vec<(&'static str, String)>,
}

impl LabelFile {
    /// Reads a file. `frames`: of cooperative labels, the frames that they must be of.
    ///
    /// # Errors
    /// A file that cannot be read; what is no label; a track twice; labels of other frames.
    pub fn read(path: &Path, frames: Option<[&FrameId; 2]>, place: BoxPlace) -> Result<Self, ImportError> {
        let mut file = LabelFile {
            path: path.into(),
            labels: Vec::new(),
            dropped: 0,
            noted: Vec::new(),
        };
        let mut known: [BTreeMap<String, usize>; 3] = Default::default();
        for (index, label) in read_json::<Vec<FileLabel>>(path)?.iter().enumerate() {
            let class = &label.label.class;
            let named = |reason: String| {
                let reason = format!("label {index} (`{}`): {reason}", crate::shown(class));
                ImportError::content(path, reason)
            };
            if let Some(frames) = frames {
                label.is_of(frames).map_err(named)?;
            }
            let Some(mut object) = label.label.to_box(path, index)? else {
                file.dropped += 1;
                continue;
            };
            if place == BoxPlace::Bottom {
                object.center[2] += object.height / 2.0;
            }
            let fields = ["track_id", "veh_track_id", "inf_track_id"];
            let values = [&label.track_id, &label.veh_track_id, &label.inf_track_id];
            let mut tracks: [Option<String>; 3] = Default::default();
            for ((track, known), (field, value)) in tracks.iter_mut().zip(&mut known).zip(fields.iter().zip(values)) {
                if class.to_lowercase() == UNTRACKED {
                    continue;
                }
                *track = track_text(value.as_ref()).map_err(|reason| named(format!("{field}: {reason}")))?;
                let Some(text) = track else { continue };
                if let Some(other) = known.insert(text.clone(), index) {
                    let reason = format!(
                        "{field}: expected each once in a frame, found `{}` in label {other} too; number one anew",
                        crate::shown(text)
                    );
                    return Err(named(reason));
                }
            }
            let [track, of_vehicle, of_roadside] = tracks;
            if let Some(text) = track.as_ref().filter(|text| text.parse::<u64>().is_err()) {
                let name = format!("{}: label {index}: `{}`", short(path), crate::shown(text));
                file.noted.push((TEXT, name));
            }
            file.labels.push(Boxed {
                object,
                track,
                of_sides: [of_vehicle, of_roadside],
            });
        }
        Ok(file)
    }

    /// The labels of a side in the map. Objects that a cooperative label names have its track; others are the side's own.
    pub fn of_side(&self, map_from_lidar: &Isometry3<f64>, side: usize, together: &LabelFile) -> Vec<Label> {
        let joined = together.by_side(side);
        let name = ["vehicle-side", "infrastructure-side"][side];
        let label = |(index, boxed): (usize, &Boxed)| {
            let known = boxed.track.as_ref();
            let id = match known.and_then(|track| joined.get(track)) {
                Some(Boxed { track: Some(track), .. }) => track.clone(),
                _ => match known {
                    Some(track) => format!("{name}:{track}"),
                    None => format!("{name}, label {index}"),
                },
            };
            boxed.label(map_from_lidar, id, known.is_some())
        };
        self.labels.iter().enumerate().map(label).collect()
    }

    /// Cooperative labels in the map.
    pub fn together(&self, map_from_lidar: &Isometry3<f64>) -> Vec<Label> {
        let label = |(index, boxed): (usize, &Boxed)| {
            let id = boxed.track.clone().unwrap_or_else(|| format!("label {index}"));
            boxed.label(map_from_lidar, id, boxed.track.is_some())
        };
        self.labels.iter().enumerate().map(label).collect()
    }

    /// Cooperative labels that are not where the vehicle itself has the object.
    pub fn apart(&self, own: &LabelFile) -> Vec<(&'static str, String)> {
        let joined = self.by_side(0);
        let apart = |boxed: &Boxed| {
            let track = boxed.track.as_ref()?;
            let here = Vector3::from(joined.get(track)?.object.center);
            let metres = (here - Vector3::from(boxed.object.center)).norm();
            let name = format!(
                "{}: veh_track_id `{}`: {metres:.1} m",
                short(&self.path),
                crate::shown(track)
            );
            (metres > MOST_APART).then_some((APART, name))
        };
        own.labels.iter().filter_map(apart).collect()
    }

    /// Labels by the tracks of a side.
    fn by_side(&self, side: usize) -> BTreeMap<&String, &Boxed> {
        let mut found = BTreeMap::new();
        for boxed in &self.labels {
            found.extend(boxed.of_sides[side].as_ref().map(|track| (track, boxed)));
        }
        found
    }
}

/// The last parts of a path, which a data set has in common.
fn short(path: &Path) -> String {
    let parts: Vec<_> = path.components().rev().take(3).collect();
    let path: PathBuf = parts.into_iter().rev().collect();
    path.display().to_string()
}

impl Boxed {
    fn label(&self, map_from_lidar: &Isometry3<f64>, id: String, is_tracked: bool) -> Label {
        let object = &self.object;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), object.yaw);
        let lidar_from_object = Isometry3::from_parts(Translation3::from(Vector3::from(object.center)), turn);
        Label {
            track: track_of(&id).filter(|_| is_tracked),
            id,
            class: object.class.to_string(),
            map_from_object: map_from_lidar * lidar_from_object,
            size: [object.length, object.width, object.height],
            speed: None,
            points: None,
        }
    }
}

impl FileLabel {
    /// Checks that it is of these frames, if it says of which it is.
    fn is_of(&self, frames: [&FrameId; 2]) -> Result<(), String> {
        let said = [
            ("veh_frame_id", &self.veh_frame_id),
            ("inf_frame_id", &self.inf_frame_id),
        ];
        for ((field, value), expected) in said.into_iter().zip(frames) {
            let Some(value) = value else { continue };
            let found = FrameId::of(field, value)?;
            if found.number != expected.number {
                return Err(format!(
                    "{field}: expected {}, as the pair of the file has it, found {}; fetch the file anew",
                    expected.name, found.name
                ));
            }
        }
        Ok(())
    }
}

/// A track as a text, digits without zeros before them; `None` for none.
fn track_text(value: Option<&Value>) -> Result<Option<String>, String> {
    let text = match value {
        None => return Ok(None),
        Some(value @ (Value::String(_) | Value::Number(_))) => words(value),
        Some(other) => return Err(format!("expected a text or a whole number, -1 for none, found {other}")),
    };
    match text.as_str() {
        "" | NO_TRACK => Ok(None),
        _ => Ok(Some(text.parse::<u64>().map_or(text, |number| number.to_string()))),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn tracks_are_digits_or_texts_and_minus_one_is_none() {
        for (value, expected) in [
            (json!("002762"), Some("2762")),
            (json!(2762), Some("2762")),
            (json!(" 7 "), Some("7")),
            (json!("-1"), None),
            (json!(-1), None),
            (json!(""), None),
            (json!("a7"), Some("a7")),
            (json!(7.5), Some("7.5")),
        ] {
            assert_eq!(track_text(Some(&value)).unwrap().as_deref(), expected, "{value}");
        }
        assert_eq!(track_text(None).unwrap(), None);
        let error = track_text(Some(&json!([1]))).unwrap_err();
        assert!(error.contains("-1 for none, found [1]"), "{error}");
    }
}
