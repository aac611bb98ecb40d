//! `PointCloud` as `sensor_msgs/msg/PointCloud2`.

mod points;

use nalgebra::{Isometry3, Point3};
use realo_schemas::{Nanos, PointCloud};

use crate::cdr::{CdrError, CdrReader, CdrWriter};
use crate::times::TimeType;
pub use crate::times::{Look, TimeRule};
use points::{Field, Number, Points, read_fields};

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
    let reading = Reading {
        scale: 1.0,
        times: reader.time_rule(&reader.look().into_iter().collect::<Vec<_>>())?,
        to: None,
    };
    Ok((reader.stamp, reader.cloud(&reading)?.0))
}

/// How the fields of a cloud are read.
#[derive(Clone, Copy, Debug)]
pub struct Reading {
    /// What intensities are multiplied by.
    pub scale: f32,
    /// How times are read, where there are some.
    pub times: Option<TimeRule>,
    /// The frame that points are brought to.
    pub to: Option<Isometry3<f64>>,
}

/// Fields of times, by what drivers call them; the first that there is counts.
const TIMES: [&str; 5] = ["time", "t", "timestamp", "time_stamp", "offset_time"];

/// Fields of intensities, by what drivers call them; the first that there is counts.
const INTENSITIES: [&str; 4] = ["intensity", "Intensity", "i", "reflectivity"];

/// A cloud whose points are not read yet.
///
/// Takes fields of any numeric type, order and padding. `x`, `y` and `z` must be there; intensities, `ring` and times are 0
/// where missing.
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
        Self::read(&mut CdrReader::new(payload)?)
    }

    /// Reads all but the points of a message in any serialisation.
    ///
    /// # Errors
    /// Says which field or length does not fit.
    pub fn read(input: &mut CdrReader<'a>) -> Result<Self, CdrError> {
        let (stamp, frame) = input.header()?;
        let (height, width) = (input.u32()? as usize, input.u32()? as usize);
        let fields = read_fields(input)?;
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
        TIMES.iter().find_map(|name| self.find(name))
    }

    /// The field that the points' times are in, and its type.
    pub fn time(&self) -> Option<(&'a str, &'static str)> {
        self.time_field().map(|field| (field.name, field.type_name()))
    }

    /// Whether the fields are as realo writes them, in Rust or Python, in any order.
    pub(crate) fn is_ours(&self) -> bool {
        let found = |field: &(&str, u32, u8)| {
            let same = |known: &Field| (known.name, known.offset as u32, known.datatype) == *field;
            self.fields.iter().any(same)
        };
        self.points.step == STEP && self.fields.len() == FIELDS.len() && FIELDS.iter().all(found)
    }

    /// What the times of the points look like; `None` without any.
    pub fn look(&self) -> Option<Look> {
        let field = self.time_field()?;
        let (mut ends, mut points) = ([f64::INFINITY, f64::NEG_INFINITY], 0);
        for (value, there) in self.points.column::<f64>(field).into_iter().zip(self.returns()) {
            if there && value.is_finite() {
                ends = [ends[0].min(value), ends[1].max(value)];
                points += 1;
            }
        }
        let stamp = self.stamp;
        (points > 0).then_some(Look { stamp, ends, points })
    }

    /// Whether each point is a return: drivers leave the fields of directions without one empty.
    fn returns(&self) -> Vec<bool> {
        let mut returns = vec![false; self.points.count];
        for field in ["x", "y", "z"].iter().filter_map(|name| self.find(name)) {
            let column = self.points.column::<f64>(field);
            returns.iter_mut().zip(column).for_each(|(there, value)| {
                *there |= value != 0.0 && value.is_finite();
            });
        }
        returns
    }

    /// How times are read, by sweeps of the same topic; `None` without a field of times.
    ///
    /// # Errors
    /// Times that no rule explains.
    pub fn time_rule(&self, looks: &[Look]) -> Result<Option<TimeRule>, CdrError> {
        let Some(field) = self.time_field() else {
            return Ok(None);
        };
        let kind = field.time_type();
        if self.is_ours() {
            return Ok(Some(TimeRule::usual(kind)));
        }
        let rule = TimeRule::of(looks, kind);
        rule.map(Some)
            .ok_or_else(|| match self.look().or(looks.first().copied()) {
                Some(look) => self.strange_time(field, look.ends[1], look.stamp),
                None => format!("field `{}` has no finite time", field.name),
            })
    }

    fn strange_time(&self, field: &Field, value: f64, stamp: Nanos) -> CdrError {
        format!(
            "times of points: `{}` ({}) is {value} where the stamp is {stamp} ns; expected offsets of the stamp within a period of the \
             sweeps (ns if integer, s if float; ms or µs are recognised by a sweep's length), or times since 1970 or since the full hour by the \
             stamp's clock; write int32 ns from the stamp",
            field.name,
            field.type_name()
        )
    }

    /// Names of the fields with their types.
    pub fn field_names(&self) -> impl Iterator<Item = (&'a str, &'static str)> {
        self.fields.iter().map(|field| (field.name, field.type_name()))
    }

    /// How many points there are, with directions without a return.
    pub fn points(&self) -> usize {
        self.points.count
    }

    fn intensity_field(&self) -> Option<&Field<'a>> {
        INTENSITIES.iter().find_map(|name| self.find(name))
    }

    /// The field that intensities are in.
    pub fn intensity_name(&self) -> Option<&'a str> {
        self.intensity_field().map(|field| field.name)
    }

    /// Type of the intensities.
    pub fn intensity(&self) -> Option<&'static str> {
        self.intensity_field().map(Field::type_name)
    }

    /// The largest finite intensity, where intensities are of another type than a byte and some are above 0.
    pub fn brightest(&self) -> Option<f32> {
        let field = self.intensity_field().filter(|field| field.datatype != UINT8)?;
        let values = self.points.column::<f32>(field).into_iter();
        values
            .filter(|value| value.is_finite() && *value > 0.0)
            .max_by(f32::total_cmp)
    }

    /// The points, and how many of their intensities were limited to 0…255 after they were multiplied.
    ///
    /// # Errors
    /// A field that is missing; a time or a beam that does not fit.
    pub fn cloud(&self, reading: &Reading) -> Result<(PointCloud, u64), CdrError> {
        let points = &self.points;
        let [x, y, z] = self.places(reading.to.as_ref())?;
        let nothing = points.count;
        let mut limited = 0;
        let intensity = match self.intensity_field() {
            None => vec![0; nothing],
            Some(field) if field.datatype == UINT8 => points.column::<u8>(field),
            Some(field) => {
                let byte = |value: f32| {
                    let scaled = (value * reading.scale).round();
                    limited += u64::from(!(0.0..=255.0).contains(&scaled));
                    // `as` limits to the range, which was counted, and makes NaN 0.
                    scaled as u8
                };
                points.column::<f32>(field).into_iter().map(byte).collect()
            }
        };
        let cloud = PointCloud::new(x, y, z, intensity, self.times(reading.times)?, self.rings()?);
        Ok((cloud.ok_or("columns of different length")?, limited))
    }

    /// Where the points are; brought to another frame in doubles, before they are rounded.
    fn places(&self, to: Option<&Isometry3<f64>>) -> Result<[Vec<f32>; 3], CdrError> {
        let has = || self.fields.iter().map(|field| field.name).collect::<Vec<_>>().join(" ");
        let need = |name: &str| {
            self.find(name)
                .ok_or_else(|| format!("PointCloud2 has no field `{name}`; it has: {}", has()))
        };
        let fields = [need("x")?, need("y")?, need("z")?];
        let Some(to) = to else {
            return Ok(fields.map(|field| self.points.column::<f32>(field)));
        };
        let [x, y, z] = fields.map(|field| self.points.column::<f64>(field));
        let mut moved = [0; 3].map(|_: u8| Vec::with_capacity(x.len()));
        for ((x, y), z) in x.into_iter().zip(y).zip(z) {
            let point = to * Point3::new(x, y, z);
            moved
                .iter_mut()
                .zip(&point.coords)
                .for_each(|(column, value)| column.push(*value as f32));
        }
        Ok(moved)
    }

    /// Offsets from the stamp; points without a finite time are taken at the stamp.
    fn times(&self, rule: Option<TimeRule>) -> Result<Vec<i32>, CdrError> {
        let (Some(field), Some(rule)) = (self.time_field(), rule) else {
            return Ok(vec![0; self.points.count]);
        };
        if field.datatype == INT32 && rule == TimeRule::usual(TimeType::Integer) {
            let times = self.points.column::<i32>(field);
            let within = |time: &i32| time.unsigned_abs() <= 1_000_000_000;
            if times.iter().all(within) {
                return Ok(times);
            }
        }
        let values = self.points.column::<f64>(field);
        let returns = self.returns();
        let one = |(value, there): (f64, bool)| match rule.offset(value, self.stamp) {
            Some(offset) => Ok(offset),
            None if !there || !value.is_finite() => Ok(0),
            None => Err(self.strange_time(field, value, self.stamp)),
        };
        values.into_iter().zip(returns).map(one).collect()
    }

    fn rings(&self) -> Result<Vec<u16>, CdrError> {
        let Some(field) = self.find("ring") else {
            return Ok(vec![0; self.points.count]);
        };
        if field.datatype == UINT16 {
            return Ok(self.points.column::<u16>(field));
        }
        let one = |value: f64| match value.round() {
            beam if (0.0..=65_535.0).contains(&beam) => Ok(beam as u16),
            beam if beam.is_nan() => Ok(0),
            _ => Err(format!(
                "field `ring` ({}) is {value}; expected beams in 0…65535; leave the field out where beams have no numbers",
                field.type_name()
            )),
        };
        self.points.column::<f64>(field).into_iter().map(one).collect()
    }
}

macro_rules! number {
    ($type:ty, $datatype:expr, $convert:expr) => {
        impl Number for $type {
            const DATATYPE: u8 = $datatype;
            fn read(bytes: &[u8]) -> Self {
                <$type>::from_le_bytes(std::array::from_fn(|i| bytes[i]))
            }
            fn convert(value: f64) -> Self {
                $convert(value)
            }
        }
    };
}

number!(f64, FLOAT64, |value: f64| value);
number!(f32, FLOAT32, |value: f64| value as f32);
// Of these, only columns of the type itself are read: values of other types are looked at first.
number!(u8, UINT8, |value: f64| value as u8);
number!(u16, UINT16, |value: f64| value as u16);
number!(i32, INT32, |value: f64| value as i32);

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
        let scaled = |reader: &CloudReader, scale: f32| {
            let reading = Reading {
                scale,
                times: None,
                to: None,
            };
            let (cloud, limited) = reader.cloud(&reading).unwrap();
            (cloud.intensity.to_vec(), limited)
        };
        assert_eq!(scaled(&reader, 255.0), (vec![0, 128, 255, 255, 0, 0, 255], 4));
        assert_eq!(scaled(&reader, 1.0), (vec![0, 1, 1, 2, 0, 0, 255], 3));
        let bytes = payload(("intensity", 16, UINT8));
        let reader = CloudReader::new(&bytes).unwrap();
        assert_eq!((reader.intensity(), reader.brightest()), (Some("uint8"), None));
        assert_eq!(scaled(&reader, 255.0), (vec![1; 7], 0));
    }

    #[test]
    fn points_are_moved_in_doubles_before_they_are_rounded() {
        let fields = [("x", 0, FLOAT64), ("y", 8, FLOAT64), ("z", 16, FLOAT64)];
        let far = [691_234.123_4, 5_334_567.876_5, 512.25];
        let row = far.map(f64::to_le_bytes).concat();
        let payload = foreign(&fields, false, 24, &[row]);
        let reading = Reading {
            scale: 1.0,
            times: None,
            to: Some(Isometry3::translation(-691_200.0, -5_334_500.0, -510.0)),
        };
        let (cloud, _) = CloudReader::new(&payload).unwrap().cloud(&reading).unwrap();
        let found = [cloud.x[0], cloud.y[0], cloud.z[0]].map(f64::from);
        for (found, expected) in found.into_iter().zip([34.123_4, 67.876_5, 2.25]) {
            assert!((found - expected).abs() < 1e-5, "{found} instead of {expected}");
        }
    }

    #[test]
    fn times_and_beams_that_do_not_fit_are_refused_by_name() {
        let row =
            |t: f64, ring: i32| [&1f32.to_le_bytes()[..], &[0; 8], &t.to_le_bytes(), &ring.to_le_bytes()].concat();
        let xyz = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)];
        let read = |field: (&str, u32, u8), rows: &[Vec<u8>]| {
            decode(&foreign(&[&xyz[..], &[field]].concat(), false, 24, rows)).map(|(_, cloud)| cloud)
        };
        let error = read(("time", 12, FLOAT64), &[row(1.7e9, 0)]).unwrap_err();
        assert!(
            error.contains("`time` (float64) is 1700000000") && error.contains("within a period of the sweeps"),
            "{error}"
        );
        let error = read(("ring", 20, INT32), &[row(0.0, 70_000)]).unwrap_err();
        assert!(error.contains("`ring` (int32) is 70000"), "{error}");
        // The stamp is 5 ns after 1970.
        for name in ["timestamp", "time_stamp", "offset_time"] {
            let cloud = read((name, 12, FLOAT64), &[row(0.05, 0), row(f64::NAN, 0)]).unwrap();
            assert_eq!(&cloud.time[..], [50_000_000, 0], "{name}");
        }
        // What is no return has no time either.
        let nothing = [&[0; 12][..], &9e9f64.to_le_bytes(), &[0; 4]].concat();
        let cloud = read(("time", 12, FLOAT64), &[row(0.05, 0), nothing]).unwrap();
        assert_eq!(&cloud.time[..], [50_000_000, 0]);
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
