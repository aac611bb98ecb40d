//! Clouds of whole steps: each coordinate a number of steps, each column as differences in byte planes.

use std::ops::RangeInclusive;

use realo_operator::Steps;
use realo_schemas::PointCloud;
use zstd::bulk::{Compressor, Decompressor};
use zstd::zstd_safe::CParameter;

use super::column::{Planes, Range, differences, plane};
use super::lanes;
use crate::bytes::Reader;
use crate::codec::Columns;
use crate::compression::{compress, decompress};
use crate::error::{DecodeError, EncodeError};

/// Steps of coordinates, m.
pub(crate) const STEPS: RangeInclusive<f64> = 1e-6..=1.0;
/// Bytes of a point in memory.
const POINT: usize = 3 * 4 + 1 + 4 + 2;
/// Added to a number below 2⁵¹, it leaves the nearest whole one in the low bits.
const ROUND: f64 = 6_755_399_441_055_744.0;

/// Columns in the order in which they cross, and the largest width of each, bytes.
const COLUMNS: [(&str, usize); 6] = [("x", 4), ("y", 4), ("z", 4), ("intensity", 1), ("time", 4), ("ring", 2)];

/// Which of [`COLUMNS`] cross.
fn crossing(columns: Columns) -> impl Iterator<Item = usize> {
    let crosses = [true, true, true, true, columns.time, columns.ring];
    (0..COLUMNS.len()).filter(move |k| crosses[*k])
}

/// Puts clouds into bytes; what it works in serves one cloud after another.
pub(super) struct Writer {
    step: f64,
    zstd: Option<Compressor<'static>>,
    columns: [Vec<i32>; COLUMNS.len()],
    lanes: Vec<u8>,
    differences: Vec<u32>,
    /// One after another.
    planes: Vec<u8>,
    compressed: Vec<u8>,
}

impl Writer {
    /// A writer; `step` is one of [`STEPS`], `zstd` the level, of those that zstd has.
    pub fn new(step: f64, zstd: Option<i32>) -> std::io::Result<Self> {
        Ok(Writer {
            step,
            zstd: zstd.map(compressor).transpose()?,
            columns: Default::default(),
            lanes: Vec::new(),
            differences: Vec::new(),
            planes: Vec::new(),
            compressed: Vec::new(),
        })
    }

    /// Takes a cloud of finite coordinates in whole steps; `false` if one is too far out for them.
    pub fn quantise(&mut self, cloud: &PointCloud, columns: Columns) -> bool {
        let rate = 1.0 / self.step;
        let places = [&cloud.x, &cloud.y, &cloud.z];
        let fits = |values: &[f32]| f64::from(max(values)) * rate < f64::from(i32::MAX);
        if !places.iter().all(|values| fits(values)) {
            return false;
        }
        let [x, y, z, intensity, time, ring] = &mut self.columns;
        for (values, out) in places.into_iter().zip([x, y, z]) {
            fill(out, values, |v| (f64::from(v) * rate + ROUND).to_bits() as i32);
        }
        fill(intensity, &cloud.intensity, i32::from);
        if columns.time {
            fill(time, &cloud.time, |v| v);
        }
        if columns.ring {
            fill(ring, &cloud.ring, i32::from);
        }
        true
    }

    /// Writes what stands behind the flags of the cloud that was taken.
    pub fn write(
        &mut self,
        out: &mut Vec<u8>,
        cloud: &PointCloud,
        columns: Columns,
        steps: &mut Steps,
    ) -> Result<(), EncodeError> {
        let [x, y, z, ..] = &self.columns;
        let has_lanes = steps.time("lanes", || lanes::choose(cloud, [x, y, z], &mut self.lanes));
        out.extend(self.step.to_le_bytes());
        out.push(u8::from(has_lanes));
        steps.time("prediction", || self.predict(out, has_lanes, columns));
        steps.time("compression", || self.compress(out, cloud.len()))
    }

    /// Writes the ranges of the columns, and makes the planes.
    fn predict(&mut self, out: &mut Vec<u8>, has_lanes: bool, columns: Columns) {
        self.planes.clear();
        if has_lanes {
            let before = std::iter::once(&0).chain(&self.lanes);
            let lanes = self.lanes.iter().zip(before);
            self.planes
                .extend(lanes.map(|(lane, before)| lane.wrapping_sub(*before)));
        }
        let lanes = has_lanes.then_some(&self.lanes[..]);
        for k in crossing(columns) {
            let range = Range::of(&self.columns[k]);
            out.extend(range.min.to_le_bytes());
            out.push(range.width as u8);
            differences(&self.columns[k], lanes, range, &mut self.differences);
            (0..range.width).for_each(|byte| plane(&self.differences, byte, &mut self.planes));
        }
    }

    /// Writes the planes of so many points.
    fn compress(&mut self, out: &mut Vec<u8>, count: usize) -> Result<(), EncodeError> {
        let Some(zstd) = &mut self.zstd else {
            out.extend_from_slice(&self.planes);
            return Ok(());
        };
        for plane in self.planes.chunks_exact(count.max(1)) {
            compress(zstd, plane, &mut self.compressed)?;
            let length = u32::try_from(self.compressed.len()).map_err(|_| EncodeError::TooMany {
                field: "compressed bytes",
                found: self.compressed.len(),
                limit: u32::MAX as usize,
            })?;
            out.extend(length.to_le_bytes());
            out.extend_from_slice(&self.compressed);
        }
        Ok(())
    }
}

/// A compressor that hardly looks for matches at the levels up to 1: differences repeat themselves by chance only, and what
/// shortens them is the code of single bytes.
fn compressor(level: i32) -> std::io::Result<Compressor<'static>> {
    let mut zstd = Compressor::new(level)?;
    if level <= 1 {
        zstd.set_parameter(CParameter::MinMatch(7))?;
        zstd.set_parameter(CParameter::HashLog(10))?;
    }
    Ok(zstd)
}

fn fill<T: Copy>(out: &mut Vec<i32>, values: &[T], number: impl Fn(T) -> i32) {
    out.clear();
    out.extend(values.iter().map(|value| number(*value)));
}

/// The largest size of numbers, all finite.
fn max(values: &[f32]) -> f32 {
    // Bits of numbers without a sign go up as the numbers do, and the maximum of whole numbers is one of vectors.
    let sizes = values.iter().map(|value| (value.to_bits() & 0x7fff_ffff) as i32);
    f32::from_bits(sizes.max().unwrap_or_default() as u32)
}

/// Gets clouds out of bytes; what it works in serves one cloud after another.
pub(super) struct Parser {
    /// Largest cloud that is made, bytes.
    limit: usize,
    zstd: Decompressor<'static>,
    decompressed: Vec<u8>,
    planes: Vec<u8>,
    lanes: Vec<u8>,
    sums: Vec<u32>,
}

impl Parser {
    /// One that makes clouds up to so many bytes.
    pub fn new(limit: usize) -> std::io::Result<Self> {
        Ok(Parser {
            limit,
            zstd: Decompressor::new()?,
            decompressed: Vec::new(),
            planes: Vec::new(),
            lanes: Vec::new(),
            sums: Vec::new(),
        })
    }

    /// Reads what stands behind the flags of a cloud of so many points.
    pub fn read(
        &mut self,
        bytes: &mut Reader,
        count: usize,
        columns: Columns,
        zstd: bool,
        steps: &mut Steps,
    ) -> Result<PointCloud, DecodeError> {
        let size = count.saturating_mul(POINT);
        if size > self.limit {
            let limit = self.limit;
            return Err(DecodeError::Points { count, size, limit });
        }
        let [step] = bytes.f64s::<1>("step")?;
        if !STEPS.contains(&step) {
            return Err(DecodeError::Value {
                field: "step",
                expected: "0.000001 to 1 m",
                found: step.to_string(),
            });
        }
        let has_lanes = bytes.flags(1, "lanes")? != 0;
        let mut ranges = [Range::default(); COLUMNS.len()];
        for k in crossing(columns) {
            ranges[k] = range(bytes, k)?;
        }
        let number = usize::from(has_lanes) + ranges.iter().map(|range| range.width).sum::<usize>();
        let planes = match zstd {
            false => bytes.take(count, number, "planes")?,
            true => {
                steps.time("decompression", || self.decompress(bytes, number, count))?;
                &self.planes
            }
        };
        let (lanes, sums) = (&mut self.lanes, &mut self.sums);
        Ok(steps.time("reconstruction", || {
            let (first, planes) = planes.split_at(if has_lanes { count } else { 0 });
            lanes.clear();
            lanes.extend(first.iter().scan(0u8, |lane, difference| {
                *lane = lane.wrapping_add(*difference);
                Some(*lane)
            }));
            let lanes = has_lanes.then_some(&lanes[..]);
            let mut planes = Planes {
                planes,
                count,
                lanes,
                sums,
            };
            let [x, y, z, intensity, time, ring] = ranges;
            let place = |number: i32| (f64::from(number) * step) as f32;
            PointCloud {
                x: planes.column(x, place).into(),
                y: planes.column(y, place).into(),
                z: planes.column(z, place).into(),
                intensity: planes.column(intensity, |v| v as u8).into(),
                time: planes.column(time, |v| v).into(),
                ring: planes.column(ring, |v| v as u16).into(),
            }
        }))
    }

    fn decompress(&mut self, bytes: &mut Reader, number: usize, count: usize) -> Result<(), DecodeError> {
        self.planes.clear();
        for _ in 0..number {
            let length = bytes.u32("size of a compressed plane")? as usize;
            let compressed = bytes.take(length, 1, "compressed plane")?;
            let into = &mut self.decompressed;
            decompress(&mut self.zstd, compressed, count, "compressed plane", into)?;
            self.planes.extend_from_slice(into);
        }
        Ok(())
    }
}

fn range(bytes: &mut Reader, column: usize) -> Result<Range, DecodeError> {
    let (name, max) = COLUMNS[column];
    let min = bytes.u32("min number of a column")? as i32;
    let width = usize::from(bytes.u8("width of a column")?);
    if width > max {
        return Err(DecodeError::Value {
            field: "width of a column",
            expected: "no more bytes than its numbers have",
            found: format!("{width} of {name}"),
        });
    }
    Ok(Range { min, width })
}
