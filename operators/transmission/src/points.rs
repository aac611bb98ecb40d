//! Clouds as bytes: columns as they are, or in whole steps and compressed as the encoder's settings say; the bytes say how.

mod column;
mod lanes;
mod quantised;

use std::borrow::Cow;

use realo_operator::Steps;
use realo_schemas::PointCloud;

use crate::bytes::{Reader, column, put_column};
use crate::codec::Columns;
use crate::error::{DecodeError, EncodeError};
pub(crate) use quantised::STEPS;

const TIME: u8 = 1;
const RING: u8 = 2;
const QUANTISED: u8 = 4;
const ZSTD: u8 = 8;

/// How the points of one cloud crossed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Coding {
    quantised: bool,
    zstd: bool,
}

impl Coding {
    /// The steps in the words of [`realo_schemas::Packet::codec`].
    pub fn steps(self) -> impl Iterator<Item = &'static str> {
        let steps: &[_] = match (self.quantised, self.zstd) {
            (false, _) => &[],
            (true, false) => &["step", "delta", "shuffle"],
            (true, true) => &["step", "delta", "shuffle", "zstd"],
        };
        steps.iter().copied()
    }
}

/// Puts clouds into bytes; what it works in serves one cloud after another.
pub(crate) struct Writer {
    columns: Columns,
    quantised: Option<quantised::Writer>,
    zstd: bool,
}

impl Writer {
    /// A writer; `step_m` is 0 or one of [`STEPS`], `zstd` the level, of those that zstd has.
    pub fn new(columns: Columns, step_m: f64, zstd: Option<i32>) -> std::io::Result<Self> {
        let quantised = (step_m != 0.0).then(|| quantised::Writer::new(step_m, zstd));
        Ok(Writer {
            columns,
            quantised: quantised.transpose()?,
            zstd: zstd.is_some(),
        })
    }

    /// Writes a cloud; gives how, and how many points were left out, because they are not finite.
    pub fn write(
        &mut self,
        out: &mut Vec<u8>,
        cloud: &PointCloud,
        steps: &mut Steps,
    ) -> Result<(Coding, u64), EncodeError> {
        let count = check(cloud)?;
        let mut quantised = self.quantised.as_mut();
        let columns = self.columns;
        let cloud_of_finite = steps.time("quantisation", || {
            let finite = finite(cloud);
            // One with a point too far out for whole steps crosses as it is.
            quantised.take_if(|writer| !writer.quantise(&finite, columns));
            finite
        });
        let (cloud, dropped) = (&*cloud_of_finite, cloud.len() - cloud_of_finite.len());
        let coding = Coding {
            quantised: quantised.is_some(),
            zstd: quantised.is_some() && self.zstd,
        };
        out.extend((count - dropped as u32).to_le_bytes());
        let flag = |set: bool, flag: u8| if set { flag } else { 0 };
        let sent = flag(columns.time, TIME) | flag(columns.ring, RING);
        out.push(sent | flag(coding.quantised, QUANTISED) | flag(coding.zstd, ZSTD));
        match quantised {
            Some(writer) => writer.write(out, cloud, columns, steps)?,
            None => steps.time("serialisation", || put_exact(out, cloud, columns)),
        }
        Ok((coding, dropped as u64))
    }
}

/// The number of points of a cloud that can be sent.
fn check(cloud: &PointCloud) -> Result<u32, EncodeError> {
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
    u32::try_from(cloud.len()).map_err(|_| EncodeError::TooMany {
        field: "points",
        found: cloud.len(),
        limit: u32::MAX as usize,
    })
}

/// The points that are finite.
fn finite(cloud: &PointCloud) -> Cow<'_, PointCloud> {
    if [&cloud.x, &cloud.y, &cloud.z].iter().all(|values| all_finite(values)) {
        return Cow::Borrowed(cloud);
    }
    let finite = |i: &usize| cloud.x[*i].is_finite() && cloud.y[*i].is_finite() && cloud.z[*i].is_finite();
    let kept: Vec<usize> = (0..cloud.len()).filter(finite).collect();
    Cow::Owned(pick(cloud, &kept))
}

fn all_finite(values: &[f32]) -> bool {
    // Without a branch between numbers, so that the loop becomes vectors.
    values.iter().fold(true, |all, v| all & v.is_finite())
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

fn put_exact(out: &mut Vec<u8>, cloud: &PointCloud, columns: Columns) {
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
}

/// Gets clouds out of bytes; what it works in serves one cloud after another.
pub(crate) struct Parser {
    quantised: quantised::Parser,
}

impl Parser {
    /// One that makes quantised clouds up to so many bytes; the size of others is in their packet.
    pub fn new(limit: usize) -> std::io::Result<Self> {
        Ok(Parser {
            quantised: quantised::Parser::new(limit)?,
        })
    }

    /// Reads a cloud; gives how its points crossed.
    pub fn read(&mut self, bytes: &mut Reader, steps: &mut Steps) -> Result<(PointCloud, Coding), DecodeError> {
        let count = bytes.u32("number of points")? as usize;
        let flags = bytes.flags(TIME | RING | QUANTISED | ZSTD, "flags of the points")?;
        let columns = Columns {
            time: flags & TIME != 0,
            ring: flags & RING != 0,
        };
        let coding = Coding {
            quantised: flags & QUANTISED != 0,
            zstd: flags & ZSTD != 0,
        };
        let cloud = match coding {
            Coding { quantised: true, zstd } => self.quantised.read(bytes, count, columns, zstd, steps)?,
            Coding { zstd: false, .. } => steps.time("deserialisation", || exact(bytes, count, columns))?,
            Coding { zstd: true, .. } => {
                return Err(DecodeError::Value {
                    field: "flags of the points",
                    expected: "zstd of quantised points only",
                    found: format!("{flags:#010b}"),
                });
            }
        };
        Ok((cloud, coding))
    }
}

fn exact(bytes: &mut Reader, count: usize, columns: Columns) -> Result<PointCloud, DecodeError> {
    let x = coordinates(bytes, count, "x")?;
    let y = coordinates(bytes, count, "y")?;
    let z = coordinates(bytes, count, "z")?;
    let intensity = bytes.take(count, 1, "intensity")?.to_vec();
    let time = match columns.time {
        false => vec![0; count],
        true => column(bytes.take(count, 4, "time")?, i32::from_le_bytes),
    };
    let ring = match columns.ring {
        false => vec![0; count],
        true => column(bytes.take(count, 2, "ring")?, u16::from_le_bytes),
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

#[cfg(test)]
mod tests;
