//! Feature maps as bytes, uncompressed.

use arrow::buffer::Buffer;
use realo_schemas::{DType, FeatureMap};

use crate::bytes::{DecodeError, EncodeError, Reader, put_f64s, put_text};

const DTYPES: [DType; 4] = [DType::F32, DType::F16, DType::Bf16, DType::U8];

pub(crate) fn write(out: &mut Vec<u8>, map: &FeatureMap) -> Result<(), EncodeError> {
    let dimensions = [map.rows, map.columns, map.channels];
    if dimensions.contains(&0) {
        return Err(EncodeError::Empty(dimensions));
    }
    let expected = size(dimensions, map.dtype);
    if map.data.len() as u128 != expected {
        return Err(EncodeError::Length {
            field: "feature map",
            found: map.data.len(),
            expected,
        });
    }
    let dtype = match map.dtype {
        DType::F32 => 0,
        DType::F16 => 1,
        DType::Bf16 => 2,
        DType::U8 => 3,
    };
    out.extend(
        [map.rows, map.columns, map.channels]
            .iter()
            .flat_map(|v| v.to_le_bytes()),
    );
    put_f64s(out, &[map.cell, map.origin[0], map.origin[1]], "cell or origin")?;
    out.push(dtype);
    put_text(out, &map.model, "length of model")?;
    out.extend_from_slice(&map.data);
    Ok(())
}

/// Bytes of a map; 128 bits hold any three dimensions.
fn size(dimensions: [u32; 3], dtype: DType) -> u128 {
    dimensions.iter().map(|n| u128::from(*n)).product::<u128>() * dtype.size() as u128
}

pub(crate) fn read(bytes: &mut Reader) -> Result<FeatureMap, DecodeError> {
    let dimensions = [bytes.u32("rows")?, bytes.u32("columns")?, bytes.u32("channels")?];
    // Without elements the other dimensions could say anything.
    if dimensions.contains(&0) {
        return Err(DecodeError::Value {
            field: "rows, columns and channels",
            expected: "at least 1 of each",
            found: format!("{dimensions:?}"),
        });
    }
    let [cell, x, y] = bytes.f64s::<3>("cell and origin")?;
    if cell <= 0.0 {
        return Err(DecodeError::Value {
            field: "cell",
            expected: "a side above 0",
            found: cell.to_string(),
        });
    }
    let code = bytes.u8("element type")?;
    let unknown = || DecodeError::Value {
        field: "element type",
        expected: "0 to 3",
        found: code.to_string(),
    };
    let dtype = *DTYPES.get(usize::from(code)).ok_or_else(unknown)?;
    let model = bytes.text("model")?.into();
    let length = usize::try_from(size(dimensions, dtype)).unwrap_or(usize::MAX);
    // A copy, because a slice of the packet would be aligned by chance only.
    let data = Buffer::from(bytes.take(length, 1, "elements")?);
    let [rows, columns, channels] = dimensions;
    Ok(FeatureMap {
        rows,
        columns,
        channels,
        cell,
        origin: [x, y],
        dtype,
        data,
        model,
    })
}
