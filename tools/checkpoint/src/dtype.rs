//! Number types of tensors.

use std::fmt;

use half::{bf16, f16};

/// Type of a tensor's numbers, by PyTorch's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtype {
    /// `torch.float32`.
    Float32,
    /// `torch.float64`.
    Float64,
    /// `torch.float16`.
    Float16,
    /// `torch.bfloat16`.
    BFloat16,
    /// `torch.int64`.
    Int64,
    /// `torch.int32`.
    Int32,
    /// `torch.int16`.
    Int16,
    /// `torch.int8`.
    Int8,
    /// `torch.uint8`.
    UInt8,
    /// `torch.bool`.
    Bool,
}

/// Names of types, of the storages that hold them, and bytes of a number.
const NAMES: [(Dtype, &str, &str, usize); 10] = [
    (Dtype::Float32, "float32", "FloatStorage", 4),
    (Dtype::Float64, "float64", "DoubleStorage", 8),
    (Dtype::Float16, "float16", "HalfStorage", 2),
    (Dtype::BFloat16, "bfloat16", "BFloat16Storage", 2),
    (Dtype::Int64, "int64", "LongStorage", 8),
    (Dtype::Int32, "int32", "IntStorage", 4),
    (Dtype::Int16, "int16", "ShortStorage", 2),
    (Dtype::Int8, "int8", "CharStorage", 1),
    (Dtype::UInt8, "uint8", "ByteStorage", 1),
    (Dtype::Bool, "bool", "BoolStorage", 1),
];

impl Dtype {
    /// The type that a storage's class holds.
    pub(crate) fn of_storage(class: &str) -> Option<Dtype> {
        let found = NAMES.iter().find(|(_, _, storage, _)| *storage == class);
        found.map(|(dtype, ..)| *dtype)
    }

    fn row(self) -> &'static (Dtype, &'static str, &'static str, usize) {
        let row = NAMES.iter().find(|(dtype, ..)| *dtype == self);
        row.expect("every type is listed")
    }

    /// Bytes of a number.
    pub fn size(self) -> usize {
        self.row().3
    }

    /// Whether it holds fractions, as weights do.
    pub fn is_float(self) -> bool {
        matches!(self, Dtype::Float32 | Dtype::Float64 | Dtype::Float16 | Dtype::BFloat16)
    }

    /// The number that the bytes at an index are, as f32; `None` for a type that holds no fractions.
    pub(crate) fn number(self, bytes: &[u8], index: usize, big_endian: bool) -> Option<f32> {
        Some(match self {
            Dtype::Float32 => f32::from_bits(u32::from_le_bytes(array(bytes, index, big_endian))),
            Dtype::Float64 => f64::from_bits(u64::from_le_bytes(array(bytes, index, big_endian))) as f32,
            Dtype::Float16 => f16::from_bits(u16::from_le_bytes(array(bytes, index, big_endian))).to_f32(),
            Dtype::BFloat16 => bf16::from_bits(u16::from_le_bytes(array(bytes, index, big_endian))).to_f32(),
            _ => return None,
        })
    }
}

/// The bytes of a number, the lowest first.
fn array<const N: usize>(bytes: &[u8], index: usize, big_endian: bool) -> [u8; N] {
    let mut number: [u8; N] = bytes[N * index..][..N].try_into().expect("as many bytes");
    if big_endian {
        number.reverse();
    }
    number
}

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.row().1)
    }
}
