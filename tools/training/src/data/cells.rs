//! What lies near a place on the ground.

use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// What there is in cells of the ground. Each point of a cloud asks for its cell, and nobody chooses cells so that they collide.
pub(crate) type CellMap<V> = HashMap<[i32; 2], V, BuildHasherDefault<CellHasher>>;

/// Spreads cells by a product.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CellHasher(u64);

impl Hasher for CellHasher {
    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            let product = (self.0 ^ u64::from_le_bytes(word)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            self.0 = product ^ (product >> 32);
        }
    }

    /// All cells have two numbers.
    fn write_usize(&mut self, _: usize) {}

    fn finish(&self) -> u64 {
        self.0
    }
}

/// Square cells of the ground, each with the numbers of what reaches into it, in the order in which they came.
#[derive(Debug)]
pub(crate) struct Cells {
    side: f32,
    members: CellMap<Vec<u32>>,
}

impl Cells {
    /// Empty cells of a side, m.
    pub fn new(side: f32) -> Self {
        Cells {
            side,
            members: CellMap::default(),
        }
    }

    /// Adds what reaches so far, m, from a place.
    pub fn add(&mut self, number: u32, place: [f32; 2], reach: f32) {
        for cell in self.around(place, reach) {
            self.members.entry(cell).or_default().push(number);
        }
    }

    /// What reaches into the cell of a place.
    pub fn at(&self, place: [f32; 2]) -> &[u32] {
        self.members.get(&self.cell(place)).map_or(&[], Vec::as_slice)
    }

    /// What was added without reach in the cells within a distance, m, of a place; some of it is further away.
    pub fn near(&self, place: [f32; 2], distance: f32) -> impl Iterator<Item = u32> {
        let cells = self.around(place, distance);
        cells.filter_map(|cell| self.members.get(&cell)).flatten().copied()
    }

    /// The cell of a place.
    pub fn cell(&self, place: [f32; 2]) -> [i32; 2] {
        place.map(|at| {
            // The floor, for which plain x86-64 would call a function.
            let (number, toward_zero) = (at / self.side, (at / self.side) as i32);
            toward_zero - i32::from(number < toward_zero as f32)
        })
    }

    fn around(&self, place: [f32; 2], distance: f32) -> impl Iterator<Item = [i32; 2]> + use<> {
        let [x, y] = self.cell(place.map(|at| at - distance));
        let [x_to, y_to] = self.cell(place.map(|at| at + distance));
        (x..=x_to).flat_map(move |x| (y..=y_to).map(move |y| [x, y]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_reaches_a_place_is_found_there() {
        let mut cells = Cells::new(4.0);
        cells.add(1, [-0.5, 0.5], 0.0);
        cells.add(2, [9.0, 9.0], 2.0);
        assert_eq!(cells.at([-3.9, 3.9]), [1]);
        assert_eq!((cells.at([7.5, 7.5]), cells.at([11.0, 8.0])), (&[2][..], &[2][..]));
        assert_eq!(cells.at([0.5, 0.5]), [0; 0]);
        assert_eq!(cells.near([1.0, 1.0], 1.5).collect::<Vec<u32>>(), [1]);
        assert_eq!(cells.near([3.0, 3.0], 0.5).count(), 0);
    }
}
