//! The fields of clouds, by their names.

use super::head::Field;
use super::stamps::Stamps;
use super::{Intensities, IntensityFrom, Points};

/// Fields of intensities, by what drivers and programs call them; the first that there is counts.
const INTENSITIES: [&str; 6] = [
    "intensity",
    "Intensity",
    "i",
    "reflectivity",
    "scalar_Intensity",
    "scalar_intensity",
];
/// Fields of colours of 32 bits: a byte each for red, green and blue, from the third byte down.
const COLOURS: [&str; 2] = ["rgb", "rgba"];

/// Where the numbers of fields are.
pub(super) trait Values {
    /// The numbers of a field that has one a point.
    fn column(&self, field: &Field) -> Vec<f64>;
    /// The same of a field of 32 bits, as its bits: as doubles, colours in floats would lose some.
    fn words(&self, field: &Field) -> Vec<u32>;
    fn points(&self) -> usize;
}

/// Numbers as bytes, the least first.
pub(super) struct Binary<'a> {
    pub values: &'a [u8],
    pub points: usize,
    pub point_size: usize,
    /// Whether they lie field by field.
    pub compressed: bool,
}

impl Binary<'_> {
    fn raw<const N: usize>(&self, field: &Field) -> impl Iterator<Item = [u8; N]> {
        let (start, step) = match self.compressed {
            true => (field.before * self.points, field.size * field.count),
            false => (field.before, self.point_size),
        };
        (0..self.points).map(move |i| {
            // One check of bounds for a value, not for each of its bytes.
            let mut value = [0; N];
            value.copy_from_slice(&self.values[start + i * step..][..N]);
            value
        })
    }
}

impl Values for Binary<'_> {
    fn column(&self, field: &Field) -> Vec<f64> {
        match (field.kind, field.size) {
            ('F', 4) => self.raw(field).map(|v| f32::from_le_bytes(v).into()).collect(),
            ('F', _) => self.raw(field).map(f64::from_le_bytes).collect(),
            ('I', 1) => self.raw(field).map(|v| i8::from_le_bytes(v).into()).collect(),
            ('I', 2) => self.raw(field).map(|v| i16::from_le_bytes(v).into()).collect(),
            ('I', 4) => self.raw(field).map(|v| i32::from_le_bytes(v).into()).collect(),
            // Of 64 bits, numbers beyond 2⁵³ lose their last digits.
            ('I', _) => self.raw(field).map(|v| i64::from_le_bytes(v) as f64).collect(),
            (_, 1) => self.raw(field).map(|v| u8::from_le_bytes(v).into()).collect(),
            (_, 2) => self.raw(field).map(|v| u16::from_le_bytes(v).into()).collect(),
            (_, 4) => self.raw(field).map(|v| u32::from_le_bytes(v).into()).collect(),
            _ => self.raw(field).map(|v| u64::from_le_bytes(v) as f64).collect(),
        }
    }

    fn words(&self, field: &Field) -> Vec<u32> {
        self.raw(field).map(u32::from_le_bytes).collect()
    }

    fn points(&self) -> usize {
        self.points
    }
}

/// Numbers of a text, a point a line.
pub(super) struct Text {
    values: Vec<f64>,
    width: usize,
}

impl Values for Text {
    fn column(&self, field: &Field) -> Vec<f64> {
        let single = (field.kind, field.size) == ('F', 4);
        let number = |row: &[f64]| match row[field.numbers_before] {
            // As a binary file would hold it.
            value if single => f64::from(value as f32),
            value => value,
        };
        self.values.chunks_exact(self.width).map(number).collect()
    }

    fn words(&self, field: &Field) -> Vec<u32> {
        let word = |row: &[f64]| match row[field.numbers_before] {
            // Some programs write the bits of a float as a whole number; as a float, such a number is no colour.
            whole if (1.0..=f64::from(u32::MAX)).contains(&whole) && whole.fract() == 0.0 => whole as u32,
            float if field.kind == 'F' => (float as f32).to_bits(),
            whole => whole as i64 as u32,
        };
        self.values.chunks_exact(self.width).map(word).collect()
    }

    fn points(&self) -> usize {
        self.values.len() / self.width
    }
}

pub(super) fn text_values(body: &[u8], fields: &[Field], points: usize) -> Result<Text, String> {
    let body = std::str::from_utf8(body).map_err(|_| "DATA ascii: expected text, found other bytes".to_string())?;
    let width: usize = fields.iter().map(|field| field.count).sum();
    let (mut values, mut found) = (Vec::new(), 0);
    let lines = body
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with('#'));
    for line in lines {
        let before = values.len();
        found += 1;
        for word in line.split_ascii_whitespace() {
            let number: f64 = word
                .parse()
                .map_err(|_| format!("point {found}: expected numbers, found `{}`", crate::shown(word)))?;
            values.push(number);
        }
        if values.len() - before != width {
            let there = values.len() - before;
            return Err(format!("point {found}: expected {width} numbers, found {there}"));
        }
    }
    match found == points {
        true => Ok(Text {
            values,
            width: width.max(1),
        }),
        false => Err(format!("expected {points} lines, one a point, found {found}")),
    }
}

/// The only field of a name, with its type.
fn find<'a>(fields: &'a [Field], name: &str) -> Result<Option<(&'a Field, &'static str)>, String> {
    let mut found = fields.iter().filter(|field| field.name == name);
    let Some(field) = found.next() else {
        return Ok(None);
    };
    if found.next().is_some() {
        return Err(format!("field `{name}`: expected one, found several; name them apart"));
    }
    if field.count != 1 {
        return Err(format!("field `{name}`: expected COUNT 1, found {}", field.count));
    }
    let kind = field.type_name().ok_or_else(|| {
        let (kind, size) = (field.kind, field.size);
        format!("field `{name}`: expected TYPE I or U with SIZE 1, 2, 4 or 8, or F with 4 or 8, found TYPE {kind} SIZE {size}")
    })?;
    Ok(Some((field, kind)))
}

/// Intensities, and where they are from.
fn intensities(fields: &[Field], values: &impl Values) -> Result<(Intensities, IntensityFrom), String> {
    for name in INTENSITIES {
        let Some((field, kind)) = find(fields, name)? else {
            continue;
        };
        let found = match kind {
            "uint8" => Intensities::Bytes(bytes(name, values.column(field))?),
            kind => Intensities::Others {
                kind,
                values: values.column(field).into_iter().map(|value| value as f32).collect(),
            },
        };
        let from = match name == INTENSITIES[0] {
            true => IntensityFrom::Named,
            false => IntensityFrom::Other(format!("of the field `{name}`")),
        };
        return Ok((found, from));
    }
    for name in COLOURS {
        if let Some((field, "float32" | "uint32" | "int32")) = find(fields, name)? {
            let first = values.words(field).into_iter().map(|word| (word >> 16) as u8).collect();
            let from = format!("of the colour `{name}`, its first channel, where OPV2V has the grey of intensities");
            return Ok((Intensities::Bytes(first), IntensityFrom::Other(from)));
        }
    }
    if let Some((field, "uint8")) = find(fields, "red")? {
        let from = IntensityFrom::Other("of `red`, the first channel of the colour".into());
        return Ok((Intensities::Bytes(bytes("red", values.column(field))?), from));
    }
    let there: Vec<String> = fields.iter().map(|field| crate::shown(&field.name)).collect();
    let nothing = Intensities::Bytes(vec![0; values.points()]);
    Ok((nothing, IntensityFrom::Nothing(there.join(", "))))
}

pub(super) fn columns(fields: &[Field], values: &impl Values) -> Result<Points, String> {
    let find = |name: &str| find(fields, name);
    let need = |name: &str| find(name)?.ok_or_else(|| format!("no field `{name}`"));
    let [x, y, z] = ["x", "y", "z"].map(|name| need(name).map(|(field, _)| values.column(field)));
    let (intensity, intensity_from) = intensities(fields, values)?;
    let timestamp = match find("timestamp")? {
        Some((field, "float64")) => Some(Stamps::Seconds(values.column(field))),
        Some((_, "float32")) => {
            return Err(
                "field `timestamp`: expected TYPE F SIZE 8, s since 1970, or whole numbers, found float32, which holds such times to two \
                 minutes only; save it as doubles or leave it out"
                    .into(),
            );
        }
        Some((field, _)) => Some(Stamps::of_whole(values.column(field))),
        None => None,
    };
    // A `t` of another type is no time of a driver.
    let mut of_drivers = fields.iter().filter(|field| field.name == "t" && field.count == 1);
    let t = of_drivers.next().filter(|field| matches!(field.kind, 'I' | 'U'));
    let t = t.map(|field| values.column(field));
    let t_is_timestamp = t.is_none() && matches!(timestamp, Some(Stamps::Counts(_)));
    let (timestamp, counts) = match timestamp {
        Some(Stamps::Seconds(seconds)) => (Some(seconds), None),
        Some(Stamps::Counts(counts)) => (None, Some(counts)),
        None => (None, None),
    };
    Ok(Points {
        x: x?,
        y: y?,
        z: z?,
        intensity,
        intensity_from,
        timestamp,
        t: t.or(counts),
        t_is_timestamp,
        offset_ns: match find("offset_ns")? {
            Some((field, "int32")) => Some(offsets(values.column(field))?),
            Some((_, kind)) => {
                return Err(format!(
                    "field `offset_ns`: expected TYPE I SIZE 4, ns from the stamp, found {kind}; save it so or leave it out"
                ));
            }
            None => None,
        },
        times: None,
    })
}

/// Times from the stamp, ns, which a text may break: within a second of it, as in a log.
fn offsets(column: Vec<f64>) -> Result<Vec<i32>, String> {
    let offset = |value: f64| match value.abs() < 1e9 && value.fract() == 0.0 {
        true => Ok(value as i32),
        false => Err(format!(
            "field `offset_ns`: expected whole numbers within 1e9 of 0, ns, found {value}"
        )),
    };
    column.into_iter().map(offset).collect()
}

/// Numbers of a field of bytes, which a text may break.
fn bytes(name: &str, column: Vec<f64>) -> Result<Vec<u8>, String> {
    let byte = |value: f64| match (0.0..=255.0).contains(&value) && value.fract() == 0.0 {
        true => Ok(value as u8),
        false => Err(format!(
            "field `{name}`: expected 0 to 255 as its TYPE U SIZE 1 says, found {value}"
        )),
    };
    column.into_iter().map(byte).collect()
}
