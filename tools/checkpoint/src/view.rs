//! Tensors as PyTorch saves them: a storage of numbers, and where in it a tensor's numbers lie.

use std::rc::Rc;

use crate::dtype::Dtype;

/// A run of numbers that tensors lie in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Storage {
    /// Its name in the file.
    pub key: Rc<str>,
    pub dtype: Dtype,
    /// Numbers that it holds.
    pub count: usize,
}

/// A tensor's place in a storage: its element `[i, j, …]` is number `offset + i * strides[0] + j * strides[1] + …`.
#[derive(Clone, Debug)]
pub(crate) struct View {
    pub storage: Storage,
    offset: usize,
    sizes: Vec<usize>,
    strides: Vec<usize>,
    count: usize,
}

/// Why a tensor is none.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// As many sizes as strides, and not too many.
    #[error(
        "expected as many strides as sizes and at most {MOST_DIMENSIONS}, found {sizes} sizes and {strides} strides"
    )]
    Dimensions {
        /// Sizes that it has.
        sizes: usize,
        /// Strides that it has.
        strides: usize,
    },
    /// It reaches beyond its storage.
    #[error("sizes {sizes:?} with strides {strides:?} from number {offset} reach beyond a storage of {count} numbers")]
    Beyond {
        /// Sizes.
        sizes: Vec<usize>,
        /// Strides.
        strides: Vec<usize>,
        /// First number.
        offset: usize,
        /// Numbers of the storage.
        count: usize,
    },
    /// It has more numbers than its storage.
    #[error(
        "sizes {sizes:?} with strides {strides:?} use numbers of the storage more than once: save `tensor.contiguous()`"
    )]
    Overlap {
        /// Sizes.
        sizes: Vec<usize>,
        /// Strides.
        strides: Vec<usize>,
    },
}

/// Dimensions of a tensor, at most.
const MOST_DIMENSIONS: usize = 16;

impl View {
    /// A tensor within its storage that repeats none of it.
    pub fn new(storage: Storage, offset: usize, sizes: Vec<usize>, strides: Vec<usize>) -> Result<View, ViewError> {
        if sizes.len() != strides.len() || sizes.len() > MOST_DIMENSIONS {
            let (sizes, strides) = (sizes.len(), strides.len());
            return Err(ViewError::Dimensions { sizes, strides });
        }
        let count = sizes.iter().try_fold(1usize, |count, size| count.checked_mul(*size));
        let along = |(size, stride): (&usize, &usize)| size.saturating_sub(1).checked_mul(*stride);
        let last = sizes
            .iter()
            .zip(&strides)
            .try_fold(offset, |last, dimension| last.checked_add(along(dimension)?));
        // A tensor without elements lies nowhere.
        let is_empty = sizes.contains(&0);
        if !is_empty && last.is_none_or(|last| last >= storage.count) {
            return Err(ViewError::Beyond {
                sizes,
                strides,
                offset,
                count: storage.count,
            });
        }
        let count = if is_empty { Some(0) } else { count };
        match count.filter(|count| *count <= storage.count) {
            Some(count) => Ok(View {
                storage,
                offset,
                sizes,
                strides,
                count,
            }),
            None => Err(ViewError::Overlap { sizes, strides }),
        }
    }

    /// Size of each dimension.
    pub fn shape(&self) -> &[usize] {
        &self.sizes
    }

    /// Its numbers in row-major order, from the bytes of its storage; `None` for a type that holds no fractions.
    pub fn numbers(&self, bytes: &[u8], big_endian: bool) -> Option<Vec<f32>> {
        let mut numbers = Vec::with_capacity(self.count);
        let (mut index, mut place) = (vec![0; self.sizes.len()], self.offset);
        for _ in 0..self.count {
            numbers.push(self.storage.dtype.number(bytes, place, big_endian)?);
            // The last dimension runs first.
            for dimension in (0..index.len()).rev() {
                index[dimension] += 1;
                place += self.strides[dimension];
                if index[dimension] < self.sizes[dimension] {
                    break;
                }
                place -= self.strides[dimension] * index[dimension];
                index[dimension] = 0;
            }
        }
        Some(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn storage(count: usize) -> Storage {
        Storage {
            key: "0".into(),
            dtype: Dtype::Float32,
            count,
        }
    }

    fn numbers(offset: usize, sizes: &[usize], strides: &[usize]) -> Result<Vec<f32>, ViewError> {
        let bytes: Vec<u8> = (0..12).flat_map(|i| (i as f32).to_le_bytes()).collect();
        let view = View::new(storage(12), offset, sizes.to_vec(), strides.to_vec())?;
        Ok(view.numbers(&bytes, false).unwrap())
    }

    #[test]
    fn elements_lie_where_offset_and_strides_say() {
        type Case<'a> = (usize, &'a [usize], &'a [usize], &'a [f32]);
        let cases: [Case; 6] = [
            (0, &[2, 3], &[3, 1], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
            (0, &[3, 2], &[1, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]),
            (5, &[2, 1, 2], &[4, 9, 2], &[5.0, 7.0, 9.0, 11.0]),
            (11, &[], &[], &[11.0]),
            (90, &[4, 0], &[1, 1], &[]),
            (11, &[1, 1], &[100, 7], &[11.0]),
        ];
        for (offset, sizes, strides, expected) in cases {
            assert_eq!(numbers(offset, sizes, strides).unwrap(), expected, "{sizes:?}");
        }
    }

    #[test]
    fn what_leaves_or_repeats_the_storage_is_refused() {
        let error = |offset: usize, sizes: &[usize], strides: &[usize]| {
            numbers(offset, sizes, strides).unwrap_err().to_string()
        };
        assert!(error(1, &[12], &[1]).contains("beyond a storage of 12"));
        assert!(error(usize::MAX, &[2], &[1]).contains("beyond"));
        assert!(error(0, &[usize::MAX, 3], &[usize::MAX, 1]).contains("beyond"));
        assert!(error(0, &[4, 4], &[0, 1]).contains("more than once"));
        assert!(error(0, &[usize::MAX, usize::MAX], &[0, 0]).contains("more than once"));
        assert!(error(0, &[2, 2], &[1]).contains("found 2 sizes and 1 strides"));
        assert!(error(0, &[1; 17], &[1; 17]).contains("at most 16"));
    }
}
