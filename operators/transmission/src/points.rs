//! Clouds as bytes.

use realo_schemas::PointCloud;

use crate::bytes::{DecodeError, EncodeError, Reader, column, put_column};
use crate::codec::Columns;

const TIME: u8 = 1;
const RING: u8 = 2;

/// Writes the cloud and returns how many points were left out, because they are not finite.
pub(crate) fn write(out: &mut Vec<u8>, cloud: &PointCloud, columns: Columns) -> Result<u64, EncodeError> {
    let lengths = [
        cloud.y.len(),
        cloud.z.len(),
        cloud.intensity.len(),
        cloud.time.len(),
        cloud.ring.len(),
    ];
    if let Some(found) = lengths.into_iter().find(|length| *length != cloud.len()) {
        return Err(EncodeError::Length {
            field: "column of a cloud",
            found,
            expected: cloud.len() as u128,
        });
    }
    let finite = |i: usize| cloud.x[i].is_finite() && cloud.y[i].is_finite() && cloud.z[i].is_finite();
    if all_finite(&cloud.x) && all_finite(&cloud.y) && all_finite(&cloud.z) {
        write_columns(out, cloud, columns)?;
        return Ok(0);
    }
    let kept: Vec<usize> = (0..cloud.len()).filter(|i| finite(*i)).collect();
    let dropped = cloud.len() - kept.len();
    write_columns(out, &pick(cloud, &kept), columns)?;
    Ok(dropped as u64)
}

fn all_finite(values: &[f32]) -> bool {
    values.iter().all(|v| v.is_finite())
}

fn pick(cloud: &PointCloud, kept: &[usize]) -> PointCloud {
    PointCloud {
        x: kept.iter().map(|i| cloud.x[*i]).collect(),
        y: kept.iter().map(|i| cloud.y[*i]).collect(),
        z: kept.iter().map(|i| cloud.z[*i]).collect(),
        intensity: kept.iter().map(|i| cloud.intensity[*i]).collect(),
        time: kept.iter().map(|i| cloud.time[*i]).collect(),
        ring: kept.iter().map(|i| cloud.ring[*i]).collect(),
    }
}

fn write_columns(out: &mut Vec<u8>, cloud: &PointCloud, columns: Columns) -> Result<(), EncodeError> {
    let limit = u32::MAX as usize;
    let count = u32::try_from(cloud.len()).map_err(|_| EncodeError::TooMany {
        field: "points",
        found: cloud.len(),
        limit,
    })?;
    let time = if columns.time { TIME } else { 0 };
    let ring = if columns.ring { RING } else { 0 };
    out.extend(count.to_le_bytes());
    out.push(time | ring);
    for values in [&cloud.x, &cloud.y, &cloud.z] {
        put_column(out, values, f32::to_le_bytes);
    }
    out.extend_from_slice(&cloud.intensity);
    if columns.time {
        put_column(out, &cloud.time, i32::to_le_bytes);
    }
    if columns.ring {
        put_column(out, &cloud.ring, u16::to_le_bytes);
    }
    Ok(())
}

pub(crate) fn read(bytes: &mut Reader) -> Result<PointCloud, DecodeError> {
    let count = bytes.u32("number of points")? as usize;
    let flags = bytes.flags(TIME | RING, "flags of the points")?;
    let x = coordinates(bytes, count, "x")?;
    let y = coordinates(bytes, count, "y")?;
    let z = coordinates(bytes, count, "z")?;
    let intensity = bytes.take(count, 1, "intensity")?.to_vec();
    let time = match flags & TIME {
        0 => vec![0; count],
        _ => column(bytes.take(count, 4, "time")?, i32::from_le_bytes),
    };
    let ring = match flags & RING {
        0 => vec![0; count],
        _ => column(bytes.take(count, 2, "ring")?, u16::from_le_bytes),
    };
    let (x, y, z) = (x.into(), y.into(), z.into());
    Ok(PointCloud {
        x,
        y,
        z,
        intensity: intensity.into(),
        time: time.into(),
        ring: ring.into(),
    })
}

fn coordinates(bytes: &mut Reader, count: usize, field: &'static str) -> Result<Vec<f32>, DecodeError> {
    let values = column(bytes.take(count, 4, field)?, f32::from_le_bytes);
    if !all_finite(&values) {
        let found = "one that is not".into();
        return Err(DecodeError::Value {
            field,
            expected: "finite coordinates",
            found,
        });
    }
    Ok(values)
}
