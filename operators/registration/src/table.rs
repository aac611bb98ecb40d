//! Places of cells in a list: open addressing with a multiplicative hash.

use crate::cell::NO_CELL;

/// 2⁶⁴ over the golden ratio, odd.
const FACTOR: u64 = 0x9e37_79b9_7f4a_7c15;

#[derive(Clone, Copy, Debug, Default)]
struct Slot {
    key: u64,
    place: u32,
}

/// Numbers cells in the order in which they first come.
#[derive(Clone, Debug)]
pub(crate) struct CellTable {
    /// A power of two, at most half of them taken.
    slots: Vec<Slot>,
    shift: u32,
    taken: usize,
}

impl CellTable {
    /// A table that holds so many cells before it grows.
    pub fn with_capacity(cells: usize) -> Self {
        let slots = (2 * cells).next_power_of_two().max(64);
        CellTable {
            slots: vec![Slot::default(); slots],
            shift: 64 - slots.trailing_zeros(),
            taken: 0,
        }
    }

    /// Cells in it.
    #[cfg(test)]
    pub fn len(&self) -> usize {
        self.taken
    }

    /// Takes all cells out; the room stays.
    pub fn clear(&mut self) {
        self.slots.fill(Slot::default());
        self.taken = 0;
    }

    /// The place of a cell by its key.
    #[inline]
    pub fn get(&self, key: u64) -> Option<u32> {
        let slot = self.slots[self.find(key)];
        (slot.key == key && key != NO_CELL).then_some(slot.place)
    }

    /// The place of a cell; one that is new takes the next.
    #[inline]
    pub fn get_or_insert(&mut self, key: u64) -> u32 {
        let at = self.find(key);
        if self.slots[at].key == key {
            return self.slots[at].place;
        }
        self.insert(at, key)
    }

    /// The keys of all cells with their places, in no order that means anything.
    pub fn keys(&self) -> impl Iterator<Item = (u64, u32)> {
        let taken = self.slots.iter().filter(|slot| slot.key != NO_CELL);
        taken.map(|slot| (slot.key, slot.place))
    }

    fn insert(&mut self, at: usize, key: u64) -> u32 {
        let place = self.taken as u32;
        self.slots[at] = Slot { key, place };
        self.taken += 1;
        if 2 * self.taken > self.slots.len() {
            self.grow();
        }
        place
    }

    /// The slot of a key, or the free one where it belongs.
    #[inline]
    fn find(&self, key: u64) -> usize {
        let mask = self.slots.len() - 1;
        let mut at = (key.wrapping_mul(FACTOR) >> self.shift) as usize;
        loop {
            let found = self.slots[at & mask].key;
            if found == key || found == NO_CELL {
                return at & mask;
            }
            at += 1;
        }
    }

    fn grow(&mut self) {
        let mut larger = CellTable::with_capacity(self.slots.len());
        for slot in self.slots.iter().filter(|slot| slot.key != NO_CELL) {
            let at = larger.find(slot.key);
            larger.slots[at] = *slot;
        }
        larger.taken = self.taken;
        *self = larger;
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_agrees_with_a_map_of_the_library(keys in prop::collection::vec(1u64..400, 0..600)) {
            let (mut table, mut known) = (CellTable::with_capacity(1), BTreeMap::new());
            for key in &keys {
                // Keys that differ in high bits alone, as cells that differ in x do.
                let next = known.len() as u32;
                let place = *known.entry(key << 42).or_insert(next);
                prop_assert_eq!(table.get_or_insert(key << 42), place);
            }
            prop_assert_eq!(table.len(), known.len());
            for key in 0u64..400 {
                prop_assert_eq!(table.get(key << 42), known.get(&(key << 42)).copied());
            }
            table.clear();
            prop_assert!(table.len() == 0 && keys.iter().all(|key| table.get(key << 42).is_none()));
        }
    }
}
