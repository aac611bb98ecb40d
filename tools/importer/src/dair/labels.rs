//! Labels of a side, and cooperative ones.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Point3, Vector3};
use realo_schemas::Box3;
use realo_schemas::geometry::{is_valid, transform_box};
use serde::Deserialize;

use crate::ImportError;
use crate::files::{number, read_json};

/// Labels lie no farther from their agent, m.
const LABELLED: f64 = 1000.0;
/// No labelled thing is longer, wider or higher, m.
const LONGEST: f64 = 100.0;

/// More than a heading in radians needs, and less than most in degrees.
const MOST_TURN: f64 = 4.0 * std::f64::consts::PI;

/// Corners of a box and its extents differ by rounding only; by so much of its longest side they are not of one box.
const MOST_APART: f64 = 0.1;

/// A label in a frame of its agent; itself if there can be no such one.
fn label_box(label: Box3) -> Result<Box3, Box<Box3>> {
    let near = label.center.iter().all(|metres| metres.abs() <= LABELLED);
    let small = [label.length, label.width, label.height]
        .iter()
        .all(|metres| *metres <= LONGEST);
    match is_valid(&label) && near && small && label.yaw.abs() <= MOST_TURN {
        true => Ok(label),
        false => Err(label.into()),
    }
}

fn not_a_label(path: &Path, index: usize, found: &Box3) -> ImportError {
    let Box3 {
        center,
        length,
        width,
        height,
        yaw,
        class,
        ..
    } = found;
    let reason = format!(
        "label {index} (`{class}`): expected a box within {LABELLED} m of its agent, at most {LONGEST} m long, with a heading in \
         radians within ±4π, found centre {center:?} there, extents {:?} m and heading {yaw}",
        [length, width, height]
    );
    ImportError::content(path, reason)
}

/// Labels of a sweep as boxes, and how many were placeholders.
#[derive(Default)]
pub struct Labels {
    /// Those with an extent.
    pub boxes: Vec<Box3>,
    /// Labels without extent, which were annotated in the image only.
    pub placeholders: usize,
}

/// Labels of one side, in the frame of its LiDAR.
pub fn side_labels(path: &Path) -> Result<Labels, ImportError> {
    let mut labels = Labels::default();
    for (index, label) in read_json::<Vec<SideLabel>>(path)?.into_iter().enumerate() {
        match label.to_box(path, index)? {
            Some(in_lidar) => labels.boxes.push(in_lidar),
            None => labels.placeholders += 1,
        }
    }
    Ok(labels)
}

impl Labels {
    /// The same in another frame.
    pub fn moved(self, to_from_here: &Isometry3<f64>) -> Self {
        let moved = |object: &Box3| transform_box(to_from_here, object);
        Labels {
            boxes: self.boxes.iter().map(moved).collect(),
            ..self
        }
    }
}

/// Cooperative labels as their file has them, in the world.
pub struct WorldLabels {
    path: PathBuf,
    labels: Vec<WorldLabel>,
}

impl WorldLabels {
    /// Reads a file of them.
    pub fn read(path: &Path) -> Result<Self, ImportError> {
        Ok(WorldLabels {
            path: path.into(),
            labels: read_json(path)?,
        })
    }

    /// The labels in the vehicle's body frame. Their pose is taken from the corners: `rotation` is the angle in the frame of
    /// the side that drew the box, and missing where that is the roadside unit.
    pub fn in_body(&self, map_from_body: &Isometry3<f64>) -> Result<Labels, ImportError> {
        let body_from_map = map_from_body.inverse();
        let mut labels = Labels::default();
        for (index, label) in self.labels.iter().enumerate() {
            if label.size.is_placeholder() {
                labels.placeholders += 1;
                continue;
            }
            let corners = label
                .corners
                .map(|corner| (body_from_map * Point3::from(corner)).coords);
            label.check_corners().map_err(|reason| {
                ImportError::content(&self.path, format!("label {index} (`{}`): {reason}", label.class))
            })?;
            let center = corners.iter().sum::<Vector3<f64>>() / 8.0;
            let front = corners[0] + corners[1] + corners[4] + corners[5];
            let rear = corners[2] + corners[3] + corners[6] + corners[7];
            let heading = front - rear;
            let yaw = nalgebra::RealField::atan2(heading.y, heading.x);
            let in_body = label.size.to_box(center.into(), yaw, &label.class);
            let in_body = label_box(in_body).map_err(|found| not_a_label(&self.path, index, &found))?;
            labels.boxes.push(in_body);
        }
        Ok(labels)
    }
}

/// A label in the frame of a LiDAR, as a file has it.
#[derive(Deserialize)]
pub struct SideLabel {
    /// Its class.
    #[serde(rename = "type")]
    pub class: String,
    #[serde(rename = "3d_dimensions")]
    size: Size,
    #[serde(rename = "3d_location")]
    location: Location,
    #[serde(deserialize_with = "number")]
    rotation: f64,
}

impl SideLabel {
    /// Its box, the label being `index` of those of the file `path`; `None` of a placeholder.
    ///
    /// # Errors
    /// Numbers that cannot be those of a box.
    pub fn to_box(&self, path: &Path, index: usize) -> Result<Option<Box3>, ImportError> {
        if self.size.is_placeholder() {
            return Ok(None);
        }
        let Location { x, y, z } = self.location;
        let in_lidar = self.size.to_box([x, y, z], self.rotation, &self.class);
        let in_lidar = label_box(in_lidar).map_err(|found| not_a_label(path, index, &found))?;
        Ok(Some(in_lidar))
    }
}

#[derive(Deserialize)]
struct WorldLabel {
    #[serde(rename = "type")]
    class: String,
    #[serde(rename = "3d_dimensions")]
    size: Size,
    /// Front-left, front-right, rear-right, rear-left of the bottom, then of the top.
    #[serde(rename = "world_8_points")]
    corners: [[f64; 3]; 8],
}

impl WorldLabel {
    /// Checks that the edges match the extents, so that the first corners are the front.
    fn check_corners(&self) -> Result<(), String> {
        let corners = self.corners.map(Point3::from);
        let edge = |to: usize| (corners[to] - corners[0]).norm();
        let found = [edge(3), edge(1), edge(4)];
        let extents = [self.size.l, self.size.w, self.size.h];
        let longest = extents.iter().copied().fold(0.0, f64::max);
        let fits = |(found, extent): (&f64, f64)| (found - extent).abs() <= MOST_APART * longest;
        // Corners that are not finite are reported with the box.
        match found.iter().zip(extents).all(fits) || found.iter().any(|edge| !edge.is_finite()) {
            true => Ok(()),
            false => Err(format!(
                "world_8_points: expected front-left, front-right, rear-right, rear-left of the bottom, then of the top, of a box of \
                 {extents:.2?} m (l, w, h of 3d_dimensions), found edges of {found:.2?} m"
            )),
        }
    }
}

#[derive(Deserialize)]
struct Size {
    #[serde(deserialize_with = "number")]
    l: f64,
    #[serde(deserialize_with = "number")]
    w: f64,
    #[serde(deserialize_with = "number")]
    h: f64,
}

impl Size {
    /// Of an object that was labelled in the image only; what is below 0 or not a number is damage.
    fn is_placeholder(&self) -> bool {
        let all = [self.l, self.w, self.h];
        all.contains(&0.0) && all.iter().all(|metres| *metres >= 0.0)
    }

    fn to_box(&self, center: [f64; 3], yaw: f64, class: &str) -> Box3 {
        Box3 {
            center,
            length: self.l,
            width: self.w,
            height: self.h,
            yaw,
            velocity: None,
            class: class.into(),
            score: 1.0,
            track: None,
            covariance: None,
        }
    }
}

#[derive(Deserialize)]
struct Location {
    #[serde(deserialize_with = "number")]
    x: f64,
    #[serde(deserialize_with = "number")]
    y: f64,
    #[serde(deserialize_with = "number")]
    z: f64,
}
