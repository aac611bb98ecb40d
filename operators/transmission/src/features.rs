//! Feature maps as bytes: converted, shuffled and compressed as the encoder is told; the bytes say how.

use arrow::buffer::Buffer;
use realo_operator::Steps;
use realo_schemas::{DType, Elements, FeatureMap};
use zstd::bulk::{Compressor, Decompressor};

use crate::bytes::{DecodeError, EncodeError, Reader, column, put_column, put_f64s, put_text};
use crate::compression::{compress, decompress};
use crate::elements::{Scales, are_finite, from_f16, not_finite, to_f16};
use crate::shuffle::transpose;

const DTYPES: [DType; 4] = [DType::F32, DType::F16, DType::Bf16, DType::U8];

const SHUFFLE: u8 = 1;
const ZSTD: u8 = 2;

/// How the elements of one map crossed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Coding {
    /// `F32`: as they were, whatever their type.
    elements: Elements,
    shuffle: bool,
    zstd: bool,
}

impl Coding {
    /// The steps in the words of [`realo_schemas::Packet::codec`].
    pub fn steps(self) -> impl Iterator<Item = &'static str> {
        let elements = match self.elements {
            Elements::F32 => None,
            Elements::F16 => Some("f16"),
            Elements::Int8 => Some("int8"),
        };
        let shuffle = self.shuffle.then_some("shuffle");
        let zstd = self.zstd.then_some("zstd");
        [elements, shuffle, zstd].into_iter().flatten()
    }
}

/// Puts maps into bytes; what it works in serves one map after another.
pub(crate) struct Writer {
    elements: Elements,
    shuffle: bool,
    zstd: Option<Compressor<'static>>,
    scales: Scales,
    converted: Vec<u8>,
    shuffled: Vec<u8>,
    compressed: Vec<u8>,
}

impl Writer {
    /// A writer; `zstd`: the level, of those that zstd has.
    pub fn new(elements: Elements, shuffle: bool, zstd: Option<i32>) -> std::io::Result<Self> {
        Ok(Writer {
            elements,
            shuffle,
            zstd: zstd.map(Compressor::new).transpose()?,
            scales: Scales::default(),
            converted: Vec::new(),
            shuffled: Vec::new(),
            compressed: Vec::new(),
        })
    }

    /// Writes a map; gives how, and how many numbers half precision could not hold.
    pub fn write(
        &mut self,
        out: &mut Vec<u8>,
        map: &FeatureMap,
        steps: &mut Steps,
    ) -> Result<(Coding, u64), EncodeError> {
        check(map)?;
        let (elements, beyond) = steps.time("quantisation", || self.convert(map))?;
        let mut bytes: &[u8] = match elements {
            Elements::F32 => &map.data,
            _ => &self.converted,
        };
        let cells = map.rows as usize * map.columns as usize;
        if self.shuffle {
            self.shuffled.resize(bytes.len(), 0);
            steps.time("shuffling", || {
                transpose(bytes, bytes.len() / cells, &mut self.shuffled)
            });
            bytes = &self.shuffled;
        }
        if let Some(zstd) = &mut self.zstd {
            steps.time("compression", || compress(zstd, bytes, &mut self.compressed))?;
            bytes = &self.compressed;
        }
        let coding = Coding {
            elements,
            shuffle: self.shuffle,
            zstd: self.zstd.is_some(),
        };
        steps.time("serialisation", || serialise(out, map, coding, &self.scales, bytes))?;
        Ok((coding, beyond))
    }

    /// Converts numbers of a map of f32 as told; any other map stays as it is.
    fn convert(&mut self, map: &FeatureMap) -> Result<(Elements, u64), EncodeError> {
        if !are_finite(&map.data, map.dtype) {
            return Err(EncodeError::NotFinite("feature map"));
        }
        let Some(numbers) = map.numbers().ok().filter(|_| self.elements != Elements::F32) else {
            return Ok((Elements::F32, 0));
        };
        let beyond = match self.elements {
            Elements::F16 => to_f16(&numbers, &mut self.converted),
            _ => {
                let channels = map.channels as usize;
                self.scales.quantise(&numbers, channels, &mut self.converted)?;
                0
            }
        };
        Ok((self.elements, beyond))
    }
}

fn check(map: &FeatureMap) -> Result<(), EncodeError> {
    let shape = [map.rows, map.columns, map.channels];
    if shape.contains(&0) {
        return Err(EncodeError::Empty(shape));
    }
    let expected = FeatureMap::size_of(shape, map.dtype);
    if map.data.len() as u128 != expected {
        return Err(EncodeError::Length {
            field: "feature map",
            found: map.data.len(),
            expected,
        });
    }
    Ok(())
}

fn serialise(
    out: &mut Vec<u8>,
    map: &FeatureMap,
    coding: Coding,
    scales: &Scales,
    bytes: &[u8],
) -> Result<(), EncodeError> {
    let shape = [map.rows, map.columns, map.channels];
    out.reserve(400 + 8 * map.channels as usize + bytes.len());
    out.extend(shape.iter().flat_map(|v| v.to_le_bytes()));
    put_f64s(out, &[map.cell, map.origin[0], map.origin[1]], "cell or origin")?;
    let dtype = match map.dtype {
        DType::F32 => 0,
        DType::F16 => 1,
        DType::Bf16 => 2,
        DType::U8 => 3,
    };
    out.push(dtype);
    put_text(out, &map.model, "length of model")?;
    let elements = match coding.elements {
        Elements::F32 => 0,
        Elements::F16 => 1,
        Elements::Int8 => 2,
    };
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    out.extend([elements, flag(coding.shuffle, SHUFFLE) | flag(coding.zstd, ZSTD)]);
    if coding.elements == Elements::Int8 {
        put_column(out, &scales.least, f32::to_le_bytes);
        put_column(out, &scales.step, f32::to_le_bytes);
    }
    if coding.zstd {
        let length = u32::try_from(bytes.len()).map_err(|_| EncodeError::TooMany {
            field: "compressed bytes",
            found: bytes.len(),
            limit: u32::MAX as usize,
        })?;
        out.extend(length.to_le_bytes());
    }
    out.extend_from_slice(bytes);
    Ok(())
}

/// Gets maps out of bytes; what it works in serves one map after another.
pub(crate) struct Parser {
    /// Greatest map that is made, bytes.
    limit: usize,
    zstd: Decompressor<'static>,
    scales: Scales,
    decompressed: Vec<u8>,
    put_back: Vec<u8>,
}

impl Parser {
    /// One that makes maps up to so many bytes.
    pub fn new(limit: usize) -> std::io::Result<Self> {
        Ok(Parser {
            limit,
            zstd: Decompressor::new()?,
            scales: Scales::default(),
            decompressed: Vec::new(),
            put_back: Vec::new(),
        })
    }

    /// Reads a map; gives how its elements crossed.
    pub fn read(&mut self, bytes: &mut Reader, steps: &mut Steps) -> Result<(FeatureMap, Coding), DecodeError> {
        let (map, coding) = steps.time("deserialisation", || self.head(bytes))?;
        let width = match coding.elements {
            Elements::F32 => map.dtype.size(),
            Elements::F16 => 2,
            Elements::Int8 => 1,
        };
        // The map itself is within the limit, and an element that crosses is no greater than one of the map.
        let cells = map.rows as usize * map.columns as usize;
        let length = cells * map.channels as usize * width;
        let mut elements = match coding.zstd {
            false => bytes.take(length, 1, "elements")?,
            true => {
                let size = bytes.u32("size of the compressed elements")?;
                let compressed = bytes.take(size as usize, 1, "compressed elements")?;
                let into = &mut self.decompressed;
                steps.time("decompression", || {
                    decompress(&mut self.zstd, compressed, length, "compressed elements", into)
                })?;
                &self.decompressed
            }
        };
        if coding.shuffle {
            self.put_back.resize(length, 0);
            steps.time("unshuffling", || transpose(elements, cells, &mut self.put_back));
            elements = &self.put_back;
        }
        let scales = &self.scales;
        let data = steps.time("dequantisation", || match coding.elements {
            Elements::F32 if !are_finite(elements, map.dtype) => Err(not_finite()),
            // A copy, because a slice of the packet would be aligned by chance only.
            Elements::F32 => Ok(Buffer::from(elements)),
            Elements::F16 => from_f16(elements).map(Buffer::from_vec),
            Elements::Int8 => Ok(Buffer::from_vec(scales.dequantise(elements))),
        })?;
        Ok((FeatureMap { data, ..map }, coding))
    }
}

impl Parser {
    /// What stands before the elements: a map without data, and how they crossed. The scales are taken.
    fn head(&mut self, bytes: &mut Reader) -> Result<(FeatureMap, Coding), DecodeError> {
        let shape = [bytes.u32("rows")?, bytes.u32("columns")?, bytes.u32("channels")?];
        // Without elements the other dimensions could say anything.
        if shape.contains(&0) {
            return Err(DecodeError::Value {
                field: "rows, columns and channels",
                expected: "at least 1 of each",
                found: format!("{shape:?}"),
            });
        }
        let [cell, x, y] = bytes.f64s::<3>("cell and origin")?;
        if cell <= 0.0 {
            return Err(DecodeError::Value {
                field: "cell",
                expected: "a side above 0",
                found: cell.to_string(),
            });
        }
        let dtype = one_of(bytes.u8("element type")?, &DTYPES, "element type", "0 to 3")?;
        let size = FeatureMap::size_of(shape, dtype);
        if size > self.limit as u128 {
            let limit = self.limit;
            return Err(DecodeError::Expanded { shape, size, limit });
        }
        let model = bytes.text("model")?.into();
        let coding = coding(bytes, dtype)?;
        let [rows, columns, channels] = shape;
        if coding.elements == Elements::Int8 {
            let mut scales = |field| Ok(column(bytes.take(channels as usize, 4, field)?, f32::from_le_bytes));
            self.scales.take(scales("least numbers")?, scales("steps")?)?;
        }
        let map = FeatureMap {
            rows,
            columns,
            channels,
            cell,
            origin: [x, y],
            dtype,
            data: Buffer::from_vec(Vec::<u8>::new()),
            model,
        };
        Ok((map, coding))
    }
}

fn coding(bytes: &mut Reader, dtype: DType) -> Result<Coding, DecodeError> {
    let known = [Elements::F32, Elements::F16, Elements::Int8];
    let elements = one_of(bytes.u8("conversion")?, &known, "conversion", "0 to 2")?;
    if elements != Elements::F32 && dtype != DType::F32 {
        return Err(DecodeError::Value {
            field: "conversion",
            expected: "0 for a map of other elements than f32",
            found: format!("{elements:?} for {dtype:?}"),
        });
    }
    let flags = bytes.flags(SHUFFLE | ZSTD, "flags of the elements")?;
    Ok(Coding {
        elements,
        shuffle: flags & SHUFFLE != 0,
        zstd: flags & ZSTD != 0,
    })
}

fn one_of<T: Copy>(code: u8, known: &[T], field: &'static str, expected: &'static str) -> Result<T, DecodeError> {
    let found = code.to_string();
    let unknown = DecodeError::Value { field, expected, found };
    known.get(usize::from(code)).copied().ok_or(unknown)
}

#[cfg(test)]
mod tests;
