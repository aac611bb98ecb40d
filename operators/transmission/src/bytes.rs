//! Reading and writing of bytes that a peer may have made up.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Why a message cannot be put into bytes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EncodeError {
    /// A payload that no link carries, or a header of another kind than its payload.
    #[error("a {payload} whose header says `{kind}` cannot be sent: links carry points, features, boxes and ego_state")]
    Content {
        /// Type of the payload.
        payload: &'static str,
        /// Kind in the header.
        kind: &'static str,
    },
    /// More of something than its field can count.
    #[error("{field}: {found}, at most {limit} fit")]
    TooMany {
        /// What there is too much of.
        field: &'static str,
        /// How much.
        found: usize,
        /// How much fits.
        limit: usize,
    },
    /// A number that is not finite, or a quaternion that is not of length 1.
    #[error("{0}: a number is not finite, or a quaternion is not of length 1")]
    NotFinite(&'static str),
    /// A map of which some cells are to cross, but that does not tell which.
    #[error(
        "feature map: `budget_bytes` and `least_confidence` choose cells by how sure the map is of each, which it does not tell: \
         say `confidence=true` to its pillar-encoder"
    )]
    NoConfidence,
    /// A map that is too great without any cell.
    #[error("feature map: {needed} bytes without any cell: expected a `budget_bytes` above that, found {budget}")]
    Budget {
        /// Bytes that it takes.
        needed: usize,
        /// Bytes that it may take.
        budget: usize,
    },
    /// A confidence that no cell can have.
    #[error("argument `least_confidence`: expected 0 to 1, found {0}")]
    Confidence(f32),
    /// A channel that 255 finite steps do not span.
    #[error(
        "feature map: channel {channel} goes from {least} to {most}, too far for int8: send it with `elements=f32`"
    )]
    Range {
        /// The channel.
        channel: usize,
        /// Its least number.
        least: f32,
        /// Its greatest number.
        most: f32,
    },
    /// A step that clouds cannot have.
    #[error("argument `step_m`: expected 0 or a step from 0.000001 to 1 m, found {0}")]
    Step(f64),
    /// A level that zstd does not have.
    #[error("argument `zstd`: expected null or a level from -7 to 19 that is not 0, found {0}")]
    Level(i32),
    /// What zstd could not compress.
    #[error("zstd: {0}")]
    Zstd(String),
    /// A feature map without elements.
    #[error("a feature map of {0:?} rows, columns and channels has no elements")]
    Empty([u32; 3]),
    /// Columns or data whose length is not what the payload says.
    #[error("{field}: {found} bytes of data, its dimensions say {expected}")]
    Length {
        /// What it is.
        field: &'static str,
        /// Bytes that are there.
        found: usize,
        /// Bytes that should be.
        expected: u128,
    },
}

/// Why bytes from a link were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes end too early.
    #[error("bytes end in `{field}`: {needed} more needed, {left} left")]
    Truncated {
        /// What was being read.
        field: &'static str,
        /// Bytes that it takes.
        needed: u64,
        /// Bytes that there were.
        left: usize,
    },
    /// Bytes after the end of the content.
    #[error("{0} bytes follow the end of the content")]
    Trailing(usize),
    /// A field with a value that it cannot have.
    #[error("`{field}`: expected {expected}, found {found}")]
    Value {
        /// The field.
        field: &'static str,
        /// What it may be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// A text that is not UTF-8.
    #[error("`{0}` is not UTF-8")]
    Text(&'static str),
    /// A codec that this decoder does not have.
    #[error(
        "codec chain [{0}] is unknown; this decoder reads chains of cells, f16, int8 or step and delta, shuffle and zstd that end with plain"
    )]
    Codec(String),
    /// A packet by another release.
    #[error("`version`: expected {expected}, found {found}: run one release of realo at both ends of the link")]
    Version {
        /// That of this decoder.
        expected: u8,
        /// That of the packet.
        found: u8,
    },
    /// Compressed bytes that do not make as many as the shape of a map or the number of points asks for.
    #[error("`{field}`: expected a zstd frame of {length} bytes, found: {found}")]
    Zstd {
        /// The field.
        field: &'static str,
        /// Bytes that there should be.
        length: usize,
        /// What there was.
        found: String,
    },
    /// A map beyond the limit.
    #[error(
        "feature map of {shape:?} rows, columns and channels takes {size} bytes, at most {limit} are made (argument `max_bytes`)"
    )]
    Expanded {
        /// Rows, columns, channels.
        shape: [u32; 3],
        /// Its bytes in memory.
        size: u128,
        /// The limit.
        limit: usize,
    },
    /// A quantised cloud beyond the limit.
    #[error("cloud of {count} points takes {size} bytes, at most {limit} are made (argument `max_bytes`)")]
    Points {
        /// Number of points.
        count: usize,
        /// Its bytes in memory.
        size: usize,
        /// The limit.
        limit: usize,
    },
    /// A packet beyond the limit.
    #[error("packet of {bytes} bytes, at most {limit} are taken (argument `max_bytes`)")]
    Oversized {
        /// Its size.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// A packet whose header and bytes disagree.
    #[error("forged: the packet's header says {field} {header}, its bytes say {content}")]
    Forged {
        /// The field.
        field: &'static str,
        /// According to the packet's header.
        header: String,
        /// According to the bytes.
        content: String,
    },
}

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

fn is_unit(quaternion: &Quaternion<f64>) -> bool {
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
