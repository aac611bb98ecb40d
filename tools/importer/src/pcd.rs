//! PCD files as DAIR-V2X-C has them: `DATA binary_compressed` (LZF, fields one after another), or `DATA binary`.

use std::borrow::Cow;
use std::fs;
use std::path::Path;

use crate::ImportError;

/// Points of a PCD file, in its frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PcdCloud {
    /// Metres.
    pub x: Vec<f32>,
    /// Metres.
    pub y: Vec<f32>,
    /// Metres.
    pub z: Vec<f32>,
    /// 0–255; intensities that the file holds as floats in [0, 1] are scaled.
    pub intensity: Vec<u8>,
    /// Time of each point, s since the epoch, where the file has it.
    pub timestamp: Option<Vec<f64>>,
}

/// Reads a PCD file.
///
/// # Errors
/// A file that cannot be read; a head, a field or a length that does not fit, by name.
pub fn read_pcd(path: &Path) -> Result<PcdCloud, ImportError> {
    let bytes = fs::read(path).map_err(ImportError::io(path))?;
    parse_pcd(&bytes).map_err(|reason| ImportError::content(path, reason))
}

/// Reads the bytes of a PCD file. What they claim is compared with how many they are before anything is allocated.
///
/// # Errors
/// A head, a field or a length that does not fit, by name.
pub fn parse_pcd(bytes: &[u8]) -> Result<PcdCloud, String> {
    let (head, body) = split_head(bytes)?;
    let words = |key: &str| -> Result<Vec<&str>, String> {
        let line = head.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        let found = line.into_iter().find(|words| words.first() == Some(&key));
        found
            .map(|words| words[1..].to_vec())
            .ok_or_else(|| format!("the PCD head has no line `{key}`"))
    };
    let number = |key: &str, text: &str| {
        text.parse::<usize>()
            .map_err(|_| format!("{key}: expected a number, found `{text}`"))
    };
    let points = number("POINTS", words("POINTS")?.first().copied().unwrap_or_default())?;
    let names = words("FIELDS")?;
    let sizes = words("SIZE")?
        .into_iter()
        .map(|text| number("SIZE", text))
        .collect::<Result<Vec<_>, _>>()?;
    let kinds = words("TYPE")?;
    if names.len() != sizes.len() || names.len() != kinds.len() {
        return Err(format!(
            "{} FIELDS, {} SIZE, {} TYPE: expected as many of each",
            names.len(),
            sizes.len(),
            kinds.len()
        ));
    }
    if words("COUNT").is_ok_and(|counts| counts.iter().any(|count| *count != "1")) {
        return Err("COUNT: expected 1 for every field".into());
    }
    if let Some(size) = sizes.iter().find(|size| !matches!(size, 1 | 2 | 4 | 8)) {
        return Err(format!("SIZE: expected 1, 2, 4 or 8 for every field, found {size}"));
    }
    let point_size: usize = sizes.iter().sum();
    let total = points.checked_mul(point_size).filter(|total| *total < 1 << 31);
    let total =
        total.ok_or_else(|| format!("POINTS: expected less than 2 GiB, found {points} of {point_size} bytes"))?;
    let data = words("DATA")?;
    let compressed = match data.first().copied() {
        Some("binary_compressed") => true,
        Some("binary") => false,
        other => {
            return Err(format!(
                "DATA: expected binary_compressed or binary, found `{}`; save the cloud as one of these",
                other.unwrap_or_default()
            ));
        }
    };
    let values = if compressed {
        Cow::Owned(decompress_body(body, total)?)
    } else {
        Cow::Borrowed(body.get(..total).unwrap_or(body))
    };
    if values.len() != total {
        return Err(format!(
            "expected {total} bytes for {points} points, found {}",
            values.len()
        ));
    }
    let mut before = 0;
    let fields: Vec<Field> = (0..names.len())
        .map(|i| {
            let (start, step) = if compressed {
                (before * points, sizes[i])
            } else {
                (before, point_size)
            };
            before += sizes[i];
            Field {
                name: names[i].into(),
                size: sizes[i],
                kind: kinds[i].into(),
                start,
                step,
            }
        })
        .collect();
    columns(&values, &fields, points)
}

struct Field {
    name: String,
    size: usize,
    kind: String,
    /// First byte of the field's first value, and from one value to the next.
    start: usize,
    step: usize,
}

fn split_head(bytes: &[u8]) -> Result<(&str, &[u8]), String> {
    let mut at = 0;
    // A head is a dozen lines.
    for line in bytes.split_inclusive(|byte| *byte == b'\n').take(64) {
        at += line.len();
        if line.starts_with(b"DATA") {
            let head = std::str::from_utf8(&bytes[..at]).map_err(|_| "the PCD head is not text".to_string())?;
            return Ok((head, &bytes[at..]));
        }
    }
    Err("expected a PCD file, found no line `DATA`".into())
}

fn columns(values: &[u8], fields: &[Field], points: usize) -> Result<PcdCloud, String> {
    let find = |name: &str, size: usize, kind: &str| -> Result<Option<&Field>, String> {
        match fields.iter().find(|field| field.name == name) {
            Some(field) if field.size == size && field.kind == kind => Ok(Some(field)),
            Some(field) => {
                let (found_kind, found) = (&field.kind, field.size);
                Err(format!(
                    "field `{name}`: expected TYPE {kind} SIZE {size}, found TYPE {found_kind} SIZE {found}"
                ))
            }
            None => Ok(None),
        }
    };
    let need = |name: &str| find(name, 4, "F")?.ok_or_else(|| format!("no field `{name}`"));
    let floats = |field: &Field| -> Vec<f32> { raw(values, field, points).map(f32::from_le_bytes).collect() };
    let [x, y, z] = ["x", "y", "z"].map(|name| need(name).map(floats));
    let intensity = match fields.iter().find(|field| field.name == "intensity") {
        Some(field) if field.size == 1 && field.kind == "U" => raw::<1>(values, field, points).map(|[v]| v).collect(),
        Some(_) => {
            let field = need("intensity")?;
            // `as` limits to the range and makes NaN 0.
            raw(values, field, points)
                .map(|v| (f32::from_le_bytes(v) * 255.0).round() as u8)
                .collect()
        }
        None => vec![0; points],
    };
    let timestamp = find("timestamp", 8, "F")?;
    let timestamp = timestamp.map(|field| raw(values, field, points).map(f64::from_le_bytes).collect());
    Ok(PcdCloud {
        x: x?,
        y: y?,
        z: z?,
        intensity,
        timestamp,
    })
}

fn raw<'a, const N: usize>(values: &'a [u8], field: &'a Field, points: usize) -> impl Iterator<Item = [u8; N]> + 'a {
    (0..points).map(move |i| std::array::from_fn(|k| values[field.start + i * field.step + k]))
}

/// What follows the compressed bytes is padding: the size in front of them counts, not that of the file.
fn decompress_body(body: &[u8], total: usize) -> Result<Vec<u8>, String> {
    let size_at = |at: usize| {
        let bytes: Option<[u8; 4]> = body.get(at..at + 4).and_then(|bytes| bytes.try_into().ok());
        bytes
            .map(|bytes| u32::from_le_bytes(bytes) as usize)
            .ok_or("the compressed sizes are missing".to_string())
    };
    let (packed, unpacked) = (size_at(0)?, size_at(4)?);
    if unpacked != total {
        return Err(format!(
            "expected {total} bytes of points, the file unpacks to {unpacked}"
        ));
    }
    let packed = body[8..]
        .get(..packed)
        .ok_or_else(|| format!("expected {packed} compressed bytes, found {}", body.len() - 8))?;
    lzf(packed, total)
}

/// Most bytes that one of LZF makes: three say how 264 are copied.
const LZF_RATIO: usize = 88;

/// Undoes LZF (Marc Lehmann's format): literal runs, and copies from at most 8 KiB back.
fn lzf(packed: &[u8], size: usize) -> Result<Vec<u8>, String> {
    if size > packed.len().saturating_mul(LZF_RATIO) {
        return Err(format!(
            "expected {size} bytes of points, {} compressed bytes cannot hold them",
            packed.len()
        ));
    }
    let mut out = Vec::with_capacity(size);
    let mut bytes = packed.iter().copied();
    let mut next = || bytes.next().ok_or("the compressed points end early".to_string());
    while out.len() < size {
        let control = usize::from(next()?);
        if control < 32 {
            for _ in 0..=control {
                out.push(next()?);
            }
            continue;
        }
        let mut length = control >> 5;
        if length == 7 {
            length += usize::from(next()?);
        }
        let distance = ((control & 31) << 8 | usize::from(next()?)) + 1;
        let from = out
            .len()
            .checked_sub(distance)
            .ok_or("the compressed points refer to bytes before their start")?;
        for at in from..from + length + 2 {
            out.push(out[at]);
        }
    }
    match out.len() == size {
        true => Ok(out),
        false => Err(format!("expected {size} bytes of points, unpacked {}", out.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(fields: &str, sizes: &str, types: &str, points: usize, data: &str) -> Vec<u8> {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
        .into_bytes()
    }

    /// Literal runs only: valid LZF, though not small.
    fn literals(values: &[u8]) -> Vec<u8> {
        let packed: Vec<u8> = values
            .chunks(32)
            .flat_map(|run| std::iter::once(run.len() as u8 - 1).chain(run.iter().copied()))
            .collect();
        let sizes = [(packed.len() as u32).to_le_bytes(), (values.len() as u32).to_le_bytes()].concat();
        [sizes, packed].concat()
    }

    #[test]
    fn reads_compressed_columns_before_padding() {
        let mut values = Vec::new();
        for column in [[1.0f32, -2.0], [3.0, 4.0], [5.0, 6.0], [0.5, 2.0]] {
            values.extend(column.iter().flat_map(|v| v.to_le_bytes()));
        }
        let mut file = head("x y z intensity", "4 4 4 4", "F F F F", 2, "binary_compressed");
        file.extend(literals(&values));
        file.extend([0; 3900]);
        let cloud = parse_pcd(&file).unwrap();
        assert_eq!(
            (cloud.x, cloud.y, cloud.z),
            (vec![1.0, -2.0], vec![3.0, 4.0], vec![5.0, 6.0])
        );
        assert_eq!((cloud.intensity, cloud.timestamp), (vec![128, 255], None));
    }

    #[test]
    fn reads_plain_points_with_times() {
        let mut file = head("x y z intensity timestamp", "4 4 4 1 8", "F F F U F", 1, "binary");
        file.extend([1.5f32, 2.5, 3.5].iter().flat_map(|v| v.to_le_bytes()));
        file.push(200);
        file.extend(1626240241.5f64.to_le_bytes());
        let cloud = parse_pcd(&file).unwrap();
        assert_eq!(
            (cloud.x[0], cloud.intensity[0], cloud.timestamp),
            (1.5, 200, Some(vec![1626240241.5]))
        );
    }

    #[test]
    fn unpacks_overlapping_copies() {
        assert_eq!(lzf(&[1, b'a', b'b', 0x60, 1], 7).unwrap(), b"abababa");
        assert_eq!(lzf(&[0, b'x', 0xe0, 3, 0], 13).unwrap(), b"xxxxxxxxxxxxx");
        assert!(lzf(&[0x20, 0], 3).unwrap_err().contains("before their start"));
        assert!(lzf(&[0], 1).unwrap_err().contains("end early"));
        let longest = [&[0, b'x'][..], &[0xe0, 255, 0].repeat(3)].concat();
        assert_eq!(lzf(&longest, 793).unwrap(), [b'x'; 793]);
        assert!(lzf(&longest, 11 * 88).unwrap_err().contains("end early"));
        assert!(
            lzf(&longest, 11 * 88 + 1)
                .unwrap_err()
                .contains("11 compressed bytes cannot hold them")
        );
        assert!(lzf(&[1, 1, 2], 1).unwrap_err().contains("unpacked 2"));
    }

    #[test]
    fn names_what_does_not_fit() {
        let error = parse_pcd(b"not a cloud").unwrap_err();
        assert!(error.contains("no line `DATA`"), "{error}");
        let error = parse_pcd(&head("x y", "4 4", "F F", 0, "binary")).unwrap_err();
        assert!(error.contains("no field `z`"), "{error}");
        let error = parse_pcd(&head("x y z", "4 4 8", "F F F", 0, "binary")).unwrap_err();
        assert!(error.contains("field `z`: expected TYPE F SIZE 4"), "{error}");
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", 3, "binary")).unwrap_err();
        assert!(error.contains("expected 36 bytes for 3 points, found 0"), "{error}");
        for size in ["0", "3", "18446744073709551615"] {
            let error = parse_pcd(&head("x y z", &format!("4 4 {size}"), "F F F", 0, "binary")).unwrap_err();
            assert_eq!(
                error,
                format!("SIZE: expected 1, 2, 4 or 8 for every field, found {size}")
            );
        }
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", 3, "ascii")).unwrap_err();
        assert!(error.contains("found `ascii`"), "{error}");
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", usize::MAX, "binary_compressed")).unwrap_err();
        assert!(error.contains("POINTS: expected less than 2 GiB"), "{error}");
    }
}
