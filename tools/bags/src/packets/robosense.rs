//! Packets of RoboSense's Helios 16P: a turn of MSOP packets in each message, and DIFOP packets with the sensor's angles.

use realo_logs::cdr::{CdrError, CdrReader};
use realo_schemas::{Nanos, PointCloud};

/// How packets of points and of the sensor's state begin.
const MSOP: [u8; 4] = [0x55, 0xaa, 0x05, 0x5a];
const DIFOP: [u8; 4] = [0xa5, 0xff, 0x00, 0x5a];
/// Bytes of a packet, and of the array that it is in.
const BYTES: usize = 1248;
const ROOM: usize = 1500;
/// The head of an MSOP packet, its blocks, and their bytes.
const HEAD: usize = 42;
const BLOCKS: usize = 12;
const BLOCK_BYTES: usize = 100;
/// Where the time is in the head: s in 6 bytes, µs in 4.
const TIME: usize = 20;
/// Where the angles of a DIFOP packet are: up, then around; a sign and hundredths of a degree for each of 32 slots.
const UP: usize = 468;
const AROUND: usize = UP + 3 * SLOTS;
const SLOTS: usize = 32;
/// Channels: all of them are shot twice in a block.
const CHANNELS: usize = 16;
/// A unit of distances, m.
const UNIT_M: f64 = 0.0025;
/// From a block to the next, and from a slot to the next, ns.
const BLOCK_NS: f64 = 55_560.0;
const SLOT_NS: f64 = 1_573.0;
/// From the axis to the lens, m.
const LENS_M: f64 = 0.035;
/// A turn, hundredths of a degree.
const TURN: u16 = 36_000;

/// Whether a packet of UDP begins as one of RoboSense, of points or of the sensor's state.
pub fn is_packet(packet: &[u8]) -> bool {
    // Older sensors differ from the third byte on.
    packet.starts_with(&MSOP[..2]) || packet.starts_with(&DIFOP[..3])
}

/// A message: the packets of a turn.
pub struct Scan {
    /// When its first packet came, ns.
    pub stamp: Nanos,
    /// Its frame.
    pub frame: String,
    packets: Vec<Vec<u8>>,
}

/// Angles of the 16 channels, from the top: up and around, rad.
pub struct Angles([[f64; 2]; CHANNELS]);

/// Reads a `RobosenseScan`.
///
/// # Errors
/// Bytes that are no such message.
pub fn scan(input: &mut CdrReader) -> Result<Scan, CdrError> {
    let (stamp, frame) = input.header()?;
    let (mut packets, mut first) = (Vec::new(), None);
    for _ in 0..input.length(ROOM)? {
        let time = input.time()?;
        input.u8()?;
        let mut bytes = vec![0; ROOM];
        for byte in &mut bytes {
            *byte = input.u8()?;
        }
        let size = input.u32()? as usize;
        if size > ROOM {
            return Err(format!("a packet of {size} bytes in an array of {ROOM}"));
        }
        bytes.truncate(size);
        first.get_or_insert(time);
        packets.push(bytes);
    }
    Ok(Scan {
        stamp: first.filter(|time| *time > 0).unwrap_or(stamp),
        frame: frame.into(),
        packets,
    })
}

fn big(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |value, byte| value << 8 | u64::from(*byte))
}

/// A return of a block.
struct Shot {
    distance: f64,
    intensity: u8,
    channel: usize,
    /// Of the block, rad clockwise.
    azimuth: f64,
    /// From the first packet, ns.
    time: i64,
}

impl Scan {
    /// The angles of the first DIFOP packet; `None` without one.
    ///
    /// # Errors
    /// A DIFOP packet of another size or without angles.
    pub fn angles(&self) -> Result<Option<Angles>, String> {
        let Some(packet) = self.packets.iter().find(|packet| packet.starts_with(&DIFOP)) else {
            return Ok(None);
        };
        if packet.len() != BYTES {
            return Err(format!(
                "expected a DIFOP packet of {BYTES} bytes, found {}",
                packet.len()
            ));
        }
        let angle = |at: usize| {
            let degrees = big(&packet[at + 1..at + 3]) as f64 / 100.0;
            if packet[at] == 0 { degrees } else { -degrees }
        };
        let of = |channel: usize| [UP, AROUND].map(|begin| angle(begin + 3 * channel));
        let angles: [[f64; 2]; CHANNELS] = std::array::from_fn(of);
        match angles.iter().flatten().all(|degrees| degrees.abs() <= 90.0) {
            true => Ok(Some(Angles(angles.map(|both| both.map(f64::to_radians))))),
            false => Err(
                "expected angles of at most 90° in the DIFOP packet, found others; the sensor is not calibrated".into(),
            ),
        }
    }

    /// The points of the turn, x ahead, y to the left, with times from its first packet.
    ///
    /// # Errors
    /// A packet that is neither MSOP nor DIFOP; no points.
    pub fn cloud(&self, angles: &Angles) -> Result<PointCloud, String> {
        let points: Vec<&Vec<u8>> = self.packets.iter().filter(|packet| packet.starts_with(&MSOP)).collect();
        if let Some(other) = self
            .packets
            .iter()
            .find(|packet| !packet.starts_with(&MSOP) && !packet.starts_with(&DIFOP))
        {
            let head = &other[..other.len().min(4)];
            return Err(format!(
                "expected packets of MSOP or DIFOP, found one that begins with {head:02x?}"
            ));
        }
        if let Some(other) = points.iter().find(|packet| packet.len() != BYTES) {
            return Err(format!(
                "expected MSOP packets of {BYTES} bytes, found {}; only Helios 16P is read",
                other.len()
            ));
        }
        let shots = shots(&points);
        let place = |shot: &Shot| angles.place(shot);
        let at: Vec<[f32; 3]> = shots.iter().map(place).collect();
        let axis = |axis: usize| at.iter().map(|point| point[axis]).collect::<Vec<f32>>();
        let cloud = PointCloud::new(
            axis(0),
            axis(1),
            axis(2),
            shots.iter().map(|shot| shot.intensity).collect::<Vec<u8>>(),
            shots
                .iter()
                .map(|shot| shot.time.clamp(i32::MIN.into(), i32::MAX.into()) as i32)
                .collect::<Vec<i32>>(),
            shots.iter().map(|shot| shot.channel as u16).collect::<Vec<u16>>(),
        );
        Ok(cloud.expect("all columns are of the same shots"))
    }
}

/// All returns of the packets of a turn.
fn shots(packets: &[&Vec<u8>]) -> Vec<Shot> {
    let time = |packet: &[u8]| {
        (big(&packet[TIME..TIME + 6]) as i64)
            .saturating_mul(1_000_000)
            .saturating_add(big(&packet[TIME + 6..TIME + 10]) as i64)
    };
    let first = packets.first().map_or(0, |packet| time(packet));
    let blocks: Vec<(&[u8], i64)> = packets
        .iter()
        .flat_map(|packet| {
            let begin = time(packet).saturating_sub(first).saturating_mul(1000);
            let block = move |index: usize| begin.saturating_add((index as f64 * BLOCK_NS) as i64);
            let bytes = packet[HEAD..].chunks_exact(BLOCK_BYTES).take(BLOCKS).enumerate();
            bytes.map(move |(index, bytes)| (bytes, block(index)))
        })
        .filter(|(bytes, _)| bytes.starts_with(&[0xff, 0xee]))
        .collect();
    let azimuth = |index: usize| big(&blocks[index].0[2..4]) as u16;
    let mut shots = Vec::new();
    for (index, (bytes, begin)) in blocks.iter().enumerate() {
        // The next block says how fast it turns; the last turns as the one before it.
        let (from, to) = if index + 1 < blocks.len() {
            (index, index + 1)
        } else {
            (index.saturating_sub(1), index)
        };
        let step = (azimuth(to) + TURN).wrapping_sub(azimuth(from)) % TURN;
        let step = if step < 100 { f64::from(step) } else { 0.0 };
        for slot in 0..SLOTS {
            let shot = &bytes[4 + 3 * slot..][..3];
            let distance = big(&shot[..2]) as f64 * UNIT_M;
            let later = slot as f64 * SLOT_NS;
            if distance > 0.0 {
                shots.push(Shot {
                    distance,
                    intensity: shot[2],
                    channel: slot % CHANNELS,
                    azimuth: ((f64::from(azimuth(index)) + step * later / BLOCK_NS) / 100.0).to_radians(),
                    time: begin.saturating_add(later as i64),
                });
            }
        }
    }
    shots
}

impl Angles {
    fn place(&self, shot: &Shot) -> [f32; 3] {
        let [up, around] = self.0[shot.channel];
        let ((sin, cos), (sin_up, cos_up)) = (libm::sincos(shot.azimuth + around), libm::sincos(up));
        let (sin_lens, cos_lens) = libm::sincos(shot.azimuth);
        // Azimuths count clockwise.
        let x = shot.distance * cos_up * cos + LENS_M * cos_lens;
        let y = -shot.distance * cos_up * sin - LENS_M * sin_lens;
        [x as f32, y as f32, (shot.distance * sin_up) as f32]
    }
}
