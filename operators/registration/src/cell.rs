//! Cells of a grid, by three 21-bit numbers in a `u64`.

/// What the keys add to each number, so that they rise with it.
const BIAS: i32 = 1 << 20;

/// What the key of a cell's neighbour adds, along x, y and z.
pub(crate) const STEPS: [u64; 3] = [1 << 42, 1 << 21, 1];

/// The key of no cell.
pub(crate) const NO_CELL: u64 = 0;

/// The key of a cell; [`NO_CELL`] unless all its numbers are within ±(2²⁰ − 2).
///
/// Keys rise with x, then y, then z. All six neighbours have keys too, which [`STEPS`] lead to.
#[inline]
pub(crate) fn key_of([x, y, z]: [i32; 3]) -> u64 {
    let biased = [x, y, z].map(|number| number.wrapping_add(BIAS).cast_unsigned());
    let inside = biased.map(|number| number.wrapping_sub(2) < (1 << 21) - 3);
    if inside[0] & inside[1] & inside[2] {
        let [x, y, z] = biased.map(u64::from);
        x << 42 | y << 21 | z
    } else {
        NO_CELL
    }
}

/// The cell of a key of 63 bits.
pub(crate) fn cell_of(key: u64) -> [i32; 3] {
    [42, 21, 0].map(|shift| (key >> shift & 0x1f_ffff) as i32 - BIAS)
}

/// Largest whole number that is not above a value, for values within the range of `i32`.
///
/// As `f32::floor`, which is a call on processors of the lowest common kind.
#[inline]
pub(crate) fn floor(value: f32) -> i32 {
    let whole = value as i32;
    whole - i32::from(value < whole as f32)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const MAX: i32 = BIAS - 2;

    #[test]
    fn cells_beyond_the_border_have_no_key() {
        for far in [MAX + 1, BIAS, -MAX - 1, -BIAS, i32::MAX, i32::MIN] {
            for axis in 0..3 {
                let mut cell = [5, -6, 7];
                cell[axis] = far;
                assert_eq!(key_of(cell), NO_CELL, "{cell:?}");
            }
        }
        assert_ne!(key_of([-MAX; 3]), NO_CELL);
        assert!(key_of([MAX; 3]) < 1 << 63);
    }

    proptest! {
        #[test]
        fn keys_lead_back_to_cells_and_on_to_neighbours(cell in prop::array::uniform3(-MAX..=MAX)) {
            let key = key_of(cell);
            prop_assert_eq!(cell_of(key), cell);
            for (axis, step) in STEPS.into_iter().enumerate() {
                for (by, found) in [(1, key + step), (-1, key - step)] {
                    let mut neighbour = cell;
                    neighbour[axis] += by;
                    prop_assert_eq!(cell_of(found), neighbour);
                }
            }
        }

        #[test]
        fn keys_rise_with_cells(a in prop::array::uniform3(-9..9), b in prop::array::uniform3(-9..9)) {
            prop_assert_eq!(a.cmp(&b), key_of(a).cmp(&key_of(b)));
        }

        #[test]
        fn floor_is_that_of_the_library(value in -1e6f32..1e6) {
            prop_assert_eq!(floor(value), value.floor() as i32);
        }
    }
}
