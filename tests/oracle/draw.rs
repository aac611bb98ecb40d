//! The channel's draws once more, from the section "Draws" of the documentation of `realo-link`.

use std::f64::consts::TAU;

use realo_schemas::Nanos;

use crate::world::Channel;

/// Delays of the copies of a packet that arrive.
#[derive(Clone, Copy, Debug, Default)]
pub struct Copies {
    /// The packet; `None` if it is lost.
    pub first: Option<Nanos>,
    /// One more.
    pub second: Option<Nanos>,
}

/// What the draws of one message of one channel depend on.
#[derive(Clone, Copy)]
pub struct Message<'a> {
    pub seed: u64,
    pub from: &'a str,
    pub to: &'a str,
    pub kind: &'a str,
    pub seq: u64,
}

/// What becomes of a packet of so many bytes.
pub fn copies(channel: &Channel, message: Message, bytes: usize) -> Copies {
    let arrives = uniform(message, 0) >= channel.loss;
    let doubled = arrives && uniform(message, 1) < channel.duplicate;
    Copies {
        first: arrives.then(|| delay(channel, message, bytes, 16)),
        second: doubled.then(|| delay(channel, message, bytes, 20)),
    }
}

/// `first`: number of the first of three draws.
fn delay(channel: &Channel, message: Message, bytes: usize, first: u64) -> Nanos {
    let [width, radius, angle] = [first, first + 1, first + 2].map(|number| uniform(message, number));
    let normal = (-2.0 * (1.0 - radius).ln()).sqrt() * (TAU * angle).cos();
    let jitter_ms = channel.uniform_ms * (2.0 * width - 1.0) + channel.gaussian_ms * normal;
    let crossing = channel.bits_per_second.map_or(0.0, |rate| {
        let seconds = 8.0 * bytes as f64 / rate as f64;
        seconds.min(86_400.0) * 1e9
    });
    (channel.fixed + (crossing + 0.5).floor() as Nanos + (jitter_ms * 1e6).round() as Nanos).max(0)
}

fn uniform(message: Message, number: u64) -> f64 {
    let Message {
        seed,
        from,
        to,
        kind,
        seq,
    } = message;
    let mut words = Vec::new();
    for text in [from, to, kind] {
        words.push(text.len() as u64);
        for start in (0..text.len()).step_by(8) {
            let byte = |place: usize| text.as_bytes().get(start + place).copied().unwrap_or(0);
            words.push(u64::from_le_bytes(std::array::from_fn(byte)));
        }
    }
    words.extend([seq, number]);
    let hash = words.into_iter().fold(key(seed), |hash, word| mix(hash ^ word));
    (hash >> 11) as f64 / 9_007_199_254_740_992.0
}

fn mix(word: u64) -> u64 {
    let a = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let b = (a ^ (a >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let c = (b ^ (b >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    c ^ (c >> 31)
}

/// The first 8 bytes of the first block of ChaCha8.
fn key(seed: u64) -> u64 {
    let mut start = [0u32; 16];
    start[..4].copy_from_slice(&[0x6170_7865, 0x3320_646e, 0x7962_2d32, 0x6b20_6574]);
    (start[4], start[5]) = (seed as u32, (seed >> 32) as u32);
    start[6] = u32::from_le_bytes(*b"link");
    let mut block = start;
    for _ in 0..4 {
        for column in 0..4 {
            quarter(&mut block, [0, 4, 8, 12].map(|row| row + column));
        }
        for diagonal in 0..4 {
            quarter(&mut block, std::array::from_fn(|row| 4 * row + (diagonal + row) % 4));
        }
    }
    let word = |place: usize| u64::from(block[place].wrapping_add(start[place]));
    word(0) | word(1) << 32
}

/// The quarter round of RFC 8439.
fn quarter(block: &mut [u32; 16], [a, b, c, d]: [usize; 4]) {
    for (x, y, z, by) in [(a, b, d, 16), (c, d, b, 12), (a, b, d, 8), (c, d, b, 7)] {
        block[x] = block[x].wrapping_add(block[y]);
        block[z] = (block[z] ^ block[x]).rotate_left(by);
    }
}
