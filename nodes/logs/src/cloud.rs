//! `PointCloud` as `sensor_msgs/msg/PointCloud2`.

use realo_schemas::{Nanos, PointCloud};

use crate::cdr::{CdrError, CdrReader, CdrWriter};

/// Bytes per point as we write them: x y z, intensity, a byte of padding, ring, time.
const STEP: usize = 20;
const INT8: u8 = 1;
const UINT8: u8 = 2;
const INT16: u8 = 3;
const UINT16: u8 = 4;
const INT32: u8 = 5;
const UINT32: u8 = 6;
const FLOAT32: u8 = 7;
const FLOAT64: u8 = 8;
const FIELDS: [(&str, u32, u8); 6] = [
    ("x", 0, FLOAT32),
    ("y", 4, FLOAT32),
    ("z", 8, FLOAT32),
    ("intensity", 12, UINT8),
    ("time", 16, INT32),
    ("ring", 14, UINT16),
];

/// Appends a cloud as CDR.
pub fn encode(buffer: &mut Vec<u8>, stamp: Nanos, frame: &str, cloud: &PointCloud) {
    let mut out = CdrWriter::new(buffer);
    out.header(stamp, frame);
    out.u32(1);
    out.length(cloud.len());
    out.length(FIELDS.len());
    for (name, offset, datatype) in FIELDS {
        out.string(name);
        out.u32(offset);
        out.u8(datatype);
        out.u32(1);
    }
    out.bool(false);
    out.length(STEP);
    out.length(STEP * cloud.len());
    let points = out.bytes_mut(STEP * cloud.len());
    for (i, point) in points.chunks_exact_mut(STEP).enumerate() {
        point[0..4].copy_from_slice(&cloud.x[i].to_le_bytes());
        point[4..8].copy_from_slice(&cloud.y[i].to_le_bytes());
        point[8..12].copy_from_slice(&cloud.z[i].to_le_bytes());
        point[12] = cloud.intensity[i];
        point[14..16].copy_from_slice(&cloud.ring[i].to_le_bytes());
        point[16..20].copy_from_slice(&cloud.time[i].to_le_bytes());
    }
    let finite = |column: &[f32]| column.iter().all(|v| v.is_finite());
    out.bool(finite(&cloud.x) && finite(&cloud.y) && finite(&cloud.z));
}

/// Reads a cloud from CDR; see [`CloudReader::cloud`].
///
/// # Errors
/// Says which field or length does not fit.
pub fn decode(payload: &[u8]) -> Result<(Nanos, PointCloud), CdrError> {
    let reader = CloudReader::new(payload)?;
    Ok((reader.stamp, reader.cloud(1.0)?))
}

/// A cloud whose points are not read yet.
///
/// Takes fields of any numeric type, order and padding. `x`, `y` and `z` must be there; `intensity` and `ring` are 0
/// where missing, limited to their range otherwise. Times count from the header's stamp, ns if integer, s if float; they
/// are in the field `time`, or, as Ouster's driver has them, in `t`.
pub struct CloudReader<'a> {
    /// The measurement's reference time, ns.
    pub stamp: Nanos,
    /// The frame of the points.
    pub frame: &'a str,
    fields: Vec<Field<'a>>,
    points: Points<'a>,
}

impl<'a> CloudReader<'a> {
    /// Reads all but the points.
    ///
    /// # Errors
    /// Says which field or length does not fit.
    pub fn new(payload: &'a [u8]) -> Result<Self, CdrError> {
        let mut input = CdrReader::new(payload)?;
        let (stamp, frame) = input.header()?;
        let (height, width) = (input.u32()? as usize, input.u32()? as usize);
        let fields = read_fields(&mut input)?;
        let big_endian = input.bool()?;
        let (step, row_step) = (input.u32()? as usize, input.u32()? as usize);
        let data = input.bytes()?;
        let points = Points::new(data, height, width, step, row_step, big_endian)?;
        for field in &fields {
            field.check(step)?;
        }
        Ok(CloudReader {
            stamp,
            frame,
            fields,
            points,
        })
    }

    fn find(&self, name: &str) -> Option<&Field<'a>> {
        self.fields.iter().find(|field| field.name == name)
    }

    fn time_field(&self) -> Option<&Field<'a>> {
        self.find("time").or_else(|| self.find("t"))
    }

    /// The field that the points' times are in, and its type.
    pub fn time(&self) -> Option<(&'a str, &'static str)> {
        self.time_field().map(|field| (field.name, field.type_name()))
    }

    /// Type of the intensities.
    pub fn intensity(&self) -> Option<&'static str> {
        self.find("intensity").map(Field::type_name)
    }

    /// The greatest finite intensity, where intensities are floats and some are above 0.
    pub fn brightest(&self) -> Option<f32> {
        let field = self.find("intensity").filter(|field| field.is_float())?;
        let values = self.points.column::<f32>(field).into_iter();
        values
            .filter(|value| value.is_finite() && *value > 0.0)
            .max_by(f32::total_cmp)
    }

    /// The points in their frame; intensities that are floats are multiplied by `scale`.
    ///
    /// # Errors
    /// A field that is missing.
    pub fn cloud(&self, scale: f32) -> Result<PointCloud, CdrError> {
        let points = &self.points;
        let need = |name: &str| {
            let has = || self.fields.iter().map(|field| field.name).collect::<Vec<_>>().join(" ");
            self.find(name)
                .ok_or_else(|| format!("PointCloud2 has no field `{name}`; it has: {}", has()))
        };
        let [x, y, z] = ["x", "y", "z"].map(|name| need(name).map(|field| points.column::<f32>(field)));
        let nothing = points.count;
        let intensity = match self.find("intensity") {
            None => vec![0; nothing],
            Some(field) if field.is_float() => {
                let values = points.column::<f32>(field).into_iter();
                // `as` limits to the range and makes NaN 0.
                values.map(|value| (value * scale).round() as u8).collect()
            }
            Some(field) => points.column::<u8>(field),
        };
        let time = self
            .time_field()
            .map_or_else(|| vec![0; nothing], |field| points.column::<i32>(field));
        let ring = self
            .find("ring")
            .map_or_else(|| vec![0; nothing], |field| points.column::<u16>(field));
        PointCloud::new(x?, y?, z?, intensity, time, ring).ok_or_else(|| "columns of different length".into())
    }
}

struct Field<'a> {
    name: &'a str,
    offset: usize,
    datatype: u8,
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

    fn is_float(&self) -> bool {
        matches!(self.datatype, FLOAT32 | FLOAT64)
    }

    fn type_name(&self) -> &'static str {
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

    fn check(&self, step: usize) -> Result<(), CdrError> {
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

fn read_fields<'a>(input: &mut CdrReader<'a>) -> Result<Vec<Field<'a>>, CdrError> {
    let mut fields = Vec::new();
    for _ in 0..input.length(13)? {
        let (name, offset, datatype) = (input.string()?, input.u32()? as usize, input.u8()?);
        input.u32()?;
        fields.push(Field { name, offset, datatype });
    }
    Ok(fields)
}

struct Points<'a> {
    rows: Vec<&'a [u8]>,
    count: usize,
    step: usize,
    big_endian: bool,
}

impl<'a> Points<'a> {
    fn new(
        data: &'a [u8],
        height: usize,
        width: usize,
        step: usize,
        row_step: usize,
        big_endian: bool,
    ) -> Result<Self, CdrError> {
        let count = height.saturating_mul(width);
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

    fn column<T: Number>(&self, field: &Field) -> Vec<T> {
        let mut column = Vec::with_capacity(self.count);
        let offset = field.offset;
        for row in &self.rows {
            let points = row.chunks_exact(self.step);
            if field.datatype == T::DATATYPE && !self.big_endian {
                column.extend(points.map(|point| T::read(&point[offset..])));
            } else {
                column.extend(
                    points.map(|point| T::convert(self.number(&point[offset..], field.datatype), field.datatype)),
                );
            }
        }
        column
    }

    fn number(&self, bytes: &[u8], datatype: u8) -> f64 {
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

trait Number: Sized {
    const DATATYPE: u8;
    fn read(bytes: &[u8]) -> Self;
    fn convert(value: f64, datatype: u8) -> Self;
}

macro_rules! number {
    ($type:ty, $datatype:expr, $convert:expr) => {
        impl Number for $type {
            const DATATYPE: u8 = $datatype;
            fn read(bytes: &[u8]) -> Self {
                <$type>::from_le_bytes(std::array::from_fn(|i| bytes[i]))
            }
            fn convert(value: f64, datatype: u8) -> Self {
                $convert(value, datatype)
            }
        }
    };
}

// `as` limits to the range of the integer and makes NaN 0.
number!(f32, FLOAT32, |value: f64, _| value as f32);
number!(u8, UINT8, |value: f64, _| value.round() as u8);
number!(u16, UINT16, |value: f64, _| value.round() as u16);
number!(i32, INT32, |value: f64, datatype| match datatype {
    FLOAT32 | FLOAT64 => (value * 1e9).round() as i32,
    _ => value as i32,
});

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> PointCloud {
        PointCloud::new(
            vec![1.0f32, f32::NAN, -3.5],
            vec![0.0f32, f32::INFINITY, 2.0],
            vec![-1.0f32, 0.5, 1e-30],
            vec![0u8, 17, 255],
            vec![-50_000_000i32, 0, 49_999_999],
            vec![0u16, 127, 65_535],
        )
        .unwrap()
    }

    #[test]
    fn reads_what_it_wrote_bit_for_bit() {
        let mut payload = Vec::new();
        encode(&mut payload, 1_700_000_000_123_456_789, "cav1/body", &cloud());
        let (stamp, back) = decode(&payload).unwrap();
        assert_eq!(stamp, 1_700_000_000_123_456_789);
        let bits = |column: &[f32]| column.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(
            (bits(&back.x), bits(&back.y), bits(&back.z)),
            (bits(&cloud().x), bits(&cloud().y), bits(&cloud().z))
        );
        assert_eq!(
            (back.intensity, back.time, back.ring),
            (cloud().intensity, cloud().time, cloud().ring)
        );
        let mut payload = Vec::new();
        encode(&mut payload, 0, "a/body", &PointCloud::empty());
        assert!(decode(&payload).unwrap().1.is_empty());
    }

    fn foreign(fields: &[(&str, u32, u8)], big_endian: bool, step: u32, rows: &[Vec<u8>]) -> Vec<u8> {
        let mut payload = Vec::new();
        let mut out = CdrWriter::new(&mut payload);
        out.header(5, "lidar");
        out.length(rows.len());
        out.length(rows[0].len() / step as usize);
        out.length(fields.len());
        for (name, offset, datatype) in fields {
            out.string(name);
            out.u32(*offset);
            out.u8(*datatype);
            out.u32(1);
        }
        out.bool(big_endian);
        out.u32(step);
        out.length(rows[0].len());
        let data = rows.concat();
        out.bytes_mut(data.len()).copy_from_slice(&data);
        out.bool(true);
        payload
    }

    #[test]
    fn accepts_other_types_orders_and_padding() {
        let fields = [
            ("ring", 0, UINT8),
            ("z", 1, FLOAT64),
            ("x", 9, INT16),
            ("y", 11, FLOAT32),
            ("intensity", 15, FLOAT32),
            ("time", 19, FLOAT64),
        ];
        let point = |ring: u8, x: i16, y: f32, z: f64, intensity: f32, time: f64| {
            let mut bytes = vec![ring];
            bytes.extend(z.to_be_bytes());
            bytes.extend(x.to_be_bytes());
            bytes.extend(y.to_be_bytes());
            bytes.extend(intensity.to_be_bytes());
            bytes.extend(time.to_be_bytes());
            bytes.push(99);
            bytes
        };
        let rows = [
            point(3, -7, 1.5, 0.25, 300.0, 0.0125),
            point(4, 8, 2.5, -0.25, f32::NAN, -1e-9),
        ];
        let (_, cloud) = decode(&foreign(&fields, true, 28, &rows)).unwrap();
        assert_eq!(
            (&cloud.x[..], &cloud.y[..], &cloud.z[..]),
            (&[-7.0f32, 8.0][..], &[1.5f32, 2.5][..], &[0.25f32, -0.25][..])
        );
        assert_eq!(
            (&cloud.intensity[..], &cloud.ring[..], &cloud.time[..]),
            (&[255u8, 0][..], &[3u16, 4][..], &[12_500_000i32, -1][..])
        );
    }

    #[test]
    fn times_of_ouster_are_read_and_time_goes_first() {
        let row = |t: u32| [&[0; 12][..], &t.to_le_bytes(), &7i32.to_le_bytes()].concat();
        let xyz = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
        let payload = |more: &[(&str, u32, u8)]| foreign(&[&xyz, more].concat(), false, 20, &[row(99_999_999), row(0)]);
        let ouster = payload(&[("t", 12, UINT32)]);
        assert_eq!(&decode(&ouster).unwrap().1.time[..], [99_999_999, 0]);
        assert_eq!(CloudReader::new(&ouster).unwrap().time(), Some(("t", "uint32")));
        let both = payload(&[("t", 12, UINT32), ("time", 16, INT32)]);
        assert_eq!(&decode(&both).unwrap().1.time[..], [7, 7]);
        assert_eq!(CloudReader::new(&both).unwrap().time(), Some(("time", "int32")));
        let none = payload(&[]);
        assert_eq!(&decode(&none).unwrap().1.time[..], [0, 0]);
        assert_eq!(CloudReader::new(&none).unwrap().time(), None);
    }

    #[test]
    fn intensities_are_scaled_only_where_they_are_floats() {
        let row = |v: f32| [&[0; 12][..], &v.to_le_bytes(), &[1]].concat();
        let xyz = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
        let values = [0.0, 0.5, 1.0, 1.5, -1.0, f32::NAN, f32::INFINITY];
        let payload = |field| foreign(&[&xyz[..], &[field]].concat(), false, 17, &values.map(row));
        let floats = payload(("intensity", 12, FLOAT32));
        let reader = CloudReader::new(&floats).unwrap();
        assert_eq!((reader.intensity(), reader.brightest()), (Some("float32"), Some(1.5)));
        assert_eq!(
            &reader.cloud(255.0).unwrap().intensity[..],
            [0, 128, 255, 255, 0, 0, 255]
        );
        assert_eq!(&reader.cloud(1.0).unwrap().intensity[..], [0, 1, 1, 2, 0, 0, 255]);
        let bytes = payload(("intensity", 16, UINT8));
        let reader = CloudReader::new(&bytes).unwrap();
        assert_eq!((reader.intensity(), reader.brightest()), (Some("uint8"), None));
        assert_eq!(&reader.cloud(255.0).unwrap().intensity[..], [1; 7]);
    }

    #[test]
    fn names_what_does_not_fit() {
        let row = vec![0; 12];
        let error = decode(&foreign(
            &[("x", 0, FLOAT32), ("y", 4, FLOAT32)],
            false,
            12,
            std::slice::from_ref(&row),
        ))
        .unwrap_err();
        assert!(error.contains("no field `z`; it has: x y"), "{error}");
        let error = decode(&foreign(&[("x", 9, FLOAT32)], false, 12, std::slice::from_ref(&row))).unwrap_err();
        assert!(error.contains("field `x` at byte 9"), "{error}");
        let error = decode(&foreign(&[("x", 0, 42)], false, 12, &[row])).unwrap_err();
        assert!(error.contains("unknown datatype 42"), "{error}");
        let mut payload = Vec::new();
        encode(&mut payload, 0, "a", &cloud());
        for cut in 0..payload.len() {
            assert!(decode(&payload[..cut]).is_err() || cut >= payload.len() - 1, "{cut}");
        }
    }
}
