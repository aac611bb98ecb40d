//! Poses of sensors and states of vehicles: matrices in files of JSON.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use realo_schemas::Nanos;
use realo_schemas::geometry::interpolate;
use serde_json::Value;

use super::super::folders::{frame_of, list};
use crate::files::read_json;
use crate::places::of_rows;
use crate::{ImportError, Options};

/// A state holds for so long before the first and behind the last, and two so far apart hold for what is between them, ns.
const NEAR: Nanos = 200_000_000;
/// Values are looked at so many levels down.
const DEEPEST: usize = 6;

/// Sensors with their poses.
pub struct Calibration {
    path: PathBuf,
    root: Value,
    pose_key: Option<String>,
    is_from_parent: bool,
}

impl Calibration {
    /// Reads the file.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn read(path: &Path, options: &Options) -> Result<Self, ImportError> {
        Ok(Calibration {
            path: path.into(),
            root: read_json(path)?,
            pose_key: options.pose_key.clone(),
            is_from_parent: options.poses_from_parent,
        })
    }

    /// The pose of a sensor in its vehicle, or in the map.
    ///
    /// # Errors
    /// No entry of its name; none or several matrices in it.
    pub fn pose(&self, sensor: &str) -> Result<Isometry3<f64>, ImportError> {
        let wrong = |reason: String| ImportError::content(&self.path, reason);
        let entry = entry(&self.root, sensor, 0).ok_or_else(|| {
            let known: Vec<String> = self
                .root
                .as_object()
                .into_iter()
                .flatten()
                .map(|(key, _)| crate::shown(key))
                .collect();
            let known = known.iter().take(12).cloned().collect::<Vec<_>>().join("`, `");
            wrong(format!(
                "expected an entry `{sensor}` as the folder is called, found `{known}`"
            ))
        })?;
        let pose =
            only_matrix(entry, self.pose_key.as_deref()).map_err(|reason| wrong(format!("{sensor}: {reason}")))?;
        Ok(if self.is_from_parent { pose.inverse() } else { pose })
    }
}

/// The value of a key, however deep.
fn entry<'a>(value: &'a Value, key: &str, depth: usize) -> Option<&'a Value> {
    let fields = value.as_object().filter(|_| depth < DEEPEST)?;
    fields
        .get(key)
        .or_else(|| fields.values().find_map(|inner| entry(inner, key, depth + 1)))
}

/// The only 4×4 matrix in a value; of several the only one under a key.
fn only_matrix(value: &Value, key: Option<&str>) -> Result<Isometry3<f64>, String> {
    let mut found = Vec::new();
    matrices(value, String::new(), 0, &mut found);
    if let Some(key) = key.filter(|_| found.len() > 1) {
        let all: Vec<String> = found.iter().map(|(path, _)| path.clone()).collect();
        found.retain(|(path, _)| path.split('.').any(|part| part == key));
        if found.is_empty() {
            return Err(format!(
                "expected a 4×4 matrix under `{}` (--pose-key), found {}",
                crate::shown(key),
                all.join(", ")
            ));
        }
    }
    match &found[..] {
        [(path, numbers)] => of_rows(numbers)
            .filter(|_| numbers[12..] == [0.0, 0.0, 0.0, 1.0])
            .ok_or_else(|| format!("{path}: expected a rotation and a translation as a 4×4 matrix, found {numbers:?}")),
        [] => Err(
            "expected a 4×4 matrix, as four rows or 16 numbers, found none; see whether the file is of the data set"
                .into(),
        ),
        several => {
            let paths: Vec<&str> = several.iter().map(|(path, _)| path.as_str()).collect();
            Err(format!(
                "expected one 4×4 matrix, found {}; choose with --pose-key KEY",
                paths.join(", ")
            ))
        }
    }
}

/// All 4×4 matrices in a value, by the keys that lead there.
fn matrices(value: &Value, path: String, depth: usize, found: &mut Vec<(String, Vec<f64>)>) {
    if depth > DEEPEST {
        return;
    }
    match value {
        Value::Object(fields) => {
            for (key, inner) in fields {
                let path = if path.is_empty() {
                    key.clone()
                } else {
                    format!("{path}.{key}")
                };
                matrices(inner, path, depth + 1, found);
            }
        }
        Value::Array(items) => {
            let row = |item: &Value| item.as_array().map_or_else(|| vec![item.clone()], Clone::clone);
            let numbers: Vec<f64> = items
                .iter()
                .flat_map(row)
                .filter_map(|number| number.as_f64())
                .collect();
            let is_square = items.len() == 16
                || (items.len() == 4 && items.iter().all(|row| row.as_array().is_some_and(|row| row.len() == 4)));
            if is_square && numbers.len() == 16 {
                found.push((path, numbers));
            }
        }
        _ => {}
    }
}

/// Where a vehicle was.
pub struct States(BTreeMap<Nanos, Isometry3<f64>>);

impl States {
    /// Reads a folder of states, which are named by their times in ms.
    ///
    /// # Errors
    /// A state that cannot be read, or has no pose.
    pub fn read(folder: &Path, pose_key: Option<&str>) -> Result<Self, ImportError> {
        let mut states = BTreeMap::new();
        for name in &list(folder)?.files {
            let Some((ms, "json")) = frame_of(name) else { continue };
            let path = folder.join(name);
            let pose =
                only_matrix(&read_json(&path)?, pose_key).map_err(|reason| ImportError::content(&path, reason))?;
            states.insert(i64::try_from(ms).unwrap_or(i64::MAX).saturating_mul(1_000_000), pose);
        }
        match states.is_empty() {
            false => Ok(States(states)),
            true => Err(ImportError::content(
                folder,
                "expected states, MS.json, found none; unpack the data set",
            )),
        }
    }

    /// Where it was at a time; `None` where no states are near.
    pub fn at(&self, at: Nanos) -> Option<Isometry3<f64>> {
        let before = self.0.range(..=at).next_back();
        let after = self.0.range(at..).next();
        match (before, after) {
            (Some((t0, a)), Some((t1, b))) if t1 - t0 <= NEAR && t1 > t0 => {
                Some(interpolate(a, b, (at - t0) as f64 / (t1 - t0) as f64))
            }
            (before, after) => {
                let both = [before, after].into_iter().flatten();
                let nearest = both.min_by_key(|(time, _)| (*time - at).abs());
                nearest
                    .filter(|(time, _)| (*time - at).abs() <= NEAR / 2)
                    .map(|(_, pose)| *pose)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_only_matrix_is_found_whatever_it_is_called() {
        let rows = json!([
            [1.0, 0.0, 0.0, 3.0],
            [0.0, 1.0, 0.0, 4.0],
            [0.0, 0.0, 1.0, 5.0],
            [0.0, 0.0, 0.0, 1.0]
        ]);
        let flat = json!([1, 0, 0, 3, 0, 1, 0, 4, 0, 0, 1, 5, 0, 0, 0, 1]);
        for value in [
            json!({"pose": {"transform": rows}, "velocity": [1, 2, 3]}),
            json!({"m": flat}),
        ] {
            let pose = only_matrix(&value, None).unwrap();
            assert_eq!(pose.translation.vector.as_slice(), [3.0, 4.0, 5.0]);
        }
        let two = json!({"a": rows, "b": {"c": rows}});
        let error = only_matrix(&two, None).unwrap_err();
        assert!(error.contains("found a, b.c; choose with --pose-key"), "{error}");
        assert!(only_matrix(&two, Some("c")).is_ok());
        let error = only_matrix(&two, Some("d")).unwrap_err();
        assert!(error.contains("under `d` (--pose-key), found a, b.c"), "{error}");
        let one = json!({"transformation": rows});
        assert!(
            only_matrix(&one, Some("c")).is_ok(),
            "where there is one, no key is needed"
        );
        assert!(
            only_matrix(&json!({"k": [[1, 2], [3, 4]]}), None)
                .unwrap_err()
                .contains("found none")
        );
        let scaled = json!({"k": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]});
        assert!(only_matrix(&scaled, None).unwrap_err().contains("expected a rotation"));
    }

    #[test]
    fn states_are_interpolated_between_near_ones() {
        let along = |x: f64| Isometry3::translation(x, 0.0, 0.0);
        let states = States(
            [(0, 0.0), (100, 1.0), (900, 9.0)]
                .map(|(ms, x)| (ms * 1_000_000, along(x)))
                .into(),
        );
        let x = |ms: i64| states.at(ms * 1_000_000).map(|pose| pose.translation.x);
        for (ms, expected) in [
            (50, Some(0.5)),
            (-90, Some(0.0)),
            (190, Some(1.0)),
            (500, None),
            (1100, None),
            (900, Some(9.0)),
        ] {
            assert_eq!(x(ms), expected, "{ms}");
        }
    }
}
