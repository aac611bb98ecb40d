//! The numbers of BEV feature maps.

use std::borrow::Cow;

use arrow_buffer::Buffer;

use crate::{DType, FeatureMap};

/// Sums of products of two greater numbers overflow.
const GREATEST: f32 = 1e15;

impl FeatureMap {
    /// Rows, columns and channels.
    pub fn size(&self) -> [usize; 3] {
        [self.rows, self.columns, self.channels].map(|n| n as usize)
    }

    /// The numbers, `[rows, columns, channels]`: those of the message, or a copy where they do not lie as numbers do.
    ///
    /// # Errors
    /// Other elements than f32, or more or fewer than the size says.
    pub fn numbers(&self) -> Result<Cow<'_, [f32]>, String> {
        if self.dtype != DType::F32 {
            return Err(format!("expected a map of f32, found {:?}", self.dtype));
        }
        let size = self.size();
        let expected = size.iter().try_fold(size_of::<f32>(), |bytes, n| bytes.checked_mul(*n));
        if expected != Some(self.data.len()) {
            let found = self.data.len();
            return Err(format!("expected 4 bytes for each number of {size:?}, found {found}"));
        }
        let lies_well = self.data.as_ptr().align_offset(align_of::<f32>()) == 0;
        Ok(match cfg!(target_endian = "little") && lies_well {
            true => Cow::Borrowed(self.data.typed_data()),
            false => {
                let numbers = self.data.as_chunks::<4>().0.iter().copied();
                Cow::Owned(numbers.map(f32::from_le_bytes).collect())
            }
        })
    }

    /// A map of the same model, size and place with other numbers, in all cells.
    ///
    /// # Panics
    /// If there are not as many as the size says.
    pub fn with_numbers(&self, numbers: Vec<f32>) -> FeatureMap {
        let expected: usize = self.size().iter().product();
        assert_eq!(numbers.len(), expected, "numbers of a map of {:?}", self.size());
        FeatureMap {
            dtype: DType::F32,
            data: Buffer::from_vec(numbers),
            confidence: None,
            ..self.clone()
        }
    }
}

/// Whether all numbers are as a network makes them: none that is no number, none so great that sums of products of two
/// overflow.
pub fn are_sound(numbers: &[f32]) -> bool {
    numbers.iter().all(|number| number.abs() <= GREATEST)
}
