//! Points as their fields are laid out.

use super::{FLOAT32, FLOAT64, INT8, INT16, INT32, UINT8, UINT16, UINT32};
use crate::cdr::{CdrError, CdrReader};
use crate::times::TimeType;

pub(super) struct Field<'a> {
    pub name: &'a str,
    pub offset: usize,
    pub datatype: u8,
}

impl Field<'_> {
    fn size(&self) -> Option<usize> {
        match self.datatype {
            INT8 | UINT8 => Some(1),
            INT16 | UINT16 => Some(2),
            INT32 | UINT32 | FLOAT32 => Some(4),
            FLOAT64 => Some(8),
            _ => None,
        }
    }

    pub(super) fn time_type(&self) -> TimeType {
        match self.datatype {
            FLOAT32 => TimeType::Single,
            FLOAT64 => TimeType::Double,
            _ => TimeType::Integer,
        }
    }

    pub(super) fn type_name(&self) -> &'static str {
        match self.datatype {
            INT8 => "int8",
            UINT8 => "uint8",
            INT16 => "int16",
            UINT16 => "uint16",
            INT32 => "int32",
            UINT32 => "uint32",
            FLOAT32 => "float32",
            _ => "float64",
        }
    }

    pub(super) fn check(&self, step: usize) -> Result<(), CdrError> {
        let size = self
            .size()
            .ok_or_else(|| format!("field `{}` has unknown datatype {}", self.name, self.datatype))?;
        match self.offset.checked_add(size) {
            Some(end) if end <= step => Ok(()),
            _ => Err(format!(
                "field `{}` at byte {} lies outside of points of {step} bytes",
                self.name, self.offset
            )),
        }
    }
}

pub(super) fn read_fields<'a>(input: &mut CdrReader<'a>) -> Result<Vec<Field<'a>>, CdrError> {
    let mut fields = Vec::new();
    for _ in 0..input.length(13)? {
        let (name, offset, datatype) = (input.string()?, input.u32()? as usize, input.u8()?);
        input.u32()?;
        fields.push(Field { name, offset, datatype });
    }
    Ok(fields)
}

pub(super) struct Points<'a> {
    pub rows: Vec<&'a [u8]>,
    pub count: usize,
    pub step: usize,
    pub big_endian: bool,
}

impl<'a> Points<'a> {
    pub(super) fn new(
        data: &'a [u8],
        height: usize,
        width: usize,
        step: usize,
        row_step: usize,
        big_endian: bool,
    ) -> Result<Self, CdrError> {
        let count = height.saturating_mul(width);
        if count == 0 && !data.is_empty() {
            return Err(format!(
                "{height} × {width} points beside {} bytes of data; expected height and width of these (a cloud that is not \
                 organised has height 1)",
                data.len()
            ));
        }
        if count == 0 {
            return Ok(Points {
                rows: Vec::new(),
                count: 0,
                step: step.max(1),
                big_endian,
            });
        }
        let used = width
            .checked_mul(step)
            .filter(|used| step > 0 && (height == 1 || *used <= row_step));
        let bytes = |used: usize| {
            row_step
                .checked_mul(height - 1)
                .and_then(|bytes| bytes.checked_add(used))
        };
        match used.and_then(|used| bytes(used).filter(|bytes| *bytes <= data.len()).map(|_| used)) {
            Some(used) => {
                let rows = (0..height)
                    .map(|row| &data[row * row_step..row * row_step + used])
                    .collect();
                Ok(Points {
                    rows,
                    count,
                    step,
                    big_endian,
                })
            }
            None => Err(format!(
                "{height} × {width} points of {step} bytes with rows of {row_step} do not fit into {} bytes",
                data.len()
            )),
        }
    }

    pub(super) fn column<T: Number>(&self, field: &Field) -> Vec<T> {
        let mut column = Vec::with_capacity(self.count);
        let offset = field.offset;
        for row in &self.rows {
            let points = row.chunks_exact(self.step);
            if field.datatype == T::DATATYPE && !self.big_endian {
                column.extend(points.map(|point| T::read(&point[offset..])));
            } else {
                column.extend(points.map(|point| T::convert(self.number(&point[offset..], field.datatype))));
            }
        }
        column
    }

    pub(super) fn number(&self, bytes: &[u8], datatype: u8) -> f64 {
        macro_rules! read {
            ($type:ty) => {{
                let bytes = std::array::from_fn(|i| bytes[i]);
                if self.big_endian {
                    <$type>::from_be_bytes(bytes)
                } else {
                    <$type>::from_le_bytes(bytes)
                }
            }};
        }
        match datatype {
            INT8 => read!(i8).into(),
            UINT8 => read!(u8).into(),
            INT16 => read!(i16).into(),
            UINT16 => read!(u16).into(),
            INT32 => read!(i32).into(),
            UINT32 => read!(u32).into(),
            FLOAT32 => read!(f32).into(),
            _ => read!(f64),
        }
    }
}

pub(super) trait Number: Sized {
    const DATATYPE: u8;
    fn read(bytes: &[u8]) -> Self;
    fn convert(value: f64) -> Self;
}
