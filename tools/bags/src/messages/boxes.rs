//! Objects of `Detection3DArray` and `MarkerArray`. Both have changed from version to version of ROS: the form that ends where the
//! message ends is the right one.

use std::collections::BTreeMap;

use nalgebra::Isometry3;
use realo_logs::cdr::{CdrError, CdrReader};
use realo_logs::pose::isometry;
use realo_schemas::Nanos;

/// An object.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// The frame of its pose.
    pub frame: String,
    /// What it is most likely, as the bag names it.
    pub class: String,
    /// Its identity over time; empty where nobody knows.
    pub track: String,
    /// How sure its maker is.
    pub score: f64,
    /// Pose of the middle of its box.
    pub frame_from_object: Isometry3<f64>,
    /// Length, width and height, m.
    pub size: [f64; 3],
}

/// The objects of a message.
#[derive(Clone, Debug, PartialEq)]
pub struct Objects {
    /// When.
    pub stamp: Nanos,
    /// All that have a place.
    pub objects: Vec<Object>,
    /// Markers that are no cubes, by the names of their types.
    pub others: BTreeMap<&'static str, usize>,
}

/// How a `Detection3D` is laid out: whether its hypotheses have numbers, and what follows its box.
#[derive(Clone, Copy, Debug)]
struct DetectionForm {
    has_numbers: bool,
    has_cloud: bool,
    tail: Tail,
}

#[derive(Clone, Copy, Debug)]
enum Tail {
    Nothing,
    /// `id`.
    Id,
    /// `is_tracking` and `tracking_id`.
    Tracking,
}

/// Reads a `Detection3DArray`; `begin` starts to read the message.
///
/// # Errors
/// Bytes that no known form explains; numbers that are no pose.
pub fn detections<'a>(begin: impl Fn() -> Result<CdrReader<'a>, CdrError>) -> Result<Objects, CdrError> {
    let form = |has_numbers, has_cloud, tail| DetectionForm {
        has_numbers,
        has_cloud,
        tail,
    };
    let forms = [
        form(false, false, Tail::Id),
        form(true, true, Tail::Nothing),
        form(true, true, Tail::Tracking),
        form(false, true, Tail::Tracking),
        form(false, true, Tail::Nothing),
        form(false, false, Tail::Tracking),
        form(true, false, Tail::Nothing),
    ];
    whole("Detection3DArray", &begin, &forms, |input, form| array(input, form))
}

/// The first form in which a message ends where its bytes end.
fn whole<'a, F: Copy>(
    what: &str,
    begin: &impl Fn() -> Result<CdrReader<'a>, CdrError>,
    forms: &[F],
    read: impl Fn(&mut CdrReader<'a>, F) -> Result<Objects, CdrError>,
) -> Result<Objects, CdrError> {
    let mut reason = String::new();
    for form in forms {
        let mut input = begin()?;
        // CDR may be filled up to 4 bytes.
        let most = if input.is_ros1() { 0 } else { 3 };
        let found = read(&mut input, *form).and_then(|found| match input.rest() {
            rest if rest <= most => Ok(found),
            rest => Err(format!("{rest} bytes are left")),
        });
        match found {
            Ok(found) => return Ok(found),
            Err(error) if reason.is_empty() => reason = error,
            Err(_) => {}
        }
    }
    Err(format!("no known form of {what} explains it: {reason}"))
}

fn array(input: &mut CdrReader, form: DetectionForm) -> Result<Objects, CdrError> {
    let (stamp, frame) = input.header()?;
    let mut objects = Vec::new();
    for _ in 0..input.length(80)? {
        objects.push(detection(input, frame, form)?);
    }
    Ok(Objects {
        stamp,
        objects,
        others: BTreeMap::new(),
    })
}

fn detection(input: &mut CdrReader, array_frame: &str, form: DetectionForm) -> Result<Object, CdrError> {
    let (_, frame) = input.header()?;
    let (mut class, mut score) = (String::new(), 1.0_f64);
    for place in 0..input.length(12)? {
        let name = match form.has_numbers {
            true => (input.u64()? as i64).to_string(),
            false => input.string()?.to_string(),
        };
        let certain = input.f64()?;
        input.f64s::<43>()?;
        if place == 0 || score.is_nan() || certain > score {
            (class, score) = (name, certain);
        }
    }
    let center = input.f64s::<7>()?;
    let size = input.f64s()?;
    if form.has_cloud {
        skip_cloud(input)?;
    }
    let track = match form.tail {
        Tail::Nothing => String::new(),
        Tail::Id => input.string()?.to_string(),
        Tail::Tracking => {
            let is_tracking = input.u8()?;
            let id = input.string()?;
            match is_tracking {
                0 => String::new(),
                1 => id.to_string(),
                other => return Err(format!("`is_tracking` is {other}")),
            }
        }
    };
    Ok(Object {
        frame: if frame.is_empty() { array_frame } else { frame }.into(),
        class,
        track,
        score,
        frame_from_object: isometry(&center)?,
        size,
    })
}

fn skip_cloud(input: &mut CdrReader) -> Result<(), CdrError> {
    input.header()?;
    input.u32()?;
    input.u32()?;
    for _ in 0..input.length(13)? {
        input.string()?;
        input.u32()?;
        input.u8()?;
        input.u32()?;
    }
    input.bool()?;
    input.u32()?;
    input.u32()?;
    input.bytes()?;
    input.bool()?;
    Ok(())
}

/// How a `Marker` is laid out: newer ones have a texture and a file of a mesh.
#[derive(Clone, Copy, Debug)]
struct MarkerForm {
    has_texture: bool,
    has_mesh_file: bool,
}

/// Reads the cubes of a `MarkerArray`; others are no objects. The class is the marker's text, else its namespace. The track is its
/// namespace and `id`, which only together name a marker.
///
/// # Errors
/// Bytes that no known form explains; numbers that are no pose.
pub fn markers<'a>(begin: impl Fn() -> Result<CdrReader<'a>, CdrError>) -> Result<Objects, CdrError> {
    let form = |has_texture, has_mesh_file| MarkerForm {
        has_texture,
        has_mesh_file,
    };
    let forms = [
        form(true, true),
        form(true, false),
        form(false, false),
        form(false, true),
    ];
    whole("MarkerArray", &begin, &forms, |input, form| {
        let (mut stamp, mut objects, mut others) = (0, Vec::new(), BTreeMap::new());
        for _ in 0..input.length(100)? {
            let (at, found) = marker(input, form)?;
            stamp = if stamp == 0 { at } else { stamp };
            match found {
                Found::Cube(object) => objects.push(object),
                Found::Other(name) => *others.entry(name).or_default() += 1,
                Found::Nothing => {}
            }
        }
        Ok(Objects { stamp, objects, others })
    })
}

/// The type of markers that only show a text.
pub const TEXT: &str = "TEXT_VIEW_FACING";
/// Types of markers, by their numbers.
const MARKERS: [&str; 12] = [
    "ARROW",
    "CUBE",
    "SPHERE",
    "CYLINDER",
    "LINE_STRIP",
    "LINE_LIST",
    "CUBE_LIST",
    "SPHERE_LIST",
    "POINTS",
    TEXT,
    "MESH_RESOURCE",
    "TRIANGLE_LIST",
];

/// What a marker is.
enum Found {
    Cube(Object),
    /// Its type.
    Other(&'static str),
    /// It deletes others.
    Nothing,
}

fn marker(input: &mut CdrReader, form: MarkerForm) -> Result<(Nanos, Found), CdrError> {
    const CUBE: i32 = 1;
    const ADD: i32 = 0;
    let (stamp, frame) = input.header()?;
    let namespace = input.string()?;
    let (id, kind, action) = (input.i32()?, input.i32()?, input.i32()?);
    let pose = input.f64s::<7>()?;
    let size = input.f64s()?;
    for _ in 0..4 {
        input.f32()?;
    }
    input.u32()?;
    input.u32()?;
    input.bool()?;
    for _ in 0..input.length(24)? {
        input.f64s::<3>()?;
    }
    for _ in 0..4 * input.length(16)? {
        input.f32()?;
    }
    if form.has_texture {
        input.string()?;
        input.header()?;
        input.string()?;
        input.bytes()?;
        for _ in 0..2 * input.length(8)? {
            input.f32()?;
        }
    }
    let text = input.string()?;
    input.string()?;
    if form.has_mesh_file {
        input.string()?;
        input.bytes()?;
    }
    input.bool()?;
    if (kind, action) != (CUBE, ADD) {
        let name = usize::try_from(kind).ok().and_then(|kind| MARKERS.get(kind));
        return Ok(match action {
            ADD => (stamp, Found::Other(name.unwrap_or(&"of another number"))),
            _ => (stamp, Found::Nothing),
        });
    }
    let object = Object {
        frame: frame.into(),
        class: if text.is_empty() { namespace } else { text }.into(),
        track: match namespace {
            "" => id.to_string(),
            _ => format!("{namespace}/{id}"),
        },
        score: 1.0,
        frame_from_object: isometry(&pose)?,
        size,
    };
    Ok((stamp, Found::Cube(object)))
}

#[cfg(test)]
mod tests {
    use realo_logs::boxes::{encode, encode_markers};
    use realo_schemas::Box3;

    use super::*;

    fn car() -> Box3 {
        let mut car = Box3::new("car", [10.0, -2.0, 0.8], [4.5, 1.8, 1.6], 0.3);
        car.track = Some(7);
        car
    }

    #[test]
    fn boxes_of_logs_are_read() {
        let mut payload = Vec::new();
        encode(&mut payload, 42, "map", &[car(), car()]);
        let found = detections(|| CdrReader::any_cdr(&payload)).unwrap();
        assert_eq!((found.stamp, found.objects.len()), (42, 2));
        let object = &found.objects[0];
        assert_eq!(
            (object.class.as_str(), object.track.as_str(), object.size),
            ("car", "7", [4.5, 1.8, 1.6])
        );
        assert!((object.frame_from_object.translation.vector.x - 10.0).abs() < 1e-12);
        let mut payload = Vec::new();
        encode_markers(&mut payload, 42, "map", "truth", &[car()]);
        let found = markers(|| CdrReader::any_cdr(&payload)).unwrap();
        assert_eq!((found.stamp, found.objects.len()), (42, 1), "what deletes is no object");
        assert_eq!(
            (found.objects[0].class.as_str(), found.objects[0].track.as_str()),
            ("car", "truth/0")
        );
        let mut other = Vec::new();
        encode_markers(&mut other, 42, "map", "", &[car()]);
        let other = markers(|| CdrReader::any_cdr(&other)).unwrap();
        assert_eq!(other.objects[0].track, "0", "another marker than that of `truth`");
        for cut in 0..payload.len() - 4 {
            assert!(markers(|| CdrReader::any_cdr(&payload[..cut])).is_err(), "{cut}");
        }
    }

    /// A `Detection3DArray` of ROS 1: numbers as classes, a cloud behind the box.
    fn of_ros1(hypotheses: &[(i64, f64)], tracking: bool) -> Vec<u8> {
        let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
        let header = |stamp: u32| [&[0; 4][..], &stamp.to_le_bytes(), &[0; 4], &text("map")].concat();
        let doubles = |numbers: &[f64]| numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let identity = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let mut bytes = [
            header(5),
            1u32.to_le_bytes().into(),
            header(5),
            (hypotheses.len() as u32).to_le_bytes().into(),
        ]
        .concat();
        for (class, score) in hypotheses {
            bytes.extend(class.to_le_bytes());
            bytes.extend(doubles(&[*score]));
            bytes.extend(doubles(&identity));
            bytes.extend(doubles(&[0.0; 36]));
        }
        bytes.extend(doubles(&[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]));
        bytes.extend(doubles(&[4.0, 2.0, 1.5]));
        bytes.extend(header(5));
        bytes.extend([0; 4 + 4 + 4 + 1 + 4 + 4 + 4 + 1]);
        if tracking {
            bytes.push(1);
            bytes.extend(text("a7"));
        }
        bytes
    }

    #[test]
    fn the_hypothesis_of_the_max_score_is_taken() {
        for hypotheses in [
            &[(1, 0.2), (3, 0.7), (2, 0.1)][..],
            &[(1, f64::NAN), (3, 0.7)],
            &[(3, 0.7), (1, 0.7)],
        ] {
            let bytes = of_ros1(hypotheses, true);
            let object = &detections(|| Ok(CdrReader::ros1(&bytes))).unwrap().objects[0];
            assert_eq!((object.class.as_str(), object.score), ("3", 0.7), "{hypotheses:?}");
        }
    }

    #[test]
    fn the_form_that_ends_with_the_message_is_taken() {
        for (tracking, track) in [(false, ""), (true, "a7")] {
            let bytes = of_ros1(&[(3, 0.5)], tracking);
            let found = detections(|| Ok(CdrReader::ros1(&bytes))).unwrap();
            let object = &found.objects[0];
            assert_eq!(
                (object.class.as_str(), object.track.as_str(), object.score),
                ("3", track, 0.5)
            );
            assert_eq!(object.size, [4.0, 2.0, 1.5]);
            let error = detections(|| Ok(CdrReader::ros1(&bytes[..bytes.len() - 1]))).unwrap_err();
            assert!(error.contains("no known form of Detection3DArray"), "{error}");
        }
    }
}
