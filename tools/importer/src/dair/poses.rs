//! Where LiDARs and cameras are, by the calibrations.

use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use realo_schemas::geometry::{View, tilt_degrees};
use serde::Deserialize;
use serde_json::Value;

use crate::ImportError;
use crate::files::read_json;
use crate::places::{MOST_TILT, ORTHONORMAL, WORLD, is_rotation};

/// Size of all images, pixels.
const IMAGE: [u32; 2] = [1920, 1080];
/// What was labelled in an image may lie beside it at the sweep's stamp, m: up to 0.12 s lie between the two. Three of the
/// sample's labels lie beside it, by up to 0.99 m.
const VIEW_MARGIN: f64 = 1.0;

type Parts = (Matrix3<f64>, Vector3<f64>);

fn compose((r1, t1): &Parts, (r2, t2): &Parts) -> Parts {
    (r1 * r2, r1 * t2 + t1)
}

/// [`ORTHONORMAL`] of a camera's: the rotations to roadside cameras are skewed, with a determinant of 0.81.
const SKEWED: f64 = 0.5;

/// A calibration from a file, whose rotation is one but for so much.
fn calibration(path: &Path, skew: f64) -> Result<Parts, ImportError> {
    let transform = Transform::read(path)?;
    let (rotation, translation) = transform.parts();
    if !is_rotation(&rotation, skew) {
        let reason = format!(
            "rotation: expected an orthonormal matrix (within {skew}) with a positive determinant, found {:?} with determinant {:.3}",
            transform.rotation,
            rotation.determinant()
        );
        return Err(ImportError::content(path, reason));
    }
    if !translation.iter().all(|metres| metres.abs() <= WORLD) {
        let reason = format!(
            "translation: expected metres within ±{WORLD:e}, found {:?}",
            transform.translation
        );
        return Err(ImportError::content(path, reason));
    }
    Ok((rotation, translation))
}

/// Map from a LiDAR, by the calibration of the LiDAR in the world.
fn pose_of_lidar(path: &Path, parts: &Parts) -> Result<Isometry3<f64>, ImportError> {
    let map_from_lidar = isometry(parts);
    let tilt = tilt_degrees(&map_from_lidar.rotation);
    if tilt > MOST_TILT {
        let reason = format!("rotation: expected a LiDAR that tilts by at most {MOST_TILT}°, found {tilt:.1}°");
        return Err(ImportError::content(path, reason));
    }
    Ok(map_from_lidar)
}

/// The nearest rotation, and the translation.
fn isometry((rotation, translation): &Parts) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_matrix(rotation);
    Isometry3::from_parts(Translation3::from(*translation), rotation)
}

/// Map from the vehicle's LiDAR: from its LiDAR to its receiver, and from there to the world.
pub fn vehicle_pose(mounting: &Path, place: &Path) -> Result<Isometry3<f64>, ImportError> {
    let novatel_from_lidar = calibration(mounting, ORTHONORMAL)?;
    let world_from_novatel = calibration(place, ORTHONORMAL)?;
    pose_of_lidar(place, &compose(&world_from_novatel, &novatel_from_lidar))
}

/// Map from the roadside unit's LiDAR, the offset added in the world, m.
pub fn roadside_pose(path: &Path, [dx, dy]: [f64; 2]) -> Result<Isometry3<f64>, ImportError> {
    let mut map_from_lidar = pose_of_lidar(path, &calibration(path, ORTHONORMAL)?)?;
    map_from_lidar.translation.vector += Vector3::new(dx, dy, 0.0);
    Ok(map_from_lidar)
}

/// A side's camera: where it is, and what is in its image.
pub struct Camera {
    camera_from_lidar: Isometry3<f64>,
    intrinsic: Intrinsic,
    path: PathBuf,
}

impl Camera {
    /// Reads the calibrations of where it lies to the LiDAR, and of its image.
    pub fn read(extrinsic: &Path, intrinsic: &Path) -> Result<Self, ImportError> {
        Ok(Camera {
            camera_from_lidar: isometry(&calibration(extrinsic, SKEWED)?),
            intrinsic: read_json(intrinsic)?,
            path: intrinsic.into(),
        })
    }

    /// What it has in its image, in the frame that is given from the LiDAR.
    pub fn view(&self, to_from_lidar: &Isometry3<f64>) -> Result<View, ImportError> {
        let Intrinsic { k, width, height } = &self.intrinsic;
        let view = View {
            frame_from_camera: to_from_lidar * self.camera_from_lidar.inverse(),
            focal: [k[0], k[4]],
            center: [k[2], k[5]],
            size: [width.unwrap_or(IMAGE[0]), height.unwrap_or(IMAGE[1])],
            margin: VIEW_MARGIN,
        };
        let named = |reason: String| {
            let said = [
                ("`focal`", "`cam_K`"),
                ("`center`", "`cam_K`"),
                ("`size`", "`width`, `height`"),
            ];
            said.iter()
                .fold(reason, |reason, (ours, theirs)| reason.replace(ours, theirs))
        };
        view.checked()
            .map_err(|reason| ImportError::content(&self.path, named(reason)))
    }
}

#[derive(Deserialize)]
struct Transform {
    rotation: [[f64; 3]; 3],
    translation: [[f64; 1]; 3],
}

impl Transform {
    /// Reads a file, in some of which it is under a key `transform`.
    fn read(path: &Path) -> Result<Self, ImportError> {
        let mut file: Value = read_json(path)?;
        let inner = file.get_mut("transform").map(Value::take);
        serde_json::from_value(inner.unwrap_or(file)).map_err(|error| ImportError::content(path, error))
    }

    fn parts(&self) -> Parts {
        let rotation = Matrix3::from_fn(|row, column| self.rotation[row][column]);
        (rotation, Vector3::from_fn(|row, _| self.translation[row][0]))
    }
}

/// Of a camera: its matrix, row-major, and the size of its image, which the vehicle's files leave out.
#[derive(Deserialize)]
struct Intrinsic {
    #[serde(rename = "cam_K")]
    k: [f64; 9],
    width: Option<u32>,
    height: Option<u32>,
}
