//! Calibrations, poses and times of KITTI.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3};
use realo_schemas::geometry::View;

use crate::ImportError;
use crate::files::read_text;
use crate::places::of_rows;

/// Size of an image, pixels: those of the set differ by some pixels, and no file says it.
const IMAGE: [u32; 2] = [1242, 375];
/// What was labelled in an image may lie beside it at the stamp of the sweep, m.
const MARGIN: f64 = 0.5;
/// Names that files give to the LiDAR's place in front of the rectified camera.
const MOUNTS: [&str; 3] = ["Tr_velo_to_cam", "Tr_velo_cam", "Tr"];
/// Names of the rectification.
const RECTIFICATIONS: [&str; 2] = ["R0_rect", "R_rect"];

/// Where camera and LiDAR are.
pub struct Calibration {
    path: PathBuf,
    /// Of the rectified camera 0.
    camera_from_lidar: Isometry3<f64>,
    /// Projection of the left colour camera, row by row.
    projection: [f64; 12],
}

impl Calibration {
    /// Reads a file of lines `NAME: numbers`.
    ///
    /// # Errors
    /// A line that is missing, or whose numbers are not those of a calibration.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        let text = read_text(path)?;
        let lines = Lines { path, text: &text };
        let mount = lines.numbers(&MOUNTS)?.ok_or_else(|| lines.missing(&MOUNTS))?;
        let mount = lines.isometry(MOUNTS[0], &mount)?;
        let rectified = match lines.numbers::<9>(&RECTIFICATIONS)? {
            Some([a, b, c, d, e, f, g, h, i]) => {
                lines.isometry(RECTIFICATIONS[0], &[a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0])?
            }
            // Poses and calibrations of the odometry benchmark are rectified already.
            None => Isometry3::identity(),
        };
        Ok(Calibration {
            path: path.into(),
            camera_from_lidar: rectified * mount,
            projection: lines.numbers(&["P2"])?.ok_or_else(|| lines.missing(&["P2"]))?,
        })
    }

    /// LiDAR from the rectified camera.
    pub fn lidar_from_camera(&self) -> Isometry3<f64> {
        self.camera_from_lidar.inverse()
    }

    /// Map from LiDAR, where the camera is there in the map of its first pose.
    pub fn map_from_lidar(&self, map_from_camera: Option<&Isometry3<f64>>) -> Isometry3<f64> {
        match map_from_camera {
            Some(pose) => self.camera_from_lidar.inverse() * pose * self.camera_from_lidar,
            None => Isometry3::identity(),
        }
    }

    /// What the left colour camera has in its image, in the frame of the LiDAR.
    ///
    /// # Errors
    /// A projection that no camera has.
    pub fn view(&self) -> Result<View, ImportError> {
        let [fx, _, cx, tx, _, fy, cy, ty, ..] = self.projection;
        // The colour camera is moved aside from camera 0, whose axes it shares.
        let aside = Translation3::new(-tx / fx, -ty / fy, 0.0);
        let view = View {
            frame_from_camera: self.lidar_from_camera() * aside,
            focal: [fx, fy],
            center: [cx, cy],
            size: IMAGE,
            margin: MARGIN,
        };
        view.checked()
            .map_err(|reason| ImportError::content(&self.path, format!("P2: {reason}")))
    }
}

struct Lines<'a> {
    path: &'a Path,
    text: &'a str,
}

impl Lines<'_> {
    fn missing(&self, names: &[&str]) -> ImportError {
        let reason = format!(
            "expected a line `{}: …`, found none; fetch the file anew",
            names.join(":` or `")
        );
        ImportError::content(self.path, reason)
    }

    /// The numbers of the first line that has one of these names.
    fn numbers<const N: usize>(&self, names: &[&str]) -> Result<Option<[f64; N]>, ImportError> {
        let mut lines = self.text.lines().filter_map(|line| line.trim().split_once([':', ' ']));
        let Some((name, words)) = lines.find(|(key, _)| names.contains(key)) else {
            return Ok(None);
        };
        let numbers = parsed(words).and_then(|numbers| {
            let found = numbers.len();
            numbers
                .try_into()
                .map_err(|_| format!("expected {N} numbers, found {found}"))
        });
        numbers
            .map(Some)
            .map_err(|reason| ImportError::content(self.path, format!("{name}: {reason}")))
    }

    fn isometry(&self, name: &str, rows: &[f64; 12]) -> Result<Isometry3<f64>, ImportError> {
        isometry(rows).map_err(|reason| ImportError::content(self.path, format!("{name}: {reason}")))
    }
}

fn parsed(words: &str) -> Result<Vec<f64>, String> {
    let number = |word: &str| {
        let number = word.parse().ok().filter(|number: &f64| number.is_finite());
        number.ok_or_else(|| format!("expected finite numbers, found `{}`", crate::shown(word)))
    };
    words.split_whitespace().map(number).collect()
}

/// A rotation with a translation in its last column, row by row.
fn isometry(rows: &[f64; 12]) -> Result<Isometry3<f64>, String> {
    of_rows(rows).ok_or_else(|| format!("expected a rotation in the first three columns, found {rows:?}"))
}

/// Poses of camera 0 in `poses.txt`, a line of 12 numbers each.
pub fn poses(dir: &Path) -> Result<Option<Vec<Isometry3<f64>>>, ImportError> {
    lines(&dir.join("poses.txt"), |numbers| match <[f64; 12]>::try_from(numbers) {
        Ok(rows) => isometry(&rows),
        Err(_) => Err(format!("expected 12 numbers, found {}", numbers.len())),
    })
}

/// Times in `times.txt`, s, a line each.
pub fn times(dir: &Path) -> Result<Option<Vec<f64>>, ImportError> {
    let times = lines(&dir.join("times.txt"), |numbers| match numbers {
        [time] => Ok(*time),
        _ => Err(format!("expected a time in s, found {} numbers", numbers.len())),
    })?;
    if let Some(line) = times
        .iter()
        .flat_map(|times| times.windows(2))
        .position(|pair| pair[1] <= pair[0])
    {
        let reason = format!("line {}: expected a later time than on the line before", line + 2);
        return Err(ImportError::content(&dir.join("times.txt"), reason));
    }
    Ok(times)
}

/// What the lines of a file are, if there is one.
fn lines<T>(path: &Path, of: impl Fn(&[f64]) -> Result<T, String>) -> Result<Option<Vec<T>>, ImportError> {
    if !path.exists() {
        return Ok(None);
    }
    let text = read_text(path)?;
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let read = lines.map(|(index, line)| {
        let read = parsed(line).and_then(|numbers| of(&numbers));
        read.map_err(|reason| ImportError::content(path, format!("line {}: {reason}", index + 1)))
    });
    read.collect::<Result<Vec<T>, _>>().map(Some)
}
