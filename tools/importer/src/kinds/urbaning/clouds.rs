//! Clouds of UrbanIng-V2X: archives of arrays, one for each LiDAR.

use std::path::Path;

use nalgebra::Point3;

use super::super::numpy::array::Arrays;
use crate::ImportError;
use crate::pcd::{Intensities, Points};
use crate::scenes::{FurtherCloud, SweepFiles};

/// Arrays of a cloud.
const ARRAYS: [&str; 5] = ["x", "y", "z", "intensity", "time_offset_ms"];
/// Times of points are nearer than this to the time of their cloud, ms, and clouds of a sweep to each other.
const NEAR_MS: f64 = 1000.0;

/// Points of all LiDARs of a sweep, in the frame of the first, with times that count from the first's.
///
/// # Errors
/// A cloud that cannot be read; clouds that are a second or more apart.
pub fn of_sweep(files: &SweepFiles) -> Result<Points, ImportError> {
    let mut points = points(&files.cloud)?;
    for further in &files.more {
        add(&mut points, further)?;
    }
    Ok(points)
}

/// Points in the frame of their LiDAR.
fn points(path: &Path) -> Result<Points, ImportError> {
    let wrong = |reason: String| ImportError::content(path, reason);
    let mut arrays = Arrays::read(path)?;
    let mut column = |name: &str| -> Result<(Vec<f64>, &'static str), ImportError> {
        let array = arrays.array(name).map_err(wrong)?;
        let known = ARRAYS.join("`, `");
        let array = array.ok_or_else(|| {
            wrong(format!(
                "expected the arrays `{known}`, found no `{name}` among {}",
                arrays.names()
            ))
        })?;
        let (numbers, kind) = array
            .numbers()
            .map_err(|reason| wrong(format!("array `{name}`: {reason}")))?;
        match array.shape[..] {
            [_] | [_, 1] | [1, _] => Ok((numbers.to_vec(), kind)),
            _ => Err(wrong(format!(
                "array `{name}`: expected a column, found the shape {:?}",
                array.shape
            ))),
        }
    };
    let [(x, _), (y, _), (z, _)] = [column("x")?, column("y")?, column("z")?];
    let ((values, kind), (offsets, _)) = (column("intensity")?, column("time_offset_ms")?);
    if [y.len(), z.len(), values.len(), offsets.len()]
        .iter()
        .any(|count| *count != x.len())
    {
        return Err(wrong(format!(
            "expected arrays of one length, {} as `x`; fetch the file anew",
            x.len()
        )));
    }
    let offset = |ms: f64| match ms.abs() < NEAR_MS {
        true => Ok((ms * 1e6).round() as i32),
        false => Err(wrong(format!(
            "array `time_offset_ms`: expected ms within ±{NEAR_MS} of the sweep, found {ms}"
        ))),
    };
    Ok(Points {
        x,
        y,
        z,
        intensity: Intensities::Others {
            kind,
            values: values.into_iter().map(|value| value as f32).collect(),
        },
        offset_ns: Some(offsets.into_iter().map(offset).collect::<Result<_, _>>()?),
        ..Points::default()
    })
}

/// Adds the points of another LiDAR.
fn add(points: &mut Points, further: &FurtherCloud) -> Result<(), ImportError> {
    let FurtherCloud {
        cloud,
        first_from_this,
        later,
    } = further;
    let near_ns = (NEAR_MS * 1e6) as i32;
    let later = i32::try_from(*later).ok().filter(|later| later.abs() < near_ns);
    let later = later.ok_or_else(|| {
        let ms = further.later as f64 / 1e6;
        let reason = format!(
            "expected a cloud within {NEAR_MS} ms of the first LiDAR's, found one {ms} ms later; see its times, or take those of the names \
             of the files, as --times names"
        );
        ImportError::content(cloud, reason)
    })?;
    let other = self::points(cloud)?;
    for ((x, y), z) in other.x.iter().zip(&other.y).zip(&other.z) {
        let point = first_from_this * Point3::new(*x, *y, *z);
        points.x.push(point.x);
        points.y.push(point.y);
        points.z.push(point.z);
    }
    if let (Intensities::Others { values, .. }, Intensities::Others { values: more, .. }) =
        (&mut points.intensity, other.intensity)
    {
        values.extend(more);
    }
    if let (Some(offsets), Some(more)) = (&mut points.offset_ns, other.offset_ns) {
        // Both are within a second, so that the sum is an i32.
        offsets.extend(more.into_iter().map(|offset| offset + later));
    }
    Ok(())
}
