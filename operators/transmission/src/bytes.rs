//! Reading and writing of bytes that a peer may have made up.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use crate::{DecodeError, EncodeError};

/// Takes bytes apart from front to back.
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Reader { rest: bytes }
    }

    /// The next `count` elements of `size` bytes each; the length is checked before anything is allocated.
    pub fn take(&mut self, count: usize, size: usize, field: &'static str) -> Result<&'a [u8], DecodeError> {
        let needed = count.saturating_mul(size);
        let Some((taken, rest)) = self.rest.split_at_checked(needed) else {
            return Err(DecodeError::Truncated {
                field,
                needed: needed as u64,
                left: self.rest.len(),
            });
        };
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self, field: &'static str) -> Result<[u8; N], DecodeError> {
        let taken = self.take(N, 1, field)?;
        Ok(std::array::from_fn(|i| taken[i]))
    }

    pub fn u8(&mut self, field: &'static str) -> Result<u8, DecodeError> {
        Ok(self.array::<1>(field)?[0])
    }

    pub fn u16(&mut self, field: &'static str) -> Result<u16, DecodeError> {
        self.array(field).map(u16::from_le_bytes)
    }

    pub fn u32(&mut self, field: &'static str) -> Result<u32, DecodeError> {
        self.array(field).map(u32::from_le_bytes)
    }

    pub fn u64(&mut self, field: &'static str) -> Result<u64, DecodeError> {
        self.array(field).map(u64::from_le_bytes)
    }

    pub fn i64(&mut self, field: &'static str) -> Result<i64, DecodeError> {
        self.array(field).map(i64::from_le_bytes)
    }

    /// Finite numbers of double precision.
    pub fn f64s<const N: usize>(&mut self, field: &'static str) -> Result<[f64; N], DecodeError> {
        let taken = self.take(N, 8, field)?;
        let values: [f64; N] = std::array::from_fn(|i| f64::from_le_bytes(std::array::from_fn(|k| taken[8 * i + k])));
        finite(values, |v| v.is_finite(), field)
    }

    /// Finite numbers of single precision.
    pub fn f32s<const N: usize>(&mut self, field: &'static str) -> Result<[f32; N], DecodeError> {
        let taken = self.take(N, 4, field)?;
        let values: [f32; N] = std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|k| taken[4 * i + k])));
        finite(values, |v| v.is_finite(), field)
    }

    pub fn text(&mut self, field: &'static str) -> Result<&'a str, DecodeError> {
        let length = self.u8(field)?;
        std::str::from_utf8(self.take(length.into(), 1, field)?).map_err(|_| DecodeError::Text(field))
    }

    /// Flags of which only those in `known` may be set.
    pub fn flags(&mut self, known: u8, field: &'static str) -> Result<u8, DecodeError> {
        let flags = self.u8(field)?;
        if flags & !known != 0 {
            return Err(DecodeError::Value {
                field,
                expected: "known flags",
                found: format!("{flags:#010b}"),
            });
        }
        Ok(flags)
    }

    pub fn pose(&mut self, field: &'static str) -> Result<Isometry3<f64>, DecodeError> {
        let [tx, ty, tz, x, y, z, w] = self.f64s::<7>(field)?;
        let quaternion = Quaternion::new(w, x, y, z);
        if !is_unit(&quaternion) {
            let found = format!("one of length {}", quaternion.norm());
            return Err(DecodeError::Value {
                field,
                expected: "a quaternion of length 1",
                found,
            });
        }
        // Unchecked, so that the receiver has the sender's bits.
        Ok(Isometry3::from_parts(
            Translation3::new(tx, ty, tz),
            UnitQuaternion::new_unchecked(quaternion),
        ))
    }

    pub fn covariance6(&mut self, field: &'static str) -> Result<Box<[f64; 36]>, DecodeError> {
        let triangle = self.f32s::<21>(field)?;
        Ok(Box::new(std::array::from_fn(|i| {
            triangle[triangle_index(i / 6, i % 6, 6)].into()
        })))
    }

    pub fn end(self) -> Result<(), DecodeError> {
        match self.rest.len() {
            0 => Ok(()),
            n => Err(DecodeError::Trailing(n)),
        }
    }
}

fn finite<T: Copy + ToString, const N: usize>(
    values: [T; N],
    is_finite: impl Fn(&T) -> bool,
    field: &'static str,
) -> Result<[T; N], DecodeError> {
    match values.iter().find(|v| !is_finite(v)) {
        None => Ok(values),
        Some(bad) => Err(DecodeError::Value {
            field,
            expected: "finite numbers",
            found: bad.to_string(),
        }),
    }
}

pub(crate) fn is_unit(quaternion: &Quaternion<f64>) -> bool {
    (quaternion.norm() - 1.0).abs() < 1e-6
}

/// Place of element (row, column) in the upper triangle of an n×n matrix.
pub(crate) fn triangle_index(row: usize, column: usize, n: usize) -> usize {
    let (row, column) = (row.min(column), row.max(column));
    row * (2 * n - row - 1) / 2 + column
}

pub(crate) fn put_f64s(out: &mut Vec<u8>, values: &[f64], field: &'static str) -> Result<(), EncodeError> {
    if !values.iter().all(|v| v.is_finite()) {
        return Err(EncodeError::NotFinite(field));
    }
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    Ok(())
}

pub(crate) fn put_f32s(out: &mut Vec<u8>, values: &[f32]) {
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

pub(crate) fn put_text(out: &mut Vec<u8>, text: &str, field: &'static str) -> Result<(), EncodeError> {
    let limit = usize::from(u8::MAX);
    let length = u8::try_from(text.len()).map_err(|_| EncodeError::TooMany {
        field,
        found: text.len(),
        limit,
    })?;
    out.push(length);
    out.extend(text.as_bytes());
    Ok(())
}

pub(crate) fn put_pose(out: &mut Vec<u8>, pose: &Isometry3<f64>, field: &'static str) -> Result<(), EncodeError> {
    let (t, q) = (&pose.translation.vector, pose.rotation.quaternion());
    if !is_unit(q) {
        return Err(EncodeError::NotFinite(field));
    }
    put_f64s(out, &[t.x, t.y, t.z, q.i, q.j, q.k, q.w], field)
}

pub(crate) fn put_covariance6(out: &mut Vec<u8>, matrix: &[f64; 36], field: &'static str) -> Result<(), EncodeError> {
    for row in 0..6 {
        for column in row..6 {
            let value = matrix[6 * row + column] as f32;
            if !value.is_finite() {
                return Err(EncodeError::NotFinite(field));
            }
            put_f32s(out, &[value]);
        }
    }
    Ok(())
}

/// Appends a column of numbers; `N` bytes each.
pub(crate) fn put_column<T: Copy, const N: usize>(out: &mut Vec<u8>, values: &[T], to_bytes: impl Fn(T) -> [u8; N]) {
    let start = out.len();
    out.resize(start + N * values.len(), 0);
    for (bytes, value) in out[start..].chunks_exact_mut(N).zip(values) {
        bytes.copy_from_slice(&to_bytes(*value));
    }
}

/// A column of numbers from bytes; `N` bytes each.
pub(crate) fn column<T, const N: usize>(bytes: &[u8], from_bytes: impl Fn([u8; N]) -> T) -> Vec<T> {
    bytes
        .chunks_exact(N)
        .map(|chunk| from_bytes(std::array::from_fn(|i| chunk[i])))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangle_covers_the_matrix_by_rows() {
        let places: Vec<usize> = (0..6)
            .flat_map(|row| (row..6).map(move |column| triangle_index(row, column, 6)))
            .collect();
        assert_eq!(places, (0..21).collect::<Vec<_>>());
        assert_eq!(triangle_index(2, 1, 3), triangle_index(1, 2, 3));
    }

    #[test]
    fn lengths_are_checked_before_anything_is_taken() {
        let mut reader = Reader::new(&[1, 2, 3]);
        for (count, size, needed) in [
            (4, 1, 4),
            (2, 2, 4),
            (1 << 40, 4, 1 << 42),
            (1 << 62, 4, u64::MAX),
            (usize::MAX, 8, u64::MAX),
        ] {
            let (field, left) = ("x", 3);
            assert_eq!(
                reader.take(count, size, "x"),
                Err(DecodeError::Truncated { field, needed, left })
            );
        }
        assert_eq!(reader.take(usize::MAX, 0, "x"), Ok(&[][..]));
        assert_eq!(reader.u16("n"), Ok(0x0201));
        assert_eq!(reader.end(), Err(DecodeError::Trailing(1)));
    }
}
