//! PLY files as Open3D and CloudCompare write clouds: text, or binary in either byte order.

use std::borrow::Cow;

use super::Points;
use super::columns::{Binary, columns, text_values};
use super::head::Field;

/// Lines of a head, at most: it has a dozen, and comments.
const MOST_LINES: usize = 1024;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Form {
    Text,
    Little,
    Big,
}

/// Whether a file begins as PLY.
pub(super) fn is_ply(bytes: &[u8]) -> bool {
    bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r\n")
}

/// Reads the points of a PLY file; what follows them, such as faces, is no cloud.
pub(super) fn parse(bytes: &[u8]) -> Result<Points, String> {
    let (head, body) = split(bytes)?;
    let (form, points, fields) = parse_head(head)?;
    let size: usize = fields.iter().map(|field| field.size).sum();
    if form == Form::Text {
        let text =
            std::str::from_utf8(body).map_err(|_| "format ascii: expected text, found other bytes".to_string())?;
        let lines = text.lines().filter(|line| !line.trim().is_empty()).take(points);
        return columns(
            &fields,
            &text_values(lines.collect::<Vec<_>>().join("\n").as_bytes(), &fields, points)?,
        );
    }
    let total = points.checked_mul(size).filter(|total| *total <= body.len());
    let total = total.ok_or_else(|| {
        format!(
            "expected {points} vertices of {size} bytes, found {} bytes; the file may be cut: fetch it anew",
            body.len()
        )
    })?;
    let values = match form {
        Form::Big => Cow::Owned(turned(&body[..total], &fields, size)),
        _ => Cow::Borrowed(&body[..total]),
    };
    columns(
        &fields,
        &Binary {
            values: &values,
            points,
            point_size: size,
            compressed: false,
        },
    )
}

/// The lines of the head, and the bytes behind it.
fn split(bytes: &[u8]) -> Result<(&str, &[u8]), String> {
    let mut at = 0;
    for line in bytes.split_inclusive(|byte| *byte == b'\n').take(MOST_LINES) {
        at += line.len();
        if line.trim_ascii() == b"end_header" {
            let head = std::str::from_utf8(&bytes[..at]).map_err(|_| "the PLY head is not text".to_string())?;
            return Ok((head, &bytes[at..]));
        }
    }
    Err("expected a PLY file, found no line `end_header`".into())
}

/// How points are written, how many there are, and their properties.
fn parse_head(head: &str) -> Result<(Form, usize, Vec<Field>), String> {
    let (mut form, mut points, mut fields) = (None, None, Vec::<Field>::new());
    let mut is_vertex = false;
    for line in head.lines() {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["format", "ascii", _] => form = Some(Form::Text),
            ["format", "binary_little_endian", _] => form = Some(Form::Little),
            ["format", "binary_big_endian", _] => form = Some(Form::Big),
            ["element", "vertex", count] => {
                points = Some(
                    count
                        .parse()
                        .map_err(|_| format!("element vertex: expected a number, found `{}`", crate::shown(count)))?,
                );
                is_vertex = true;
            }
            ["element", name, _] if points.is_none() => {
                return Err(format!(
                    "expected the element `vertex` first, found `{}`; save the points alone",
                    crate::shown(name)
                ));
            }
            ["element", ..] => is_vertex = false,
            ["property", kind, name] if is_vertex => {
                let (kind, size) = type_of(kind).ok_or_else(|| {
                    format!(
                        "property `{}`: expected a type as float or uchar, found `{}`",
                        crate::shown(name),
                        crate::shown(kind)
                    )
                })?;
                fields.push(Field {
                    name: name.into(),
                    size,
                    kind,
                    count: 1,
                    before: fields.iter().map(|field| field.size).sum(),
                    numbers_before: fields.len(),
                });
            }
            ["property", "list", ..] if is_vertex => {
                return Err("expected a number for each property of a vertex, found a list; save it without".into());
            }
            _ => {}
        }
    }
    let form = form.ok_or("the PLY head has no line `format ascii`, `binary_little_endian` or `binary_big_endian`")?;
    let points = points.ok_or("the PLY head has no line `element vertex`")?;
    Ok((form, points, fields))
}

/// A type as PCD calls it, and its bytes.
fn type_of(name: &str) -> Option<(char, usize)> {
    Some(match name {
        "char" | "int8" => ('I', 1),
        "uchar" | "uint8" => ('U', 1),
        "short" | "int16" => ('I', 2),
        "ushort" | "uint16" => ('U', 2),
        "int" | "int32" => ('I', 4),
        "uint" | "uint32" => ('U', 4),
        "float" | "float32" => ('F', 4),
        "double" | "float64" => ('F', 8),
        _ => return None,
    })
}

/// The same numbers with their bytes the other way round.
fn turned(values: &[u8], fields: &[Field], size: usize) -> Vec<u8> {
    let mut turned = values.to_vec();
    for point in turned.chunks_exact_mut(size.max(1)) {
        for field in fields {
            point[field.before..field.before + field.size].reverse();
        }
    }
    turned
}

#[cfg(test)]
mod tests {
    use super::super::{IntensityFrom, parse_points};

    fn head(form: &str, count: usize) -> Vec<u8> {
        format!(
            "ply\nformat {form} 1.0\ncomment by hand\nelement vertex {count}\nproperty float x\nproperty double y\n\
             property float z\nproperty uchar intensity\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        )
        .into_bytes()
    }

    #[test]
    fn text_and_either_byte_order_are_read_alike() {
        let rows = [(1.0f32, 2.5f64, -3.0f32, 7u8), (4.0, 5.0, 6.0, 255)];
        let (mut text, mut little, mut big) = (
            head("ascii", 2),
            head("binary_little_endian", 2),
            head("binary_big_endian", 2),
        );
        for (x, y, z, intensity) in rows {
            text.extend(format!("{x} {y} {z} {intensity}\n").bytes());
            for (file, order) in [(&mut little, false), (&mut big, true)] {
                let mut put = |mut bytes: Vec<u8>| {
                    if order {
                        bytes.reverse();
                    }
                    file.extend(bytes);
                };
                put(x.to_le_bytes().into());
                put(y.to_le_bytes().into());
                put(z.to_le_bytes().into());
                put(vec![intensity]);
            }
        }
        text.extend(b"3 0 1 1\n");
        little.extend([3, 0, 0, 0, 0]);
        let points = parse_points(&text).unwrap();
        assert_eq!((points.x[1], points.y[0], points.z[0]), (4.0, 2.5, -3.0));
        assert_eq!(points.intensity.to_bytes(1.0).0, [7, 255]);
        assert_eq!(points.intensity_from, IntensityFrom::Named);
        assert_eq!(parse_points(&little).unwrap(), points);
        assert_eq!(parse_points(&big).unwrap(), points);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let text = |from: &str, to: &str| String::from_utf8(head("ascii", 1)).unwrap().replace(from, to);
        for (file, named) in [
            (text("end_header", "end"), "no line `end_header`"),
            (
                text("float x", "half x"),
                "property `x`: expected a type as float or uchar, found `half`",
            ),
            (text("float x", "float a") + "1 2 3 4\n", "no field `x`"),
            (text("ascii", "json"), "no line `format ascii`"),
            (
                text("vertex 1", "vertex many"),
                "element vertex: expected a number, found `many`",
            ),
            (text("property float x", "property list uchar int x"), "found a list"),
            (
                text("ascii", "binary_little_endian"),
                "expected 1 vertices of 17 bytes, found 0 bytes",
            ),
        ] {
            let error = parse_points(file.as_bytes()).unwrap_err();
            assert!(error.contains(named), "{error}");
        }
    }
}
