//! Packets of Ouster's LiDARs, as their metadata describes them.

mod metadata;

use std::collections::BTreeSet;
use std::ops::Range;

use realo_schemas::{Nanos, PointCloud};

pub use self::metadata::Format;

/// A field of a pixel: its first byte, bytes, mask, and by how many bits it is moved to the left.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Field {
    at: usize,
    bytes: usize,
    mask: u32,
    shift: u32,
}

impl Field {
    const fn new(at: usize, bytes: usize, mask: u32, shift: u32) -> Self {
        Field { at, bytes, mask, shift }
    }

    fn of(&self, pixel: &[u8]) -> u32 {
        let bytes = pixel[self.at..self.at + self.bytes].iter().rev();
        let value = bytes.fold(0_u32, |value, byte| value << 8 | u32::from(*byte));
        (value & self.mask) << self.shift
    }
}

/// How packets of a profile are laid out.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Profile {
    /// As metadata names it.
    pub name: &'static str,
    /// Bytes before the columns and behind them, before the pixels of a column and behind them, and of a pixel.
    packet: [usize; 2],
    column: [usize; 2],
    pixel: usize,
    /// Where the number of the frame is, from the packet's first byte, and its bytes; in the column for the first profile.
    frame: [usize; 2],
    range: Field,
    reflectivity: Field,
    near_ir: Field,
}

/// Where heads of packets have the number of the sensor's start, and its serial number.
const START: Range<usize> = 4..7;
const SERIAL: Range<usize> = 7..12;

/// All profiles that are read.
pub(crate) const PROFILES: [Profile; 5] = [
    Profile {
        name: "LEGACY",
        packet: [0, 0],
        column: [16, 4],
        pixel: 12,
        frame: [10, 2],
        range: Field::new(0, 4, 0x000f_ffff, 0),
        reflectivity: Field::new(4, 1, 0xff, 0),
        near_ir: Field::new(8, 2, 0xffff, 0),
    },
    Profile {
        name: "RNG19_RFL8_SIG16_NIR16",
        packet: [32, 32],
        column: [12, 0],
        pixel: 12,
        frame: [2, 2],
        range: Field::new(0, 4, 0x0007_ffff, 0),
        reflectivity: Field::new(4, 1, 0xff, 0),
        near_ir: Field::new(8, 2, 0xffff, 0),
    },
    Profile {
        name: "RNG19_RFL8_SIG16_NIR16_DUAL",
        packet: [32, 32],
        column: [12, 0],
        pixel: 16,
        frame: [2, 2],
        range: Field::new(0, 4, 0x0007_ffff, 0),
        reflectivity: Field::new(3, 1, 0xff, 0),
        near_ir: Field::new(12, 2, 0xffff, 0),
    },
    Profile {
        name: "RNG15_RFL8_NIR8",
        packet: [32, 32],
        column: [12, 0],
        pixel: 4,
        frame: [2, 2],
        range: Field::new(0, 2, 0x7fff, 3),
        reflectivity: Field::new(2, 1, 0xff, 0),
        near_ir: Field::new(3, 1, 0xff, 4),
    },
    Profile {
        name: "FUSA_RNG15_RFL8_NIR8_DUAL",
        packet: [32, 32],
        column: [12, 0],
        pixel: 8,
        frame: [4, 4],
        range: Field::new(0, 2, 0x7fff, 3),
        reflectivity: Field::new(2, 1, 0xff, 0),
        near_ir: Field::new(3, 1, 0xff, 4),
    },
];

impl Profile {
    fn is_legacy(&self) -> bool {
        self.packet == [0, 0]
    }

    fn column_bytes(&self, pixels: usize) -> usize {
        self.column[0] + pixels * self.pixel + self.column[1]
    }

    fn packet_bytes(&self, columns: usize, pixels: usize) -> usize {
        self.packet[0] + columns * self.column_bytes(pixels) + self.packet[1]
    }
}

/// A column of a packet.
struct Column<'a> {
    frame: u32,
    number: usize,
    time: Nanos,
    pixels: &'a [u8],
}

/// A return: where it is in the frame of the sensor, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Return {
    /// Place.
    pub at: [f32; 3],
    /// 0 to 255.
    pub reflectivity: u8,
    /// Time from the first column, ns.
    pub offset: i32,
    /// The beam, from the top.
    pub ring: u16,
}

/// Sums over all pixels of a frame, with those without a return.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sums {
    /// mm.
    pub range: u64,
    /// As the sensor counts it.
    pub reflectivity: u64,
    /// As the sensor counts it.
    pub near_ir: u64,
}

/// A turn of the sensor.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// Its number.
    pub number: u32,
    /// Columns that are valid, and all of a turn.
    pub columns: usize,
    /// Columns of a whole turn.
    pub all_columns: usize,
    /// Times of the first and the last column by the sensor's clock, ns.
    pub first: Nanos,
    /// Of the last.
    pub last: Nanos,
    /// First returns.
    pub returns: Vec<Return>,
    /// Of all pixels.
    pub sums: Sums,
    /// Columns that came more than once: the first counts.
    pub doubled: usize,
    /// Columns that came.
    seen: BTreeSet<usize>,
}

impl Frame {
    /// Its cloud, with times from the first column.
    pub fn cloud(&self) -> PointCloud {
        let axis = |axis: usize| self.returns.iter().map(|point| point.at[axis]).collect::<Vec<f32>>();
        let cloud = PointCloud::new(
            axis(0),
            axis(1),
            axis(2),
            self.returns.iter().map(|point| point.reflectivity).collect::<Vec<u8>>(),
            self.returns.iter().map(|point| point.offset).collect::<Vec<i32>>(),
            self.returns.iter().map(|point| point.ring).collect::<Vec<u16>>(),
        );
        cloud.expect("all columns are of the same returns")
    }
}

impl Format {
    /// Columns of a packet that are valid; `None`: a packet of something else than points.
    fn columns<'a>(&'a self, packet: &'a [u8]) -> Result<Option<impl Iterator<Item = Column<'a>>>, String> {
        let Profile {
            packet: [head, _],
            column: [before, after],
            ..
        } = self.profile;
        let bytes = self.profile.packet_bytes(self.columns_per_packet, self.pixels);
        if packet.len() != bytes {
            return Err(format!(
                "expected packets of {bytes} bytes for {} of {} pixels, found {}; see whether the metadata are this sensor's",
                self.profile.name,
                self.pixels,
                packet.len()
            ));
        }
        let number = |at: usize, bytes: usize| {
            packet[at..at + bytes]
                .iter()
                .rev()
                .fold(0_u32, |value, byte| value << 8 | u32::from(*byte))
        };
        // Both sorts of heads have the type of the packet first; points are 1.
        if !self.profile.is_legacy() && packet[0] != 1 {
            return Ok(None);
        }
        let size = self.profile.column_bytes(self.pixels);
        let [frame_at, frame_bytes] = self.profile.frame;
        let columns = (0..self.columns_per_packet).filter_map(move |index| {
            let column = head + index * size;
            let bytes = &packet[column..column + size];
            let pixels = &bytes[before..size - after];
            let is_valid = match self.profile.is_legacy() {
                true => bytes[size - after..] == [0xff; 4],
                false => bytes[10] & 1 == 1,
            };
            let time = u64::from_le_bytes(bytes[..8].try_into().ok()?);
            let frame = match self.profile.is_legacy() {
                true => number(column + frame_at, frame_bytes),
                false => number(frame_at, frame_bytes),
            };
            let column = Column {
                frame,
                number: usize::from(u16::from_le_bytes([bytes[8], bytes[9]])),
                time: Nanos::try_from(time).ok()?,
                pixels,
            };
            is_valid.then_some(column)
        });
        let columns: Vec<Column> = columns.collect();
        let most = self.columns_per_frame;
        match columns.iter().find(|column| column.number >= most) {
            Some(column) => Err(format!(
                "expected columns 0 to {} of a turn, found {}; see whether the metadata are of this mode of the sensor",
                most - 1,
                column.number
            )),
            None => Ok(Some(columns.into_iter())),
        }
    }

    /// The last valid column of a packet: time by the sensor's clock (ns), frame, and place in the turn.
    ///
    /// # Errors
    /// A packet of another size, or of a mode with more columns.
    pub fn last(&self, packet: &[u8]) -> Result<Option<(Nanos, u32, usize)>, String> {
        let columns = self.columns(packet)?;
        let last = columns.and_then(|columns| columns.max_by_key(|column| column.time));
        Ok(last.map(|column| (column.time, column.frame, column.number)))
    }

    /// Whether a packet is of another start of the sensor than the metadata, by what newer heads say.
    ///
    /// # Errors
    /// A packet of another sensor, with both serial numbers.
    pub fn is_of_other_start(&self, packet: &[u8]) -> Result<bool, String> {
        let has_ids = !self.profile.is_legacy() && self.profile.frame == [2, 2];
        if !has_ids || packet.len() < self.profile.packet[0] {
            return Ok(false);
        }
        let number = |at: Range<usize>| packet[at].iter().rev().fold(0_u64, |n, byte| n << 8 | u64::from(*byte));
        let (serial, start) = (number(SERIAL), number(START));
        match self.serial.filter(|known| *known != serial && serial != 0) {
            Some(known) => Err(format!(
                "expected packets of the sensor {known}, whose metadata these are, found packets of the sensor {serial}; save the metadata \
                 of that one"
            )),
            None => Ok(self.start.is_some_and(|known| known != start)),
        }
    }

    fn add(&self, frame: &mut Frame, column: &Column) {
        if frame.columns == 0 {
            (frame.number, frame.first, frame.last) = (column.frame, column.time, column.time);
        }
        if !frame.seen.insert(column.number) {
            frame.doubled += 1;
            return;
        }
        frame.columns += 1;
        frame.first = frame.first.min(column.time);
        frame.last = frame.last.max(column.time);
        let offset = (column.time - frame.first).clamp(i32::MIN.into(), i32::MAX.into()) as i32;
        for (ring, pixel) in column.pixels.chunks_exact(self.profile.pixel).enumerate() {
            let [range, reflectivity, near_ir] =
                [self.profile.range, self.profile.reflectivity, self.profile.near_ir].map(|field| field.of(pixel));
            frame.sums.range += u64::from(range);
            frame.sums.reflectivity += u64::from(reflectivity);
            frame.sums.near_ir += u64::from(near_ir);
            if range > 0 {
                frame.returns.push(Return {
                    at: self.place(column.number, ring, f64::from(range) / 1000.0),
                    // Masked to a byte by every profile.
                    reflectivity: reflectivity as u8,
                    offset,
                    ring: ring as u16,
                });
            }
        }
    }
}

/// Makes frames of packets. A frame ends when the number of the frame changes, not by a count.
pub struct Decoder<'a> {
    format: &'a Format,
    frame: Frame,
}

impl<'a> Decoder<'a> {
    /// Of packets of a format.
    pub fn new(format: &'a Format) -> Self {
        Decoder {
            format,
            frame: Frame::default(),
        }
    }

    /// Takes a packet; gives the frame before, if the packet is of the next.
    ///
    /// # Errors
    /// A packet of another size.
    pub fn take(&mut self, packet: &[u8]) -> Result<Option<Frame>, String> {
        let Some(columns) = self.format.columns(packet)? else {
            return Ok(None);
        };
        let mut ended = None;
        for column in columns {
            if self.frame.columns > 0 && column.frame != self.frame.number {
                ended = self.finish();
            }
            self.format.add(&mut self.frame, &column);
        }
        Ok(ended)
    }

    /// What was read of the last frame.
    pub fn finish(&mut self) -> Option<Frame> {
        let mut frame = std::mem::take(&mut self.frame);
        frame.all_columns = self.format.window;
        (frame.columns > 0).then_some(frame)
    }
}
