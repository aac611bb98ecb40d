//! A column of whole numbers as differences from earlier ones, split into byte planes.

use super::lanes::LANES;

/// Bytes that hold every number of a column above its smallest one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Range {
    pub min: i32,
    /// 0 to 4.
    pub width: usize,
}

impl Range {
    /// That of a column; of an empty one nothing.
    pub fn of(values: &[i32]) -> Self {
        let min = values.iter().copied().min().unwrap_or_default();
        let most = values.iter().copied().max().unwrap_or_default();
        let span = most.wrapping_sub(min) as u32;
        let width = (u32::BITS - span.leading_zeros()).div_ceil(8) as usize;
        Range { min, width }
    }

    /// Bits above those of the width.
    fn spare(self) -> u32 {
        u32::BITS - 8 * self.width as u32
    }
}

/// Differences of a column, each from the number before it in its lane, or from the smallest one; modulo 256 to the power
/// of the width, of both signs in turn: 0, -1, 1, -2 become 0, 1, 2, 3.
pub(super) fn differences(values: &[i32], lanes: Option<&[u8]>, range: Range, out: &mut Vec<u32>) {
    out.clear();
    if range.width == 0 {
        return;
    }
    match lanes {
        None => {
            out.extend(values.first().map(|first| first.wrapping_sub(range.min) as u32));
            let pairs = values.iter().zip(values.iter().skip(1));
            out.extend(pairs.map(|(before, value)| value.wrapping_sub(*before) as u32));
        }
        Some(lanes) => {
            let mut last = [range.min; LANES];
            out.extend(values.iter().zip(lanes).map(|(value, lane)| {
                let before = std::mem::replace(&mut last[usize::from(*lane)], *value);
                value.wrapping_sub(before) as u32
            }));
        }
    }
    // By itself, so that the loop becomes vectors.
    let spare = range.spare();
    for difference in out {
        let signed = (*difference << spare) as i32 >> spare;
        *difference = ((signed << 1) ^ (signed >> 31)) as u32;
    }
}

/// Appends byte `k` of each number, from the lowest on.
pub(super) fn plane(values: &[u32], k: usize, out: &mut Vec<u8>) {
    out.extend(values.iter().map(|value| (value >> (8 * k)) as u8));
}

/// Planes of columns that are still to be read.
pub(super) struct Planes<'a> {
    pub planes: &'a [u8],
    /// Numbers in a column.
    pub count: usize,
    pub lanes: Option<&'a [u8]>,
    /// What it works in.
    pub sums: &'a mut Vec<u32>,
}

impl Planes<'_> {
    /// The next column.
    pub fn column<T: Clone>(&mut self, range: Range, from: impl Fn(i32) -> T) -> Vec<T> {
        if range.width == 0 {
            return vec![from(range.min); self.count];
        }
        let (own, rest) = self.planes.split_at(range.width * self.count);
        self.planes = rest;
        self.merge(own);
        self.add_up();
        let mask = u32::MAX >> range.spare();
        let number = |sum: &u32| from(range.min.wrapping_add((sum & mask) as i32));
        self.sums.iter().map(number).collect()
    }

    /// Puts the bytes of each number together.
    fn merge(&mut self, planes: &[u8]) {
        self.sums.clear();
        self.sums.resize(self.count, 0);
        for (k, plane) in planes.chunks_exact(self.count.max(1)).enumerate() {
            for (value, byte) in self.sums.iter_mut().zip(plane) {
                *value |= u32::from(*byte) << (8 * k);
            }
        }
    }

    /// Replaces each difference by the sum of those of its lane up to it.
    fn add_up(&mut self) {
        let unfolded = |value: u32| (value >> 1) ^ (value & 1).wrapping_neg();
        match self.lanes {
            None => {
                let mut sum = 0u32;
                for value in self.sums.iter_mut() {
                    sum = sum.wrapping_add(unfolded(*value));
                    *value = sum;
                }
            }
            Some(lanes) => {
                let mut sums = [0u32; LANES];
                for (value, lane) in self.sums.iter_mut().zip(lanes) {
                    let sum = &mut sums[usize::from(*lane)];
                    *sum = sum.wrapping_add(unfolded(*value));
                    *value = *sum;
                }
            }
        }
    }
}
