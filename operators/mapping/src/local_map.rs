//! Maps of some keyframes, for registration.

use nalgebra::Isometry3;
use realo_registration::{MapBuilder, MapSettings, PosedSweep, RegistrarSettings, SettingError, VoxelMap};

use crate::keyframe::Keyframe;

/// Points that are registered, one for each cell of this side, m: finer than on a finished map, for cells in which ground and wall meet would
/// lower every sweep a little.
const ALIGNED_M: f64 = 0.5;
/// A voxel is taken with so many sampled points.
const MIN_POINTS: u32 = 5;

/// How sweeps are registered to maps of others.
pub(crate) fn registrar() -> RegistrarSettings {
    RegistrarSettings {
        sample_m: ALIGNED_M,
        ..RegistrarSettings::default()
    }
}

/// The map of keyframes, each with its pose in the frame of the map; `None` where nothing is in them.
///
/// # Errors
/// A voxel's side that is none.
pub(crate) fn map_of<'a>(
    keyframes: impl Iterator<Item = (&'a Keyframe, Isometry3<f64>)>,
    voxel_m: f64,
) -> Result<Option<VoxelMap>, SettingError> {
    let settings = MapSettings {
        voxel_m,
        min_points: MIN_POINTS,
        min_sweeps: 1,
        apart_s: 0.0,
        // What moves is left to the kernel of registration.
        empty_share: 1.0,
        ..MapSettings::default()
    };
    let mut builder = MapBuilder::new(settings, "odom")?;
    for (keyframe, pose) in keyframes {
        let sweep = PosedSweep {
            agent: "",
            stamp: keyframe.stamp,
            cloud: &keyframe.cloud,
            map_from_body: &pose,
            sensor: [0.0; 3],
            sigmas: [0.0; 3],
        };
        // One that is no place adds nothing.
        let _ = builder.add(&sweep);
    }
    Ok(builder.finish(|_, _| ()).ok())
}
