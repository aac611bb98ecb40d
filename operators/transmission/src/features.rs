//! Feature maps as bytes: converted, shuffled and compressed as the encoder's settings say; the bytes say how.

use arrow::buffer::{Buffer, MutableBuffer};
use realo_operator::Steps;
use realo_schemas::{DType, Elements, FeatureMap};
use zstd::bulk::{Compressor, Decompressor};

use crate::EncoderSettings;
use crate::bytes::{Reader, column, put_column, put_f64s, put_text};
use crate::cells::{self, Chosen, Covering};
use crate::compression::{compress, decompress};
use crate::elements::{Scales, are_finite, from_f16, not_finite, to_f16};
use crate::error::{DecodeError, EncodeError};
use crate::shuffle::transpose;

const DTYPES: [DType; 4] = [DType::F32, DType::F16, DType::Bf16, DType::U8];

const SHUFFLE: u8 = 1;
const ZSTD: u8 = 2;

const CELLS: u8 = 4;

/// How the elements of one map crossed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Coding {
    /// Whether only some of its cells did.
    cells: bool,
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
        let cells = self.cells.then_some("cells");
        let shuffle = self.shuffle.then_some("shuffle");
        let zstd = self.zstd.then_some("zstd");
        [cells, elements, shuffle, zstd].into_iter().flatten()
    }
}

/// What became of a map.
pub(crate) struct Written {
    pub coding: Coding,
    /// Numbers that half precision could not hold.
    pub beyond: u64,
    /// Cells that did not cross.
    pub left_out: u64,
}

/// Which cells of a map cross, where not all do.
#[derive(Clone, Copy, Debug)]
struct Choice {
    min_confidence: f32,
    /// Bytes that a packet may take.
    budget: Option<usize>,
}

/// Puts maps into bytes; what it works in serves one map after another.
pub(crate) struct Writer {
    choice: Option<Choice>,
    elements: Elements,
    shuffle: bool,
    zstd: Option<Compressor<'static>>,
    scales: Scales,
    converted: Vec<u8>,
    shuffled: Vec<u8>,
    compressed: Vec<u8>,
    places: Vec<u8>,
    compressed_places: Vec<u8>,
    /// The largest packet so far that is within the budget.
    best: Vec<u8>,
}

impl Writer {
    /// A writer; the level of zstd is one that it has.
    pub fn new(config: &EncoderSettings) -> std::io::Result<Self> {
        let choice = Choice {
            min_confidence: config.min_confidence,
            budget: config.budget_bytes,
        };
        let chooses = choice.min_confidence > 0.0 || choice.budget.is_some();
        Ok(Writer {
            choice: chooses.then_some(choice),
            elements: config.elements,
            shuffle: config.shuffle,
            zstd: config.zstd.map(Compressor::new).transpose()?,
            scales: Scales::default(),
            converted: Vec::new(),
            shuffled: Vec::new(),
            compressed: Vec::new(),
            places: Vec::new(),
            compressed_places: Vec::new(),
            best: Vec::new(),
        })
    }

    /// Writes a map, behind what stands in `out` already; `budget`: bytes that this packet may take in place of those of the settings.
    pub fn write(
        &mut self,
        out: &mut Vec<u8>,
        map: &FeatureMap,
        budget: Option<usize>,
        covering: Option<Covering>,
        steps: &mut Steps,
    ) -> Result<Written, EncodeError> {
        check(map)?;
        let Some(choice) = self.choice else {
            return self.write_cells(out, map, None, steps);
        };
        let ranked = steps.time("selection", || cells::ranked(map, choice.min_confidence, covering))?;
        match budget.or(choice.budget) {
            None => self.write_cells(out, map, Some(&ranked), steps),
            Some(budget) => self.write_within(budget, out, map, &ranked, steps),
        }
    }

    /// Writes the surest cells, as many as a packet of so many bytes holds. How far they compress is seen by trying, so that the
    /// last few that would fit may stay out.
    fn write_within(
        &mut self,
        budget: usize,
        out: &mut Vec<u8>,
        map: &FeatureMap,
        ranked: &[u32],
        steps: &mut Steps,
    ) -> Result<Written, EncodeError> {
        let before = out.len();
        let (mut held, mut beyond) = (None, ranked.len() + 1);
        // What is guessed first fits, but for what stands before the elements, if nothing of it compresses.
        let mut count = ranked.len().min(budget / (map.channels as usize * map.dtype.size()));
        for trial in 1..=TRIALS {
            if trial == TRIALS && held.is_none() {
                count = 0;
            }
            out.truncate(before);
            let written = self.write_cells(out, map, Some(&ranked[..count]), steps)?;
            let found = out.len();
            match found <= budget {
                true => {
                    self.best.clone_from(out);
                    held = Some((count, written));
                }
                false if count == 0 => return Err(EncodeError::Budget { needed: found, budget }),
                false => beyond = count,
            }
            let share = budget.saturating_sub(before) as f64 / (found - before) as f64;
            let min = held.as_ref().map_or(0, |(count, _)| *count);
            count = ((NEARLY * share * count as f64) as usize).clamp(min, beyond - 1);
            if held.is_some() && count - min <= min / 32 {
                break;
            }
        }
        std::mem::swap(out, &mut self.best);
        Ok(held.expect("without any cell at the latest").1)
    }

    /// Writes a map, or some of its cells.
    fn write_cells(
        &mut self,
        out: &mut Vec<u8>,
        map: &FeatureMap,
        chosen: Option<&[u32]>,
        steps: &mut Steps,
    ) -> Result<Written, EncodeError> {
        let ascending = chosen.map(|chosen| {
            let mut chosen = chosen.to_vec();
            chosen.sort_unstable();
            chosen
        });
        let gathered = ascending.as_ref().map(|chosen| cells::gathered(map, chosen));
        let from = gathered.as_ref().unwrap_or(map);
        let (all, crossing) = (cells_of(map), cells_of(from));
        let (elements, beyond) = match crossing {
            0 => (Elements::F32, 0),
            _ => steps.time("quantisation", || self.convert(from))?,
        };
        let coding = Coding {
            cells: chosen.is_some(),
            elements,
            shuffle: self.shuffle && crossing > 0,
            zstd: self.zstd.is_some(),
        };
        self.places.clear();
        if let (Some(ascending), Some(confidence)) = (&ascending, &map.confidence) {
            cells::write(ascending, confidence, &mut self.places);
        }
        self.pack(from, coding, steps)?;
        steps.time("serialisation", || self.serialise(out, map, from, coding))?;
        Ok(Written {
            coding,
            beyond,
            left_out: (all - crossing) as u64,
        })
    }

    /// Shuffles the elements of cells that cross, and compresses them and their places, as the coding says.
    fn pack(&mut self, from: &FeatureMap, coding: Coding, steps: &mut Steps) -> Result<(), EncodeError> {
        let mut bytes: &[u8] = match coding.elements {
            Elements::F32 => &from.data,
            _ => &self.converted,
        };
        if coding.shuffle {
            self.shuffled.resize(bytes.len(), 0);
            steps.time("shuffling", || {
                transpose(bytes, bytes.len() / cells_of(from), &mut self.shuffled)
            });
            bytes = &self.shuffled;
        }
        let Some(zstd) = &mut self.zstd else { return Ok(()) };
        steps.time("compression", || {
            compress(zstd, &self.places, &mut self.compressed_places)?;
            compress(zstd, bytes, &mut self.compressed)
        })
    }

    /// Writes what [`Writer::pack`] made of cells of a map.
    fn serialise(
        &self,
        out: &mut Vec<u8>,
        map: &FeatureMap,
        from: &FeatureMap,
        coding: Coding,
    ) -> Result<(), EncodeError> {
        let (places, bytes): (&[u8], &[u8]) = match coding {
            Coding { zstd: true, .. } => (&self.compressed_places, &self.compressed),
            Coding { shuffle: true, .. } => (&self.places, &self.shuffled),
            Coding {
                elements: Elements::F32,
                ..
            } => (&self.places, &from.data),
            _ => (&self.places, &self.converted),
        };
        let crossing = cells_of(from);
        out.reserve(400 + 8 * map.channels as usize + places.len() + bytes.len());
        head(out, map, coding)?;
        if coding.cells {
            out.extend((crossing as u32).to_le_bytes());
            put(out, places, coding.zstd)?;
        }
        if crossing > 0 {
            if coding.elements == Elements::Int8 {
                put_column(out, &self.scales.min, f32::to_le_bytes);
                put_column(out, &self.scales.step, f32::to_le_bytes);
            }
            put(out, bytes, coding.zstd)?;
        }
        Ok(())
    }

    /// Converts numbers of a map of f32 as the settings say; any other map stays as it is.
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

/// Times that a map is put into bytes to find how many of its cells a budget holds.
const TRIALS: usize = 6;
/// Of a budget that the next trial aims at, as the last cells compress less than the surest ones.
const NEARLY: f64 = 0.98;

/// Writes bytes; of those that zstd made, how many they are first.
fn put(out: &mut Vec<u8>, bytes: &[u8], compressed: bool) -> Result<(), EncodeError> {
    if compressed {
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

fn cells_of(map: &FeatureMap) -> usize {
    map.rows as usize * map.columns as usize
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

/// What stands before the cells that cross, or the scales.
fn head(out: &mut Vec<u8>, map: &FeatureMap, coding: Coding) -> Result<(), EncodeError> {
    let shape = [map.rows, map.columns, map.channels];
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
    let flags = [
        flag(coding.shuffle, SHUFFLE),
        flag(coding.zstd, ZSTD),
        flag(coding.cells, CELLS),
    ];
    out.extend([elements, flags.iter().sum()]);
    Ok(())
}

/// Gets maps out of bytes; what it works in serves one map after another.
pub(crate) struct Parser {
    /// Largest map that is made, bytes.
    limit: usize,
    zstd: Decompressor<'static>,
    scales: Scales,
    places: Vec<u8>,
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
            places: Vec::new(),
            decompressed: Vec::new(),
            put_back: Vec::new(),
        })
    }

    /// Reads a map; gives how its elements crossed.
    pub fn read(&mut self, bytes: &mut Reader, steps: &mut Steps) -> Result<(FeatureMap, Coding), DecodeError> {
        let (map, coding) = steps.time("deserialisation", || self.head(bytes))?;
        let all = map.rows as usize * map.columns as usize;
        let chosen = match coding.cells {
            true => Some(self.chosen(bytes, all, coding.zstd, steps)?),
            false => None,
        };
        let data = self.elements(bytes, &map, coding, chosen.as_ref(), steps)?;
        let confidence = chosen.map(|chosen| chosen.confidence.into());
        Ok((
            FeatureMap {
                data,
                confidence,
                ..map
            },
            coding,
        ))
    }

    /// Which cells of a map of so many cross.
    fn chosen(&mut self, bytes: &mut Reader, all: usize, zstd: bool, steps: &mut Steps) -> Result<Chosen, DecodeError> {
        let crossing = bytes.u32("number of cells that cross")? as usize;
        if crossing > all {
            return Err(DecodeError::Value {
                field: "number of cells that cross",
                expected: "at most those of the map",
                found: format!("{crossing} of {all}"),
            });
        }
        let length = cells::length(crossing, all);
        let zstd = zstd.then_some(&mut self.zstd);
        let places = taken(
            bytes,
            zstd,
            length,
            ["cells that cross", "compressed cells"],
            &mut self.places,
            steps,
        )?;
        steps.time("deserialisation", || cells::read(places, crossing, all))
    }

    /// The elements of a map, whose cells that do not cross are zeros.
    fn elements(
        &mut self,
        bytes: &mut Reader,
        map: &FeatureMap,
        coding: Coding,
        chosen: Option<&Chosen>,
        steps: &mut Steps,
    ) -> Result<Buffer, DecodeError> {
        let (all, channels) = (map.rows as usize * map.columns as usize, map.channels as usize);
        let crossing = chosen.map_or(all, |chosen| chosen.ascending.len());
        if crossing == 0 {
            return Ok(MutableBuffer::from_len_zeroed(all * channels * map.dtype.size()).into());
        }
        if coding.elements == Elements::Int8 {
            let mut scales = |field| Ok(column(bytes.take(channels, 4, field)?, f32::from_le_bytes));
            self.scales.take(scales("min numbers")?, scales("steps")?)?;
        }
        let width = match coding.elements {
            Elements::F32 => map.dtype.size(),
            Elements::F16 => 2,
            Elements::Int8 => 1,
        };
        // The map itself is within the limit, and an element that crosses is no greater than one of the map.
        let length = crossing * channels * width;
        let zstd = coding.zstd.then_some(&mut self.zstd);
        let mut elements = taken(
            bytes,
            zstd,
            length,
            ["elements", "compressed elements"],
            &mut self.decompressed,
            steps,
        )?;
        if coding.shuffle {
            self.put_back.resize(length, 0);
            steps.time("unshuffling", || transpose(elements, crossing, &mut self.put_back));
            elements = &self.put_back;
        }
        let scales = &self.scales;
        steps.time("dequantisation", || {
            let numbers = match coding.elements {
                Elements::F32 if !are_finite(elements, map.dtype) => return Err(not_finite()),
                Elements::F32 => None,
                Elements::F16 => Some(Buffer::from_vec(from_f16(elements)?)),
                Elements::Int8 => Some(Buffer::from_vec(scales.dequantise(elements))),
            };
            Ok(match (chosen, numbers) {
                (Some(chosen), numbers) => chosen.scattered(numbers.as_deref().unwrap_or(elements)),
                (None, Some(numbers)) => numbers,
                // A copy, because a slice of the packet would be aligned by chance only.
                (None, None) => Buffer::from(elements),
            })
        })
    }

    /// What stands before the elements: a map without data, and how they crossed.
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
        let model = bytes.text("model")?.into();
        let coding = coding(bytes, dtype)?;
        let [rows, columns, channels] = shape;
        let size = FeatureMap::size_of(shape, dtype);
        let of_confidence = if coding.cells { 4 } else { 0 } * u128::from(rows) * u128::from(columns);
        let size = size + of_confidence;
        if size > self.limit as u128 {
            let limit = self.limit;
            return Err(DecodeError::Expanded { shape, size, limit });
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
            confidence: None,
        };
        Ok((map, coding))
    }
}

/// Takes so many bytes as they are, or out of a zstd frame; the field's name as they are, and as a frame.
fn taken<'a, 'b: 'a>(
    bytes: &mut Reader<'b>,
    zstd: Option<&mut Decompressor>,
    length: usize,
    [plain, compressed]: [&'static str; 2],
    into: &'a mut Vec<u8>,
    steps: &mut Steps,
) -> Result<&'a [u8], DecodeError> {
    let Some(zstd) = zstd else {
        return bytes.take(length, 1, plain);
    };
    let size = bytes.u32("size of compressed bytes")? as usize;
    let frame = bytes.take(size, 1, compressed)?;
    steps.time("decompression", || decompress(zstd, frame, length, compressed, into))?;
    Ok(into)
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
    let flags = bytes.flags(SHUFFLE | ZSTD | CELLS, "flags of the elements")?;
    Ok(Coding {
        cells: flags & CELLS != 0,
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
