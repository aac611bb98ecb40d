//! PCD files as PCL, Open3D and DAIR-V2X-C write them: `DATA binary_compressed` (LZF, fields one after another), `binary` or
//! `ascii`; fields of any numeric type, padding, and counts above 1. PLY files are read alike.

mod columns;
mod head;
mod lzf;
mod ply;
mod stamps;

use std::borrow::Cow;
use std::path::Path;

use realo_logs::intensity_scale;

use self::columns::{Binary, columns, text_values};
use self::head::{Data, Head, split_head};
use self::lzf::decompress_body;
use crate::ImportError;

/// Points of a PCD file in its frame, in single precision.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PcdCloud {
    /// Metres.
    pub x: Vec<f32>,
    /// Metres.
    pub y: Vec<f32>,
    /// Metres.
    pub z: Vec<f32>,
    /// 0–255, scaled by the rule of clouds in logs ([`intensity_scale`]) and the brightest of the file.
    pub intensity: Vec<u8>,
    /// Intensities that were limited to 0…255 after they were scaled.
    pub limited_intensities: usize,
    /// Time of each point, s since the epoch, where the file has it.
    pub timestamp: Option<Vec<f64>>,
}

/// Nothing that a LiDAR sees lies farther from it, m; single precision holds it to a centimetre.
pub(crate) const SEEN: f64 = 1e5;

/// Refuses a point farther away than a LiDAR sees; what is not a number is no return and stays.
pub(crate) fn seen(point: [f64; 3]) -> Result<[f64; 3], String> {
    match point.iter().any(|metres| metres.abs() > SEEN) {
        true => {
            let [u, v, w] = point;
            Err(format!(
                "expected points within {SEEN} m of the LiDAR, in its frame, found one at {u}, {v}, {w}; bring them there in doubles"
            ))
        }
        false => Ok(point),
    }
}

/// Points of a PCD file as it holds them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Points {
    pub x: Vec<f64>,
    pub y: Vec<f64>,
    pub z: Vec<f64>,
    pub intensity: Intensities,
    pub intensity_from: IntensityFrom,
    pub timestamp: Option<Vec<f64>>,
    /// Counts of a field of whole numbers, as the file has it: data sets differ in what they mean.
    pub t: Option<Vec<f64>>,
    /// The field of these counts is `timestamp`, and not `t`.
    pub t_is_timestamp: bool,
    /// Times as offsets from the stamp, ns; they count before `timestamp`.
    pub offset_ns: Option<Vec<i32>>,
    /// How these offsets were made of other times, in words.
    pub times: Option<String>,
}

impl Points {
    /// Refuses a field `timestamp` whose counts have no unit, for whoever needs seconds since 1970.
    pub fn no_unknown_times(&self) -> Result<(), String> {
        match (&self.t, self.t_is_timestamp) {
            (Some(counts), true) => Err(stamps::unknown(counts)),
            _ => Ok(()),
        }
    }
}

/// Where intensities are from.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) enum IntensityFrom {
    /// What is called so.
    #[default]
    Named,
    /// Another field, in words.
    Other(String),
    /// Nowhere: all that there is.
    Nothing(String),
}

/// Intensities as a file holds them.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Intensities {
    Bytes(Vec<u8>),
    Others {
        /// As [`intensity_scale`] names it.
        kind: &'static str,
        values: Vec<f32>,
    },
}

impl Default for Intensities {
    fn default() -> Self {
        Intensities::Bytes(Vec::new())
    }
}

impl Intensities {
    /// The largest finite one above 0 where they are not bytes.
    pub fn brightest(&self) -> Option<f32> {
        let Intensities::Others { values, .. } = self else {
            return None;
        };
        let bright = values.iter().copied().filter(|value| value.is_finite() && *value > 0.0);
        bright.max_by(f32::total_cmp)
    }

    /// None of them, of the same type.
    pub fn without_values(&self) -> Self {
        match self {
            Intensities::Bytes(_) => Intensities::default(),
            Intensities::Others { kind, .. } => Intensities::Others {
                kind,
                values: Vec::new(),
            },
        }
    }

    /// The rule by which they become bytes, in words.
    pub fn rule(&self, brightest: f32, clouds: usize) -> String {
        match self {
            Intensities::Bytes(_) => "bytes, as they are".into(),
            Intensities::Others { kind, .. } => format!(
                "{kind}, at most {brightest} in the first {clouds} clouds: multiplied by {}",
                self.scale(brightest)
            ),
        }
    }

    /// What they are multiplied by where so much is the brightest.
    pub fn scale(&self, brightest: f32) -> f32 {
        match self {
            Intensities::Bytes(_) => 1.0,
            Intensities::Others { kind, .. } => intensity_scale(kind, brightest),
        }
    }

    /// As bytes, and how many were limited to 0…255.
    pub fn to_bytes(&self, scale: f32) -> (Vec<u8>, usize) {
        let mut limited = 0;
        let bytes = match self {
            Intensities::Bytes(bytes) => bytes.clone(),
            Intensities::Others { values, .. } => {
                let byte = |value: &f32| {
                    let scaled = (value * scale).round();
                    limited += usize::from(!(0.0..=255.0).contains(&scaled));
                    // `as` limits to the range, which was counted, and makes NaN 0.
                    scaled as u8
                };
                values.iter().map(byte).collect()
            }
        };
        (bytes, limited)
    }
}

/// Reads a PCD file.
///
/// # Errors
/// A file that cannot be read; a head, a field or a length that does not fit, by name.
pub fn read_pcd(path: &Path) -> Result<PcdCloud, ImportError> {
    let bytes = crate::files::bytes(path)?;
    parse_pcd(&bytes).map_err(|reason| ImportError::content(path, reason))
}

/// Reads the bytes of a PCD file. What they claim is compared with how many they are before anything is allocated.
///
/// # Errors
/// A head, a field or a length that does not fit, by name; points farther away than a LiDAR sees.
pub fn parse_pcd(bytes: &[u8]) -> Result<PcdCloud, String> {
    let points = parse_points(bytes)?;
    points.no_unknown_times()?;
    let Points {
        x,
        y,
        z,
        intensity,
        timestamp,
        ..
    } = points;
    for ((x, y), z) in x.iter().zip(&y).zip(&z) {
        seen([*x, *y, *z])?;
    }
    let single = |column: Vec<f64>| column.into_iter().map(|metres| metres as f32).collect();
    let scale = intensity.scale(intensity.brightest().unwrap_or(0.0));
    let (intensity, limited_intensities) = intensity.to_bytes(scale);
    Ok(PcdCloud {
        x: single(x),
        y: single(y),
        z: single(z),
        intensity,
        limited_intensities,
        timestamp,
    })
}

/// Reads the bytes of a PCD or PLY file as they are.
pub(crate) fn parse_points(bytes: &[u8]) -> Result<Points, String> {
    if ply::is_ply(bytes) {
        return ply::parse(bytes);
    }
    let (text, body) = split_head(bytes)?;
    let head = Head::parse(text)?;
    let Head { fields, points, .. } = &head;
    if head.data == Data::Ascii {
        return columns(fields, &text_values(body, fields, *points)?);
    }
    let size = head.point_size;
    let total = points.checked_mul(size).filter(|total| *total < 1 << 31);
    let total = total.ok_or_else(|| format!("POINTS: expected less than 2 GiB, found {points} of {size} bytes"))?;
    let compressed = head.data == Data::Compressed;
    let values = match compressed {
        // Some writers leave out the sizes of nothing.
        true if total == 0 => Cow::Borrowed(&[][..]),
        true => Cow::Owned(decompress_body(body, total)?),
        false => {
            let (values, rest) = body.split_at(total.min(body.len()));
            // Some writers pad a file with zeros.
            if rest.len() >= size.max(1) && rest.iter().any(|byte| *byte != 0) {
                return Err(format!(
                    "expected {total} bytes for {points} points of {size} bytes, found {}; see WIDTH, POINTS, SIZE and COUNT",
                    body.len()
                ));
            }
            Cow::Borrowed(values)
        }
    };
    if values.len() != total {
        return Err(format!(
            "expected {total} bytes for {points} points, found {}",
            values.len()
        ));
    }
    let binary = Binary {
        values: &values,
        points: *points,
        point_size: size,
        compressed,
    };
    columns(fields, &binary)
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
        for column in [[1.0f32, -2.0], [3.0, 4.0], [5.0, 6.0], [0.5, 1.0]] {
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

    /// Points of (x, y, z, intensity) whose fields have such types, with padding behind each.
    fn typed(kind: &str, size: usize, value: impl Fn(f64) -> Vec<u8>) -> Points {
        let fields = format!("x y z _ intensity\nSIZE 8 8 8 1 {size}\nTYPE F F F U {kind}\nCOUNT 1 1 1 3 1");
        let mut file = format!("# .PCD v0.7\nFIELDS {fields}\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n").into_bytes();
        for i in 0..3 {
            let place = [691_234.25, 5_334_567.5, f64::from(i)];
            file.extend(place.iter().flat_map(|v| v.to_le_bytes()));
            file.extend([9, 9, 9]);
            file.extend(value([0.0, 0.5, 1.0][i as usize]));
        }
        parse_points(&file).unwrap()
    }

    #[test]
    fn intensities_of_every_type_fill_a_byte_by_the_brightest() {
        let bytes = |points: &Points| {
            points
                .intensity
                .to_bytes(points.intensity.scale(points.intensity.brightest().unwrap_or(0.0)))
        };
        let float = |most: f64| typed("F", 4, move |v| ((v * most) as f32).to_le_bytes().to_vec());
        for (points, expected) in [
            (float(1.0), [0, 128, 255]),
            (float(255.0), [0, 128, 255]),
            (float(100.0), [0, 50, 100]),
            (float(4000.0), [0, 125, 249]),
            (typed("F", 8, |v| v.to_le_bytes().to_vec()), [0, 128, 255]),
            (typed("U", 1, |v| vec![(v * 254.0) as u8]), [0, 127, 254]),
            (
                typed("U", 2, |v| ((v * 254.0) as u16).to_le_bytes().to_vec()),
                [0, 127, 254],
            ),
            (
                typed("U", 2, |v| ((v * 65_535.0) as u16).to_le_bytes().to_vec()),
                [0, 127, 255],
            ),
            (
                typed("I", 4, |v| ((v * 4_095.0) as i32).to_le_bytes().to_vec()),
                [0, 127, 255],
            ),
        ] {
            assert_eq!(bytes(&points), (expected.to_vec(), 0), "{:?}", points.intensity);
            assert_eq!((points.x[2], points.y[2], points.z[2]), (691_234.25, 5_334_567.5, 2.0));
        }
        let negative = typed("I", 1, |v| vec![(v * -100.0) as i8 as u8]);
        assert_eq!(bytes(&negative), (vec![0, 0, 0], 2));
    }

    #[test]
    fn reads_text_comments_windows_lines_and_other_counts() {
        let head = "# .PCD v0.7\n# DATA of a test\nVERSION 0.7\nFIELDS x\ty\tz normal intensity\nSIZE 4 4 4 4 4\nTYPE F F F F F\n\
                    COUNT 1 1 1 3 1\nWIDTH 2\nHEIGHT 1\nDATA ascii\n1 2 3 0 0 1 0.5\n nan nan nan 0 0 1 1\n\n";
        for text in [head.to_string(), head.replace('\n', "\r\n")] {
            let cloud = parse_pcd(text.as_bytes()).unwrap();
            assert_eq!(
                (cloud.x[0], cloud.y[0], cloud.z[0], cloud.x[1].is_nan()),
                (1.0, 2.0, 3.0, true)
            );
            assert_eq!(cloud.intensity, [128, 255]);
        }
        let nothing = parse_pcd(&self::head(
            "x y z intensity",
            "4 4 4 4",
            "F F F F",
            0,
            "binary_compressed",
        ))
        .unwrap();
        assert!(nothing.x.is_empty());
    }

    #[test]
    fn names_what_does_not_fit() {
        let error = parse_pcd(b"not a cloud").unwrap_err();
        assert!(error.contains("no line `DATA`"), "{error}");
        let error = parse_pcd(&head("x y", "4 4", "F F", 0, "binary")).unwrap_err();
        assert!(error.contains("no field `z`"), "{error}");
        let error = parse_pcd(&head("x y z", "4 4 2", "F F F", 0, "binary")).unwrap_err();
        assert!(error.contains("field `z`: expected TYPE I or U"), "{error}");
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F\nCOUNT 1 1 2", 0, "binary")).unwrap_err();
        assert_eq!(error, "field `z`: expected COUNT 1, found 2");
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", 3, "binary")).unwrap_err();
        assert!(error.contains("expected 36 bytes for 3 points, found 0"), "{error}");
        for size in ["0", "3", "18446744073709551615"] {
            let error = parse_pcd(&head("x y z", &format!("4 4 {size}"), "F F F", 0, "binary")).unwrap_err();
            assert_eq!(
                error,
                format!("SIZE: expected 1, 2, 4 or 8 for every field, found {size}")
            );
        }
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", 3, "binary_zstd")).unwrap_err();
        assert!(error.contains("found `binary_zstd`"), "{error}");
        for (body, named) in [
            ("1 2 3\n", "expected 2 lines, one a point, found 1"),
            ("1 2 3\n4 5\n", "point 2: expected 3 numbers, found 2"),
            ("1 2 x\n4 5 6\n", "point 1: expected numbers, found `x`"),
        ] {
            let file = [&head("x y z", "4 4 4", "F F F", 2, "ascii")[..], body.as_bytes()].concat();
            assert_eq!(parse_pcd(&file).unwrap_err(), named);
        }
        let file = [
            &head("x y z intensity", "4 4 4 1", "F F F U", 1, "ascii")[..],
            b"1 2 3 256\n",
        ]
        .concat();
        assert!(parse_pcd(&file).unwrap_err().contains("expected 0 to 255"));
        let contradicting = String::from_utf8(head("x y z", "4 4 4", "F F F", 3, "binary")).unwrap();
        let contradicting = contradicting.replace("HEIGHT 1", "HEIGHT 2");
        let error = parse_pcd(contradicting.as_bytes()).unwrap_err();
        assert!(error.contains("expected WIDTH 3 × HEIGHT 2, found 3"), "{error}");
        let short = [&head("x y z", "4 4 4", "F F F", 1, "binary")[..], &[1; 24]].concat();
        let error = parse_pcd(&short).unwrap_err();
        assert!(
            error.contains("expected 12 bytes for 1 points of 12 bytes, found 24"),
            "{error}"
        );
        let padded = [&head("x y z", "4 4 4", "F F F", 1, "binary")[..], &[1; 12], &[0; 40]].concat();
        assert_eq!(parse_pcd(&padded).unwrap().x.len(), 1);
        let error = parse_pcd(&head("x y z", "4 4 4", "F F F", usize::MAX, "binary_compressed")).unwrap_err();
        assert!(error.contains("POINTS: expected less than 2 GiB"), "{error}");
    }
}
